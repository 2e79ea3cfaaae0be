//! One opened DEM file: where its samples lie, what they mean, and windows of them.

use std::path::{Path, PathBuf};

use super::error::Result;
use super::geotiff::Chunks;
use super::samples::SampleFile;
use crate::projection::{self, Projection};

/// Samples a side, at most: the Earth's equator at 2.4 metres.
pub(super) const SIDE_MAX: u32 = 1 << 24;

/// A rectangle of samples: its south-west sample and its size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Window {
    pub(super) x0: u32,
    pub(super) y0: u32,
    pub(super) width: u32,
    pub(super) height: u32,
}

impl Window {
    pub(super) fn samples(&self) -> usize {
        self.width as usize * self.height as usize
    }
}

/// The CRS of a file.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct SourceCrs {
    pub(super) name: String,
    pub(super) proj4: Option<String>,
    pub(super) geographic: bool,
    /// Metres in one CRS unit; 1 when the unit is the degree.
    pub(super) metres_per_unit: f64,
}

impl SourceCrs {
    /// A CRS by its EPSG code. `geographic` decides only where the tables do not know the code.
    pub(super) fn epsg(code: u32, geographic: bool) -> Self {
        let proj4 = projection::epsg(code).map(str::to_owned);
        Self::new(format!("EPSG:{code}"), proj4, geographic)
    }

    pub(super) fn new(name: String, proj4: Option<String>, geographic: bool) -> Self {
        let known = proj4.as_deref().and_then(|text| Projection::new(text).ok());
        let geographic = known.as_ref().map_or(geographic, Projection::is_geographic);
        // Units are known also where the formulas are not.
        let metres_per_unit = proj4.as_deref().map_or(1.0, projection::unit_metres);
        Self { name, proj4, geographic, metres_per_unit }
    }
}

/// Where samples lie: the south-west sample and the step, in CRS units.
#[derive(Clone, Debug)]
pub(super) struct Place {
    pub(super) origin: [f64; 2],
    pub(super) step: [f64; 2],
    pub(super) crs: Option<SourceCrs>,
}

/// Storage of one sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Dtype {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    F32,
    F64,
}

impl Dtype {
    pub(super) fn bytes(self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    pub(super) fn is_integer(self) -> bool {
        !matches!(self, Self::F32 | Self::F64)
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::U8 => "u8",
            Self::I8 => "i8",
            Self::U16 => "u16",
            Self::I16 => "i16",
            Self::U32 => "u32",
            Self::I32 => "i32",
            Self::F32 => "f32",
            Self::F64 => "f64",
        }
    }

    fn range(self) -> (f64, f64) {
        match self {
            Self::U8 => (0.0, f64::from(u8::MAX)),
            Self::I8 => (f64::from(i8::MIN), f64::from(i8::MAX)),
            Self::U16 => (0.0, f64::from(u16::MAX)),
            Self::I16 => (f64::from(i16::MIN), f64::from(i16::MAX)),
            Self::U32 => (0.0, f64::from(u32::MAX)),
            Self::I32 => (f64::from(i32::MIN), f64::from(i32::MAX)),
            Self::F32 => (f64::from(f32::MIN), f64::from(f32::MAX)),
            Self::F64 => (f64::MIN, f64::MAX),
        }
    }

    /// The value as a sample of this type would hold it, or `None` if no sample can hold it.
    /// NaN and infinities are always nodata, whatever is declared, so any float type holds them.
    pub(super) fn hold(self, value: f64) -> Option<f64> {
        let (low, high) = self.range();
        if !value.is_finite() {
            return (!self.is_integer()).then_some(value);
        }
        // Decimal text such as 3.40282347e38 may lie a rounding beyond f32::MAX.
        let value = if self == Self::F32 { f32_nearest(value) } else { value };
        let whole = !self.is_integer() || value.fract() == 0.0;
        (whole && (low..=high).contains(&value)).then_some(value)
    }
}

#[expect(clippy::cast_possible_truncation, reason = "rounding to the precision of f32 is the purpose")]
fn f32_nearest(value: f64) -> f64 {
    f64::from(value as f32)
}

/// Where the numbers come from.
pub(super) enum Samples {
    Tiff(Chunks),
    File(SampleFile),
}

/// One opened DEM.
pub(super) struct Raster {
    pub(super) file: PathBuf,
    pub(super) width: u32,
    pub(super) height: u32,
    /// `None` when the file says nothing of where it lies or how large its cells are.
    pub(super) place: Option<Place>,
    pub(super) dtype: Dtype,
    pub(super) integer: bool,
    pub(super) height_scale: f64,
    pub(super) height_offset: f64,
    /// What the file says of its heights, where it is unclear how many metres a value is.
    pub(super) height_doubt: Option<String>,
    pub(super) nodata: Option<f64>,
    /// What its bands are, if it is a picture: then it has no heights.
    pub(super) picture: Option<Picture>,
    pub(super) samples: Samples,
}

/// What is to be read from files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Wanted {
    /// One band of heights.
    Heights,
    /// Bands of 8 bits: grey, or red, green and blue, and perhaps how opaque they are.
    Imagery,
}

/// The bands of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Picture {
    /// 1 (grey) or 3 (red, green, blue): the first ones of the file.
    pub(super) colours: u32,
    /// The band that tells how opaque a pixel is, if there is one.
    pub(super) opacity: Option<u32>,
}

/// The band by which the opacity of a picture is asked for; 0 to 2 are red, green and blue.
pub(super) const OPACITY: u32 = 3;

/// The value of an opaque pixel.
const OPAQUE: f64 = 255.0;

impl Raster {
    /// A file of plain values: metres of height, or the bands of a picture.
    pub(super) fn plain(
        file: &Path,
        samples: SampleFile,
        place: Option<Place>,
        picture: Option<Picture>,
    ) -> Self {
        Self {
            file: file.to_owned(),
            width: samples.width,
            height: samples.height,
            place,
            dtype: samples.dtype,
            integer: samples.dtype.is_integer(),
            height_scale: 1.0,
            height_offset: 0.0,
            height_doubt: None,
            nodata: None,
            picture,
            samples: Samples::File(samples),
        }
    }

    /// Fills `out` (as long as the window, rows from the south) with values, NaN for nodata. `band` is for pictures.
    pub(super) fn read(&self, window: Window, band: u32, out: &mut [f64]) -> Result<()> {
        debug_assert_eq!(out.len(), window.samples());
        if let Some(picture) = self.picture {
            return self.read_picture(picture, window, band, out);
        }
        self.stored(window, 0, out)?;
        // Without nodata this compares with NaN, which equals nothing.
        let nodata = self.nodata.unwrap_or(f64::NAN);
        for value in out {
            if *value == nodata || !value.is_finite() {
                *value = f64::NAN;
            }
        }
        Ok(())
    }

    /// Values as the file has them.
    fn stored(&self, window: Window, band: u32, out: &mut [f64]) -> Result<()> {
        match &self.samples {
            Samples::Tiff(chunks) => chunks.read(&self.file, window, band, out),
            Samples::File(samples) => samples.read(&self.file, window, band, out),
        }
    }

    /// A band of a picture; NaN where nothing is to be seen, so that no colour comes from there.
    fn read_picture(&self, picture: Picture, window: Window, band: u32, out: &mut [f64]) -> Result<()> {
        match if band == OPACITY { picture.opacity } else { Some(band.min(picture.colours - 1)) } {
            Some(own) => self.stored(window, own, out)?,
            None => out.fill(OPAQUE),
        }
        let mut other = vec![0.0; out.len()];
        if let Some(opacity) = picture.opacity {
            self.stored(window, opacity, &mut other)?;
            for (value, _) in out.iter_mut().zip(&other).filter(|(_, opacity)| **opacity == 0.0) {
                *value = f64::NAN;
            }
        }
        if let Some(nodata) = self.nodata {
            let mut is_empty = vec![true; out.len()];
            for colour in 0..picture.colours {
                self.stored(window, colour, &mut other)?;
                is_empty.iter_mut().zip(&other).for_each(|(is_empty, value)| *is_empty &= *value == nodata);
            }
            for (value, _) in out.iter_mut().zip(is_empty).filter(|(_, is_empty)| *is_empty) {
                *value = f64::NAN;
            }
        }
        Ok(())
    }
}

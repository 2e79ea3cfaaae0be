//! GeoKeys of a TIFF → a CRS, a vertical unit and where a sample lies in its cell.
//!
//! After OGC GeoTIFF 1.1 (19-008r4). A directory of 16-bit numbers (tag 34735) points into lists of
//! doubles (34736) and text (34737). Value 32767 means "defined by the other keys".

use std::collections::HashMap;
use std::fmt::Write;
use std::path::Path;

use super::error::unsupported;
use super::raster::SourceCrs;
use super::tiff_header::{Header, VALUES_MAX};
use super::units::{Vertical, linear_metres, vertical};
use crate::projection;

const USER_DEFINED: u64 = 32767;

/// What the keys say.
pub(super) struct GeoKeys {
    pub(super) crs: Option<SourceCrs>,
    /// True when the tie point is a sample, not the corner of a cell.
    pub(super) sample_is_point: bool,
    /// Metres in one unit of height, where the file says it; or what it says, where that is unclear.
    pub(super) vertical_metres: Option<Result<f64, String>>,
}

/// Geographic systems of the EPSG's whose unit is the grad.
const GRADS: [u32; 8] = [4807, 4810, 4811, 4816, 4819, 4821, 4901, 4902];

struct Keys {
    shorts: HashMap<u64, u64>,
    doubles: HashMap<u64, f64>,
    texts: HashMap<u64, String>,
}

impl GeoKeys {
    pub(super) fn read(path: &Path, header: &Header<'_>) -> super::error::Result<Self> {
        let keys = Keys::read(header)?;
        Ok(Self {
            crs: keys.crs(path)?,
            sample_is_point: keys.short(1025) == Some(2),
            vertical_metres: keys.vertical(),
        })
    }
}

impl Keys {
    fn read(header: &Header<'_>) -> super::error::Result<Self> {
        let directory = header.integers(34735, VALUES_MAX)?;
        let doubles = header.reals(34736, VALUES_MAX)?;
        let text = header.text(34737)?.unwrap_or_default();
        let mut keys = Self { shorts: HashMap::new(), doubles: HashMap::new(), texts: HashMap::new() };
        for key in directory.as_chunks::<4>().0.iter().skip(1) {
            let [id, place, count, value] = *key;
            let from = usize::try_from(value).unwrap_or(usize::MAX);
            match place {
                0 => drop(keys.shorts.insert(id, value)),
                34736 => {
                    if let Some(v) = doubles.get(from).filter(|v| v.is_finite()) {
                        keys.doubles.insert(id, *v);
                    }
                }
                34737 => {
                    let count = usize::try_from(count).unwrap_or(0);
                    let piece = text.get(from..from.saturating_add(count).min(text.len())).unwrap_or("");
                    keys.texts.insert(id, piece.trim_matches(['|', ' ', '\0']).to_owned());
                }
                _ => {}
            }
        }
        Ok(keys)
    }

    fn short(&self, key: u64) -> Option<u64> {
        self.shorts.get(&key).copied()
    }

    fn double(&self, key: u64) -> Option<f64> {
        self.doubles.get(&key).copied()
    }

    /// An EPSG code; absent, zero and "user-defined" are all `None`.
    fn code(&self, key: u64) -> Option<u32> {
        let value = self.short(key).filter(|v| !matches!(*v, 0 | USER_DEFINED | 65535))?;
        u32::try_from(value).ok()
    }

    /// Metres in one unit of height: said by a unit, a vertical CRS, or a compound one in the place of a plain.
    fn vertical(&self) -> Option<Result<f64, String>> {
        let code = self.code(4096);
        let counts = code.map(|code| (code, vertical(code)));
        if let Some((code, Some(Vertical::Depths))) = counts {
            return Some(Err(format!("depths, which grow downwards (vertical CRS EPSG:{code})")));
        }
        if let Some(unit) = self.code(4099) {
            return Some(
                linear_metres(unit).ok_or(format!("heights in unit EPSG:{unit}, which is not known")),
            );
        }
        match counts {
            Some((_, Some(Vertical::Heights(metres)))) => return Some(Ok(metres)),
            // GDAL writes a geographic system with heights above the ellipsoid here: they are in metres.
            Some((code, _)) if projection::epsg(code).is_some_and(|text| text.contains("+proj=longlat")) => {
                return Some(Ok(1.0));
            }
            Some((code, _)) => {
                return Some(Err(format!("heights in vertical CRS EPSG:{code}, whose unit is not known")));
            }
            None => {}
        }
        let compound = [3072, 2048].into_iter().find_map(|key| projection::epsg(self.code(key)?));
        compound.and_then(projection::vertical_metres).map(Ok)
    }

    fn crs(&self, path: &Path) -> super::error::Result<Option<SourceCrs>> {
        let projected = self.short(3072).is_some() && self.short(1024) != Some(2);
        let geographic = self.short(2048).is_some();
        if self.short(1024) == Some(3) {
            return Err(unsupported(
                path,
                "a geographic or projected CRS",
                "geocentric coordinates",
                "reproject it, for instance with gdalwarp -t_srs EPSG:4326",
            ));
        }
        if projected {
            return self.projected(path).map(Some);
        }
        if !geographic {
            return Ok(None);
        }
        self.check_degrees(path)?;
        Ok(Some(match self.code(2048) {
            Some(code) => SourceCrs::epsg(code, true),
            None => SourceCrs::new(
                self.citation(&[2049, 1026], "geographic"),
                Some(format!("+proj=longlat {} +no_defs", self.datum())),
                true,
            ),
        }))
    }

    /// Refuses longitudes and latitudes that are not in degrees.
    fn check_degrees(&self, path: &Path) -> super::error::Result<()> {
        let grads = self.code(2048).is_some_and(|code| GRADS.contains(&code));
        let found = match self.short(2054) {
            Some(9102 | 9107 | 9108 | 9122) => return Ok(()),
            // Radians in one unit; without the number there is nothing to judge by.
            Some(USER_DEFINED)
                if self.double(2055).is_none_or(|u| (u / 1f64.to_radians() - 1.0).abs() < 1e-6) =>
            {
                return Ok(());
            }
            Some(USER_DEFINED) => "a unit of its own".to_owned(),
            Some(code) if code != 0 => format!("angles in unit EPSG:{code}"),
            _ if grads => "a CRS whose unit is the grad".to_owned(),
            _ => return Ok(()),
        };
        Err(unsupported(
            path,
            "longitudes and latitudes in degrees",
            found,
            "reproject it, for instance with gdalwarp -t_srs EPSG:4326",
        ))
    }

    fn projected(&self, path: &Path) -> super::error::Result<SourceCrs> {
        let unit = match self.short(3076).filter(|code| !matches!(code, 0 | 65535)) {
            Some(USER_DEFINED) => self.double(3077),
            Some(code) => Some(u32::try_from(code).ok().and_then(linear_metres).ok_or_else(|| {
                unsupported(
                    path,
                    "coordinates in a unit known here, such as metres or feet",
                    format!("unit EPSG:{code}"),
                    "reproject it, for instance with gdalwarp -t_srs and a CRS in metres",
                )
            })?),
            None => None,
        }
        .filter(|m| *m > 0.0);
        let mut crs = match self.code(3072) {
            Some(code) => SourceCrs::epsg(code, false),
            None => {
                let proj4 = self
                    .projection(unit.unwrap_or(1.0))
                    .map(|text| format!("{text} {} +no_defs", self.datum()));
                let name = self.citation(&[3073, 1026], proj4.as_deref().unwrap_or("unnamed projection"));
                SourceCrs::new(name, proj4, false)
            }
        };
        // The unit of the coordinates may differ from the definition's; the keys win, as in GDAL.
        if let Some(metres) = unit.filter(|m| (m / crs.metres_per_unit - 1.0).abs() > 1e-9) {
            if let Some(text) = &mut crs.proj4 {
                let words = text.split_whitespace();
                let kept = words.filter(|w| !w.starts_with("+units=") && !w.starts_with("+to_meter="));
                *text = format!("{} +to_meter={metres}", kept.collect::<Vec<_>>().join(" "));
            }
            crs.metres_per_unit = metres;
        }
        Ok(crs)
    }

    /// The first citation that says something.
    fn citation(&self, keys: &[u64], otherwise: &str) -> String {
        let said = keys.iter().filter_map(|k| self.texts.get(k));
        let mut said = said.filter(|t| !t.is_empty() && !t.to_lowercase().contains("unknown"));
        said.next().map_or(otherwise, String::as_str).to_owned()
    }

    /// Ellipsoid, datum and prime meridian as PROJ words.
    fn datum(&self) -> String {
        if let Some(known) = self.code(2048).and_then(projection::epsg) {
            let words = known.split_whitespace();
            let words = words.filter(|w| !w.starts_with("+proj=") && !w.starts_with("+no_defs"));
            return words.collect::<Vec<_>>().join(" ");
        }
        let a = self.double(2057).filter(|a| *a > 0.0);
        let b = self.double(2058).filter(|b| *b > 0.0);
        let rf = self.double(2059).filter(|rf| *rf > 0.0);
        let mut text = match (a, b, rf) {
            (Some(a), Some(b), _) if a == b => format!("+R={a}"),
            (Some(a), Some(b), _) => format!("+a={a} +b={b}"),
            (Some(a), None, Some(rf)) => format!("+a={a} +rf={rf}"),
            (Some(a), None, None) => format!("+R={a}"),
            (None, ..) => match self.short(2056) {
                Some(7019) => "+ellps=GRS80".to_owned(),
                Some(7008) => "+ellps=clrk66".to_owned(),
                _ => "+datum=WGS84".to_owned(),
            },
        };
        if let Some(pm) = self.double(2061).filter(|pm| *pm != 0.0) {
            // Writing to a String cannot fail.
            let _ = write!(text, " +pm={pm}");
        }
        text
    }

    /// The projection and its parameters as PROJ words; `None` for methods that are not known here.
    fn projection(&self, unit_metres: f64) -> Option<String> {
        match self.short(3074) {
            Some(code @ 16001..=16060) => return Some(format!("+proj=utm +zone={}", code - 16000)),
            Some(code @ 16101..=16160) => return Some(format!("+proj=utm +zone={} +south", code - 16100)),
            _ => {}
        }
        let first = |keys: &[u64]| keys.iter().find_map(|k| self.double(*k)).unwrap_or(0.0);
        let lon = first(&[3080, 3084, 3088, 3095]);
        let lat = first(&[3081, 3085, 3089]);
        let (lat_1, lat_2) = (first(&[3078]), first(&[3079]));
        let k = self.double(3092).or(self.double(3093)).unwrap_or(1.0);
        // Keys are in the file's unit, PROJ's false origins always in metres.
        let x = first(&[3082, 3086, 3090]) * unit_metres;
        let y = first(&[3083, 3087, 3091]) * unit_metres;
        let method = match self.short(3075)? {
            1 => format!("+proj=tmerc +lat_0={lat} +lon_0={lon} +k={k}"),
            7 if self.double(3078).is_some() => format!("+proj=merc +lat_ts={lat_1} +lon_0={lon}"),
            7 => format!("+proj=merc +lon_0={lon} +k={k}"),
            8 => format!("+proj=lcc +lat_1={lat_1} +lat_2={lat_2} +lat_0={lat} +lon_0={lon}"),
            9 => format!("+proj=lcc +lat_1={lat} +lat_0={lat} +lon_0={lon} +k_0={k}"),
            10 => format!("+proj=laea +lat_0={lat} +lon_0={lon}"),
            11 => format!("+proj=aea +lat_1={lat_1} +lat_2={lat_2} +lat_0={lat} +lon_0={lon}"),
            15 if lat < 0.0 => format!("+proj=stere +lat_0=-90 +lat_ts={lat} +lon_0={lon} +k={k}"),
            15 => format!("+proj=stere +lat_0=90 +lat_ts={lat} +lon_0={lon} +k={k}"),
            17 => format!("+proj=eqc +lat_ts={lat_1} +lat_0={lat} +lon_0={lon}"),
            _ => return None,
        };
        Some(format!("{method} +x_0={x} +y_0={y}"))
    }
}

//! Plain files of samples, read by position: raw input, `.hgt`, and what the sequential formats are
//! transcribed into. Nothing but the window asked for is in memory.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::os::unix::fs::FileExt;
use std::path::Path;

use super::error::{Result, broken, io_error};
use super::raster::{Dtype, Window};

/// How samples follow each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Order {
    /// Rows from north to south, each from west to east.
    RowsFromNorth,
    /// Columns from west to east, each from south to north.
    ColumnsFromSouth,
}

/// A file that holds width x height samples and nothing else.
pub(super) struct SampleFile {
    pub(super) file: File,
    pub(super) dtype: Dtype,
    pub(super) big_endian: bool,
    pub(super) order: Order,
    pub(super) width: u32,
    pub(super) height: u32,
    /// Values at each place, one after the other: more than one only of rows from the north.
    pub(super) bands: u32,
}

impl SampleFile {
    /// Checks that the file has as many bytes as its shape needs.
    pub(super) fn check_length(&self, path: &Path) -> Result<()> {
        let found = self.file.metadata().map_err(io_error(path, "ask for its length"))?.len();
        let expected = u64::from(self.width) * u64::from(self.height) * self.place_bytes() as u64;
        if found == expected {
            return Ok(());
        }
        let shape = format!("{} x {} samples of {}", self.width, self.height, self.dtype.name());
        Err(broken(
            path,
            format!("{expected} bytes for {shape}"),
            format!("{found} bytes"),
            "correct the shape, or fetch the file again if it was cut short",
        ))
    }

    fn place_bytes(&self) -> usize {
        self.dtype.bytes() * self.bands as usize
    }

    /// Values of a band as stored. One positioned read for each row (or column) of the window.
    pub(super) fn read(&self, path: &Path, window: Window, band: u32, out: &mut [f64]) -> Result<()> {
        let (w, h) = (window.width as usize, window.height as usize);
        let size = self.dtype.bytes();
        match self.order {
            Order::RowsFromNorth => {
                let mut bytes = vec![0; w * self.place_bytes()];
                for (y, row) in (window.y0..).zip(out.chunks_exact_mut(w.max(1))) {
                    let before =
                        u64::from(self.height - 1 - y) * u64::from(self.width) + u64::from(window.x0);
                    self.read_at(path, before, &mut bytes)?;
                    decode(
                        band_of(&mut bytes, size, self.bands, band),
                        self.dtype,
                        self.big_endian,
                        row.iter_mut(),
                    );
                }
            }
            Order::ColumnsFromSouth => {
                let mut bytes = vec![0; h * size];
                for (i, x) in (window.x0..window.x0 + window.width).enumerate() {
                    let before = u64::from(x) * u64::from(self.height) + u64::from(window.y0);
                    self.read_at(path, before, &mut bytes)?;
                    decode(&bytes, self.dtype, self.big_endian, out.iter_mut().skip(i).step_by(w));
                }
            }
        }
        Ok(())
    }

    fn read_at(&self, path: &Path, samples_before: u64, bytes: &mut [u8]) -> Result<()> {
        let at = samples_before * self.place_bytes() as u64;
        self.file.read_exact_at(bytes, at).map_err(io_error(path, "read samples"))
    }
}

/// Moves the values of one band, of `size` bytes each, to the front of those of all bands.
pub(super) fn band_of(bytes: &mut [u8], size: usize, bands: u32, band: u32) -> &[u8] {
    let (bands, band) = (bands as usize, band as usize);
    if bands == 1 {
        return bytes;
    }
    let places = bytes.len() / (bands * size);
    for place in 0..places {
        let from = (place * bands + band) * size;
        bytes.copy_within(from..from + size, place * size);
    }
    &bytes[..places * size]
}

/// Turns bytes into values, one for each place of `out`.
pub(super) fn decode<'a>(
    bytes: &[u8],
    dtype: Dtype,
    big_endian: bool,
    out: impl Iterator<Item = &'a mut f64>,
) {
    macro_rules! each {
        ($type:ty) => {{
            let (chunks, _) = bytes.as_chunks::<{ size_of::<$type>() }>();
            if big_endian {
                out.zip(chunks).for_each(|(o, b)| *o = f64::from(<$type>::from_be_bytes(*b)));
            } else {
                out.zip(chunks).for_each(|(o, b)| *o = f64::from(<$type>::from_le_bytes(*b)));
            }
        }};
    }
    match dtype {
        Dtype::U8 => each!(u8),
        Dtype::I8 => each!(i8),
        Dtype::U16 => each!(u16),
        Dtype::I16 => each!(i16),
        Dtype::U32 => each!(u32),
        Dtype::I32 => each!(i32),
        Dtype::F32 => each!(f32),
        Dtype::F64 => each!(f64),
    }
}

/// Writes values one after the other into a temporary file that vanishes with its handle.
pub(super) struct Transcript {
    writer: BufWriter<File>,
    values: u64,
}

impl Transcript {
    pub(super) fn new(path: &Path) -> Result<Self> {
        let file = tempfile::tempfile().map_err(io_error(path, "create a temporary file"))?;
        Ok(Self { writer: BufWriter::with_capacity(1 << 18, file), values: 0 })
    }

    pub(super) fn values(&self) -> u64 {
        self.values
    }

    pub(super) fn push(&mut self, path: &Path, value: f64) -> Result<()> {
        self.values += 1;
        self.writer.write_all(&value.to_le_bytes()).map_err(io_error(path, "write a temporary file"))
    }

    pub(super) fn finish(self, path: &Path, order: Order, width: u32, height: u32) -> Result<SampleFile> {
        let file =
            self.writer.into_inner().map_err(|e| io_error(path, "write a temporary file")(e.into_error()))?;
        let samples =
            SampleFile { file, dtype: Dtype::F64, big_endian: false, order, width, height, bands: 1 };
        samples.check_length(path)?;
        Ok(samples)
    }
}

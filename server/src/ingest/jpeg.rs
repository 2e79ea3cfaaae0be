//! JPEG: pictures, whose place a world file tells.
//!
//! It cannot be read by position: it is decoded whole, once, to a temporary file. Memory: the file and 3 bytes a pixel.

use std::fs::File;
use std::io::{Read, Write};
use std::path::Path;

use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use super::error::{Result, broken, io_error, unsupported};
use super::raster::{Dtype, Picture, Raster};
use super::samples::{Order, SampleFile};
use super::world_file;

/// Pixels of the largest picture: 600 MB of memory.
const PIXELS_MAX: u64 = 200_000_000;

/// The largest file, in bytes: no picture of so many pixels is larger.
const FILE_BYTES_MAX: u64 = 1 << 30;

pub(super) fn open(path: &Path, mut file: File) -> Result<Raster> {
    let failed = |what: String| broken(path, "a whole JPEG", what, "the file is damaged: fetch it again");
    let mut bytes = Vec::new();
    let read = Read::by_ref(&mut file).take(FILE_BYTES_MAX + 1).read_to_end(&mut bytes);
    read.map_err(io_error(path, "read it"))?;
    let mut decoder = JpegDecoder::new(ZCursor::new(&bytes[..]));
    decoder.decode_headers().map_err(|e| failed(e.to_string()))?;
    let (width, height) = decoder.dimensions().ok_or_else(|| failed("no size".to_owned()))?;
    let pixels = width as u64 * height as u64;
    if pixels > PIXELS_MAX || bytes.len() as u64 > FILE_BYTES_MAX {
        return Err(unsupported(
            path,
            format!("at most {PIXELS_MAX} pixels in a JPEG"),
            format!("{width} x {height} pixels in {} bytes", bytes.len()),
            "convert it with gdal_translate -co TILED=YES -co COMPRESS=JPEG, which is read in parts",
        ));
    }
    let is_grey = decoder.input_colorspace() == Some(ColorSpace::Luma);
    let (colours, space) = if is_grey { (1, ColorSpace::Luma) } else { (3, ColorSpace::RGB) };
    decoder.set_options(DecoderOptions::default().jpeg_set_out_colorspace(space));
    let decoded = decoder.decode().map_err(|e| failed(e.to_string()))?;
    let mut file = tempfile::tempfile().map_err(io_error(path, "create a temporary file"))?;
    file.write_all(&decoded).map_err(io_error(path, "write a temporary file"))?;
    // JPEG has 16 bits for each side.
    let side = |texels: usize| u32::try_from(texels).unwrap_or(u32::MAX);
    let (width, height, dtype) = (side(width), side(height), Dtype::U8);
    let order = Order::RowsFromNorth;
    let samples = SampleFile { file, dtype, big_endian: false, order, width, height, bands: colours };
    samples.check_length(path)?;
    let picture = Picture { colours, opacity: None };
    Ok(Raster::plain(path, samples, world_file::find(path, height)?, Some(picture)))
}

//! PNG: greyscale of 8 or 16 bits as heights, whose cells come from `--cell` or a world file; or pictures, of which 8
//! bits a band count.
//!
//! PNG cannot be read by position, so rows are transcribed once to a temporary file. Memory: one row.

use std::fs::File;
use std::io::{BufReader, BufWriter, Write};
use std::path::Path;

use ::png::{BitDepth, ColorType, Decoder, Limits, Transformations};

use super::error::{Result, broken, io_error, unsupported};
use super::raster::{Dtype, Picture, Raster, SIDE_MAX, Wanted};
use super::samples::{Order, SampleFile};
use super::world_file;

/// What the decoder may allocate: a few rows of the widest picture.
const DECODER_BYTES_MAX: usize = 256 << 20;

pub(super) fn open(path: &Path, file: File, wanted: Wanted) -> Result<Raster> {
    let failed = |e: ::png::DecodingError| {
        broken(path, "a whole PNG", e.to_string(), "the file is damaged: fetch it again")
    };
    let limits = Limits { bytes: DECODER_BYTES_MAX };
    let mut decoder = Decoder::new_with_limits(BufReader::new(file), limits);
    if wanted == Wanted::Imagery {
        decoder.set_transformations(Transformations::normalize_to_color8());
    }
    let mut reader = decoder.read_info().map_err(failed)?;
    let colour = reader.output_color_type().0;
    let info = reader.info();
    let (width, height) = (info.width, info.height);
    if width > SIDE_MAX || height > SIDE_MAX {
        let found = format!("{width} x {height}");
        return Err(broken(
            path,
            format!("at most {SIDE_MAX} samples a side"),
            found,
            "fetch the file again",
        ));
    }
    let picture = match (wanted, colour) {
        (Wanted::Heights, _) => None,
        (Wanted::Imagery, ColorType::Grayscale) => Some(Picture { colours: 1, opacity: None }),
        (Wanted::Imagery, ColorType::GrayscaleAlpha) => Some(Picture { colours: 1, opacity: Some(1) }),
        (Wanted::Imagery, ColorType::Rgba) => Some(Picture { colours: 3, opacity: Some(3) }),
        // What has a palette has been given its colours.
        (Wanted::Imagery, ColorType::Rgb | ColorType::Indexed) => Some(Picture { colours: 3, opacity: None }),
    };
    let dtype = match (info.color_type, info.bit_depth, info.interlaced) {
        (_, _, false) if picture.is_some() => Dtype::U8,
        (_, _, true) if picture.is_some() => {
            let remedy = "save it again without interlacing";
            return Err(unsupported(path, "a picture that is not interlaced", "an interlaced one", remedy));
        }
        (ColorType::Grayscale, BitDepth::Eight, false) => Dtype::U8,
        (ColorType::Grayscale, BitDepth::Sixteen, false) => Dtype::U16,
        (ColorType::Grayscale, depth, interlaced) => {
            return Err(unsupported(
                path,
                "8 or 16 bits a sample, not interlaced",
                format!("{depth:?} bits, {}", if interlaced { "interlaced" } else { "not interlaced" }),
                "save it again as 16-bit greyscale without interlacing",
            ));
        }
        (colour, ..) => {
            return Err(unsupported(
                path,
                "a greyscale picture of heights",
                format!("{colour:?}: imagery"),
                "save the heights themselves as 16-bit greyscale; imagery has none",
            ));
        }
    };
    let bands = picture.map_or(1, |picture| picture.colours + u32::from(picture.opacity.is_some()));
    let file = tempfile::tempfile().map_err(io_error(path, "create a temporary file"))?;
    let mut writer = BufWriter::with_capacity(1 << 18, file);
    while let Some(row) = reader.next_row().map_err(failed)? {
        writer.write_all(row.data()).map_err(io_error(path, "write a temporary file"))?;
    }
    let file = writer.into_inner().map_err(|e| io_error(path, "write a temporary file")(e.into_error()))?;
    let samples =
        SampleFile { file, dtype, big_endian: true, order: Order::RowsFromNorth, width, height, bands };
    samples.check_length(path)?;
    Ok(Raster::plain(path, samples, world_file::find(path, height)?, picture))
}

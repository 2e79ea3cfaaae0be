//! SRTM `.hgt`: a square of big-endian 16-bit metres, rows from the north, shared rims, void −32768.
//!
//! The file says nothing of itself: its length gives the side, its name the south-west corner
//! (`N46E008.hgt` covers 46 to 47 degrees north and 8 to 9 degrees east).

use std::fs::File;
use std::path::Path;

use super::error::{Result, broken, io_error, options};
use super::raster::{Dtype, Place, Raster, SIDE_MAX, Samples, SourceCrs};
use super::samples::{Order, SampleFile};

/// Opens a square of samples; `name` is the file's own, also where it was packed under another.
pub(super) fn open(path: &Path, file: File, name: &str) -> Result<Raster> {
    let length = file.metadata().map_err(io_error(path, "ask for its length"))?.len();
    let side = (length / 2).isqrt();
    if side * side * 2 != length || side < 2 || side > u64::from(SIDE_MAX) {
        return Err(broken(
            path,
            "a square of 16-bit samples (1201 x 1201 is 2884802 bytes)",
            format!("{length} bytes"),
            "fetch the file again; for another shape use --raw WIDTHxHEIGHT:i16 (little-endian)",
        ));
    }
    let side = u32::try_from(side).unwrap_or(SIDE_MAX);
    let [lon, lat] = corner(name).ok_or_else(|| {
        options(
            path,
            "a name that begins with the corner, such as N46E008",
            format!("'{name}'"),
            "give the file its original name back",
        )
    })?;
    let step = 1.0 / f64::from(side - 1);
    let crs = Some(SourceCrs::epsg(4326, true));
    let samples = SampleFile {
        file,
        dtype: Dtype::I16,
        big_endian: true,
        order: Order::RowsFromNorth,
        width: side,
        height: side,
        bands: 1,
    };
    Ok(Raster {
        file: path.to_owned(),
        width: side,
        height: side,
        place: Some(Place { origin: [lon, lat], step: [step, step], crs }),
        dtype: Dtype::I16,
        integer: true,
        height_scale: 1.0,
        height_offset: 0.0,
        height_doubt: None,
        nodata: Some(-32768.0),
        picture: None,
        samples: Samples::File(samples),
    })
}

/// Longitude and latitude of the south-west corner, from a name such as `S46W066.hgt.gz`.
fn corner(name: &str) -> Option<[f64; 2]> {
    let name = name.to_ascii_uppercase();
    let number = |range: std::ops::Range<usize>| -> Option<f64> {
        let digits = name.get(range)?;
        digits.bytes().all(|b| b.is_ascii_digit()).then(|| digits.parse().ok())?
    };
    let sign = |at: usize, plus: u8, minus: u8| match name.as_bytes().get(at) {
        Some(b) if *b == plus => Some(1.0),
        Some(b) if *b == minus => Some(-1.0),
        _ => None,
    };
    let lat = sign(0, b'N', b'S')? * number(1..3)?;
    let lon = sign(3, b'E', b'W')? * number(4..7)?;
    ((-90.0..90.0).contains(&lat) && (-180.0..180.0).contains(&lon)).then_some([lon, lat])
}

//! USGS ASCII DEM (`.dem`): the old format of 1024-byte records, column by column.
//!
//! | record A, bytes | field |
//! |---|---|
//! | 156..162, 162..168 | reference system (0 geographic, 1 UTM), UTM zone |
//! | 528..534, 534..540 | unit on the ground (2 metres, 3 arc seconds), unit of height (1 feet, 2 metres) |
//! | 546..738 | corners of the quadrangle: x, y of SW, NW, NE, SE |
//! | 816..852 | resolution in x, y and z |
//! | 858..864 | columns |
//! | 890..892 | horizontal datum (1 NAD27, 2 WGS 72, 3 WGS 84, 4 NAD83), blank in the oldest: NAD27 |
//!
//! Each column is a record B: 24 bytes of counts, then x, y of its southernmost sample and the local
//! datum (24 bytes each), then after byte 144 six-letter heights from south to north, 146 in the first
//! 1024 bytes and 170 in each further 1024. Columns start and end where the quadrangle does, so a first
//! pass over their headers finds the rectangle and a second transcribes them, padded with nodata.
//! Memory: one column.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::Path;

use super::error::{Result, broken, io_error, unsupported};
use super::raster::{Dtype, Place, Raster, SIDE_MAX, Samples, SourceCrs};
use super::samples::{Order, Transcript};

const RECORD: u64 = 1024;
const PROFILE_HEADER: usize = 144;
const FIRST_HEIGHTS: u64 = 146;
const FURTHER_HEIGHTS: u64 = 170;
/// Samples of the padded rectangle for each byte of the file, at most.
const PADDED_SAMPLES_MAX: u64 = 4;
const VOID: f64 = -32767.0;
const REMEDY: &str = "fetch the file again, or convert it to GeoTIFF";

/// True if the first bytes of a file look like a record A.
pub(super) fn looks_like(start: &[u8]) -> bool {
    let field =
        |from, to| start.get(from..to).and_then(|b| std::str::from_utf8(b).ok()?.trim().parse::<u32>().ok());
    start.len() >= 1024
        && field(144, 150).is_some_and(|level| (1..=4).contains(&level))
        && field(150, 156) == Some(1)
        && field(156, 162).is_some()
}

/// Record A, checked.
struct Header {
    crs: SourceCrs,
    /// CRS units in one unit of the file.
    unit: f64,
    step: [f64; 2],
    z_step: f64,
    height_metres: f64,
    columns: u32,
    /// Lowest and highest y of the quadrangle's corners, NaN if blank.
    corners: [f64; 2],
}

/// Where a column lies: the byte of its record, samples north of the southernmost row, and count.
struct Column {
    at: u64,
    south: f64,
    count: u32,
}

pub(super) fn open(path: &Path, file: &File) -> Result<Raster> {
    let mut record = [0; 1024];
    file.read_exact_at(&mut record, 0).map_err(io_error(path, "read its header"))?;
    let header = header(path, &record)?;
    let (columns, west) = columns(path, file, &header)?;
    let lowest = columns.iter().map(|c| c.south).fold(f64::INFINITY, f64::min);
    let south = lowest - header.step[1] * rows_outside(lowest - header.corners[0], header.step[1]);
    let mut height = 0;
    let mut skips = Vec::with_capacity(columns.len());
    for column in &columns {
        let skip = (column.south - south) / header.step[1];
        let whole =
            super::whole(skip.round()).filter(|k| *k < SIDE_MAX && (skip - f64::from(*k)).abs() < 0.01);
        let skip = whole.ok_or_else(|| {
            broken(path, "columns on one lattice", format!("one that starts {skip} samples north"), REMEDY)
        })?;
        height = height.max(skip + column.count);
        skips.push(skip);
    }
    let highest = south + f64::from(height.saturating_sub(1)) * header.step[1];
    let above = rows_outside(header.corners[1] - highest, header.step[1]);
    height = super::whole(f64::from(height) + above).unwrap_or(0);
    if !(1..=SIDE_MAX).contains(&height) {
        return Err(broken(path, format!("1 to {SIDE_MAX} rows"), height.to_string(), REMEDY));
    }
    // Real quadrangles are mostly full (6 bytes a sample); a hostile one could pad without end.
    let length = file.metadata().map_err(io_error(path, "ask for its length"))?.len();
    let samples = u64::from(header.columns) * u64::from(height);
    if samples > length.saturating_mul(PADDED_SAMPLES_MAX) {
        let found = format!("{} columns of {height} rows", header.columns);
        return Err(broken(path, format!("columns that fit {length} bytes"), found, REMEDY));
    }
    let mut transcript = Transcript::new(path)?;
    let mut integer = header.z_step.fract() == 0.0;
    for (column, skip) in columns.iter().zip(skips) {
        let (datum, heights) = heights(path, file, column)?;
        integer &= datum.fract() == 0.0;
        let below = std::iter::repeat_n(f64::NAN, skip as usize);
        let above = std::iter::repeat_n(f64::NAN, (height - skip - column.count) as usize);
        let values = heights.iter().map(|h| if *h == VOID { f64::NAN } else { datum + h * header.z_step });
        for value in below.chain(values).chain(above) {
            transcript.push(path, value)?;
        }
    }
    let samples = transcript.finish(path, Order::ColumnsFromSouth, header.columns, height)?;
    let step = header.step.map(|s| s * header.unit);
    let origin = [west * header.unit, south * header.unit];
    Ok(Raster {
        file: path.to_owned(),
        width: header.columns,
        height,
        place: Some(Place { origin, step, crs: Some(header.crs) }),
        dtype: Dtype::F64,
        integer,
        height_scale: header.height_metres,
        height_offset: 0.0,
        height_doubt: None,
        nodata: None,
        picture: None,
        samples: Samples::File(samples),
    })
}

fn header(path: &Path, record: &[u8]) -> Result<Header> {
    let zone = whole(record, 162, 168).unwrap_or(0);
    let datum = whole(record, 890, 892).unwrap_or(1);
    let zone_code = u32::try_from(zone.unsigned_abs()).unwrap_or(0);
    let bad =
        |expected: &str, found: String| Err(unsupported(path, expected, found, "convert it to GeoTIFF"));
    let (code, geographic) = match (whole(record, 156, 162), whole(record, 528, 534), datum) {
        (Some(0), Some(3), 1) => (4267, true),
        (Some(0), Some(3), 2) => (4322, true),
        (Some(0), Some(3), 3) => (4326, true),
        (Some(0), Some(3), 4) => (4269, true),
        (Some(1), Some(2), 0 | 1) if (1..=22).contains(&zone) => (26700 + zone_code, false),
        (Some(1), Some(2), 2) if (1..=60).contains(&zone) => (32200 + zone_code, false),
        (Some(1), Some(2), 3) if (1..=60).contains(&zone) => (32600 + zone_code, false),
        (Some(1), Some(2), 3) if (-60..=-1).contains(&zone) => (32700 + zone_code, false),
        (Some(1), Some(2), 4) if (1..=23).contains(&zone) => (26900 + zone_code, false),
        (system, unit, datum) => {
            return bad(
                "UTM in metres or geographic in arc seconds, NAD27, WGS 72, WGS 84 or NAD83",
                format!("system {system:?}, zone {zone}, unit {unit:?}, datum {datum}"),
            );
        }
    };
    let height_metres = match whole(record, 534, 540) {
        Some(1) => 0.3048,
        Some(2) => 1.0,
        found => return bad("heights in feet (1) or metres (2)", format!("unit {found:?}")),
    };
    let positive = |from| real(record, from, from + 12).filter(|v| *v > 0.0);
    let (Some(dx), Some(dy), Some(dz)) = (positive(816), positive(828), positive(840)) else {
        return Err(broken(path, "positive resolutions in bytes 816 to 852", "none", REMEDY));
    };
    let columns = whole(record, 858, 864).and_then(|c| u32::try_from(c).ok()).filter(|c| *c > 0);
    let Some(columns) = columns else {
        return Err(broken(path, "a count of columns in bytes 858 to 864", "none", REMEDY));
    };
    Ok(Header {
        crs: SourceCrs::epsg(code, geographic),
        unit: if geographic { 1.0 / 3600.0 } else { 1.0 },
        step: [dx, dy],
        z_step: dz,
        height_metres,
        columns,
        corners: corners(record),
    })
}

/// Lowest and highest y among the four corners (bytes 546..738, x and y of each).
fn corners(record: &[u8]) -> [f64; 2] {
    let y = |i: usize| real(record, 570 + 48 * i, 594 + 48 * i);
    let all = || (0..4).filter_map(y);
    [all().fold(f64::NAN, f64::min), all().fold(f64::NAN, f64::max)]
}

/// Rows between the outermost sample and a corner beyond it, so that the rectangle covers the quadrangle
/// as GDAL's does; they are nodata.
fn rows_outside(distance: f64, step: f64) -> f64 {
    // `max` turns the NaN of blank corners into 0.
    (distance / step - 1e-6).ceil().max(0.0)
}

/// The first pass: the place of every column, and the x of the first.
fn columns(path: &Path, file: &File, header: &Header) -> Result<(Vec<Column>, f64)> {
    let length = file.metadata().map_err(io_error(path, "ask for its length"))?.len();
    let cut = |i: u32| {
        let found = format!("{length} bytes, the end within column {}", i + 1);
        broken(path, format!("{} columns", header.columns), found, REMEDY)
    };
    let mut columns = Vec::new();
    let (mut at, mut west) = (RECORD, 0.0);
    for i in 0..header.columns {
        let mut bytes = [0; PROFILE_HEADER];
        file.read_exact_at(&mut bytes, at).map_err(|_| cut(i))?;
        let count =
            whole(&bytes, 12, 18).and_then(|m| u32::try_from(m).ok()).filter(|m| (1..=SIDE_MAX).contains(m));
        let (Some(count), Some(1), Some(x), Some(south)) =
            (count, whole(&bytes, 18, 24), real(&bytes, 24, 48), real(&bytes, 48, 72))
        else {
            let found = format!("'{}'", String::from_utf8_lossy(&bytes[..72]));
            return Err(broken(path, format!("the header of column {} at byte {at}", i + 1), found, REMEDY));
        };
        if i == 0 {
            west = x;
        }
        if ((x - west) / header.step[0] - f64::from(i)).abs() > 0.01 {
            let expected = format!("column {} at x = {}", i + 1, west + f64::from(i) * header.step[0]);
            return Err(broken(path, expected, format!("{x}"), REMEDY));
        }
        columns.push(Column { at, south, count });
        let further = u64::from(count).saturating_sub(FIRST_HEIGHTS).div_ceil(FURTHER_HEIGHTS);
        at += RECORD * (1 + further);
        // The last record may lack its padding, but not its heights: the second pass would notice.
        if at > length + RECORD {
            return Err(cut(i));
        }
    }
    Ok((columns, west))
}

/// The second pass: the local datum and the heights of a column, from the south.
fn heights(path: &Path, file: &File, column: &Column) -> Result<(f64, Vec<f64>)> {
    let mut heights = Vec::with_capacity(column.count as usize);
    let mut record = [0; 1024];
    let (mut at, mut from, mut datum) = (column.at, PROFILE_HEADER, 0.0);
    while heights.len() < column.count as usize {
        record.fill(b' ');
        read_some(file, &mut record, at).map_err(io_error(path, "read a column"))?;
        if at == column.at {
            datum = real(&record, 72, 96).unwrap_or(0.0);
        }
        let (fields, _) = record[from..].as_chunks::<6>();
        for field in fields.iter().take(column.count as usize - heights.len()) {
            let Some(height) = whole(field, 0, 6) else {
                let found = format!("'{}'", String::from_utf8_lossy(field));
                return Err(broken(path, format!("a height in the record at byte {at}"), found, REMEDY));
            };
            heights.push(height_value(height));
        }
        at += RECORD;
        from = 0;
    }
    Ok((datum, heights))
}

/// Reads as much of a record as the file has.
fn read_some(file: &File, record: &mut [u8], at: u64) -> std::io::Result<()> {
    let mut done = 0;
    while done < record.len() {
        match file.read_at(&mut record[done..], at + done as u64)? {
            0 => break,
            n => done += n,
        }
    }
    Ok(())
}

/// Six letters are at most a million: exact.
fn height_value(height: i64) -> f64 {
    height as f64
}

fn whole(bytes: &[u8], from: usize, to: usize) -> Option<i64> {
    std::str::from_utf8(bytes.get(from..to)?).ok()?.trim().parse().ok()
}

/// A Fortran number: the exponent is a D or an E.
fn real(bytes: &[u8], from: usize, to: usize) -> Option<f64> {
    let text = std::str::from_utf8(bytes.get(from..to)?).ok()?.trim().replace(['D', 'd'], "E");
    text.parse().ok().filter(|v: &f64| v.is_finite())
}

//! Arc/Info ASCII grid (`.asc`): a header of keywords, then width x height numbers from the north-west, lines wrapped anywhere.
//!
//! | keyword | value |
//! |---|---|
//! | `ncols`, `nrows` | samples |
//! | `xllcorner`/`yllcorner` or `xllcenter`/`yllcenter` | corner of the south-west cell, or its sample |
//! | `cellsize`, or `dx` and `dy` | CRS units between samples |
//! | `NODATA_value` | optional, −9999 by custom but not by default here |
//!
//! Text cannot be read by position, so the numbers are transcribed once to a temporary file of f64
//! (8 bytes a sample). Memory: a buffer of 64 KiB.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::Path;

use super::error::{Result, broken, io_error};
use super::raster::{Dtype, Place, Raster, SIDE_MAX, Samples};
use super::samples::{Order, Transcript};

/// Letters of one number or keyword, at most.
const WORD_BYTES_MAX: usize = 64;
const REMEDY: &str = "fetch the file again or correct it";

pub(super) fn open(path: &Path, file: File) -> Result<Raster> {
    read(path, BufReader::with_capacity(1 << 16, file))
}

#[derive(Default)]
struct Header {
    columns: Option<u32>,
    rows: Option<u32>,
    x: Option<f64>,
    y: Option<f64>,
    centred: [bool; 2],
    dx: Option<f64>,
    dy: Option<f64>,
    nodata: Option<f64>,
}

fn read(path: &Path, input: impl BufRead) -> Result<Raster> {
    let mut words = Words { path, input, word: Vec::with_capacity(WORD_BYTES_MAX) };
    let (header, first) = header(path, &mut words)?;
    let missing = |name: &str| broken(path, format!("'{name}' in the header"), "none", REMEDY);
    let width = header.columns.ok_or_else(|| missing("ncols"))?;
    let height = header.rows.ok_or_else(|| missing("nrows"))?;
    let dx = header.dx.ok_or_else(|| missing("cellsize"))?;
    let dy = header.dy.unwrap_or(dx);
    let half = |centred: bool| if centred { 0.0 } else { 0.5 };
    let x = header.x.ok_or_else(|| missing("xllcorner"))? + half(header.centred[0]) * dx;
    let y = header.y.ok_or_else(|| missing("yllcorner"))? + half(header.centred[1]) * dy;

    let expected = u64::from(width) * u64::from(height);
    let mut transcript = Transcript::new(path)?;
    let mut integer = true;
    let mut next = first;
    while let Some(value) = next {
        if transcript.values() == expected {
            return Err(broken(path, format!("{expected} values ({width} x {height})"), "more", REMEDY));
        }
        transcript.push(path, value)?;
        // Nodata may be fractional without making the grid so.
        integer &= value.fract() == 0.0 || !value.is_finite() || Some(value) == header.nodata;
        next = words.number()?;
    }
    if transcript.values() != expected {
        let found = format!("{} values", transcript.values());
        return Err(broken(path, format!("{expected} values ({width} x {height})"), found, REMEDY));
    }
    let samples = transcript.finish(path, Order::RowsFromNorth, width, height)?;
    Ok(Raster {
        file: path.to_owned(),
        width,
        height,
        place: Some(Place { origin: [x, y], step: [dx, dy], crs: None }),
        dtype: Dtype::F64,
        integer,
        height_scale: 1.0,
        height_offset: 0.0,
        height_doubt: None,
        nodata: header.nodata,
        picture: None,
        samples: Samples::File(samples),
    })
}

/// The keywords, and the first number after them.
fn header(path: &Path, words: &mut Words<'_, impl BufRead>) -> Result<(Header, Option<f64>)> {
    let mut header = Header::default();
    loop {
        let Some(word) = words.next()? else { return Ok((header, None)) };
        let keyword = word.to_ascii_lowercase();
        // "nan" is a number although it begins with a letter.
        if let Some(value) = parse(&keyword) {
            return Ok((header, Some(value)));
        }
        let value = match words.next()? {
            Some(word) => parse(&word).ok_or_else(|| {
                broken(path, format!("a number after '{keyword}'"), format!("'{word}'"), REMEDY)
            })?,
            None => return Err(broken(path, format!("a number after '{keyword}'"), "the end", REMEDY)),
        };
        let finite = || Some(value).filter(|v| v.is_finite());
        let positive = || finite().filter(|v| *v > 0.0);
        let known = match keyword.as_str() {
            "ncols" => {
                header.columns = side(value);
                header.columns.is_some()
            }
            "nrows" => {
                header.rows = side(value);
                header.rows.is_some()
            }
            "xllcorner" | "xllcenter" => {
                header.centred[0] = keyword.ends_with("center");
                header.x = finite();
                header.x.is_some()
            }
            "yllcorner" | "yllcenter" => {
                header.centred[1] = keyword.ends_with("center");
                header.y = finite();
                header.y.is_some()
            }
            "cellsize" => {
                (header.dx, header.dy) = (positive(), positive());
                header.dx.is_some()
            }
            "dx" => {
                header.dx = positive();
                header.dx.is_some()
            }
            "dy" => {
                header.dy = positive();
                header.dy.is_some()
            }
            "nodata_value" | "nodata" => {
                header.nodata = Some(value);
                true
            }
            _ => false,
        };
        if !known {
            let expected = format!("an Arc ASCII header with sizes from 1 to {SIDE_MAX} and positive cells");
            return Err(broken(path, expected, format!("'{keyword} {value}'"), REMEDY));
        }
    }
}

fn side(value: f64) -> Option<u32> {
    super::whole(value).filter(|v| (1..=SIDE_MAX).contains(v))
}

/// A number; infinities are not, NaN is (it means nodata).
fn parse(word: &str) -> Option<f64> {
    word.parse::<f64>().ok().filter(|v| !v.is_infinite())
}

/// Words between white space, never more than one in memory.
struct Words<'a, R> {
    path: &'a Path,
    input: R,
    word: Vec<u8>,
}

impl<R: BufRead> Words<'_, R> {
    fn number(&mut self) -> Result<Option<f64>> {
        let Some(word) = self.next()? else { return Ok(None) };
        match parse(&word) {
            Some(value) => Ok(Some(value)),
            None => {
                let found = format!("'{word}'");
                Err(broken(self.path, "numbers after the header", found, REMEDY))
            }
        }
    }

    fn next(&mut self) -> Result<Option<std::borrow::Cow<'_, str>>> {
        self.word.clear();
        loop {
            let bytes = self.input.fill_buf().map_err(io_error(self.path, "read its text"))?;
            if bytes.is_empty() {
                break;
            }
            let blank = |b: &u8| b.is_ascii_whitespace() || *b == 0x1a;
            let skip = if self.word.is_empty() { bytes.iter().take_while(|b| blank(b)).count() } else { 0 };
            let rest = &bytes[skip..];
            let end = rest.iter().position(blank);
            self.word.extend_from_slice(&rest[..end.unwrap_or(rest.len()).min(WORD_BYTES_MAX + 1)]);
            let used = skip + end.unwrap_or(rest.len());
            self.input.consume(used);
            if self.word.len() > WORD_BYTES_MAX {
                let found = format!("'{}...'", String::from_utf8_lossy(&self.word[..16]));
                return Err(broken(
                    self.path,
                    format!("words of at most {WORD_BYTES_MAX} letters"),
                    found,
                    REMEDY,
                ));
            }
            if end.is_some() && !self.word.is_empty() {
                break;
            }
        }
        Ok((!self.word.is_empty()).then(|| String::from_utf8_lossy(&self.word)))
    }
}

//! Several DEM files on one grid, read as one raster.
//!
//! Files must agree in CRS, cell and unit of height, and lie whole cells apart. Where they overlap (tiles
//! of SRTM share their rims) the first file that has a valid sample wins.

use super::error::{IngestError, Result};
use super::raster::{Place, Raster, SIDE_MAX, Window};
use super::sentinels::Seen;
use std::path::Path;

/// Cells of two files may differ by this share.
const CELL_TOLERANCE: f64 = 1e-6;
/// Offsets of two files may differ from whole cells by this share of a cell.
const OFFSET_TOLERANCE: f64 = 1e-3;

/// One or several rasters, each at its offset from the south-west sample of all.
pub(super) struct Mosaic {
    parts: Vec<(Raster, u32, u32)>,
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) place: Option<Place>,
    seen: Seen,
}

impl Mosaic {
    pub(super) fn new(rasters: Vec<Raster>) -> Result<Self> {
        let first = rasters.first().ok_or(IngestError::NoInput)?;
        if rasters.len() == 1 {
            let (width, height, place) = (first.width, first.height, first.place.clone());
            let parts = rasters.into_iter().map(|r| (r, 0, 0)).collect();
            return Ok(Self { parts, width, height, place, seen: Seen::default() });
        }
        let mut offsets = Vec::with_capacity(rasters.len());
        for raster in &rasters {
            offsets.push(offset(first, raster)?);
        }
        let low = |axis: usize| offsets.iter().map(|o| o[axis]).min().unwrap_or(0);
        let (west, south) = (low(0), low(1));
        let mut parts = Vec::with_capacity(rasters.len());
        let (mut width, mut height) = (0, 0);
        let place = first.place.as_ref().map(|p| Place {
            origin: [p.origin[0] + west as f64 * p.step[0], p.origin[1] + south as f64 * p.step[1]],
            ..p.clone()
        });
        let first_file = first.file.clone();
        for (raster, [x, y]) in rasters.into_iter().zip(offsets) {
            let x = side(x - west, raster.width);
            let y = side(y - south, raster.height);
            let (Some(x), Some(y)) = (x, y) else {
                return Err(IngestError::Mosaic {
                    first: first_file,
                    second: raster.file,
                    expected: format!("at most {SIDE_MAX} samples a side"),
                    found: "files farther apart".to_owned(),
                });
            };
            width = width.max(x + raster.width);
            height = height.max(y + raster.height);
            parts.push((raster, x, y));
        }
        Ok(Self { parts, width, height, place, seen: Seen::default() })
    }

    pub(super) fn first(&self) -> &Raster {
        // `new` refuses an empty list.
        &self.parts[0].0
    }

    /// A value that usually means "no data", met among the heights read so far: its file, itself, and the
    /// range of all other values.
    pub(super) fn suspect(&self) -> Option<(&Path, f64, [f64; 2])> {
        let (value, number, range) = self.seen.suspect()?;
        Some((&self.parts.get(number)?.0.file, value, range))
    }

    pub(super) fn integer(&self) -> bool {
        self.parts.iter().all(|(raster, ..)| raster.integer)
    }

    /// Fills `out` with the window's values, rows from the south, NaN for nodata and gaps. `band` is for pictures.
    pub(super) fn read(&self, window: Window, band: u32, out: &mut [f64]) -> Result<()> {
        if let [(raster, ..)] = &self.parts[..] {
            raster.read(window, band, out)?;
            self.note(0, raster, out);
            return Ok(());
        }
        out.fill(f64::NAN);
        let mut scratch = Vec::new();
        for (number, (raster, x, y)) in self.parts.iter().enumerate() {
            let Some(common) = overlap(window, *x, *y, raster) else { continue };
            let own = Window { x0: common.x0 - x, y0: common.y0 - y, ..common };
            scratch.clear();
            scratch.resize(own.samples(), f64::NAN);
            raster.read(own, band, &mut scratch)?;
            self.note(number, raster, &scratch);
            let left = (common.x0 - window.x0) as usize;
            let rows = out.chunks_exact_mut(window.width as usize).skip((common.y0 - window.y0) as usize);
            for (row, from) in rows.zip(scratch.chunks_exact(common.width as usize)) {
                for (o, v) in row[left..].iter_mut().zip(from) {
                    if o.is_nan() {
                        *o = *v;
                    }
                }
            }
        }
        Ok(())
    }
}

impl Mosaic {
    /// Looks for heights that are none.
    fn note(&self, number: usize, raster: &Raster, values: &[f64]) {
        if raster.picture.is_none() {
            self.seen.note(number, values);
        }
    }
}

/// What a window and a part at (x, y) have in common.
fn overlap(window: Window, x: u32, y: u32, raster: &Raster) -> Option<Window> {
    let (x0, y0) = (window.x0.max(x), window.y0.max(y));
    let x1 = (window.x0 + window.width).min(x + raster.width);
    let y1 = (window.y0 + window.height).min(y + raster.height);
    (x0 < x1 && y0 < y1).then(|| Window { x0, y0, width: x1 - x0, height: y1 - y0 })
}

fn side(offset: i64, size: u32) -> Option<u32> {
    u32::try_from(offset).ok().filter(|o| o.checked_add(size).is_some_and(|end| end <= SIDE_MAX))
}

/// Whole cells from the south-west sample of `first` to that of `second`.
fn offset(first: &Raster, second: &Raster) -> Result<[i64; 2]> {
    let differ = |expected: String, found: String| IngestError::Mosaic {
        first: first.file.clone(),
        second: second.file.clone(),
        expected,
        found,
    };
    let (Some(a), Some(b)) = (&first.place, &second.place) else {
        return Err(differ("files that say where they lie".into(), "one that does not".into()));
    };
    let name = |p: &Place| p.crs.as_ref().map_or("no CRS".to_owned(), |c| c.name.clone());
    if a.crs != b.crs {
        return Err(differ(name(a), name(b)));
    }
    if (0..2).any(|i| (b.step[i] / a.step[i] - 1.0).abs() > CELL_TOLERANCE) {
        let text = |p: &Place| format!("cells of {} x {}", p.step[0], p.step[1]);
        return Err(differ(text(a), text(b)));
    }
    let heights = |r: &Raster| (r.height_scale, r.height_offset);
    if heights(first) != heights(second) {
        let text = |r: &Raster| format!("heights of value x {} + {} metres", r.height_scale, r.height_offset);
        return Err(differ(text(first), text(second)));
    }
    let mut offset = [0; 2];
    for i in 0..2 {
        let mut distance = b.origin[i] - a.origin[i];
        if i == 0 && a.crs.as_ref().is_some_and(|c| c.geographic) {
            // Tiles on both sides of the antimeridian are neighbours.
            distance -= (distance / 360.0).round() * 360.0;
        }
        let cells = distance / a.step[i];
        let whole = super::whole(cells.abs().round())
            .filter(|w| (f64::from(*w) - cells.abs()).abs() <= OFFSET_TOLERANCE);
        let Some(whole) = whole else {
            return Err(differ(
                "whole cells between them".into(),
                format!("{cells} cells along {}", ["x", "y"][i]),
            ));
        };
        offset[i] = if cells < 0.0 { -i64::from(whole) } else { i64::from(whole) };
    }
    Ok(offset)
}

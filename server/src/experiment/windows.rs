//! Which parts of DEMs an experiment works on.
//!
//! Windows of (2^k + 1)^2 samples: one at a place, or all on a lattice of 2^k cells, from each source's south-west corner, that
//! have data everywhere and pass a rule. The rule *partly flat* is for ground that is both flat and mountainous, like
//! the window of the bitree paper: a quarter to three quarters of the inner samples are as high as all their four
//! neighbours, and the relief is at least 300 m. It was fixed before anything was measured with it.

use super::ExperimentError;
use super::field::Field;
use crate::ingest::{self, Source};
use crate::progress::Progress;
use diamantina_protocol::bintree::Point;
use diamantina_protocol::message::Crs;
use std::path::{Path, PathBuf};

/// Shares of inner samples that are as high as their four neighbours, for ground that is partly flat.
const FLAT_SHARES: std::ops::RangeInclusive<f64> = 0.25..=0.75;
/// Metres between the lowest and the highest sample, at least, for ground that is partly mountainous.
const RELIEF_MIN: f64 = 300.0;

/// Which windows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Rule {
    /// One window, at --at, or in the middle
    One,
    /// All on the lattice that have data everywhere and are not level
    All,
    /// Those of them with 25 to 75 % flat samples and at least 300 m of relief
    PartlyFlat,
}

/// Which windows of a DEM.
#[derive(Debug, Clone, clap::Args)]
#[group(id = "windows_options")]
pub struct Options {
    /// Samples along a side of a window: a power of two and one more
    #[arg(long, default_value_t = 65, value_name = "N")]
    pub(crate) samples: u32,
    /// Which windows
    #[arg(long, value_enum, default_value_t = Rule::One)]
    pub(crate) windows: Rule,
    /// South-west sample of the one window [default: in the middle of the DEM]
    #[arg(long, value_name = "X,Y", value_parser = parse_place)]
    pub(crate) at: Option<Point>,
}

pub(super) fn parse_place(text: &str) -> Result<Point, String> {
    let parts =
        text.split_once(',').and_then(|(x, y)| Some([x.trim().parse().ok()?, y.trim().parse().ok()?]));
    parts.ok_or_else(|| format!("expected X,Y in samples from the south-west corner, found '{text}'"))
}

/// A field and where it is from.
#[derive(Debug, Clone)]
pub struct Window {
    /// File name of its DEM.
    pub source: String,
    /// South-west sample.
    pub at: Point,
    /// Frame coordinates of that sample, metres.
    pub origin: [f64; 2],
    /// The frame's system of coordinates, if the source says.
    pub crs: Option<Crs>,
    /// Heights.
    pub field: Field,
    /// Weights of samples, if there is a mask.
    pub weights: Option<Vec<f32>>,
}

impl Window {
    /// What tells it from other windows, for captions.
    pub(super) fn label(&self) -> String {
        format!("{} at {},{}", self.source, self.at[0], self.at[1])
    }
}

/// The share of inner samples that are as high as their four neighbours.
#[must_use]
pub fn flat_share(field: &Field) -> f64 {
    let (row, all) = (field.row(), field.heights());
    let inner = |slot: &usize| (1..row - 1).contains(&(slot % row)) && (1..row - 1).contains(&(slot / row));
    let is_flat =
        |slot: &usize| [slot - 1, slot + 1, slot - row, slot + row].iter().all(|s| all[*s] == all[*slot]);
    let flat = (0..all.len()).filter(inner).filter(is_flat).count();
    flat as f64 / ((row - 2) * (row - 2)) as f64
}

/// Reads the windows of each source.
pub(super) fn read(
    sources: &[PathBuf],
    ingest: &ingest::Options,
    options: &Options,
    mask: Option<&Path>,
    progress: &Progress,
) -> Result<Vec<Window>, ExperimentError> {
    let bad = |option, expected: &str, found: String| ExperimentError::Options {
        option,
        expected: expected.to_owned(),
        found,
    };
    let cells = options.samples.saturating_sub(1);
    if !(2..=4096).contains(&cells) || !cells.is_power_of_two() {
        return Err(bad("--samples", "a power of two and one more, 3 to 4097", options.samples.to_string()));
    }
    if options.at.is_some() && options.windows != Rule::One {
        return Err(bad("--at", "a place for one window", "--windows that says which".to_owned()));
    }
    if mask.is_some() && sources.len() != 1 {
        return Err(bad("--mask", "one DEM, whose grid the mask has", format!("{} DEMs", sources.len())));
    }
    let log2 = u8::try_from(cells.trailing_zeros()).unwrap_or(u8::MAX);
    let mut windows = Vec::new();
    for path in sources {
        let source = ingest::open(std::slice::from_ref(path), ingest)?;
        let (name, grid) = (file_name(path), source.grid());
        if let Some([x, y]) = options.at.filter(|[x, y]| *x >= grid.width || *y >= grid.height) {
            let expected = format!("a sample of {name}, up to {},{}", grid.width - 1, grid.height - 1);
            return Err(bad("--at", &expected, format!("{x},{y}")));
        }
        // A window at a place may reach beyond a side, as it may lie over voids; one that no place would fill is a slip.
        let sides = [grid.width, grid.height];
        if options.windows == Rule::One && sides.iter().any(|side| options.samples > *side) {
            let [width, height] = sides;
            let expected = format!(
                "a window that fits into the {width} x {height} samples of {name}: {}",
                fitting(sides)
            );
            return Err(bad("--samples", &expected, options.samples.to_string()));
        }
        let mask = mask.map(|m| open_mask(m, ingest, &source)).transpose()?;
        let (places, before) = (places(&source, options, cells), windows.len());
        progress.stage("reading windows", "windows", places.len() as u64, 0);
        for at in places {
            if progress.is_stopping() {
                return Err(ExperimentError::Stopped);
            }
            progress.advance(1);
            let read = Field::read(&source, at, log2)?;
            if let Some(coarse) = read.as_ref().filter(|field| field.rounding() > ROUNDING_MAX) {
                let largest = coarse.heights().iter().fold(0.0f64, |most, h| most.max(h.abs()));
                return Err(ExperimentError::Heights {
                    file: name,
                    at,
                    largest,
                    rounding: coarse.rounding(),
                });
            }
            let Some(field) = read.filter(|f| passes(f, options.windows)) else {
                continue;
            };
            let weights = mask.as_ref().map(|m| weights(m, at, log2)).transpose()?;
            let origin = [0, 1].map(|k| grid.origin[k] + f64::from(at[k]) * grid.cell[k]);
            windows.push(Window { source: name.clone(), at, origin, crs: grid.frame_crs(), field, weights });
        }
        source.check_nodata()?;
        if options.windows == Rule::One && windows.len() == before {
            return Err(bad("--at", "a window with data in it", format!("none there in {name}")));
        }
    }
    if windows.is_empty() {
        let names = sources.iter().map(|path| file_name(path)).collect::<Vec<_>>().join(", ");
        return Err(bad("--windows", "at least one window that fits the rule", format!("none in {names}")));
    }
    Ok(windows)
}

/// What to say of windows for a DEM with these sides.
fn fitting(sides: [u32; 2]) -> String {
    match sides[0].min(sides[1]).saturating_sub(1).checked_ilog2() {
        Some(log2 @ 1..) => format!("--samples {} at most", (1u32 << log2.min(12)) + 1),
        _ => "no window fits, a larger DEM is needed".to_owned(),
    }
}

/// How many windows each DEM has, also where it has none.
pub(super) fn counts(sources: &[PathBuf], windows: &[Window]) -> String {
    let mut names: Vec<String> = sources.iter().map(|path| file_name(path)).collect();
    names.dedup();
    let count = |name: &String| windows.iter().filter(|w| w.source == *name).count();
    let told: Vec<String> = names.iter().map(|name| format!("{name} {}", count(name))).collect();
    format!("Windows that fit the rule: {}.", told.join(", "))
}

/// Heights are rounded, which errors do not tell of: at most so many metres.
const ROUNDING_MAX: f64 = 1e-3;

fn file_name(path: &Path) -> String {
    path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

fn places(source: &Source, options: &Options, cells: u32) -> Vec<Point> {
    let grid = source.grid();
    if options.windows == Rule::One {
        let middle = [grid.width, grid.height].map(|n| n.saturating_sub(cells + 1) / 2);
        return vec![options.at.unwrap_or(middle)];
    }
    let along = |n: u32| (0..n.saturating_sub(cells)).step_by(cells as usize);
    along(grid.height).flat_map(|y| along(grid.width).map(move |x| [x, y])).collect()
}

fn passes(field: &Field, rule: Rule) -> bool {
    let is_whole = || field.samples() == field.heights().len() && field.relief() > 0.0;
    match rule {
        Rule::One => true,
        Rule::All => is_whole(),
        Rule::PartlyFlat => {
            is_whole() && field.relief() >= RELIEF_MIN && FLAT_SHARES.contains(&flat_share(field))
        }
    }
}

fn open_mask(path: &Path, ingest: &ingest::Options, source: &Source) -> Result<Source, ExperimentError> {
    // Weights have no unit: what was said of the heights is not for them.
    let options =
        ingest::Options { height_scale: Some(1.0), height_offset: Some(0.0), raw: None, ..ingest.clone() };
    let mask = ingest::open(&[path.to_owned()], &options)?;
    let size = |s: &Source| format!("{} x {} samples", s.grid().width, s.grid().height);
    if size(&mask) != size(source) {
        return Err(ExperimentError::Options {
            option: "--mask",
            expected: format!("the DEM's own grid, {}", size(source)),
            found: format!("{} in {}", size(&mask), path.display()),
        });
    }
    // Weights of another place would be taken for those of this one. A raster that says not where it lies is believed.
    let [own, given] = [source, &mask].map(Source::grid);
    let says_where = given.crs.is_some() || given.origin != [0.0; 2];
    // Metres of degrees begin at the raster itself: where that is its coordinates tell.
    let is_elsewhere = match (&own.crs, &given.crs) {
        (Some(own), Some(given)) => {
            (0..2).any(|k| (own.origin[k] - given.origin[k]).abs() > 0.01 * own.step[k].abs())
        }
        _ => false,
    };
    let is_there = !is_elsewhere
        && (0..2).all(|k| {
            let [apart, coarser] = [given.origin[k] - own.origin[k], given.cell[k] - own.cell[k]];
            apart.abs() <= 0.01 * own.cell[k]
                && coarser.abs() * f64::from(own.width.max(own.height)) <= own.cell[k]
        });
    if says_where && !is_there {
        let place = |grid: &ingest::Grid| {
            let ([x, y], [dx, dy]) = (grid.origin, grid.cell);
            let [x, y] = grid.crs.as_ref().map_or([x, y], |crs| crs.origin);
            format!("the south-west sample at {x:.4}, {y:.4}, {dx:.4} x {dy:.4} m a cell")
        };
        return Err(ExperimentError::Options {
            option: "--mask",
            expected: format!("the DEM's own grid, {}", place(own)),
            found: format!("{} in {}", place(given), path.display()),
        });
    }
    Ok(mask)
}

fn weights(mask: &Source, at: Point, log2: u8) -> Result<Vec<f32>, ExperimentError> {
    let row = (1usize << log2) + 1;
    let Some(field) = Field::read(mask, at, log2)? else { return Ok(vec![0.0; row * row]) };
    let [low, high] = field.range();
    if low < 0.0 || high > 1.0 {
        return Err(ExperimentError::Options {
            option: "--mask",
            expected: "weights from 0 to 1 (of 0 to 255: gdal_translate -scale 0 255 0 1 -ot Float32)"
                .to_owned(),
            found: format!("{low} to {high}"),
        });
    }
    #[allow(clippy::cast_possible_truncation, reason = "from 0 to 1")]
    Ok(field.heights().iter().map(|h| if h.is_nan() { 0.0 } else { *h as f32 }).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_window_that_fits_is_told() {
        assert_eq!(fitting([374, 394]), "--samples 257 at most");
        assert_eq!(fitting([513, 600]), "--samples 513 at most");
        assert_eq!(fitting([512, 600]), "--samples 257 at most");
        assert_eq!(fitting([9000, 10_000]), "--samples 4097 at most");
        assert_eq!(fitting([3, 80]), "--samples 3 at most");
        assert!(fitting([2, 80]).starts_with("no window fits"));
    }
}

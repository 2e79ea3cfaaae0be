//! What a build would take and give, from a bounded sample of the source: a dry run.
//!
//! The source is cut into tiles of 4 x 4 patches. Some are read, to know how much of it has heights; some of
//! those are built as if each were a source of its own, by the same code, in a temporary folder. Of their four
//! levels the finer three, which add 7 of 8 points, are taken as they are, and so are those past the lattice;
//! what the coarser ones cost follows from how the cost falls from level to level. Triangles of a tile halve with each
//! level, so its own levels are nearly all there will be.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "estimates are rounded, and sides of tiles are below 2^9"
)]

use super::coding::{coding, fine_step};
use super::journal::Journal;
use super::layers::{LayerSource, Part, parts};
use super::plan::Plan;
use super::tallies::Tallies;
use super::transcribe::to_quanta;
use super::work::{Work, failure};
use super::{Build, BuildError, Options, Stats, forest_of, tins};
use crate::canvas::Canvas;
use crate::ingest::{Grid, Source};
use crate::progress::Progress;
use crate::store::Writer;
use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::points;
use rayon::prelude::*;
use std::collections::HashSet;
use std::sync::Mutex;
use std::sync::atomic::AtomicU64;
use std::time::{Duration, Instant};

/// Base-2 logarithm of the patches along a side of a tile.
const TILE_LOG2: u8 = 2;
/// Samples that are read.
const READ_MAX: usize = 1 << 24;
/// Samples that are built.
const BUILT_MAX: usize = 1 << 22;
/// What a whole build takes for each sample, compared with a tile's: diamonds that straddle chunks are coded
/// on both sides, there are more levels to compare, and blobs are laid into packs. Measured.
const WHOLE_TO_TILE: f64 = 1.6;
/// What a build takes however small the source: the coding is chosen, the disk synced. Measured.
const FIXED_SECONDS: f64 = 0.22;
/// Where points of the coarser levels stop costing more and more: their steps grow with what there is to say.
/// Bytes; measured.
const POINT_BYTES_MAX: f64 = 3.5 / 8.0;
/// What a payload takes whatever it holds: its header and the end of its symbols.
const FIXED_BYTES: f64 = points::HEADER_BYTES as f64 + 4.0;
/// Steps of the quadtree above a tile that cost anything.
const STEPS_MAX: i32 = 10;
/// What the journal takes for a diamond.
const JOURNAL_BYTES: u64 = 60;

/// What a build is expected to take and to give.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Estimate {
    /// Samples of the source.
    pub samples: u64,
    /// Samples that have a height.
    pub valid_samples: u64,
    /// Samples that the estimate rests on.
    pub sampled: u64,
    /// Diamonds with a payload of points.
    pub diamonds: u64,
    /// Bytes of their payloads.
    pub point_bytes: u64,
    /// Bits of payload of points for each sample that has a height.
    pub bits_per_sample: f64,
    /// Triangles of all levels.
    pub triangles: u64,
    /// Bytes of their payloads.
    pub tin_bytes: u64,
    /// Seconds, with the threads at hand.
    pub seconds: f64,
    /// The most memory that it takes.
    pub memory_bytes: u64,
    /// Space that the work folder needs, the new store included.
    pub disk_bytes: u64,
}

/// What a build of a scene is expected to take and to give.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Estimates {
    /// Of all layers together.
    #[serde(flatten)]
    pub all: Estimate,
    /// Of each by itself, in the scene's order.
    pub layers: Vec<LayerEstimate>,
}

/// What a layer is expected to take and to give.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct LayerEstimate {
    /// The layer's name.
    pub name: String,
    /// What it takes and gives.
    #[serde(flatten)]
    pub estimate: Estimate,
}

impl Estimate {
    /// Of layers that are built one after the other.
    fn sum(layers: &[LayerEstimate]) -> Self {
        let each = || layers.iter().map(|layer| &layer.estimate);
        let sum = |of: fn(&Self) -> u64| each().map(of).sum::<u64>();
        let (valid_samples, point_bytes) = (sum(|e| e.valid_samples), sum(|e| e.point_bytes));
        Self {
            samples: sum(|e| e.samples),
            valid_samples,
            sampled: sum(|e| e.sampled),
            diamonds: sum(|e| e.diamonds),
            point_bytes,
            bits_per_sample: per(point_bytes as f64 * 8.0, valid_samples),
            triangles: sum(|e| e.triangles),
            tin_bytes: sum(|e| e.tin_bytes),
            seconds: each().map(|e| e.seconds).sum(),
            memory_bytes: each().map(|e| e.memory_bytes).max().unwrap_or(0),
            // All work files stay until all layers are published.
            disk_bytes: sum(|e| e.disk_bytes),
        }
    }
}

/// So much for each of so many; of none, nothing.
fn per(part: f64, of: u64) -> f64 {
    if of == 0 { 0.0 } else { part / of as f64 }
}

/// A tile that was read.
struct Tile {
    size: [u32; 2],
    heights: Vec<i32>,
    stats: Stats,
    /// Whether each quarter has a height.
    quarters: [bool; 4],
}

/// Estimates what [`super::build_layers`] would take and give. Reads at most 17 million samples of each layer, and takes at
/// most 100 MB of memory and of temporary files.
///
/// # Errors
/// When a source cannot be read or the options do not fit it, as in a build.
pub fn estimate(layers: &[LayerSource<'_>], options: &Options) -> Result<Estimates, BuildError> {
    let of_part = |part: &Part<'_>| -> Result<LayerEstimate, BuildError> {
        let mut estimate = of_layer(part).map_err(|error| part.failed(error))?;
        // What is known of the other layers waits meanwhile.
        estimate.memory_bytes += options.memory - part.options.memory;
        Ok(LayerEstimate { name: part.layer.name.to_owned(), estimate })
    };
    let layers: Vec<LayerEstimate> =
        parts(layers, options)?.iter().map(of_part).collect::<Result<_, BuildError>>()?;
    Ok(Estimates { all: Estimate::sum(&layers), layers })
}

/// Estimates what a layer would take and give.
fn of_layer(part: &Part<'_>) -> Result<Estimate, BuildError> {
    let Part { layer, plan, quantum, options, .. } = part;
    let (source, quantum) = (layer.source, *quantum);
    let grid = source.grid();
    let forest = forest_of(grid, options)?;
    let started = Instant::now();
    let side = 1u32 << (options.patch_log2 + TILE_LOG2);
    let tile_samples = (side * side) as usize;
    let chosen = spread(tiles(grid, side), READ_MAX / tile_samples);
    let mut tiles: Vec<Tile> = chosen
        .par_iter()
        .map(|corner| read_tile(source, *corner, side, quantum))
        .collect::<Result<_, _>>()?;
    let reading = started.elapsed();
    let samples = u64::from(grid.width) * u64::from(grid.height);
    let sum = |tiles: &[Tile]| {
        tiles.iter().fold((0, 0), |(all, valid), t| (all + t.heights.len() as u64, valid + t.stats.valid))
    };
    let (read, valid) = sum(&tiles);
    let valid_samples = (samples as f64 * valid as f64 / read as f64).round() as u64;
    let diamonds = diamonds(&forest, grid, &tiles, side);

    tiles.retain(|tile| tile.stats.valid > 0);
    let tiles = spread(tiles, BUILT_MAX / tile_samples);
    let (built, built_valid) = sum(&tiles);
    let each: Vec<Built> =
        tiles.par_iter().map(|tile| build_tile(tile, grid, options)).collect::<Result<_, BuildError>>()?;
    let mut all = Built::default();
    for built in each {
        all.levels.iter_mut().zip(built.levels).for_each(|(sum, bytes)| *sum += bytes);
        all.past_bytes += built.past_bytes;
        all.past_diamonds += built.past_diamonds;
        all.took += built.took;
        all.triangles += built.triangles;
        all.tin_bytes += built.tin_bytes;
        all.triangulating += built.triangulating;
    }
    let bytes = of_all_levels(all.levels, built_valid) + all.past_bytes;
    let workers = rayon::current_num_threads().min(plan.workers);
    let building = all.took / workers as u32;
    let triangulating = all.triangulating / tins::workers(options.memory) as u32;
    let diamonds = diamonds + (per(all.past_diamonds, built_valid) * valid_samples as f64).round() as u64;
    let diamonds = if options.points { diamonds } else { 0 };
    let in_all = |part: f64| (per(part, built_valid) * valid_samples as f64).round() as u64;
    let (point_bytes, tin_bytes, triangles) = (in_all(bytes), in_all(all.tin_bytes), in_all(all.triangles));
    let seconds = FIXED_SECONDS
        + samples as f64 * per(reading.as_secs_f64(), read)
        + valid_samples as f64 * per(building.as_secs_f64(), built_valid) * WHOLE_TO_TILE
        + valid_samples as f64 * per(triangulating.as_secs_f64(), built_valid);
    let tin_disk = if options.tin.is_some() { samples * tins::DISK_BYTES + 2 * tin_bytes } else { 0 };
    Ok(Estimate {
        samples,
        valid_samples,
        sampled: read.max(built),
        diamonds,
        point_bytes,
        bits_per_sample: per(point_bytes as f64 * 8.0, valid_samples),
        seconds,
        triangles,
        tin_bytes,
        memory_bytes: plan.memory.max(tins::memory_max(&forest, options)?),
        // A third more for the coarser planes; payloads in the spool and in the packs.
        disk_bytes: samples * 16 / 3 + 2 * point_bytes + diamonds * JOURNAL_BYTES + tin_disk,
    })
}

/// South-west samples of all tiles, in Morton order: neighbours in the list are neighbours on the ground.
fn tiles(grid: &Grid, side: u32) -> Vec<[u32; 2]> {
    let count = |samples: u32| samples.saturating_sub(1).max(1).div_ceil(side);
    let (columns, rows) = (count(grid.width), count(grid.height));
    let mut all: Vec<[u32; 2]> = (0..rows).flat_map(|j| (0..columns).map(move |i| [i, j])).collect();
    let interleaved = |[i, j]: [u32; 2]| {
        (0..32).map(|bit| (u64::from(i >> bit & 1) | u64::from(j >> bit & 1) << 1) << (2 * bit)).sum::<u64>()
    };
    all.sort_unstable_by_key(|tile| interleaved(*tile));
    all.into_iter().map(|tile| tile.map(|w| w * side)).collect()
}

/// At most `count` of a list, at even distances.
fn spread<T>(list: Vec<T>, count: usize) -> Vec<T> {
    let all = list.len();
    if all <= count {
        return list;
    }
    let mut next = 0;
    let kept = list.into_iter().enumerate().filter(|(at, _)| {
        // The middle of each of `count` equal stretches.
        let take = *at == (2 * next + 1) * all / (2 * count);
        next += usize::from(take);
        take
    });
    kept.map(|(_, item)| item).collect()
}

fn read_tile(source: &Source, [x, y]: [u32; 2], side: u32, quantum: f64) -> Result<Tile, BuildError> {
    let grid = source.grid();
    let size = [(grid.width - x).min(side + 1), (grid.height - y).min(side + 1)];
    let mut values = Vec::new();
    source.read(x, y, size[0], size[1], &mut values)?;
    let (heights, stats) = to_quanta(&values, grid, quantum)?;
    let mut quarters = [false; 4];
    for (row, j) in heights.chunks_exact(size[0] as usize).zip(0u32..) {
        let (west, east) = row.split_at(row.len().min(side as usize / 2));
        let south = if j < side / 2 { 0 } else { 2 };
        quarters[south] |= west.iter().any(|h| *h != NODATA);
        quarters[south + 1] |= east.iter().any(|h| *h != NODATA);
    }
    Ok(Tile { size, heights, stats, quarters })
}

/// How many diamonds have a payload: those of a full source, and of these the share of squares in which the
/// tiles have a height.
fn diamonds(forest: &Forest, grid: &Grid, tiles: &[Tile], tile_side: u32) -> u64 {
    let quarters = tiles.iter().flat_map(|tile| {
        // Quarters beyond the source's border do not count.
        let inside = [0, 1, 2, 3]
            .map(|q| tile.size[0] > q % 2 * tile_side / 2 && tile.size[1] > q / 2 * tile_side / 2);
        tile.quarters.into_iter().zip(inside).filter(|(_, inside)| *inside).map(|(valid, _)| valid)
    });
    let share = |all: &[bool]| all.iter().filter(|valid| **valid).count() as f64 / all.len().max(1) as f64;
    let fine = share(&quarters.collect::<Vec<_>>());
    let coarse = share(&tiles.iter().map(|tile| tile.stats.valid > 0).collect::<Vec<_>>());
    let [w, h] = [grid.width, grid.height].map(|n| u64::from(n.saturating_sub(1).max(1)));
    let mut sum = 0.0;
    for level in (0..forest.lattice_levels()).step_by(2) {
        let side = 1u64 << (forest.root_log2() - level / 2);
        // Squares; and sides of squares, which need not be all in the source for their diamonds to touch it.
        let squares = |n: u64| n.div_ceil(side);
        let lines = |n: u64| (n + side / 2 - 1) / side + 1;
        let both = squares(w) * squares(h) + squares(w) * lines(h) + lines(w) * squares(h);
        sum += both as f64 * if side <= u64::from(tile_side / 2) { fine } else { coarse };
    }
    sum.round() as u64
}

/// Bytes of payloads of the levels of a tile, coarse first. Level 0 holds the root's own points too, coded as
/// nowhere else.
type Levels = [f64; 2 * TILE_LOG2 as usize];

/// The bytes of all levels of a source, from those of its tiles with so many samples that have a height.
fn of_all_levels([_, one, two, three]: Levels, samples: u64) -> f64 {
    let samples = samples as f64;
    // Two levels are one step of the quadtree. A point of the next coarser ones costs more by as much as it
    // does from the third level to the first, but not for ever.
    let points = samples * 3.0 / 8.0;
    let growth = if three > 0.0 { (4.0 * one / three).clamp(1.0, 4.0) } else { 1.0 };
    let own = if points > 0.0 { (one + two) / points } else { 0.0 };
    let coarser = (1..=STEPS_MAX).map(|step| {
        let each = (own * growth.powi(step)).min(POINT_BYTES_MAX.max(own));
        each * points / 4f64.powi(step)
    });
    three + two + one + coarser.sum::<f64>()
}

/// What building a tile gave.
#[derive(Debug, Clone, Copy, Default)]
struct Built {
    levels: Levels,
    /// Bytes of the levels past the lattice, and the diamonds that have them.
    past_bytes: f64,
    past_diamonds: f64,
    /// How long coding and comparing took.
    took: Duration,
    /// Of all levels of a source that has many such tiles.
    triangles: f64,
    tin_bytes: f64,
    /// How long these took.
    triangulating: Duration,
}

/// Builds a tile in a temporary folder.
fn build_tile(tile: &Tile, grid: &Grid, options: &Options) -> Result<Built, BuildError> {
    let temporary = |error| BuildError::Work { path: std::env::temp_dir(), error };
    let folder = tempfile::tempdir().map_err(temporary)?;
    let writer = Writer::create(folder.path())?;
    let failed = failure(&writer);
    let [width, height] = tile.size;
    let grid = Grid { width, height, ..grid.clone() };
    let forest = Forest::new(options.patch_log2 + TILE_LOG2, options.patch_log2, [1, 1])
        .map_err(|error| BuildError::Forest { width, height, error })?;
    let plan = Plan::new(forest, u64::MAX / 2, 0)?;
    let canvas = Canvas::create(writer.work_folder(), width, height, plan.coarsest()).map_err(&failed)?;
    canvas.write_rows(0, &tile.heights).map_err(&failed)?;
    let fine_step = fine_step(options.max_error, &tile.stats)?;
    let (plan, coding) = coding(&plan, &canvas, options.rule, fine_step)?;
    let forest = plan.forest;
    let progress = Progress::hidden();
    let journal = Journal::create(writer.work_folder(), &[0; 32], Duration::MAX).map_err(&failed)?;
    let work = Work { writer: &writer, journal, progress: &progress, chunks: 1, done: AtomicU64::new(0) };
    let build = Build {
        number: 0,
        plan,
        canvas,
        coding,
        work: &work,
        tallies: Mutex::new(Tallies::new(forest)),
        before: HashSet::new(),
        grid: &grid,
    };
    let started = Instant::now();
    if options.points {
        let coarse = build.coarse_levels()?;
        build.chunks(&coarse)?;
    }
    let took = started.elapsed();
    let started = Instant::now();
    let tin_forest = options.tin.map(|tin| tins::forest_of(&forest, &tin)).transpose()?;
    let nothing = tin_forest.map(|forest| (forest, tins::Found::new(forest)));
    let layer = build.triangles(nothing, options, &tile.stats)?.map(|(layer, _)| layer);
    let triangulating = started.elapsed();
    // As the levels above have half as many each, all of them have as many as the tile's coarsest.
    let all = layer.as_ref().map_or(1.0, |layer| 1.0 + 1.0 / (f64::from(layer.forest.levels()).exp2() - 1.0));
    let (triangles, tin_bytes) = layer.map_or((0, 0), |layer| (layer.triangles, layer.bytes));
    let tallies = build.tallies.lock().unwrap_or_else(std::sync::PoisonError::into_inner).take();
    let [w, h] = forest.size();
    let bytes = |d: Diamond| {
        let bytes = f64::from(tallies.of.get(d).bytes);
        // In the whole source the halves on both sides of a tile's border are one diamond.
        let [x, y] = d.centre();
        let half = x == 0 || y == 0 || x == w || y == h;
        bytes - if half { bytes.min(FIXED_BYTES) / 2.0 } else { 0.0 }
    };
    let mut built = Built {
        took,
        triangles: triangles as f64 * all,
        tin_bytes: tin_bytes as f64 * all,
        triangulating,
        ..Built::default()
    };
    for (level, sum) in (0..forest.lattice_levels()).zip(&mut built.levels) {
        *sum = forest.diamonds(level).map(bytes).sum();
    }
    for d in (forest.lattice_levels()..forest.levels()).flat_map(|level| forest.diamonds(level)) {
        built.past_bytes += bytes(d);
        let [x, y] = d.centre();
        let share = if x == 0 || y == 0 || x == w || y == h { 0.5 } else { 1.0 };
        built.past_diamonds += if tallies.of.get(d).bytes > 0 { share } else { 0.0 };
    }
    Ok(built)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coarser_levels_follow_from_finer_ones() {
        // As much for each point at every level; the root's own points do not count.
        let found = of_all_levels([1e9, 1.0, 2.0, 4.0], 8);
        assert!((found - 8.0).abs() < 1e-3, "{found}");
        assert!(of_all_levels([0.0; 4], 8) == 0.0 && of_all_levels([0.0; 4], 0) == 0.0);
        // However fast the cost grows, a third of the points cost no more than the most that a point does.
        let found = of_all_levels([0.0, 0.01, 0.001, 0.001], 800);
        assert!(found < 0.012 + 100.0 * POINT_BYTES_MAX, "{found}");
    }

    #[test]
    fn a_spread_is_even_and_of_the_size_asked_for() {
        for (all, count) in [(5, 9), (9, 9), (10, 9), (1000, 64), (65, 64), (7, 1)] {
            let kept = spread((0..all).collect(), count);
            assert_eq!(kept.len(), count.min(all), "{count} of {all}");
            let gaps: Vec<usize> = kept.windows(2).map(|w| w[1] - w[0]).collect();
            let (least, most) = (gaps.iter().min(), gaps.iter().max());
            assert!(least.zip(most).is_none_or(|(l, m)| m - l <= 1), "{count} of {all}: {kept:?}");
        }
    }
}

//! Drives a build in bounded memory: source → canvas → diamonds → store.
//!
//! 1. **Transcribe.** The source is read once, in bands of rows, into the [`Canvas`]: whole numbers of
//!    quanta at every power-of-two spacing.
//! 2. **Coarse levels.** The levels above the chunks are coded from the canvas' coarsest plane, all in
//!    memory.
//! 3. **Chunks.** The squares of one depth of the quadtree are independent of one another, since they need
//!    only what the coarse levels left: each worker takes one, codes the diamonds that it owns, and
//!    compares its samples with the surface of every level. Diamonds that straddle a chunk's border are
//!    computed on both sides (from the same numbers, so with the same result) and written by their owner.
//! 4. **Index.** Errors and ranges are saturated from the finest level up, pages written, all published.
//!
//! Everything written is a function of the source and the options, whatever the number of threads.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "lattice coordinates are below 2^28, sizes within the memory that was granted, and heights are checked against the range of quanta before they become integers"
)]

use crate::canvas::{Canvas, Window};
use crate::chunks::Chunks;
use crate::ingest::{Grid, IngestError, Source};
use crate::measure::{Found, Samples, measure};
use crate::progress::Progress;
use crate::store::{Key, Kind as BlobKind, StoreError, Writer};
use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::{Forest, ForestError};
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::message::{Crs, Frame, Kind, Layer, Scene};
use diamantina_protocol::points::{self, Coding, CodingError, Rule, SOURCE_MAX, STEP_MAX};
use rayon::prelude::*;
use std::collections::HashMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// What a build may be told.
#[derive(Debug, Clone)]
pub struct Options {
    /// The name of the scene.
    pub scene: String,
    /// The name of the layer.
    pub layer: String,
    /// Terrain or water.
    pub kind: Kind,
    /// The error asked of the finest level, in metres; 0 is lossless (to the quantum).
    pub max_error: f64,
    /// How the receiver deduces heights.
    pub rule: Rule,
    /// Metres of one quantum, or what suits the source.
    pub quantum: Option<f64>,
    /// Segments along the side of a patch, as a base-2 logarithm: 5, 6 or 7.
    pub patch_log2: u8,
    /// The most memory that the build may take, in bytes.
    pub memory: u64,
}

/// Why a scene could not be built.
#[derive(Debug, thiserror::Error)]
pub enum BuildError {
    /// The source could not be read.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// The store could not be written.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The working files could not be written.
    #[error("{path}: cannot write the working files: {error}; {}", if error.kind() == io::ErrorKind::StorageFull { "free some space (16/3 bytes a sample) and build again" } else { "check the disk, or choose another folder with -o" })]
    Work {
        /// The work folder.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// No sample has a height.
    #[error(
        "the source has no data: all {0} samples are nodata; check its nodata value, or give another with --nodata"
    )]
    AllNodata(u64),
    /// Heights do not fit in the integers of the format.
    #[error("height {value} is {} quanta of {quantum} m, beyond {SOURCE_MAX}: if it stands for nodata, say --nodata; else give a larger --quantum", (value / quantum).round())]
    Range {
        /// Metres.
        value: f64,
        /// Metres of a quantum.
        quantum: f64,
    },
    /// The quantum makes no sense.
    #[error("--quantum {0}: expected metres above 0 and below {HEIGHT_METRES_MAX}")]
    Quantum(f64),
    /// The asked error is out of range.
    #[error("--max-error {asked}: expected 0 to {limit} m for a quantum of {quantum} m")]
    MaxError {
        /// Metres asked.
        asked: f64,
        /// The largest that can be coded.
        limit: f64,
        /// Metres of a quantum.
        quantum: f64,
    },
    /// Too large, or too thin, for a forest.
    #[error(
        "the source has {width} x {height} samples: {error}; cut it into pieces and build a store of each"
    )]
    Forest {
        /// Samples along x.
        width: u32,
        /// Samples along y.
        height: u32,
        /// Why not.
        error: ForestError,
    },
    /// Our own steps were refused.
    #[error("steps: {0}")]
    Coding(#[from] CodingError),
    /// The memory asked for is too little.
    #[error("--memory {}: too little for this source: say --memory {} or more", mebibytes(*asked), mebibytes(*needed))]
    Memory {
        /// Bytes asked.
        asked: u64,
        /// Bytes needed.
        needed: u64,
    },
}

/// Bytes as the command line takes them, rounded up.
fn mebibytes(bytes: u64) -> String {
    format!("{}MiB", bytes.div_ceil(1 << 20))
}

/// What a build did.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Report {
    /// The scene as published.
    pub scene: Scene,
    /// Samples of the source.
    pub samples: u64,
    /// Diamonds with a payload.
    pub diamonds: u64,
    /// Bytes of payloads.
    pub point_bytes: u64,
    /// Bytes of index pages.
    pub index_bytes: u64,
    /// Bits of payload for each sample of the source that has a height.
    pub bits_per_sample: f64,
    /// Seconds taken.
    pub seconds: f64,
    /// Millions of samples a second.
    pub msamples_per_second: f64,
}

/// Builds a scene of one layer from a source and publishes it at `out`.
///
/// # Errors
/// When the source or the disk fails, or the options do not fit the source. The store at `out`, if there
/// was one, is then untouched.
pub fn build(
    source: &Source,
    out: &Path,
    options: &Options,
    progress: &Progress,
) -> Result<Report, BuildError> {
    let started = std::time::Instant::now();
    let grid = source.grid();
    let forest = Forest::covering(grid.width, grid.height, options.patch_log2)
        .map_err(|error| BuildError::Forest { width: grid.width, height: grid.height, error })?;
    let writer = Writer::create(out)?;
    let work = |error: io::Error| BuildError::Work { path: writer.work_folder().to_owned(), error };
    let plan = Plan::new(forest, options.memory)?;

    let (canvas, stats) = transcribe(source, &plan, options, writer.work_folder(), progress)?;
    let fine_step = fine_step(options.max_error, &stats)?;
    let exponents = exponents(&plan, &canvas, fine_step).map_err(work)?;
    let coding = Coding::new(options.rule, fine_step, exponents)?;
    let build = Build { plan, canvas, coding, writer: &writer, tallies: Mutex::default(), grid };

    let coarse = build.coarse_levels()?;
    build.chunks(&coarse, progress)?;
    let layer = build.index(options, &stats)?;
    let (diamonds, point_bytes, index_bytes) = {
        let tallies = build.tallies.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let written = tallies.ranges.values().filter(|r| r.bytes > 0);
        let points = written.clone().map(|r| u64::from(r.bytes)).sum::<u64>();
        (written.count() as u64, points, layer.bytes - points)
    };
    drop(build);
    progress.stage("publish", 0);
    let crs = grid.crs.as_ref().map(|crs| {
        let per_metre = [crs.step[0] / grid.cell[0], crs.step[1] / grid.cell[1]];
        let origin =
            [crs.origin[0] - grid.origin[0] * per_metre[0], crs.origin[1] - grid.origin[1] * per_metre[1]];
        Crs { name: crs.name.clone(), proj4: crs.proj4.clone(), origin, per_metre }
    });
    let frame = Frame { crs, vertical_unit: "metre".to_owned() };
    let scene = Scene {
        name: options.scene.clone(),
        version: String::new(),
        frame,
        layers: vec![layer],
        zones: Vec::new(),
    };
    let scene = writer.publish(scene)?;
    progress.finish();
    let samples = u64::from(grid.width) * u64::from(grid.height);
    let seconds = started.elapsed().as_secs_f64();
    Ok(Report {
        scene,
        samples,
        diamonds,
        point_bytes,
        index_bytes,
        bits_per_sample: point_bytes as f64 * 8.0 / stats.valid as f64,
        seconds,
        msamples_per_second: samples as f64 / seconds / 1e6,
    })
}

/// How the forest is divided for the build.
#[derive(Debug, Clone, Copy)]
struct Plan {
    forest: Forest,
    /// The squares that are built one by one.
    chunks: Chunks,
    /// Rows that are read at once, as a share of the memory.
    band_bytes: u64,
    /// Chunks that may be worked on at once.
    workers: usize,
}

impl Plan {
    fn new(forest: Forest, memory: u64) -> Result<Self, BuildError> {
        let [w, h] = forest.size().map(u64::from);
        let threads = rayon::current_num_threads() as u64;
        // Chunks of 1024 cells, or larger where the coarse levels would otherwise not fit.
        let chunk_logs = 10.max(forest.patch_log2() + 2).min(forest.root_log2())..=forest.root_log2();
        let coarse_bytes = |chunk_log2: u32| {
            let spacing = chunk_log2 - forest.patch_log2();
            // Heights of all coarse levels, and the blocks of the last three: about 40 bytes a point.
            ((w >> spacing) + 1) * ((h >> spacing) + 1) * 40
        };
        // A chunk's windows, blocks and surfaces: measured at about 40 bytes a cell, halo included.
        let chunk_bytes = |chunk_log2: u32| 40u64 << (2 * chunk_log2);
        let base = 96 << 20;
        let needed = |chunk_log2: u32| {
            // The coarse levels should take no more than a quarter, where larger chunks could still help.
            let share = if chunk_log2 < forest.root_log2() { 4 } else { 1 };
            let coarse = coarse_bytes(chunk_log2);
            (base + coarse + chunk_bytes(chunk_log2)).max(share * coarse)
        };
        let Some(chunk_log2) = chunk_logs.clone().find(|log2| needed(*log2) <= memory) else {
            let least = chunk_logs.map(needed).min().unwrap_or(u64::MAX);
            return Err(BuildError::Memory { asked: memory, needed: least });
        };
        let chunk_bytes = chunk_bytes(chunk_log2);
        let workers = ((memory - base - coarse_bytes(chunk_log2)) / 2 / chunk_bytes).clamp(1, threads);
        let chunks = Chunks::new(forest, chunk_log2);
        Ok(Self { forest, chunks, band_bytes: memory / 8 / threads, workers: workers as usize })
    }

    /// Base-2 logarithm of the spacing of the lattice of a level: that of the canvas plane with all its
    /// points. Of an odd level half of the plane's points are its own.
    fn spacing_log2(&self, level: u32) -> u32 {
        self.forest.root_log2() - self.forest.patch_log2() - level.div_ceil(2)
    }
}

/// What the transcription found.
#[derive(Debug, Clone, Copy)]
struct Stats {
    /// Metres of a quantum.
    quantum: f64,
    low: i32,
    high: i32,
    valid: u64,
    /// The largest distance between a source height and its quantum, in metres.
    rounding: f64,
}

/// Heights are below this, in metres: a client refuses what is more.
const HEIGHT_METRES_MAX: f64 = 1e12;

/// The greatest power of ten at or below `value`.
fn power_of_ten(value: f64) -> f64 {
    let exponent = value.log10().floor() as i32;
    // By division where it is exact: 0.01 is 1/100, not 10^-2 in steps.
    if exponent < 0 { 1.0 / 10f64.powi(-exponent) } else { 10f64.powi(exponent) }
}

/// A quantum for heights that are not whole numbers: their own decimal step if they have one, else a
/// power of ten of about 1/65536 of the range; coarser where the asked error allows it.
fn find_quantum(source: &Source, options: &Options) -> Result<f64, BuildError> {
    let grid = source.grid();
    let scale = grid.height_scale.abs();
    if let Some(quantum) = options.quantum {
        return if quantum > 0.0 && quantum < HEIGHT_METRES_MAX {
            Ok(quantum)
        } else {
            Err(BuildError::Quantum(quantum))
        };
    }
    if grid.integer {
        return Ok(scale);
    }
    // Up to 64 windows spread over the source say enough; an outlier beyond them is dealt with later.
    let mut heights = Vec::new();
    let mut window = Vec::new();
    let (side, along) = (128.min(grid.width).min(grid.height), 8);
    for j in 0..along {
        for i in 0..along {
            let at = |n: u32, i: u32| (u64::from(n - side) * u64::from(i) / u64::from(along - 1)) as u32;
            source.read(at(grid.width, i), at(grid.height, j), side, side, &mut window)?;
            heights.extend(window.iter().filter(|h| h.is_finite()).map(|h| h * grid.height_scale));
        }
    }
    let (low, high) = heights.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    let largest = low.abs().max(high.abs());
    if heights.is_empty() || largest == 0.0 || low >= high {
        return Ok(0.01);
    }
    // Heights read from 32-bit floats are within half a unit in their last place of a decimal.
    let slack = |h: f64| h.abs() * 1e-6;
    let has_step = |step: f64| {
        heights.iter().all(|h| (h - (h / step).round() * step).abs() <= slack(*h).min(step / 8.0))
    };
    let decimal = [1.0, 0.1, 0.01, 0.001].into_iter().find(|step| has_step(*step));
    let fine = power_of_ten((high - low) / 65536.0).min(0.01);
    let asked =
        if options.max_error > 0.0 { power_of_ten(options.max_error / 50.0).min(high - low) } else { 0.0 };
    let quantum = match decimal {
        Some(step) if options.max_error == 0.0 || step <= options.max_error => step,
        _ => fine.max(asked),
    };
    let least = power_of_ten(largest / f64::from(SOURCE_MAX)) * 10.0;
    if least > quantum && (largest >= HEIGHT_METRES_MAX || is_outlier(&mut heights, least)) {
        let value = if low.abs() > high.abs() { low } else { high };
        return Err(BuildError::Range { value, quantum });
    }
    Ok(quantum.max(least))
}

/// Whether a quantum that is due to the largest height is too coarse for the heights without their extremes:
/// then these are no heights, but nodata that nobody declared.
fn is_outlier(heights: &mut Vec<f64>, quantum: f64) -> bool {
    heights.sort_by(f64::total_cmp);
    heights.dedup();
    let aside = (heights.len() / 100).max(1);
    let rest = heights.get(aside..heights.len().saturating_sub(aside)).unwrap_or_default();
    rest.first().zip(rest.last()).is_some_and(|(low, high)| high - low < 256.0 * quantum)
}

/// Reads the whole source into a canvas of quanta.
fn transcribe(
    source: &Source,
    plan: &Plan,
    options: &Options,
    folder: &Path,
    progress: &Progress,
) -> Result<(Canvas, Stats), BuildError> {
    let grid = source.grid();
    let quantum = find_quantum(source, options)?;
    let work = |error: io::Error| BuildError::Work { path: folder.to_owned(), error };
    let coarsest = plan.spacing_log2(plan.chunks.level());
    let canvas = Canvas::create(folder, grid.width, grid.height, coarsest).map_err(work)?;
    let rows = (plan.band_bytes / 16 / u64::from(grid.width)).clamp(1, 256) as u32;
    progress.stage("read", u64::from(grid.width) * u64::from(grid.height));
    let bands: Vec<u32> = (0..grid.height).step_by(rows as usize).collect();
    let per_value = grid.height_scale / quantum;
    let stats = bands
        .into_par_iter()
        .map(|y0| {
            let count = rows.min(grid.height - y0);
            let mut values = Vec::new();
            source.read(0, y0, grid.width, count, &mut values)?;
            let mut stats = Stats { quantum, low: i32::MAX, high: i32::MIN, valid: 0, rounding: 0.0 };
            let mut heights = Vec::with_capacity(values.len());
            for value in &values {
                if value.is_nan() {
                    heights.push(NODATA);
                    continue;
                }
                let exact = value * per_value;
                let rounded = exact.round();
                if rounded.abs() > f64::from(SOURCE_MAX) {
                    return Err(BuildError::Range { value: value * grid.height_scale, quantum });
                }
                let height = rounded as i32;
                stats.low = stats.low.min(height);
                stats.high = stats.high.max(height);
                stats.valid += 1;
                stats.rounding = stats.rounding.max((exact - rounded).abs() * quantum);
                heights.push(height);
            }
            canvas.write_rows(y0, &heights).map_err(work)?;
            progress.advance(values.len() as u64);
            Ok(stats)
        })
        .try_reduce(
            || Stats { quantum, low: i32::MAX, high: i32::MIN, valid: 0, rounding: 0.0 },
            |a, b| {
                Ok(Stats {
                    quantum,
                    low: a.low.min(b.low),
                    high: a.high.max(b.high),
                    valid: a.valid + b.valid,
                    rounding: a.rounding.max(b.rounding),
                })
            },
        )?;
    if stats.valid == 0 {
        return Err(BuildError::AllNodata(u64::from(grid.width) * u64::from(grid.height)));
    }
    Ok((canvas, stats))
}

/// 2E+1 quanta for the whole number of quanta E that keeps every height within the asked error.
fn fine_step(max_error: f64, stats: &Stats) -> Result<u32, BuildError> {
    let room = ((max_error - stats.rounding) / stats.quantum * (1.0 + 1e-12)).floor().max(0.0);
    let limit = f64::from(STEP_MAX / 2 - 1);
    if max_error.is_finite() && max_error >= 0.0 && room <= limit {
        return Ok(2 * room as u32 + 1);
    }
    Err(BuildError::MaxError { asked: max_error, limit: limit * stats.quantum, quantum: stats.quantum })
}

/// A step for each level: about what the next finer level would add anyway, so that coarse views do not
/// pay for a precision that they cannot show.
fn exponents(plan: &Plan, canvas: &Canvas, fine_step: u32) -> io::Result<Vec<u8>> {
    let forest = &plan.forest;
    let details: Vec<f64> =
        (0..forest.levels()).map(|level| detail(plan, canvas, level)).collect::<io::Result<_>>()?;
    let mut exponents = vec![0u8; forest.levels() as usize + 1];
    // exponents[i + 1] is level i's; a level's step follows the detail of the level after it.
    for i in (0..forest.levels() as usize).rev() {
        let target = details.get(i).copied().unwrap_or(0.0);
        let mut exponent = exponents[i + 1];
        while (f64::from(fine_step) * 3f64.powi(i32::from(exponent) + 1)) <= target
            && fine_step.saturating_mul(3u32.pow(u32::from(exponent) + 1)) < STEP_MAX / 4
        {
            exponent += 1;
        }
        exponents[i] = exponent;
    }
    Ok(exponents)
}

/// The root mean square, in quanta, of what a level's new points differ from the mean of the four around
/// them, over a spread of windows.
fn detail(plan: &Plan, canvas: &Canvas, level: u32) -> io::Result<f64> {
    let forest = &plan.forest;
    let plane = plan.spacing_log2(level + 1).min(plan.spacing_log2(plan.chunks.level()));
    let step = 1u32 << plan.spacing_log2(level + 1);
    let [w, h] = forest.size();
    let side = (256 * step).min(w).min(h);
    let (mut sum, mut count) = (0.0, 0u64);
    for j in 0..4u64 {
        for i in 0..4u64 {
            let at = |n: u32, i: u64| ((u64::from(n - side) * i / 3) as u32) & !(2 * step - 1);
            let (x0, y0) = (at(w, i), at(h, j));
            let window = canvas.read(plane, [x0, y0], [x0 + side, y0 + side])?;
            // New points of an even level have odd coordinates in steps, with the corners around them; of
            // an odd level one odd and one even, with their neighbours along both axes.
            for y in (1..side / step).map(|y| y * step) {
                for x in (1..side / step).map(|x| x * step) {
                    let odd = (x / step % 2, y / step % 2);
                    let near = if level.is_multiple_of(2) {
                        if odd != (1, 1) {
                            continue;
                        }
                        [
                            (x - step, y - step),
                            (x + step, y - step),
                            (x + step, y + step),
                            (x - step, y + step),
                        ]
                    } else {
                        if odd.0 == odd.1 {
                            continue;
                        }
                        [(x - step, y), (x + step, y), (x, y - step), (x, y + step)]
                    };
                    let at = |(x, y): (u32, u32)| window.at(x0 + x, y0 + y);
                    let (here, around) = (at((x, y)), near.map(at));
                    if here != NODATA && !around.contains(&NODATA) {
                        let mean = around.iter().map(|h| f64::from(*h)).sum::<f64>() / 4.0;
                        sum += (f64::from(here) - mean).powi(2);
                        count += 1;
                    }
                }
            }
        }
    }
    Ok(if count == 0 { 0.0 } else { (sum / count as f64).sqrt() })
}

/// What is known of a diamond when it has been coded.
#[derive(Debug, Clone, Copy)]
struct Coded {
    low: i32,
    high: i32,
    bytes: u32,
}

/// What the workers collect.
#[derive(Debug, Default)]
struct Tallies {
    ranges: HashMap<Diamond, Coded>,
    found: HashMap<Diamond, Found>,
    finest: f64,
}

/// What the coarse levels leave: the heights that each level draws.
#[derive(Debug)]
struct Coarse {
    /// By level, from 0 to the chunks' level.
    surfaces: Vec<Surface>,
}

/// The heights that a level draws, over a rectangle.
#[derive(Debug)]
struct Surface {
    spacing_log2: u32,
    origin: [u32; 2],
    width: usize,
    heights: Vec<i32>,
}

impl Surface {
    fn new(spacing_log2: u32, origin: [u32; 2], cells: [u32; 2]) -> Self {
        let [w, h] = cells.map(|c| (c >> spacing_log2) as usize + 1);
        Self { spacing_log2, origin, width: w, heights: vec![NODATA; w * h] }
    }

    fn slot(&self, x: u32, y: u32) -> usize {
        let (i, j) = ((x - self.origin[0]) >> self.spacing_log2, (y - self.origin[1]) >> self.spacing_log2);
        j as usize * self.width + i as usize
    }

    fn at(&self, x: u32, y: u32) -> i32 {
        self.heights[self.slot(x, y)]
    }

    /// Takes over the points of a split diamond that lie in the rectangle.
    fn draw(&mut self, forest: &Forest, d: Diamond, block: &Block, cells: [u32; 2]) {
        let local = forest.local(d);
        let n = block.segments();
        let [x0, y0] = self.origin;
        let (xs, ys) = (i64::from(x0)..=i64::from(x0 + cells[0]), i64::from(y0)..=i64::from(y0 + cells[1]));
        for q in 0..=2 * n {
            for p in (q % 2..=2 * n).step_by(2) {
                let [x, y] = local.lattice2([p as i64, q as i64]);
                if xs.contains(&x) && ys.contains(&y) && (local.upper || q <= p) {
                    let slot = self.slot(x as u32, y as u32);
                    self.heights[slot] = block.heights()[Block::slot(n, p, q)];
                }
            }
        }
    }
}

/// A build under way.
struct Build<'a> {
    plan: Plan,
    canvas: Canvas,
    coding: Coding,
    writer: &'a Writer,
    tallies: Mutex<Tallies>,
    grid: &'a Grid,
}

/// A key that sorts blobs as a viewer descends: index pages first, then level by level along the Morton
/// curve.
fn blob_order(forest: &Forest, d: Diamond) -> u64 {
    let spread = |v: u32| {
        let mut v = u64::from(v) & 0x0fff_ffff;
        for (shift, mask) in [
            (16, 0x0000_ffff_0000_ffff_u64),
            (8, 0x00ff_00ff_00ff_00ff),
            (4, 0x0f0f_0f0f_0f0f_0f0f),
            (2, 0x3333_3333_3333_3333),
            (1, 0x5555_5555_5555_5555),
        ] {
            v = (v | v << shift) & mask;
        }
        v
    };
    let [x, y] = d.centre();
    // 2 x 27 bits below 6 bits of level: diamonds of a level lie at least two cells apart.
    debug_assert!(forest.levels() < 63);
    u64::from(d.level() + 1) << 56 | spread(x >> 1) | spread(y >> 1) << 1
}

impl Build<'_> {
    fn work(&self) -> impl Fn(io::Error) -> BuildError {
        let path = self.canvas.folder().to_owned();
        move |error| BuildError::Work { path: path.clone(), error }
    }

    /// The source heights of a diamond's block.
    fn source_block(&self, d: Diamond, window: &Window) -> Block {
        let mut block = Block::empty(&self.plan.forest);
        block.fill(&self.plan.forest.local(d), |x, y| window.at(x, y));
        block
    }

    /// Codes a diamond whose old points are in `block`, and keeps what it took.
    fn code(&self, d: Diamond, block: &mut Block, source: &Block) -> Result<(Diamond, Coded), BuildError> {
        let payload = points::encode(&self.plan.forest, &self.coding, d, block, source);
        let bytes = u32::try_from(payload.len()).unwrap_or(u32::MAX);
        if bytes > 0 {
            let [a, b] = d.centre();
            let key = Key { layer: 0, kind: BlobKind::Points, a, b };
            self.writer.put(key, blob_order(&self.plan.forest, d), &payload)?;
        }
        let all = block.heights().iter().chain(source.heights()).filter(|h| **h != NODATA);
        let (low, high) = all.fold((i32::MAX, i32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
        Ok((d, Coded { low, high, bytes }))
    }

    /// Codes every level above the chunks.
    fn coarse_levels(&self) -> Result<Coarse, BuildError> {
        let forest = &self.plan.forest;
        let size = forest.size();
        let chunk_level = self.plan.chunks.level();
        let plane = self.plan.spacing_log2(chunk_level);
        let window = self.canvas.read(plane, [0, 0], size).map_err(self.work())?;
        let mut surfaces = vec![Surface::new(self.plan.spacing_log2(0), [0, 0], size)];
        let mut before: HashMap<Diamond, Block> = HashMap::new();
        for level in 0..chunk_level {
            let coded: Vec<_> = forest
                .diamonds(level)
                .collect::<Vec<_>>()
                .into_par_iter()
                .map(|d| {
                    let mut block = inherited(forest, &before, d);
                    let coded = self.code(d, &mut block, &self.source_block(d, &window))?;
                    Ok((d, block, coded))
                })
                .collect::<Result<_, BuildError>>()?;
            let mut surface = Surface::new(self.plan.spacing_log2(level + 1), [0, 0], size);
            before.clear();
            let mut tallies = self.tallies.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            for (d, block, (_, range)) in coded {
                surface.draw(forest, d, &block, size);
                tallies.ranges.insert(d, range);
                before.insert(d, block);
            }
            drop(tallies);
            surfaces.push(surface);
        }
        Ok(Coarse { surfaces })
    }

    /// Codes all chunks.
    fn chunks(&self, coarse: &Coarse, progress: &Progress) -> Result<(), BuildError> {
        let chunks = self.plan.chunks.corners();
        let cells = 1u64 << (2 * self.plan.chunks.side_log2());
        progress.stage("build", chunks.len() as u64 * cells);
        let next = std::sync::atomic::AtomicUsize::new(0);
        // As many workers as the memory allows, each taking the next chunk when it is done with one.
        (0..self.plan.workers).into_par_iter().try_for_each(|_| {
            while let Some(corner) = chunks.get(next.fetch_add(1, std::sync::atomic::Ordering::Relaxed)) {
                self.chunk(*corner, coarse)?;
                progress.advance(cells);
            }
            Ok(())
        })
    }

    /// Codes the diamonds that a chunk owns and compares its samples with the surface of every level.
    fn chunk(&self, corner: [u32; 2], coarse: &Coarse) -> Result<(), BuildError> {
        let forest = &self.plan.forest;
        let side = 1u32 << self.plan.chunks.side_log2();
        let cells = [side, side];
        let far = corner.map(|w| w + side);
        // Beyond the source there is nothing, but for what straddles the border by half a chunk.
        if corner[0] > self.grid.width + side || corner[1] > self.grid.height + side {
            return Ok(());
        }
        let samples = self.canvas.read(0, corner, far).map_err(self.work())?;
        let (ranges, surfaces) = self.chunk_diamonds(corner, coarse)?;
        let mut found = HashMap::new();
        let mut finest = 0.0f64;
        if !samples.is_empty() {
            let heights: Vec<i32> = samples.rows().flatten().copied().collect();
            let samples = Samples { origin: corner, cells, heights: &heights };
            let coarse_levels =
                coarse.surfaces.iter().take(self.plan.chunks.level() as usize + 1).enumerate();
            for (level, surface) in coarse_levels.skip(1) {
                measure(forest, level as u32, samples, |x, y| surface.at(x, y), &mut found);
            }
            let first = self.plan.chunks.level() + 1;
            for (level, surface) in (first..forest.levels()).zip(&surfaces) {
                measure(forest, level, samples, |x, y| surface.at(x, y), &mut found);
            }
            if let Some(last) = surfaces.last() {
                let worst = last
                    .heights
                    .iter()
                    .zip(&heights)
                    .filter(|(_, s)| **s != NODATA)
                    .map(|(h, s)| h.abs_diff(*s))
                    .max();
                finest = f64::from(worst.unwrap_or(0));
            }
        }
        let mut tallies = self.tallies.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        tallies.ranges.extend(ranges);
        for (d, here) in found {
            tallies.found.entry(d).or_default().merge(here);
        }
        tallies.finest = tallies.finest.max(finest);
        Ok(())
    }

    /// The diamonds of a chunk, level by level: ranges of those that it owns, and the surfaces of the
    /// levels below the chunk's own, over the chunk.
    #[allow(
        clippy::type_complexity,
        reason = "two results of one pass, taken apart at once by the only caller"
    )]
    fn chunk_diamonds(
        &self,
        corner: [u32; 2],
        coarse: &Coarse,
    ) -> Result<(Vec<(Diamond, Coded)>, Vec<Surface>), BuildError> {
        let forest = &self.plan.forest;
        let side = 1u32 << self.plan.chunks.side_log2();
        let needed = self.plan.chunks.needed(corner);
        let (mut ranges, mut surfaces) = (Vec::new(), Vec::new());
        let mut before: HashMap<Diamond, Block> = HashMap::new();
        for (level, diamonds) in (self.plan.chunks.level()..).zip(&needed) {
            let spacing = self.plan.spacing_log2(level + 1);
            let bounds = diamonds.iter().map(|d| forest.bounds(*d)).reduce(|[a, b], [c, d]| {
                [[a[0].min(c[0]), a[1].min(c[1])], [b[0].max(d[0]), b[1].max(d[1])]]
            });
            let Some([low, high]) = bounds else { continue };
            let window = self.canvas.read(spacing, low, high).map_err(self.work())?;
            let mut surface = Surface::new(spacing, corner, [side, side]);
            let mut here = HashMap::new();
            for d in diamonds {
                let mut block = inherited(forest, &before, *d);
                if level == self.plan.chunks.level() && level > 0 {
                    // The chunks' own level starts from what the coarse levels left.
                    if let Some(last) = coarse.surfaces.last() {
                        let mut whole = Block::empty(forest);
                        whole.fill(&forest.local(*d), |x, y| {
                            let on_lattice = (x | y).trailing_zeros() >= last.spacing_log2;
                            if on_lattice { last.at(x, y) } else { NODATA }
                        });
                        block.parts_mut().0.copy_from_slice(whole.parts().0);
                    }
                }
                let source = self.source_block(*d, &window);
                if self.plan.chunks.owns(corner, *d) {
                    ranges.push(self.code(*d, &mut block, &source)?);
                } else {
                    points::quantise(forest, &self.coding, *d, &mut block, &source);
                }
                surface.draw(forest, *d, &block, [side, side]);
                here.insert(*d, block);
            }
            before = here;
            surfaces.push(surface);
        }
        Ok((ranges, surfaces))
    }

    /// Saturates errors and ranges, writes the index, and describes the layer.
    fn index(&self, options: &Options, stats: &Stats) -> Result<Layer, BuildError> {
        let forest = &self.plan.forest;
        let tallies = self.tallies.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let cell = self.grid.cell;
        // Room for the rounding of metres, where they are not whole.
        let slack = if stats.quantum.fract() == 0.0 && stats.rounding == 0.0 { 1.0 } else { 1.0 + 1e-9 };
        let finest = up((tallies.finest * stats.quantum + stats.rounding) * slack);
        let mut entries: HashMap<Diamond, Entry> = HashMap::new();
        for level in (0..forest.levels()).rev() {
            let [along, across] = forest.hypotenuse(level);
            let hypotenuse = if across > 0.0 {
                (along * cell[0]).hypot(across * cell[1])
            } else {
                along * cell[0].max(cell[1])
            };
            for d in forest.diamonds(level) {
                let mut entry = Entry::EMPTY;
                let coded = tallies.ranges.get(&d);
                if let Some(coded) = coded.filter(|c| c.low <= c.high) {
                    (entry.low, entry.high) = (coded.low, coded.high);
                }
                entry.bytes = coded.map_or(0, |c| c.bytes);
                let own = tallies.found.get(&d).map_or(0.0, |f| {
                    f.vertical * stats.quantum + stats.rounding + if f.outline { hypotenuse } else { 0.0 }
                });
                entry.error_metres = up(own * slack);
                for child in forest.children(d).into_iter().flatten().filter_map(|c| entries.get(&c)) {
                    if !child.is_empty() {
                        entry.error_metres = entry.error_metres.max(child.error_metres);
                        let fresh = entry.is_empty();
                        entry.low = if fresh { child.low } else { entry.low.min(child.low) };
                        entry.high = if fresh { child.high } else { entry.high.max(child.high) };
                    }
                }
                if !entry.is_empty() {
                    entry.error_metres = index::declared(entry.error_metres.max(finest));
                }
                entries.insert(d, entry);
            }
        }
        let mut bytes: u64 = entries.values().map(|e| u64::from(e.bytes)).sum();
        for page in 0..index::pages(forest) {
            let diamonds = index::page_diamonds(forest, page).unwrap_or_default();
            let list: Vec<Entry> =
                diamonds.iter().map(|d| entries.get(d).copied().unwrap_or(Entry::EMPTY)).collect();
            let blob = zstd::bulk::compress(&index::encode(&list), 12).map_err(self.work())?;
            bytes += blob.len() as u64;
            self.writer.put(
                Key { layer: 0, kind: BlobKind::Index, a: page, b: 0 },
                u64::from(page),
                &blob,
            )?;
        }
        let offset = self.grid.height_offset;
        Ok(Layer {
            name: options.layer.clone(),
            kind: options.kind,
            forest: *forest,
            origin: self.grid.origin,
            cell,
            samples: [self.grid.width, self.grid.height],
            valid_samples: stats.valid,
            quantum: stats.quantum,
            height_offset: offset,
            heights: [
                f64::from(stats.low) * stats.quantum + offset,
                f64::from(stats.high) * stats.quantum + offset,
            ],
            max_error: options.max_error,
            finest_error: finest,
            encodings: vec!["points".to_owned()],
            coding: self.coding.clone(),
            bytes,
            resampled: self.grid.resampled,
            errors: "exact".to_owned(),
        })
    }
}

/// The least `f32` at or above a value.
fn up(value: f64) -> f32 {
    let near = value as f32;
    if f64::from(near) < value { near.next_up() } else { near }
}

/// The block of a diamond with the old points that its parents leave.
fn inherited(forest: &Forest, before: &HashMap<Diamond, Block>, d: Diamond) -> Block {
    let mut block = Block::empty(forest);
    for parent in forest.parents(d) {
        if let Some(from) = before.get(&parent) {
            block.inherit(forest, d, parent, from);
        }
    }
    block
}

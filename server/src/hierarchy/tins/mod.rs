//! The encoding `tin`: every diamond's triangles, from the finest level up.
//!
//! A diamond needs nothing but the halves that its children left, and leaves two for its parents; so the diamonds of
//! a level are independent, and levels follow one another. Those of a level are taken in tiles, many at once, each
//! noted in the journal when it is done:
//!
//! ```text
//! halves of its children ─► merge ─► payload ─► simplify ─► two halves, and how far they are from every sample
//! ```
//!
//! The finest payloads are of triangles that were simplified as well, as far as the error asked of the layer allows (without
//! loss, of the source's own mesh where hardly anything is flat):
//! of the levels below them nothing is kept, a tile makes what it needs of them.
//!
//! Memory: a tile's samples and the meshes of one diamond a worker, [`WINDOW_SAMPLES`] at most, unless an error is to
//! be kept at each collapse: then all samples of a diamond, of the largest ones one by one. Disk: the halves of two
//! levels, some 30 bytes a sample in all.

mod halves;
mod tile;

pub(super) use halves::Place;
pub(super) use tile::BEHIND;

use super::index::{saturated, up};
use super::journal::{Record, Tile, Triangulated};
use super::tallies::{PerDiamond, places_of_all};
use super::transcribe::Stats;
use super::{BuildError, Options, Work};
use crate::canvas::Canvas;
use crate::tin::{Metric, Rules, Scale};
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::Entry;
use diamantina_protocol::message::TinLayer;
use diamantina_protocol::tin::TRIANGLES_MAX;
use halves::Halves;
use rayon::prelude::*;
use std::collections::{BTreeMap, HashSet};
use std::io;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

/// How the triangles of a layer are chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TinOptions {
    /// Triangles of a patch at which simplification stops.
    pub patch_triangles: u32,
    /// The order of collapses.
    pub metric: Metric,
    /// How much the borders along nodata count in it.
    pub lambda: f64,
    /// Instead of a count: the error of the finest patches that are simplified, in metres. Twice as much every two
    /// levels.
    pub patch_error: Option<f64>,
}

impl Default for TinOptions {
    fn default() -> Self {
        Self { patch_triangles: PATCH_TRIANGLES, metric: Metric::Normal, lambda: LAMBDA, patch_error: None }
    }
}

/// Triangles of a patch, unless asked otherwise.
pub const PATCH_TRIANGLES: u32 = 1024;

/// Triangles that may be asked for: the finest patches have up to 4096.
pub const PATCH_TRIANGLES_RANGE: std::ops::RangeInclusive<u32> = 64..=8192;

/// Triangles of a half, whatever error is asked, and vertices, whatever nodata leaves: so that four of them fit in a
/// payload of 256 KiB even if each vertex takes its 8 bytes.
const HALF_TRIANGLES_MAX: usize = TRIANGLES_MAX / 16 * 3;
const HALF_VERTICES_MAX: usize = 1 << 13;

/// The weight of borders, unless asked otherwise.
pub const LAMBDA: f64 = 1.0;

/// Base-2 logarithm of the side of a tile, in cells; of larger diamonds each has one of its own.
const TILE_LOG2: u32 = 10;

/// Samples that a worker reads at once: those of a diamond 4096 cells wide, 64 MiB. The samples of larger ones are looked
/// at when they are simplified, not at each collapse, unless an error was asked.
const WINDOW_SAMPLES: u64 = (1 << 24) + (1 << 14);

/// What the program, its threads and the source's cache take, as for points.
const BASE_BYTES: u64 = 96 << 20;

/// Of a worker: samples, meshes, halves.
const WORKER_BYTES: u64 = 128 << 20;

/// Of work files for each sample, at most.
pub(super) const DISK_BYTES: u64 = 30;

/// 32 (known) + 16 (place) + 40 (spool) + 40 (pack) + 32 (directory) + 16 (entry).
const DIAMOND_BYTES: u64 = 176;

/// Whether the options make sense.
pub(super) fn check(options: &Options) -> Result<(), BuildError> {
    let Some(tin) = options.tin else { return Ok(()) };
    let wrong = |name, found, expected| Err(BuildError::TinOption { name, found, expected });
    if !PATCH_TRIANGLES_RANGE.contains(&tin.patch_triangles) {
        return wrong("--patch-triangles", tin.patch_triangles.into(), "64 to 8192");
    }
    if !(tin.lambda.is_finite() && tin.lambda >= 0.0) {
        return wrong("--lambda", tin.lambda, "0 or more");
    }
    match tin.patch_error {
        Some(error) if !(error.is_finite() && error >= 0.0) => {
            wrong("--patch-error", error, "metres, 0 or more")
        }
        _ => Ok(()),
    }
}

/// Bytes that the diamonds of triangles need, whatever else the memory is used for. Refuses what would be found too little
/// only when the largest diamonds are reached, late in the build.
pub(super) fn bytes(layer: &Forest, options: &Options) -> Result<u64, BuildError> {
    let Some(tin) = options.tin else { return Ok(0) };
    let forest = forest_of(layer, &tin)?;
    let window = window_bytes(&forest, 1);
    if tin.patch_error.is_some() && window > options.memory / 2 {
        let side = (1 << forest.root_log2()) + 1;
        return Err(BuildError::PatchErrorMemory { side, asked: options.memory, needed: 2 * window });
    }
    Ok(places_of_all(&forest) * DIAMOND_BYTES)
}

/// The most memory that triangles take; 0 if there are none.
pub(super) fn memory_max(layer: &Forest, options: &Options) -> Result<u64, BuildError> {
    if options.tin.is_none() {
        return Ok(0);
    }
    let all = BASE_BYTES + workers(options.memory) as u64 * WORKER_BYTES + bytes(layer, options)?;
    // An error at each collapse may want half of what was asked.
    Ok(if options.tin.is_some_and(|tin| tin.patch_error.is_some()) { all.max(options.memory) } else { all })
}

/// Bytes of all samples of a diamond.
fn window_bytes(forest: &Forest, level: u32) -> u64 {
    let side = 1u64 << (forest.root_log2() - level / 2);
    4 * (side + 1) * (side + 1)
}

/// Workers that the memory allows.
pub(super) fn workers(memory: u64) -> usize {
    let most = rayon::current_num_threads();
    usize::try_from(memory.saturating_sub(BASE_BYTES) / WORKER_BYTES).unwrap_or(most).clamp(1, most)
}

/// The forest of the triangles of a layer: its own roots, and patches that have about as many triangles where nothing
/// is simplified as all others have.
pub(super) fn forest_of(layer: &Forest, options: &TinOptions) -> Result<Forest, BuildError> {
    let wanted = (options.patch_triangles.max(1).ilog2() / 2).clamp(3, 6);
    let patch_log2 = u8::try_from(wanted.min(layer.root_log2() - 1)).unwrap_or(u8::MAX);
    let root_log2 = u8::try_from(layer.root_log2()).unwrap_or(u8::MAX);
    Forest::new(root_log2, patch_log2, layer.roots()).map_err(BuildError::TinForest)
}

/// Diamonds that are worked on one after the other: by tiles, and in order. As many tiles whatever the machine.
fn tiles(forest: &Forest, level: u32) -> Vec<Vec<Diamond>> {
    let side_log2 = TILE_LOG2.max(forest.root_log2() - level / 2);
    let mut tiles: BTreeMap<[u32; 2], Vec<Diamond>> = BTreeMap::new();
    for d in forest.diamonds(level) {
        let [x, y] = d.centre();
        tiles.entry([y >> side_log2, x >> side_log2]).or_default().push(d);
    }
    tiles.into_values().collect()
}

/// How many tiles there are in all.
pub(super) fn tiles_of_all(forest: &Forest) -> u64 {
    let side_log2 = |level: u32| TILE_LOG2.max(forest.root_log2() - level / 2);
    let count = |level: u32| {
        // Centres of odd levels lie on the far borders as well.
        let mut places = HashSet::new();
        for d in forest.diamonds(level) {
            places.insert(d.centre().map(|w| w >> side_log2(level)));
        }
        places.len() as u64
    };
    (0..forest.levels()).map(count).sum()
}

/// What is known of a diamond.
#[derive(Debug, Clone, Copy)]
struct Known {
    /// The largest vertical distance, in quanta, and between borders, in metres, while it is not split.
    vertical: f64,
    apart: f64,
    low: i32,
    high: i32,
    /// Of its payload.
    bytes: u32,
    triangles: u32,
}

impl Known {
    const NOTHING: Self =
        Self { vertical: 0.0, apart: 0.0, low: i32::MAX, high: i32::MIN, bytes: 0, triangles: 0 };
}

/// A build's triangles under way.
pub(super) struct Tins<'a> {
    /// Position of the layer in the scene.
    pub(super) number: u8,
    pub(super) forest: Forest,
    pub(super) canvas: &'a Canvas,
    pub(super) work: &'a Work<'a>,
    pub(super) options: TinOptions,
    pub(super) stats: &'a Stats,
    pub(super) max_error: f64,
    pub(super) cell: [f64; 2],
    pub(super) workers: usize,
    /// The most memory, in bytes.
    pub(super) memory: u64,
}

/// What is done. Takes 32 bytes a diamond, and 16 more of two levels.
#[derive(Debug)]
pub(super) struct Found {
    of: PerDiamond<Known>,
    places: PerDiamond<Place>,
    tiles: HashSet<(u32, u32)>,
    /// The largest vertical distance, in quanta, and between borders, in metres, where all is split.
    finest: [f64; 2],
}

impl Found {
    /// Nothing is done.
    pub(super) fn new(forest: Forest) -> Self {
        Self {
            of: PerDiamond::new(forest, Known::NOTHING),
            places: PerDiamond::new(forest, Place::default()),
            tiles: HashSet::new(),
            finest: [0.0; 2],
        }
    }

    /// How many tiles are done.
    pub(super) fn tiles(&self) -> u64 {
        self.tiles.len() as u64
    }

    /// Takes over a tile; false if it is done already or speaks of diamonds that are not of this forest.
    pub(super) fn add(&mut self, forest: &Forest, tile: &Tile) -> bool {
        let named = |one: &Triangulated| forest.diamond(one.centre).filter(|d| d.level() == tile.level);
        if !tile.done.iter().all(|one| named(one).is_some()) || !self.tiles.insert((tile.level, tile.number))
        {
            return false;
        }
        for (one, d) in tile.done.iter().filter_map(|one| Some((one, named(one)?))) {
            let Triangulated { vertical, apart, low, high, triangles, spot, halves, .. } = *one;
            let bytes = spot.map_or(0, |spot| spot.bytes);
            *self.of.at(d) = Known { vertical, apart, low, high, bytes, triangles };
            *self.places.at(d) = halves;
        }
        for (worst, here) in self.finest.iter_mut().zip(tile.finest) {
            *worst = worst.max(here);
        }
        true
    }
}

impl Tins<'_> {
    pub(super) fn rules(&self) -> Rules {
        let scale = Scale { cell: self.cell, quantum: self.stats.quantum };
        Rules {
            metric: self.options.metric,
            lambda: self.options.lambda,
            scale,
            triangles_max: HALF_TRIANGLES_MAX,
            vertices_max: HALF_VERTICES_MAX,
        }
    }

    /// Triangulates all that no earlier run has.
    pub(super) fn run(&self, before: Found) -> Result<Found, BuildError> {
        let forest = &self.forest;
        let found = RwLock::new(before);
        let all: u64 = (0..forest.levels()).map(|level| forest.diamonds(level).count() as u64).sum();
        self.work.progress.stage("triangulate", "diamonds", all, 0);
        let folder = self.canvas.folder();
        let failed = self.work.failure();
        for level in (0..forest.levels()).rev() {
            let tiles = tiles(forest, level);
            let count = u32::try_from(tiles.len()).unwrap_or(u32::MAX);
            let is_done = |number: u32| read(&found).tiles.contains(&(level, number));
            if (0..count).all(is_done) {
                self.work.progress.advance(forest.diamonds(level).count() as u64);
                continue;
            }
            let open = |level: u32| {
                let places = forest.diamonds(level).map(|d| read(&found).places.get(d));
                let halves = Halves::open(folder, level, places).map_err(&failed)?;
                halves.ok_or_else(|| {
                    failed(io::Error::other("work files are missing: build again with --fresh"))
                })
            };
            let input = if level + 1 < forest.levels() { Some(open(level + 1)?) } else { None };
            let output = open(level)?;
            self.level(level, &tiles, &found, input.as_ref(), &output)?;
            // What was read is needed no more once this level is on the disk.
            self.work.checkpoint_with(self.canvas, || output.sync())?;
            Halves::remove(folder, level + 1).map_err(&failed)?;
            if level + 1 < forest.levels() {
                write(&found).places.forget(level + 1);
            }
        }
        Ok(found.into_inner().unwrap_or_else(PoisonError::into_inner))
    }

    /// The tiles of a level that are not done.
    fn level(
        &self,
        level: u32,
        tiles: &[Vec<Diamond>],
        found: &RwLock<Found>,
        input: Option<&Halves>,
        output: &Halves,
    ) -> Result<(), BuildError> {
        let next = AtomicUsize::new(0);
        let failed = AtomicBool::new(false);
        let go_on = || !self.work.progress.is_stopping() && !failed.load(Ordering::Relaxed);
        let place = |d: Diamond| read(found).places.get(d);
        let worked: Result<(), BuildError> = (0..self.workers_at(level)).into_par_iter().try_for_each(|_| {
            while go_on() {
                let position = next.fetch_add(1, Ordering::Relaxed);
                let Some(diamonds) = tiles.get(position) else { break };
                let number = u32::try_from(position).unwrap_or(u32::MAX);
                if !read(found).tiles.contains(&(level, number)) {
                    let input = input.map(|halves| (halves, &place as &(dyn Fn(Diamond) -> Place + Sync)));
                    let tile = self
                        .tile(level, number, diamonds, input, output)
                        .inspect_err(|_| failed.store(true, Ordering::Relaxed))?;
                    write(found).add(&self.forest, &tile);
                    if self.work.note(self.number, &Record::Tile(tile)) {
                        self.work.checkpoint_with(self.canvas, || output.sync())?;
                    }
                }
                self.work.progress.advance(diamonds.len() as u64);
            }
            Ok(())
        });
        if let Err(error) = worked {
            // What is done may still be kept; the first failure is the one to tell.
            let _ = self.work.checkpoint_with(self.canvas, || output.sync());
            return Err(error);
        }
        let count = u32::try_from(tiles.len()).unwrap_or(u32::MAX);
        if !(0..count).all(|number| read(found).tiles.contains(&(level, number))) {
            self.work.checkpoint_with(self.canvas, || output.sync())?;
            return Err(self.work.interrupted());
        }
        Ok(())
    }

    /// How many tiles of a level may be worked on at once: one, where the samples of two diamonds would be too many.
    fn workers_at(&self, level: u32) -> usize {
        let bytes = window_bytes(&self.forest, level);
        let one = self.options.patch_error.is_some() && bytes * self.workers as u64 > self.memory / 2;
        if one { 1 } else { self.workers }
    }

    /// The layer's part in the scene, but for the bytes of its index, and what that index says.
    pub(super) fn describe(&self, found: Found) -> (TinLayer, PerDiamond<Entry>) {
        let forest = &self.forest;
        let stats = self.stats;
        let slack = if stats.quantum.fract() == 0.0 && stats.rounding == 0.0 { 1.0 } else { 1.0 + 1e-9 };
        // Below this length errors are taken for such of heights alone.
        let least = forest.hypotenuse(forest.levels(), self.cell);
        let metres = |vertical: f64, apart: f64| {
            let apart = if apart > 0.0 { apart.max(least) } else { 0.0 };
            up((vertical * stats.quantum + stats.rounding + apart) * slack)
        };
        let finest = metres(found.finest[0], found.finest[1]);
        let sums = found.of.values().fold((0, 0), |(triangles, bytes), one| {
            (triangles + u64::from(one.triangles), bytes + u64::from(one.bytes))
        });
        let apart = |level: u32| forest.diamonds(level).map(|d| found.of.get(d).apart).fold(0.0, f64::max);
        let borders = (0..forest.levels()).map(|level| up(apart(level))).collect();
        let entry = |_, one: Known| {
            let lossless = one.vertical <= 0.0 && one.apart <= 0.0;
            let error_metres = if lossless { 0.0 } else { metres(one.vertical, one.apart) };
            let entry = Entry { error_metres, bytes: one.bytes, ..Entry::EMPTY };
            if one.low <= one.high { Entry { low: one.low, high: one.high, ..entry } } else { entry }
        };
        let entries = saturated(forest, found.of, finest, entry);
        let layer = TinLayer {
            forest: *forest,
            finest_error: finest,
            triangles: sums.0,
            bytes: sums.1,
            patch_triangles: self.options.patch_triangles,
            borders,
            metric: match self.options.metric {
                Metric::Normal => "normal".to_owned(),
                Metric::Quadric => "quadric".to_owned(),
            },
            lambda: self.options.lambda,
            patch_error: self.options.patch_error,
            errors: "exact".to_owned(),
        };
        (layer, entries)
    }
}

fn read(found: &RwLock<Found>) -> RwLockReadGuard<'_, Found> {
    found.read().unwrap_or_else(PoisonError::into_inner)
}

fn write(found: &RwLock<Found>) -> RwLockWriteGuard<'_, Found> {
    found.write().unwrap_or_else(PoisonError::into_inner)
}

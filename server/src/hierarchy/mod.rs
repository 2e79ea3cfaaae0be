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
//! What is done is noted in a `journal`; a build that was killed goes on from there.
//!
//! Everything written is a function of the source and the options, whatever the number of threads.

mod coding;
mod error;
mod estimate;
mod index;
mod journal;
mod levels;
mod plan;
mod surface;
mod tallies;
mod tins;
mod transcribe;
mod work;

use crate::canvas::Canvas;
use crate::ingest::{Grid, Source};
use crate::progress::Progress;
use crate::store::{Kind as BlobKind, Writer};
use coding::fine_step;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::index::Entry;
use diamantina_protocol::message::{Crs, Frame, Kind, Layer, Scene, TinLayer};
use diamantina_protocol::points::{Coding, Rule};
use index::Sums;
use plan::Plan;
use std::collections::HashSet;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};
use tallies::{PerDiamond, Tallies};
use transcribe::{Stats, find_quantum, transcribe};
use work::Work;

pub use error::BuildError;
pub use estimate::{Estimate, estimate};
pub use tins::{LAMBDA, PATCH_TRIANGLES, PATCH_TRIANGLES_RANGE, TinOptions};

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
    /// Whether to build the encoding `points`.
    pub points: bool,
    /// How to build the encoding `tin`, if it is wanted.
    pub tin: Option<TinOptions>,
    /// The most memory that the build may take, in bytes.
    pub memory: u64,
    /// Whether to begin anew even where an interrupted build could be gone on with.
    pub fresh: bool,
    /// Between two checkpoints: the most work that a kill costs.
    pub checkpoint: Duration,
}

impl Options {
    /// A lossless terrain of smooth rule and 64 segments, in 2 GiB: what the command line says by itself.
    #[must_use]
    pub fn new(scene: &str) -> Self {
        Self {
            scene: scene.to_owned(),
            layer: "terrain".to_owned(),
            kind: Kind::Terrain,
            max_error: 0.0,
            rule: Rule::Smooth,
            quantum: None,
            patch_log2: 6,
            points: true,
            tin: None,
            memory: 2 << 30,
            fresh: false,
            checkpoint: CHECKPOINT,
        }
    }
}

/// Between two checkpoints, unless told otherwise. Syncing more often would cost more than a kill does.
pub const CHECKPOINT: Duration = Duration::from_secs(5);

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
    /// Bytes of index pages, of all encodings.
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
/// What an earlier run of the same build left in the work folder is gone on with; the bytes are those of an
/// unbroken build. `progress` says when to stop.
///
/// # Errors
/// When the source or the disk fails, the options do not fit the source, or `progress` was told to stop. The
/// store at `out`, if there was one, is then untouched. Where the source and the options are not to blame, the
/// work folder stays, for the same build to go on with.
pub fn build(
    source: &Source,
    out: &Path,
    options: &Options,
    progress: &Progress,
) -> Result<Report, BuildError> {
    let started = Instant::now();
    let grid = source.grid();
    let forest = forest_of(grid, options)?;
    // Wrong use is refused before an earlier run's work is touched.
    tins::check(options)?;
    let plan = Plan::new(forest, options.memory, tins::bytes(&forest, options)?)?;
    let quantum = find_quantum(source, options)?;
    let writer = Writer::create(out)?;
    let built = run(source, &writer, options, progress, plan, quantum);
    progress.finish();
    match built {
        Ok((scene, stats, sums)) => Ok(report(grid, scene, &stats, sums, started)),
        Err(error) => {
            if error.keeps_work() {
                writer.keep();
            }
            Err(error)
        }
    }
}

/// The forest that covers a source.
fn forest_of(grid: &Grid, options: &Options) -> Result<Forest, BuildError> {
    Forest::covering(grid.width, grid.height, options.patch_log2).map_err(|error| BuildError::Forest {
        width: grid.width,
        height: grid.height,
        error,
    })
}

/// Reads, codes, indexes and publishes.
fn run(
    source: &Source,
    writer: &Writer,
    options: &Options,
    progress: &Progress,
    plan: Plan,
    quantum: f64,
) -> Result<(Scene, Stats, Sums), BuildError> {
    let grid = source.grid();
    let fingerprint = work::fingerprint(source, options, &plan);
    let (work, canvas, before) = work::open(writer, &plan, grid, &fingerprint, options, progress)?;
    let stats = transcribe(source, &plan, &canvas, quantum, &before.bands, &work)?;
    let fine_step = fine_step(options.max_error, &stats)?;
    let done = AtomicU64::new(before.done());
    let (plan, coding) = if options.points {
        coding::coding(&plan, &canvas, options.rule, fine_step)?
    } else {
        coding::without_points(&plan, options.rule, fine_step)?
    };
    let build = Build {
        plan,
        canvas,
        coding,
        work: &work,
        tallies: Mutex::new(before.tallies),
        done,
        before: before.chunks,
        grid,
    };
    if options.points {
        let coarse = build.coarse_levels()?;
        build.chunks(&coarse)?;
    }
    let tallies = build.tallies.lock().unwrap_or_else(PoisonError::into_inner).take();
    let triangles = build.triangles(before.tins, options, &stats)?;
    let (mut layer, mut sums) = build.index(tallies, options, &stats)?;
    if let Some((tin, entries)) = triangles {
        build.index_triangles(&mut layer, &mut sums, tin, &entries)?;
    }
    progress.stage("publish", "bytes", layer.bytes, 0);
    let scene = Scene {
        name: options.scene.clone(),
        version: String::new(),
        frame: frame(grid),
        layers: vec![layer],
        zones: Vec::new(),
    };
    let go_on = |bytes| {
        progress.advance(bytes);
        !progress.is_stopping()
    };
    let scene = writer.publish(scene, go_on)?.ok_or_else(|| build.interrupted())?;
    Ok((scene, stats, sums))
}

/// The frame of a source's grid.
fn frame(grid: &Grid) -> Frame {
    let crs = grid.crs.as_ref().map(|crs| {
        let per_metre = [crs.step[0] / grid.cell[0], crs.step[1] / grid.cell[1]];
        let origin =
            [crs.origin[0] - grid.origin[0] * per_metre[0], crs.origin[1] - grid.origin[1] * per_metre[1]];
        Crs { name: crs.name.clone(), proj4: crs.proj4.clone(), origin, per_metre }
    });
    Frame { crs, vertical_unit: "metre".to_owned() }
}

fn report(grid: &Grid, scene: Scene, stats: &Stats, sums: Sums, started: Instant) -> Report {
    let samples = u64::from(grid.width) * u64::from(grid.height);
    let seconds = started.elapsed().as_secs_f64();
    let Sums { diamonds, point_bytes, index_bytes } = sums;
    Report {
        scene,
        samples,
        diamonds,
        point_bytes,
        index_bytes,
        bits_per_sample: point_bytes as f64 * 8.0 / stats.valid as f64,
        seconds,
        msamples_per_second: samples as f64 / seconds / 1e6,
    }
}

/// A build under way.
struct Build<'a> {
    plan: Plan,
    canvas: Canvas,
    coding: Coding,
    work: &'a Work<'a>,
    tallies: Mutex<Tallies>,
    /// Chunks that earlier runs have done.
    before: HashSet<u32>,
    /// How many are done by now.
    done: AtomicU64,
    grid: &'a Grid,
}

impl Build<'_> {
    /// The layer's triangles, if they are wanted: what the scene says of them, and the index.
    fn triangles(
        &self,
        before: Option<(Forest, tins::Found)>,
        options: &Options,
        stats: &Stats,
    ) -> Result<Option<(TinLayer, PerDiamond<Entry>)>, BuildError> {
        let Some(((forest, found), tin)) = before.zip(options.tin) else { return Ok(None) };
        let tins = tins::Tins {
            forest,
            canvas: &self.canvas,
            work: self.work,
            options: tin,
            stats,
            max_error: options.max_error,
            cell: self.grid.cell,
            workers: tins::workers(options.memory),
            memory: options.memory,
            done: &self.done,
        };
        let found = tins.run(found)?;
        Ok(Some(tins.describe(found)))
    }

    /// Writes the index of the triangles, and says of the layer that it has them.
    fn index_triangles(
        &self,
        layer: &mut Layer,
        sums: &mut Sums,
        mut tin: TinLayer,
        entries: &PerDiamond<Entry>,
    ) -> Result<(), BuildError> {
        let index_bytes = self.pages(&tin.forest, entries, BlobKind::TinIndex)?;
        tin.bytes += index_bytes;
        sums.index_bytes += index_bytes;
        if layer.encodings.is_empty() {
            layer.finest_error = tin.finest_error;
        }
        layer.bytes += tin.bytes;
        layer.encodings.push("tin".to_owned());
        layer.tin = Some(tin);
        Ok(())
    }

    fn interrupted(&self) -> BuildError {
        BuildError::Interrupted { done: self.done.load(Ordering::Relaxed), chunks: self.work.chunks }
    }
}

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

mod coding;
mod error;
mod index;
mod levels;
mod plan;
mod surface;
mod transcribe;

use crate::canvas::Canvas;
use crate::ingest::{Grid, Source};
use crate::progress::Progress;
use crate::store::Writer;
use coding::fine_step;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::message::{Crs, Frame, Kind, Scene};
use diamantina_protocol::points::{Coding, Rule};
use levels::Tallies;
use plan::Plan;
use std::io;
use std::path::Path;
use std::sync::Mutex;
use transcribe::transcribe;

pub use error::BuildError;

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
    let plan = Plan::new(forest, options.memory)?;

    let (canvas, stats) = transcribe(source, &plan, options, writer.work_folder(), progress)?;
    let fine_step = fine_step(options.max_error, &stats)?;
    let coding = coding::coding(&plan, &canvas, options.rule, fine_step)?;
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

/// A build under way.
struct Build<'a> {
    plan: Plan,
    canvas: Canvas,
    coding: Coding,
    writer: &'a Writer,
    tallies: Mutex<Tallies>,
    grid: &'a Grid,
}

impl Build<'_> {
    fn work(&self) -> impl Fn(io::Error) -> BuildError {
        let path = self.canvas.folder().to_owned();
        move |error| BuildError::Work { path: path.clone(), error }
    }
}

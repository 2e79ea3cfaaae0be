//! Drives a build in bounded memory: source → canvas → diamonds → store.
//!
//! 1. **Transcribe.** Each layer's source is read once, in bands of rows, into the [`Canvas`]: whole numbers of
//!    quanta at every power-of-two spacing.
//! 2. **Coarse levels.** The levels above the chunks are coded from the canvas' coarsest plane, all in
//!    memory.
//! 3. **Chunks.** The squares of one depth of the quadtree are independent of one another, since they need
//!    only what the coarse levels left: each worker takes one, codes the diamonds that it owns, and
//!    compares its samples with the surface of every level. Diamonds that straddle a chunk's border are
//!    computed on both sides (from the same numbers, so with the same result) and written by their owner.
//! 4. **Index.** Errors and ranges are saturated from the finest level up, and pages written.
//!
//! All sources are read first, so that what is wrong with one is found before hours of work on another; then layer after
//! layer takes steps 2 to 4, then each texture is cut into tiles ([`crate::texture`]), and all are published as one version.
//!
//! What is done is noted in a `journal`; a build that was killed goes on from there.
//!
//! Everything written is a function of the source and the options, whatever the number of threads.

mod coding;
mod error;
mod estimate;
mod index;
mod journal;
mod layers;
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
use crate::texture::{self, TextureSource};
use coding::fine_step;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::index::Entry;
use diamantina_protocol::message::{Frame, Layer, Scene, TinLayer};
use diamantina_protocol::points::{Coding, Rule};
use diamantina_protocol::series::Series;
use diamantina_protocol::texture::Texture;
use index::Sums;
use layers::{Part, check_series, check_textures, parts};
use plan::Plan;
use std::collections::HashSet;
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};
use tallies::{PerDiamond, Tallies};
use transcribe::{Stats, transcribe};
use work::{Before, Work};

pub use error::BuildError;
pub use estimate::{Estimate, Estimates, estimate};
pub use layers::LayerSource;
pub use tins::{LAMBDA, PATCH_TRIANGLES, PATCH_TRIANGLES_RANGE, TinOptions};

/// What a build may be told.
#[derive(Debug, Clone)]
pub struct Options {
    /// The name of the scene.
    pub scene: String,
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
    /// Between two checkpoints: the most work that a kill costs. Tiles of textures are made anew.
    pub checkpoint: Duration,
    /// How well textures keep their images: 1 to 99; 100 is lossless.
    pub texture_quality: u8,
}

impl Options {
    /// Lossless layers of smooth rule and 64 segments, in 2 GiB: what the command line says by itself.
    #[must_use]
    pub fn new(scene: &str) -> Self {
        Self {
            scene: scene.to_owned(),
            max_error: 0.0,
            rule: Rule::Smooth,
            quantum: None,
            patch_log2: 6,
            points: true,
            tin: None,
            memory: 2 << 30,
            fresh: false,
            checkpoint: CHECKPOINT,
            texture_quality: texture::QUALITY,
        }
    }
}

/// Between two checkpoints, unless told otherwise. Syncing more often would cost more than a kill does.
pub const CHECKPOINT: Duration = Duration::from_secs(5);

/// What a build did: sums of all layers.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Report {
    /// The scene as published.
    pub scene: Scene,
    /// Samples of the sources.
    pub samples: u64,
    /// Diamonds with a payload.
    pub diamonds: u64,
    /// Bytes of payloads.
    pub point_bytes: u64,
    /// Bytes of index pages, of all encodings.
    pub index_bytes: u64,
    /// Bits of payload for each sample of the sources that has a height.
    pub bits_per_sample: f64,
    /// Seconds taken.
    pub seconds: f64,
    /// Millions of samples a second.
    pub msamples_per_second: f64,
    /// What there is of each layer, in the scene's order.
    pub layers: Vec<LayerReport>,
}

/// What a build did of a layer.
#[derive(Debug, Clone, serde::Serialize)]
pub struct LayerReport {
    /// The layer's name.
    pub name: String,
    /// Samples of its source.
    pub samples: u64,
    /// Diamonds with a payload.
    pub diamonds: u64,
    /// Bytes of payloads.
    pub point_bytes: u64,
    /// Bytes of index pages, of all encodings.
    pub index_bytes: u64,
    /// Bits of payload for each sample of the source that has a height.
    pub bits_per_sample: f64,
}

/// Builds a scene of one layer, named terrain, from a source: see [`build_layers`].
///
/// # Errors
/// As [`build_layers`].
pub fn build(
    source: &Source,
    out: &Path,
    options: &Options,
    progress: &Progress,
) -> Result<Report, BuildError> {
    build_layers(&[LayerSource::terrain(source)], out, options, progress)
}

/// Builds a scene from the sources of its layers, which lie in one frame, and publishes it at `out`.
///
/// What an earlier run of the same build left in the work folder is gone on with; the bytes are those of an
/// unbroken build. `progress` says when to stop.
///
/// # Errors
/// When a source or the disk fails, the options do not fit a source, or `progress` was told to stop. The
/// store at `out`, if there was one, is then untouched. Where the sources and the options are not to blame, the
/// work folder stays, for the same build to go on with.
pub fn build_layers(
    layers: &[LayerSource<'_>],
    out: &Path,
    options: &Options,
    progress: &Progress,
) -> Result<Report, BuildError> {
    build_scene(Content { layers, ..Content::default() }, out, options, progress)
}

/// What a scene is made of.
#[derive(Debug, Clone, Copy, Default)]
pub struct Content<'a> {
    /// Its surfaces.
    pub layers: &'a [LayerSource<'a>],
    /// Its imagery, which lies in the same frame.
    pub textures: &'a [TextureSource<'a>],
    /// Which of the layers are the steps of a surface that changes with time.
    pub series: &'a [Series],
}

/// As [`build_layers`], with textures, and with layers that are the steps of series.
///
/// # Errors
/// As [`build_layers`].
pub fn build_scene(
    content: Content<'_>,
    out: &Path,
    options: &Options,
    progress: &Progress,
) -> Result<Report, BuildError> {
    let started = Instant::now();
    // Wrong use is refused before an earlier run's work is touched.
    let Content { layers, series, .. } = content;
    let parts = parts(layers, options)?;
    check_series(layers, series)?;
    check_textures(&content, options)?;
    let writer = Writer::create(out)?;
    let built = run(&parts, &content, &writer, options, progress);
    progress.finish();
    match built {
        Ok((scene, sums)) => Ok(report(scene, &sums, started)),
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

/// Reads, codes, indexes and publishes; the scene, and what coding gave of each layer.
fn run(
    parts: &[Part<'_>],
    content: &Content<'_>,
    writer: &Writer,
    options: &Options,
    progress: &Progress,
) -> Result<(Scene, Vec<Sums>), BuildError> {
    let (work, begun) = work::open(writer, parts, options, progress)?;
    let mut read = Vec::with_capacity(parts.len());
    for (part, before) in parts.iter().zip(begun) {
        progress.of(part.label());
        let found = || -> Result<(Stats, u32), BuildError> {
            // One at a time: a series has more files than a program may have open.
            let canvas = work.canvas(part)?;
            let stats = transcribe(part, &canvas, &before.bands, &work)?;
            // What is noted of this canvas must not wait for a checkpoint of another.
            if parts.len() > 1 {
                work.checkpoint(&canvas)?;
            }
            let fine_step = fine_step(options.max_error, &stats)?;
            Ok((stats, fine_step))
        };
        let (stats, fine_step) = found().map_err(|error| part.failed(error))?;
        read.push((before, stats, fine_step));
    }
    let (mut layers, mut sums) = (Vec::with_capacity(parts.len()), Vec::with_capacity(parts.len()));
    for (part, (before, stats, fine_step)) in parts.iter().zip(read) {
        progress.of(part.label());
        let built = build_layer(part, work.canvas(part)?, before, &stats, fine_step, &work);
        let (layer, sum) = built.map_err(|error| part.failed(error))?;
        layers.push(layer);
        sums.push(sum);
    }
    let textures = build_textures(content.textures, writer, options, &work)?;
    progress.of(None);
    let bytes =
        layers.iter().map(|layer| layer.bytes).chain(textures.iter().map(|texture| texture.bytes)).sum();
    progress.stage("publish", "bytes", bytes, 0);
    let scene = Scene {
        name: options.scene.clone(),
        version: String::new(),
        frame: frame(parts[0].layer.source),
        layers,
        zones: Vec::new(),
        textures,
        series: content.series.to_vec(),
    };
    let go_on = |bytes| {
        progress.advance(bytes);
        !progress.is_stopping()
    };
    let scene = writer.publish(scene, go_on)?.ok_or_else(|| work.interrupted())?;
    Ok((scene, sums))
}

/// Cuts imagery into tiles.
fn build_textures(
    sources: &[TextureSource<'_>],
    writer: &Writer,
    options: &Options,
    work: &Work<'_>,
) -> Result<Vec<Texture>, BuildError> {
    let mut built = Vec::with_capacity(sources.len());
    for (number, source) in (0u8..).zip(sources) {
        work.progress.of(Some(source.name));
        let failed = |error| BuildError::Texture { texture: source.name.to_owned(), error: Box::new(error) };
        let texture = texture::build(*source, number, options.texture_quality, writer, work.progress)
            .map_err(failed)?;
        built.push(texture.ok_or_else(|| work.interrupted())?);
    }
    Ok(built)
}

/// Codes and indexes a layer that has been read.
fn build_layer(
    part: &Part<'_>,
    canvas: Canvas,
    before: Before,
    stats: &Stats,
    fine_step: u32,
    work: &Work<'_>,
) -> Result<(Layer, Sums), BuildError> {
    let options = &part.options;
    let (plan, coding) = if options.points {
        coding::coding(&part.plan, &canvas, options.rule, fine_step)?
    } else {
        coding::without_points(&part.plan, options.rule, fine_step)?
    };
    let build = Build {
        number: part.number,
        plan,
        canvas,
        coding,
        work,
        tallies: Mutex::new(before.tallies),
        before: before.chunks,
        grid: part.layer.source.grid(),
    };
    if options.points {
        let coarse = build.coarse_levels()?;
        build.chunks(&coarse)?;
    }
    let tallies = build.tallies.lock().unwrap_or_else(PoisonError::into_inner).take();
    let triangles = build.triangles(before.tins, options, stats)?;
    let (mut layer, mut sums) = build.index(tallies, &part.layer, options, stats)?;
    if let Some((tin, entries)) = triangles {
        build.index_triangles(&mut layer, &mut sums, tin, &entries)?;
    }
    Ok((layer, sums))
}

/// The frame that a source lies in.
fn frame(source: &Source) -> Frame {
    Frame { crs: source.frame_crs(), vertical_unit: "metre".to_owned() }
}

fn report(scene: Scene, sums: &[Sums], started: Instant) -> Report {
    let seconds = started.elapsed().as_secs_f64();
    let bits = |bytes: u64, valid: u64| bytes as f64 * 8.0 / valid as f64;
    let of_layer = |(layer, sums): (&Layer, &Sums)| LayerReport {
        name: layer.name.clone(),
        samples: layer.samples.map(u64::from).iter().product(),
        diamonds: sums.diamonds,
        point_bytes: sums.point_bytes,
        index_bytes: sums.index_bytes,
        bits_per_sample: bits(sums.point_bytes, layer.valid_samples),
    };
    let layers: Vec<LayerReport> = scene.layers.iter().zip(sums).map(of_layer).collect();
    let sum = |of: fn(&LayerReport) -> u64| layers.iter().map(of).sum::<u64>();
    let (samples, point_bytes) = (sum(|l| l.samples), sum(|l| l.point_bytes));
    let valid = scene.layers.iter().map(|layer| layer.valid_samples).sum();
    Report {
        samples,
        diamonds: sum(|l| l.diamonds),
        point_bytes,
        index_bytes: sum(|l| l.index_bytes),
        bits_per_sample: bits(point_bytes, valid),
        seconds,
        msamples_per_second: samples as f64 / seconds / 1e6,
        layers,
        scene,
    }
}

/// A layer's build under way.
struct Build<'a> {
    /// Position of the layer in the scene.
    number: u8,
    plan: Plan,
    canvas: Canvas,
    coding: Coding,
    work: &'a Work<'a>,
    tallies: Mutex<Tallies>,
    /// Chunks that earlier runs have done.
    before: HashSet<u32>,
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
            number: self.number,
            forest,
            canvas: &self.canvas,
            work: self.work,
            options: tin,
            stats,
            max_error: options.max_error,
            cell: self.grid.cell,
            workers: tins::workers(options.memory),
            memory: options.memory,
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
        self.work.interrupted()
    }
}

//! The work folder of a build: begun anew, or gone on with where an earlier run ended.

use super::journal::{Band, Chunk, Fingerprint, Journal, Record};
use super::levels::blob_order;
use super::plan::Plan;
use super::tallies::Tallies;
use super::{BuildError, Options, journal, tins};
use crate::canvas::Canvas;
use crate::ingest::{Grid, Source};
use crate::progress::Progress;
use crate::store::{self, Key, Kind as BlobKind, Writer};
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::{index, points};
use std::collections::HashSet;
use std::io;

/// What a build under way keeps its work with.
#[derive(Debug)]
pub(super) struct Work<'a> {
    pub(super) writer: &'a Writer,
    pub(super) journal: Journal,
    pub(super) progress: &'a Progress,
    /// How many chunks there are.
    pub(super) chunks: u64,
}

/// What earlier runs of a build have done.
#[derive(Debug)]
pub(super) struct Before {
    pub(super) bands: Vec<Band>,
    pub(super) chunks: HashSet<u32>,
    pub(super) tallies: Tallies,
    /// Of triangles, if they are wanted.
    pub(super) tins: Option<(Forest, tins::Found)>,
}

impl Work<'_> {
    /// Puts on the disk what is done.
    pub(super) fn checkpoint(&self, canvas: &Canvas) -> Result<(), BuildError> {
        self.checkpoint_with(canvas, || Ok(()))
    }

    /// Likewise, and another file of the work folder.
    pub(super) fn checkpoint_with(
        &self,
        canvas: &Canvas,
        other: impl Fn() -> io::Result<()>,
    ) -> Result<(), BuildError> {
        let sync = || {
            canvas.sync().map_err(self.failure())?;
            other().map_err(self.failure())?;
            Ok(self.writer.sync()?)
        };
        self.journal.checkpoint(sync, self.failure())
    }

    /// Says that the work folder is to blame.
    pub(super) fn failure(&self) -> impl Fn(io::Error) -> BuildError {
        failure(self.writer)
    }
}

pub(super) fn failure(writer: &Writer) -> impl Fn(io::Error) -> BuildError {
    let path = writer.work_folder().to_owned();
    move |error| BuildError::Work { path: path.clone(), error }
}

/// A hash of what the result of a build, and the form of its work files, depend on. Memory counts only by
/// the chunks that it allows; threads do not count.
pub(super) fn fingerprint(source: &Source, options: &Options, plan: &Plan) -> Fingerprint {
    let Options {
        scene,
        layer,
        kind,
        max_error,
        rule,
        quantum,
        patch_log2,
        points,
        tin,
        memory: _,
        fresh: _,
        checkpoint: _,
    } = options;
    let program = (
        env!("CARGO_PKG_VERSION"),
        store::FORMAT,
        points::FORMAT,
        diamantina_protocol::tin::FORMAT,
        index::FORMAT,
    );
    let built = (scene, layer, kind, max_error.to_bits(), rule, quantum.map(f64::to_bits), patch_log2);
    let built = (built, points, tin);
    let text = format!("{program:?} {} {built:?} {}", source.identity(), plan.chunks.side_log2());
    *blake3::hash(text.as_bytes()).as_bytes()
}

/// Goes on with what an earlier run left, if it is of the same build, or begins anew; says which.
pub(super) fn open<'a>(
    writer: &'a Writer,
    plan: &Plan,
    grid: &Grid,
    fingerprint: &Fingerprint,
    options: &Options,
    progress: &'a Progress,
) -> Result<(Work<'a>, Canvas, Before), BuildError> {
    let tin_forest = options.tin.map(|tin| tins::forest_of(&plan.forest, &tin)).transpose()?;
    let tiles = tin_forest.map_or(0, |forest| tins::tiles_of_all(&forest));
    let chunks = tiles + if options.points { plan.chunks.corners().len() as u64 } else { 0 };
    let folder = writer.work_folder();
    let left = Journal::exists(folder);
    if left && !options.fresh {
        let resumed = resume(writer, plan, tin_forest, grid, fingerprint, options)?;
        if let Some((journal, canvas, before)) = resumed {
            progress.say(&before.words(grid, chunks));
            return Ok((Work { writer, journal, progress, chunks }, canvas, before));
        }
    }
    if left {
        let why = if options.fresh {
            "--fresh was given"
        } else {
            "the source, the options or the program are not those of the build that was interrupted"
        };
        progress.say(&format!("starting anew: {why}"));
    }
    writer.clear()?;
    let failed = failure(writer);
    let canvas = Canvas::create(folder, grid.width, grid.height, plan.coarsest()).map_err(&failed)?;
    let journal = Journal::create(folder, fingerprint, options.checkpoint).map_err(&failed)?;
    Ok((Work { writer, journal, progress, chunks }, canvas, Before::nothing(plan, tin_forest)))
}

/// What an earlier run of the same build left; `None` if there is none that can be gone on with.
fn resume(
    writer: &Writer,
    plan: &Plan,
    tin_forest: Option<Forest>,
    grid: &Grid,
    fingerprint: &Fingerprint,
    options: &Options,
) -> Result<Option<(Journal, Canvas, Before)>, BuildError> {
    let folder = writer.work_folder();
    let failed = failure(writer);
    let canvas = Canvas::reopen(folder, grid.width, grid.height, plan.coarsest()).map_err(&failed)?;
    let Some(canvas) = canvas else { return Ok(None) };
    let mut before = Before::nothing(plan, tin_forest);
    let take = |record| match record {
        Record::Band(band) => Ok(before.take_band(band, grid)),
        Record::Chunk(chunk) => before.take_chunk(&chunk, plan, writer),
        Record::Tile(tile) => before.take_tile(&tile, writer),
    };
    let journal = Journal::reopen(folder, fingerprint, options.checkpoint, take, &failed)?;
    let Some(journal) = journal else { return Ok(None) };
    writer.settle()?;
    Ok(Some((journal, canvas, before)))
}

impl Before {
    fn nothing(plan: &Plan, tin_forest: Option<Forest>) -> Self {
        let tins = tin_forest.map(|forest| (forest, tins::Found::new(forest)));
        Self { bands: Vec::new(), chunks: HashSet::new(), tallies: Tallies::new(plan.forest), tins }
    }

    /// Chunks and tiles that are done.
    pub(super) fn done(&self) -> u64 {
        self.chunks.len() as u64 + self.tins.as_ref().map_or(0, |(_, found)| found.tiles())
    }

    /// Takes over a band; false if it is not of this source.
    fn take_band(&mut self, band: Band, grid: &Grid) -> bool {
        let fits = band.y0.checked_add(band.rows).is_some_and(|end| end <= grid.height);
        if fits {
            self.bands.push(band);
        }
        fits
    }

    /// Takes over a chunk and its blobs; false if they are not there, or it is none of this plan.
    fn take_chunk(&mut self, chunk: &Chunk, plan: &Plan, writer: &Writer) -> Result<bool, BuildError> {
        let mut blobs = Vec::with_capacity(chunk.coded.len());
        for journal::Coded { centre, spot, .. } in &chunk.coded {
            let Some(d) = plan.forest.diamond(*centre) else { return Ok(false) };
            let [a, b] = *centre;
            let key = Key { layer: 0, kind: BlobKind::Points, a, b };
            blobs.extend(spot.map(|spot| (key, blob_order(d), spot)));
        }
        if self.chunks.contains(&chunk.number) || !writer.adopt(&blobs)? {
            return Ok(false);
        }
        self.chunks.insert(chunk.number);
        Ok(self.tallies.add(&plan.forest, chunk))
    }

    /// Takes over a tile of triangles and its blobs; false if they are not there, or it is none of this build.
    fn take_tile(&mut self, tile: &journal::Tile, writer: &Writer) -> Result<bool, BuildError> {
        let Some((forest, found)) = &mut self.tins else { return Ok(false) };
        let mut blobs = Vec::with_capacity(tile.done.len());
        for journal::Triangulated { centre, spot, .. } in &tile.done {
            let Some(d) = forest.diamond(*centre) else { return Ok(false) };
            let [a, b] = *centre;
            let key = Key { layer: 0, kind: BlobKind::Tin, a, b };
            blobs.extend(spot.map(|spot| (key, tins::BEHIND | blob_order(d), spot)));
        }
        Ok(writer.adopt(&blobs)? && found.add(forest, tile))
    }

    /// How far the earlier runs came.
    fn words(&self, grid: &Grid, chunks: u64) -> String {
        let rows: u64 = self.bands.iter().map(|band| u64::from(band.rows)).sum();
        if rows < u64::from(grid.height) {
            return format!("resuming: {rows} of {} rows are read", grid.height);
        }
        format!("resuming: {} of {chunks} chunks are done", self.done())
    }
}

//! The work folder of a build: begun anew, or gone on with where an earlier run ended.

use super::journal::{Band, Chunk, Fingerprint, Journal, Record};
use super::layers::Part;
use super::levels::blob_order;
use super::tallies::Tallies;
use super::{BuildError, Options, journal, tins};
use crate::canvas::Canvas;
use crate::ingest::Grid;
use crate::progress::Progress;
use crate::store::{self, Key, Kind as BlobKind, Writer};
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::{index, points};
use std::collections::HashSet;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// What a build under way keeps its work with.
#[derive(Debug)]
pub(super) struct Work<'a> {
    pub(super) writer: &'a Writer,
    pub(super) journal: Journal,
    pub(super) progress: &'a Progress,
    /// How many chunks and tiles there are, of all layers, ...
    pub(super) chunks: u64,
    /// ... and how many of them are done.
    pub(super) done: AtomicU64,
}

/// What earlier runs of a build have done of a layer.
#[derive(Debug)]
pub(super) struct Before {
    pub(super) bands: Vec<Band>,
    pub(super) chunks: HashSet<u32>,
    pub(super) tallies: Tallies,
    /// Of triangles, if they are wanted.
    pub(super) tins: Option<(Forest, tins::Found)>,
}

impl Work<'_> {
    /// The canvas of a layer.
    pub(super) fn canvas(&self, part: &Part<'_>) -> Result<Canvas, BuildError> {
        let gone = || io::Error::new(io::ErrorKind::NotFound, "planes of a layer are gone");
        let canvas = reopen(self.writer.work_folder(), part).and_then(|canvas| canvas.ok_or_else(gone));
        canvas.map_err(self.failure())
    }

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

    /// Notes that a chunk or a tile is done; true if a checkpoint is due.
    pub(super) fn note(&self, layer: u8, record: &Record) -> bool {
        self.done.fetch_add(1, Ordering::Relaxed);
        self.journal.note(layer, record)
    }

    pub(super) fn interrupted(&self) -> BuildError {
        BuildError::Interrupted { done: self.done.load(Ordering::Relaxed), chunks: self.chunks }
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
fn fingerprint(parts: &[Part<'_>], options: &Options) -> Fingerprint {
    let Options {
        scene,
        max_error,
        rule,
        quantum,
        patch_log2,
        points,
        tin,
        memory: _,
        fresh: _,
        checkpoint: _,
        // Tiles are made anew.
        texture_quality: _,
    } = options;
    let program = (
        env!("CARGO_PKG_VERSION"),
        store::FORMAT,
        points::FORMAT,
        diamantina_protocol::tin::FORMAT,
        index::FORMAT,
    );
    let built = (scene, max_error.to_bits(), rule, quantum.map(f64::to_bits), patch_log2, points, tin);
    let mut text = format!("{program:?} {built:?}");
    for part in parts {
        let (layer, side_log2) = (&part.layer, part.plan.chunks.side_log2());
        text += &format!(" {:?} {:?} {} {side_log2}", layer.name, layer.kind, layer.source.identity());
    }
    *blake3::hash(text.as_bytes()).as_bytes()
}

/// The folder of a layer's planes and halves.
fn folder_of(work: &Path, part: &Part<'_>) -> PathBuf {
    work.join(format!("layer-{}", part.number))
}

/// Goes on with what an earlier run left, if it is of the same build, or begins anew; says which.
pub(super) fn open<'a>(
    writer: &'a Writer,
    parts: &[Part<'_>],
    options: &Options,
    progress: &'a Progress,
) -> Result<(Work<'a>, Vec<Before>), BuildError> {
    let mut nothing = Vec::with_capacity(parts.len());
    let mut chunks = 0;
    for part in parts {
        let tin_forest = options.tin.map(|tin| tins::forest_of(&part.plan.forest, &tin)).transpose()?;
        chunks += tin_forest.map_or(0, |forest| tins::tiles_of_all(&forest));
        chunks += if options.points { part.plan.chunks.corners().len() as u64 } else { 0 };
        nothing.push(Before::nothing(part, tin_forest));
    }
    let work = |journal, done| Work { writer, journal, progress, chunks, done: AtomicU64::new(done) };
    let fingerprint = fingerprint(parts, options);
    let folder = writer.work_folder();
    let left = Journal::exists(folder);
    if left && !options.fresh {
        let mut before = nothing;
        if let Some(journal) = resume(writer, parts, &mut before, &fingerprint, options)? {
            progress.say(&words(parts, &before, chunks));
            let done = before.iter().map(Before::done).sum();
            return Ok((work(journal, done), before));
        }
        // Nothing was taken from a journal of another build.
        nothing = before;
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
    for part in parts {
        let (folder, Grid { width, height, .. }) = (folder_of(folder, part), part.layer.source.grid());
        let made = std::fs::create_dir_all(&folder)
            .and_then(|()| Canvas::create(&folder, *width, *height, part.plan.coarsest()));
        made.map_err(&failed)?;
    }
    let journal = Journal::create(folder, &fingerprint, options.checkpoint).map_err(&failed)?;
    Ok((work(journal, 0), nothing))
}

/// The canvas of a layer that was begun; `None` if it is not there as it should be.
fn reopen(work: &Path, part: &Part<'_>) -> io::Result<Option<Canvas>> {
    let Grid { width, height, .. } = part.layer.source.grid();
    Canvas::reopen(&folder_of(work, part), *width, *height, part.plan.coarsest())
}

/// Adds to `before` what an earlier run of the same build left; `None`, with nothing added, if there is none that can be
/// gone on with.
fn resume(
    writer: &Writer,
    parts: &[Part<'_>],
    before: &mut [Before],
    fingerprint: &Fingerprint,
    options: &Options,
) -> Result<Option<Journal>, BuildError> {
    let folder = writer.work_folder();
    let failed = failure(writer);
    for part in parts {
        if reopen(folder, part).map_err(&failed)?.is_none() {
            return Ok(None);
        }
    }
    let take = |layer: u8, record| {
        let number = usize::from(layer);
        let (Some(before), Some(part)) = (before.get_mut(number), parts.get(number)) else {
            return Ok(false);
        };
        match record {
            Record::Band(band) => Ok(before.take_band(band, part.layer.source.grid())),
            Record::Chunk(chunk) => before.take_chunk(&chunk, part, writer),
            Record::Tile(tile) => before.take_tile(&tile, part, writer),
        }
    };
    let journal = Journal::reopen(folder, fingerprint, options.checkpoint, take, &failed)?;
    let Some(journal) = journal else { return Ok(None) };
    writer.settle()?;
    Ok(Some(journal))
}

/// How far the earlier runs came.
fn words(parts: &[Part<'_>], before: &[Before], chunks: u64) -> String {
    let all: u64 = parts.iter().map(|part| u64::from(part.layer.source.grid().height)).sum();
    let rows: u64 = before.iter().flat_map(|before| &before.bands).map(|band| u64::from(band.rows)).sum();
    if rows < all {
        return format!("resuming: {rows} of {all} rows are read");
    }
    format!("resuming: {} of {chunks} chunks are done", before.iter().map(Before::done).sum::<u64>())
}

impl Before {
    fn nothing(part: &Part<'_>, tin_forest: Option<Forest>) -> Self {
        let tins = tin_forest.map(|forest| (forest, tins::Found::new(forest)));
        Self { bands: Vec::new(), chunks: HashSet::new(), tallies: Tallies::new(part.plan.forest), tins }
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
    fn take_chunk(&mut self, chunk: &Chunk, part: &Part<'_>, writer: &Writer) -> Result<bool, BuildError> {
        let plan = &part.plan;
        let mut blobs = Vec::with_capacity(chunk.coded.len());
        for journal::Coded { centre, spot, .. } in &chunk.coded {
            let Some(d) = plan.forest.diamond(*centre) else { return Ok(false) };
            let [a, b] = *centre;
            let key = Key { layer: part.number, kind: BlobKind::Points, a, b };
            blobs.extend(spot.map(|spot| (key, blob_order(d), spot)));
        }
        if self.chunks.contains(&chunk.number) || !writer.adopt(&blobs)? {
            return Ok(false);
        }
        self.chunks.insert(chunk.number);
        Ok(self.tallies.add(&plan.forest, chunk))
    }

    /// Takes over a tile of triangles and its blobs; false if they are not there, or it is none of this build.
    fn take_tile(
        &mut self,
        tile: &journal::Tile,
        part: &Part<'_>,
        writer: &Writer,
    ) -> Result<bool, BuildError> {
        let Some((forest, found)) = &mut self.tins else { return Ok(false) };
        let mut blobs = Vec::with_capacity(tile.done.len());
        for journal::Triangulated { centre, spot, .. } in &tile.done {
            let Some(d) = forest.diamond(*centre) else { return Ok(false) };
            let [a, b] = *centre;
            let key = Key { layer: part.number, kind: BlobKind::Tin, a, b };
            blobs.extend(spot.map(|spot| (key, tins::BEHIND | blob_order(d), spot)));
        }
        Ok(writer.adopt(&blobs)? && found.add(forest, tile))
    }
}

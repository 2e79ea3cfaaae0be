//! The index: errors and ranges saturated from the finest level up, pages, and the layer's description.

#![allow(clippy::cast_possible_truncation, reason = "metres are rounded to f32 on purpose")]

use super::tallies::{PerDiamond, Tallies, Tally};
use super::tins::BEHIND;
use super::transcribe::Stats;
use super::{Build, BuildError, LayerSource, Options};
use crate::store::{Key, Kind as BlobKind, compress};
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::message::Layer;
use rayon::prelude::*;

/// What coding gave, in numbers.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sums {
    /// Diamonds with a payload.
    pub(super) diamonds: u64,
    /// Bytes of payloads.
    pub(super) point_bytes: u64,
    /// Bytes of pages, of all encodings.
    pub(super) index_bytes: u64,
}

impl Build<'_> {
    /// Saturates errors and ranges, writes the index, and describes the layer.
    pub(super) fn index(
        &self,
        tallies: Tallies,
        of: &LayerSource<'_>,
        options: &Options,
        stats: &Stats,
    ) -> Result<(Layer, Sums), BuildError> {
        let forest = &self.plan.forest;
        let cell = self.grid.cell;
        // Room for the rounding of metres, where they are not whole.
        let slack = if stats.quantum.fract() == 0.0 && stats.rounding == 0.0 { 1.0 } else { 1.0 + 1e-9 };
        let finest = up((tallies.finest * stats.quantum + stats.rounding) * slack);
        let written = tallies.of.values().filter(|t| t.bytes > 0);
        let (diamonds, point_bytes) =
            written.fold((0, 0), |(n, sum): (u64, u64), t| (n + 1, sum + u64::from(t.bytes)));
        let entry = |level: u32, tally: Tally| {
            let own = tally.vertical * stats.quantum + stats.rounding;
            let apart = if tally.outline { forest.hypotenuse(level, cell) } else { 0.0 };
            let compared = tally.vertical > 0.0 || tally.outline;
            let error_metres = if compared { up((own + apart) * slack) } else { 0.0 };
            let entry = Entry { bytes: tally.bytes, error_metres, ..Entry::EMPTY };
            if tally.low <= tally.high { Entry { low: tally.low, high: tally.high, ..entry } } else { entry }
        };
        let index_bytes = if options.points {
            self.pages(forest, &saturated(forest, tallies.of, finest, entry), BlobKind::Index)?
        } else {
            0
        };
        let offset = self.grid.height_offset;
        let layer = Layer {
            name: of.name.to_owned(),
            kind: of.kind,
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
            encodings: if options.points { vec!["points".to_owned()] } else { Vec::new() },
            coding: self.coding.rested(),
            bytes: point_bytes + index_bytes,
            resampled: self.grid.resampled,
            errors: "exact".to_owned(),
            tin: None,
        };
        Ok((layer, Sums { diamonds, point_bytes, index_bytes }))
    }

    /// Writes the pages of an index; their bytes.
    pub(super) fn pages(
        &self,
        forest: &Forest,
        entries: &PerDiamond<Entry>,
        kind: BlobKind,
    ) -> Result<u64, BuildError> {
        let pages = index::pages(forest);
        let progress = self.work.progress;
        progress.stage("index", "pages", pages.into(), 0);
        let behind = if kind == BlobKind::TinIndex { BEHIND } else { 0 };
        let page = |page: u32| {
            if progress.is_stopping() {
                return Err(self.interrupted());
            }
            let diamonds = index::page_diamonds(forest, page).unwrap_or_default();
            let list: Vec<Entry> = diamonds.iter().map(|d| entries.get(*d)).collect();
            let blob = compress(&index::encode(&list)).map_err(self.work.failure())?;
            let key = Key { layer: self.number, kind, a: page, b: 0 };
            self.work.writer.put(key, behind | u64::from(page), &blob)?;
            progress.advance(1);
            Ok(blob.len() as u64)
        };
        (0..pages).into_par_iter().map(page).sum()
    }
}

/// What the index says of each diamond, given what is known of it alone: parents declare at least what their children
/// do.
pub(super) fn saturated<T: Copy>(
    forest: &Forest,
    mut known: PerDiamond<T>,
    finest: f32,
    own: impl Fn(u32, T) -> Entry,
) -> PerDiamond<Entry> {
    let mut entries = PerDiamond::new(*forest, Entry::EMPTY);
    for level in (0..forest.levels()).rev() {
        for d in forest.diamonds(level) {
            let mut entry = own(level, known.get(d));
            for child in forest.children(d).into_iter().flatten().map(|c| entries.get(c)) {
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
            *entries.at(d) = entry;
        }
        known.forget(level);
    }
    entries
}

/// The least `f32` at or above a value.
pub(super) fn up(value: f64) -> f32 {
    let near = value as f32;
    if f64::from(near) < value { near.next_up() } else { near }
}

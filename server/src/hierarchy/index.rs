//! The index: errors and ranges saturated from the finest level up, pages, and the layer's description.

#![allow(clippy::cast_possible_truncation, reason = "metres are rounded to f32 on purpose")]

use super::transcribe::Stats;
use super::{Build, BuildError, Options};
use crate::store::{Key, Kind as BlobKind};
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::message::Layer;
use std::collections::HashMap;

impl Build<'_> {
    /// Saturates errors and ranges, writes the index, and describes the layer.
    pub(super) fn index(&self, options: &Options, stats: &Stats) -> Result<Layer, BuildError> {
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

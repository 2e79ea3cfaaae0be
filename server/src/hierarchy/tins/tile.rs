//! The diamonds of one tile of a level.

#![allow(clippy::cast_possible_truncation, reason = "counts of triangles are limited by the format")]

use super::halves::{Halves, Place};
use super::{Tins, WINDOW_SAMPLES};
use crate::canvas::Window;
use crate::hierarchy::BuildError;
use crate::hierarchy::journal::{Tile, Triangulated};
use crate::hierarchy::levels::blob_order;
use crate::store::{Key, Kind as BlobKind};
use crate::tin::{Ground, Merged, Simplified, Tin, Until, half_of, lattice, merge, simplify, source};
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::PAYLOAD_BYTES_MAX;
use diamantina_protocol::tin::Lattices;
use rayon::prelude::*;
use std::collections::HashMap;

/// Levels below the finest payloads at which simplification begins, if anything may be lost there: so that all sides of
/// the finest triangles are simplified, too.
const BELOW: u8 = 2;

/// Blobs of triangles lie behind those of points.
pub(in crate::hierarchy) const BEHIND: u64 = 1 << 63;

/// Where a tile's input lies.
pub(super) type Input<'a> = (&'a Halves, &'a (dyn Fn(Diamond) -> Place + Sync));

/// What has been made of diamonds below the finest payloads.
#[derive(Default)]
struct Finest {
    /// Their halves, and how far these are from the source.
    halves: HashMap<Diamond, (Simplified, f64)>,
    /// Whether the source's own mesh is left as it is.
    keep: HashMap<Diamond, bool>,
    /// What has been made of these.
    lattices: Lattices,
}

/// The rectangle around some boxes.
fn around(boxes: impl Iterator<Item = [[u32; 2]; 2]>) -> Option<[[u32; 2]; 2]> {
    boxes.reduce(|[a, b], [c, d]| [[a[0].min(c[0]), a[1].min(c[1])], [b[0].max(d[0]), b[1].max(d[1])]])
}

fn samples([low, high]: [[u32; 2]; 2]) -> u64 {
    u64::from(high[0] - low[0] + 1) * u64::from(high[1] - low[1] + 1)
}

fn ground(window: &Window) -> Ground<'_> {
    Ground { origin: window.origin(), width: window.width(), heights: window.heights() }
}

/// The largest distance between the samples and the triangles of a diamond's halves, in quanta.
fn distance(halves: &[Tin; 2], ground: Ground<'_>) -> f64 {
    let of_half = |half: &Tin| {
        let corners = half.triangles.iter().map(|t| t.map(|v| half.vertices[v as usize]));
        corners.map(|t| ground.distance(t, f64::INFINITY)).fold(0.0, f64::max)
    };
    halves.iter().map(of_half).fold(0.0, f64::max)
}

impl Tins<'_> {
    /// Makes the payloads of a tile's diamonds, and what they leave for the level above.
    pub(super) fn tile(
        &self,
        level: u32,
        number: u32,
        diamonds: &[Diamond],
        input: Option<Input<'_>>,
        output: &Halves,
    ) -> Result<Tile, BuildError> {
        let forest = &self.forest;
        let failed = self.work.failure();
        let mut tile = Tile { level, number, finest: [0.0; 2], done: Vec::with_capacity(diamonds.len()) };
        let deep = forest.with_precision(BELOW).map_err(BuildError::TinForest)?;
        let boxes = diamonds.iter().map(|d| forest.bounds(*d));
        // What is made of the finest levels reaches beyond the tile's own diamonds.
        let children = diamonds.iter().filter(|_| input.is_none()).flat_map(|d| deep.children(*d)).flatten();
        let around_child = |c: Diamond| std::iter::once(c).chain(deep.children(c).into_iter().flatten());
        let beyond = children.flat_map(around_child).map(|c| deep.bounds(c));
        let Some(bounds) = around(boxes.chain(beyond)) else { return Ok(tile) };
        let wants_all = self.options.patch_error.is_some() || input.is_none();
        let window = if level > 0 && (wants_all || samples(bounds) <= WINDOW_SAMPLES) {
            Some(self.canvas.read(0, bounds[0], bounds[1]).map_err(&failed)?)
        } else {
            None
        };
        let mut finest = Finest::default();
        for d in diamonds {
            if self.work.progress.is_out_of_patience() {
                return Err(self.work.interrupted());
            }
            let mut merged = match (input, &window) {
                (Some((halves, place)), _) => {
                    let quarter = |child: Option<Diamond>| match child {
                        Some(c) => halves.get(place(c), half_of(forest, c, *d)),
                        None => Ok(Tin::default()),
                    };
                    let [a, b, c, e] = forest.children(*d).map(quarter);
                    let tins =
                        [a.map_err(&failed)?, b.map_err(&failed)?, c.map_err(&failed)?, e.map_err(&failed)?];
                    merge(forest, *d, tins.each_ref())
                }
                (None, Some(window)) => self.of_finest(&deep, *d, ground(window), &mut finest),
                (None, None) => Merged::default(),
            };
            tile.done.push(self.diamond(*d, &mut merged, window.as_ref(), output)?);
        }
        for (simplified, vertical) in finest.halves.values() {
            tile.finest = [tile.finest[0].max(*vertical), tile.finest[1].max(simplified.apart)];
        }
        Ok(tile)
    }

    /// Makes a diamond's payload and its halves.
    fn diamond(
        &self,
        d: Diamond,
        merged: &mut Merged,
        window: Option<&Window>,
        output: &Halves,
    ) -> Result<Triangulated, BuildError> {
        let forest = &self.forest;
        let failed = self.work.failure();
        let centre = d.centre();
        let heights = merged.patch.vertices.iter().map(|v| v.height);
        let (low, high) = heights.fold((i32::MAX, i32::MIN), |(low, high), h| (low.min(h), high.max(h)));
        let triangles = merged.patch.triangles.len() as u32;
        let mut one = Triangulated { centre, low, high, triangles, ..Triangulated::default() };
        if triangles == 0 {
            return Ok(one);
        }
        let payload = merged.encode(forest, d).map_err(|error| BuildError::Patch { centre, error })?;
        if payload.len() as u64 > u64::from(PAYLOAD_BYTES_MAX) {
            return Err(BuildError::Payload { centre, bytes: payload.len() });
        }
        let [a, b] = centre;
        let key = Key { layer: self.number, kind: BlobKind::Tin, a, b };
        one.spot = Some(self.work.writer.put(key, BEHIND | blob_order(d), &payload)?);
        if d.level() == 0 {
            return Ok(one);
        }
        let until = self.until(d.level(), window);
        let simplified = simplify(forest, d, merged, &self.rules(), until);
        one.apart = simplified.apart;
        one.vertical = match (simplified.vertical, window) {
            (Some(vertical), _) => vertical,
            (None, Some(window)) => distance(&simplified.halves, ground(window)),
            (None, None) => self.distance_in_bands(d, &simplified.halves)?,
        };
        one.halves = output.put(&simplified.halves).map_err(&failed)?;
        Ok(one)
    }

    /// Where the simplification of a diamond stops.
    fn until<'b>(&self, level: u32, window: Option<&'b Window>) -> Until<'b> {
        let triangles = self.options.patch_triangles as usize;
        let Some(ground) = window.map(ground) else { return Until::Triangles(triangles) };
        if let Some(error) = self.options.patch_error {
            let above = f64::from(self.forest.levels() - 1 - level);
            return self.limit(error * (above / 2.0).exp2(), ground);
        }
        Until::Within { triangles, ground }
    }

    /// Stops at an error in metres.
    fn limit<'b>(&self, metres: f64, ground: Ground<'b>) -> Until<'b> {
        let vertical = ((metres - self.stats.rounding) / self.stats.quantum).max(0.0);
        Until::Error { ground, vertical, border: metres }
    }

    /// Stops at the error asked of the layer; what is drawn where all is split has the source's own border.
    fn finest_limit<'b>(&self, ground: Ground<'b>) -> Until<'b> {
        match self.limit(self.max_error, ground) {
            Until::Error { ground, vertical, .. } => Until::Error { ground, vertical, border: 0.0 },
            other => other,
        }
    }

    /// The mesh of a diamond of the finest payloads: its children, which have none, are made from the source.
    fn of_finest(&self, deep: &Forest, d: Diamond, ground: Ground<'_>, finest: &mut Finest) -> Merged {
        let until = self.finest_limit(ground);
        let loses = matches!(until, Until::Error { vertical, .. } if vertical > 0.0);
        if !loses && let Some(whole) = self.whole(deep, d, ground, finest) {
            return whole;
        }
        let children = deep.children(d);
        for c in children.into_iter().flatten() {
            if finest.halves.contains_key(&c) {
                continue;
            }
            let merged = if loses { self.of_finer(deep, c, ground, finest) } else { source(deep, c, ground) };
            let simplified = simplify(deep, c, &merged, &self.rules(), until);
            let vertical = simplified.vertical.unwrap_or_else(|| distance(&simplified.halves, ground));
            finest.halves.insert(c, (simplified, vertical));
        }
        quarters(deep, d, children, finest)
    }

    /// The mesh of a diamond of the finest payloads if it is the source's own.
    fn whole(&self, deep: &Forest, d: Diamond, ground: Ground<'_>, finest: &mut Finest) -> Option<Merged> {
        lattice(deep, d, ground, &mut finest.keep, &mut finest.lattices)
    }

    /// The mesh of a diamond whose children are the first to be simplified.
    fn of_finer(&self, deep: &Forest, d: Diamond, ground: Ground<'_>, finest: &mut Finest) -> Merged {
        let children = deep.children(d);
        for c in children.into_iter().flatten() {
            finest.halves.entry(c).or_insert_with(|| {
                let merged = source(deep, c, ground);
                // What is drawn is what becomes of it one level up.
                (simplify(deep, c, &merged, &self.rules(), self.finest_limit(ground)), 0.0)
            });
        }
        quarters(deep, d, children, finest)
    }

    /// The largest distance between the samples and a diamond's halves, in quanta, where its samples are too many to
    /// be read at once.
    fn distance_in_bands(&self, d: Diamond, halves: &[Tin; 2]) -> Result<f64, BuildError> {
        let [low, high] = self.forest.bounds(d);
        let width = u64::from(high[0] - low[0] + 1);
        let rows = u32::try_from((WINDOW_SAMPLES / 16 / width).max(1)).unwrap_or(u32::MAX);
        let bands: Vec<u32> = (low[1]..=high[1]).step_by(rows as usize).collect();
        let band = |y: u32| {
            let last = high[1].min(y.saturating_add(rows - 1));
            let window = self.canvas.read(0, [low[0], y], [high[0], last]).map_err(self.work.failure())?;
            Ok(distance(halves, ground(&window)))
        };
        bands.into_par_iter().map(band).try_reduce(|| 0.0, |a, b| Ok(a.max(b)))
    }
}

/// The mesh of a diamond whose children's halves are at hand.
fn quarters(deep: &Forest, d: Diamond, children: [Option<Diamond>; 4], finest: &Finest) -> Merged {
    let empty = Tin::default();
    let quarter = |c: Option<Diamond>| {
        c.and_then(|c| Some(&finest.halves.get(&c)?.0.halves[half_of(deep, c, d)])).unwrap_or(&empty)
    };
    merge(deep, d, children.map(quarter))
}

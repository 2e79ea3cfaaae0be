//! Corrections: points strictly inside a diamond move, where its split has a finer step than they have.
//!
//! A step three times as fine splits each interval into three equal ones, so a correction is one of three
//! symbols: stay, or move to either side. How likely each is depends on where the neighbours lie.
//!
//! Rows run along the local grid. Past the finest lattice the grid of an odd level is turned, so that its rows
//! run along the lattice and a point's neighbours are the nearest there are:
//!
//! ```text
//!   y           (p, q) are doubled local coordinates, m segments a side:
//!   :    .      x = (p + q) / 2, y = (q - p) / 2 + m. The diamond's square stands on its corner in a
//!   :  . . .    square of 2m + 1 points a side, and its diagonals are the middle row and column.
//!   :. . . . .
//!   :  . . .
//!   :    . . x
//! ```

#![allow(
    clippy::cast_possible_wrap,
    reason = "a block has fewer than 2^16 points, and steps fewer than 2^21 quanta"
)]

use super::coding::{Coding, Place};
use super::model::{ROUGHNESSES, TILTS, correction_class};
use super::walk::{moved, steps};
use super::{DecodeError, Pass, Tally};
use crate::NODATA;
use crate::diamond::Block;
use std::ops::Range;

const PLACES: [Place; 4] = [Place::Off, Place::Hypotenuse, Place::OtherDiagonal, Place::Centre];

/// By how many factors of three the split makes the old points of a place more precise.
fn depth(coding: &Coding, level: u32, place: Place) -> u8 {
    coding.exponent_before(level, place).saturating_sub(coding.exponent(level, place))
}

/// Corrects the points strictly inside: in each round, coarse to fine, every one whose step is still too large.
/// `upper`: whether the triangle above the diagonal exists. `turned`: whether all is known, centres too.
pub(super) fn walk_corrections<P: Pass>(
    coding: &Coding,
    level: u32,
    upper: bool,
    turned: bool,
    block: &mut Block,
    pass: &mut P,
    tally: &mut Tally,
) -> Result<(), DecodeError> {
    let depths = PLACES.map(|p| depth(coding, level, p));
    let rounds = depths.into_iter().max().unwrap_or(0);
    if rounds == 0 {
        return Ok(());
    }
    let finest = PLACES.map(|p| coding.exponent(level, p));
    let mut raster = turned.then(|| Turned::of(block));
    let (side, points) = match &mut raster {
        Some(raster) => (raster.side(), raster.heights.as_mut_slice()),
        None => (block.segments() + 1, block.parts_mut().0),
    };
    let holes = points.contains(&NODATA);
    let mut thirds = Thirds::new(side, turned);
    for round in (1..=rounds).rev() {
        for v in 1..side - 1 {
            thirds.clear(v);
            let (runs, count) = if turned { runs_turned(side, v, upper) } else { runs(side, v, upper) };
            for Run { from, to, place } in runs.into_iter().take(count) {
                let at = PLACES.iter().position(|p| *p == place).unwrap_or(0);
                if depths[at] < round || from >= to {
                    continue;
                }
                let step = coding.step(finest[at] + round - 1);
                let slots = v * side + from..v * side + to;
                if holes {
                    for slot in slots.filter(|s| points[*s] != NODATA) {
                        thirds.push(points, slot, step);
                    }
                } else {
                    thirds.push_all(points, slots, step);
                }
            }
            thirds.pass(coding, pass, points, tally)?;
        }
    }
    if let Some(raster) = raster {
        raster.give_back(block);
    }
    Ok(())
}

/// Columns of a row whose points are alike.
#[derive(Debug, Clone, Copy)]
struct Run {
    from: usize,
    to: usize,
    place: Place,
}

impl Run {
    const NONE: Self = Self { from: 0, to: 0, place: Place::Off };
}

/// The points of row v strictly inside, of a grid of `side` points a side: the diagonals part what lies between.
fn runs(side: usize, v: usize, upper: bool) -> ([Run; 5], usize) {
    let n = side - 1;
    let first = if upper { 1 } else { v };
    let run = |from: usize, to: usize, place| Run { from: from.max(first), to: to.min(n), place };
    let (low, high) = (v.min(n - v), v.max(n - v));
    let at = |u: usize| super::coding::place(n, 2 * u, 2 * v);
    let off = Place::Off;
    if low == high {
        let runs = [run(1, low, off), run(low, low + 1, at(low)), run(low + 1, n, off), Run::NONE, Run::NONE];
        return (runs, 3);
    }
    let runs = [
        run(1, low, off),
        run(low, low + 1, at(low)),
        run(low + 1, high, off),
        run(high, high + 1, at(high)),
        run(high + 1, n, off),
    ];
    (runs, 5)
}

/// The same of a turned grid: the diagonals are the middle row and column.
fn runs_turned(side: usize, v: usize, upper: bool) -> ([Run; 5], usize) {
    let m = side / 2;
    let (from, to) = (v.abs_diff(m) + 1, side - 1 - v.abs_diff(m));
    let (along, middle) = match v.cmp(&m) {
        std::cmp::Ordering::Equal => (Place::Hypotenuse, Place::Centre),
        std::cmp::Ordering::Greater if !upper => return ([Run::NONE; 5], 0),
        _ => (Place::Off, Place::OtherDiagonal),
    };
    let run = |from, to, place| Run { from, to, place };
    let runs =
        [run(from, m, along), run(m, m + 1, middle), run(m + 1, to, along), Run::NONE, Run::NONE];
    (runs, 3)
}

/// A block with known centres, in rows along the lattice; without height outside of the diamond.
struct Turned {
    m: usize,
    heights: Vec<i32>,
}

impl Turned {
    fn of(block: &Block) -> Self {
        let m = block.segments();
        let mut turned = Self { m, heights: vec![NODATA; (2 * m + 1) * (2 * m + 1)] };
        for [p, q] in block.places() {
            let at = turned.at(p, q);
            turned.heights[at] = block.heights()[Block::slot(m, p, q)];
        }
        turned
    }

    fn side(&self) -> usize {
        2 * self.m + 1
    }

    fn at(&self, p: usize, q: usize) -> usize {
        (q + 2 * self.m - p) / 2 * self.side() + (p + q) / 2
    }

    fn give_back(&self, block: &mut Block) {
        let m = self.m;
        for [p, q] in block.places() {
            let height = self.heights[self.at(p, q)];
            let (old, centres) = block.parts_mut();
            match Block::slot(m, p, q) {
                slot if slot < old.len() => old[slot] = height,
                slot => centres[slot - old.len()] = height,
            }
        }
    }
}

/// A row's worth of corrections by a third, in the order of the row.
struct Thirds {
    side: usize,
    turned: bool,
    row: usize,
    slots: Vec<usize>,
    steps: Vec<i32>,
    /// Whether the neighbours lie lower: towards them counts as up.
    down: Vec<bool>,
    classes: Vec<u8>,
    numbers: Vec<i32>,
}

/// The class of a correction by `1 / per_step` of a point with these neighbours to the west, east, south
/// and north; and whether they lie lower.
#[inline(always)]
fn third(here: i32, [w, e, s, n]: [i32; 4], per_step: f32) -> (u8, bool) {
    // How far the neighbours' mean lies to one side, in parts of the three steps to choose from.
    const TILT: [f32; TILTS - 1] = [0.06, 0.18, 0.35, 0.6, 1.2];
    const ROUGH: [f32; ROUGHNESSES - 1] = [6.0, 18.0];
    let tilt = w + e + s + n - 4 * here;
    let aside = tilt.abs() as f32 * (per_step * (1.0 / 12.0));
    let bends = (2 * (w + e - s - n).abs() + (w - e).abs() + (s - n).abs()) as f32 * (per_step * 0.25);
    let tilted: u8 = TILT.iter().map(|limit| u8::from(aside >= *limit)).sum();
    let rough: u8 = ROUGH.iter().map(|limit| u8::from(bends >= *limit)).sum();
    (correction_class(tilted, rough), tilt < 0)
}

impl Thirds {
    fn new(side: usize, turned: bool) -> Self {
        Self {
            side,
            turned,
            row: 0,
            slots: Vec::with_capacity(side),
            steps: Vec::with_capacity(side),
            down: Vec::with_capacity(side),
            classes: Vec::with_capacity(side),
            numbers: Vec::with_capacity(side),
        }
    }

    fn clear(&mut self, row: usize) {
        self.row = row;
        self.slots.clear();
        self.steps.clear();
        self.down.clear();
        self.classes.clear();
    }

    /// Adds the point at `slot`, to be moved by a `step` or not at all.
    fn push(&mut self, points: &[i32], slot: usize, step: i32) {
        let here = points[slot];
        let near = [slot - 1, slot + 1, slot - self.side, slot + self.side];
        let near = near.map(|slot| if points[slot] == NODATA { here } else { points[slot] });
        let (class, down) = third(here, near, 1.0 / step as f32);
        self.slots.push(slot);
        self.steps.push(step);
        self.classes.push(class);
        self.down.push(down);
    }

    /// Adds a run of points whose neighbours all have heights.
    fn push_all(&mut self, points: &[i32], slots: Range<usize>, step: i32) {
        let (from, count) = (slots.start, slots.len());
        let per_step = 1.0 / step as f32;
        let line = |at: usize| &points[at..at + count];
        let (here, w, e) = (line(from), line(from - 1), line(from + 1));
        let (s, north) = (line(from - self.side), line(from + self.side));
        let start = self.classes.len();
        self.slots.extend(slots);
        self.steps.resize(start + count, step);
        self.classes.resize(start + count, 0);
        self.down.resize(start + count, false);
        let (classes, down) = (&mut self.classes[start..][..count], &mut self.down[start..][..count]);
        for u in 0..count {
            (classes[u], down[u]) = third(here[u], [w[u], e[u], s[u], north[u]], per_step);
        }
    }

    /// Where the block has the point at `slot`.
    #[inline(always)]
    fn in_block(&self, slot: usize) -> usize {
        if !self.turned {
            return slot;
        }
        let (m, x) = (self.side / 2, slot - self.row * self.side);
        Block::slot(m, x + m - self.row, x + self.row - m)
    }

    fn pass<P: Pass>(
        &mut self,
        coding: &Coding,
        pass: &mut P,
        points: &mut [i32],
        tally: &mut Tally,
    ) -> Result<(), DecodeError> {
        let tables = coding.model().tables();
        let mut numbers = std::mem::take(&mut self.numbers);
        numbers.clear();
        numbers.resize(self.slots.len(), 0);
        pass.receive(tables, &self.classes, &mut numbers);
        let places = self.slots.iter().zip(&self.steps).zip(&self.down);
        for (((slot, step), down), number) in places.zip(&mut numbers) {
            let base = points[*slot];
            let turn = |k: i32| if *down { -k } else { k };
            let wanted = |h: i32| turn(steps(h - base, *step).clamp(-1, 1));
            *number = pass.number(*number, self.in_block(*slot), wanted);
            // Where numbers are damaged they are still small: tables of corrections have three symbols.
            points[*slot] = moved(base, turn(*number), *step)?;
            tally.corrected += u32::from(*number != 0);
        }
        pass.send(tables, &self.classes, &numbers);
        self.numbers = numbers;
        Ok(())
    }
}

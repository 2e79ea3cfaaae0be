//! Corrections: points strictly inside a diamond move, where its split has a finer step than they have.
//!
//! A step three times as fine splits each interval into three equal ones, so a correction is one of three
//! symbols: stay, or move to either side. How likely each is depends on where the neighbours lie: a weighted
//! sum of what they differ says where the point is expected, and of how they differ among themselves how far
//! off that may be. The weights are learnt, by level and pass.
//!
//! **Passes.** Coarse to fine, like the lattice, so that most points have neighbours on all sides that are
//! corrected already:
//!
//! ```text
//!   c b c b c      a  those in even rows and columns
//!   a c a c a      b  those in odd rows and columns, between four corrected ones across corners
//!   c b c b c      c  all others, between four corrected ones
//!   a c a c a
//! ```
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
use super::model::{REFINER_PASSES, Refiner, SPREAD_PARTS, TILT_PARTS};
use super::tables::{FIRST_CORRECTION, SPREADS, TILTS};
use super::walk::HEIGHT_BITS;
use super::{DecodeError, Pass, Tally};
use crate::NODATA;
use crate::diamond::Block;

const PLACES: [Place; 4] = [Place::Off, Place::Hypotenuse, Place::OtherDiagonal, Place::Centre];

/// The passes over a grid, in their order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Which {
    Even,
    Odd,
    Mixed,
}

const PASSES: [Which; REFINER_PASSES] = [Which::Even, Which::Odd, Which::Mixed];

impl Which {
    /// The parity of the columns of a row that it goes through, if it does.
    fn columns(self, row: usize) -> Option<usize> {
        let parity = row % 2;
        match self {
            Self::Even => (parity == 0).then_some(0),
            Self::Odd => (parity == 1).then_some(1),
            Self::Mixed => Some(1 - parity),
        }
    }
}

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
    let refiners = coding.model().refiners(level);
    let tables = coding.model().tables();
    let mut raster = Raster::of(block, upper, turned);
    let side = raster.side;
    let (mut thirds, mut row) = (Thirds::default(), Row::default());
    for (round, which) in (1..=rounds).rev().flat_map(|round| PASSES.map(|p| (round, p))) {
        let refiner = &refiners[which as usize];
        for y in 1..side - 1 {
            let Some(parity) = which.columns(y) else { continue };
            let (runs, count) = if turned { runs_turned(side, y, upper) } else { runs(side, y, upper) };
            let due = runs.into_iter().take(count).filter_map(|Run { from, to, place }| {
                let at = PLACES.iter().position(|p| *p == place).unwrap_or(0);
                let from = from + usize::from(from % 2 != parity);
                if depths[at] < round || from >= to {
                    return None;
                }
                let step = coding.step(finest[at] + round - 1);
                Some(Third { place: [from, y], count: (to - from).div_ceil(2), step })
            });
            let (Some(first), Some(last)) = (due.clone().next(), due.clone().next_back()) else { continue };
            let span = (last.place[0] - first.place[0]) / 2 + last.count;
            row.look(&raster, first.place, span, refiner);
            thirds.clear();
            due.for_each(|third| thirds.add(&raster, &row, third, refiner));
            if P::LEARNS {
                for third in &thirds.runs {
                    third.learn(&raster, which as usize, pass);
                }
            }
            thirds.numbers.clear();
            thirds.numbers.resize(thirds.classes.len(), 0);
            pass.receive_corrections(tables, &thirds.classes, &mut thirds.numbers);
            thirds.apply(&mut raster, pass, tally)?;
            pass.send(tables, &thirds.classes, &thirds.numbers);
        }
    }
    raster.give_back(block);
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
    let runs = [run(from, m, along), run(m, m + 1, middle), run(m + 1, to, along), Run::NONE, Run::NONE];
    (runs, 3)
}

/// Points beyond the grid's border on each side, so that all have neighbours two steps away.
const MARGIN: usize = 2;

/// The known points of a block as rows, each with its even columns first and then its odd ones: what a pass
/// looks at lies side by side.
///
/// Outside of the diamond, and where there is no height, a row goes on with its nearest point to the west, or
/// else to the east, and beyond the last row with that row: neighbours are expected from there, too.
struct Raster {
    /// Points along each side.
    side: usize,
    turned: bool,
    upper: bool,
    /// Points that have no height, by position, if there are any.
    holes: Vec<bool>,
    stride: usize,
    heights: Vec<i32>,
}

impl Raster {
    fn of(block: &Block, upper: bool, turned: bool) -> Self {
        let n = block.segments();
        let side = if turned { 2 * n + 1 } else { n + 1 };
        let stride = (side + 2 * MARGIN).next_multiple_of(2);
        let heights = vec![0; stride * (side + 2 * MARGIN)];
        let mut raster = Self { side, turned, upper, holes: Vec::new(), stride, heights };
        for y in 0..side {
            let (from, to) = raster.span(y);
            let mut is_whole = from < to;
            for half in raster.halves(y) {
                let points = raster.heights[half.at..half.at + half.count].iter_mut();
                for (point, slot) in points.zip((half.slot..).step_by(half.step)) {
                    *point = block.heights()[slot];
                    is_whole &= *point != NODATA;
                }
            }
            if is_whole {
                raster.extend(y, from, to);
            } else {
                raster.mend(y, from, to);
            }
        }
        for margin in 0..MARGIN {
            let (first, last) = (MARGIN * stride, (side + MARGIN - 1) * stride);
            raster.heights.copy_within(first..first + stride, margin * stride);
            raster.heights.copy_within(last..last + stride, (side + MARGIN + margin) * stride);
        }
        raster
    }

    /// The columns of a row that lie in the diamond.
    fn span(&self, y: usize) -> (usize, usize) {
        if !self.turned {
            return (if self.upper { 0 } else { y }, self.side);
        }
        let m = self.side / 2;
        if y > m && !self.upper { (0, 0) } else { (y.abs_diff(m), self.side - y.abs_diff(m)) }
    }

    /// The points of a row that lie in the diamond: every other from the first and from the second on.
    fn halves(&self, y: usize) -> [Half; 2] {
        let (from, to) = self.span(y);
        // From one point to the next but one of a turned row, both local coordinates grow by one.
        let m = self.side / 2;
        [from, from + 1].map(|x| {
            if x >= to {
                return Half { at: 0, count: 0, slot: 0, step: 1 };
            }
            let slot = self.slot(x, y);
            let is_old = slot < (m + 1) * (m + 1);
            let step = if !self.turned { 2 } else { m + 1 + usize::from(is_old) };
            Half { at: self.at(x, y), count: (to - x).div_ceil(2), slot, step }
        })
    }

    /// Beyond the ends of the points of a row it goes on with them.
    fn extend(&mut self, y: usize, from: usize, to: usize) {
        let (first, last) = (self.heights[self.at(from, y)], self.heights[self.at(to - 1, y)]);
        let row = (y + MARGIN) * self.stride;
        for half in [row, row + self.stride / 2] {
            let odd = usize::from(half > row);
            // The first column of this half at or beyond each end, margin included.
            let [low, high] = [from, to].map(|x| (x + MARGIN + 1 - odd) / 2);
            self.heights[half..half + low].fill(first);
            self.heights[half + high..half + self.stride / 2].fill(last);
        }
    }

    /// Notes the holes of a row and fills them: with what lies to the west, or else to the east, or else in the
    /// row before.
    fn mend(&mut self, y: usize, from: usize, to: usize) {
        self.holes.resize(self.heights.len(), false);
        let mut last = None;
        for x in from..to {
            let at = self.at(x, y);
            if self.heights[at] != NODATA {
                last = Some(self.heights[at]);
                continue;
            }
            self.holes[at] = true;
            if let Some(last) = last {
                self.heights[at] = last;
            }
        }
        if last.is_none() {
            let row = (y + MARGIN) * self.stride;
            self.heights.copy_within(row - self.stride..row, row);
            return;
        }
        let first = (from..to).map(|x| self.heights[self.at(x, y)]).find(|h| *h != NODATA).unwrap_or(0);
        for x in from..to {
            let at = self.at(x, y);
            if self.heights[at] != NODATA {
                break;
            }
            self.heights[at] = first;
        }
        self.extend(y, from, to);
    }

    /// Where the block has a point of the diamond.
    #[inline(always)]
    fn slot(&self, x: usize, y: usize) -> usize {
        if !self.turned {
            return y * self.side + x;
        }
        let m = self.side / 2;
        Block::slot(m, x + m - y, x + y - m)
    }

    /// The position of a point.
    #[inline(always)]
    fn at(&self, x: usize, y: usize) -> usize {
        let x = x + MARGIN;
        (y + MARGIN) * self.stride + x % 2 * (self.stride / 2) + x / 2
    }

    /// `count` points, every other one from `x + dx` on, of the row at `y + dy`.
    #[inline(always)]
    fn line(&self, [x, y]: [usize; 2], [dx, dy]: [isize; 2], count: usize) -> &[i32] {
        let x = (x + MARGIN).wrapping_add_signed(dx);
        let row = (y + MARGIN).wrapping_add_signed(dy) * self.stride;
        let at = row + x % 2 * (self.stride / 2) + x / 2;
        &self.heights[at..at + count]
    }

    fn give_back(&self, block: &mut Block) {
        let heights = block.heights_mut();
        for half in (0..self.side).flat_map(|y| self.halves(y)) {
            let points = &self.heights[half.at..half.at + half.count];
            if self.holes.is_empty() {
                for (point, slot) in points.iter().zip((half.slot..).step_by(half.step)) {
                    heights[slot] = *point;
                }
                continue;
            }
            let is_hole = &self.holes[half.at..half.at + half.count];
            for (i, slot) in (0..half.count).zip((half.slot..).step_by(half.step)) {
                if !is_hole[i] {
                    heights[slot] = points[i];
                }
            }
        }
    }
}

/// Every other point of a row: where the raster has the first of `count`, one after the other, and where the
/// block has them, `step` slots apart.
#[derive(Debug, Clone, Copy)]
struct Half {
    at: usize,
    count: usize,
    slot: usize,
    step: usize,
}

/// A row's worth of corrections by a third, in the order of the row.
#[derive(Debug, Default)]
struct Thirds {
    runs: Vec<Third>,
    classes: Vec<u8>,
    /// Whether a point is expected lower: towards that counts as up.
    down: Vec<bool>,
    numbers: Vec<i32>,
}

/// What a correction is expected from, in quanta.
#[derive(Debug, Clone, Copy)]
pub(super) struct Parts {
    /// What neighbours lie higher: those to the west and east, the south, the north, the two south and the two
    /// north of those; two steps away those to the west and east, the south, the north, and the four a
    /// knight's move to the south and to the north.
    pub(super) tilt: [f32; TILT_PARTS],
    /// What they differ among themselves; without the constant.
    pub(super) spread: [f32; SPREAD_PARTS - 1],
}

/// The neighbours of a run of points.
struct Around<'a> {
    here: &'a [i32],
    near: [&'a [i32]; 8],
    far: [&'a [i32]; 12],
}

impl<'a> Around<'a> {
    #[inline(always)]
    fn new(raster: &'a Raster, place: [usize; 2], count: usize) -> Self {
        const NEAR: [[isize; 2]; 8] = [[-1, 0], [1, 0], [0, -1], [0, 1], [-1, -1], [1, -1], [-1, 1], [1, 1]];
        const FAR: [[isize; 2]; 12] = [
            [-2, 0],
            [2, 0],
            [0, -2],
            [0, 2],
            [-2, -1],
            [2, -1],
            [-1, -2],
            [1, -2],
            [-2, 1],
            [2, 1],
            [-1, 2],
            [1, 2],
        ];
        let line = |d: [isize; 2]| raster.line(place, d, count);
        Self { here: line([0, 0]), near: NEAR.map(line), far: FAR.map(line) }
    }

    /// What the neighbours of point i lie higher, and what they differ among themselves.
    #[inline(always)]
    fn tilt(&self, i: usize) -> [f32; TILT_PARTS] {
        let h = self.here[i];
        let [w, e, s, n, sw, se, nw, ne] = self.near;
        let [ww, ee, ss, nn, a, b, c, d, f, g, j, k] = self.far;
        let (two, four) = (2 * h, 4 * h);
        [
            (w[i] + e[i] - two) as f32,
            (s[i] - h) as f32,
            (n[i] - h) as f32,
            (sw[i] + se[i] - two) as f32,
            (nw[i] + ne[i] - two) as f32,
            (ww[i] + ee[i] - two) as f32,
            (ss[i] - h) as f32,
            (nn[i] - h) as f32,
            (a[i] + b[i] + c[i] + d[i] - four) as f32,
            (f[i] + g[i] + j[i] + k[i] - four) as f32,
        ]
    }

    #[inline(always)]
    fn spread(&self, i: usize) -> [f32; SPREAD_PARTS - 1] {
        let [w, e, s, n, sw, se, nw, ne] = self.near;
        let [ww, ee, ss, nn, ..] = self.far;
        let (we, sn) = (w[i] + e[i], s[i] + n[i]);
        [
            (we - sn).abs() as f32,
            ((w[i] - e[i]).abs() + (s[i] - n[i]).abs()) as f32,
            (sw[i] + ne[i] - se[i] - nw[i]).abs() as f32,
            ((ww[i] + ee[i] - we).abs() + (ss[i] + nn[i] - sn).abs()) as f32,
        ]
    }

    fn parts(&self, i: usize) -> Parts {
        Parts { tilt: self.tilt(i), spread: self.spread(i) }
    }
}

/// What is expected of every other point of a row, in quanta.
#[derive(Debug, Default)]
struct Row {
    /// The column of the first.
    from: usize,
    /// How far up each is expected.
    tilts: Vec<f32>,
    /// How far off that may be, but for the constant.
    spreads: Vec<f32>,
}

impl Row {
    /// Looks at `count` points from `place` on. Loop by loop over plain slices, so that each becomes one over
    /// vectors.
    fn look(&mut self, raster: &Raster, place: [usize; 2], count: usize, refiner: &Refiner) {
        self.from = place[0];
        self.tilts.resize(count, 0.0);
        self.spreads.resize(count, 0.0);
        let around = Around::new(raster, place, count);
        let (tilts, spreads) = (&mut self.tilts[..count], &mut self.spreads[..count]);
        let weights = refiner.tilt();
        for (i, tilt) in tilts.iter_mut().enumerate() {
            let mut sum = 0.0;
            for (weight, part) in weights.iter().zip(around.tilt(i)) {
                sum += weight * part;
            }
            *tilt = sum;
        }
        let weights = refiner.spread();
        for (i, spread) in spreads.iter_mut().enumerate() {
            let mut sum = 0.0;
            for (weight, part) in weights.iter().zip(around.spread(i)) {
                sum += weight * part;
            }
            *spread = sum;
        }
    }

    /// The classes of some of its points, the first of them in column `x`, by `step`.
    fn classes(&self, x: usize, step: i32, refiner: &Refiner, classes: &mut [u8], down: &mut [bool]) {
        // In steps: the outer thirds begin at half a step.
        const TILT: [f32; TILTS - 1] = [0.06, 0.15, 0.3, 0.5, 0.75, 1.1, 1.6, 2.6];
        // Two classes an octave.
        const LEAST: f32 = 0.0625;
        const MOST: f32 = LEAST * (1 << (SPREADS / 2)) as f32 * 0.999;
        let (count, at) = (classes.len(), (x - self.from) / 2);
        let (tilts, spreads) = (&self.tilts[at..at + count], &self.spreads[at..at + count]);
        let down = &mut down[..count];
        let (per_step, constant) = (1.0 / step as f32, refiner.spread()[SPREAD_PARTS - 1]);
        for i in 0..count {
            let aside = tilts[i].abs() * per_step;
            let mut tilted = 0;
            for limit in TILT {
                tilted += u32::from(aside >= limit);
            }
            let spread = spreads[i] * per_step + constant;
            let spread = if spread > LEAST { spread } else { LEAST };
            let spread = if spread < MOST { spread } else { MOST };
            let spread = (spread.to_bits() >> 22) - (LEAST.to_bits() >> 22);
            classes[i] = (u32::from(FIRST_CORRECTION) + spread * TILTS as u32 + tilted) as u8;
            down[i] = tilts[i] < 0.0;
        }
    }
}

/// Every other point from `place` on, along a row.
#[derive(Debug, Clone, Copy)]
struct Third {
    place: [usize; 2],
    count: usize,
    step: i32,
}

impl Third {
    /// Shows a pass what each of the corrections is expected from.
    fn learn<P: Pass>(&self, raster: &Raster, which: usize, pass: &mut P) {
        let ([x, y], around) = (self.place, Around::new(raster, self.place, self.count));
        for i in 0..self.count {
            if raster.holes.is_empty() || !raster.holes[raster.at(x + 2 * i, y)] {
                pass.learn(which, raster.slot(x + 2 * i, y), around.here[i], self.step, &around.parts(i));
            }
        }
    }
}

impl Thirds {
    fn clear(&mut self) {
        self.runs.clear();
        self.classes.clear();
        self.down.clear();
    }

    /// Adds every other of a run of points of a row, each to be moved by the run's step or not at all.
    fn add(&mut self, raster: &Raster, row: &Row, run: Third, refiner: &Refiner) {
        let Third { place: [x, y], count, step } = run;
        let start = self.classes.len();
        self.classes.resize(start + count, 0);
        self.down.resize(start + count, false);
        row.classes(x, step, refiner, &mut self.classes[start..], &mut self.down[start..]);
        self.runs.push(run);
        if raster.holes.is_empty() {
            return;
        }
        // Without height there is nothing to correct.
        let mut kept = start;
        for i in 0..count {
            if !raster.holes[raster.at(x + 2 * i, y)] {
                (self.classes[kept], self.down[kept]) = (self.classes[start + i], self.down[start + i]);
                kept += 1;
            }
        }
        self.classes.truncate(kept);
        self.down.truncate(kept);
    }

    /// Moves the points by their numbers: those that were received, or those that the source asks for.
    fn apply<P: Pass>(
        &mut self,
        raster: &mut Raster,
        pass: &mut P,
        tally: &mut Tally,
    ) -> Result<(), DecodeError> {
        let (mut next, mut beyond) = (0, 0);
        for Third { place: [x, y], count, step } in self.runs.iter().copied() {
            let first = raster.at(x, y);
            // From point to point of a row's half the slots are as far apart.
            let slot = raster.slot(x, y);
            let apart = if count > 1 { raster.slot(x + 2, y) - slot } else { 0 };
            for i in 0..count {
                if !raster.holes.is_empty() && raster.holes[first + i] {
                    continue;
                }
                let base = raster.heights[first + i];
                let turn = |k: i32| if self.down[next] { -k } else { k };
                // The outer thirds begin at half a step, which is no whole number.
                let wanted = |h: i32| {
                    let twice = 2 * (h - base);
                    turn(i32::from(twice > step) - i32::from(twice < -step))
                };
                let number = pass.number(self.numbers[next], slot + i * apart, wanted);
                self.numbers[next] = number;
                // Where numbers are damaged they are still small: corrections have three symbols.
                let height = base + turn(number) * step;
                beyond |= height.unsigned_abs() >> HEIGHT_BITS;
                raster.heights[first + i] = height;
                tally.corrected += u32::from(number != 0);
                next += 1;
            }
        }
        if beyond == 0 { Ok(()) } else { Err(DecodeError::Height) }
    }
}

//! The walk over a diamond's symbols, the same for sender and receiver.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "a block has fewer than 2^16 points; numbers are below 2^31 and heights are checked"
)]

use super::coding::{Coding, Place, Rule};
use super::corrections::walk_corrections;
use super::model::{CAUSAL_BITS, Kernel};
use super::rows::{Below, Ground, Row, activity, complete};
use super::tables::class;
use super::{DecodeError, Pass, Tally};
use crate::bintree::Forest;
use crate::diamond::{Block, Diamond, Local};
use crate::rans::Context;
use crate::{HEIGHT_MAX, NODATA};

/// The multiple of `step` nearest to `value`, in steps; `step` is odd, so nothing lies half way.
fn steps(value: i32, step: i32) -> i32 {
    Divisor::new(step).steps(value)
}

/// Division by one step again and again, as a multiplication (Granlund and Montgomery 1994, *Division by
/// invariant integers using multiplication*).
#[derive(Debug, Clone, Copy)]
struct Divisor {
    step: i32,
    reciprocal: u64,
    shift: u32,
}

impl Divisor {
    /// By a step from 1 to [`super::STEP_MAX`].
    fn new(step: i32) -> Self {
        // With 2^shift of 32 more bits than the step has, the reciprocal rounded up is exact for all of 32 bits.
        let shift = 32 + (32 - (step as u32 - 1).leading_zeros());
        Self { step, reciprocal: (1u64 << shift).div_ceil(step as u64), shift }
    }

    /// The multiple of the step nearest to `value`, in steps.
    #[inline(always)]
    fn steps(self, value: i32) -> i32 {
        let dividend = value.unsigned_abs() + (self.step as u32 - 1) / 2;
        let magnitude = ((u128::from(dividend) * u128::from(self.reciprocal)) >> self.shift) as i32;
        if value < 0 { -magnitude } else { magnitude }
    }
}

/// `base + k * step`, if that is a height.
fn moved(base: i32, k: i32, step: i32) -> Result<i32, DecodeError> {
    let height = i64::from(base) + i64::from(k) * i64::from(step);
    i32::try_from(height).ok().filter(|h| h.abs() <= HEIGHT_MAX).ok_or(DecodeError::Height)
}

/// In which of two ways the local grid lies on the lattice: upright or turned by a quarter.
pub(super) fn way(local: &Local) -> usize {
    let [x, y] = local.u;
    // Of an even level u lies along x or y; of an odd one along one diagonal or the other.
    usize::from(if x == 0 || y == 0 { x == 0 } else { (x > 0) != (y > 0) })
}

/// Which new points have a height.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Known {
    /// All.
    All,
    /// The payload says it of each.
    Sent,
    /// Those all of whose cell's corners have one.
    Inferred,
}

pub(super) fn walk<P: Pass>(
    forest: &Forest,
    coding: &Coding,
    d: Diamond,
    block: &mut Block,
    known: Known,
    pass: &mut P,
) -> Result<Tally, DecodeError> {
    let local = forest.local(d);
    let old = walk_old(forest, coding, d.level(), &local, block, known == Known::Sent, pass)?;
    let new = if forest.adds_points(d.level()) {
        walk_new(coding, d.level(), &local, block, known, pass)?
    } else {
        Tally::default()
    };
    Ok(Tally { real: old.real + new.real, fictitious: old.fictitious + new.fictitious, ..old })
}

/// All that comes before the new points: the root's own points and the corrections.
pub(super) fn walk_old<P: Pass>(
    forest: &Forest,
    coding: &Coding,
    level: u32,
    local: &Local,
    block: &mut Block,
    mixed: bool,
    pass: &mut P,
) -> Result<Tally, DecodeError> {
    let mut tally = Tally::default();
    if level == 0 {
        walk_root(coding, block, mixed, pass, &mut tally)?;
    }
    let turned = !forest.adds_points(level) && block.has_centres();
    walk_corrections(coding, level, local.upper, turned, block, pass, &mut tally)?;
    Ok(tally)
}

/// The root square's own points, coarse to fine. Their heights are rounded to multiples of their step,
/// not relative to a prediction, so that two squares which share a side give its points the same heights.
fn walk_root<P: Pass>(
    coding: &Coding,
    block: &mut Block,
    mixed: bool,
    pass: &mut P,
    tally: &mut Tally,
) -> Result<(), DecodeError> {
    let n = block.segments();
    let row = n + 1;
    let (old, _) = block.parts_mut();
    old.fill(NODATA);
    let mut validity = [Context::likely(7, 8), Context::likely(1, 2), Context::likely(1, 8)];
    let tables = coding.model().tables();
    let mut point = |old: &mut [i32], u: usize, v: usize, near: &[usize]| -> Result<(), DecodeError> {
        let slot = v * row + u;
        let known = near.iter().map(|s| old[*s]).filter(|h| *h != NODATA);
        let (low, high, sum, count) = known.fold((i32::MAX, i32::MIN, 0i64, 0i64), |(l, h, s, c), height| {
            (l.min(height), h.max(height), s + i64::from(height), c + 1)
        });
        if mixed {
            let context = match count {
                0 => 2,
                c if c == near.len() as i64 => 0,
                _ => 1,
            };
            if !pass.valid(&mut validity[context], slot) {
                return Ok(());
            }
        }
        let corner = (u == 0 || u == n) && (v == 0 || v == n);
        // Corners lie strictly inside no diamond at all: nobody will correct them.
        let step = coding.step(if corner { 0 } else { coding.first_exponent() });
        let mean = if count > 0 { sum.div_euclid(count) as i32 } else { 0 };
        let expected = steps(mean, step);
        // Some third of what the neighbours differ; of a lone or a first point nothing is known.
        let activity = if count < 2 { 200.0 } else { 0.3 * (high - low) as f32 / step as f32 + 0.25 };
        let classes = [class(activity)];
        let mut number = [0];
        pass.receive(tables, &classes, &mut number);
        let k = pass.number(number[0], slot, |h| steps(h, step) - expected);
        pass.send(tables, &classes, &[k]);
        old[slot] = moved(0, expected.checked_add(k).ok_or(DecodeError::Height)?, step)?;
        *(if k == 0 { &mut tally.fictitious } else { &mut tally.real }) += 1;
        Ok(())
    };
    for (u, v) in [(0, 0), (n, 0), (n, n), (0, n)] {
        let before = [0, n, n * row + n];
        let count = [(0, 0), (n, 0), (n, n), (0, n)].iter().position(|c| *c == (u, v)).unwrap_or(0);
        point(old, u, v, &before[..count])?;
    }
    let mut side = n;
    while side > 1 {
        let half = side / 2;
        for v in (half..n).step_by(side) {
            for u in (half..n).step_by(side) {
                let at = |du: usize, dv: usize| (v + dv - half) * row + u + du - half;
                point(old, u, v, &[at(0, 0), at(side, 0), at(side, side), at(0, side)])?;
            }
        }
        for v in (0..=n).step_by(half) {
            let first = if v % side == 0 { half } else { 0 };
            for u in (first..=n).step_by(side) {
                let at = |ok: bool, u: usize, v: usize| if ok { v * row + u } else { usize::MAX };
                let near = [
                    at(u >= half, u.wrapping_sub(half), v),
                    at(u + half <= n, u + half, v),
                    at(v >= half, u, v.wrapping_sub(half)),
                    at(v + half <= n, u, v + half),
                ];
                let mut inside = [0; 4];
                let mut count = 0;
                for slot in near.into_iter().filter(|slot| *slot != usize::MAX) {
                    inside[count] = slot;
                    count += 1;
                }
                point(old, u, v, &inside[..count])?;
            }
        }
        side = half;
    }
    Ok(())
}

/// Which new points have a height: into `new`, 0 for those that have.
fn walk_validity<P: Pass>(old: &[i32], new: &mut [i32], n: usize, upper: bool, pass: &mut P) {
    let mut contexts: [Context; 20] = std::array::from_fn(|i| {
        Context::likely(1 + 2 * (i as u64 / 4) + 3 * (i as u64 % 4).count_ones() as u64, 16)
    });
    let border = (n + 1) * (n + 1);
    for v in 0..n {
        let first = if upper { 0 } else { v };
        for u in first..n {
            let valid = corners(n, upper, u, v).iter().filter(|s| old[**s] != NODATA).count();
            let west = u > first && new[v * n + u - 1] != NODATA;
            let south = v > 0 && new[(v - 1) * n + u] != NODATA;
            let context = valid * 4 + usize::from(west) * 2 + usize::from(south);
            let has = pass.valid(&mut contexts[context], border + v * n + u);
            new[v * n + u] = if has { 0 } else { NODATA };
        }
    }
}

/// The slots of the corners of a cell, as far as they exist: the fourth one lies beyond the diagonal of a
/// diamond at the forest's border, and is then the first one again.
fn corners(n: usize, upper: bool, u: usize, v: usize) -> [usize; 4] {
    let at = v * (n + 1) + u;
    [at, at + 1, at + n + 2, if !upper && u == v { at } else { at + n + 1 }]
}

/// Whether the new point of a cell has a height, as long as nothing else is said.
pub(super) fn is_inferred(old: &[i32], n: usize, upper: bool, u: usize, v: usize) -> bool {
    corners(n, upper, u, v).iter().all(|s| old[*s] != NODATA)
}

/// The new points, row by row.
pub(super) fn walk_new<P: Pass>(
    coding: &Coding,
    level: u32,
    local: &Local,
    block: &mut Block,
    known: Known,
    pass: &mut P,
) -> Result<Tally, DecodeError> {
    let mut tally = Tally::default();
    let n = block.segments();
    let (old, new) = block.parts_mut();
    new.fill(NODATA);
    match known {
        Known::All => {}
        Known::Sent => walk_validity(old, new, n, local.upper, pass),
        Known::Inferred => {
            for (v, row) in new.chunks_exact_mut(n).enumerate() {
                let first = if local.upper { 0 } else { v };
                for (u, point) in row.iter_mut().enumerate().skip(first) {
                    *point = if is_inferred(old, n, local.upper, u, v) { 0 } else { NODATA };
                }
            }
        }
    }
    let mixed = known != Known::All;
    let quiet = pass.new_points();
    let mut rows = NewRows::new(coding, level, local, old, n);
    let mut all_zero = true;
    for v in 0..n {
        let first = if local.upper { 0 } else { v };
        rows.predict(old, v);
        let line = &mut new[v * n..(v + 1) * n];
        rows.choose(line, first, mixed);
        if !quiet {
            rows.receive(coding, pass);
        }
        rows.rebuild(line, v, pass)?;
        all_zero &= rows.numbers.iter().all(|k| *k == 0);
        rows.tally(&mut tally);
        rows.send(coding, pass);
    }
    pass.was_quiet(all_zero);
    Ok(tally)
}

/// The state of the walk over rows of new points.
struct NewRows<'a> {
    n: usize,
    coding: &'a Coding,
    kernel: Kernel,
    ground: Ground,
    row: Row,
    below: Below,
    /// Steps of new points off the diagonals and on them.
    steps: [i32; 2],
    divisors: [Divisor; 2],
    /// Of every place of the row: the prediction, the part of it that comes from old points (both less the
    /// base), and the class.
    guesses: Vec<i32>,
    bases: Vec<i32>,
    classes: Vec<u8>,
    /// Places of the row with a height, with their classes and numbers.
    places: Vec<usize>,
    chosen: Vec<u8>,
    numbers: Vec<i32>,
}

impl<'a> NewRows<'a> {
    fn new(coding: &'a Coding, level: u32, local: &Local, old: &[i32], n: usize) -> Self {
        let mut kernel = *coding.model().kernel(level, way(local));
        if coding.rule() == Rule::Midpoint {
            kernel.causal = [0; 4];
        }
        let steps = [Place::Off, Place::Hypotenuse].map(|p| coding.step(coding.exponent(level, p)));
        Self {
            n,
            coding,
            kernel,
            ground: Ground::new(old, n, local.upper),
            row: Row::new(n),
            below: Below::new(n),
            steps,
            divisors: steps.map(Divisor::new),
            guesses: vec![0; n],
            bases: vec![0; n],
            classes: vec![0; n],
            places: Vec::with_capacity(n),
            chosen: Vec::with_capacity(n),
            numbers: Vec::with_capacity(n),
        }
    }

    /// Predictions and classes of all places of row v.
    fn predict(&mut self, old: &[i32], v: usize) {
        let n = self.n;
        self.ground.row(v, &self.kernel, &mut self.row);
        if v == 0 {
            self.below.expect(&self.row, &self.kernel, self.steps[0]);
        }
        let (guesses, bases, classes) = (&mut self.guesses, &mut self.bases, &mut self.classes);
        complete(&self.row, &self.below, &self.kernel, self.steps[0], guesses, bases, classes);
        if self.steps[0] != self.steps[1] {
            for u in [v, n - 1 - v] {
                classes[u] = class(activity(&self.row, &self.below, &self.kernel, self.steps[1], u));
            }
        }
        if self.coding.rule() == Rule::Midpoint {
            for (u, guess) in guesses.iter_mut().enumerate() {
                let at = v * (n + 1) + u;
                let (a, b) = if (u + v).is_multiple_of(2) { (at, at + n + 2) } else { (at + 1, at + n + 1) };
                if old[a] != NODATA && old[b] != NODATA {
                    *guess = ((old[a] + old[b] + 1) >> 1) - self.ground.base;
                }
            }
        }
    }

    /// Which places of the row have a height, from `first` on.
    fn choose(&mut self, line: &[i32], first: usize, mixed: bool) {
        self.places.clear();
        self.chosen.clear();
        if mixed {
            self.places.extend((first..self.n).filter(|u| line[*u] != NODATA));
            self.chosen.extend(self.places.iter().map(|u| self.classes[*u]));
        } else {
            self.places.extend(first..self.n);
            self.chosen.extend_from_slice(&self.classes[first..]);
        }
        self.numbers.clear();
        self.numbers.resize(self.places.len(), 0);
    }

    fn receive<P: Pass>(&mut self, coding: &Coding, pass: &mut P) {
        pass.receive(coding.model().tables(), &self.chosen, &mut self.numbers);
    }

    fn send<P: Pass>(&mut self, coding: &Coding, pass: &mut P) {
        pass.send(coding.model().tables(), &self.chosen, &self.numbers);
    }

    /// Heights of the row from its numbers; and what the next row will want to know.
    fn rebuild<P: Pass>(&mut self, line: &mut [i32], v: usize, pass: &mut P) -> Result<(), DecodeError> {
        let n = self.n;
        let slot = (n + 1) * (n + 1) + v * n;
        let west_weight = i64::from(self.kernel.causal[3]);
        let base = self.ground.base;
        let mut before = usize::MAX;
        let mut missing = 0i64;
        let mut beyond = 0;
        if self.places.len() < n {
            self.below.clear();
        }
        for (u, number) in self.places.iter().copied().zip(&mut self.numbers) {
            // West of a hole nothing is known.
            if before.wrapping_add(1) != u {
                missing = 0;
            }
            before = u;
            let causal = (west_weight * missing + (1 << (CAUSAL_BITS - 1))) >> CAUSAL_BITS;
            let deduced = i64::from(base) + i64::from(self.guesses[u]) + causal;
            let divisor = &self.divisors[usize::from(u == v || u + v == n - 1)];
            *number = pass.number(*number, slot + u, |h| divisor.steps((i64::from(h) - deduced) as i32));
            let height = deduced + i64::from(*number) * i64::from(divisor.step);
            beyond |= height.unsigned_abs() >> HEIGHT_BITS;
            line[u] = height as i32;
            missing = height - i64::from(base) - i64::from(self.bases[u]);
            self.below.missing[u + 1] = missing as f32;
            self.below.numbers[u + 1] = number.unsigned_abs().min(NUMBER_MAX) as f32;
        }
        self.below.close();
        if beyond == 0 { Ok(()) } else { Err(DecodeError::Height) }
    }

    fn tally(&self, tally: &mut Tally) {
        let fictitious = self.numbers.iter().filter(|k| **k == 0).count() as u32;
        tally.fictitious += fictitious;
        tally.real += self.numbers.len() as u32 - fictitious;
    }
}

/// Heights are below 2^HEIGHT_BITS in magnitude.
pub(super) const HEIGHT_BITS: u32 = (HEIGHT_MAX as u32 + 1).trailing_zeros();

/// Larger numbers make a neighbour no rougher.
const NUMBER_MAX: u32 = 1000;

//! Learns a layer's model from samples of its diamonds: for the sender alone.
//!
//! Least squares, three times over, each on what the one before left: the weights of old points; those of
//! what was missing at earlier new points; and the activity, which is to be the mean magnitude of a
//! difference. Every sample is weighed by how rough its neighbourhood is, since a difference twice as
//! large costs one bit more wherever it occurs. Numbers are counted by class along the way.
//!
//! Level by level: a sampled diamond's ancestors are coded first, with what has been learnt of their
//! levels, so a level is learnt from the very heights that a receiver will have. (Rounded source heights
//! are not like them: where steps are large, most points are fictitious and lie on smooth ground. Learning
//! from those cost a third more on hills at 16 m.) All sums run in the order of the diamonds, so the same
//! samples give the same model.

#![allow(
    clippy::cast_possible_truncation,
    reason = "weights are clamped to 16 bits; heights of a block are below 2^24"
)]

use super::coding::{Coding, Place, Rule};
use super::corrections::Parts;
use super::model::{
    CAUSAL_BITS, Counts, Kernel, Model, PAIRS, REFINER_PASSES, Refiner, SPREAD_PARTS, TILT_PARTS, Tables,
};
use super::rows::Ground;
use super::walk::{Known, walk_new, walk_old, way};
use super::{Pass, Rounder};
use crate::NODATA;
use crate::bintree::Forest;
use crate::diamond::{Block, Diamond};
use crate::rans::Context;
use std::collections::{BTreeMap, BTreeSet};

/// The model that suits the sampled diamonds `of` (of the finest levels, usually) and their ancestors; where
/// these say little it stays near the default. `coding` gives the rule and the steps; `source` the heights
/// of a diamond's whole block.
///
/// Takes some five microseconds for each new point of the diamonds and their ancestors, of which there are
/// up to four a level and sample; and the memory of two levels of them.
///
/// # Errors
/// When `source` does.
pub fn train<E>(
    forest: &Forest,
    coding: &Coding,
    of: &[Diamond],
    mut source: impl FnMut(Diamond) -> Result<Block, E>,
) -> Result<Model, E> {
    let levels = forest.levels();
    let mut kernels = vec![[Kernel::default(); 2]; forest.lattice_levels() as usize];
    let mut refiners = vec![[Refiner::default(); REFINER_PASSES]; levels as usize];
    let mut counts = Counts::default();
    let mut before: BTreeMap<Diamond, Block> = BTreeMap::new();
    for (level, diamonds) in (0..levels).zip(with_ancestors(forest, of)) {
        let mut here = Vec::with_capacity(diamonds.len());
        for d in diamonds {
            let mut block = Block::empty(forest, level);
            for parent in forest.parents(d) {
                block.inherit(forest, d, parent, &before[&parent]);
            }
            here.push((d, block, source(d)?));
        }
        before.clear();
        if level > 0 {
            refiners[level as usize] = learn_refiners(forest, coding, level, &here);
        }
        let learnt = coding.clone().with_model(Model::of_weights(kernels.clone(), refiners.clone()));
        for (d, block, source) in &mut here {
            let mut pass = Rounder { source: source.heights(), counts: Some(&mut counts) };
            // A sender's heights never fail.
            let _ = walk_old(forest, &learnt, level, &forest.local(*d), block, true, &mut pass);
        }
        if !forest.adds_points(level) {
            before.extend(here.into_iter().map(|(d, block, _)| (d, block)));
            continue;
        }
        let kernels_here = learn(forest, coding, level, &here);
        kernels[level as usize] = kernels_here;
        let learnt = coding.clone().with_model(Model::of_weights(kernels.clone(), refiners.clone()));
        for (d, mut block, source) in here {
            let mut pass = Rounder { source: source.heights(), counts: Some(&mut counts) };
            let _ = walk_new(&learnt, level, &forest.local(d), &mut block, Known::Sent, &mut pass);
            before.insert(d, block);
        }
    }
    Ok(counts.model(kernels, refiners))
}

/// Diamonds with all their ancestors, by level.
fn with_ancestors(forest: &Forest, of: &[Diamond]) -> Vec<BTreeSet<Diamond>> {
    let mut levels = vec![BTreeSet::new(); forest.levels() as usize];
    for d in of {
        levels[d.level() as usize].insert(*d);
    }
    for level in (1..levels.len()).rev() {
        let parents: Vec<Diamond> = levels[level].iter().flat_map(|d| forest.parents(*d)).collect();
        levels[level - 1].extend(parents);
    }
    levels
}

/// The refiners of a level from its sampled diamonds: their blocks, before any correction, and sources.
fn learn_refiners(
    forest: &Forest,
    coding: &Coding,
    level: u32,
    diamonds: &[(Diamond, Block, Block)],
) -> [Refiner; REFINER_PASSES] {
    let mut refiners = [Refiner::default(); REFINER_PASSES];
    // The places first, then, twice, how far off they are: the second time weighed by what the first one found.
    for round in 0..3 {
        let mut fits: [_; REFINER_PASSES] = std::array::from_fn(|_| (Fit::new(), Fit::new()));
        for (d, block, source) in diamonds {
            let mut pass = Corrector { source: source.heights(), refiners, fits: &mut fits };
            let mut block = block.clone();
            let _ = walk_old(forest, coding, level, &forest.local(*d), &mut block, true, &mut pass);
        }
        for (refiner, (tilt, spread)) in refiners.iter_mut().zip(fits) {
            if round == 0 {
                let prior = refiner.tilt().map(f64::from);
                refiner.tilt = tilt.solve(&prior).map(|w| fixed(w, 4096.0));
            } else {
                let prior = refiner.spread().map(f64::from);
                refiner.spread = spread.solve(&prior).map(|w| fixed(w, 4096.0));
            }
        }
    }
    refiners
}

/// Corrects as a sender does, and gathers what each correction could be expected from.
struct Corrector<'a> {
    source: &'a [i32],
    refiners: [Refiner; REFINER_PASSES],
    /// By pass: the places, and how far off they are.
    fits: &'a mut [(Fit<TILT_PARTS>, Fit<SPREAD_PARTS>); REFINER_PASSES],
}

impl Pass for Corrector<'_> {
    const LEARNS: bool = true;

    fn valid(&mut self, _: &mut Context, slot: usize) -> bool {
        self.source[slot] != NODATA
    }
    fn receive(&mut self, _: &Tables, _: &[u8], _: &mut [i32]) {}
    fn learn(&mut self, pass: usize, slot: usize, here: i32, step: i32, parts: &Parts) {
        let step = f64::from(step);
        let own = f64::from(self.source[slot] - here) / step;
        let places = parts.tilt.map(|d| f64::from(d) / step);
        let [a, b, c, d] = parts.spread.map(|d| f64::from(d) / step);
        let ranges = [a, b, c, d, 1.0];
        let sum = |weights: &[f32], parts: &[f64]| {
            weights.iter().zip(parts).map(|(w, p)| f64::from(*w) * p).sum::<f64>()
        };
        // No surer than the step before let it be.
        let expected = sum(&self.refiners[pass].spread(), &ranges).max(0.3);
        let missing = (own - sum(&self.refiners[pass].tilt(), &places)).abs();
        let (tilt, spread) = &mut self.fits[pass];
        tilt.add(&places, own, expected.powi(-2));
        spread.add(&ranges, missing, expected.powi(-2));
    }
    fn number(&mut self, _: i32, slot: usize, wanted: impl Fn(i32) -> i32) -> i32 {
        wanted(self.source[slot])
    }
    fn send(&mut self, _: &Tables, _: &[u8], _: &[i32]) {}
    fn new_points(&mut self) -> bool {
        false
    }
    fn was_quiet(&mut self, _: bool) {}
}

/// The kernels of a level from its sampled diamonds: their blocks, before the new points, and sources.
fn learn(forest: &Forest, coding: &Coding, level: u32, diamonds: &[(Diamond, Block, Block)]) -> [Kernel; 2] {
    std::array::from_fn(|w| {
        let here = diamonds.iter().filter(|(d, ..)| way(&forest.local(*d)) == w);
        let fields: Vec<Field> =
            here.map(|(d, block, source)| Field::new(forest, coding, level, *d, block, source)).collect();
        let mut kernel = Kernel::default();
        if coding.rule() == Rule::Smooth {
            learn_pairs(&fields, &mut kernel);
            learn_causal(&fields, &mut kernel);
        }
        learn_activity(&fields, coding.rule(), &mut kernel);
        kernel
    })
}

/// A sample's cells as the weights see them.
struct Field<'a> {
    n: usize,
    upper: bool,
    step: f64,
    ground: Ground,
    old: &'a [i32],
    new: &'a [i32],
}

/// One cell: the mean of the nearest four, the pairs, the parts of the activity, and the source's height,
/// heights less the base.
struct Cell {
    mean: f64,
    pairs: [f64; PAIRS],
    rough: [f64; 3],
    height: f64,
    /// What the four corners lie on: the two ends of the hypotenuse first.
    midpoint: f64,
}

impl<'a> Field<'a> {
    fn new(
        forest: &Forest,
        coding: &Coding,
        level: u32,
        d: Diamond,
        block: &'a Block,
        source: &'a Block,
    ) -> Self {
        let (n, upper) = (forest.segments(), forest.local(d).upper);
        let old = block.parts().0;
        let step = f64::from(coding.step(coding.exponent(level, Place::Off)));
        Self { n, upper, step, ground: Ground::new(old, n, upper), old, new: source.parts().1 }
    }

    /// The cell at (u, v), if it and its corners have heights.
    fn cell(&self, u: usize, v: usize) -> Option<Cell> {
        let at = v * (self.n + 1) + u;
        let corners = [at, at + 1, at + self.n + 2, at + self.n + 1];
        let height = self.new[v * self.n + u];
        if height == NODATA || (!self.upper && u <= v) || corners.iter().any(|c| self.old[*c] == NODATA) {
            return None;
        }
        let (mean, pairs, rough) = self.ground.parts(u, v);
        let [a, b, c, d] = corners.map(|c| f64::from(self.old[c] - self.ground.base));
        let midpoint = if (u + v).is_multiple_of(2) { (a + c) / 2.0 } else { (b + d) / 2.0 };
        Some(Cell {
            mean: f64::from(mean),
            pairs: pairs.map(f64::from),
            rough: rough.map(f64::from),
            height: f64::from(height - self.ground.base),
            midpoint,
        })
    }

    /// Calls `each` with every such cell, row by row.
    fn cells(&self, mut each: impl FnMut(usize, usize, Cell)) {
        for v in 0..self.n {
            for u in 0..self.n {
                if let Some(cell) = self.cell(u, v) {
                    each(u, v, cell);
                }
            }
        }
    }

    /// What a difference at the cell is expected to be, in quanta, by a kernel's activity, and never less
    /// than a part of a step.
    fn expected(&self, kernel: &Kernel, cell: &Cell) -> f64 {
        let [twist, bend, spread, below, constant] = kernel.activity().map(f64::from);
        let [t, b, s] = cell.rough;
        let own = twist * t + bend * b + spread * s + constant * self.step;
        // What the row below would add, when it is as rough: four numbers of about the same magnitude.
        (own / (1.0 - 4.0 * below).max(0.25)).max(0.2 * self.step)
    }
}

fn predicted(kernel: &Kernel, cell: &Cell) -> f64 {
    cell.mean + kernel.pairs().iter().zip(cell.pairs).map(|(w, p)| f64::from(*w) * p).sum::<f64>()
}

/// Weighted least squares in N unknowns.
struct Fit<const N: usize> {
    matrix: [[f64; N]; N],
    right: [f64; N],
    count: f64,
}

impl<const N: usize> Fit<N> {
    fn new() -> Self {
        Self { matrix: [[0.0; N]; N], right: [0.0; N], count: 0.0 }
    }

    fn add(&mut self, parts: &[f64; N], value: f64, weight: f64) {
        for (i, row) in self.matrix.iter_mut().enumerate() {
            for (entry, part) in row.iter_mut().zip(parts) {
                *entry += weight * parts[i] * part;
            }
            self.right[i] += weight * parts[i] * value;
        }
        self.count += 1.0;
    }

    /// The solution, drawn towards `prior` as strongly as a hundred samples would.
    fn solve(mut self, prior: &[f64; N]) -> [f64; N] {
        const PRIOR_SAMPLES: f64 = 100.0;
        if self.count == 0.0 {
            return *prior;
        }
        for (i, prior) in prior.iter().enumerate() {
            let pull = (self.matrix[i][i] * PRIOR_SAMPLES / self.count).max(1e-12);
            self.matrix[i][i] += pull;
            self.right[i] += pull * prior;
        }
        for i in 0..N {
            let pivot = (i..N)
                .max_by(|a, b| self.matrix[*a][i].abs().total_cmp(&self.matrix[*b][i].abs()))
                .unwrap_or(i);
            self.matrix.swap(i, pivot);
            self.right.swap(i, pivot);
            for j in i + 1..N {
                let factor = self.matrix[j][i] / self.matrix[i][i];
                for k in i..N {
                    self.matrix[j][k] -= factor * self.matrix[i][k];
                }
                self.right[j] -= factor * self.right[i];
            }
        }
        let mut solution = [0.0; N];
        for i in (0..N).rev() {
            let known: f64 = (i + 1..N).map(|k| self.matrix[i][k] * solution[k]).sum();
            solution[i] = (self.right[i] - known) / self.matrix[i][i];
        }
        if solution.iter().all(|w| w.is_finite()) { solution } else { *prior }
    }
}

/// A weight as a whole number of 1/scale.
fn fixed(weight: f64, scale: f64) -> i16 {
    (weight * scale).round().clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16
}

fn learn_pairs(fields: &[Field], kernel: &mut Kernel) {
    let mut fit = Fit::new();
    for field in fields {
        field.cells(|_, _, cell| {
            let weight = field.expected(kernel, &cell).powi(-2);
            fit.add(&cell.pairs, cell.height - cell.mean, weight);
        });
    }
    let prior = kernel.pairs().map(f64::from);
    kernel.pairs = fit.solve(&prior).map(|w| fixed(w, 4096.0));
}

fn learn_causal(fields: &[Field], kernel: &mut Kernel) {
    let mut fit = Fit::new();
    for field in fields {
        let n = field.n;
        let mut missing = vec![None; n * n];
        field.cells(|u, v, cell| {
            let here = cell.height - predicted(kernel, &cell);
            missing[v * n + u] = Some(here);
            if v == 0 || u == 0 || u == n - 1 {
                return;
            }
            let at = v * n + u;
            let near = [at - n, at - n - 1, at - n + 1, at - 1].map(|i| missing[i]);
            if let [Some(s), Some(sw), Some(se), Some(w)] = near {
                fit.add(&[s, sw, se, w], here, field.expected(kernel, &cell).powi(-2));
            }
        });
    }
    let scale = f64::from(1u32 << CAUSAL_BITS);
    kernel.causal = fit.solve(&[0.0; 4]).map(|w| fixed(w, scale));
}

fn learn_activity(fields: &[Field], rule: Rule, kernel: &mut Kernel) {
    // Twice: the second time weighed by what the first one found.
    for _ in 0..2 {
        let mut fit = Fit::new();
        for field in fields {
            let n = field.n;
            let causal = kernel.causal.map(|w| f64::from(w) / f64::from(1u32 << CAUSAL_BITS));
            let mut missing = vec![None; n * n];
            let mut numbers = vec![0.0; n * n];
            field.cells(|u, v, cell| {
                let at = v * n + u;
                let guess = if rule == Rule::Midpoint { cell.midpoint } else { predicted(kernel, &cell) };
                missing[at] = Some(cell.height - guess);
                let near = |ok: bool, i: usize| if ok { missing[i].unwrap_or(0.0) } else { 0.0 };
                let (s, w) = (near(v > 0, at.wrapping_sub(n)), near(u > 0, at.wrapping_sub(1)));
                let sw = near(v > 0 && u > 0, at.wrapping_sub(n + 1));
                let se = near(v > 0 && u + 1 < n, at.wrapping_sub(n - 1));
                let rest =
                    cell.height - guess - (causal[0] * s + causal[1] * sw + causal[2] * se + causal[3] * w);
                let k = (rest / field.step).abs();
                numbers[at] = k.round();
                if v == 0 || u == 0 || u + 1 == n {
                    return;
                }
                let below = 2.0 * numbers[at - n] + numbers[at - n - 1] + numbers[at - n + 1];
                let parts = cell.rough.map(|r| r / field.step);
                let weight = (field.expected(kernel, &cell) / field.step).powi(-2);
                fit.add(&[parts[0], parts[1], parts[2], below, 1.0], k, weight);
            });
        }
        let prior = kernel.activity().map(f64::from);
        kernel.activity = fit.solve(&prior).map(|w| fixed(w, 4096.0));
    }
}

//! Weights of new points.

use super::super::coding::{Coding, Place, Rule};
use super::super::model::{CAUSAL_BITS, Kernel, PAIRS};
use super::super::rows::Ground;
use super::super::walk::way;
use super::fit::{Fit, fixed, inverse_square};
use super::likelihood::{Likelihood, MEAN_TO_SPREAD, SEEN, Seen, product};
use super::sampler::Sampler;
use crate::NODATA;
use crate::bintree::Forest;
use crate::diamond::{Block, Diamond};

const CAUSAL: usize = 4;
const ACTIVITY: usize = 5;
/// Parts of the place where a height is expected.
const PLACES: usize = PAIRS + CAUSAL;
const PARTS: usize = PLACES + ACTIVITY;

/// Kernels of a level, in both ways, from its sampled diamonds: their blocks, before the new points, and sources.
/// The first one's places are those of least squares, the second one's the likeliest. Which is cheaper depends on the
/// ground: where it is rough here and flat there, what is missing is not distributed as the likelihood takes it.
pub(super) fn learn_kernels(
    forest: &Forest,
    coding: &Coding,
    level: u32,
    diamonds: &[(Diamond, Block, Block)],
) -> Vec<[Kernel; 2]> {
    let rule = coding.rule();
    let [first, second] = [0, 1].map(|w| {
        let here = diamonds.iter().filter(|(d, ..)| way(&forest.local(*d)) == w);
        let fields: Vec<Field> =
            here.map(|(d, block, source)| Field::new(forest, coding, level, *d, block, source)).collect();
        let mut least_squares = Kernel::default();
        if rule == Rule::Smooth {
            learn_pairs(&fields, &mut least_squares);
            learn_causal(&fields, &mut least_squares);
        }
        let samples = samples(&fields, rule, &least_squares);
        learn_activity(&samples, rule, &mut least_squares);
        let mut likeliest = least_squares;
        if rule == Rule::Smooth {
            learn_places(&samples, &mut likeliest);
            learn_activity(&samples, rule, &mut likeliest);
        }
        [least_squares, likeliest]
    });
    let candidates = if rule == Rule::Smooth { 2 } else { 1 };
    first.into_iter().zip(second).map(|(a, b)| [a, b]).take(candidates).collect()
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

/// What a walk row by row has seen around a cell.
struct Around {
    /// What was missing at the cells to the south, south-west, south-east and west.
    missing: [Option<f64>; CAUSAL],
    /// The magnitudes in the row below: twice the middle one, and those beside it.
    below: f64,
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

    /// Calls `each` with every such cell that has neighbours to all of these sides, and with what was seen there.
    fn cells_around(&self, rule: Rule, kernel: &Kernel, mut each: impl FnMut(&Cell, &Around)) {
        let n = self.n;
        let mut missing = vec![None; n * n];
        let mut numbers = vec![0.0; n * n];
        let weights = causal(kernel);
        self.cells(|u, v, cell| {
            let at = v * n + u;
            let here = cell.height - guess(rule, kernel, &cell);
            missing[at] = Some(here);
            let near = |ok: bool, back: usize| if ok { missing[at - back] } else { None };
            let (s, w) = (near(v > 0, n), near(u > 0, 1));
            let (sw, se) = (near(v > 0 && u > 0, n + 1), near(v > 0 && u + 1 < n, n - 1));
            let around = [s, sw, se, w];
            let told: f64 = weights.iter().zip(around).map(|(w, m)| w * m.unwrap_or(0.0)).sum();
            numbers[at] = ((here - told) / self.step).abs().round();
            if v > 0 && u > 0 && u + 1 < n {
                let below = 2.0 * numbers[at - n] + numbers[at - n - 1] + numbers[at - n + 1];
                each(&cell, &Around { missing: around, below });
            }
        });
    }

    /// The activity at the cell, in steps, above such numbers.
    fn activity(&self, kernel: &Kernel, cell: &Cell, below: f64) -> f64 {
        let [twist, bend, spread, numbers, constant] = kernel.activity().map(f64::from);
        let [t, b, s] = cell.rough;
        (twist * t + bend * b + spread * s) / self.step + numbers * below + constant
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

fn causal(kernel: &Kernel) -> [f64; CAUSAL] {
    kernel.causal.map(|w| f64::from(w) / f64::from(1u32 << CAUSAL_BITS))
}

fn predicted(kernel: &Kernel, cell: &Cell) -> f64 {
    cell.mean + kernel.pairs().iter().zip(cell.pairs).map(|(w, p)| f64::from(*w) * p).sum::<f64>()
}

fn guess(rule: Rule, kernel: &Kernel, cell: &Cell) -> f64 {
    if rule == Rule::Midpoint { cell.midpoint } else { predicted(kernel, cell) }
}

fn learn_pairs(fields: &[Field], kernel: &mut Kernel) {
    let mut fit = Fit::new();
    for field in fields {
        field.cells(|_, _, cell| {
            let weight = inverse_square(field.expected(kernel, &cell));
            fit.add(&cell.pairs, cell.height - cell.mean, weight);
        });
    }
    let prior = kernel.pairs().map(f64::from);
    kernel.pairs = fit.solve(&prior).map(|w| fixed(w, 4096.0));
}

fn learn_causal(fields: &[Field], kernel: &mut Kernel) {
    let mut fit = Fit::new();
    for field in fields {
        field.cells_around(Rule::Smooth, kernel, |cell, around| {
            if let [Some(s), Some(sw), Some(se), Some(w)] = around.missing {
                let here = cell.height - predicted(kernel, cell);
                fit.add(&[s, sw, se, w], here, inverse_square(field.expected(kernel, cell)));
            }
        });
    }
    let scale = f64::from(1u32 << CAUSAL_BITS);
    kernel.causal = fit.solve(&[0.0; CAUSAL]).map(|w| fixed(w, scale));
}

/// A new point as the weights see it, in steps.
struct Sample {
    /// What the weights multiply.
    parts: [f64; PARTS],
    /// The height above the mean of the nearest four, or above the midpoint where that is the guess.
    height: f64,
    /// How many like it there are.
    weight: f64,
}

/// Some of all cells that have neighbours.
fn samples(fields: &[Field], rule: Rule, kernel: &Kernel) -> Vec<Sample> {
    let mut sampler = Sampler::new(SEEN);
    for field in fields {
        field.cells_around(rule, kernel, |cell, around| {
            // On flat ground nearly all numbers are zero, and none of them says much.
            let missed = (cell.height - guess(rule, kernel, cell)).abs() / field.step;
            let importance = (0.03 + missed + field.activity(kernel, cell, around.below)).min(1.0);
            sampler.offer(importance, || {
                let missing = around.missing.map(|m| m.unwrap_or(0.0));
                let parts = cell.pairs.into_iter().chain(missing).chain(cell.rough).map(|p| p / field.step);
                let from = if rule == Rule::Midpoint { cell.midpoint } else { cell.mean };
                let height = (cell.height - from) / field.step;
                let mut sample = Sample { parts: [0.0; PARTS], height, weight: 1.0 };
                let parts = parts.chain([around.below, 1.0]);
                sample.parts.iter_mut().zip(parts).for_each(|(to, part)| *to = part);
                sample
            });
        });
    }
    sampler.finish().map(|(sample, weight)| Sample { weight, ..sample }).collect()
}

fn places(kernel: &Kernel) -> [f64; PLACES] {
    let (pairs, causal) = (kernel.pairs(), causal(kernel));
    std::array::from_fn(|i| if i < PAIRS { f64::from(pairs[i]) } else { causal[i - PAIRS] })
}

/// Moves the weights of places to where the samples are likeliest.
fn learn_places(samples: &[Sample], kernel: &mut Kernel) {
    let (places, activity) = (places(kernel), kernel.activity());
    let start = std::array::from_fn(|i| {
        if i < PLACES { places[i] } else { f64::from(activity[i - PLACES]) / MEAN_TO_SPREAD }
    });
    let seen = samples.iter().map(|Sample { parts, height, weight }| Seen {
        parts: *parts,
        interval: [height - 0.5, height + 0.5],
        weight: *weight,
    });
    let weights = Likelihood { places: PLACES, possible: None, seen: seen.collect() }.likeliest(start);
    kernel.pairs = std::array::from_fn(|i| fixed(weights[i], 4096.0));
    kernel.causal = std::array::from_fn(|i| fixed(weights[PAIRS + i], f64::from(1u32 << CAUSAL_BITS)));
}

/// The activity is to be the mean magnitude of what is missing, in steps. (Those of whole numbers made stores of some
/// ground 3 % smaller, and of others, where next to no number is not zero, up to a quarter larger; the scale of the
/// likeliest distribution tells too few classes apart.) All levels have their tables in common, so it is the same for all.
fn learn_activity(samples: &[Sample], rule: Rule, kernel: &mut Kernel) {
    let places = places(kernel);
    // Each time weighed by what the one before found: magnitudes of mean a vary by about a (1 + a).
    for _ in 0..4 {
        let mut fit = Fit::new();
        let known = kernel.activity().map(f64::from);
        for Sample { parts, height, weight } in samples {
            let told = if rule == Rule::Midpoint { 0.0 } else { product(&places, &parts[..PLACES]) };
            let rough: [f64; ACTIVITY] = std::array::from_fn(|i| parts[PLACES + i]);
            let mean = product(&known, &rough).max(0.05);
            fit.add(&rough, (height - told).abs(), weight / (mean * (1.0 + mean)));
        }
        kernel.activity = fit.solve(&known).map(|w| fixed(w, 4096.0));
    }
}

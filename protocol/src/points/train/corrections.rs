//! Weights of corrections.

use super::super::Pass;
use super::super::coding::Coding;
use super::super::corrections::Parts;
use super::super::model::{REFINER_PASSES, Refiner, SPREAD_PARTS, TILT_PARTS};
use super::super::tables::Tables;
use super::super::walk::walk_old;
use super::fit::{Fit, fixed, inverse_square};
use super::likelihood::{Likelihood, MEAN_TO_SPREAD, SEEN, Seen, product};
use super::sampler::Sampler;
use crate::NODATA;
use crate::bintree::Forest;
use crate::diamond::{Block, Diamond};
use crate::rans::Context;

const PARTS: usize = TILT_PARTS + SPREAD_PARTS;

/// The refiners of a level from its sampled diamonds: their blocks, before any correction, and sources.
pub(super) fn learn_refiners(
    forest: &Forest,
    coding: &Coding,
    level: u32,
    diamonds: &[(Diamond, Block, Block)],
) -> [Refiner; REFINER_PASSES] {
    // The places first; then how far off they are, weighed by what was thought of it; then both together.
    let mut tilts: [_; REFINER_PASSES] = std::array::from_fn(|_| Fit::new());
    let known = Refiner::default();
    let (tilt, spread) = (known.tilt().map(f64::from), known.spread().map(f64::from));
    correct(forest, coding, level, diamonds, |correction| {
        let weight = inverse_square(correction.expected(&spread));
        tilts[correction.pass].add(&correction.tilt, correction.own, weight);
    });
    let tilts = tilts.map(|fit| fit.solve(&tilt));
    let mut samplers: [_; REFINER_PASSES] = std::array::from_fn(|_| Sampler::new(SEEN));
    correct(forest, coding, level, diamonds, |correction| {
        // Where a correction can hardly be another one, it says little.
        let away = product(&tilts[correction.pass], &correction.tilt).abs();
        let importance = (2.0 * (away + product(&spread, &correction.spread))).clamp(0.03, 1.0);
        samplers[correction.pass].offer(importance, || correction.clone());
    });
    let mut learnt = tilts.into_iter().zip(samplers).map(|(tilt, sampler)| {
        let sample: Vec<(Correction, f64)> = sampler.finish().collect();
        let mut fit = Fit::new();
        for (correction, weight) in &sample {
            let missing = (correction.own - product(&tilt, &correction.tilt)).abs();
            fit.add(&correction.spread, missing, weight * inverse_square(correction.expected(&spread)));
        }
        let start = join(tilt, fit.solve(&spread).map(|w| w / MEAN_TO_SPREAD));
        let seen = sample.into_iter().map(|(correction, weight)| correction.seen(weight)).collect();
        let weights = Likelihood { places: TILT_PARTS, possible: Some([-1.5, 1.5]), seen }.likeliest(start);
        Refiner {
            tilt: std::array::from_fn(|i| fixed(weights[i], 4096.0)),
            spread: std::array::from_fn(|i| fixed(weights[TILT_PARTS + i] * MEAN_TO_SPREAD, 4096.0)),
        }
    });
    std::array::from_fn(|_| learnt.next().unwrap_or_default())
}

/// Corrects the diamonds as a sender does, and calls `each` with every correction.
fn correct(
    forest: &Forest,
    coding: &Coding,
    level: u32,
    diamonds: &[(Diamond, Block, Block)],
    mut each: impl FnMut(&Correction),
) {
    for (d, block, source) in diamonds {
        let mut pass = Corrector { source: source.heights(), each: &mut each };
        // A sender's heights never fail.
        let _ = walk_old(forest, coding, level, &forest.local(*d), &mut block.clone(), true, &mut pass);
    }
}

/// A correction to be made, and what it could be expected from; all in steps.
#[derive(Clone)]
struct Correction {
    pass: usize,
    /// The distance to the source's height.
    own: f64,
    tilt: [f64; TILT_PARTS],
    spread: [f64; SPREAD_PARTS],
}

impl Correction {
    /// How far off the place may be: no surer than the step before let it be.
    fn expected(&self, spread: &[f64; SPREAD_PARTS]) -> f64 {
        product(spread, &self.spread).max(0.3)
    }

    /// The number sent, which says where in the interval before the source's height lies.
    fn seen(&self, weight: f64) -> Seen<PARTS> {
        let number = self.own.round().clamp(-1.0, 1.0);
        Seen { parts: join(self.tilt, self.spread), interval: [number - 0.5, number + 0.5], weight }
    }
}

fn join(tilt: [f64; TILT_PARTS], spread: [f64; SPREAD_PARTS]) -> [f64; PARTS] {
    std::array::from_fn(|i| if i < TILT_PARTS { tilt[i] } else { spread[i - TILT_PARTS] })
}

struct Corrector<'a, F> {
    source: &'a [i32],
    each: F,
}

impl<F: FnMut(&Correction)> Pass for Corrector<'_, F> {
    const LEARNS: bool = true;

    fn valid(&mut self, _: &mut Context, slot: usize) -> bool {
        self.source[slot] != NODATA
    }
    fn receive(&mut self, _: &Tables, _: &[u8], _: &mut [i32]) {}
    fn learn(&mut self, pass: usize, slot: usize, here: i32, step: i32, parts: &Parts) {
        let in_steps = |quanta: f32| f64::from(quanta) / f64::from(step);
        let [a, b, c, d] = parts.spread.map(in_steps);
        (self.each)(&Correction {
            pass,
            own: f64::from(self.source[slot] - here) / f64::from(step),
            tilt: parts.tilt.map(in_steps),
            spread: [a, b, c, d, 1.0],
        });
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

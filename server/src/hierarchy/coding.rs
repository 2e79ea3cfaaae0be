//! How the heights of the layer are coded: the steps of its levels, and the bytes of a diamond.
//!
//! All that chooses the `points` coding of a layer stands here, and the one call of its encoder.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "lattice coordinates are below 2^28, and the fine step is checked against its limit"
)]

use super::journal::Coded;
use super::levels::blob_order;
use super::plan::Plan;
use super::transcribe::Stats;
use super::{Build, BuildError};
use crate::canvas::Canvas;
use crate::store::{Key, Kind as BlobKind};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::points::{self, Coding, Rule, STEP_MAX};
use std::io;

/// 2E+1 quanta for the whole number of quanta E that keeps every height within the asked error.
pub(super) fn fine_step(max_error: f64, stats: &Stats) -> Result<u32, BuildError> {
    let room = ((max_error - stats.rounding) / stats.quantum * (1.0 + 1e-12)).floor().max(0.0);
    let limit = f64::from(STEP_MAX / 2 - 1);
    if max_error.is_finite() && max_error >= 0.0 && room <= limit {
        return Ok(2 * room as u32 + 1);
    }
    Err(BuildError::MaxError { asked: max_error, limit: limit * stats.quantum, quantum: stats.quantum })
}

/// Diamonds of the finest level from which the model is learnt, with all their ancestors. More than 24 gain
/// less than 0.1 %; with 8 a store is 1 % larger, where steps are large 7 %.
const MODEL_SAMPLES: usize = 24;

/// How a layer without points would be coded: nothing is measured or learnt for it.
pub(super) fn without_points(plan: &Plan, rule: Rule, fine_step: u32) -> Result<(Plan, Coding), BuildError> {
    let plan = plan.with_precision(0);
    let exponents = vec![0; plan.forest.lattice_levels() as usize + 1];
    Ok((plan, Coding::new(rule, fine_step, exponents)?))
}

/// How the layer is coded: its steps, and a model learnt from a spread of its diamonds; and the plan with as
/// many levels past the finest lattice as these steps ask for.
pub(super) fn coding(
    plan: &Plan,
    canvas: &Canvas,
    rule: Rule,
    fine_step: u32,
) -> Result<(Plan, Coding), BuildError> {
    let work = |error: io::Error| BuildError::Work { path: canvas.folder().to_owned(), error };
    let (exponents, precision) = exponents(plan, canvas, fine_step).map_err(work)?;
    let plan = &plan.with_precision(precision);
    let coding = Coding::new(rule, fine_step, exponents)?;
    let forest = &plan.forest;
    // Coarse levels are all read from one window, finer ones each from its own.
    let chunk_level = plan.chunks.level();
    let coarse = canvas.read(plan.spacing_log2(chunk_level), [0, 0], forest.size()).map_err(work)?;
    let source = |d: Diamond| -> io::Result<Block> {
        let mut block = Block::empty(forest, d.level());
        let local = forest.local(d);
        if d.level() < chunk_level {
            block.fill(&local, |x, y| coarse.at(x, y));
        } else {
            let [low, high] = forest.bounds(d);
            let window = canvas.read(plan.spacing_log2(d.level() + 1), low, high)?;
            block.fill(&local, |x, y| window.at(x, y));
        }
        Ok(block)
    };
    let finest: Vec<Diamond> = forest.diamonds(forest.levels() - 1).collect();
    let mut samples = Vec::with_capacity(MODEL_SAMPLES);
    // Four candidates a sample: those with the most heights are taken, since nodata teaches nothing.
    for group in spread(&finest, 4 * MODEL_SAMPLES).chunks(4) {
        let mut fullest = None;
        for d in group {
            let valid = source(*d).map_err(work)?.heights().iter().filter(|h| **h != NODATA).count();
            if valid > fullest.map_or(0, |(most, _)| most) {
                fullest = Some((valid, *d));
            }
        }
        samples.extend(fullest.map(|(_, d)| d));
    }
    let model = points::train(forest, &coding, &samples, source).map_err(work)?;
    Ok((*plan, coding.with_model(model)))
}

/// Up to `count` of a list, evenly spread over it.
fn spread(list: &[Diamond], count: usize) -> Vec<Diamond> {
    let count = count.min(list.len());
    (0..count).map(|i| list[i * list.len() / count]).collect()
}

/// How many times what the next level typically adds a level's step may be. A level is used at errors about as large
/// as the largest that it adds, which is several times that. Larger steps cost more in the end and gain little.
const STEP_TO_DETAIL: f64 = 4.0;
/// The same for the step of the finest lattice. It may be larger: views at any finer error start from it, where
/// the next lattice would have been used at one error alone. Alps at 1 m take 2.3 % more with 4 and 3.9 % with 5,
/// and a view 254 and 151 kB.
const LAST_STEP_TO_DETAIL: f64 = 5.0;

/// A step for each level, so that views do not pay for a precision that they cannot show, and how many levels
/// past the finest lattice make up for it.
///
/// A level's step follows what the level after it would add. Past the lattice nothing is added; the first step
/// there follows what would be, if the source went on as it did.
fn exponents(plan: &Plan, canvas: &Canvas, fine_step: u32) -> io::Result<(Vec<u8>, u8)> {
    let lattice = plan.forest.lattice_levels() as usize;
    let mut details: Vec<f64> =
        (0..lattice as u32).map(|level| detail(plan, canvas, level)).collect::<io::Result<_>>()?;
    details.push(next_detail(&details));
    let mut exponents = vec![0u8; lattice + 1];
    // exponents[i + 1] is level i's.
    for i in (0..=lattice).rev() {
        let times = if i == lattice { LAST_STEP_TO_DETAIL } else { STEP_TO_DETAIL };
        let mut exponent = exponents.get(i + 1).copied().unwrap_or(0);
        while (f64::from(fine_step) * 3f64.powi(i32::from(exponent) + 1)) <= times * details[i]
            && fine_step.saturating_mul(3u32.pow(u32::from(exponent) + 1)) < STEP_MAX / 4
        {
            exponent += 1;
        }
        exponents[i] = exponent;
    }
    // The levels past the lattice share what is left.
    let left = exponents[lattice];
    let precision = left.min(plan.precision_max());
    exponents.extend((0..precision).rev().map(|rest| left * rest / precision));
    Ok((exponents, precision))
}

/// What the level after the last would add: the trend of the last three, which are of both parities.
fn next_detail(details: &[f64]) -> f64 {
    let ratio = match details {
        [.., first, _, last] if *first > 0.0 => (last / first).sqrt().clamp(0.25, 1.0),
        _ => 1.0,
    };
    details.last().map_or(0.0, |last| last * ratio)
}

/// What a level's new points typically differ from the mean of the four around them, in quanta, over a spread of
/// windows: the mean square root, squared, in units in which it is the root mean square of a Laplacian field.
///
/// Not the root mean square itself: a few cliffs would make steps coarse on all the flat ground around them.
/// (Cairns, shelf and slope, at 1 m then took a quarter more than with steps that are fine at once.)
fn detail(plan: &Plan, canvas: &Canvas, level: u32) -> io::Result<f64> {
    let forest = &plan.forest;
    let plane = plan.spacing_log2(level + 1).min(plan.spacing_log2(plan.chunks.level()));
    let step = 1u32 << plan.spacing_log2(level + 1);
    let [w, h] = forest.size();
    let side = (256 * step).min(w).min(h);
    let (mut sum, mut count) = (0.0, 0u64);
    for j in 0..4u64 {
        for i in 0..4u64 {
            let at = |n: u32, i: u64| ((u64::from(n - side) * i / 3) as u32) & !(2 * step - 1);
            let (x0, y0) = (at(w, i), at(h, j));
            let window = canvas.read(plane, [x0, y0], [x0 + side, y0 + side])?;
            // New points of an even level have odd coordinates in steps, with the corners around them; of
            // an odd level one odd and one even, with their neighbours along both axes.
            for y in (1..side / step).map(|y| y * step) {
                for x in (1..side / step).map(|x| x * step) {
                    let odd = (x / step % 2, y / step % 2);
                    let near = if level.is_multiple_of(2) {
                        if odd != (1, 1) {
                            continue;
                        }
                        [
                            (x - step, y - step),
                            (x + step, y - step),
                            (x + step, y + step),
                            (x - step, y + step),
                        ]
                    } else {
                        if odd.0 == odd.1 {
                            continue;
                        }
                        [(x - step, y), (x + step, y), (x, y - step), (x, y + step)]
                    };
                    let at = |(x, y): (u32, u32)| window.at(x0 + x, y0 + y);
                    let (here, around) = (at((x, y)), near.map(at));
                    if here != NODATA && !around.contains(&NODATA) {
                        let mean = around.iter().map(|h| f64::from(*h)).sum::<f64>() / 4.0;
                        sum += (f64::from(here) - mean).abs().sqrt();
                        count += 1;
                    }
                }
            }
        }
    }
    // Of a Laplacian field of scale b the mean square root is sqrt(pi b) / 2, and the root mean square sqrt(2) b.
    let typical = sum / count.max(1) as f64;
    Ok(typical * typical * 4.0 * std::f64::consts::SQRT_2 / std::f64::consts::PI)
}

impl Build<'_> {
    /// Codes a diamond whose old points are in `block`, and keeps what it took.
    pub(super) fn code(&self, d: Diamond, block: &mut Block, source: &Block) -> Result<Coded, BuildError> {
        let payload = points::encode(&self.plan.forest, &self.coding, d, block, source);
        let mut spot = None;
        if !payload.is_empty() {
            let [a, b] = d.centre();
            let key = Key { layer: self.number, kind: BlobKind::Points, a, b };
            spot = Some(self.work.writer.put(key, blob_order(d), &payload)?);
        }
        Ok(Coded::new(d, block, source, spot))
    }
}

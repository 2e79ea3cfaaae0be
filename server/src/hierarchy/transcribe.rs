//! The source, read once, becomes whole numbers of quanta on the canvas.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "coordinates of the source are 32-bit, and heights are checked against the range of quanta before they become integers"
)]

use super::plan::Plan;
use super::{BuildError, Options};
use crate::canvas::Canvas;
use crate::ingest::Source;
use crate::progress::Progress;
use diamantina_protocol::NODATA;
use diamantina_protocol::points::SOURCE_MAX;
use rayon::prelude::*;
use std::io;
use std::path::Path;

/// What the transcription found.
#[derive(Debug, Clone, Copy)]
pub(super) struct Stats {
    /// Metres of a quantum.
    pub(super) quantum: f64,
    pub(super) low: i32,
    pub(super) high: i32,
    pub(super) valid: u64,
    /// The largest distance between a source height and its quantum, in metres.
    pub(super) rounding: f64,
}

/// Heights are below this, in metres: a client refuses what is more.
pub(super) const HEIGHT_METRES_MAX: f64 = 1e12;

/// The greatest power of ten at or below `value`.
fn power_of_ten(value: f64) -> f64 {
    let exponent = value.log10().floor() as i32;
    // By division where it is exact: 0.01 is 1/100, not 10^-2 in steps.
    if exponent < 0 { 1.0 / 10f64.powi(-exponent) } else { 10f64.powi(exponent) }
}

/// A quantum for heights that are not whole numbers: their own decimal step if they have one, else a
/// power of ten of about 1/65536 of the range; coarser where the asked error allows it.
fn find_quantum(source: &Source, options: &Options) -> Result<f64, BuildError> {
    let grid = source.grid();
    let scale = grid.height_scale.abs();
    if let Some(quantum) = options.quantum {
        return if quantum > 0.0 && quantum < HEIGHT_METRES_MAX {
            Ok(quantum)
        } else {
            Err(BuildError::Quantum(quantum))
        };
    }
    if grid.integer {
        return Ok(scale);
    }
    // Up to 64 windows spread over the source say enough; an outlier beyond them is dealt with later.
    let mut heights = Vec::new();
    let mut window = Vec::new();
    let (side, along) = (128.min(grid.width).min(grid.height), 8);
    for j in 0..along {
        for i in 0..along {
            let at = |n: u32, i: u32| (u64::from(n - side) * u64::from(i) / u64::from(along - 1)) as u32;
            source.read(at(grid.width, i), at(grid.height, j), side, side, &mut window)?;
            heights.extend(window.iter().filter(|h| h.is_finite()).map(|h| h * grid.height_scale));
        }
    }
    let (low, high) = heights.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    let largest = low.abs().max(high.abs());
    if heights.is_empty() || largest == 0.0 || low >= high {
        return Ok(0.01);
    }
    // Heights read from 32-bit floats are within half a unit in their last place of a decimal.
    let slack = |h: f64| h.abs() * 1e-6;
    let has_step = |step: f64| {
        heights.iter().all(|h| (h - (h / step).round() * step).abs() <= slack(*h).min(step / 8.0))
    };
    let decimal = [1.0, 0.1, 0.01, 0.001].into_iter().find(|step| has_step(*step));
    let fine = power_of_ten((high - low) / 65536.0).min(0.01);
    let asked =
        if options.max_error > 0.0 { power_of_ten(options.max_error / 50.0).min(high - low) } else { 0.0 };
    let quantum = match decimal {
        Some(step) if options.max_error == 0.0 || step <= options.max_error => step,
        _ => fine.max(asked),
    };
    let least = power_of_ten(largest / f64::from(SOURCE_MAX)) * 10.0;
    if least > quantum && (largest >= HEIGHT_METRES_MAX || is_outlier(&mut heights, least)) {
        let value = if low.abs() > high.abs() { low } else { high };
        return Err(BuildError::Range { value, quantum });
    }
    Ok(quantum.max(least))
}

/// Whether a quantum that is due to the largest height is too coarse for the heights without their extremes:
/// then these are no heights, but nodata that nobody declared.
fn is_outlier(heights: &mut Vec<f64>, quantum: f64) -> bool {
    heights.sort_by(f64::total_cmp);
    heights.dedup();
    let aside = (heights.len() / 100).max(1);
    let rest = heights.get(aside..heights.len().saturating_sub(aside)).unwrap_or_default();
    rest.first().zip(rest.last()).is_some_and(|(low, high)| high - low < 256.0 * quantum)
}

/// Reads the whole source into a canvas of quanta.
pub(super) fn transcribe(
    source: &Source,
    plan: &Plan,
    options: &Options,
    folder: &Path,
    progress: &Progress,
) -> Result<(Canvas, Stats), BuildError> {
    let grid = source.grid();
    let quantum = find_quantum(source, options)?;
    let work = |error: io::Error| BuildError::Work { path: folder.to_owned(), error };
    let coarsest = plan.spacing_log2(plan.chunks.level());
    let canvas = Canvas::create(folder, grid.width, grid.height, coarsest).map_err(work)?;
    let rows = (plan.band_bytes / 16 / u64::from(grid.width)).clamp(1, 256) as u32;
    progress.stage("read", u64::from(grid.width) * u64::from(grid.height));
    let bands: Vec<u32> = (0..grid.height).step_by(rows as usize).collect();
    let per_value = grid.height_scale / quantum;
    let stats = bands
        .into_par_iter()
        .map(|y0| {
            let count = rows.min(grid.height - y0);
            let mut values = Vec::new();
            source.read(0, y0, grid.width, count, &mut values)?;
            let mut stats = Stats { quantum, low: i32::MAX, high: i32::MIN, valid: 0, rounding: 0.0 };
            let mut heights = Vec::with_capacity(values.len());
            for value in &values {
                if value.is_nan() {
                    heights.push(NODATA);
                    continue;
                }
                let exact = value * per_value;
                let rounded = exact.round();
                if rounded.abs() > f64::from(SOURCE_MAX) {
                    return Err(BuildError::Range { value: value * grid.height_scale, quantum });
                }
                let height = rounded as i32;
                stats.low = stats.low.min(height);
                stats.high = stats.high.max(height);
                stats.valid += 1;
                stats.rounding = stats.rounding.max((exact - rounded).abs() * quantum);
                heights.push(height);
            }
            canvas.write_rows(y0, &heights).map_err(work)?;
            progress.advance(values.len() as u64);
            Ok(stats)
        })
        .try_reduce(
            || Stats { quantum, low: i32::MAX, high: i32::MIN, valid: 0, rounding: 0.0 },
            |a, b| {
                Ok(Stats {
                    quantum,
                    low: a.low.min(b.low),
                    high: a.high.max(b.high),
                    valid: a.valid + b.valid,
                    rounding: a.rounding.max(b.rounding),
                })
            },
        )?;
    if stats.valid == 0 {
        return Err(BuildError::AllNodata(u64::from(grid.width) * u64::from(grid.height)));
    }
    Ok((canvas, stats))
}

//! The source, read once, becomes whole numbers of quanta on the canvas.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "coordinates of the source are 32-bit, and heights are checked against the range of quanta before they become integers"
)]

use super::journal::{Band, Record};
use super::layers::Part;
use super::{BuildError, Options, Work};
use crate::canvas::Canvas;
use crate::ingest::{Grid, Source};
use diamantina_protocol::NODATA;
use diamantina_protocol::points::SOURCE_MAX;
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, Ordering};

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
pub(super) fn find_quantum(source: &Source, options: &Options) -> Result<f64, BuildError> {
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

/// Reads the source of a layer into its canvas, but for the rows of `done`, and says what all rows hold.
pub(super) fn transcribe(
    part: &Part<'_>,
    canvas: &Canvas,
    done: &[Band],
    work: &Work<'_>,
) -> Result<Stats, BuildError> {
    let (source, quantum) = (part.layer.source, part.quantum);
    let grid = source.grid();
    let rows = (part.plan.band_bytes / 16 / u64::from(grid.width)).clamp(1, 256) as u32;
    let before: u64 = done.iter().map(|b| u64::from(b.rows)).sum();
    let width = u64::from(grid.width);
    work.progress.stage("read", "samples", width * u64::from(grid.height), width * before);
    let failed = AtomicBool::new(false);
    let read = missing(grid.height, done, rows)
        .into_par_iter()
        .map(|(y0, count)| {
            // Whoever fails stops the others at their next band.
            if work.progress.is_stopping() || failed.load(Ordering::Relaxed) {
                return Ok(None);
            }
            let band = read_band(source, canvas, quantum, y0, count, work)
                .inspect_err(|_| failed.store(true, Ordering::Relaxed))?;
            if work.journal.note(part.number, &Record::Band(band)) {
                work.checkpoint(canvas)?;
            }
            work.progress.advance(u64::from(count) * width);
            Ok(Some(band))
        })
        .collect::<Result<Vec<_>, BuildError>>();
    let read = match read {
        Ok(read) => read,
        Err(error) => {
            // What is done may still be kept; the first failure is the one to tell.
            let _ = work.checkpoint(canvas);
            return Err(error);
        }
    };
    if read.contains(&None) {
        work.checkpoint(canvas)?;
        return Err(work.interrupted());
    }
    let mut stats = Stats { quantum, low: i32::MAX, high: i32::MIN, valid: 0, rounding: 0.0 };
    for band in done.iter().chain(read.iter().flatten()) {
        stats.low = stats.low.min(band.low);
        stats.high = stats.high.max(band.high);
        stats.valid += band.valid;
        stats.rounding = stats.rounding.max(band.rounding);
    }
    if stats.valid == 0 {
        return Err(BuildError::AllNodata(width * u64::from(grid.height)));
    }
    source.check_nodata()?;
    Ok(stats)
}

/// The rows that are not done, in bands of at most `rows`: first row and number.
fn missing(height: u32, done: &[Band], rows: u32) -> Vec<(u32, u32)> {
    let mut done: Vec<_> = done.iter().map(|b| (b.y0, b.y0.saturating_add(b.rows))).collect();
    done.push((height, height));
    done.sort_unstable();
    let (mut bands, mut next) = (Vec::new(), 0);
    for (from, to) in done {
        while next < from {
            let count = rows.min(from - next);
            bands.push((next, count));
            next += count;
        }
        next = next.max(to);
    }
    bands
}

/// Reads `count` rows from row `y0` into the canvas.
fn read_band(
    source: &Source,
    canvas: &Canvas,
    quantum: f64,
    y0: u32,
    count: u32,
    work: &Work<'_>,
) -> Result<Band, BuildError> {
    let grid = source.grid();
    let mut values = Vec::new();
    source.read(0, y0, grid.width, count, &mut values)?;
    let (heights, stats) = to_quanta(&values, grid, quantum)?;
    drop(values);
    canvas.write_rows(y0, &heights).map_err(work.failure())?;
    let Stats { low, high, valid, rounding, .. } = stats;
    Ok(Band { y0, rows: count, low, high, valid, rounding })
}

/// Source values as whole numbers of quanta, and what was found in them.
pub(super) fn to_quanta(values: &[f64], grid: &Grid, quantum: f64) -> Result<(Vec<i32>, Stats), BuildError> {
    let per_value = grid.height_scale / quantum;
    let mut stats = Stats { quantum, low: i32::MAX, high: i32::MIN, valid: 0, rounding: 0.0 };
    let mut heights = Vec::with_capacity(values.len());
    for value in values {
        if value.is_nan() {
            heights.push(NODATA);
            continue;
        }
        let exact = value * per_value;
        // Most are whole already, and to ask that is faster than to round.
        let whole = f64::from(exact as i32);
        let rounded = if whole == exact { exact } else { exact.round() };
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
    Ok((heights, stats))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_missing_is_what_no_band_has() {
        let band = |y0, rows| Band { y0, rows, low: 0, high: 0, valid: 0, rounding: 0.0 };
        assert_eq!(missing(10, &[], 4), [(0, 4), (4, 4), (8, 2)]);
        assert_eq!(missing(10, &[band(4, 2), band(0, 1)], 4), [(1, 3), (6, 4)]);
        assert_eq!(missing(10, &[band(0, 5), band(5, 5)], 4), []);
        // Bands of a run with other threads overlap, if at all, harmlessly.
        assert_eq!(missing(6, &[band(0, 4), band(2, 3)], 4), [(5, 1)]);
    }
}

//! Which slopes are still open along a ray.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::cast_possible_wrap,
    reason = "places are kept within the relief, whose sides are below 2^28; shares of 255 are below 256"
)]

use super::Optics;

/// The most windows below the horizon that are told apart; beyond, the lowest two are taken for one, which
/// shows more than there is.
const WINDOWS_MAX: usize = 16;

/// Slopes closer than this are the same: some thousand times the rounding of the arithmetic.
const SAME: f64 = 1e-11;

/// The slopes that are still open: all above the horizon, and some windows below it, from low to high.
pub(super) struct Sky<'a> {
    pub(super) horizon: f64,
    /// Above this a slope is above the horizon by more than rounding.
    pub(super) threshold: f64,
    pub(super) windows: Vec<[f64; 2]>,
    /// The highest slope of all windows.
    pub(super) ajar: f64,
    /// Whether something without height was passed since the last segment: only there may a window open. A surface
    /// without holes goes on where it was, whatever rounding says.
    pub(super) after_hole: bool,
    /// Kept to be filled again.
    pub(super) spare: Vec<[f64; 2]>,
    pub(super) optics: &'a Optics,
    pub(super) least: f64,
}

/// Above this a slope is above another by more than rounding.
pub(super) fn threshold(slope: f64) -> f64 {
    if slope.is_infinite() { slope } else { slope + SAME * (1.0 + slope.abs()) }
}

/// Below this a slope is below another by more than rounding.
pub(super) fn beneath(slope: f64) -> f64 {
    if slope.is_infinite() { slope } else { slope - 2.0 * SAME * (1.0 + slope.abs()) }
}

pub(super) fn is_above(a: f64, b: f64) -> bool {
    a > threshold(b)
}

pub(super) fn overlap([lo, hi]: [f64; 2], [least, most]: [f64; 2]) -> bool {
    is_above(hi, least) && is_above(most, lo)
}

impl<'a> Sky<'a> {
    pub(super) fn new(optics: &'a Optics) -> Self {
        let (horizon, least) = (f64::NEG_INFINITY, optics.least());
        Self {
            horizon,
            threshold: horizon,
            windows: Vec::new(),
            ajar: horizon,
            after_hole: true,
            spare: Vec::new(),
            optics,
            least,
        }
    }

    /// Whether some of the slopes between two are open.
    pub(super) fn shows(&self, slopes: [f64; 2]) -> bool {
        slopes[1] > self.threshold
            || slopes[0] < self.ajar && self.windows.iter().any(|window| overlap(slopes, *window))
    }

    /// What the errors of something count for that lies between two slopes, none of them open.
    pub(super) fn share(&self, [lo, hi]: [f64; 2]) -> f64 {
        if self.optics.angle == 0.0 {
            return 0.0;
        }
        let Optics { quantum, .. } = *self.optics;
        let mut share = self.beside(hi, self.horizon);
        // Towards a border above, the count grows as long as slopes are above h - √(h² + 1): see `beside`.
        if lo * quantum < -0.5 || self.horizon * quantum > 0.5 {
            share = share.max(self.beside(lo, self.horizon));
        }
        // Of windows only the next below and the next above count.
        if !self.windows.is_empty() {
            let above = self.windows.iter().position(|[least, _]| !is_above(hi, *least));
            let below = above.unwrap_or(self.windows.len()).checked_sub(1);
            let borders = [above.map(|i| self.windows[i][0]), below.map(|i| self.windows[i][1])];
            for border in borders.into_iter().flatten() {
                share = share.max(self.beside(lo, border)).max(self.beside(hi, border));
            }
        }
        share.min(1.0)
    }

    /// The same for one slope beside one border of what is open. A vertical error E at the distance t
    /// and the slope s is seen as E / (t (1 + s²)) and changes the slope by E / t. Of all slopes between two, one of
    /// both counts for the most: in between, the quotient has a least value, if any.
    pub(super) fn beside(&self, slope: f64, border: f64) -> f64 {
        let Optics { angle, quantum, .. } = *self.optics;
        let gap = (border - slope).abs() * quantum;
        let slope = slope * quantum;
        // Straight down, no vertical error is seen.
        if slope.is_infinite() { 1.0 } else { angle * (1.0 + slope * slope) / gap }
    }

    /// Closes the slopes below one, where no windows are open.
    pub(super) fn raise(&mut self, slope: f64) {
        if slope > self.threshold {
            self.horizon = slope;
            self.threshold = threshold(slope);
        }
    }

    /// Closes the slopes between two.
    pub(super) fn cover(&mut self, [lo, hi]: [f64; 2]) {
        if lo < self.ajar && self.windows.iter().any(|window| overlap([lo, hi], *window)) {
            // What is left of each; at most two parts.
            let mut before = std::mem::take(&mut self.spare);
            std::mem::swap(&mut before, &mut self.windows);
            for [least, most] in before.drain(..) {
                if !overlap([lo, hi], [least, most]) {
                    self.windows.push([least, most]);
                    continue;
                }
                if is_above(lo, least) {
                    self.windows.push([least, lo]);
                }
                if is_above(most, hi) {
                    self.windows.push([hi, most]);
                }
            }
            self.spare = before;
        }
        if self.after_hole && is_above(lo, self.horizon) {
            self.windows.push([self.horizon, lo]);
        }
        self.after_hole = false;
        if hi > self.horizon {
            self.horizon = hi;
            self.threshold = threshold(hi);
        }
        while self.windows.len() > WINDOWS_MAX {
            self.windows[1][0] = self.windows[0][0];
            self.windows.remove(0);
        }
        self.ajar = self.windows.last().map_or(f64::NEG_INFINITY, |[_, most]| *most);
    }
}

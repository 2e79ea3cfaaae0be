//! What a diamond's old points say of its new ones, row by row: predictions and activities.
//!
//! Everything here is a fixed sequence of 32-bit float operations, none of which may be fused or reordered,
//! on integers less a common base: every platform gets the same bits (IEEE 754), and rows are long loops
//! without branches, which compilers turn into vector instructions.
//!
//! Around the cell of a new point `*` lie sixteen old points, named by their odd distances in halves of a
//! cell. Opposite ones are added up first, since neither side of a point is like the other:
//!
//! ```text
//!   +3     c2   e    f   c1'       a + a', b + b'   the nearest four: their mean is the first guess,
//!   +1     g    b    a'  h         (a + a') - (b + b') its twist
//!                  *               c1, c2, d .. h   what the next twelve differ from the mean, weighed
//!   -1     h'   a    b'  g'
//!   -3     c1   f'   e'  c2'
//! ```
//!
//! Beyond the diamond's border, where the prediction may not look, the border's slope goes on.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    reason = "heights less their base are below 2^25 and are clamped to 2^22 before they become integers again"
)]

use super::model::{Kernel, PAIRS};
use super::tables::class;
use crate::NODATA;

/// Predictions beyond this many quanta from the base are cut off: far from any real ground, and what a
/// float can still round exactly.
const FAR: f32 = 4_000_000.0;

/// The old heights of a diamond as floats, with a margin of one point around, and no holes.
pub(super) struct Ground {
    n: usize,
    /// Rows of n+3 heights less `base`.
    heights: Vec<f32>,
    /// At each old point, rows of n+1: the second differences along both axes.
    bends: Vec<f32>,
    /// The height that all others are taken less of.
    pub base: i32,
}

/// What is known of a row of new points before the row itself.
pub(super) struct Row {
    /// Predictions from the old points, less the base.
    pub guess: Vec<f32>,
    /// Activities, in quanta.
    pub rough: Vec<f32>,
}

impl Row {
    pub(super) fn new(n: usize) -> Self {
        Self { guess: vec![0.0; n], rough: vec![0.0; n] }
    }
}

impl Ground {
    /// From the old points of a block of n segments. `upper`: whether those above the diagonal exist.
    pub(super) fn new(old: &[i32], n: usize, upper: bool) -> Self {
        let row = n + 3;
        let base = old.iter().copied().find(|h| *h != NODATA).unwrap_or(0);
        let mut ground = Self { n, heights: vec![0.0; row * row], bends: vec![0.0; (n + 1) * (n + 1)], base };
        let mut holes = false;
        for (v, from) in old.chunks_exact(n + 1).enumerate() {
            let to = &mut ground.heights[(v + 1) * row + 1..][..n + 1];
            let known = if upper { 0 } else { v };
            for (to, from) in to.iter_mut().zip(from).skip(known) {
                holes |= *from == NODATA;
                // NODATA less the base may wrap: holes are filled below.
                *to = from.wrapping_sub(base) as f32;
            }
        }
        if holes {
            ground.fill_holes(old, upper);
        }
        if !upper {
            ground.mirror();
        }
        ground.extend();
        ground.bend();
        ground
    }

    /// Gives holes the mean of their known neighbours, ring by ring.
    fn fill_holes(&mut self, old: &[i32], upper: bool) {
        let (n, row) = (self.n, self.n + 3);
        let known = |u: usize, v: usize| (upper || u >= v) && old[v * (n + 1) + u] != NODATA;
        let mut have: Vec<bool> = (0..(n + 1) * (n + 1)).map(|i| known(i % (n + 1), i / (n + 1))).collect();
        let is_hole = |have: &[bool], u: usize, v: usize| (upper || u >= v) && !have[v * (n + 1) + u];
        let mut ring: Vec<(usize, usize)> = (0..=n)
            .flat_map(|v| (if upper { 0 } else { v }..=n).map(move |u| (u, v)))
            .filter(|(u, v)| is_hole(&have, *u, *v))
            .collect();
        for &(u, v) in &ring {
            self.heights[(v + 1) * row + u + 1] = 0.0;
        }
        ring.retain(|&(u, v)| around(u, v, n).any(|(i, j)| have[j * (n + 1) + i]));
        let mut filled = Vec::new();
        while !ring.is_empty() {
            filled.clear();
            for &(u, v) in &ring {
                let (mut sum, mut count) = (0.0f32, 0.0f32);
                for (i, j) in around(u, v, n) {
                    if have[j * (n + 1) + i] {
                        sum += self.heights[(j + 1) * row + i + 1];
                        count += 1.0;
                    }
                }
                filled.push((u, v, sum / count));
            }
            for &(u, v, height) in &filled {
                self.heights[(v + 1) * row + u + 1] = height;
                have[v * (n + 1) + u] = true;
            }
            // The next ring: what lies next to this one and is still unknown.
            ring.clear();
            for &(u, v, _) in &filled {
                ring.extend(around(u, v, n).filter(|(i, j)| is_hole(&have, *i, *j)));
            }
            ring.sort_unstable();
            ring.dedup();
        }
    }

    /// Continues a lower triangle beyond its hypotenuse, turned by a half about each point of it.
    fn mirror(&mut self) {
        let row = self.n + 3;
        let at = |u: usize, v: usize| (v + 1) * row + u + 1;
        for v in 0..=self.n {
            for u in 0..v {
                let middle = (u + v) / 2;
                let on = if (u + v).is_multiple_of(2) {
                    2.0 * self.heights[at(middle, middle)]
                } else {
                    self.heights[at(middle, middle)] + self.heights[at(middle + 1, middle + 1)]
                };
                self.heights[at(u, v)] = on - self.heights[at(v, u)];
            }
        }
    }

    /// Fills the margin: the slope at the border goes on.
    fn extend(&mut self) {
        let (n, row) = (self.n, self.n + 3);
        for v in 1..=n + 1 {
            let line = &mut self.heights[v * row..(v + 1) * row];
            line[0] = 2.0 * line[1] - line[2];
            line[n + 2] = 2.0 * line[n + 1] - line[n];
        }
        for u in 0..row {
            let h = |v: usize| self.heights[v * row + u];
            let (south, north) = (2.0 * h(1) - h(2), 2.0 * h(n + 1) - h(n));
            self.heights[u] = south;
            self.heights[(n + 2) * row + u] = north;
        }
    }

    /// Second differences along both axes; at the border, those of the next point inside.
    fn bend(&mut self) {
        let (n, row) = (self.n, self.n + 3);
        for v in 0..=n {
            // A diamond has at least four segments, so there is a point inside.
            let inner = v.clamp(1, n - 1) + 1;
            let lines = [v + 1, inner - 1, inner, inner + 1].map(|v| &self.heights[v * row + 1..][..n + 1]);
            let [here, south, middle, north] = lines;
            let bends = &mut self.bends[v * (n + 1)..][..n + 1];
            for (bend, ((s, m), n)) in bends.iter_mut().zip(south.iter().zip(middle).zip(north)) {
                *bend = (s - 2.0 * m + n).abs();
            }
            let along = |w: &[f32]| (w[0] - 2.0 * w[1] + w[2]).abs();
            for (bend, line) in bends[1..n].iter_mut().zip(here.windows(3)) {
                *bend += along(line);
            }
            bends[0] += along(&here[..3]);
            bends[n] += along(&here[n - 2..]);
        }
    }

    /// The sixteen old points around each cell of row v, as rows: by distance up, then to the right.
    fn around(&self, v: usize) -> [[&[f32]; 4]; 4] {
        let (n, row) = (self.n, self.n + 3);
        std::array::from_fn(|j| std::array::from_fn(|i| &self.heights[(v + j) * row + i..][..n]))
    }

    /// Predicts row v of the new points and says how rough the ground is there.
    pub(super) fn row(&self, v: usize, kernel: &Kernel, to: &mut Row) {
        let n = self.n;
        let weights = kernel.pairs();
        let around = self.around(v);
        let guess = &mut to.guess[..n];
        for (u, guess) in guess.iter_mut().enumerate() {
            let (four, pairs) = pairs(&around, u);
            let mut sum = 0.25 * four;
            for (w, pair) in weights.iter().zip(pairs) {
                sum += w * pair;
            }
            *guess = sum;
        }
        let [w_twist, w_bend, w_spread, ..] = kernel.activity();
        let [_, [_, a, b, _], [_, d, c, _], _] = around;
        let (low, high) = (&self.bends[v * (n + 1)..][..n + 1], &self.bends[(v + 1) * (n + 1)..][..n + 1]);
        let rough = &mut to.rough[..n];
        for u in 0..n {
            let (a, b, c, d) = (a[u], b[u], c[u], d[u]);
            let twist = (a + c - b - d).abs();
            let spread = (a - c).abs() + (b - d).abs();
            let bend = low[u] + low[u + 1] + high[u] + high[u + 1];
            rough[u] = w_twist * twist + w_bend * bend + w_spread * spread;
        }
    }

    /// The parts of the prediction and of the activity at one cell, to learn weights from.
    pub(super) fn parts(&self, u: usize, v: usize) -> (f32, [f32; PAIRS], [f32; 3]) {
        let around = self.around(v);
        let (sum, pairs) = pairs(&around, u);
        let [_, [_, a, b, _], [_, d, c, _], _] = around;
        let (a, b, c, d) = (a[u], b[u], c[u], d[u]);
        let at = v * (self.n + 1) + u;
        let bend =
            self.bends[at] + self.bends[at + 1] + self.bends[at + self.n + 1] + self.bends[at + self.n + 2];
        (0.25 * sum, pairs, [(a + c - b - d).abs(), bend, (a - c).abs() + (b - d).abs()])
    }
}

/// The sum of the nearest four, and what the pairs around cell u differ from twice their mean.
#[inline(always)]
fn pairs(around: &[[&[f32]; 4]; 4], u: usize) -> (f32, [f32; PAIRS]) {
    let [s, l, h, t] = around;
    let (aa, bb) = (l[1][u] + h[2][u], l[2][u] + h[1][u]);
    let sum = aa + bb;
    let twice = 0.5 * sum;
    let pairs = [
        aa - bb,
        s[0][u] + t[3][u] - twice,
        s[3][u] + t[0][u] - twice,
        h[3][u] + l[0][u] - twice,
        t[2][u] + s[1][u] - twice,
        l[3][u] + h[0][u] - twice,
        s[2][u] + t[1][u] - twice,
    ];
    (sum, pairs)
}

/// The up to eight neighbours of an old point.
fn around(u: usize, v: usize, n: usize) -> impl Iterator<Item = (usize, usize)> {
    let (us, vs) = (u.saturating_sub(1)..=(u + 1).min(n), v.saturating_sub(1)..=(v + 1).min(n));
    vs.flat_map(move |j| us.clone().map(move |i| (i, j))).filter(move |p| *p != (u, v))
}

/// What the row below leaves for the one above it, with a margin of one point on each side.
pub(super) struct Below {
    /// What was missing from the guess, in quanta.
    pub missing: Vec<f32>,
    /// The magnitudes of the numbers.
    pub numbers: Vec<f32>,
}

impl Below {
    pub(super) fn new(n: usize) -> Self {
        Self { missing: vec![0.0; n + 2], numbers: vec![0.0; n + 2] }
    }
}

/// Completes a row's predictions, to be rounded, and classes from the row below it. `steps`: quanta of a
/// step.
pub(super) fn complete(
    row: &Row,
    below: &Below,
    kernel: &Kernel,
    step: i32,
    guesses: &mut [i32],
    bases: &mut [i32],
    classes: &mut [u8],
) {
    const CAUSAL: f32 = 1.0 / (1 << super::model::CAUSAL_BITS) as f32;
    let n = guesses.len();
    let [south, south_west, south_east, _] = kernel.causal.map(|w| f32::from(w) * CAUSAL);
    let [.., w_below, constant] = kernel.activity();
    let per_step = 1.0 / step as f32;
    let (m0, m1, m2) = (&below.missing[..n], &below.missing[1..=n], &below.missing[2..n + 2]);
    let (k0, k1, k2) = (&below.numbers[..n], &below.numbers[1..=n], &below.numbers[2..n + 2]);
    let (guess, rough) = (&row.guess[..n], &row.rough[..n]);
    let (guesses, bases, classes) = (&mut guesses[..n], &mut bases[..n], &mut classes[..n]);
    for u in 0..n {
        let full = guess[u] + (south * m1[u] + south_west * m0[u] + south_east * m2[u]);
        guesses[u] = whole(full);
        bases[u] = whole(guess[u]);
    }
    for u in 0..n {
        let near = 2.0 * k1[u] + k0[u] + k2[u];
        classes[u] = class(rough[u] * per_step + (w_below * near + constant));
    }
}

/// The nearest integer, halves to even; cut off at [`FAR`].
#[inline(always)]
fn whole(value: f32) -> i32 {
    // 1.5 * 2^23: adding it leaves the integer in the low bits of the float.
    const MAGIC: f32 = 12_582_912.0;
    let value = if value > -FAR { value } else { -FAR };
    let value = if value < FAR { value } else { FAR };
    (value + MAGIC).to_bits() as i32 - MAGIC.to_bits() as i32
}

impl Below {
    /// Below the first row, numbers are as large as it expects of its own.
    pub(super) fn expect(&mut self, row: &Row, kernel: &Kernel, step: i32) {
        let [.., constant] = kernel.activity();
        let per_step = 1.0 / step as f32;
        for (number, rough) in self.numbers[1..].iter_mut().zip(&row.rough) {
            let expected = rough * per_step + constant;
            *number = if expected > 0.0 { expected } else { 0.0 };
        }
        self.close();
    }

    /// Forgets the row below.
    pub(super) fn clear(&mut self) {
        self.missing.fill(0.0);
        self.numbers.fill(0.0);
    }

    /// Beyond both ends it goes on as it ended.
    pub(super) fn close(&mut self) {
        let last = self.missing.len() - 2;
        for values in [&mut self.missing, &mut self.numbers] {
            values[0] = values[1];
            values[last + 1] = values[last];
        }
    }
}

/// The activity at place u of a row, in units of `step`.
pub(super) fn activity(row: &Row, below: &Below, kernel: &Kernel, step: i32, u: usize) -> f32 {
    let [.., w_below, constant] = kernel.activity();
    let near = 2.0 * below.numbers[u + 1] + below.numbers[u] + below.numbers[u + 2];
    row.rough[u] * (1.0 / step as f32) + (w_below * near + constant)
}

//! Triangles against the samples that they cover: the largest vertical distance, exactly.
//!
//! Row by row, each sample of a triangle, edges included. With D twice the triangle's area in plan, D times
//! the height of its plane is a whole number at every lattice point; so is D times a sample's. Their
//! differences are exact in `f64` as long as they stay below 2^53, which they do for triangles up to 2^13
//! cells wide whatever their heights, and there is one division at the end. Larger ones are rounded by less than
//! a 2^-28th of a quantum.

use super::Vertex;
use super::metric::turn;
use diamantina_protocol::NODATA;

/// Samples of a rectangle of the lattice, one cell apart.
#[derive(Debug, Clone, Copy)]
pub struct Ground<'a> {
    /// Lattice coordinates of the south-west sample.
    pub origin: [u32; 2],
    /// Samples in a row.
    pub width: usize,
    /// Heights in quanta, row by row from the south.
    pub heights: &'a [i32],
}

#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "rows and columns are clipped to the rectangle before they become positions"
)]
impl Ground<'_> {
    /// The height of a sample, if it lies in the rectangle.
    #[must_use]
    pub fn at(&self, x: u32, y: u32) -> i32 {
        let (i, j) = ((x - self.origin[0]) as usize, (y - self.origin[1]) as usize);
        self.heights[j * self.width + i]
    }

    /// Whether there is a sample at a vertex, with a height.
    pub(super) fn has(&self, v: Vertex) -> bool {
        self.sample(v).is_some()
    }

    /// How far a vertex is from its sample, if that lies in the rectangle and has a height.
    fn off(&self, v: Vertex) -> f64 {
        self.sample(v).map_or(0.0, |h| v.height.abs_diff(h).into())
    }

    fn sample(&self, v: Vertex) -> Option<i32> {
        let step = |w: u32, o: u32| w.checked_sub(o).map(|w| w as usize);
        let (i, j) = (step(v.x, self.origin[0])?, step(v.y, self.origin[1])?);
        self.heights.get(j * self.width + i).filter(|h| i < self.width && **h != NODATA).copied()
    }

    /// Whether the ground may be a plane around a sample: it is not where it bends along one axis. Only of samples whose
    /// four neighbours lie in the rectangle and have heights it is known that it is not.
    #[must_use]
    pub(super) fn may_be_plane(&self, v: Vertex) -> bool {
        let (i, j) = ((v.x - self.origin[0]) as usize, (v.y - self.origin[1]) as usize);
        let (at, rows) = (j * self.width + i, self.heights.len() / self.width);
        if i == 0 || j == 0 || i + 1 == self.width || j + 1 == rows {
            return true;
        }
        let bends = |a: i32, b: i32| a != NODATA && b != NODATA && a + b != 2 * v.height;
        let h = self.heights;
        !bends(h[at - 1], h[at + 1]) && !bends(h[at - self.width], h[at + self.width])
    }

    /// The largest distance, in quanta, between a triangle (which turns left) and the samples of the rectangle that it
    /// covers, or something above `limit` as soon as that is known. Samples without height count for nothing.
    #[must_use]
    pub fn distance(&self, [a, b, c]: [Vertex; 3], limit: f64) -> f64 {
        let doubled = turn(a, b, c);
        if doubled == 1 {
            // No other lattice point has room in it.
            return [a, b, c].map(|v| self.off(v)).into_iter().fold(0.0, f64::max);
        }
        let doubled = doubled as f64;
        let local = |v: Vertex| {
            let step = |w: u32, o: u32| i64::from(w.wrapping_sub(o).cast_signed());
            [step(v.x, self.origin[0]), step(v.y, self.origin[1])]
        };
        let corners = [local(a), local(b), local(c)];
        let sides = Sides::new(corners);
        let rows = (self.heights.len() / self.width) as i64;
        let (low, high) = (sides.low[1].max(0), sides.high[1].min(rows - 1));
        // The plane, times D: D h = D h_a + east (x - x_a) + north (y - y_a).
        let [ab, ac] = [b, c].map(|v| {
            let step = |w: u32, o: u32| f64::from(w.wrapping_sub(o).cast_signed());
            [step(v.x, a.x), step(v.y, a.y), f64::from(v.height - a.height)]
        });
        let east = ab[2] * ac[1] - ac[2] * ab[1];
        let north = ab[0] * ac[2] - ac[0] * ab[2];
        let start =
            f64::from(a.height) * doubled - east * corners[0][0] as f64 - north * corners[0][1] as f64;
        let limit = limit * doubled;
        let mut worst = 0.0f64;
        for y in low..=high {
            let Some((from, to)) = sides.span(y, self.width as i64 - 1) else { continue };
            let row = &self.heights[y as usize * self.width..][from as usize..=to as usize];
            let here = start + north * y as f64 + east * from as f64;
            worst = worst.max(run(row, here, east, doubled));
            if worst > limit {
                break;
            }
        }
        worst / doubled
    }
}

/// A triangle's sides, from its lowest corner up: one goes all the way, the other one by the corner between.
struct Sides {
    low: [i64; 2],
    middle: [i64; 2],
    high: [i64; 2],
    /// Whether the side by the middle lies in the east.
    is_east: bool,
}

impl Sides {
    /// Those of a triangle that turns left.
    fn new([a, b, c]: [[i64; 2]; 3]) -> Self {
        // Turned until the lowest comes first; what follows it is in the east.
        let [low, next, last] = if a[1] <= b[1] && a[1] <= c[1] {
            [a, b, c]
        } else if b[1] <= c[1] {
            [b, c, a]
        } else {
            [c, a, b]
        };
        let is_east = next[1] <= last[1];
        let (middle, high) = if is_east { (next, last) } else { (last, next) };
        Self { low, middle, high, is_east }
    }

    /// The samples of a row that lie in the triangle, edges included, within 0 to `last`.
    fn span(&self, y: i64, last: i64) -> Option<(i64, i64)> {
        let Self { low, middle, high, .. } = *self;
        // A quotient that is whole comes out whole, and no other does: numbers are below 2^26.
        let at = |p: [i64; 2], q: [i64; 2]| {
            p[0] as f64 + ((y - p[1]) * (q[0] - p[0])) as f64 / (q[1] - p[1]) as f64
        };
        let all = at(low, high);
        let by = if y < middle[1] {
            at(low, middle)
        } else if y > middle[1] {
            at(middle, high)
        } else {
            middle[0] as f64
        };
        let (west, east) = if self.is_east { (all, by) } else { (by, all) };
        let (from, to) = (ceil(west).max(0), (-ceil(-east)).min(last));
        (from <= to).then_some((from, to))
    }
}

/// The least whole number at or above `x`. Without a call, which `f64::ceil` is where a machine is taken for an old one.
#[allow(clippy::cast_possible_truncation, reason = "coordinates are below 2^26")]
fn ceil(x: f64) -> i64 {
    let toward_zero = x as i64;
    toward_zero + i64::from((toward_zero as f64) < x)
}

/// The largest of `|h * doubled - (start + east * i)|` over a row.
fn run(row: &[i32], start: f64, east: f64, doubled: f64) -> f64 {
    const LANES: usize = 8;
    let distance = |i: usize, h: i32| {
        let distance = (f64::from(h) * doubled - (start + east * i as f64)).abs();
        if h == NODATA { 0.0 } else { distance }
    };
    let mut worst = [0.0f64; LANES];
    let (lanes, rest) = row.as_chunks::<LANES>();
    for (k, chunk) in lanes.iter().enumerate() {
        for (i, h) in chunk.iter().enumerate() {
            let here = distance(k * LANES + i, *h);
            worst[i] = if here > worst[i] { here } else { worst[i] };
        }
    }
    let most = worst.into_iter().fold(0.0, f64::max);
    rest.iter().enumerate().map(|(i, h)| distance(lanes.len() * LANES + i, *h)).fold(most, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Against a test of each sample by itself; corners may lie beyond the samples.
        #[test]
        fn the_distance_is_that_of_the_farthest_sample_covered(
            corners in prop::array::uniform3((0u32..24, 0u32..24, -500i32..500)),
            heights in prop::collection::vec(prop_oneof![9 => -500i32..500, 1 => Just(NODATA)], 12 * 14),
            origin in prop::array::uniform2(0u32..12),
        ) {
            let ground = Ground { origin, width: 12, heights: &heights };
            let [a, b, c] = corners.map(|(x, y, height)| Vertex { x, y, height });
            prop_assume!(turn(a, b, c) > 0);
            let mut expected = 0.0f64;
            for (i, sample) in heights.iter().enumerate().filter(|(_, h)| **h != NODATA) {
                let at = Vertex {
                    x: origin[0] + u32::try_from(i % 12).unwrap(),
                    y: origin[1] + u32::try_from(i / 12).unwrap(),
                    height: *sample,
                };
                let shares = [turn(at, b, c), turn(a, at, c), turn(a, b, at)];
                if shares.iter().all(|share| *share >= 0) {
                    let sum: i64 = shares.iter().zip([a, b, c]).map(|(s, v)| s * i64::from(v.height)).sum();
                    let plane = sum as f64 / turn(a, b, c) as f64;
                    expected = expected.max((plane - f64::from(*sample)).abs());
                }
            }
            let found = ground.distance([a, b, c], f64::INFINITY);
            prop_assert!((found - expected).abs() < 1e-9 * (1.0 + expected), "{found}, expected {expected}");
        }
    }
}

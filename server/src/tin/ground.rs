//! Triangles against the samples that they cover: the largest vertical distance, exactly.
//!
//! Row by row, each sample of a triangle, edges included. With D twice the triangle's area in plan, D times
//! the height of its plane is a whole number at every lattice point; so is D times a sample's. Their
//! differences are exact in `f64` as long as they stay below 2^53, which they do for triangles up to 2^13
//! cells wide whatever their heights, and there is one division at the end. Larger ones are rounded by less than
//! a 2^-28th of a quantum.

use super::Vertex;
use super::metric::turn;
use super::narrow::{self, Bounds, WIDE};
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
    pub fn distance(&self, corners: [Vertex; 3], limit: f64) -> f64 {
        let off = corners.map(|v| self.off(v)).into_iter().fold(0.0, f64::max);
        if off > limit { off } else { self.distance_within(corners, limit).max(off) }
    }

    /// [`Ground::distance`] of a triangle whose corners are known to be samples.
    #[must_use]
    #[inline]
    pub(super) fn distance_within(&self, [a, b, c]: [Vertex; 3], limit: f64) -> f64 {
        match turn(a, b, c) {
            // No other lattice point has room.
            1 => 0.0,
            doubled => self.distance_in([a, b, c], doubled, limit),
        }
    }

    /// Likewise, given twice its area.
    fn distance_in(&self, [a, b, c]: [Vertex; 3], doubled: i64, limit: f64) -> f64 {
        if doubled == 2 {
            return self.distance_halfway([a, b, c]);
        }
        if let Some(distance) = self.distance_nearby([a, b, c], doubled) {
            return distance;
        }
        let step = |w: u32, o: u32| w.wrapping_sub(o).cast_signed();
        let local = |v: Vertex| [step(v.x, self.origin[0]), step(v.y, self.origin[1])];
        let sides = Sides::new([local(a), local(b), local(c)]);
        let doubled = doubled as f64;
        // The plane, times D: D h = D h_a + east (x - x_a) + north (y - y_a).
        let of_side = |v: Vertex| {
            [f64::from(step(v.x, a.x)), f64::from(step(v.y, a.y)), f64::from(v.height - a.height)]
        };
        let (ab, ac) = (of_side(b), of_side(c));
        let east = ab[2] * ac[1] - ac[2] * ab[1];
        let north = ab[0] * ac[2] - ac[0] * ab[2];
        let corner = local(a).map(f64::from);
        let start = f64::from(a.height) * doubled - east * corner[0] - north * corner[1];
        let plane = Plane { start, east, north, doubled };
        let worst = self.worst::<false>(&plane, &sides, limit * doubled);
        // No height is as far off, but what stands for none is.
        if worst >= doubled * NODATA_AWAY {
            return self.worst::<true>(&plane, &sides, limit * doubled) / doubled;
        }
        worst / doubled
    }

    /// Likewise of a triangle that has one other lattice point: in the middle of a side.
    fn distance_halfway(&self, corners: [Vertex; 3]) -> f64 {
        let [a, b, c] = corners;
        let has_none = |p: Vertex, q: Vertex| ((p.x ^ q.x) | (p.y ^ q.y)) & 1;
        // Without a choice: which one it is is as random as the mesh.
        let side = (has_none(a, b) + (has_none(a, b) & has_none(b, c))) as usize;
        let (p, q) = (corners[side % 3], corners[(side + 1) % 3]);
        let middle = Vertex { x: (p.x + q.x) / 2, y: (p.y + q.y) / 2, height: 0 };
        self.sample(middle).map_or(0.0, |h| 0.5 * f64::from((2 * h - p.height - q.height).abs()))
    }

    /// Likewise of a triangle few cells wide, all samples around which lie in the rectangle; `None` of others.
    #[inline(always)]
    fn distance_nearby(&self, corners: [Vertex; 3], doubled: i64) -> Option<f64> {
        let around = Bounds::around(corners)?;
        // So many columns are looked at.
        let most = if around.columns <= WIDE / 2 { WIDE / 2 } else { WIDE };
        let (i, j) = (around.low[0].checked_sub(self.origin[0])?, around.low[1].checked_sub(self.origin[1])?);
        let from = i.min((self.width as u32).checked_sub(most)?);
        if i + around.columns > self.width as u32 {
            return None;
        }
        let heights = self.heights.get(j as usize * self.width + from as usize..)?;
        let worst = if most == WIDE {
            narrow::distance::<2>(corners, doubled as f32, &around, i - from, heights, self.width)
        } else {
            narrow::distance::<1>(corners, doubled as f32, &around, i - from, heights, self.width)
        };
        Some(f64::from(worst?) / doubled as f64)
    }

    /// The largest distance of a triangle's samples, times D; or something above `limit`. Whether samples without height are
    /// looked for.
    fn worst<const GAPS: bool>(&self, plane: &Plane, sides: &Sides, limit: f64) -> f64 {
        let Sides { low, middle, high, is_east } = *sides;
        let all = Line::new(low, high);
        let mut worst = [0.0f64; LANES];
        // A row with one corner alone has no other sample.
        let (first, last) =
            (low[1] + i32::from(low[1] != middle[1]), high[1] - i32::from(high[1] != middle[1]));
        for (from, to, rows) in
            [(low, middle, [first, middle[1] - 1]), (middle, high, [first.max(middle[1]), last])]
        {
            let rows = [rows[0].max(0), rows[1]];
            if rows[0] > rows[1] {
                continue;
            }
            let by = Line::new(from, to);
            let spans = if is_east { Spans::new(&all, &by, rows[0]) } else { Spans::new(&by, &all, rows[0]) };
            self.worst_of_rows::<GAPS>(plane, spans, rows, limit, &mut worst);
            if most(worst) > limit {
                break;
            }
        }
        most(worst)
    }

    /// Likewise of some rows between two sides.
    #[inline(always)]
    fn worst_of_rows<const GAPS: bool>(
        &self,
        plane: &Plane,
        mut spans: Spans,
        rows: [i32; 2],
        limit: f64,
        worst: &mut [f64; LANES],
    ) {
        let east = self.width as i32 - 1;
        let mut since = 0;
        let mut at = rows[0] as usize * self.width;
        let mut y = f64::from(rows[0]);
        for _ in rows[0]..=rows[1] {
            let (from, to) = (nearest(spans.west).max(0), nearest(spans.east).min(east));
            if from <= to {
                // Rows beyond the rectangle have no samples.
                let Some(row) = self.heights.get(at + from as usize..=at + to as usize) else { break };
                let start = plane.start + plane.north * y + plane.east * f64::from(from);
                if row.len() < 2 * LANES {
                    run_short::<GAPS>(row, start, plane, &mut worst[0]);
                } else {
                    run::<GAPS>(row, start, plane, worst);
                }
                since += row.len();
                if since > SAMPLES_BETWEEN {
                    since = 0;
                    if most(*worst) > limit {
                        break;
                    }
                }
            }
            spans.next();
            y += 1.0;
            at += self.width;
        }
    }
}

/// Distances that are looked at side by side.
const LANES: usize = 4;

/// Samples after which it is worth a look whether the limit is exceeded.
const SAMPLES_BETWEEN: usize = 64;

/// Twice as far as any two heights are apart is less than this, in quanta; from what stands for none it is more.
const NODATA_AWAY: f64 = (1u32 << 30) as f64;

/// A triangle's plane: at column i of row j its height is (start + east * i + north * j) / doubled.
struct Plane {
    start: f64,
    east: f64,
    north: f64,
    doubled: f64,
}

fn most(worst: [f64; LANES]) -> f64 {
    worst.into_iter().fold(0.0, f64::max)
}

/// A triangle's sides, from its lowest corner up: one goes all the way, the other one by the corner between.
struct Sides {
    low: [i32; 2],
    middle: [i32; 2],
    high: [i32; 2],
    /// Whether the side by the middle lies in the east.
    is_east: bool,
}

/// A side as a line: where it is at a row, and a share of what two such places differ by at least.
#[derive(Clone, Copy)]
struct Line {
    /// Of the lower end.
    from: [f64; 2],
    /// Along x for each row.
    slope: f64,
    /// Half of what a place that is no whole number is away from the next one at least.
    least: f64,
}

impl Line {
    fn new(from: [i32; 2], to: [i32; 2]) -> Self {
        // Of a flat side nothing but its lower end is asked.
        let each = 1.0 / f64::from((to[1] - from[1]).max(1));
        Self { from: from.map(f64::from), slope: f64::from(to[0] - from[0]) * each, least: 0.5 * each }
    }

    fn at(&self, y: f64) -> f64 {
        self.from[0] + (y - self.from[1]) * self.slope
    }
}

/// Which samples of a row lie between two sides: from the whole number nearest to one place to that nearest to another,
/// edges included.
struct Spans {
    west: f64,
    east: f64,
    /// From one row to the next.
    slopes: [f64; 2],
}

impl Spans {
    /// Of a row. Places are rounded by less than 2^-40, and in going on over 2^13 rows by less than 2^-26 in all; none of
    /// them is as near to a whole number without being one as 2^-25: sides are at most as high.
    #[inline(always)]
    fn new(west: &Line, east: &Line, y: i32) -> Self {
        let y = f64::from(y);
        // Half a cell on, the nearest whole number is the next one.
        Self {
            west: west.at(y) + (0.5 - west.least),
            east: east.at(y) - (0.5 - east.least),
            slopes: [west.slope, east.slope],
        }
    }

    #[inline(always)]
    fn next(&mut self) {
        self.west += self.slopes[0];
        self.east += self.slopes[1];
    }
}

impl Sides {
    /// Those of a triangle that turns left.
    fn new([a, b, c]: [[i32; 2]; 3]) -> Self {
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
}

/// The whole number nearest to `x`, which is not halfway between two. By the lowest bits of a sum so large that it has
/// no others: a conversion has to look at what does not fit.
#[allow(clippy::cast_possible_truncation, reason = "the lower half")]
#[inline(always)]
fn nearest(x: f64) -> i32 {
    const LARGE: f64 = (3u64 << 51) as f64;
    ((x + LARGE).to_bits() as u32).cast_signed()
}

/// A sample's distance from a plane that is `at` there, times D.
#[inline(always)]
fn away<const GAPS: bool>(h: i32, plane: &Plane, at: f64) -> f64 {
    let distance = (f64::from(h) * plane.doubled - at).abs();
    if GAPS && h == NODATA { 0.0 } else { distance }
}

/// Takes the largest of `|h * doubled - (start + east * i)|` over a row into `worst`.
#[inline(always)]
fn run_short<const GAPS: bool>(row: &[i32], start: f64, plane: &Plane, worst: &mut f64) {
    let mut at = start;
    for h in row {
        let distance = away::<GAPS>(*h, plane, at);
        *worst = if distance > *worst { distance } else { *worst };
        at += plane.east;
    }
}

/// Likewise over a longer one, side by side.
fn run<const GAPS: bool>(row: &[i32], start: f64, plane: &Plane, worst: &mut [f64; LANES]) {
    let mut lanes = *worst;
    let mut i = [0.0, 1.0, 2.0, 3.0];
    let (chunks, rest) = row.as_chunks::<LANES>();
    for chunk in chunks {
        for lane in 0..LANES {
            let distance = away::<GAPS>(chunk[lane], plane, start + plane.east * i[lane]);
            lanes[lane] = if distance > lanes[lane] { distance } else { lanes[lane] };
            i[lane] += LANES as f64;
        }
    }
    *worst = lanes;
    for (h, i) in rest.iter().zip(i) {
        let distance = away::<GAPS>(*h, plane, start + plane.east * i);
        worst[0] = if distance > worst[0] { distance } else { worst[0] };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Against a test of each sample by itself; corners may lie beyond the samples. Half of the triangles are among
        /// the least; some heights are too far apart for the short way.
        #[test]
        fn the_distance_is_that_of_the_farthest_sample_covered(
            corners in prop_oneof![
                prop::array::uniform3((0u32..24, 0u32..24, -500i32..500)),
                prop::array::uniform3((9u32..13, 9u32..13, -500i32..500)),
            ],
            heights in prop::collection::vec(prop_oneof![9 => -500i32..500, 1 => Just(NODATA)], 12 * 14),
            origin in prop::array::uniform2(0u32..12),
            steep in prop::array::uniform2(prop_oneof![3 => Just(1), 1 => Just(40), 1 => Just(100_000)]),
        ) {
            let heights: Vec<i32> =
                heights.into_iter().map(|h| if h == NODATA { h } else { h * steep[0] }).collect();
            let ground = Ground { origin, width: 12, heights: &heights };
            let [a, b, c] = corners.map(|(x, y, height)| Vertex { x, y, height: height * steep[1] });
            let (b, c) = if turn(a, b, c) < 0 { (c, b) } else { (b, c) };
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

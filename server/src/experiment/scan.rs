//! Every sample under a triangle, row by row.
//!
//! A triangle of the bintree has sides along rows, columns or diagonals, so each row of samples in it is
//! one unbroken run, and its ends are integers. The plane over it has slopes divided by powers of two: with
//! integer heights every number here is exact. Runs are compared four samples at a time.

use super::field::Field;
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::Bitree;
use std::ops::ControlFlow;

/// A triangle's plane: height at x, y = 0 of the grid, slopes along x and y in metres a cell.
#[derive(Debug, Clone, Copy)]
pub struct Plane {
    origin: [f64; 2],
    height: f64,
    slope: [f64; 2],
}

impl Plane {
    /// Through the corners of a triangle of the bintree, apex in the middle.
    #[must_use]
    pub fn new([a, c, b]: [Point; 3], [ha, hc, hb]: [f64; 3]) -> Self {
        let leg = |p: Point, i: usize| f64::from(p[i]) - f64::from(c[i]);
        let square = leg(a, 0) * leg(a, 0) + leg(a, 1) * leg(a, 1);
        // The legs are as long as each other and at right angles, and their square is a power of two.
        let part = 1.0 / square;
        let slope = [0, 1].map(|i| ((ha - hc) * leg(a, i) + (hb - hc) * leg(b, i)) * part);
        Self { origin: c.map(f64::from), height: hc, slope }
    }

    /// The height over a point.
    #[must_use]
    pub fn at(&self, [x, y]: Point) -> f64 {
        self.along_row(y) + self.slope[0] * (f64::from(x) - self.origin[0])
    }

    /// Metres a cell along x and y.
    #[must_use]
    pub fn slope(&self) -> [f64; 2] {
        self.slope
    }

    fn along_row(&self, y: u32) -> f64 {
        self.height + self.slope[1] * (f64::from(y) - self.origin[1])
    }
}

/// The runs of samples of a triangle, border included: calls `visit` with y and the first and last x of
/// each row, from the south, until it answers false.
pub fn rows(corners: [Point; 3], mut visit: impl FnMut(u32, u32, u32) -> bool) {
    let [mut south, mut bend, mut north] = corners;
    for _ in 0..2 {
        if bend[1] < south[1] {
            (south, bend) = (bend, south);
        }
        if north[1] < bend[1] {
            (bend, north) = (north, bend);
        }
    }
    // Sides that are not level are upright or diagonal: as far along x as along y, or not at all.
    let step = |from: Point, to: Point| (to[0].cast_signed() - from[0].cast_signed()).signum();
    // From south to north lead one side, and the two others.
    let (mut one, mut other) = (south[0], south[0]);
    let (along_one, mut along_other) = (step(south, north), step(south, bend));
    for y in south[1]..=north[1] {
        if y == bend[1] {
            (other, along_other) = (bend[0], step(bend, north));
        }
        if !visit(y, one.min(other), one.max(other)) {
            return;
        }
        (one, other) = (one.wrapping_add_signed(along_one), other.wrapping_add_signed(along_other));
    }
}

/// The largest vertical distance in metres between a triangle and the samples that it covers, border
/// included, each times its weight (`None`: 1). 0 where none has data. Gives up, with what it has found so
/// far, once that is more than `enough`.
#[must_use]
pub fn vertical_error(
    field: &Field,
    weights: Option<&[f32]>,
    corners: [Point; 3],
    heights: [f64; 3],
    enough: f64,
) -> f64 {
    let plane = Plane::new(corners, heights);
    let mut worst = 0.0;
    rows(corners, |y, first, last| {
        let run = field.slot([first, y])..field.slot([last, y]) + 1;
        let start = plane.at([first, y]);
        let weights = weights.map(|w| &w[run.clone()]);
        let found = row_error(&field.heights()[run], weights, start, plane.slope[0]);
        if found > worst {
            worst = found;
        }
        worst <= enough
    });
    worst
}

/// Whether [`vertical_error`] is more than a tolerance, the samples that tell it most often first.
#[must_use]
pub fn exceeds(
    field: &Field,
    weights: Option<&[f32]>,
    corners: [Point; 3],
    heights: [f64; 3],
    tolerance: f64,
) -> bool {
    let is_off = |i: usize| is_off(field, weights, corners[i], heights[i], tolerance);
    is_off(0) || is_off(1) || is_off(2) || exceeds_between(field, weights, corners, heights, tolerance)
}

/// The same where no sample at the corners is off by so much: of the finest triangles nothing is left then.
#[must_use]
pub fn exceeds_between(
    field: &Field,
    weights: Option<&[f32]>,
    corners: [Point; 3],
    heights: [f64; 3],
    tolerance: f64,
) -> bool {
    let ([a, c, b], [ha, hc, hb]) = (corners, heights);
    // Middles of sides lie on the grid, or the triangle has no more samples. Means are exact, as the plane is.
    for ((p, hp), (q, hq)) in [((a, ha), (b, hb)), ((a, ha), (c, hc)), ((c, hc), (b, hb))] {
        if (p[0] ^ q[0] | p[1] ^ q[1]) & 1 == 1 {
            return false;
        }
        let middle = [p[0].midpoint(q[0]), p[1].midpoint(q[1])];
        if is_off(field, weights, middle, (hp + hq) / 2.0, tolerance) {
            return true;
        }
    }
    // With these the smallest triangle with three middles is complete.
    let is_small = c[0].abs_diff(a[0]) + c[1].abs_diff(a[1]) == 2 && (c[0] == a[0] || c[1] == a[1]);
    !is_small && vertical_error(field, weights, corners, heights, tolerance) > tolerance
}

/// Whether a sample, times its weight, is further from a height than a tolerance.
fn is_off(field: &Field, weights: Option<&[f32]>, point: Point, height: f64, tolerance: f64) -> bool {
    let slot = field.slot(point);
    weights.map_or(1.0, |w| f64::from(w[slot])) * (field.heights()[slot] - height).abs() > tolerance
}

/// The height of a bitree's surface at each sample, data or not.
#[must_use]
pub fn surface(field: &Field, tree: &Bitree) -> Vec<f64> {
    let mut heights = vec![0.0; field.heights().len()];
    for root in tree.roots() {
        let _ = tree.leaves(&root, &mut |facet| {
            let plane = Plane::new(facet.corners(), facet.heights());
            rows(facet.corners(), |y, first, last| {
                for x in first..=last {
                    heights[field.slot([x, y])] = plane.at([x, y]);
                }
                true
            });
            ControlFlow::Continue(())
        });
    }
    heights
}

/// The runs of at least so many samples are compared four at a time: shorter ones are over before that pays.
const LONG: usize = 12;

/// Over one run; comparisons with NaN are false, so samples without data never count.
fn row_error(heights: &[f64], weights: Option<&[f32]>, start: f64, slope: f64) -> f64 {
    let larger = |worst: f64, found: f64| if found > worst { found } else { worst };
    if let Some(weights) = weights {
        let mut worst = 0.0;
        for ((h, w), x) in heights.iter().zip(weights).zip(0u32..) {
            worst = larger(worst, f64::from(*w) * (h - (start + slope * f64::from(x))).abs());
        }
        return worst;
    }
    let (long, rest) = heights.split_at(if heights.len() < LONG { 0 } else { heights.len() & !3 });
    let mut worst = [0.0f64; 4];
    let mut x = [0.0, 1.0, 2.0, 3.0];
    for chunk in long.chunks_exact(4) {
        for i in 0..4 {
            worst[i] = larger(worst[i], (chunk[i] - (start + slope * x[i])).abs());
            x[i] += 4.0;
        }
    }
    let mut worst = if long.is_empty() { 0.0 } else { worst[0].max(worst[1]).max(worst[2]).max(worst[3]) };
    let mut x = x[0];
    for h in rest {
        worst = larger(worst, (h - (start + slope * x)).abs());
        x += 1.0;
    }
    worst
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn rows_visit_exactly_the_samples_in_each_triangle() {
        let grid = Bitree::of(3, vec![0.0; 81]).unwrap();
        let mut open = grid.roots().to_vec();
        while let Some(facet) = open.pop() {
            let corners = facet.corners();
            let turn = |p: Point, q: Point, r: [u32; 2]| {
                let d = |from: Point, to: Point, i: usize| i64::from(to[i]) - i64::from(from[i]);
                d(p, q, 0) * d(p, r, 1) - d(p, q, 1) * d(p, r, 0)
            };
            let [a, c, b] = corners;
            let expected: BTreeSet<Point> = (0..=8)
                .flat_map(|y| (0..=8).map(move |x| [x, y]))
                .filter(|p| turn(a, c, *p) >= 0 && turn(c, b, *p) >= 0 && turn(b, a, *p) >= 0)
                .collect();
            let mut found = BTreeSet::new();
            rows(corners, |y, first, last| {
                found.extend((first..=last).map(|x| [x, y]));
                true
            });
            assert_eq!(found, expected, "{corners:?}");
            if grid.is_split(&facet) {
                open.extend(grid.halves(&facet));
            }
        }
    }

    #[test]
    fn errors_are_those_of_each_sample_by_itself() {
        let heights: Vec<f64> = (0..81u32).map(|i| f64::from(i * i % 37)).collect();
        let field = Field::new(3, heights, [1.0, 1.0]).unwrap();
        let weights: Vec<f32> = (0..81u8).map(|i| f32::from(i % 3) / 2.0).collect();
        let mut grid = Bitree::new(3, field.corners()).unwrap();
        grid.add([4, 4], 5.0);
        grid.add([2, 4], -3.0);
        let _ = grid.leaves(&grid.roots()[0], &mut |facet| {
            for weights in [None, Some(&weights[..])] {
                let plane = Plane::new(facet.corners(), facet.heights());
                let mut expected: f64 = 0.0;
                rows(facet.corners(), |y, first, last| {
                    for x in first..=last {
                        let weight = weights.map_or(1.0, |w| f64::from(w[field.slot([x, y])]));
                        expected = expected.max(weight * (field.at([x, y]) - plane.at([x, y])).abs());
                    }
                    true
                });
                let found = vertical_error(&field, weights, facet.corners(), facet.heights(), f64::INFINITY);
                assert_eq!(found, expected);
                for (tolerance, is_more) in [(expected, false), (0.9 * expected, expected > 0.0)] {
                    let told = exceeds(&field, weights, facet.corners(), facet.heights(), tolerance);
                    assert_eq!(told, is_more, "{tolerance}");
                }
            }
            for (corner, height) in facet.corners().into_iter().zip(facet.heights()) {
                assert_eq!(Plane::new(facet.corners(), facet.heights()).at(corner), height);
            }
            ControlFlow::Continue(())
        });
    }
}

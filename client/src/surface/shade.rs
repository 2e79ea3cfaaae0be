//! Normals of a grid of points.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "local coordinates are at most 256, and slopes need no more than f32"
)]

use super::normal;
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::message::Layer;

/// Normals of the points strictly inside (and, at level 0, on the sides), by differences along two axes: the
/// diagonals of the cells around a point, or, where centres are no points, the sides of the cells. Where all
/// eight points around are there, the middle one of three differences side by side counts twice (Horn 1981):
/// a difference alone joins points of one colour of the chessboard that old and new points make, and slopes
/// of the two colours drift apart, which light shows as teeth on steep ground.
pub(super) fn shade(layer: &Layer, d: Diamond, block: &Block, has_nodata: bool, normals: &mut [[i16; 2]]) {
    let grid = Grid::new(layer, d, block);
    if !has_nodata {
        grid.shade_rows(normals);
    }
    let n = grid.n;
    for [p, q] in block.places().map(|place| place.map(|w| w as i64)) {
        let is_border = p == 0 || q == 0 || p == 2 * n || q == 2 * n;
        let is_outside = !grid.upper && q > p;
        if (is_border && d.level() > 0) || is_outside || (!has_nodata && grid.has_all_around(p, q)) {
            continue;
        }
        normals[Block::slot(n as usize, p as usize, q as usize)] = grid.normal_at(p, q);
    }
}

/// The heights of a block, and its two axes.
struct Grid {
    /// Metres; [`f64::NAN`] where there is none.
    heights: Vec<f64>,
    n: i64,
    has_centres: bool,
    upper: bool,
    axes: Axes,
}

/// Metres east and north of a unit along each axis.
struct Axes {
    /// In doubled local coordinates.
    units: [[i64; 2]; 2],
    along: [f64; 2],
    across: [f64; 2],
    det: f64,
}

impl Axes {
    /// The normal where the ground rises so much, in metres, a unit along each axis.
    #[inline]
    fn normal(&self, rises: [f64; 2]) -> [i16; 2] {
        let [along, across] = [self.along, self.across];
        let slope = [rises[0] * across[1] - rises[1] * along[1], rises[1] * along[0] - rises[0] * across[0]];
        normal(slope.map(|s| (s / self.det) as f32))
    }
}

/// The points around those of a row, each a row of the same length: before and behind along both axes, then those
/// beside the axes, in turn.
struct Around<'a> {
    along: [&'a [f64]; 2],
    across: [&'a [f64]; 2],
    beside: [&'a [f64]; 4],
}

impl Grid {
    fn new(layer: &Layer, d: Diamond, block: &Block) -> Self {
        let local = layer.forest.local(d);
        let units = if block.has_centres() { [[1, 1], [1, -1]] } else { [[2, 0], [0, 2]] };
        let metres =
            |[p, q]: [i64; 2]| [0, 1].map(|i| (local.u[i] * p + local.v[i] * q) as f64 * layer.cell[i] / 2.0);
        let (along, across) = (metres(units[0]), metres(units[1]));
        let metres = |h: &i32| if *h == NODATA { f64::NAN } else { f64::from(*h) * layer.quantum };
        Self {
            heights: block.heights().iter().map(metres).collect(),
            n: block.segments() as i64,
            has_centres: block.has_centres(),
            upper: local.upper,
            axes: Axes { units, along, across, det: along[0] * across[1] - along[1] * across[0] },
        }
    }

    /// Whether all eight points around one are in the diamond: [`Grid::shade_rows`] does those.
    fn has_all_around(&self, p: i64, q: i64) -> bool {
        // With centres those that are farthest lie along a side of a cell, without along a diagonal.
        let beyond = if self.has_centres { 2 } else { 4 };
        let reach = 2..=2 * self.n - 2;
        reach.contains(&p) && reach.contains(&q) && (self.upper || q + beyond <= p)
    }

    /// The normals of all points that have all eight around.
    fn shade_rows(&self, normals: &mut [[i16; 2]]) {
        let n = self.n as usize;
        let (old, centres) = self.heights.split_at((n + 1) * (n + 1));
        let corner = |i: usize, j: usize, count: usize| &old[j * (n + 1) + i..][..count];
        let centre = |u: usize, v: usize, count: usize| &centres[v * n + u..][..count];
        for j in 1..n {
            let first = if self.upper { 1 } else { j + 1 + usize::from(!self.has_centres) };
            let Some(count) = n.checked_sub(first).filter(|count| *count > 0) else { continue };
            let at = |di: usize, dj: usize| corner(first + di - 1, j + dj - 1, count);
            let between = |du: usize, dv: usize| centre(first + du - 1, j + dv - 1, count);
            let around = if self.has_centres {
                Around {
                    along: [between(0, 0), between(1, 1)],
                    across: [between(0, 1), between(1, 0)],
                    beside: [at(0, 1), at(1, 2), at(2, 1), at(1, 0)],
                }
            } else {
                Around {
                    along: [at(0, 1), at(2, 1)],
                    across: [at(1, 0), at(1, 2)],
                    beside: [at(0, 0), at(2, 0), at(2, 2), at(0, 2)],
                }
            };
            self.shade_row(&around, &mut normals[j * (n + 1) + first..][..count]);
        }
        if !self.has_centres {
            return;
        }
        for v in 1..n.saturating_sub(1) {
            let first = if self.upper { 1 } else { v + 1 };
            let Some(count) = (n - 1).checked_sub(first).filter(|count| *count > 0) else { continue };
            let at = |du: usize, dv: usize| centre(first + du - 1, v + dv - 1, count);
            let between = |di: usize, dj: usize| corner(first + di, v + dj, count);
            let around = Around {
                along: [between(0, 0), between(1, 1)],
                across: [between(0, 1), between(1, 0)],
                beside: [at(0, 1), at(1, 2), at(2, 1), at(1, 0)],
            };
            self.shade_row(&around, &mut normals[(n + 1) * (n + 1) + v * n + first..][..count]);
        }
    }

    fn shade_row(&self, around: &Around<'_>, normals: &mut [[i16; 2]]) {
        let count = normals.len();
        let rows = [around.along[0], around.along[1], around.across[0], around.across[1]];
        let [before, behind, left, right] = rows.map(|row| &row[..count]);
        let [a, b, c, d] = around.beside.map(|row| &row[..count]);
        for (i, normal) in normals.iter_mut().enumerate() {
            let rises = [(behind[i] - before[i]) / 2.0, (right[i] - left[i]) / 2.0];
            let beside = [(b[i] - a[i] + c[i] - d[i]) / 4.0, (d[i] - a[i] + c[i] - b[i]) / 4.0];
            *normal = self.axes.normal([0, 1].map(|k| (rises[k] + beside[k]) / 2.0));
        }
    }

    fn height(&self, p: i64, q: i64) -> Option<f64> {
        if !(0..=2 * self.n).contains(&p) || !(0..=2 * self.n).contains(&q) || (!self.upper && q > p) {
            return None;
        }
        let height = self.heights[Block::slot(self.n as usize, p as usize, q as usize)];
        (!height.is_nan()).then_some(height)
    }

    /// The normal at a point, whatever is around it.
    fn normal_at(&self, p: i64, q: i64) -> [i16; 2] {
        let [e, f] = self.axes.units;
        let mut rises = [self.rise(p, q, e), self.rise(p, q, f)];
        if let Some(beside) = self.rises_beside(p, q) {
            rises = [0, 1].map(|i| (rises[i] + beside[i]) / 2.0);
        }
        self.axes.normal(rises)
    }

    /// The rise a unit along an axis, from both sides of a point where it can be.
    fn rise(&self, p: i64, q: i64, [dp, dq]: [i64; 2]) -> f64 {
        match (self.height(p - dp, q - dq), self.height(p + dp, q + dq), self.height(p, q)) {
            (Some(a), Some(b), _) => (b - a) / 2.0,
            (Some(a), None, Some(h)) => h - a,
            (None, Some(b), Some(h)) => b - h,
            _ => 0.0,
        }
    }

    /// The mean of the rises on both sides of a point, if the four points beside the axes are there.
    fn rises_beside(&self, p: i64, q: i64) -> Option<[f64; 2]> {
        self.height(p, q)?;
        let [e, f] = self.axes.units;
        let at = |i: i64, j: i64| self.height(p + i * e[0] + j * f[0], q + i * e[1] + j * f[1]);
        let (a, b, c, d) = (at(-1, -1)?, at(1, -1)?, at(1, 1)?, at(-1, 1)?);
        Some([(b - a + c - d) / 4.0, (d - a + c - b) / 4.0])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::{Dice, world};

    #[test]
    fn rows_give_what_points_one_by_one_do() {
        let layer = &world()[0].layer;
        let forest = layer.forest;
        let mut dice = Dice(7);
        for level in 0..forest.levels() {
            for d in forest.diamonds(level).take(40) {
                let mut block = Block::empty(&forest, level);
                block.heights_mut().fill_with(|| (dice.roll() * 1e4) as i32);
                let grid = Grid::new(layer, d, &block);
                let mut normals = vec![[0; 2]; block.heights().len()];
                grid.shade_rows(&mut normals);
                for [p, q] in block.places() {
                    let (at, slot) = ([p as i64, q as i64], Block::slot(block.segments(), p, q));
                    let expected =
                        if grid.has_all_around(at[0], at[1]) { grid.normal_at(at[0], at[1]) } else { [0; 2] };
                    assert_eq!(normals[slot], expected, "level {level}, {at:?}");
                }
            }
        }
    }
}

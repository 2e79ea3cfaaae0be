//! The heights that a level draws, over a rectangle: what the samples are compared with. And the walks
//! between such rectangles of the lattice and the grids of diamonds, row by row.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "lattice coordinates are below 2^28, and what is walked lies in the rectangle"
)]

use crate::canvas::Window;
use crate::measure::Nodes;
use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond, Local};

/// The heights that a level draws, over a rectangle.
#[derive(Debug)]
pub(super) struct Surface {
    pub(super) spacing_log2: u32,
    origin: [u32; 2],
    width: usize,
    pub(super) heights: Vec<i32>,
}

/// The steps of a diamond's grid through an array of rows: the position of (0, 0), and what a step along u
/// and v adds. New points lie half a step along both from old ones.
#[derive(Clone, Copy)]
struct Walk {
    start: isize,
    u: isize,
    v: isize,
}

impl Walk {
    fn new(local: &Local, spacing_log2: u32, origin: [u32; 2], width: usize) -> Self {
        let place =
            |[x, y]: [i64; 2]| ((y >> spacing_log2) as isize) * width as isize + (x >> spacing_log2) as isize;
        let start = place([local.origin[0] - i64::from(origin[0]), local.origin[1] - i64::from(origin[1])]);
        Self { start, u: place(local.u), v: place(local.v) }
    }

    fn at(self, u: usize, v: usize) -> isize {
        self.start + u as isize * self.u + v as isize * self.v
    }

    fn half(self) -> Self {
        Self { start: self.start + (self.u + self.v) / 2, ..self }
    }
}

/// The source heights of a diamond's block; the window holds all of the diamond, at the spacing of the level
/// that it splits into.
pub(super) fn source_block(forest: &Forest, d: Diamond, window: &Window) -> Block {
    let mut block = Block::empty(forest, d.level());
    let local = forest.local(d);
    let walk = Walk::new(&local, window.spacing_log2(), window.origin(), window.width());
    let n = block.segments();
    let (old, new) = block.parts_mut();
    for (points, row, walk) in [(old, n + 1, walk), (new, n, walk.half())] {
        for (v, points) in points.chunks_exact_mut(row).enumerate() {
            let first = if local.upper { 0 } else { v };
            let mut at = walk.at(first, v);
            for point in &mut points[first..] {
                *point = window.heights()[at as usize];
                at += walk.u;
            }
        }
    }
    block
}

impl Surface {
    pub(super) fn new(spacing_log2: u32, origin: [u32; 2], cells: [u32; 2]) -> Self {
        let [w, h] = cells.map(|c| (c >> spacing_log2) as usize + 1);
        Self { spacing_log2, origin, width: w, heights: vec![NODATA; w * h] }
    }

    pub(super) fn at(&self, x: u32, y: u32) -> i32 {
        let (i, j) = ((x - self.origin[0]) >> self.spacing_log2, (y - self.origin[1]) >> self.spacing_log2);
        self.heights[j as usize * self.width + i as usize]
    }

    /// As the comparison with the samples wants it.
    pub(super) fn nodes(&self) -> Nodes<'_> {
        let Self { spacing_log2, origin, width, ref heights } = *self;
        Nodes { spacing_log2, origin, width, heights }
    }

    /// Takes over the points of a split diamond that lie in the rectangle.
    pub(super) fn draw(&mut self, forest: &Forest, d: Diamond, block: &Block, cells: [u32; 2]) {
        let local = forest.local(d);
        let [low, high] = forest.bounds(d);
        if (0..2).any(|axis| low[axis] < self.origin[axis] || high[axis] > self.origin[axis] + cells[axis]) {
            return self.draw_part(&local, block, cells);
        }
        let walk = Walk::new(&local, self.spacing_log2, self.origin, self.width);
        let n = block.segments();
        let (old, new) = block.parts();
        for (points, row, walk) in [(old, n + 1, walk), (new, n, walk.half())] {
            for (v, points) in points.chunks_exact(row).enumerate() {
                let first = if local.upper { 0 } else { v };
                let mut at = walk.at(first, v);
                for point in &points[first..] {
                    self.heights[at as usize] = *point;
                    at += walk.u;
                }
            }
        }
    }

    /// Likewise, of a diamond that straddles the rectangle's border.
    fn draw_part(&mut self, local: &Local, block: &Block, cells: [u32; 2]) {
        let walk = Walk::new(local, self.spacing_log2, self.origin, self.width);
        let n = block.segments();
        let (old, new) = block.parts();
        // Twice the distance from the rectangle's corner, since new points lie half a step on.
        let far = cells.map(|c| 2 * i64::from(c));
        let corner = [0, 1].map(|axis| 2 * (local.origin[axis] - i64::from(self.origin[axis])));
        for (points, row, walk, odd) in [(old, n + 1, walk, 0), (new, n, walk.half(), 1)] {
            for (v, points) in points.chunks_exact(row).enumerate() {
                let first = if local.upper { 0 } else { v };
                let mut at = walk.at(first, v);
                let (p, q) = (2 * first as i64 + odd, 2 * v as i64 + odd);
                let [mut x, mut y] = [0, 1].map(|axis| corner[axis] + local.u[axis] * p + local.v[axis] * q);
                for point in &points[first..] {
                    if (0..=far[0]).contains(&x) && (0..=far[1]).contains(&y) {
                        self.heights[at as usize] = *point;
                    }
                    at += walk.u;
                    x += 2 * local.u[0];
                    y += 2 * local.u[1];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canvas::Canvas;

    #[test]
    fn walking_rows_is_looking_up_every_point() {
        let forest = Forest::new(5, 2, [2, 1]).unwrap();
        let [w, h] = forest.size();
        let folder = tempfile::tempdir().unwrap();
        let canvas = Canvas::create(folder.path(), w + 1, h + 1, 3).unwrap();
        let height = |x: u32, y: u32| (y * 1000 + x).cast_signed();
        let heights: Vec<i32> = (0..=h).flat_map(|y| (0..=w).map(move |x| height(x, y))).collect();
        canvas.write_rows(0, &heights).unwrap();
        for level in 0..forest.levels() {
            let spacing = forest.root_log2() - forest.patch_log2() - (level + 1).div_ceil(2);
            for d in forest.diamonds(level) {
                let [low, high] = forest.bounds(d);
                let window = canvas.read(spacing, low, high).unwrap();
                let block = source_block(&forest, d, &window);
                let mut expected = Block::empty(&forest, level);
                let local = forest.local(d);
                expected.fill(&local, height);
                assert_eq!(block, expected, "{d:?}");
                // A rectangle that some diamonds lie in, some straddle and some miss.
                let (origin, cells) = ([16, 8], [16, 16]);
                let mut surface = Surface::new(spacing, origin, cells);
                surface.draw(&forest, d, &block, cells);
                let mut drawn = Surface::new(spacing, origin, cells).heights;
                expected.fill(&local, |x, y| {
                    let inside = (16..=32).contains(&x) && (8..=24).contains(&y);
                    if inside {
                        let slot = ((y - 8) >> spacing) * (surface.width as u32) + ((x - 16) >> spacing);
                        drawn[slot as usize] = height(x, y);
                    }
                    0
                });
                assert_eq!(surface.heights, drawn, "{d:?}");
            }
        }
    }
}

//! The heights that a level draws, over a rectangle: what the samples are compared with.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "lattice coordinates are below 2^28, and what is drawn lies in the rectangle"
)]

use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond};

/// The heights that a level draws, over a rectangle.
#[derive(Debug)]
pub(super) struct Surface {
    pub(super) spacing_log2: u32,
    origin: [u32; 2],
    width: usize,
    pub(super) heights: Vec<i32>,
}

impl Surface {
    pub(super) fn new(spacing_log2: u32, origin: [u32; 2], cells: [u32; 2]) -> Self {
        let [w, h] = cells.map(|c| (c >> spacing_log2) as usize + 1);
        Self { spacing_log2, origin, width: w, heights: vec![NODATA; w * h] }
    }

    fn slot(&self, x: u32, y: u32) -> usize {
        let (i, j) = ((x - self.origin[0]) >> self.spacing_log2, (y - self.origin[1]) >> self.spacing_log2);
        j as usize * self.width + i as usize
    }

    pub(super) fn at(&self, x: u32, y: u32) -> i32 {
        self.heights[self.slot(x, y)]
    }

    /// Takes over the points of a split diamond that lie in the rectangle.
    pub(super) fn draw(&mut self, forest: &Forest, d: Diamond, block: &Block, cells: [u32; 2]) {
        let local = forest.local(d);
        let n = block.segments();
        let [x0, y0] = self.origin;
        let (xs, ys) = (i64::from(x0)..=i64::from(x0 + cells[0]), i64::from(y0)..=i64::from(y0 + cells[1]));
        for q in 0..=2 * n {
            for p in (q % 2..=2 * n).step_by(2) {
                let [x, y] = local.lattice2([p as i64, q as i64]);
                if xs.contains(&x) && ys.contains(&y) && (local.upper || q <= p) {
                    let slot = self.slot(x as u32, y as u32);
                    self.heights[slot] = block.heights()[Block::slot(n, p, q)];
                }
            }
        }
    }
}

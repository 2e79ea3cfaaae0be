//! The regular patch of a diamond: the triangles of the bintree itself, where there are heights.

use super::{Patch, Vertex};
use crate::bintree::{Forest, Point};
use crate::diamond::{Block, Diamond};

impl Patch {
    /// The patch that a diamond's local grid of `segments` a side gives: each cell is cut into four triangles by its
    /// diagonals, and those with a corner where `height` gives nothing are left out.
    ///
    /// Regular patches of the same number of segments in all diamonds fit each other. With [`Forest::segments`]
    /// the finest ones hold every point of the lattice. `segments`: a power of two, at most [`Forest::segments`].
    #[must_use]
    pub fn regular(
        forest: &Forest,
        d: Diamond,
        segments: usize,
        mut height: impl FnMut(Point) -> Option<i32>,
    ) -> Self {
        let local = forest.local(d);
        let n = segments.next_power_of_two().min(forest.segments());
        let step = i64::try_from(forest.segments() / n).unwrap_or(1);
        let count = (n + 1) * (n + 1) + n * n;
        let mut names: Vec<Option<u32>> = vec![None; count];
        let mut vertices = Vec::new();
        let lattice = |p: usize, q: usize| {
            let place = [p, q].map(|w| i64::try_from(w).unwrap_or(0) * step);
            local.lattice2(place).map(|w| u32::try_from(w).ok())
        };
        for q in 0..=2 * n {
            for p in (q % 2..=2 * n).step_by(2).filter(|p| local.upper || q <= *p) {
                let [Some(x), Some(y)] = lattice(p, q) else { continue };
                if let Some(height) = height([x, y]) {
                    names[Block::slot(n, p, q)] = u32::try_from(vertices.len()).ok();
                    vertices.push(Vertex { x, y, height });
                }
            }
        }
        let mut children: [Vec<[u32; 3]>; 4] = Default::default();
        for v in 0..n {
            for u in 0..n {
                let (p, q) = (2 * u, 2 * v);
                let corners = [[p, q], [p + 2, q], [p + 2, q + 2], [p, q + 2]];
                let name = |[p, q]: [usize; 2]| names[Block::slot(n, p, q)];
                for side in 0..4 {
                    // The child triangle is told by three times the triangle's centroid, seen from the middle.
                    let (a, b) = (corners[side], corners[(side + 1) % 4]);
                    let sum =
                        [0, 1].map(|i| (a[i] + b[i] + [p, q][i] + 1).cast_signed() - 3 * n.cast_signed());
                    let child = [-sum[1], sum[0], sum[1], -sum[0]]
                        .iter()
                        .position(|depth| *depth >= sum[0].abs().max(sum[1].abs()))
                        .unwrap_or(0);
                    if let [Some(a), Some(b), Some(c)] = [name(a), name(b), name([p + 1, q + 1])] {
                        children[child].push([a, b, c]);
                    }
                }
            }
        }
        let mut patch = Self { vertices, ..Self::default() };
        for (child, triangles) in children.into_iter().enumerate() {
            patch.triangles.extend(triangles);
            patch.ends[child] = u32::try_from(patch.triangles.len()).unwrap_or(u32::MAX);
        }
        patch
    }
}

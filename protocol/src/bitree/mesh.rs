//! The triangles of a bitree: as they are, or with those of zero area that close T-junctions.
//!
//! A fictitious point splits one triangle and leaves the one across whole: it lies on that one's side, at
//! the side's own height, so nothing shows through but what rounding on the way to a screen opens. A side with points
//! on it can be closed by triangles without area, whose corners lie on the side:
//!
//! ```text
//!  u---x---m-------v     side u v of a whole triangle, points m and x beyond it:
//!                        u m v, then u x m; m v has no middle that is present.
//! ```
//!
//! With these, each edge belongs to two triangles or lies on the grid's border.

use super::{Bitree, Facet};
use crate::bintree::Point;
use std::ops::ControlFlow;

/// A corner and its height.
pub type Corner = (Point, f64);

/// Points that are present, one bit each.
struct Marks {
    bits: Vec<u64>,
    row: usize,
}

impl Marks {
    fn place(&self, [x, y]: Point) -> (usize, u64) {
        let slot = y as usize * self.row + x as usize;
        (slot / 64, 1 << (slot % 64))
    }

    /// Whether the point was not marked before.
    fn mark(&mut self, point: Point) -> bool {
        let (word, bit) = self.place(point);
        let before = self.bits[word];
        self.bits[word] |= bit;
        before & bit == 0
    }

    fn has(&self, point: Point) -> bool {
        let (word, bit) = self.place(point);
        self.bits[word] & bit != 0
    }
}

impl Bitree {
    /// The triangles that are drawn, each turning left, apex in the middle; with the heights of their
    /// corners. Costs one step a triangle.
    #[must_use]
    pub fn triangles(&self) -> Vec<[Corner; 3]> {
        let mut list = Vec::new();
        for root in self.roots() {
            let _ = self.leaves(&root, &mut |facet| {
                list.push(corners(facet));
                ControlFlow::Continue(())
            });
        }
        list
    }

    /// The same, followed by triangles without area that close every T-junction, so that each edge
    /// belongs to two triangles or lies on the border. Takes an eighth of a byte a point of the grid.
    #[must_use]
    pub fn triangles_closed(&self) -> Vec<[Corner; 3]> {
        let marks = self.marks();
        let mut list = self.triangles();
        for i in 0..list.len() {
            let t = list[i];
            for (u, v) in [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])] {
                close(&marks, u, v, &mut list);
            }
        }
        list
    }

    /// How many triangles are drawn: two, and one more for each that is split.
    #[must_use]
    pub fn triangle_count(&self) -> usize {
        2 + self.below.iter().filter(|count| **count > 0).count()
    }

    /// How many points are real, corners included, and how many fictitious. Takes an eighth of a byte a point
    /// of the grid.
    #[must_use]
    pub fn points(&self) -> (usize, usize) {
        let real = self.real.iter().filter(|h| !h.is_nan()).count();
        let present: u32 = self.marks().bits.iter().map(|word| word.count_ones()).sum();
        (real, present as usize - real)
    }

    /// The fictitious points, in the order of descent.
    #[must_use]
    pub fn fictitious(&self) -> Vec<Point> {
        let mut list = Vec::new();
        self.mark_all(&mut |m| list.push(m));
        list
    }

    fn marks(&self) -> Marks {
        self.mark_all(&mut |_| ())
    }

    /// Marks what is present; calls `fictitious` once with each point that has no height of its own.
    fn mark_all(&self, fictitious: &mut impl FnMut(Point)) -> Marks {
        let row = self.side() as usize + 1;
        let mut marks = Marks { bits: vec![0; (row * row).div_ceil(64)], row };
        for corner in self.outermost() {
            marks.mark(corner);
        }
        let mut open = self.roots().to_vec();
        while let Some(facet) = open.pop() {
            if self.is_split(&facet) {
                let m = facet.middle();
                if marks.mark(m) && self.real(m).is_none() {
                    fictitious(m);
                }
                open.extend(self.halves(&facet));
            }
        }
        marks
    }
}

fn corners(facet: &Facet) -> [Corner; 3] {
    let ([a, c, b], [ha, hc, hb]) = (facet.corners, facet.heights);
    [(a, ha), (c, hc), (b, hb)]
}

/// Fills between a side and the points on it. Between two ends further points are only where their middle is.
fn close(marks: &Marks, u: Corner, v: Corner, list: &mut Vec<[Corner; 3]>) {
    let steps = [u.0[0].abs_diff(v.0[0]), u.0[1].abs_diff(v.0[1])];
    if (steps[0] | steps[1]) & 1 == 1 {
        return;
    }
    let m = [u.0[0].midpoint(v.0[0]), u.0[1].midpoint(v.0[1])];
    if marks.has(m) {
        let m = (m, (u.1 + v.1) / 2.0);
        list.push([u, m, v]);
        close(marks, u, m, list);
        close(marks, m, v, list);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    proptest! {
        #[test]
        fn closed_triangles_share_every_edge_at_the_same_heights(
            points in prop::collection::vec(([0u32..=32, 0u32..=32], -1000i32..1000), 0..40)
        ) {
            let mut bitree = Bitree::new(5, [0.0; 4]).unwrap();
            for (p, h) in points { bitree.add(p, f64::from(h)); }
            let closed = bitree.triangles_closed();
            // Each edge forwards once and backwards once; on the border only forwards.
            let mut edges: BTreeMap<[Point; 2], i32> = BTreeMap::new();
            let mut heights: BTreeMap<Point, f64> = BTreeMap::new();
            for t in &closed {
                for i in 0..3 {
                    let ((u, hu), (v, _)) = (t[i], t[(i + 1) % 3]);
                    prop_assert_eq!(*heights.entry(u).or_insert(hu), hu);
                    *edges.entry([u, v]).or_default() += 1;
                    *edges.entry([v, u]).or_default() -= 1;
                }
            }
            for ([u, v], balance) in edges {
                let border = (0..2).any(|i| u[i] == v[i] && (u[i] == 0 || u[i] == 32));
                prop_assert!(balance == 0 || border, "{:?} {:?} {}", u, v, balance);
            }
            let (real, fictitious) = bitree.points();
            prop_assert_eq!(heights.len(), real + fictitious);
            prop_assert_eq!(bitree.fictitious().len(), fictitious);
            prop_assert_eq!(bitree.triangles().len(), bitree.triangle_count());
        }
    }
}

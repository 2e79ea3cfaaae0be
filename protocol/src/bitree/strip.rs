//! One triangle strip through a whole bitree, by recursion.
//!
//! A strip is a list of references to points; each three in a row are a triangle, and those without area
//! are *line triangles*, which draw nothing. Each triangle is entered through one side and left through
//! another, and so referred to as p, q, r: entered over p q, left over q r. By where the apex c stands
//! between the ends a and b of the hypotenuse there are three sequences, and each splits into two, one
//! after the other (m is the middle of the hypotenuse):
//!
//! ```text
//!           entered over   left over   splits into
//! A  a b c  hypotenuse     leg         B (a m c)  C (m c b)
//! B  a c b  leg            leg         A (a c m)  C (m c b)
//! C  c a b  leg            hypotenuse  A (a c m)  B (c m b)
//! ```
//!
//! A grid begins as C, A: two triangles that share their hypotenuse. Then the path through the triangles is
//! Sierpinski's curve. Neighbours that share a whole side follow each other with it explicit in the sequence: the next
//! triangle takes one reference, or two where the side has to be turned round (one line triangle).
//! Where a side is shared in part, both sides are explicit, with line triangles between.
//!
//! After the bitree paper, its section 4 and figure 11: 3 x 3 points take 15 references, 65 x 65 points 13 655.

use super::{Bitree, Facet};
use crate::bintree::Point;

/// Where the apex stands among the three references of a triangle.
#[derive(Clone, Copy)]
enum Sequence {
    /// Last.
    A,
    /// In the middle.
    B,
    /// First.
    C,
}

/// The references of one strip that draws exactly the bitree's triangles. Costs one step a triangle.
#[must_use]
pub fn strip(bitree: &Bitree) -> Vec<Point> {
    let [lower, upper] = bitree.roots();
    let mut out = Vec::with_capacity(2 * bitree.triangle_count());
    let [[a, c, b], [_, opposite, _]] = [lower.corners(), upper.corners()];
    walk(bitree, &lower, Sequence::C, [c, a, b], &mut out);
    walk(bitree, &upper, Sequence::A, [b, a, opposite], &mut out);
    out
}

fn walk(bitree: &Bitree, facet: &Facet, sequence: Sequence, pqr: [Point; 3], out: &mut Vec<Point>) {
    if !bitree.is_split(facet) {
        append(out, pqr);
        return;
    }
    let m = facet.middle();
    let [p, q, r] = pqr;
    use Sequence::{A, B, C};
    // The end of the hypotenuse whose half comes first.
    let (first, parts) = match sequence {
        A => (p, [(B, [p, m, r]), (C, [m, r, q])]),
        B => (p, [(A, [p, q, m]), (C, [m, q, r])]),
        C => (q, [(A, [q, p, m]), (B, [p, m, r])]),
    };
    let [left, right] = bitree.halves(facet);
    // The left half is the one that keeps the corner a.
    let halves = if facet.corners()[0] == first { [left, right] } else { [right, left] };
    for (half, (sequence, pqr)) in halves.iter().zip(parts) {
        walk(bitree, half, sequence, pqr, out);
    }
}

/// Puts a triangle behind those that are there.
fn append(out: &mut Vec<Point>, [p, q, r]: [Point; 3]) {
    let (last, before) = match out[..] {
        [.., before, last] => (last, before),
        _ => return out.extend([p, q, r]),
    };
    if [before, last] == [p, q] {
        out.push(r);
    } else if last == p {
        // The side turned round, or a longer or shorter one on the same line from the same point.
        out.extend([q, r]);
    } else {
        out.extend([p, q, r]);
    }
}

/// The triangles with area that a strip draws, in its order.
#[must_use]
pub fn triangles(strip: &[Point]) -> Vec<[Point; 3]> {
    strip.windows(3).filter_map(|w| <[Point; 3]>::try_from(w).ok()).filter(|t| !is_line(*t)).collect()
}

/// How many triangles of a strip have no area.
#[must_use]
pub fn line_triangles(strip: &[Point]) -> usize {
    strip.len().saturating_sub(2) - triangles(strip).len()
}

/// Whether three corners lie on one line.
fn is_line([a, b, c]: [Point; 3]) -> bool {
    let d = |p: Point, i: usize| i64::from(p[i]) - i64::from(a[i]);
    d(b, 0) * d(c, 1) == d(b, 1) * d(c, 0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn full(log2: u8) -> Bitree {
        let row = (1usize << log2) + 1;
        Bitree::of(log2, vec![1.0; row * row]).unwrap()
    }

    #[test]
    fn full_grids_take_the_papers_references() {
        let three = strip(&full(1));
        assert_eq!((three.len(), line_triangles(&three)), (15, 5));
        let grid = full(6);
        let sixty_five = strip(&grid);
        assert_eq!(grid.triangle_count() * 3, 24_576);
        assert_eq!((sixty_five.len(), line_triangles(&sixty_five)), (13_655, 5461));
    }

    proptest! {
        #[test]
        fn a_strip_draws_each_triangle_once_and_no_other(
            log2 in 1u8..=5,
            points in prop::collection::vec(([0u32..=32, 0u32..=32], -9i32..9), 0..60)
        ) {
            let mut bitree = Bitree::new(log2, [0.0; 4]).unwrap();
            for (p, h) in points { bitree.add(p, f64::from(h)); }
            let sorted = |mut list: Vec<[Point; 3]>| {
                for t in &mut list { t.sort_unstable(); }
                list.sort_unstable();
                list
            };
            let drawn = sorted(triangles(&strip(&bitree)));
            let there = sorted(bitree.triangles().into_iter().map(|t| t.map(|(p, _)| p)).collect());
            prop_assert_eq!(drawn, there);
        }
    }
}

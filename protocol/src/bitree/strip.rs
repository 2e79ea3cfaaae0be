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
//!
//! The rules fix more than the path: the corners' order in each triangle, too, and with it where a side has to be turned
//! round. [`shortest`] finds those orders that take the fewest references in all, along the path, and in small
//! meshes along other paths, too.
//!
//! Graphics processors take every other triangle of a strip, line triangles counted, the other way round, so that neighbours
//! show the same side. By the rules all triangles turn right then: with a reference twice at the beginning, left.

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
    let mut out = Vec::with_capacity(2 * bitree.triangle_count());
    path(bitree, [false, true], &mut |pqr| append(&mut out, pqr));
    out
}

/// Gives all triangles in the order of the recursion, as the rules refer to them. Both roots have two ways, by the end of the
/// hypotenuse where the path comes into the lower one, and where it goes over into the upper one.
fn path(bitree: &Bitree, from_b: [bool; 2], each: &mut impl FnMut([Point; 3])) {
    let [lower, upper] = bitree.roots();
    let [[a, c, b], [_, opposite, _]] = [lower.corners(), upper.corners()];
    let first = if from_b[0] { [c, b, a] } else { [c, a, b] };
    let second = if from_b[1] { [b, a, opposite] } else { [a, b, opposite] };
    walk(bitree, &lower, Sequence::C, first, each);
    walk(bitree, &upper, Sequence::A, second, each);
}

fn walk(
    bitree: &Bitree,
    facet: &Facet,
    sequence: Sequence,
    pqr: [Point; 3],
    each: &mut impl FnMut([Point; 3]),
) {
    if !bitree.is_split(facet) {
        each(pqr);
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
        walk(bitree, half, sequence, pqr, each);
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

/// The orders of three corners.
const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];

/// The most triangles for which [`shortest`] looks for other paths: in larger meshes they gain one reference in a thousand.
const SMALL: usize = 256;

/// Which way round a strip's triangles are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Winding {
    /// All alike, every other one taken the other way round: so that they show the same side.
    Kept,
    /// Any way, for whoever draws both sides.
    Free,
}

/// A strip that draws exactly the bitree's triangles in the order of the recursion, each with whichever order of its corners
/// makes the whole shortest; of the recursion's four ways through a grid (from either end of the diagonal, and over to either
/// side) the one for which that is least. By dynamic programming: the fewest references until a triangle, for each order of
/// its corners, follow from those until the triangle before. Meshes of up to 256 triangles are also put together from their
/// parts, either half of each triangle first.
///
/// Costs some 150 steps a triangle, a hundred times as many in small meshes, and 50 bytes of memory.
#[must_use]
pub fn shortest(bitree: &Bitree, winding: Winding) -> Vec<Point> {
    let ways = [[false, true], [false, false], [true, true], [true, false]].map(|from_b| {
        let mut triangles = Vec::with_capacity(bitree.triangle_count());
        path(bitree, from_b, &mut |pqr| triangles.push(pqr));
        triangles
    });
    // What is best where all show the same side is not far off where any may be seen.
    let windings: &[Winding] = match winding {
        Winding::Kept => &[Winding::Kept],
        Winding::Free => &[Winding::Free, Winding::Kept],
    };
    let windings = windings.iter().filter(|_| bitree.triangle_count() <= SMALL);
    let others = windings.map(|winding| Orders { winding: *winding, joints: Vec::new() }.of(bitree));
    let strips = ways.into_iter().chain(others).map(|triangles| shortest_through(&triangles, winding));
    strips.min_by_key(Vec::len).unwrap_or_default()
}

/// Orders of triangles that are kept of each part of a bitree while others are joined to it.
const KEPT: usize = 24;

/// References to the end of a run of triangles but for those of its first: by the orders of the first triangle's corners and
/// of the last's.
type Costs = [[u32; 6]; 6];

/// Some order of the triangles of a part.
struct Run {
    ends: [[Point; 3]; 2],
    costs: Costs,
    /// Its place in [`Orders::joints`].
    joint: usize,
}

/// What a run is made of.
enum Joint {
    Leaf([Point; 3]),
    Both([usize; 2]),
}

struct Orders {
    winding: Winding,
    joints: Vec<Joint>,
}

impl Orders {
    /// The triangles in the best order found, from the parts to the whole.
    fn of(mut self, bitree: &Bitree) -> Vec<[Point; 3]> {
        let [lower, upper] = bitree.roots().map(|root| self.runs(bitree, &root));
        let whole = self.joined(&lower, &upper);
        let mut out = Vec::with_capacity(bitree.triangle_count());
        let mut open: Vec<usize> = whole.first().map(|run| run.joint).into_iter().collect();
        while let Some(joint) = open.pop() {
            match self.joints[joint] {
                Joint::Leaf(triangle) => out.push(triangle),
                Joint::Both([first, second]) => open.extend([second, first]),
            }
        }
        out
    }

    fn push(&mut self, joint: Joint) -> usize {
        self.joints.push(joint);
        self.joints.len() - 1
    }

    /// The best orders of what is drawn of a triangle, the best one first.
    fn runs(&mut self, bitree: &Bitree, facet: &Facet) -> Vec<Run> {
        if !bitree.is_split(facet) {
            let triangle = facet.corners();
            let mut costs = [[FAR; 6]; 6];
            (0..6).for_each(|order| costs[order][order] = 0);
            return vec![Run { ends: [triangle; 2], costs, joint: self.push(Joint::Leaf(triangle)) }];
        }
        let [left, right] = bitree.halves(facet).map(|half| self.runs(bitree, &half));
        self.joined(&left, &right)
    }

    /// Each run of one part before and behind each of the other: the best of these.
    fn joined(&mut self, left: &[Run], right: &[Run]) -> Vec<Run> {
        let pairs = left.iter().flat_map(|l| right.iter().flat_map(move |r| [[l, r], [r, l]]));
        let mut found: Vec<_> = pairs
            .map(|[first, second]| {
                let costs = chained(
                    &chained(&first.costs, &self.links(first.ends[1], second.ends[0])),
                    &second.costs,
                );
                (costs.iter().flatten().copied().min(), costs, [first, second])
            })
            .collect();
        found.sort_by_key(|(least, ..)| *least);
        // Of those that begin and end alike one is enough.
        let mut seen = std::collections::HashSet::new();
        found.retain(|(least, costs, [first, second])| {
            seen.insert((*least, *costs, first.ends[0], second.ends[1]))
        });
        found.truncate(KEPT);
        let run = |(_, costs, [first, second]): (Option<u32>, Costs, [&Run; 2])| Run {
            ends: [first.ends[0], second.ends[1]],
            costs,
            joint: self.push(Joint::Both([first.joint, second.joint])),
        };
        found.into_iter().map(run).collect()
    }

    /// References from one triangle to the next, by the orders of their corners.
    fn links(&self, from: [Point; 3], to: [Point; 3]) -> Costs {
        let ordered = |triangle: [Point; 3]| ORDERS.map(|order| order.map(|corner| triangle[corner]));
        let count = |from, to| u32::try_from(link(from, to, self.winding).1).unwrap_or(FAR);
        ordered(from).map(|from| ordered(to).map(|to| count(from, to)))
    }
}

/// More than any strip has; three times that is a number still.
const FAR: u32 = u32::MAX / 4;

/// The least costs of one run and then the next.
fn chained(first: &Costs, second: &Costs) -> Costs {
    first.map(|row| {
        let mut least = [FAR; 6];
        for (cost, row) in row.iter().zip(second) {
            for (least, more) in least.iter_mut().zip(row) {
                *least = (*least).min(cost + more);
            }
        }
        least
    })
}

/// The fewest references through triangles in their order.
fn shortest_through(triangles: &[[Point; 3]], winding: Winding) -> Vec<Point> {
    let ordered = |i: usize, order: usize| ORDERS[order].map(|corner| triangles[i][corner]);
    // By order: the fewest references so far; and of each triangle, the order before that led to them.
    let mut fewest = [3usize; 6];
    let mut before: Vec<[u8; 6]> = vec![[0; 6]];
    for i in 1..triangles.len() {
        let mut next = [(usize::MAX, 0u8); 6];
        for (order, best) in next.iter_mut().enumerate() {
            for (last, so_far) in (0u8..).zip(fewest) {
                let total = so_far + link(ordered(i - 1, last.into()), ordered(i, order), winding).1;
                *best = (*best).min((total, last));
            }
        }
        fewest = next.map(|(total, _)| total);
        before.push(next.map(|(_, last)| last));
    }
    // Back from the best end.
    let mut order = (0u8..).zip(fewest).min_by_key(|(_, total)| *total).map_or(0, |(order, _)| order);
    let mut orders = vec![0; triangles.len()];
    for i in (0..triangles.len()).rev() {
        orders[i] = usize::from(order);
        order = before[i][usize::from(order)];
    }
    let mut out = Vec::new();
    for i in 0..triangles.len() {
        let to = ordered(i, orders[i]);
        if i == 0 {
            out.extend(to);
        } else {
            let (references, count) = link(ordered(i - 1, orders[i - 1]), to, winding);
            out.extend(&references[references.len() - count..]);
        }
    }
    out
}

/// The fewest references that lead from one triangle of a strip to another with nothing but lines between: of these six the
/// last ones, as many as told.
fn link(from: [Point; 3], [p, q, r]: [Point; 3], winding: Winding) -> ([Point; 6], usize) {
    let [_, u, v] = from;
    let (goes_on_to_p, starts_towards_q) = (is_line([u, v, p]), is_line([v, p, q]));
    let count = match () {
        () if [u, v] == [p, q] => 1,
        () if v == p && is_line([u, p, q]) => 2,
        () if goes_on_to_p && starts_towards_q => 3,
        () if goes_on_to_p || starts_towards_q => 4,
        () => 5,
    };
    // Each reference turns what comes next the other way round. Twice the same makes two lines of whatever stands around it.
    let turns = is_left(from) != is_left([p, q, r]);
    let once_more = winding == Winding::Kept && turns != (count % 2 == 1);
    let total = count + usize::from(once_more);
    let mut references = [p, p, p, p, q, r];
    if count > 3 && !(count == 4 && goes_on_to_p) {
        references[6 - total] = v;
    }
    (references, total)
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
fn is_line(corners: [Point; 3]) -> bool {
    doubled_area(corners) == 0
}

/// Whether three corners turn left.
#[must_use]
pub fn is_left(corners: [Point; 3]) -> bool {
    doubled_area(corners) > 0
}

fn doubled_area([a, b, c]: [Point; 3]) -> i64 {
    let d = |p: Point, i: usize| i64::from(p[i]) - i64::from(a[i]);
    d(b, 0) * d(c, 1) - d(b, 1) * d(c, 0)
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

    #[test]
    fn the_shortest_orders_of_small_grids_are_known() {
        // Two triangles share a side: nobody needs more than the four corners. Four around a centre: six at least.
        let square = Bitree::new(1, [0.0; 4]).unwrap();
        let lengths = |bitree: &Bitree| [Winding::Kept, Winding::Free].map(|w| shortest(bitree, w).len());
        assert_eq!((strip(&square).len(), lengths(&square)), (5, [4, 4]));
        let mut four = square;
        four.add([1, 1], 1.0);
        assert_eq!((strip(&four).len(), lengths(&four)), (7, [7, 7]));
        // Six around a centre, on two of whose outer sides a point lies: nine, found by trying all strips.
        let mut six = Bitree::new(1, [0.0; 4]).unwrap();
        for p in [[1, 2], [0, 1], [1, 1]] {
            six.add(p, 1.0);
        }
        assert_eq!((six.triangle_count(), lengths(&six)), (6, [9, 9]));
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
            let there = sorted(bitree.triangles().into_iter().map(|t| t.map(|(p, _)| p)).collect());
            let by_rules = strip(&bitree);
            let [kept, free] = [Winding::Kept, Winding::Free].map(|winding| shortest(&bitree, winding));
            prop_assert!(free.len() <= kept.len() && kept.len() <= by_rules.len());
            for strip in [&by_rules, &kept, &free] {
                prop_assert_eq!(&sorted(triangles(strip)), &there);
            }
            for strip in [&by_rules, &kept] {
                let areas = strip.array_windows().map(|corners| doubled_area(*corners)).enumerate();
                let mut turns = areas.filter(|(_, area)| *area != 0).map(|(i, area)| (area > 0) == (i % 2 == 0));
                let first = turns.next();
                prop_assert!(turns.all(|turn| Some(turn) == first), "triangles show both sides");
            }
        }
    }
}

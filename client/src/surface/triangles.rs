//! The triangles of a split diamond, as index lists: one list for each of its four sides.
//!
//! A split puts a new point in the middle of each cell of the old grid. The sides of the cells are the
//! hypotenuses of the new micro-triangles, and the new point is their apex, so each cell has four:
//!
//! ```text
//!   +-------+        Seen whole, the micro-triangle over side s of a cell belongs to the triangle of
//!   | \ 2 / |        the split in which it lies: 0 is south, 1 east, 2 north, 3 west of the diamond's
//!   | 3 * 1 |        centre, in local coordinates. Micro-triangles never straddle the diagonals that
//!   | / 0 \ |        part the four, since those diagonals run along cells' diagonals.
//!   +-------+
//! ```
//!
//! Each list has n^2 triangles, which turn left seen from above. Where centres are no points (see
//! [`diamantina_protocol::diamond`]), cells have two triangles, cut along diagonals that alternate as the
//! bintree's do, and each list has n^2 / 2.

use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Block;
use std::ops::Range;

/// Index lists, one after the other in the order of the sides.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Lists {
    /// Slots of a block, three a triangle. 16 bits are enough: n = 128 has 33,025 slots.
    pub(crate) indices: Vec<u16>,
    /// Where each side's list lies in `indices`.
    pub(crate) sides: [Range<u32>; 4],
}

/// The form of a local grid: what all diamonds of this many segments, with centres or without, share.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Form {
    pub(crate) segments: usize,
    pub(crate) centres: bool,
}

impl Form {
    pub(crate) fn of(block: &Block) -> Self {
        Self { segments: block.segments(), centres: block.has_centres() }
    }

    /// Of the diamonds of a level.
    pub(crate) fn at(forest: &Forest, level: u32) -> Self {
        Self { segments: forest.segments_at(level), centres: forest.adds_points(level) || level % 2 == 1 }
    }

    /// Bytes of GPU memory that places and index lists take; with `wires` also the lines around triangles.
    pub(crate) fn gpu_bytes(self, wires: bool) -> u64 {
        let cells = self.segments.pow(2);
        let (slots, indices) = if self.centres { (cells, 12 * cells) } else { (0, 6 * cells) };
        let slots = (self.segments + 1).pow(2) + slots;
        (4 * slots + 2 * indices.next_multiple_of(2) + if wires { 4 * indices } else { 0 }) as u64
    }
}

/// The lists of a diamond, of those triangles whose three slots `keep` wants.
pub(crate) fn lists(form: Form, keep: impl Fn(usize) -> bool) -> Lists {
    let n = form.segments;
    let mut parts: [Vec<u16>; 4] = std::array::from_fn(|_| Vec::new());
    for v in 0..n {
        for u in 0..n {
            let corner = |du: usize, dv: usize| Block::slot(n, 2 * (u + du), 2 * (v + dv));
            let corners = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
            let mut add = |side: usize, triangle: [usize; 3]| {
                if triangle.iter().all(|slot| keep(*slot)) {
                    parts[side].extend(triangle.map(|s| u16::try_from(s).unwrap_or(0)));
                }
            };
            if form.centres {
                let apex = Block::slot(n, 2 * u + 1, 2 * v + 1);
                for (side, centroid) in [[3, 1], [5, 3], [3, 5], [1, 3]].into_iter().enumerate() {
                    add(side_of(n, u, v, centroid), [corners[side], corners[(side + 1) % 4], apex]);
                }
            } else {
                let [a, b, c, d] = corners;
                let halves = if (u + v).is_multiple_of(2) {
                    [([a, b, c], [4, 2]), ([a, c, d], [2, 4])]
                } else {
                    [([a, b, d], [2, 2]), ([b, c, d], [4, 4])]
                };
                for (triangle, centroid) in halves {
                    add(side_of(n, u, v, centroid), triangle);
                }
            }
        }
    }
    Lists::of(&parts)
}

impl Lists {
    /// Those of the four sides.
    pub(crate) fn of(parts: &[Vec<u16>; 4]) -> Self {
        let mut end = 0;
        let sides = parts.each_ref().map(|part| {
            let start = end;
            end += u32::try_from(part.len()).unwrap_or(0);
            start..end
        });
        Self { indices: parts.concat(), sides }
    }
}

/// The lists of a diamond with nodata: triangles with a point that has no height are dropped.
pub(crate) fn lists_of(block: &Block) -> Lists {
    lists(Form::of(block), |slot| block.heights()[slot] != NODATA)
}

/// The triangle of the split in which a micro-triangle of the cell (u, v) lies. Its centroid is given as three
/// times its doubled coordinates in the cell.
fn side_of(n: usize, u: usize, v: usize, [east, north]: [usize; 2]) -> usize {
    // The diamond's centre is at 3n.
    let (x, y, centre) = (6 * u + east, 6 * v + north, 3 * n);
    match (x.abs_diff(centre) > y.abs_diff(centre), x > centre, y > centre) {
        (true, true, _) => 1,
        (true, false, _) => 3,
        (false, _, true) => 2,
        (false, _, false) => 0,
    }
}

/// Doubled local coordinates (2u, 2v) of each slot of a block.
pub(crate) fn places(form: Form) -> Vec<[u16; 2]> {
    let n = form.segments;
    let step = if form.centres { 1 } else { 2 };
    let mut places = vec![[0; 2]; (n + 1) * (n + 1) + if form.centres { n * n } else { 0 }];
    for q in (0..=2 * n).step_by(step) {
        for p in (q % 2..=2 * n).step_by(2) {
            places[Block::slot(n, p, q)] = [p, q].map(|i| u16::try_from(i).unwrap_or(0));
        }
    }
    places
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::{BTreeMap, BTreeSet};

    type Place = [i64; 2];

    fn form(segments: usize) -> Form {
        Form { segments, centres: true }
    }

    fn triangles(n: usize) -> [Vec<[Place; 3]>; 4] {
        triangles_of(form(n))
    }

    fn triangles_of(form: Form) -> [Vec<[Place; 3]>; 4] {
        let (lists, places) = (lists(form, |_| true), places(form));
        lists.sides.map(|range| {
            lists.indices[range.start as usize..range.end as usize]
                .chunks(3)
                .map(|t| [0, 1, 2].map(|i| places[usize::from(t[i])].map(i64::from)))
                .collect()
        })
    }

    fn double_area([a, b, c]: [Place; 3]) -> i64 {
        (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    }

    #[test]
    fn each_side_has_n_squared_triangles_that_turn_left() {
        for n in [4usize, 8, 64, 128] {
            for list in triangles(n) {
                assert_eq!(list.len(), n * n);
                // A quarter of the square of 2n, all in micro-triangles of area 1.
                assert!(list.iter().all(|t| double_area(*t) == 2));
            }
        }
    }

    /// Past the finest lattice the triangles are those of the lattice's last level, in smaller diamonds.
    #[test]
    fn cells_without_centres_are_halved_as_the_bintree_halves_them() {
        for n in [2usize, 4, 64] {
            let form = Form { segments: n, centres: false };
            let mut edges = BTreeMap::new();
            for (side, list) in triangles_of(form).into_iter().enumerate() {
                assert_eq!(list.len(), n * n / 2, "side {side} of {n}");
                let m = i64::try_from(n).unwrap();
                for triangle in list {
                    assert_eq!(double_area(triangle), 4, "half of a cell, turning left");
                    // All of it lies between the diagonals that part the side from its neighbours.
                    for [x, y] in triangle.map(|[p, q]| [p - m, q - m]) {
                        let turned = [[x, y], [y, -x], [-x, -y], [-y, x]][side];
                        assert!(turned[1] <= 0 && turned[0].abs() <= -turned[1], "{side} {turned:?}");
                    }
                    let [a, b, c] = triangle;
                    for (from, to) in [(a, b), (b, c), (c, a)] {
                        assert_eq!(edges.insert((from, to), ()), None, "an edge is walked once each way");
                    }
                }
            }
            // Neighbouring cells are cut the other way.
            let rising = |[p, q]: Place| edges.contains_key(&([p, q], [p + 2, q + 2]));
            assert!(rising([0, 0]) && !rising([2, 0]) && !rising([0, 2]) && (n == 2 || rising([2, 2])));
        }
    }

    #[test]
    fn the_lists_cover_the_square_exactly() {
        let n = 8i64;
        let mut covered = BTreeMap::new();
        for list in triangles(8) {
            for [a, b, c] in list {
                // A triangle of area 1 is known by its hypotenuse and its side: its centroid, times 3.
                let centroid = [a[0] + b[0] + c[0], a[1] + b[1] + c[1]];
                assert!((0..=6 * n).contains(&centroid[0]) && (0..=6 * n).contains(&centroid[1]));
                *covered.entry(centroid).or_insert(0) += 1;
            }
        }
        assert!(covered.values().all(|count| *count == 1), "no triangle twice");
        assert_eq!(covered.len(), 4 * 8 * 8, "areas add up to the square's");
        // Every inner edge has two triangles, every edge of the square one: so nothing overlaps.
        let mut edges = BTreeMap::new();
        for [a, b, c] in triangles(8).concat() {
            for (from, to) in [(a, b), (b, c), (c, a)] {
                assert_eq!(edges.insert((from, to), ()), None, "an edge is walked once each way");
            }
        }
        let border = |p: &Place| p.iter().any(|i| *i == 0 || *i == 2 * n);
        for (from, to) in edges.keys() {
            let outer = border(from) && border(to) && (from[0] == to[0] || from[1] == to[1]);
            assert_eq!(edges.contains_key(&(*to, *from)), !outer, "{from:?} {to:?}");
        }
    }

    /// The same triangles, found the other way: walking the local grid of the child at each side.
    #[test]
    fn the_triangles_are_those_of_the_childs_local_grid() {
        let n = 8i64;
        let ends = [
            [[0, 0], [2 * n, 0]],
            [[2 * n, 0], [2 * n, 2 * n]],
            [[2 * n, 2 * n], [0, 2 * n]],
            [[0, 2 * n], [0, 0]],
        ];
        for (side, list) in triangles(8).into_iter().enumerate() {
            // Seen from inside, the child's hypotenuse runs from b to a: its lower triangle turns left.
            let [b, a] = ends[side];
            let apex = [n, n];
            let step = |from: Place, to: Place| [(to[0] - from[0]) / n, (to[1] - from[1]) / n];
            let (u, v) = (step(a, apex), step(apex, b));
            let at = |i: i64, j: i64| [a[0] + u[0] * i + v[0] * j, a[1] + u[1] * i + v[1] * j];
            let sorted = |mut t: [Place; 3]| {
                t.sort_unstable();
                t
            };
            let mut expected = BTreeSet::new();
            for j in 0..n {
                for i in j..n {
                    let (low, high) = ((i, j), (i + 1, j + 1));
                    let (east, west) = ((i + 1, j), (i, j + 1));
                    let pair = if (i + j) % 2 == 0 {
                        [[low, east, high], [low, high, west]]
                    } else {
                        [[low, east, west], [east, high, west]]
                    };
                    let count = if i == j { 1 } else { 2 };
                    for t in &pair[..count] {
                        expected.insert(sorted(t.map(|(i, j)| at(i, j))));
                    }
                }
            }
            let found: BTreeSet<_> = list.into_iter().map(sorted).collect();
            assert_eq!(found, expected, "side {side}");
        }
    }

    #[test]
    fn hypotenuses_join_old_points_and_apexes_are_new() {
        for [a, b, c] in triangles(8).concat() {
            assert!(a.iter().chain(&b).all(|i| i % 2 == 0) && c.iter().all(|i| i % 2 == 1));
            assert_eq!((a[0] - b[0]).abs() + (a[1] - b[1]).abs(), 2, "one step of the old grid");
        }
    }

    #[test]
    fn a_side_has_the_points_of_the_old_grids_side() {
        let n = 8;
        for (side, list) in triangles(8).into_iter().enumerate() {
            let on_side = |p: &Place| match side {
                0 => p[1] == 0,
                1 => p[0] == 2 * n,
                2 => p[1] == 2 * n,
                _ => p[0] == 0,
            };
            let points: BTreeSet<_> = list.into_iter().flatten().filter(on_side).collect();
            assert_eq!(points.len(), 8 + 1);
            assert!(points.iter().all(|p| p.iter().all(|i| i % 2 == 0)));
        }
    }

    #[test]
    fn triangles_without_a_point_are_dropped() {
        let (n, all) = (4, lists(form(4), |_| true));
        let hole = Block::slot(n, 1, 1);
        let some = lists(form(n), |slot| slot != hole);
        assert_eq!(all.indices.len() - some.indices.len(), 4 * 3, "the four triangles of a cell");
        assert!(!some.indices.contains(&u16::try_from(hole).unwrap()));
        assert_eq!(some.sides[3].end as usize, some.indices.len());
    }
}

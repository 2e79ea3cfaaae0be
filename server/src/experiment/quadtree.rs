//! The restricted quadtree, the baseline: whoever selects a point selects all that it depends on.
//!
//! A point depends on the apexes of the one or two triangles that it is the middle of, and those on theirs, up to the
//! corners; with them the triangulation is conforming, levels of neighbours differ by one at most, and
//! every point has its own height and is transmitted. After Pajarola, *Large Scale Terrain Visualization
//! Using the Restricted Quadtree Triangulation* (1998), whose two kinds of dependency (centres and others)
//! are one in the bintree.

use super::field::Field;
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::{Bitree, Facet, level};

/// Adds to a selection all points that it depends on, each with the height of its own sample. Where a point
/// that is needed has no data, its height is the mean that a bitree would deduce. Linear in the grid.
#[must_use]
pub fn close(field: &Field, selected: &Bitree) -> Bitree {
    let own = |slot: usize| selected.real(field.point(slot));
    let closed = closure(field, (0..field.heights().len()).map(|slot| own(slot).is_some()).collect());
    let height =
        |slot: usize| own(slot).unwrap_or(if closed[slot] { field.heights()[slot] } else { f64::NAN });
    let mut tree = field.tree();
    // From coarse to fine, so that what has no data is deduced from heights that stay.
    let mut order: Vec<usize> = (0..closed.len()).filter(|slot| closed[*slot]).collect();
    order.sort_by_key(|slot| level(field.log2(), field.point(*slot)));
    for slot in order {
        let (point, height) = (field.point(slot), height(slot));
        let deduced = || {
            let [ha, _, hb] = tree.around(point).into_iter().flatten().next()?.heights();
            Some((ha + hb) / 2.0)
        };
        if let Some(height) = if height.is_nan() { deduced() } else { Some(height) } {
            tree.add(point, height);
        }
    }
    tree
}

/// The dependencies of what is wanted, level by level from the finest up.
fn closure(field: &Field, mut wanted: Vec<bool>) -> Vec<bool> {
    let side = field.side();
    let log2 = field.log2();
    for up in 0..u32::from(log2) {
        let s = 1u32 << up;
        // Middles of sides first, the finer of the two levels with this spacing; then centres.
        for odd in [1, 0] {
            for y in (0..=side).step_by(s as usize) {
                for x in (0..=side).step_by(s as usize) {
                    let (i, j) = (x >> up & 1, y >> up & 1);
                    let is_side = i + j == 1;
                    let is_centre = i + j == 2;
                    if !wanted[field.slot([x, y])] || !(if odd == 1 { is_side } else { is_centre }) {
                        continue;
                    }
                    for apex in apexes(log2, [x, y], s, side).into_iter().flatten() {
                        wanted[field.slot(apex)] = true;
                    }
                }
            }
        }
    }
    wanted
}

/// The corners opposite to the hypotenuse of which a point is the middle.
fn apexes(log2: u8, [x, y]: Point, s: u32, side: u32) -> [Option<Point>; 2] {
    let within = |p: [Option<u32>; 2]| match p {
        [Some(px), Some(py)] if px <= side && py <= side => Some([px, py]),
        _ => None,
    };
    let (west, east) = (x.checked_sub(s), x.checked_add(s));
    let (south, north) = (y.checked_sub(s), y.checked_add(s));
    if level(log2, [x, y]).is_multiple_of(2) {
        // The middle of a side: the hypotenuse runs along it.
        return if x / s % 2 == 1 {
            [within([Some(x), south]), within([Some(x), north])]
        } else {
            [within([west, Some(y)]), within([east, Some(y)])]
        };
    }
    // A centre: its square's diagonal joins the two corners of coarser lattices; the apexes are the others,
    // the middles of the larger square's sides. Diagonals alternate from square to square.
    let even = (x / s / 2 + y / s / 2).is_multiple_of(2);
    if even {
        [within([east, south]), within([west, north])]
    } else {
        [within([east, north]), within([west, south])]
    }
}

/// The quadtree's own selection, from the top: splits both triangles at a hypotenuse while `error` of either
/// is more than `tolerance` (it may stop counting beyond that), and whatever they depend on. All heights are samples'; no smaller
/// quadtree holds every triangle within the tolerance. See [`complete`] of `blindly`.
pub fn select(field: &Field, tolerance: f64, blindly: bool, error: impl Fn(&Facet, f64) -> f64) -> Bitree {
    complete(field, &field.tree(), tolerance, blindly, error)
}

/// The smallest quadtree within the tolerance that has all points of a selection. A selection that is within it by
/// itself may leave it when it is closed, as the points that it depends on move the surface; then more have to split.
///
/// A middle without data cannot be transmitted. Where an error tells which sample is wrong, that sample makes the triangle
/// split; where it does not (`blindly`), the coarsest sample below that has data does.
pub fn complete(
    field: &Field,
    selected: &Bitree,
    tolerance: f64,
    blindly: bool,
    error: impl Fn(&Facet, f64) -> f64,
) -> Bitree {
    let full = field.full_tree();
    let is_selected = |slot: usize| selected.real(field.point(slot)).is_some();
    let mut wanted = closure(field, (0..field.heights().len()).map(is_selected).collect());
    let mut open = full.roots().to_vec();
    while let Some(facet) = open.pop() {
        if !full.is_split(&facet) {
            continue;
        }
        if wanted[field.slot(facet.middle())] {
            open.extend(full.halves(&facet));
        } else if error(&facet, tolerance) > tolerance {
            let middle = facet.middle();
            let is_blind = blindly && field.at(middle).is_nan();
            let below = if is_blind { field.known_below(facet.corners()) } else { None };
            force(field, &full, below.unwrap_or(middle), &mut wanted, &mut open);
        }
    }
    let mut tree = selected.clone();
    for slot in (0..wanted.len()).filter(|slot| wanted[*slot]) {
        tree.add(field.point(slot), field.heights()[slot]);
    }
    close(field, &tree)
}

/// Splits at a point, after all that it depends on, and opens what comes of it.
fn force(field: &Field, full: &Bitree, point: Point, wanted: &mut [bool], open: &mut Vec<Facet>) {
    let log2 = field.log2();
    let mut stack = vec![point];
    while let Some(p) = stack.pop() {
        let slot = field.slot(p);
        if wanted[slot] || level(log2, p) == 0 {
            continue;
        }
        wanted[slot] = true;
        let [x, y] = p;
        let s = 1 << (x | y).trailing_zeros();
        stack.extend(apexes(log2, p, s, field.side()).into_iter().flatten());
        for facet in full.around(p).into_iter().flatten() {
            open.extend(full.halves(&facet));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn apexes_are_those_of_the_triangles() {
        let grid = Bitree::of(3, vec![0.0; 81]).unwrap();
        for y in 0..=8 {
            for x in 0..=8u32 {
                if level(3, [x, y]) == 0 {
                    continue;
                }
                let s = 1 << (x | y).trailing_zeros();
                let mut found: Vec<Point> = apexes(3, [x, y], s, 8).into_iter().flatten().collect();
                let mut expected: Vec<Point> =
                    grid.around([x, y]).into_iter().flatten().map(|t| t.corners()[1]).collect();
                found.sort_unstable();
                expected.sort_unstable();
                assert_eq!(found, expected, "{x} {y}");
            }
        }
    }

    proptest! {
        #[test]
        fn a_closed_selection_is_conforming_and_all_of_it_is_real(
            points in prop::collection::vec([0u32..=32, 0u32..=32], 0..20)
        ) {
            let heights = (0..33 * 33).map(|i| f64::from(i * 7919 % 101)).collect();
            let field = Field::new(5, heights, [1.0, 1.0]).unwrap();
            let mut selected = field.tree();
            for p in points { selected.add(p, field.at(p)); }
            let closed = close(&field, &selected);
            prop_assert_eq!(closed.points().1, 0, "nothing is fictitious");
            prop_assert_eq!(closed.triangles_closed().len(), closed.triangle_count(), "no T-junctions");
            for slot in 0..33 * 33 {
                let p = field.point(slot);
                prop_assert!(selected.real(p).is_none() || closed.real(p).is_some());
            }
        }
    }
}

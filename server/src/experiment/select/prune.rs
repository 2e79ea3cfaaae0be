//! Takes out again what a selection does not need.
//!
//! Without a point only the one or two triangles at whose middle it stands change, and what is drawn below
//! them; the triangles above lie on the same surface whether they are split or not. So a point may go if all
//! drawn triangles below those two stay within the tolerance. The finest go first: there are most of them, and each
//! that goes may let its triangle vanish.

use super::{Criterion, Ground};
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::Bitree;
use std::ops::ControlFlow;

/// Times that all points are tried: later passes find a handful.
const PASSES_MAX: usize = 3;

/// Removes points while every triangle stays within `tolerance`. If all were before, all are after.
pub fn prune(ground: &Ground<'_>, criterion: Criterion, tolerance: f64, tree: &mut Bitree) {
    let all = all(ground, tree);
    prune_among(ground, criterion, tolerance, tree, all);
}

/// The same where it is known which of its points might go.
pub(super) fn prune_among(
    ground: &Ground<'_>,
    criterion: Criterion,
    tolerance: f64,
    tree: &mut Bitree,
    mut may_go: Vec<Point>,
) {
    for _ in 0..PASSES_MAX {
        // The finest first, and row by row.
        may_go.sort_unstable_by_key(|p| (std::cmp::Reverse(tree.level(*p)), p[1], p[0]));
        let mut removed = 0;
        for point in may_go {
            if has_to_stay(ground, criterion, tolerance, tree, point) {
                continue;
            }
            let Some(height) = tree.remove(point) else { continue };
            if is_good(ground, criterion, tolerance, tree, point) {
                removed += 1;
            } else {
                tree.add(point, height);
            }
        }
        if removed == 0 {
            return;
        }
        may_go = all(ground, tree);
    }
}

/// Whether a point's own sample would be off by more than the tolerance without it: told at once, and true of most.
fn has_to_stay(
    ground: &Ground<'_>,
    criterion: Criterion,
    tolerance: f64,
    tree: &Bitree,
    point: Point,
) -> bool {
    let Some(facet) = tree.around(point).into_iter().flatten().next() else { return false };
    let [ha, _, hb] = facet.heights();
    let off = ground.field().at(point) - (ha + hb) / 2.0;
    criterion.is_beyond(ground, ground.field().slot(point), off, tolerance)
}

/// Every real point; the corners, which always stay, do no harm.
fn all(ground: &Ground<'_>, tree: &Bitree) -> Vec<Point> {
    let field = ground.field();
    let points = (0..field.heights().len()).map(|slot| field.point(slot));
    points.filter(|p| tree.real(*p).is_some()).collect()
}

/// Whether all that is drawn around a point is within the tolerance.
fn is_good(ground: &Ground<'_>, criterion: Criterion, tolerance: f64, tree: &Bitree, point: Point) -> bool {
    let within =
        |found: f64| if found > tolerance { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
    tree.around(point).into_iter().flatten().all(|facet| {
        tree.leaves(&facet, &mut |leaf| within(criterion.error(ground, leaf, tolerance))).is_continue()
    })
}

//! Takes out again what a selection does not need.
//!
//! Without a point only the one or two triangles at whose middle it stands change, and what is drawn below
//! them; the triangles above lie on the same surface whether they are split or not. So a point may go if all
//! drawn triangles below those two stay within the tolerance. The finest go first: there are most of them, and each
//! that goes may let its triangle vanish.

use super::top_down::diamonds;
use super::{Criterion, Ground};
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::Bitree;
use std::ops::ControlFlow;

/// Times that points are tried: later passes find a handful.
const PASSES_MAX: usize = 3;

/// Removes points while every triangle stays within `tolerance`. If all were before, all are after.
pub fn prune(ground: &Ground<'_>, criterion: Criterion, tolerance: f64, tree: &mut Bitree) {
    let all = real_points(tree);
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
    // The finest first, and row by row.
    may_go.sort_unstable_by_key(|p| (std::cmp::Reverse(tree.level(*p)), p[1], p[0]));
    let mut last: Option<Areas> = None;
    for pass in 1..=PASSES_MAX {
        let mut removed = Areas::new(tree.log2());
        for point in may_go {
            if has_to_stay(ground, criterion, tolerance, tree, point) {
                continue;
            }
            // Where nothing has changed since it was tried, it would stay again.
            let is_tried = last.as_ref().is_some_and(|last| !last.overlap(point) && !removed.overlap(point));
            if !is_tried
                && is_good_without(ground, criterion, tolerance, tree, point)
                && tree.remove(point).is_some()
            {
                removed.insert(point);
            }
        }
        if removed.is_empty() || pass == PASSES_MAX {
            return;
        }
        may_go = real_points(tree);
        last = Some(removed);
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
    let Some(without) = tree.height_without(point) else { return true };
    criterion.is_beyond(ground, ground.field().slot(point), ground.field().at(point) - without, tolerance)
}

/// The real points, the finest first, and row by row; without the corners, which always stay.
fn real_points(tree: &Bitree) -> Vec<Point> {
    let mut points = Vec::new();
    for level in (0..2 * tree.log2()).rev() {
        diamonds(tree.log2(), level, |middle, _| {
            if tree.real(middle).is_some() {
                points.push(middle);
            }
        });
    }
    points
}

/// Whether all that would be drawn otherwise without a point would be within the tolerance.
fn is_good_without(
    ground: &Ground<'_>,
    criterion: Criterion,
    tolerance: f64,
    tree: &Bitree,
    point: Point,
) -> bool {
    let within =
        |found: f64| if found > tolerance { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
    tree.around(point).into_iter().flatten().all(|facet| {
        let visit = &mut |leaf: &_| within(criterion.error(ground, leaf, tolerance));
        tree.changes_without_middle(&facet, visit).is_continue()
    })
}

/// The squares around points that reach as far as the triangles in whose middle these stand: 2^z cells to each side,
/// z being the number of times that both coordinates can be halved. So they lie on the lattice of that step.
struct Areas {
    log2: u8,
    /// By z: the cells of 2^z that are covered by squares of this and finer steps, and by those of this step alone.
    cells: Vec<[Vec<u64>; 2]>,
}

impl Areas {
    fn new(log2: u8) -> Self {
        let words = |z: u8| (1usize << (2 * (log2 - z))).div_ceil(64);
        let cells = (0..=log2).map(|z| [vec![0; words(z)], vec![0; words(z)]]).collect();
        Self { log2, cells }
    }

    fn is_empty(&self) -> bool {
        // Every square lies in the one cell as large as the grid.
        self.cells.last().is_none_or(|[upto, _]| upto.iter().all(|word| *word == 0))
    }

    fn insert(&mut self, point: Point) {
        let own = zeros(point);
        for z in own..=u32::from(self.log2) {
            for cell in cells(self.log2, point, own, z) {
                let bit = 1 << (cell % 64);
                let [upto, exact] = &mut self.cells[z as usize];
                upto[cell / 64] |= bit;
                if z == own {
                    exact[cell / 64] |= bit;
                }
            }
        }
    }

    /// Whether the square around a point shares a cell with any of them.
    fn overlap(&self, point: Point) -> bool {
        let own = zeros(point).min(u32::from(self.log2));
        (own..=u32::from(self.log2)).any(|z| {
            let [upto, exact] = &self.cells[z as usize];
            let covered = if z == own { upto } else { exact };
            cells(self.log2, point, own, z).any(|cell| covered[cell / 64] >> (cell % 64) & 1 == 1)
        })
    }
}

/// The times that both coordinates can be halved.
fn zeros([x, y]: Point) -> u32 {
    (x | y).trailing_zeros()
}

/// The numbers of the cells of 2^z, on a grid, in which the square of 2^`own` cells to each side of a point lies, z being
/// no less than `own`; some twice.
fn cells(log2: u8, [x, y]: Point, own: u32, z: u32) -> impl Iterator<Item = usize> {
    let side = 1usize << log2;
    // By the middles of the square's quarters.
    let along = move |w: u32, forth: bool| {
        let middle = 2 * w as usize + (usize::from(forth) << (own + 1));
        let middle = middle.checked_sub(1 << own)?;
        (middle < 2 * side).then_some(middle >> (z + 1))
    };
    [(false, false), (true, false), (false, true), (true, true)]
        .into_iter()
        .filter_map(move |(east, north)| Some((along(y, north)? * (side >> z)) + along(x, east)?))
}

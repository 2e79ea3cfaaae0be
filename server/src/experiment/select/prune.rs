//! Takes out again what a selection does not need.
//!
//! Without a point only the one or two triangles at whose middle it stands change, and what is drawn below
//! them; the triangles above lie on the same surface whether they are split or not. So a point may go if all
//! drawn triangles below those two stay within the tolerance. The finest go first: there are most of them, and each
//! that goes may let its triangle vanish.

use super::top_down::diamonds;
use super::{Criterion, Ground};
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::{Bitree, Facet};
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
    let within = |leaf: &Facet| match criterion.exceeds(ground, leaf.corners(), leaf.heights(), tolerance) {
        true => ControlFlow::Break(()),
        false => ControlFlow::Continue(()),
    };
    let mut last: Option<Areas> = None;
    for pass in 1..=PASSES_MAX {
        let mut removed = Areas::new(tree.log2());
        for point in may_go {
            // Where nothing has changed since it was tried, it would stay again.
            let is_tried = last.as_ref().is_some_and(|last| !last.overlap(point)) && !removed.overlap(point);
            if !is_tried
                && !has_to_stay(ground, criterion, tolerance, tree, point)
                && tree.remove_if(point, within).is_some()
            {
                removed.insert(point);
            }
        }
        if removed.is_empty() || pass == PASSES_MAX {
            return;
        }
        may_go = real_points(tree);
        removed.complete();
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

/// The squares around points that reach as far as the triangles in whose middle these stand: 2^z cells to each side,
/// z being the number of times that both coordinates can be halved. So each is four cells of the lattice of that step.
struct Areas {
    log2: u8,
    /// By z and cell of 2^z, in bits.
    cells: Vec<Vec<u8>>,
}

/// A square of this step covers the cell.
const OWN: u8 = 1;
/// Squares of finer steps lie in it.
const FINER: u8 = 2;
/// Squares of coarser steps cover it.
const COARSER: u8 = 4;

impl Areas {
    fn new(log2: u8) -> Self {
        let cells = (0..=log2).map(|z| vec![0; 1 << (2 * (log2 - z))]).collect();
        Self { log2, cells }
    }

    fn is_empty(&self) -> bool {
        // Every square lies in the one cell as large as the grid.
        self.cells.last().is_none_or(|whole| *whole == [0])
    }

    fn insert(&mut self, point: Point) {
        for mut cell in self.square(point) {
            let mut z = zeros(point);
            self.cells[z][cell] |= OWN;
            while z < usize::from(self.log2) {
                let row = usize::from(self.log2) - z;
                let [x, y] = [cell & ((1 << row) - 1), cell >> row];
                (z, cell) = (z + 1, (y >> 1 << (row - 1)) + (x >> 1));
                if self.cells[z][cell] & FINER != 0 {
                    break;
                }
                self.cells[z][cell] |= FINER;
            }
        }
    }

    /// Whether the square around a point shares a cell with any of them that is no coarser, in a pass that comes from the finest
    /// with all there are; once they are complete, with any.
    fn overlap(&self, point: Point) -> bool {
        self.square(point).any(|cell| self.cells[zeros(point)][cell] != 0)
    }

    /// No more points come: tells finer cells of the coarser squares over them, too.
    fn complete(&mut self) {
        for z in (1..=self.log2.into()).rev() {
            let row = usize::from(self.log2) - z;
            for cell in 0..self.cells[z].len() {
                if self.cells[z][cell] & (OWN | COARSER) != 0 {
                    let [x, y] = [cell & ((1 << row) - 1), cell >> row];
                    for below in [2 * y, 2 * y + 1].map(|y| (y << (row + 1)) + 2 * x) {
                        self.cells[z - 1][below] |= COARSER;
                        self.cells[z - 1][below + 1] |= COARSER;
                    }
                }
            }
        }
    }

    /// The cells of a point's square that are on the grid.
    fn square(&self, point: Point) -> impl Iterator<Item = usize> + use<> {
        let z = zeros(point);
        let row = 1usize << (usize::from(self.log2) - z);
        let [x, y] = point.map(|w| w as usize >> z);
        let pair = move |w: usize| [w.checked_sub(1), (w < row).then_some(w)].into_iter().flatten();
        pair(y).flat_map(move |y| pair(x).map(move |x| y * row + x))
    }
}

/// The times that both coordinates can be halved.
fn zeros([x, y]: Point) -> usize {
    (x | y).trailing_zeros() as usize
}

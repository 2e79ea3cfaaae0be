//! Takes out again what a selection does not need.
//!
//! Without a point only the one or two triangles at whose middle it stands change, and what is drawn below
//! them; the triangles above lie on the same surface whether they are split or not. So a point may go if all
//! drawn triangles below those two stay within the tolerance. The finest go first: there are most of them, and each
//! that goes may let its triangle vanish.
//!
//! So in the first pass all that is below a point is as it will be, and which triangles are split follows from one level to the
//! next: a point that goes is not counted out of all the triangles that it is in.

use super::surface::{MAY_GO, REAL, Step, Surface, back, bit, corners, diamonds, halves, moved};
use super::{Criterion, Ground};
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::{Bitree, hypotenuse};

/// Times that points are tried: later passes find a handful.
const PASSES_MAX: usize = 3;

/// Removes points while every triangle stays within `tolerance`. If all were before, all are after.
pub fn prune(ground: &Ground<'_>, criterion: Criterion, tolerance: f64, tree: &mut Bitree) {
    let surface = Surface::of(tree);
    *tree = prune_surface(ground, criterion, tolerance, surface).into_tree();
}

/// The same where it is known which of its points might go.
pub(super) fn prune_surface(
    ground: &Ground<'_>,
    criterion: Criterion,
    tolerance: f64,
    surface: Surface,
) -> Surface {
    let log2 = surface.log2();
    let mut pruning = Pruning { ground, criterion, tolerance, surface, moved: Vec::new() };
    let mut last = Areas::new(log2);
    for level in (0..2 * log2).rev() {
        diamonds(log2, level, |middle, to_apex| pruning.settle(middle, to_apex, &mut last));
    }
    for _ in 1..PASSES_MAX {
        if last.is_empty() {
            break;
        }
        last.complete();
        let mut removed = Areas::new(log2);
        for level in (0..2 * log2).rev() {
            diamonds(log2, level, |middle, to_apex| {
                // Where nothing has changed since it was tried, it would stay again.
                if pruning.is_real(middle)
                    && (last.overlap(middle) || removed.overlap(middle))
                    && pruning.remove(middle, to_apex)
                {
                    removed.insert(middle);
                    pruning.unsplit(middle, to_apex);
                }
            });
        }
        last = removed;
    }
    pruning.surface
}

/// A surface from which points go.
struct Pruning<'a, 'b> {
    ground: &'a Ground<'b>,
    criterion: Criterion,
    tolerance: f64,
    surface: Surface,
    /// Fictitious points that get another height with what is tried: where they are among the heights, and how high.
    moved: Vec<(usize, f64)>,
}

impl Pruning<'_, '_> {
    fn is_real(&self, point: Point) -> bool {
        self.surface.known[self.surface.slot(point)] & REAL != 0
    }

    /// Takes out a point if it may go, and tells which of its triangles are split in the end.
    fn settle(&mut self, middle: Point, to_apex: Step, removed: &mut Areas) {
        let slot = self.surface.slot(middle);
        if self.surface.known[slot] & MAY_GO != 0 && self.remove(middle, to_apex) {
            removed.insert(middle);
        }
        let mut known = self.surface.known[slot] & REAL;
        for to_apex in [to_apex, back(to_apex)] {
            let is_there = self.surface.has(moved(middle, to_apex));
            if is_there && (known & REAL != 0 || self.has_split_half(middle, to_apex)) {
                known |= bit(to_apex);
            }
        }
        self.surface.known[slot] = known;
    }

    /// Tells of triangles that have nothing real in them any more: those of a middle that has gone, and larger ones.
    fn unsplit(&mut self, middle: Point, to_apex: Step) {
        for to_apex in [to_apex, back(to_apex)] {
            if !self.surface.has(moved(middle, to_apex)) {
                continue;
            }
            let (mut middle, mut to_apex) = (middle, to_apex);
            while !self.is_real(middle) && !self.has_split_half(middle, to_apex) {
                let slot = self.surface.slot(middle);
                self.surface.known[slot] &= !bit(to_apex);
                // Its apex is the middle of the triangle that it is half of, whose hypotenuse is one of its legs; the apex of
                // that one is the corner across.
                let [a, c, b] = corners(middle, to_apex);
                let Some(ends) = hypotenuse(self.surface.log2(), c) else { break };
                let apex = if ends.contains(&a) { b } else { a };
                (middle, to_apex) = (c, [0, 1].map(|i| apex[i].wrapping_sub(c[i]).cast_signed()));
            }
        }
    }

    fn has_split_half(&self, middle: Point, to_apex: Step) -> bool {
        let is_split =
            |(half, to_apex): (Point, Step)| self.surface.known[self.surface.slot(half)] & bit(to_apex) != 0;
        halves(middle, to_apex).is_some_and(|[left, right]| is_split(left) || is_split(right))
    }

    /// Takes out a real point if all triangles that change are within the tolerance without it.
    fn remove(&mut self, middle: Point, to_apex: Step) -> bool {
        let slot = self.surface.slot(middle);
        let [a, _, b] = corners(middle, to_apex);
        let [ha, hb] = self.surface.at([a, b]);
        let (height, mean) = (self.surface.heights[slot], (ha + hb) / 2.0);
        // Its own sample tells it at once, of most.
        if self.is_beyond(slot, mean) {
            return false;
        }
        self.moved.clear();
        for to_apex in [to_apex, back(to_apex)] {
            let [a, c, b] = corners(middle, to_apex);
            if !self.surface.has(c) {
                continue;
            }
            let [ha, hc, hb] = self.surface.at([a, c, b]);
            let stays = match self.has_split_half(middle, to_apex) {
                false => self.is_within([a, c, b], [ha, hc, hb]),
                true => {
                    self.moves([c, middle, a], [hc, height, ha], [hc, mean, ha])
                        && self.moves([b, middle, c], [hb, height, hc], [hb, mean, hc])
                }
            };
            if !stays {
                return false;
            }
        }
        self.surface.known[slot] &= !REAL;
        self.surface.heights[slot] = mean;
        for (slot, height) in self.moved.drain(..) {
            self.surface.heights[slot] = height;
        }
        true
    }

    fn is_within(&self, corners: [Point; 3], heights: [f64; 3]) -> bool {
        !self.criterion.exceeds_between(self.ground, corners, heights, self.tolerance)
    }

    /// Whether all that is drawn of a triangle stays within the tolerance when its corners get other heights, which are within
    /// it themselves.
    fn moves(&mut self, [a, c, b]: [Point; 3], from: [f64; 3], to: [f64; 3]) -> bool {
        if from == to {
            return true;
        }
        if (a[0] ^ b[0] | a[1] ^ b[1]) & 1 != 0 {
            // One of the finest.
            return self.criterion.is_of_samples() || self.is_within([a, c, b], to);
        }
        let middle = [a[0].midpoint(b[0]), a[1].midpoint(b[1])];
        let to_apex = [0, 1].map(|i| c[i].wrapping_sub(middle[i]).cast_signed());
        let slot = self.surface.slot(middle);
        let known = self.surface.known[slot];
        if known & bit(to_apex) == 0 {
            return self.is_within([a, c, b], to);
        }
        let height = self.surface.heights[slot];
        let mut to_height = height;
        if known & REAL == 0 {
            to_height = (to[0] + to[2]) / 2.0;
            if to_height != height {
                if self.is_beyond(slot, to_height) {
                    return false;
                }
                self.moved.push((slot, to_height));
            }
        }
        if self.criterion.is_of_samples() && (a[0] ^ c[0] | a[1] ^ c[1]) & 1 != 0 {
            // Its halves are of the finest, and their corners are all their samples.
            return true;
        }
        self.moves([c, middle, a], [from[1], height, from[0]], [to[1], to_height, to[0]])
            && self.moves([b, middle, c], [from[2], height, from[1]], [to[2], to_height, to[1]])
    }

    /// Whether a sample is off by more than the tolerance by itself where the surface is so high.
    fn is_beyond(&self, slot: usize, height: f64) -> bool {
        let off = self.ground.field().heights()[slot] - height;
        self.criterion.is_beyond(self.ground, slot, off, self.tolerance)
    }
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
            if self.cells[z][cell] & OWN != 0 {
                continue;
            }
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
        self.square(point).into_iter().any(|cell| self.cells[zeros(point)][cell] != 0)
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

    /// The cells of a point's square; of those beyond the grid, the ones beside them on it.
    fn square(&self, point: Point) -> [usize; 4] {
        let z = zeros(point);
        let row = 1usize << (usize::from(self.log2) - z);
        let [[west, east], [south, north]] = point.map(|w| {
            let w = w as usize >> z;
            [w.saturating_sub(1), w.min(row - 1)]
        });
        [south * row + west, south * row + east, north * row + west, north * row + east]
    }
}

/// The times that both coordinates can be halved.
fn zeros([x, y]: Point) -> usize {
    (x | y).trailing_zeros() as usize
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const LOG2: u8 = 4;
    const SIDE: u32 = 1 << LOG2;

    /// The unit cells of the grid that the square around a point covers: the first, and the one after the last.
    fn covered(point: Point) -> [[u32; 2]; 2] {
        let reach = 1 << zeros(point);
        point.map(|w| [w.saturating_sub(reach), (w + reach).min(SIDE)])
    }

    fn have_cells_in_common(a: Point, b: Point) -> bool {
        let common = |[from, to]: [u32; 2], [other, end]: [u32; 2]| from.max(other) < to.min(end);
        let [a, b] = [a, b].map(covered);
        common(a[0], b[0]) && common(a[1], b[1])
    }

    /// Any point but the grid's corners, which no triangle has in its middle.
    fn any_point() -> impl Strategy<Value = Point> {
        [0..=SIDE, 0..=SIDE].prop_filter("a corner", |point| point.iter().any(|w| w % SIDE != 0))
    }

    proptest! {
        #[test]
        fn areas_overlap_where_their_squares_have_cells_in_common(points in prop::collection::vec(any_point(), 0..12)) {
            let mut areas = Areas::new(LOG2);
            for point in &points {
                areas.insert(*point);
            }
            prop_assert_eq!(areas.is_empty(), points.is_empty());
            let all = || (0..=SIDE).flat_map(|y| (0..=SIDE).map(move |x| [x, y])).filter(|p| p.iter().any(|w| w % SIDE != 0));
            for tried in all() {
                let finer = |p: &&Point| zeros(**p) <= zeros(tried);
                let expected = points.iter().filter(finer).any(|p| have_cells_in_common(*p, tried));
                prop_assert_eq!(areas.overlap(tried), expected, "{:?} among {:?}", tried, &points);
            }
            areas.complete();
            for tried in all() {
                let expected = points.iter().any(|p| have_cells_in_common(*p, tried));
                prop_assert_eq!(areas.overlap(tried), expected, "{:?} among all of {:?}", tried, &points);
            }
        }
    }
}

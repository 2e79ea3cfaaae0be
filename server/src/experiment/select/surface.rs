//! The surface of a selection, point by point: what a descent builds up and pruning takes from.
//!
//! Both go through the hypotenuses of a level row by row, two triangles at each, and keep a height and a byte a point. A list
//! of triangles would be larger than the field, and lead through it in an order that waits for memory.
//!
//! ```text
//!  a-----m-----b     A triangle is told by the middle m of its hypotenuse and the step from there to its apex c. Turned right
//!   \    |    /      by a quarter, it leads to the end a; turned by a half, to the apex of the other triangle.
//!    \   |   /
//!     \  |  /        The halves' hypotenuses are the legs: their middles lie halfway from c to a and to b, their apexes in m.
//!        c
//! ```

use crate::experiment::field::Field;
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::Bitree;

/// What is known of a point, in bits: that it is real.
pub(super) const REAL: u8 = 1;
/// Of the first triangle in whose middle the point stands, see [`bit`]: in a descent that it has to be judged, afterwards that
/// it is split.
pub(super) const FIRST: u8 = 2;
/// The same of the other triangle.
pub(super) const SECOND: u8 = 4;
/// That nothing is known to need the point.
pub(super) const MAY_GO: u8 = 8;

/// Heights on a grid, and what is known of each point.
#[derive(Debug)]
pub(super) struct Surface {
    log2: u8,
    /// Metres, of points that some triangle has as a corner; those of the others mean nothing.
    pub(super) heights: Vec<f64>,
    /// By bits, see [`REAL`].
    pub(super) known: Vec<u8>,
}

impl Surface {
    /// Of a field's corners alone.
    pub(super) fn new(field: &Field) -> Self {
        let mut surface = Self::empty(field.log2());
        for (corner, height) in field.outermost().into_iter().zip(field.corners()) {
            surface.set_real(corner, height);
        }
        surface
    }

    fn empty(log2: u8) -> Self {
        let points = ((1usize << log2) + 1).pow(2);
        Self { log2, heights: vec![f64::NAN; points], known: vec![0; points] }
    }

    /// Of a whole selection. Every real point but the corners may go, and which triangles are split is not told.
    pub(super) fn of(tree: &Bitree) -> Self {
        let mut surface = Self::empty(tree.log2());
        let mut open = tree.roots().to_vec();
        for (corner, height) in open.iter().flat_map(|root| root.corners().into_iter().zip(root.heights())) {
            surface.set_real(corner, height);
        }
        while let Some(facet) = open.pop() {
            if tree.is_split(&facet) {
                let halves = tree.halves(&facet);
                let slot = surface.slot(facet.middle());
                surface.heights[slot] = halves[0].heights()[1];
                if tree.real(facet.middle()).is_some() {
                    surface.known[slot] = REAL | MAY_GO;
                }
                open.extend(halves);
            }
        }
        surface
    }

    /// The selection.
    pub(super) fn into_tree(self) -> Bitree {
        let Self { log2, mut heights, known } = self;
        for (height, known) in heights.iter_mut().zip(known) {
            if known & REAL == 0 {
                *height = f64::NAN;
            }
        }
        Bitree::of(log2, heights).expect("a field has the limits of a bitree, and its corners are known")
    }

    pub(super) fn log2(&self) -> u8 {
        self.log2
    }

    pub(super) fn slot(&self, [x, y]: Point) -> usize {
        y as usize * ((1 << self.log2) + 1) + x as usize
    }

    /// Whether a point is on the grid; what lies to the west or south of it has wrapped round.
    pub(super) fn has(&self, [x, y]: Point) -> bool {
        x.max(y) <= 1 << self.log2
    }

    pub(super) fn set_real(&mut self, point: Point, height: f64) {
        let slot = self.slot(point);
        self.heights[slot] = height;
        self.known[slot] |= REAL;
    }

    /// The heights of points.
    pub(super) fn at<const N: usize>(&self, points: [Point; N]) -> [f64; N] {
        points.map(|p| self.heights[self.slot(p)])
    }
}

/// Cells to the east and to the north.
pub(super) type Step = [i32; 2];

/// The hypotenuses of triangles of a level, 0 to 2 `log2` - 1, row by row: calls `visit` with the middle of each and the step
/// from there to the apex of its first triangle.
pub(super) fn diamonds(log2: u8, level: u8, mut visit: impl FnMut(Point, Step)) {
    let side = 1u32 << log2;
    let step = side >> (level / 2 + 1);
    let to_apex = step.cast_signed();
    for (y, is_odd) in (0..=side).step_by(step as usize).zip([false, true].into_iter().cycle()) {
        let first = match (level.is_multiple_of(2), is_odd) {
            (true, false) => continue,
            (false, true) => 0,
            (true, true) | (false, false) => step,
        };
        for x in (first..=side).step_by(2 * step as usize) {
            let to_apex = match (level.is_multiple_of(2), is_odd) {
                // Middles of sides of squares: along a column or a row.
                (false, true) => [to_apex, 0],
                (false, false) => [0, to_apex],
                // Centres: diagonals turn from square to square.
                (true, _) if (x ^ y) & (2 * step) == 0 => [-to_apex, to_apex],
                (true, _) => [to_apex, to_apex],
            };
            visit([x, y], to_apex);
        }
    }
}

/// Which bit tells of a triangle, by the step from the middle of its hypotenuse to its apex: the first of two has it to the
/// north, or else to the east.
pub(super) fn bit([east, north]: Step) -> u8 {
    if north > 0 || (north == 0 && east > 0) { FIRST } else { SECOND }
}

/// The middles of a triangle's legs and the steps from there to its own middle, which is the halves' apex: of the left half,
/// then of the right one. `None` of the finest triangles' parents, whose legs have no middles.
pub(super) fn halves(middle: Point, to_apex: Step) -> Option<[(Point, Step); 2]> {
    let end = turned(to_apex);
    if (to_apex[0] + end[0]) % 2 != 0 {
        return None;
    }
    Some([end, back(end)].map(|end| {
        let step = [0, 1].map(|i| (to_apex[i] + end[i]) / 2);
        (moved(middle, step), back(step))
    }))
}

/// The corners of a triangle, turning left, apex in the middle.
pub(super) fn corners(middle: Point, to_apex: Step) -> [Point; 3] {
    let end = turned(to_apex);
    [end, to_apex, back(end)].map(|step| moved(middle, step))
}

pub(super) fn moved([x, y]: Point, [east, north]: Step) -> Point {
    [x.wrapping_add_signed(east), y.wrapping_add_signed(north)]
}

pub(super) fn back([east, north]: Step) -> Step {
    [-east, -north]
}

/// To the right by a quarter.
pub(super) fn turned([east, north]: Step) -> Step {
    [north, -east]
}

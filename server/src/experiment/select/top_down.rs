//! Selection from the top, level by level.
//!
//! Going by levels means that the ends of a hypotenuse have their final heights before its middle is judged,
//! so each triangle is judged by the surface that it will be part of. A middle that becomes real for the
//! sake of one triangle moves the other one at the same hypotenuse, too: its halves are judged again, even where the
//! triangle, or a larger one that it is part of, was good enough before.
//!
//! So the two triangles at a hypotenuse, a diamond, are judged together, and a level's diamonds row by row. All that is kept
//! is a height and a byte a point: a list of triangles would be larger than the field, and lead through it in an order that
//! waits for memory.
//!
//! ```text
//!  a-----m-----b     A triangle is told by the middle m of its hypotenuse and the step from there to its apex c. Turned right
//!   \    |    /      by a quarter, it leads to the end a; turned by a half, to the apex of the other triangle.
//!    \   |   /
//!     \  |  /        The halves' hypotenuses are the legs: their middles lie halfway from c to a and to b, their apexes in m.
//!        c
//! ```
//!
//! Each triangle scans its samples only until the tolerance is passed; a triangle that is good is scanned
//! once. So the cost is at most one scan of the field a level, and usually two or three in all.

use super::{Criterion, Ground};
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::{Bitree, hypotenuse};

/// The points of a descent; middles that are off by no more than `share` of the tolerance stay fictitious. By criteria
/// that are no distances each middle that is off at all is real, by sums any. Every triangle is within the tolerance
/// afterwards, down to the finest ones, which cannot split.
#[must_use]
pub fn top_down(ground: &Ground<'_>, criterion: Criterion, tolerance: f64, share: f64) -> Bitree {
    descend(ground, criterion, tolerance, share).0
}

/// The same, with those of its points that might go again. A point whose own sample would be off by more than the
/// tolerance without it has to stay, and most are such: what they hang between has its final height by then.
pub(super) fn descend(
    ground: &Ground<'_>,
    criterion: Criterion,
    tolerance: f64,
    share: f64,
) -> (Bitree, Vec<Point>) {
    let field = ground.field();
    let mut descent = Descent {
        ground,
        criterion,
        tolerance,
        share,
        heights: vec![f64::NAN; field.heights().len()],
        known: vec![0; field.heights().len()],
        may_go: Vec::new(),
    };
    for (corner, height) in field.outermost().into_iter().zip(field.corners()) {
        descent.set_real(corner, height);
    }
    let centre = field.slot([field.side() / 2; 2]);
    descent.known[centre] = FIRST | SECOND;
    for level in 0..2 * field.log2() {
        diamonds(field.log2(), level, |middle, to_apex| descent.judge(middle, to_apex));
    }
    let Descent { mut heights, known, may_go, .. } = descent;
    for (height, known) in heights.iter_mut().zip(known) {
        if known & REAL == 0 {
            *height = f64::NAN;
        }
    }
    let tree = Bitree::of(field.log2(), heights);
    (tree.expect("a field has the limits of a bitree, and its corners are known"), may_go)
}

/// Cells to the east and to the north.
pub(super) type Step = [i32; 2];

/// The hypotenuses of triangles of a level, 0 to 2 `log2` - 1, row by row: calls `visit` with the middle of each and the step
/// from there to the apex of the first of its triangles, the one to the north or else to the east.
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

/// What is known of a point, in bits: that it is real, and that the first or second triangle in whose middle it stands has
/// to be judged.
const REAL: u8 = 1;
const FIRST: u8 = 2;
const SECOND: u8 = 4;

/// The surface so far.
struct Descent<'a, 'b> {
    ground: &'a Ground<'b>,
    criterion: Criterion,
    tolerance: f64,
    share: f64,
    /// Metres, final; NaN while nothing hangs on a point.
    heights: Vec<f64>,
    known: Vec<u8>,
    may_go: Vec<Point>,
}

impl Descent<'_, '_> {
    /// Splits those of a diamond's triangles that are to be judged and not good enough.
    fn judge(&mut self, middle: Point, to_apex: Step) {
        let (criterion, field) = (self.criterion, self.ground.field());
        let slot = field.slot(middle);
        let known = self.known[slot];
        if known & (FIRST | SECOND) == 0 {
            return;
        }
        let end = turned(to_apex);
        let [ha, hb] = [end, back(end)].map(|step| self.heights[field.slot(moved(middle, step))]);
        let mean = (ha + hb) / 2.0;
        let off = field.heights()[slot] - mean;
        // The middle is one of the samples, and often tells enough.
        let is_beyond = criterion.is_beyond(self.ground, slot, off, self.tolerance);
        let triangles = [(to_apex, FIRST), (back(to_apex), SECOND)];
        let split = triangles
            .map(|(apex, bit)| known & bit != 0 && (is_beyond || self.is_worse(corners(middle, apex))));
        if split == [false; 2] {
            return;
        }
        let mut moves_both = false;
        // Whatever the middle's own weight: triangles that count hang on it.
        let is_off = match criterion.is_distance() {
            true => off.abs() > self.share * self.tolerance,
            false => !off.is_nan() && (off != 0.0 || criterion.splits_level()),
        };
        if known & REAL == 0 && is_off {
            self.set_real(middle, field.heights()[slot]);
            moves_both = middle.iter().all(|w| *w != 0 && *w != field.side());
            if !is_beyond {
                self.may_go.push(middle);
            }
        } else if known & REAL == 0 {
            self.heights[slot] = mean;
        }
        for ((apex, _), is_split) in triangles.into_iter().zip(split) {
            if is_split && off.is_nan() && criterion.splits_level() {
                // Any real point below makes the middle fictitious.
                if let Some(below) = field.known_below(corners(middle, apex)) {
                    self.set_real(below, field.at(below));
                }
            }
            if is_split || moves_both {
                self.halve(middle, apex);
            }
        }
    }

    fn is_worse(&self, corners: [Point; 3]) -> bool {
        let heights = corners.map(|p| self.heights[self.ground.field().slot(p)]);
        self.criterion.exceeds(self.ground, corners, heights, self.tolerance)
    }

    fn set_real(&mut self, point: Point, height: f64) {
        let slot = self.ground.field().slot(point);
        self.heights[slot] = height;
        self.known[slot] |= REAL;
    }

    /// Has the halves of a triangle judged.
    fn halve(&mut self, middle: Point, to_apex: Step) {
        let end = turned(to_apex);
        if (to_apex[0] + end[0]) % 2 != 0 {
            // They are the finest, and have no middles.
            return;
        }
        // Where nothing hung on the apex so far, a larger triangle was good enough, but for what moved this one.
        self.deduce(moved(middle, to_apex));
        for end in [end, back(end)] {
            let step = [0, 1].map(|i| (to_apex[i] + end[i]) / 2);
            let [east, north] = back(step);
            let is_first = north > 0 || (north == 0 && east > 0);
            let slot = self.ground.field().slot(moved(middle, step));
            self.known[slot] |= if is_first { FIRST } else { SECOND };
        }
    }

    /// The height of a point on which something hangs now.
    fn deduce(&mut self, point: Point) -> f64 {
        let field = self.ground.field();
        let slot = field.slot(point);
        if self.heights[slot].is_nan()
            && let Some(ends) = hypotenuse(field.log2(), point)
        {
            let [ha, hb] = ends.map(|end| self.deduce(end));
            self.heights[slot] = (ha + hb) / 2.0;
        }
        self.heights[slot]
    }
}

fn corners(middle: Point, to_apex: Step) -> [Point; 3] {
    let end = turned(to_apex);
    [end, to_apex, back(end)].map(|step| moved(middle, step))
}

fn moved([x, y]: Point, [east, north]: Step) -> Point {
    [x.wrapping_add_signed(east), y.wrapping_add_signed(north)]
}

fn back([east, north]: Step) -> Step {
    [-east, -north]
}

/// To the right by a quarter.
fn turned([east, north]: Step) -> Step {
    [north, -east]
}

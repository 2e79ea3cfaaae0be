//! Selection from the top, level by level.
//!
//! Going by levels means that the ends of a hypotenuse have their final heights before its middle is judged,
//! so each triangle is judged by the surface that it will be part of. A middle that becomes real for the
//! sake of one triangle moves the other one at the same hypotenuse, too: its halves are judged again, even where the
//! triangle, or a larger one that it is part of, was good enough before. So the two triangles at a hypotenuse, a diamond, are
//! judged together.
//!
//! Each triangle scans its samples only until the tolerance is passed; a triangle that is good is scanned
//! once. So the cost is at most one scan of the field a level, and usually two or three in all.

use super::surface::{
    FIRST, MAY_GO, REAL, SECOND, Step, Surface, back, bit, corners, diamonds, halves, moved, turned,
};
use super::{Criterion, Ground};
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::{Bitree, hypotenuse};

/// The points of a descent; middles that are off by no more than `share` of the tolerance stay fictitious. By criteria
/// that are no distances each middle that is off at all is real, by sums any. Every triangle is within the tolerance
/// afterwards, down to the finest ones, which cannot split.
#[must_use]
pub fn top_down(ground: &Ground<'_>, criterion: Criterion, tolerance: f64, share: f64) -> Bitree {
    descend(ground, criterion, tolerance, share).into_tree()
}

/// The same, with those of its points that might go again. A point whose own sample would be off by more than the
/// tolerance without it has to stay, and most are such: what they hang between has its final height by then.
pub(super) fn descend(ground: &Ground<'_>, criterion: Criterion, tolerance: f64, share: f64) -> Surface {
    let field = ground.field();
    let mut descent = Descent { ground, criterion, tolerance, share, surface: Surface::new(field) };
    let centre = field.slot([field.side() / 2; 2]);
    descent.surface.known[centre] = FIRST | SECOND;
    for level in 0..2 * field.log2() {
        diamonds(field.log2(), level, |middle, to_apex| descent.judge(middle, to_apex));
    }
    descent.surface
}

/// The surface so far.
struct Descent<'a, 'b> {
    ground: &'a Ground<'b>,
    criterion: Criterion,
    tolerance: f64,
    share: f64,
    /// Heights are final, and NaN while nothing hangs on a point.
    surface: Surface,
}

impl Descent<'_, '_> {
    /// Splits those of a diamond's triangles that are to be judged and not good enough.
    fn judge(&mut self, middle: Point, to_apex: Step) {
        let (criterion, field) = (self.criterion, self.ground.field());
        let slot = field.slot(middle);
        let known = self.surface.known[slot];
        if known & (FIRST | SECOND) == 0 {
            return;
        }
        let end = turned(to_apex);
        let [ha, hb] = self.surface.at([end, back(end)].map(|step| moved(middle, step)));
        let mean = (ha + hb) / 2.0;
        let off = field.heights()[slot] - mean;
        // The middle is one of the samples, and often tells enough.
        let is_beyond = criterion.is_beyond(self.ground, slot, off, self.tolerance);
        let apexes = [to_apex, back(to_apex)];
        let is_bad =
            |i: usize, bit| known & bit != 0 && (is_beyond || self.is_worse(corners(middle, apexes[i])));
        let split = [is_bad(0, FIRST), is_bad(1, SECOND)];
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
            self.surface.heights[slot] = field.heights()[slot];
            self.surface.known[slot] |= if is_beyond { REAL } else { REAL | MAY_GO };
            moves_both = middle.iter().all(|w| *w != 0 && *w != field.side());
        } else if known & REAL == 0 {
            self.surface.heights[slot] = mean;
        }
        for i in 0..2 {
            if split[i] && off.is_nan() && criterion.splits_level() {
                // Any real point below makes the middle fictitious.
                if let Some(below) = field.known_below(corners(middle, apexes[i])) {
                    self.surface.set_real(below, field.at(below));
                }
            }
            if split[i] || moves_both {
                self.halve(middle, apexes[i]);
            }
        }
    }

    fn is_worse(&self, corners: [Point; 3]) -> bool {
        self.criterion.exceeds(self.ground, corners, self.surface.at(corners), self.tolerance)
    }

    /// Has the halves of a triangle judged.
    fn halve(&mut self, middle: Point, to_apex: Step) {
        // The finest have no middles.
        let Some(halves) = halves(middle, to_apex) else { return };
        // Where nothing hung on the apex so far, a larger triangle was good enough, but for what moved this one.
        self.deduce(moved(middle, to_apex));
        for (half, to_apex) in halves {
            let slot = self.surface.slot(half);
            self.surface.known[slot] |= bit(to_apex);
        }
    }

    /// The height of a point on which something hangs now.
    fn deduce(&mut self, point: Point) -> f64 {
        let slot = self.surface.slot(point);
        if self.surface.heights[slot].is_nan()
            && let Some(ends) = hypotenuse(self.surface.log2(), point)
        {
            let [ha, hb] = ends.map(|end| self.deduce(end));
            self.surface.heights[slot] = (ha + hb) / 2.0;
        }
        self.surface.heights[slot]
    }
}

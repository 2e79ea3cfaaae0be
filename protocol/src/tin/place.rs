//! Where the vertices of a patch lie in its square, on which side of one another, and where a new one is expected.

#![allow(
    clippy::cast_possible_truncation,
    reason = "what lies in a diamond's square has coordinates of 25 bits, heights have 26, and a child triangle 2"
)]

use crate::bintree::Forest;
use crate::diamond::Diamond;

/// A vertex: in units of the payload, x and y from the diamond's centre, heights from the first one's.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Point {
    pub(super) x: i32,
    pub(super) y: i32,
    pub(super) height: i32,
}

/// The diamond's square, in units of the payload from its centre.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Square {
    /// Directions of the local grid's axes.
    u: [i64; 2],
    v: [i64; 2],
    /// The largest coordinate along them.
    half: i64,
    upper: bool,
}

/// In which child triangles a point lies, as bits; then on which straight lines of the square's outer border.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Within {
    pub(super) children: u8,
    pub(super) outer: u8,
}

impl Square {
    /// In lattice units shifted down by `shift`.
    pub(super) fn new(forest: &Forest, d: Diamond, shift: u32) -> Self {
        let local = forest.local(d);
        let half = 1i64 << (forest.root_log2() - 1 - d.level() / 2);
        Self {
            u: local.u.map(i64::signum),
            v: local.v.map(i64::signum),
            half: half >> shift,
            upper: local.upper,
        }
    }

    /// The same, three times as large: in it lies three times what lies in this one.
    pub(super) fn thrice(self) -> Self {
        Self { half: 3 * self.half, ..self }
    }

    /// The largest coordinate along its axes.
    pub(super) fn half(&self) -> i64 {
        self.half
    }

    /// Whether units are so large that nothing is left of it.
    pub(super) fn is_empty(&self) -> bool {
        self.half == 0
    }

    /// Where a point lies; no bits of children if it is outside.
    #[inline(always)]
    pub(super) fn within(&self, x: i64, y: i64) -> Within {
        let p = x * self.u[0] + y * self.u[1];
        let q = x * self.v[0] + y * self.v[1];
        let h = self.half;
        if p.abs() > h || q.abs() > h || (!self.upper && q > p) {
            return Within::default();
        }
        let bits =
            |[a, b, c, d]: [bool; 4]| u8::from(a) | u8::from(b) << 1 | u8::from(c) << 2 | u8::from(d) << 3;
        let children = bits([-q >= p.abs(), p >= q.abs(), q >= p.abs(), -p >= q.abs()]);
        let outer = bits([q == -h, p == h, q == h, p == -h]);
        if self.upper {
            Within { children, outer }
        } else {
            Within { children: children & 0b0011, outer: outer | u8::from(p == q) << 4 }
        }
    }
}

#[inline(always)]
pub(super) fn difference(a: Point, b: Point) -> [i64; 2] {
    // In the square they are of 26 bits; of what lies elsewhere, and is refused for that, it does not matter.
    [b.x.wrapping_sub(a.x), b.y.wrapping_sub(a.y)].map(i64::from)
}

/// Twice the area of the triangle `a`, `b`, `c`; above 0 if it turns left.
#[inline(always)]
pub(super) fn cross(a: Point, b: Point, c: Point) -> i64 {
    let (u, v) = (difference(a, b), difference(a, c));
    u[0] * v[1] - u[1] * v[0]
}

#[inline(always)]
pub(super) fn dot(a: Point, b: Point, c: Point) -> i64 {
    let (u, v) = (difference(a, b), difference(a, c));
    u[0] * v[0] + u[1] * v[1]
}

/// Whether the direction from `at` to `to` lies strictly inside the turn left from that to `from` to that to `until`:
/// a full turn where these two are the same.
#[inline(always)]
pub(super) fn inside(at: Point, from: Point, until: Point, to: Point) -> bool {
    let turn = cross(at, from, until);
    let (after, before) = (cross(at, from, to), cross(at, to, until));
    if turn == 0 && dot(at, from, until) > 0 {
        return after != 0 || dot(at, from, to) < 0;
    }
    // Without branches: which way a front turns is as random as the mesh, and would be mispredicted.
    let (left, right) = (after > 0, before > 0);
    (left & right) | ((turn <= 0) & (left | right))
}

/// [`inside`] of what is known to lie to the left of `from`, seen from `at`.
#[inline(always)]
pub(super) fn is_left_inside(at: Point, from: Point, until: Point, to: Point) -> bool {
    (cross(at, from, until) <= 0) | (cross(at, to, until) > 0)
}

/// [`inside`] of what is known to have `until` to its left.
#[inline(always)]
pub(super) fn is_right_inside(at: Point, from: Point, until: Point, to: Point) -> bool {
    (cross(at, from, until) <= 0) | (cross(at, from, to) > 0)
}

/// Where the third vertex of a triangle beyond a gate is expected, by two rules: as far as that of the triangle behind,
/// which regular meshes follow; or half as far as the gate is long, straight ahead.
#[inline(always)]
pub(super) fn expected_places(a: Point, b: Point, behind: Option<Point>) -> [[i64; 2]; 2] {
    let (x, y) = (i64::from(a.x) + i64::from(b.x), i64::from(a.y) + i64::from(b.y));
    let [dx, dy] = difference(a, b);
    let ahead = [(x - dy) >> 1, (y + dx) >> 1];
    [behind.map_or(ahead, |c| [x - i64::from(c.x), y - i64::from(c.y)]), ahead]
}

/// The height of the plane of the triangle on the gate's right, seen from beyond.
#[inline(always)]
pub(super) fn expected_height(a: Point, b: Point, behind: Option<Point>, x: i64, y: i64) -> i64 {
    let [from, to] = [a, b].map(|p| i64::from(p.height));
    let Some(c) = behind else { return (from + to) / 2 };
    let (along, back) = (difference(a, b), difference(a, c));
    let here = [x - i64::from(a.x), y - i64::from(a.y)];
    let whole = back[0] * along[1] - back[1] * along[0];
    let (s, t) = (back[0] * here[1] - back[1] * here[0], here[0] * along[1] - here[1] * along[0]);
    // 34 bits and 3 and those of a difference of heights fit in 63.
    let shift = (64 - whole.leading_zeros()).saturating_sub(34);
    let whole = (whole >> shift).max(1);
    let clamp = |part: i64| (part >> shift).clamp(-4 * whole, 4 * whole);
    let (s, t) = (clamp(s), clamp(t));
    from + (s * (to - from) + t * (i64::from(c.height) - from)).div_euclid(whole)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn what_lies_on_the_known_side_is_inside_as_anything_is(xy in prop::array::uniform8(-4i32..=4)) {
            let [at, from, until, to] = [0, 2, 4, 6].map(|i| Point { x: xy[i], y: xy[i + 1], height: 0 });
            prop_assume!(difference(at, from) != [0, 0] && difference(at, until) != [0, 0]);
            let expected = inside(at, from, until, to);
            if cross(at, from, to) > 0 {
                prop_assert_eq!(is_left_inside(at, from, until, to), expected);
            }
            if cross(at, to, until) > 0 {
                prop_assert_eq!(is_right_inside(at, from, until, to), expected);
            }
        }
    }
}

//! The square of a diamond: where a vertex lies in it says what may become of it.

use super::Vertex;
use super::metric::turn;

/// What may become of a vertex.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    Free,
    /// On the hypotenuse.
    Along,
    Locked,
}

/// The corners of a diamond in lattice coordinates: the ends of the hypotenuse and the apexes. Only the lower
/// triangle may be there.
#[derive(Debug, Clone, Copy)]
pub(super) struct Square {
    pub(super) a: Vertex,
    pub(super) b: Vertex,
    pub(super) lower: Vertex,
    pub(super) upper: Option<Vertex>,
}

impl Square {
    /// Whether a point lies inside, given how to scale the corners to its coordinates.
    pub(super) fn contains(&self, v: Vertex, scaled: impl Fn(Vertex) -> Vertex) -> bool {
        let far = self.upper.map_or([self.b, self.a], |upper| [self.b, upper]);
        let corners = [self.a, self.lower, far[0], far[1]].map(scaled);
        (0..4).all(|i| turn(corners[i], corners[(i + 1) % 4], v) >= 0)
    }

    /// Cells along x or y, whichever are more.
    pub(super) fn width(&self) -> u32 {
        let corners = [self.a, self.b, self.lower].into_iter().chain(self.upper);
        let all = |w: fn(Vertex) -> u32| {
            corners.clone().map(w).fold((u32::MAX, 0), |(low, high), w| (low.min(w), high.max(w)))
        };
        let (x, y) = (all(|v| v.x), all(|v| v.y));
        (x.1 - x.0).max(y.1 - y.0)
    }

    /// Whether a point lies on the line of the hypotenuse.
    pub(super) fn is_along(&self, v: Vertex) -> bool {
        turn(self.a, self.b, v) == 0
    }

    pub(super) fn role(&self, v: Vertex) -> Role {
        let on_side = |apex: Vertex| turn(self.a, apex, v) == 0 || turn(apex, self.b, v) == 0;
        if on_side(self.lower) || self.upper.is_some_and(on_side) {
            Role::Locked
        } else if self.is_along(v) {
            Role::Along
        } else {
            Role::Free
        }
    }
}

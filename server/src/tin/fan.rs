//! What surrounds a vertex, seen from there: which ways it may go, and what each costs.
//!
//! With the vertex as the origin, the triangle u, p, q that takes the place of 0, p, q once the vertex has slid into u is
//!
//! ```text
//! (p - u) x (q - u) = p x q + u x p - u x q
//! ```
//!
//! so one cross product with u for each vertex around tells all: whether a triangle turns over, its area vector, and, as
//! the three terms are barycentric coordinates of the origin, how far the vertex's own sample will be from the surface.
//! Most ways that an error forbids are forbidden by that sample, before any other is looked at.

use super::mesh::{Mesh, Star};
use super::metric::{Vector, length};
use super::{Scale, Vertex};

/// A vertex around: along x and y in cells, and in height in quanta.
type Step = [f64; 3];

/// The vertices around another one, counterclockwise.
#[derive(Debug, Default)]
pub(super) struct Fan {
    /// One more than triangles: around a whole fan the first is the last, too.
    steps: Vec<Step>,
    /// For each triangle, twice its area in plan.
    turns: Vec<f64>,
    /// Vertices around, each once.
    count: usize,
    /// For each vertex, the turn from the way that is looked at to it.
    about: Vec<f64>,
}

/// Twice the area of a triangle of the origin, in plan.
fn turn(a: Step, b: Step) -> f64 {
    a[0] * b[1] - a[1] * b[0]
}

impl Fan {
    /// Takes over a star.
    pub(super) fn look(&mut self, mesh: &Mesh, star: &Star) {
        let centre = mesh.points[star.centre as usize];
        let step = |a: u32, b: u32| f64::from(b.wrapping_sub(a).cast_signed());
        let seen = |v: &u32| {
            let v: Vertex = mesh.points[*v as usize];
            [step(centre.x, v.x), step(centre.y, v.y), f64::from(v.height - centre.height)]
        };
        self.steps.clear();
        self.steps.extend(star.rim.iter().map(seen));
        self.count = self.steps.len();
        if !star.border {
            self.steps.extend_from_within(..1);
        }
        self.turns.clear();
        self.turns.extend(self.steps.windows(2).map(|pair| turn(pair[0], pair[1])));
    }

    /// Whether triangle `i` vanishes if the centre slides into the vertex `to`.
    fn vanishes(&self, i: usize, to: usize) -> bool {
        // The last one of a whole fan ends where the first begins.
        i == to || i + 1 == to || (to == 0 && i + 1 == self.count)
    }

    /// How far the centre's own sample will be from the surface, in quanta, if the centre slides into the vertex
    /// `to`; `None` if a triangle would turn over.
    pub(super) fn off(&mut self, to: usize) -> Option<f64> {
        let u = self.steps[to];
        self.about.clear();
        self.about.extend(self.steps.iter().map(|p| turn(u, *p)));
        // All are whole numbers, exact below 2^53.
        let mut off = 0.0;
        for (i, (turn, (steps, about))) in
            self.turns.iter().zip(self.steps.windows(2).zip(self.about.windows(2))).enumerate()
        {
            if self.vanishes(i, to) {
                continue;
            }
            let (of_q, of_p) = (about[0], -about[1]);
            let doubled = turn + of_p + of_q;
            if doubled <= 0.0 {
                return None;
            }
            if of_p >= 0.0 && of_q >= 0.0 {
                let height = turn * u[2] + of_p * steps[0][2] + of_q * steps[1][2];
                off = height.abs() / doubled;
            }
        }
        Some(off)
    }

    /// How much the normals of the triangles that survive change: the sum of (A + A')/2 (1 - n . n') over them, given
    /// their area vectors and areas now.
    pub(super) fn cost(&self, scale: &Scale, to: usize, now: impl Fn(usize) -> (Vector, f64)) -> f64 {
        // Of a cross product of steps in the lattice's units, half of one in metres.
        let [x, y, z] = [scale.cell[0], scale.cell[1], scale.quantum];
        let metres = [0.5 * y * z, 0.5 * z * x, 0.5 * x * y];
        let u = self.steps[to];
        let with = |i: usize| {
            let p = self.steps[i];
            [
                (u[1] * p[2] - u[2] * p[1]) * metres[0],
                (u[2] * p[0] - u[0] * p[2]) * metres[1],
                self.about[i] * metres[2],
            ]
        };
        let mut sum = 0.0;
        let mut here = with(0);
        for i in 0..self.turns.len() {
            let there = with(i + 1);
            if !self.vanishes(i, to) {
                let (old, area) = now(i);
                let new: Vector = std::array::from_fn(|k| old[k] + here[k] - there[k]);
                let area_new = length(new);
                let dot = old[0] * new[0] + old[1] * new[1] + old[2] * new[2];
                sum += 0.5 * (area + area_new) * (1.0 - dot / (area * area_new));
            }
            here = there;
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::super::ground::Ground;
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// A fan around a sample, whole or with a gap: what is said of a way is what its triangles say of that sample.
        #[test]
        fn the_centre_is_off_as_far_as_the_triangle_that_covers_it(
            rim in prop::collection::vec((1u32..=6, -900i32..900), 8),
            whole: bool,
            height in -900i32..900,
        ) {
            const AROUND: [[i32; 2]; 8] = [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]];
            let centre = Vertex { x: 10, y: 10, height };
            let around = AROUND.iter().zip(&rim).map(|([x, y], (away, height))| {
                let at = |w: i32| 10u32.wrapping_add_signed(w * away.cast_signed());
                Vertex { x: at(*x), y: at(*y), height: *height }
            });
            let points: Vec<Vertex> = std::iter::once(centre).chain(around).collect();
            let triangles: Vec<[u32; 3]> = (1..8 + u32::from(whole)).map(|i| [0, i, i % 8 + 1]).collect();
            let mesh = Mesh::new(&points, &triangles);
            let (mut star, mut fan) = (Star::default(), Fan::default());
            mesh.look(0, &mut star);
            fan.look(&mesh, &star);
            let mut heights = vec![diamantina_protocol::NODATA; 21 * 21];
            heights[10 * 21 + 10] = height;
            let ground = Ground { origin: [0, 0], width: 21, heights: &heights };
            let point = |v: u32| mesh.points[v as usize];
            for to in 0..star.rim.len() {
                let u = star.rim[to];
                let rest = (0..star.spokes.len()).map(|i| star.edge(i)).filter(|edge| !edge.contains(&u));
                let rest: Vec<[Vertex; 3]> = rest.map(|[p, q]| [point(u), point(p), point(q)]).collect();
                let turns_over = rest.iter().any(|[a, b, c]| super::super::metric::turn(*a, *b, *c) <= 0);
                let off = fan.off(to);
                prop_assert_eq!(off.is_none(), turns_over);
                if let Some(off) = off {
                    let expected = rest.iter().map(|t| ground.distance(*t, f64::INFINITY)).fold(0.0, f64::max);
                    prop_assert!((off - expected).abs() <= 1e-9 * expected, "{off}, expected {expected}");
                }
            }
        }
    }
}

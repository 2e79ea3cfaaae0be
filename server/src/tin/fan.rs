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

use super::Scale;
use super::few::{FEW, Few, NEAR};
use super::mesh::{Mesh, Star};
use super::metric::{Vector, dot, length};

/// A vertex around: along x and y in cells, and in height in quanta.
type Step = [f64; 3];

/// The vertices around another one, counterclockwise.
#[derive(Debug, Default)]
pub(super) struct Fan {
    /// Around a whole fan that is not [`Few`], all twice: so that those after any one follow one another.
    steps: Vec<Step>,
    /// For each triangle that follows a vertex, twice its area in plan; likewise. None if the fan is [`Few`].
    turns: Vec<f64>,
    few: Few,
    is_few: bool,
    is_near: bool,
    /// Vertices around, each once.
    count: usize,
    border: bool,
}

/// Twice the area of a triangle of the origin, in plan.
fn turn(a: Step, b: Step) -> f64 {
    a[0] * b[1] - a[1] * b[0]
}

impl Fan {
    /// Of a mesh so many cells wide.
    pub(super) fn new(width: u32) -> Self {
        Self { is_near: width <= NEAR, ..Self::default() }
    }

    /// Takes over a star.
    pub(super) fn look(&mut self, mesh: &Mesh, star: &Star) {
        let centre = mesh.points[star.centre as usize];
        let step = |a: u32, b: u32| f64::from(b.wrapping_sub(a).cast_signed());
        let rim = star.rim();
        (self.count, self.border) = (rim.len(), star.border);
        self.is_few = self.is_near && !self.border && self.count <= FEW;
        if self.is_few {
            return self.few.look(centre, &mesh.points, star.few(), self.count);
        }
        self.steps.clear();
        self.steps.extend(rim.iter().map(|v| {
            let v = &mesh.points[*v as usize];
            [step(centre.x, v.x), step(centre.y, v.y), f64::from(v.height - centre.height)]
        }));
        self.turns.clear();
        self.turns.extend(self.steps.windows(2).map(|pair| turn(pair[0], pair[1])));
        if !self.border {
            let last = turn(self.steps[self.count - 1], self.steps[0]);
            self.steps.extend_from_within(..);
            self.turns.push(last);
            self.turns.extend_from_within(..self.count - 1);
        }
    }

    /// Prepares [`Fan::off`].
    pub(super) fn measure(&mut self) {
        if self.is_few {
            self.few.measure();
        }
    }

    /// The vertices whose triangles survive if the centre slides into the vertex `to`, at a border the first or the last:
    /// all but that one, in turn.
    fn rest(&self, to: usize) -> std::ops::Range<usize> {
        match (self.border, to) {
            (false, _) => to + 1..to + self.count,
            (true, 0) => 1..self.count,
            (true, _) => 0..self.count - 1,
        }
    }

    /// How far the centre's own sample will be from the surface, in quanta, if the centre slides into the vertex
    /// `to`; `None` if a triangle would turn over, or if that does not matter so far off.
    pub(super) fn off(&self, to: usize, matters: impl Fn(f64) -> bool) -> Option<f64> {
        if self.is_few {
            return Some(self.few.off(to)).filter(|off| *off < f64::INFINITY && matters(*off));
        }
        self.off_of_any(to).filter(|off| matters(*off))
    }

    /// [`Fan::off`] of a fan that is not [`Few`].
    fn off_of_any(&self, to: usize) -> Option<f64> {
        let u = self.steps[to];
        let rest = self.rest(to);
        let steps = &self.steps[rest.clone()];
        let turns = &self.turns[rest.start..rest.end - 1];
        // All are whole numbers, exact below 2^53.
        let (mut off, mut area) = (0.0, 1.0);
        let mut here = turn(u, steps[0]);
        for (pair, between) in steps.windows(2).zip(turns) {
            let there = turn(u, pair[1]);
            let doubled = between + here - there;
            if doubled <= 0.0 {
                return None;
            }
            if here >= 0.0 && there <= 0.0 {
                let height = between * u[2] + here * pair[1][2] - there * pair[0][2];
                (off, area) = (height.abs(), doubled);
            }
            here = there;
        }
        Some(off / area)
    }

    /// How far the centre's own sample will be from the surface at least, whichever way the centre goes; infinite if there
    /// is none.
    pub(super) fn least_off(&mut self) -> f64 {
        self.measure();
        if self.is_few { self.few.least_off() } else { self.least_off_of(|_| true) }
    }

    /// Likewise of those ways alone that `may` be gone.
    pub(super) fn least_off_of(&mut self, may: impl Fn(usize) -> bool) -> f64 {
        self.measure();
        let mut least = f64::INFINITY;
        for to in (0..self.count).filter(|to| may(*to)) {
            least = self.off(to, |off| off < least).unwrap_or(least);
        }
        least
    }

    /// The ways on which the centre's own sample will be no farther off than a limit, as bits, and what the others are at least;
    /// `None` if there may be more ways than bits, or the centre may not go any way.
    pub(super) fn within(&self, limit: f32) -> Option<(u32, f64)> {
        self.is_few.then(|| self.few.within(limit))
    }

    /// Of a cross product of steps in the lattice's units, half of one in metres.
    fn metres(scale: &Scale) -> Vector {
        let [x, y, z] = [scale.cell[0], scale.cell[1], scale.quantum];
        [0.5 * y * z, 0.5 * z * x, 0.5 * x * y]
    }

    /// Prepares [`Fan::cost`].
    pub(super) fn prepare(&mut self, scale: &Scale) {
        if self.is_few {
            self.few.prepare(Self::metres(scale));
        }
    }

    /// How much the normals vary: the sum of areas, less the length of the sum of area vectors. With n the direction of that
    /// sum it is that of A (1 - n_t . n) as well, which is half of A |n_t - n|^2, of which little is lost in rounding.
    pub(super) fn importance(&mut self, scale: &Scale) -> f64 {
        if self.is_few {
            self.few.prepare(Self::metres(scale));
            return self.few.importance();
        }
        let metres = Self::metres(scale);
        let triangles = self.steps.windows(2).take(self.triangles());
        let (vectors, mut sum) = (triangles.map(|pair| area_vector(metres, pair[0], pair[1])), [0.0; 3]);
        for vector in vectors.clone() {
            sum = std::array::from_fn(|k| sum[k] + vector[k]);
        }
        let all = length(sum);
        let varies = vectors.map(|vector| {
            let area = length(vector);
            let off: Vector = std::array::from_fn(|k| vector[k] / area - sum[k] / all);
            0.5 * area * dot(off, off)
        });
        varies.sum()
    }

    /// How many triangles there are.
    fn triangles(&self) -> usize {
        self.count - usize::from(self.border)
    }

    /// How much the normals of the triangles that survive change: the sum of (A + A')/2 (1 - n . n') over them.
    pub(super) fn cost(&self, scale: &Scale, to: usize) -> f64 {
        if self.is_few {
            return self.few.cost(to);
        }
        let metres = Self::metres(scale);
        let u = self.steps[to];
        let rest = &self.steps[self.rest(to)];
        let changes = rest.windows(2).map(|pair| {
            let [p, q] = [pair[0], pair[1]];
            let old = area_vector(metres, p, q);
            let new = area_vector(metres, difference(u, p), difference(u, q));
            let (area, area_new) = (length(old), length(new));
            0.5 * (area + area_new) * (1.0 - dot(old, new) / (area * area_new))
        });
        changes.sum()
    }
}

fn difference(a: Step, b: Step) -> Step {
    std::array::from_fn(|k| b[k] - a[k])
}

/// Of the triangle of the origin and two steps, given [`Fan::metres`].
fn area_vector(metres: Vector, p: Step, q: Step) -> Vector {
    let cross = [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]];
    std::array::from_fn(|k| cross[k] * metres[k])
}

#[cfg(test)]
mod tests {
    use super::super::Vertex;
    use super::super::ground::Ground;
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// A fan around a sample, whole or with a gap: what is said of a way is what its triangles say of that sample.
        #[test]
        fn the_centre_is_off_as_far_as_the_triangle_that_covers_it(
            rim in prop::collection::vec((1u32..=6, -900i32..900), 8),
            whole: bool,
            symmetric: bool,
            height in -900i32..900,
        ) {
            const AROUND: [[i32; 2]; 8] = [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]];
            let centre = Vertex { x: 10, y: 10, height };
            let around = AROUND.iter().enumerate().map(|(i, [x, y])| {
                let (away, height) = (&rim[if symmetric { i % 4 } else { i }].0, &rim[i].1);
                let at = |w: i32| 10u32.wrapping_add_signed(w * away.cast_signed());
                Vertex { x: at(*x), y: at(*y), height: *height }
            });
            let points: Vec<Vertex> = std::iter::once(centre).chain(around).collect();
            let triangles: Vec<[u32; 3]> = (1..8 + u32::from(whole)).map(|i| [0, i, i % 8 + 1]).collect();
            let mesh = Mesh::new(&points, &triangles);
            let (mut star, mut fan) = (Star::default(), Fan::new(if whole { 20 } else { NEAR + 1 }));
            mesh.look(0, &mut star);
            fan.look(&mesh, &star);
            fan.measure();
            let mut heights = vec![diamantina_protocol::NODATA; 21 * 21];
            heights[10 * 21 + 10] = height;
            let ground = Ground { origin: [0, 0], width: 21, heights: &heights };
            let point = |v: u32| mesh.points[v as usize];
            let mut least = f64::INFINITY;
            let mut turns = false;
            let last = star.rim().len() - 1;
            let is_way = |to: usize| whole || to == 0 || to == last;
            for to in (0..=last).filter(|to| is_way(*to)) {
                let u = star.rim()[to];
                let rest = (0..star.spokes().len()).map(|i| star.edge(i)).filter(|edge| !edge.contains(&u));
                let rest: Vec<[Vertex; 3]> = rest.map(|[p, q]| [point(u), point(p), point(q)]).collect();
                let turns_over = rest.iter().any(|[a, b, c]| super::super::metric::turn(*a, *b, *c) <= 0);
                let off = fan.off(to, |_| true);
                prop_assert_eq!(off.is_none(), turns_over);
                turns |= turns_over;
                least = least.min(off.unwrap_or(f64::INFINITY));
                if let Some(off) = off {
                    let expected = rest.iter().map(|t| ground.distance(*t, f64::INFINITY)).fold(0.0, f64::max);
                    // Of few vertices it is at most as far: 2^-20 of three products of at most 72 and 1800, over an area of 1.
                    let least = if whole { expected - 0.4 } else { expected * (1.0 - 1e-9) };
                    prop_assert!(least <= off && off <= expected * (1.0 + 1e-9), "{off}, expected {expected}");
                }
            }
            let found = fan.least_off_of(is_way);
            prop_assert!(found <= least, "{found}, expected {least}");
            prop_assert!(turns || found == least, "{found}, expected {least}");
        }
    }
}

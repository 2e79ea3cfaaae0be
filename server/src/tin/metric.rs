//! What a collapse costs: the order in which vertices go.
//!
//! **`normal`**, after Hussain's simplification by normal field deviation (2013). The paper's exact formulas
//! could not be had; these are ours. A triangle is its area vector: half the cross product of two edges, in
//! metres. The *importance* of a vertex is how much the normals around it vary,
//!
//! ```text
//! sum of areas - length of the sum of area vectors   (+ lambda * its border's bend)
//! ```
//!
//! which is nothing where all lie in a plane. Vertices go by importance; which way one goes is decided by what the
//! surviving triangles t, which become t', lose:
//!
//! ```text
//! sum of (A_t + A_t')/2 * (1 - n_t . n_t')           (+ lambda * the bend of the border that way)
//! ```
//!
//! **`quadric`**: the sum of squared distances to the planes around, weighted by area, after Garland and
//! Heckbert (1997); at borders also to the walls that stand on them, weighted by lambda.
//!
//! **The bend** of a border at v between its neighbours w and u is (1 - cos of the turn) * the square of the
//! length of the edge that is moved along: an area, as the others are.

use super::fan::Fan;
use super::mesh::{Mesh, Star};
use super::{Metric, Scale, Vertex};

pub(super) type Vector = [f64; 3];

/// From one vertex to another, in metres.
pub(super) fn between(scale: &Scale, a: Vertex, b: Vertex) -> Vector {
    let step = |a: u32, b: u32| f64::from(b.wrapping_sub(a).cast_signed());
    [
        step(a.x, b.x) * scale.cell[0],
        step(a.y, b.y) * scale.cell[1],
        f64::from(b.height - a.height) * scale.quantum,
    ]
}

pub(super) fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn length(a: Vector) -> f64 {
    dot(a, a).sqrt()
}

/// The area vector of a triangle.
pub(super) fn area_vector(scale: &Scale, [a, b, c]: [Vertex; 3]) -> Vector {
    let (e, f) = (between(scale, a, b), between(scale, a, c));
    [0.5 * (e[1] * f[2] - e[2] * f[1]), 0.5 * (e[2] * f[0] - e[0] * f[2]), 0.5 * (e[0] * f[1] - e[1] * f[0])]
}

/// Twice the area of a triangle in plan, in cells; above 0 if it turns left.
pub(super) fn turn(a: Vertex, b: Vertex, c: Vertex) -> i64 {
    let step = |a: u32, b: u32| i64::from(b.wrapping_sub(a).cast_signed());
    step(a.x, b.x) * step(a.y, c.y) - step(a.y, b.y) * step(a.x, c.x)
}

/// A sum of squared distances to planes, as a quadratic form about an origin: the upper half of the matrix,
/// row by row.
#[derive(Debug, Clone, Copy, Default)]
struct Quadric([f64; 10]);

impl Quadric {
    /// `weight` times the squared distance to the plane through `point` with the unit normal `n`.
    fn plane(n: Vector, point: Vector, weight: f64) -> Self {
        let d = -dot(n, point);
        let [a, b, c] = n;
        Self([a * a, a * b, a * c, a * d, b * b, b * c, b * d, c * c, c * d, d * d].map(|q| q * weight))
    }

    fn add(&mut self, other: &Self) {
        for (here, there) in self.0.iter_mut().zip(other.0) {
            *here += there;
        }
    }

    fn at(&self, [x, y, z]: Vector) -> f64 {
        let q = &self.0;
        x * (q[0] * x + 2.0 * (q[1] * y + q[2] * z + q[3]))
            + y * (q[4] * y + 2.0 * (q[5] * z + q[6]))
            + z * (q[7] * z + 2.0 * q[8])
            + q[9]
    }
}

/// What a metric knows of a mesh.
#[derive(Debug)]
pub(super) struct Costs {
    scale: Scale,
    lambda: f64,
    /// Of the vertices, for the metric that wants them.
    quadrics: Vec<Quadric>,
    origin: Vertex,
}

impl Costs {
    pub(super) fn new(mesh: &Mesh, metric: Metric, lambda: f64, scale: Scale) -> Self {
        let origin = mesh.points.first().copied().unwrap_or_default();
        let mut costs = Self { scale, lambda, quadrics: Vec::new(), origin };
        if metric == Metric::Quadric {
            costs.quadrics = costs.all_quadrics(mesh);
        }
        costs
    }

    fn all_quadrics(&self, mesh: &Mesh) -> Vec<Quadric> {
        let at = |v: u32| between(&self.scale, self.origin, mesh.points[v as usize]);
        let mut quadrics = vec![Quadric::default(); mesh.points.len()];
        for (_, t) in mesh.triangles() {
            let vector = area_vector(&self.scale, t.map(|v| mesh.points[v as usize]));
            let area = length(vector);
            let plane = Quadric::plane(vector.map(|w| w / area), at(t[0]), area / 3.0);
            for v in t {
                quadrics[v as usize].add(&plane);
            }
        }
        for h in mesh.borders() {
            let (a, b) = (mesh.origin(h), mesh.target(h));
            let along = between(&self.scale, mesh.points[a as usize], mesh.points[b as usize]);
            let level = along[0].hypot(along[1]);
            let wall = [along[1] / level, -along[0] / level, 0.0];
            let plane = Quadric::plane(wall, at(a), self.lambda * level * level);
            for v in [a, b] {
                quadrics[v as usize].add(&plane);
            }
        }
        quadrics
    }

    /// What a star's centre is worth, as the fan has just looked at it: those of the least go first. And whether its surroundings
    /// are a plane, so that nothing is lost with it.
    pub(super) fn importance(&self, mesh: &Mesh, star: &Star, fan: &mut Fan) -> (f64, bool) {
        let border = star.border;
        let bend = || self.bend(mesh, star, 0).min(self.bend(mesh, star, 1));
        let flat = is_plane(mesh, star) && !(border && self.lambda * bend() > 0.0);
        if self.quadrics.is_empty() {
            let varies = fan.importance(&self.scale);
            return (if border { varies + self.lambda * bend() } else { varies }, flat);
        }
        // The least of what the ways out of here cost.
        let ways = (0..star.rim().len()).filter(|to| !border || *to == 0 || *to + 1 == star.rim().len());
        (ways.map(|to| self.quadric(mesh, star, to)).fold(f64::INFINITY, f64::min), flat)
    }

    /// What it costs to move a star's centre into the rim's vertex `to`, as the fan has just looked at it.
    pub(super) fn cost(&self, mesh: &Mesh, star: &Star, fan: &Fan, to: usize) -> f64 {
        if !self.quadrics.is_empty() {
            return self.quadric(mesh, star, to);
        }
        let changes = fan.cost(&self.scale, to);
        if star.border {
            return changes + self.lambda * self.bend(mesh, star, usize::from(to > 0));
        }
        changes
    }

    /// The bend of the border where it is moved along its outgoing edge, or (1) its incoming one.
    fn bend(&self, mesh: &Mesh, star: &Star, way: usize) -> f64 {
        let point = |v: u32| mesh.points[v as usize];
        let ends = [star.rim()[0], star.rim()[star.rim().len() - 1]];
        let centre = point(star.centre);
        let out = between(&self.scale, centre, point(ends[0]));
        let into = between(&self.scale, point(ends[1]), centre);
        let cos = dot(out, into) / (length(out) * length(into));
        let moved = if way == 0 { out } else { into };
        (1.0 - cos).max(0.0) * dot(moved, moved)
    }

    fn quadric(&self, mesh: &Mesh, star: &Star, to: usize) -> f64 {
        let u = star.rim()[to] as usize;
        let at = between(&self.scale, self.origin, mesh.points[u]);
        (self.quadrics[star.centre as usize].at(at) + self.quadrics[u].at(at)).max(0.0)
    }

    /// Follows a collapse that has been done.
    pub(super) fn follow(&mut self, star: &Star, to: usize) {
        if !self.quadrics.is_empty() {
            let gone = self.quadrics[star.centre as usize];
            self.quadrics[star.rim()[to] as usize].add(&gone);
        }
    }
}

/// Whether all triangles of a star lie in one plane.
fn is_plane(mesh: &Mesh, star: &Star) -> bool {
    let centre = mesh.points[star.centre as usize];
    let step = |a: u32, b: u32| i64::from(b.wrapping_sub(a).cast_signed());
    let mut steps = star.rim().iter().map(|v| {
        let v = &mesh.points[*v as usize];
        [step(centre.x, v.x), step(centre.y, v.y), i64::from(v.height) - i64::from(centre.height)]
    });
    let (Some(a), Some(b)) = (steps.next(), steps.next()) else { return true };
    let normal = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    let along = |step: [i64; 3]| (0..3).map(|i| i128::from(normal[i]) * i128::from(step[i])).sum::<i128>();
    steps.all(|step| along(step) == 0)
}

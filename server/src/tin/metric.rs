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
use super::mesh::{Mesh, NONE, Star, triangle};
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
    /// Area vectors and areas of the triangles.
    vectors: Vec<(Vector, f64)>,
    /// Of the vertices, for the metric that wants them.
    quadrics: Vec<Quadric>,
    origin: Vertex,
}

impl Costs {
    pub(super) fn new(mesh: &Mesh, metric: Metric, lambda: f64, scale: Scale) -> Self {
        let corner = |v: u32| mesh.points[v as usize];
        // A mesh that is new has all its triangles.
        let mut vectors = Vec::with_capacity(mesh.live);
        vectors.extend(mesh.triangles().map(|(_, t)| with_length(area_vector(&scale, t.map(corner)))));
        let origin = mesh.points.first().copied().unwrap_or_default();
        let mut costs = Self { scale, lambda, vectors, quadrics: Vec::new(), origin };
        if metric == Metric::Quadric {
            costs.quadrics = costs.all_quadrics(mesh);
        }
        costs
    }

    fn all_quadrics(&self, mesh: &Mesh) -> Vec<Quadric> {
        let at = |v: u32| between(&self.scale, self.origin, mesh.points[v as usize]);
        let mut quadrics = vec![Quadric::default(); mesh.points.len()];
        for ((_, t), (vector, area)) in mesh.triangles().zip(&self.vectors) {
            let plane = Quadric::plane(vector.map(|w| w / area), at(t[0]), *area / 3.0);
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

    /// What a star's centre is worth: those of the least go first. And whether its surroundings are a plane, so that
    /// nothing is lost with it.
    pub(super) fn importance(&self, mesh: &Mesh, star: &Star) -> (f64, bool) {
        let (mut areas, mut sum) = (0.0, [0.0; 3]);
        for spoke in star.spokes() {
            let (vector, area) = self.vectors[triangle(*spoke)];
            areas += area;
            sum = [sum[0] + vector[0], sum[1] + vector[1], sum[2] + vector[2]];
        }
        let border = star.border;
        let varies = areas - length(sum);
        if !border && self.quadrics.is_empty() {
            return (varies, varies <= FLAT * areas);
        }
        let bend =
            if border { self.lambda * self.bend(mesh, star, 0).min(self.bend(mesh, star, 1)) } else { 0.0 };
        let flat = varies <= FLAT * areas && bend <= FLAT * areas;
        if self.quadrics.is_empty() {
            return (varies + bend, flat);
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
        let changes = fan.cost(&self.scale, to, |i| self.vectors[triangle(star.spokes()[i])]);
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
    pub(super) fn follow(&mut self, mesh: &Mesh, star: &Star, to: usize) {
        let u = star.rim()[to];
        if !self.quadrics.is_empty() {
            let gone = self.quadrics[star.centre as usize];
            self.quadrics[u as usize].add(&gone);
        }
        for spoke in star.spokes() {
            let t = triangle(*spoke);
            let corners = mesh.corners(t);
            if corners[0] != NONE {
                let points = corners.map(|v| mesh.points[v as usize]);
                self.vectors[t] = with_length(area_vector(&self.scale, points));
            }
        }
    }
}

/// A share of an area that is nothing but rounding.
const FLAT: f64 = 1e-12;

fn with_length(vector: Vector) -> (Vector, f64) {
    (vector, length(vector))
}

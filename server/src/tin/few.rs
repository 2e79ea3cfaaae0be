//! A whole fan of few vertices nearby, as most are: two times four numbers, worked on side by side.
//!
//! Steps along x and y and their products are whole numbers below 2^24, so areas in plan are exact in `f32`. What heights
//! have a part in is rounded: distances are made so much less that they are never more than the true ones.

use super::Vertex;
use super::metric::Vector;
use glam::Vec4;

/// Vertices around of most fans, at most.
pub(super) const FEW: usize = 8;

/// Cells that a mesh may be wide for all areas of its fans to be exact in `f32`: sums of three products of two steps
/// are below 2^24.
pub(super) const NEAR: u32 = (1 << 11) - 1;

/// More than what rounding leaves of a sum of three products of which each has been rounded four times.
const ROUNDING: f32 = 1.0 / (1u32 << 20) as f32;

/// A number of each triangle: of those that follow the first four vertices, and the others.
type Eight = [Vec4; 2];

/// The vertices around the origin, in cells and quanta.
#[derive(Debug, Default)]
pub(super) struct Few {
    count: usize,
    /// The vertices. Behind the last one comes the first one again and again.
    steps: [[f32; FEW + 1]; 3],
    /// How far the centre's own sample will be from the surface at least, by ways; infinite where there is no way.
    offs: [f32; FEW],
    /// Of the triangles that follow the vertices the edges, back to the vertices; twice the area vectors, in cells and
    /// quanta; the normals; and the areas.
    edges: [Eight; 3],
    vectors: [Eight; 3],
    normals: [Eight; 3],
    areas: Eight,
    metres: [f32; 3],
}

fn each<T>(of: impl Fn(usize) -> T) -> [T; 2] {
    [of(0), of(1)]
}

/// Eight numbers from the first or the second on.
fn eight(numbers: &[f32; FEW + 1], from: usize) -> Eight {
    each(|four| {
        let at = from % 2 + 4 * four;
        Vec4::new(numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3])
    })
}

fn length([a, b, c]: [Vec4; 3]) -> Vec4 {
    (a * a + b * b + c * c).sqrt()
}

/// The sum of four numbers, in an order of our own: the same on every machine.
fn in_order(four: Vec4) -> f32 {
    let [a, b, c, d] = four.to_array();
    (a + b) + (c + d)
}

impl Few {
    /// Takes over so many vertices around a centre, behind which the first one comes again and again.
    #[allow(clippy::cast_precision_loss, reason = "below 2^24, but for heights, whose rounding is counted")]
    pub(super) fn look(&mut self, centre: Vertex, points: &[Vertex], rim: &[u32; FEW], count: usize) {
        let step = |a: u32, b: u32| b.wrapping_sub(a).cast_signed() as f32;
        self.count = count;
        for (i, v) in rim.iter().enumerate() {
            let v = &points[*v as usize];
            self.steps[0][i] = step(centre.x, v.x);
            self.steps[1][i] = step(centre.y, v.y);
            self.steps[2][i] = (v.height - centre.height) as f32;
        }
        for steps in &mut self.steps {
            steps[FEW] = steps[0];
        }
    }

    /// The vertices, and those that follow them.
    fn here(&self) -> [Eight; 3] {
        self.steps.each_ref().map(|steps| eight(steps, 0))
    }

    fn after(&self) -> [Eight; 3] {
        self.steps.each_ref().map(|steps| eight(steps, 1))
    }

    /// Finds out how far off the centre's own sample will be, whichever way it goes. Of each triangle all ways are looked at
    /// at once: of which it turns over, and of which it will cover the sample.
    pub(super) fn measure(&mut self) {
        if self.count <= FEW / 2 { self.measure_ways::<1>() } else { self.measure_ways::<2>() }
    }

    #[inline(always)]
    fn measure_ways<const FOURS: usize>(&mut self) {
        let ways = self.here();
        let [u_x, u_y, u_z] = ways.each_ref().map(|w| &w[..FOURS]);
        let with = |i: usize| -> [Vec4; FOURS] {
            let (x, y) = (Vec4::splat(self.steps[0][i]), Vec4::splat(self.steps[1][i]));
            std::array::from_fn(|k| u_x[k] * y - u_y[k] * x)
        };
        let (mut height, mut area) = ([Vec4::ZERO; FOURS], [Vec4::ONE; FOURS]);
        // How many triangles keep turning left: all but the two at the way itself have to.
        let mut remaining = [Vec4::ZERO; FOURS];
        let mut from = with(0);
        for i in 0..self.count.min(FEW) {
            let until = with(i + 1);
            let [x, y, z] = self.steps.each_ref().map(|w| w[i]);
            let [next_x, next_y, next_z] = self.steps.each_ref().map(|w| w[i + 1]);
            let turn = Vec4::splat(x * next_y - y * next_x);
            let (z, next_z) = (Vec4::splat(z), Vec4::splat(next_z));
            for k in 0..FOURS {
                let doubled = turn + from[k] - until[k];
                let remains = doubled.cmpgt(Vec4::ZERO);
                remaining[k] += Vec4::select(remains, Vec4::ONE, Vec4::ZERO);
                let (a, b, c) = (turn * u_z[k], from[k] * next_z, until[k] * z);
                let surely = (a + b - c).abs() - Vec4::splat(ROUNDING) * (a.abs() + b.abs() + c.abs());
                let covers = from[k].cmpge(Vec4::ZERO) & until[k].cmple(Vec4::ZERO) & remains;
                height[k] = Vec4::select(covers, surely, height[k]);
                area[k] = Vec4::select(covers, doubled, area[k]);
            }
            from = until;
        }
        #[allow(clippy::cast_precision_loss, reason = "at most eight")]
        let all = Vec4::splat((self.count - 2) as f32);
        let mut offs = [Vec4::INFINITY; 2];
        for k in 0..FOURS {
            let off = (height[k] / area[k]).max(Vec4::ZERO);
            offs[k] = Vec4::select(remaining[k].cmpeq(all), off, Vec4::INFINITY);
        }
        let [a, b] = offs.map(|four| four.to_array());
        self.offs = [a[0], a[1], a[2], a[3], b[0], b[1], b[2], b[3]];
    }

    /// What [`Few::measure`] has found of a way.
    pub(super) fn off(&self, to: usize) -> f64 {
        self.offs[to % FEW].into()
    }

    /// The least of what [`Few::measure`] has found of all ways.
    pub(super) fn least_off(&self) -> f64 {
        self.offs[..self.count.min(FEW)].iter().copied().fold(f32::INFINITY, f32::min).into()
    }

    /// Which ways [`Few::measure`] has found to be no farther off than a limit, as bits, and the least of the others.
    pub(super) fn within(&self, limit: f32) -> (u32, f64) {
        let (mut ways, mut least) = (0, f32::INFINITY);
        for (to, off) in self.offs.iter().enumerate() {
            let is_within = *off <= limit;
            ways |= u32::from(is_within) << to;
            least = least.min(if is_within { f32::INFINITY } else { *off });
        }
        (ways & !(u32::MAX << self.count), least.into())
    }

    /// Prepares [`Few::cost`], given what the components of cross products have to be scaled by to be area vectors.
    #[allow(clippy::cast_possible_truncation, reason = "an order need not be precise")]
    pub(super) fn prepare(&mut self, metres: Vector) {
        self.metres = metres.map(|w| w as f32);
        let ([x, y, z], [next_x, next_y, next_z]) = (self.here(), self.after());
        self.edges = [each(|i| x[i] - next_x[i]), each(|i| y[i] - next_y[i]), each(|i| z[i] - next_z[i])];
        self.vectors = [
            each(|i| y[i] * next_z[i] - z[i] * next_y[i]),
            each(|i| z[i] * next_x[i] - x[i] * next_z[i]),
            each(|i| x[i] * next_y[i] - y[i] * next_x[i]),
        ];
        for i in 0..2 {
            let vector = [0, 1, 2].map(|k| self.vectors[k][i] * self.metres[k]);
            let area = length(vector);
            self.areas[i] = area;
            for (normals, vector) in self.normals.iter_mut().zip(vector) {
                normals[i] = vector / area;
            }
        }
    }

    /// How much the normals vary: half of the sum of A |n_t - n|^2, n the direction of all area vectors together.
    pub(super) fn importance(&self) -> f64 {
        // Behind all there is no area, and no normal.
        let is_there = |area: Vec4| area.cmpgt(Vec4::ZERO);
        let together = |of: &Eight| in_order(of[0] + of[1]);
        let vectors = [0, 1, 2].map(|k| each(|i| self.vectors[k][i] * self.metres[k]));
        let [x, y, z] = vectors.each_ref().map(together);
        let each_of = 1.0 / (x * x + y * y + z * z).sqrt();
        let direction = [x * each_of, y * each_of, z * each_of];
        let of_four = each(|i| {
            let d = [0, 1, 2].map(|k| self.normals[k][i] - Vec4::splat(direction[k]));
            let varies = self.areas[i] * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
            Vec4::select(is_there(self.areas[i]), varies, Vec4::ZERO)
        });
        0.5 * f64::from(in_order(of_four[0] + of_four[1]))
    }

    /// How much the normals of the triangles that survive change if the centre slides into a vertex: where normals differ
    /// by d, 1 - n . n' is d^2 / 2.
    pub(super) fn cost(&self, to: usize) -> f64 {
        let [u_x, u_y, u_z] = [0, 1, 2].map(|k| Vec4::splat(self.steps[k][to % FEW]));
        let [x, y, z] = &self.edges;
        let of_four = each(|i| {
            let [old_x, old_y, old_z] = [0, 1, 2].map(|k| self.vectors[k][i]);
            let doubled = old_z + (u_x * y[i] - u_y * x[i]);
            let vector = [
                (old_x + (u_y * z[i] - u_z * y[i])) * self.metres[0],
                (old_y + (u_z * x[i] - u_x * z[i])) * self.metres[1],
                doubled * self.metres[2],
            ];
            let area = length(vector);
            let d = [0, 1, 2].map(|k| vector[k] / area - self.normals[k][i]);
            let change = (area + self.areas[i]) * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
            Vec4::select(doubled.cmpgt(Vec4::ZERO), change, Vec4::ZERO)
        });
        0.25 * f64::from(in_order(of_four[0] + of_four[1]))
    }
}

//! The simplification of a diamond: vertices slide into their neighbours, the least important first.
//!
//! ```text
//!      b          The square's outer border is locked. What lies on its hypotenuse, from a to b, moves along it
//!     / \         alone, so that both halves keep the same vertices there. Inner vertices move where they like,
//!    /   \        as long as no triangle turns over; so none can cross the hypotenuse, whose edges are edges
//!   e --- c       of the mesh. Vertices along nodata move along that border alone, and only where it bulges or
//!    \   /        is straight: what is drawn never grows, so it never covers what has no data.
//!     \ /
//!      a
//! ```
//!
//! No other check of the topology is needed: triangles that turn left around a vertex which sees its whole rim
//! cannot overlap others, and an edge that was there already would have had to cross them.

use super::ground::Ground;
use super::mesh::{Mesh, NONE, Star, next};
use super::metric::{Costs, between, length, turn};
use super::queue::Queue;
use super::{Rules, Vertex};
use std::collections::HashMap;

/// Where simplification stops.
#[derive(Debug, Clone, Copy)]
pub enum Until<'a> {
    /// At so many triangles of each half, or a few less; but it goes on as long as nothing is lost.
    Triangles(usize),
    /// Likewise, but no collapse may put a sample farther away than a distance that grows from `start`, in quanta, only
    /// when nothing is left that keeps it: so the largest error is about the least that so many triangles can have. Nor
    /// may a border move farther than that over lambda.
    Within {
        /// Triangles of each half.
        triangles: usize,
        /// The samples of the diamond.
        ground: Ground<'a>,
        /// How far they are from it as it is, in quanta; at least half of one.
        start: f64,
    },
    /// Where any further collapse would put a sample farther away than so many quanta, or a border than so
    /// many metres.
    Error {
        /// The samples of the diamond.
        ground: Ground<'a>,
        /// Vertical distance, in quanta.
        vertical: f64,
        /// Distance of borders, in metres.
        border: f64,
    },
}

/// Where the limit of a count begins, in quanta, and how it grows: in finer steps there are more passes, and hardly fewer
/// triangles.
const LIMIT_LEAST: f64 = 0.5;
const LIMIT_GROWTH: f64 = 1.5;

/// What may become of a vertex.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
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
    fn sides(&self) -> impl Iterator<Item = [Vertex; 2]> {
        let apexes = std::iter::once(self.lower).chain(self.upper);
        apexes.flat_map(|apex| [[self.a, apex], [apex, self.b]])
    }

    /// Whether a point lies inside, given how to scale the corners to its coordinates.
    pub(super) fn contains(&self, v: Vertex, scaled: impl Fn(Vertex) -> Vertex) -> bool {
        let far = self.upper.map_or([self.b, self.a], |upper| [self.b, upper]);
        let corners = [self.a, self.lower, far[0], far[1]].map(scaled);
        (0..4).all(|i| turn(corners[i], corners[(i + 1) % 4], v) >= 0)
    }

    fn role(&self, v: Vertex) -> Role {
        if self.sides().any(|[p, q]| turn(p, q, v) == 0) {
            Role::Locked
        } else if turn(self.a, self.b, v) == 0 {
            Role::Along
        } else {
            Role::Free
        }
    }
}

/// Points of the source's border that an edge of the border stands for.
pub(super) type Passed = HashMap<u32, Vec<[u32; 2]>>;

/// A mesh being simplified.
#[derive(Debug)]
pub(super) struct Simplifier<'a> {
    pub(super) mesh: Mesh,
    /// By half-edges of the border.
    pub(super) passed: Passed,
    /// Whether it is the mesh of the source, with nothing gone yet.
    is_source: bool,
    square: Square,
    rules: &'a Rules,
    until: Until<'a>,
    /// Triangles that are few enough, whatever else allows.
    target: usize,
    costs: Costs,
    roles: Vec<Role>,
    queue: Queue,
    star: Star,
    /// Of the vertices around, as they are looked at in turn.
    other: Star,
    ways: Vec<(f64, usize)>,
}

impl<'a> Simplifier<'a> {
    pub(super) fn new(
        mesh: Mesh,
        passed: Passed,
        is_source: bool,
        square: Square,
        rules: &'a Rules,
        until: Until<'a>,
    ) -> Self {
        let costs = Costs::new(&mesh, rules.metric, rules.lambda, rules.scale);
        let roles = mesh.points.iter().map(|v| square.role(*v)).collect();
        let queue = Queue::new(mesh.points.len());
        let (star, other, ways) = (Star::default(), Star::default(), Vec::new());
        Self {
            mesh,
            passed,
            is_source,
            square,
            rules,
            until,
            target: 0,
            costs,
            roles,
            queue,
            star,
            other,
            ways,
        }
    }

    /// Collapses until there is nothing left to do; on beyond an error as long as there are more triangles than a
    /// payload has room for.
    pub(super) fn run(&mut self) {
        if let Until::Within { triangles, ground, start } = self.until {
            return self.run_within(triangles, ground, start);
        }
        self.pass();
        let most = self.halves().saturating_mul(self.rules.triangles_max);
        if matches!(self.until, Until::Error { .. }) && self.mesh.live > most {
            self.until = Until::Triangles(self.rules.triangles_max);
            self.pass();
        }
    }

    fn run_within(&mut self, triangles: usize, ground: Ground<'a>, start: f64) {
        self.target = self.halves().saturating_mul(triangles);
        let heights = self.mesh.points.iter().map(|v| f64::from(v.height));
        let (low, high) = heights.fold((f64::MAX, f64::MIN), |(low, high), h| (low.min(h), high.max(h)));
        let mut vertical = start.max(LIMIT_LEAST);
        // No sample is farther from a triangle than this, whatever goes: then only borders hold what is left.
        let flat = |v: Vertex| Vertex { height: 0, ..v };
        let width = length(between(&self.rules.scale, flat(self.square.a), flat(self.square.b)));
        // A border that moves by a metre counts as lambda metres of height.
        let per_metre = self.rules.lambda / self.rules.scale.quantum;
        let most = (start + high - low).max(width * per_metre);
        loop {
            let border = if per_metre > 0.0 { vertical / per_metre } else { f64::INFINITY };
            self.until = Until::Error { ground, vertical, border };
            self.pass();
            if self.mesh.live <= self.target || vertical > most {
                return;
            }
            vertical *= LIMIT_GROWTH;
        }
    }

    fn pass(&mut self) {
        for v in 0..u32::try_from(self.mesh.points.len()).unwrap_or(NONE) {
            if self.mesh.is_live(v) && self.may_go(v) {
                self.enqueue(v);
            }
        }
        while let Some((_, v)) = self.queue.pop() {
            if self.is_enough(v) {
                continue;
            }
            self.mesh.look(v, &mut self.star);
            self.find_ways();
            let ways = std::mem::take(&mut self.ways);
            if let Some((_, to)) = ways.iter().find(|(_, to)| self.is_allowed(*to)) {
                self.collapse(*to);
            }
            self.ways = ways;
        }
    }

    /// How many triangles of the bintree the square has.
    fn halves(&self) -> usize {
        1 + usize::from(self.square.upper.is_some())
    }

    /// Whether it is worth a look if a vertex may go: of the source's own mesh few may where nothing may be lost.
    fn may_go(&self, v: u32) -> bool {
        match self.until {
            Until::Error { ground, vertical: 0.0, .. } if self.is_source => {
                ground.may_be_plane(self.mesh.points[v as usize])
            }
            _ => true,
        }
    }

    /// Whether a vertex has to stay since there are few enough triangles.
    fn is_enough(&mut self, v: u32) -> bool {
        match self.until {
            Until::Triangles(target) => {
                self.mesh.live <= self.halves().saturating_mul(target)
                    && !self.costs.importance(&self.mesh, v, &mut self.other).1
            }
            Until::Error { .. } | Until::Within { .. } => {
                self.mesh.live <= self.target && !self.costs.importance(&self.mesh, v, &mut self.other).1
            }
        }
    }

    fn enqueue(&mut self, v: u32) {
        if self.roles[v as usize] == Role::Locked {
            return;
        }
        let (key, flat) = self.costs.importance(&self.mesh, v, &mut self.other);
        // Where nothing may be lost, and something would be, there is no need to try.
        if matches!(self.until, Until::Error { vertical: 0.0, .. }) && !flat {
            self.queue.remove(v);
            return;
        }
        #[allow(clippy::cast_possible_truncation, reason = "an order need not be precise")]
        self.queue.set(v, key as f32);
    }

    /// The ways that the star's centre may go without turning a triangle over, the cheapest first.
    fn find_ways(&mut self) {
        self.ways.clear();
        let (star, mesh) = (&self.star, &self.mesh);
        let along = self.roles[star.centre as usize] == Role::Along;
        if star.border {
            // The last triangle of all stays.
            if star.spokes.len() == 1 && mesh.twin(next(star.spokes[0])) == NONE {
                return;
            }
            let ends = [star.rim[0], star.rim[star.rim.len() - 1]];
            let [out, into] = ends.map(|v| mesh.points[v as usize]);
            // What is drawn must not grow, and a border that leaves the hypotenuse stays where it does.
            let leaves = along && !ends.iter().all(|v| self.is_along(*v));
            if leaves || turn(mesh.points[star.centre as usize], out, into) < 0 {
                return;
            }
        }
        for to in 0..star.rim.len() {
            let is_end = to == 0 || to + 1 == star.rim.len();
            if star.border && !is_end {
                continue;
            }
            if along && !self.is_along(star.rim[to]) {
                continue;
            }
            if let Some(cost) = self.costs.cost(mesh, star, to) {
                self.ways.push((cost, to));
            }
        }
        self.ways.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    }

    /// Whether a vertex beside one on the hypotenuse lies on it, too.
    fn is_along(&self, v: u32) -> bool {
        turn(self.square.a, self.square.b, self.mesh.points[v as usize]) == 0
    }

    /// Whether the star's centre may go that way as far as errors are concerned.
    fn is_allowed(&self, to: usize) -> bool {
        let Until::Error { ground, vertical, border } = &self.until else { return true };
        let star = &self.star;
        if star.border && self.border_distance() > *border {
            return false;
        }
        let u = star.rim[to];
        let point = |v: u32| self.mesh.points[v as usize];
        (0..star.spokes.len())
            .map(|i| star.edge(i))
            .filter(|edge| !edge.contains(&u))
            .all(|[p, q]| ground.distance([point(u), point(p), point(q)], *vertical) <= *vertical)
    }

    /// How far the border would be from the source's if the star's centre left it, in metres.
    fn border_distance(&self) -> f64 {
        let star = &self.star;
        let point = |v: u32| self.mesh.points[v as usize];
        let ends = [point(star.rim[star.rim.len() - 1]), point(star.rim[0])];
        let halves = star.incoming().into_iter().chain([star.spokes[0]]);
        let passed = halves.filter_map(|h| self.passed.get(&h)).flatten().copied();
        let centre = point(star.centre);
        passed
            .chain([[centre.x, centre.y]])
            .map(|p| distance_to(&self.rules.scale, p, ends))
            .fold(0.0, f64::max)
    }

    /// Lets the star's centre go that way.
    fn collapse(&mut self, to: usize) {
        let star = std::mem::take(&mut self.star);
        let point = |v: u32| self.mesh.points[v as usize];
        let mut passed = Vec::new();
        if star.border {
            let (centre, out, into) =
                (point(star.centre), point(star.rim[0]), point(star.rim[star.rim.len() - 1]));
            if let Some(before) = star.incoming().and_then(|h| self.passed.remove(&h)) {
                passed = before;
            }
            // What lies on a straight border is as near to any other as the ends are.
            if turn(into, centre, out) != 0 {
                passed.push([centre.x, centre.y]);
            }
            passed.extend(self.passed.remove(&star.spokes[0]).unwrap_or_default());
        }
        let moved = self.mesh.collapse(&star, to);
        if !self.passed.is_empty() {
            for [before, now] in moved.rim {
                if let Some(points) = self.passed.remove(&before) {
                    self.passed.insert(now, points);
                }
            }
        }
        if let Some(h) = moved.joined.filter(|_| !passed.is_empty()) {
            self.passed.insert(h, passed);
        }
        self.costs.follow(&self.mesh, &star, to);
        for v in &star.rim {
            self.enqueue(*v);
        }
        self.star = star;
    }
}

/// The distance between a point and a line between two vertices, in plan, in metres.
pub(super) fn distance_to(scale: &super::Scale, [x, y]: [u32; 2], [a, b]: [Vertex; 2]) -> f64 {
    let flat = |v: Vertex| Vertex { height: 0, ..v };
    let (along, to) = (between(scale, flat(a), flat(b)), between(scale, flat(a), Vertex { x, y, height: 0 }));
    let squared = along[0] * along[0] + along[1] * along[1];
    let share =
        if squared > 0.0 { ((along[0] * to[0] + along[1] * to[1]) / squared).clamp(0.0, 1.0) } else { 0.0 };
    (to[0] - share * along[0]).hypot(to[1] - share * along[1])
}

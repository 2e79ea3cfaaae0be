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
//! Whether a vertex may go depends on what surrounds it alone. So one that was tried in vain waits until that changes, or
//! until the limit has grown to what it needs; and what has changed is tried in the next pass, under the next limit. The
//! farthest sample of each triangle is known from when it was allowed: nothing is measured twice.
//!
//! No other check of the topology is needed: triangles that turn left around a vertex which sees its whole rim
//! cannot overlap others, and an edge that was there already would have had to cross them.

use super::fan::Fan;
use super::ground::Ground;
use super::mesh::{Mesh, NONE, Star, next};
use super::metric::{Costs, between, length, turn};
use super::{Rules, Vertex};
use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap};

/// Where simplification stops.
#[derive(Debug, Clone, Copy)]
pub enum Until<'a> {
    /// At so many triangles of each half, or a few less; but it goes on as long as nothing is lost.
    Triangles(usize),
    /// Likewise, but no collapse may put a sample farther away than a distance that grows from what it is, in quanta, only
    /// when nothing is left that keeps it: so the largest error is about the least that so many triangles can have. Nor
    /// may a border move farther than that over lambda.
    Within {
        /// Triangles of each half.
        triangles: usize,
        /// The samples of the diamond.
        ground: Ground<'a>,
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
const LIMIT_GROWTH: f64 = 1.2;

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
    /// Of each vertex.
    states: Vec<State>,
    /// By rank, those of the least first.
    queue: BinaryHeap<Reverse<u64>>,
    /// How far samples are from each triangle, in quanta, if that is known.
    pub(super) errors: Vec<f32>,
    /// Of triangles of the star, if its centre goes the way that was looked at last.
    found: Vec<(u32, f32)>,
    star: Star,
    fan: Fan,
    /// Of the vertices around, as they are looked at in turn.
    other: Star,
    ways: Vec<(f64, usize)>,
}

/// What is known of a vertex as long as nothing changes around it.
#[derive(Debug, Clone, Copy)]
struct State {
    /// How important it is.
    key: f32,
    /// It cannot go under any limit below this: known once it has been tried.
    needed: f32,
    /// Whether nothing is lost with it.
    flat: bool,
    /// Whether both are known.
    is_known: bool,
    role: Role,
}

impl State {
    fn is_flat_or_unknown(&self) -> bool {
        self.flat || !self.is_known
    }

    /// Numbers that sort as the keys do, none of which is negative, and of equal keys as the vertices: so that the order
    /// is the same on every run.
    fn rank(&self, v: u32) -> u64 {
        u64::from(self.key.to_bits()) << 32 | u64::from(v)
    }
}

#[allow(clippy::cast_possible_truncation, reason = "the vertex is the lower half")]
fn vertex(rank: u64) -> u32 {
    rank as u32
}

impl<'a> Simplifier<'a> {
    pub(super) fn new(
        mesh: Mesh,
        passed: Passed,
        errors: Vec<f32>,
        is_source: bool,
        square: Square,
        rules: &'a Rules,
        until: Until<'a>,
    ) -> Self {
        let costs = Costs::new(&mesh, rules.metric, rules.lambda, rules.scale);
        let state =
            |v: &Vertex| State { key: 0.0, needed: 0.0, flat: false, is_known: false, role: square.role(*v) };
        let states = mesh.points.iter().map(state).collect();
        let queue = BinaryHeap::with_capacity(mesh.points.len());
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
            states,
            queue,
            errors,
            found: Vec::new(),
            star,
            fan: Fan::default(),
            other,
            ways,
        }
    }

    /// Collapses until there is nothing left to do; on beyond an error as long as there are more triangles than a
    /// payload has room for.
    pub(super) fn run(&mut self) {
        if let Until::Within { triangles, ground } = self.until {
            return self.run_within(triangles, ground);
        }
        self.exhaust();
        let most = self.halves().saturating_mul(self.rules.triangles_max);
        if matches!(self.until, Until::Error { .. }) && self.mesh.live > most {
            self.until = Until::Triangles(self.rules.triangles_max);
            self.exhaust();
            // Nobody has looked at any sample.
            self.errors.clear();
        } else if matches!(self.until, Until::Triangles(_)) {
            self.errors.clear();
        }
    }

    /// Passes until nothing goes any more.
    fn exhaust(&mut self) {
        self.look_at_all();
        while self.pass(0.0) {}
    }

    fn run_within(&mut self, triangles: usize, ground: Ground<'a>) {
        let start = f64::from(self.errors.iter().copied().fold(0.0, f32::max));
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
        self.look_at_all();
        loop {
            let border = if per_metre > 0.0 { vertical / per_metre } else { f64::INFINITY };
            self.until = Until::Error { ground, vertical, border };
            self.pass(per_metre);
            if self.mesh.live <= self.target || vertical > most {
                return;
            }
            vertical *= LIMIT_GROWTH;
        }
    }

    /// Has every vertex tried.
    fn look_at_all(&mut self) {
        for v in 0..u32::try_from(self.mesh.points.len()).unwrap_or(NONE) {
            let tried = self.mesh.is_live(v) && self.may_go(v);
            let state = &mut self.states[v as usize];
            let stays = !tried || state.role == Role::Locked;
            (state.needed, state.is_known) = (if stays { f32::INFINITY } else { 0.0 }, false);
        }
    }

    /// Collapses what a limit allows, the least important first. What changes after it was tried is tried again in
    /// the next pass. A border that moves by a metre counts as `per_metre` quanta of height in what a vertex needs.
    /// Whether anything has gone.
    fn pass(&mut self, per_metre: f64) -> bool {
        let limit = match self.until {
            Until::Error { vertical, .. } => vertical,
            _ => f64::INFINITY,
        };
        self.fill(limit);
        let before = self.mesh.live;
        let mut is_enough = false;
        while let Some(Reverse(rank)) = self.queue.pop() {
            let v = vertex(rank);
            if !self.states[v as usize].is_known {
                let state = self.weigh(v);
                let rank = state.rank(v);
                // Something else may be less important now.
                if self.queue.peek().is_some_and(|Reverse(least)| *least < rank) {
                    self.queue.push(Reverse(rank));
                    continue;
                }
            }
            if !is_enough && self.is_enough() {
                is_enough = true;
                let mut others = std::mem::take(&mut self.queue);
                others.retain(|Reverse(rank)| self.states[vertex(*rank) as usize].is_flat_or_unknown());
                self.queue = others;
            }
            let state = self.states[v as usize];
            if state.needed == f32::INFINITY || (is_enough && !state.flat) {
                continue;
            }
            self.mesh.look(v, &mut self.star);
            let needed = self.find_ways(per_metre);
            match self.first_allowed(limit) {
                Ok(to) => self.collapse(to),
                Err(at_least) => self.states[v as usize].needed = below(needed.min(at_least)),
            }
        }
        self.mesh.live < before
    }

    /// Queues all that a limit may let go.
    fn fill(&mut self, limit: f64) {
        let mut ranks = std::mem::take(&mut self.queue).into_vec();
        for v in 0..u32::try_from(self.states.len()).unwrap_or(NONE) {
            let mut state = self.states[v as usize];
            if state.needed < f32::INFINITY && f64::from(state.needed) <= limit {
                if !state.is_known {
                    state = self.weigh(v);
                }
                if state.needed < f32::INFINITY {
                    ranks.push(Reverse(state.rank(v)));
                }
            }
        }
        self.queue = ranks.into();
    }

    /// The cheapest way whose triangles keep the limit, or what the others need at least; with the distances of these
    /// triangles in `found`.
    fn first_allowed(&mut self, limit: f64) -> Result<usize, f64> {
        let ways = std::mem::take(&mut self.ways);
        let mut needed = f64::INFINITY;
        let allowed = ways.iter().find(|(_, to)| {
            let found = self.needs(*to);
            needed = needed.min(found);
            found <= limit
        });
        let allowed = allowed.map(|(_, to)| *to);
        self.ways = ways;
        allowed.ok_or(needed)
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

    /// Whether there are few enough triangles, so that no more than what is for nothing goes.
    fn is_enough(&self) -> bool {
        match self.until {
            Until::Triangles(target) => self.mesh.live <= self.halves().saturating_mul(target),
            Until::Error { .. } | Until::Within { .. } => self.mesh.live <= self.target,
        }
    }

    /// Finds out how important a vertex is that is not locked.
    fn weigh(&mut self, v: u32) -> State {
        let (key, flat) = self.costs.importance(&self.mesh, v, &mut self.other);
        let state = &mut self.states[v as usize];
        #[allow(clippy::cast_possible_truncation, reason = "an order need not be precise")]
        let key = key.max(0.0) as f32;
        // Where nothing may be lost, and something would be, there is no need to try.
        let stays = !flat && matches!(self.until, Until::Error { vertical: 0.0, .. });
        let needed = if stays { f32::INFINITY } else { state.needed };
        *state = State { key, needed, flat, is_known: true, ..*state };
        *state
    }

    /// The ways that the star's centre may go, the cheapest first: without turning a triangle over, as far as its own
    /// sample and the border allow. What others need at least, in quanta.
    fn find_ways(&mut self, per_metre: f64) -> f64 {
        self.ways.clear();
        let (star, mesh) = (&self.star, &self.mesh);
        let along = self.states[star.centre as usize].role == Role::Along;
        let mut limit = f64::INFINITY;
        if star.border {
            // The last triangle of all stays.
            if star.spokes.len() == 1 && mesh.twin(next(star.spokes[0])) == NONE {
                return f64::INFINITY;
            }
            let ends = [star.rim[0], star.rim[star.rim.len() - 1]];
            let [out, into] = ends.map(|v| mesh.points[v as usize]);
            // What is drawn must not grow, and a border that leaves the hypotenuse stays where it does.
            let leaves = along && !ends.iter().all(|v| self.is_along(*v));
            if leaves || turn(mesh.points[star.centre as usize], out, into) < 0 {
                return f64::INFINITY;
            }
        }
        if let Until::Error { ground, vertical, border } = &self.until {
            if star.border {
                let distance = self.border_distance();
                if distance > *border {
                    return distance * per_metre;
                }
            }
            if ground.has(mesh.points[star.centre as usize]) {
                limit = *vertical;
            }
        }
        let mut needed = f64::INFINITY;
        self.fan.look(mesh, star);
        for to in 0..star.rim.len() {
            let is_end = to == 0 || to + 1 == star.rim.len();
            if star.border && !is_end {
                continue;
            }
            if along && !self.is_along(star.rim[to]) {
                continue;
            }
            let Some(off) = self.fan.off(to) else { continue };
            if off > limit {
                needed = needed.min(off);
            } else {
                self.ways.push((self.costs.cost(mesh, star, &self.fan, to), to));
            }
        }
        self.ways.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        needed
    }

    /// Whether a vertex beside one on the hypotenuse lies on it, too.
    fn is_along(&self, v: u32) -> bool {
        turn(self.square.a, self.square.b, self.mesh.points[v as usize]) == 0
    }

    /// How far samples will be from the triangles if the star's centre goes that way, in quanta; or, where that is more
    /// than is allowed, something between the two. Notes what it finds.
    fn needs(&mut self, to: usize) -> f64 {
        self.found.clear();
        let Until::Error { ground, vertical, .. } = &self.until else { return 0.0 };
        let star = &self.star;
        let u = star.rim[to];
        let point = |v: u32| self.mesh.points[v as usize];
        let mut most = 0.0f64;
        for i in 0..star.spokes.len() {
            let [p, q] = star.edge(i);
            if p == u || q == u {
                continue;
            }
            let distance = ground.distance([point(u), point(p), point(q)], *vertical);
            most = most.max(distance);
            if most > *vertical {
                break;
            }
            self.found.push((star.spokes[i] / 3, at_least(distance)));
        }
        most
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
        for (t, distance) in self.found.drain(..) {
            if let Some(error) = self.errors.get_mut(t as usize) {
                *error = distance;
            }
        }
        self.states[star.centre as usize].needed = f32::INFINITY;
        for v in &star.rim {
            let state = &mut self.states[*v as usize];
            if state.role != Role::Locked {
                (state.needed, state.is_known) = (0.0, false);
            }
        }
        self.star = star;
    }
}

/// The least short number that is no less.
#[allow(clippy::cast_possible_truncation, reason = "rounded, and then made larger where that was to smaller")]
pub(super) fn at_least(value: f64) -> f32 {
    let short = value as f32;
    if f64::from(short) < value { short.next_up() } else { short }
}

/// The next smaller number that is short.
#[allow(clippy::cast_possible_truncation, reason = "rounded, and then made smaller")]
fn below(value: f64) -> f32 {
    (value as f32).next_down()
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

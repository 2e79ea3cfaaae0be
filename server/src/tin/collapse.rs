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
//! until the limit has grown to what it needs; and what has changed is tried in the next pass, under the next limit. What a
//! vertex strictly within a half needs holds in the diamonds above as well, so it goes along with the half. Of all others
//! it is at least how far their own samples will be, which says no to most before anything else is looked at. The
//! farthest sample of each triangle is known from when it was allowed: nothing is measured twice.
//!
//! On the way to a count the source's own mesh is thinned first: every second vertex, of those with four neighbours, goes
//! where the limit allows, all at once. And there what a vertex needs is not found out anew as often as one goes beside it: it
//! is tried when the limit reaches what it needed at first.
//!
//! No other check of the topology is needed: triangles that turn left around a vertex which sees its whole rim
//! cannot overlap others, and an edge that was there already would have had to cross them.

use super::fan::Fan;
use super::ground::Ground;
use super::mesh::{Mesh, NONE, Star, next, triangle};
use super::metric::{Costs, between, length, turn};
use super::square::{Role, Square};
use super::state::{Around, State, at_least, at_most, below, rounded, shortened, unshortened, vertex};
use super::{Rules, Vertex};
use std::collections::HashMap;

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

/// Where the limit of a count begins: at the least, in quanta, and so high that this many times as many vertices as are to
/// go could, if each were alone. It begins with what is flat, so what a limit allows is taken where it is hardly seen; lower
/// ones take more passes for more triangles.
const LIMIT_LEAST: f64 = 0.5;
const LIMIT_SHARE: f64 = 1.3;

/// How the limit grows: in finer steps there are more passes, and fewer triangles.
const LIMIT_GROWTH: f64 = 1.06;

/// Vertices that are passed over at once.
const SIDE_BY_SIDE: usize = 16;

/// Points of the source's border that an edge of the border stands for.
pub(super) type Passed = HashMap<u32, Vec<[u32; 2]>>;

/// What is known of a mesh before it is simplified.
#[derive(Debug)]
pub(super) struct Before<'a> {
    /// How far samples are from each triangle, in quanta, if that is known.
    pub(super) errors: Vec<f32>,
    /// What each vertex needs at least, [`shortened`]; none if nothing is known.
    pub(super) needs: &'a [u16],
    /// Whether it is the mesh of the source, with nothing gone yet.
    pub(super) is_source: bool,
    /// Which vertices are as they are in the source's mesh; none if nothing is known.
    pub(super) untouched: &'a [bool],
}

/// A mesh being simplified.
#[derive(Debug)]
pub(super) struct Simplifier<'a> {
    pub(super) mesh: Mesh,
    /// By half-edges of the border.
    pub(super) passed: Passed,
    square: Square,
    rules: &'a Rules,
    until: Until<'a>,
    /// Triangles that are few enough, whatever else allows.
    target: usize,
    costs: Costs,
    /// Of each vertex.
    states: Vec<State>,
    /// Of each vertex: it cannot go under any limit below this. Known once it has been tried.
    needed: Vec<f32>,
    /// Vertices that may go in this pass, by rank.
    queue: Vec<u64>,
    /// How far samples are from each triangle, in quanta, if that is known.
    pub(super) errors: Vec<f32>,
    /// As [`Before`] says.
    needs: &'a [u16],
    is_source: bool,
    untouched: &'a [bool],
    /// Whether a vertex beside one that has gone is taken to need what it did before, until it is tried.
    needs_stay: bool,
    /// Of triangles of the star, if its centre goes the way that was looked at last.
    found: Vec<(usize, f32)>,
    star: Star,
    fan: Fan,
    ways: Vec<(f64, usize)>,
}

impl<'a> Simplifier<'a> {
    pub(super) fn new(
        mesh: Mesh,
        passed: Passed,
        before: Before<'a>,
        square: Square,
        rules: &'a Rules,
        until: Until<'a>,
    ) -> Self {
        let costs = Costs::new(&mesh, rules.metric, rules.lambda, rules.scale);
        let states = mesh.points.iter().map(|v| State::new(square.role(*v))).collect();
        let needed = vec![0.0; mesh.points.len()];
        Self {
            mesh,
            passed,
            square,
            rules,
            until,
            target: 0,
            costs,
            states,
            needed,
            queue: Vec::new(),
            errors: before.errors,
            needs: before.needs,
            is_source: before.is_source,
            untouched: before.untouched,
            needs_stay: false,
            found: Vec::new(),
            star: Star::default(),
            fan: Fan::new(square.width()),
            ways: Vec::new(),
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
        self.needs_stay = self.untouched.contains(&true);
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
        vertical = vertical.max(self.share_needs());
        self.thin(vertical);
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

    /// Has every vertex tried, but for what is known before.
    fn look_at_all(&mut self) {
        let known = if matches!(self.until, Until::Triangles(_)) { &[] } else { self.needs };
        for v in 0..index(self.mesh.points.len()) {
            let tried = self.mesh.is_live(v) && self.may_go(v);
            let state = &mut self.states[v as usize];
            let stays = !tried || state.role == Role::Locked;
            let before = known.get(v as usize).filter(|_| state.role == Role::Free);
            state.is_known = false;
            self.needed[v as usize] =
                if stays { f32::INFINITY } else { before.map_or(0.0, |short| unshortened(*short)) };
        }
    }

    /// What a share of the vertices that are to go will need at least: below that hardly anything is worth a pass.
    fn share_needs(&mut self) -> f64 {
        let mut needs = Vec::with_capacity(self.states.len());
        for v in 0..index(self.states.len()) {
            if self.needed[v as usize] == 0.0 {
                let untouched = self.untouched.get(v as usize).is_some_and(|is| *is);
                if untouched && !self.mesh.is_at_border(v) {
                    self.bound_in_lattice(v);
                } else {
                    self.look(v);
                    self.bound();
                }
            }
            needs.extend(Some(self.needed[v as usize]).filter(|needed| *needed < f32::INFINITY));
        }
        // Two triangles vanish with an inner vertex.
        let go = self.mesh.live.saturating_sub(self.target) / 2;
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "some more than there are triangles"
        )]
        let place = ((go as f64 * LIMIT_SHARE) as usize).min(needs.len().saturating_sub(1));
        if needs.is_empty() { 0.0 } else { f64::from(*needs.select_nth_unstable_by(place, f32::total_cmp).1) }
    }

    /// Lets go at once what a limit allows of every second vertex of the source's mesh, those with four neighbours: no two
    /// of them are neighbours, so none changes what another one needs, and nothing but its own sample lies in the two
    /// triangles that one leaves. Each goes the way on which that sample is nearer.
    fn thin(&mut self, limit: f64) {
        let mut ranks = std::mem::take(&mut self.queue);
        ranks.clear();
        for v in 0..index(self.states.len()) {
            let (state, needed) = (&self.states[v as usize], self.needed[v as usize]);
            let at = self.mesh.points[v as usize];
            let is_one = state.role == Role::Free
                && f64::from(needed) <= limit
                && !(at.x + at.y).is_multiple_of(2)
                && self.untouched.get(v as usize).is_some_and(|is| *is)
                && !self.mesh.is_at_border(v);
            if is_one {
                ranks.push(State { key: needed, ..*state }.rank(v));
            }
        }
        let most = self.mesh.live.saturating_sub(self.target) / 2;
        if ranks.len() > most {
            ranks.sort_unstable();
            ranks.truncate(most);
        }
        for v in ranks.iter().map(|rank| vertex(*rank)) {
            self.mesh.look(v, &mut self.star);
            let height = |to: usize| self.mesh.points[self.star.rim()[to] as usize].height;
            let at = self.mesh.points[v as usize].height;
            let bends = [0, 1].map(|to| (height(to) + height(to + 2) - 2 * at).abs());
            let to = usize::from(bends[1] < bends[0]);
            let off = at_least(0.5 * f64::from(bends[to]));
            self.found.clear();
            for i in [to + 1, to + 2] {
                self.found.push((triangle(self.star.spokes()[i % 4]), off));
            }
            self.collapse(to);
        }
        self.queue = ranks;
    }

    /// Looks around a vertex.
    fn look(&mut self, v: u32) {
        self.mesh.look(v, &mut self.star);
        self.fan.look(&self.mesh, &self.star);
    }

    /// Notes what the star's centre needs at least for its own sample, unless it lies at a border.
    fn bound(&mut self) {
        let v = self.star.centre;
        if self.star.border || !self.has_sample(v) {
            return;
        }
        let off = if self.states[v as usize].role == Role::Along {
            let (square, points, rim) = (&self.square, &self.mesh.points, &self.star.rim());
            self.fan.least_off_of(|to| square.is_along(points[rim[to] as usize]))
        } else {
            self.fan.least_off()
        };
        self.needed[v as usize] = below(off).max(0.0);
    }

    /// [`Simplifier::bound`] of a vertex that no border and nothing but what the source's mesh has is around: it ends up halfway between two opposite
    /// neighbours.
    fn bound_in_lattice(&mut self, v: u32) {
        const AXES: [[i32; 2]; 4] = [[1, 0], [0, 1], [1, 1], [-1, 1]];
        let (Until::Error { ground, .. } | Until::Within { ground, .. }) = self.until else { return };
        let (at, along) = (self.mesh.points[v as usize], self.states[v as usize].role == Role::Along);
        // Diagonals meet in every second vertex.
        let axes = if (at.x + at.y).is_multiple_of(2) { &AXES[..] } else { &AXES[..2] };
        let mut least = f64::INFINITY;
        for [x, y] in axes {
            let (here, there) = (
                Vertex { x: at.x.wrapping_add_signed(*x), y: at.y.wrapping_add_signed(*y), height: 0 },
                Vertex { x: at.x.wrapping_add_signed(-*x), y: at.y.wrapping_add_signed(-*y), height: 0 },
            );
            if !along || self.square.is_along(here) {
                let bend = ground.at(here.x, here.y) + ground.at(there.x, there.y) - 2 * at.height;
                least = least.min(0.5 * f64::from(bend.abs()));
            }
        }
        self.needed[v as usize] = below(least).max(0.0);
    }

    /// Whether the vertex has a sample that is to be kept.
    fn has_sample(&self, v: u32) -> bool {
        match self.until {
            Until::Error { ground, .. } | Until::Within { ground, .. } => {
                ground.has(self.mesh.points[v as usize])
            }
            Until::Triangles(_) => false,
        }
    }

    /// What a vertex needs at least as long as nothing changes around it, shortened; 0 if that is not known, or may change
    /// with what the diamond becomes a part of.
    pub(super) fn known(&self) -> Vec<u16> {
        let known = |(v, (state, needed)): (u32, (&State, &f32))| {
            let is_sure = *needed < f32::INFINITY && state.around != Around::Thinned;
            let may = state.role == Role::Free && is_sure;
            if may && !self.mesh.is_at_border(v) { shortened(*needed) } else { 0 }
        };
        (0..).zip(self.states.iter().zip(&self.needed)).map(known).collect()
    }

    /// Which vertices have had nothing gone around them.
    pub(super) fn untouched(&self) -> Vec<bool> {
        self.states.iter().map(|state| state.around == Around::Whole).collect()
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
        let queue = std::mem::take(&mut self.queue);
        let mut is_enough = false;
        for v in queue.iter().map(|rank| vertex(*rank)) {
            is_enough = is_enough || self.is_enough();
            let mut state = self.states[v as usize];
            // Beyond what is enough, and where nothing may be lost, only what is flat goes.
            if !state.is_known && (is_enough || limit <= 0.0) {
                self.look(v);
                state = self.weigh();
            }
            if self.needed[v as usize] == f32::INFINITY || (is_enough && !state.flat) {
                continue;
            }
            self.look(v);
            let needed = self.find_ways(per_metre);
            match self.first_allowed(limit) {
                Ok(to) => self.collapse(to),
                Err(at_least) => {
                    self.needed[v as usize] = below(needed.min(at_least));
                    let state = &mut self.states[v as usize];
                    if state.around == Around::Thinned {
                        state.around = Around::Changed;
                    }
                }
            }
        }
        self.queue = queue;
        self.mesh.live < before
    }

    /// Queues all that a limit may let go.
    fn fill(&mut self, limit: f64) {
        let mut ranks = std::mem::take(&mut self.queue);
        ranks.clear();
        let has_limit = limit > 0.0 && limit < f64::INFINITY;
        // What may not go needs more than any limit.
        let most = at_most(limit).min(f32::MAX);
        for first in (0..self.needed.len()).step_by(SIDE_BY_SIDE) {
            let last = self.needed.len().min(first + SIDE_BY_SIDE);
            // Most need more: so many at once are seen to.
            if self.needed[first..last].iter().fold(true, |all, needed| all & (*needed > most)) {
                continue;
            }
            for v in index(first)..index(last) {
                if self.needed[v as usize] > most {
                    continue;
                }
                let mut state = self.states[v as usize];
                if !state.is_known {
                    self.look(v);
                    if self.needed[v as usize] == 0.0 && has_limit {
                        self.bound();
                        if self.needed[v as usize] > most {
                            continue;
                        }
                    }
                    state = self.weigh();
                }
                if self.needed[v as usize] < f32::INFINITY {
                    ranks.push(state.rank(v));
                }
            }
        }
        ranks.sort_unstable();
        self.queue = ranks;
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
    fn weigh(&mut self) -> State {
        let (key, flat) = self.costs.importance(&self.mesh, &self.star, &mut self.fan);
        let state = &mut self.states[self.star.centre as usize];
        let key = rounded(key.max(0.0));
        // Where nothing may be lost, and something would be, there is no need to try.
        let stays = !flat && matches!(self.until, Until::Error { vertical: 0.0, .. });
        if stays {
            self.needed[self.star.centre as usize] = f32::INFINITY;
        }
        *state = State { key, flat, is_known: true, ..*state };
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
            if star.spokes().len() == 1 && mesh.twin(next(star.spokes()[0])) == NONE {
                return f64::INFINITY;
            }
            let ends = [star.rim()[0], star.rim()[star.rim().len() - 1]];
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
        self.fan.measure();
        // Opposite ways out of four leave the same two triangles.
        let is_twice = star.rim().len() == 4 && !star.border && !along;
        let within = if along { None } else { self.fan.within(at_most(limit).min(f32::MAX)) };
        if let Some((mut ways, least)) = within {
            needed = least;
            if is_twice {
                ways &= 0b11;
            }
            while ways != 0 {
                self.ways.push((0.0, ways.trailing_zeros() as usize));
                ways &= ways - 1;
            }
        }
        let rest = if within.is_some() { 0 } else { star.rim().len() };
        for to in 0..if is_twice { rest.min(2) } else { rest } {
            let is_end = to == 0 || to + 1 == star.rim().len();
            if star.border && !is_end {
                continue;
            }
            if along && !self.is_along(star.rim()[to]) {
                continue;
            }
            let matters = |off| off <= limit || off < needed;
            let Some(off) = self.fan.off(to, matters) else { continue };
            if off > limit {
                needed = needed.min(off);
            } else {
                self.ways.push((0.0, to));
            }
        }
        // What a way costs matters beside others alone.
        if self.ways.len() > 1 {
            self.fan.prepare(&self.rules.scale);
            for (cost, to) in &mut self.ways {
                *cost = self.costs.cost(mesh, star, &self.fan, *to);
            }
            self.ways.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        }
        needed
    }

    /// Whether a vertex beside one on the hypotenuse lies on it, too.
    fn is_along(&self, v: u32) -> bool {
        self.square.is_along(self.mesh.points[v as usize])
    }

    /// How far samples will be from the triangles if the star's centre goes that way, in quanta; or, where that is more
    /// than is allowed, something between the two. Notes what it finds.
    fn needs(&mut self, to: usize) -> f64 {
        self.found.clear();
        let Until::Error { ground, vertical, .. } = &self.until else { return 0.0 };
        let star = &self.star;
        let u = star.rim()[to];
        let point = |v: u32| self.mesh.points[v as usize];
        let mut most = 0.0f64;
        // All but those two that the way is a side of.
        let (count, last) = (star.spokes().len(), star.rim().len() - 1);
        let (first, rest) = if star.border { (usize::from(to == 0), count - 1) } else { (to + 1, count - 2) };
        // Those far from the way, where most samples are, come first.
        for i in (first + rest / 2..first + rest).chain(first..first + rest / 2) {
            let i = if i > last { i - last - 1 } else { i };
            let [p, q] = star.edge(i);
            let distance = ground.distance_within([point(u), point(p), point(q)], *vertical);
            most = most.max(distance);
            if most > *vertical {
                break;
            }
            self.found.push((triangle(star.spokes()[i]), at_least(distance)));
        }
        most
    }

    /// How far the border would be from the source's if the star's centre left it, in metres.
    fn border_distance(&self) -> f64 {
        let star = &self.star;
        let point = |v: u32| self.mesh.points[v as usize];
        let ends = [point(star.rim()[star.rim().len() - 1]), point(star.rim()[0])];
        let halves = star.incoming().into_iter().chain([star.spokes()[0]]);
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
                (point(star.centre), point(star.rim()[0]), point(star.rim()[star.rim().len() - 1]));
            if let Some(before) = star.incoming().and_then(|h| self.passed.remove(&h)) {
                passed = before;
            }
            // What lies on a straight border is as near to any other as the ends are.
            if turn(into, centre, out) != 0 {
                passed.push([centre.x, centre.y]);
            }
            passed.extend(self.passed.remove(&star.spokes()[0]).unwrap_or_default());
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
        self.costs.follow(&star, to);
        for (t, distance) in self.found.drain(..) {
            if let Some(error) = self.errors.get_mut(t) {
                *error = distance;
            }
        }
        self.needed[star.centre as usize] = f32::INFINITY;
        for v in star.rim() {
            let state = &mut self.states[*v as usize];
            let stays = self.needs_stay && state.around != Around::Changed;
            state.around = if stays { Around::Thinned } else { Around::Changed };
            if state.role != Role::Locked {
                state.is_known = false;
                if !stays {
                    self.needed[*v as usize] = 0.0;
                }
            }
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

fn index(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(NONE)
}

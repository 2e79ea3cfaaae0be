//! The walk over a mesh that sender and receiver take in step: a front that grows, gate by gate.
//!
//! A *gate* is a directed edge whose right side is done and whose left side is not. Gates are linked to
//! *loops*, the borders of what is done, and taken in the order in which they arose:
//!
//! ```text
//!        v             Either nothing lies beyond the gate from a to b (a border), or a triangle whose third
//!      ↗   ↘           vertex v is new, or ends the gate before (left), or the gate behind (right), or is
//!    /       \         somewhere else on a front (other). The gates from a to v and from v to b take the
//!   a ------> b        gate's place in the loop.
//! ```
//!
//! One walk serves both ends, so they cannot disagree about contexts, order or predictions. What is known
//! already costs nothing: beyond the border of the diamond's square lies nothing, a triangle stays within
//! the child triangle of its gate, and corners around a vertex do not overlap. After Gumhold and Strasser,
//! *Real time compression of triangle mesh connectivity* (1998), whose cut-border machine this is, and Lee,
//! Alliez and Desbrun, *Angle-Analyzer* (2002): a gate's angles tell much of what comes.

#![allow(
    clippy::cast_possible_truncation,
    reason = "what lies in a diamond's square has coordinates of 25 bits, heights have 26, and a child triangle 2"
)]

use super::numbers::Scale;
use super::place::{
    Point, Square, Within, cross, difference, dot, expected_height, expected_places, inside, is_left_inside,
    is_right_inside,
};
use super::{TRIANGLES_MAX, VERTICES_MAX};
use crate::HEIGHT_MAX;
use crate::rans::Context;

pub(super) const NONE: u32 = u32::MAX;

/// How many vertices ahead and behind are looked at for one that is neither left nor right.
const REACH: i64 = 31;

/// Classes of the angle at a vertex that a gate might be joined with; 0: it cannot be.
const ANGLES: usize = 6;

/// Octaves of a gate's length.
const LENGTHS: usize = 25;

/// The two ends of the wire.
pub(super) trait Wire {
    /// A number: a sender's goes out and comes back.
    fn number(&mut self, scale: &mut Scale, number: i64) -> Result<i64, Fault>;
    /// Likewise some bits as they are.
    fn plain(&mut self, value: u32, bits: u32) -> u32;
}

/// The two ends of the walk.
pub(super) trait Pass: Wire {
    /// A bit under a context: a sender's goes out and comes back.
    fn bit(&mut self, context: &mut Context, bit: bool) -> bool;
    /// A sender's next triangle that the walk cannot reach.
    fn seed(&mut self) -> Option<Seed>;
    /// What a sender's mesh has beyond a gate, by the gate's mark.
    fn beyond(&mut self, mark: u32) -> Beyond;
    /// The marks of the gates from `a` to `v` and from `v` to `b`, beyond the triangle of the gate with this mark.
    fn marks(&self, mark: u32) -> [u32; 2];
}

/// A part of a mesh begins with the edge between two vertices.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Seed {
    pub(super) points: [Point; 2],
    /// The mark of the gate between them, and that of the same edge seen from the other side.
    pub(super) marks: [u32; 2],
}

/// Beyond a gate, as a sender knows it. A receiver's is [`Beyond::Nothing`], and means nothing.
#[derive(Debug, Clone, Copy)]
pub(super) enum Beyond {
    Nothing,
    New(Point),
    Known(u32),
}

/// Why a walk ends early.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fault {
    /// Symbols that no encoder writes.
    Symbols,
    /// A vertex or triangle out of its place.
    Place,
    /// More than a patch may have.
    Size,
}

/// What of a gate is left to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Open,
    /// Nothing lies beyond.
    Border,
    /// There is a triangle on each side.
    Done,
}

#[derive(Debug, Clone, Copy)]
struct Gate {
    /// Where it starts.
    origin: u32,
    /// Where it ends, and the next one starts: at hand, so that nobody need wait for that one.
    target: u32,
    prev: u32,
    next: u32,
    /// The third vertex of the triangle on its right.
    behind: u32,
    /// A sender's name for it.
    mark: u32,
    state: State,
}

/// A vertex with what is known of its place.
#[derive(Debug, Clone, Copy)]
struct Placed {
    point: Point,
    within: Within,
}

/// An open gate with the front around it.
#[derive(Debug, Clone, Copy)]
struct Here {
    at: usize,
    gate: Gate,
    prev: Gate,
    next: Gate,
    /// Where the gate starts and ends.
    a: Placed,
    b: Placed,
    /// Where the gate before it starts, and the one behind it ends.
    before: Placed,
    after: Placed,
    /// Twice the areas of the gate's triangles with these two.
    areas: [i64; 2],
}

impl Here {
    /// Whether the corner at the gate's start leaves room for an edge to `v`, which lies to the left of the gate.
    #[inline(always)]
    fn start_has_room(&self, v: Point) -> bool {
        (self.areas[0] <= 0) | (cross(self.a.point, v, self.before.point) > 0)
    }

    /// Whether the corner at the gate's end does.
    #[inline(always)]
    fn end_has_room(&self, v: Point) -> bool {
        (self.areas[1] <= 0) | (cross(self.b.point, self.after.point, v) > 0)
    }
}

/// All that is learnt on the way.
struct Contexts {
    more: Context,
    border: [Context; 4],
    new: [[Context; ANGLES]; ANGLES],
    left: [[Context; ANGLES]; ANGLES],
    right: [Context; ANGLES],
    other: Scale,
    seeds: [Scale; 2],
    places: [[Scale; 2]; LENGTHS],
    heights: [Scale; LENGTHS],
    /// How far off new vertices have been of late, by each of the two rules.
    misses: [i64; 2],
}

impl Contexts {
    fn new(half: i64) -> Self {
        let length = |octave: usize| u32::try_from(1u64 << octave).unwrap_or(u32::MAX);
        Self {
            more: Context::default(),
            border: [Context::default(); 4],
            new: [[Context::default(); ANGLES]; ANGLES],
            left: [[Context::default(); ANGLES]; ANGLES],
            right: [Context::default(); ANGLES],
            other: Scale::expecting(2),
            seeds: [Scale::expecting(u32::try_from(half).unwrap_or(u32::MAX) / 2), Scale::expecting(64)],
            places: std::array::from_fn(|octave| [Scale::expecting(length(octave) / 2); 2]),
            heights: std::array::from_fn(|octave| Scale::expecting(4 + length(octave / 2))),
            misses: [0; 2],
        }
    }
}

/// The walk's state; and, in the end, the mesh.
pub(super) struct Walk {
    square: Square,
    /// Whether some border is not the square's.
    holes: bool,
    places: Vec<Placed>,
    gates: Vec<Gate>,
    /// The triangles of each child triangle, and how many there are in all.
    triangles: [Vec<[u32; 3]>; 4],
    count: usize,
    /// The lowest child triangle of the part of the mesh that is under way.
    lowest: u8,
    /// Inner borders found.
    borders: usize,
    contexts: Contexts,
}

impl Walk {
    /// A walk that is expected to find about so many triangles.
    pub(super) fn new(square: Square, holes: bool, expected: usize) -> Self {
        let expected = expected.min(TRIANGLES_MAX);
        Self {
            holes,
            places: Vec::with_capacity(expected * 5 / 8),
            gates: Vec::with_capacity(expected * 7 / 4),
            triangles: [(); 4].map(|()| Vec::with_capacity(expected / 4)),
            count: 0,
            lowest: u8::MAX,
            borders: 0,
            contexts: Contexts::new(square.half()),
            square,
        }
    }

    /// The vertices, in the order in which they were met.
    pub(super) fn points(&self) -> impl ExactSizeIterator<Item = Point> + '_ {
        self.places.iter().map(|placed| placed.point)
    }

    /// The triangles of each child triangle, in the order in which they were met.
    pub(super) fn triangles(&self) -> &[Vec<[u32; 3]>; 4] {
        &self.triangles
    }

    /// Walks over a whole mesh.
    pub(super) fn run(&mut self, pass: &mut impl Pass) -> Result<(), Fault> {
        let (mut at, mut least) = (0, 0);
        loop {
            let seed = pass.seed();
            if !pass.bit(&mut self.contexts.more, seed.is_some()) {
                break;
            }
            self.lowest = u8::MAX;
            self.begin(pass, seed.unwrap_or_default())?;
            let first = self.lowest;
            while at < self.gates.len() {
                if self.gates[at].state == State::Open {
                    self.step(pass, at)?;
                }
                at += 1;
            }
            // Each part of the mesh begins in its lowest child triangle, and parts come in that order.
            if first < least || self.lowest < first {
                return Err(Fault::Symbols);
            }
            least = first;
        }
        if self.holes == (self.borders > 0) && self.fans_are_whole() { Ok(()) } else { Err(Fault::Symbols) }
    }

    /// Whether the triangles at each vertex hang together.
    fn fans_are_whole(&self) -> bool {
        let mut seen = vec![false; self.places.len()];
        let mut borders = self.gates.iter().filter(|gate| gate.state == State::Border);
        borders.all(|gate| !std::mem::replace(&mut seen[gate.origin as usize], true))
    }

    /// The first triangle of a part of the mesh.
    fn begin(&mut self, pass: &mut impl Pass, seed: Seed) -> Result<(), Fault> {
        let last = self.places.last().map_or(0, |placed| placed.point.height);
        let mut near = [0, 0, i64::from(last)];
        let first = self.places.len();
        for point in seed.points {
            let [across, up] = &mut self.contexts.seeds;
            let wanted = [point.x, point.y, point.height].map(i64::from);
            let x = near[0] + pass.number(across, wanted[0] - near[0])?;
            let y = near[1] + pass.number(across, wanted[1] - near[1])?;
            let height = near[2] + pass.number(up, wanted[2] - near[2])?;
            self.place(x, y, height)?;
            near = [x, y, height];
        }
        if difference(self.places[first].point, self.places[first + 1].point) == [0, 0] {
            return Err(Fault::Place);
        }
        // Two gates, one on each side of the edge. The first has a triangle for sure.
        let gate = index(self.gates.len());
        let outer = self.places[first].within.outer & self.places[first + 1].within.outer;
        let ends = [index(first), index(first + 1)];
        self.push(ends, outer, [gate + 1; 2], NONE, seed.marks[0]);
        self.push([ends[1], ends[0]], outer, [gate; 2], index(first + 2), seed.marks[1]);
        let beyond = pass.beyond(seed.marks[0]);
        self.grow(pass, &self.here(gate as usize), beyond)
    }

    /// Takes a vertex in.
    #[inline(always)]
    fn place(&mut self, x: i64, y: i64, height: i64) -> Result<Placed, Fault> {
        let within = self.square.within(x, y);
        if within.children == 0 || height.abs() > 2 * i64::from(HEIGHT_MAX) {
            return Err(Fault::Place);
        }
        if self.places.len() >= VERTICES_MAX {
            return Err(Fault::Size);
        }
        // Within the square, so of 25 bits.
        let [x, y, height] = [x, y, height].map(|w| w as i32);
        let placed = Placed { point: Point { x, y, height }, within };
        self.places.push(placed);
        Ok(placed)
    }

    /// A new gate from one vertex to another, between two gates; with the lines of the square's border on which both of
    /// its ends lie.
    #[inline(always)]
    fn push(
        &mut self,
        [origin, target]: [u32; 2],
        outer: u8,
        [prev, next]: [u32; 2],
        behind: u32,
        mark: u32,
    ) -> u32 {
        let state = if outer == 0 { State::Open } else { State::Border };
        let number = index(self.gates.len());
        self.gates.push(Gate { origin, target, prev, next, behind, mark, state });
        number
    }

    /// The new sides of a gate's triangle: a gate to its apex, and one from there; given the apex, the gate that follows the
    /// first of them, the one before the second, and the lines of the square's border on which the apex lies.
    #[inline(always)]
    fn sides(&mut self, here: &Here, [v, after, before]: [u32; 3], outer: u8, marks: [u32; 2]) -> [u32; 2] {
        let state = |end: &Placed| if end.within.outer & outer == 0 { State::Open } else { State::Border };
        let Gate { origin: a, target: b, prev, next, .. } = here.gate;
        let [to, from] = [0, 1].map(|i| index(self.gates.len()) + i);
        let [mark, last] = marks;
        self.gates.extend_from_slice(&[
            Gate { origin: a, target: v, prev, next: after, behind: b, mark, state: state(&here.a) },
            Gate { origin: v, target: b, prev: before, next, behind: a, mark: last, state: state(&here.b) },
        ]);
        self.gates[prev as usize].next = to;
        self.gates[next as usize].prev = from;
        [to, from]
    }

    fn point(&self, vertex: u32) -> Point {
        self.places[vertex as usize].point
    }

    #[inline(always)]
    fn gate(&self, gate: u32) -> Gate {
        self.gates[gate as usize]
    }

    #[inline(always)]
    fn here(&self, at: usize) -> Here {
        let gate = self.gates[at];
        let (prev, next) = (self.gate(gate.prev), self.gate(gate.next));
        let [a, b, before, after] =
            [gate.origin, gate.target, prev.origin, next.target].map(|vertex| self.places[vertex as usize]);
        let areas = [before, after].map(|v| cross(a.point, b.point, v.point));
        Here { at, gate, prev, next, a, b, before, after, areas }
    }

    /// Settles what lies beyond a gate.
    #[inline(always)]
    fn step(&mut self, pass: &mut impl Pass, at: usize) -> Result<(), Fault> {
        let here = self.here(at);
        let Here { gate, prev, next, .. } = here;
        let beyond = pass.beyond(gate.mark);
        let alone = prev.prev == gate.next;
        let (before, behind) = (prev.state == State::Open, next.state == State::Open);
        let left = angle(&here, &here.before, here.areas[0], before & (!alone | behind));
        let right = angle(&here, &here.after, here.areas[1], behind & !alone);
        if self.holes {
            let context =
                usize::from(prev.state == State::Border) * 2 + usize::from(next.state == State::Border);
            if pass.bit(&mut self.contexts.border[context], matches!(beyond, Beyond::Nothing)) {
                self.gates[at].state = State::Border;
                self.borders += 1;
                return Ok(());
            }
        }
        if pass.bit(&mut self.contexts.new[left][right], matches!(beyond, Beyond::New(_))) {
            return self.grow(pass, &here, beyond);
        }
        let known = if let Beyond::Known(vertex) = beyond { vertex } else { NONE };
        if left > 0 && pass.bit(&mut self.contexts.left[left][right], known == prev.origin) {
            return self.join_left(pass, &here);
        }
        if right > 0 && pass.bit(&mut self.contexts.right[right], known == next.target) {
            return self.join_right(pass, &here);
        }
        self.join_other(pass, at, known)
    }

    /// The gate's triangle, if it can be one.
    #[inline(always)]
    fn triangle(&mut self, here: &Here, v: u32, apex: &Placed) -> Result<(), Fault> {
        let within = here.a.within.children & here.b.within.children & apex.within.children;
        if within == 0 || cross(here.a.point, here.b.point, apex.point) <= 0 {
            return Err(Fault::Place);
        }
        if self.count >= TRIANGLES_MAX {
            return Err(Fault::Size);
        }
        // Closed child triangles share lines only, so there is one bit.
        let child = within.trailing_zeros() as u8;
        self.triangles[usize::from(child % 4)].push([here.gate.origin, here.gate.target, v]);
        self.count += 1;
        self.lowest = self.lowest.min(child);
        self.gates[here.at].state = State::Done;
        Ok(())
    }

    /// A triangle with a new vertex.
    #[inline(always)]
    fn grow(&mut self, pass: &mut impl Pass, here: &Here, beyond: Beyond) -> Result<(), Fault> {
        let (a, b) = (here.a.point, here.b.point);
        let wanted = if let Beyond::New(point) = beyond { point } else { Point::default() };
        let behind = (here.gate.behind != NONE).then(|| self.point(here.gate.behind));
        let length = b.x.abs_diff(a.x).max(b.y.abs_diff(a.y)).max(1).ilog2() as usize;
        let length = length.min(LENGTHS - 1);
        let rules = expected_places(a, b, behind);
        let is_second = self.contexts.misses[1] < self.contexts.misses[0];
        let [x, y] = [0, 1].map(|i| if is_second { rules[1][i] } else { rules[0][i] });
        let [along_x, along_y] = &mut self.contexts.places[length];
        let x = x + pass.number(along_x, i64::from(wanted.x) - x)?;
        let y = y + pass.number(along_y, i64::from(wanted.y) - y)?;
        for (misses, rule) in self.contexts.misses.iter_mut().zip(rules) {
            // Numbers are below 2^30, so the means are below 2^36.
            *misses += (x - rule[0]).abs() + (y - rule[1]).abs() - (*misses >> 5);
        }
        let height = expected_height(a, b, behind, x, y);
        let height =
            height + pass.number(&mut self.contexts.heights[length], i64::from(wanted.height) - height)?;
        let placed = self.place(x, y, height)?;
        if !here.start_has_room(placed.point) || !here.end_has_room(placed.point) {
            return Err(Fault::Place);
        }
        let v = index(self.places.len() - 1);
        self.triangle(here, v, &placed)?;
        let to = index(self.gates.len());
        self.sides(here, [v, to + 1, to], placed.within.outer, pass.marks(here.gate.mark));
        Ok(())
    }

    /// A triangle with the start of the gate before.
    #[inline(always)]
    fn join_left(&mut self, pass: &impl Pass, here: &Here) -> Result<(), Fault> {
        let Here { gate, prev, before: apex, .. } = *here;
        let (v, closes) = (prev.origin, prev.prev == gate.next);
        if !closes {
            let before = self.point(self.gate(prev.prev).origin);
            let room = is_left_inside(apex.point, here.a.point, before, here.b.point);
            if !room || !here.end_has_room(apex.point) {
                return Err(Fault::Place);
            }
        }
        self.triangle(here, v, &apex)?;
        self.gates[gate.prev as usize].state = State::Done;
        if closes {
            self.gates[gate.next as usize].state = State::Done;
            return Ok(());
        }
        let outer = apex.within.outer & here.b.within.outer;
        let links = [prev.prev, gate.next];
        let from = self.push([v, gate.target], outer, links, gate.origin, pass.marks(gate.mark)[1]);
        self.gates[prev.prev as usize].next = from;
        self.gates[gate.next as usize].prev = from;
        Ok(())
    }

    /// A triangle with the end of the gate behind.
    #[inline(always)]
    fn join_right(&mut self, pass: &impl Pass, here: &Here) -> Result<(), Fault> {
        let Here { gate, next, after: apex, .. } = *here;
        let v = next.target;
        let after = self.point(self.gate(next.next).target);
        let room = is_right_inside(apex.point, after, here.b.point, here.a.point);
        if !room || !here.start_has_room(apex.point) {
            return Err(Fault::Place);
        }
        self.triangle(here, v, &apex)?;
        self.gates[gate.next as usize].state = State::Done;
        let outer = here.a.within.outer & apex.within.outer;
        let links = [gate.prev, next.next];
        let to = self.push([gate.origin, v], outer, links, gate.target, pass.marks(gate.mark)[0]);
        self.gates[gate.prev as usize].next = to;
        self.gates[next.next as usize].prev = to;
        Ok(())
    }

    /// Whether a triangle's corner fits in at the start of the gate `out`.
    fn fits(&self, here: &Here, out: u32) -> bool {
        let gate = self.gate(out);
        let [v, before, after] =
            [gate.origin, self.gate(gate.prev).origin, gate.target].map(|vertex| self.point(vertex));
        gate.state != State::Done
            && inside(v, after, before, here.a.point)
            && inside(v, after, before, here.b.point)
    }

    /// The first place along the loop for which `is` holds: so many steps ahead, or behind if negative.
    fn look_around(&self, here: &Here, mut is: impl FnMut(i64, u32) -> bool) -> Option<(i64, u32)> {
        let (mut ahead, mut behind) = (here.next.next, here.gate.prev);
        for steps in 1..=REACH {
            if ahead == behind {
                return None;
            }
            ahead = self.gate(ahead).next;
            if ahead == behind {
                return None;
            }
            if is(steps, ahead) {
                return Some((steps, ahead));
            }
            behind = self.gate(behind).prev;
            if ahead == behind {
                return None;
            }
            if is(-steps, behind) {
                return Some((-steps, behind));
            }
        }
        None
    }

    /// A triangle with another vertex of a front.
    #[cold]
    #[inline(never)]
    fn join_other(&mut self, pass: &mut impl Pass, at: usize, known: u32) -> Result<(), Fault> {
        let here = &self.here(at);
        let is_known = |walk: &Self, out: u32| walk.gate(out).origin == known && walk.fits(here, out);
        let found = self.look_around(here, |_, out| is_known(self, out));
        let steps = pass.number(&mut self.contexts.other, found.map_or(0, |(steps, _)| steps))?;
        let out = if steps == 0 {
            let far = if known == NONE {
                None
            } else {
                (0..index(self.gates.len())).find(|out| is_known(self, *out))
            };
            let far = far.unwrap_or(0);
            // Each triangle makes two gates at most, each part of the mesh two more.
            let out = pass.plain(far & 0xffff, 16) | pass.plain(far >> 16, 4) << 16;
            if out as usize >= self.gates.len() || self.look_around(here, |_, near| near == out).is_some() {
                return Err(Fault::Symbols);
            }
            out
        } else {
            self.look_around(here, |now, _| now == steps).ok_or(Fault::Symbols)?.1
        };
        let Gate { origin: v, prev: incoming, .. } = self.gate(out);
        let apex = self.places[v as usize];
        let room = here.start_has_room(apex.point) && here.end_has_room(apex.point);
        if !room || !self.fits(here, out) {
            return Err(Fault::Place);
        }
        self.triangle(here, v, &apex)?;
        let [to, from] = self.sides(here, [v, out, incoming], apex.within.outer, pass.marks(here.gate.mark));
        self.gates[out as usize].prev = to;
        self.gates[incoming as usize].next = from;
        Ok(())
    }
}

/// The class of the angle at `v` of a gate's triangle, 0 if there can be none, or none is wanted; `sine` is twice its area.
#[inline(always)]
fn angle(here: &Here, v: &Placed, sine: i64, wanted: bool) -> usize {
    let cosine = dot(v.point, here.a.point, here.b.point);
    let within = here.a.within.children & here.b.within.children & v.within.children;
    // 45 degrees, some 63, 90, 135. Without branches, as above.
    let class = 1
        + usize::from(cosine <= sine)
        + usize::from(2 * cosine <= sine)
        + usize::from(cosine <= 0)
        + usize::from(cosine <= -sine);
    class * usize::from((sine > 0) & (within != 0) & wanted)
}

pub(super) fn index(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(NONE)
}

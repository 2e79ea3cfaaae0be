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

use super::numbers::Scale;
use super::{TRIANGLES_MAX, VERTICES_MAX};
use crate::HEIGHT_MAX;
use crate::bintree::Forest;
use crate::diamond::Diamond;
use crate::rans::Context;

pub(super) const NONE: u32 = u32::MAX;

/// How many vertices ahead and behind are looked at for one that is neither left nor right.
const REACH: i64 = 31;

/// Classes of the angle at a vertex that a gate might be joined with; 0: it cannot be.
const ANGLES: usize = 6;

/// Octaves of a gate's length.
const LENGTHS: usize = 25;

/// The two ends of the wire.
pub(super) trait Pass {
    /// A bit under a context: a sender's goes out and comes back.
    fn bit(&mut self, context: &mut Context, bit: bool) -> bool;
    /// Likewise a number.
    fn number(&mut self, scale: &mut Scale, number: i64) -> Result<i64, Fault>;
    /// Likewise some bits as they are.
    fn plain(&mut self, value: u32, bits: u32) -> u32;
    /// A sender's next triangle that the walk cannot reach, as its first two vertices.
    fn seed(&mut self) -> Option<[Point; 2]>;
    /// What a sender's mesh has beyond the gate from `a` to `b`.
    fn beyond(&mut self, a: u32, b: u32) -> Beyond;
}

/// Beyond a gate, as a sender knows it. A receiver's is [`Beyond::Nothing`], and means nothing.
#[derive(Debug, Clone, Copy)]
pub(super) enum Beyond {
    Nothing,
    New(Point),
    Known(u32),
}

/// A vertex: in units of the payload, x and y from the diamond's centre.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Point {
    pub(super) x: i64,
    pub(super) y: i64,
    pub(super) height: i64,
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

/// The diamond's square, in units of the payload from its centre.
#[derive(Debug, Clone, Copy)]
pub(super) struct Square {
    /// Directions of the local grid's axes.
    u: [i64; 2],
    v: [i64; 2],
    /// The largest coordinate along them.
    half: i64,
    upper: bool,
}

/// In which child triangles a point lies, as bits; then on which straight lines of the square's outer border.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Within {
    pub(super) children: u8,
    pub(super) outer: u8,
}

impl Square {
    /// In lattice units shifted down by `shift`.
    pub(super) fn new(forest: &Forest, d: Diamond, shift: u32) -> Self {
        let local = forest.local(d);
        let half = 1i64 << (forest.root_log2() - 1 - d.level() / 2);
        Self {
            u: local.u.map(i64::signum),
            v: local.v.map(i64::signum),
            half: half >> shift,
            upper: local.upper,
        }
    }

    /// Whether units are so large that nothing is left of it.
    pub(super) fn is_empty(&self) -> bool {
        self.half == 0
    }

    /// Where a point lies; no bits of children if it is outside.
    #[inline]
    pub(super) fn within(&self, x: i64, y: i64) -> Within {
        let p = x * self.u[0] + y * self.u[1];
        let q = x * self.v[0] + y * self.v[1];
        let h = self.half;
        if p.abs() > h || q.abs() > h || (!self.upper && q > p) {
            return Within::default();
        }
        let bits = |flags: [bool; 5]| flags.iter().rev().fold(0u8, |bits, flag| bits << 1 | u8::from(*flag));
        let children = bits([-q >= p.abs(), p >= q.abs(), q >= p.abs(), -p >= q.abs(), false]);
        let outer = bits([q == -h, p == h, q == h, p == -h, !self.upper && p == q]);
        Within { children: if self.upper { children } else { children & 0b0011 }, outer }
    }
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
    /// Where it starts; it ends where the next one starts.
    origin: u32,
    prev: u32,
    next: u32,
    /// The third vertex of the triangle on its right.
    behind: u32,
    state: State,
}

/// A vertex with what is known of its place.
#[derive(Debug, Clone, Copy)]
struct Placed {
    point: Point,
    within: Within,
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
    triangles: Vec<[u32; 3]>,
    /// The child triangle of each triangle.
    children: Vec<u8>,
    /// Inner borders found.
    borders: usize,
    contexts: Contexts,
}

fn cross(a: Point, b: Point, c: Point) -> i64 {
    (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x)
}

fn dot(a: Point, b: Point, c: Point) -> i64 {
    (b.x - a.x) * (c.x - a.x) + (b.y - a.y) * (c.y - a.y)
}

/// Whether the direction from `at` to `to` lies strictly inside the turn left from that to `from` to that to `until`:
/// a full turn where these two are the same.
fn inside(at: Point, from: Point, until: Point, to: Point) -> bool {
    let turn = cross(at, from, until);
    let (after, before) = (cross(at, from, to), cross(at, to, until));
    if turn > 0 {
        after > 0 && before > 0
    } else if turn < 0 || dot(at, from, until) < 0 {
        after > 0 || before > 0
    } else {
        after != 0 || dot(at, from, to) < 0
    }
}

impl Walk {
    pub(super) fn new(square: Square, holes: bool) -> Self {
        Self {
            holes,
            places: Vec::new(),
            gates: Vec::new(),
            triangles: Vec::new(),
            children: Vec::new(),
            borders: 0,
            contexts: Contexts::new(square.half),
            square,
        }
    }

    /// The vertices, in the order in which they were met.
    pub(super) fn points(&self) -> impl ExactSizeIterator<Item = Point> + '_ {
        self.places.iter().map(|placed| placed.point)
    }

    /// The triangles, in the order in which they were met, with the child triangle of each.
    pub(super) fn triangles(&self) -> impl ExactSizeIterator<Item = ([u32; 3], u8)> + '_ {
        self.triangles.iter().copied().zip(self.children.iter().copied())
    }

    /// Walks over a whole mesh.
    pub(super) fn run(&mut self, pass: &mut impl Pass) -> Result<(), Fault> {
        let (mut at, mut least) = (0, 0);
        loop {
            let seed = pass.seed();
            let mut more = self.contexts.more;
            let goes_on = pass.bit(&mut more, seed.is_some());
            self.contexts.more = more;
            if !goes_on {
                break;
            }
            let first = self.triangles.len();
            self.begin(pass, seed.unwrap_or_default())?;
            while at < self.gates.len() {
                if self.gates[at].state == State::Open {
                    self.step(pass, at)?;
                }
                at += 1;
            }
            // Each part of the mesh begins in its lowest child triangle, and parts come in that order.
            let (seed, rest) = self.children[first..].split_first().ok_or(Fault::Symbols)?;
            if *seed < least || rest.iter().any(|child| child < seed) {
                return Err(Fault::Symbols);
            }
            least = *seed;
        }
        if self.holes == (self.borders > 0) && self.fans_are_whole() { Ok(()) } else { Err(Fault::Symbols) }
    }

    /// Whether the triangles at each vertex hang together.
    fn fans_are_whole(&self) -> bool {
        let mut seen = vec![false; self.places.len()];
        let mut borders = self.gates.iter().filter(|gate| gate.state == State::Border);
        borders.all(|gate| !std::mem::replace(&mut seen[gate.origin as usize], true))
    }

    /// The first two vertices of a part of the mesh, and the two sides of the edge between them.
    fn begin(&mut self, pass: &mut impl Pass, seed: [Point; 2]) -> Result<(), Fault> {
        let last = self.places.last().map_or(Point::default(), |placed| placed.point);
        let mut near = Point { x: 0, y: 0, height: last.height };
        let first = self.places.len();
        for point in seed {
            let [mut across, mut up] = self.contexts.seeds;
            let read = Point {
                x: near.x + pass.number(&mut across, point.x - near.x)?,
                y: near.y + pass.number(&mut across, point.y - near.y)?,
                height: near.height + pass.number(&mut up, point.height - near.height)?,
            };
            self.contexts.seeds = [across, up];
            self.place(read)?;
            near = read;
        }
        let (a, b) = (self.places[first], self.places[first + 1]);
        if (a.point.x, a.point.y) == (b.point.x, b.point.y) {
            return Err(Fault::Place);
        }
        let [a, b] = [index(first), index(first + 1)];
        let gate = index(self.gates.len());
        self.push(a, b, gate + 1, gate + 1, NONE);
        self.push(b, a, gate, gate, NONE);
        // Its triangle is there, whatever the sides of the square say.
        if self.gates[gate as usize].state == State::Border {
            return Err(Fault::Place);
        }
        Ok(())
    }

    /// Takes a vertex in.
    fn place(&mut self, point: Point) -> Result<u32, Fault> {
        let within = self.square.within(point.x, point.y);
        if within.children == 0 || point.height.abs() > 2 * i64::from(HEIGHT_MAX) {
            return Err(Fault::Place);
        }
        if self.places.len() >= VERTICES_MAX {
            return Err(Fault::Size);
        }
        self.places.push(Placed { point, within });
        Ok(index(self.places.len() - 1))
    }

    /// A new gate from `origin` to `end`.
    fn push(&mut self, origin: u32, end: u32, prev: u32, next: u32, behind: u32) -> u32 {
        let outer = self.places[origin as usize].within.outer & self.places[end as usize].within.outer;
        // A part's first edge may run along the border, with its triangle on the inner side.
        let state = if outer != 0 && (behind != NONE || self.looks_out(origin, end)) {
            State::Border
        } else {
            State::Open
        };
        let number = index(self.gates.len());
        self.gates.push(Gate { origin, prev, next, behind, state });
        number
    }

    /// Whether the left side of an edge along the square's border lies outside.
    fn looks_out(&self, origin: u32, end: u32) -> bool {
        let (a, b) = (self.point(origin), self.point(end));
        // Somewhere inside of a convex square: the middle of the lower triangle's centroid.
        let Square { u, v, half, .. } = self.square;
        let inner = Point { x: (u[0] - v[0]) * half, y: (u[1] - v[1]) * half, height: 0 };
        let thrice = |p: Point| Point { x: 3 * p.x, y: 3 * p.y, height: 0 };
        cross(thrice(a), thrice(b), inner) < 0
    }

    fn point(&self, vertex: u32) -> Point {
        self.places[vertex as usize].point
    }

    fn gate(&self, gate: u32) -> Gate {
        self.gates[gate as usize]
    }

    fn link(&mut self, prev: u32, next: u32) {
        self.gates[prev as usize].next = next;
        self.gates[next as usize].prev = prev;
    }

    /// Settles what lies beyond a gate.
    fn step(&mut self, pass: &mut impl Pass, at: usize) -> Result<(), Fault> {
        let gate = self.gates[at];
        let (prev, next) = (self.gate(gate.prev), self.gate(gate.next));
        let (a, b) = (gate.origin, next.origin);
        let beyond = pass.beyond(a, b);
        // The first edge of a part has a triangle for sure.
        let first = gate.behind == NONE && gate.prev == gate.next && gate.prev as usize > at;
        if first {
            return self.grow(pass, at, beyond);
        }
        let alone = prev.prev == gate.next;
        let can_left = prev.state == State::Open && (!alone || next.state == State::Open);
        let can_right = next.state == State::Open && !alone;
        let left = if can_left { self.angle(a, b, prev.origin) } else { 0 };
        let right = if can_right { self.angle(a, b, self.gate(next.next).origin) } else { 0 };
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
            return self.grow(pass, at, beyond);
        }
        let known = if let Beyond::Known(vertex) = beyond { vertex } else { NONE };
        if left > 0 && pass.bit(&mut self.contexts.left[left][right], known == prev.origin) {
            return self.join_left(at);
        }
        let end = self.gate(next.next).origin;
        if right > 0 && pass.bit(&mut self.contexts.right[right], known == end) {
            return self.join_right(at);
        }
        self.join_other(pass, at, known)
    }

    /// The class of the angle at `v` of a triangle, 0 if there can be none.
    fn angle(&self, a: u32, b: u32, v: u32) -> usize {
        let [from, to, at] = [a, b, v].map(|vertex| self.places[vertex as usize]);
        let (sine, cosine) = (cross(from.point, to.point, at.point), dot(at.point, from.point, to.point));
        let within = from.within.children & to.within.children & at.within.children;
        if sine <= 0 || within == 0 {
            0
        } else if cosine <= -sine {
            5
        } else if cosine <= 0 {
            4
        } else if cosine <= sine / 2 {
            3
        } else if cosine <= sine {
            2
        } else {
            1
        }
    }

    /// The gate's triangle, if it can be one.
    fn triangle(&mut self, at: usize, v: u32) -> Result<(), Fault> {
        let (a, b) = (self.gates[at].origin, self.gate(self.gates[at].next).origin);
        let [from, to, apex] = [a, b, v].map(|vertex| self.places[vertex as usize]);
        let within = from.within.children & to.within.children & apex.within.children;
        if within == 0 || cross(from.point, to.point, apex.point) <= 0 {
            return Err(Fault::Place);
        }
        if self.triangles.len() >= TRIANGLES_MAX {
            return Err(Fault::Size);
        }
        self.triangles.push([a, b, v]);
        // Closed child triangles share lines only, so there is one bit.
        self.children.push(u8::try_from(within.trailing_zeros()).unwrap_or(0));
        self.gates[at].state = State::Done;
        Ok(())
    }

    /// Whether the corner at the gate's start, or end, leaves room for an edge to `v`.
    fn has_room(&self, at: usize, v: Point) -> [bool; 2] {
        let gate = self.gates[at];
        let (prev, next) = (self.gate(gate.prev), self.gate(gate.next));
        let [a, b, before, after] =
            [gate.origin, next.origin, prev.origin, self.gate(next.next).origin].map(|i| self.point(i));
        [inside(a, b, before, v), inside(b, after, a, v)]
    }

    /// A triangle with a new vertex.
    fn grow(&mut self, pass: &mut impl Pass, at: usize, beyond: Beyond) -> Result<(), Fault> {
        let gate = self.gates[at];
        let (a, b) = (gate.origin, self.gate(gate.next).origin);
        let wanted = if let Beyond::New(point) = beyond { point } else { Point::default() };
        let point = self.receive(pass, [a, b, gate.behind], wanted)?;
        if self.has_room(at, point) != [true; 2] {
            return Err(Fault::Place);
        }
        let v = self.place(point)?;
        self.triangle(at, v)?;
        let to = self.push(a, v, gate.prev, NONE, b);
        let from = self.push(v, b, to, gate.next, a);
        self.link(gate.prev, to);
        self.link(to, from);
        self.link(from, gate.next);
        if gate.behind == NONE {
            // The first edge of a part: its other side is the gate before, and behind.
            self.gates[gate.prev as usize].behind = v;
        }
        Ok(())
    }

    /// A triangle with the start of the gate before.
    fn join_left(&mut self, at: usize) -> Result<(), Fault> {
        let gate = self.gates[at];
        let prev = self.gate(gate.prev);
        let (a, b, v) = (gate.origin, self.gate(gate.next).origin, prev.origin);
        let closes = prev.prev == gate.next;
        if !closes {
            let before = self.point(self.gate(prev.prev).origin);
            let room = inside(self.point(v), self.point(a), before, self.point(b));
            if !room || !self.has_room(at, self.point(v))[1] {
                return Err(Fault::Place);
            }
        }
        self.triangle(at, v)?;
        self.gates[gate.prev as usize].state = State::Done;
        if closes {
            self.gates[gate.next as usize].state = State::Done;
            return Ok(());
        }
        let from = self.push(v, b, prev.prev, gate.next, a);
        self.link(prev.prev, from);
        self.link(from, gate.next);
        Ok(())
    }

    /// A triangle with the end of the gate behind.
    fn join_right(&mut self, at: usize) -> Result<(), Fault> {
        let gate = self.gates[at];
        let next = self.gate(gate.next);
        let beyond = self.gate(next.next);
        let (a, b, v) = (gate.origin, next.origin, beyond.origin);
        let after = self.point(self.gate(beyond.next).origin);
        let room = inside(self.point(v), after, self.point(b), self.point(a));
        if !room || !self.has_room(at, self.point(v))[0] {
            return Err(Fault::Place);
        }
        self.triangle(at, v)?;
        self.gates[gate.next as usize].state = State::Done;
        let to = self.push(a, v, gate.prev, next.next, b);
        self.link(gate.prev, to);
        self.link(to, next.next);
        Ok(())
    }

    /// Whether a triangle's corner fits in at the start of the gate `out`.
    fn fits(&self, at: usize, out: u32) -> bool {
        let gate = self.gate(out);
        let (a, b) = (self.gates[at].origin, self.gate(self.gates[at].next).origin);
        let [v, before, after, a, b] =
            [gate.origin, self.gate(gate.prev).origin, self.gate(gate.next).origin, a, b]
                .map(|i| self.point(i));
        gate.state != State::Done && inside(v, after, before, a) && inside(v, after, before, b)
    }

    /// The first place along the loop for which `is` holds: so many steps ahead, or behind if negative.
    fn look_around(&self, at: usize, mut is: impl FnMut(i64, u32) -> bool) -> Option<(i64, u32)> {
        let gate = self.gates[at];
        let (mut ahead, mut behind) = (self.gate(gate.next).next, gate.prev);
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
    fn join_other(&mut self, pass: &mut impl Pass, at: usize, known: u32) -> Result<(), Fault> {
        let found = self.look_around(at, |_, out| self.gate(out).origin == known && self.fits(at, out));
        let steps = pass.number(&mut self.contexts.other, found.map_or(0, |(steps, _)| steps))?;
        let out = if steps == 0 {
            let far = (0..index(self.gates.len()))
                .find(|out| self.gate(*out).origin == known && self.fits(at, *out));
            let far = far.filter(|_| known != NONE).unwrap_or(0);
            // Each triangle makes two gates at most, each part of the mesh two more.
            let out = pass.plain(far & 0xffff, 16) | pass.plain(far >> 16, 4) << 16;
            if out as usize >= self.gates.len() || self.look_around(at, |_, near| near == out).is_some() {
                return Err(Fault::Symbols);
            }
            out
        } else {
            self.look_around(at, |here, _| here == steps).ok_or(Fault::Symbols)?.1
        };
        let gate = self.gates[at];
        let (v, incoming) = (self.gate(out).origin, self.gate(out).prev);
        if !self.fits(at, out) || self.has_room(at, self.point(v)) != [true; 2] {
            return Err(Fault::Place);
        }
        let (a, b) = (gate.origin, self.gate(gate.next).origin);
        self.triangle(at, v)?;
        let to = self.push(a, v, gate.prev, out, b);
        let from = self.push(v, b, incoming, gate.next, a);
        self.link(gate.prev, to);
        self.link(to, out);
        self.link(incoming, from);
        self.link(from, gate.next);
        Ok(())
    }

    /// A new vertex beyond a gate, as its difference from what is expected there.
    fn receive(&mut self, pass: &mut impl Pass, gate: [u32; 3], wanted: Point) -> Result<Point, Fault> {
        let [a, b] = [gate[0], gate[1]].map(|vertex| self.point(vertex));
        let behind = (gate[2] != NONE).then(|| self.point(gate[2]));
        let (x, y) = expected_place(a, b, behind);
        let length = (b.x - a.x).abs().max((b.y - a.y).abs()).max(1).ilog2() as usize;
        let length = length.min(LENGTHS - 1);
        let [along_x, along_y] = &mut self.contexts.places[length];
        let x = x + pass.number(along_x, wanted.x - x)?;
        let y = y + pass.number(along_y, wanted.y - y)?;
        let height = expected_height(a, b, behind, x, y);
        let height = height + pass.number(&mut self.contexts.heights[length], wanted.height - height)?;
        Ok(Point { x, y, height })
    }
}

/// Where the third vertex of a triangle beyond a gate is expected.
fn expected_place(a: Point, b: Point, behind: Option<Point>) -> (i64, i64) {
    match behind {
        Some(c) => (a.x + b.x - c.x, a.y + b.y - c.y),
        // That of a triangle of three equal sides.
        None => ((a.x + b.x) / 2 - (b.y - a.y) * 7 / 8, (a.y + b.y) / 2 + (b.x - a.x) * 7 / 8),
    }
}

/// The height of the plane of the triangle on the gate's right, seen from beyond.
fn expected_height(a: Point, b: Point, behind: Option<Point>, x: i64, y: i64) -> i64 {
    let level = (a.height + b.height) / 2;
    let Some(c) = behind else { return level };
    let v = Point { x, y, height: 0 };
    let whole = cross(a, c, b);
    let (s, t) = (cross(a, c, v), -cross(a, b, v));
    // 34 bits and 3 and those of a difference of heights fit in 63.
    let shift = (64 - whole.leading_zeros()).saturating_sub(34);
    let whole = (whole >> shift).max(1);
    let clamp = |part: i64| (part >> shift).clamp(-4 * whole, 4 * whole);
    let (s, t) = (clamp(s), clamp(t));
    a.height + (s * (b.height - a.height) + t * (c.height - a.height)).div_euclid(whole)
}

fn index(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(NONE)
}

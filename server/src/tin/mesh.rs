//! Triangles with their neighbours, on flat arrays, and the one change that is made to them: a vertex slides
//! along an edge into the vertex at its other end, and the triangles at that edge vanish.
//!
//! A half-edge is a corner of a triangle: number 4t + i runs from corner i of triangle t to the next one, with
//! the triangle to its left. Each knows its twin, the half-edge of the neighbour that runs the other way. The fourth
//! of each triangle is none: so its numbers need no division, and all of it lies in 32 bytes.
//!
//! ```text
//!         p2                  The star of v: its spokes are the half-edges that leave it, counterclockwise,
//!       /  |  \               and its rim is what they lead to. At a border the first spoke has no twin, and
//!     p3 - v - p1             the rim ends with the vertex whose half-edge into v has none.
//!       \  |  /
//!         p0                  v slides into p0: the triangles left and right of that spoke vanish, the others
//!                             have p0 in the place of v.
//! ```
//!
//! Where triangles touch in a point alone (nodata may leave such), that point is a vertex for each fan of them.

use super::Vertex;
use super::few::FEW;
use diamantina_protocol::tin::Neighbours;

/// No half-edge, vertex or triangle.
pub(super) const NONE: u32 = u32::MAX;

/// Half-edges a triangle, the one that is none included.
const STRIDE: usize = 4;

/// The half-edge after this one around its triangle.
pub(super) fn next(h: u32) -> u32 {
    if h & 3 == 2 { h - 2 } else { h + 1 }
}

/// The half-edge before this one around its triangle.
pub(super) fn prev(h: u32) -> u32 {
    if h & 3 == 0 { h + 2 } else { h - 1 }
}

/// The triangle of a half-edge.
pub(super) fn triangle(h: u32) -> usize {
    h as usize / STRIDE
}

#[derive(Debug, Clone, Copy)]
struct Half {
    /// Where it begins; [`NONE`] of what has vanished, or never was.
    origin: u32,
    /// [`NONE`] at a border.
    twin: u32,
}

impl Half {
    const NO: Self = Self { origin: NONE, twin: NONE };
}

/// Triangles with their neighbours. Takes 32 bytes a triangle, 40 more while it is made if its twins are not known, and 16
/// a vertex.
#[derive(Debug, Default)]
pub(super) struct Mesh {
    halves: Vec<Half>,
    /// Of each vertex a half-edge that leaves it, at a border the one without a twin; [`NONE`] if it has none.
    first: Vec<u32>,
    pub(super) points: Vec<Vertex>,
    /// Triangles that have not vanished.
    pub(super) live: usize,
}

/// A vertex with what surrounds it.
#[derive(Debug, Default)]
pub(super) struct Star {
    pub(super) centre: u32,
    /// Of stars before there may be more behind.
    spokes: Vec<u32>,
    rim: Vec<u32>,
    /// How many spokes there are.
    count: usize,
    pub(super) border: bool,
}

/// Which half-edges took the place of others.
#[derive(Debug, Clone, Copy)]
pub(super) struct Moved {
    /// At a border: what became of the two half-edges of the centre.
    pub(super) joined: Option<u32>,
    /// Edges of the rim whose inner triangle vanished, and the half-edges that are the same edge now. Equal where there
    /// is none.
    pub(super) rim: [[u32; 2]; 2],
}

impl Default for Moved {
    fn default() -> Self {
        Self { joined: None, rim: [[NONE; 2]; 2] }
    }
}

impl Star {
    /// Half-edges that leave the centre, counterclockwise: one a triangle.
    pub(super) fn spokes(&self) -> &[u32] {
        &self.spokes[..self.count]
    }

    #[cold]
    fn grow(&mut self) {
        let count = (2 * self.spokes.len()).max(4 * FEW);
        self.spokes.resize(count, NONE);
        self.rim.resize(count, NONE);
    }

    /// The vertices around, counterclockwise: one a spoke, and one more at a border.
    pub(super) fn rim(&self) -> &[u32] {
        &self.rim[..self.count + usize::from(self.border)]
    }

    /// The rim of a whole star, or its first part; behind the last vertex comes the first one again and again.
    pub(super) fn few(&self) -> &[u32; FEW] {
        self.rim.first_chunk().unwrap_or(&[NONE; FEW])
    }

    /// The rim's edge opposite of the centre in triangle `i`.
    pub(super) fn edge(&self, i: usize) -> [u32; 2] {
        let rim = self.rim();
        [rim[i], rim[if i + 1 == rim.len() { 0 } else { i + 1 }]]
    }

    /// The border's half-edge into the centre, if there is a border.
    pub(super) fn incoming(&self) -> Option<u32> {
        self.spokes().last().filter(|_| self.border).map(|spoke| prev(*spoke))
    }
}

impl Mesh {
    /// The mesh of some triangles, counterclockwise in plan, no two of which overlap.
    pub(super) fn new(points: &[Vertex], triangles: &[[u32; 3]]) -> Self {
        Self::with_twins(points, triangles, Neighbours::of(triangles, points.len()).across())
    }

    /// [`Mesh::new`] given the twin of each half-edge.
    pub(super) fn with_twins(points: &[Vertex], triangles: &[[u32; 3]], twins: &[u32]) -> Self {
        let mut mesh = Self {
            halves: Vec::with_capacity(STRIDE * triangles.len()),
            first: vec![NONE; points.len()],
            points: points.to_vec(),
            live: triangles.len(),
        };
        for (h, ([a, b, c], [ab, bc, ca, _])) in
            (0..).step_by(STRIDE).zip(triangles.iter().zip(twins.as_chunks::<STRIDE>().0))
        {
            let half = |origin: &u32, twin: &u32| Half { origin: *origin, twin: *twin };
            mesh.halves.extend_from_slice(&[half(a, ab), half(b, bc), half(c, ca), Half::NO]);
            for (h, v) in (h..).zip([a, b, c]) {
                let first = &mut mesh.first[*v as usize];
                *first = (*first).min(h);
            }
        }
        mesh.separate();
        mesh
    }

    /// Gives each fan of triangles around a point a vertex of its own.
    fn separate(&mut self) {
        let mut others = Vec::new();
        for (h, half) in (0..).zip(&self.halves).filter(|(_, half)| half.twin == NONE && half.origin != NONE)
        {
            let first = &mut self.first[half.origin as usize];
            if *first != h && self.halves[*first as usize].twin == NONE {
                others.push((half.origin, h));
            } else {
                *first = h;
            }
        }
        others.sort_unstable();
        for (v, fan) in others {
            let copy = index(self.points.len());
            self.points.push(self.points[v as usize]);
            self.first.push(fan);
            let mut h = fan;
            while h != NONE {
                self.halves[h as usize].origin = copy;
                h = self.twin(prev(h));
            }
        }
    }

    /// The half-edge on the other side; [`NONE`] at a border.
    pub(super) fn twin(&self, h: u32) -> u32 {
        self.halves[h as usize].twin
    }

    /// Where a half-edge begins.
    pub(super) fn origin(&self, h: u32) -> u32 {
        self.halves[h as usize].origin
    }

    /// Where a half-edge ends.
    pub(super) fn target(&self, h: u32) -> u32 {
        self.origin(next(h))
    }

    /// Whether a vertex has any triangles left.
    pub(super) fn is_live(&self, v: u32) -> bool {
        self.first[v as usize] != NONE
    }

    /// Whether a vertex that is live lies at a border.
    pub(super) fn is_at_border(&self, v: u32) -> bool {
        self.twin(self.first[v as usize]) == NONE
    }

    /// The triangles that have not vanished: their numbers and corners.
    pub(super) fn triangles(&self) -> impl Iterator<Item = (usize, [u32; 3])> {
        let fours = self.halves.as_chunks::<STRIDE>().0.iter().enumerate();
        fours.map(|(t, [a, b, c, _])| (t, [a.origin, b.origin, c.origin])).filter(|(_, t)| t[0] != NONE)
    }

    /// The corners of a triangle; [`NONE`] if it has vanished.
    pub(super) fn corners(&self, t: usize) -> [u32; 3] {
        let [a, b, c, _] = self.halves.as_chunks::<STRIDE>().0[t];
        [a.origin, b.origin, c.origin]
    }

    /// Half-edges without a twin.
    pub(super) fn borders(&self) -> impl Iterator<Item = u32> {
        (0..).zip(&self.halves).filter(|(_, half)| half.origin != NONE && half.twin == NONE).map(|(h, _)| h)
    }

    /// Looks around a vertex that is live.
    pub(super) fn look(&self, v: u32, star: &mut Star) {
        let fours = self.halves.as_chunks::<STRIDE>().0;
        let start = self.first[v as usize];
        let (mut h, mut count) = (start, 0);
        star.centre = v;
        star.border = loop {
            let four = &fours[triangle(h)];
            // Of corner 0, 1 and 2 two bits each: the corners after and before.
            let twice = 2 * (h & 3);
            let (to, from) = (four[0b00_10_01 >> twice & 3], four[0b01_00_10 >> twice & 3]);
            // Room for those behind.
            if count + FEW >= star.spokes.len().min(star.rim.len()) {
                star.grow();
            }
            (star.spokes[count], star.rim[count]) = (h, to.origin);
            count += 1;
            h = from.twin;
            if h == NONE {
                star.rim[count] = from.origin;
                break true;
            }
            if h == start {
                break false;
            }
        };
        if !star.border {
            let first = star.rim[0];
            star.rim[count..count + FEW].fill(first);
        }
        star.count = count;
    }

    fn link(&mut self, h: u32, twin: u32) {
        self.halves[h as usize].twin = twin;
        if twin != NONE {
            self.halves[twin as usize].twin = h;
        }
    }

    fn remove(&mut self, h: u32) {
        self.halves.as_chunks_mut::<STRIDE>().0[triangle(h)].fill(Half::NO);
        self.live -= 1;
    }

    /// Notes the half-edge without a twin that leaves the origin of `h`, or `h` where there is none.
    fn settle_around(&mut self, h: u32) {
        let mut start = h;
        while self.twin(start) != NONE {
            start = next(self.twin(start));
            if start == h {
                break;
            }
        }
        let v = self.origin(h) as usize;
        self.first[v] = start;
    }

    /// Notes `h` as the first that leaves its origin, unless the one noted is a border. For where no border has changed.
    fn settle(&mut self, h: u32) {
        let v = self.origin(h);
        let noted = self.first[v as usize];
        let stays = self.origin(noted) == v && self.twin(noted) == NONE && self.twin(h) != NONE;
        if !stays {
            self.first[v as usize] = h;
        }
    }

    /// Slides the star's centre into the rim's vertex `to`, which at a border is the rim's first or last, and tells which
    /// half-edges are borders then.
    ///
    /// The star must not be all there is of a component: a triangle has to be left.
    pub(super) fn collapse(&mut self, star: &Star, to: usize) -> Moved {
        let count = star.spokes().len();
        let u = star.rim()[to];
        let mut moved = Moved::default();
        if star.border && count == 1 {
            let beyond = self.twin(next(star.spokes()[0]));
            self.remove(star.spokes()[0]);
            self.first[star.centre as usize] = NONE;
            self.halves[beyond as usize].twin = NONE;
            self.settle_around(beyond);
            self.settle_around(next(beyond));
            return Moved { joined: Some(beyond), ..moved };
        }
        for spoke in star.spokes() {
            self.halves[*spoke as usize].origin = u;
        }
        let mut touched = [NONE; 3];
        if !star.border || to == 0 {
            // The triangle left of the spoke vanishes: what was beyond it lies beyond the next spoke.
            let (gone, after) = (star.spokes()[to], star.spokes()[(to + 1) % count]);
            let beyond = self.twin(next(gone));
            self.link(after, beyond);
            moved.rim[0] = [next(gone), after];
            self.remove(gone);
            touched[0] = after;
            touched[1] = next(after);
            moved.joined = star.incoming();
        }
        if !star.border || to > 0 {
            let (gone, before) =
                (star.spokes()[(to + count - 1) % count], star.spokes()[(to + 2 * count - 2) % count]);
            let side = prev(before);
            let beyond = self.twin(next(gone));
            self.link(side, beyond);
            moved.rim[1] = [next(gone), side];
            self.remove(gone);
            touched[2] = side;
            if star.border {
                touched[0] = star.spokes()[0];
                moved.joined = Some(star.spokes()[0]);
            }
        }
        self.first[star.centre as usize] = NONE;
        for h in touched.into_iter().filter(|h| *h != NONE) {
            if star.border { self.settle_around(h) } else { self.settle(h) }
        }
        moved
    }
}

fn index(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(NONE)
}

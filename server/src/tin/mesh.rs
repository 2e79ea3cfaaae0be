//! Triangles with their neighbours, on flat arrays, and the one change that is made to them: a vertex slides
//! along an edge into the vertex at its other end, and the triangles at that edge vanish.
//!
//! A half-edge is a corner of a triangle: number 3t + i runs from corner i of triangle t to the next one, with
//! the triangle to its left. Each knows its twin, the half-edge of the neighbour that runs the other way.
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

/// No half-edge, vertex or triangle.
pub(super) const NONE: u32 = u32::MAX;

/// The half-edge after this one around its triangle.
pub(super) fn next(h: u32) -> u32 {
    if h % 3 == 2 { h - 2 } else { h + 1 }
}

/// The half-edge before this one around its triangle.
pub(super) fn prev(h: u32) -> u32 {
    if h.is_multiple_of(3) { h + 2 } else { h - 1 }
}

/// Triangles with their neighbours. Takes 40 bytes a triangle and as much a vertex.
#[derive(Debug, Default)]
pub(super) struct Mesh {
    /// Where half-edges begin, three a triangle; [`NONE`] of what has vanished.
    pub(super) origins: Vec<u32>,
    twins: Vec<u32>,
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
    /// Half-edges that leave the centre, counterclockwise: one a triangle.
    pub(super) spokes: Vec<u32>,
    /// The vertices around, counterclockwise: one a spoke, and one more at a border.
    pub(super) rim: Vec<u32>,
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
    /// The rim's edge opposite of the centre in triangle `i`.
    pub(super) fn edge(&self, i: usize) -> [u32; 2] {
        [self.rim[i], self.rim[if i + 1 == self.rim.len() { 0 } else { i + 1 }]]
    }

    /// The border's half-edge into the centre, if there is a border.
    pub(super) fn incoming(&self) -> Option<u32> {
        self.spokes.last().filter(|_| self.border).map(|spoke| prev(*spoke))
    }
}

impl Mesh {
    /// The mesh of some triangles, counterclockwise in plan, no two of which overlap.
    pub(super) fn new(points: &[Vertex], triangles: &[[u32; 3]]) -> Self {
        let origins: Vec<u32> = triangles.as_flattened().to_vec();
        let mut mesh = Self {
            twins: vec![NONE; origins.len()],
            first: vec![NONE; points.len()],
            points: points.to_vec(),
            live: triangles.len(),
            origins,
        };
        let outgoing = mesh.pair();
        mesh.separate(&outgoing);
        mesh
    }

    /// Finds the twins; the half-edges that leave each vertex, with the position of its first.
    fn pair(&mut self) -> (Vec<u32>, Vec<u32>) {
        let mut starts = vec![0u32; self.points.len() + 1];
        for v in &self.origins {
            starts[*v as usize + 1] += 1;
        }
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut filled = starts.clone();
        let mut list = vec![0u32; self.origins.len()];
        for (h, v) in (0..).zip(&self.origins) {
            list[filled[*v as usize] as usize] = h;
            filled[*v as usize] += 1;
        }
        for h in 0..self.origins.len() {
            if self.twins[h] != NONE {
                continue;
            }
            let here = u32::try_from(h).unwrap_or(NONE);
            let (from, to) = (self.origins[h], self.target(here) as usize);
            let leaving = &list[starts[to] as usize..starts[to + 1] as usize];
            if let Some(twin) = leaving.iter().find(|g| self.target(**g) == from) {
                self.twins[h] = *twin;
                self.twins[*twin as usize] = here;
            }
        }
        (list, starts)
    }

    /// Gives each fan of triangles around a point a vertex of its own.
    fn separate(&mut self, (list, starts): &(Vec<u32>, Vec<u32>)) {
        for v in 0..starts.len() - 1 {
            let leaving = &list[starts[v] as usize..starts[v + 1] as usize];
            let Some(any) = leaving.first() else { continue };
            let fans = leaving.iter().filter(|h| self.twin(**h) == NONE);
            let mut fans: Vec<u32> = fans.copied().collect();
            if fans.is_empty() {
                fans.push(*any);
            }
            self.first[v] = fans[0];
            for fan in &fans[1..] {
                let copy = u32::try_from(self.points.len()).unwrap_or(NONE);
                self.points.push(self.points[v]);
                self.first.push(*fan);
                let mut h = *fan;
                while h != NONE {
                    self.origins[h as usize] = copy;
                    h = self.twin(prev(h));
                }
            }
        }
    }

    /// The half-edge on the other side; [`NONE`] at a border.
    pub(super) fn twin(&self, h: u32) -> u32 {
        self.twins[h as usize]
    }

    /// Where a half-edge begins.
    pub(super) fn origin(&self, h: u32) -> u32 {
        self.origins[h as usize]
    }

    /// Where a half-edge ends.
    pub(super) fn target(&self, h: u32) -> u32 {
        self.origins[next(h) as usize]
    }

    /// Whether a vertex has any triangles left.
    pub(super) fn is_live(&self, v: u32) -> bool {
        self.first[v as usize] != NONE
    }

    /// The triangles that have not vanished: their numbers and corners.
    pub(super) fn triangles(&self) -> impl Iterator<Item = (usize, [u32; 3])> {
        self.origins.as_chunks::<3>().0.iter().copied().enumerate().filter(|(_, t)| t[0] != NONE)
    }

    /// Half-edges without a twin.
    pub(super) fn borders(&self) -> impl Iterator<Item = u32> {
        (0..).zip(&self.origins).filter(|(h, v)| **v != NONE && self.twin(*h) == NONE).map(|(h, _)| h)
    }

    /// Looks around a vertex that is live.
    pub(super) fn look(&self, v: u32, star: &mut Star) {
        star.spokes.clear();
        star.rim.clear();
        star.centre = v;
        let start = self.first[v as usize];
        star.border = self.twin(start) == NONE;
        let mut h = start;
        loop {
            star.spokes.push(h);
            star.rim.push(self.target(h));
            let into = prev(h);
            h = self.twin(into);
            if h == NONE {
                star.rim.push(self.origin(into));
                break;
            }
            if h == start {
                break;
            }
        }
    }

    /// Calls `visit` with each triangle around a vertex that is live, counterclockwise; whether the vertex lies at a
    /// border.
    pub(super) fn around(&self, v: u32, mut visit: impl FnMut(usize)) -> bool {
        let start = self.first[v as usize];
        let mut h = start;
        loop {
            visit(h as usize / 3);
            h = self.twin(prev(h));
            if h == NONE || h == start {
                return h == NONE;
            }
        }
    }

    fn link(&mut self, h: u32, twin: u32) {
        self.twins[h as usize] = twin;
        if twin != NONE {
            self.twins[twin as usize] = h;
        }
    }

    fn remove(&mut self, h: u32) {
        let t = h as usize / 3 * 3;
        self.origins[t..t + 3].fill(NONE);
        self.live -= 1;
    }

    /// Notes `h` or, at a border, the half-edge without a twin, as the first that leaves its origin.
    fn settle(&mut self, h: u32) {
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

    /// Slides the star's centre into the rim's vertex `to`, which at a border is the rim's first or last, and tells which
    /// half-edges are borders then.
    ///
    /// The star must not be all there is of a component: a triangle has to be left.
    pub(super) fn collapse(&mut self, star: &Star, to: usize) -> Moved {
        let count = star.spokes.len();
        let u = star.rim[to];
        let mut moved = Moved::default();
        if star.border && count == 1 {
            let beyond = self.twin(next(star.spokes[0]));
            self.remove(star.spokes[0]);
            self.first[star.centre as usize] = NONE;
            self.twins[beyond as usize] = NONE;
            self.settle(beyond);
            self.settle(next(beyond));
            return Moved { joined: Some(beyond), ..moved };
        }
        for spoke in &star.spokes {
            self.origins[*spoke as usize] = u;
        }
        let mut touched = [NONE; 3];
        if !star.border || to == 0 {
            // The triangle left of the spoke vanishes: what was beyond it lies beyond the next spoke.
            let (gone, after) = (star.spokes[to], star.spokes[(to + 1) % count]);
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
                (star.spokes[(to + count - 1) % count], star.spokes[(to + 2 * count - 2) % count]);
            let side = prev(before);
            let beyond = self.twin(next(gone));
            self.link(side, beyond);
            moved.rim[1] = [next(gone), side];
            self.remove(gone);
            touched[2] = side;
            if star.border {
                touched[0] = star.spokes[0];
                moved.joined = Some(star.spokes[0]);
            }
        }
        self.first[star.centre as usize] = NONE;
        for h in touched.into_iter().filter(|h| *h != NONE) {
            self.settle(h);
        }
        moved
    }
}

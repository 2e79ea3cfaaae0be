//! A sender's mesh: which triangle lies on which side of an edge.
//!
//! Corners around a vertex that are joined by edges make a *fan*. A vertex with several fans, where parts
//! of a patch meet in a point alone, becomes one vertex a fan: then each has at most one gap around it, and
//! a front can be followed without choices.

use super::walk::{Beyond, NONE, Point, Square};
use super::{Patch, PatchError, TRIANGLES_MAX};

/// A triangle's corner: three times its number, and 0 to 2.
type Corner = u32;

fn next(corner: Corner) -> Corner {
    if corner % 3 == 2 { corner - 2 } else { corner + 1 }
}

fn prev(corner: Corner) -> Corner {
    next(next(corner))
}

/// A mesh to be sent.
pub(super) struct Mesh {
    /// The fan of each corner.
    fans: Vec<u32>,
    /// Across the edge from a corner to the next one: the corner where the edge ends, or [`NONE`].
    opposite: Vec<Corner>,
    /// The corners of each fan, and where the list of each begins.
    corners: Vec<Corner>,
    starts: Vec<u32>,
    /// The place of each fan.
    points: Vec<Point>,
    /// The walk's name of each fan, [`NONE`] before it is met, and back.
    names: Vec<u32>,
    fan_of: Vec<u32>,
    /// Triangles that the walk has met, and before which there are none left to begin with.
    met: Vec<bool>,
    first: usize,
}

/// The items' positions in an order by key, and where each key begins. Keys are below `keys`.
fn grouped(keys: usize, of: &[u32]) -> (Vec<u32>, Vec<u32>) {
    let mut starts = vec![0u32; keys + 1];
    for key in of {
        starts[*key as usize + 1] += 1;
    }
    for i in 0..keys {
        starts[i + 1] += starts[i];
    }
    let mut at = starts.clone();
    let mut list = vec![0u32; of.len()];
    for (i, key) in (0..).zip(of) {
        let slot = &mut at[*key as usize];
        list[*slot as usize] = i;
        *slot += 1;
    }
    (list, starts)
}

impl Mesh {
    /// The mesh of a patch whose vertices lie at `points`.
    pub(super) fn new(patch: &Patch, points: &[Point], square: &Square) -> Result<Self, PatchError> {
        if patch.triangles.len() > TRIANGLES_MAX {
            return Err(PatchError::Triangles(patch.triangles.len()));
        }
        check(patch, points, square)?;
        let vertices: Vec<u32> = patch.triangles.iter().flatten().copied().collect();
        let (corners, starts) = grouped(points.len(), &vertices);
        let around = |v: u32| &corners[starts[v as usize] as usize..starts[v as usize + 1] as usize];
        let mut opposite = vec![NONE; vertices.len()];
        for corner in 0..index(vertices.len()) {
            let (a, b) = (vertices[corner as usize], vertices[next(corner) as usize]);
            let twice = around(a).iter().filter(|c| vertices[next(**c) as usize] == b).count();
            if twice > 1 {
                return Err(PatchError::Edge(a, b));
            }
            let across = around(b).iter().find(|c| vertices[next(**c) as usize] == a);
            opposite[corner as usize] = across.map_or(NONE, |c| next(*c));
        }
        let (fans, places) = fans(&vertices, &opposite, points);
        let (corners, starts) = grouped(places.len(), &fans);
        Ok(Self {
            opposite,
            corners,
            starts,
            names: vec![NONE; places.len()],
            points: places,
            fans,
            fan_of: Vec::new(),
            met: vec![false; patch.triangles.len()],
            first: 0,
        })
    }

    /// Whether some edge without a neighbour lies strictly within the square.
    pub(super) fn has_holes(&self, square: &Square) -> bool {
        (0..index(self.fans.len())).any(|corner| {
            let outer = |corner: Corner| {
                let p = self.points[self.fans[corner as usize] as usize];
                square.within(p.x, p.y).outer
            };
            self.opposite[corner as usize] == NONE && outer(corner) & outer(next(corner)) == 0
        })
    }

    /// The first two vertices of the first triangle that has not been met.
    pub(super) fn seed(&mut self) -> Option<[Point; 2]> {
        while *self.met.get(self.first)? {
            self.first += 1;
        }
        let corner = index(3 * self.first);
        Some([corner, corner + 1].map(|corner| {
            let fan = self.fans[corner as usize];
            self.meet(fan);
            self.points[fan as usize]
        }))
    }

    fn meet(&mut self, fan: u32) {
        self.names[fan as usize] = index(self.fan_of.len());
        self.fan_of.push(fan);
    }

    /// What lies to the left of the edge between two vertices that the walk has met.
    pub(super) fn beyond(&mut self, a: u32, b: u32) -> Beyond {
        let [a, b] = [a, b].map(|name| self.fan_of[name as usize]);
        let corners = &self.corners[self.starts[a as usize] as usize..self.starts[a as usize + 1] as usize];
        let Some(corner) = corners.iter().copied().find(|c| self.fans[next(*c) as usize] == b) else {
            return Beyond::Nothing;
        };
        self.met[corner as usize / 3] = true;
        let fan = self.fans[prev(corner) as usize];
        match self.names[fan as usize] {
            NONE => {
                self.meet(fan);
                Beyond::New(self.points[fan as usize])
            }
            name => Beyond::Known(name),
        }
    }
}

/// Whether a patch is one.
fn check(patch: &Patch, points: &[Point], square: &Square) -> Result<(), PatchError> {
    let total = patch.triangles.len();
    if !patch.ends.is_sorted() || patch.ends[3] as usize != total {
        return Err(PatchError::Ends(patch.ends));
    }
    let mut from = 0;
    for (child, to) in patch.ends.iter().enumerate() {
        for triangle in &patch.triangles[from..*to as usize] {
            if triangle.iter().any(|v| *v as usize >= points.len()) {
                return Err(PatchError::Vertex(*triangle));
            }
            let corners = triangle.map(|v| points[v as usize]);
            let [a, b, c] = corners;
            if (b.x - a.x) * (c.y - a.y) <= (b.y - a.y) * (c.x - a.x) {
                return Err(PatchError::Turn(*triangle));
            }
            if corners.iter().any(|p| square.within(p.x, p.y).children & 1 << child == 0) {
                return Err(PatchError::Child(*triangle, child));
            }
        }
        from = *to as usize;
    }
    Ok(())
}

/// The fan of each corner, and the place of each fan.
fn fans(vertices: &[u32], opposite: &[Corner], points: &[Point]) -> (Vec<u32>, Vec<Point>) {
    let mut fans = vec![NONE; vertices.len()];
    let mut places = Vec::new();
    for corner in 0..index(vertices.len()) {
        if fans[corner as usize] != NONE {
            continue;
        }
        let fan = index(places.len());
        places.push(points[vertices[corner as usize] as usize]);
        // To the left around the vertex, and if that does not come back, to the right.
        let mut at = corner;
        while at != NONE && fans[at as usize] == NONE {
            fans[at as usize] = fan;
            at = opposite_start(opposite, prev(at));
        }
        at = opposite[corner as usize];
        while at != NONE && fans[at as usize] == NONE {
            fans[at as usize] = fan;
            at = opposite[at as usize];
        }
    }
    (fans, places)
}

/// Across the edge from a corner to the next one: the corner where the neighbour's edge starts.
fn opposite_start(opposite: &[Corner], corner: Corner) -> Corner {
    match opposite[corner as usize] {
        NONE => NONE,
        end => prev(end),
    }
}

fn index(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(NONE)
}

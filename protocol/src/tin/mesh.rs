//! A sender's mesh: which triangle lies on which side of an edge.
//!
//! Corners around a vertex that are joined by edges make a *fan*. A vertex with several fans, where parts
//! of a patch meet in a point alone, becomes one vertex a fan: then each has at most one gap around it, and
//! a front can be followed without choices.

use super::walk::{Beyond, NONE, Point, Seed, Square, Within, cross};
use super::{Patch, PatchError, TRIANGLES_MAX};

/// A triangle's corner: four times its number, and 0 to 2. So no number needs a division; every fourth is none.
type Corner = u32;

const STRIDE: usize = 4;

fn next(corner: Corner) -> Corner {
    if corner & 3 == 2 { corner - 2 } else { corner + 1 }
}

fn prev(corner: Corner) -> Corner {
    if corner & 3 == 0 { corner + 2 } else { corner - 1 }
}

/// The corners of so many triangles.
fn corners(triangles: usize) -> impl Iterator<Item = Corner> {
    (0..index(STRIDE * triangles)).filter(|corner| corner & 3 != 3)
}

/// A mesh to be sent. Gates are marked with the corner of the triangle beyond where the gate starts, or [`NONE`].
pub(super) struct Mesh {
    /// The fan of each corner.
    fans: Vec<u32>,
    /// Across the edge from a corner to the next one: the corner where the neighbour's edge starts, or [`NONE`].
    across: Vec<Corner>,
    /// The place of each fan.
    points: Vec<Point>,
    /// The walk's name of each fan, [`NONE`] before it is met, and how many have been.
    names: Vec<u32>,
    named: u32,
    /// Triangles that the walk has met, and before which there are none left to begin with.
    met: Vec<bool>,
    first: usize,
    /// Whether some edge without a neighbour lies strictly within the square.
    holes: bool,
}

impl Mesh {
    /// The mesh of a patch whose vertices lie at `points`.
    pub(super) fn new(patch: &Patch, points: &[Point], square: &Square) -> Result<Self, PatchError> {
        if patch.triangles.len() > TRIANGLES_MAX {
            return Err(PatchError::Triangles(patch.triangles.len()));
        }
        let within: Vec<Within> =
            points.iter().map(|p| square.within(i64::from(p.x), i64::from(p.y))).collect();
        check(patch, points, &within)?;
        let across = across(&patch.triangles, points.len())?;
        let vertex = |corner: Corner| patch.triangles[corner as usize / STRIDE][corner as usize % STRIDE];
        let (fans, places) = fans(&patch.triangles, &across, points);
        let outer = |corner: Corner| within[vertex(corner) as usize].outer;
        let is_inner = |corner: Corner| outer(corner) & outer(next(corner)) == 0;
        let holes = corners(patch.triangles.len()).any(|c| across[c as usize] == NONE && is_inner(c));
        Ok(Self {
            across,
            names: vec![NONE; places.len()],
            named: 0,
            points: places,
            fans,
            met: vec![false; patch.triangles.len()],
            first: 0,
            holes,
        })
    }

    /// Whether some edge without a neighbour lies strictly within the square.
    pub(super) fn has_holes(&self) -> bool {
        self.holes
    }

    /// The first two vertices of the first triangle that has not been met.
    pub(super) fn seed(&mut self) -> Option<Seed> {
        while *self.met.get(self.first)? {
            self.first += 1;
        }
        let corner = index(STRIDE * self.first);
        let points = [corner, corner + 1].map(|corner| {
            let fan = self.fans[corner as usize] as usize;
            self.names[fan] = self.named;
            self.named += 1;
            self.points[fan]
        });
        Some(Seed { points, marks: [corner, self.across[corner as usize]] })
    }

    /// What lies beyond a gate.
    pub(super) fn beyond(&mut self, mark: u32) -> Beyond {
        if mark == NONE {
            return Beyond::Nothing;
        }
        self.met[mark as usize / STRIDE] = true;
        let fan = self.fans[prev(mark) as usize] as usize;
        match self.names[fan] {
            NONE => {
                self.names[fan] = self.named;
                self.named += 1;
                Beyond::New(self.points[fan])
            }
            name => Beyond::Known(name),
        }
    }

    /// The marks of the two gates that the triangle beyond a gate makes.
    pub(super) fn marks(&self, mark: u32) -> [u32; 2] {
        [prev(mark), next(mark)].map(|corner| self.across[corner as usize])
    }
}

/// For each corner the one across the edge to the next corner, where the neighbour's edge starts.
fn across(triangles: &[[u32; 3]], count: usize) -> Result<Vec<Corner>, PatchError> {
    // The corners of each vertex, with where their edges end. One place too far to begin with: filling the list
    // moves each to where it belongs.
    let mut starts = vec![0u32; count + 2];
    for v in triangles.as_flattened() {
        starts[*v as usize + 2] += 1;
    }
    let mut sum = 0;
    for start in &mut starts {
        sum += *start;
        *start = sum;
    }
    let mut edges = vec![[0u32; 2]; 3 * triangles.len()];
    for (t, [a, b, c]) in (0..).step_by(STRIDE).zip(triangles) {
        for (corner, from, to) in [(t, a, b), (t + 1, b, c), (t + 2, c, a)] {
            let slot = &mut starts[*from as usize + 1];
            edges[*slot as usize] = [*to, corner];
            *slot += 1;
        }
    }
    let edges_of = |v: u32| &edges[starts[v as usize] as usize..starts[v as usize + 1] as usize];
    let mut across = vec![NONE; STRIDE * triangles.len()];
    for (a, list) in (0..index(count)).map(|a| (a, edges_of(a))) {
        for (i, [b, corner]) in list.iter().enumerate() {
            if list[..i].iter().any(|[other, _]| other == b) {
                return Err(PatchError::Edge(a, *b));
            }
            if *b > a
                && let Some([_, twin]) = edges_of(*b).iter().find(|[end, _]| *end == a)
            {
                across[*corner as usize] = *twin;
                across[*twin as usize] = *corner;
            }
        }
    }
    Ok(across)
}

/// Whether a patch is one.
fn check(patch: &Patch, points: &[Point], within: &[Within]) -> Result<(), PatchError> {
    let total = patch.triangles.len();
    if !patch.ends.is_sorted() || patch.ends[3] as usize != total {
        return Err(PatchError::Ends(patch.ends));
    }
    for child in 0..4 {
        for triangle in &patch.triangles[patch.range(child)] {
            let point = |v: u32| points.get(v as usize).copied();
            let [a, b, c] = *triangle;
            let (Some(p), Some(q), Some(r)) = (point(a), point(b), point(c)) else {
                return Err(PatchError::Vertex(*triangle));
            };
            if cross(p, q, r) <= 0 {
                return Err(PatchError::Turn(*triangle));
            }
            let inside = |v: u32| within[v as usize].children;
            if inside(a) & inside(b) & inside(c) & 1 << child == 0 {
                return Err(PatchError::Child(*triangle, child));
            }
        }
    }
    Ok(())
}

/// The fan of each corner, and the place of each fan.
fn fans(triangles: &[[u32; 3]], across: &[Corner], points: &[Point]) -> (Vec<u32>, Vec<Point>) {
    let mut fans = vec![NONE; across.len()];
    let mut places = Vec::with_capacity(points.len());
    for (corner, vertex) in corners(triangles.len()).zip(triangles.as_flattened()) {
        if fans[corner as usize] != NONE {
            continue;
        }
        let fan = index(places.len());
        places.push(points[*vertex as usize]);
        // To the left around the vertex, and if that does not come back, to the right.
        let mut at = corner;
        while at != NONE && fans[at as usize] == NONE {
            fans[at as usize] = fan;
            at = across[prev(at) as usize];
        }
        at = right_of(across, corner);
        while at != NONE && fans[at as usize] == NONE {
            fans[at as usize] = fan;
            at = right_of(across, at);
        }
    }
    (fans, places)
}

/// The corner to the right around the same vertex.
fn right_of(across: &[Corner], corner: Corner) -> Corner {
    match across[corner as usize] {
        NONE => NONE,
        end => next(end),
    }
}

fn index(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(NONE)
}

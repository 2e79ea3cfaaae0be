//! A sender's mesh: which triangle lies on which side of an edge.
//!
//! Corners around a vertex that are joined by edges make a *fan*. A vertex with several fans, where parts
//! of a patch meet in a point alone, becomes one vertex a fan: then each has at most one gap around it, and
//! a front can be followed without choices.

use super::place::{Point, Square, Within, cross};
use super::walk::{Beyond, NONE, Seed};
use super::{Neighbours, Patch, PatchError, TRIANGLES_MAX};

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
pub(super) struct Mesh<'a> {
    /// The fan of each corner: its vertex, or where that has several, for each but one another number.
    fans: Vec<u32>,
    /// Across the edge from a corner to the next one: the corner where the neighbour's edge starts, or [`NONE`].
    across: &'a [Corner],
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

impl<'a> Mesh<'a> {
    /// The mesh of a patch whose vertices lie at `points`.
    pub(super) fn new(
        patch: &Patch,
        neighbours: &'a Neighbours,
        points: &[Point],
        square: &Square,
    ) -> Result<Self, PatchError> {
        if patch.triangles.len() > TRIANGLES_MAX {
            return Err(PatchError::Triangles(patch.triangles.len()));
        }
        let within: Vec<Within> =
            points.iter().map(|p| square.within(i64::from(p.x), i64::from(p.y))).collect();
        check(patch, points, &within)?;
        let across = neighbours.across();
        if let Some([a, b]) = neighbours.repeated {
            return Err(PatchError::Edge(a, b));
        }
        let mut fans = vec![NONE; STRIDE * patch.triangles.len()];
        for (four, triangle) in fans.as_chunks_mut::<STRIDE>().0.iter_mut().zip(&patch.triangles) {
            four[..3].copy_from_slice(triangle);
        }
        let (mut gaps, mut is_torn, mut holes) = (vec![false; points.len()], false, false);
        for (four, triangle) in across.as_chunks::<STRIDE>().0.iter().zip(&patch.triangles) {
            for i in (0..3).filter(|i| four[*i] == NONE) {
                let ends = [triangle[i], triangle[(i + 1) % 3]].map(|v| v as usize);
                holes |= within[ends[0]].outer & within[ends[1]].outer == 0;
                is_torn |= std::mem::replace(&mut gaps[ends[0]], true);
            }
        }
        let mut places = points.to_vec();
        if is_torn {
            separate(&patch.triangles, across, &mut fans, &mut places);
        }
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

/// For each corner of a patch with so many vertices the one across the edge to the next corner, where the neighbour's
/// edge starts, or [`NONE`]; and an edge with two triangles on the same side, if there is one. Nothing if it is no patch
/// for another reason.
pub(super) fn across(triangles: &[[u32; 3]], count: usize) -> (Vec<Corner>, Option<[u32; 2]>) {
    let has_numbers = triangles.len() <= NONE as usize / STRIDE;
    if !has_numbers || triangles.as_flattened().iter().any(|v| *v as usize >= count) {
        return (Vec::new(), None);
    }
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
    let (mut across, mut repeated) = (vec![NONE; STRIDE * triangles.len()], None);
    for a in 0..index(count) {
        for [b, corner] in edges_of(a).iter().filter(|[b, _]| *b > a) {
            if let Some([_, twin]) = edges_of(*b).iter().find(|[end, _]| *end == a) {
                if across[*twin as usize] != NONE {
                    repeated = Some([a, *b]);
                }
                across[*corner as usize] = *twin;
                across[*twin as usize] = *corner;
            }
        }
    }
    // Of two on the same side of an edge one at least has found nobody.
    for (four, triangle) in across.as_chunks::<STRIDE>().0.iter().zip(triangles) {
        for i in (0..3).filter(|i| four[*i] == NONE) {
            let (a, b) = (triangle[i], triangle[(i + 1) % 3]);
            if edges_of(a).iter().filter(|[end, _]| *end == b).count() > 1 {
                repeated = Some([a, b]);
            }
        }
    }
    (across, repeated)
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

/// Gives each fan of a vertex with several gaps around it a place of its own.
fn separate(triangles: &[[u32; 3]], across: &[Corner], fans: &mut [u32], places: &mut Vec<Point>) {
    let mut is_met = vec![false; fans.len()];
    let mut is_first = vec![true; places.len()];
    for (corner, vertex) in corners(triangles.len()).zip(triangles.as_flattened()) {
        if is_met[corner as usize] {
            continue;
        }
        let mut fan = *vertex;
        if !std::mem::replace(&mut is_first[fan as usize], false) {
            fan = index(places.len());
            places.push(places[*vertex as usize]);
        }
        // To the left around the vertex, and if that does not come back, to the right.
        let mut at = corner;
        while at != NONE && !is_met[at as usize] {
            (fans[at as usize], is_met[at as usize]) = (fan, true);
            at = across[prev(at) as usize];
        }
        at = right_of(across, corner);
        while at != NONE && !is_met[at as usize] {
            (fans[at as usize], is_met[at as usize]) = (fan, true);
            at = right_of(across, at);
        }
    }
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

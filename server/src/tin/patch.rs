//! The mesh of a triangle of the bintree; four of them merged, simplified, and cut in two.

use super::collapse::{Before, Passed, Simplifier, Until, distance_to};
use super::ground::Ground;
use super::mesh::{Mesh, NONE, triangle};
use super::metric::{between, length, turn};
use super::square::{Role, Square};
use super::state::at_least;
use super::{Rules, Vertex};
use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::tin::{Lattices, Neighbours, Patch, PatchError, encode_whole, encode_with};
use std::collections::{HashMap, HashSet};

/// An edge of the border, from vertex to vertex, and the points of the source's border that it stands for, but for those
/// on a straight line between others. It has the mesh to its left.
pub type Border = ([u32; 2], Vec<[u32; 2]>);

/// The mesh of one triangle of the bintree. Takes 28 bytes a triangle, and 8 for each point that its borders stand for.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tin {
    /// In no order; some of the same place where triangles touch in a point alone.
    pub vertices: Vec<Vertex>,
    /// Counterclockwise in plan.
    pub triangles: Vec<[u32; 3]>,
    /// Those borders along nodata that are not the source's own.
    pub borders: Vec<Border>,
    /// How far samples are from each triangle, in quanta, a little more at most; none if that is not known.
    pub errors: Vec<f32>,
    /// What vertices need at least to go, in quanta, the upper half of an `f32`; 0 if that is not known. None if it is
    /// known of none.
    pub needs: Vec<u16>,
    /// How far what was left out since there was no room for it lies from what is there, in metres.
    pub lost: f64,
    /// Which vertices have all triangles that they have in the source's own mesh; none if that is not known.
    pub untouched: Vec<bool>,
}

/// The meshes of a diamond's four triangles as one.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Merged {
    /// What lies on a side of two triangles is one vertex.
    pub patch: Patch,
    /// See [`Tin::borders`].
    pub borders: Vec<Border>,
    /// See [`Tin::errors`].
    pub errors: Vec<f32>,
    /// See [`Tin::needs`].
    needs: Vec<u16>,
    /// See [`Tin::lost`].
    pub lost: f64,
    /// Whether it is the source's own mesh.
    is_source: bool,
    /// See [`Tin::untouched`]; of each vertex.
    untouched: Vec<bool>,
    /// Those of the patch, if they are known.
    neighbours: Option<Neighbours>,
    /// Whether it is what [`Lattices`] has made.
    is_whole: bool,
}

impl Merged {
    /// The payload of the diamond. What neighbours the patch has is known from then on.
    ///
    /// # Errors
    /// When it is no patch of this diamond.
    pub fn encode(&mut self, forest: &Forest, d: Diamond) -> Result<Vec<u8>, PatchError> {
        if self.is_whole {
            return encode_whole(forest, d, &self.patch);
        }
        let neighbours = self.neighbours.take();
        let neighbours =
            neighbours.unwrap_or_else(|| Neighbours::of(&self.patch.triangles, self.patch.vertices.len()));
        let bytes = encode_with(forest, d, &self.patch, &neighbours)?;
        self.neighbours = Some(neighbours);
        Ok(bytes)
    }
}

/// What became of a diamond.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Simplified {
    /// The meshes of its triangles below and above the hypotenuse.
    pub halves: [Tin; 2],
    /// The largest distance between their borders and the source's, in metres.
    pub apart: f64,
    /// The largest vertical distance between them and the samples that they cover, in quanta, if that is known.
    pub vertical: Option<f64>,
}

/// A lattice point of the forest as a vertex.
fn point([x, y]: [i64; 2]) -> Vertex {
    let whole = |w: i64| u32::try_from(w).unwrap_or(0);
    Vertex { x: whole(x), y: whole(y), height: 0 }
}

/// The corners of a diamond.
fn square(forest: &Forest, d: Diamond) -> Square {
    let local = forest.local(d);
    let n = i64::try_from(forest.segments_at(d.level())).unwrap_or(0);
    let corner = |u: i64, v: i64| point(local.lattice2([2 * n * u, 2 * n * v]));
    Square { a: corner(0, 0), b: corner(1, 1), lower: corner(1, 0), upper: local.upper.then(|| corner(0, 1)) }
}

/// The half of a diamond that a parent of it gets: 0 is the one below its hypotenuse.
#[must_use]
pub fn half_of(forest: &Forest, child: Diamond, parent: Diamond) -> usize {
    let lower = square(forest, child).lower;
    usize::from([lower.x, lower.y] != parent.centre())
}

/// The two micro-triangles of a cell of the lattice, given its south-west corner.
fn halves_of_cell(x: u32, y: u32) -> [[[u32; 2]; 3]; 2] {
    let [sw, se, ne, nw] = [[x, y], [x + 1, y], [x + 1, y + 1], [x, y + 1]];
    if (x + y).is_multiple_of(2) { [[sw, se, ne], [sw, ne, nw]] } else { [[sw, se, nw], [se, ne, nw]] }
}

/// The source's own mesh of a diamond's square: all micro-triangles of the lattice whose corners have heights. For
/// diamonds of an even level, and of an odd one at least two cells across.
#[must_use]
pub fn source(forest: &Forest, d: Diamond, ground: Ground<'_>) -> Merged {
    let square = square(forest, d);
    let [low, high] = forest.bounds(d);
    let even = d.level().is_multiple_of(2);
    let columns = (high[0] - low[0] + 1) as usize;
    let mut numbers = vec![NONE; columns * (high[1] - low[1] + 1) as usize];
    let mut merged = Merged { is_source: true, ..Merged::default() };
    // Of an odd level's box half.
    let cells = (columns - 1) * (high[1] - low[1]) as usize;
    merged.patch.triangles.reserve(if even { 2 * cells } else { cells });
    merged.patch.vertices.reserve(if even { numbers.len() } else { numbers.len() * 5 / 8 });
    let inside = |corners: [[u32; 2]; 3]| {
        // The sum of the three corners, against three times each side.
        let (x, y) = (corners.iter().map(|c| c[0]).sum(), corners.iter().map(|c| c[1]).sum());
        let thrice = |v: Vertex| Vertex { x: 3 * v.x, y: 3 * v.y, height: 0 };
        let middle = Vertex { x, y, height: 0 };
        square.contains(middle, thrice)
    };
    for y in low[1]..high[1] {
        for x in low[0]..high[0] {
            for corners in halves_of_cell(x, y) {
                let heights = corners.map(|[x, y]| ground.at(x, y));
                if heights.contains(&NODATA) || !(even || inside(corners)) {
                    continue;
                }
                merged.patch.triangles.push(std::array::from_fn(|i| {
                    let [x, y] = corners[i];
                    let slot = &mut numbers[(y - low[1]) as usize * columns + (x - low[0]) as usize];
                    if *slot == NONE {
                        *slot = u32::try_from(merged.patch.vertices.len()).unwrap_or(NONE);
                        merged.patch.vertices.push(Vertex { x, y, height: heights[i] });
                    }
                    *slot
                }));
            }
        }
    }
    merged.errors = vec![0.0; merged.patch.triangles.len()];
    merged
}

/// Merges the meshes of the four triangles of a diamond's split, side by side as they are numbered.
#[must_use]
pub fn merge(forest: &Forest, d: Diamond, tins: [&Tin; 4]) -> Merged {
    let square = square(forest, d);
    let [x, y] = d.centre();
    let centre = Vertex { x, y, height: 0 };
    let mut merged = Merged::default();
    merged.patch.vertices.reserve(tins.iter().map(|t| t.vertices.len()).sum());
    merged.patch.triangles.reserve(tins.iter().map(|t| t.triangles.len()).sum());
    let mut shared: HashMap<[u32; 2], u32> = HashMap::new();
    for (i, tin) in tins.into_iter().enumerate() {
        let numbers: Vec<u32> = tin
            .vertices
            .iter()
            .enumerate()
            .map(|(i, v)| {
                let next = u32::try_from(merged.patch.vertices.len()).unwrap_or(NONE);
                // Two lines through the centre part the four.
                let is_shared = turn(square.a, centre, *v) == 0 || turn(square.lower, centre, *v) == 0;
                let number = if is_shared { *shared.entry([v.x, v.y]).or_insert(next) } else { next };
                let untouched = tin.untouched.get(i).copied().unwrap_or(false);
                if number != next {
                    merged.untouched[number as usize] &= untouched;
                } else {
                    merged.patch.vertices.push(*v);
                    merged.untouched.push(untouched);
                    // What lies on a side has other triangles around it now.
                    merged.needs.push(tin.needs.get(i).copied().filter(|_| !is_shared).unwrap_or(0));
                }
                number
            })
            .collect();
        let renumber = |v: &u32| numbers[*v as usize];
        let triangle = |[a, b, c]: &[u32; 3]| [renumber(a), renumber(b), renumber(c)];
        merged.patch.triangles.extend(tin.triangles.iter().map(triangle));
        merged.errors.extend_from_slice(&tin.errors);
        merged.patch.ends[i] = u32::try_from(merged.patch.triangles.len()).unwrap_or(NONE);
        merged
            .borders
            .extend(tin.borders.iter().map(|(edge, points)| (edge.each_ref().map(renumber), points.clone())));
    }
    if merged.errors.len() < merged.patch.triangles.len() {
        merged.errors.clear();
    }
    merged
}

/// Simplifies the mesh of a diamond and cuts it along the hypotenuse.
#[must_use]
pub fn simplify(forest: &Forest, d: Diamond, merged: &Merged, rules: &Rules, until: Until<'_>) -> Simplified {
    if merged.patch.triangles.is_empty() {
        return Simplified::default();
    }
    let square = square(forest, d);
    let is_lossless = |ground: &Ground<'_>| merged.is_source && keeps(forest, d, *ground);
    let mut simplified = if matches!(&until, Until::Error { ground, vertical: 0.0, .. } if is_lossless(ground))
    {
        // Nothing is lost, and nothing is known of what any vertex needs.
        let count = merged.patch.vertices.len();
        let (needs, untouched) = (vec![0; count], vec![true; count]);
        let told = Told { errors: &merged.errors, needs: &needs, untouched: &untouched };
        let triangles = merged.patch.triangles.iter().copied().enumerate();
        let live = merged.patch.triangles.len();
        let (halves, _) = cut(&merged.patch.vertices, live, triangles, &told, &square);
        Simplified { halves, apart: merged.lost, vertical: Some(0.0) }
    } else {
        collapsed(merged, square, rules, until)
    };
    for half in &mut simplified.halves {
        half.lost = merged.lost;
        if half.triangles.len() > rules.triangles_max || half.vertices.len() > rules.vertices_max {
            *half = with_room(half, rules);
            // Wherever something was, something is no farther than the diamond is wide.
            half.lost = length(between(&rules.scale, square.a, square.b));
            simplified.apart = simplified.apart.max(half.lost);
        }
    }
    if let Some(vertical) = &mut simplified.vertical {
        let all = simplified.halves.iter().flat_map(|half| &half.errors);
        *vertical = all.copied().fold(0.0, f32::max).into();
    }
    simplified
}

/// Simplifies a mesh that has triangles, and cuts it along the hypotenuse. How far it is from the samples is left to be seen.
fn collapsed(merged: &Merged, square: Square, rules: &Rules, until: Until<'_>) -> Simplified {
    let patch = &merged.patch;
    let mesh = match &merged.neighbours {
        Some(neighbours) => Mesh::with_twins(&patch.vertices, &patch.triangles, neighbours.across()),
        None => Mesh::new(&patch.vertices, &patch.triangles),
    };
    let passed = find_passed(&mesh, merged);
    let before = Before {
        errors: find_errors(merged, &until),
        needs: &merged.needs,
        untouched: &merged.untouched,
        is_source: merged.is_source,
    };
    let mut simplifier = Simplifier::new(mesh, passed, before, square, rules, until);
    simplifier.run();
    let needs = if simplifier.errors.is_empty() { Vec::new() } else { simplifier.known() };
    let untouched = if merged.is_source { simplifier.untouched() } else { Vec::new() };
    let Simplifier { mesh, mut passed, errors, .. } = simplifier;
    let point = |v: u32| mesh.points[v as usize];
    let distance = |(h, points): (&u32, &Vec<[u32; 2]>)| {
        let ends = [point(mesh.origin(*h)), point(mesh.target(*h))];
        points.iter().map(|p| distance_to(&rules.scale, *p, ends)).fold(0.0, f64::max)
    };
    let apart = passed.iter().map(distance).fold(0.0, f64::max) + merged.lost;
    let told = Told { errors: &errors, needs: &needs, untouched: &untouched };
    let (mut halves, numbers) = cut(&mesh.points, mesh.live, mesh.triangles(), &told, &square);
    if !passed.is_empty() {
        let is_above = |v: &u32| turn(square.a, square.b, point(*v)) > 0;
        for h in mesh.borders() {
            if let Some(points) = passed.remove(&h) {
                let i = usize::from(mesh.corners(triangle(h)).iter().any(is_above));
                let edge = [mesh.origin(h), mesh.target(h)].map(|v| numbers[i][v as usize]);
                halves[i].borders.push((edge, points));
            }
        }
    }
    Simplified { halves, apart, vertical: (!errors.is_empty()).then_some(0.0) }
}

/// Of so many samples one may be in a plane for the source's own mesh to be left as it is where nothing may be lost: told as a
/// whole lattice it takes fewer bytes than what would be left of it, and no time.
const FLAT_SHARE: usize = 8;

/// The lattice points of a diamond's square.
fn points(forest: &Forest, d: Diamond, square: Square) -> impl Iterator<Item = [u32; 2]> {
    let [low, high] = forest.bounds(d);
    let is_box = d.level().is_multiple_of(2);
    let all = (low[1]..=high[1]).flat_map(move |y| (low[0]..=high[0]).map(move |x| [x, y]));
    all.filter(move |[x, y]| is_box || square.contains(Vertex { x: *x, y: *y, height: 0 }, |corner| corner))
}

/// Whether the source's own mesh of a diamond is left as it is where nothing may be lost.
fn keeps(forest: &Forest, d: Diamond, ground: Ground<'_>) -> bool {
    let square = square(forest, d);
    let [low, high] = forest.bounds(d);
    let (mut all, mut flat) = (0, 0);
    for [x, y] in points(forest, d, square) {
        let height = ground.at(x, y);
        if height == NODATA {
            return false;
        }
        all += 1;
        // Whoever asks finds the same: nothing beyond the square's box is looked at.
        let is_inner = (low[0] < x && x < high[0]) && (low[1] < y && y < high[1]);
        flat += usize::from(is_inner && ground.may_be_plane(Vertex { x, y, height }));
    }
    square.upper.is_some() && (flat <= all / FLAT_SHARE || stays(forest, d, ground))
}

/// Whether it is sure that nothing goes of the source's own mesh of a diamond, where nothing may be lost: it is a whole
/// square, there is no gap, and no vertex has flat surroundings.
fn stays(forest: &Forest, d: Diamond, ground: Ground<'_>) -> bool {
    let square = square(forest, d);
    let vertices = || points(forest, d, square).map(|[x, y]| Vertex { x, y, height: ground.at(x, y) });
    let may_go = |v: &Vertex| ground.may_be_plane(*v) && square.role(*v) != Role::Locked;
    // First without any gap: surroundings are of heights.
    square.upper.is_some()
        && vertices().all(|v| v.height != NODATA)
        && !vertices().filter(may_go).any(|v| is_flat(v, ground))
}

/// The mesh of a diamond all of whose children have the source's own, if that is left as it is where nothing may be lost.
/// `known`: of which children that has been found out; `lattices`: what has been made.
#[must_use]
pub fn lattice(
    forest: &Forest,
    d: Diamond,
    ground: Ground<'_>,
    known: &mut HashMap<Diamond, bool>,
    lattices: &mut Lattices,
) -> Option<Merged> {
    for child in forest.children(d).into_iter().flatten() {
        if !*known.entry(child).or_insert_with(|| keeps(forest, child, ground)) {
            return None;
        }
    }
    let (patch, neighbours) = lattices.patch(forest, d, |[x, y]| ground.at(x, y))?;
    let count = patch.vertices.len();
    Some(Merged {
        errors: vec![0.0; patch.triangles.len()],
        needs: vec![0; count],
        untouched: vec![true; count],
        neighbours: Some(neighbours),
        is_whole: true,
        patch,
        ..Merged::default()
    })
}

/// Whether the surroundings of a vertex of the source's mesh are a plane, given that they [may be](Ground::may_be_plane) and
/// have heights.
fn is_flat(v: Vertex, ground: Ground<'_>) -> bool {
    let rise = |x: i32, y: i32| ground.at(v.x.wrapping_add_signed(x), v.y.wrapping_add_signed(y)) - v.height;
    let slopes = [rise(1, 0), rise(0, 1)];
    let goes_on = |x: i32, y: i32| rise(x, y) == slopes[0] * x + slopes[1] * y;
    // Diagonals meet in every second vertex.
    let has_diagonals = (v.x + v.y).is_multiple_of(2);
    !has_diagonals || [-1, 1].into_iter().all(|x| goes_on(x, -1) && goes_on(x, 1))
}

/// How far samples are from each triangle, in quanta: measured where that is asked and not known.
fn find_errors(merged: &Merged, until: &Until<'_>) -> Vec<f32> {
    let (Until::Within { ground, .. } | Until::Error { ground, .. }) = until else { return Vec::new() };
    if !merged.errors.is_empty() {
        return merged.errors.clone();
    }
    let corners = merged.patch.triangles.iter().map(|t| t.map(|v| merged.patch.vertices[v as usize]));
    corners.map(|t| at_least(ground.distance(t, f64::INFINITY))).collect()
}

/// The largest triangles of a half, as many as there may be. Only where nodata tears the ground to shreds can there be
/// more that nothing but borders holds.
fn with_room(half: &Tin, rules: &Rules) -> Tin {
    let area = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|v| half.vertices[v as usize]);
        turn(a, b, c)
    };
    let mut order: Vec<usize> = (0..half.triangles.len()).collect();
    order.sort_by_key(|i| (std::cmp::Reverse(area(&half.triangles[*i])), *i));
    let mut kept = Tin::default();
    let mut numbers = vec![NONE; half.vertices.len()];
    for i in order {
        let t = half.triangles[i];
        let fresh = t.iter().filter(|v| numbers[**v as usize] == NONE).count();
        if kept.triangles.len() == rules.triangles_max || kept.vertices.len() + fresh > rules.vertices_max {
            break;
        }
        kept.errors.extend(half.errors.get(i));
        kept.triangles.push(t.map(|v| {
            let number = &mut numbers[v as usize];
            if *number == NONE {
                *number = u32::try_from(kept.vertices.len()).unwrap_or(NONE);
                kept.vertices.push(half.vertices[v as usize]);
            }
            *number
        }));
    }
    let edges: HashSet<[u32; 2]> =
        kept.triangles.iter().flat_map(|t| (0..3).map(|i| [t[i], t[(i + 1) % 3]])).collect();
    for (edge, points) in &half.borders {
        let edge = edge.map(|v| numbers[v as usize]);
        if edges.contains(&edge) {
            kept.borders.push((edge, points.clone()));
        }
    }
    kept
}

/// The half-edges of the borders that stand for more than themselves.
fn find_passed(mesh: &Mesh, merged: &Merged) -> Passed {
    let mut passed = Passed::new();
    if merged.borders.is_empty() {
        return passed;
    }
    // By place: where triangles touch in a point alone, the mesh has other numbers.
    let place = |v: u32| [mesh.points[v as usize].x, mesh.points[v as usize].y];
    let ends = |edge: [u32; 2]| {
        edge.map(|v| [merged.patch.vertices[v as usize].x, merged.patch.vertices[v as usize].y])
    };
    let mut by_ends: HashMap<[[u32; 2]; 2], &Vec<[u32; 2]>> =
        merged.borders.iter().map(|(edge, points)| (ends(*edge), points)).collect();
    for h in mesh.borders() {
        if let Some(points) = by_ends.remove(&[place(mesh.origin(h)), place(mesh.target(h))]) {
            passed.insert(h, points.clone());
        }
    }
    passed
}

/// What is told of triangles and vertices, by their numbers; or nothing.
struct Told<'a> {
    errors: &'a [f32],
    needs: &'a [u16],
    untouched: &'a [bool],
}

/// Cuts so many triangles, each given with its number, along the hypotenuse. With the numbers of the vertices in each half.
fn cut(
    points: &[Vertex],
    live: usize,
    triangles: impl Iterator<Item = (usize, [u32; 3])>,
    told: &Told<'_>,
    square: &Square,
) -> ([Tin; 2], [Vec<u32>; 2]) {
    let mut halves = [Tin::default(), Tin::default()];
    let mut numbers = [vec![NONE; points.len()], vec![NONE; points.len()]];
    let is_above: Vec<bool> = points.iter().map(|v| turn(square.a, square.b, *v) > 0).collect();
    for half in &mut halves {
        // Each has about half of the triangles, and half as many vertices.
        half.triangles.reserve(live / 2);
        half.errors.reserve(told.errors.len().min(live / 2));
        half.vertices.reserve(live * 5 / 16);
        half.needs.reserve(told.needs.len().min(live * 5 / 16));
        half.untouched.reserve(told.untouched.len().min(live * 5 / 16));
    }
    for (number, t) in triangles {
        let i = usize::from(t.map(|v| is_above[v as usize]).contains(&true));
        let (half, numbers) = (&mut halves[i], &mut numbers[i]);
        if let Some(error) = told.errors.get(number) {
            half.errors.push(*error);
        }
        let mut named = [NONE; 3];
        for (name, v) in named.iter_mut().zip(t) {
            let number = &mut numbers[v as usize];
            if *number == NONE {
                *number = u32::try_from(half.vertices.len()).unwrap_or(NONE);
                half.vertices.push(points[v as usize]);
                half.needs.extend(told.needs.get(v as usize));
                half.untouched.extend(told.untouched.get(v as usize));
            }
            *name = *number;
        }
        half.triangles.push(named);
    }
    (halves, numbers)
}

#[cfg(test)]
mod tests {
    use super::super::tests::Field;
    use super::super::{Metric, Scale};
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Few heights, so that some squares have a vertex in a plane and some have not; or a gap.
        #[test]
        fn what_stays_is_cut_as_a_mesh_would_be(
            heights in prop::collection::vec(0..4, 17 * 17),
            gap in prop::option::of(0usize..17 * 17),
            slope in 0..3,
        ) {
            let forest = Forest::new(4, 2, [1, 1]).unwrap();
            let field = Field::new(forest, |x, y| {
                let i = (17 * y + x) as usize;
                if gap == Some(i) { NODATA } else { heights[i] + slope * x.cast_signed() }
            });
            let scale = Scale { cell: [30.0, 20.0], quantum: 1.0 };
            let rules =
                Rules { metric: Metric::Normal, lambda: 1.0, scale, triangles_max: 4096, vertices_max: 4096 };
            let until = Until::Error { ground: field.ground(), vertical: 0.0, border: 0.0 };
            for d in (1..=forest.levels()).flat_map(|level| forest.diamonds(level)) {
                let merged = source(&forest, d, field.ground());
                let square = square(&forest, d);
                if stays(&forest, d, field.ground()) {
                    let expected = collapsed(&merged, square, &rules, until);
                    prop_assert_eq!(simplify(&forest, d, &merged, &rules, until), expected);
                }
            }
        }
    }
}

//! A set of points on a square grid, and the one triangulation that it implies.
//!
//! A bitree keeps the heights of *real* points only. A real point is the middle of the hypotenuse of one or
//! two triangles of the bintree, and those must be there to be split at it; so must the triangles that
//! they come from, whose own middles are then present as *fictitious* points, with the mean height of the
//! two ends. Nothing else is split: a fictitious point splits the triangle that needs it and not the one
//! across, and since it lies exactly on the other's hypotenuse there is no gap between them. Levels of
//! neighbours may differ by any number.
//!
//! The trick: a triangle is split if and only if it or some triangle below it has a real middle. So
//! the whole structure is one count a triangle, of such triangles at or below it. Adding a point
//! adds 1 along the paths to its one or two triangles, removing it takes that away again: the way back is
//! exact, whatever else was added in between. A whole selection at once is counted from the finest
//! triangles up, in one pass.
//!
//! This is the unrestricted hierarchical triangulation of the bitree paper (dependencies of real and
//! fictitious points, its section 2.2). Heights are `f64`: a mean halves, so sums of 24-bit heights over
//! the 24 levels at most stay exact, and the same everywhere.
//!
//! [`Bitree::triangles`] lists triangles, [`Bitree::triangles_closed`] also those that close T-junctions;
//! [`strip`] has the references of a triangle strip.

pub mod strip;

mod mesh;

pub use mesh::Corner;

use crate::bintree::Point;
use std::ops::ControlFlow;

/// The largest grid: 2^12 + 1 points a side; 134 MB of counts and as much of heights.
pub const LOG2_MAX: u8 = 12;

/// What a grid point is in a bitree.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Presence {
    /// No triangle has it as a corner.
    Absent,
    /// Needed by some triangle; its height is deduced.
    Fictitious,
    /// Selected; its height is its own.
    Real,
}

/// Points selected from a grid of (2^k + 1)^2, with the triangulation that they imply. Takes 16 bytes a
/// point of the grid, selected or not.
#[derive(Debug, Clone)]
pub struct Bitree {
    log2: u8,
    /// Height of each real point, row by row, NaN for the others; the corners are always real.
    real: Vec<f64>,
    /// By path: triangles at or below with a real middle.
    below: Vec<u32>,
}

/// A triangle of the hierarchy with the heights that the bitree's surface has at its corners, whether it
/// is drawn, split or part of a larger one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Facet {
    path: u32,
    corners: [Point; 3],
    heights: [f64; 3],
}

impl Facet {
    /// The triangle with these corners, turning left, apex in the middle, of a grid of 2^`log2` cells a side, if its corners
    /// are so high; `None` if it is none of that grid's. Costs one step a level.
    #[must_use]
    pub fn new(log2: u8, corners: [Point; 3], heights: [f64; 3]) -> Option<Self> {
        if log2 > LOG2_MAX || corners.iter().flatten().any(|w| *w > 1 << log2) {
            return None;
        }
        let [a, c, b] = corners;
        // The square of the hypotenuse halves from level to level.
        let square = a[0].abs_diff(b[0]).pow(2) + a[1].abs_diff(b[1]).pow(2);
        let level = (2 * u32::from(log2) + 1).checked_sub(square.checked_ilog2()?)?;
        let (path, at) = descend(log2, inside([a, c, b]), level);
        (at == corners).then_some(Self { path, corners, heights })
    }

    /// Its corners, turning left, apex in the middle.
    #[must_use]
    pub fn corners(&self) -> [Point; 3] {
        self.corners
    }

    /// The heights of its corners, in the same order.
    #[must_use]
    pub fn heights(&self) -> [f64; 3] {
        self.heights
    }

    /// The number of splits from the half of the grid to here.
    #[must_use]
    pub fn level(&self) -> u32 {
        self.path.ilog2() - 1
    }

    /// A number that tells it from all others of its grid: from 2, below 4 * 4^k.
    #[must_use]
    pub fn path(&self) -> u32 {
        self.path
    }

    /// The middle of the hypotenuse; of the finest triangles, which have none on the grid, their corner.
    #[must_use]
    pub fn middle(&self) -> Point {
        middle(self.corners)
    }

    /// The mean height of the hypotenuse's two ends.
    fn mean(&self) -> f64 {
        let [ha, _, hb] = self.heights;
        (ha + hb) / 2.0
    }

    /// Its left or right half, if it is split at its middle `m`, which is so high.
    fn half(&self, is_right: bool, m: Point, height: f64) -> Self {
        let (path, corners) = split(self.path, self.corners, m)[usize::from(is_right)];
        Self { path, corners, heights: half_heights(is_right, self.heights, height) }
    }
}

impl Bitree {
    /// The two root triangles of a grid of 2^`log2` cells a side; `corners` are the heights at south-west,
    /// south-east, north-east and north-west. `None` unless `log2` is 1 to [`LOG2_MAX`] and the heights are
    /// numbers.
    #[must_use]
    pub fn new(log2: u8, corners: [f64; 4]) -> Option<Self> {
        if !(1..=LOG2_MAX).contains(&log2) || corners.iter().any(|h| h.is_nan()) {
            return None;
        }
        let side = 1u32 << log2;
        let points = (side as usize + 1).pow(2);
        let mut bitree = Self { log2, real: vec![f64::NAN; points], below: vec![0; 2 << (2 * log2)] };
        for (point, height) in bitree.outermost().into_iter().zip(corners) {
            let slot = bitree.slot(point);
            bitree.real[slot] = height;
        }
        Some(bitree)
    }

    /// A whole selection at once: the heights of all points of the grid, rows from the south, NaN where a
    /// point is not selected. The same as adding them one by one, in time proportional to the grid. `None`
    /// unless `log2` is 1 to [`LOG2_MAX`], there are (2^`log2` + 1)^2 heights and the corners are selected.
    #[must_use]
    pub fn of(log2: u8, heights: Vec<f64>) -> Option<Self> {
        let points = ((1usize << log2.min(LOG2_MAX)) + 1).pow(2);
        if !(1..=LOG2_MAX).contains(&log2) || heights.len() != points {
            return None;
        }
        let mut bitree = Self { log2, real: heights, below: vec![0; 2 << (2 * log2)] };
        if bitree.outermost().iter().any(|p| bitree.real[bitree.slot(*p)].is_nan()) {
            return None;
        }
        for root in bitree.roots() {
            let [a, c, _] = root.corners.map(|corner| bitree.slot(corner).cast_signed());
            let middle = bitree.slot(root.middle());
            bitree.recount(root.path, middle, c - middle.cast_signed(), a - middle.cast_signed());
        }
        Some(bitree)
    }

    /// Counts the real middles at and below a triangle: by the slot of its middle and the steps in slots from there to its
    /// apex c and to the end a of its hypotenuse.
    fn recount(&mut self, path: u32, middle: usize, to_apex: isize, to_end: isize) -> u32 {
        let is_real = |real: &[f64], middle: usize| u32::from(!real[middle].is_nan());
        let mut count = is_real(&self.real, middle);
        let [first, last] = [path as usize, self.below.len()];
        if 2 * first < last {
            let [to_left, to_right] = [(to_apex + to_end) / 2, (to_apex - to_end) / 2];
            let [left, right] = [to_left, to_right].map(|step| middle.wrapping_add_signed(step));
            let halves = if 4 * first < last {
                [
                    self.recount(path << 1, left, -to_left, to_right),
                    self.recount(path << 1 | 1, right, -to_right, -to_left),
                ]
            } else {
                // Half of all triangles are those without any below: here, without a call for each.
                let halves = [left, right].map(|middle| is_real(&self.real, middle));
                self.below[2 * first..2 * first + 2].copy_from_slice(&halves);
                halves
            };
            count += halves[0] + halves[1];
        }
        self.below[first] = count;
        count
    }

    /// Base-2 logarithm of the cells along a side.
    #[must_use]
    pub fn log2(&self) -> u8 {
        self.log2
    }

    /// Cells along a side.
    #[must_use]
    pub fn side(&self) -> u32 {
        1 << self.log2
    }

    /// South-west, south-east, north-east, north-west.
    fn outermost(&self) -> [Point; 4] {
        outermost(self.log2)
    }

    fn slot(&self, [x, y]: Point) -> usize {
        y as usize * (self.side() as usize + 1) + x as usize
    }

    fn inside(&self, [x, y]: Point) -> bool {
        x <= self.side() && y <= self.side()
    }

    /// The level of a point: 0 for the corners, else one more than that of the triangles it is the middle
    /// of. `None` outside of the grid.
    #[must_use]
    pub fn level(&self, point: Point) -> Option<u32> {
        self.inside(point).then(|| level(self.log2, point))
    }

    /// Selects a point. Gives back the height it had, if it was real already. A point outside of the grid
    /// and a height that is no number change nothing.
    pub fn add(&mut self, point: Point, height: f64) -> Option<f64> {
        if !self.inside(point) || height.is_nan() {
            return None;
        }
        let slot = self.slot(point);
        let before = std::mem::replace(&mut self.real[slot], height);
        if before.is_nan() {
            self.count(self.around(point), 1);
            return None;
        }
        Some(before)
    }

    /// Takes a point out of the selection; gives back its height. The corners stay.
    pub fn remove(&mut self, point: Point) -> Option<f64> {
        let height = self.real(point).filter(|_| self.level(point) != Some(0))?;
        let around = self.around(point);
        let slot = self.slot(point);
        self.real[slot] = f64::NAN;
        self.count(around, u32::MAX);
        Some(height)
    }

    /// Adds `change` (modulo 2^32) along the paths to triangles.
    fn count(&mut self, to: [Option<Facet>; 2], change: u32) {
        for facet in to.into_iter().flatten() {
            let mut path = facet.path;
            while path > 1 {
                let count = &mut self.below[path as usize];
                *count = count.wrapping_add(change);
                path >>= 1;
            }
        }
    }

    /// The one or two triangles that have the point as their middle, whether they are drawn or not; none for
    /// the corners and outside of the grid. Costs one step a level.
    #[must_use]
    pub fn around(&self, point: Point) -> [Option<Facet>; 2] {
        let Some([a, b]) = hypotenuse(self.log2, point) else { return [None; 2] };
        let level = level(self.log2, point) - 1;
        // Seen from the middle, the apex lies where the end a does, turned left by a quarter.
        let [x, y] = point;
        let apex = |a: Point| [(x + y).wrapping_sub(a[1]), (y + a[0]).wrapping_sub(x)];
        // First the triangle to the east, or else to the north.
        let is_first = (y, a[0]) > (a[1], x);
        let ways = if is_first { [[a, b], [b, a]] } else { [[b, a], [a, b]] };
        ways.map(|[a, b]| {
            let corners = [a, apex(a), b];
            self.inside(corners[1]).then(|| self.facet(descend(self.log2, inside(corners), level).0))?
        })
    }

    /// The two halves of the grid.
    #[must_use]
    pub fn roots(&self) -> [Facet; 2] {
        root_corners(self.log2).map(|(path, corners)| {
            let heights = corners.map(|p| self.real[self.slot(p)]);
            Facet { path, corners, heights }
        })
    }

    /// The triangle of a path, see [`Facet::path`]; `None` out of its range. Costs one step a level.
    #[must_use]
    pub fn facet(&self, path: u32) -> Option<Facet> {
        if path < 2 || path as usize >= 2 * self.below.len() {
            return None;
        }
        let level = path.ilog2() - 1;
        let mut facet = self.roots()[(path >> level & 1) as usize];
        for step in (0..level).rev() {
            let (m, height) = self.middle(&facet);
            facet = facet.half(path >> step & 1 == 1, m, height);
        }
        Some(facet)
    }

    /// What a triangle splits into, left then right, whether it is split or not. Not for the finest ones,
    /// of level 2 k, which have no middle on the grid.
    #[must_use]
    pub fn halves(&self, facet: &Facet) -> [Facet; 2] {
        let (m, height) = self.middle(facet);
        [false, true].map(|is_right| facet.half(is_right, m, height))
    }

    /// The middle of a triangle's hypotenuse, and how high it is if the triangle is split: its own height, or the mean of
    /// the two ends.
    fn middle(&self, facet: &Facet) -> (Point, f64) {
        let m = facet.middle();
        let own = self.real[self.slot(m)];
        (m, if own.is_nan() { facet.mean() } else { own })
    }

    /// Whether there is a real point at its middle or strictly below.
    #[must_use]
    pub fn is_split(&self, facet: &Facet) -> bool {
        self.below.get(facet.path as usize).is_some_and(|count| *count > 0)
    }

    /// The triangles that are drawn, of those at or below one: calls `visit` with each, until it breaks.
    /// Costs one step a triangle.
    pub fn leaves(&self, from: &Facet, visit: &mut impl FnMut(&Facet) -> ControlFlow<()>) -> ControlFlow<()> {
        if !self.is_split(from) {
            return visit(from);
        }
        for half in self.halves(from) {
            self.leaves(&half, visit)?;
        }
        ControlFlow::Continue(())
    }

    /// The height of a real point.
    #[must_use]
    pub fn real(&self, point: Point) -> Option<f64> {
        let height = *self.real.get(self.slot(point)).filter(|_| self.inside(point))?;
        (!height.is_nan()).then_some(height)
    }

    /// What a point is. Costs one step a level.
    #[must_use]
    pub fn presence(&self, point: Point) -> Presence {
        if self.real(point).is_some() {
            Presence::Real
        } else if self.around(point).into_iter().flatten().any(|t| self.is_split(&t)) {
            Presence::Fictitious
        } else {
            Presence::Absent
        }
    }

    /// The height of a point that is present: its own, or the mean of the ends of its hypotenuse.
    #[must_use]
    pub fn height(&self, point: Point) -> Option<f64> {
        match self.presence(point) {
            Presence::Absent => None,
            Presence::Real => self.real(point),
            Presence::Fictitious => self.around(point).into_iter().flatten().next().map(|facet| facet.mean()),
        }
    }
}

/// What was selected is the same; counts follow from it.
impl PartialEq for Bitree {
    fn eq(&self, other: &Self) -> bool {
        let bits = |tree: &Self| tree.real.iter().map(|h| h.to_bits()).collect::<Vec<_>>();
        self.log2 == other.log2 && bits(self) == bits(other) && self.below == other.below
    }
}

/// The level of a point of a grid of 2^`log2` cells a side: see [`Bitree::level`].
#[must_use]
pub fn level(log2: u8, [x, y]: Point) -> u32 {
    let zeros = (x | y).trailing_zeros().min(u32::from(log2));
    let up = u32::from(log2) - zeros;
    // On the lattice of squares of 2^zeros cells: centres of larger squares, or middles of their sides.
    let both_odd = (x >> zeros) & (y >> zeros) & 1 == 1;
    if up == 0 { 0 } else { 2 * up - u32::from(both_odd) }
}

/// The ends of the hypotenuse in whose middle a point of a grid of 2^`log2` cells a side stands; `None` for the grid's
/// corners and outside of it.
#[must_use]
pub fn hypotenuse(log2: u8, [x, y]: Point) -> Option<[Point; 2]> {
    if x.max(y) > 1 << log2 || level(log2, [x, y]) == 0 {
        return None;
    }
    let zeros = (x | y).trailing_zeros();
    let step = 1u32 << zeros;
    let is_odd = |w: u32| w >> zeros & 1 == 1;
    Some(match (is_odd(x), is_odd(y)) {
        (true, false) => [[x - step, y], [x + step, y]],
        (false, _) => [[x, y - step], [x, y + step]],
        // Diagonals of neighbouring squares meet in the centres of those twice as large.
        (true, true) if (x >> (zeros + 1) ^ y >> (zeros + 1)) & 1 == 0 => {
            [[x - step, y - step], [x + step, y + step]]
        }
        (true, true) => [[x - step, y + step], [x + step, y - step]],
    })
}

/// South-west, south-east, north-east, north-west of a grid of 2^`log2` cells a side.
fn outermost(log2: u8) -> [Point; 4] {
    let side = 1 << log2;
    [[0, 0], [side, 0], [side, side], [0, side]]
}

/// Path and corners of both halves of a grid of 2^`log2` cells a side.
fn root_corners(log2: u8) -> [(u32, [Point; 3]); 2] {
    let [sw, se, ne, nw] = outermost(log2);
    [(2, [sw, se, ne]), (3, [ne, nw, sw])]
}

/// A place in a triangle, halfway between its apex and its middle, in quarters of cells.
fn inside([a, c, b]: [Point; 3]) -> [i32; 2] {
    [0, 1].map(|i| (a[i] + 2 * c[i] + b[i]).cast_signed())
}

/// Path and corners of the triangle of a level that has a place, in quarters of cells, strictly inside.
fn descend(log2: u8, place: [i32; 2], level: u32) -> (u32, [Point; 3]) {
    let [lower, upper] = root_corners(log2);
    let (mut path, mut at) = if place[0] > place[1] { lower } else { upper };
    for _ in 0..level {
        let m = middle(at);
        (path, at) = split(path, at, m)[usize::from(!is_left(at, m, place))];
    }
    (path, at)
}

/// Whether a place, in quarters of cells, is on the left half's side of the line from a triangle's apex to its middle.
fn is_left([_, c, _]: [Point; 3], m: Point, place: [i32; 2]) -> bool {
    // Four times the grid's side at most, so products stay below 2^30.
    let [[mx, my], [cx, cy]] = [m, c].map(|p| p.map(u32::cast_signed));
    (mx - cx) * (place[1] - 4 * cy) > (my - cy) * (place[0] - 4 * cx)
}

/// Path and corners of both halves, left then right.
fn split(path: u32, [a, c, b]: [Point; 3], m: Point) -> [(u32, [Point; 3]); 2] {
    [(path << 1, [c, m, a]), (path << 1 | 1, [b, m, c])]
}

/// Heights of the corners of one half, if the middle is so high.
fn half_heights(is_right: bool, [ha, hc, hb]: [f64; 3], height: f64) -> [f64; 3] {
    if is_right { [hb, height, hc] } else { [hc, height, ha] }
}

fn middle([a, _, b]: [Point; 3]) -> Point {
    [a[0].midpoint(b[0]), a[1].midpoint(b[1])]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn flat(log2: u8) -> Bitree {
        Bitree::new(log2, [0.0; 4]).unwrap()
    }

    #[test]
    fn levels_follow_from_coordinates() {
        let bitree = flat(2);
        let rows: Vec<Vec<u32>> =
            (0..=4).map(|y| (0..=4).map(|x| bitree.level([x, y]).unwrap()).collect()).collect();
        assert_eq!(
            rows,
            [[0, 4, 2, 4, 0], [4, 3, 4, 3, 4], [2, 4, 1, 4, 2], [4, 3, 4, 3, 4], [0, 4, 2, 4, 0]]
        );
        assert_eq!(bitree.level([5, 0]), None);
    }

    #[test]
    fn a_real_point_needs_its_apexes_and_a_fictitious_one_only_the_side_that_needs_it() {
        // The middle of a level-3 hypotenuse: its two apexes, of level 2 and 1, and what those need.
        let mut bitree = flat(3);
        bitree.add([1, 2], 7.0);
        // Its apexes.
        assert_eq!(bitree.presence([0, 2]), Presence::Fictitious);
        assert_eq!(bitree.presence([2, 2]), Presence::Fictitious);
        // What those need on this side, and on no other.
        assert_eq!(bitree.presence([4, 4]), Presence::Fictitious);
        assert_eq!(bitree.presence([0, 4]), Presence::Fictitious);
        assert_eq!(bitree.presence([4, 0]), Presence::Absent, "a restricted quadtree would need it");
        assert_eq!(bitree.presence([1, 2]), Presence::Real);
    }

    #[test]
    fn hypotenuses_are_those_of_the_triangles_around() {
        let mut bitree = flat(4);
        for (point, height) in [([8, 8], 3.0), ([4, 12], -7.0), ([5, 0], 11.0), ([16, 8], 6.0)] {
            bitree.add(point, height);
        }
        for point in (0..=16).flat_map(|y| (0..=16).map(move |x| [x, y])) {
            let facets: Vec<Facet> = bitree.around(point).into_iter().flatten().collect();
            assert_eq!(hypotenuse(4, point).is_some(), !facets.is_empty(), "{point:?}");
            for facet in facets {
                let [a, _, b] = facet.corners();
                let ends = hypotenuse(4, point).unwrap();
                assert!(ends == [a, b] || ends == [b, a], "{point:?}: {ends:?}");
            }
        }
        assert_eq!(hypotenuse(4, [17, 3]), None);
    }

    #[test]
    fn triangles_are_found_by_their_corners_and_others_are_not() {
        let mut open = flat(3).roots().to_vec();
        while let Some(facet) = open.pop() {
            let [a, c, b] = facet.corners();
            assert_eq!(Facet::new(3, [a, c, b], facet.heights()), Some(facet));
            assert_eq!(Facet::new(3, [b, c, a], facet.heights()), None, "turns right");
            if facet.level() < 6 {
                open.extend(flat(3).halves(&facet));
            }
        }
        assert_eq!(Facet::new(3, [[0, 1], [1, 1], [1, 2]], [0.0; 3]), None, "the other diagonal");
        assert_eq!(Facet::new(3, [[u32::MAX; 2]; 3], [0.0; 3]), None, "outside");
    }

    #[test]
    fn a_full_grid_has_two_triangles_a_cell() {
        let mut bitree = flat(3);
        for y in 0..=8 {
            for x in 0..=8 {
                bitree.add([x, y], f64::from(x * y));
            }
        }
        assert_eq!(bitree.triangles().len(), 128);
        assert_eq!(bitree.points(), (81, 0));
    }

    /// Some points of a grid, with heights.
    fn some_points(log2: u8) -> impl Strategy<Value = Vec<(Point, i32)>> {
        let side = 1u32 << log2;
        prop::collection::vec((0..=side, 0..=side, -1000i32..1000).prop_map(|(x, y, h)| ([x, y], h)), 0..40)
    }

    proptest! {
        #[test]
        fn triangles_cover_the_grid_once_and_leave_no_gap(points in some_points(5)) {
            let mut bitree = flat(5);
            for (p, h) in points { bitree.add(p, f64::from(h)); }
            let triangles = bitree.triangles();
            let area: i64 = triangles.iter().map(|t| {
                let [a, c, b] = t.map(|(p, _)| p.map(i64::from));
                (c[0] - a[0]) * (b[1] - a[1]) - (c[1] - a[1]) * (b[0] - a[0])
            }).sum();
            prop_assert_eq!(area, 2 * 32 * 32);
            // Every corner that lies on another triangle's side lies at the height of that side.
            let corners: std::collections::BTreeMap<Point, u64> = triangles.iter().flatten().map(|(p, h)| (*p, h.to_bits())).collect();
            for t in &triangles {
                for (p, h) in t { prop_assert_eq!(bitree.height(*p), Some(*h)); }
                for i in 0..3 {
                    let ((a, ha), (b, hb)) = (t[i], t[(i + 1) % 3]);
                    let steps = a[0].abs_diff(b[0]).max(a[1].abs_diff(b[1]));
                    for s in 1..steps {
                        // One step along each axis that the side runs along, forwards or backwards.
                        let along = |from: u32, to: u32| match from.cmp(&to) {
                            std::cmp::Ordering::Less => from + s,
                            std::cmp::Ordering::Equal => from,
                            std::cmp::Ordering::Greater => from - s,
                        };
                        let p = [along(a[0], b[0]), along(a[1], b[1])];
                        if let Some(h) = corners.get(&p) {
                            let side = ha + (hb - ha) * f64::from(s) / f64::from(steps);
                            prop_assert_eq!(f64::from_bits(*h), side, "{:?} on {:?} {:?}", p, a, b);
                        }
                    }
                }
            }
        }

        #[test]
        fn removing_what_was_added_gives_back_the_same(first in some_points(4), second in some_points(4)) {
            let mut bitree = flat(4);
            for (p, h) in &first { bitree.add(*p, f64::from(*h)); }
            let before = bitree.clone();
            let mut undo = Vec::new();
            for (p, h) in &second { undo.push((*p, bitree.add(*p, f64::from(*h)))); }
            for (p, old) in undo.into_iter().rev() {
                match old {
                    Some(h) => { bitree.add(p, h); }
                    None => { bitree.remove(p); }
                }
            }
            prop_assert!(bitree == before);
        }

        #[test]
        fn a_selection_at_once_is_the_same_as_point_by_point(points in some_points(4)) {
            let mut bitree = flat(4);
            let mut heights = vec![f64::NAN; 17 * 17];
            for p in bitree.outermost() { heights[bitree.slot(p)] = 0.0; }
            for (p, h) in &points {
                bitree.add(*p, f64::from(*h));
                heights[bitree.slot(*p)] = f64::from(*h);
            }
            let at_once = Bitree::of(4, heights).unwrap();
            prop_assert_eq!(at_once.triangles(), bitree.triangles());
            prop_assert!(at_once == bitree);
        }

        #[test]
        fn what_is_present_is_what_the_dependencies_say(points in some_points(4)) {
            let mut bitree = flat(4);
            for (p, h) in &points { bitree.add(*p, f64::from(*h)); }
            // The paper's rules, followed one by one: a real point needs all its apexes; a fictitious one
            // the apex of the triangle whose child needs it.
            let mut needed = std::collections::BTreeSet::new();
            for (p, _) in &points {
                for facet in bitree.around(*p).into_iter().flatten() {
                    needed.insert(*p);
                    // Its apex is the middle of the triangle that it came from, and so on up.
                    prop_assert_eq!(bitree.facet(facet.path), Some(facet));
                    prop_assert_eq!(Facet::new(4, facet.corners, facet.heights), Some(facet));
                    let mut at = bitree.roots().into_iter().find(|r| r.path == facet.path >> facet.level()).unwrap();
                    for step in (0..facet.level()).rev() {
                        needed.insert(at.middle());
                        at = bitree.halves(&at)[(facet.path >> step & 1) as usize];
                    }
                }
            }
            for y in 0..=16 { for x in 0..=16 {
                let present = bitree.presence([x, y]) != Presence::Absent;
                let corner = bitree.level([x, y]) == Some(0);
                prop_assert_eq!(present, corner || needed.contains(&[x, y]), "{} {}", x, y);
            }}
        }
    }

    #[test]
    fn impossible_grids_are_refused() {
        assert!(Bitree::new(0, [0.0; 4]).is_none());
        assert!(Bitree::new(LOG2_MAX + 1, [0.0; 4]).is_none());
        assert!(Bitree::new(1, [0.0, 0.0, f64::NAN, 0.0]).is_none(), "a corner without a height");
        assert!(Bitree::of(1, vec![0.0; 8]).is_none(), "a point too few");
        assert!(Bitree::of(1, [vec![0.0; 8], vec![f64::NAN]].concat()).is_none());
        let mut bitree = flat(1);
        assert_eq!(bitree.add([3, 0], 1.0), None);
        assert_eq!(bitree.add([1, 1], f64::NAN), None);
        assert_eq!(bitree, flat(1));
        assert_eq!(bitree.remove([0, 0]), None, "corners stay");
    }
}

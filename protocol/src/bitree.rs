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
//! exact, whatever else was added in between.
//!
//! This is the unrestricted hierarchical triangulation of the bitree paper (dependencies of real and
//! fictitious points, its section 2.2). Heights are `f64`: a mean halves, so sums of 24-bit heights over
//! the 48 levels at most stay exact, and the same everywhere.

use crate::bintree::{Forest, Point, Triangle};

/// The largest grid: 2^12 + 1 points a side, 134 MB of counts.
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

/// Points selected from a grid of (2^k + 1)^2, with the triangulation that they imply.
#[derive(Debug, Clone, PartialEq)]
pub struct Bitree {
    forest: Forest,
    side: u32,
    /// Height of each real point; the corners are always real.
    real: Vec<Option<f64>>,
    /// By path: triangles at or below with a real middle.
    below: Vec<u32>,
}

impl Bitree {
    /// The two root triangles of a grid of 2^`log2` cells a side; `corners` are the heights at south-west,
    /// south-east, north-east and north-west. `None` unless `log2` is 1 to [`LOG2_MAX`].
    #[must_use]
    pub fn new(log2: u8, corners: [f64; 4]) -> Option<Self> {
        if !(1..=LOG2_MAX).contains(&log2) {
            return None;
        }
        // A forest's patches are for streaming; for addresses any finer root does.
        let forest = Forest::single(log2);
        let side = 1u32 << log2;
        let points = (side as usize + 1).pow(2);
        let mut bitree = Self { forest, side, real: vec![None; points], below: vec![0; 2 << (2 * log2)] };
        for (point, height) in [[0, 0], [side, 0], [side, side], [0, side]].into_iter().zip(corners) {
            let slot = bitree.slot(point);
            bitree.real[slot] = Some(height);
        }
        Some(bitree)
    }

    fn slot(&self, [x, y]: Point) -> usize {
        y as usize * (self.side as usize + 1) + x as usize
    }

    fn inside(&self, [x, y]: Point) -> bool {
        x <= self.side && y <= self.side
    }

    /// The level of a point: 0 for the corners, else one more than that of the triangles it is the middle
    /// of. `None` outside of the grid.
    #[must_use]
    pub fn level(&self, [x, y]: Point) -> Option<u32> {
        if !self.inside([x, y]) {
            return None;
        }
        let zeros = (x | y).trailing_zeros().min(self.side.trailing_zeros());
        let up = self.side.trailing_zeros() - zeros;
        // On the lattice of squares of 2^zeros cells: centres of larger squares, or middles of their sides.
        let both_odd = (x >> zeros) & (y >> zeros) & 1 == 1;
        Some(if up == 0 { 0 } else { 2 * up - u32::from(both_odd) })
    }

    /// Selects a point. Gives back the height it had, if it was real already. A point outside of the grid
    /// changes nothing.
    pub fn add(&mut self, point: Point, height: f64) -> Option<f64> {
        if !self.inside(point) {
            return None;
        }
        let slot = self.slot(point);
        let before = self.real[slot].replace(height);
        if before.is_none() {
            self.count(point, 1);
        }
        before
    }

    /// Takes a point out of the selection; gives back its height. The corners stay.
    pub fn remove(&mut self, point: Point) -> Option<f64> {
        if self.level(point)? == 0 {
            return None;
        }
        let slot = self.slot(point);
        let height = self.real[slot].take()?;
        self.count(point, u32::MAX);
        Some(height)
    }

    /// Adds `change` (modulo 2^32) along the paths to the triangles that have the point as their middle.
    fn count(&mut self, point: Point, change: u32) {
        for triangle in self.around(point).into_iter().flatten() {
            let mut at = Some(triangle);
            while let Some(t) = at {
                let count = &mut self.below[path(t)];
                *count = count.wrapping_add(change);
                at = t.parent();
            }
        }
    }

    /// The one or two triangles that have the point as their middle.
    fn around(&self, point: Point) -> [Option<Triangle>; 2] {
        let mut found = [None; 2];
        let Some(level) = self.level(point).filter(|l| *l > 0) else { return found };
        let mut open: Vec<Triangle> = self.forest.root_triangles().collect();
        let mut count = 0;
        while let Some(t) = open.pop() {
            let Some(corners) = self.forest.corners(t) else { continue };
            if !covers(corners, point) {
                continue;
            }
            if t.level() + 1 < level {
                open.extend(t.children().into_iter().flatten());
            } else if middle(corners) == point && count < 2 {
                found[count] = Some(t);
                count += 1;
            }
        }
        found
    }

    fn is_split(&self, t: Triangle) -> bool {
        self.below.get(path(t)).is_some_and(|count| *count > 0)
    }

    /// What a point is.
    #[must_use]
    pub fn presence(&self, point: Point) -> Presence {
        if !self.inside(point) {
            Presence::Absent
        } else if self.real[self.slot(point)].is_some() {
            Presence::Real
        } else if self.around(point).into_iter().flatten().any(|t| self.is_split(t)) {
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
            Presence::Real => self.real[self.slot(point)],
            Presence::Fictitious => {
                let t = self.around(point).into_iter().flatten().next()?;
                let [a, _, b] = self.forest.corners(t)?;
                // The ends are corners of a triangle that is there, so they are present.
                Some((self.height(a)? + self.height(b)?) / 2.0)
            }
        }
    }

    /// The triangles, each turning left, apex in the middle; with the heights of their corners. Costs one
    /// step a triangle.
    #[must_use]
    pub fn triangles(&self) -> Vec<[(Point, f64); 3]> {
        let mut list = Vec::new();
        let mut open = Vec::new();
        for t in self.forest.root_triangles() {
            let corners = self.forest.corners(t).unwrap_or_default();
            let heights = corners.map(|p| self.real[self.slot(p)].unwrap_or(0.0));
            open.push((t, corners, heights));
        }
        while let Some((t, corners, heights)) = open.pop() {
            let ([a, c, b], [ha, hc, hb]) = (corners, heights);
            if !self.is_split(t) {
                list.push([(a, ha), (c, hc), (b, hb)]);
                continue;
            }
            let m = middle(corners);
            let hm = self.real[self.slot(m)].unwrap_or((ha + hb) / 2.0);
            if let Some([left, right]) = t.children() {
                open.push((right, [b, m, c], [hb, hm, hc]));
                open.push((left, [c, m, a], [hc, hm, ha]));
            }
        }
        list
    }

    /// How many points are real, corners included, and how many fictitious.
    #[must_use]
    pub fn points(&self) -> (usize, usize) {
        let real = self.real.iter().filter(|h| h.is_some()).count();
        let mut present: std::collections::BTreeSet<Point> = std::collections::BTreeSet::new();
        present.extend(self.triangles().into_iter().flatten().map(|(p, _)| p));
        (real, present.len() - real)
    }
}

fn path(t: Triangle) -> usize {
    usize::try_from(t.path()).unwrap_or(usize::MAX)
}

fn middle([a, _, b]: [Point; 3]) -> Point {
    [a[0].midpoint(b[0]), a[1].midpoint(b[1])]
}

/// Whether a triangle that turns left contains a point, border included.
fn covers(corners: [Point; 3], p: Point) -> bool {
    let turn = |a: Point, b: Point| {
        let d = |p: u32, q: u32| i64::from(q) - i64::from(p);
        d(a[0], b[0]) * d(a[1], p[1]) - d(a[1], b[1]) * d(a[0], p[0])
    };
    let [a, c, b] = corners;
    turn(a, c) >= 0 && turn(c, b) >= 0 && turn(b, a) >= 0
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
        fn what_is_present_is_what_the_dependencies_say(points in some_points(4)) {
            let mut bitree = flat(4);
            for (p, h) in &points { bitree.add(*p, f64::from(*h)); }
            // The paper's rules, followed one by one: a real point needs all its apexes; a fictitious one
            // the apex of the triangle whose child needs it.
            let mut needed = std::collections::BTreeSet::new();
            for (p, _) in &points {
                let mut open: Vec<Triangle> = bitree.around(*p).into_iter().flatten().collect();
                while let Some(t) = open.pop() {
                    needed.insert(middle(bitree.forest.corners(t).unwrap()));
                    // Its apex is the middle of the triangle that it came from.
                    open.extend(t.parent());
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
        let mut bitree = flat(1);
        assert_eq!(bitree.add([3, 0], 1.0), None);
        assert_eq!(bitree.remove([0, 0]), None, "corners stay");
    }
}

//! Diamonds: the triangles that share a hypotenuse, split as one and travel as one.
//!
//! A diamond is named by its centre, the middle of the hypotenuse, whose coordinates alone tell its
//! level: with `h` the largest power of two that divides both, the centre of an even level has both
//! `x/h` and `y/h` odd, that of an odd level just one. Its parents are the diamonds whose centres are
//! its own apexes, and its children those centred at the middles of its sides: the graph is arithmetic,
//! there is nothing to store.
//!
//! **The local grid.** A diamond of n segments a side has (n+1)^2 *old* points, known before it splits,
//! and n^2 *new* ones, the centres of its cells, which its split adds. In local coordinates (u, v) the
//! hypotenuse runs from `a` = (0, 0) to `b` = (n, n), and the apexes are (n, 0) and (0, n):
//!
//! ```text
//!   v                      The triangle below the diagonal always lies inside the forest; a diamond
//!   n +-----3-----b        at the border may lack the one above. Sides are numbered 0 to 3, and
//!     |         / |        triangle q of the split has side q as its hypotenuse and the diamond's
//!     4  upper/   2        centre as its apex. (In the picture they are 1 to 4.)
//!     |     /     |
//!     |   /       |        Splitting changes only points strictly inside. So a side carries the same
//!     | /  lower  |        heights in both diamonds that share it, at whatever level each stands:
//!     a-----1-----+  u     there are no cracks.
//! ```
//!
//! **Past the finest lattice** diamonds split on, as names and regions, but there are no points left to
//! add: the cells stay one sample wide, and each level halves the points of a diamond. Of an even level
//! the local grid has (m+1)^2 old points and no others; of an odd level, whose grid is turned by 45 degrees,
//! the m^2 centres of its cells are known already, like the old ones. A split only makes the points
//! strictly inside more precise, so all that holds of the lattice's levels holds of these.
//!
//! After Cignoni et al., *BDAM: Batched Dynamic Adaptive Meshes* (2003), and Gobbetti et al., *C-BDAM*
//! (2006), whose diamonds these are.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "lattice coordinates are below 2^28 and local ones at most 256: nothing is lost between u32, i64 and usize"
)]

use crate::NODATA;
use crate::bintree::{Forest, Point};

/// A diamond of a forest: a checked centre with its level.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Diamond {
    level: u8,
    y: u32,
    x: u32,
}

/// Where a diamond's local grid lies on the lattice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Local {
    /// The point (0, 0): one end of the hypotenuse.
    pub origin: [i64; 2],
    /// The lattice step of one unit of u.
    pub u: [i64; 2],
    /// The lattice step of one unit of v: `u` turned left.
    pub v: [i64; 2],
    /// Whether the triangle above the diagonal lies in the forest.
    pub upper: bool,
    n: i64,
}

impl Forest {
    /// Whether a split at `level` adds points: the centres of its cells.
    #[must_use]
    pub fn adds_points(&self, level: u32) -> bool {
        level < self.lattice_levels()
    }

    /// The diamond with this centre, or `None` where no diamond of a level that splits is centred.
    #[must_use]
    pub fn diamond(&self, [x, y]: Point) -> Option<Diamond> {
        if !self.contains([x, y]) {
            return None;
        }
        let zeros = (x | y).trailing_zeros();
        if zeros >= self.root_log2() {
            return None;
        }
        let both_odd = (x >> zeros) & (y >> zeros) & 1 == 1;
        let level = 2 * (self.root_log2() - 1 - zeros) + u32::from(!both_odd);
        (level < self.levels()).then(|| Diamond { level: u8::try_from(level).unwrap_or(u8::MAX), x, y })
    }

    /// The diamonds of level 0, one a root square, south row first.
    pub fn root_diamonds(&self) -> impl Iterator<Item = Diamond> + use<> {
        let half = 1u32 << (self.root_log2() - 1);
        let [columns, rows] = self.roots();
        (0..rows).flat_map(move |j| {
            (0..columns).map(move |i| Diamond { level: 0, x: (2 * i + 1) * half, y: (2 * j + 1) * half })
        })
    }

    /// The ends of the hypotenuse `[a, b]` and the apexes `[lower, upper]`, which may lie outside.
    fn frame(&self, d: Diamond) -> ([[i64; 2]; 2], [[i64; 2]; 2]) {
        let h = 1i64 << (self.root_log2() - 1 - u32::from(d.level) / 2);
        let (x, y) = (i64::from(d.x), i64::from(d.y));
        if d.level.is_multiple_of(2) {
            // Diagonals of the squares alternate: they join points whose coordinates, in squares, sum to
            // an even number.
            if (d.x / (2 * h as u32) + d.y / (2 * h as u32)).is_multiple_of(2) {
                ([[x - h, y - h], [x + h, y + h]], [[x + h, y - h], [x - h, y + h]])
            } else {
                ([[x + h, y - h], [x - h, y + h]], [[x + h, y + h], [x - h, y - h]])
            }
        } else if (x / h) % 2 == 1 {
            ([[x - h, y], [x + h, y]], [[x, y - h], [x, y + h]])
        } else {
            ([[x, y - h], [x, y + h]], [[x + h, y], [x - h, y]])
        }
    }

    fn inside(&self, [x, y]: [i64; 2]) -> bool {
        let [w, h] = self.size();
        (0..=i64::from(w)).contains(&x) && (0..=i64::from(h)).contains(&y)
    }

    /// The diamond's local grid. Where only one triangle lies in the forest, it is the lower one.
    #[must_use]
    pub fn local(&self, d: Diamond) -> Local {
        let ([mut a, mut b], [mut lower, mut upper]) = self.frame(d);
        if !self.inside(lower) {
            (a, b) = (b, a);
            (lower, upper) = (upper, lower);
        }
        let n = self.segments_at(d.level()) as i64;
        let u = [(lower[0] - a[0]) / n, (lower[1] - a[1]) / n];
        let v = [(b[0] - lower[0]) / n, (b[1] - lower[1]) / n];
        Local { origin: a, u, v, upper: self.inside(upper), n }
    }

    /// The diamonds whose splits give this one its triangles: none at level 0, one at the border, else two.
    pub fn parents(&self, d: Diamond) -> impl Iterator<Item = Diamond> + use<> {
        let forest = *self;
        let apexes = if d.level == 0 { None } else { Some(self.frame(d).1) };
        apexes.into_iter().flatten().filter(move |p| forest.inside(*p)).filter_map(move |p| forest.at(p))
    }

    /// The diamond centred at the middle of each side, or `None` where the side's triangle is outside of
    /// the forest or splits no further.
    #[must_use]
    pub fn children(&self, d: Diamond) -> [Option<Diamond>; 4] {
        let local = self.local(d);
        std::array::from_fn(|side| {
            if side > 1 && !local.upper {
                return None;
            }
            self.at(local.lattice2(SIDE_MIDDLES[side].map(|w| w * local.n)))
        })
    }

    fn at(&self, [x, y]: [i64; 2]) -> Option<Diamond> {
        self.diamond([u32::try_from(x).ok()?, u32::try_from(y).ok()?])
    }

    /// Lattice coordinates of the box around a diamond, clipped to the forest: south-west, north-east.
    #[must_use]
    pub fn bounds(&self, d: Diamond) -> [Point; 2] {
        let ([a, b], [c, e]) = self.frame(d);
        let [w, h] = self.size();
        let clip = |value: i64, max: u32| u32::try_from(value.clamp(0, i64::from(max))).unwrap_or(0);
        let x = [a[0], b[0], c[0], e[0]];
        let y = [a[1], b[1], c[1], e[1]];
        let least = |values: [i64; 4]| values.into_iter().fold(i64::MAX, i64::min);
        let most = |values: [i64; 4]| values.into_iter().fold(i64::MIN, i64::max);
        [[clip(least(x), w), clip(least(y), h)], [clip(most(x), w), clip(most(y), h)]]
    }

    /// Every diamond of a level, in row order. `level` below [`Forest::levels`].
    pub fn diamonds(&self, level: u32) -> impl Iterator<Item = Diamond> + use<> {
        let forest = *self;
        let h = 1u32 << (self.root_log2() - 1 - level / 2);
        let [w, height] = self.size();
        let (columns, rows) = (w / h, height / h);
        (0..=rows).flat_map(move |j| {
            (0..=columns).filter_map(move |i| {
                let fits = if level.is_multiple_of(2) { i % 2 == 1 && j % 2 == 1 } else { i % 2 != j % 2 };
                if fits { forest.diamond([i * h, j * h]).filter(|d| d.level() == level) } else { None }
            })
        })
    }

    /// The largest length of a micro-hypotenuse of triangles of a level, in metres, of a lattice with these
    /// metres of a step along x and y. Level may be [`Forest::levels`].
    ///
    /// Where the outline of what is drawn differs from the source's, it does by at most this; declared errors
    /// hold it then, so one that is smaller is an error of heights alone.
    #[must_use]
    pub fn hypotenuse(&self, level: u32, cell: [f64; 2]) -> f64 {
        let level = level.min(self.lattice_levels());
        let spacing = f64::from(1u32 << (self.root_log2() - self.patch_log2() - level / 2));
        // An odd level's cells are turned by 45 degrees: their hypotenuse lies along one axis.
        let [x, y] = cell.map(|metres| metres * spacing);
        if level.is_multiple_of(2) { x.hypot(y) } else { x.max(y) }
    }
}

/// Middles of the sides, in units of n, in doubled local coordinates.
const SIDE_MIDDLES: [[i64; 2]; 4] = [[1, 0], [2, 1], [1, 2], [0, 1]];

impl Diamond {
    /// The diamond's level: 0 for a root square.
    #[must_use]
    pub fn level(self) -> u32 {
        u32::from(self.level)
    }

    /// The centre, in lattice coordinates: the diamond's name.
    #[must_use]
    pub fn centre(self) -> Point {
        [self.x, self.y]
    }
}

impl Local {
    /// The lattice point of doubled local coordinates (2u, 2v): both even for an old point, both odd
    /// for a new one.
    #[must_use]
    pub fn lattice2(&self, [p, q]: [i64; 2]) -> [i64; 2] {
        [
            self.origin[0] + (self.u[0] * p + self.v[0] * q) / 2,
            self.origin[1] + (self.u[1] * p + self.v[1] * q) / 2,
        ]
    }

    /// The doubled local coordinates of a lattice point.
    #[must_use]
    pub fn local2(&self, [x, y]: [i64; 2]) -> [i64; 2] {
        let w = [x - self.origin[0], y - self.origin[1]];
        let length2 = self.u[0] * self.u[0] + self.u[1] * self.u[1];
        let along = |e: [i64; 2]| 2 * (w[0] * e[0] + w[1] * e[1]) / length2;
        [along(self.u), along(self.v)]
    }
}

/// The heights of a diamond once it is split: old points and the centres of cells, in quanta.
///
/// Takes `4 ((n+1)^2 + n^2)` bytes: 33 kB for n = 64. An even level past the finest lattice has no centres.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Block {
    n: usize,
    heights: Vec<i32>,
}

impl Block {
    /// A block without heights, for a diamond of a level.
    #[must_use]
    pub fn empty(forest: &Forest, level: u32) -> Self {
        let n = forest.segments_at(level);
        let centres = if forest.adds_points(level) || level % 2 == 1 { n * n } else { 0 };
        Self { n, heights: vec![NODATA; (n + 1) * (n + 1) + centres] }
    }

    /// Segments a side.
    #[must_use]
    pub fn segments(&self) -> usize {
        self.n
    }

    /// Whether the centres of the cells are points, too.
    #[must_use]
    pub fn has_centres(&self) -> bool {
        self.heights.len() > (self.n + 1) * (self.n + 1)
    }

    /// Old points, rows of n+1 along u, then centres, rows of n.
    #[must_use]
    pub fn heights(&self) -> &[i32] {
        &self.heights
    }

    /// The same, to be changed.
    pub fn heights_mut(&mut self) -> &mut [i32] {
        &mut self.heights
    }

    /// The old points, row v after row v, each of n+1 heights; and the centres, rows of n.
    pub fn parts_mut(&mut self) -> (&mut [i32], &mut [i32]) {
        self.heights.split_at_mut((self.n + 1) * (self.n + 1))
    }

    /// The old points and the centres.
    #[must_use]
    pub fn parts(&self) -> (&[i32], &[i32]) {
        self.heights.split_at((self.n + 1) * (self.n + 1))
    }

    /// Position in [`Block::heights`] of doubled local coordinates, both even or both odd, in 0..=2n.
    #[must_use]
    pub fn slot(n: usize, p: usize, q: usize) -> usize {
        if p.is_multiple_of(2) { q / 2 * (n + 1) + p / 2 } else { (n + 1) * (n + 1) + q / 2 * n + p / 2 }
    }

    /// The height at doubled local coordinates, as for [`Block::slot`].
    #[must_use]
    pub fn height(&self, [p, q]: [usize; 2]) -> i32 {
        self.heights[Self::slot(self.n, p, q)]
    }

    /// Doubled local coordinates of every point of the block's square, row by row.
    pub fn places(&self) -> impl Iterator<Item = [usize; 2]> + use<> {
        let (n, step) = (self.n, if self.has_centres() { 1 } else { 2 });
        (0..=2 * n).step_by(step).flat_map(move |q| (q % 2..=2 * n).step_by(2).map(move |p| [p, q]))
    }

    /// Fills in, from `parent`'s split, the points of `child` that are known and lie in the triangle they
    /// share.
    ///
    /// Both parents together give a child all of them; those on the shared hypotenuse come from
    /// either, and are equal, since no split moves its own border.
    pub fn inherit(&mut self, forest: &Forest, child: Diamond, parent: Diamond, from: &Self) {
        if !from.has_centres() {
            walk_shared(forest, child, parent, |to, slot| self.heights[to] = from.heights[slot]);
            return;
        }
        let n = self.n;
        let shared = Shared::new(forest, child, parent);
        for j in 0..=n {
            let (first, last) = shared.columns(n, j);
            // Along a row, old points of the parent alternate with centres: each kind lies at even steps.
            for i in first..=last.min(first + 1) {
                let [p, q] = shared.at2(2 * i, 2 * j);
                let [p2, q2] = shared.at2(2 * i + 4, 2 * j);
                let mut slot = Self::slot(from.n, p as usize, q as usize) as i64;
                let row = (from.n + usize::from(p % 2 == 0)) as i64;
                let step = (q2 - q) / 2 * row + (p2 - p) / 2;
                for to in self.heights[j * (n + 1) + i..=j * (n + 1) + last].iter_mut().step_by(2) {
                    *to = from.heights[slot as usize];
                    slot += step;
                }
            }
        }
    }

    /// Reads every point of the block from the lattice: `height(x, y)`. Points outside stay empty.
    pub fn fill(&mut self, local: &Local, mut height: impl FnMut(u32, u32) -> i32) {
        for [p, q] in self.places() {
            if local.upper || q <= p {
                let [x, y] = local.lattice2([p as i64, q as i64]);
                self.heights[Self::slot(self.n, p, q)] = height(x as u32, y as u32);
            }
        }
    }
}

/// The triangle that a child takes from a parent, in the local grids of both.
struct Shared {
    /// The child's (0, 0) in the parent's doubled coordinates, and what a step along the child's u and v adds.
    origin: [i64; 2],
    u: [i64; 2],
    v: [i64; 2],
    /// Whether it is the child's lower triangle.
    lower: bool,
}

impl Shared {
    fn new(forest: &Forest, child: Diamond, parent: Diamond) -> Self {
        let (c, p) = (forest.local(child), forest.local(parent));
        // The child's local grid seen from the parent's: a turn by an odd multiple of 45 degrees.
        let origin = p.local2(c.origin);
        let along = |e: [i64; 2]| {
            let tip = p.local2([c.origin[0] + e[0] * c.n, c.origin[1] + e[1] * c.n]);
            [(tip[0] - origin[0]) / c.n, (tip[1] - origin[1]) / c.n]
        };
        let centre = [i64::from(parent.x), i64::from(parent.y)];
        Self { origin, u: along(c.u), v: along(c.v), lower: c.lattice2([2 * c.n, 0]) == centre }
    }

    /// The first and last column of a row of the child's old points that lie in the triangle.
    fn columns(&self, n: usize, row: usize) -> (usize, usize) {
        if self.lower { (row, n) } else { (0, row) }
    }

    /// The parent's doubled coordinates of the child's.
    fn at2(&self, p: usize, q: usize) -> [i64; 2] {
        let (p, q) = (p as i64, q as i64);
        [0, 1].map(|axis| self.origin[axis] + (self.u[axis] * p + self.v[axis] * q) / 2)
    }
}

/// Calls `copy(slot of the child's point, slot in the parent's block)` for each point of the triangle that
/// `child` takes from `parent`, as far as the parent has it.
pub fn walk_shared(forest: &Forest, child: Diamond, parent: Diamond, mut copy: impl FnMut(usize, usize)) {
    let (n, from) = (forest.segments_at(child.level()), forest.segments_at(parent.level()));
    let shared = Shared::new(forest, child, parent);
    // Past the finest lattice all is known; before, centres are what the child is about to add.
    let centres = !forest.adds_points(child.level()) && child.level() % 2 == 1;
    for q in (0..=2 * n).step_by(if centres { 1 } else { 2 }) {
        let (first, last) = if shared.lower { (q, 2 * n) } else { (q % 2, q) };
        // Along a row, old points of the parent alternate with centres: each kind lies at even steps.
        for p in [first, first + 2].into_iter().filter(|p| *p <= last) {
            let slot_of = |p: usize| {
                let [p2, q2] = shared.at2(p, q);
                Block::slot(from, p2 as usize, q2 as usize) as i64
            };
            let (mut to, mut slot) = (Block::slot(n, p, q), slot_of(p));
            let step = if p + 4 <= last { slot_of(p + 4) - slot } else { 0 };
            for _ in (p..=last).step_by(4) {
                copy(to, slot as usize);
                to += 2;
                slot += step;
            }
        }
    }
}

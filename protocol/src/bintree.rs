//! Addresses of right isosceles triangles, and the forest of squares that they bisect.
//!
//! A triangle is named by its root square and its path: the path starts as `0b10` or `0b11` (which
//! half of the square) and each split appends one bit. So the level is the bit length less two, the
//! parent is a shift, and no table is needed. After Evans, Kirkpatrick and Townsend, *Right-Triangulated
//! Irregular Networks* (2001), and Duchaineau et al., *ROAMing Terrain* (1997).
//!
//! ```text
//!      b            The hypotenuse runs from a to b, c is the apex, and a, c, b turn left.
//!     /|            A split draws the line from c to m, the middle of the hypotenuse; its
//!    m |            left child is (c, m, a), its right child (b, m, c): apex in the middle.
//!   / \|
//!  a---c
//! ```

/// A point of the lattice: samples to the east and to the north of the forest's south-west corner.
pub type Point = [u32; 2];

/// The deepest level of a triangle; two bits of the path name the half of the root square.
pub const LEVEL_MAX: u32 = 60;

/// Largest base-2 logarithm of a root square's side: lattice coordinates stay below 2^28.
pub const ROOT_LOG2_MAX: u8 = 24;

/// Largest number of root squares along each axis.
pub const ROOTS_MAX: u32 = 1024;

/// Smallest and largest base-2 logarithm of the segments of a patch's leg.
pub const PATCH_LOG2: std::ops::RangeInclusive<u8> = 2..=7;

/// Base-2 logarithm of the most squares of finest patches: 2^48 samples at 64 segments. Keeps the pages of
/// an index within 32 bits.
pub const PATCHES_LOG2_MAX: u32 = 36;

/// The most levels past the finest lattice, unless patches are too small for them: see
/// [`Forest::with_precision`].
pub const PRECISION_MAX: u8 = 6;

/// The squares that cover a layer, and how finely each is cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(try_from = "ForestParts", into = "ForestParts")]
pub struct Forest {
    root_log2: u8,
    patch_log2: u8,
    roots: [u32; 2],
    precision: u8,
}

/// The JSON form of a [`Forest`].
#[derive(Clone, Copy, serde::Serialize, serde::Deserialize)]
struct ForestParts {
    root_log2: u8,
    patch_log2: u8,
    roots: [u32; 2],
    precision: u8,
}

/// Why numbers do not describe a forest.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ForestError {
    /// The patch size is outside of what this build handles.
    #[error("patch of 2^{found} segments: expected an exponent in {PATCH_LOG2:?}")]
    Patch {
        /// The exponent found.
        found: u8,
    },
    /// The root square is too small for its patch, or too large.
    #[error("root square of 2^{found} cells: expected an exponent from {} to {ROOT_LOG2_MAX}", patch + 1)]
    Root {
        /// The exponent found.
        found: u8,
        /// The exponent of the patch.
        patch: u8,
    },
    /// More patches than an index can count.
    #[error("2^{found} patches along x and y together: expected at most 2^{PATCHES_LOG2_MAX}")]
    Patches {
        /// The base-2 logarithm found, rounded up.
        found: u32,
    },
    /// More levels past the finest lattice than patches have room for.
    #[error("{found} levels past the finest lattice: expected at most {most}")]
    Precision {
        /// The number found.
        found: u8,
        /// The most.
        most: u8,
    },
    /// No root squares, or too many.
    #[error("{0} x {1} root squares: expected 1 to {ROOTS_MAX} along each axis")]
    Roots(u32, u32),
}

impl TryFrom<ForestParts> for Forest {
    type Error = ForestError;
    fn try_from(p: ForestParts) -> Result<Self, ForestError> {
        Self::new(p.root_log2, p.patch_log2, p.roots)?.with_precision(p.precision)
    }
}

impl From<Forest> for ForestParts {
    fn from(f: Forest) -> Self {
        Self { root_log2: f.root_log2, patch_log2: f.patch_log2, roots: f.roots, precision: f.precision }
    }
}

impl Forest {
    /// `roots[0]` by `roots[1]` squares of `2^root_log2` cells a side, cut into patches of
    /// `2^patch_log2` segments a leg.
    ///
    /// # Errors
    /// When a number is out of the documented limits. A root is larger than a patch, so that every
    /// root square splits at least twice.
    pub fn new(root_log2: u8, patch_log2: u8, roots: [u32; 2]) -> Result<Self, ForestError> {
        if !PATCH_LOG2.contains(&patch_log2) {
            return Err(ForestError::Patch { found: patch_log2 });
        }
        if root_log2 <= patch_log2 || root_log2 > ROOT_LOG2_MAX {
            return Err(ForestError::Root { found: root_log2, patch: patch_log2 });
        }
        let in_range = |n: u32| (1..=ROOTS_MAX).contains(&n) && u64::from(n) << root_log2 < 1 << 28;
        if !in_range(roots[0]) || !in_range(roots[1]) {
            return Err(ForestError::Roots(roots[0], roots[1]));
        }
        let squares = (u64::from(roots[0]) * u64::from(roots[1])) << (2 * u32::from(root_log2 - patch_log2));
        if squares > 1 << PATCHES_LOG2_MAX {
            return Err(ForestError::Patches { found: squares.next_power_of_two().trailing_zeros() });
        }
        Ok(Self { root_log2, patch_log2, roots, precision: 0 })
    }

    /// The same with `levels` past the finest lattice: their diamonds add no points, they only make those
    /// that are there more precise. Each of them has half of the points of one of the level before.
    ///
    /// # Errors
    /// Beyond [`PRECISION_MAX`], and where a diamond of the last one would have less than two segments a side.
    pub fn with_precision(self, levels: u8) -> Result<Self, ForestError> {
        let most = PRECISION_MAX.min(2 * self.patch_log2 - 1);
        let squares = (u64::from(self.roots[0]) * u64::from(self.roots[1]))
            << (2 * u32::from(self.root_log2 - self.patch_log2));
        if levels > most || squares << levels > 1 << PATCHES_LOG2_MAX {
            return Err(ForestError::Precision { found: levels, most });
        }
        Ok(Self { precision: levels, ..self })
    }

    /// The forest for a grid of `width` by `height` samples: the shorter side fits one root square,
    /// the longer takes as many as it needs, so that a long thin source is not padded to a huge square.
    ///
    /// # Errors
    /// As [`Forest::new`], for grids beyond 2^28 samples a side or thinner than 1 : 1024.
    pub fn covering(width: u32, height: u32, patch_log2: u8) -> Result<Self, ForestError> {
        let cells = |samples: u32| samples.saturating_sub(1).max(1);
        let (w, h) = (cells(width), cells(height));
        let shorter = w.min(h).next_power_of_two().trailing_zeros();
        // Never more roots than the limit along the longer side.
        let longer = w.max(h).div_ceil(ROOTS_MAX).next_power_of_two().trailing_zeros();
        let log2 = shorter.max(longer).max(u32::from(patch_log2) + 1);
        let root_log2 = u8::try_from(log2).unwrap_or(u8::MAX);
        if root_log2 > ROOT_LOG2_MAX {
            return Err(ForestError::Root { found: root_log2, patch: patch_log2 });
        }
        Self::new(root_log2, patch_log2, [w.div_ceil(1 << log2), h.div_ceil(1 << log2)])
    }

    /// Base-2 logarithm of the cells along a root square's side.
    #[must_use]
    pub fn root_log2(&self) -> u32 {
        u32::from(self.root_log2)
    }

    /// Base-2 logarithm of the segments along each side of a patch.
    #[must_use]
    pub fn patch_log2(&self) -> u32 {
        u32::from(self.patch_log2)
    }

    /// Segments along each side of a patch on the lattice: n.
    #[must_use]
    pub fn segments(&self) -> usize {
        1 << self.patch_log2
    }

    /// Root squares along x and y.
    #[must_use]
    pub fn roots(&self) -> [u32; 2] {
        self.roots
    }

    /// How many levels of diamonds split: those of the lattice, then those that only add precision.
    #[must_use]
    pub fn levels(&self) -> u32 {
        self.lattice_levels() + u32::from(self.precision)
    }

    /// How many levels of diamonds add points. Triangles of this level are drawn from source samples one
    /// cell apart. Even, and at least 2.
    #[must_use]
    pub fn lattice_levels(&self) -> u32 {
        2 * (self.root_log2() - self.patch_log2())
    }

    /// Segments along each side of a diamond of a level: n on the lattice; past it the cells stay as they
    /// are, and diamonds have fewer of them.
    #[must_use]
    pub fn segments_at(&self, level: u32) -> usize {
        let past = level.saturating_sub(self.lattice_levels());
        let halvings = if level < self.lattice_levels() { 0 } else { past.div_ceil(2) };
        1 << (self.patch_log2() - halvings)
    }

    /// The largest lattice coordinates, in cells.
    #[must_use]
    pub fn size(&self) -> Point {
        [self.roots[0] << self.root_log2, self.roots[1] << self.root_log2]
    }

    /// Whether a point lies on the lattice, borders included.
    #[must_use]
    pub fn contains(&self, [x, y]: Point) -> bool {
        let [w, h] = self.size();
        x <= w && y <= h
    }

    /// The two halves of each root square, south row first.
    pub fn root_triangles(&self) -> impl Iterator<Item = Triangle> + use<> {
        (0..self.roots[0] * self.roots[1])
            .flat_map(|root| [Triangle { root, path: 0b10 }, Triangle { root, path: 0b11 }])
    }

    /// Corners `[a, c, b]` of a triangle in lattice coordinates, turning left; `a` and `b` end the
    /// hypotenuse. `None` below the level at which corners are no longer lattice points, or for a root
    /// square that the forest has not. Costs one step a level.
    #[must_use]
    pub fn corners(&self, t: Triangle) -> Option<[Point; 3]> {
        if t.root >= self.roots[0] * self.roots[1] || t.level() > 2 * self.root_log2() {
            return None;
        }
        let side = 1u32 << self.root_log2;
        let [i, j] = [t.root % self.roots[0], t.root / self.roots[0]];
        let [x, y] = [i * side, j * side];
        // Diagonals alternate from square to square, as they do within one.
        let [mut a, mut c, mut b] = if (i + j) % 2 == 0 {
            [[x, y], [x + side, y], [x + side, y + side]]
        } else {
            [[x + side, y], [x + side, y + side], [x, y + side]]
        };
        let level = t.level();
        if (t.path >> level) & 1 == 1 {
            // The other half is this one turned by half a circle about the square's centre.
            let apex = [2 * x + side - c[0], 2 * y + side - c[1]];
            [a, c, b] = [b, apex, a];
        }
        for step in (0..level).rev() {
            let m = [a[0].midpoint(b[0]), a[1].midpoint(b[1])];
            [a, c, b] = if (t.path >> step) & 1 == 0 { [c, m, a] } else { [b, m, c] };
        }
        Some([a, c, b])
    }
}

/// The address of a triangle: root square and path.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Triangle {
    root: u32,
    path: u64,
}

impl Triangle {
    /// The number of splits from the half square to here.
    #[must_use]
    pub fn level(self) -> u32 {
        62 - self.path.leading_zeros()
    }

    /// The triangle that splits into this one; `None` for the half of a root square.
    #[must_use]
    pub fn parent(self) -> Option<Self> {
        (self.level() > 0).then_some(Self { path: self.path >> 1, ..self })
    }

    /// Left and right halves, cut at the middle of the hypotenuse; `None` at [`LEVEL_MAX`].
    #[must_use]
    pub fn children(self) -> Option<[Self; 2]> {
        (self.level() < LEVEL_MAX)
            .then_some([Self { path: self.path << 1, ..self }, Self { path: self.path << 1 | 1, ..self }])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn double_area([a, c, b]: [Point; 3]) -> i64 {
        let d = |p: Point, q: Point| [i64::from(q[0]) - i64::from(p[0]), i64::from(q[1]) - i64::from(p[1])];
        let (e, f) = (d(a, c), d(a, b));
        e[0] * f[1] - e[1] * f[0]
    }

    fn any_forest() -> impl Strategy<Value = Forest> {
        (2u8..=3, 1u8..=3, 1u32..=3, 1u32..=3)
            .prop_map(|(m, extra, c, r)| Forest::new(m + extra, m, [c, r]).unwrap())
    }

    proptest! {
        #[test]
        fn children_cover_their_parent_exactly(forest in any_forest(), turns in prop::collection::vec(0usize..2, 0..6), pick in 0usize..18) {
            let roots: Vec<_> = forest.root_triangles().collect();
            let mut t = roots[pick % roots.len()];
            for turn in turns {
                let both = t.children().unwrap();
                let Some(corners) = forest.corners(t) else { break };
                if let (Some(left), Some(right)) = (forest.corners(both[0]), forest.corners(both[1])) {
                    prop_assert_eq!(double_area(left) + double_area(right), double_area(corners));
                    prop_assert!(double_area(left) > 0 && double_area(left) == double_area(right));
                    // They share the cut from the apex to the middle, and nothing of the parent is lost.
                    prop_assert_eq!([left[2], left[0]], [corners[0], corners[1]]);
                    prop_assert_eq!([right[2], right[0]], [corners[1], corners[2]]);
                    prop_assert_eq!(left[1], right[1]);
                }
                for child in both { prop_assert_eq!(child.parent(), Some(t)); }
                t = both[turn];
            }
        }
    }

    #[test]
    fn roots_cover_the_forest_exactly() {
        let forest = Forest::new(4, 2, [3, 2]).unwrap();
        let area: i64 = forest.root_triangles().map(|t| double_area(forest.corners(t).unwrap())).sum();
        assert_eq!(area, 2 * 48 * 32);
    }

    #[test]
    fn impossible_forests_are_refused() {
        assert_eq!(Forest::new(8, 1, [1, 1]), Err(ForestError::Patch { found: 1 }));
        assert_eq!(Forest::new(6, 6, [1, 1]), Err(ForestError::Root { found: 6, patch: 6 }));
        assert_eq!(Forest::new(8, 6, [0, 1]), Err(ForestError::Roots(0, 1)));
        assert!(Forest::new(24, 6, [1024, 1]).is_err(), "coordinates beyond 28 bits");
        // A scene that a fuzzer made up: its pages did not fit 32 bits.
        assert_eq!(Forest::new(24, 2, [15, 15]), Err(ForestError::Patches { found: 52 }));
        assert!(serde_json_like(9, 12).is_err());
        fn serde_json_like(root_log2: u8, patch_log2: u8) -> Result<Forest, ForestError> {
            ForestParts { root_log2, patch_log2, roots: [1, 1], precision: 0 }.try_into()
        }
    }

    #[test]
    fn a_thin_source_gets_several_roots() {
        let forest = Forest::covering(10_000, 500, 6).unwrap();
        assert_eq!((forest.root_log2(), forest.roots()), (9, [20, 1]));
        let exact = Forest::covering(1025, 1025, 6).unwrap();
        assert_eq!((exact.root_log2(), exact.roots()), (10, [1, 1]));
        let tiny = Forest::covering(1, 1, 6).unwrap();
        assert_eq!((tiny.root_log2(), tiny.roots()), (7, [1, 1]));
    }
}

//! A split diamond as a grid: its block of heights with a slope at each point.
//!
//! Slopes follow the same rule as heights: a split changes only what lies strictly inside, so two
//! surfaces that meet along a side agree about its shading too, and light shows no seams.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "local coordinates are at most 256, and slopes need no more than f32"
)]

use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond, walk_shared};
use diamantina_protocol::message::Layer;
use diamantina_protocol::points::{self, DecodeError, Tally};

/// Bytes of a point on the GPU: a height and a normal.
pub(crate) const GPU_POINT_BYTES: usize = 8;

/// Points of the surface of a diamond of a level.
fn slots(forest: &Forest, level: u32) -> usize {
    let n = forest.segments_at(level);
    let centres = if forest.adds_points(level) || level % 2 == 1 { n * n } else { 0 };
    (n + 1).pow(2) + centres
}

/// The heights and slopes of a split diamond.
///
/// Takes `12 ((n+1)^2 + n^2)` bytes: 100 kB for n = 64.
#[derive(Debug, Clone, PartialEq)]
pub struct Points {
    block: Block,
    slopes: Vec<[f32; 2]>,
    has_nodata: bool,
    tally: Tally,
}

impl Points {
    /// Decodes what `d`'s split adds to what its parents have. `parents` are the surfaces of
    /// `forest.parents(d)`, in that order. The bytes may be hostile.
    ///
    /// # Errors
    /// When the bytes are not `d`'s payload.
    pub fn split(
        layer: &Layer,
        d: Diamond,
        parents: &[(Diamond, &Self)],
        payload: &[u8],
    ) -> Result<Self, DecodeError> {
        let forest = &layer.forest;
        let mut block = Block::empty(forest, d.level());
        let mut slopes = vec![[0.0f32; 2]; block.heights().len()];
        for (parent, surface) in parents {
            block.inherit(forest, d, *parent, &surface.block);
            walk_shared(forest, d, *parent, |to, from| slopes[to] = surface.slopes[from]);
        }
        let tally = points::decode(forest, &layer.coding, d, &mut block, payload)?;
        let (upper, n) = (forest.local(d).upper, block.segments());
        let mut inside = block.places().filter(|[p, q]| upper || q <= p);
        let has_nodata = inside.any(|[p, q]| block.heights()[Block::slot(n, p, q)] == NODATA);
        let mut surface = Self { block, slopes, has_nodata, tally };
        surface.slope(layer, d);
        Ok(surface)
    }

    /// Slopes of the points strictly inside (and, at level 0, on the sides), by differences along two axes: the
    /// diagonals of the cells around a point, or, where centres are no points, the sides of the cells. Where all
    /// eight points around are there, the middle one of three differences side by side counts twice (Horn 1981):
    /// a difference alone joins points of one colour of the chessboard that old and new points make, and slopes
    /// of the two colours drift apart, which light shows as teeth on steep ground.
    fn slope(&mut self, layer: &Layer, d: Diamond) {
        let local = layer.forest.local(d);
        let n = self.block.segments() as i64;
        // In doubled local coordinates.
        let [e, f]: [[i64; 2]; 2] =
            if self.block.has_centres() { [[1, 1], [1, -1]] } else { [[2, 0], [0, 2]] };
        // Metres of a unit along an axis.
        let metres =
            |[p, q]: [i64; 2]| [0, 1].map(|i| (local.u[i] * p + local.v[i] * q) as f64 * layer.cell[i] / 2.0);
        let (along, across) = (metres(e), metres(f));
        let det = along[0] * across[1] - along[1] * across[0];
        let height = |p: i64, q: i64| -> Option<f64> {
            if !(0..=2 * n).contains(&p) || !(0..=2 * n).contains(&q) || (!local.upper && q > p) {
                return None;
            }
            let h = self.block.heights()[Block::slot(n as usize, p as usize, q as usize)];
            (h != NODATA).then_some(f64::from(h) * layer.quantum)
        };
        // Rise a unit along an axis, from both sides of a point where it can be.
        let rise = |p: i64, q: i64, [dp, dq]: [i64; 2]| -> f64 {
            let here = height(p, q);
            match (height(p - dp, q - dq), height(p + dp, q + dq), here) {
                (Some(a), Some(b), _) => (b - a) / 2.0,
                (Some(a), None, Some(h)) => h - a,
                (None, Some(b), Some(h)) => b - h,
                _ => 0.0,
            }
        };
        // The mean of the rises on both sides of a point, if the four points beside the axes are there.
        let beside = |p: i64, q: i64| -> Option<[f64; 2]> {
            height(p, q)?;
            let at = |i: i64, j: i64| height(p + i * e[0] + j * f[0], q + i * e[1] + j * f[1]);
            let (a, b, c, d) = (at(-1, -1)?, at(1, -1)?, at(1, 1)?, at(-1, 1)?);
            Some([(b - a + c - d) / 4.0, (d - a + c - b) / 4.0])
        };
        let mut fresh = Vec::new();
        for [p, q] in self.block.places().map(|place| place.map(|w| w as i64)) {
            let border = p == 0 || q == 0 || p == 2 * n || q == 2 * n;
            if (border && d.level() > 0) || (!local.upper && q > p) {
                continue;
            }
            let mut rises = [rise(p, q, e), rise(p, q, f)];
            if let Some(beside) = beside(p, q) {
                rises = [0, 1].map(|i| f64::midpoint(rises[i], beside[i]));
            }
            let slope = [
                (rises[0] * across[1] - rises[1] * along[1]) / det,
                (rises[1] * along[0] - rises[0] * across[0]) / det,
            ];
            fresh.push((Block::slot(n as usize, p as usize, q as usize), slope.map(|s| s as f32)));
        }
        for (slot, slope) in fresh {
            self.slopes[slot] = slope;
        }
    }

    /// The heights, in quanta.
    #[must_use]
    pub fn block(&self) -> &Block {
        &self.block
    }

    /// The slope at each slot of the block: metres up for a metre east, and for a metre north.
    #[must_use]
    pub fn slopes(&self) -> &[[f32; 2]] {
        &self.slopes
    }

    /// Whether some point of the diamond, inside the forest, has no height.
    #[must_use]
    pub fn has_nodata(&self) -> bool {
        self.has_nodata
    }

    /// What the payload held.
    #[must_use]
    pub fn tally(&self) -> Tally {
        self.tally
    }

    /// Bytes of memory that the surface of a diamond of a level takes, with what a cache notes of it.
    #[must_use]
    pub fn bytes(forest: &Forest, level: u32) -> usize {
        12 * slots(forest, level) + size_of::<Self>()
    }

    /// Bytes of GPU memory that points and index lists take at most: those that have nodata have lists of their own.
    pub(super) fn gpu_bytes(&self) -> (usize, usize) {
        let n = self.block.segments();
        // Four triangles a cell, or two, of three indices each.
        let lists = if self.block.has_centres() { 24 * n * n } else { 12 * n * n };
        (GPU_POINT_BYTES * self.slopes.len(), if self.has_nodata { lists } else { 0 })
    }

    /// Bytes of GPU memory that a surface of a level without nodata takes.
    pub(super) fn expected_gpu_bytes(forest: &Forest, level: u32) -> usize {
        GPU_POINT_BYTES * slots(forest, level)
    }
}

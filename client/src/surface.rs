//! The geometry of a split diamond: its block of heights with a slope at each point.
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
use diamantina_protocol::diamond::{Block, Diamond, walk_shared};
use diamantina_protocol::message::Layer;
use diamantina_protocol::points::{self, DecodeError, Tally};

/// The heights and slopes of a split diamond.
///
/// Takes `12 ((n+1)^2 + n^2)` bytes: 100 kB for n = 64.
#[derive(Debug, Clone, PartialEq)]
pub struct Surface {
    block: Block,
    slopes: Vec<[f32; 2]>,
    has_nodata: bool,
    tally: Tally,
}

impl Surface {
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
        let mut block = Block::empty(forest);
        let mut slopes = vec![[0.0f32; 2]; block.heights().len()];
        for (parent, surface) in parents {
            block.inherit(forest, d, *parent, &surface.block);
            walk_shared(forest, d, *parent, |to, from| slopes[to] = surface.slopes[from]);
        }
        let tally = points::decode(forest, &layer.coding, d, &mut block, payload)?;
        let local = forest.local(d);
        let n = forest.segments();
        let (old, _) = block.parts();
        let exists = |v: usize, u: usize| local.upper || v <= u;
        let has_nodata = (0..=n).any(|v| (0..=n).any(|u| exists(v, u) && old[v * (n + 1) + u] == NODATA))
            || (0..n).any(|v| {
                (0..n).any(|u| exists(v, u) && block.heights()[(n + 1) * (n + 1) + v * n + u] == NODATA)
            });
        let mut surface = Self { block, slopes, has_nodata, tally };
        surface.slope(layer, d);
        Ok(surface)
    }

    /// Slopes of the points strictly inside (and, at level 0, on the sides), by differences along the two
    /// diagonals of the cells around them. Where all eight points around are there, the middle one of three
    /// differences side by side counts twice (Horn 1981): a difference alone joins points of one colour of
    /// the chessboard that old and new points make, and slopes of the two colours drift apart, which light
    /// shows as teeth on steep ground.
    fn slope(&mut self, layer: &Layer, d: Diamond) {
        let local = layer.forest.local(d);
        let n = self.block.segments() as i64;
        // Metres of half a unit of u and of v.
        let half = |e: [i64; 2]| [e[0] as f64 * layer.cell[0] / 2.0, e[1] as f64 * layer.cell[1] / 2.0];
        let (hu, hv) = (half(local.u), half(local.v));
        let height = |p: i64, q: i64| -> Option<f64> {
            if !(0..=2 * n).contains(&p) || !(0..=2 * n).contains(&q) || (!local.upper && q > p) {
                return None;
            }
            let h = self.block.heights()[Block::slot(n as usize, p as usize, q as usize)];
            (h != NODATA).then_some(f64::from(h) * layer.quantum)
        };
        // Rise a unit along (dp, dq), from both sides of a point where it can be.
        let rise = |p: i64, q: i64, dp: i64, dq: i64| -> f64 {
            let here = height(p, q);
            match (height(p - dp, q - dq), height(p + dp, q + dq), here) {
                (Some(a), Some(b), _) => (b - a) / 2.0,
                (Some(a), None, Some(h)) => h - a,
                (None, Some(b), Some(h)) => b - h,
                _ => 0.0,
            }
        };
        // The mean of the rises on both sides of a point, if their four points are there.
        let beside = |p: i64, q: i64, [w, e, s, n]: [Option<f64>; 4]| -> Option<[f64; 2]> {
            height(p, q)?;
            let (w, e, s, n) = (w?, e?, s?, n?);
            Some([(e - s + n - w) / 4.0, (e - n + s - w) / 4.0])
        };
        // The step along (1, 1) in metres, and the one along (1, -1).
        let (e, f) = ([hu[0] + hv[0], hu[1] + hv[1]], [hu[0] - hv[0], hu[1] - hv[1]]);
        let det = e[0] * f[1] - e[1] * f[0];
        let mut fresh = Vec::new();
        for q in 0..=2 * n {
            for p in (q % 2..=2 * n).step_by(2) {
                let border = p == 0 || q == 0 || p == 2 * n || q == 2 * n;
                if (border && d.level() > 0) || (!local.upper && q > p) {
                    continue;
                }
                let (mut along, mut across) = (rise(p, q, 1, 1), rise(p, q, 1, -1));
                let axes = [height(p - 2, q), height(p + 2, q), height(p, q - 2), height(p, q + 2)];
                if let Some(beside) = beside(p, q, axes) {
                    (along, across) = (f64::midpoint(along, beside[0]), f64::midpoint(across, beside[1]));
                }
                let slope = [(along * f[1] - across * e[1]) / det, (across * e[0] - along * f[0]) / det];
                fresh.push((Block::slot(n as usize, p as usize, q as usize), slope.map(|s| s as f32)));
            }
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

    /// Bytes of memory that a surface of this many segments takes.
    #[must_use]
    pub fn bytes(segments: usize) -> usize {
        12 * ((segments + 1).pow(2) + segments.pow(2)) + size_of::<Self>()
    }
}

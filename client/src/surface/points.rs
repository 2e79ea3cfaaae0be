//! A split diamond as a grid: its block of heights with a normal at each point.
//!
//! Normals follow the same rule as heights: a split changes only what lies strictly inside, so two
//! surfaces that meet along a side agree about its shading too, and light shows no seams.

use super::shade::shade;
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

/// The heights and normals of a split diamond.
///
/// Takes `8 ((n+1)^2 + n^2)` bytes: 67 kB for n = 64.
#[derive(Debug, Clone, PartialEq)]
pub struct Points {
    block: Block,
    normals: Vec<[i16; 2]>,
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
        let mut normals = vec![[0; 2]; block.heights().len()];
        for (parent, surface) in parents {
            block.inherit(forest, d, *parent, &surface.block);
            walk_shared(forest, d, *parent, |to, from| normals[to] = surface.normals[from]);
        }
        let tally = points::decode(forest, &layer.coding, d, &mut block, payload)?;
        let (upper, n) = (forest.local(d).upper, block.segments());
        let mut inside = block.places().filter(|[p, q]| upper || q <= p);
        let has_nodata = inside.any(|[p, q]| block.heights()[Block::slot(n, p, q)] == NODATA);
        shade(layer, d, &block, has_nodata, &mut normals);
        Ok(Self { block, normals, has_nodata, tally })
    }

    /// The heights, in quanta.
    #[must_use]
    pub fn block(&self) -> &Block {
        &self.block
    }

    /// The normal at each slot of the block, as [`normal`](super::normal) gives it.
    #[must_use]
    pub fn normals(&self) -> &[[i16; 2]] {
        &self.normals
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
        8 * slots(forest, level) + size_of::<Self>()
    }

    /// Bytes of GPU memory that points and index lists take at most: those that have nodata have lists of their own.
    pub(super) fn gpu_bytes(&self) -> (usize, usize) {
        let n = self.block.segments();
        // Four triangles a cell, or two, of three indices each.
        let lists = if self.block.has_centres() { 24 * n * n } else { 12 * n * n };
        (GPU_POINT_BYTES * self.normals.len(), if self.has_nodata { lists } else { 0 })
    }

    /// Bytes of GPU memory that a surface of a level without nodata takes.
    pub(super) fn expected_gpu_bytes(forest: &Forest, level: u32) -> usize {
        GPU_POINT_BYTES * slots(forest, level)
    }
}

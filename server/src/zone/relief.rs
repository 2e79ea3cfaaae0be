//! The finest surface of a layer as a raster, with the highest and lowest sample of each block of it.

use super::tiled::Tiled;
use crate::inspect::{self, InspectError};
use crate::store::Store;
use diamantina_protocol::NODATA;
use diamantina_protocol::message::Layer;
use rayon::prelude::*;
use std::sync::{Mutex, PoisonError};

/// Base-2 logarithms of the sides of blocks, in cells, from small to large.
pub const BLOCKS_LOG2: [u32; 3] = [2, 4, 6];

/// Heights in quanta, with a pyramid of blocks.
///
/// Takes 4 bytes a sample and 3/5 of a byte for the blocks.
#[derive(Debug)]
pub struct Relief {
    heights: Tiled<i32>,
    blocks: [Blocks; BLOCKS_LOG2.len()],
}

/// The lowest and highest sample of each block, its borders included; those without height do not count.
#[derive(Debug)]
struct Blocks {
    size: [usize; 2],
    bounds: Vec<[i32; 2]>,
    /// Whether some sample has no height.
    holes: Vec<bool>,
}

/// What a block without any height has: it lies below everything.
const NOTHING: [i32; 2] = [i32::MAX, NODATA];

impl Relief {
    /// The relief of a raster of two samples at least along each axis, and [`NODATA`] beyond.
    #[must_use]
    pub fn new(heights: Tiled<i32>) -> Self {
        let finest = Blocks::finest(&heights);
        let middle = finest.coarser(BLOCKS_LOG2[1] - BLOCKS_LOG2[0]);
        let coarsest = middle.coarser(BLOCKS_LOG2[2] - BLOCKS_LOG2[1]);
        Self { heights, blocks: [finest, middle, coarsest] }
    }

    /// The relief of `size[0]` by `size[1]` samples, two at least along each axis; `heights` in quanta, row by row
    /// from the south.
    #[must_use]
    pub fn from_rows(size: [usize; 2], heights: &[i32]) -> Self {
        let mut tiled = Tiled::filled(size, NODATA);
        for (i, height) in heights.iter().enumerate() {
            tiled.set([i % size[0], i / size[0]], *height);
        }
        Self::new(tiled)
    }

    /// The finest surface of a layer, decoded chunk by chunk: some 100 MB at a time, besides the relief itself.
    ///
    /// # Errors
    /// When the store is damaged.
    pub fn read(store: &Store, number: u8, layer: &Layer) -> Result<Self, InspectError> {
        let size = layer.samples.map(|s| s as usize);
        let heights = Mutex::new(Tiled::filled(size, NODATA));
        inspect::decode_finest(store, number, layer, |blocks| {
            let mut heights = heights.lock().unwrap_or_else(PoisonError::into_inner);
            for (d, block, _) in blocks {
                let local = layer.forest.local(*d);
                for [p, q] in block.places().filter(|[p, q]| local.upper || q <= p) {
                    let at = local.lattice2([p, q].map(|w| i64::try_from(w).unwrap_or(0)));
                    let [x, y] = at.map(|w| usize::try_from(w).unwrap_or(usize::MAX));
                    if x < size[0] && y < size[1] {
                        heights.set([x, y], block.height([p, q]));
                    }
                }
            }
        })?;
        Ok(Self::new(heights.into_inner().unwrap_or_else(PoisonError::into_inner)))
    }

    /// The heights.
    pub(super) fn heights(&self) -> &Tiled<i32> {
        &self.heights
    }

    /// Samples along x and y.
    #[must_use]
    pub fn size(&self) -> [usize; 2] {
        self.heights.size()
    }

    /// Blocks of a kind along x and y.
    pub(super) fn blocks_size(&self, which: usize) -> [usize; 2] {
        self.blocks[which].size
    }

    /// The height of a sample.
    #[must_use]
    pub fn at(&self, place: [usize; 2]) -> i32 {
        self.heights.at(place)
    }

    /// Three corners of the small triangle at a place, in cells from the south-west sample and within the relief,
    /// and what each of them counts for there. Diagonals alternate as in the bintree's finest lattice.
    #[must_use]
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "places lie within the relief, so they are above 0 and below the count of samples"
    )]
    pub fn triangle(&self, place: [f64; 2]) -> [([usize; 2], f64); 3] {
        let [i, j]: [usize; 2] =
            std::array::from_fn(|axis| (place[axis].max(0.0) as usize).min(self.size()[axis] - 2));
        let [s, t] = [place[0] - i as f64, place[1] - j as f64];
        match ((i + j).is_multiple_of(2), s >= t, s + t <= 1.0) {
            (true, true, _) => [([i, j], 1.0 - s), ([i + 1, j], s - t), ([i + 1, j + 1], t)],
            (true, false, _) => [([i, j], 1.0 - t), ([i, j + 1], t - s), ([i + 1, j + 1], s)],
            (false, _, true) => [([i, j], 1.0 - s - t), ([i + 1, j], s), ([i, j + 1], t)],
            (false, _, false) => {
                [([i + 1, j], 1.0 - t), ([i, j + 1], 1.0 - s), ([i + 1, j + 1], s + t - 1.0)]
            }
        }
    }

    /// The height of the surface at a place, in quanta; `None` where it is not drawn. The place as for
    /// [`Relief::triangle`].
    #[must_use]
    pub fn height(&self, place: [f64; 2]) -> Option<f64> {
        let corners = self.triangle(place).map(|(at, weight)| (self.at(at), weight));
        let drawn = corners.iter().all(|(height, _)| *height != NODATA);
        drawn.then(|| corners.iter().map(|(height, weight)| f64::from(*height) * weight).sum())
    }

    /// Whether some sample of two neighbouring blocks or one has no height.
    #[must_use]
    pub(super) fn has_holes(&self, which: usize, places: [[usize; 2]; 2]) -> bool {
        let blocks = &self.blocks[which];
        places.iter().any(|[x, y]| blocks.holes[y * blocks.size[0] + x])
    }

    /// The lowest and highest sample of two neighbouring blocks or one; blocks number `which` of
    /// [`BLOCKS_LOG2`]. None has a height where low > high.
    #[must_use]
    pub(super) fn bounds(&self, which: usize, [first, last]: [[usize; 2]; 2]) -> [i32; 2] {
        let blocks = &self.blocks[which];
        let at = |[x, y]: [usize; 2]| blocks.bounds[y * blocks.size[0] + x];
        merged(at(first), at(last))
    }
}

fn merged(a: [i32; 2], b: [i32; 2]) -> [i32; 2] {
    [a[0].min(b[0]), a[1].max(b[1])]
}

impl Blocks {
    fn finest(heights: &Tiled<i32>) -> Self {
        let side = 1usize << BLOCKS_LOG2[0];
        let [width, height] = heights.size();
        let size = [width, height].map(|samples| (samples - 1).div_ceil(side));
        let items = heights.items();
        let bound = |i: usize| {
            let [x, y] = [i % size[0] * side, i / size[0] * side];
            let (mut bounds, mut has_holes) = (NOTHING, false);
            for y in y..=(y + side).min(height - 1) {
                let row = heights.offset(1, y);
                for x in x..=(x + side).min(width - 1) {
                    let height = items[row + heights.offset(0, x)];
                    if height == NODATA {
                        has_holes = true;
                    } else {
                        bounds = merged(bounds, [height, height]);
                    }
                }
            }
            (bounds, has_holes)
        };
        let (bounds, holes) = (0..size[0] * size[1]).into_par_iter().map(bound).unzip();
        Self { size, bounds, holes }
    }

    /// Blocks with sides larger by a power of two.
    fn coarser(&self, log2: u32) -> Self {
        let size = self.size.map(|blocks| blocks.div_ceil(1 << log2));
        let mut bounds = vec![NOTHING; size[0] * size[1]];
        let mut holes = vec![false; bounds.len()];
        for (i, (bound, has_holes)) in self.bounds.iter().zip(&self.holes).enumerate() {
            let [x, y] = [i % self.size[0], i / self.size[0]].map(|w| w >> log2);
            let whole = y * size[0] + x;
            bounds[whole] = merged(bounds[whole], *bound);
            holes[whole] |= has_holes;
        }
        Self { size, bounds, holes }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_bound_their_samples_and_borders() {
        let (width, height) = (100usize, 70usize);
        let of = |i: usize| i32::try_from(i * 7919 % 1013).unwrap();
        let heights = (0..width * height).map(|i| if of(i) % 9 == 0 { NODATA } else { of(i) }).collect();
        let heights: Vec<i32> = heights;
        let relief = Relief::from_rows([width, height], &heights);
        for (which, log2) in BLOCKS_LOG2.into_iter().enumerate() {
            for y in 0..height - 1 {
                for x in 0..width - 1 {
                    let block = [x >> log2, y >> log2];
                    let [low, high] = relief.bounds(which, [block, block]);
                    let corners = [[x, y], [x + 1, y], [x, y + 1], [x + 1, y + 1]].map(|c| relief.at(c));
                    assert!(!corners.contains(&NODATA) || relief.has_holes(which, [block, block]));
                    assert!(corners.iter().all(|h| *h == NODATA || (low..=high).contains(h)));
                }
            }
        }
        let empty = Relief::from_rows([9, 9], &[NODATA; 81]);
        assert_eq!(empty.bounds(0, [[0, 0], [0, 0]]), NOTHING);
    }

    #[test]
    fn the_surface_passes_through_its_samples_and_bends_along_its_diagonals() {
        let relief = Relief::from_rows([3, 2], &[0, 10, 20, 30, 40, NODATA]);
        for (place, expected) in [
            ([0.0, 0.0], Some(0.0)),
            ([1.0, 1.0], Some(40.0)),
            // The first cell rises along its diagonal, the second falls: its upper half is not drawn.
            ([0.5, 0.5], Some(20.0)),
            ([1.25, 0.25], Some(20.0)),
            ([1.75, 0.75], None),
            ([2.0, 0.0], Some(20.0)),
        ] {
            assert_eq!(relief.height(place), expected, "{place:?}");
        }
    }
}

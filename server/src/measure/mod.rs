//! How far the surface drawn at a level lies from the source: every sample, exactly.
//!
//! The surface of a level is made of micro-triangles between lattice points. On the lattice of an even
//! level they are the halves of square cells; on that of an odd level, the quarters, cut by both
//! diagonals. Over each the surface is a plane, and since cells are powers of two wide all arithmetic in
//! binary floating point is exact. Samples on a shared edge count for both sides, as both draw them.
//!
//! Work goes tile by tile, some 64 x 64 samples. Where all have a height, so has the surface: `tile` then
//! halves the lattice until it is as fine as the samples, whole rows at a time. All else is for `cells`,
//! which walks cell by cell and knows of nodata; both find the same, to the bit.
//!
//! **Nodata.** A triangle with a corner that has no height is not drawn. Where a level draws what the
//! source has not, or leaves out what it has, the two outlines differ; each such sample lies in a
//! triangle that has both data and nodata, so the outlines are at most a hypotenuse apart, and that
//! length is added to the error of the diamond.

mod cells;
mod tile;

use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use std::collections::HashMap;

/// Cells along a side of a tile: its buffers fit a core's first cache.
const TILE: u32 = 64;

/// What was found of a diamond.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Found {
    /// The largest vertical distance, in quanta.
    pub vertical: f64,
    /// Whether the outlines differ.
    pub outline: bool,
}

impl Found {
    /// The worse of both.
    pub fn merge(&mut self, other: Self) {
        self.vertical = self.vertical.max(other.vertical);
        self.outline |= other.outline;
    }
}

/// The samples of a rectangle of the lattice, one cell apart, with a summary of each tile of them.
#[derive(Debug)]
pub struct Samples<'a> {
    origin: [u32; 2],
    cells: [u32; 2],
    heights: &'a [i32],
    /// Cells along a side of a tile.
    tile: u32,
    tiles: Vec<Tile>,
}

/// What the samples of a tile have in common, its borders included.
#[derive(Debug, Clone, Copy)]
struct Tile {
    low: i32,
    high: i32,
    /// Some sample has no height.
    holes: bool,
    /// No sample has a height.
    empty: bool,
}

impl<'a> Samples<'a> {
    /// `origin` holds the lattice coordinates of the south-west sample; `cells` the cells along x and y, of
    /// which there is one less than samples; `heights` quanta, row by row from the south.
    ///
    /// The rectangle must be a square of the quadtree of roots, so that it is made of whole cells of any
    /// level or lies within one.
    #[must_use]
    pub fn new(origin: [u32; 2], cells: [u32; 2], heights: &'a [i32]) -> Self {
        let tile = TILE.min(cells[0]).min(cells[1]);
        let mut samples = Self { origin, cells, heights, tile, tiles: Vec::new() };
        for y in (0..cells[1]).step_by(tile as usize) {
            for x in (0..cells[0]).step_by(tile as usize) {
                let mut summary = Tile { low: i32::MAX, high: i32::MIN, holes: false, empty: true };
                for row in samples.rows([origin[0] + x, origin[1] + y], tile) {
                    for height in row {
                        let hole = *height == NODATA;
                        summary.holes |= hole;
                        summary.empty &= hole;
                        summary.low = summary.low.min(if hole { i32::MAX } else { *height });
                        summary.high = summary.high.max(*height);
                    }
                }
                samples.tiles.push(summary);
            }
        }
        samples
    }

    /// Whether no sample has a height.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.tiles.iter().all(|tile| tile.empty)
    }

    /// The rows of a square of `side` cells, from its south-west sample `[x, y]`.
    fn rows(&self, [x, y]: [u32; 2], side: u32) -> impl Iterator<Item = &[i32]> {
        let width = self.cells[0] as usize + 1;
        let (i, j) = ((x - self.origin[0]) as usize, (y - self.origin[1]) as usize);
        let side = side as usize;
        self.heights.chunks_exact(width).skip(j).take(side + 1).map(move |row| &row[i..=i + side])
    }

    /// The summary of the tile that holds the square whose south-west sample is `[x, y]`.
    fn summary(&self, [x, y]: [u32; 2]) -> Tile {
        let (i, j) = ((x - self.origin[0]) / self.tile, (y - self.origin[1]) / self.tile);
        self.tiles[(j * (self.cells[0] / self.tile) + i) as usize]
    }
}

/// The heights that a level draws, at the points of its lattice in a rectangle. Of an odd level's, those
/// whose coordinates, in spacings, are odd and even mean nothing.
#[derive(Debug, Clone, Copy)]
pub struct Nodes<'a> {
    /// Base-2 logarithm of the distance between points: half a cell of an odd level.
    pub spacing_log2: u32,
    /// Lattice coordinates of the south-west point.
    pub origin: [u32; 2],
    /// Points in a row.
    pub width: usize,
    /// Heights in quanta, row by row from the south.
    pub heights: &'a [i32],
}

impl Nodes<'_> {
    fn at(&self, x: u32, y: u32) -> i32 {
        let (i, j) = ((x - self.origin[0]) >> self.spacing_log2, (y - self.origin[1]) >> self.spacing_log2);
        self.heights[j as usize * self.width + i as usize]
    }

    /// `count` points of the row at `y`, from `x`.
    fn row(&self, x: u32, y: u32, count: usize) -> &[i32] {
        let (i, j) = ((x - self.origin[0]) >> self.spacing_log2, (y - self.origin[1]) >> self.spacing_log2);
        let first = j as usize * self.width + i as usize;
        &self.heights[first..first + count]
    }
}

/// A square of the lattice.
#[derive(Debug, Clone, Copy)]
struct Square {
    x: u32,
    y: u32,
    side: u32,
}

/// Compares the surface of `level` (1 to `forest.levels()` - 1) with the samples, and adds what it finds to
/// `found`. `nodes` are at least those of the samples' rectangle and of the cell around it.
pub fn measure(
    forest: &Forest,
    level: u32,
    samples: &Samples<'_>,
    nodes: Nodes<'_>,
    found: &mut HashMap<Diamond, Found>,
) {
    // A macro-square's triangles, one or four, collect before they are put into the map.
    let side = 1u32 << (forest.root_log2() - level / 2);
    let tile = samples.tile.min(side);
    let [x0, y0] = samples.origin;
    let [x1, y1] = [x0 + samples.cells[0], y0 + samples.cells[1]];
    let first = |w: u32| w & !(side - 1);
    let mut buffers = tile::Buffers::default();
    for square_y in (first(y0)..y1).step_by(side as usize) {
        for square_x in (first(x0)..x1).step_by(side as usize) {
            let around = Square { x: square_x, y: square_y, side };
            let mut local = [Found::default(); 4];
            for y in (y0.max(square_y)..y1.min(square_y + side)).step_by(tile as usize) {
                for x in (x0.max(square_x)..x1.min(square_x + side)).step_by(tile as usize) {
                    let here = Square { x, y, side: tile };
                    if !tile::measure(level, here, around, samples, nodes, &mut buffers, &mut local) {
                        cells::measure(level, here, around, samples, nodes, &mut local);
                    }
                }
            }
            let half = side / 2;
            let centres = if level.is_multiple_of(2) {
                [Some([square_x + half, square_y + half]), None, None, None]
            } else {
                [
                    Some([square_x + half, square_y]),
                    Some([square_x + side, square_y + half]),
                    Some([square_x + half, square_y + side]),
                    Some([square_x, square_y + half]),
                ]
            };
            for (centre, here) in centres.into_iter().zip(local) {
                if let Some(d) = centre.and_then(|c| forest.diamond(c)).filter(|_| here != Found::default()) {
                    found.entry(d).or_default().merge(here);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// What `cells` alone finds.
    fn by_cells(forest: &Forest, level: u32, samples: &Samples<'_>, nodes: Nodes<'_>) -> Vec<[Found; 4]> {
        let side = 1u32 << (forest.root_log2() - level / 2);
        let tile = samples.tile.min(side);
        let mut all = Vec::new();
        squares(samples, side, tile, |here, around| {
            let mut local = [Found::default(); 4];
            cells::measure(level, here, around, samples, nodes, &mut local);
            all.push(local);
        });
        all
    }

    /// What `tile` finds, and `cells` where it declines; how often it did not.
    fn by_tiles(
        forest: &Forest,
        level: u32,
        samples: &Samples<'_>,
        nodes: Nodes<'_>,
    ) -> (Vec<[Found; 4]>, usize) {
        let side = 1u32 << (forest.root_log2() - level / 2);
        let tile = samples.tile.min(side);
        let (mut all, mut taken) = (Vec::new(), 0);
        let mut buffers = tile::Buffers::default();
        squares(samples, side, tile, |here, around| {
            let mut local = [Found::default(); 4];
            if tile::measure(level, here, around, samples, nodes, &mut buffers, &mut local) {
                taken += 1;
            } else {
                cells::measure(level, here, around, samples, nodes, &mut local);
            }
            all.push(local);
        });
        (all, taken)
    }

    fn squares(samples: &Samples<'_>, side: u32, tile: u32, mut visit: impl FnMut(Square, Square)) {
        let [x0, y0] = samples.origin;
        for y in (y0..y0 + samples.cells[1]).step_by(tile as usize) {
            for x in (x0..x0 + samples.cells[0]).step_by(tile as usize) {
                let around = Square { x: x & !(side - 1), y: y & !(side - 1), side };
                visit(Square { x, y, side: tile }, around);
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]
        #[test]
        fn tiles_find_what_cells_find_to_the_bit(
            seed in any::<u64>(),
            roughness in prop::sample::select(vec![1i32, 300, (1 << 24) - 1]),
            holes in prop::sample::select(vec![0u64, 0, 0, 7, 2000]),
            corner in (0u32..4, 0u32..4),
        ) {
            // Chunks of 64 cells in two roots of 256, and so lattices both finer and coarser than a tile.
            let forest = Forest::new(8, 2, [2, 1]).unwrap();
            let [w, h] = forest.size();
            let mut state = seed | 1;
            let mut dice = move || {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                state
            };
            let mut height = || {
                let value = i32::try_from(dice() % (2 * roughness.unsigned_abs() as u64 + 1)).unwrap() - roughness;
                if holes > 0 && dice() % holes == 0 { NODATA } else { value }
            };
            let whole: Vec<i32> = (0..(w + 1) * (h + 1)).map(|_| height()).collect();
            let origin = [corner.0 * 64 + if seed % 2 == 0 { 256 } else { 0 }, corner.1 * 64];
            let at = |x: u32, y: u32| whole[(y * (w + 1) + x) as usize];
            let part: Vec<i32> = (origin[1]..=origin[1] + 64)
                .flat_map(|y| (origin[0]..=origin[0] + 64).map(move |x| at(x, y)))
                .collect();
            let samples = Samples::new(origin, [64, 64], &part);
            for level in 1..forest.levels() {
                let spacing_log2 = forest.root_log2() - forest.patch_log2() - level.div_ceil(2);
                let step = 1u32 << spacing_log2;
                // Nodes have a height where the source has, though another one.
                let drawn: Vec<i32> = (0..=h).step_by(step as usize)
                    .flat_map(|y| (0..=w).step_by(step as usize).map(move |x| (x, y)))
                    .map(|(x, y)| {
                        let meaningless = level % 2 == 1 && (x / step + y / step) % 2 == 1;
                        let here = at(x, y);
                        if meaningless || here == NODATA { NODATA } else { here / 2 }
                    })
                    .collect();
                let nodes =
                    Nodes { spacing_log2, origin: [0, 0], width: (w / step + 1) as usize, heights: &drawn };
                let expected = by_cells(&forest, level, &samples, nodes);
                let (found, taken) = by_tiles(&forest, level, &samples, nodes);
                prop_assert_eq!(&found, &expected, "level {}", level);
                prop_assert!(holes > 0 || taken == found.len(), "nothing is left to the slow way");
            }
        }
    }
}

//! A square field of heights that experiments work on.
//!
//! Heights are metres in `f64`, NaN for no data, rows from the south: a window of a DEM of (2^k + 1)^2
//! samples, padded with no data where it leaves the DEM. They are rounded to 28 bits below the power of two
//! above the largest (4000 m: to 8 µm; windows refuse heights so large that it would be a millimetre), which changes nothing in integers: then all means of means down to
//! the finest level are exact in `f64`, and an error of 0 is 0.

use super::scan::rows;
use crate::ingest::{IngestError, Source};
use diamantina_protocol::bintree::Point;
use diamantina_protocol::bitree::{self, Bitree, LOG2_MAX};

/// Bits of a height; with the 24 halvings of the deepest grid and a sign they fit the 53 of `f64`.
const MANTISSA_BITS: f64 = 28.0;

/// Heights on a square grid.
#[derive(Debug, Clone)]
pub struct Field {
    log2: u8,
    heights: Vec<f64>,
    cell: [f64; 2],
    quantum: f64,
}

impl Field {
    /// A field of 2^`log2` cells a side, heights in metres row by row from the south, samples `cell` metres
    /// apart along x and y. `None` unless `log2` is 1 to [`LOG2_MAX`], there are (2^`log2` + 1)^2 heights,
    /// at least one of which is a number, and none infinite.
    #[must_use]
    pub fn new(log2: u8, mut heights: Vec<f64>, cell: [f64; 2]) -> Option<Self> {
        let points = ((1usize << log2.min(LOG2_MAX)) + 1).pow(2);
        let known = heights.iter().any(|h| !h.is_nan()) && !heights.iter().any(|h| h.is_infinite());
        let fits = (1..=LOG2_MAX).contains(&log2) && heights.len() == points && known;
        if !fits {
            return None;
        }
        let largest = heights.iter().fold(0.0f64, |most, h| most.max(h.abs()));
        // Below 2^-900 a height is nothing, and its quantum could not be told.
        let quantum = (largest.log2().ceil().max(-900.0) - MANTISSA_BITS).exp2();
        for h in &mut heights {
            *h = (*h / quantum).round() * quantum;
        }
        Some(Self { log2, heights, cell, quantum })
    }

    /// How far a height may be off its source's for being rounded, in metres: no error of a mesh tells of it.
    #[must_use]
    pub fn rounding(&self) -> f64 {
        self.quantum / 2.0
    }

    /// The window of a source with its south-west sample at `origin`, padded with no data. `None` where it has
    /// no data at all.
    ///
    /// # Errors
    /// When the source cannot be read.
    pub fn read(source: &Source, origin: Point, log2: u8) -> Result<Option<Self>, IngestError> {
        let grid = source.grid();
        let row = (1usize << log2) + 1;
        let mut heights = vec![f64::NAN; row * row];
        let there = |from: u32, all: u32| ((1u32 << log2) + 1).min(all.saturating_sub(from));
        let [width, height] = [there(origin[0], grid.width), there(origin[1], grid.height)];
        if width > 0 && height > 0 {
            let mut values = Vec::new();
            source.read(origin[0], origin[1], width, height, &mut values)?;
            for (to, from) in heights.chunks_mut(row).zip(values.chunks(width as usize)) {
                for (h, v) in to.iter_mut().zip(from) {
                    *h = v * grid.height_scale + grid.height_offset;
                }
            }
        }
        Ok(Self::new(log2, heights, grid.cell))
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

    /// Samples along a side.
    #[must_use]
    pub fn row(&self) -> usize {
        self.side() as usize + 1
    }

    /// Metres between samples along x and y.
    #[must_use]
    pub fn cell(&self) -> [f64; 2] {
        self.cell
    }

    /// All heights, rows from the south, metres; NaN for no data.
    #[must_use]
    pub fn heights(&self) -> &[f64] {
        &self.heights
    }

    /// Where a point stands among the heights.
    #[must_use]
    pub fn slot(&self, [x, y]: Point) -> usize {
        y as usize * self.row() + x as usize
    }

    /// The height of a point of the grid, NaN for no data.
    #[must_use]
    pub fn at(&self, point: Point) -> f64 {
        self.heights[self.slot(point)]
    }

    /// The coarsest sample with data below a triangle of the bintree, its corners apart: what it can split at where its middle
    /// has none. The first by rows among those of a level; `None` if it knows nothing but its corners.
    #[must_use]
    pub fn known_below(&self, corners: [Point; 3]) -> Option<Point> {
        let mut best: Option<(u32, Point)> = None;
        rows(corners, |y, first, last| {
            for p in (first..=last).map(|x| [x, y]).filter(|p| !corners.contains(p)) {
                let level = bitree::level(self.log2, p);
                if best.is_none_or(|(coarsest, _)| level < coarsest) && !self.at(p).is_nan() {
                    best = Some((level, p));
                }
            }
            true
        });
        best.map(|(_, p)| p)
    }

    /// Samples that have data.
    #[must_use]
    pub fn samples(&self) -> usize {
        self.heights.iter().filter(|h| !h.is_nan()).count()
    }

    /// Lowest and highest height, metres.
    #[must_use]
    pub fn range(&self) -> [f64; 2] {
        self.heights
            .iter()
            .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], h| [low.min(*h), high.max(*h)])
    }

    /// Highest less lowest height, metres.
    #[must_use]
    pub fn relief(&self) -> f64 {
        let [low, high] = self.range();
        high - low
    }

    /// Heights for the corners of a mesh, which always needs them: south-west, south-east, north-east and
    /// north-west, each of the nearest sample that has data.
    #[must_use]
    pub fn corners(&self) -> [f64; 4] {
        self.outermost().map(|corner| self.nearest(corner))
    }

    /// A bitree of the corners alone.
    #[must_use]
    pub fn tree(&self) -> Bitree {
        Bitree::new(self.log2, self.corners())
            .expect("a field has the limits of a bitree, and its corners are known")
    }

    /// A bitree of every sample that has data.
    #[must_use]
    pub fn full_tree(&self) -> Bitree {
        let mut heights = self.heights.clone();
        for (corner, height) in self.outermost().into_iter().zip(self.corners()) {
            heights[self.slot(corner)] = height;
        }
        Bitree::of(self.log2, heights).expect("a field has the limits of a bitree, and its corners are known")
    }

    /// The point that stands at a place among the heights.
    #[must_use]
    pub fn point(&self, slot: usize) -> Point {
        // A row has at most 4097 samples.
        [slot % self.row(), slot / self.row()].map(|v| u32::try_from(v).unwrap_or(u32::MAX))
    }

    /// South-west, south-east, north-east, north-west.
    #[must_use]
    pub fn outermost(&self) -> [Point; 4] {
        let side = self.side();
        [[0, 0], [side, 0], [side, side], [0, side]]
    }

    fn nearest(&self, corner: Point) -> f64 {
        if !self.at(corner).is_nan() {
            return self.at(corner);
        }
        let mut best = (u64::MAX, 0.0);
        for (row, y) in self.heights.chunks(self.row()).zip(0u64..) {
            for (h, x) in row.iter().zip(0u64..).filter(|(h, _)| !h.is_nan()) {
                let [dx, dy] = [x.abs_diff(corner[0].into()), y.abs_diff(corner[1].into())];
                if dx * dx + dy * dy < best.0 {
                    best = (dx * dx + dy * dy, *h);
                }
            }
        }
        best.1
    }
}

//! Rasters whose samples lie tile by tile in memory.

/// The base-2 logarithm of a tile's side in samples: a tile of heights fills a line of the processor's cache.
const TILE_LOG2: u32 = 2;

/// A raster kept tile by tile, so that samples which are near are near in memory, whatever way a walk takes. Rows of
/// samples would make each step along a column another page of memory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tiled<T> {
    size: [usize; 2],
    items: Vec<T>,
}

impl<T> Tiled<T> {
    /// Items in the order of this raster's tiles: some more than samples, as all tiles are whole.
    pub(super) fn like<U>(&self, items: Vec<U>) -> Tiled<U> {
        assert_eq!(items.len(), self.items.len(), "an item for each");
        Tiled { size: self.size, items }
    }

    /// Samples along x and y.
    #[must_use]
    pub fn size(&self) -> [usize; 2] {
        self.size
    }

    pub(super) fn items(&self) -> &[T] {
        &self.items
    }

    /// What to add for a column and for a row: an item stands where the sum of both says.
    pub(super) fn offset(&self, axis: usize, w: usize) -> usize {
        let (tile, inner) = (w >> TILE_LOG2, w & ((1 << TILE_LOG2) - 1));
        if axis == 0 {
            (tile << (2 * TILE_LOG2)) + inner
        } else {
            ((tile * tiles(self.size[0])) << (2 * TILE_LOG2)) + (inner << TILE_LOG2)
        }
    }

    pub(super) fn index(&self, [x, y]: [usize; 2]) -> usize {
        self.offset(0, x) + self.offset(1, y)
    }
}

fn tiles(samples: usize) -> usize {
    samples.div_ceil(1 << TILE_LOG2)
}

impl<T: Copy> Tiled<T> {
    /// A raster of one item.
    #[must_use]
    pub fn filled(size: [usize; 2], item: T) -> Self {
        Self { size, items: vec![item; size.map(tiles).iter().product::<usize>() << (2 * TILE_LOG2)] }
    }

    /// The item of a sample.
    #[must_use]
    pub fn at(&self, place: [usize; 2]) -> T {
        self.items[self.index(place)]
    }

    /// Changes the item of a sample.
    pub fn set(&mut self, place: [usize; 2], item: T) {
        let index = self.index(place);
        self.items[index] = item;
    }

    /// All samples' items, row by row from the south.
    pub fn rows(&self) -> impl Iterator<Item = T> + '_ {
        let [width, height] = self.size;
        (0..height).flat_map(move |y| (0..width).map(move |x| self.at([x, y])))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_sample_has_its_own_item() {
        for size in [[1, 1], [4, 4], [5, 9], [13, 2]] {
            let mut raster = Tiled::filled(size, usize::MAX);
            for i in 0..size[0] * size[1] {
                raster.set([i % size[0], i / size[0]], i);
            }
            assert!(raster.rows().eq(0..size[0] * size[1]), "{size:?}");
            assert_eq!(raster.items().len() % (1 << (2 * TILE_LOG2)), 0);
        }
    }
}

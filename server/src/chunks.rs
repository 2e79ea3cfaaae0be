//! Squares of the quadtree that can be worked on one by one, once the levels above them are done.
//!
//! A chunk's diamonds are those that overlap it. They need nothing but one another's parents and what the
//! coarse levels left, so chunks are independent: what straddles a border is computed on both sides,
//! with the same result, and counted by its owner alone. That keeps memory to a few chunks' worth.

use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use std::collections::BTreeSet;

/// The squares of one depth of a forest's quadtree.
#[derive(Debug, Clone, Copy)]
pub struct Chunks {
    forest: Forest,
    /// The diamonds of twice this level are centred in the chunks.
    depth: u32,
}

impl Chunks {
    /// Chunks of 2^`side_log2` cells a side, or as near to that as a chunk can be: a root square at most, two
    /// patches at least.
    #[must_use]
    pub fn new(forest: Forest, side_log2: u32) -> Self {
        let side_log2 = side_log2.max(forest.patch_log2() + 1).min(forest.root_log2());
        Self { forest, depth: forest.root_log2() - side_log2 }
    }

    /// The first level that belongs to the chunks; those above are the coarse levels.
    #[must_use]
    pub fn level(&self) -> u32 {
        2 * self.depth
    }

    /// Base-2 logarithm of a chunk's side, in cells.
    #[must_use]
    pub fn side_log2(&self) -> u32 {
        self.forest.root_log2() - self.depth
    }

    /// South-west corners of all chunks, south row first.
    #[must_use]
    pub fn corners(&self) -> Vec<[u32; 2]> {
        let [w, h] = self.forest.size();
        let side = 1u32 << self.side_log2();
        (0..h / side).flat_map(|j| (0..w / side).map(move |i| [i * side, j * side])).collect()
    }

    /// Whether the chunk at `corner` is the one that counts a diamond: it contains the centre, or the
    /// centre lies on the forest's own east or north border and it touches that.
    #[must_use]
    pub fn owns(&self, corner: [u32; 2], d: Diamond) -> bool {
        let side = 1u32 << self.side_log2();
        let size = self.forest.size();
        (0..2).all(|axis| {
            let at = d.centre()[axis].min(size[axis] - 1);
            (corner[axis]..corner[axis] + side).contains(&at)
        })
    }

    /// The diamonds that a chunk must compute, by level from [`Chunks::level`]: all that overlap it, and
    /// their ancestors.
    #[must_use]
    pub fn needed(&self, corner: [u32; 2]) -> Vec<BTreeSet<Diamond>> {
        let forest = &self.forest;
        let side = 1u32 << self.side_log2();
        let far = corner.map(|w| w + side);
        let mut levels = vec![BTreeSet::new(); (forest.levels() - self.level()) as usize];
        // Downward: children of what overlaps, if they overlap.
        let overlaps = |d: Diamond| {
            let [low, high] = forest.bounds(d);
            (0..2).all(|axis| low[axis] < far[axis] && high[axis] > corner[axis])
        };
        if let (Some(first), Some(own)) = (levels.first_mut(), forest.diamond(corner.map(|w| w + side / 2))) {
            first.insert(own);
        }
        for i in 1..levels.len() {
            let children = levels[i - 1].iter().flat_map(|d| forest.children(*d)).flatten();
            levels[i] = children.filter(|d| overlaps(*d)).collect();
        }
        // Upward: the other parents of what straddles the border.
        for i in (1..levels.len()).rev() {
            let parents: Vec<_> = levels[i].iter().flat_map(|d| forest.parents(*d)).collect();
            levels[i - 1].extend(parents);
        }
        levels
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    #[test]
    fn each_diamond_has_one_owner_which_needs_it_and_its_parents() {
        let forest = Forest::new(6, 2, [2, 1]).unwrap();
        let chunks = Chunks::new(forest, 4);
        let mut owners: BTreeMap<Diamond, u32> = BTreeMap::new();
        for corner in chunks.corners() {
            let needed = chunks.needed(corner);
            for (i, level) in needed.iter().enumerate() {
                for d in level {
                    assert_eq!(d.level() as usize, chunks.level() as usize + i);
                    if chunks.owns(corner, *d) {
                        *owners.entry(*d).or_default() += 1;
                    }
                    if i > 0 {
                        assert!(forest.parents(*d).all(|p| needed[i - 1].contains(&p)), "{d:?}");
                    }
                }
            }
        }
        for level in chunks.level()..forest.levels() {
            for d in forest.diamonds(level) {
                assert_eq!(owners.get(&d), Some(&1), "{d:?}");
            }
        }
    }
}

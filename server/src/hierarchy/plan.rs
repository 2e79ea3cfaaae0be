//! How the forest is divided so that a build stays within its memory.
//!
//! | what | bytes | while |
//! |---|---|---|
//! | the program, its threads, the source's cache of strips and tiles | 96 MiB | always |
//! | rows of the source | an eighth of what is granted | reading |
//! | coarse levels: heights of each, blocks of the last two | 40 a point of the chunks' lattice | coding |
//! | a chunk, for each worker: windows 9, surface 4, blocks of two levels 8, a third for the allocator | 28 a cell | coding |
//! | a diamond's tally, place in the spool, entry, place in a pack, line of the directory; those of other layers, too | 136 | coding, then publishing |

#![allow(clippy::cast_possible_truncation, reason = "levels are fewer than 64")]

use super::BuildError;
use super::tallies::places_of_all;
use crate::chunks::Chunks;
use diamantina_protocol::bintree::Forest;

/// Chunks are not made larger than this, but to make the coarse levels fit: more work would be lost by a kill.
const CHUNK_LOG2_MAX: u32 = 12;
/// What does not grow with the source.
const BASE_BYTES: u64 = 96 << 20;
/// See the table.
const COARSE_POINT_BYTES: u64 = 40;
/// See the table; halo included, which is a quarter more at chunks of 1024 cells and less at larger ones.
const CHUNK_CELL_BYTES: u64 = 28;
/// 24 (tally) + 16 (entry) + 40 (spool) + 40 (pack) + 32 (directory), less what is given back in between.
const DIAMOND_BYTES: u64 = 136;

/// The most levels past the finest lattice. More would have very small diamonds; where they are too few, each
/// makes steps finer by more than one factor of three.
const PRECISION_MAX: u8 = 3;
/// Diamonds beyond which there are fewer such levels, so that the index does not outgrow the memory: sources of
/// 4 x 10^9 samples and more, with 64 segments.
const PLACES_MAX: u64 = 1 << 23;

/// How the forest is divided for the build.
#[derive(Debug, Clone, Copy)]
pub(super) struct Plan {
    pub(super) forest: Forest,
    /// The squares that are built one by one.
    pub(super) chunks: Chunks,
    /// Rows that are read at once, as a share of the memory.
    pub(super) band_bytes: u64,
    /// Chunks that may be worked on at once.
    pub(super) workers: usize,
    /// The most memory that coding may take, in bytes.
    pub(super) memory: u64,
}

impl Plan {
    /// For a forest that may yet get levels past its finest lattice: there is room for as many as there can be.
    /// `aside` is the memory that is not to be used, of all that is granted.
    pub(super) fn new(forest: Forest, granted: u64, aside: u64) -> Result<Self, BuildError> {
        let memory = granted.saturating_sub(aside);
        let forest = widest(forest);
        let [w, h] = forest.size().map(u64::from);
        let threads = rayon::current_num_threads() as u64;
        // Chunks of 1024 cells, or larger where the coarse levels would otherwise not fit.
        let chunk_logs = 10.max(forest.patch_log2() + 2).min(forest.root_log2())..=forest.root_log2();
        let coarse_bytes = |chunk_log2: u32| {
            let spacing = chunk_log2 - forest.patch_log2();
            ((w >> spacing) + 1) * ((h >> spacing) + 1) * COARSE_POINT_BYTES
        };
        let chunk_bytes = |chunk_log2: u32| CHUNK_CELL_BYTES << (2 * chunk_log2);
        let always =
            |chunk_log2: u32| BASE_BYTES + coarse_bytes(chunk_log2) + places_of_all(&forest) * DIAMOND_BYTES;
        let needed = |chunk_log2: u32| {
            // The coarse levels should take no more than a quarter, where larger chunks could still help.
            let share = if chunk_log2 < forest.root_log2() { 4 } else { 1 };
            (always(chunk_log2) + chunk_bytes(chunk_log2)).max(share * coarse_bytes(chunk_log2))
        };
        let Some(least_log2) = chunk_logs.clone().find(|log2| needed(*log2) <= memory) else {
            let least = chunk_logs.map(needed).min().unwrap_or(u64::MAX);
            return Err(BuildError::Memory { asked: granted, needed: least.saturating_add(aside) });
        };
        // Larger ones compute less twice, along their borders: two fifths more at 1024 cells, a fifth at 2048. As
        // long as there are enough to keep all cores busy. Cores and not threads: a build may be gone on with by
        // other threads, and needs the same chunks then.
        let cores = std::thread::available_parallelism().map_or(1, |n| n.get() as u64);
        let count = |log2: u32| (w >> log2) * (h >> log2);
        let suits = |log2: &u32| {
            let busy = always(*log2) + cores * chunk_bytes(*log2) <= memory && count(*log2) >= 4 * cores;
            busy && *log2 <= CHUNK_LOG2_MAX && needed(*log2) <= memory
        };
        let chunk_log2 = (least_log2 + 1..=forest.root_log2()).take_while(suits).last().unwrap_or(least_log2);
        let (always, chunk_bytes) = (always(chunk_log2), chunk_bytes(chunk_log2));
        let workers = ((memory - always) / chunk_bytes).clamp(1, threads);
        let chunks = Chunks::new(forest, chunk_log2);
        Ok(Self {
            forest,
            chunks,
            band_bytes: memory / 8 / threads,
            workers: usize::try_from(workers).unwrap_or(1),
            memory: always + workers * chunk_bytes,
        })
    }

    /// The most levels past the finest lattice that there is room for.
    pub(super) fn precision_max(&self) -> u8 {
        (self.forest.levels() - self.forest.lattice_levels()) as u8
    }

    /// The same plan with as many levels past the finest lattice, if there is room for them.
    pub(super) fn with_precision(&self, levels: u8) -> Self {
        let forest = self.forest.with_precision(levels.min(self.precision_max())).unwrap_or(self.forest);
        Self { forest, chunks: Chunks::new(forest, self.chunks.side_log2()), ..*self }
    }

    /// Base-2 logarithm of the spacing of the lattice of a level: that of the canvas plane with all its
    /// points. Of an odd level half of the plane's points are its own.
    pub(super) fn spacing_log2(&self, level: u32) -> u32 {
        let level = level.min(self.forest.lattice_levels());
        self.forest.root_log2() - self.forest.patch_log2() - level.div_ceil(2)
    }

    /// Base-2 logarithm of the spacing of the coarsest plane of the canvas.
    pub(super) fn coarsest(&self) -> u32 {
        self.spacing_log2(self.chunks.level())
    }
}

/// What is known of the diamonds of a layer while another one is built, in bytes, triangles aside.
pub(super) fn held_bytes(forest: &Forest) -> u64 {
    places_of_all(&widest(*forest)) * DIAMOND_BYTES
}

/// The forest with as many levels past its finest lattice as a build makes at most.
fn widest(forest: Forest) -> Forest {
    let fits = |forest: &Forest| places_of_all(forest) <= PLACES_MAX;
    let all = (1..=PRECISION_MAX).filter_map(|levels| forest.with_precision(levels).ok());
    all.take_while(fits).last().unwrap_or(forest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ten_thousand_million_samples_fit_the_memory_that_is_granted_by_default() {
        let forest = Forest::covering(100_000, 100_000, 6).unwrap();
        let granted = 2 << 30;
        let plan = Plan::new(forest, granted, 0).unwrap();
        assert!(plan.memory <= granted, "{} bytes", plan.memory);
        assert_eq!(plan.workers, rayon::current_num_threads().min(2), "two cores have work");
    }
}

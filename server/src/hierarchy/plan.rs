//! How the forest is divided so that a build stays within its memory.

use super::BuildError;
use crate::chunks::Chunks;
use diamantina_protocol::bintree::Forest;

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
}

impl Plan {
    pub(super) fn new(forest: Forest, memory: u64) -> Result<Self, BuildError> {
        let [w, h] = forest.size().map(u64::from);
        let threads = rayon::current_num_threads() as u64;
        // Chunks of 1024 cells, or larger where the coarse levels would otherwise not fit.
        let chunk_logs = 10.max(forest.patch_log2() + 2).min(forest.root_log2())..=forest.root_log2();
        let coarse_bytes = |chunk_log2: u32| {
            let spacing = chunk_log2 - forest.patch_log2();
            // Heights of all coarse levels, and the blocks of the last three: about 40 bytes a point.
            ((w >> spacing) + 1) * ((h >> spacing) + 1) * 40
        };
        // A chunk's windows, blocks and surfaces: measured at about 40 bytes a cell, halo included.
        let chunk_bytes = |chunk_log2: u32| 40u64 << (2 * chunk_log2);
        let base = 96 << 20;
        let needed = |chunk_log2: u32| {
            // The coarse levels should take no more than a quarter, where larger chunks could still help.
            let share = if chunk_log2 < forest.root_log2() { 4 } else { 1 };
            let coarse = coarse_bytes(chunk_log2);
            (base + coarse + chunk_bytes(chunk_log2)).max(share * coarse)
        };
        let Some(chunk_log2) = chunk_logs.clone().find(|log2| needed(*log2) <= memory) else {
            let least = chunk_logs.map(needed).min().unwrap_or(u64::MAX);
            return Err(BuildError::Memory { asked: memory, needed: least });
        };
        let chunk_bytes = chunk_bytes(chunk_log2);
        let workers = ((memory - base - coarse_bytes(chunk_log2)) / 2 / chunk_bytes).clamp(1, threads);
        let chunks = Chunks::new(forest, chunk_log2);
        Ok(Self { forest, chunks, band_bytes: memory / 8 / threads, workers: workers as usize })
    }

    /// Base-2 logarithm of the spacing of the lattice of a level: that of the canvas plane with all its
    /// points. Of an odd level half of the plane's points are its own.
    pub(super) fn spacing_log2(&self, level: u32) -> u32 {
        self.forest.root_log2() - self.forest.patch_log2() - level.div_ceil(2)
    }
}

//! Codes every diamond: the coarse levels in memory, then chunk by chunk.

#![allow(clippy::cast_possible_truncation, reason = "the levels of a forest are fewer than 64")]

use super::coding::Coded;
use super::surface::Surface;
use super::{Build, BuildError};
use crate::canvas::Window;
use crate::measure::{Found, Samples, measure};
use crate::progress::Progress;
use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::points;
use rayon::prelude::*;
use std::collections::HashMap;

/// What the workers collect.
#[derive(Debug, Default)]
pub(super) struct Tallies {
    pub(super) ranges: HashMap<Diamond, Coded>,
    pub(super) found: HashMap<Diamond, Found>,
    pub(super) finest: f64,
}

/// What the coarse levels leave: the heights that each level draws.
#[derive(Debug)]
pub(super) struct Coarse {
    /// By level, from 0 to the chunks' level.
    pub(super) surfaces: Vec<Surface>,
}

/// A key that sorts blobs as a viewer descends: index pages first, then level by level along the Morton
/// curve.
pub(super) fn blob_order(forest: &Forest, d: Diamond) -> u64 {
    let spread = |v: u32| {
        let mut v = u64::from(v) & 0x0fff_ffff;
        for (shift, mask) in [
            (16, 0x0000_ffff_0000_ffff_u64),
            (8, 0x00ff_00ff_00ff_00ff),
            (4, 0x0f0f_0f0f_0f0f_0f0f),
            (2, 0x3333_3333_3333_3333),
            (1, 0x5555_5555_5555_5555),
        ] {
            v = (v | v << shift) & mask;
        }
        v
    };
    let [x, y] = d.centre();
    // 2 x 27 bits below 6 bits of level: diamonds of a level lie at least two cells apart.
    debug_assert!(forest.levels() < 63);
    u64::from(d.level() + 1) << 56 | spread(x >> 1) | spread(y >> 1) << 1
}

impl Build<'_> {
    /// The source heights of a diamond's block.
    fn source_block(&self, d: Diamond, window: &Window) -> Block {
        let mut block = Block::empty(&self.plan.forest);
        block.fill(&self.plan.forest.local(d), |x, y| window.at(x, y));
        block
    }

    /// Codes every level above the chunks.
    pub(super) fn coarse_levels(&self) -> Result<Coarse, BuildError> {
        let forest = &self.plan.forest;
        let size = forest.size();
        let chunk_level = self.plan.chunks.level();
        let plane = self.plan.spacing_log2(chunk_level);
        let window = self.canvas.read(plane, [0, 0], size).map_err(self.work())?;
        let mut surfaces = vec![Surface::new(self.plan.spacing_log2(0), [0, 0], size)];
        let mut before: HashMap<Diamond, Block> = HashMap::new();
        for level in 0..chunk_level {
            let coded: Vec<_> = forest
                .diamonds(level)
                .collect::<Vec<_>>()
                .into_par_iter()
                .map(|d| {
                    let mut block = inherited(forest, &before, d);
                    let coded = self.code(d, &mut block, &self.source_block(d, &window))?;
                    Ok((d, block, coded))
                })
                .collect::<Result<_, BuildError>>()?;
            let mut surface = Surface::new(self.plan.spacing_log2(level + 1), [0, 0], size);
            before.clear();
            let mut tallies = self.tallies.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            for (d, block, (_, range)) in coded {
                surface.draw(forest, d, &block, size);
                tallies.ranges.insert(d, range);
                before.insert(d, block);
            }
            drop(tallies);
            surfaces.push(surface);
        }
        Ok(Coarse { surfaces })
    }

    /// Codes all chunks.
    pub(super) fn chunks(&self, coarse: &Coarse, progress: &Progress) -> Result<(), BuildError> {
        let chunks = self.plan.chunks.corners();
        let cells = 1u64 << (2 * self.plan.chunks.side_log2());
        progress.stage("build", chunks.len() as u64 * cells);
        let next = std::sync::atomic::AtomicUsize::new(0);
        // As many workers as the memory allows, each taking the next chunk when it is done with one.
        (0..self.plan.workers).into_par_iter().try_for_each(|_| {
            while let Some(corner) = chunks.get(next.fetch_add(1, std::sync::atomic::Ordering::Relaxed)) {
                self.chunk(*corner, coarse)?;
                progress.advance(cells);
            }
            Ok(())
        })
    }

    /// Codes the diamonds that a chunk owns and compares its samples with the surface of every level.
    fn chunk(&self, corner: [u32; 2], coarse: &Coarse) -> Result<(), BuildError> {
        let forest = &self.plan.forest;
        let side = 1u32 << self.plan.chunks.side_log2();
        let cells = [side, side];
        let far = corner.map(|w| w + side);
        // Beyond the source there is nothing, but for what straddles the border by half a chunk.
        if corner[0] > self.grid.width + side || corner[1] > self.grid.height + side {
            return Ok(());
        }
        let samples = self.canvas.read(0, corner, far).map_err(self.work())?;
        let (ranges, surfaces) = self.chunk_diamonds(corner, coarse)?;
        let mut found = HashMap::new();
        let mut finest = 0.0f64;
        if !samples.is_empty() {
            let heights: Vec<i32> = samples.rows().flatten().copied().collect();
            let samples = Samples { origin: corner, cells, heights: &heights };
            let coarse_levels =
                coarse.surfaces.iter().take(self.plan.chunks.level() as usize + 1).enumerate();
            for (level, surface) in coarse_levels.skip(1) {
                measure(forest, level as u32, samples, |x, y| surface.at(x, y), &mut found);
            }
            let first = self.plan.chunks.level() + 1;
            for (level, surface) in (first..forest.levels()).zip(&surfaces) {
                measure(forest, level, samples, |x, y| surface.at(x, y), &mut found);
            }
            if let Some(last) = surfaces.last() {
                let worst = last
                    .heights
                    .iter()
                    .zip(&heights)
                    .filter(|(_, s)| **s != NODATA)
                    .map(|(h, s)| h.abs_diff(*s))
                    .max();
                finest = f64::from(worst.unwrap_or(0));
            }
        }
        let mut tallies = self.tallies.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        tallies.ranges.extend(ranges);
        for (d, here) in found {
            tallies.found.entry(d).or_default().merge(here);
        }
        tallies.finest = tallies.finest.max(finest);
        Ok(())
    }

    /// The diamonds of a chunk, level by level: ranges of those that it owns, and the surfaces of the
    /// levels below the chunk's own, over the chunk.
    #[allow(
        clippy::type_complexity,
        reason = "two results of one pass, taken apart at once by the only caller"
    )]
    fn chunk_diamonds(
        &self,
        corner: [u32; 2],
        coarse: &Coarse,
    ) -> Result<(Vec<(Diamond, Coded)>, Vec<Surface>), BuildError> {
        let forest = &self.plan.forest;
        let side = 1u32 << self.plan.chunks.side_log2();
        let needed = self.plan.chunks.needed(corner);
        let (mut ranges, mut surfaces) = (Vec::new(), Vec::new());
        let mut before: HashMap<Diamond, Block> = HashMap::new();
        for (level, diamonds) in (self.plan.chunks.level()..).zip(&needed) {
            let spacing = self.plan.spacing_log2(level + 1);
            let bounds = diamonds.iter().map(|d| forest.bounds(*d)).reduce(|[a, b], [c, d]| {
                [[a[0].min(c[0]), a[1].min(c[1])], [b[0].max(d[0]), b[1].max(d[1])]]
            });
            let Some([low, high]) = bounds else { continue };
            let window = self.canvas.read(spacing, low, high).map_err(self.work())?;
            let mut surface = Surface::new(spacing, corner, [side, side]);
            let mut here = HashMap::new();
            for d in diamonds {
                let mut block = inherited(forest, &before, *d);
                if level == self.plan.chunks.level() && level > 0 {
                    // The chunks' own level starts from what the coarse levels left.
                    if let Some(last) = coarse.surfaces.last() {
                        let mut whole = Block::empty(forest);
                        whole.fill(&forest.local(*d), |x, y| {
                            let on_lattice = (x | y).trailing_zeros() >= last.spacing_log2;
                            if on_lattice { last.at(x, y) } else { NODATA }
                        });
                        block.parts_mut().0.copy_from_slice(whole.parts().0);
                    }
                }
                let source = self.source_block(*d, &window);
                if self.plan.chunks.owns(corner, *d) {
                    ranges.push(self.code(*d, &mut block, &source)?);
                } else {
                    points::quantise(forest, &self.coding, *d, &mut block, &source);
                }
                surface.draw(forest, *d, &block, [side, side]);
                here.insert(*d, block);
            }
            before = here;
            surfaces.push(surface);
        }
        Ok((ranges, surfaces))
    }
}

/// The block of a diamond with the old points that its parents leave.
fn inherited(forest: &Forest, before: &HashMap<Diamond, Block>, d: Diamond) -> Block {
    let mut block = Block::empty(forest);
    for parent in forest.parents(d) {
        if let Some(from) = before.get(&parent) {
            block.inherit(forest, d, parent, from);
        }
    }
    block
}

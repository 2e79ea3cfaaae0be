//! Codes every diamond: the coarse levels in memory, then chunk by chunk.

#![allow(clippy::cast_possible_truncation, reason = "chunks are fewer than 2^32, levels fewer than 64")]

use super::journal::{Chunk, Coded, Record};
use super::surface::{Surface, source_block};
use super::tallies::Tally;
use super::{Build, BuildError};
use crate::canvas::Window;
use crate::measure::{Found, Samples, measure};
use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::points;
use rayon::prelude::*;
use std::collections::{BTreeSet, HashMap};
use std::sync::PoisonError;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};

/// What the coarse levels leave: the heights that each level draws.
#[derive(Debug)]
pub(super) struct Coarse {
    /// By level, from 0 to the chunks' level.
    pub(super) surfaces: Vec<Surface>,
}

/// A key that sorts blobs as a viewer descends: index pages first, then level by level along the Morton
/// curve.
pub(super) fn blob_order(d: Diamond) -> u64 {
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
    debug_assert!(d.level() < 63);
    u64::from(d.level() + 1) << 56 | spread(x >> 1) | spread(y >> 1) << 1
}

/// The rectangle around some diamonds.
fn bounds<'a>(forest: &Forest, diamonds: impl IntoIterator<Item = &'a Diamond>) -> Option<[[u32; 2]; 2]> {
    diamonds
        .into_iter()
        .map(|d| forest.bounds(*d))
        .reduce(|[a, b], [c, d]| [[a[0].min(c[0]), a[1].min(c[1])], [b[0].max(d[0]), b[1].max(d[1])]])
}

impl Build<'_> {
    /// Codes every level above the chunks.
    pub(super) fn coarse_levels(&self) -> Result<Coarse, BuildError> {
        let forest = &self.plan.forest;
        let size = forest.size();
        let chunk_level = self.plan.chunks.level();
        let plane = self.plan.spacing_log2(chunk_level);
        let window = self.canvas.read(plane, [0, 0], size).map_err(self.work.failure())?;
        let mut surfaces = vec![Surface::new(self.plan.spacing_log2(0), [0, 0], size)];
        let mut before: HashMap<Diamond, Block> = HashMap::new();
        for level in 0..chunk_level {
            let coded: Vec<_> = forest
                .diamonds(level)
                .collect::<Vec<_>>()
                .into_par_iter()
                .map(|d| {
                    if self.work.progress.is_stopping() {
                        return Err(self.interrupted());
                    }
                    let mut block = inherited(forest, &before, d);
                    // The plane is finer than most of these levels.
                    let mut source = Block::empty(forest, level);
                    source.fill(&forest.local(d), |x, y| window.at(x, y));
                    let coded = self.code(d, &mut block, &source)?;
                    Ok((d, block, coded))
                })
                .collect::<Result<_, BuildError>>()?;
            let mut surface = Surface::new(self.plan.spacing_log2(level + 1), [0, 0], size);
            before.clear();
            let mut tallies = self.tallies.lock().unwrap_or_else(PoisonError::into_inner);
            for (d, block, coded) in coded {
                surface.draw(forest, d, &block, size);
                tallies.coded(d, Tally::from(&coded));
                before.insert(d, block);
            }
            drop(tallies);
            surfaces.push(surface);
        }
        Ok(Coarse { surfaces })
    }

    /// Codes all chunks that no earlier run has coded.
    pub(super) fn chunks(&self, coarse: &Coarse) -> Result<(), BuildError> {
        let chunks = self.plan.chunks.corners();
        let cells = 1u64 << (2 * self.plan.chunks.side_log2());
        let (all, before) = (chunks.len() as u64, self.before.len() as u64);
        self.work.progress.stage("build", "samples", all * cells, before * cells);
        let (next, done) = (AtomicUsize::new(0), AtomicU64::new(before));
        let failed = AtomicBool::new(false);
        let go_on = || !self.work.progress.is_stopping() && !failed.load(Ordering::Relaxed);
        // As many workers as the memory allows, each taking the next chunk when it is done with one.
        let worked: Result<(), BuildError> = (0..self.plan.workers).into_par_iter().try_for_each(|_| {
            while go_on() {
                let number = next.fetch_add(1, Ordering::Relaxed);
                let Some(corner) = chunks.get(number) else { break };
                if self.before.contains(&(number as u32)) {
                    continue;
                }
                let chunk = self.chunk(number as u32, *corner, coarse);
                self.finish(chunk).inspect_err(|_| failed.store(true, Ordering::Relaxed))?;
                done.fetch_add(1, Ordering::Relaxed);
                self.work.progress.advance(cells);
            }
            Ok(())
        });
        if let Err(error) = worked
            && !matches!(error, BuildError::Interrupted { .. })
        {
            // What is done may still be kept; the first failure is the one to tell.
            let _ = self.work.checkpoint(&self.canvas);
            return Err(error);
        }
        if done.into_inner() < all {
            self.work.checkpoint(&self.canvas)?;
            return Err(self.interrupted());
        }
        Ok(())
    }

    /// Tallies a chunk and notes it in the journal.
    fn finish(&self, chunk: Result<Chunk, BuildError>) -> Result<(), BuildError> {
        let chunk = chunk?;
        let mut tallies = self.tallies.lock().unwrap_or_else(PoisonError::into_inner);
        tallies.add(&self.plan.forest, &chunk);
        drop(tallies);
        if self.work.note(self.number, &Record::Chunk(chunk)) {
            self.work.checkpoint(&self.canvas)?;
        }
        Ok(())
    }

    /// Codes the diamonds that a chunk owns and compares its samples with the surface of every level.
    fn chunk(&self, number: u32, corner: [u32; 2], coarse: &Coarse) -> Result<Chunk, BuildError> {
        let forest = &self.plan.forest;
        let side = 1u32 << self.plan.chunks.side_log2();
        let cells = [side, side];
        let far = corner.map(|w| w + side);
        let mut chunk = Chunk { number, ..Chunk::default() };
        // Beyond the source there is nothing, but for what straddles the border by half a chunk.
        if corner[0] > self.grid.width + side || corner[1] > self.grid.height + side {
            return Ok(chunk);
        }
        let window = self.canvas.read(0, corner, far).map_err(self.work.failure())?;
        let samples = Samples::new(corner, cells, window.heights());
        let mut found = HashMap::new();
        let own = self.plan.chunks.level();
        if !samples.is_empty() {
            for (level, surface) in coarse.surfaces.iter().enumerate().take(own as usize + 1).skip(1) {
                measure(forest, level as u32, &samples, surface.nodes(), &mut found);
            }
        }
        let mut before: HashMap<Diamond, Block> = HashMap::new();
        let mut around = None;
        for (level, diamonds) in (own..).zip(&self.plan.chunks.needed(corner)) {
            let Some(bounds) = bounds(forest, diamonds) else { continue };
            // Two levels of the lattice share a plane, and those past it the finest. What parents cover holds their
            // children, so the first window that is read of a plane does for all.
            let spacing = self.plan.spacing_log2(level + 1);
            let window = match around.take().filter(|w: &Window| w.spacing_log2() == spacing) {
                Some(window) => window,
                None => self.canvas.read(spacing, bounds[0], bounds[1]).map_err(self.work.failure())?,
            };
            // What the last level of the lattice draws, and those past it, is at the samples' own places: there
            // the diamonds compare themselves.
            let draws = level + 1 < forest.lattice_levels();
            let mut surface = draws.then(|| Surface::new(self.plan.spacing_log2(level + 1), corner, cells));
            let work = Level { corner, level, diamonds, window: &window, before: &before, coarse };
            before = self.chunk_level(&work, surface.as_mut(), &mut chunk)?;
            around = Some(window);
            if let Some(surface) = surface.filter(|_| !samples.is_empty()) {
                measure(forest, level + 1, &samples, surface.nodes(), &mut found);
            }
        }
        chunk.found.extend(found.into_iter().map(|(d, here): (_, Found)| (d.centre(), here)));
        Ok(chunk)
    }

    /// Codes the diamonds of one level of a chunk, those that it owns for good, and draws all, if there is
    /// something to draw to. Their blocks.
    fn chunk_level(
        &self,
        work: &Level<'_>,
        mut surface: Option<&mut Surface>,
        chunk: &mut Chunk,
    ) -> Result<HashMap<Diamond, Block>, BuildError> {
        let forest = &self.plan.forest;
        let side = 1u32 << self.plan.chunks.side_log2();
        let &Level { corner, level, diamonds, window, before, coarse } = work;
        let mut here = HashMap::with_capacity(diamonds.len());
        for d in diamonds {
            if self.work.progress.is_out_of_patience() {
                return Err(self.interrupted());
            }
            let mut block = inherited(forest, before, *d);
            if level == self.plan.chunks.level() && level > 0 {
                take_over(forest, *d, coarse, &mut block);
            }
            let source = source_block(forest, *d, window);
            if self.plan.chunks.owns(corner, *d) {
                if !forest.adds_points(level) {
                    let vertical = distance(&block, &source);
                    chunk.found.push((d.centre(), Found { vertical, outline: false }));
                }
                chunk.coded.push(self.code(*d, &mut block, &source)?);
                if level + 1 == forest.levels() {
                    chunk.finest = chunk.finest.max(distance(&block, &source));
                }
            } else {
                points::quantise(forest, &self.coding, *d, &mut block, &source);
            }
            if let Some(surface) = &mut surface {
                surface.draw(forest, *d, &block, [side, side]);
            }
            here.insert(*d, block);
        }
        Ok(here)
    }
}

/// What a level of a chunk is made from. The chunk is given by its corner; the window holds the samples of all of
/// the diamonds.
struct Level<'a> {
    corner: [u32; 2],
    level: u32,
    diamonds: &'a BTreeSet<Diamond>,
    window: &'a Window,
    before: &'a HashMap<Diamond, Block>,
    coarse: &'a Coarse,
}

/// The old points of a diamond of the chunks' own level, which starts from what the coarse levels left.
fn take_over(forest: &Forest, d: Diamond, coarse: &Coarse, block: &mut Block) {
    let Some(last) = coarse.surfaces.last() else { return };
    let mut whole = Block::empty(forest, d.level());
    whole.fill(&forest.local(d), |x, y| {
        let on_lattice = (x | y).trailing_zeros() >= last.spacing_log2;
        if on_lattice { last.at(x, y) } else { NODATA }
    });
    block.parts_mut().0.copy_from_slice(whole.parts().0);
}

/// The largest distance between what a diamond has and its samples, in quanta.
fn distance(block: &Block, source: &Block) -> f64 {
    let both = block.heights().iter().zip(source.heights());
    // Without a branch, so that it becomes a loop over vectors.
    let distance =
        |(drawn, sample): (&i32, &i32)| if *sample == NODATA { 0 } else { drawn.abs_diff(*sample) };
    both.map(distance).fold(0, u32::max).into()
}

/// The block of a diamond with the old points that its parents leave.
fn inherited(forest: &Forest, before: &HashMap<Diamond, Block>, d: Diamond) -> Block {
    let mut block = Block::empty(forest, d.level());
    for parent in forest.parents(d) {
        if let Some(from) = before.get(&parent) {
            block.inherit(forest, d, parent, from);
        }
    }
    block
}

impl Coded {
    /// What coding a diamond gave.
    pub(super) fn new(d: Diamond, block: &Block, source: &Block, spot: Option<crate::store::Spot>) -> Self {
        // Nodata is the least number there is: it is above no height, and must not be taken for the lowest.
        let range = |heights: &[i32]| {
            heights.iter().fold((i32::MAX, NODATA), |(low, high), height| {
                (low.min(if *height == NODATA { i32::MAX } else { *height }), high.max(*height))
            })
        };
        let (drawn, own) = (range(block.heights()), range(source.heights()));
        let (low, high) = (drawn.0.min(own.0), drawn.1.max(own.1));
        Self { centre: d.centre(), low, high, spot }
    }
}

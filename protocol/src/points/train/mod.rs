//! Learns a layer's model from samples of its diamonds: for the sender alone.
//!
//! Least squares first, each on what the one before left: the weights of old points; those of what was
//! missing at earlier new points; and the activity, which is to be the mean magnitude of a difference. Every
//! sample is weighed by how rough its neighbourhood is, since a difference twice as large costs one bit more
//! wherever it occurs. From there to the weights under which the numbers sent are likeliest ([`likelihood`]).
//! New points of all samples are coded by both, and each level takes the one by which they cost less; their
//! numbers are counted by class along the way.
//!
//! Level by level: a sampled diamond's ancestors are coded first, with what has been learnt of their
//! levels, so a level is learnt from the very heights that a receiver will have. (Rounded source heights
//! are not like them: where steps are large, most points are fictitious and lie on smooth ground. Learning
//! from those cost a third more on hills at 16 m.) All sums run in the order of the diamonds, so the same
//! samples give the same model.

#![allow(
    clippy::cast_possible_truncation,
    reason = "weights are clamped to 16 bits; heights of a block are below 2^24"
)]

mod corrections;
mod fit;
mod likelihood;
mod new_points;
mod sampler;

use super::Rounder;
use super::coding::Coding;
use super::counts::Counts;
use super::model::{Kernel, Model, REFINER_PASSES, Refiner};
use super::walk::{Known, walk_new, walk_old, way};
use crate::bintree::Forest;
use crate::diamond::{Block, Diamond};
use corrections::learn_refiners;
use new_points::learn_kernels;
use std::collections::{BTreeMap, BTreeSet};

/// The model that suits the sampled diamonds `of` (of the finest levels, usually) and their ancestors; where
/// these say little it stays near the default. `coding` gives the rule and the steps; `source` the heights
/// of a diamond's whole block.
///
/// Takes about a microsecond for each new point of the diamonds and their ancestors, of which there are up to
/// four a level and sample; and four times the memory of the blocks of one level of them.
///
/// # Errors
/// When `source` does.
pub fn train<E>(
    forest: &Forest,
    coding: &Coding,
    of: &[Diamond],
    mut source: impl FnMut(Diamond) -> Result<Block, E>,
) -> Result<Model, E> {
    let levels = forest.levels();
    let mut kernels = vec![[Kernel::default(); 2]; forest.lattice_levels() as usize];
    let mut refiners = vec![[Refiner::default(); REFINER_PASSES]; levels as usize];
    let mut counts = Counts::default();
    let mut before: BTreeMap<Diamond, Block> = BTreeMap::new();
    for (level, diamonds) in (0..levels).zip(with_ancestors(forest, of)) {
        let mut here = Vec::with_capacity(diamonds.len());
        for d in diamonds {
            let mut block = Block::empty(forest, level);
            for parent in forest.parents(d) {
                block.inherit(forest, d, parent, &before[&parent]);
            }
            here.push((d, block, source(d)?));
        }
        before.clear();
        if level > 0 {
            refiners[level as usize] = learn_refiners(forest, coding, level, &here);
        }
        let learnt = coding.clone().with_model(Model::of_weights(kernels.clone(), refiners.clone()));
        for (d, block, source) in &mut here {
            let mut pass = Rounder { source: source.heights(), counts: Some(&mut counts) };
            // A sender's heights never fail.
            let _ = walk_old(forest, &learnt, level, &forest.local(*d), block, true, &mut pass);
        }
        if !forest.adds_points(level) {
            before.extend(here.into_iter().map(|(d, block, _)| (d, block)));
            continue;
        }
        let mut best: [Option<Tried>; 2] = [None, None];
        for candidate in learn_kernels(forest, coding, level, &here) {
            kernels[level as usize] = candidate;
            let learnt = coding.clone().with_model(Model::of_weights(kernels.clone(), refiners.clone()));
            let mut tried =
                candidate.map(|kernel| Tried { kernel, counts: Counts::default(), blocks: Vec::new() });
            for (d, block, source) in &here {
                let (local, mut block) = (forest.local(*d), block.clone());
                let tried = &mut tried[way(&local)];
                let mut pass = Rounder { source: source.heights(), counts: Some(&mut tried.counts) };
                let _ = walk_new(&learnt, level, &local, &mut block, Known::Sent, &mut pass);
                tried.blocks.push((*d, block));
            }
            for (best, tried) in best.iter_mut().zip(tried) {
                if best.as_ref().is_none_or(|best| tried.counts.bits() < best.counts.bits()) {
                    *best = Some(tried);
                }
            }
        }
        for (kernel, best) in kernels[level as usize].iter_mut().zip(best) {
            let Some(best) = best else { continue };
            *kernel = best.kernel;
            counts.merge(&best.counts);
            before.extend(best.blocks);
        }
    }
    Ok(counts.model(kernels, refiners))
}

/// A kernel, the numbers of the sampled diamonds coded by it, and these diamonds as a receiver has them.
struct Tried {
    kernel: Kernel,
    counts: Counts,
    blocks: Vec<(Diamond, Block)>,
}

/// Diamonds with all their ancestors, by level.
fn with_ancestors(forest: &Forest, of: &[Diamond]) -> Vec<BTreeSet<Diamond>> {
    let mut levels = vec![BTreeSet::new(); forest.levels() as usize];
    for d in of {
        levels[d.level() as usize].insert(*d);
    }
    for level in (1..levels.len()).rev() {
        let parents: Vec<Diamond> = levels[level].iter().flat_map(|d| forest.parents(*d)).collect();
        levels[level - 1].extend(parents);
    }
    levels
}

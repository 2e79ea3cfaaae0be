//! What rays have seen so far, and what later ones may know of it.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::cast_possible_wrap,
    reason = "places are kept within the relief, whose sides are below 2^28; shares of 255 are below 256"
)]

use super::{Region, Seen};
use crate::zone::relief::{BLOCKS_LOG2, Relief};
use crate::zone::tiled::Tiled;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};

/// What has been seen so far, in 255ths: of samples, in the order of the relief's tiles, and of whole blocks.
pub(super) struct Sheets<'a> {
    pub(super) floor: u8,
    pub(super) relief: &'a Relief,
    pub(super) heights: &'a Tiled<i32>,
    pub(super) samples: Vec<AtomicU8>,
    pub(super) blocks: Vec<AtomicU8>,
    /// The least of the samples of each small block, or what it was not long ago; for larger ones, the least that is
    /// known of the small ones in them.
    pub(super) least: [Vec<AtomicU8>; BLOCKS_LOG2.len()],
    /// Whether all samples of a block of each kind are known to have heights and to be seen.
    pub(super) plain: [Vec<AtomicBool>; BLOCKS_LOG2.len()],
}

impl<'a> Sheets<'a> {
    pub(super) fn new(relief: &'a Relief, floor: u8) -> Self {
        let sheet = |count: usize| (0..count).map(|_| AtomicU8::new(floor)).collect();
        let counts = std::array::from_fn(|which| relief.blocks_size(which).iter().product());
        let heights = relief.heights();
        Self {
            floor,
            relief,
            heights,
            samples: sheet(heights.items().len()),
            blocks: sheet(counts[0]),
            least: counts.map(sheet),
            plain: counts.map(|count| (0..count).map(|_| AtomicBool::new(false)).collect()),
        }
    }

    /// What is known of the samples of a small block.
    pub(super) fn of_block(&self, [x, y]: [usize; 2]) -> impl Iterator<Item = u8> {
        let side = 1usize << BLOCKS_LOG2[0];
        let [columns, rows] = [0, 1].map(|axis| {
            let first = [x, y][axis] * side;
            first..=(first + side).min(self.heights.size()[axis] - 1)
        });
        rows.map(|y| self.heights.offset(1, y)).flat_map(move |row| {
            let columns = columns.clone().map(|x| self.heights.offset(0, x));
            columns.map(move |column| self.samples[row + column].load(Ordering::Relaxed))
        })
    }

    /// The place of a block in the sheets of its kind.
    pub(super) fn index(&self, which: usize, [x, y]: [usize; 2]) -> usize {
        y * self.relief.blocks_size(which)[0] + x
    }

    /// The blocks of the next smaller kind in a larger block.
    pub(super) fn parts(&self, which: usize, block: [usize; 2]) -> impl Iterator<Item = [usize; 2]> {
        let size = self.relief.blocks_size(which - 1);
        let log2 = BLOCKS_LOG2[which] - BLOCKS_LOG2[which - 1];
        let [columns, rows] =
            [0, 1].map(|axis| block[axis] << log2..((block[axis] + 1) << log2).min(size[axis]));
        rows.flat_map(move |y| columns.clone().map(move |x| [x, y]))
    }

    /// The least that is known of what is in a block, or that was not long ago.
    pub(super) fn least(&self, which: usize, block: [usize; 2]) -> u8 {
        let i = self.index(which, block);
        let least = self.least[which][i].load(Ordering::Relaxed);
        if which == 0 { least.max(self.blocks[i].load(Ordering::Relaxed)) } else { least }
    }

    /// Whether so much is known of all that is in a block of a larger kind.
    pub(super) fn knows(&self, which: usize, block: [usize; 2], share: u8) -> bool {
        if self.least(which, block) >= share {
            return true;
        }
        let least = self.parts(which, block).map(|part| self.least(which - 1, part)).min().unwrap_or(u8::MAX);
        self.least[which][self.index(which, block)].store(least, Ordering::Relaxed);
        least >= share
    }

    pub(super) fn merged(self) -> Tiled<u8> {
        let relief = self.relief;
        let mut samples = self.heights.like(self.samples.into_iter().map(AtomicU8::into_inner).collect());
        let side = 1usize << BLOCKS_LOG2[0];
        let [width, height] = relief.size();
        let columns = relief.blocks_size(0)[0];
        for (i, share) in self.blocks.into_iter().map(AtomicU8::into_inner).enumerate() {
            if share == self.floor {
                continue;
            }
            let [x, y] = [i % columns * side, i / columns * side];
            for y in y..=(y + side).min(height - 1) {
                for x in x..=(x + side).min(width - 1) {
                    samples.set([x, y], share.max(samples.at([x, y])));
                }
            }
        }
        samples
    }
}

/// Who is shown what rays meet.
pub(super) trait Witness {
    fn note(&mut self, seen: Seen);

    /// Whether of a block of the smallest kind so much is known that a share changes nothing.
    fn knows_block(&self, _block: [usize; 2], _share: f64) -> bool {
        false
    }

    /// The same of blocks of a larger kind, for a share of at most [`BLOCK_SHARE_MAX`](super::BLOCK_SHARE_MAX).
    fn knows_larger(&self, _which: usize, _blocks: [[usize; 2]; 2], _share: f64) -> bool {
        false
    }

    /// Whether all samples of a block are known to have heights and to be seen.
    fn is_plain(&self, _which: usize, _block: [usize; 2]) -> bool {
        false
    }

    /// Finds out whether a block of the smallest kind is plain, and then whether those are that it is in.
    fn look(&self, _block: [usize; 2]) {}

    /// Whether all four samples of a cell, by their place among the heights, are known to be seen.
    fn knows_seen(&self, _corners: [usize; 4]) -> bool {
        false
    }
}

impl<F: FnMut(Seen)> Witness for F {
    fn note(&mut self, seen: Seen) {
        self(seen);
    }
}

impl Witness for &Sheets<'_> {
    fn note(&mut self, seen: Seen) {
        let share = stepped(seen.share, self.floor);
        let raise = |here: &AtomicU8| {
            // Most are known already, and looking costs less than changing.
            if here.load(Ordering::Relaxed) < share {
                here.fetch_max(share, Ordering::Relaxed);
            }
        };
        match seen.region {
            Region::Triangle(corners) => {
                corners.iter().for_each(|c| raise(&self.samples[self.heights.index(*c)]))
            }
            Region::Cell([x, y]) => {
                let columns = [x, x + 1].map(|x| self.heights.offset(0, x));
                for row in [y, y + 1].map(|y| self.heights.offset(1, y)) {
                    columns.iter().for_each(|column| raise(&self.samples[row + column]));
                }
            }
            Region::Block(block) => raise(&self.blocks[self.index(0, block)]),
        }
    }

    fn knows_block(&self, block: [usize; 2], share: f64) -> bool {
        let share = stepped(share, self.floor);
        let known = &self.least[0][self.index(0, block)];
        if known.load(Ordering::Relaxed) >= share {
            return true;
        }
        let least = self.of_block(block).min().unwrap_or(u8::MAX);
        known.store(least, Ordering::Relaxed);
        least >= share
    }

    fn knows_larger(&self, which: usize, blocks: [[usize; 2]; 2], share: f64) -> bool {
        let share = stepped(share, self.floor);
        blocks.iter().all(|block| self.knows(which, *block, share))
    }

    fn is_plain(&self, which: usize, block: [usize; 2]) -> bool {
        self.plain[which][self.index(which, block)].load(Ordering::Relaxed)
    }

    fn look(&self, mut block: [usize; 2]) {
        let is_seen = |block| self.of_block(block).all(|share| share == u8::MAX);
        if self.is_plain(0, block) || self.relief.has_holes(0, [block; 2]) || !is_seen(block) {
            return;
        }
        self.least[0][self.index(0, block)].store(u8::MAX, Ordering::Relaxed);
        for which in 0..BLOCKS_LOG2.len() {
            if which > 0 {
                block = block.map(|w| w >> (BLOCKS_LOG2[which] - BLOCKS_LOG2[which - 1]));
                if !self.parts(which, block).all(|part| self.is_plain(which - 1, part)) {
                    return;
                }
            }
            self.plain[which][self.index(which, block)].store(true, Ordering::Relaxed);
        }
    }

    fn knows_seen(&self, corners: [usize; 4]) -> bool {
        corners.iter().all(|i| self.samples[*i].load(Ordering::Relaxed) == u8::MAX)
    }
}

/// A share as it is kept: in 255ths, at the least of the steps 1, 1/√2, 1/2, ... 1/256 that is not below it, so that
/// masks compress.
pub(super) fn stepped(share: f64, floor: u8) -> u8 {
    // Half the binary logarithm of the share's square: its exponent, but for a power of two itself.
    let bits = (share * share).to_bits();
    let exponent = (bits >> 52) as i64 - 1023 + i64::from(bits << 12 != 0);
    STEPS[(-exponent).clamp(0, STEPS.len() as i64 - 1) as usize].max(floor)
}

/// 255 times the powers of 1/√2, rounded up.
pub(super) const STEPS: [u8; 17] = [255, 181, 128, 91, 64, 46, 32, 23, 16, 12, 8, 6, 4, 3, 2, 2, 1];

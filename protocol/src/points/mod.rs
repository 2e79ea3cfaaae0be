//! The `points` encoding: what the split of one diamond adds, as bytes.
//!
//! A diamond's payload holds, in this order,
//! 1. at level 0 only, the (n+1)^2 points of the root square itself, coarse to fine;
//! 2. the corrections of the old points strictly inside, wherever this level's step is finer than the
//!    one that they were last coded with;
//! 3. which of the n^2 new points have a height, if not all have;
//! 4. the new points, row by row.
//!
//! Each number is the difference between a height and its prediction from what the receiver already
//! has, in units of a step. **A point whose difference is zero is fictitious**: nothing is said of it
//! but that, and the receiver deduces its height. The loop is closed (the sender predicts from what the
//! receiver will have) and there is no update step, so the error of every point is at most half a step,
//! at every level. The entropy coder starts afresh in each diamond, and no prediction looks beyond it:
//! a payload can be decoded given only its ancestors.
//!
//! **Steps.** Level l uses `fine * 3^e[l]`, fine = 2E+1 quanta, with exponents that fall to 0. A step
//! three times as fine splits each interval into three equal ones, so a correction costs what was
//! saved before. The last diamond that has a point strictly inside gives it the fine step: see
//! `Coding::exponent`. So coarse views do not pay for fine precision, and the finest is as promised.
//!
//! **Speed.** The class of a number depends on the old points and on the row below, never on its
//! neighbours in the row: a row's classes are known before its first number, and the two lanes of the
//! coder run through it side by side.
//!
//! | offset | size | field | valid range |
//! |---|---|---|---|
//! | 0 | 1 | format, in the high four bits | 2 |
//! | 0 | | bit 0: some new point has no height; bit 1: two lanes; bit 2: every new point is fictitious, and nothing is said of them | |
//! | 1 | .. | symbols, see [`crate::rans`]; none at all where there is nothing to say | |
//!
//! History: format 1 had an adaptive binary coder and a header of 6 bytes.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "a block has fewer than 2^16 points and its symbols fewer than 2^32 bytes"
)]

pub mod model;

mod coding;
mod rows;
mod train;
mod walk;

pub use coding::{Coding, CodingError, Rule, STEP_MAX};
pub use train::train;

use crate::bintree::Forest;
use crate::diamond::{Block, Diamond};
use crate::rans::{Context, Decoder, Encoder};
use crate::{HEIGHT_MAX, NODATA};
use model::{Counts, Tables};
use walk::walk;

/// The format that this build writes, and the only one that it reads.
pub const FORMAT: u8 = 2;

/// Bytes before the symbols.
pub const HEADER_BYTES: usize = 1;

const MIXED: u8 = 1;
const TWO_LANES: u8 = 2;
const QUIET: u8 = 4;

/// Payloads of this many bits and more have two lanes: a second one costs three bytes.
const TWO_LANES_BITS: f64 = 8192.0;

/// The largest magnitude of a source height, in quanta. Half of [`HEIGHT_MAX`], so that no prediction
/// of reconstructed heights can leave the range.
pub const SOURCE_MAX: i32 = (1 << 23) - 1;

/// How many points a payload held.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Tally {
    /// New points whose height was sent.
    pub real: u32,
    /// New points whose height the receiver deduced.
    pub fictitious: u32,
    /// Older points whose height was made more precise.
    pub corrected: u32,
}

/// Why bytes are not the payload of a diamond. Whichever it is, drop them and ask again.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// Written by another version.
    #[error("payload has format {found}, this build reads {FORMAT}: rebuild the store")]
    Format {
        /// The format found.
        found: u8,
    },
    /// Unknown flags.
    #[error("payload has flags {found:#x}, expected at most 0x7: fetch it again")]
    Flags {
        /// The flags found.
        found: u8,
    },
    /// Cut off, with something behind, or not written by an encoder.
    #[error("payload's symbols are damaged: fetch it again")]
    Symbols,
    /// A height beyond the range of heights.
    #[error("payload gives a height beyond {HEIGHT_MAX} quanta: fetch it again")]
    Height,
    /// The coding is for another number of levels than the forest.
    #[error("coding for {found} levels on a forest of {expected}: reload the scene")]
    Levels {
        /// Levels of the coding.
        found: u32,
        /// Levels of the forest.
        expected: u32,
    },
}

/// Codes the split of `d` and leaves in `block` what a receiver will have.
///
/// `block` holds the reconstructed old points (except at level 0, where they are coded too); `source`
/// is the whole block of source heights, at most [`SOURCE_MAX`] in magnitude, with [`NODATA`] wherever
/// the block has none. Returns the payload, and empty bytes where no new point has a height and no old
/// one is to be corrected: such a diamond has no payload.
#[must_use]
pub fn encode(forest: &Forest, coding: &Coding, d: Diamond, block: &mut Block, source: &Block) -> Vec<u8> {
    let root = d.level() == 0;
    let (old, new) = source.parts();
    let upper = forest.local(d).upper;
    let n = forest.segments();
    let mut valid = (0..n * n).filter(|i| upper || i % n >= i / n).map(|i| new[i] != NODATA);
    let mut valid_old = old.iter().map(|h| *h != NODATA);
    if valid.clone().all(|v| !v)
        && !walk::has_corrections(coding, d.level(), upper, block)
        && (!root || valid_old.clone().all(|v| !v))
    {
        block.parts_mut().1.fill(NODATA);
        return Vec::new();
    }
    let mixed = !valid.all(|v| v) || (root && !valid_old.all(|v| v));
    let mut sender = Sender { source: source.heights(), coder: Encoder::default(), quiet_from: None };
    // A sender's symbols never fail.
    let _ = walk(forest, coding, d, block, mixed, &mut sender);
    let mut flags = if mixed { MIXED } else { 0 };
    if let Some(from) = sender.quiet_from {
        flags |= QUIET;
        sender.coder.truncate(from);
    }
    let mut lanes = 1;
    if sender.coder.bits() >= TWO_LANES_BITS {
        flags |= TWO_LANES;
        lanes = 2;
    }
    let mut bytes = sender.coder.finish(lanes);
    bytes.insert(0, FORMAT << 4 | flags);
    bytes
}

/// Like [`encode`], without the bytes: leaves in `block` what a receiver will have.
pub fn quantise(forest: &Forest, coding: &Coding, d: Diamond, block: &mut Block, source: &Block) {
    let _ = walk(forest, coding, d, block, true, &mut Rounder { source: source.heights(), counts: None });
}

/// Completes `block`, which holds the old points of `d` (none at level 0), from a payload.
///
/// The bytes may be hostile. Takes no memory beyond the block but some hundred kilobytes, and time in
/// proportion to the block's points. Empty bytes mean that no new point has a height and no old one moves.
///
/// # Errors
/// When the bytes are no payload of this format; `block` is then of no use.
pub fn decode(
    forest: &Forest,
    coding: &Coding,
    d: Diamond,
    block: &mut Block,
    bytes: &[u8],
) -> Result<Tally, DecodeError> {
    if coding.levels() != forest.levels() {
        return Err(DecodeError::Levels { found: coding.levels(), expected: forest.levels() });
    }
    let Some((header, symbols)) = bytes.split_first() else {
        block.parts_mut().1.fill(NODATA);
        return Ok(Tally::default());
    };
    let (format, flags) = (header >> 4, header & 15);
    if format != FORMAT {
        return Err(DecodeError::Format { found: format });
    }
    if flags > MIXED | TWO_LANES | QUIET {
        return Err(DecodeError::Flags { found: flags });
    }
    let lanes = if flags & TWO_LANES == 0 { 1 } else { 2 };
    let coder = Decoder::new(symbols, lanes).ok_or(DecodeError::Symbols)?;
    let mut receiver = Receiver { coder, quiet: flags & QUIET != 0 };
    let tally = walk(forest, coding, d, block, flags & MIXED != 0, &mut receiver)?;
    if receiver.coder.is_spent() { Ok(tally) } else { Err(DecodeError::Symbols) }
}

/// One pass over a diamond's symbols, whichever way they flow. A single walk serves sender and
/// receiver, so they cannot disagree about contexts, order or predictions.
trait Pass {
    /// Whether the point at `slot` has a height.
    fn valid(&mut self, context: &mut Context, slot: usize) -> bool;
    /// A receiver's numbers of these classes; a sender leaves them alone.
    fn receive(&mut self, tables: &Tables, classes: &[u8], numbers: &mut [i32]);
    /// The number of the point at `slot`: what was received, or what `wanted` computes from the source.
    fn number(&mut self, received: i32, slot: usize, wanted: impl Fn(i32) -> i32) -> i32;
    /// A sender's numbers go out; a receiver has them already.
    fn send(&mut self, tables: &Tables, classes: &[u8], numbers: &[i32]);
    /// Called once between the corrections (and whatever comes before) and the new points. Whether every
    /// new point is fictitious, as a receiver knows.
    fn new_points(&mut self) -> bool;
    /// Called at the end: whether every new point is fictitious, as a sender knows.
    fn was_quiet(&mut self, quiet: bool);
}

struct Sender<'a> {
    source: &'a [i32],
    coder: Encoder,
    /// Where the numbers of the new points begin, if all of them turned out to be zero.
    quiet_from: Option<usize>,
}

struct Rounder<'a> {
    source: &'a [i32],
    /// Where to count the numbers that would be sent.
    counts: Option<&'a mut Counts>,
}

struct Receiver<'a> {
    coder: Decoder<'a>,
    quiet: bool,
}

impl Pass for Sender<'_> {
    fn valid(&mut self, context: &mut Context, slot: usize) -> bool {
        let valid = self.source[slot] != NODATA;
        self.coder.bit(context, !valid);
        valid
    }
    fn receive(&mut self, _: &Tables, _: &[u8], _: &mut [i32]) {}
    fn number(&mut self, _: i32, slot: usize, wanted: impl Fn(i32) -> i32) -> i32 {
        wanted(self.source[slot])
    }
    fn send(&mut self, tables: &Tables, classes: &[u8], numbers: &[i32]) {
        for (lane, (class, number)) in [0, 1].into_iter().cycle().zip(classes.iter().zip(numbers)) {
            tables.encode(&mut self.coder, lane, *class, *number);
        }
    }
    fn new_points(&mut self) -> bool {
        self.quiet_from = Some(self.coder.len());
        false
    }
    fn was_quiet(&mut self, quiet: bool) {
        if !quiet {
            self.quiet_from = None;
        }
    }
}

impl Pass for Rounder<'_> {
    fn valid(&mut self, _: &mut Context, slot: usize) -> bool {
        self.source[slot] != NODATA
    }
    fn receive(&mut self, _: &Tables, _: &[u8], _: &mut [i32]) {}
    fn number(&mut self, _: i32, slot: usize, wanted: impl Fn(i32) -> i32) -> i32 {
        wanted(self.source[slot])
    }
    fn send(&mut self, _: &Tables, classes: &[u8], numbers: &[i32]) {
        if let Some(counts) = &mut self.counts {
            for (class, number) in classes.iter().zip(numbers) {
                counts.add(*class, *number);
            }
        }
    }
    fn new_points(&mut self) -> bool {
        false
    }
    fn was_quiet(&mut self, _: bool) {}
}

impl Pass for Receiver<'_> {
    fn valid(&mut self, context: &mut Context, _: usize) -> bool {
        !self.coder.bit(context)
    }
    fn receive(&mut self, tables: &Tables, classes: &[u8], numbers: &mut [i32]) {
        tables.decode(&mut self.coder, classes, numbers);
    }
    fn number(&mut self, received: i32, _: usize, _: impl Fn(i32) -> i32) -> i32 {
        received
    }
    fn send(&mut self, _: &Tables, _: &[u8], _: &[i32]) {}
    fn new_points(&mut self) -> bool {
        self.quiet
    }
    fn was_quiet(&mut self, _: bool) {}
}

//! The `points` encoding: what the split of one diamond adds, as bytes.
//!
//! A diamond's payload holds, in this order,
//! 1. at level 0 only, the (n+1)^2 points of the root square itself, coarse to fine;
//! 2. the corrections of the known points strictly inside, wherever this level's step is finer than the
//!    one that they were last coded with;
//! 3. which of the n^2 new points have a height, if not all have;
//! 4. the new points, row by row.
//!
//! Levels past the finest lattice have corrections alone.
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
//! `Coding::exponent`. So coarse views do not pay for fine precision, and the finest is as promised. Rough
//! ground needs its finest lattice even for a coarse error: so steps need not be fine there, and the levels
//! past the lattice refine what is left.
//!
//! **Speed.** The class of a number depends on the old points and on the row below, never on its
//! neighbours in the row: a row's classes are known before its first number, and the two lanes of the
//! coder run through it side by side.
//!
//! | offset | size | field | valid range |
//! |---|---|---|---|
//! | 0 | 1 | format, in the high four bits | 3 |
//! | 0 | | bit 0: some new point has no height; bit 1: two lanes; bit 2: every new point is fictitious, and nothing is said of them | |
//! | 1 | .. | symbols, see [`crate::rans`]; none at all where there is nothing to say | |
//!
//! A payload without bytes says that all is as expected: see [`decode`].
//!
//! History: format 1 had an adaptive binary coder and a header of 6 bytes; format 2 had no levels past the
//! lattice, and where all was as expected a header that said so.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "a block has fewer than 2^16 points and its symbols fewer than 2^32 bytes"
)]

pub mod model;
pub mod tables;

mod coding;
mod corrections;
mod counts;
mod rows;
mod train;
mod walk;

pub use coding::{Coding, CodingError, Rule, STEP_MAX};
pub use train::train;

use crate::bintree::Forest;
use crate::diamond::{Block, Diamond};
use crate::rans::{Context, Decoder, Encoder};
use crate::{HEIGHT_MAX, NODATA};
use corrections::Parts;
use counts::Counts;
use tables::Tables;
use walk::{Known, is_inferred, walk, walk_new};

/// The format that this build writes, and the only one that it reads.
pub const FORMAT: u8 = 3;

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
/// `block` holds the reconstructed points that are known (at level 0 none is: all are coded); `source`
/// is the whole block of source heights, at most [`SOURCE_MAX`] in magnitude, with [`NODATA`] wherever
/// the block has none. Returns the payload, and empty bytes where there is nothing to say, since all is as
/// [`decode`] infers it: such a diamond has no payload.
#[must_use]
pub fn encode(forest: &Forest, coding: &Coding, d: Diamond, block: &mut Block, source: &Block) -> Vec<u8> {
    if source.heights().iter().all(|h| *h == NODATA) {
        return Vec::new();
    }
    let root = d.level() == 0;
    let upper = forest.local(d).upper;
    let n = block.segments();
    let (mut all_valid, mut as_inferred) = (true, !root);
    // Where all have a height, nothing needs to be looked up cell by cell.
    if forest.adds_points(d.level()) && source.heights().contains(&NODATA) {
        let (old, new) = source.parts();
        all_valid = !root || !old.contains(&NODATA);
        for (v, row) in new.chunks_exact(n).enumerate() {
            for (u, point) in row.iter().enumerate().skip(if upper { 0 } else { v }) {
                all_valid &= *point != NODATA;
                as_inferred &= is_inferred(old, n, upper, u, v) == (*point != NODATA);
            }
        }
    }
    let known = if all_valid { Known::All } else { Known::Sent };
    let coder = Encoder::default();
    let mut sender = Sender { source: source.heights(), coder, quiet_from: None, is_silent: as_inferred };
    // A sender's symbols never fail.
    let _ = walk(forest, coding, d, block, known, &mut sender);
    if sender.is_silent {
        return Vec::new();
    }
    let mut flags = if all_valid { 0 } else { MIXED };
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
    if source.heights().iter().all(|h| *h == NODATA) {
        return;
    }
    let _ =
        walk(forest, coding, d, block, Known::Sent, &mut Rounder { source: source.heights(), counts: None });
}

/// Completes `block`, which holds the known points of `d` (none at level 0), from a payload.
///
/// The bytes may be hostile. Takes no memory beyond the block but some hundred kilobytes, and time in
/// proportion to the block's points. Empty bytes mean that a new point has a height where all the corners of
/// its cell have one, that it is fictitious, and that no known point moves.
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
        return infer(forest, coding, d, block);
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
    let known = if flags & MIXED == 0 { Known::All } else { Known::Sent };
    let tally = walk(forest, coding, d, block, known, &mut receiver)?;
    if receiver.coder.is_spent() { Ok(tally) } else { Err(DecodeError::Symbols) }
}

/// Completes a block of which nothing is said.
fn infer(forest: &Forest, coding: &Coding, d: Diamond, block: &mut Block) -> Result<Tally, DecodeError> {
    if d.level() == 0 {
        block.parts_mut().0.fill(NODATA);
        block.parts_mut().1.fill(NODATA);
    } else if forest.adds_points(d.level()) {
        return walk_new(coding, d.level(), &forest.local(d), block, Known::Inferred, &mut Silence);
    }
    Ok(Tally::default())
}

/// One pass over a diamond's symbols, whichever way they flow. A single walk serves sender and
/// receiver, so they cannot disagree about contexts, order or predictions.
trait Pass {
    /// Whether it wants to know what corrections are expected from.
    const LEARNS: bool = false;
    /// Whether the point at `slot` has a height.
    fn valid(&mut self, context: &mut Context, slot: usize) -> bool;
    /// A receiver's numbers of these classes; a sender leaves them alone.
    fn receive(&mut self, tables: &Tables, classes: &[u8], numbers: &mut [i32]);
    /// Likewise corrections.
    fn receive_corrections(&mut self, _: &Tables, _: &[u8], _: &mut [i32]) {}
    /// What is known of a correction by `step` that the point at `slot`, now at `here`, may take: only if
    /// [`Pass::LEARNS`].
    fn learn(&mut self, _pass: usize, _slot: usize, _here: i32, _step: i32, _parts: &Parts) {}
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
    /// Whether all is as a receiver infers it.
    is_silent: bool,
}

struct Rounder<'a> {
    source: &'a [i32],
    /// Where to count the numbers that would be sent.
    counts: Option<&'a mut Counts>,
}

/// A receiver's without a payload.
struct Silence;

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
        self.is_silent &= numbers.iter().all(|k| *k == 0);
        tables.encode(&mut self.coder, classes, numbers);
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

impl Pass for Silence {
    fn valid(&mut self, _: &mut Context, _: usize) -> bool {
        false
    }
    fn receive(&mut self, _: &Tables, _: &[u8], _: &mut [i32]) {}
    fn number(&mut self, _: i32, _: usize, _: impl Fn(i32) -> i32) -> i32 {
        0
    }
    fn send(&mut self, _: &Tables, _: &[u8], _: &[i32]) {}
    fn new_points(&mut self) -> bool {
        true
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
    fn receive_corrections(&mut self, tables: &Tables, classes: &[u8], numbers: &mut [i32]) {
        tables.decode_corrections(&mut self.coder, classes, numbers);
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

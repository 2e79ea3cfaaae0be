//! The `points` encoding: what the split of one diamond adds, as bytes.
//!
//! A diamond's payload holds, in this order,
//! 1. at level 0 only, the (n+1)^2 points of the root square itself, coarse to fine;
//! 2. the corrections of the old points strictly inside, wherever this level's step is finer than the
//!    one that they were last coded with;
//! 3. the n^2 new points, row by row.
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
//! | offset | size | field | valid range |
//! |---|---|---|---|
//! | 0 | 1 | format | 1 |
//! | 1 | 1 | flags: bit 0 = some new point has no height | 0 or 1 |
//! | 2 | 4 | bytes that follow, little-endian | even, exactly what follows |
//! | 6 | .. | range-coded symbols, 16-bit little-endian words | |
//!
//! History: format 1 is the first.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "a block has fewer than 2^16 points and its symbols fewer than 2^32 bytes"
)]

use crate::bintree::Forest;
use crate::diamond::{Block, Diamond};
use crate::entropy::{Context, Decoder, Encoder, Magnitude};
use crate::{HEIGHT_MAX, NODATA};

/// The format that this build writes, and the only one that it reads.
pub const FORMAT: u8 = 1;

/// Bytes before the symbols.
pub const HEADER_BYTES: usize = 6;

/// The largest magnitude of a source height, in quanta. Half of [`HEIGHT_MAX`], so that no prediction
/// of reconstructed heights can leave the range.
pub const SOURCE_MAX: i32 = (1 << 23) - 1;

/// The largest step, in quanta.
pub const STEP_MAX: u32 = 1 << 21;

/// How a receiver deduces the height of a new point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rule {
    /// The mean of the two ends of the hypotenuse: the rule of the bitree papers.
    Midpoint,
    /// The quincunx interpolation of Neville type, (10 * sum of the 4 nearest - sum of the 8 next) / 32
    /// (Kovacevic and Sweldens 2000), and the mean of the 4 nearest near the diamond's border.
    #[default]
    Smooth,
}

/// What a sender and a receiver agree on for a layer.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(try_from = "CodingParts", into = "CodingParts")]
pub struct Coding {
    rule: Rule,
    fine_step: u32,
    exponents: Vec<u8>,
}

#[derive(Clone, serde::Serialize, serde::Deserialize)]
struct CodingParts {
    rule: Rule,
    fine_step: u32,
    exponents: Vec<u8>,
}

/// Why numbers do not describe a coding.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CodingError {
    /// The fine step is not 2E+1 for a whole E.
    #[error("fine step of {0} quanta: expected an odd number below {STEP_MAX}")]
    FineStep(u32),
    /// The exponents rise, make a step too large, or are none.
    #[error("exponents {0:?}: expected at least two, none rising, steps below {STEP_MAX}")]
    Exponents(Vec<u8>),
}

impl TryFrom<CodingParts> for Coding {
    type Error = CodingError;
    fn try_from(p: CodingParts) -> Result<Self, CodingError> {
        Self::new(p.rule, p.fine_step, p.exponents)
    }
}

impl From<Coding> for CodingParts {
    fn from(c: Coding) -> Self {
        Self { rule: c.rule, fine_step: c.fine_step, exponents: c.exponents }
    }
}

impl Coding {
    /// `fine_step` = 2E+1 quanta; `exponents[0]` is for the root squares' own points, `exponents[l+1]`
    /// for level l.
    ///
    /// # Errors
    /// When the step is even, or the exponents rise or are too large.
    pub fn new(rule: Rule, fine_step: u32, exponents: Vec<u8>) -> Result<Self, CodingError> {
        if fine_step.is_multiple_of(2) || fine_step >= STEP_MAX {
            return Err(CodingError::FineStep(fine_step));
        }
        let fits = |e: u8| {
            3u32.checked_pow(e.into()).and_then(|p| p.checked_mul(fine_step)).is_some_and(|s| s < STEP_MAX)
        };
        if exponents.len() < 2
            || !exponents.is_sorted_by(|a, b| a >= b)
            || !exponents.iter().all(|e| fits(*e))
        {
            return Err(CodingError::Exponents(exponents));
        }
        Ok(Self { rule, fine_step, exponents })
    }

    /// The prediction rule.
    #[must_use]
    pub fn rule(&self) -> Rule {
        self.rule
    }

    /// The finest step, 2E+1 quanta.
    #[must_use]
    pub fn fine_step(&self) -> u32 {
        self.fine_step
    }

    /// Levels that these exponents serve; must equal [`Forest::levels`].
    #[must_use]
    pub fn levels(&self) -> u32 {
        self.exponents.len() as u32 - 1
    }

    /// The step of most points that a split at `level` adds, in quanta.
    #[must_use]
    pub fn level_step(&self, level: u32) -> u32 {
        self.step(self.exponent(level, Place::Off)).cast_unsigned()
    }

    fn step(&self, exponent: u8) -> i32 {
        (self.fine_step * 3u32.pow(exponent.into())).cast_signed()
    }

    fn level_exponent(&self, level: u32) -> u8 {
        self.exponents.get(level as usize + 1).copied().unwrap_or(0)
    }

    /// The exponent with which a split at `level` leaves a point strictly inside the diamond.
    ///
    /// Points off both diagonals lie strictly inside a diamond of the next level, those on a diagonal
    /// inside one of the level after it, and the centre inside none: whoever is last gives the fine step.
    fn exponent(&self, level: u32, place: Place) -> u8 {
        let next_inside = match place {
            Place::Centre => return 0,
            Place::Hypotenuse | Place::OtherDiagonal => level + 2,
            Place::Off => level + 1,
        };
        if next_inside < self.levels() { self.level_exponent(level) } else { 0 }
    }

    /// The exponent that an old point strictly inside a diamond of `level` has before the split.
    ///
    /// It was last strictly inside a parent, or, on the hypotenuse (the parents' border), a grandparent.
    fn exponent_before(&self, level: u32, place: Place) -> u8 {
        let since = match place {
            Place::Hypotenuse | Place::Centre => 2,
            Place::OtherDiagonal | Place::Off => 1,
        };
        if level >= since { self.level_exponent(level - since) } else { self.exponents[0] }
    }
}

/// Where a point lies in its diamond.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    Centre,
    Hypotenuse,
    OtherDiagonal,
    Off,
}

/// The place of a point at doubled local coordinates.
fn place(n: usize, p: usize, q: usize) -> Place {
    match (p == q, p + q == 2 * n) {
        (true, true) => Place::Centre,
        (true, false) => Place::Hypotenuse,
        (false, true) => Place::OtherDiagonal,
        (false, false) => Place::Off,
    }
}

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
    /// Too short to have a header.
    #[error("payload has {found} bytes, its header alone takes {HEADER_BYTES}: fetch it again")]
    Short {
        /// Bytes found.
        found: usize,
    },
    /// Written by another version.
    #[error("payload has format {found}, this build reads {FORMAT}: rebuild the store")]
    Format {
        /// The format found.
        found: u8,
    },
    /// Unknown flags.
    #[error("payload has flags {found:#x}, expected 0 or 1: fetch it again")]
    Flags {
        /// The flags found.
        found: u8,
    },
    /// Cut off, or with something behind.
    #[error("payload claims {claimed} bytes of symbols and has {found}: fetch it again")]
    Length {
        /// Bytes that the header claims.
        claimed: u32,
        /// Bytes that follow it.
        found: usize,
    },
    /// Symbols that no encoder writes.
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
        && !has_corrections(coding, d.level(), upper, block)
        && (!root || valid_old.clone().all(|v| !v))
    {
        block.parts_mut().1.fill(NODATA);
        return Vec::new();
    }
    let mixed = !valid.all(|v| v) || (root && !valid_old.all(|v| v));
    let mut sender = Sender { source: source.heights(), coder: Encoder::default() };
    // A sender's symbols never fail.
    let _ = walk(forest, coding, d, block, mixed, &mut sender);
    let symbols = sender.coder.finish();
    let mut bytes = Vec::with_capacity(HEADER_BYTES + symbols.len());
    bytes.extend([FORMAT, u8::from(mixed)]);
    bytes.extend((symbols.len() as u32).to_le_bytes());
    bytes.extend(symbols);
    bytes
}

/// Like [`encode`], without the bytes: leaves in `block` what a receiver will have.
pub fn quantise(forest: &Forest, coding: &Coding, d: Diamond, block: &mut Block, source: &Block) {
    let _ = walk(forest, coding, d, block, true, &mut Rounder { source: source.heights() });
}

/// Completes `block`, which holds the old points of `d` (none at level 0), from a payload.
///
/// The bytes may be hostile. Takes no memory beyond the block but some tens of kilobytes, and time in
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
    if bytes.is_empty() {
        block.parts_mut().1.fill(NODATA);
        return Ok(Tally::default());
    }
    let Some((header, symbols)) = bytes.split_first_chunk::<HEADER_BYTES>() else {
        return Err(DecodeError::Short { found: bytes.len() });
    };
    let [format, flags, claimed @ ..] = *header;
    if format != FORMAT {
        return Err(DecodeError::Format { found: format });
    }
    if flags > 1 {
        return Err(DecodeError::Flags { found: flags });
    }
    let claimed = u32::from_le_bytes(claimed);
    if symbols.len() as u64 != u64::from(claimed) {
        return Err(DecodeError::Length { claimed, found: symbols.len() });
    }
    let mut receiver = Receiver(Decoder::new(symbols).ok_or(DecodeError::Symbols)?);
    let tally = walk(forest, coding, d, block, flags == 1, &mut receiver)?;
    if receiver.0.is_spent() { Ok(tally) } else { Err(DecodeError::Symbols) }
}

/// One pass over a diamond's symbols, whichever way they flow. A single walk serves sender and
/// receiver, so they cannot disagree about contexts, order or predictions.
trait Pass {
    /// Whether the point at `slot` has a height.
    fn valid(&mut self, context: &mut Context, slot: usize) -> Result<bool, DecodeError>;
    /// The number for the point at `slot`; `wanted` computes it from the source height.
    fn number(
        &mut self,
        contexts: &mut Magnitude,
        sign: &mut Context,
        slot: usize,
        wanted: impl Fn(i32) -> i32,
    ) -> Result<i32, DecodeError>;
}

struct Sender<'a> {
    source: &'a [i32],
    coder: Encoder,
}

struct Rounder<'a> {
    source: &'a [i32],
}

struct Receiver(Decoder);

impl Pass for Sender<'_> {
    fn valid(&mut self, context: &mut Context, slot: usize) -> Result<bool, DecodeError> {
        let valid = self.source[slot] != NODATA;
        self.coder.bit(context, !valid);
        Ok(valid)
    }
    fn number(
        &mut self,
        contexts: &mut Magnitude,
        sign: &mut Context,
        slot: usize,
        wanted: impl Fn(i32) -> i32,
    ) -> Result<i32, DecodeError> {
        let number = wanted(self.source[slot]);
        contexts.encode(&mut self.coder, sign, number);
        Ok(number)
    }
}

impl Pass for Rounder<'_> {
    fn valid(&mut self, _: &mut Context, slot: usize) -> Result<bool, DecodeError> {
        Ok(self.source[slot] != NODATA)
    }
    fn number(
        &mut self,
        _: &mut Magnitude,
        _: &mut Context,
        slot: usize,
        wanted: impl Fn(i32) -> i32,
    ) -> Result<i32, DecodeError> {
        Ok(wanted(self.source[slot]))
    }
}

impl Pass for Receiver {
    fn valid(&mut self, context: &mut Context, _: usize) -> Result<bool, DecodeError> {
        Ok(!self.0.bit(context).ok_or(DecodeError::Symbols)?)
    }
    fn number(
        &mut self,
        contexts: &mut Magnitude,
        sign: &mut Context,
        _: usize,
        _: impl Fn(i32) -> i32,
    ) -> Result<i32, DecodeError> {
        contexts.decode(&mut self.0, sign).ok_or(DecodeError::Symbols)
    }
}

/// The multiple of `step` nearest to `value`, in steps; `step` is odd, so nothing lies half way.
fn steps(value: i32, step: i32) -> i32 {
    let magnitude = (value.abs() + (step - 1) / 2) / step;
    if value < 0 { -magnitude } else { magnitude }
}

/// `base + k * step`, if that is a height.
fn moved(base: i32, k: i32, step: i32) -> Result<i32, DecodeError> {
    let height = i64::from(base) + i64::from(k) * i64::from(step);
    i32::try_from(height).ok().filter(|h| h.abs() <= HEIGHT_MAX).ok_or(DecodeError::Height)
}

/// Activity classes of a number's neighbourhood.
const CLASSES: usize = 14;

/// The class of an activity in sixteenths of a step: about two classes an octave, then one.
fn class(sixteenths: u32) -> usize {
    const LIMITS: [u32; CLASSES - 1] = [2, 5, 8, 12, 18, 27, 40, 64, 112, 224, 512, 1400, 5000];
    LIMITS.partition_point(|limit| sixteenths >= *limit)
}

/// Contexts by activity class; each expects about the activity that leads to it.
fn contexts() -> [Magnitude; CLASSES] {
    const EXPECTED: [u32; CLASSES] = [1, 3, 6, 10, 15, 22, 33, 50, 85, 160, 350, 900, 2600, 12000];
    const START: [Magnitude; CLASSES] = {
        let mut start = [const { Magnitude::expecting(1) }; CLASSES];
        let mut i = 0;
        while i < CLASSES {
            start[i] = Magnitude::expecting(EXPECTED[i]);
            i += 1;
        }
        start
    };
    START
}

fn walk<P: Pass>(
    forest: &Forest,
    coding: &Coding,
    d: Diamond,
    block: &mut Block,
    mixed: bool,
    pass: &mut P,
) -> Result<Tally, DecodeError> {
    let mut tally = Tally::default();
    if d.level() == 0 {
        walk_root(coding, block, mixed, pass, &mut tally)?;
    }
    let upper = forest.local(d).upper;
    walk_corrections(coding, d.level(), upper, block, pass, &mut tally)?;
    walk_new(coding, d.level(), upper, block, mixed, pass, &mut tally)?;
    Ok(tally)
}

/// The root square's own points, coarse to fine. Their heights are rounded to multiples of their step,
/// not relative to a prediction, so that two squares which share a side give its points the same heights.
fn walk_root<P: Pass>(
    coding: &Coding,
    block: &mut Block,
    mixed: bool,
    pass: &mut P,
    tally: &mut Tally,
) -> Result<(), DecodeError> {
    let n = block.segments();
    let row = n + 1;
    let (old, _) = block.parts_mut();
    old.fill(NODATA);
    let mut validity = [Context::likely(7, 8), Context::likely(1, 2), Context::likely(1, 8)];
    let mut numbers = [Magnitude::expecting(1600), Magnitude::expecting(320), Magnitude::expecting(64)];
    let mut signs = Context::default();
    let mut point = |old: &mut [i32], u: usize, v: usize, near: &[usize]| -> Result<(), DecodeError> {
        let slot = v * row + u;
        let (sum, count) = near
            .iter()
            .filter(|s| old[**s] != NODATA)
            .fold((0i64, 0i64), |(s, c), i| (s + i64::from(old[*i]), c + 1));
        if mixed {
            let context = if count == near.len() as i64 {
                0
            } else if count > 0 {
                1
            } else {
                2
            };
            if !pass.valid(&mut validity[context], slot)? {
                return Ok(());
            }
        }
        let corner = (u == 0 || u == n) && (v == 0 || v == n);
        // Corners lie strictly inside no diamond at all: nobody will correct them.
        let step = coding.step(if corner { 0 } else { coding.exponents[0] });
        let mean = if count > 0 { i32::try_from(sum.div_euclid(count)).unwrap_or(0) } else { 0 };
        let expected = steps(mean, step);
        let contexts = &mut numbers[if near.is_empty() {
            0
        } else if count < 4 {
            1
        } else {
            2
        }];
        let k = pass.number(contexts, &mut signs, slot, |h| steps(h, step) - expected)?;
        old[slot] = moved(0, expected.checked_add(k).ok_or(DecodeError::Height)?, step)?;
        *(if k == 0 { &mut tally.fictitious } else { &mut tally.real }) += 1;
        Ok(())
    };
    for (u, v) in [(0, 0), (n, 0), (n, n), (0, n)] {
        point(old, u, v, &[])?;
    }
    let mut side = n;
    while side > 1 {
        let half = side / 2;
        for v in (half..n).step_by(side) {
            for u in (half..n).step_by(side) {
                let at = |du: usize, dv: usize| (v + dv - half) * row + u + du - half;
                point(old, u, v, &[at(0, 0), at(side, 0), at(side, side), at(0, side)])?;
            }
        }
        for v in (0..=n).step_by(half) {
            let first = if v % side == 0 { half } else { 0 };
            for u in (first..=n).step_by(side) {
                let at = |ok: bool, u: usize, v: usize| if ok { v * row + u } else { usize::MAX };
                let near = [
                    at(u >= half, u.wrapping_sub(half), v),
                    at(u + half <= n, u + half, v),
                    at(v >= half, u, v.wrapping_sub(half)),
                    at(v + half <= n, u, v + half),
                ];
                let mut inside = [0; 4];
                let mut count = 0;
                for slot in near.into_iter().filter(|slot| *slot != usize::MAX) {
                    inside[count] = slot;
                    count += 1;
                }
                point(old, u, v, &inside[..count])?;
            }
        }
        side = half;
    }
    Ok(())
}

/// Whether the split says something of an old point.
fn has_corrections(coding: &Coding, level: u32, upper: bool, block: &Block) -> bool {
    let n = block.segments();
    let (old, _) = block.parts();
    (1..n).any(|v| {
        (if upper { 1 } else { v }..n).any(|u| {
            let place = place(n, 2 * u, 2 * v);
            old[v * (n + 1) + u] != NODATA
                && coding.exponent_before(level, place) > coding.exponent(level, place)
        })
    })
}

/// Corrections of the old points strictly inside, row by row.
fn walk_corrections<P: Pass>(
    coding: &Coding,
    level: u32,
    upper: bool,
    block: &mut Block,
    pass: &mut P,
    tally: &mut Tally,
) -> Result<(), DecodeError> {
    let n = block.segments();
    let row = n + 1;
    let (old, _) = block.parts_mut();
    let mut numbers = [
        Magnitude::expecting(3),
        Magnitude::expecting(8),
        Magnitude::expecting(16),
        Magnitude::expecting(60),
    ];
    let mut signs = Context::default();
    // Steps taken in the row below, and in this one.
    let mut last = vec![0u32; row];
    for v in 1..n {
        let mut west = 0;
        // Of a diamond at the border the hypotenuse itself is inside: nobody else has it.
        #[allow(clippy::needless_range_loop, reason = "u is a coordinate first")]
        for u in if upper { 1 } else { v }..n {
            let slot = v * row + u;
            let place = place(n, 2 * u, 2 * v);
            let (before, after) = (coding.exponent_before(level, place), coding.exponent(level, place));
            if old[slot] == NODATA || before <= after {
                last[u] = 0;
                west = 0;
                continue;
            }
            let step = coding.step(after);
            let base = old[slot];
            let around = west + last[u];
            let contexts = &mut numbers[if before - after > 1 { 3 } else { around.min(2) as usize }];
            let k = pass.number(contexts, &mut signs, slot, |h| steps(h - base, step))?;
            old[slot] = moved(base, k, step)?;
            tally.corrected += u32::from(k != 0);
            west = u32::from(k != 0);
            last[u] = west;
        }
    }
    Ok(())
}

/// The new points, row by row.
fn walk_new<P: Pass>(
    coding: &Coding,
    level: u32,
    upper: bool,
    block: &mut Block,
    mixed: bool,
    pass: &mut P,
    tally: &mut Tally,
) -> Result<(), DecodeError> {
    let n = block.segments();
    let border = (n + 1) * (n + 1);
    let (old, new) = block.parts_mut();
    new.fill(NODATA);
    let mut validity: [Context; 20] = std::array::from_fn(|i| {
        Context::likely(1 + 2 * (i as u64 / 4) + 3 * (i as u64 % 4).count_ones() as u64, 16)
    });
    let mut numbers = contexts();
    let mut signs = [Context::default(); 3];
    // Magnitudes and signs of the row below, with a margin of one on each side.
    let mut below = vec![0i32; n + 2];
    let mut row_now = vec![0i32; n + 2];
    let mut fallback = old.iter().copied().find(|h| *h != NODATA).unwrap_or(0);
    let steps_by_exponent = [coding.step(0), coding.step(coding.level_exponent(level))];
    for v in 0..n {
        let first = if upper { 0 } else { v };
        row_now[first] = below[first + 1];
        for u in first..n {
            let cell = Cell::read(old, n, u, v, upper);
            if mixed {
                let west = u > first && new[v * n + u - 1] != NODATA;
                let south = v > 0 && new[(v - 1) * n + u] != NODATA;
                let context = cell.valid() as usize * 4 + usize::from(west) * 2 + usize::from(south);
                if !pass.valid(&mut validity[context.min(19)], border + v * n + u)? {
                    row_now[u + 1] = 0;
                    continue;
                }
            }
            let place = place(n, 2 * u + 1, 2 * v + 1);
            let step = steps_by_exponent[usize::from(coding.exponent(level, place) > 0)];
            let deduced = cell.predict(coding.rule, old, n, u, v, fallback);
            let (west, south, east) = (row_now[u], below[u + 1], below[u + 2]);
            let near = 2 * (west.unsigned_abs() + south.unsigned_abs())
                + below[u].unsigned_abs()
                + east.unsigned_abs();
            let rough = cell.roughness() / step.unsigned_abs();
            let activity = class(near.saturating_mul(2).saturating_add(rough));
            let sign = &mut signs[(1 + (west + south).signum()) as usize];
            let k =
                pass.number(&mut numbers[activity], sign, border + v * n + u, |h| steps(h - deduced, step))?;
            let height = moved(deduced, k, step)?;
            new[v * n + u] = height;
            fallback = height;
            row_now[u + 1] = k;
            *(if k == 0 { &mut tally.fictitious } else { &mut tally.real }) += 1;
        }
        row_now[n + 1] = row_now[n];
        std::mem::swap(&mut below, &mut row_now);
    }
    Ok(())
}

/// The four old points around a new one.
struct Cell {
    /// (u, v), (u+1, v), (u+1, v+1), (u, v+1); [`NODATA`] where there is none.
    corners: [i32; 4],
}

impl Cell {
    fn read(old: &[i32], n: usize, u: usize, v: usize, upper: bool) -> Self {
        let at = v * (n + 1) + u;
        let mut corners = [old[at], old[at + 1], old[at + n + 2], old[at + n + 1]];
        if !upper && u == v {
            corners[3] = NODATA;
        }
        Self { corners }
    }

    fn valid(&self) -> u32 {
        self.corners.iter().map(|h| u32::from(*h != NODATA)).sum()
    }

    /// Sixteen times how far the four corners are from a plane, plus their spread a little: what the
    /// difference is likely to be.
    fn roughness(&self) -> u32 {
        if self.valid() < 4 {
            return 0;
        }
        let [a, b, c, d] = self.corners;
        4 * (a + c - b - d).unsigned_abs() + ((a - c).unsigned_abs() + (b - d).unsigned_abs()) / 2
    }

    /// The height that a receiver deduces.
    fn predict(&self, rule: Rule, old: &[i32], n: usize, u: usize, v: usize, fallback: i32) -> i32 {
        let [a, b, c, d] = self.corners;
        if rule == Rule::Midpoint {
            let (end, other) = if (u + v).is_multiple_of(2) { (a, c) } else { (b, d) };
            if end != NODATA && other != NODATA {
                return (end + other + 1) >> 1;
            }
        } else if self.valid() == 4 {
            let four = a + b + c + d;
            if (1..n - 1).contains(&u) && (1..n - 1).contains(&v) {
                let row = n + 1;
                let at = v * row + u;
                let next = [
                    old[at - 1],
                    old[at + row - 1],
                    old[at + 2],
                    old[at + row + 2],
                    old[at - row],
                    old[at - row + 1],
                    old[at + 2 * row],
                    old[at + 2 * row + 1],
                ];
                if next.iter().all(|h| *h != NODATA) {
                    return (10 * four - next.iter().sum::<i32>() + 16) >> 5;
                }
            }
            return (four + 2) >> 2;
        }
        // Beside nodata: the mean of what there is.
        let (sum, count) =
            self.corners.iter().filter(|h| **h != NODATA).fold((0, 0), |(s, c), h| (s + h, c + 1));
        if count == 0 { fallback } else { (sum + count / 2).div_euclid(count) }
    }
}

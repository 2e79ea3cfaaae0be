//! Whole numbers under the entropy coder: small where they are expected to be small.
//!
//! A [`Scale`] is the mean magnitude of the numbers that have passed under it, learnt as they go by on both
//! ends, so that nothing need be said of it. Half octaves of it choose among few tables of shares, made of
//! integers alone. Beyond a mean of four, low bits go plainly and the rest under the two largest tables.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "shares are 12 bits, symbols 6, means below 2^31: each is bounded beside its cast"
)]

use crate::rans::{Decoder, Encoder, PRECISION, TOTAL};
use std::sync::LazyLock;

/// Symbol 0 is the escape, the others are these magnitudes and less, with their sign.
const DIRECT: i64 = 31;
const SYMBOLS: usize = 2 * DIRECT as usize + 2;

/// Octaves of the mean, from 1/16 on, that have tables of their own: up to 4.
const OCTAVES: u32 = 6;

/// The largest magnitude that a scale learns from as it is; means stay below 2^31.
const LEARNT_MAX: i64 = (1 << 22) - 1;

/// The largest magnitude of a number: differences of lattice coordinates and of heights have 26 bits.
const NUMBER_MAX: i64 = 1 << 30;

/// How large numbers are, learnt from those before.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scale {
    /// Mean magnitude, in units of 2^-8.
    mean: u32,
}

impl Scale {
    /// A scale that expects numbers of this magnitude.
    pub(super) fn expecting(magnitude: u32) -> Self {
        Self { mean: magnitude.clamp(1, LEARNT_MAX as u32) << 8 }
    }

    #[inline]
    fn class(self) -> Class {
        Class::of(self.mean >> 4)
    }

    #[inline]
    fn learn(&mut self, number: i64) {
        let magnitude = number.abs().min(LEARNT_MAX) as u32;
        // The 15 parts are rounded down: otherwise a mean of less than 16 would never fall.
        self.mean = self.mean - ((self.mean + 15) >> 4) + (magnitude << 4);
    }
}

/// The table under which a number goes, and how many of its low bits go plainly.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Class {
    table: u8,
    low: u8,
}

impl Class {
    /// Of numbers with a mean magnitude in sixteenths.
    #[inline]
    pub(super) fn of(sixteenths: u32) -> Self {
        let sixteenths = sixteenths.max(1);
        let octave = sixteenths.ilog2();
        // Of the least octave there is no upper half.
        let half = (2 * sixteenths) >> octave & 1;
        let own = octave.min(OCTAVES);
        Self { table: (2 * own + half) as u8, low: (octave - octave.min(OCTAVES - 1)) as u8 }
    }
}

/// One table's shares, and the way back from a share to its symbol.
pub(super) struct Table {
    symbol: [u8; TOTAL as usize],
    /// The start and the share of each symbol.
    range: [(u16, u16); SYMBOLS],
}

const TABLES: usize = 2 * OCTAVES as usize + 2;

/// The shares of all classes.
pub(super) struct Tables([Table; TABLES]);

impl std::ops::Index<usize> for Tables {
    type Output = Table;
    #[inline(always)]
    fn index(&self, class: usize) -> &Table {
        &self.0[class]
    }
}

/// The tables, made when they are first needed.
pub(super) fn tables() -> &'static Tables {
    static MADE: LazyLock<Box<Tables>> = LazyLock::new(|| Box::new(Tables(std::array::from_fn(table))));
    &MADE
}

/// The ratio, in units of 2^-16, of a geometric distribution with a mean magnitude in sixteenths: on both sides of
/// zero, or on both sides of the border between zero and -1.
fn ratio(sixteenths: u64, is_split: bool) -> u64 {
    if is_split {
        (sixteenths << 16) / (sixteenths + 16)
    } else {
        let root = ((256 + sixteenths * sixteenths) << 32).isqrt();
        (root - (16 << 16)) / sixteenths
    }
}

fn table(class: usize) -> Table {
    let (octave, half) = (class as u32 / 2, class as u64 % 2);
    // The two last tables are for numbers whose low bits have gone: their means are those of the octave before.
    let is_split = octave == OCTAVES;
    let octave = octave.min(OCTAVES - 1);
    // The middle of the half octave, times 4.
    let mean4 = ((4 + 2 * half) << octave) * 5 / 4;
    // Most numbers are of a narrow distribution, some of a wide one.
    let weights = |scale4: u64| {
        let ratio = ratio((mean4 * scale4 / 16).max(1), is_split);
        let mut weight = 1u64 << 32;
        let mut weights = [0u64; DIRECT as usize + 2];
        for slot in &mut weights {
            *slot = weight;
            weight = (weight * ratio) >> 16;
        }
        let sum = weights.iter().sum::<u64>() * 2 - if is_split { 0 } else { weights[0] };
        weights.map(|w| (w << 24) / sum)
    };
    let (narrow, wide) = (weights(3), weights(8));
    let weight = |high: i64| {
        let at = if is_split && high < 0 { -1 - high } else { high.abs() } as usize;
        4 * narrow[at] + wide[at]
    };
    let raw: Vec<u64> = (0..SYMBOLS as i64)
        .map(|symbol| if symbol == 0 { 2 * weight(DIRECT + 1) } else { weight(symbol - DIRECT - 1) })
        .collect();
    let sum: u64 = raw.iter().sum();
    // Each has at least one part; what rounding leaves goes to the likeliest.
    let rest = u64::from(TOTAL) - SYMBOLS as u64;
    let mut share: Vec<u16> = raw.iter().map(|w| (1 + w * rest / sum) as u16).collect();
    let middle = DIRECT as usize + 1;
    share[middle] += (TOTAL - share.iter().map(|s| u32::from(*s)).sum::<u32>()) as u16;
    let mut table = Table { symbol: [0; TOTAL as usize], range: [(0, 0); SYMBOLS] };
    let mut start = 0usize;
    for (symbol, share) in share.into_iter().enumerate() {
        table.range[symbol] = (start as u16, share);
        table.symbol[start..start + usize::from(share)].fill(symbol as u8);
        start += usize::from(share);
    }
    table
}

/// Appends a number of magnitude below 2^30.
#[inline]
pub(super) fn encode(coder: &mut Encoder, lane: u8, tables: &Tables, scale: &mut Scale, number: i64) {
    encode_as(coder, lane, tables, scale.class(), number);
    scale.learn(number);
}

/// [`encode`] under a class that is known.
#[inline]
pub(super) fn encode_as(coder: &mut Encoder, lane: u8, tables: &Tables, class: Class, number: i64) {
    let low = u32::from(class.low);
    let table = &tables[usize::from(class.table)];
    let high = number >> low;
    let symbol = if high.abs() <= DIRECT { (high + DIRECT + 1) as usize } else { 0 };
    let (start, share) = table.range[symbol];
    coder.symbol(lane, start, share);
    if symbol == 0 {
        let beyond = (high.abs() - DIRECT) as u32;
        let bits = beyond.ilog2();
        coder.plain(lane, u16::from(high < 0), 1);
        coder.plain(lane, bits as u16, 5);
        plain(coder, lane, beyond - (1 << bits), bits);
    }
    // Most numbers have no such bits.
    if low > 0 {
        plain(coder, lane, (number - (high << low)) as u32, low);
    }
}

/// Appends up to 32 plain bits.
pub(super) fn plain(coder: &mut Encoder, lane: u8, value: u32, bits: u32) {
    coder.plain(lane, (value & 0xffff) as u16, bits.min(16));
    if bits > 16 {
        coder.plain(lane, (value >> 16) as u16, bits - 16);
    }
}

/// Up to 32 plain bits.
#[inline(always)]
pub(super) fn read_plain<const LANE: usize>(coder: &mut Decoder<'_>, bits: u32) -> u32 {
    let (low, mut state) = coder.plain_of(coder.state(LANE), bits.min(16));
    let mut value = low;
    if bits > 16 {
        let high;
        (high, state) = coder.plain_of(state, bits - 16);
        value |= high << 16;
    }
    coder.set_state(LANE, state);
    value
}

/// The next number; `None` where it is one that no encoder writes.
#[inline(always)]
pub(super) fn decode<const LANE: usize>(
    coder: &mut Decoder<'_>,
    tables: &Tables,
    scale: &mut Scale,
) -> Option<i64> {
    let number = decode_as::<LANE>(coder, tables, scale.class())?;
    scale.learn(number);
    Some(number)
}

/// [`decode`] under a class that is known.
#[inline(always)]
pub(super) fn decode_as<const LANE: usize>(
    coder: &mut Decoder<'_>,
    tables: &Tables,
    class: Class,
) -> Option<i64> {
    let low = u32::from(class.low);
    let table = &tables[usize::from(class.table) % TABLES];
    let state = coder.state(LANE);
    let slot = state % TOTAL;
    let symbol = usize::from(table.symbol[slot as usize]) % SYMBOLS;
    let (start, share) = table.range[symbol];
    let state = coder.refill(u32::from(share) * (state >> PRECISION) + slot - u32::from(start));
    coder.set_state(LANE, state);
    let high = if symbol == 0 { escaped::<LANE>(coder) } else { symbol as i64 - DIRECT - 1 };
    let number = (high << low) + if low > 0 { i64::from(read_plain::<LANE>(coder, low)) } else { 0 };
    (number.abs() < NUMBER_MAX).then_some(number)
}

#[cold]
fn escaped<const LANE: usize>(coder: &mut Decoder<'_>) -> i64 {
    let is_negative = read_plain::<LANE>(coder, 1) == 1;
    let bits = read_plain::<LANE>(coder, 5);
    let magnitude = DIRECT + (i64::from(read_plain::<LANE>(coder, bits)) | 1 << bits);
    if is_negative { -magnitude } else { magnitude }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn any_number() -> impl Strategy<Value = i64> {
        (0u32..30).prop_flat_map(|bits| -(1i64 << bits) + 1..1 << bits)
    }

    proptest! {
        #[test]
        fn numbers_come_back(numbers in prop::collection::vec(any_number(), 0..200), expected in 0u32..1 << 24, lanes in 1usize..=2) {
            let (mut coder, mut scale) = (Encoder::default(), Scale::expecting(expected));
            for number in &numbers {
                encode(&mut coder, 1, tables(), &mut scale, *number);
            }
            let bytes = coder.finish(lanes);
            let (mut coder, mut scale) = (Decoder::new(&bytes, lanes).unwrap(), Scale::expecting(expected));
            for number in &numbers {
                let back = if lanes == 1 {
                    decode::<0>(&mut coder, tables(), &mut scale)
                } else {
                    decode::<1>(&mut coder, tables(), &mut scale)
                };
                prop_assert_eq!(back, Some(*number));
            }
            prop_assert!(coder.is_spent());
        }
    }

    #[test]
    fn shares_fill_each_table() {
        for table in &tables().0 {
            assert_eq!(table.range.iter().map(|(_, s)| u32::from(*s)).sum::<u32>(), TOTAL);
            assert!(table.range.iter().all(|(_, s)| *s > 0));
        }
    }

    #[test]
    fn numbers_as_large_as_expected_cost_what_they_carry() {
        for mean in [1i64, 3, 20, 300, 70_000] {
            let (mut coder, mut scale) = (Encoder::default(), Scale::expecting(mean as u32));
            let mut state = 1u64;
            for _ in 0..4000 {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                let unit = ((state >> 33) as f64 + 0.5) / f64::from(1u32 << 31);
                let magnitude = (-unit.ln() * mean as f64).round() as i64;
                encode(
                    &mut coder,
                    0,
                    tables(),
                    &mut scale,
                    if state & 1 << 32 == 0 { magnitude } else { -magnitude },
                );
            }
            // A continuous distribution of this mean, cut into ones: log2(2 e mean) bits.
            let least = (2.0 * std::f64::consts::E * mean as f64).log2();
            let bits = coder.bits() / 4000.0;
            assert!(bits < least + 0.35, "{bits} bits for a mean of {mean}, {least} at best");
        }
    }
}

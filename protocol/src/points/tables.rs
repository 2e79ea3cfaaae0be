//! Tables of how large a number is likely to be, and numbers coded by them.
//!
//! **Classes.** The neighbourhood of a new point gives an *activity*, the difference to be expected in
//! steps. Two classes an octave of activity each have a table of their own: the probability of magnitude
//! 0, and of each larger one given that it is not smaller (a *hazard*). Eight hazards describe a table.
//! Signs are taken as even: both have half of a magnitude's share, so sign and magnitude are one symbol.
//! Where large numbers are usual, their low bits are as good as random and are sent plainly.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "classes, symbols and shares are below 2^13, magnitudes below 2^27; casts keep them in place"
)]

use crate::rans::{Decoder, Encoder, PLAIN_MAX, PRECISION, TOTAL};

/// Activity classes of numbers.
pub const CLASSES: usize = 40;

/// The activity of the first class is 2^-OCTAVES_BELOW.
const OCTAVES_BELOW: u32 = 8;

/// Classes of corrections: how far to one side a point is expected, times how sure that is.
pub const CORRECTION_CLASSES: usize = TILTS * SPREADS;
/// Kinds of tilt: how far to one side.
pub const TILTS: usize = 9;
/// Kinds of spread: how sure.
pub const SPREADS: usize = 16;

/// Hazards of a table.
pub const HAZARDS: usize = 8;

/// The magnitudes that have a hazard in common: from this one up to the next.
const HAZARD_FROM: [usize; HAZARDS] = [0, 1, 2, 3, 4, 6, 9, 14];

/// The largest magnitude with symbols of its own.
pub(super) const DIRECT_MAX: usize = 31;

/// Symbols are magnitudes with sign, from -31 to 31, then the escape.
const SYMBOLS: usize = 2 * DIRECT_MAX + 2;
const ZERO: usize = DIRECT_MAX;
const ESCAPE: usize = SYMBOLS - 1;

/// Bits that say how long an escaped magnitude is.
pub(super) const LENGTH_BITS: u32 = 5;

/// The class of an activity; anything is allowed, NaN and infinities too.
#[inline]
#[must_use]
pub fn class(activity: f32) -> u8 {
    const LEAST: f32 = 1.0 / (1 << OCTAVES_BELOW) as f32;
    const MOST: f32 = (1 << (CLASSES as u32 / 2 - OCTAVES_BELOW)) as f32 * 0.999;
    // The exponent and the first bit behind the point of a float: two classes an octave.
    const BASE: u32 = LEAST.to_bits() >> 22;
    let activity = if activity > LEAST { activity } else { LEAST };
    let activity = if activity < MOST { activity } else { MOST };
    ((activity.to_bits() >> 22) - BASE) as u8
}

/// The least activity of a class, in sixteenths of 2^-OCTAVES_BELOW.
fn class_from(class: usize) -> u64 {
    (2 + class as u64 % 2) << (class / 2 + 3)
}

/// How many low bits of the numbers of a class are sent plainly.
pub(super) fn class_shift(class: usize) -> u32 {
    // Bins of a quarter of the activity: eight of them hold most numbers.
    (class as u32 / 2).saturating_sub(OCTAVES_BELOW + 2)
}

/// Hazards of a class of which nothing is known: those of a geometric distribution whose mean magnitude is
/// the activity.
pub(super) fn default_hazards(class: usize) -> [u16; HAZARDS] {
    // The middle of the class, in units of 2^-12 bins.
    let mean = (class_from(class) * 5 / 4) >> class_shift(class);
    let hazard = (1u64 << 24) / (mean + 4096);
    [hazard.clamp(1, u64::from(TOTAL) - 1) as u16; HAZARDS]
}

/// The group of magnitudes that share a hazard.
pub(super) fn hazard_group(magnitude: usize) -> usize {
    HAZARD_FROM.partition_point(|from| *from <= magnitude) - 1
}

/// One class's shares, and the way back from a share to its symbol.
#[derive(Clone, PartialEq, Eq)]
struct Table {
    /// The symbol of each of the [`TOTAL`] slots.
    symbol: [u8; TOTAL as usize],
    /// Start and share of each symbol: `start << 16 | share`.
    range: [u32; SYMBOLS],
    /// Low bits that are sent plainly.
    shift: u32,
    /// The largest magnitude that has symbols here.
    direct: u32,
}

impl Table {
    /// From shares of symbols that sum to [`TOTAL`].
    fn from_shares(shares: &[u32; SYMBOLS], shift: u32, direct: u32) -> Self {
        let mut table = Self { symbol: [0; TOTAL as usize], range: [0; SYMBOLS], shift, direct };
        let mut start = 0;
        for (symbol, share) in shares.iter().enumerate() {
            table.range[symbol] = start << 16 | share;
            table.symbol[start as usize..(start + share) as usize].fill(symbol as u8);
            start += share;
        }
        table
    }

    fn of_numbers(hazards: &[u16; HAZARDS], shift: u32) -> Self {
        let mut shares = [0u32; SYMBOLS];
        // What is left of the probabilities, in 2^-28.
        let mut left = u64::from(TOTAL) << 16;
        let mut used = 0;
        let mut direct = 0;
        for magnitude in 0..=DIRECT_MAX {
            let part = (left * u64::from(hazards[hazard_group(magnitude)])) >> PRECISION;
            let share = if magnitude == 0 { part >> 16 } else { (part + (1 << 16)) >> 17 } as u32;
            // The escape keeps a share, however unlikely it is.
            let room = TOTAL - 1 - used;
            let share = if magnitude == 0 { share.clamp(1, room) } else { share.min(room / 2) };
            if share == 0 {
                break;
            }
            let both = if magnitude == 0 { share } else { 2 * share };
            if magnitude == 0 {
                shares[ZERO] = both;
            } else {
                shares[ZERO + magnitude] = share;
                shares[ZERO - magnitude] = share;
            }
            used += both;
            left -= part;
            direct = magnitude as u32;
        }
        let escape = ((left + (1 << 15)) >> 16).clamp(1, u64::from(TOTAL - used)) as u32;
        shares[ESCAPE] = escape;
        // What rounding left over goes to zero, which is the largest or near to it.
        shares[ZERO] += TOTAL - used - escape;
        Self::from_shares(&shares, shift, direct)
    }
}

/// The tables of a model, by class. Those of numbers take 4.4 kB each.
#[derive(Clone, PartialEq, Eq)]
pub struct Tables {
    numbers: Vec<Table>,
    corrections: Vec<Thirds>,
}

/// Where the shares of moving down, of staying and of moving up begin, and where the last one ends.
type Thirds = [u16; 4];

/// The shares of a correction: of staying, and of moving to the nearer side where it moves.
fn thirds([zero, nearer]: [u16; 2]) -> Thirds {
    let zero = u32::from(zero).min(TOTAL - 2);
    let rest = TOTAL - zero;
    let nearer = ((rest * u32::from(nearer)) >> PRECISION).clamp(1, rest - 1);
    let farther = rest - nearer;
    [0, farther as u16, (farther + zero) as u16, TOTAL as u16]
}

impl std::fmt::Debug for Tables {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Tables of {} classes", self.numbers.len() + self.corrections.len())
    }
}

/// Classes from this one on are those of corrections.
pub const FIRST_CORRECTION: u8 = CLASSES as u8;

impl Tables {
    pub(super) fn new(
        numbers: &[[u16; HAZARDS]; CLASSES],
        corrections: &[[u16; 2]; CORRECTION_CLASSES],
    ) -> Self {
        let numbers = numbers.iter().enumerate().map(|(c, h)| Table::of_numbers(h, class_shift(c))).collect();
        Self { numbers, corrections: corrections.iter().map(|c| thirds(*c)).collect() }
    }

    /// Appends numbers, of magnitude below 2^27, under their classes, the lanes taking turns. The classes are all of
    /// numbers or all of corrections.
    pub fn encode(&self, coder: &mut Encoder, classes: &[u8], numbers: &[i32]) {
        if classes.first().is_some_and(|class| *class >= FIRST_CORRECTION) {
            coder.symbols(classes.iter().zip(numbers).map(|(class, number)| {
                let bounds = &self.corrections[usize::from(class.saturating_sub(FIRST_CORRECTION))];
                let k = (number.clamp(&-1, &1) + 1) as usize;
                (bounds[k], bounds[k + 1] - bounds[k])
            }));
            return;
        }
        for (lane, (class, number)) in [0, 1].into_iter().cycle().zip(classes.iter().zip(numbers)) {
            self.encode_number(coder, lane, *class, *number);
        }
    }

    #[inline(always)]
    fn encode_number(&self, coder: &mut Encoder, lane: u8, class: u8, value: i32) {
        let table = &self.numbers[usize::from(class)];
        // Bins are centred on zero.
        let half = (1 << table.shift) >> 1;
        let bin = (value + half) >> table.shift;
        let magnitude = bin.unsigned_abs();
        let put = |coder: &mut Encoder, symbol: usize| {
            let range = table.range[symbol];
            coder.symbol(lane, (range >> 16) as u16, range as u16);
        };
        if magnitude <= table.direct {
            put(coder, (ZERO as i32 + bin) as usize);
        } else {
            put(coder, ESCAPE);
            let excess = magnitude - table.direct;
            let below = excess.ilog2();
            coder.plain(lane, (below << 1 | u32::from(bin < 0)) as u16, LENGTH_BITS + 1);
            plain_long(coder, lane, excess ^ 1 << below, below);
        }
        if table.shift > 0 {
            plain_long(coder, lane, ((value + half) & ((1 << table.shift) - 1)).cast_unsigned(), table.shift);
        }
    }

    /// Reads as many corrections as there are classes, all of corrections, the lanes taking turns.
    #[inline]
    pub fn decode_corrections(&self, coder: &mut Decoder, classes: &[u8], numbers: &mut [i32]) {
        if coder.lanes() == 2 {
            self.decode_corrections_in::<2>(coder, classes, numbers)
        } else {
            self.decode_corrections_in::<1>(coder, classes, numbers)
        }
    }

    fn decode_corrections_in<const LANES: usize>(
        &self,
        coder: &mut Decoder,
        classes: &[u8],
        numbers: &mut [i32],
    ) {
        let Ok(tables) = <&[Thirds; CORRECTION_CLASSES]>::try_from(self.corrections.as_slice()) else {
            return;
        };
        let mut local = *coder;
        let mut states = local.states();
        for (classes, numbers) in classes.chunks(LANES).zip(numbers.chunks_mut(LANES)) {
            for (lane, (class, number)) in classes.iter().zip(numbers).enumerate() {
                let class = usize::from(class.wrapping_sub(FIRST_CORRECTION)).min(CORRECTION_CLASSES - 1);
                let bounds = tables[class].map(u32::from);
                let state = states[lane];
                let slot = state % TOTAL;
                let (up, down) = (slot >= bounds[2], slot < bounds[1]);
                let (start, end) = if up {
                    (bounds[2], bounds[3])
                } else if down {
                    (0, bounds[1])
                } else {
                    (bounds[1], bounds[2])
                };
                states[lane] = local.refill((end - start) * (state >> PRECISION) + slot - start);
                *number = i32::from(up) - i32::from(down);
            }
        }
        local.set_states(states);
        *coder = local;
    }

    /// Reads as many numbers as there are classes, all of numbers, the lanes taking turns.
    ///
    /// A damaged payload gives numbers of no meaning, of magnitude below 2^31.
    #[inline]
    pub fn decode(&self, coder: &mut Decoder, classes: &[u8], numbers: &mut [i32]) {
        if coder.lanes() == 2 {
            self.decode_in::<2>(coder, classes, numbers)
        } else {
            self.decode_in::<1>(coder, classes, numbers)
        }
    }

    fn decode_in<const LANES: usize>(&self, coder: &mut Decoder, classes: &[u8], numbers: &mut [i32]) {
        // A copy, so that states and place stay in registers.
        let mut local = *coder;
        let mut states = local.states();
        for (classes, numbers) in classes.chunks(LANES).zip(numbers.chunks_mut(LANES)) {
            for (lane, (class, number)) in classes.iter().zip(numbers).enumerate() {
                let Some(table) = self.numbers.get(usize::from(*class)) else { continue };
                let state = states[lane];
                let slot = state % TOTAL;
                let symbol = table.symbol[slot as usize];
                let range = table.range[usize::from(symbol & (SYMBOLS as u8 - 1))];
                let (start, share) = (range >> 16, range & 0xffff);
                let state = local.refill(share * (state >> PRECISION) + slot - start);
                let bin = i32::from(symbol) - ZERO as i32;
                if usize::from(symbol) == ESCAPE {
                    (*number, states[lane], local) = table.escaped(local, state);
                } else if table.shift > 0 {
                    let (low, state) = local.plain_of(state, table.shift);
                    (*number, states[lane]) = (table.whole(bin, low), state);
                } else {
                    (*number, states[lane]) = (bin, state);
                }
            }
        }
        local.set_states(states);
        *coder = local;
    }
}

impl Table {
    /// The number of a bin and the low bits in it.
    #[inline(always)]
    fn whole(&self, bin: i32, low: u32) -> i32 {
        let half = (1 << self.shift) >> 1;
        (bin.wrapping_shl(self.shift) | low.cast_signed()).wrapping_sub(half)
    }

    /// The number behind an escape.
    #[cold]
    #[inline(never)]
    fn escaped<'a>(&self, mut coder: Decoder<'a>, state: u32) -> (i32, u32, Decoder<'a>) {
        let (kind, state) = coder.plain_of(state, LENGTH_BITS + 1);
        // 26 bits are the most that an encoder writes.
        let below = (kind >> 1).min(26);
        let (excess, state) = plain_long_of(&mut coder, state, below);
        let magnitude = ((1 << below | excess) + self.direct).cast_signed();
        let bin = if kind & 1 == 1 { -magnitude } else { magnitude };
        let (low, state) = plain_long_of(&mut coder, state, self.shift);
        (self.whole(bin, low), state, coder)
    }
}

/// Plain bits, as many as 32.
fn plain_long(coder: &mut Encoder, lane: u8, value: u32, bits: u32) {
    if bits > PLAIN_MAX {
        coder.plain(lane, (value >> PLAIN_MAX) as u16, bits - PLAIN_MAX);
    }
    if bits > 0 {
        coder.plain(lane, value as u16 & (((1u32 << bits.min(PLAIN_MAX)) - 1) as u16), bits.min(PLAIN_MAX));
    }
}

fn plain_long_of(coder: &mut Decoder, mut state: u32, bits: u32) -> (u32, u32) {
    let mut value = 0;
    if bits > PLAIN_MAX {
        (value, state) = coder.plain_of(state, bits - PLAIN_MAX);
    }
    let low = bits.min(PLAIN_MAX);
    if low > 0 {
        let (part, after) = coder.plain_of(state, low);
        (value, state) = (value << low | part, after);
    }
    (value, state)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Hazards as counts could give them, extremes included.
    fn any_hazards() -> impl Strategy<Value = [u16; HAZARDS]> {
        let any_hazard = prop_oneof![Just(1u16), Just(TOTAL as u16 - 1), 1..TOTAL as u16];
        prop::array::uniform8(any_hazard)
    }

    proptest! {
        #[test]
        fn every_table_shares_out_everything(hazards in any_hazards(), shift in 0u32..12) {
            let table = Table::of_numbers(&hazards, shift);
            let shares: u32 = table.range.iter().map(|r| r & 0xffff).sum();
            prop_assert_eq!(shares, TOTAL);
            prop_assert!(table.range[ESCAPE] & 0xffff > 0, "any number can be sent");
            for m in 0..=table.direct as usize {
                prop_assert!(table.range[ZERO + m] & 0xffff > 0 && table.range[ZERO - m] & 0xffff > 0);
            }
        }

        #[test]
        fn any_number_comes_back_under_any_table(
            hazards in any_hazards(),
            items in prop::collection::vec((0..CLASSES as u8, prop_oneof![-3i32..=3, -4000i32..4000, -(1 << 26)..(1 << 26)]), 1..200),
            lanes in 1usize..=2,
        ) {
            let tables = Tables::new(&[hazards; CLASSES], &[[2000, 2100]; CORRECTION_CLASSES]);
            let mut coder = Encoder::default();
            let (classes, values): (Vec<u8>, Vec<i32>) = items.into_iter().unzip();
            tables.encode(&mut coder, &classes, &values);
            let bytes = coder.finish(lanes);
            let mut coder = Decoder::new(&bytes, lanes).unwrap();
            let mut found = vec![0; values.len()];
            tables.decode(&mut coder, &classes, &mut found);
            prop_assert_eq!(found, values);
            prop_assert!(coder.is_spent());
        }

        #[test]
        fn any_correction_comes_back_under_any_table(
            hazards in any_hazards(),
            items in prop::collection::vec((0..CORRECTION_CLASSES as u8, -1i32..=1), 1..200),
            lanes in 1usize..=2,
        ) {
            let corrections = std::array::from_fn(|c| [hazards[c % HAZARDS], hazards[c / HAZARDS % HAZARDS]]);
            let tables = Tables::new(&[hazards; CLASSES], &corrections);
            let mut coder = Encoder::default();
            let (classes, values): (Vec<u8>, Vec<i32>) =
                items.into_iter().map(|(class, value)| (class + FIRST_CORRECTION, value)).unzip();
            tables.encode(&mut coder, &classes, &values);
            let bytes = coder.finish(lanes);
            let mut coder = Decoder::new(&bytes, lanes).unwrap();
            let mut found = vec![0; values.len()];
            tables.decode_corrections(&mut coder, &classes, &mut found);
            prop_assert_eq!(found, values);
            prop_assert!(coder.is_spent());
        }

        #[test]
        fn every_activity_has_a_class_and_larger_ones_no_smaller(a in any::<f32>(), b in any::<f32>()) {
            prop_assert!(usize::from(class(a)) < CLASSES);
            prop_assert!(class(a) <= class(b) || a.is_nan() || b.is_nan() || a > b, "{} {}", a, b);
        }
    }

    #[test]
    fn an_octave_of_activity_has_two_classes() {
        assert_eq!(class(1.0) - class(0.5), 2);
        assert_eq!(class(1.5) - class(1.0), 1);
        assert_eq!(class_from(usize::from(class(1.0))), 1 << 12);
    }
}

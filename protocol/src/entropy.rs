//! The adaptive binary coder: bits in, bytes out, each bit at the cost that its context has learnt.
//!
//! Range coding itself is the `constriction` crate's; ours are the adaptive probabilities and the way in
//! which an integer becomes bits ([`Magnitude`]). A context learns fast at first and settles: its rate is
//! 1/(count+2) until it reaches 1/64.

use constriction::backends::Cursor;
use constriction::stream::model::{DecoderModel, EncoderModel, EntropyModel};
use constriction::stream::queue::{SmallRangeDecoder, SmallRangeEncoder};
use constriction::stream::{Decode, Encode};
use std::borrow::Borrow;
use std::num::NonZeroU16;

/// Bits of a probability.
const PRECISION: usize = 12;

/// The slowest rate of adaptation is 2^-SLOWEST.
const SLOWEST: u32 = 6;

/// How likely the next bit of a context is zero, learnt as bits go by.
#[derive(Debug, Clone, Copy)]
pub struct Context {
    /// Probability of zero, 16 bits.
    zero: u16,
    seen: u8,
}

impl Default for Context {
    fn default() -> Self {
        Self::likely(1, 2)
    }
}

impl Context {
    /// A context that starts out believing that `part` bits of `whole` are zero, but never quite sure.
    #[must_use]
    #[allow(clippy::cast_possible_truncation, reason = "at most 65535, since part is at most whole")]
    pub const fn likely(part: u64, whole: u64) -> Self {
        let zero = part * 65535 / whole;
        let zero = if zero < 1000 {
            1000
        } else if zero > 64535 {
            64535
        } else {
            zero
        };
        Self { zero: zero as u16, seen: 0 }
    }

    /// The probability of zero in units of 2^-12, never 0 nor 1.
    fn probability(self) -> u16 {
        (self.zero >> (16 - PRECISION)).clamp(1, (1 << PRECISION) - 1)
    }

    fn learn(&mut self, bit: bool) {
        // 1/2 would forget the prior at once; start at 1/4.
        const RATE: [u16; 32] = rates();
        let rate = u32::from(RATE[usize::from(self.seen.min(31))]);
        // A share of what it has, so it stays within 16 bits.
        let share = |of: u16| u16::try_from((u32::from(of) * rate) >> 16).unwrap_or(of);
        self.zero = if bit { self.zero - share(self.zero) } else { self.zero + share(u16::MAX - self.zero) };
        self.seen = self.seen.saturating_add(1);
    }
}

#[allow(clippy::cast_possible_truncation, reason = "65536 divided by at least 4")]
const fn rates() -> [u16; 32] {
    let mut table = [0u16; 32];
    let mut i = 0;
    while i < 32 {
        let divisor = if i < 30 { i as u32 * 2 + 4 } else { 1 << SLOWEST };
        table[i] = (65536 / divisor) as u16;
        i += 1;
    }
    table
}

/// A context seen as a model of one bit.
struct Bit(u16);

impl EntropyModel<PRECISION> for Bit {
    type Symbol = bool;
    type Probability = u16;
}

impl Bit {
    fn part(&self, bit: bool) -> (u16, NonZeroU16) {
        let (left, size) = if bit { (self.0, (1 << PRECISION) - self.0) } else { (0, self.0) };
        (left, NonZeroU16::new(size).unwrap_or(NonZeroU16::MIN))
    }
}

impl EncoderModel<PRECISION> for Bit {
    fn left_cumulative_and_probability(&self, bit: impl Borrow<bool>) -> Option<(u16, NonZeroU16)> {
        Some(self.part(*bit.borrow()))
    }
}

impl DecoderModel<PRECISION> for Bit {
    fn quantile_function(&self, quantile: u16) -> (bool, u16, NonZeroU16) {
        let bit = quantile >= self.0;
        let (left, size) = self.part(bit);
        (bit, left, size)
    }
}

/// Writes bits.
#[derive(Debug, Default)]
pub struct Encoder(SmallRangeEncoder);

impl Encoder {
    /// Appends one bit under its context.
    pub fn bit(&mut self, context: &mut Context, bit: bool) {
        // The model has no impossible symbol and a Vec takes every word, so this cannot fail.
        let _ = self.0.encode_symbol(bit, Bit(context.probability()));
        context.learn(bit);
    }

    /// Appends the `count` low bits of `value`, each costing one bit.
    pub fn plain(&mut self, value: u32, count: u32) {
        for i in (0..count).rev() {
            let _ = self.0.encode_symbol((value >> i) & 1 == 1, Bit(1 << (PRECISION - 1)));
        }
    }

    /// The finished bytes.
    #[must_use]
    pub fn finish(self) -> Vec<u8> {
        self.0.into_compressed().unwrap_or_default().into_iter().flat_map(u16::to_le_bytes).collect()
    }
}

/// Reads bits. After the end of its bytes it goes on with bits of no meaning; ask [`Decoder::is_spent`].
pub struct Decoder(SmallRangeDecoder<Cursor<u16, Vec<u16>>>);

impl Decoder {
    /// Over bytes from anywhere; an odd length is refused.
    #[must_use]
    pub fn new(bytes: &[u8]) -> Option<Self> {
        let (pairs, rest) = bytes.as_chunks::<2>();
        if !rest.is_empty() {
            return None;
        }
        let words: Vec<u16> = pairs.iter().map(|pair| u16::from_le_bytes(*pair)).collect();
        SmallRangeDecoder::from_compressed(words).ok().map(Self)
    }

    /// The next bit under its context; `None` when the bytes cannot come from an encoder.
    pub fn bit(&mut self, context: &mut Context) -> Option<bool> {
        let bit = self.0.decode_symbol(Bit(context.probability())).ok()?;
        context.learn(bit);
        Some(bit)
    }

    /// `count` bits that cost one bit each.
    pub fn plain(&mut self, count: u32) -> Option<u32> {
        let mut value = 0;
        for _ in 0..count {
            value = value << 1 | u32::from(self.0.decode_symbol(Bit(1 << (PRECISION - 1))).ok()?);
        }
        Some(value)
    }

    /// Whether all bytes may have been used: true after the last symbol of intact bytes.
    #[must_use]
    pub fn is_spent(&self) -> bool {
        self.0.maybe_exhausted()
    }
}

/// Contexts for a signed integer: zero or not, sign, then the bit length of the magnitude in unary and
/// its bits below the leading one, the first of them in context.
#[derive(Debug, Clone)]
pub struct Magnitude {
    zero: Context,
    length: [Context; Self::LENGTH_MAX as usize],
    first: [Context; Self::LENGTH_MAX as usize],
    second: [[Context; 2]; Self::LENGTH_MAX as usize],
}

impl Magnitude {
    /// The longest magnitude, in bits: any height less any prediction.
    pub const LENGTH_MAX: u32 = 26;

    /// Contexts that expect magnitudes of about `sixteenths`/16.
    ///
    /// The prior is geometric, P(|k| >= m) = r^m with r = s/(s+1). In integers throughout, so that every
    /// platform starts from the same probabilities.
    #[must_use]
    pub const fn expecting(sixteenths: u32) -> Self {
        const ONE: u64 = 1 << 30;
        let r = ONE * sixteenths as u64 / (sixteenths as u64 + 16);
        let mut length = [Context::likely(0, 1); Self::LENGTH_MAX as usize];
        let mut first = length;
        // The square root of r^(2^i) is r^(2^(i-1)): one step behind.
        let (mut power, mut root) = (r, ONE);
        let mut i = 0;
        while i < Self::LENGTH_MAX as usize {
            length[i] = Context::likely(ONE - power, ONE);
            first[i] = Context::likely(ONE, ONE + root);
            root = power;
            power = power * power / ONE;
            i += 1;
        }
        let even = Context::likely(1, 2);
        Self {
            zero: Context::likely(ONE - r, ONE),
            length,
            first,
            second: [[even; 2]; Self::LENGTH_MAX as usize],
        }
    }

    /// Writes `value`, whose magnitude is below 2^26.
    pub fn encode(&mut self, coder: &mut Encoder, sign: &mut Context, value: i32) {
        coder.bit(&mut self.zero, value != 0);
        if value == 0 {
            return;
        }
        coder.bit(sign, value < 0);
        let magnitude = value.unsigned_abs();
        let length = 32 - magnitude.leading_zeros();
        for i in 1..length {
            coder.bit(&mut self.length[i as usize - 1], true);
        }
        if length < Self::LENGTH_MAX {
            coder.bit(&mut self.length[length as usize - 1], false);
        }
        let (top, at) = (length - 1, length as usize - 1);
        if top >= 1 {
            let bit = magnitude >> (top - 1) & 1;
            coder.bit(&mut self.first[at], bit == 1);
            if top >= 2 {
                coder.bit(&mut self.second[at][bit as usize], magnitude >> (top - 2) & 1 == 1);
                coder.plain(magnitude, top - 2);
            }
        }
    }

    /// Reads what [`Magnitude::encode`] wrote.
    pub fn decode(&mut self, coder: &mut Decoder, sign: &mut Context) -> Option<i32> {
        if !coder.bit(&mut self.zero)? {
            return Some(0);
        }
        let negative = coder.bit(sign)?;
        let mut length = 1;
        while length < Self::LENGTH_MAX && coder.bit(&mut self.length[length as usize - 1])? {
            length += 1;
        }
        let (top, at) = (length - 1, length as usize - 1);
        let mut magnitude = 1u32;
        if top >= 1 {
            let bit = u32::from(coder.bit(&mut self.first[at])?);
            magnitude = magnitude << 1 | bit;
            if top >= 2 {
                magnitude = magnitude << 1 | u32::from(coder.bit(&mut self.second[at][bit as usize])?);
                magnitude = magnitude << (top - 2) | coder.plain(top - 2)?;
            }
        }
        let value = magnitude.cast_signed();
        Some(if negative { -value } else { value })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn contexts() -> ([Magnitude; 2], Context) {
        ([Magnitude::expecting(3), Magnitude::expecting(500)], Context::default())
    }

    proptest! {
        #[test]
        fn integers_come_back(values in prop::collection::vec(prop_oneof![-3i32..=3, -4000i32..4000, -(1 << 25)..(1 << 25)], 0..300)) {
            let (mut m, mut sign) = contexts();
            let mut coder = Encoder::default();
            for (i, value) in values.iter().enumerate() { m[i % 2].encode(&mut coder, &mut sign, *value); }
            let bytes = coder.finish();
            let (mut m, mut sign) = contexts();
            let mut coder = Decoder::new(&bytes).unwrap();
            for (i, value) in values.iter().enumerate() {
                prop_assert_eq!(m[i % 2].decode(&mut coder, &mut sign), Some(*value));
            }
            prop_assert!(coder.is_spent());
        }

        #[test]
        fn any_bytes_decode_to_something_or_nothing(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let (mut m, mut sign) = contexts();
            if let Some(mut coder) = Decoder::new(&bytes) {
                for i in 0..500 {
                    let Some(value) = m[i % 2].decode(&mut coder, &mut sign) else { break };
                    prop_assert!(value.unsigned_abs() < 1 << Magnitude::LENGTH_MAX);
                }
            }
        }
    }

    #[test]
    fn rare_bits_cost_little() {
        let mut context = Context::default();
        let mut coder = Encoder::default();
        for i in 0..8000 {
            coder.bit(&mut context, i % 100 == 99);
        }
        // The entropy is 0.0808 bits a bit: 81 bytes. Adaptation may cost a third.
        let bytes = coder.finish().len();
        assert!((80..110).contains(&bytes), "{bytes} bytes");
    }
}

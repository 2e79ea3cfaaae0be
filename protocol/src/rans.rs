//! The entropy coder: symbols in, bytes out, each at the cost of its probability.
//!
//! Range asymmetric numeral systems (Duda 2013, *Asymmetric numeral systems: entropy coding combining
//! speed of Huffman coding with compression rate of arithmetic coding*): the state of the coder is one
//! integer x in 2^16..2^32; a symbol of probability f/4096 makes it about 4096/f times as large, and what
//! no longer fits leaves as 16-bit words. Decoding undoes the steps last to first, so an [`Encoder`] keeps
//! its symbols until it is finished, and a [`Decoder`] has no division and no search: a symbol is looked
//! up in a table by the state's low bits.
//!
//! **Lanes.** One state is a chain of dependent steps, which leaves most of a processor idle. Large
//! payloads take turns between two states over one sequence of words (Giesen 2014, *Interleaved entropy
//! coders*); small ones do with one, which saves its bytes.
//!
//! | offset | size | field | valid range |
//! |---|---|---|---|
//! | 0 | 4 a lane | states of the lanes, little-endian | 2^16.. |
//! | 4 a lane | .. | words of 16 bits, little-endian | just as many as the symbols take |
//!
//! Two lanes begin, and so end for the receiver, at 2^16. A single one begins at 1, which costs no bits: until
//! its state first outgrows 32 bits there are no words, and where that never happens the state is all there
//! is, without its leading zero bytes. After the last symbol every state must be back at its beginning, and no
//! word may be left.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "states are 32 bits, probabilities 12, words 16: each cast says so beside it; costs are not negative"
)]

use std::sync::LazyLock;

/// Bits of a probability.
pub const PRECISION: u32 = 12;

/// The sum of the probabilities of a table's symbols.
pub const TOTAL: u32 = 1 << PRECISION;

/// The least state while there are words.
const LOWEST: u32 = 1 << 16;

/// Where the states of so many lanes begin.
fn beginning(lanes: usize) -> u32 {
    if lanes == 1 { 1 } else { LOWEST }
}

/// The most bits that [`Encoder::plain`] takes at once.
pub const PLAIN_MAX: u32 = 16;

/// A step of the coder: a share of the probabilities, or some bits as they are.
#[derive(Debug, Clone, Copy)]
struct Step {
    start: u16,
    /// Share out of [`TOTAL`]; 0 marks plain bits, `start` being their value.
    share: u16,
    bits: u8,
    lane: u8,
}

/// What is needed of each share: how many 2^-16 bits it costs, and its reciprocal.
struct Shares {
    costs: [u32; TOTAL as usize + 1],
    reciprocals: [u64; TOTAL as usize + 1],
}

static SHARES: LazyLock<Box<Shares>> = LazyLock::new(|| {
    let mut shares =
        Box::new(Shares { costs: [0; TOTAL as usize + 1], reciprocals: [0; TOTAL as usize + 1] });
    for share in 1..=TOTAL {
        let bits = f64::from(PRECISION) - f64::from(share).log2();
        shares.costs[share as usize] = (bits * f64::from(1 << 16)).round() as u32;
        shares.reciprocals[share as usize] = (1u64 << (32 + PRECISION)).div_ceil(u64::from(share));
    }
    shares
});

/// A state divided by a share, given the share's reciprocal: exact, since 2^44 over it is rounded up by less than
/// a share out of 2^32 times as much (Granlund and Montgomery 1994).
#[inline(always)]
fn quotient(state: u32, reciprocal: u64) -> u32 {
    ((u128::from(state) * u128::from(reciprocal)) >> (32 + PRECISION)) as u32
}

/// Collects symbols and turns them into bytes. Takes 6 bytes a symbol until it is finished.
#[derive(Debug, Default)]
pub struct Encoder {
    steps: Vec<Step>,
}

impl Encoder {
    /// An encoder that has room for so many symbols before it grows.
    #[must_use]
    pub fn with_capacity(symbols: usize) -> Self {
        Self { steps: Vec::with_capacity(symbols) }
    }

    /// Appends a symbol that takes the probabilities `start..start + share` of [`TOTAL`]; share above 0.
    #[inline]
    pub fn symbol(&mut self, lane: u8, start: u16, share: u16) {
        self.steps.push(Step { start, share, bits: 0, lane });
    }

    /// Appends symbols given as start and share, the lanes taking turns.
    pub fn symbols(&mut self, symbols: impl ExactSizeIterator<Item = (u16, u16)>) {
        let symbols = symbols.enumerate();
        self.steps.extend(symbols.map(|(i, (start, share))| Step {
            start,
            share,
            bits: 0,
            lane: (i & 1) as u8,
        }));
    }

    /// Appends the `bits` low bits of `value`, at most [`PLAIN_MAX`], each costing one bit.
    pub fn plain(&mut self, lane: u8, value: u16, bits: u32) {
        self.steps.push(Step { start: value, share: 0, bits: bits as u8, lane });
    }

    /// Appends one bit under an adaptive context.
    #[inline]
    pub fn bit(&mut self, context: &mut Context, bit: bool) {
        let zero = context.probability();
        if bit {
            self.symbol(0, zero, TOTAL as u16 - zero);
        } else {
            self.symbol(0, 0, zero);
        }
        context.learn(bit);
    }

    /// Steps so far: a place to [`Encoder::truncate`] to.
    #[must_use]
    pub fn len(&self) -> usize {
        self.steps.len()
    }

    /// Whether nothing has been appended.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.steps.is_empty()
    }

    /// Takes back all but the first `len` steps.
    pub fn truncate(&mut self, len: usize) {
        self.steps.truncate(len);
    }

    /// About how many bits the symbols will take.
    #[must_use]
    pub fn bits(&self) -> f64 {
        let costs = &SHARES.costs;
        let cost =
            |s: &Step| if s.share == 0 { u32::from(s.bits) << 16 } else { costs[usize::from(s.share)] };
        self.steps.iter().map(|s| u64::from(cost(s))).sum::<u64>() as f64 / f64::from(1 << 16)
    }

    /// The finished bytes, in one lane or in two.
    #[must_use]
    pub fn finish(self, lanes: usize) -> Vec<u8> {
        if self.steps.is_empty() {
            return Vec::new();
        }
        let mut states = [beginning(lanes); 2];
        let mut words: Vec<u16> = Vec::with_capacity(self.steps.len());
        let reciprocals = &SHARES.reciprocals;
        let lane_mask = lanes - 1;
        for step in self.steps.iter().rev() {
            let state = &mut states[usize::from(step.lane) & lane_mask & 1];
            let (share, precision) =
                if step.share == 0 { (1, u32::from(step.bits)) } else { (u32::from(step.share), PRECISION) };
            // The state after the step must stay below 2^32.
            if u64::from(*state) >= u64::from(share) << (32 - precision) {
                words.push(*state as u16);
                *state >>= 16;
            }
            let many = quotient(*state, reciprocals[share as usize]);
            *state = (many << precision) + (*state - many * share) + u32::from(step.start);
        }
        if lanes == 1 && words.is_empty() {
            let zeros = states[0].leading_zeros() as usize / 8;
            return states[0].to_le_bytes()[..4 - zeros].to_vec();
        }
        let mut bytes = Vec::with_capacity(4 * lanes + 2 * words.len());
        for state in &states[..lanes] {
            bytes.extend(state.to_le_bytes());
        }
        bytes.extend(words.iter().rev().flat_map(|word| word.to_le_bytes()));
        bytes
    }
}

/// Takes symbols from bytes, which may be hostile: after their end it goes on with symbols of no meaning;
/// ask [`Decoder::is_spent`] when all are read.
#[derive(Debug, Clone, Copy)]
pub struct Decoder<'a> {
    words: &'a [[u8; 2]],
    next: usize,
    states: [u32; 2],
    lanes: usize,
}

impl<'a> Decoder<'a> {
    /// Over bytes with one lane or two; `None` where they cannot be whole.
    #[must_use]
    pub fn new(bytes: &'a [u8], lanes: usize) -> Option<Self> {
        let mut states = [beginning(lanes); 2];
        match (lanes, bytes) {
            (_, []) => return Some(Self { words: &[], next: 0, states, lanes }),
            (1, [.., highest]) if bytes.len() <= 4 => {
                let mut state = [0; 4];
                state[..bytes.len()].copy_from_slice(bytes);
                states[0] = u32::from_le_bytes(state);
                return (*highest > 0).then_some(Self { words: &[], next: 0, states, lanes });
            }
            _ => {}
        }
        let mut rest = bytes;
        for state in &mut states[..lanes] {
            let (head, tail) = rest.split_first_chunk::<4>()?;
            *state = u32::from_le_bytes(*head);
            rest = tail;
        }
        let (words, odd) = rest.as_chunks::<2>();
        let is_whole = odd.is_empty() && states[..lanes].iter().all(|s| *s >= LOWEST);
        is_whole.then_some(Self { words, next: 0, states, lanes })
    }

    /// How many lanes there are.
    #[must_use]
    pub fn lanes(&self) -> usize {
        self.lanes
    }

    /// The states, to be worked on in registers and given back with [`Decoder::set_states`].
    #[must_use]
    pub fn states(&self) -> [u32; 2] {
        self.states
    }

    /// One lane's state, where others are not needed: reading all after one has been written waits for the writing.
    #[inline(always)]
    #[must_use]
    pub fn state(&self, lane: usize) -> u32 {
        self.states[lane]
    }

    /// Gives one lane's state back.
    #[inline(always)]
    pub fn set_state(&mut self, lane: usize, state: u32) {
        self.states[lane] = state;
    }

    /// Gives the states back.
    pub fn set_states(&mut self, states: [u32; 2]) {
        self.states = states;
    }

    /// Fills a state up with the next word where it has become small.
    ///
    /// Without a branch: whether a word is needed is as random as the data, and would be mispredicted.
    #[inline(always)]
    pub fn refill(&mut self, state: u32) -> u32 {
        let word = self.words.get(self.next);
        let low = state < LOWEST && word.is_some();
        let word = word.map_or(0, |w| u32::from(u16::from_le_bytes(*w)));
        self.next += usize::from(low);
        if low { state << 16 | word } else { state }
    }

    /// `bits` plain bits, at most [`PLAIN_MAX`], of a state; and the state after them.
    #[inline]
    pub fn plain_of(&mut self, state: u32, bits: u32) -> (u32, u32) {
        (state & ((1 << bits) - 1), self.refill(state >> bits))
    }

    /// The next bit under an adaptive context, in the first lane.
    pub fn bit(&mut self, context: &mut Context) -> bool {
        let zero = u32::from(context.probability());
        let slot = self.states[0] % TOTAL;
        let bit = slot >= zero;
        let (start, share) = if bit { (zero, TOTAL - zero) } else { (0, zero) };
        self.states[0] = self.refill(share * (self.states[0] >> PRECISION) + slot - start);
        context.learn(bit);
        bit
    }

    /// Whether the symbols so far are just those of the bytes.
    #[must_use]
    pub fn is_spent(&self) -> bool {
        self.next == self.words.len() && self.states == [beginning(self.lanes); 2]
    }
}

/// How likely the next bit of a context is zero, learnt as bits go by: fast at first, by 1/4, then slower
/// to 1/64.
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

/// The slowest rate of adaptation is 2^-SLOWEST.
const SLOWEST: u32 = 6;

impl Context {
    /// A context that starts out believing that `part` bits of `whole` are zero, but never quite sure.
    #[must_use]
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
        (self.zero >> (16 - PRECISION)).clamp(1, TOTAL as u16 - 1)
    }

    fn learn(&mut self, bit: bool) {
        // 1/2 would forget the prior at once; start at 1/4.
        const RATE: [u16; 32] = rates();
        let rate = u32::from(RATE[usize::from(self.seen) % RATE.len()]);
        // Probability of what did not come: a share of it goes, so it stays within 16 bits.
        let turned = if bit { 0 } else { u16::MAX };
        let other = self.zero ^ turned;
        self.zero = (other - ((u32::from(other) * rate) >> 16) as u16) ^ turned;
        self.seen += u8::from(usize::from(self.seen) + 1 < RATE.len());
    }
}

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

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// What may be appended: a symbol of some share, plain bits, or an adaptive bit.
    #[derive(Debug, Clone, Copy)]
    enum Item {
        Symbol(u16, u16),
        Plain(u16, u32),
        Bit(bool),
    }

    fn any_item() -> impl Strategy<Value = Item> {
        prop_oneof![
            (0u16..4095, 1u16..4096).prop_map(|(start, share)| Item::Symbol(start, share.min(4096 - start))),
            (any::<u16>(), 0u32..=PLAIN_MAX).prop_map(|(v, b)| Item::Plain(v & ((1u32 << b) - 1) as u16, b)),
            any::<bool>().prop_map(Item::Bit),
        ]
    }

    fn written(items: &[Item], lanes: usize) -> Vec<u8> {
        let (mut coder, mut context) = (Encoder::default(), Context::default());
        for (i, item) in items.iter().enumerate() {
            match *item {
                Item::Symbol(start, share) => coder.symbol((i % 2) as u8, start, share),
                Item::Plain(value, bits) => coder.plain((i % 2) as u8, value, bits),
                Item::Bit(bit) => coder.bit(&mut context, bit),
            }
        }
        coder.finish(lanes)
    }

    proptest! {
        #[test]
        fn what_is_written_comes_back(items in prop::collection::vec(any_item(), 0..300), lanes in 1usize..=2) {
            let bytes = written(&items, lanes);
            let (mut coder, mut context) = (Decoder::new(&bytes, lanes).unwrap(), Context::default());
            for (i, item) in items.iter().enumerate() {
                let lane = (i % 2) % lanes;
                let mut states = coder.states();
                match *item {
                    Item::Symbol(start, share) => {
                        let slot = states[lane] % TOTAL;
                        prop_assert!((u32::from(start)..u32::from(start) + u32::from(share)).contains(&slot));
                        let next = u32::from(share) * (states[lane] >> PRECISION) + slot - u32::from(start);
                        states[lane] = coder.refill(next);
                        coder.set_states(states);
                    }
                    Item::Plain(value, bits) => {
                        let (read, next) = coder.plain_of(states[lane], bits);
                        prop_assert_eq!(read, u32::from(value));
                        states[lane] = next;
                        coder.set_states(states);
                    }
                    Item::Bit(bit) => prop_assert_eq!(coder.bit(&mut context), bit),
                }
            }
            prop_assert!(coder.is_spent());
        }

        #[test]
        fn any_bytes_decode_to_something_or_nothing(bytes in prop::collection::vec(any::<u8>(), 0..200), lanes in 1usize..=2) {
            let mut context = Context::default();
            if let Some(mut coder) = Decoder::new(&bytes, lanes) {
                for _ in 0..500 { coder.bit(&mut context); }
                let _ = coder.is_spent();
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
        let estimate = coder.bits() / 8.0;
        let bytes = coder.finish(1).len();
        assert!((80..110).contains(&bytes), "{bytes} bytes");
        assert!((bytes as f64 - estimate).abs() < 6.0, "{bytes} bytes, {estimate} expected");
    }

    #[test]
    fn nothing_takes_no_bytes_and_too_few_are_refused() {
        assert!(Encoder::default().finish(2).is_empty());
        assert!((1..=2).all(|lanes| Decoder::new(&[], lanes).unwrap().is_spent()));
        assert!(Decoder::new(&[0, 0, 1], 2).is_none());
        assert!(Decoder::new(&[0, 0, 1, 0, 7], 1).is_none(), "half a word");
        assert!(Decoder::new(&[1, 0, 0, 0, 7, 7], 1).is_none(), "a state below the least");
        assert!(Decoder::new(&[7, 0], 1).is_none(), "a zero byte that says nothing");
    }

    #[test]
    fn few_symbols_take_few_bytes() {
        let mut coder = Encoder::default();
        for _ in 0..7 {
            coder.symbol(0, 0, TOTAL as u16 / 2);
        }
        assert_eq!(coder.finish(1).len(), 1, "seven bits");
    }
}

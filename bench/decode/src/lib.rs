//! The diamonds of the benchmark `points/decode`, to be decoded on any architecture.
//!
//! A module for wasm32 has neither a clock nor a console: whoever runs it (`run.mjs`) asks for work, numbers in and
//! numbers out, and times it. The native program does the same work.
//!
//! [`sweep`] is law 4: it codes all diamonds of a scene with holes, decodes them as a receiver does, and sums up
//! payloads and heights. If two architectures find the same sums, then a receiver on one has the very heights that a
//! sender on the other meant.

#[path = "../../../protocol/benches/cases/mod.rs"]
mod cases;

use cases::{CASES, Case, case, height, inherited};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::Block;
use diamantina_protocol::message::checksum;
use diamantina_protocol::points;
use std::collections::HashMap;

/// Names of the cases, in their order.
#[must_use]
pub fn names() -> [&'static str; CASES.len()] {
    CASES.map(|(name, ..)| name)
}

/// Copies of a diamond that are about to be decoded, 33 kB each.
pub struct Work {
    case: Case,
    blocks: Vec<Block>,
}

impl Work {
    /// The diamond of a case; its training takes a tenth of a second.
    ///
    /// # Panics
    /// When there is no such case.
    #[must_use]
    pub fn new(number: usize) -> Self {
        let (_, fine_step, past) = CASES[number];
        Self { case: case(fine_step, past), blocks: Vec::new() }
    }

    /// Points that a diamond's payload speaks of.
    #[must_use]
    pub fn points(&self) -> usize {
        self.case.points()
    }

    /// Lays out `copies` blocks with what the parents leave.
    pub fn lay_out(&mut self, copies: usize) {
        self.blocks.resize(copies, self.case.old.clone());
        self.blocks.fill(self.case.old.clone());
    }

    /// Decodes into each of the blocks.
    ///
    /// # Panics
    /// When a payload that was made here does not decode: our own bug.
    pub fn decode(&mut self) {
        let Case { forest, coding, diamond, payload, .. } = &self.case;
        for block in &mut self.blocks {
            points::decode(forest, coding, *diamond, block, payload).expect("a payload of our own");
        }
    }

    /// Whether each of the blocks holds what the sender meant.
    #[must_use]
    pub fn is_right(&self) -> bool {
        let Case { forest, coding, diamond, old, source, .. } = &self.case;
        let mut sent = old.clone();
        let _payload = points::encode(forest, coding, *diamond, &mut sent, source);
        self.blocks.iter().all(|block| *block == sent)
    }
}

/// Checksums of all payloads and of all decoded heights of a scene with holes, in the coding of a case: the payloads'
/// in the upper half.
///
/// # Panics
/// When a receiver does not find what the sender meant.
#[must_use]
pub fn sweep(number: usize) -> u64 {
    let (_, fine_step, past) = CASES[number];
    let Case { forest, coding, .. } = case(fine_step, past);
    let hole = |x: u32, y: u32| ((x / 37) ^ (y / 53)).is_multiple_of(7);
    let (mut payloads, mut heights) = (Vec::new(), Vec::new());
    let mut before = HashMap::new();
    for level in 0..forest.levels() {
        let mut here = HashMap::new();
        for d in forest.diamonds(level) {
            let mut source = Block::empty(&forest, level);
            source.fill(&forest.local(d), |x, y| if hole(x, y) { NODATA } else { height(x, y) });
            let (mut sent, mut received) = (inherited(&forest, &before, d), inherited(&forest, &before, d));
            let payload = points::encode(&forest, &coding, d, &mut sent, &source);
            points::decode(&forest, &coding, d, &mut received, &payload).expect("a payload of our own");
            assert!(sent == received, "a receiver finds what the sender meant");
            payloads.extend(checksum(&payload).to_le_bytes());
            let bytes: Vec<u8> = received.heights().iter().flat_map(|h| h.to_le_bytes()).collect();
            heights.extend(checksum(&bytes).to_le_bytes());
            here.insert(d, received);
        }
        before = here;
    }
    (u64::from(checksum(&payloads)) << 32) | u64::from(checksum(&heights))
}

/// What a module for wasm32 answers.
#[cfg(target_arch = "wasm32")]
#[allow(
    unsafe_code,
    reason = "no code is unsafe: the names must be the module's only ones, which cargo sees to"
)]
mod exports {
    use super::Work;
    use std::cell::RefCell;

    thread_local! {
        static WORK: RefCell<Option<Work>> = const { RefCell::new(None) };
    }

    fn with<T>(act: impl FnOnce(&mut Work) -> T) -> T {
        WORK.with_borrow_mut(|work| act(work.as_mut().expect("`choose` comes first")))
    }

    #[unsafe(no_mangle)]
    extern "C" fn choose(number: u32) {
        WORK.set(Some(Work::new(number as usize)));
    }

    #[unsafe(no_mangle)]
    extern "C" fn lay_out(copies: u32) {
        with(|work| work.lay_out(copies as usize));
    }

    #[unsafe(no_mangle)]
    extern "C" fn decode() {
        with(Work::decode);
    }

    #[unsafe(no_mangle)]
    extern "C" fn is_right() -> u32 {
        with(|work| u32::from(work.is_right()))
    }

    #[unsafe(no_mangle)]
    extern "C" fn sweep(number: u32) -> u64 {
        super::sweep(number as usize)
    }
}

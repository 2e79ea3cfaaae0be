//! The laws that the whole system stands on, as properties of random fields: cracks cannot exist (law 2),
//! the bound holds at every sample (law 3), the receiver has what the sender had (law 4), and decoders
//! take any bytes (law 6). Law 1 is tested in `bintree.rs` and here for diamonds.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    clippy::unwrap_used,
    reason = "fields of a few hundred points, made here"
)]

use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::points::{self, Coding, DecodeError, FORMAT, Rule, decode, encode};
use proptest::prelude::*;
use std::collections::HashMap;

/// A field of heights over a forest.
struct Field {
    forest: Forest,
    heights: Vec<i32>,
}

impl Field {
    fn at(&self, x: u32, y: u32) -> i32 {
        self.heights[(y * (self.forest.size()[0] + 1) + x) as usize]
    }

    fn block(&self, d: Diamond) -> Block {
        let mut block = Block::empty(&self.forest, d.level());
        block.fill(&self.forest.local(d), |x, y| self.at(x, y));
        block
    }
}

impl std::fmt::Debug for Field {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:?}", self.forest)
    }
}

/// What crosses the wire, and what sender and receiver make of it.
struct Sent {
    payloads: HashMap<Diamond, Vec<u8>>,
    blocks: HashMap<Diamond, Block>,
}

fn inherited(forest: &Forest, blocks: &HashMap<Diamond, Block>, d: Diamond) -> Block {
    let mut block = Block::empty(forest, d.level());
    for p in forest.parents(d) {
        block.inherit(forest, d, p, &blocks[&p]);
    }
    block
}

fn send(field: &Field, coding: &Coding) -> Sent {
    let forest = &field.forest;
    let (mut payloads, mut blocks) = (HashMap::new(), HashMap::new());
    for d in (0..forest.levels()).flat_map(|level| forest.diamonds(level)) {
        let mut block = inherited(forest, &blocks, d);
        let bytes = encode(forest, coding, d, &mut block, &field.block(d));
        let mut rounded = inherited(forest, &blocks, d);
        points::quantise(forest, coding, d, &mut rounded, &field.block(d));
        assert!(bytes.is_empty() || rounded == block, "a sender that keeps no bytes has the same heights");
        payloads.insert(d, bytes);
        blocks.insert(d, block);
    }
    Sent { payloads, blocks }
}

/// Smooth hills, cliffs, flat sea and holes without data.
fn field(forest: Forest, seed: u32, rough: i32, holes: u32) -> Field {
    let [w, h] = forest.size();
    let hash = |x: u32, y: u32, z: u32| {
        let mut v =
            x.wrapping_mul(0x9E37_79B1) ^ y.wrapping_mul(0x85EB_CA77) ^ z.wrapping_mul(0xC2B2_AE3D) ^ seed;
        v = (v ^ v >> 15).wrapping_mul(0x2C1B_3C6D);
        v ^ v >> 13
    };
    let mut heights = Vec::new();
    for y in 0..=h {
        for x in 0..=w {
            let cliff = if (x + y * 2) % 37 > 18 { rough * 3 } else { 0 };
            let noise = (hash(x, y, 1) % (2 * rough.cast_unsigned() + 1)).cast_signed() - rough;
            let sea = hash(x / 7, y / 5, 2) % 4 == 0;
            // Up to 15 in 16: lone samples in a sea of nothing.
            let hole =
                holes > 0 && (hash(x / 3, y / 4, 3) % 16 < holes || hash(x, y, 4) % 64 < holes * holes / 4);
            heights.push(if hole {
                NODATA
            } else if sea {
                0
            } else {
                cliff + noise + (x as i32 - y as i32)
            });
        }
    }
    Field { forest, heights }
}

/// The coding with a model learnt from every third diamond of the finest level.
fn learnt(field: &Field, coding: Coding) -> Coding {
    let finest = field.forest.diamonds(field.forest.levels() - 1);
    let some: Vec<Diamond> = finest.step_by(3).collect();
    let source = |d| Ok::<_, std::convert::Infallible>(field.block(d));
    let Ok(model) = points::train(&field.forest, &coding, &some, source);
    coding.with_model(model)
}

prop_compose! {
    fn any_world()(m in 2u8..=3, extra in 1u8..=3, c in 1u32..=2, r in 1u32..=2, seed in any::<u32>(),
                   rough in prop_oneof![Just(0), 1..20, Just(3000)], holes in prop_oneof![Just(0u32), 1u32..5, Just(12), Just(15), Just(16)],
                   e in prop_oneof![Just(0u32), Just(1), Just(5), Just(40)],
                   smooth in any::<bool>(), learns in any::<bool>(), precision in prop_oneof![Just(0u8), 1u8..=3],
                   rises in prop::collection::vec(0u8..2, 10))
                  -> (Field, Coding) {
        let forest = Forest::new(m + extra, m, [c, r]).unwrap().with_precision(precision).unwrap();
        // Exponents that fall to zero in steps of at most one.
        let mut exponents = vec![0u8; forest.levels() as usize + 1];
        for i in (0..forest.levels() as usize).rev() { exponents[i] = exponents[i + 1] + rises[i]; }
        let rule = if smooth { Rule::Smooth } else { Rule::Midpoint };
        let field = field(forest, seed, rough, holes);
        let coding = Coding::new(rule, 2 * e + 1, exponents).unwrap();
        let coding = if learns { learnt(&field, coding) } else { coding };
        (field, coding)
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn the_bound_holds_at_every_sample_and_no_data_stays_no_data((field, coding) in any_world()) {
        let sent = send(&field, &coding);
        let bound = (coding.fine_step() as i32 - 1) / 2;
        let forest = &field.forest;
        let mut seen = 0;
        let deepest = forest.levels() - 1;
        for d in forest.diamonds(deepest) {
            let source = field.block(d);
            let last = &sent.blocks[&d];
            let (local, n) = (forest.local(d), source.segments());
            for [p, q] in source.places() {
                if !local.upper && q > p { continue }
                // Points on the sides belong to a neighbour of this level or of the one before: they have
                // their last height too.
                let slot = Block::slot(n, p, q);
                let (h, s) = (last.heights()[slot], source.heights()[slot]);
                prop_assert_eq!(h == NODATA, s == NODATA);
                if h != NODATA { prop_assert!((h - s).abs() <= bound, "{:?} {} {}: {} for {}", d, p, q, h, s); }
                seen += 1;
            }
        }
        prop_assert!(seen >= field.heights.len());
    }

    #[test]
    fn at_every_level_a_point_is_within_half_its_step((field, coding) in any_world()) {
        let sent = send(&field, &coding);
        let widest = coding.fine_step() as i32 * 3i32.pow(10);
        for (d, block) in &sent.blocks {
            for (h, s) in block.heights().iter().zip(field.block(*d).heights()) {
                prop_assert_eq!(*h == NODATA, *s == NODATA);
                if *h != NODATA { prop_assert!((h - s).abs() <= widest / 2); }
            }
        }
    }

    #[test]
    fn the_receiver_has_what_the_sender_had_bit_for_bit((field, coding) in any_world()) {
        let sent = send(&field, &coding);
        let mut blocks: HashMap<Diamond, Block> = HashMap::new();
        for d in (0..field.forest.levels()).flat_map(|level| field.forest.diamonds(level)) {
            let mut block = inherited(&field.forest, &blocks, d);
            let tally = decode(&field.forest, &coding, d, &mut block, &sent.payloads[&d]).unwrap();
            if !sent.payloads[&d].is_empty() {
                let n = field.forest.segments() as u32;
                let new = n * n + if d.level() == 0 { (n + 1) * (n + 1) } else { 0 };
                prop_assert!(tally.real + tally.fictitious <= new);
            }
            prop_assert_eq!(&block, &sent.blocks[&d]);
            blocks.insert(d, block);
        }
    }

    #[test]
    fn both_parents_agree_about_what_they_share((field, coding) in any_world()) {
        // A child takes the points of its hypotenuse from either parent. If they ever differed, the order
        // of arrival would show: so inherit in both orders.
        let sent = send(&field, &coding);
        let forest = &field.forest;
        for d in (1..forest.levels()).flat_map(|level| forest.diamonds(level)) {
            let parents: Vec<_> = forest.parents(d).collect();
            let mut backwards = Block::empty(forest, d.level());
            for p in parents.iter().rev() { backwards.inherit(forest, d, *p, &sent.blocks[p]); }
            prop_assert_eq!(&backwards, &inherited(forest, &sent.blocks, d));
        }
    }

    #[test]
    fn a_split_moves_nothing_on_the_diamonds_border((field, coding) in any_world()) {
        let sent = send(&field, &coding);
        let forest = &field.forest;
        for d in (1..forest.levels()).flat_map(|level| forest.diamonds(level)) {
            let n = forest.segments_at(d.level());
            let (before, after) = (inherited(forest, &sent.blocks, d), &sent.blocks[&d]);
            let upper = forest.local(d).upper;
            for i in 0..=n {
                let mut sides = vec![(i, 0), (n, i)];
                if upper { sides.extend([(0, i), (i, n)]); }
                for (u, v) in sides {
                    let slot = Block::slot(n, 2 * u, 2 * v);
                    prop_assert_eq!(before.heights()[slot], after.heights()[slot]);
                }
            }
        }
    }

    #[test]
    fn any_bytes_are_a_payload_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..300), level in 0u32..7, flags in 0u8..8) {
        let forest = Forest::new(4, 2, [1, 1]).unwrap().with_precision(3).unwrap();
        let coding = Coding::new(Rule::Smooth, 3, vec![5, 5, 4, 4, 3, 2, 1, 0]).unwrap();
        let d = forest.diamonds(level).last().unwrap();
        let mut block = Block::empty(&forest, level);
        if level > 0 { block.parts_mut().0.fill(100); }
        let _ = decode(&forest, &coding, d, &mut block, &bytes);
        // And with a header that lets the symbols through.
        let mut framed = vec![FORMAT << 4 | flags];
        framed.extend(&bytes[..bytes.len() / 2 * 2]);
        let _ = decode(&forest, &coding, d, &mut block, &framed);
    }

    #[test]
    fn a_centre_gives_back_its_diamond_and_its_kin(m in 2u8..=3, extra in 1u8..=3, c in 1u32..=3, r in 1u32..=3, precision in 0u8..=3) {
        let forest = Forest::new(m + extra, m, [c, r]).unwrap().with_precision(precision).unwrap();
        for level in 0..forest.levels() {
            for d in forest.diamonds(level) {
                prop_assert_eq!(d.level(), level);
                prop_assert_eq!(forest.diamond(d.centre()), Some(d));
                for child in forest.children(d).into_iter().flatten() {
                    prop_assert_eq!(child.level(), level + 1);
                    prop_assert!(forest.parents(child).any(|p| p == d));
                }
                for parent in forest.parents(d) {
                    prop_assert!(forest.children(parent).contains(&Some(d)));
                }
            }
        }
    }
}

fn world() -> (Field, Coding) {
    let forest = Forest::new(4, 2, [1, 1]).unwrap().with_precision(2).unwrap();
    (field(forest, 7, 9, 1), Coding::new(Rule::Smooth, 3, vec![3, 3, 2, 2, 2, 1, 0]).unwrap())
}

#[test]
fn golden_bytes_of_format_3() {
    let (field, coding) = world();
    let sent = send(&field, &coding);
    let mut all = Vec::new();
    for d in (0..field.forest.levels()).flat_map(|level| field.forest.diamonds(level)) {
        all.extend((sent.payloads[&d].len() as u32).to_le_bytes());
        all.extend(&sent.payloads[&d]);
    }
    let root = &sent.payloads[&field.forest.root_diamonds().next().unwrap()];
    let hash = xxhash_rust::xxh3::xxh3_64(&all);
    assert_eq!(
        (all.len(), hash),
        (GOLDEN_BYTES, GOLDEN_HASH),
        "the format changed: raise FORMAT; root is {root:02x?}"
    );
}

const GOLDEN_BYTES: usize = 640;
const GOLDEN_HASH: u64 = 9865382836694118852;

#[test]
fn damaged_payloads_are_refused() {
    let (field, coding) = world();
    let sent = send(&field, &coding);
    let forest = &field.forest;
    let d = forest.root_diamonds().next().unwrap();
    let good = &sent.payloads[&d];
    let try_it = |bytes: &[u8]| decode(forest, &coding, d, &mut Block::empty(forest, d.level()), bytes);
    assert!(try_it(good).is_ok());
    for cut in 1..good.len() {
        assert!(try_it(&good[..cut]).is_err(), "prefix of {cut} bytes");
    }
    let extra = [good.as_slice(), &[0]].concat();
    assert_eq!(try_it(&extra), Err(DecodeError::Symbols));
    // Symbols left over: the payload of a diamond with more to say.
    let padded = [good.as_slice(), &[0x5a; 8]].concat();
    assert_eq!(try_it(&padded), Err(DecodeError::Symbols));
    let mut version = good.clone();
    version[0] = (FORMAT + 1) << 4;
    assert_eq!(try_it(&version), Err(DecodeError::Format { found: FORMAT + 1 }));
    let mut flags = good.clone();
    flags[0] |= 8;
    assert!(matches!(try_it(&flags), Err(DecodeError::Flags { .. })));
    let short_coding = Coding::new(Rule::Smooth, 3, vec![0, 0]).unwrap();
    assert!(matches!(
        decode(forest, &short_coding, d, &mut Block::empty(forest, d.level()), good),
        Err(DecodeError::Levels { .. })
    ));
}

#[test]
fn a_diamond_without_heights_takes_no_bytes() {
    let (mut field, coding) = world();
    field.heights.fill(NODATA);
    assert!(send(&field, &coding).payloads.values().all(Vec::is_empty));
}

#[test]
fn flat_ground_takes_no_bytes_but_the_roots() {
    let forest = Forest::new(8, 6, [1, 1]).unwrap().with_precision(2).unwrap();
    let mut field = field(forest, 1, 1, 0);
    // A multiple of the coarsest step.
    field.heights.fill(15 * 81);
    let coding = Coding::new(Rule::Smooth, 1, vec![4, 3, 2, 2, 2, 1, 0]).unwrap();
    let sent = send(&field, &coding);
    for (d, payload) in &sent.payloads {
        assert_eq!(payload.is_empty(), d.level() > 0, "{d:?}");
    }
}

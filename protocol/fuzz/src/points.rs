//! Payloads of diamonds: any bytes decode to heights or an error; and what decodes twice is the same.
//!
//! The first byte chooses the forest's patch, the level and the rule; the rest is the payload, with a
//! header made to fit unless the second byte says otherwise (else few inputs would have a known format).

use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::points::{self, Coding, FORMAT, Rule};

/// One input.
pub fn run(data: &[u8]) {
    let [choice, shape, rest @ ..] = data else { return };
    let patch_log2 = 2 + choice % 3;
    let forest = Forest::new(patch_log2 + 2, patch_log2, [2, 1]).expect("within the documented limits");
    let forest = forest.with_precision(2).expect("few levels past the lattice");
    let levels = forest.levels();
    let level = u32::from(choice >> 2 & 15) % levels;
    let rule = if choice & 0x80 == 0 { Rule::Smooth } else { Rule::Midpoint };
    let exponents = (0..=levels).map(|l| ((levels - l) / 2) as u8).collect();
    let coding = Coding::new(rule, 3, exponents).expect("falling exponents, odd step");
    let diamonds: Vec<Diamond> = forest.diamonds(level).collect();
    let d = diamonds[usize::from(*shape >> 2) % diamonds.len()];
    let payload = if shape & 1 == 0 { rest.to_vec() } else { with_header(shape >> 1 & 7, rest) };
    let mut block = known_points(&forest, level, *choice);
    let mut again = block.clone();
    let first = points::decode(&forest, &coding, d, &mut block, &payload);
    assert_eq!(first, points::decode(&forest, &coding, d, &mut again, &payload));
    if first.is_ok() {
        assert_eq!(block, again);
        let within = |h: &i32| *h == NODATA || h.abs() <= diamantina_protocol::HEIGHT_MAX;
        assert!(block.heights().iter().all(within));
    }
}

fn with_header(flags: u8, symbols: &[u8]) -> Vec<u8> {
    let mut bytes = vec![FORMAT << 4 | flags];
    bytes.extend(&symbols[..symbols.len() & !1]);
    bytes
}

/// Known points as parents could leave them: a slope, with holes for some choices.
fn known_points(forest: &Forest, level: u32, choice: u8) -> Block {
    let mut block = Block::empty(forest, level);
    let known = if forest.adds_points(level) { block.parts_mut().0 } else { block.heights_mut() };
    for (i, height) in known.iter_mut().enumerate() {
        let hole = choice & 0x40 != 0 && i % 11 == 3;
        *height = if hole { NODATA } else { i as i32 * 17 - 900 };
    }
    block
}

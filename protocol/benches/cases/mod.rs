//! The diamonds that are coded and decoded by benchmarks, here and in the browser's architecture (`bench/decode`).

use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::points::{self, Coding, Rule};
use std::collections::HashMap;
use std::convert::Infallible;

/// Name, finest step in metres, and whether old points have a coarser step.
pub(crate) const CASES: [(&str, u32, bool); 5] = [
    ("lossless", 1, false),
    ("lossless_corrected", 1, true),
    ("error_1_m", 3, false),
    ("error_1_m_corrected", 3, true),
    ("error_5_m", 11, false),
];

/// One root square of 1024 cells in patches of 64 segments: eight levels.
pub(crate) fn forest() -> Forest {
    Forest::new(10, 6, [1, 1]).expect("within the documented limits")
}

/// Hills of eight octaves, 0 to about 2500 m in whole metres, rough as a survey at 30 m is.
pub(crate) fn height(x: u32, y: u32) -> i32 {
    let corner = |i: u32, j: u32, octave: u32| {
        let mut v = i.wrapping_mul(0x9E37_79B1) ^ j.wrapping_mul(0x85EB_CA6B) ^ octave;
        v = (v ^ v >> 16).wrapping_mul(0x7FEB_352D);
        f64::from((v ^ v >> 15) & 0xffff) / 65535.0
    };
    let mut sum = 0.0;
    for octave in 0..8 {
        let side = 512 >> octave;
        let (i, j) = (x / side, y / side);
        let fade = |t: f64| t * t * (3.0 - 2.0 * t);
        let (s, t) =
            (fade(f64::from(x % side) / f64::from(side)), fade(f64::from(y % side) / f64::from(side)));
        let row = |j: u32| corner(i, j, octave) * (1.0 - s) + corner(i + 1, j, octave) * s;
        sum += (row(j) * (1.0 - t) + row(j + 1) * t) * 1250.0 / f64::from(1 << octave);
    }
    #[allow(clippy::cast_possible_truncation, reason = "below 2500 m")]
    let whole = sum as i32;
    whole
}

/// A diamond of the finest level with what its parents leave, its source and its payload.
pub(crate) struct Case {
    pub(crate) forest: Forest,
    pub(crate) coding: Coding,
    pub(crate) diamond: Diamond,
    pub(crate) old: Block,
    pub(crate) source: Block,
    pub(crate) payload: Vec<u8>,
}

/// `coarse`: whether old points have a coarser step, so that each is corrected as well.
pub(crate) fn case(fine_step: u32, coarse: bool) -> Case {
    let forest = forest();
    let exponents = if coarse { vec![4, 4, 3, 3, 2, 2, 1, 1, 0] } else { vec![0; 9] };
    let coding = Coding::new(Rule::Smooth, fine_step, exponents).expect("falling exponents, odd step");
    let source_of = |d: Diamond| {
        let mut block = Block::empty(&forest);
        block.fill(&forest.local(d), height);
        block
    };
    let inherited = |before: &HashMap<Diamond, Block>, d: Diamond| {
        let mut block = Block::empty(&forest);
        for parent in forest.parents(d) {
            block.inherit(&forest, d, parent, &before[&parent]);
        }
        block
    };
    let finest = forest.levels() - 1;
    let some: Vec<Diamond> = forest.diamonds(finest).step_by(6).collect();
    let Ok(model) = points::train(&forest, &coding, &some, |d| Ok::<_, Infallible>(source_of(d)));
    let coding = coding.with_model(model);
    let mut before = HashMap::new();
    for level in 0..finest {
        let mut here = HashMap::new();
        for d in forest.diamonds(level) {
            let mut block = inherited(&before, d);
            points::quantise(&forest, &coding, d, &mut block, &source_of(d));
            here.insert(d, block);
        }
        before = here;
    }
    let inner = |d: &Diamond| forest.local(*d).upper;
    let diamond = forest.diamonds(finest).filter(inner).nth(40).expect("more than forty diamonds");
    let (old, source) = (inherited(&before, diamond), source_of(diamond));
    let payload = points::encode(&forest, &coding, diamond, &mut old.clone(), &source);
    Case { forest, coding, diamond, old, source, payload }
}

//! The diamonds that are coded and decoded by benchmarks, here and in the browser's architecture (`bench/decode`).

use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::points::{self, Coding, Rule};
use std::collections::HashMap;
use std::convert::Infallible;

/// Name, finest step in metres, and levels past the lattice. Without any, a diamond of the lattice's last level,
/// all of whose points are new; with some, one of the last of them, whose points are corrected.
pub(crate) const CASES: [(&str, u32, u8); 5] = [
    ("lossless", 1, 0),
    ("error_1_m", 3, 0),
    ("error_5_m", 11, 0),
    ("from_4_m_to_1_m", 3, 1),
    ("from_1_m_to_lossless", 1, 2),
];

/// One root square of 1024 cells in patches of 64 segments: eight levels.
pub(crate) fn forest() -> Forest {
    Forest::new(10, 6, [1, 1]).expect("within the documented limits")
}

/// Hills of ten octaves, 0 to about 2500 m in whole metres, rough as a survey at 30 m is.
pub(crate) fn height(x: u32, y: u32) -> i32 {
    let corner = |i: u32, j: u32, octave: u32| {
        let mut v = i.wrapping_mul(0x9E37_79B1) ^ j.wrapping_mul(0x85EB_CA6B) ^ octave;
        v = (v ^ v >> 16).wrapping_mul(0x7FEB_352D);
        f64::from((v ^ v >> 15) & 0xffff) / 65535.0
    };
    let (mut sum, mut size) = (0.0, 1250.0);
    for octave in 0..10 {
        let side = 512 >> octave;
        let (i, j) = (x / side, y / side);
        let fade = |t: f64| t * t * (3.0 - 2.0 * t);
        let (s, t) =
            (fade(f64::from(x % side) / f64::from(side)), fade(f64::from(y % side) / f64::from(side)));
        let row = |j: u32| corner(i, j, octave) * (1.0 - s) + corner(i + 1, j, octave) * s;
        sum += (row(j) * (1.0 - t) + row(j + 1) * t) * size;
        size /= 1.75;
    }
    #[allow(clippy::cast_possible_truncation, reason = "below 2500 m")]
    let whole = sum as i32;
    whole
}

/// A diamond with what its parents leave, its source and its payload.
pub(crate) struct Case {
    pub(crate) forest: Forest,
    pub(crate) coding: Coding,
    pub(crate) diamond: Diamond,
    pub(crate) old: Block,
    pub(crate) source: Block,
    pub(crate) payload: Vec<u8>,
}

impl Case {
    /// Points that the diamond's split adds or corrects.
    pub(crate) fn points(&self) -> usize {
        let n = self.old.segments();
        match (self.forest.adds_points(self.diamond.level()), self.old.has_centres()) {
            (true, _) => n * n,
            (false, false) => (n - 1) * (n - 1),
            (false, true) => (n - 1) * (n - 1) + n * n,
        }
    }
}

/// The block of a diamond with what its parents leave.
pub(crate) fn inherited(forest: &Forest, before: &HashMap<Diamond, Block>, d: Diamond) -> Block {
    let mut block = Block::empty(forest, d.level());
    for parent in forest.parents(d) {
        block.inherit(forest, d, parent, &before[&parent]);
    }
    block
}

/// With so many levels past the lattice, each of which divides the step by three.
pub(crate) fn case(fine_step: u32, past: u8) -> Case {
    let forest = forest().with_precision(past).expect("few levels past the lattice");
    let left = |level: u32| u32::from(past) - level.saturating_sub(forest.lattice_levels());
    let exponents = (0..=forest.levels()).map(|level| u8::try_from(left(level)).unwrap_or(0)).collect();
    let coding = Coding::new(Rule::Smooth, fine_step, exponents).expect("falling exponents, odd step");
    let source_of = |d: Diamond| {
        let mut block = Block::empty(&forest, d.level());
        block.fill(&forest.local(d), height);
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
            let mut block = inherited(&forest, &before, d);
            points::quantise(&forest, &coding, d, &mut block, &source_of(d));
            here.insert(d, block);
        }
        before = here;
    }
    let inner = |d: &Diamond| forest.local(*d).upper;
    let diamond = forest.diamonds(finest).filter(inner).nth(40).expect("more than forty diamonds");
    let (old, source) = (inherited(&forest, &before, diamond), source_of(diamond));
    let payload = points::encode(&forest, &coding, diamond, &mut old.clone(), &source);
    Case { forest, coding, diamond, old, source, payload }
}

//! How fast diamonds become bytes and come back, and how fast a page of the index is read.
#![allow(clippy::cast_possible_truncation, reason = "heights below 2500 m")]

use criterion::{BatchSize, Criterion, Throughput};
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::points::{self, Coding, Rule};
use std::collections::HashMap;
use std::convert::Infallible;
use std::hint::black_box;

/// One root square of 1024 cells in patches of 64 segments: eight levels.
fn forest() -> Forest {
    Forest::new(10, 6, [1, 1]).expect("within the documented limits")
}

/// Hills of eight octaves, 0 to about 2500 m in whole metres, rough as a survey at 30 m is.
fn height(x: u32, y: u32) -> i32 {
    let corner = |i: u32, j: u32, octave: u32| {
        let mut v = i.wrapping_mul(0x9E37_79B1) ^ j.wrapping_mul(0x85EB_CA6B) ^ octave;
        v = (v ^ v >> 16).wrapping_mul(0x7FEB_352D);
        f64::from((v ^ v >> 15) & 0xffff) / 65535.0
    };
    let mut sum = 0.0;
    for octave in 0..10 {
        let side = 512 >> octave;
        let (i, j) = (x / side, y / side);
        let fade = |t: f64| t * t * (3.0 - 2.0 * t);
        let (s, t) =
            (fade(f64::from(x % side) / f64::from(side)), fade(f64::from(y % side) / f64::from(side)));
        let row = |j: u32| corner(i, j, octave) * (1.0 - s) + corner(i + 1, j, octave) * s;
        sum += (row(j) * (1.0 - t) + row(j + 1) * t) * 1250.0 / 1.75f64.powi(octave.cast_signed());
    }
    sum as i32
}

/// A diamond with what its parents leave, its source and its payload.
struct Case {
    forest: Forest,
    coding: Coding,
    diamond: Diamond,
    old: Block,
    source: Block,
    payload: Vec<u8>,
}

/// Of the last level of the lattice, whose steps are fine; or of a level past it, the first being 1, whose
/// points are corrected by one factor of three.
fn case(fine_step: u32, past: u8) -> Case {
    let forest = forest().with_precision(past).expect("few levels past the lattice");
    let lattice = forest.lattice_levels();
    let exponents = (0..=forest.levels()).map(|l| past - l.saturating_sub(lattice) as u8).collect();
    let coding = Coding::new(Rule::Smooth, fine_step, exponents).expect("falling exponents, odd step");
    let source_of = |d: Diamond| {
        let mut block = Block::empty(&forest, d.level());
        block.fill(&forest.local(d), height);
        block
    };
    let inherited = |before: &HashMap<Diamond, Block>, d: Diamond| {
        let mut block = Block::empty(&forest, d.level());
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

/// Points that the split of a case's diamond adds or corrects.
fn points_of(case: &Case) -> u64 {
    let (n, level) = (case.old.segments() as u64, case.diamond.level());
    match (case.forest.adds_points(level), case.old.has_centres()) {
        (true, _) => n * n,
        (false, false) => (n - 1) * (n - 1),
        (false, true) => (n - 1) * (n - 1) + n * n,
    }
}

fn points(c: &mut Criterion) {
    let mut group = c.benchmark_group("points");
    let cases = [
        ("lossless", 1, 0),
        ("error_1_m", 3, 0),
        ("error_5_m", 11, 0),
        ("4_m_to_1_m", 3, 1),
        ("1_m_to_lossless", 1, 2),
    ];
    for (name, fine_step, past) in cases {
        let case = case(fine_step, past);
        let points = points_of(&case);
        group.throughput(Throughput::Elements(points));
        println!("{name}: {} bytes for {points} points", case.payload.len());
        group.bench_function(format!("encode/{name}"), |b| {
            b.iter_batched_ref(
                || case.old.clone(),
                |block| points::encode(&case.forest, &case.coding, case.diamond, block, &case.source),
                BatchSize::SmallInput,
            );
        });
        group.bench_function(format!("decode/{name}"), |b| {
            b.iter_batched_ref(
                || case.old.clone(),
                |block| points::decode(&case.forest, &case.coding, case.diamond, block, &case.payload),
                BatchSize::SmallInput,
            );
        });
    }
    group.finish();
}

fn pages(c: &mut Criterion) {
    let forest = Forest::new(11, 6, [1, 1]).expect("within the documented limits");
    let diamonds = index::page_diamonds(&forest, 0).expect("the first page");
    let entry = |i: i32| Entry {
        error_metres: 4000.0 / (i + 1) as f32,
        low: i % 700,
        high: i % 700 + 90,
        bytes: 2100,
    };
    let entries: Vec<Entry> = (0..).map(entry).take(diamonds.len()).collect();
    let bytes = index::encode(&entries);
    let mut group = c.benchmark_group("index");
    group.throughput(Throughput::Elements(entries.len() as u64));
    group.bench_function("decode_page", |b| b.iter(|| index::decode(&forest, 0, black_box(&bytes))));
    group.finish();
}

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    points(&mut criterion);
    pages(&mut criterion);
    criterion.final_summary();
}

//! How fast diamonds become bytes and come back, and how fast a page of the index is read.
#![allow(clippy::cast_possible_truncation, reason = "heights below 2500 m")]

mod cases;

use cases::{CASES, case, forest, height};
use criterion::{BatchSize, Criterion, Throughput};
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::points;
use diamantina_protocol::tin::{self, Patch};
use std::hint::black_box;

fn points(c: &mut Criterion) {
    let mut group = c.benchmark_group("points");
    for (name, fine_step, past) in CASES {
        let case = case(fine_step, past);
        group.throughput(Throughput::Elements(case.points() as u64));
        println!("{name}: {} bytes for {} points", case.payload.len(), case.points());
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

/// The patch of the root with most vertices moved aside and many cells cut in two: as many triangles as patches have
/// that were simplified, and as irregular.
fn irregular(forest: &Forest) -> Patch {
    let root = forest.root_diamonds().next().expect("a forest has roots");
    let regular = Patch::regular(forest, root, 32, |[x, y]| Some(height(x, y)));
    let chance = |x: u32, y: u32, salt: u32| {
        let v = (x.wrapping_mul(0x9E37_79B1) ^ y.wrapping_mul(0x85EB_CA6B) ^ salt).wrapping_mul(0x7FEB_352D);
        (v ^ v >> 15) >> 8 & 0xff
    };
    let mut patch = Patch { vertices: regular.vertices.clone(), ..Patch::default() };
    // Those on the sides and the diagonals stay; the others move by a quarter of their distance at most.
    for vertex in &mut patch.vertices {
        let (x, y) = (vertex.x, vertex.y);
        if ![x, y].iter().any(|w| w % 1024 == 0) && x != y && x + y != 1024 {
            let aside = |salt| chance(x, y, salt) % 9;
            (vertex.x, vertex.y) = (x + aside(1) - 4, y + aside(2) - 4);
            vertex.height = height(vertex.x, vertex.y);
        }
    }
    for child in 0..4 {
        for cell in regular.triangles[regular.range(child)].chunk_by(|a, b| a[2] == b[2]) {
            let middle = regular.vertices[cell[0][2] as usize];
            match (cell, chance(middle.x, middle.y, 3)) {
                ([a, b, c, d], 100..) => patch.triangles.extend([[a[0], b[0], c[0]], [a[0], c[0], d[0]]]),
                _ => patch.triangles.extend(cell),
            }
        }
        patch.ends[child] = u32::try_from(patch.triangles.len()).expect("within the limit");
    }
    patch
}

fn patches(c: &mut Criterion) {
    let forest = forest();
    let root = forest.root_diamonds().next().expect("a forest has roots");
    let finest = forest.diamonds(forest.levels() - 1).find(|d| forest.local(*d).upper).expect("there is one");
    let regular = Patch::regular(&forest, finest, forest.segments(), |[x, y]| Some(height(x, y)));
    let mut group = c.benchmark_group("tin");
    for (name, d, patch) in [("regular", finest, regular), ("irregular", root, irregular(&forest))] {
        let triangles = patch.triangles.len();
        let bytes = tin::encode(&forest, d, &patch).expect("a patch of the diamond");
        let bits = 8.0 * bytes.len() as f64 / triangles as f64;
        println!("{name}: {} bytes for {triangles} triangles, {bits:.2} bits each", bytes.len());
        group.throughput(Throughput::Elements(triangles as u64));
        group.bench_function(format!("encode/{name}"), |b| {
            b.iter(|| tin::encode(&forest, d, black_box(&patch)))
        });
        group.bench_function(format!("decode/{name}"), |b| {
            b.iter(|| tin::decode(&forest, d, black_box(&bytes)))
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
    patches(&mut criterion);
    pages(&mut criterion);
    criterion.final_summary();
}

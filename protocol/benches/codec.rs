//! How fast diamonds become bytes and come back, and how fast a page of the index is read.
#![allow(clippy::cast_possible_truncation, reason = "heights below 2500 m")]

mod cases;

use cases::{CASES, case};
use criterion::{BatchSize, Criterion, Throughput};
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::points;
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

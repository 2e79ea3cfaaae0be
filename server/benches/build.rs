//! The two steps of a build that touch every sample again and again: reading windows, measuring errors.
#![allow(clippy::cast_possible_truncation, reason = "heights below 3000 m")]

use criterion::{Criterion, Throughput};
use diamantina_protocol::bintree::Forest;
use diamantina_server::canvas::Canvas;
use diamantina_server::measure::{Samples, measure};
use std::collections::HashMap;
use std::hint::black_box;

const SIDE: u32 = 1024;

fn height(x: u32, y: u32) -> i32 {
    let (x, y) = (f64::from(x), f64::from(y));
    (900.0 * (x / 90.0).sin() * (y / 70.0).cos() + 40.0 * (x / 3.0).cos() + 2000.0) as i32
}

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    let heights: Vec<i32> = (0..=SIDE).flat_map(|y| (0..=SIDE).map(move |x| height(x, y))).collect();
    let folder = tempfile::tempdir().expect("a folder for temporary files");
    let canvas = Canvas::create(folder.path(), SIDE + 1, SIDE + 1, 4).expect("a folder that can be written");
    canvas.write_rows(0, &heights).expect("a disk with room");

    let mut group = criterion.benchmark_group("build");
    group.throughput(Throughput::Elements(heights.len() as u64));
    group.bench_function("canvas_read", |b| b.iter(|| canvas.read(0, [0, 0], black_box([SIDE, SIDE]))));

    let forest = Forest::new(10, 6, [1, 1]).expect("within the documented limits");
    let samples = Samples { origin: [0, 0], cells: [SIDE, SIDE], heights: &heights };
    let node = |x: u32, y: u32| heights[(y * (SIDE + 1) + x) as usize];
    for level in [4, 5] {
        group.bench_function(format!("measure_level_{level}"), |b| {
            b.iter(|| {
                let mut found = HashMap::new();
                measure(&forest, level, samples, node, &mut found);
                found
            });
        });
    }
    group.finish();
    criterion.final_summary();
}

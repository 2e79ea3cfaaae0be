//! The exact criterion on one core: selection from the top, the same with pruning (which is what `select` does), greedy,
//! and measuring what was found.
#![allow(clippy::cast_possible_truncation, reason = "heights below 3000 m")]

use criterion::{Criterion as Bench, Throughput};
use diamantina_server::experiment::field::Field;
use diamantina_server::experiment::select::{
    Criterion, Ground, Strategy, by_strategy, largest_error, top_down,
};
use std::hint::black_box;

const LOG2: u8 = 10;

/// Hills with rough ground upon them, whole metres.
fn field() -> Field {
    let side = 1u32 << LOG2;
    let heights = (0..=side).flat_map(|y| (0..=side).map(move |x| [x, y])).map(|[x, y]| {
        let noise = f64::from((x.wrapping_mul(0x9E37_79B1) ^ y.wrapping_mul(0x85EB_CA77)) >> 28);
        let [x, y] = [f64::from(x), f64::from(y)];
        (900.0 * (x / 90.0).sin() * (y / 70.0).cos() + 40.0 * (x / 7.0).cos() + noise).round()
    });
    Field::new(LOG2, heights.collect(), [30.0, 30.0]).expect("a field within the limits")
}

fn main() {
    let mut bench = Bench::default().configure_from_args();
    let field = field();
    let ground = Ground::new(&field, None).expect("no mask to be wrong");
    let mut group = bench.benchmark_group("selection");
    group.throughput(Throughput::Elements(field.samples() as u64)).sample_size(10);
    for percent in [0.0, 0.1, 0.3, 0.4, 0.5, 1.0, 3.0, 7.0] {
        let tolerance = percent / 100.0 * field.relief();
        group.bench_function(format!("top_down_{percent}_percent"), |b| {
            b.iter(|| top_down(&ground, Criterion::Vertical, black_box(tolerance), 0.0));
        });
        group.bench_function(format!("compact_{percent}_percent"), |b| {
            b.iter(|| by_strategy(&ground, Criterion::Vertical, black_box(tolerance), Strategy::Compact));
        });
        // A minute each, where many points are real.
        if percent >= 1.0 {
            group.bench_function(format!("greedy_{percent}_percent"), |b| {
                b.iter(|| by_strategy(&ground, Criterion::Vertical, black_box(tolerance), Strategy::Greedy));
            });
        }
    }
    let tree = top_down(&ground, Criterion::Vertical, 0.01 * field.relief(), 0.0);
    group.bench_function("measure", |b| {
        b.iter(|| largest_error(&ground, Criterion::Vertical, black_box(&tree)))
    });
    group.finish();
    bench.final_summary();
}

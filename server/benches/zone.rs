//! What a zone costs: one eye over 4097 x 4097 samples of the made landscape, looking all around.
#![allow(clippy::cast_possible_truncation, reason = "heights below 4000 m in decimetres")]

use criterion::{Criterion, Throughput};
use diamantina_protocol::NODATA;
use diamantina_server::progress::Progress;
use diamantina_server::sample;
use diamantina_server::zone::cast::{Eye, Optics, cast};
use diamantina_server::zone::relief::Relief;
use diamantina_server::zone::tiled::Tiled;
use diamantina_server::zone::{ANGLE, EPSILON, HIDDEN};
use rayon::prelude::*;

const SIDE: usize = 4097;

/// The made landscape in decimetres, its sea without heights.
fn heights() -> Tiled<i32> {
    let part = |w: usize| w as f64 / (SIDE - 1) as f64;
    // Made here first: making it needs the workers.
    let _ = sample::height(0.5, 0.5);
    let height = |i: usize| {
        let height = sample::height(part(i % SIDE), part(i / SIDE));
        height.map_or(NODATA, |metres| (metres * 10.0).round() as i32)
    };
    let rows: Vec<i32> = (0..SIDE * SIDE).into_par_iter().map(height).collect();
    let mut heights = Tiled::filled([SIDE; 2], NODATA);
    for (i, height) in rows.into_iter().enumerate() {
        heights.set([i % SIDE, i / SIDE], height);
    }
    heights
}

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    let heights = heights();
    let mut group = criterion.benchmark_group("zone");
    group.throughput(Throughput::Elements((SIDE * SIDE) as u64)).sample_size(10);
    group.bench_function("blocks", |b| b.iter(|| Relief::new(heights.clone())));
    let relief = Relief::new(heights);
    let optics =
        Optics { cell: [30.0; 2], quantum: 0.1, bend: 0.0, epsilon: EPSILON, hidden: HIDDEN, angle: ANGLE };
    for (name, optics) in [("eye", optics), ("eye_binary", Optics { angle: 0.0, ..optics })] {
        let place = [0.55 * SIDE as f64, 0.62 * SIDE as f64];
        let height = relief.height(place).unwrap_or(0.0) + 30.0;
        let eye = Eye { place, height };
        group.throughput(Throughput::Elements(optics.azimuths(&relief, place) as u64));
        group.bench_function(name, |b| b.iter(|| cast(&relief, &optics, &[eye], &Progress::hidden())));
    }
    group.finish();
    criterion.final_summary();
}

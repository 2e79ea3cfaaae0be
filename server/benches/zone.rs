//! What a zone costs over 4097 x 4097 samples of the made landscape: one eye looking all around, and whole masks of
//! 200 eyes, each cast once: around a bay, and around a disc with a summit, whose height eyes stand at and see far from;
//! and around a disc of rough ground, of which half is seen.
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
use std::f64::consts::TAU;
use std::time::Instant;

const SIDE: usize = 4097;

/// Decimetres of the rough ground's noise at a pitch of one cell.
const ROUGHNESS: f64 = 100.0;

fn tiled(height: impl Fn(usize, usize) -> i32 + Sync) -> Tiled<i32> {
    let rows: Vec<i32> = (0..SIDE * SIDE).into_par_iter().map(|i| height(i % SIDE, i / SIDE)).collect();
    let mut heights = Tiled::filled([SIDE; 2], NODATA);
    for (i, height) in rows.into_iter().enumerate() {
        heights.set([i % SIDE, i / SIDE], height);
    }
    heights
}

/// The made landscape in decimetres, its sea without heights.
fn made() -> Tiled<i32> {
    let part = |w: usize| w as f64 / (SIDE - 1) as f64;
    // Made here first: making it needs the workers.
    let _ = sample::height(0.5, 0.5);
    tiled(|x, y| sample::height(part(x), part(y)).map_or(NODATA, |metres| (metres * 10.0).round() as i32))
}

/// Rough ground in decimetres: noise of nine octaves, so that there are ridges of all sizes and no plains.
fn rough() -> Tiled<i32> {
    let hash = |x: usize, y: usize, octave: u32| {
        let mut v = (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA6B) ^ octave;
        v = (v ^ v >> 16).wrapping_mul(0x7FEB_352D);
        v = (v ^ v >> 15).wrapping_mul(0x846C_A68B);
        f64::from(v ^ v >> 16) / f64::from(u32::MAX)
    };
    tiled(|x, y| {
        let height = |octave: u32| {
            let pitch = 4usize << octave;
            let [s, t] = [x, y].map(|w| (w % pitch) as f64 / pitch as f64);
            let [x, y] = [x, y].map(|w| w / pitch);
            let row = |y: usize| hash(x, y, octave) * (1.0 - s) + hash(x + 1, y, octave) * s;
            (row(y) * (1.0 - t) + row(y + 1) * t) * (pitch as f64).powf(0.75) * ROUGHNESS
        };
        (0..9).map(height).sum::<f64>().round() as i32
    })
}

/// A region whose contour has eyes: its centre and half axes, in shares of the side.
struct Region {
    name: &'static str,
    centre: [f64; 2],
    axes: [f64; 2],
}

const REGIONS: [Region; 2] = [
    Region { name: "zone/mask_bay", centre: [0.235, 0.1], axes: [0.061, 0.028] },
    Region { name: "zone/mask_summit", centre: [0.55, 0.62], axes: [0.049, 0.049] },
];
const ROUGH: Region = Region { name: "zone/mask_rough", centre: [0.5, 0.5], axes: [0.049, 0.049] };
const EYES: usize = 200;

impl Region {
    /// Eyes along the contour, ten metres above the region's highest ground.
    fn eyes(&self, relief: &Relief) -> Vec<Eye> {
        let side = (SIDE - 1) as f64;
        let at = |share: f64, angle: f64| {
            let part = [angle.cos(), angle.sin()];
            [0, 1].map(|k| (self.centre[k] + share * self.axes[k] * part[k]) * side)
        };
        let around = |n: usize| (0..n).map(move |i| i as f64 / n as f64 * TAU);
        let places = (0..=100).flat_map(|ring| around(8 * ring + 1).map(move |a| at(ring as f64 / 100.0, a)));
        let highest = places.filter_map(|p| relief.height(p)).fold(0.0, f64::max);
        around(EYES).map(|a| Eye { place: at(1.0, a), height: highest + 100.0 }).collect()
    }
}

/// Casts a whole mask once, and tells its time as the other measurements are told.
fn whole(region: &Region, relief: &Relief, optics: &Optics) {
    let eyes = region.eyes(relief);
    let started = Instant::now();
    let mask = cast(relief, optics, &eyes, &Progress::hidden()).expect("nobody stops it");
    let seconds = started.elapsed().as_secs_f64();
    let seen = mask.rows().filter(|share| *share == u8::MAX).count() as f64 / (SIDE * SIDE) as f64;
    println!(
        "{}\n    time:   [{seconds:.1} s {seconds:.1} s {seconds:.1} s] ({:.0} % seen)",
        region.name,
        100.0 * seen
    );
}

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    let heights = made();
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
    let words: Vec<String> = std::env::args().skip(1).collect();
    let filters: Vec<&String> = words.iter().filter(|word| !word.starts_with('-')).collect();
    let is_tried = words.iter().any(|word| word == "--test");
    let is_asked =
        |name: &str| filters.is_empty() || filters.iter().any(|filter| name.contains(filter.as_str()));
    for region in REGIONS.iter().filter(|region| !is_tried && is_asked(region.name)) {
        whole(region, &relief, &optics);
    }
    if !is_tried && is_asked(ROUGH.name) {
        whole(&ROUGH, &Relief::new(rough()), &optics);
    }
    criterion.final_summary();
}

//! What a build does with every sample: reading the source, reading windows again, measuring errors; and the whole.
#![allow(clippy::cast_possible_truncation, reason = "heights below 3000 m")]

use criterion::{Criterion, Throughput};
use diamantina_protocol::bintree::Forest;
use diamantina_server::canvas::Canvas;
use diamantina_server::ingest::CrsChoice;
use diamantina_server::measure::{Nodes, Samples, measure};
use diamantina_server::progress::Progress;
use diamantina_server::{hierarchy, ingest, sample};
use std::collections::HashMap;
use std::hint::black_box;
use std::path::Path;

const SIDE: u32 = 1024;

fn height(x: u32, y: u32) -> i32 {
    let (x, y) = (f64::from(x), f64::from(y));
    (900.0 * (x / 90.0).sin() * (y / 70.0).cos() + 40.0 * (x / 3.0).cos() + 2000.0) as i32
}

/// The source, as it is and interpolated to another system, in windows of 512 samples.
fn read(criterion: &mut Criterion, folder: &Path) {
    let dem = folder.join("dem.tif");
    sample::write(&dem, SIDE + 1).expect("a disk with room");
    let mut group = criterion.benchmark_group("read");
    for (name, crs) in [("as_it_is", CrsChoice::Source), ("reprojected", CrsChoice::Epsg(3857))] {
        let options = ingest::Options { crs, ..ingest::Options::default() };
        let source = ingest::open(std::slice::from_ref(&dem), &options).expect("the file just written");
        let (grid, mut out) = (source.grid(), Vec::new());
        group
            .throughput(Throughput::Elements(u64::from(grid.width) * u64::from(grid.height)))
            .sample_size(10);
        group.bench_function(name, |b| {
            b.iter(|| {
                for y in (0..grid.height).step_by(512) {
                    for x in (0..grid.width).step_by(512) {
                        let [w, h] = [grid.width - x, grid.height - y].map(|n| n.min(512));
                        source.read(x, y, w, h, &mut out).expect("a window of the source");
                    }
                }
            });
        });
    }
    group.finish();
}

/// A whole build, disk included.
fn whole(criterion: &mut Criterion, folder: &Path) {
    let dem = folder.join("dem.raw");
    let bytes: Vec<u8> = (0..=SIDE)
        .flat_map(|y| (0..=SIDE).map(move |x| height(x, SIDE - y) as i16))
        .flat_map(i16::to_le_bytes)
        .collect();
    std::fs::write(&dem, bytes).expect("a disk with room");
    let shape = format!("{0}x{0}:i16", SIDE + 1).parse().expect("a shape");
    let ingest = ingest::Options { raw: Some(shape), cell: Some(30.0), ..ingest::Options::default() };
    let source = ingest::open(&[dem], &ingest).expect("the file just written");
    let points = hierarchy::Options { memory: 1 << 30, fresh: true, ..hierarchy::Options::new("bench") };
    let triangles =
        hierarchy::Options { points: false, tin: Some(hierarchy::TinOptions::default()), ..points.clone() };
    let mut group = criterion.benchmark_group("build");
    group.throughput(Throughput::Elements(u64::from(SIDE + 1).pow(2))).sample_size(10);
    for (name, options) in [("whole", points), ("whole_tin", triangles)] {
        group.bench_function(name, |b| {
            b.iter(|| hierarchy::build(&source, &folder.join("store"), &options, &Progress::hidden()));
        });
    }
    group.finish();
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
    group.bench_function("samples", |b| b.iter(|| Samples::new([0, 0], [SIDE, SIDE], black_box(&heights))));
    let samples = Samples::new([0, 0], [SIDE, SIDE], &heights);
    for level in 1..forest.levels() {
        let spacing_log2 = forest.root_log2() - forest.patch_log2() - level.div_ceil(2);
        let window = canvas.read(spacing_log2, [0, 0], [SIDE, SIDE]).expect("what was written");
        let nodes = Nodes { spacing_log2, origin: [0, 0], width: window.width(), heights: window.heights() };
        group.bench_function(format!("measure_level_{level}"), |b| {
            b.iter(|| {
                let mut found = HashMap::new();
                measure(&forest, level, &samples, nodes, &mut found);
                found
            });
        });
    }
    group.finish();
    read(&mut criterion, folder.path());
    whole(&mut criterion, folder.path());
    criterion.final_summary();
}

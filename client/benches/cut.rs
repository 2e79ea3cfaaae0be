//! What a frame costs before anything is drawn: the cut of a thousand diamonds, all of them resident.

use criterion::{Criterion, Throughput};
use diamantina_client::camera::{Camera, FOV_Y};
use diamantina_client::cut::{self, Ask};
use diamantina_client::encoding::Encoding;
use diamantina_client::sight::Sight;
use diamantina_client::surface::{Points, Surface};
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::Entry;
use diamantina_protocol::message::{Kind, Layer};
use diamantina_protocol::points::{Coding, Rule};
use glam::DVec3;
use std::hint::black_box;
use std::sync::Arc;

const SPLITS: usize = 1000;

/// 65 536 cells a side, 30 m each.
fn layer() -> Layer {
    let forest = Forest::new(16, 6, [1, 1]).expect("within the documented limits");
    Layer {
        name: "terrain".into(),
        kind: Kind::Terrain,
        forest,
        origin: [500_000.0, 4_000_000.0],
        cell: [30.0, 30.0],
        samples: forest.size(),
        valid_samples: 1 << 32,
        quantum: 1.0,
        height_offset: 0.0,
        heights: [0.0, 3000.0],
        max_error: 0.0,
        finest_error: 0.0,
        encodings: vec!["points".into()],
        coding: Coding::new(Rule::Smooth, 1, vec![0; forest.levels() as usize + 1]).expect("odd step"),
        bytes: 1,
        resampled: false,
        errors: "exact".into(),
        tin: None,
    }
}

/// Errors that shrink by the square root of two from level to level.
fn entry(d: Diamond) -> Option<Entry> {
    let error_metres = 600.0 * 0.5f32.powf(d.level() as f32 / 2.0);
    Some(Entry { error_metres, low: 0, high: 3000, bytes: 2000 })
}

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    let layer = layer();
    let eye = DVec3::new(500_000.0 + 9e5, 4_000_000.0 + 2e5, 9000.0);
    let camera =
        Camera { eye, target: eye + DVec3::new(1e5, 4e5, -60_000.0), fov_y: FOV_Y, size: [1380, 768] };
    let memory_bytes = SPLITS * Points::bytes(&layer.forest, 0);
    let ask = Ask {
        layer: &layer,
        encoding: Encoding::Points,
        camera: &camera,
        exaggeration: 1.0,
        tolerance_pixels: 1e-3,
        sight: Sight::default(),
        seen: None,
        memory_bytes,
        gpu: None,
    };
    let root = layer.forest.root_diamonds().next().expect("a forest has roots");
    let surface =
        Arc::new(Surface::split(Encoding::Points, &layer, root, &[], &[]).expect("no bytes are a payload"));
    let ideal = cut::choose(&ask, entry);
    assert_eq!(ideal.len(), SPLITS);
    let mut group = criterion.benchmark_group("cut");
    group.throughput(Throughput::Elements(SPLITS as u64));
    group.bench_function("choose", |b| b.iter(|| cut::choose(black_box(&ask), entry)));
    group.bench_function("draw", |b| {
        b.iter(|| cut::draw(0, black_box(&ask), &ideal, |_| Some(Arc::clone(&surface))));
    });
    group.finish();
    criterion.final_summary();
}

//! What a frame costs before anything is drawn: the cut of a thousand diamonds, all of them resident, and the motions of
//! those that begin to be drawn; and what it costs, beside the frames, to take in what has arrived.

use criterion::{BatchSize, Criterion, Throughput};
use diamantina_client::camera::{Camera, FOV_Y};
use diamantina_client::cut::{self, Ask};
use diamantina_client::encoding::Encoding;
use diamantina_client::morph::{Change, Moment, Morphs, Sight as Seen};
use diamantina_client::sight::Sight;
use diamantina_client::surface::{Points, Surface};
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::index::Entry;
use diamantina_protocol::message::{Kind, Layer};
use diamantina_protocol::points::{self, Coding, Rule};
use glam::DVec3;
use std::collections::HashMap;
use std::hint::black_box;
use std::sync::Arc;

const SPLITS: usize = 1000;

/// Cells of 30 m.
fn layer(forest: Forest) -> Layer {
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

type Surfaces = HashMap<Diamond, Arc<Surface>>;

/// The surfaces of rough ground, down to a level, and the payload of the last.
fn rough(layer: &Layer, last: u32) -> (Surfaces, Diamond, Vec<u8>) {
    let (forest, mut noise) = (&layer.forest, 1u32);
    let mut surfaces = Surfaces::new();
    let mut newest = None;
    for d in (0..=last).flat_map(|level| forest.diamonds(level)) {
        let parents: Vec<_> = forest.parents(d).map(|p| (p, Arc::clone(&surfaces[&p]))).collect();
        let (mut block, mut source) = (Block::empty(forest, d.level()), Block::empty(forest, d.level()));
        for (p, surface) in &parents {
            block.inherit(forest, d, *p, surface.points().expect("points").block());
        }
        source.fill(&forest.local(d), |_, _| {
            noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (noise >> 24).cast_signed()
        });
        let payload = points::encode(forest, &layer.coding, d, &mut block, &source);
        let parents: Vec<_> = parents.iter().map(|(p, surface)| (*p, surface.as_ref())).collect();
        let surface = Surface::split(Encoding::Points, layer, d, &parents, &payload).expect("its payload");
        surfaces.insert(d, Arc::new(surface));
        newest = Some((d, payload));
    }
    let (d, payload) = newest.expect("there are diamonds");
    (surfaces, d, payload)
}

/// What has arrived becomes a surface: heights decoded, normals worked out.
fn arrive(criterion: &mut Criterion, layer: &Layer, surfaces: &Surfaces, d: Diamond, payload: &[u8]) {
    let parents: Vec<_> = layer.forest.parents(d).map(|p| (p, surfaces[&p].as_ref())).collect();
    let mut group = criterion.benchmark_group("surface");
    group.throughput(Throughput::Elements(layer.forest.segments_at(d.level()).pow(2) as u64));
    group.bench_function("split", |b| {
        b.iter(|| Surface::split(Encoding::Points, layer, d, black_box(&parents), payload));
    });
    group.finish();
}

/// Drawing from within the boxes of finest diamonds, the worst of which are looked at cell by cell.
fn hover(criterion: &mut Criterion) {
    let layer = Layer {
        finest_error: 1.0,
        ..layer(Forest::new(9, 6, [1, 1]).expect("within the documented limits"))
    };
    let (surfaces, ..) = rough(&layer, layer.forest.levels() - 1);
    let eye = DVec3::new(500_000.0 + 7800.0, 4_000_000.0 + 7800.0, 200.0);
    let camera = Camera { eye, target: eye + DVec3::new(1.0, 1.0, -0.3), fov_y: FOV_Y, size: [1380, 768] };
    let ask = Ask {
        layer: &layer,
        encoding: Encoding::Points,
        camera: &camera,
        exaggeration: 1.0,
        tolerance_pixels: 1.0,
        sight: Sight::default(),
        seen: None,
        memory_bytes: usize::MAX,
        gpu: None,
    };
    let ideal = cut::choose(&ask, |_| Some(Entry { error_metres: 200.0, low: 0, high: 255, bytes: 2000 }));
    let mut group = criterion.benchmark_group("cut");
    group.bench_function("draw_hovering", |b| {
        b.iter(|| cut::draw(0, black_box(&ask), &ideal, |d| surfaces.get(&d).cloned()));
    });
    group.finish();
}

/// A frame in which as many motions begin as may, over parents that move.
fn begin(criterion: &mut Criterion, layer: &Layer, surfaces: &Surfaces) {
    let wanted: Vec<Diamond> = (0..=7).flat_map(|level| layer.forest.diamonds(level)).collect();
    let step = |morphs: &mut Morphs, last: u32, seconds: f64| {
        let end = wanted.partition_point(|d| d.level() <= last);
        morphs.step(&Change {
            layer,
            now: Moment::at(seconds),
            wanted: &wanted[..end],
            surface: &|d| surfaces.get(&d).cloned(),
            sight: &|_| Seen { visible: true, error_metres: 1.0 },
        })
    };
    let ready = || {
        let mut morphs = Morphs::new(1.0);
        morphs.jump(&wanted[..wanted.partition_point(|d| d.level() <= 5)]);
        // As many frames as those of the next level need to begin; they move on for a while.
        let mut frames = 0;
        while !step(&mut morphs, 6, 0.02 * f64::from(frames)).waiting.is_empty() {
            frames += 1;
        }
        assert!(frames < 40, "the first are over");
        (morphs, 0.02 * f64::from(frames))
    };
    let mut group = criterion.benchmark_group("morph");
    // The same frame where nothing begins, and where as many begin as may.
    for (name, last) in [("go_on", 6), ("begin", 7)] {
        group.bench_function(name, |b| {
            let frame =
                |(mut morphs, seconds): (Morphs, f64)| (step(&mut morphs, last, seconds + 0.02), morphs);
            b.iter_batched(ready, frame, BatchSize::PerIteration);
        });
    }
    group.finish();
}

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    // 65 536 cells a side.
    let layer = layer(Forest::new(16, 6, [1, 1]).expect("within the documented limits"));
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
    let layer = self::layer(Forest::new(12, 6, [1, 1]).expect("within the documented limits"));
    let (surfaces, newest, payload) = rough(&layer, 7);
    arrive(&mut criterion, &layer, &surfaces, newest, &payload);
    begin(&mut criterion, &layer, &surfaces);
    hover(&mut criterion);
    criterion.final_summary();
}

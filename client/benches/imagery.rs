//! What a tile of imagery costs beside its decoding: its texels in blocks.

use criterion::{Criterion, Throughput};
use diamantina_client::texture::{Coding, TileImage};
use diamantina_protocol::texture::SIDE;
use std::hint::black_box;

/// Slopes and rough ground; half of it, if asked, less and less opaque.
fn texels(fades: bool) -> Vec<u8> {
    let texel = |i: u32| {
        let [x, y] = [i % SIDE, i / SIDE];
        let rough = (x.wrapping_mul(0x9E37_79B1) ^ y.wrapping_mul(0x85EB_CA77)) >> 29;
        let byte = |value: u32| u8::try_from(value).unwrap_or(u8::MAX);
        let opacity = if fades { byte(255 - x / 2) } else { 255 };
        [byte(x / 2 + rough), byte(40 + y / 2 + rough), byte(90 + (x + y) / 8), opacity]
    };
    (0..SIDE * SIDE).flat_map(texel).collect()
}

fn main() {
    let mut bench = Criterion::default().configure_from_args();
    let mut group = bench.benchmark_group("imagery");
    group.throughput(Throughput::Elements(u64::from(SIDE * SIDE))).sample_size(20);
    for (name, fades) in [("blocks", false), ("blocks_of_varying_opacity", true)] {
        let texels = texels(fades);
        group.bench_function(name, |b| {
            b.iter(|| TileImage::new(black_box(texels.clone())).map(|image| image.coded(Coding::Blocks)));
        });
    }
    group.finish();
    bench.final_summary();
}

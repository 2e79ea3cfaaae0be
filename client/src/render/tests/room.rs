//! What is said of the GPU's memory against what the driver was asked for.

use super::water::{CALM, Shore};
use super::*;
use crate::render::Water;
use crate::texture::{self, Coding};
use crate::world::photo;

/// Imagery of no tiles yet, and with room for so many.
fn drape(capacity: usize) -> Drape {
    Drape { texture: Arc::new(photo()), tiles: Vec::new(), capacity, coding: Coding::Plain }
}

/// Bytes that the driver was asked for, as far as it tells: without what wgpu takes for itself.
fn allocated(offscreen: &Offscreen) -> Option<u64> {
    let report = offscreen.device().generate_allocator_report()?;
    let own = |name: &str| !name.starts_with("(wgpu");
    Some(report.allocations.iter().filter(|a| own(&a.name)).map(|a| a.size).sum())
}

#[test]
fn all_that_frames_take_is_counted_and_told_in_advance() {
    let shore = Shore::new(12.0, rough);
    let [width, height] = [320, 200];
    let camera = Camera { size: [width, height], ..shore.land.overhead([width, height]) };
    let still = Look { water: CALM, ..PLAIN };
    let waves = Look { water: Water { waves: 1.0, ..CALM }, ..PLAIN };
    let dry = Look { wireframe: true, ..PLAIN };
    for samples in [1, 4] {
        for (name, look, tiles) in
            [("still", still, 0), ("waves", waves, 40), ("wires", dry, 0), ("imagery", still, 100)]
        {
            let mut offscreen = offscreen(samples, 1 << 30);
            if tiles > 0 {
                offscreen.drape(Some(&drape(tiles)));
            }
            let stats = offscreen.draw(&shore.layers, &camera, &shore.items, &look).unwrap();
            let told = offscreen.frame_bytes(&shore.layers, camera.size, &look, 1)
                + if tiles > 0 { texture::gpu_bytes(tiles, Coding::Plain) } else { 0 };
            // Where diamonds are is told to each pass: at most twice 56 bytes for each.
            let places = 3 * (4096 + 112 * shore.items.len() as u64);
            println!("{samples} {name}: {stats:?}, told {told}");
            assert!(stats.fixed_bytes <= told + places, "{name}: {} of {told}", stats.fixed_bytes);
            assert!(told < stats.fixed_bytes / 10 * 11, "{name}: {} of {told}", stats.fixed_bytes);
            let Some(allocated) = allocated(&offscreen) else { continue };
            // It is read back by as much as a pixel has bytes.
            let counted = stats.total_bytes() - u64::from(width * height) * 4;
            println!("{samples} {name}: {allocated} asked for, {counted} counted");
            // Each buffer and texture is a little larger than asked for.
            assert!(allocated.abs_diff(counted) < counted / 100, "{name}: {allocated}, {counted} counted");
        }
    }
}

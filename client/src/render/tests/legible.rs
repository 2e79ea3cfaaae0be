//! Pictures in which what was asked for can be read: levels under imagery, steep ground in soft light.

use super::*;
use crate::texture::{Coding, DrapedTile, TileImage};
use diamantina_protocol::texture::{INNER, Texture, Tile};

/// One grey tile over all of a world, and more.
fn photo(world: &World) -> Drape {
    let texture = Texture {
        name: "photo".to_owned(),
        origin: world.place(-0.5, -0.5, 0.0).truncate().to_array(),
        texel: [10.0, 10.0],
        size: [INNER, INNER],
        format: "webp".to_owned(),
        quality: 80,
        tiles: 1,
        bytes: 1,
        resampled: false,
    };
    let grey = [128, 128, 128, 255].repeat(Coding::Plain.tile_bytes() / 4);
    let image = Arc::new(TileImage::new(grey).unwrap());
    Drape {
        texture: Arc::new(texture),
        tiles: vec![DrapedTile { tile: Tile::ROOT, image, weight: 1.0 }],
        capacity: 16,
        coding: Coding::Plain,
    }
}

#[test]
fn levels_show_through_imagery() {
    let world = World::new(Forest::new(6, 4, [1, 1]).unwrap(), 10.0, |_, _| 300);
    let (camera, drape) = (world.overhead([120, 120]), photo(&world));
    let mut offscreen = offscreen(1, 1 << 30);
    offscreen.drape(Some(&drape));
    let mut seen = |level: u32, show_levels: bool| {
        let look = Look { show_levels, ..PLAIN };
        offscreen.draw(std::slice::from_ref(&world.layer), &camera, &world.level(level), &look).unwrap();
        mean(&offscreen.read().unwrap(), 0.3, 0.5)
    };
    let [a, b] = [1, 2].map(|level| seen(level, false));
    assert!((0..3).all(|i| (a[i] - 128.0).abs() < 3.0 && (b[i] - 128.0).abs() < 3.0), "{a:?} {b:?}");
    let [a, b] = [1, 2].map(|level| seen(level, true));
    let apart = |a: [f64; 3], b: [f64; 3]| (0..3).map(|i| (a[i] - b[i]).abs()).fold(0.0, f64::max);
    assert!(apart(a, b) > 40.0 && apart(a, [128.0; 3]) > 30.0, "{a:?} {b:?}");
}

#[test]
fn ground_that_is_stretched_much_is_not_black() {
    // Slopes of some ten degrees, all around.
    let world = World::new(Forest::new(6, 4, [1, 1]).unwrap(), 100.0, rough);
    let camera = world.overhead([200, 200]);
    let light = |exaggeration: f64| {
        let look = Look { colours: Colours::Flat, exaggeration, ..PLAIN };
        let high = Camera { eye: camera.eye + DVec3::Z * 200.0 * exaggeration, ..camera };
        let picture = picture(&world, &high, &world.level(6), &look);
        let places = [0.35, 0.42, 0.5, 0.58, 0.65].map(|x| [0.4, 0.5, 0.6].map(|y| mean(&picture, x, y)[1]));
        places.as_flattened().iter().sum::<f64>() / 15.0
    };
    let [plain, stretched] = [1.0, 20.0].map(light);
    assert!(stretched > 0.8 * plain, "{stretched} of {plain}");
}

//! What water mirrors: land that is in the picture, and land that only its mirror image brings into it.

use crate::hostile::server;
use crate::world::serve;
use diamantina_client::camera::Camera;
use diamantina_client::headless;
use diamantina_client::picture::Picture;
use diamantina_client::render::{self, Background, Look, Offscreen, Water};
use diamantina_client::terrain::{self, Terrain};
use glam::{DVec2, DVec3};
use std::time::Duration;

const SIDE: u32 = 513;

/// A lake with a bed 20 m deep, and a rough ridge of some 700 m in its east.
fn ground(x: u32, y: u32) -> f32 {
    let from_ridge = (f64::from(x) - 400.0).abs() / 60.0;
    let rough = f64::from((x.wrapping_mul(0x9E37_79B1) ^ y.wrapping_mul(0x85EB_CA77)) >> 29);
    let waves = 60.0 * (f64::from(y) / 17.0).sin() + 5.0 * rough;
    ((700.0 + waves) * (1.0 - from_ridge).max(0.0) - 20.0) as f32
}

const PATIENCE: Duration = Duration::from_secs(60);

fn bare() -> Look {
    // As good as a mirror, and still.
    let water = Water { waves: 0.0, refractive_index: 1e12, mirror_error: 1.0, ..Water::default() };
    Look { haze: 0.0, background: Background::Colour([1.0, 0.0, 1.0, 1.0]), water, ..Look::default() }
}

/// The pixel in which a camera sees a direction.
fn pixel(picture: &Picture, camera: &Camera, direction: DVec3) -> Option<[u8; 3]> {
    let [right, up, backward] = camera.axes();
    let forward = -direction.dot(backward);
    let [width, height] = camera.size.map(f64::from);
    let scale = camera.pixels_per_radian() / forward;
    let place =
        DVec2::new(width / 2.0, height / 2.0) + DVec2::new(direction.dot(right), -direction.dot(up)) * scale;
    let is_inside = forward > 0.0 && place.cmpge(DVec2::ZERO).all() && place.x < width && place.y < height;
    let [r, g, b, _] = is_inside.then(|| picture.pixel([place.x as u32, place.y as u32]))??;
    Some([r, g, b])
}

#[test]
fn land_out_of_the_picture_is_seen_in_the_water() {
    let scratch = tempfile::tempdir().unwrap();
    let bytes: Vec<u8> = (0..SIDE)
        .rev()
        .flat_map(|y| (0..SIDE).map(move |x| (x, y)))
        .flat_map(|(x, y)| ground(x, y).to_le_bytes())
        .collect();
    std::fs::write(scratch.path().join("lake.raw"), bytes).unwrap();
    let built = server(
        scratch.path(),
        "build {}/lake.raw --raw 513x513:f32 --cell 10 --layer sea=water:level=0 --max-error 0.1 -o {}/store",
    );
    assert_eq!(built.code, Some(0), "{built:?}");
    let served = serve(&[scratch.path().join("store")]);
    let mut terrain = Terrain::open(&served.scene("store"), terrain::Options::default()).unwrap();
    let position = terrain.scene().layers[0].position([100, 256]);
    let eye = DVec3::new(position[0], position[1], 40.0);
    let at = |degrees: f64, fov: f64, size| {
        let towards = DVec3::new(degrees.to_radians().cos(), 0.0, degrees.to_radians().sin());
        Camera { eye, target: eye + 1000.0 * towards, fov_y: fov.to_radians(), size }
    };
    // Both the ridge and its image; and the water before it alone.
    let (whole, down) = (at(0.0, 60.0, [400, 400]), at(-18.0, 24.0, [300, 150]));
    let options = render::Options { samples: 1, ..render::Options::default() };
    let look = bare();
    let mut draw = |camera: &Camera| {
        let (picture, report) = headless::picture(&mut terrain, camera, &look, &options, PATIENCE).unwrap();
        assert!(report.complete, "{report:?}");
        picture
    };
    let reference = draw(&whole);
    let found = draw(&down);
    // The same from what is drawn of the picture itself alone.
    let view = terrain.settle(&down, PATIENCE);
    assert_eq!(view.mirrors.len(), 1);
    let mut offscreen = Offscreen::new(&options).unwrap();
    offscreen.draw(&terrain.scene().layers, &down, &view.items, &look).unwrap();
    let without = offscreen.read().unwrap();

    // Where the ridge's image is: between the shore and the summit's.
    let (mut near, mut near_without, mut count) = (0, 0, 0);
    for y in 0..150 {
        for x in 0..300 {
            let [right, up, backward] = down.axes();
            let [u, v] = [(f64::from(x) + 0.5 - 150.0), (75.0 - f64::from(y) - 0.5)]
                .map(|p| p / down.pixels_per_radian());
            let direction = right * u + up * v - backward;
            let Some(expected) = pixel(&reference, &whole, direction) else { continue };
            if expected == [255, 0, 255] {
                continue;
            }
            let is_near = |picture: &Picture| {
                let [r, g, b, _] = picture.pixel([x, y]).unwrap();
                [r, g, b].iter().zip(expected).all(|(a, b)| a.abs_diff(b) < 24)
            };
            count += 1;
            near += usize::from(is_near(&found));
            near_without += usize::from(is_near(&without));
        }
    }
    println!("of {count} pixels of mirrored land {near} are right, {near_without} without a cut of its own");
    assert!(count > 5000, "{count}");
    assert!(near * 100 > count * 95, "{near} of {count}");
    assert!(near_without * 100 < count * 80, "{near_without} of {count}: this test shows nothing");
}

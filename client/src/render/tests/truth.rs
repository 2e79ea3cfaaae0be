//! Colours that can be read, shading by a formula, and the sun where it is.

use super::*;
use crate::render::{Scale, Shading};

/// A plane that rises to the east, and its height in metres at a place of the frame.
fn slope(per_cell: i32, cell: f64) -> (World, impl Fn(DVec3) -> f64) {
    let forest = Forest::new(6, 4, [1, 1]).unwrap();
    let world = World::new(forest, cell, move |x, _| per_cell * (x.cast_signed() - 20));
    let origin = world.layer.origin[0];
    (world, move |p: DVec3| f64::from(per_cell) * 0.1 * ((p.x - origin) / cell - 20.0))
}

/// Where the ray through the middle of a pixel meets a surface of some height.
fn place_at(camera: &Camera, pixel: [u32; 2], height: impl Fn(DVec3) -> f64) -> DVec3 {
    let [right, up, backward] = camera.axes();
    let [width, height_pixels] = camera.size.map(f64::from);
    let focal = camera.pixels_per_radian();
    let [x, y] = pixel.map(|p| f64::from(p) + 0.5);
    let ray = right * (x - width / 2.0) + up * (height_pixels / 2.0 - y) - backward * focal;
    let ray = ray.normalize();
    let along = |t: f64| camera.eye + ray * t;
    let (mut low, mut high) = (0.0, 1e5);
    for _ in 0..100 {
        let middle = f64::midpoint(low, high);
        if along(middle).z > height(along(middle)) { low = middle } else { high = middle }
    }
    along(low)
}

fn aside(world: &World) -> Camera {
    Camera {
        eye: world.place(0.5, -0.5, 900.0),
        target: world.place(0.5, 0.5, 0.0),
        fov_y: FOV_Y,
        size: [240, 180],
    }
}

#[test]
fn colours_can_be_read_as_heights() {
    let (world, height) = slope(30, 10.0);
    let camera = aside(&world);
    for colours in
        [Colours::Auto, Colours::Terrain, Colours::Grey, Colours::Batlow, Colours::Viridis, Colours::Magma]
    {
        let look = Look { colours, shading: Shading::Unlit, ..PLAIN }.truthful();
        let scale = Scale::of(&look, &world.layer);
        assert_eq!(scale.has_sea(), colours == Colours::Auto);
        let [low, high] = scale.range();
        let table: Vec<_> = (0..=2550).map(|i| low + (high - low) * f64::from(i) / 2550.0).collect();
        let table: Vec<_> = table.iter().map(|value| (*value, scale.colour(*value))).collect();
        let picture = picture(&world, &camera, &world.level(6), &look);
        let mut seen = 0;
        for pixel in (0..180).step_by(7).flat_map(|y| (0..240).step_by(3).map(move |x| [x, y])) {
            let found = picture.pixel(pixel).unwrap();
            if found == [255; 4] {
                continue;
            }
            seen += 1;
            let expected = height(place_at(&camera, pixel, &height));
            let apart = |c: &[u8; 3]| (0..3).map(|i| i32::from(c[i].abs_diff(found[i])).pow(2)).sum::<i32>();
            let least = table.iter().map(|(_, c)| apart(c)).min().unwrap();
            assert!(least <= 3, "{colours:?}: {found:?} is no colour of the ramp");
            let off = table.iter().filter(|(_, c)| apart(c) == least).map(|(v, _)| (v - expected).abs());
            let off = off.fold(f64::INFINITY, f64::min);
            // A step of the ramp, of 256.
            assert!(off <= (high - low) / 255.0, "{colours:?}: {found:?} at {expected} m, {off} m off");
        }
        assert!(seen > 500, "{seen}");
    }
}

#[test]
fn hillshade_is_the_cosine_of_the_stretched_surface() {
    let (world, _) = slope(30, 10.0);
    for exaggeration in [1.0, 3.0] {
        let look = Look { colours: Colours::Flat, shading: Shading::Hillshade, exaggeration, ..PLAIN };
        let camera = world.overhead([64, 64]);
        let picture = picture(&world, &camera, &world.level(6), &look);
        // 3 m up each 10 m.
        let normal = DVec3::new(-0.3 * exaggeration, 0.0, 1.0).normalize();
        let expected = (255.0 * normal.dot(look.sun.direction()).max(0.0)).round();
        let found = picture.pixel([32, 32]).unwrap();
        for channel in &found[..3] {
            assert!((f64::from(*channel) - expected).abs() <= 1.5, "{found:?}, expected {expected}");
        }
    }
    // Turned away from the light it is black, and colours are multiplied as they are encoded.
    let sun = Sun { azimuth_degrees: 90.0, altitude_degrees: 10.0 };
    let look = Look { colours: Colours::Flat, shading: Shading::Hillshade, sun, ..PLAIN };
    let camera = world.overhead([64, 64]);
    assert_eq!(picture(&world, &camera, &world.level(6), &look).pixel([32, 32]), Some([0, 0, 0, 255]));
    let look = Look { colours: Colours::Viridis, shading: Shading::Hillshade, ..PLAIN };
    let [lit, unlit] = [Shading::Hillshade, Shading::Unlit].map(|shading| {
        let look = Look { shading, ..look };
        picture(&world, &camera, &world.level(6), &look).pixel([40, 32]).unwrap()
    });
    let light = DVec3::new(-0.3, 0.0, 1.0).normalize().dot(look.sun.direction());
    for i in 0..3 {
        let expected = f64::from(unlit[i]) * light;
        assert!((f64::from(lit[i]) - expected).abs() <= 1.5, "{lit:?} {unlit:?} {light}");
    }
}

#[test]
fn slopes_are_those_of_the_ground() {
    for per_cell in [0, 30, 100] {
        let (world, _) = slope(per_cell, 10.0);
        let look = Look { colours: Colours::Slope, shading: Shading::Unlit, ..PLAIN };
        let expected = Scale::of(&look, &world.layer).colour(f64::from(per_cell).atan2(100.0).to_degrees());
        for exaggeration in [1.0, 4.0] {
            let look = Look { exaggeration, ..look };
            let camera = world.overhead([64, 64]);
            let found = picture(&world, &camera, &world.level(6), &look).pixel([32, 32]).unwrap();
            assert!((0..3).all(|i| found[i].abs_diff(expected[i]) <= 2), "{found:?}, expected {expected:?}");
        }
    }
}

/// A camera that looks at the sun, or, from above water, at where it is mirrored.
fn towards_sun(look: &Look, at: DVec3, fov_y: f64) -> Camera {
    Camera { eye: at - look.sun.direction() * 100.0, target: at, fov_y, size: [301, 301] }
}

fn white(picture: &Picture) -> f64 {
    let pixels = (0..301).flat_map(|y| (0..301).map(move |x| [x, y]));
    f64::from(u32::try_from(pixels.filter(|p| picture.pixel(*p) == Some([255; 4])).count()).unwrap())
}

#[test]
fn the_sun_is_half_a_degree_wide() {
    let sun = Sun { azimuth_degrees: 30.0, altitude_degrees: 25.0 };
    let look = Look { background: Background::Sky, sun, ..PLAIN };
    let drawn = |look: &Look, degrees: f64| {
        let mut offscreen = offscreen(1, 1 << 20);
        let camera = towards_sun(look, DVec3::new(5e5, 4e6, 1e3), degrees.to_radians());
        offscreen.draw(&[], &camera, &[], look).unwrap();
        offscreen.read().unwrap()
    };
    for degrees in [2.0, 10.0] {
        let picture = drawn(&look, degrees);
        let across = 2.0 * (white(&picture) / std::f64::consts::PI).sqrt() * degrees / 301.0;
        assert!((across - 0.53).abs() < 0.04, "{across} degrees");
    }
    // The air glows around it, less with distance; on paper there is neither.
    let hazy = drawn(&Look { haze: 1.0, ..look }, 20.0);
    let at = |x: u32| u32::from(hazy.pixel([x, 150]).unwrap()[0]);
    let clear = u32::from(drawn(&look, 20.0).pixel([180, 150]).unwrap()[0]);
    assert!(at(160) > at(180) && at(180) > at(290) && at(180) > clear, "{} {} {}", at(160), at(180), at(290));
    assert_eq!(white(&drawn(&look.truthful(), 2.0)), 301.0 * 301.0, "paper alone");
}

#[test]
fn the_sun_is_mirrored_once_and_hidden_by_hills() {
    let sun = Sun { azimuth_degrees: 0.0, altitude_degrees: 30.0 };
    let still = Look { background: Background::Sky, sun, ..PLAIN };
    let seen = |look: &Look, wall: bool| {
        let forest = Forest::new(6, 4, [1, 1]).unwrap();
        let land = World::new(forest, 10.0, move |x, y| match (x, y) {
            // 30 m up each 10 m: far steeper than the sun stands.
            (_, 50..=64) if wall => 300 * (y.cast_signed() - 50),
            (0..=3, 0..=3) => 10,
            _ => NODATA,
        });
        let mut water = World::new(forest, 10.0, |_, _| 0);
        water.layer = Layer { name: "water".into(), kind: Kind::Water, ..water.layer };
        let mut items = land.level(forest.levels());
        items.extend(water.level(2).into_iter().map(|item| DrawItem { layer: 1, ..item }));
        let at = land.place(0.5, 0.5, 0.0);
        let ahead = look.sun.direction() * DVec3::new(1.0, 1.0, -1.0);
        let camera = Camera { eye: at - ahead * 100.0, target: at, fov_y: 0.03, size: [301, 301] };
        let mut offscreen = offscreen(1, 1 << 30);
        offscreen.draw(&[land.layer, water.layer], &camera, &items, look).unwrap();
        offscreen.read().unwrap()
    };
    let across = |picture: &Picture| {
        2.0 * (white(picture) / std::f64::consts::PI).sqrt() * 0.03f64.to_degrees() / 301.0
    };
    let found = across(&seen(&still, false));
    assert!((found - 0.53).abs() < 0.04, "{found} degrees");
    assert_eq!(white(&seen(&still, true)), 0.0, "a wall stands before it");
    // Waves spread it: their glitter is wider than the disc, and soft.
    let wavy = Look { water: Water { waves: 1.0, ..still.water }, ..still };
    let glitter = seen(&wavy, false);
    assert!(across(&glitter) > 0.8, "{} degrees", across(&glitter));
    let row: Vec<i32> = (0..301).map(|x| i32::from(glitter.pixel([x, 150]).unwrap()[0])).collect();
    let steepest = row.windows(2).map(|pair| (pair[1] - pair[0]).abs()).max();
    assert!(steepest < Some(40), "{row:?}");
}

//! Water against what is known of it: mirrors, Fresnel's part, what is seen through.

use super::*;
use crate::render::Water;

/// One linear number of an sRGB byte.
fn light(byte: u8) -> f64 {
    let c = f64::from(byte) / 255.0;
    if c <= 0.040_45 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
}

pub(super) const CALM: Water = PLAIN.water;

/// Land and water over the same forest; water level at a height in metres.
pub(super) struct Shore {
    pub(super) layers: [Layer; 2],
    pub(super) items: Vec<DrawItem>,
    pub(super) land: World,
}

impl Shore {
    pub(super) fn new(level_metres: f64, height: impl Fn(u32, u32) -> i32) -> Self {
        let forest = Forest::new(6, 4, [1, 1]).unwrap();
        let land = World::new(forest, 10.0, height);
        let mut water = World::new(forest, 10.0, |_, _| (level_metres * 10.0) as i32);
        water.layer = Layer { name: "water".into(), kind: Kind::Water, ..water.layer };
        let mut items = land.level(forest.levels());
        items.extend(water.level(2).into_iter().map(|item| DrawItem { layer: 1, ..item }));
        Self { layers: [land.layer.clone(), water.layer], items, land }
    }

    fn land_items(&self) -> Vec<DrawItem> {
        self.items.iter().filter(|item| item.layer == 0).cloned().collect()
    }

    fn picture(&self, camera: &Camera, items: &[DrawItem], look: &Look, samples: u32) -> Picture {
        let mut offscreen = offscreen(samples, 1 << 30);
        offscreen.draw(&self.layers, camera, items, look).unwrap();
        offscreen.read().unwrap()
    }
}

#[test]
fn a_mirror_shows_what_the_mirrored_eye_sees() {
    // A box and a ridge stand in the water; there is no bed that would hide them from below.
    let height = |x: u32, y: u32| match (x, y) {
        (20..=30, 30..=36) => 900,
        (0..=64, 50..=64) => rough(x, y) / 2 + 300,
        _ => NODATA,
    };
    let level = 12.0;
    let shore = Shore::new(level, height);
    let camera = Camera {
        eye: shore.land.place(0.5, 0.02, level + 60.0),
        target: shore.land.place(0.5, 0.6, level - 10.0),
        fov_y: 0.9,
        size: [320, 240],
    };
    // Light must not tell the two eyes apart, nor air.
    let mirror = Look { water: Water { refractive_index: 1e12, ..CALM }, ..PLAIN };
    let found = shore.picture(&camera, &shore.items, &mirror, 1);
    let flip = |p: DVec3| DVec3::new(p.x, p.y, 2.0 * level - p.z);
    let below = Camera { eye: flip(camera.eye), target: flip(camera.target), ..camera };
    let expected = shore.picture(&below, &shore.land_items(), &PLAIN, 1);
    let plain = Look { water: Water { reflecting: false, ..CALM }, ..PLAIN };
    let without = shore.picture(&camera, &shore.land_items(), &PLAIN, 1);
    let with_flat = shore.picture(&camera, &shore.items, &plain, 1);
    let (mut pixels, mut mirrored_land, mut off) = (0, 0, 0);
    for y in 0..240 {
        for x in 0..320 {
            if with_flat.pixel([x, y]) == without.pixel([x, y]) {
                continue; // No water here.
            }
            pixels += 1;
            let image = expected.pixel([x, 239 - y]).unwrap();
            mirrored_land += u32::from(image != [255, 0, 255, 255]);
            let here = found.pixel([x, y]).unwrap();
            off += u32::from((0..3).any(|i| here[i].abs_diff(image[i]) > 3));
        }
    }
    assert!(pixels > 20_000 && mirrored_land > 4000, "{pixels} of water, {mirrored_land} of mirrored land");
    // Outlines fall on other pixels where rows do not lie symmetrically.
    assert!(off * 100 < pixels, "{off} of {pixels} differ");
    // What is not water is as it was.
    let differs = |x, y| found.pixel([x, y]) != without.pixel([x, y]);
    let land = (0..240).flat_map(|y| (0..320).map(move |x| (x, y)));
    let land = land.filter(|(x, y)| with_flat.pixel([*x, *y]) == without.pixel([*x, *y]));
    assert!(!land.into_iter().any(|(x, y)| differs(x, y)));
}

#[test]
fn what_is_mirrored_follows_fresnel() {
    let shore = Shore::new(0.0, |x, y| if x + y < 8 { 10 } else { NODATA });
    // White all around, and nothing below.
    let white = Look { background: Background::Colour([1.0; 4]), ..PLAIN };
    for (degrees, expected) in [(0.0f64, 0.0201), (60.0, 0.0507), (85.0, 0.6412)] {
        let towards = DVec3::new(0.0, degrees.to_radians().sin(), -degrees.to_radians().cos());
        let target = shore.land.place(0.5, 0.5, 0.0);
        let camera = Camera { eye: target - 150.0 * towards, target, fov_y: 0.02, size: [63, 63] };
        let water = |refractive_index| Look { water: Water { refractive_index, ..CALM }, ..white };
        let [found, none] = [1.33, 1.000_001].map(|index| {
            let picture = shore.picture(&camera, &shore.items, &water(index), 1);
            picture.pixel([31, 31]).unwrap().map(light)
        });
        for (found, none) in found.into_iter().zip(none).take(3) {
            // Schlick's form lets a grazing mirror remain whatever the index.
            let rest = (1.0 - degrees.to_radians().cos()).powi(5);
            let own = (none - rest) / (1.0 - rest);
            let part = (found - own) / (1.0 - own);
            assert!((part - expected).abs() < 0.006, "{degrees} degrees: {part}, expected {expected}");
        }
    }
}

#[test]
fn the_bed_shows_where_water_is_shallow_or_clear() {
    // A bed of even slope; the water covers its northern part.
    let shore = Shore::new(20.0, |_, y| 400 - 8 * i32::try_from(y).unwrap());
    let camera = Camera {
        eye: shore.land.place(0.5, 0.5, 700.0),
        target: shore.land.place(0.5, 0.5001, 0.0),
        fov_y: FOV_Y,
        size: [200, 200],
    };
    let seen = |clarity: f64| {
        let look = Look { water: Water { clarity: Some(clarity), ..CALM }, colours: Colours::Flat, ..PLAIN };
        shore.picture(&camera, &shore.items, &look, 1)
    };
    let grey = Look { colours: Colours::Flat, ..PLAIN };
    let bare = shore.picture(&camera, &shore.land_items(), &grey, 1);
    let difference = |picture: &Picture, y: f64| {
        let (a, b) = (mean(picture, 0.5, y), mean(&bare, 0.5, y));
        (0..3).map(|i| (a[i] - b[i]).abs()).fold(0.0, f64::max)
    };
    let (clear, murky) = (seen(1e5), seen(3.0));
    // The shore is a little below the middle; north is at the top.
    assert!(difference(&clear, 0.1) < 8.0, "{}", difference(&clear, 0.1));
    assert!(difference(&murky, 0.1) > 60.0, "{}", difference(&murky, 0.1));
    let steps: Vec<f64> = [0.613, 0.605, 0.595, 0.58].map(|y| difference(&murky, y)).to_vec();
    assert!(steps.is_sorted(), "deeper water hides more: {steps:?}");
    assert_eq!(difference(&murky, 0.8), 0.0, "dry land is as it was");
}

#[test]
fn waves_move_and_can_be_told_to_rest() {
    let shore = Shore::new(0.0, |x, y| if y > 40 { rough(x, y) / 2 + 500 } else { -300 });
    let camera = Camera {
        eye: shore.land.place(0.5, 0.05, 40.0),
        target: shore.land.place(0.5, 0.7, 10.0),
        fov_y: FOV_Y,
        size: [240, 160],
    };
    let look = |waves, seconds| Look { water: Water { waves, seconds, ..CALM }, ..PLAIN };
    let at = |waves, seconds| shore.picture(&camera, &shore.items, &look(waves, seconds), 1);
    assert_eq!(at(0.0, 0.0), at(0.0, 5.0));
    let (first, second) = (at(1.0, 0.0), at(1.0, 0.7));
    assert_eq!(first, at(1.0, 0.0));
    let moved = (0..160).flat_map(|y| (0..240).map(move |x| [x, y]));
    let moved = moved.filter(|p| first.pixel(*p) != second.pixel(*p)).count();
    assert!(moved > 2000, "{moved}");
}

#[test]
fn water_is_drawn_from_below_plain_and_as_wires() {
    let shore = Shore::new(0.0, |x, y| if x > 40 { rough(x, y) / 2 } else { -600 });
    let (eye, target) = (shore.land.place(0.2, 0.1, -20.0), shore.land.place(0.4, 0.9, 10.0));
    let below = Camera { eye, target, fov_y: FOV_Y, size: [160, 120] };
    let above = Camera { eye: eye + DVec3::Z * 120.0, ..below };
    let mut offscreen = offscreen(4, 1 << 30);
    let mut pictures = Vec::new();
    for (camera, look) in [
        (below, Look { water: CALM, ..PLAIN }),
        (above, Look { water: CALM, ..PLAIN }),
        (above, Look { water: Water { reflecting: false, ..CALM }, ..PLAIN }),
        (above, Look { wireframe: true, water: CALM, ..PLAIN }),
        (Camera { size: [91, 77], ..above }, Look { water: Water { mirror_scale: 0.5, ..CALM }, ..PLAIN }),
    ] {
        let stats = offscreen.draw(&shore.layers, &camera, &shore.items, &look).unwrap();
        assert!(stats.triangles > 0);
        pictures.push(offscreen.read().unwrap());
    }
    for (i, a) in pictures.iter().enumerate() {
        assert!(pictures[i + 1..].iter().all(|b| a != b), "picture {i} is like a later one");
    }
    // The other way about through many frames: sizes change, and water comes and goes.
    let again = offscreen.draw(&shore.layers, &above, &shore.items, &Look { water: CALM, ..PLAIN });
    assert!(again.is_ok());
    assert_eq!(offscreen.read().unwrap(), pictures[1]);
}

#[test]
fn outlines_in_the_mirror_are_as_smooth_as_those_of_the_picture() {
    let shore = Shore::new(0.0, |x, y| if (20..=40).contains(&x) && y > 30 { 600 } else { NODATA });
    let camera = Camera {
        eye: shore.land.place(0.4, 0.05, 60.0),
        target: shore.land.place(0.55, 0.5, 0.0),
        fov_y: FOV_Y,
        size: [320, 240],
    };
    // Of grey land over magenta: green tells how much of a pixel it takes.
    let look = Look { colours: Colours::Flat, ..PLAIN };
    let mirror = Look { water: Water { refractive_index: 1e12, ..CALM }, ..look };
    let plain = Look { water: Water { reflecting: false, ..CALM }, ..look };
    let with_flat = shore.picture(&camera, &shore.items, &plain, 1);
    let without = shore.picture(&camera, &shore.land_items(), &plain, 1);
    let is_water = |x: u32, y: u32| with_flat.pixel([x, y]) != without.pixel([x, y]);
    let is_inside = |[x, y]: [u32; 2]| (x - 1..=x + 1).all(|x| (y - 1..=y + 1).all(|y| is_water(x, y)));
    let inside: Vec<_> =
        (1..239).flat_map(|y| (1..319).map(move |x| [x, y])).filter(|p| is_inside(*p)).collect();
    let mixed = [1, 4].map(|samples| {
        let picture = shore.picture(&camera, &shore.items, &mirror, samples);
        inside.iter().filter(|p| (15..180).contains(&picture.pixel(**p).unwrap()[1])).count()
    });
    assert!(inside.len() > 10_000 && mixed[0] < 10 && mixed[1] > 50, "{mixed:?} of {}", inside.len());
}

/// Where what is seen through jumped by a pixel, beds had contours that were none of theirs.
#[test]
fn an_even_bed_has_no_contours() {
    let shore = Shore::new(0.0, |x, y| -60 - i32::try_from(2 * x + y).unwrap());
    let camera = Camera {
        eye: shore.land.place(0.5, 0.1, 40.0),
        target: shore.land.place(0.5, 0.6, 0.0),
        fov_y: FOV_Y,
        size: [200, 300],
    };
    let look = Look {
        water: Water { clarity: Some(8.0), ..CALM },
        background: Background::Colour([1.0; 4]),
        colours: Colours::Flat,
        ..PLAIN
    };
    let picture = shore.picture(&camera, &shore.items, &look, 1);
    for x in [60, 100, 140] {
        let green = |y: u32| i32::from(picture.pixel([x, y]).unwrap()[1]);
        let bends = (140..290).map(|y| (green(y - 1) - 2 * green(y) + green(y + 1)).abs());
        let most = bends.max().unwrap();
        assert!(most <= 3, "{most}: {:?}", (140..290).map(green).collect::<Vec<_>>());
    }
}

/// Behind a low island waves mirrored the island itself, from below: dark patches along its far shore.
#[test]
fn waves_mirror_no_bank_on_this_side_of_the_water() {
    let shore = Shore::new(0.0, |_, y| if (8..=12).contains(&y) { 20 } else { -400 });
    let camera = Camera {
        eye: shore.land.place(0.5, 0.02, 14.0),
        target: shore.land.place(0.5, 0.6, 0.0),
        fov_y: FOV_Y,
        size: [300, 200],
    };
    // Grey land in water that mirrors magenta, and nothing else, where the land ends: no light comes from below.
    let look = Look {
        water: Water { refractive_index: 1e12, waves: 1.0, clarity: Some(1e-3), ..CALM },
        sun: Sun { azimuth_degrees: 180.0, altitude_degrees: 60.0 },
        colours: Colours::Flat,
        ..PLAIN
    };
    let picture = shore.picture(&camera, &shore.items, &look, 1);
    let dry = shore.picture(&camera, &shore.land_items(), &look, 1);
    let row = |north: f64| pixel_of(&camera, shore.land.place(0.5, north, 0.0))[1] as u32;
    let (first, last) = (row(0.9), row(13.5 / 64.0));
    assert!(first + 20 < last, "rows {first} to {last}");
    let water = (first..last).flat_map(|y| (0..300).map(move |x| [x, y]));
    let water: Vec<_> = water.filter(|p| dry.pixel(*p) != picture.pixel(*p)).collect();
    let patches = water.iter().filter(|p| picture.pixel(**p).unwrap()[1] > 40).count();
    assert!(water.len() > 1000 && patches == 0, "{patches} of {} pixels", water.len());
}

/// Where a crest hides the place that is seen through the surface above it, pixels of the crest floated there, in combs and dots.
#[test]
fn no_crest_is_seen_through_the_water_behind_it() {
    let shore = Shore::new(0.0, |x, y| if (16..=24).contains(&y) { 900 - 8 * x as i32 } else { -600 });
    let camera = Camera {
        eye: shore.land.place(0.5, -3.0, 800.0),
        target: shore.land.place(0.5, 0.6, 0.0),
        fov_y: 0.25,
        size: [300, 200],
    };
    // Bright land in water that lets nothing through from where it is deep.
    let look = Look { water: Water { clarity: Some(1.0), ..CALM }, colours: Colours::Flat, ..PLAIN };
    let plain = Look { water: Water { reflecting: false, ..CALM }, ..look };
    let [picture, flat, dry] = [
        shore.picture(&camera, &shore.items, &look, 1),
        shore.picture(&camera, &shore.items, &plain, 1),
        shore.picture(&camera, &shore.land_items(), &look, 1),
    ];
    // Down each column there is sky, water behind the crest, and then the crest.
    let is_water = |p: [u32; 2]| flat.pixel(p) != dry.pixel(p);
    let rows = |x: u32| {
        let first = (0..200).find(|y| is_water([x, *y])).unwrap();
        first..(first..200).find(|y| !is_water([x, *y])).unwrap()
    };
    let land = dry.pixel([150, rows(150).end + 3]).unwrap()[1];
    let water: Vec<_> = (60..240).flat_map(|x| rows(x).map(move |y| [x, y])).collect();
    let floating = water.iter().filter(|p| picture.pixel(**p).unwrap()[1] > land / 2).count();
    assert!(water.len() > 2000 && floating == 0, "{floating} of {} pixels as bright as {land}", water.len());
}

/// A coast whose ground ends where its samples do had their corners.
#[test]
fn a_coast_without_a_bed_has_no_corners() {
    // Every other sample along the coast is missing one step farther out.
    let shore = Shore::new(0.0, |x, y| if y >= 32 + x % 2 { 10 } else { NODATA });
    let camera = Camera {
        eye: shore.land.place(0.5, 0.5, 500.0),
        target: shore.land.place(0.5, 0.5001, 0.0),
        fov_y: FOV_Y,
        size: [400, 300],
    };
    let look = Look { water: CALM, colours: Colours::Flat, ..PLAIN };
    let plain = Look { water: Water { reflecting: false, ..CALM }, ..look };
    let [smooth, cornered] = [look, plain].map(|look| {
        let picture = shore.picture(&camera, &shore.items, &look, 1);
        let land = picture.pixel([200, 100]).unwrap()[0];
        // How far down the ground's colour goes, in each column.
        let ends: Vec<u32> = (120..280)
            .map(|x| (100..200).find(|y| picture.pixel([x, *y]).unwrap()[0].abs_diff(land) > 25).unwrap())
            .collect();
        ends.iter().max().unwrap() - ends.iter().min().unwrap()
    });
    assert!(cornered >= 4 && 3 * smooth < 2 * cornered, "{smooth} of {cornered} pixels");
}

/// Water that has no heights where it is dry looks as water that has them everywhere, which the ground hides: it runs on under the
/// shore. Where it is drawn plain, it ends with its samples.
#[test]
fn water_that_ends_where_it_is_dry_has_the_shore_of_the_ground() {
    let land = |x: u32, y: u32| rough(x, y) / 8 - 130;
    let shore = Shore::new(12.0, land);
    let forest = shore.land.layer.forest;
    let mut wet = World::new(forest, 10.0, |x, y| if land(x, y) > 120 { NODATA } else { 120 });
    wet.layer = shore.layers[1].clone();
    let finest = forest.levels();
    let ending: Vec<DrawItem> = shore
        .land_items()
        .into_iter()
        .chain(wet.level(finest).into_iter().map(|item| DrawItem { layer: 1, ..item }))
        .collect();
    for (x, z) in [(0.5, 150.0), (0.2, 60.0)] {
        let camera = Camera {
            eye: shore.land.place(x, -0.2, z),
            target: shore.land.place(0.5, 0.5, 12.0),
            fov_y: 0.8,
            size: [320, 240],
        };
        let differs = |look: &Look| {
            let [a, b] = [&shore.items, &ending].map(|items| shore.picture(&camera, items, look, 1));
            let pixels = a.pixels.chunks(4).zip(b.pixels.chunks(4));
            pixels.filter(|(a, b)| a.iter().zip(b.iter()).any(|(a, b)| a.abs_diff(*b) > 8)).count()
        };
        let mirroring = differs(&Look { water: CALM, ..PLAIN });
        let plain = differs(&Look { water: Water { reflecting: false, ..CALM }, ..PLAIN });
        println!("{mirroring} pixels differ, {plain} where water is drawn plain");
        assert!(plain > 200 && mirroring < plain / 20, "{mirroring} {plain}");
    }
}

use super::*;
use crate::camera::FOV_Y;
use diamantina_protocol::texture::{INNER, SIDE};
use glam::DVec3;
use proptest::prelude::*;

/// 10 x 6 tiles of metres, but for a hole in the north-east.
fn texture() -> (Texture, Coverage) {
    let texture = Texture {
        name: "photo".to_owned(),
        origin: [1000.0, -500.0],
        texel: [1.0, 1.0],
        size: [10 * INNER, 6 * INNER],
        format: "webp".to_owned(),
        quality: 80,
        tiles: 0,
        bytes: 0,
        resampled: false,
    };
    let mut coverage = Coverage::empty(&texture);
    let finest = texture.levels() - 1;
    let all = (0..6).flat_map(|y| (0..10).map(move |x| Tile { level: finest, x, y }));
    for tile in all.filter(|tile| tile.x < 8 || tile.y < 4) {
        let mut next = Some(tile);
        while let Some(tile) = next {
            coverage.insert(tile);
            next = tile.parent();
        }
    }
    (texture, coverage)
}

fn ground() -> Bounds {
    Bounds { min: DVec3::new(0.0, -2000.0, 0.0), max: DVec3::new(5000.0, 3000.0, 100.0) }
}

fn above(x: f64, y: f64, height: f64) -> Camera {
    let eye = DVec3::new(x, y, height);
    Camera { eye, target: DVec3::new(x + 0.01, y, 0.0), fov_y: FOV_Y, size: [800, 600] }
}

fn look(camera: &Camera, boxes: &[Bounds], most: usize) -> Vec<Tile> {
    let (texture, coverage) = texture();
    wanted(&texture, &coverage, camera, boxes, 1.0, most)
}

#[test]
fn from_far_the_coarsest_tile_is_enough_and_from_near_the_finest_are_wanted() {
    assert_eq!(look(&above(2000.0, 200.0, 2e5), &[ground()], 100), [Tile::ROOT]);
    let near = look(&above(1500.0, 0.0, 200.0), &[ground()], 1000);
    assert_eq!(near[0], Tile::ROOT);
    let finest = texture().0.levels() - 1;
    assert!(near.iter().any(|tile| tile.level == finest));
    // Only where it is looked at: 130 m to each side.
    assert!(near.iter().all(|tile| tile.level < finest || tile.x < 4), "{near:?}");
    // Nothing is drawn, nothing is wanted.
    assert!(look(&above(1500.0, 0.0, 200.0), &[], 1000).is_empty());
}

#[test]
fn the_tile_within_which_a_rectangle_lies_is_the_finest_such() {
    let (texture, _) = texture();
    let finest = texture.levels() - 1;
    let at = |x: f64, y: f64| [1000.0 + f64::from(INNER) * x, -500.0 + f64::from(INNER) * y];
    assert_eq!(within(&texture, at(3.1, 2.1), at(3.9, 2.9)), Some(Tile { level: finest, x: 3, y: 2 }));
    assert_eq!(within(&texture, at(2.1, 2.1), at(3.9, 2.9)), Some(Tile { level: finest - 1, x: 1, y: 1 }));
    assert_eq!(within(&texture, at(3.9, 0.1), at(4.1, 0.2)), Some(Tile { level: finest - 3, x: 0, y: 0 }));
    assert_eq!(within(&texture, at(10.2, 0.1), at(11.0, 0.2)), None);
    assert_eq!(within(&texture, at(0.1, -3.0), at(0.2, -2.0)), None);
}

fn image() -> Bytes {
    let mut bytes = Vec::new();
    let texels = vec![200; Coding::Plain.tile_bytes()];
    image_webp::WebPEncoder::new(&mut bytes)
        .encode(&texels, SIDE, SIDE, image_webp::ColorType::Rgba8)
        .unwrap();
    bytes.into()
}

/// Frames until nothing more is wished for; the last one's step.
fn settle(draping: &mut Draping, camera: &Camera) -> Step {
    let picture = image();
    for frame in 0..500 {
        let step = draping.step(camera, &[ground()], 1.0, f64::from(frame));
        if step.complete {
            return step;
        }
        for tile in step.wishes {
            draping.take(tile, picture.clone());
        }
        while !draping.is_idle() {
            assert!(draping.take_decoded().iter().all(|(_, result)| result.is_ok()));
        }
    }
    panic!("it does not come to an end");
}

#[test]
fn memory_is_held_and_the_shown_hold_their_parents_wherever_the_eye_goes() {
    let bytes = 20 * Coding::Plain.tile_bytes();
    hold(bytes, Coding::Plain, 20);
    // Of blocks, four times as many.
    hold(bytes, Coding::Blocks, 80);
}

fn hold(bytes: usize, coding: Coding, most: usize) {
    let (texture, coverage) = texture();
    let mut draping = Draping::start(0, &texture, bytes, coding, 0.0).unwrap();
    assert!(draping.step(&above(0.0, 0.0, 10.0), &[ground()], 1.0, 0.0).lacks_coverage);
    draping.set_coverage(coverage);
    let mut largest = 0;
    for (x, y, height) in
        [(1500.0, 0.0, 300.0), (3000.0, 500.0, 200.0), (2000.0, 200.0, 5000.0), (1200.0, -400.0, 90.0)]
    {
        let step = settle(&mut draping, &above(x, y, height));
        let drape = step.drape.unwrap();
        assert!(
            drape.tiles.len() <= most && draping.tiles() <= most && draping.bytes() <= bytes,
            "{} {}",
            drape.tiles.len(),
            draping.tiles()
        );
        assert_eq!(drape.coding, coding);
        largest = largest.max(drape.tiles.len());
        let shown: Vec<Tile> = drape.tiles.iter().map(|draped| draped.tile).collect();
        for (i, tile) in shown.iter().enumerate() {
            assert!(tile.parent().is_none_or(|parent| shown[..i].contains(&parent)), "{tile:?}");
        }
        assert!(drape.tiles.iter().all(|draped| draped.weight == 1.0));
    }
    assert!(largest >= most.min(21), "{largest} tiles of {most}");
}

/// With less room on the GPU fewer are shown, and what is shown no more goes from memory, too.
#[test]
fn fewer_tiles_are_shown_where_the_gpu_has_no_room_for_more() {
    let (texture, coverage) = texture();
    let tile = Coding::Plain.tile_bytes();
    let mut draping = Draping::start(0, &texture, 100 * tile, Coding::Plain, 0.0).unwrap();
    draping.set_coverage(coverage);
    let camera = Camera { size: [1600, 1200], ..above(2500.0, 200.0, 1200.0) };
    let shown = |draping: &mut Draping| settle(draping, &camera).drape.unwrap().tiles.len();
    let all = shown(&mut draping);
    draping.fit_gpu(25 * tile as u64);
    let few = shown(&mut draping);
    assert!(all > 24 && few <= 24 && draping.tiles() <= 24, "{all} {few}");
    assert_eq!(draping.gpu_bytes(), 24 * tile as u64);
    draping.fit_gpu(u64::MAX);
    assert_eq!(shown(&mut draping), all);
    assert_eq!(draping.gpu_bytes(), 128 * tile as u64, "whole sheets");
}

#[test]
fn tiles_fade_in_and_damaged_ones_are_told() {
    let (texture, coverage) = texture();
    let mut draping =
        Draping::start(0, &texture, 100 * Coding::Plain.tile_bytes(), Coding::Plain, 0.5).unwrap();
    draping.set_coverage(coverage);
    let camera = above(1500.0, 0.0, 200.0);
    let picture = image();
    let wishes = draping.step(&camera, &[ground()], 1.0, 0.0).wishes;
    draping.take(wishes[0], Bytes::from_static(b"no picture"));
    draping.take(wishes[1], picture.clone());
    let mut told = Vec::new();
    while !draping.is_idle() {
        told.extend(draping.take_decoded());
    }
    assert_eq!(told.iter().filter(|(tile, result)| *tile == wishes[0] && result.is_err()).count(), 1);
    // Its child is there, but is not shown without it.
    assert!(draping.step(&camera, &[ground()], 1.0, 0.0).drape.is_none());
    draping.take(wishes[0], picture);
    while !draping.is_idle() {
        draping.take_decoded();
    }
    let weights =
        |step: Step| step.drape.unwrap().tiles.iter().map(|draped| draped.weight).collect::<Vec<_>>();
    assert_eq!(weights(draping.step(&camera, &[ground()], 1.0, 1.0)), [1.0, 0.0]);
    assert_eq!(weights(draping.step(&camera, &[ground()], 1.0, 1.25)), [1.0, 0.5]);
    assert_eq!(weights(draping.step(&camera, &[ground()], 1.0, 2.0)), [1.0, 1.0]);
}

proptest! {
    #[test]
    fn any_number_of_the_first_ones_holds_the_parents_of_each(
        x in 0.0..5000.0, y in -2000.0..3000.0, height in 1.0..50_000.0, yaw in 0.0..6.3, down in -1.4..0.3f64,
        boxes in prop::collection::vec((0.0..4500.0, -2000.0..2500.0, 10.0..500.0), 1..20), most in 1usize..60,
    ) {
        let eye = DVec3::new(x, y, height);
        let ahead = DVec3::new(f64::cos(yaw) * down.cos(), f64::sin(yaw) * down.cos(), down.sin());
        let camera = Camera { eye, target: eye + ahead, fov_y: FOV_Y, size: [800, 600] };
        let boxes: Vec<Bounds> = boxes.iter().map(|(x, y, side)| Bounds {
            min: DVec3::new(*x, *y, 0.0), max: DVec3::new(x + side, y + side, 80.0),
        }).collect();
        let all = look(&camera, &boxes, 100_000);
        let (texture, coverage) = texture();
        for (i, tile) in all.iter().enumerate() {
            prop_assert!(coverage.has(*tile));
            prop_assert!(tile.parent().is_none_or(|parent| all[..i].contains(&parent)), "{tile:?} in {all:?}");
        }
        prop_assert_eq!(&look(&camera, &boxes, most)[..], &all[..most.min(all.len())]);
        // Where something is drawn in view, no coarser texel than a pixel is left where a finer one is.
        let planes = camera.planes();
        for bounds in boxes.iter().filter(|bounds| bounds.touches(&planes)) {
            let finest = texture.levels() - 1;
            let [min, max] = [bounds.min, bounds.max].map(|corner| [corner.x, corner.y]);
            let Some(within) = within(&texture, min, max) else { continue };
            let texel = texture.texel_at(within.level)[0] * camera.pixels_per_radian() / bounds.distance(eye).max(1.0);
            let is_enough = texel <= 1.0 || within.level == finest || all.iter().any(|t| t.level > within.level);
            prop_assert!(!coverage.has(within) || is_enough || within.children().iter().all(|c| !coverage.has(*c)));
        }
    }
}

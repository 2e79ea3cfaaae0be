//! Pictures in which what was asked for can be read: steep ground in soft light.

use super::*;

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

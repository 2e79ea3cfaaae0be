//! Cuts of made scenes from any view: closed, conforming, within their tolerance and their memory.

mod tin;

use super::*;
use crate::surface::Points;
use crate::world::{Built, Dice, above, any_camera, surfaces, tin_surfaces, world};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::Block;
use std::time::Instant;

type Side = Vec<([i64; 2], i32)>;

fn ask<'a>(built: &'a Built, camera: &'a Camera, tolerance_pixels: f64) -> Ask<'a> {
    let sight = Sight::default();
    Ask {
        layer: &built.layer,
        encoding: Encoding::Points,
        camera,
        exaggeration: 1.0,
        tolerance_pixels,
        sight,
        seen: None,
        memory_bytes: usize::MAX,
        gpu: None,
    }
}

/// The three sides of a drawn triangle: lattice points with their heights, from the lesser end.
fn sides_of(built: &Built, item: &DrawItem, side: usize) -> [Side; 3] {
    let local = built.layer.forest.local(item.diamond);
    let block = item.surface.points().unwrap().block();
    let (n, centres) = (block.segments(), block.has_centres());
    let m = 2 * n as i64;
    let corners = [[0, 0], [m, 0], [m, m], [0, m]];
    let (a, b, centre) = (corners[side], corners[(side + 1) % 4], [m / 2, m / 2]);
    // Where centres are no points, half of a diagonal has half as many segments.
    let inner = if centres { n } else { n / 2 };
    [(a, b, n), (b, centre, inner), (centre, a, inner)].map(|(from, to, count)| {
        let mut points: Side = (0..=count as i64)
            .map(|i| {
                let p = [0, 1].map(|k| from[k] + (to[k] - from[k]) * i / count as i64);
                let slot = Block::slot(n, p[0] as usize, p[1] as usize);
                (local.lattice2(p), block.heights()[slot])
            })
            .collect();
        if points[0].0 > points[count].0 {
            points.reverse();
        }
        points
    })
}

fn double_area(side: &Side, other: &Side) -> i64 {
    let vector = |s: &Side| {
        let (a, b) = (s[0].0, s[s.len() - 1].0);
        [b[0] - a[0], b[1] - a[1]]
    };
    let (u, v) = (vector(side), vector(other));
    (u[0] * v[1] - u[1] * v[0]).abs()
}

/// Law 2: the drawn triangles cover the forest once, and neighbours share every height of their edge.
fn assert_conforming(built: &Built, drawn: &[Diamond], items: &[DrawItem]) {
    let forest = &built.layer.forest;
    let mut area = 0;
    let mut sides: HashMap<Vec<[i64; 2]>, Vec<Vec<i32>>> = HashMap::new();
    for item in items {
        for q in (0..4).filter(|q| item.sides & (1 << q) != 0) {
            let triangle = sides_of(built, item, q);
            area += double_area(&triangle[0], &triangle[1]);
            for side in triangle {
                let (points, heights): (Vec<_>, Vec<_>) = side.into_iter().unzip();
                sides.entry(points).or_default().push(heights);
            }
        }
    }
    // Triangles left out because the index says that nothing is there.
    let mut void = 0;
    for root in forest.root_diamonds().filter(|root| built.entries[root].is_empty()) {
        let [a, b] = forest.bounds(root);
        void += 2 * i64::from(b[0] - a[0]) * i64::from(b[1] - a[1]);
    }
    for d in drawn.iter().copied() {
        let [u, v] = [forest.local(d).u, forest.local(d).v];
        let n = forest.segments_at(d.level()) as i64;
        let quarter = (u[0] * v[1] - u[1] * v[0]).abs() * n * n / 2;
        let empty = |c: &Diamond| built.entries[c].is_empty();
        void += quarter * forest.children(d).iter().flatten().filter(|c| empty(c)).count() as i64;
    }
    let [w, h] = forest.size().map(i64::from);
    assert_eq!(area + void, 2 * w * h, "covered once");
    for (points, heights) in sides {
        let on_border = |k: usize, at: i64| points.iter().all(|p| p[k] == at);
        let border = on_border(0, 0) || on_border(0, w) || on_border(1, 0) || on_border(1, h);
        match heights.as_slice() {
            [a, b] => assert!(!border && a == b, "a crack along {points:?}: {a:?} {b:?}"),
            [a] => assert!(
                border || a.iter().all(|h| *h == NODATA),
                "nothing beyond {points:?}, which has heights {a:?}"
            ),
            more => panic!("{} triangles along {points:?}", more.len()),
        }
    }
}

/// Sees everything: the eye is far above, and the field of view wide.
fn all_seeing(dice: &mut Dice) -> Camera {
    let camera = any_camera(dice);
    let eye = DVec3::new(camera.eye.x, camera.eye.y, 30_000.0);
    Camera { eye, target: eye - DVec3::Z, fov_y: 2.6, ..camera }
}

#[test]
fn any_cut_with_any_data_missing_covers_the_forest_once_without_cracks() {
    let mut dice = Dice(7);
    for built in world() {
        for round in 0..60 {
            let camera = all_seeing(&mut dice);
            let ask = ask(built, &camera, 0.02 * 300f64.powf(dice.roll()));
            let known = if round % 3 == 0 { 0.5 + dice.roll() / 2.0 } else { 1.0 };
            let levels = built.layer.forest.levels();
            let has = |d: Diamond, chance: f64| {
                let [x, y] = d.centre();
                d.level() == 0 || Dice(u64::from(x) << 32 | u64::from(y) ^ round).roll() < chance
            };
            // A page is there or not, with all its entries.
            let page = |d: Diamond| index::page_of(&built.layer.forest, d);
            let entry = |d: Diamond| {
                (Dice(u64::from(page(d)) ^ round << 40).roll() < known).then(|| built.entries[&d])
            };
            let ideal = choose(&ask, entry);
            let arrived = 0.7 + 0.3 * dice.roll();
            let surfaces = surfaces(built, |d| has(d, arrived) && d.level() < levels);
            let drawing = draw(0, &ask, &ideal, |d| surfaces.get(&d).cloned());
            let splits: HashSet<Diamond> = ideal.splits().collect();
            for d in &splits {
                assert!(built.layer.forest.parents(*d).all(|p| splits.contains(&p)), "closed under parents");
            }
            assert!(!drawing.items.is_empty());
            if known == 1.0 {
                let drawn: Vec<_> = ideal.splits().filter(|d| surfaces.contains_key(d)).collect();
                assert_eq!(drawn, drawing.splits);
                assert_conforming(built, &drawn, &drawing.items);
                assert!(drawing.error_pixels >= drawing.error_pixels_goal);
            }
        }
    }
}

#[test]
fn chosen_from_any_view_the_ideal_set_reaches_the_tolerance() {
    let mut dice = Dice(3);
    let built = &world()[0];
    for _ in 0..200 {
        let camera = any_camera(&mut dice);
        let tolerance = 0.5 + 20.0 * dice.roll();
        let ask = ask(built, &camera, tolerance);
        let ideal = choose(&ask, |d| Some(built.entries[&d]));
        let splits: HashSet<Diamond> = ideal.splits().collect();
        let forest = &built.layer.forest;
        assert!(splits.iter().all(|d| forest.parents(*d).all(|p| splits.contains(&p))));
        for d in splits.iter() {
            for child in forest.children(*d).into_iter().flatten().filter(|c| !splits.contains(c)) {
                let entry = built.entries[&child];
                let bounds = bounds(&built.layer, child, &entry);
                assert!(
                    entry.is_empty()
                        || !bounds.touches(&camera.planes())
                        || ask.pixels(child, child.level(), entry.error_metres, &bounds) <= tolerance
                );
            }
        }
        let drawing = draw(0, &ask, &ideal, |_| None);
        assert!(drawing.items.is_empty() && drawing.error_pixels.is_infinite(), "no root, no picture");
        let order: Vec<Diamond> = drawing.wishes.iter().map(|wish| wish.diamond).collect();
        for (at, d) in order.iter().enumerate() {
            assert!(forest.parents(*d).all(|p| order[..at].contains(&p)), "parents are asked for first");
        }
    }
}

#[test]
fn seen_from_above_the_same_tolerance_needs_fewer_splits() {
    let built = &world()[0];
    let mut dice = Dice(5);
    let sphere = Sight { vertical: false, ..Sight::default() };
    let (mut with, mut without) = (0, 0);
    for _ in 0..40 {
        // Straight down, at errors below a cell, where none can be of an outline.
        let camera = above();
        let eye = camera.eye + DVec3::Z * 3000.0 * (dice.roll() - 0.5);
        let camera = Camera { eye, target: eye - DVec3::Z, ..camera };
        let splits = |sight| -> HashSet<Diamond> {
            let ask = Ask { sight, ..ask(built, &camera, 0.5) };
            choose(&ask, |d| Some(built.entries[&d])).splits().collect()
        };
        let (vertical, sphere) = (splits(Sight::default()), splits(sphere));
        assert!(vertical.is_subset(&sphere), "what is not split looks no larger than a sphere does");
        with += vertical.len();
        without += sphere.len();
    }
    println!("{with} splits, {without} with spheres");
    assert!(with * 4 < without * 3, "{with} of {without}");
}

#[test]
fn heights_multiplied_are_cut_as_a_terrain_of_that_height() {
    let mut dice = Dice(77);
    let built = &world()[0];
    for round in 0..40 {
        let exaggeration = [1.5, 5.0, 40.0][round % 3];
        let tall = Layer {
            quantum: built.layer.quantum * exaggeration,
            height_offset: built.layer.height_offset * exaggeration,
            finest_error: built.layer.finest_error * exaggeration as f32,
            ..built.layer.clone()
        };
        let taller = |e: Entry| Entry { error_metres: e.error_metres * exaggeration as f32, ..e };
        // Every third one looks straight down, where multiplied heights are multiplied distances, too.
        let camera = any_camera(&mut dice);
        let eye = camera.eye.with_z(camera.eye.z * exaggeration);
        let target = if round % 3 == 0 { eye - DVec3::Z } else { camera.target };
        let camera = Camera { eye, target, ..camera };
        // Taller errors might be taken for those of outlines: all count as spheres here.
        let sight = Sight { vertical: false, ..Sight::default() };
        let ask = Ask { exaggeration, sight, ..ask(built, &camera, 2.0) };
        let ideal = choose(&ask, |d| Some(built.entries[&d]));
        let as_tall = Ask { layer: &tall, exaggeration: 1.0, ..ask };
        let expected = choose(&as_tall, |d| Some(taller(built.entries[&d])));
        let count = |a: &Ideal| a.splits().collect::<HashSet<_>>();
        let different = count(&ideal).symmetric_difference(&count(&expected)).count();
        // Errors are f32, so one that is just at the tolerance may fall on either side.
        assert!(different * 200 <= expected.len().max(200), "{different} of {}", expected.len());
    }
}

#[test]
fn an_eye_within_the_terrain_sees_an_error_of_finite_size() {
    let built = &world()[0];
    let lossy = Layer { finest_error: 1.5, ..built.layer.clone() };
    let [low, high] = built.layer.forest.bounds(built.layer.forest.root_diamonds().next().unwrap());
    let [x, y] = built.layer.position([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2]);
    let eye = DVec3::new(x, y, f64::midpoint(built.layer.heights[0], built.layer.heights[1]));
    let camera = Camera { eye, target: eye + DVec3::X, ..above() };
    let ask = Ask { layer: &lossy, ..ask(built, &camera, 1.0) };
    let ideal = choose(&ask, |d| Some(built.entries[&d]));
    let goal = draw(0, &ask, &ideal, |_| None).error_pixels_goal;
    let sphere = |distance: f64| 1.5 * camera.pixels_per_radian() / distance;
    assert!(goal > sphere(1000.0) && goal <= sphere(0.05) * (1.0 + 1e-6), "{goal}");
}

#[test]
fn memory_bounds_the_ideal_set_and_spends_itself_on_the_largest_errors() {
    let built = &world()[0];
    let camera = above();
    let mut last = f64::INFINITY;
    let forest = &built.layer.forest;
    let largest = Points::bytes(forest, 0);
    for surfaces in [2, 50, 200, 800] {
        let memory_bytes = surfaces * largest;
        let ask = Ask { memory_bytes, ..ask(built, &camera, 0.1) };
        let ideal = choose(&ask, |d| Some(built.entries[&d]));
        let bytes: usize = ideal.splits().map(|d| Points::bytes(forest, d.level())).sum();
        assert!(bytes <= memory_bytes && bytes * 10 >= memory_bytes * 9, "{bytes} of {memory_bytes}");
        let goal = draw(0, &ask, &ideal, |_| None).error_pixels_goal;
        assert!(goal < last);
        last = goal;
    }
}

#[test]
fn without_an_index_the_roots_are_wished_for_with_their_pages_and_drawn() {
    let built = &world()[0];
    let camera = above();
    let ask = ask(built, &camera, 1.0);
    let ideal = choose(&ask, |_| None);
    assert_eq!((ideal.len(), ideal.pages()), (2, [0, 1].as_slice()));
    let drawing = draw(0, &ask, &ideal, |_| None);
    assert_eq!(drawing.wishes.len(), 2);
    assert!(drawing.wishes.iter().all(|wish| wish.bytes.is_none()));
    let surfaces = surfaces(built, |d| d.level() == 0);
    let drawing = draw(0, &ask, &ideal, |d| surfaces.get(&d).cloned());
    assert_eq!(drawing.items.len(), 2);
}

#[test]
fn a_cut_of_a_thousand_diamonds_takes_less_than_a_frame() {
    let built = &world()[0];
    let camera = above();
    let memory_bytes = 1000 * Points::bytes(&built.layer.forest, 0);
    let ask = Ask { memory_bytes, ..ask(built, &camera, 0.1) };
    let entries: HashMap<Diamond, Entry, RandomState> = built.entries.clone().into_iter().collect();
    let surfaces = surfaces(built, |_| true);
    let surfaces: HashMap<Diamond, Arc<Surface>, RandomState> = surfaces.into_iter().collect();
    let mut best = f64::INFINITY;
    let mut items = 0;
    for _ in 0..50 {
        let started = Instant::now();
        let ideal = choose(&ask, |d| entries.get(&d).copied());
        let drawing = draw(0, &ask, &ideal, |d| surfaces.get(&d).cloned());
        best = best.min(started.elapsed().as_secs_f64());
        items = drawing.items.len();
    }
    println!("1000 splits, {items} items: {:.3} ms", best * 1e3);
    assert!(best < 0.010, "{best} s");
}

/// Low over the ground, within the boxes of what is below: no point that is drawn looks farther off than the cut says,
/// which says far less than those boxes would.
#[test]
fn what_is_far_below_the_eye_counts_as_that() {
    let built = &world()[0];
    let (layer, forest) = (&built.layer, &built.layer.forest);
    let all = surfaces(built, |_| true);
    let error = f64::from(layer.finest_error);
    let mut dice = Dice(11);
    let finest: Vec<Diamond> = forest.diamonds(forest.levels() - 1).collect();
    let (mut hovers, mut nearer) = (0, 0);
    for _ in 0..60 {
        // Some metres above a point of the finest diamonds.
        let d = finest[(dice.roll() * finest.len() as f64) as usize];
        let block = all[&d].points().unwrap().block();
        let n = block.segments();
        let height = layer.metres(block.heights()[Block::slot(n, n, n)]);
        let place = [0, 1].map(|i| layer.origin[i] + layer.cell[i] * f64::from(d.centre()[i]));
        let eye = DVec3::new(place[0], place[1], height + 2.0 + 30.0 * dice.roll());
        let target = eye + DVec3::new(dice.roll() - 0.5, dice.roll() - 0.5, -dice.roll());
        let camera = Camera { eye, target, ..above() };
        let ask = ask(built, &camera, 1.0);
        let ideal = choose(&ask, |d| built.entries.get(&d).copied());
        let drawing = draw(0, &ask, &ideal, |d| all.get(&d).cloned());
        assert_eq!(drawing.error_pixels, drawing.error_pixels_goal);
        let boxes = ideal.finest_pixels.iter().copied().fold(0.0, f64::max);
        hovers += usize::from(boxes > 20.0);
        nearer += usize::from(boxes > 20.0 && boxes > 2.0 * drawing.error_pixels);
        let planes = camera.planes();
        for item in drawing.items.iter().filter(|item| item.diamond.level() + 1 == forest.levels()) {
            let (local, block) = (forest.local(item.diamond), item.surface.points().unwrap().block());
            for [p, q] in block.places() {
                let height = block.heights()[Block::slot(block.segments(), p, q)];
                let at = local.lattice2([p as i64, q as i64]);
                let place = [0, 1].map(|i| layer.origin[i] + layer.cell[i] * at[i] as f64);
                let drawn = DVec3::new(place[0], place[1], layer.metres(height));
                let in_view = planes.iter().all(|plane| plane.normal.dot(drawn) + plane.offset >= 0.0);
                if height == NODATA || !in_view || (drawn - eye).length() < nearest_drawn(layer.cell) {
                    continue;
                }
                for truth in [drawn - DVec3::Z * error, drawn + DVec3::Z * error] {
                    let pixels = (truth - eye).angle_between(drawn - eye) * camera.pixels_per_radian();
                    let said = drawing.error_pixels.max(ask.tolerance_pixels);
                    assert!(pixels <= said * 1.001, "{pixels} at {drawn}, {said} said, eye {eye}");
                }
            }
        }
    }
    assert!(hovers > 10 && nearer > hovers / 2, "{nearer} of {hovers}");
}

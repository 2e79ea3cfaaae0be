//! Irregular triangles as the client draws them: they fit each other whatever has arrived, light shows no seams, and
//! the ground is that of the points.

use crate::stream::{fly_over_magenta, over_magenta, sharp};
use crate::world::{Faults, Proxy, World, build, data, options, programs, serve};
use diamantina_client::camera::{Camera, FOV_Y};
use diamantina_client::drawing::DrawItem;
use diamantina_client::encoding::Encoding;
use diamantina_client::fetch;
use diamantina_client::headless;
use diamantina_client::picture::Picture;
use diamantina_client::terrain::{self, Terrain};
use diamantina_protocol::bintree::Forest;
use diamantina_server::hierarchy::{self, TinOptions};
use diamantina_server::ingest;
use glam::DVec3;
use std::collections::{HashMap, HashSet};
use std::process::Command;
use std::time::{Duration, Instant};

const MINUTE: Duration = Duration::from_secs(60);

type Place = [i64; 2];

fn open(url: &str, encoding: Encoding, tolerance_pixels: f64) -> Terrain {
    let fetch = fetch::Options { encoding, ..fetch::Options::default() };
    Terrain::open(url, terrain::Options { tolerance_pixels, fetch, ..terrain::Options::default() }).unwrap()
}

/// The drawn triangles of an item: places with heights and normals.
fn triangles(item: &DrawItem) -> Vec<[(Place, i32, [i16; 2]); 3]> {
    let tin = item.surface.tin().expect("irregular triangles");
    let centre = item.diamond.centre().map(i64::from);
    let sides = (0..4).filter(|side| item.sides & (1 << side) != 0);
    let ranges = sides.map(|side| tin.sides()[side].start as usize..tin.sides()[side].end as usize);
    let triangles = ranges.flat_map(|range| tin.indices()[range].chunks_exact(3));
    let corner = |index: u16| {
        let corner = tin.corners()[usize::from(index)];
        ([0, 1].map(|k| centre[k] + i64::from(corner.place[k])), corner.height, corner.normal)
    };
    triangles.map(|t| [corner(t[0]), corner(t[1]), corner(t[2])]).collect()
}

/// The straight line through two places, where they stand along it, and whether `a` comes first.
fn line(a: Place, b: Place) -> ([i64; 3], [i64; 2], bool) {
    let (mut x, mut y) = ((b[0] - a[0]).abs(), (b[1] - a[1]).abs());
    while y != 0 {
        (x, y) = (y, x % y);
    }
    let forth = (b[0] - a[0], b[1] - a[1]) > (0, 0);
    let sign = if forth { x } else { -x };
    let (dx, dy) = ((b[0] - a[0]) / sign, (b[1] - a[1]) / sign);
    let along = |p: Place| p[0] * dx + p[1] * dy;
    let (s, t) = (along(a), along(b));
    ([dx, dy, a[0] * dy - a[1] * dx], [s.min(t), s.max(t)], forth)
}

/// Asserts that no side of a drawn triangle lies along that of another without being the same, with the same heights; and
/// that vertices have one normal, but for those on sides of root squares, which know nothing of each other. Returns how
/// many sides have triangles on both sides.
fn assert_fit(forest: &Forest, items: &[DrawItem]) -> usize {
    let root = 1i64 << forest.root_log2();
    let (mut points, mut sides) = (HashMap::new(), HashSet::new());
    let mut normals = HashMap::<Place, HashSet<[i16; 2]>>::new();
    for triangle in items.iter().flat_map(triangles) {
        for i in 0..3 {
            let ((a, height, normal), (b, ..)) = (triangle[i], triangle[(i + 1) % 3]);
            assert!(sides.insert((a, b)), "two triangles on one side of {a:?} to {b:?}");
            assert_eq!(*points.entry(a).or_insert(height), height, "two heights at {a:?}");
            normals.entry(a).or_default().insert(normal);
        }
    }
    // Fans that meet in a point alone, each with a gap beside it, have a normal each.
    let mut gaps = HashMap::<Place, usize>::new();
    for (a, _) in sides.iter().filter(|(a, b)| !sides.contains(&(*b, *a))) {
        *gaps.entry(*a).or_default() += 1;
    }
    let fans = |place: &Place| gaps.get(place).copied().unwrap_or(0).max(1);
    let seam = |(place, found): &(&Place, &HashSet<[i16; 2]>)| {
        found.len() > fans(place) && place.iter().all(|w| w % root != 0)
    };
    let seams: Vec<_> = normals.iter().filter(seam).collect();
    assert!(seams.is_empty(), "{} of {} vertices: {:?}", seams.len(), normals.len(), seams[0]);
    let mut open: HashMap<[i64; 3], Vec<([i64; 2], bool)>> = HashMap::new();
    for (a, b) in sides.iter().filter(|(a, b)| !sides.contains(&(*b, *a))) {
        let (line, span, forth) = line(*a, *b);
        open.entry(line).or_default().push((span, forth));
    }
    for (line, mut spans) in open {
        spans.sort_unstable();
        let mut until = [i64::MIN; 2];
        for ([from, to], forth) in spans {
            assert!(from >= until[0].max(until[1]), "a crack or an overlap along {line:?} from {from}");
            until[usize::from(forth)] = to;
        }
    }
    sides.iter().filter(|(a, b)| sides.contains(&(*b, *a))).count() / 2
}

/// A camera somewhere over a scene.
fn any_camera(terrain: &Terrain, turn: f64, near: f64) -> Camera {
    let [low, high] = headless::extent(terrain.scene());
    let (centre, span) = ((low + high) / 2.0, high - low);
    let around = DVec3::new(turn.cos() * span.x, turn.sin() * span.y, 0.0) * near;
    let eye = (centre + around).with_z(high.z + span.truncate().length() * near * 0.6);
    Camera { eye, target: centre.with_z(low.z), fov_y: FOV_Y, size: [320, 200] }
}

#[test]
fn over_magenta_no_pixel_is_magenta_while_triangles_come_late_and_out_of_order() {
    let world = World::whole_with_triangles(1025);
    let faults = Faults { delay: Duration::from_millis(250), cut: 0.95, ..Faults::default() };
    let (unfinished, _) = fly_over_magenta(&world, faults, 3, Encoding::Tin);
    assert!(unfinished > 30, "the network was too fast: {unfinished} unfinished frames");
}

#[test]
fn triangles_of_real_dems_fit_at_every_moment_of_their_arrival_and_show_no_seams() {
    let Some(folder) = data() else { return };
    // The last three have rivers, voids and margins without data.
    let dems = ["srtm3_crops/hills_1025.tif", "osgearth_terrain/mt_fuji_90m.tif", "qgis_training/SRTM.tif"];
    for name in dems {
        let store = tempfile::tempdir().unwrap();
        let options = hierarchy::Options { tin: Some(TinOptions::default()), ..options() };
        build(&folder.join(name), store.path(), &ingest::Options::default(), &options);
        let served = serve(&[store.path().to_owned()]);
        let (mut moments, mut fitting) = (0, 0);
        for seed in 0..7u8 {
            // Each piece of an answer comes late, so frames see the scene in parts; also those of a busy machine.
            let faults = Faults { delay: Duration::from_millis(160), ..Faults::default() };
            let proxy = Proxy::start(&served.address, faults, seed.into());
            let mut terrain = open(&format!("{}/scenes/world", proxy.address), Encoding::Tin, 0.7);
            let forest = terrain.scene().layers[0].forest;
            let camera = any_camera(&terrain, f64::from(seed) * 1.7, 0.2 + 0.2 * f64::from(seed));
            let (until, mut last) = (Instant::now() + MINUTE, f64::INFINITY);
            loop {
                let view = terrain.frame(&camera);
                if view.error_pixels < last {
                    last = view.error_pixels;
                    fitting += assert_fit(&forest, &view.items);
                    moments += 1;
                }
                if view.complete || Instant::now() > until {
                    assert!(view.complete && view.error_pixels <= 0.7, "{name}: {:?}", terrain.problem());
                    break;
                }
                std::thread::sleep(Duration::from_millis(2));
            }
        }
        println!("{name}: {moments} moments, {fitting} sides with triangles on both sides");
        assert!(moments > 6 && fitting > 20_000, "{name}: {moments} {fitting}");
    }
}

/// The first row of a column, from the top, that is not background.
fn skyline(picture: &Picture, x: u32) -> Option<u32> {
    (0..picture.size[1]).find(|y| picture.pixel([x, *y]) != Some([255, 0, 255, 255]))
}

#[test]
fn both_encodings_of_a_real_dem_show_the_same_ground() {
    let Some(folder) = data() else { return };
    let store = tempfile::tempdir().unwrap();
    let options = hierarchy::Options { tin: Some(TinOptions::default()), ..options() };
    let dem = folder.join("srtm3_crops/alps_1025.tif");
    build(&dem, store.path(), &ingest::Options::default(), &options);
    let served = serve(&[store.path().to_owned()]);
    for (turn, near) in [(0.4, 0.45), (2.0, 0.3), (4.4, 0.8)] {
        let error = 1.0;
        let both = [Encoding::Points, Encoding::Tin].map(|encoding| {
            let mut terrain = open(&served.scene("world"), encoding, error);
            // Low enough for mountains to stand against the sky.
            let mut camera = any_camera(&terrain, turn, near);
            let [low, high] = headless::extent(terrain.scene());
            camera.eye.z = high.z + 600.0;
            camera.target.z = (low.z + high.z) / 2.0;
            headless::picture(&mut terrain, &camera, &over_magenta(), &sharp(), MINUTE).unwrap()
        });
        let [(points, of_points), (tin, of_tin)] = &both;
        assert!(of_points.complete && of_tin.complete);
        assert!(of_points.largest_error_pixels <= error && of_tin.largest_error_pixels <= error);
        assert!(of_tin.triangles_received > 0 && of_tin.real_points == 0);
        assert!(of_tin.triangles_drawn * 3 < of_points.triangles_drawn, "{of_tin:?} {of_points:?}");
        let [width, height] = points.size;
        let mut worst = 0;
        for x in 0..width {
            match (skyline(points, x), skyline(tin, x)) {
                // Each is wrong by a pixel at most, and a pixel is there or not.
                (Some(a), Some(b)) => worst = worst.max(a.abs_diff(b)),
                (a, b) => assert_eq!(a, b, "column {x}"),
            }
        }
        let pixels = (0..width).flat_map(|x| (0..height).map(move |y| [x, y]));
        let differences: Vec<u8> = pixels
            .map(|p| {
                let (a, b) = (points.pixel(p).unwrap(), tin.pixel(p).unwrap());
                (0..3).map(|i| a[i].abs_diff(b[i])).max().unwrap()
            })
            .collect();
        let mean = differences.iter().map(|d| f64::from(*d)).sum::<f64>() / differences.len() as f64;
        println!(
            "skylines differ by {worst} pixels at most, colours by {mean:.1} of 255 on average; {} and {} triangles",
            of_points.triangles_drawn, of_tin.triangles_drawn
        );
        assert!(worst <= 3, "skylines differ by {worst} pixels");
        assert!(mean < 8.0, "colours differ by {mean}");
    }
}

#[test]
fn what_triangles_cannot_do_is_refused_with_the_remedy() {
    let world = World::sample(129, 0.0);
    let client = |arguments: &[&str]| {
        let mut command = Command::new(&programs().client);
        command.args(arguments).args(["--encoding", "tin", "--size", "64x64"]);
        let output = command.current_dir(world.folder.path()).output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let scene = world.served.scene("world");
    let (code, text) = client(&["render", &scene, "-o", "a.png"]);
    assert!(
        code == Some(1) && text.contains("offered as points, asked for as tin: build the store"),
        "{text}"
    );
    let (code, text) = client(&["render", &scene, "-o", "a.png", "--stream"]);
    assert!(code == Some(2) && text.contains("leave --stream or --encoding tin out"), "{text}");
}

/// Goes on until the scene is streamed otherwise, and looks at each frame on the way.
fn go_over(terrain: &mut Terrain, camera: &Camera, error_pixels: f64) {
    let reloads = terrain.frame(camera).stats.reloads;
    let until = Instant::now() + MINUTE;
    loop {
        let view = terrain.frame(camera);
        let tins = view.items.iter().filter(|item| item.surface.tin().is_some()).count();
        assert!(
            !view.items.is_empty() && (tins == 0 || tins == view.items.len()),
            "{tins} of {}",
            view.items.len()
        );
        assert!(view.error_pixels <= error_pixels + 1e-6, "{} pixels on the way", view.error_pixels);
        if view.stats.reloads > reloads {
            return;
        }
        assert!(Instant::now() < until, "{:?}", terrain.problem());
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn one_encoding_gives_way_to_the_other_without_a_gap() {
    let world = World::whole_with_triangles(257);
    let mut terrain = open(&world.served.scene("world"), Encoding::Points, 1.0);
    let camera = any_camera(&terrain, 1.0, 0.5);
    assert!(terrain.settle(&camera, MINUTE).complete);
    for encoding in [Encoding::Tin, Encoding::Points] {
        terrain.choose(encoding, None);
        assert_eq!(terrain.choice(), (encoding, None));
        go_over(&mut terrain, &camera, 1.0);
        let view = terrain.settle(&camera, MINUTE);
        assert!(view.complete && terrain.encoding() == encoding, "{:?}", terrain.problem());
        let is_tin = |item: &DrawItem| item.surface.tin().is_some();
        assert!(view.items.iter().all(|item| is_tin(item) == (encoding == Encoding::Tin)));
    }
    // Chosen and taken back before it is there: nothing happens.
    terrain.choose(Encoding::Tin, None);
    terrain.choose(Encoding::Points, None);
    let view = terrain.settle(&camera, MINUTE);
    assert!(view.complete && view.stats.reloads == 2);
}

#[test]
fn an_encoding_that_is_not_offered_changes_nothing() {
    let world = World::sample(257, 1.0);
    let mut terrain = open(&world.served.scene("world"), Encoding::Points, 1.0);
    let camera = any_camera(&terrain, 1.0, 0.5);
    assert!(terrain.settle(&camera, MINUTE).complete);
    terrain.choose(Encoding::Tin, None);
    let until = Instant::now() + MINUTE;
    while terrain.choice().0 == Encoding::Tin {
        assert!(!terrain.frame(&camera).items.is_empty() && Instant::now() < until);
        std::thread::sleep(Duration::from_millis(5));
    }
    assert!(terrain.problem().is_some_and(|problem| problem.contains("tin")), "{:?}", terrain.problem());
    assert!(terrain.settle(&camera, MINUTE).complete);
}

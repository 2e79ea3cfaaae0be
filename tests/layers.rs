//! Several layers in one scene: ground, and water of another resolution and extent, from the command line to the picture.

use crate::hostile::{Ended, PATIENCE, assert_failed, client, end, server, signal, start, words};
use crate::http::{block, get};
use crate::resume::finished;
use crate::seams::{Loaded, assert_no_cracks, load};
use crate::stream::fly_over_magenta;
use crate::truth::{Samples, judge};
use crate::world::{Dice, Faults, World, programs, serve, write_raw};
use diamantina_client::camera::Camera;
use diamantina_client::cut::{self, Ask};
use diamantina_client::encoding::Encoding;
use diamantina_client::sight::Sight;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::{self, HeightAnswer, Kind, StreamAsk};
use diamantina_server::hierarchy::{self, LayerSource};
use diamantina_server::ingest::{self, Source};
use diamantina_server::progress::Progress;
use diamantina_server::projection::{self, Projection};
use diamantina_server::store::{Key, Kind as BlobKind, Store};
use diamantina_server::{inspect, sample};
use glam::DVec3;
use std::collections::HashSet;
use std::fmt::Write as _;
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// The frame of the made landscape.
const EPSG: u32 = 32723;

/// Metres between samples of the sea: more than twice those of the ground.
const SEA_CELL: f64 = 70.0;

/// Writes an Arc ASCII grid with the centre of its south-west sample at `origin`; it says nothing of its CRS.
pub(crate) fn write_asc(
    path: &Path,
    [width, height]: [u32; 2],
    [x, y]: [f64; 2],
    cell: f64,
    at: impl Fn(u32, u32) -> Option<f64>,
) {
    let mut text = format!(
        "ncols {width}\nnrows {height}\nxllcenter {x}\nyllcenter {y}\ncellsize {cell}\nNODATA_value -9999\n"
    );
    for j in (0..height).rev() {
        for i in 0..width {
            // Writing to a String cannot fail.
            let _ = match at(i, j) {
                Some(height) => write!(text, "{height:.3} "),
                None => write!(text, "-9999 "),
            };
        }
        text.push('\n');
    }
    std::fs::write(path, text).unwrap();
}

/// A swell with an island, and nothing in the east.
fn swell(i: u32, j: u32) -> Option<f64> {
    let (x, y) = (f64::from(i), f64::from(j));
    let is_dry = (x - 60.0).hypot(y - 40.0) < 17.0 || i > 100 && (i + j).is_multiple_of(3) || i > 150;
    (!is_dry).then(|| ((2.0 + (x / 5.0).sin() * (y / 7.0).cos()) * 100.0).round() / 100.0)
}

/// The made landscape as `dem.tif`, and as `sea.asc` a sea that reaches beyond it in the south and the east.
struct Pair {
    scratch: TempDir,
}

impl Pair {
    fn new(samples: u32) -> Self {
        let scratch = tempfile::tempdir().unwrap();
        sample::write(&scratch.path().join("dem.tif"), samples).unwrap();
        let sea = [samples * 2 / 5, samples / 3];
        let origin = sample::place(0.3, -0.2, samples);
        write_asc(&scratch.path().join("sea.asc"), sea, origin, SEA_CELL, swell);
        Self { scratch }
    }

    fn folder(&self) -> &Path {
        self.scratch.path()
    }

    /// What builds the store of this name.
    fn command(name: &str, options: &str) -> String {
        format!(
            "build {{}}/dem.tif --layer sea=water:{{}}/sea.asc --assume-crs EPSG:{EPSG} --scene world -o {{}}/{name} {options}"
        )
    }

    fn build(&self, name: &str, options: &str) -> (PathBuf, Ended) {
        let ended = server(self.folder(), &Self::command(name, options));
        assert_eq!(ended.code, Some(0), "{ended:?}");
        (self.folder().join(name), ended)
    }

    /// The layers' sources, as the build reads them.
    fn sources(&self) -> [Source; 2] {
        let options = ingest::Options { assume_crs: NonZeroU32::new(EPSG), ..ingest::Options::default() };
        let ground = ingest::open(&[self.folder().join("dem.tif")], &options).unwrap();
        let sea = ingest::open_over(&[self.folder().join("sea.asc")], &options, &ground).unwrap();
        [ground, sea]
    }
}

#[test]
fn each_layer_keeps_the_laws_of_errors_and_of_borders() {
    let pair = Pair::new(400);
    let (store, ended) = pair.build("store", "--max-error 0.5 --patch-segments 32");
    assert!(
        ended.out.contains("layer terrain: terrain") && ended.out.contains("layer sea: water"),
        "{ended:?}"
    );
    let store = Store::open(&store).unwrap();
    let layers = &store.scene().layers;
    let about: Vec<_> = layers.iter().map(|layer| (layer.name.as_str(), layer.kind)).collect();
    assert_eq!(about, [("terrain", Kind::Terrain), ("sea", Kind::Water)]);
    assert_eq!(layers[1].cell, [SEA_CELL; 2]);
    assert_eq!(layers[1].origin, sample::place(0.3, -0.2, 400));
    assert_eq!(store.scene().frame.crs.as_ref().unwrap().name, format!("EPSG:{EPSG}"));
    let mut dice = Dice(26);
    for (number, source) in (0u8..).zip(&pair.sources()) {
        let Loaded { layer, entries, surfaces } = load(&store, number);
        let samples = Samples::read(source);
        assert_eq!([samples.width, samples.height], layer.samples);
        assert!(!layer.resampled && layer.valid_samples < source_samples(source), "with holes");
        assert!(layer.finest_error <= 0.5 + 1e-6, "{}", layer.finest_error);
        // Law 3: every sample at every level.
        let verdict = judge(&store, number, &entries, &samples);
        let compared = verdict.compared.load(Ordering::Relaxed);
        let wrong = verdict.wrong.load(Ordering::Relaxed);
        assert_eq!(wrong, 0, "{}: {:?}", layer.name, verdict.examples.lock().unwrap());
        assert!(compared >= layer.valid_samples * u64::from(layer.forest.levels()), "{compared}");
        // Law 2: any cut, with anything missing.
        let [low, high] = [layer.position([0, 0]), layer.position(layer.samples)];
        let mut shared = 0;
        for _ in 0..20 {
            let place = |axis: usize, part: f64| low[axis] + (high[axis] - low[axis]) * part;
            let eye = DVec3::new(place(0, dice.roll()), place(1, dice.roll()), 20_000.0);
            let camera = Camera { eye, target: eye - DVec3::Z, fov_y: 2.7, size: [1380, 768] };
            let ask = Ask {
                layer: &layer,
                encoding: Encoding::Points,
                camera: &camera,
                exaggeration: 1.0,
                tolerance_pixels: 0.002 * 100f64.powf(dice.roll()),
                sight: Sight::default(),
                seen: None,
                memory_bytes: usize::MAX,
                gpu: None,
            };
            let ideal = cut::choose(&ask, |d| Some(entries[&d]));
            let missing: HashSet<Diamond> =
                ideal.splits().filter(|d| d.level() > 0 && dice.roll() > 0.8).collect();
            let there = |d: Diamond| surfaces.get(&d).filter(|_| !missing.contains(&d)).cloned();
            let drawing = cut::draw(usize::from(number), &ask, &ideal, there);
            shared += assert_no_cracks(&layer, &drawing.items, false);
        }
        assert!(shared > 100, "{}: {shared} shared edges", layer.name);
    }
}

fn source_samples(source: &Source) -> u64 {
    u64::from(source.grid().width) * u64::from(source.grid().height)
}

#[test]
fn threads_memory_and_kills_change_no_byte_of_any_layer() {
    let pair = Pair::new(800);
    let options = "--encoding points,tin --checkpoint 0";
    let began = Instant::now();
    let (whole, _) = pair.build("whole", &format!("{options} --threads 1"));
    let took = began.elapsed();
    let reference = finished(&whole);
    let (other, _) = pair.build("other", &format!("{options} --threads 3 --memory 400MiB"));
    assert!(reference == finished(&other), "other threads and memory, other bytes");
    // Killed while the second layer's triangles are made: the first is complete by then.
    let command = words(pair.folder(), &Pair::command("store", options));
    let second = pair.folder().join("store/.building/layer-1");
    let is_at_sea = || {
        let names = std::fs::read_dir(&second).into_iter().flatten().flatten().map(|entry| entry.file_name());
        names.into_iter().any(|name| name.to_string_lossy().starts_with("tin-"))
    };
    let child = start(&programs().server, &command);
    let began = Instant::now();
    while !is_at_sea() {
        assert!(began.elapsed() < PATIENCE, "it never comes to the second layer");
        std::thread::sleep(Duration::from_millis(1));
    }
    signal(&child, "KILL");
    assert_eq!(end(child).code, None, "killed too late");
    let ended = end(start(&programs().server, &command));
    assert!(ended.code == Some(0) && ended.err.contains("resuming: "), "{ended:?}");
    assert!(reference == finished(&pair.folder().join("store")), "killed in the second layer, other bytes");
    std::fs::remove_dir_all(pair.folder().join("store")).unwrap();
    // Killed again and again until it ends.
    let mut dice = Dice(7);
    let (mut kills, mut resumed) = (0, 0);
    loop {
        let child = start(&programs().server, &command);
        // Longer from kill to kill, so that the loop ends on any machine.
        std::thread::sleep(took.mul_f64((0.3 + 0.05 * f64::from(kills)) * dice.roll()));
        let _ = Command::new("kill").args(["-KILL", &child.id().to_string()]).status();
        let ended = end(child);
        resumed += u32::from(ended.err.contains("resuming: "));
        assert!(!ended.err.contains("anew"), "{ended:?}");
        if ended.code == Some(0) {
            break;
        }
        kills += 1;
        assert!(kills < 200, "it never ends: {ended:?}");
    }
    assert!(kills >= 3 && resumed >= 2, "killed {kills} times, resumed {resumed} times");
    assert!(reference == finished(&pair.folder().join("store")), "killed {kills} times, other bytes");
}

#[test]
fn each_layer_is_served_inspected_and_mended_by_its_name() {
    let pair = Pair::new(300);
    let (path, _) = pair.build("store", "--encoding points,tin --json");
    let store = Store::open(&path).unwrap();
    let served = serve(std::slice::from_ref(&path));
    let scene = store.scene();
    let sources = pair.sources();
    block(async {
        for (number, layer) in (0u8..).zip(&scene.layers) {
            let (version, name) = (scene.version.as_str(), layer.name.as_str());
            let blob =
                |kind, [a, b]: [u32; 2]| store.get(Key { layer: number, kind, a, b }).unwrap().unwrap();
            let root = layer.forest.root_diamonds().next().unwrap().centre();
            for (route, kind, at) in [
                (message::index_route("world", version, name, 0), BlobKind::Index, [0, 0]),
                (message::tin_index_route("world", version, name, 0), BlobKind::TinIndex, [0, 0]),
                (message::points_route("world", version, name, root), BlobKind::Points, root),
                (message::tin_route("world", version, name, root), BlobKind::Tin, root),
            ] {
                let answer = get(&format!("{}{route}", served.address)).await;
                assert!(answer.status == 200 && answer.body == blob(kind, at), "{route}");
            }
            for route in [
                message::batch_route("world", version, name, &[root]),
                message::tin_batch_route("world", version, name, &[root]),
                message::stream_route("world", version, name, &StreamAsk::default()),
            ] {
                let answer = get(&format!("{}{route}", served.address)).await;
                let kind = if route.contains("/tin?") { BlobKind::Tin } else { BlobKind::Points };
                let payload = blob(kind, root);
                let is_there = answer.body.windows(payload.len()).any(|part| part == payload);
                assert!(answer.status == 200 && is_there, "{route}");
            }
            let samples = Samples::read(&sources[usize::from(number)]);
            let mut dice = Dice(3);
            for _ in 0..20 {
                let at = layer.samples.map(|side| dice.below(side.into()) as u32);
                let [x, y] = layer.position(at);
                let url = format!("{}/scenes/world/{name}/height?x={x}&y={y}", served.address);
                let answer: HeightAnswer = serde_json::from_slice(&get(&url).await.body).unwrap();
                let truth = samples.at(at[0].into(), at[1].into());
                assert_eq!(answer.nodata, truth.is_nan(), "{name} at {at:?}");
                let apart = answer.height.map_or(0.0, |height| (height - truth).abs());
                assert!(apart <= answer.error + 1e-9 && answer.error <= 0.1, "{name} at {at:?}: {answer:?}");
            }
        }
    });
    let ended = server(pair.folder(), "inspect {}/store --verify --json");
    let found: serde_json::Value = serde_json::from_str(&ended.out).unwrap();
    assert_eq!((&found["verified"], &found["layers"][1]["name"]), (&true.into(), &"sea".into()));
    let text = server(pair.folder(), "inspect {}/store").out;
    assert!(text.contains("layer terrain: terrain, ") && text.contains("layer sea: water, "), "{text}");
    let curve = server(pair.folder(), "inspect {}/store --curve -").out;
    assert!(["\nterrain,", "\nsea,"].iter().all(|layer| curve.matches(layer).count() > 2), "{curve}");
    // A dry run knows both, and is not far off.
    let dry = server(pair.folder(), &Pair::command("none", "--dry-run --json"));
    let estimate: serde_json::Value = serde_json::from_str(&dry.out).unwrap();
    for (layer, about) in scene.layers.iter().zip(estimate["layers"].as_array().unwrap()) {
        assert_eq!(about["name"], layer.name.as_str());
        let ratio = about["valid_samples"].as_f64().unwrap() / layer.valid_samples as f64;
        assert!((0.8..1.25).contains(&ratio), "{about}");
    }
    let sum = |field: &str| {
        estimate["layers"].as_array().unwrap().iter().map(|l| l[field].as_f64().unwrap()).sum::<f64>()
    };
    for field in ["samples", "diamonds", "point_bytes", "disk_bytes"] {
        assert!((estimate[field].as_f64().unwrap() - sum(field)).abs() < 0.5, "{field}: {estimate}");
    }
    let words = server(pair.folder(), &Pair::command("none", "--dry-run")).out;
    assert!(words.contains("layer sea: ") && words.contains("all layers"), "{words}");
    // A copy mends what is damaged of the sea.
    assert!(
        Command::new("cp").arg("-r").arg(&path).arg(pair.folder().join("copy")).status().unwrap().success()
    );
    let root = scene.layers[1].forest.root_diamonds().next().unwrap().centre();
    let key = Key { layer: 1, kind: BlobKind::Points, a: root[0], b: root[1] };
    let payload = store.get(key).unwrap().unwrap();
    let pack = path.join(&scene.version).join("pack-00000");
    let mut bytes = std::fs::read(&pack).unwrap();
    let at = bytes.windows(payload.len()).position(|part| part == payload).unwrap();
    bytes[at + payload.len() / 2] ^= 1;
    std::fs::write(&pack, bytes).unwrap();
    let told = server(pair.folder(), "repair {}/store");
    assert!(told.code == Some(1) && told.out.contains("layer: 1"), "{told:?}");
    let mended = server(pair.folder(), "repair {}/store --from {}/copy");
    assert!(mended.code == Some(0) && mended.out.contains("1 mended"), "{mended:?}");
    assert_eq!(server(pair.folder(), "inspect {}/store --verify").code, Some(0));
}

#[test]
fn a_picture_shows_the_layers_that_are_asked_for_and_no_others() {
    let pair = Pair::new(400);
    let (both, _) = pair.build("both", "");
    let alone = server(pair.folder(), "build {}/dem.tif -o {}/alone --scene alone");
    assert_eq!(alone.code, Some(0), "{alone:?}");
    let served = serve(&[both, pair.folder().join("alone")]);
    let render = |scene: &str, name: &str, options: &str| {
        let url = served.scene(scene);
        let command = format!("render {url} -o {{}}/{name}.png --size 400x250 --no-antialias {options}");
        let ended = client(pair.folder(), &command);
        (ended, pair.folder().join(format!("{name}.png")))
    };
    // All from one place: an overview depends on what has arrived when it is chosen.
    let [x, y] = sample::place(0.5, 0.1, 400);
    let view = format!("--eye {x},{},6000 --target {x},{},0 --background ff00ff", y - 4000.0, y + 1000.0);
    let drawn = |scene: &str, options: &str| {
        let (ended, path) = render(scene, "picture", &format!("{view} {options}"));
        assert_eq!(ended.code, Some(0), "{ended:?}");
        pixels(&path)
    };
    let all = drawn("world", "");
    let [ground, sea] = ["terrain", "sea"].map(|layer| drawn("world", &format!("--layer {layer}")));
    assert!(all == drawn("world", "--layer sea,terrain"), "all layers by name are all layers");
    assert!(ground == drawn("alone", ""), "without the sea it is the scene without a sea");
    assert!(all != ground && all != sea && ground != sea);
    let is_empty = |p: &[u8]| p == [255, 0, 255, 255];
    let (mut of_sea, mut of_ground) = (0, 0);
    for ((all, ground), sea) in all.chunks(4).zip(ground.chunks(4)).zip(sea.chunks(4)) {
        assert!(!is_empty(sea) || all == ground, "where there is no sea, it changes nothing");
        assert!(is_empty(ground) || !is_empty(all), "no layer makes a hole in another");
        of_sea += usize::from(all != ground);
        // Ground that stands above the sea hides it.
        of_ground += usize::from(all == ground && !is_empty(sea));
    }
    assert!(of_sea > 2000 && of_ground > 200, "{of_sea} pixels of sea, {of_ground} of ground before it");
    let (refused, _) = render("world", "none", "--layer lava");
    assert_failed(&refused, 2, &["'lava'", "terrain, sea"], "an unknown layer");
    // Others that look at layers.
    let url = served.scene("world");
    let examined = client(pair.folder(), &format!("doctor {url}"));
    assert_eq!(examined.code, Some(0), "{examined:?}");
    for (layers, code) in [("sea", 0), ("sea,lava", 2)] {
        let few = "--users 2 --seconds 1 --arrival 0 --think 0.2 --size 160x90";
        let loaded = client(pair.folder(), &format!("load {url} {few} --layer {layers}"));
        assert_eq!(loaded.code, Some(code), "{loaded:?}");
    }
    let flown = client(pair.folder(), &format!("fly {url} --frames 3 --size 160x90 --settle 30 --layer sea"));
    assert_eq!(flown.code, Some(0), "{flown:?}");
}

/// The pixels of a PNG.
pub(crate) fn pixels(path: &Path) -> Vec<u8> {
    let mut reader =
        png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path).unwrap())).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut pixels).unwrap();
    pixels
}

#[test]
fn over_magenta_no_pixel_is_magenta_while_two_layers_come_late_and_out_of_order() {
    let folder = tempfile::tempdir().unwrap();
    let (dem, water) = (folder.path().join("dem.raw"), folder.path().join("water.raw"));
    let part = |v: u32| f64::from(v) / 1024.0;
    let ingest = write_raw(&dem, [1025; 2], |x, y| Some(sample::height(part(x), part(y)).unwrap_or(0.0)));
    write_raw(&water, [1025; 2], |x, y| Some((f64::from(x) / 9.0).sin().mul_add(20.0, f64::from(y)) as f32));
    let ground = ingest::open(&[dem], &ingest).unwrap();
    let surface = ingest::open_over(&[water], &ingest, &ground).unwrap();
    let layers =
        [LayerSource::terrain(&ground), LayerSource { name: "water", kind: Kind::Water, source: &surface }];
    let store = folder.path().join("store");
    let options = hierarchy::Options::new("world");
    let report = hierarchy::build_layers(&layers, &store, &options, &Progress::hidden()).unwrap();
    assert_eq!(report.layers.iter().map(|l| l.point_bytes).sum::<u64>(), report.point_bytes);
    let served = serve(&[store]);
    let world = World { folder, report, served };
    let faults = Faults { delay: Duration::from_millis(250), cut: 0.95, ..Faults::default() };
    let (unfinished, _) = fly_over_magenta(&world, faults, 4, Encoding::Points);
    assert!(unfinished > 30, "the network was too fast: {unfinished} unfinished frames");
}

#[test]
fn a_zone_hides_ground_and_no_water() {
    let pair = Pair::new(400);
    let (store, _) = pair.build("store", "");
    // A bay in the south, where the sea is.
    let corners = [[0.42, 0.14], [0.46, 0.14], [0.46, 0.18], [0.42, 0.18], [0.42, 0.14]];
    let corners = corners.map(|[x, y]| sample::place(x, y, 400)).map(|[x, y]| format!("[{x},{y}]"));
    let text = format!(r#"{{"type":"Polygon","coordinates":[[{}]]}}"#, corners.join(","));
    std::fs::write(pair.folder().join("bay.geojson"), text).unwrap();
    let zone = "zone {}/store --name bay --polygon {}/bay.geojson --coordinates frame --eye 3 --level 0";
    let ended = server(pair.folder(), zone);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let store = Store::open(&store).unwrap();
    let masks = inspect::masks(&store, 0).unwrap();
    let hidden = masks.iter().map(|mask| mask.tally(mask.levels() - 1)[1]).collect::<Vec<_>>();
    assert!(hidden[0] > 0, "mountains hide what is behind them: {hidden:?}");
    let water = &store.scene().layers[1];
    let entries = inspect::entries(&store, 1, water).unwrap();
    let seen = entries.iter().filter(|(_, e)| !e.is_empty()).all(|(d, _)| masks[1].get(*d) == u8::MAX);
    assert!(seen, "water is seen through");
    assert_eq!(server(pair.folder(), "inspect {}/store --verify").code, Some(0));
}

#[test]
fn a_layer_in_degrees_is_laid_into_the_frame_of_the_first() {
    let pair = Pair::new(300);
    let folder = pair.folder();
    let [x, y] = sample::place(0.5, 0.5, 300);
    let utm = Projection::new(projection::epsg(EPSG).unwrap()).unwrap();
    let (lon, lat) = utm.inverse(x, y).unwrap();
    let cell = 0.0005;
    let (west, south) = (lon - 100.0 * cell, lat - 80.0 * cell);
    let plane = |lon: f64, lat: f64| 200.0 + 900.0 * (lon - west) + 1500.0 * (lat - south);
    write_asc(&folder.join("lake.asc"), [200, 160], [west, south], cell, |i, j| {
        Some(plane(west + f64::from(i) * cell, south + f64::from(j) * cell))
    });
    let build =
        "build {}/dem.tif -o {}/store --scene world --layer lake=water:{}/lake.asc --assume-crs EPSG:4326";
    let ended = server(folder, build);
    assert!(ended.code == Some(0) && !ended.err.contains("notice"), "{ended:?}");
    let scene = Store::open(&folder.join("store")).unwrap().scene().clone();
    assert_eq!([scene.layers[0].resampled, scene.layers[1].resampled], [false, true]);
    let served = serve(&[folder.join("store")]);
    block(async {
        for (east, north) in [(0.0, 0.0), (0.02, 0.01), (-0.03, -0.02), (0.04, -0.03)] {
            let (lon, lat) = (lon + east, lat + north);
            let url = format!("{}/scenes/world/lake/height?lon={lon}&lat={lat}", served.address);
            let answer: HeightAnswer = serde_json::from_slice(&get(&url).await.body).unwrap();
            let apart = (answer.height.unwrap() - plane(lon, lat)).abs();
            assert!(apart < 0.05, "{apart} m at {lon}, {lat}: {answer:?}");
        }
    });
    // All to a system that is neither's own: both are resampled.
    let ended = server(folder, &format!("{} --crs EPSG:31983", build.replace("store", "sirgas")));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let scene = Store::open(&folder.join("sirgas")).unwrap().scene().clone();
    assert_eq!(scene.frame.crs.unwrap().name, "EPSG:31983");
    // Layers of one system of degrees keep their samples, and the frame its metres.
    let kept = "build --layer ground=terrain:{}/lake.asc --layer lake=water:{}/part.asc -o {}/kept --crs source \
                --assume-crs EPSG:4326";
    write_asc(&folder.join("part.asc"), [50, 40], [west + 30.0 * cell, south + 20.0 * cell], cell, |i, _| {
        Some(f64::from(i))
    });
    let ended = server(folder, kept);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let scene = Store::open(&folder.join("kept")).unwrap().scene().clone();
    let [ground, part] = [&scene.layers[0], &scene.layers[1]];
    assert!(!ground.resampled && !part.resampled && ground.name == "ground");
    for axis in 0..2 {
        let expected = ground.position([30, 20])[axis];
        assert!(
            (part.origin[axis] - expected).abs() < 1e-3 * ground.cell[axis],
            "{expected} {:?}",
            part.origin
        );
        assert!((part.cell[axis] / ground.cell[axis] - 1.0).abs() < 1e-9);
    }
}

#[test]
fn a_level_is_flat_water_over_the_ground() {
    let pair = Pair::new(300);
    let folder = pair.folder();
    let build = "build --layer sea=water:level=-0.25 --layer land=terrain:{}/dem.tif --layer tarn=water:level=1200 \
                 -o {}/store --scene world --encoding points,tin";
    let ended = server(folder, build);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let store = Store::open(&folder.join("store")).unwrap();
    let layers = &store.scene().layers;
    assert_eq!(layers.iter().map(|l| l.name.as_str()).collect::<Vec<_>>(), ["sea", "land", "tarn"]);
    let land = &layers[1];
    for (water, level) in [(&layers[0], -0.25), (&layers[2], 1200.0)] {
        assert_eq!((water.kind, water.heights, water.finest_error), (Kind::Water, [level; 2], 0.0));
        let [far, land_far] = [water, land].map(|layer| layer.position(layer.samples.map(|s| s - 1)));
        assert_eq!(water.origin, land.origin);
        for axis in 0..2 {
            assert!((far[axis] - land_far[axis]).abs() < 1e-6, "{far:?} {land_far:?}");
        }
        assert!(water.bytes < 4096, "{} bytes", water.bytes);
    }
    assert_eq!(server(folder, "inspect {}/store --verify").code, Some(0));
    let served = serve(&[folder.join("store")]);
    block(async {
        let [x, y] = sample::place(0.9, 0.1, 300);
        let url = format!("{}/scenes/world/tarn/height?x={x}&y={y}", served.address);
        let answer = get(&url).await.json();
        assert_eq!(answer["height"], 1200.0, "{answer}");
    });
    for encoding in ["points", "tin"] {
        let url = served.scene("world");
        let drawn = client(
            folder,
            &format!("render {url} -o {{}}/{encoding}.png --size 200x120 --encoding {encoding}"),
        );
        assert_eq!(drawn.code, Some(0), "{drawn:?}");
    }
}

#[test]
fn layers_that_make_no_scene_are_refused_with_what_to_do() {
    let pair = Pair::new(300);
    let folder = pair.folder();
    let [x, y] = sample::place(0.5, 0.5, 300);
    write_asc(&folder.join("dry.asc"), [40, 40], [x, y], 30.0, |_, _| None);
    write_asc(&folder.join("far.asc"), [40, 40], [x + 1e6, y], 30.0, |_, _| Some(1.0));
    write_asc(&folder.join("degrees.asc"), [40, 40], [-43.5, -18.5], 0.001, |_, _| Some(1.0));
    let utm = format!("--assume-crs EPSG:{EPSG}");
    let sea = "--layer sea=water:{}/sea.asc";
    for (args, code, expected) in [
        ("{}/dem.tif --layer sea", 2, &["NAME=KIND:PATH"][..]),
        ("{}/dem.tif --layer sea=texture:{}/sea.asc", 1, &["sea.asc", "GeoTIFF, PNG or JPEG"]),
        ("{}/dem.tif --layer Sea=water:{}/sea.asc", 2, &["small letters", "'Sea'"]),
        ("{}/dem.tif --layer terrain=water:{}/sea.asc", 2, &["'terrain' is terrain", "another name"]),
        ("{}/dem.tif --layer sea=water:{}/sea.asc --layer sea=water:level=0", 2, &["'sea'", "level"]),
        (sea, 2, &["found water alone"]),
        ("", 2, &["DEM"]),
        ("{}/dem.tif --layer sea=water:{}/none.asc", 1, &["none.asc"]),
        // One CRS is known, the other is not.
        (&format!("{{}}/dem.tif {sea}"), 2, &["sea.asc", "dem.tif", "EPSG:32723", "--assume-crs"]),
        (
            "{}/sea.asc --layer more=terrain:{}/dem.tif",
            2,
            &["dem.tif", "sea.asc", "has none", "--assume-crs"],
        ),
        // Degrees are kept, so nothing else fits.
        (
            "{}/degrees.asc --assume-crs EPSG:4326 --crs source --layer more=terrain:{}/dem.tif",
            2,
            &["dem.tif", "degrees.asc", "leave --crs source out"],
        ),
        (
            &format!("{{}}/dem.tif --layer dry=water:{{}}/dry.asc {utm}"),
            1,
            &["dry.asc", "layer 'dry'", "all 1600 samples are nodata"],
        ),
        (&format!("{{}}/dem.tif {sea} {utm} --memory 64MiB"), 2, &["--memory 64MiB", "say --memory"]),
        (&format!("{{}}/dem.tif {sea} {utm} --max-error -1"), 2, &["--max-error -1"]),
    ] {
        let ended = server(folder, &format!("build {args} -o {{}}/store"));
        assert_failed(&ended, code, expected, args);
        assert!(!folder.join("store/scene.json").exists(), "{args}");
    }
    // What the message asks for is enough for both layers, and a unit less is not.
    let both = format!("build {{}}/dem.tif {sea} {utm} -o {{}}/store --memory");
    let ended = server(folder, &format!("{both} 64MiB"));
    let needed = ended.err.rsplit_once("--memory ").unwrap().1.split(' ').next().unwrap();
    let mebibytes: u64 = needed.strip_suffix("MiB").unwrap().parse().unwrap();
    assert_eq!(server(folder, &format!("{both} {}MiB", mebibytes - 1)).code, Some(2));
    assert_eq!(server(folder, &format!("{both} {mebibytes}MiB")).code, Some(0));
    // Far from each other they are built, but it is said.
    let far = server(folder, &format!("build {{}}/dem.tif --layer far=water:{{}}/far.asc {utm} -o {{}}/far"));
    assert!(far.code == Some(0) && far.err.contains("'far' does not touch"), "{far:?}");
}

//! Zones from end to end: a lake in mountains is built, its zone computed, stored, served, and drawn from within.

use crate::world::{Dice, Served, build, options, programs, serve, write_raw};
use diamantina_client::camera::{Camera, FOV_Y};
use diamantina_client::headless;
use diamantina_client::picture::Picture;
use diamantina_client::render::{self, Background, Look};
use diamantina_client::terrain::{self, Terrain, TerrainError};
use diamantina_protocol::message::Scene;
use diamantina_protocol::zone;
use diamantina_server::store::Store;
use diamantina_server::{hierarchy, inspect, sample};
use glam::DVec3;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;
use tempfile::TempDir;

/// Samples along each side.
const SAMPLES: u32 = 1025;

/// The middle of the lake in samples, its radius, and how far its shores are levelled.
const LAKE: ([f64; 2], f64, f64) = ([560.0, 640.0], 60.0, 50.0);

/// The lake's surface, in metres.
const LEVEL: f64 = 400.0;

/// The made landscape with a lake in it, and a wall of mountains around the lake: steep, as around a fjord.
fn ground(x: u32, y: u32) -> f64 {
    let last = f64::from(SAMPLES - 1);
    let land = f64::from(sample::height(f64::from(x) / last, f64::from(y) / last).unwrap_or(0.0));
    let ([cx, cy], radius, shore) = LAKE;
    let away = (f64::from(x) - cx).hypot(f64::from(y) - cy);
    let t = ((away - radius) / shore).clamp(0.0, 1.0);
    let wall = (1.0 - ((away - radius - 0.8 * shore) / (0.7 * shore)).powi(2)).max(0.0);
    (LEVEL + (land - LEVEL) * t * t * (3.0 - 2.0 * t) + 900.0 * wall * t).round()
}

/// The landscape with its store, and the lake's outline.
struct Lake {
    folder: TempDir,
    store: PathBuf,
    polygon: PathBuf,
    scene: Scene,
}

impl Lake {
    fn build() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let (dem, store) = (folder.path().join("dem.raw"), folder.path().join("store"));
        let ingest = write_raw(&dem, [SAMPLES; 2], |x, y| Some(ground(x, y) as f32));
        // Small patches, so that a diamond is seen as a whole or not at all more often.
        let options = hierarchy::Options { patch_log2: 5, ..options() };
        let scene = build(&dem, &store, &ingest, &options).scene;
        let lake = Self { polygon: folder.path().join("lake.geojson"), folder, store, scene };
        // A little within the lake, so that the contour runs over water.
        let corners: Vec<String> = (0..=48)
            .map(|i| {
                let angle = f64::from(i % 48) / 48.0 * std::f64::consts::TAU;
                let [x, y] = lake.place((LAKE.1 - 2.0) * angle.cos(), (LAKE.1 - 2.0) * angle.sin());
                format!("[{x},{y}]")
            })
            .collect();
        let text = format!(r#"{{"type":"Polygon","coordinates":[[{}]]}}"#, corners.join(","));
        std::fs::write(&lake.polygon, text).unwrap();
        lake
    }

    /// A place in the frame, in samples from the middle of the lake.
    fn place(&self, east: f64, north: f64) -> [f64; 2] {
        let layer = &self.scene.layers[0];
        let at = [LAKE.0[0] + east, LAKE.0[1] + north];
        [0, 1].map(|k| layer.origin[k] + layer.cell[k] * at[k])
    }

    /// Runs `diamantina-server zone` on the store.
    fn zone(&self, args: &[&str]) -> Output {
        Command::new(&programs().server).arg("zone").arg(&self.store).args(args).output().unwrap()
    }

    /// Computes the lake's zone; the report.
    fn compute(&self) -> serde_json::Value {
        let polygon = self.polygon.to_str().unwrap();
        let output =
            self.zone(&["--name", "lake", "--polygon", polygon, "--eye", "3", "--spacing", "240", "--json"]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(&output.stdout).unwrap()
    }

    fn camera(&self, [east, north]: [f64; 2], height: f64, azimuth: f64) -> Camera {
        let [x, y] = self.place(east, north);
        let eye = DVec3::new(x, y, LEVEL + height);
        // A little upwards, where the mountains are.
        let target = eye + DVec3::new(azimuth.cos(), azimuth.sin(), 0.12) * 1000.0;
        Camera { eye, target, fov_y: FOV_Y, size: [1380, 768] }
    }

    /// Eyes all over the lake, looking all around.
    fn views(&self) -> Vec<Camera> {
        let mut dice = Dice(5);
        let around = (0..8).map(|i| {
            let angle = f64::from(i) * 0.9;
            let away = LAKE.1 * 0.9 * dice.roll();
            self.camera(
                [away * angle.cos(), away * angle.sin()],
                2.9 * dice.roll() + 0.05,
                f64::from(i) * 1.7,
            )
        });
        around.collect()
    }
}

fn open(served: &Served, zone: Option<&str>) -> Result<Terrain, TerrainError> {
    let options = terrain::Options { zone: zone.map(str::to_owned), ..terrain::Options::default() };
    Terrain::open(&served.scene("world"), options)
}

/// A picture over magenta, one sample a pixel.
fn draw(terrain: &mut Terrain, camera: &Camera) -> Picture {
    let look = Look { background: Background::Colour([1.0, 0.0, 1.0, 1.0]), ..Look::default() };
    let sharp = render::Options { samples: 1, ..render::Options::default() };
    let (picture, report) =
        headless::picture(terrain, camera, &look, &sharp, Duration::from_secs(60)).unwrap();
    assert!(report.complete);
    picture
}

/// The row of the highest pixel of terrain in each column. No magenta may be below it: neither cracks nor holes.
fn silhouette(picture: &Picture) -> Vec<u32> {
    let is_sky = |x, y| picture.pixel([x, y]) == Some([255, 0, 255, 255]);
    let [width, height] = picture.size;
    let column = |x| {
        let top = (0..height).find(|y| !is_sky(x, *y)).unwrap_or(height);
        assert!((top..height).all(|y| !is_sky(x, y)), "a hole in column {x}");
        top
    };
    (0..width).map(column).collect()
}

#[test]
fn a_flight_inside_a_zone_costs_less_and_looks_the_same() {
    let lake = Lake::build();
    let report = lake.compute();
    println!("{report}");
    let served = serve(std::slice::from_ref(&lake.store));
    let (mut plain, mut zoned) = (open(&served, None).unwrap(), open(&served, Some("lake")).unwrap());
    let mut bytes = [0; 2];
    for (i, camera) in lake.views().iter().enumerate() {
        let views =
            [plain.settle(camera, Duration::from_secs(60)), zoned.settle(camera, Duration::from_secs(60))];
        assert!(views.iter().all(|view| view.complete && view.error_pixels <= 1.0));
        assert_eq!(views.each_ref().map(|view| view.stats.zone_in_effect), [false, true], "eye {i}");
        bytes = views.map(|view| view.stats.traffic.bytes);
        if i % 3 == 0 {
            let skylines = [&mut plain, &mut zoned].map(|terrain| silhouette(&draw(terrain, camera)));
            let apart = skylines[0].iter().zip(&skylines[1]).map(|(a, b)| a.abs_diff(*b));
            let (worst, differ) = (apart.clone().max().unwrap(), apart.filter(|d| *d > 0).count());
            println!("view {i}: skylines differ in {differ} of 1380 columns, by {worst} pixels at most");
            // The same, but for pixels of which one is drawn and one is not.
            assert!(worst <= 1 && differ < 1380 / 10, "view {i}: {differ} columns, {worst} pixels");
        }
    }
    println!("{} bytes without the zone, {} with it", bytes[0], bytes[1]);
    assert!(bytes[1] * 10 <= bytes[0] * 6, "{bytes:?}: less than 40 % saved");
    // Above the zone all is as if there were none.
    let above = lake.camera([0.0, 0.0], 900.0, 1.0);
    let views = [&mut plain, &mut zoned].map(|terrain| terrain.settle(&above, Duration::from_secs(60)));
    assert!(views.iter().all(|view| view.complete && !view.stats.zone_in_effect));
    let drawn = views.each_ref().map(|view| {
        let mut items: Vec<_> = view.items.iter().map(|item| (item.diamond, item.sides)).collect();
        items.sort_unstable();
        items
    });
    assert!(drawn[0] == drawn[1], "another cut above the zone");
}

#[test]
fn a_zone_is_published_listed_served_and_gone_again() {
    let lake = Lake::build();
    let before = Store::open(&lake.store).unwrap().scene().clone();
    let report = lake.compute();
    let store = Store::open(&lake.store).unwrap();
    let scene = store.scene().clone();
    assert_eq!(report["version"], scene.version.as_str());
    assert_eq!(report["version_before"], before.version.as_str());
    assert_ne!(scene.version, before.version, "what is under a version never changes");
    assert_eq!(Scene { zones: vec![], version: before.version.clone(), ..scene.clone() }, before);
    let lake_zone = &scene.zones[0];
    assert_eq!(
        (lake_zone.name.as_str(), lake_zone.eye, lake_zone.parts[0].ceiling),
        ("lake", 3.0, LEVEL + 3.0)
    );
    // Levels past the finest lattice, too, are told.
    let masks = inspect::masks(&store, 0).unwrap();
    assert_eq!(masks[0].levels(), scene.layers[0].forest.levels());
    // All of it has data; so what is counted is what the mask says.
    let number = |name: &str| report[name].as_u64().unwrap();
    assert_eq!(number("samples"), scene.layers[0].valid_samples);
    assert!(number("samples_seen") > 0 && number("samples_hidden") > 0);
    assert!(number("samples_seen") + number("samples_hidden") <= number("samples"));
    let finest = masks[0].tally(masks[0].levels() - 1);
    assert_eq!([number("diamonds"), number("diamonds_hidden")], finest);
    assert!(inspect::inspect(&store, true).is_ok());
    let inspected = Command::new(&programs().server).arg("inspect").arg(&lake.store).output().unwrap();
    let text = String::from_utf8(inspected.stdout).unwrap();
    assert!(text.contains("zone lake: eye 3 m, up to 403.000 m"), "{text}");
    served_zone(&lake, &scene);
    // The same again is the same to the byte; another height is not.
    let polygon = lake.polygon.to_str().unwrap();
    let again = ["--name", "lake", "--polygon", polygon, "--spacing", "240", "--replace", "--eye"];
    assert!(lake.zone(&[&again[..], &["3"]].concat()).status.success());
    assert_eq!(Store::open(&lake.store).unwrap().scene(), &scene);
    assert!(lake.zone(&[&again[..], &["30", "--threads", "1"]].concat()).status.success());
    assert_ne!(Store::open(&lake.store).unwrap().scene().version, scene.version);
    let second = ["--name", "a", "--polygon", polygon, "--eye", "3", "--spacing", "900"];
    assert!(lake.zone(&second).status.success());
    let names: Vec<String> =
        Store::open(&lake.store).unwrap().scene().zones.iter().map(|z| z.name.clone()).collect();
    assert_eq!(names, ["a", "lake"]);
    for name in ["a", "lake"] {
        assert!(lake.zone(&["--name", name, "--remove"]).status.success());
    }
    assert_eq!(Store::open(&lake.store).unwrap().scene(), &before, "the first version is back");
    assert!(inspect::inspect(&Store::open(&lake.store).unwrap(), true).is_ok());
}

/// What the server and the client make of a store with the lake's zone.
fn served_zone(lake: &Lake, scene: &Scene) {
    let served = serve(std::slice::from_ref(&lake.store));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let get = |route: &str| {
        runtime.block_on(async {
            let answer = crate::world::asker()
                .build()
                .unwrap()
                .get(format!("{}{route}", served.address))
                .send()
                .await
                .unwrap();
            (answer.status().as_u16(), answer.headers().clone(), answer.bytes().await.unwrap())
        })
    };
    let (status, headers, body) =
        get(&diamantina_protocol::message::zone_route("world", &scene.version, "lake"));
    assert_eq!((status, body.len() as u64), (200, scene.zones[0].bytes));
    assert_eq!(headers["cache-control"], "public, max-age=31536000, immutable");
    let forests = [scene.layers[0].forest];
    let bytes = zstd::bulk::decompress(&body, zone::bytes_max(&forests)).unwrap();
    assert!(zone::decode(&forests, &bytes).is_ok());
    assert_eq!(get(&diamantina_protocol::message::zone_route("world", &scene.version, "road")).0, 404);
    assert_eq!(get(&diamantina_protocol::message::zone_route("world", "0123456789abcdef", "lake")).0, 410);
    let (_, _, body) = get("/scenes/world");
    assert_eq!(&serde_json::from_slice::<Scene>(&body).unwrap(), scene);
    let client = |args: &[&str]| {
        let png = lake.folder.path().join("out.png");
        let mut command = Command::new(&programs().client);
        command.args(["render", &served.scene("world"), "--size", "320x180", "-o"]).arg(png).args(args);
        command.output().unwrap()
    };
    let camera = lake.camera([0.0, 0.0], 2.0, 0.5);
    let point = |p: DVec3| format!("{},{},{}", p.x, p.y, p.z);
    let (eye, target) = (point(camera.eye), point(camera.target));
    let view = ["--eye", &eye, "--target", &target, "--json", "-"];
    for (zone, in_effect) in [(None, false), (Some("lake"), true)] {
        let zone_args = zone.map(|name| ["--zone", name]);
        let output =
            client(&[&view[..], zone_args.iter().flatten().copied().collect::<Vec<_>>().as_slice()].concat());
        let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!((&report["zone"], &report["zone_in_effect"]), (&zone.into(), &in_effect.into()));
    }
    let unknown = client(&["--zone", "road"]);
    let words = String::from_utf8(unknown.stderr).unwrap();
    assert_eq!(unknown.status.code(), Some(2));
    assert!(words.contains("no zone 'road'") && words.contains("it has lake"), "{words}");
}

#[test]
fn what_is_no_zone_is_refused_with_the_remedy() {
    let lake = Lake::build();
    let version = Store::open(&lake.store).unwrap().scene().version.clone();
    let polygon = lake.polygon.to_str().unwrap();
    let write = |name: &str, text: &str| {
        let path = lake.folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let square = |x: f64, w: f64| {
        format!(
            r#"{{"type":"Polygon","coordinates":[[[{x},0],[{0},0],[{0},{w}],[{x},{w}],[{x},0]]]}}"#,
            x + w
        )
    };
    let outside = write("outside.geojson", &square(-500.0, 100.0));
    let line = write("line.geojson", r#"{"type":"LineString","coordinates":[[0,0],[9,9]]}"#);
    let good = ["--name", "lake", "--eye", "3", "--polygon", polygon];
    for (args, code, words) in [
        (vec!["--name", "a/b", "--eye", "3", "--polygon", polygon], 2, "--name 'a/b'"),
        (vec!["--name", "lake", "--eye", "0", "--polygon", polygon], 2, "--eye 0: expected metres"),
        (vec!["--name", "lake", "--eye", "-3", "--polygon", polygon], 2, "--eye -3"),
        ([&good[..], &["--hidden", "1"]].concat(), 2, "--hidden 1"),
        ([&good[..], &["--spacing", "0.0001"]].concat(), 2, "choose a larger --spacing"),
        ([&good[..], &["--memory", "1MiB"]].concat(), 2, "--memory allows 1048576"),
        ([&good[..], &["--coordinates", "lonlat"]].concat(), 1, "no longitude and latitude"),
        (vec!["--name", "lake", "--eye", "3", "--polygon", &outside], 1, "expected a polygon within it"),
        (vec!["--name", "lake", "--eye", "3", "--polygon", &line], 1, "found a LineString"),
        (vec!["--name", "lake", "--eye", "3", "--polygon", "/nowhere"], 1, "/nowhere: cannot read"),
        (vec!["--name", "lake", "--remove"], 2, "it has none at all"),
        (vec!["--name", "lake"], 2, "--polygon"),
    ] {
        let output = lake.zone(&args);
        let text = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{args:?}: {text}");
        assert!(text.contains(words), "{args:?}: {text}");
    }
    assert_eq!(Store::open(&lake.store).unwrap().scene().version, version, "the store is as it was");
    assert!(!lake.store.join(".zoning").exists());
    assert!(lake.zone(&[&good[..], &["--spacing", "2000"]].concat()).status.success());
    let twice = lake.zone(&good);
    assert_eq!(twice.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&twice.stderr).contains("say --replace"));
    // A rebuild has no zones, and says so.
    let raw = format!("{SAMPLES}x{SAMPLES}:f32");
    let rebuilt = Command::new(&programs().server)
        .arg("build")
        .arg(lake.folder.path().join("dem.raw"))
        .args([
            "--raw",
            &raw,
            "--cell",
            "30",
            "--nodata",
            "-9999",
            "--patch-segments",
            "32",
            "--scene",
            "world",
            "-o",
        ])
        .arg(&lake.store)
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&rebuilt.stderr);
    assert!(
        rebuilt.status.success()
            && text.contains("zones of the scene before are gone")
            && text.contains("lake"),
        "{text}"
    );
    assert!(Store::open(&lake.store).unwrap().scene().zones.is_empty());
}

#[test]
fn a_zone_killed_at_any_instant_leaves_the_old_store_or_the_new_one() {
    let lake = Lake::build();
    let old = Store::open(&lake.store).unwrap().scene().version.clone();
    let polygon = lake.polygon.to_str().unwrap();
    let args = ["--name", "lake", "--polygon", polygon, "--eye", "3", "--spacing", "3000", "--replace"];
    let started = std::time::Instant::now();
    assert!(lake.zone(&args).status.success());
    let whole = started.elapsed();
    let new = Store::open(&lake.store).unwrap().scene().version.clone();
    assert!(lake.zone(&["--name", "lake", "--remove"]).status.success());
    let mut dice = Dice(17);
    let (mut killed, mut outcomes) = (0, std::collections::BTreeSet::new());
    for i in 0..24 {
        // Most of them near the end, where the store changes.
        let part = if i % 4 == 0 { dice.roll() } else { 0.85 + 0.3 * dice.roll() };
        let mut command = Command::new(&programs().server);
        let mut child = command.arg("zone").arg(&lake.store).args(args).spawn().unwrap();
        std::thread::sleep(whole.mul_f64(part));
        killed += u32::from(child.kill().is_ok() && !child.wait().unwrap().success());
        let store = Store::open(&lake.store).unwrap();
        let version = store.scene().version.clone();
        assert!(version == old || version == new, "neither version");
        // Payloads are not touched; they are looked at in the end.
        assert!(inspect::inspect(&store, false).is_ok(), "a broken store");
        for number in 0..store.scene().zones.len() {
            assert!(inspect::masks(&store, number).is_ok(), "a broken mask");
        }
        outcomes.insert(version.clone());
        if version == new {
            assert!(lake.zone(&["--name", "lake", "--remove"]).status.success());
        }
    }
    println!("{killed} killed, {} outcomes", outcomes.len());
    assert!(killed > 3);
    // What kills left behind is gone once something has been published.
    assert!(lake.zone(&args).status.success());
    assert!(!Path::new(&lake.store).join(".zoning").exists());
    let store = Store::open(&lake.store).unwrap();
    assert_eq!(store.scene().version, new);
    assert!(inspect::inspect(&store, true).is_ok(), "a broken store");
}

//! Streaming from end to end: pictures, bytes, and flights while data arrive late and out of order.

use crate::world::{Faults, Proxy, World, build, data, options, programs, serve};
use diamantina_client::camera::{Camera, FOV_Y};
use diamantina_client::encoding::Encoding;
use diamantina_client::headless::{self, Flight, FlightPath, PathKey, Play};
use diamantina_client::render::{self, Background, Look};
use diamantina_client::terrain::{self, Terrain};
use diamantina_server::{hierarchy, ingest};
use glam::DVec3;
use std::fmt::Write as _;
use std::io::Write as _;
use std::process::Command;
use std::sync::atomic::Ordering;
use std::time::Duration;

const MAGENTA: [u8; 4] = [255, 0, 255, 255];

/// One sample a pixel, so that a gap between triangles shows as magenta, not as a tint.
pub(crate) fn sharp() -> render::Options {
    render::Options { samples: 1, ..render::Options::default() }
}

pub(crate) fn over_magenta() -> Look {
    Look { background: Background::Colour([1.0, 0.0, 1.0, 1.0]), ..Look::default() }
}

#[test]
fn a_rendered_view_is_as_exact_as_asked_and_its_numbers_agree() {
    let world = World::sample(1025, 0.0);
    let (png, json) = (world.folder.path().join("out.png"), world.folder.path().join("out.json"));
    let output = Command::new(&programs().client)
        .args(["render", &world.served.scene("world"), "--size", "640x360", "--error-pixels", "2"])
        .arg("-o")
        .arg(&png)
        .arg("--json")
        .arg(&json)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(&json).unwrap()).unwrap();
    let number = |key: &str| report[key].as_f64().unwrap_or_else(|| panic!("{key} in {report}"));
    assert_eq!(report["complete"], true);
    assert_eq!(report["scene"], "world");
    assert_eq!(report["version"], world.report.scene.version.as_str());
    assert_eq!(number("asked_error_pixels"), 2.0);
    assert!(number("largest_error_pixels") <= 2.0 && number("largest_error_pixels") > 0.0);
    assert_eq!(number("real_points") + number("fictitious_points"), number("points_received"));
    assert!(number("round_trips") <= number("requests") && number("round_trips") >= 1.0);
    assert!(number("bytes") < (world.report.point_bytes + world.report.index_bytes) as f64 + 64e3);
    assert!(number("seconds_to_first_picture") <= number("seconds_to_asked_error"));
    assert!(number("triangles_drawn") > 10_000.0 && number("draws") >= 1.0);
    let picture = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(&png).unwrap()));
    let info = picture.read_info().unwrap();
    assert_eq!((info.info().width, info.info().height), (640, 360));
    // Half the error costs more.
    let mut terrain = world.served.open(1.0);
    let camera = headless::overview(terrain.scene(), [640, 360]);
    let view = terrain.settle(&camera, Duration::from_secs(60));
    assert!(view.complete && view.error_pixels <= 1.0);
    assert!(view.stats.traffic.bytes as f64 > number("bytes"));
    // Once it is there, nothing more is fetched.
    let again = terrain.settle(&camera, Duration::from_secs(60));
    assert_eq!(again.stats.traffic.bytes, view.stats.traffic.bytes);
}

#[test]
fn an_overview_of_a_real_dem_within_a_pixel_costs_little() {
    let Some(folder) = data() else { return };
    let dems = [
        "srtm3_crops/alps_1025.tif",
        "srtm3_crops/hills_1025.tif",
        "puget_1k/ps_height_1k.png",
        "osgearth_terrain/mt_rainier_90m.tif",
        "osgearth_terrain/mt_fuji_90m.tif",
        "srtm3_geotiff/N46E008.tif",
        "srtm3_nh/N44W072.hgt.gz",
        "srtm3_ventoux/N44E005.hgt",
        "qgis_training/SRTM.tif",
        "bigtujunga/bigtujunga.tif",
        "gcanyon/gcanyon_elev_crop.bw.png",
        "cairns/cairns.zip",
        "srtm1_patagonia/S46W066.hgt.gz",
    ];
    let mut table =
        String::from("overview of 1380 x 768 within 1 pixel:\n      bytes requests round-trips  DEM\n");
    let mut wrong = Vec::new();
    for name in dems {
        let (dem, store) = (folder.join(name), tempfile::tempdir().unwrap());
        if !dem.exists() {
            continue;
        }
        let png = name.ends_with(".png");
        let ingest = ingest::Options {
            cell: png.then_some(if name.starts_with("puget") { 160.0 } else { 60.0 }),
            height_scale: png.then_some(if name.starts_with("puget") { 0.1 } else { 10.0 }),
            ..ingest::Options::default()
        };
        build(&dem, store.path(), &ingest, &hierarchy::Options { ..options() });
        let served = serve(&[store.path().to_owned()]);
        let mut terrain = served.open(1.0);
        let camera = headless::overview(terrain.scene(), [1380, 768]);
        let view = terrain.settle(&camera, Duration::from_secs(60));
        let traffic = view.stats.traffic;
        let _ = writeln!(
            table,
            "{:>11} {:>8} {:>11}  {name}",
            traffic.bytes, traffic.requests, traffic.round_trips
        );
        if !view.complete || view.error_pixels > 1.0 || traffic.bytes > 1_500_000 || traffic.requests > 40 {
            wrong.push(format!("{name}: {} pixels, {traffic:?}", view.error_pixels));
        }
    }
    let _ = write!(std::io::stderr(), "{table}");
    assert!(wrong.is_empty(), "{wrong:#?}\n{table}");
}

/// A flight low over the middle of the whole landscape, looking down steeply: terrain fills every frame.
fn steep_flight(scene: &diamantina_protocol::message::Scene) -> FlightPath {
    let [low, high] = headless::extent(scene);
    let centre = (low + high) / 2.0;
    let keys = (0..=8).map(|i| {
        let part = f64::from(i) / 8.0;
        let angle = part * std::f64::consts::TAU;
        let around = DVec3::new(angle.cos(), angle.sin(), 0.0) * 4000.0;
        let eye = (centre + around).with_z(high.z + 2500.0);
        // From straight down to 30 degrees off it, forward.
        let lean = (part * std::f64::consts::PI).sin() * 30f64.to_radians().tan() * eye.z;
        let ahead = DVec3::new(-angle.sin(), angle.cos(), 0.0) * lean;
        PathKey { seconds: f64::from(i), eye: eye.to_array(), target: (eye + ahead).with_z(0.0).to_array() }
    });
    FlightPath { keys: keys.collect() }
}

/// Flies 300 frames through a network and looks at each pixel of each.
///
/// How many frames lacked data, and the sorted milliseconds of their cuts.
pub(crate) fn fly_over_magenta(
    world: &World,
    faults: Faults,
    seed: u64,
    encoding: Encoding,
) -> (usize, Vec<f64>) {
    let proxy = Proxy::start(&world.served.address, faults, seed);
    let fetch = diamantina_client::fetch::Options { encoding, ..Default::default() };
    let options = terrain::Options { tolerance_pixels: 0.2, fetch, ..terrain::Options::default() };
    let mut terrain = Terrain::open(&format!("{}/scenes/world", proxy.address), options).unwrap();
    let path = steep_flight(terrain.scene());
    let flight = Flight {
        play: Play::default(),
        frames: 300,
        frames_a_second: 30.0,
        size: [160, 120],
        pictures: None,
        reads: true,
        patience: None,
    };
    let (mut begun, mut unfinished, mut cuts) = (false, 0, Vec::new());
    headless::fly(&mut terrain, &path, &flight, &over_magenta(), &sharp(), |line, picture| {
        cuts.push(line.cut_ms);
        begun |= line.diamonds > 0;
        unfinished += usize::from(begun && !line.complete);
        let magenta = picture.unwrap().pixels.chunks_exact(4).filter(|p| **p == MAGENTA).count();
        if begun {
            assert_eq!(magenta, 0, "magenta in frame {}, which lacks data: {}", line.frame, !line.complete);
        } else {
            assert_eq!(magenta, 160 * 120, "something is drawn before there is anything");
        }
        Ok(())
    })
    .unwrap();
    assert!(begun, "nothing was ever drawn");
    assert!(proxy.faults_done.load(Ordering::Relaxed) > 0, "the network behaved");
    cuts.sort_by(f64::total_cmp);
    (unfinished, cuts)
}

#[test]
fn over_magenta_no_pixel_is_magenta_while_data_come_late_and_out_of_order() {
    let world = World::whole(1025);
    let faults = Faults { delay: Duration::from_millis(250), cut: 0.95, ..Faults::default() };
    let (unfinished, _) = fly_over_magenta(&world, faults, 1, Encoding::Points);
    assert!(unfinished > 30, "the network was too fast: {unfinished} unfinished frames");
}

#[test]
fn a_hole_would_be_seen() {
    // The judge is judged: over a scene with a sea of nodata the same flight does show magenta.
    let world = World::sample(513, 0.0);
    let mut terrain = world.served.open(1.0);
    let [low, high] = headless::extent(terrain.scene());
    let corner = low.with_z(high.z);
    let camera = Camera { eye: corner + DVec3::Z * 3000.0, target: corner, fov_y: FOV_Y, size: [160, 120] };
    let patience = Duration::from_secs(60);
    let (picture, _) = headless::picture(&mut terrain, &camera, &over_magenta(), &sharp(), patience).unwrap();
    assert!(picture.pixels.chunks_exact(4).any(|p| p == MAGENTA));
}

//! Answers that are spoilt on their way, servers that end, and scenes that change in the middle of a flight: the client comes
//! to the same picture, and draws nothing wrong before.

use crate::hostile::end;
use crate::rough::Rough;
use crate::seams::assert_no_cracks;
use crate::service::Program;
use crate::stream::{over_magenta, sharp};
use crate::swap::{drawn, publish};
use crate::world::{Served, World, build, options, programs, serve, write_raw};
use diamantina_client::camera::Camera;
use diamantina_client::headless::{self, Flight, FlightPath, PathKey, Play};
use diamantina_client::picture::Picture;
use diamantina_client::terrain::{self, Terrain};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(60);

/// Draws a picture with the real client; its bytes. It must say that it has all that it asked for.
fn render(url: &str, folder: &Path, name: &str, options: &[&str]) -> Vec<u8> {
    let png = folder.join(format!("{name}.png"));
    let mut command = Command::new(&programs().client);
    command.args(["render", url, "--size", "400x240", "--error-pixels", "0.5", "--json", "-", "-o"]);
    command.arg(&png).args(options).env("NODEVICE_SELECT", "1").stdin(Stdio::null());
    let ended = end(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap());
    assert_eq!(ended.code, Some(0), "{name}: {ended:?}");
    assert!(!ended.err.contains("panicked"), "{name}: {ended:?}");
    let report: serde_json::Value = serde_json::from_str(&ended.out).unwrap();
    assert_eq!(report["complete"], true, "{name}: {ended:?}");
    std::fs::read(png).unwrap()
}

#[test]
fn a_picture_through_a_proxy_that_spoils_answers_is_the_same_to_the_last_byte() {
    let world = World::whole_with_triangles(513);
    let folder = world.folder.path();
    let mut played = Vec::new();
    for options in [&["--encoding", "points"][..], &["--encoding", "tin"], &["--stream"]] {
        let name = options.last().unwrap().trim_start_matches('-');
        let calm = render(&world.served.scene("world"), folder, name, options);
        for seed in 1..=3 {
            let rough = Rough::start(&world.served.address, seed);
            let url = format!("{}/scenes/world", rough.address);
            let name = format!("{name}, seed {seed}");
            let found = render(&url, folder, &name, options);
            assert!(found == calm, "{name}: another picture, after {:?}", rough.played());
            played.extend(rough.played());
        }
    }
    for (trick, _) in &played {
        let count: u64 = played.iter().filter(|(other, _)| other == trick).map(|(_, count)| count).sum();
        assert!(count > 0, "{trick:?} was never played: {played:?}");
    }
}

#[test]
fn while_answers_are_spoilt_nothing_has_a_crack_and_the_cut_ends_as_without() {
    let world = World::whole(1025);
    let options = terrain::Options { tolerance_pixels: 0.5, ..terrain::Options::default() };
    let mut calm = Terrain::open(&world.served.scene("world"), options.clone()).unwrap();
    let layer = calm.scene().layers[0].clone();
    let far = headless::overview(calm.scene(), [640, 480]);
    let near = Camera { eye: far.target + (far.eye - far.target) * 0.2, ..far };
    for seed in 11..=13 {
        let rough = Rough::start(&world.served.address, seed);
        let url = format!("{}/scenes/world", rough.address);
        let mut terrain = Terrain::open(&url, options.clone()).unwrap();
        let mut looked = 0;
        for camera in [far, near] {
            let (started, mut splits) = (Instant::now(), 0);
            let view = loop {
                let view = terrain.frame(&camera);
                if view.stats.splits_drawn != splits {
                    splits = view.stats.splits_drawn;
                    looked += assert_no_cracks(&layer, &view.items, true);
                }
                if view.complete {
                    break view;
                }
                let problem = terrain.problem();
                assert!(started.elapsed() < PATIENCE, "seed {seed}: {problem:?}, {:?}", rough.played());
                std::thread::sleep(Duration::from_millis(5));
            };
            let expected = calm.settle(&camera, PATIENCE);
            assert!(expected.complete && drawn(&view) == drawn(&expected), "seed {seed}: another cut");
        }
        assert!(looked > 1000, "seed {seed}: only {looked} edges were looked at");
    }
}

/// A flight: high over the south-west at first, then down to the north-east, where nothing has been seen before. All of it
/// looks down steeply, so that ground fills each frame.
fn descent() -> FlightPath {
    let key = |seconds: f64, [x, y]: [f64; 2], z: f64| PathKey {
        seconds,
        eye: [x, y, z],
        target: [x + 100.0, y + 300.0, 0.0],
    };
    FlightPath {
        keys: vec![
            key(0.0, [5000.0, 5000.0], 5000.0),
            key(3.0, [6000.0, 5500.0], 4500.0),
            key(6.0, [9500.0, 9000.0], 3500.0),
            key(8.0, [10_000.0, 10_000.0], 3200.0),
            key(9.0, [10_100.0, 10_100.0], 3200.0),
        ],
    }
}

/// Builds a store of hills named `world`; what differs between scenes is their cell, their waves and what they are placed on.
fn hills(folder: &Path, name: &str, cell: f64, waves: f64) -> PathBuf {
    let (dem, store) = (folder.join(format!("{name}.raw")), folder.join(name));
    let mut ingest = write_raw(&dem, [513, 513], |x, y| {
        let (x, y) = (f64::from(x) / waves, f64::from(y) / waves);
        Some((500.0 + 300.0 * x.sin() * y.cos() + 40.0 * (7.0 * x).cos() + 9.0 * (23.0 * y).sin()) as f32)
    });
    ingest.cell = Some(cell);
    build(&dem, &store, &ingest, &options());
    store
}

fn terrain(served: &str) -> Terrain {
    let options = terrain::Options { tolerance_pixels: 1.0, ..terrain::Options::default() };
    Terrain::open(&format!("{served}/scenes/world"), options).unwrap()
}

/// What a client of its own draws of a scene from somewhere, once it has all.
fn alone(served: &Served, camera: &Camera) -> Picture {
    let mut terrain = terrain(&served.address);
    headless::picture(&mut terrain, camera, &over_magenta(), &sharp(), PATIENCE).unwrap().0
}

/// A frame of a flight that had all that it wanted.
struct Whole {
    frame: u32,
    picture: Picture,
}

/// Flights drew the new scene as if it lay where the one before had lain.
#[test]
fn a_flight_goes_on_while_its_server_ends_and_its_scene_is_replaced() {
    const FRAMES: u32 = 270;
    const SIZE: [u32; 2] = [160, 120];
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    let (first, second) = (hills(folder, "first", 30.0, 37.0), hills(folder, "second", 42.0, 29.0));
    let version =
        |store: &Path| diamantina_server::store::Store::open(store).unwrap().scene().version.clone();
    let (old, new) = (version(&first), version(&second));
    // What is served is a copy, which is replaced in the middle of the flight.
    let store = folder.join("store");
    std::fs::create_dir(&store).unwrap();
    publish(&first, &store, &old, false);
    let start = |listen: &str| {
        let args = [store.to_str().unwrap(), "--reload", "1", "--grace", "0"];
        Program::start_at(listen, &args, &[])
    };
    let mut server = Some(start("127.0.0.1:0"));
    let address = server.as_ref().unwrap().address.clone();
    let listen = address.strip_prefix("http://").unwrap().to_owned();
    let mut terrain = terrain(&address);
    let path = descent();
    let flight = Flight {
        play: Play::default(),
        frames: FRAMES,
        frames_a_second: 30.0,
        size: SIZE,
        pictures: None,
        reads: true,
        patience: None,
    };
    let (mut begun, mut whole) = (false, Vec::new());
    headless::fly(&mut terrain, &path, &flight, &over_magenta(), &sharp(), |line, picture| {
        let picture = picture.unwrap();
        match line.frame {
            // It ends suddenly, and another one takes its place.
            20 => drop(server.take().unwrap().kill()),
            23 => server = Some(start(&listen)),
            // While it is away, its store becomes another one.
            90 => {
                server.take().unwrap().kill();
                publish(&second, &store, &new, false);
                server = Some(start(&listen));
            }
            _ => {}
        }
        begun |= line.diamonds > 0;
        let magenta = picture.pixels.chunks_exact(4).filter(|p| **p == [255, 0, 255, 255]).count();
        assert!(!begun || magenta == 0, "{magenta} pixels of frame {} show no ground", line.frame);
        if line.complete && line.frame % 30 == 29 {
            let picture = Picture { size: picture.size, pixels: picture.pixels.clone() };
            whole.push(Whole { frame: line.frame, picture });
        }
        Ok(())
    })
    .unwrap();
    assert!(begun && terrain.scene().version == new, "the new scene is not there: {:?}", terrain.problem());
    let last = whole.last().map_or(0, |whole| whole.frame);
    assert!(last == FRAMES - 1 && whole.len() >= 3, "frame {last} is the last of {} whole ones", whole.len());
    // Each frame that was whole is that of the one scene or of the other, and none is of the first after the second.
    let served = [serve(&[first]), serve(&[second])];
    let mut before = 0;
    for Whole { frame, picture } in &whole {
        let camera = path.camera(f64::from(*frame) / f64::from(FRAMES - 1), SIZE);
        let is_of = |scene: &Served| alone(scene, &camera).pixels == picture.pixels;
        let scene = served.iter().position(is_of);
        let scene = scene.unwrap_or_else(|| panic!("frame {frame} is of neither scene"));
        assert!(scene >= before, "frame {frame} is of the scene before");
        before = scene;
    }
    assert_eq!(before, 1, "the last frame is of the new scene");
    server.unwrap().stop();
}

//! `load`: many users find a server well, and what is wrong on the way is counted.

use crate::hostile::end;
use crate::world::{Faults, Proxy, World, build, options as options_of_build, programs, serve_within};
use diamantina_client::encoding::Encoding;
use diamantina_client::load::{Options, Report, run};
use diamantina_server::http::Limits;
use diamantina_server::{hierarchy, ingest, sample};
use std::process::{Command, Stdio};
use std::thread;
use std::time::Duration;

fn options(users: u32) -> Options {
    Options {
        users,
        duration: Duration::from_secs(4),
        arrival: Duration::from_secs(1),
        think: Duration::from_millis(200),
        paths: Vec::new(),
        views: 10,
        size: [320, 180],
        tolerance_pixels: 2.0,
        memory_bytes: 64 << 20,
        layers: None,
        encoding: Encoding::Points,
        requests_max: 4,
        http2: false,
        token: None,
        seed: 7,
    }
}

fn load(url: &str, options: &Options) -> Report {
    run(url, options, |_| {}).unwrap()
}

#[test]
fn users_of_a_server_by_itself_find_all_they_want() {
    let world = World::sample(513, 1.0);
    for http2 in [false, true] {
        let report = load(&world.served.scene("world"), &Options { http2, ..options(24) });
        assert!(report.errors.is_empty(), "{report:?}");
        assert!(report.views.count >= 48 && report.diamonds.count > 24 * 4, "{report:?}");
        assert!(report.diamonds.p50 > 0.0 && report.diamonds.p50 <= report.diamonds.p99, "{report:?}");
        // Each user has its own cache, so most payloads came more than once.
        assert!(report.decoded.0 < report.diamonds.count, "{report:?}");
    }
}

#[test]
fn triangles_load_a_server_as_well() {
    let world = World::whole_with_triangles(257);
    let report = load(&world.served.scene("world"), &Options { encoding: Encoding::Tin, ..options(6) });
    assert!(report.errors.is_empty() && report.views.count > 0 && report.decoded.0 > 0, "{report:?}");
}

#[test]
fn users_go_over_to_the_version_that_takes_the_place_of_theirs() {
    let folder = tempfile::tempdir().unwrap();
    let (dem, store) = (folder.path().join("dem.tif"), folder.path().join("store"));
    sample::write(&dem, 257).unwrap();
    let make = |max_error: f64| {
        let options = hierarchy::Options { max_error, ..options_of_build() };
        build(&dem, &store, &ingest::Options::default(), &options)
    };
    make(4.0);
    let limits = Limits { reload: 1, grace: 0, ..Limits::default() };
    let served = serve_within(std::slice::from_ref(&store), limits);
    let options = Options { duration: Duration::from_secs(8), ..options(12) };
    let report = thread::scope(|threads| {
        threads.spawn(|| {
            thread::sleep(Duration::from_secs(2));
            make(1.0);
        });
        load(&served.scene("world"), &options)
    });
    assert!(report.errors.is_empty(), "{report:?}");
    // A user who has all that its views want never hears of it.
    assert!((6..=12).contains(&report.went_over) && report.unsettled == 0, "{report:?}");
}

#[test]
fn what_goes_wrong_on_the_way_is_counted() {
    let world = World::sample(257, 1.0);
    let faults = Faults { cut: 0.3, ..Faults::default() };
    let proxy = Proxy::start(&world.served.address, faults, 11);
    let report = load(&format!("{}/scenes/world", proxy.address), &options(12));
    assert!(!report.errors.is_empty() && report.views.count > 0, "{report:?}");
}

#[test]
fn the_program_prints_what_it_found() {
    let world = World::sample(257, 1.0);
    let url = world.served.scene("world");
    let start = |arguments: &[&str]| {
        let mut command = Command::new(&programs().client);
        command.arg("load").args(arguments);
        end(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap())
    };
    let few = ["--users", "4", "--seconds", "2", "--arrival", "0", "--think", "0.2", "--size", "160x90"];
    let done = start(&[&[url.as_str()], &few[..]].concat());
    assert_eq!(done.code, Some(0), "{}{}", done.out, done.err);
    assert!(done.out.contains("p99") && done.out.contains("4 users"), "{}", done.out);
    let json = start(&[&[url.as_str(), "--json", "-"], &few[..]].concat());
    let report: serde_json::Value = serde_json::from_str(&json.out).unwrap();
    assert!(report["diamonds"]["count"].as_u64().unwrap() > 0);
    let nobody = start(&[&["http://127.0.0.1:9/scenes/world"], &few[..]].concat());
    assert_eq!(nobody.code, Some(1), "{}{}", nobody.out, nobody.err);
    assert_eq!(start(&[&url, "--think", "-1"]).code, Some(2));
}

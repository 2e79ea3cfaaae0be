//! A scene that is built again while it is served: nobody is refused, and a bad version never replaces a good one.

use crate::limits::{answer, connect, request};
use crate::service::metric;
use crate::world::{Served, build, options, serve_within};
use diamantina_client::headless;
use diamantina_client::terrain::{FrameView, Options, Terrain};
use diamantina_protocol::diamond::Diamond;
use diamantina_server::http::{self, Limits, Server, new_token};
use diamantina_server::{hierarchy, ingest, sample};
use std::io::Write as _;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{scope, sleep, spawn};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(60);

fn ask(served: &Served, path: &str) -> String {
    let mut stream = connect(&served.address);
    request(&mut stream, path);
    answer(&mut stream)
}

/// The version that the server's description of the scene tells.
fn version(served: &Served) -> String {
    let found = ask(served, "/scenes/world");
    let (_, rest) = found.split_once("\"version\":\"").unwrap_or_else(|| panic!("{found}"));
    rest.split('"').next().unwrap().to_owned()
}

fn wait(what: &str, mut is_done: impl FnMut() -> bool) {
    let started = Instant::now();
    while !is_done() {
        assert!(started.elapsed() < PATIENCE, "{what}");
        sleep(Duration::from_millis(100));
    }
}

/// Puts another version into a store's folder as a build does: its files first, then `scene.json` at once.
pub(crate) fn publish(from: &Path, to: &Path, version: &str, damage: bool) {
    std::fs::create_dir(to.join(version)).unwrap();
    for entry in std::fs::read_dir(from.join(version)).unwrap() {
        let path = entry.unwrap().path();
        let mut bytes = std::fs::read(&path).unwrap();
        if damage && path.file_name().is_some_and(|name| name != "directory") {
            let middle = bytes.len() / 2;
            bytes[middle] ^= 1;
        }
        std::fs::write(to.join(version).join(path.file_name().unwrap()), bytes).unwrap();
    }
    std::fs::copy(from.join("scene.json"), to.join("new.json")).unwrap();
    std::fs::rename(to.join("new.json"), to.join("scene.json")).unwrap();
}

#[test]
fn a_scene_built_again_is_swapped_and_a_damaged_one_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let (dem, store) = (folder.path().join("dem.tif"), folder.path().join("store"));
    sample::write(&dem, 129).unwrap();
    let made = |store: &Path, max_error: f64| {
        let options = hierarchy::Options { max_error, ..options() };
        build(&dem, store, &ingest::Options::default(), &options).scene
    };
    let first = made(&store, 4.0);
    let limits = Limits { reload: 1, grace: 4, ..Limits::default() };
    let served = serve_within(std::slice::from_ref(&store), limits);
    let page = |version: &str| format!("/scenes/world/{version}/{}/index/0", first.layers[0].name);
    assert_eq!(version(&served), first.version);
    let is_over = AtomicBool::new(false);
    scope(|threads| {
        // Somebody who is at the first version, all along.
        threads.spawn(|| {
            while !is_over.load(Ordering::Relaxed) {
                let found = ask(&served, &page(&first.version));
                assert!(found.starts_with("HTTP/1.1 200"), "{found}");
            }
        });
        let second = made(&store, 0.0);
        assert_ne!(second.version, first.version);
        wait("the second version is never served", || version(&served) == second.version);
        assert!(
            ask(&served, &page(&first.version)).starts_with("HTTP/1.1 200"),
            "for a while, both are there"
        );
        is_over.store(true, Ordering::Relaxed);
    });
    let second = version(&served);
    wait("the first version does not go", || ask(&served, &page(&first.version)).starts_with("HTTP/1.1 410"));
    assert!(ask(&served, &page(&first.version)).contains(&second), "whoever comes late is told where to go");

    let other = folder.path().join("other");
    let third = made(&other, 2.0);
    publish(&other, &store, &third.version, true);
    sleep(Duration::from_secs(3));
    assert_eq!(version(&served), second, "a damaged version is not served");
    assert_eq!(metric(&served, "diamantina_checksum_failures_total"), 1.0);
    assert!(ask(&served, &page(&second)).starts_with("HTTP/1.1 200"));
    let fourth = made(&folder.path().join("fourth"), 3.0);
    publish(&folder.path().join("fourth"), &store, &fourth.version, false);
    wait("a sound version after a damaged one is never served", || version(&served) == fourth.version);
}

/// What a view draws, and how high.
pub(crate) fn drawn(view: &FrameView) -> Vec<(Diamond, u8, Vec<i32>)> {
    let mut items: Vec<_> = view
        .items
        .iter()
        .map(|item| {
            let heights = item.surface.points().unwrap().block().heights().to_vec();
            (item.diamond, item.sides, heights)
        })
        .collect();
    items.sort_by_key(|(d, sides, _)| (d.level(), d.centre(), *sides));
    items
}

#[test]
fn a_flight_across_a_swap_goes_on_and_ends_in_the_new_version() {
    let folder = tempfile::tempdir().unwrap();
    let (dem, store) = (folder.path().join("dem.tif"), folder.path().join("store"));
    sample::write(&dem, 257).unwrap();
    let made = |max_error: f64| {
        let options = hierarchy::Options { max_error, ..options() };
        build(&dem, &store, &ingest::Options::default(), &options).scene
    };
    let first = made(4.0);
    let limits = Limits { reload: 1, grace: 0, ..Limits::default() };
    let served = serve_within(std::slice::from_ref(&store), limits);
    let url = format!("{}/scenes/world", served.address);
    let open =
        |tolerance_pixels| Terrain::open(&url, Options { tolerance_pixels, ..Options::default() }).unwrap();
    let mut terrain = open(30.0);
    let camera = headless::overview(terrain.scene(), [640, 480]);
    assert!(terrain.settle(&camera, PATIENCE).complete);
    let second = made(0.0);
    wait("the first version does not go", || {
        ask(&served, &format!("/scenes/world/{}/terrain/index/0", first.version)).starts_with("HTTP/1.1 410")
    });
    // Closer looked at, more is needed, and there is none of it.
    terrain.set_tolerance_pixels(0.5);
    let started = Instant::now();
    while terrain.scene().version != second.version {
        let view = terrain.frame(&camera);
        assert!(!view.items.is_empty() && view.error_pixels.is_finite(), "there is always a picture");
        assert!(started.elapsed() < PATIENCE, "the new version never takes over: {:?}", terrain.problem());
        sleep(Duration::from_millis(5));
    }
    let view = terrain.settle(&camera, PATIENCE);
    assert!(view.complete && view.error_pixels <= 0.5 && view.stats.reloads == 1, "{view:?}");
    assert!(!terrain.scene_changed());
    let fresh = open(0.5).settle(&camera, PATIENCE);
    assert!(drawn(&view) == drawn(&fresh), "what is drawn is what a new client draws");
    assert!(view.stats.traffic.bytes > fresh.stats.traffic.bytes, "both versions are counted");
}

/// As a folder on a file server that is away: whoever opens the description waits.
fn hang(store: &Path) {
    let description = store.join("scene.json");
    std::fs::remove_file(&description).unwrap();
    assert!(Command::new("mkfifo").arg(&description).status().unwrap().success());
}

#[test]
fn a_scene_that_does_not_answer_holds_up_neither_tokens_nor_other_scenes_nor_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let dem = folder.path().join("dem.tif");
    sample::write(&dem, 65).unwrap();
    let make = |name: &str, max_error: f64| {
        let options = hierarchy::Options { max_error, scene: name.to_owned(), ..options() };
        let store = folder.path().join(name);
        (build(&dem, &store, &ingest::Options::default(), &options).scene.version, store)
    };
    let ((_, stuck), (_, other)) = (make("a-stuck", 1.0), make("world", 1.0));
    let tokens = folder.path().join("tokens");
    let (token, hash) = new_token().unwrap();
    let line = |scene: &str| format!("{scene} {hash}\n");
    std::fs::write(&tokens, line("world") + &line("a-stuck")).unwrap();
    let limits = Limits { reload: 1, ..Limits::default() };
    let server = Server::open_with(
        &[stuck.clone(), other],
        "127.0.0.1:0".parse().unwrap(),
        &http::Options { limits, tokens: Some(tokens.clone()), ..http::Options::default() },
    )
    .unwrap();
    let address = server.address();
    let described = |token: &str| {
        let mut stream = connect(&address);
        write!(stream, "GET /scenes/world HTTP/1.1\r\nHost: here\r\nAuthorization: Bearer {token}\r\n\r\n")
            .unwrap();
        answer(&mut stream)
    };
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let running = spawn(move || server.run(async { drop(stopped.await) }));
    hang(&stuck);
    sleep(Duration::from_secs(2));
    let (newer, _) = make("world", 0.0);
    wait("the other scene stays as it was", || described(&token).contains(&newer));
    let (another, hash) = new_token().unwrap();
    std::fs::write(&tokens, format!("world {hash}\n") + &line("a-stuck")).unwrap();
    wait("the token goes on", || described(&token).starts_with("HTTP/1.1 404"));
    assert!(described(&another).starts_with("HTTP/1.1 200"));
    drop(stop);
    wait("the server waits for the scene", || running.is_finished());
    running.join().unwrap().unwrap();
    // Whoever waits still is let go.
    drop(std::fs::File::options().read(true).write(true).open(stuck.join("scene.json")));
}

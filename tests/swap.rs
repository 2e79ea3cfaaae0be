//! A scene that is built again while it is served: nobody is refused, and a bad version never replaces a good one.

use crate::limits::{answer, connect, request};
use crate::world::{Served, build, options, serve_within};
use diamantina_server::http::Limits;
use diamantina_server::{hierarchy, ingest, sample};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{scope, sleep};
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
fn publish(from: &Path, to: &Path, version: &str, damage: bool) {
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
    assert!(ask(&served, &page(&second)).starts_with("HTTP/1.1 200"));
    let fourth = made(&folder.path().join("fourth"), 3.0);
    publish(&folder.path().join("fourth"), &store, &fourth.version, false);
    wait("a sound version after a damaged one is never served", || version(&served) == fourth.version);
}

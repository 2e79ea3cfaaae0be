//! Law 7, at fifty moments: a build that is killed leaves the scene before or a whole new one, for whoever reads the store and
//! for servers, and the same command completes it to the last byte, with nothing left beside it.

use crate::determinism::files;
use crate::hostile::{PATIENCE, end, server, start, words};
use crate::limits::connect;
use crate::swap::publish;
use crate::world::{Dice, programs, serve_within};
use diamantina_protocol::message;
use diamantina_server::http::Limits;
use diamantina_server::sample;
use diamantina_server::store::{Key, Kind, Store, StoreError};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{scope, sleep};
use std::time::{Duration, Instant};

const SEED: u64 = 0x50_C1DE;

const MOMENTS: u32 = 50;

/// About what laying packs, the description and clearing up take.
const PUBLISHING: Duration = Duration::from_millis(6);

/// Both encodings, and a note of each thing that is done as soon as it is.
const BUILD: &str =
    "build {}/new.tif --scene world --encoding points,tin --patch-triangles 512 --checkpoint 0 --threads 2";

/// A scene as it has to be: its files, and its blobs.
struct Scene {
    version: String,
    files: BTreeMap<PathBuf, Vec<u8>>,
    blobs: HashMap<Key, Vec<u8>>,
    /// Addresses of diamonds and pages, and their blobs.
    routes: Vec<(String, Vec<u8>)>,
}

impl Scene {
    fn of(folder: &Path) -> Self {
        let store = Store::open(folder).unwrap();
        let version = store.scene().version.clone();
        let blobs: HashMap<Key, Vec<u8>> =
            store.keys().map(|(key, _)| (key, store.get(key).unwrap().unwrap().to_vec())).collect();
        let route = |key: &Key| match key.kind {
            Kind::Points => Some(message::points_route("world", &version, "terrain", [key.a, key.b])),
            Kind::Index => Some(message::index_route("world", &version, "terrain", key.a)),
            _ => None,
        };
        let routes = blobs.iter().filter_map(|(key, blob)| Some((route(key)?, blob.clone()))).collect();
        let mut files = files(folder);
        files.retain(|path, _| path != Path::new(".lock"));
        Self { version, files, blobs, routes }
    }

    /// Whether this is what is at a store now, every byte of it.
    fn assert_is(&self, store: &Store, what: &str) {
        assert_eq!(store.keys().count(), self.blobs.len(), "{what}: another number of blobs");
        for (key, expected) in &self.blobs {
            let found = store.get(*key).unwrap_or_else(|e| panic!("{what}: {e}"));
            assert!(found.as_deref() == Some(expected.as_slice()), "{what}: {key:?} is another");
        }
    }
}

/// Reads a store: it has to be one of these scenes, whole. Its version, or `None` if there is none.
fn read(folder: &Path, scenes: &[&Scene], what: &str) -> Option<String> {
    let store = match Store::open(folder) {
        Ok(store) => store,
        Err(StoreError::NotAStore(_)) => return None,
        Err(error) => panic!("{what}: {error}"),
    };
    let version = store.scene().version.clone();
    let scene = scenes.iter().find(|scene| scene.version == version);
    scene.unwrap_or_else(|| panic!("{what}: version {version} is of no scene")).assert_is(&store, what);
    Some(version)
}

/// Asks a server for something; status and body.
fn ask(address: &str, route: &str) -> (u16, Vec<u8>) {
    let mut stream = connect(address);
    write!(stream, "GET {route} HTTP/1.0\r\nHost: here\r\n\r\n").unwrap();
    let mut bytes = Vec::new();
    stream.read_to_end(&mut bytes).unwrap();
    let at = bytes.windows(4).position(|window| window == b"\r\n\r\n").unwrap();
    let status = String::from_utf8_lossy(&bytes[9..12]).parse().unwrap();
    (status, bytes.split_off(at + 4))
}

/// Asks for one thing of each scene: what a server gives is right, or it says that another version took its place.
fn look(address: &str, scenes: &[&Scene], dice: &mut Dice) {
    let (status, description) = ask(address, "/scenes/world");
    let text = String::from_utf8(description).unwrap();
    let known = scenes.iter().any(|scene| text.contains(&format!("\"version\":\"{}\"", scene.version)));
    assert!(status == 200 && known, "{status}: {text}");
    for scene in scenes {
        let (route, expected) = &scene.routes[dice.below(scene.routes.len() as u64) as usize];
        let (status, found) = ask(address, route);
        assert!(status == 410 || (status == 200 && found == *expected), "{route}: {status}");
    }
}

/// What lies in a folder.
fn names(folder: &Path) -> BTreeSet<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

/// Makes `old` the scene of a store again.
fn put_back(from: &Path, to: &Path, old: &Scene, new: &Scene) {
    publish(from, to, &old.version, false);
    std::fs::remove_dir_all(to.join(&new.version)).unwrap();
}

#[test]
fn killed_at_any_of_fifty_moments_a_build_shows_no_half_of_a_scene_and_is_completed_to_the_last_byte() {
    println!("seed {SEED}");
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    let [old_store, whole_store, served_store, bare_store] =
        ["old", "whole", "served", "bare"].map(|name| folder.join(name));
    sample::write(&folder.join("old.tif"), 129).unwrap();
    sample::write(&folder.join("new.tif"), 180).unwrap();
    let done = |command: &str| {
        let ended = server(folder, command);
        assert_eq!(ended.code, Some(0), "{ended:?}");
        ended
    };
    done("build {}/old.tif -o {}/old --scene world");
    done("build {}/old.tif -o {}/served --scene world");
    let started = Instant::now();
    done(&format!("{BUILD} -o {{}}/whole"));
    // Others at work may leave it: a build that ends before it is killed tells how long one takes now.
    let mut whole = started.elapsed();
    let (old, new) = (Scene::of(&old_store), Scene::of(&whole_store));
    assert!(new.blobs.keys().any(|key| key.kind == Kind::Tin) && old.version != new.version);
    let limits = Limits { reload: 1, grace: 0, ..Limits::default() };
    let served = serve_within(std::slice::from_ref(&served_store), limits);
    let (is_over, looks) = (AtomicBool::new(false), AtomicU64::new(0));
    // Held by whoever reads the store that is taken away now and then, and by whoever does that.
    let bare_is_used = Mutex::new(());
    let mut dice = Dice(SEED);
    let (mut killed, mut resumed, mut moments) = (0, 0, Vec::new());
    scope(|threads| {
        // Somebody who reads the store, and somebody who asks a server of it, all along.
        threads.spawn(|| {
            let mut dice = Dice(SEED ^ 1);
            while !is_over.load(Ordering::Relaxed) {
                assert!(read(&served_store, &[&old, &new], "meanwhile").is_some(), "there is no scene");
                let used = bare_is_used.lock().unwrap();
                read(&bare_store, &[&new], "meanwhile, where there was none");
                drop(used);
                look(&served.address, &[&old, &new], &mut dice);
                looks.fetch_add(1, Ordering::Relaxed);
                sleep(Duration::from_millis(25));
            }
        });
        let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            for moment in 0..MOMENTS {
                // Every other time there was no scene before.
                let (name, store) =
                    if moment % 2 == 0 { ("served", &served_store) } else { ("bare", &bare_store) };
                let command = format!("{BUILD} -o {{}}/{name}");
                let mut child = start(&programs().server, &words(folder, &command));
                // One of five while it publishes, which takes no time; the others all along.
                let after = if moment % 5 == 4 {
                    let until = Instant::now() + PATIENCE;
                    while !store.join(".building/data").exists() && child.try_wait().unwrap().is_none() {
                        assert!(Instant::now() < until, "it never publishes");
                        sleep(Duration::from_micros(300));
                    }
                    PUBLISHING.mul_f64(dice.roll())
                } else {
                    whole.mul_f64((f64::from(moment) + dice.roll()) / f64::from(MOMENTS))
                };
                sleep(after);
                // It may have ended by itself, and been waited for.
                child.kill().unwrap();
                let was_killed = end(child).code.is_none();
                let what = format!("seed {SEED}, moment {moment}, after {after:?}");
                let left = read(store, &[&old, &new], &what);
                assert!(name == "bare" || left.is_some(), "{what}: the scene before is gone");
                let begun = Instant::now();
                let ended = done(&command);
                if !was_killed {
                    whole = whole.min(begun.elapsed());
                }
                killed += u32::from(was_killed);
                let goes_on = ended.err.contains("resuming: ");
                resumed += u32::from(goes_on);
                moments.push((after, was_killed, goes_on, left));
                assert_eq!(read(store, &[&new], &what).as_ref(), Some(&new.version), "{what}");
                let expected = [".lock", "scene.json", &new.version].map(str::to_owned).into();
                assert_eq!(names(store), expected, "{what}: something is left");
                let mut now = files(store);
                now.retain(|path, _| path != Path::new(".lock"));
                assert!(now == new.files, "{what}: the bytes are not those of an unbroken build");
                if name == "served" {
                    put_back(&old_store, store, &old, &new);
                } else {
                    let _used = bare_is_used.lock().unwrap();
                    std::fs::remove_dir_all(store).unwrap();
                }
            }
        }));
        is_over.store(true, Ordering::Relaxed);
        if let Err(panic) = result {
            std::panic::resume_unwind(panic);
        }
    });
    println!("killed {killed}, resumed {resumed} of {MOMENTS}, {looks:?} looks meanwhile: {moments:?}");
    assert!(killed >= 30 && resumed >= 20, "killed {killed}, resumed {resumed} of {MOMENTS}: {moments:?}");
    assert!(looks.load(Ordering::Relaxed) > 50, "{looks:?} looks");
    // The judge is judged: of a half it says so.
    let half = folder.join("half");
    std::fs::create_dir(&half).unwrap();
    publish(&whole_store, &half, &new.version, true);
    let found = std::panic::catch_unwind(|| read(&half, &[&new], "a damaged one"));
    assert!(found.is_err(), "damage is not seen");
}

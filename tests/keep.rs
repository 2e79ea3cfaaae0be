//! What was fetched and kept on the disk, through the real programs: the next session, two at once, no server, other
//! versions, private scenes.

use crate::hostile::{assert_failed, client, end, start, words};
use crate::swap::drawn;
use crate::world::{World, build, options, programs, serve, serve_with, serve_within};
use diamantina_client::disk::Disk;
use diamantina_client::terrain::{Options, Terrain};
use diamantina_client::{fetch, headless};
use diamantina_server::http::Limits;
use diamantina_server::{hierarchy, http, ingest, sample};
use std::path::Path;
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(60);

fn report(path: &Path) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

#[test]
fn pictures_of_the_next_session_of_two_at_once_and_without_a_server_are_the_same() {
    let world = World::sample(257, 0.0);
    let folder = world.folder.path();
    let url = world.served.scene("world");
    let render = |name: &str, more: &str| {
        format!(
            "render {url} -o {{}}/{name}.png --json {{}}/{name}.json --size 320x240 --no-antialias {more}"
        )
    };
    let picture = |name: &str| std::fs::read(folder.join(name).with_extension("png")).unwrap();
    let told = |name: &str| report(&folder.join(name).with_extension("json"));
    // Two that know nothing of each other.
    let both = ["first", "second"]
        .map(|name| start(&programs().client, &words(folder, &render(name, "--disk-cache {}/kept"))));
    for ended in both.map(end) {
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert!(!ended.err.contains("disk cache"), "{ended:?}");
    }
    assert!(picture("first") == picture("second"));
    let ended = client(folder, &render("warm", "--disk-cache {}/kept"));
    assert_eq!((ended.code, told("warm")["requests"].as_u64()), (Some(0), Some(1)), "{ended:?}");
    assert!(told("warm")["disk_bytes"].as_u64() > told("warm")["bytes"].as_u64());
    let stopped = url.clone();
    drop(world.served);
    let left = Instant::now();
    while std::net::TcpStream::connect(stopped.split('/').nth(2).unwrap()).is_ok() {
        assert!(left.elapsed() < PATIENCE, "the server does not end");
        std::thread::sleep(Duration::from_millis(20));
    }
    for (name, more) in [("gone", "--disk-cache {}/kept"), ("forced", "--disk-cache {}/kept --offline")] {
        let ended = client(folder, &render(name, more));
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert!(ended.err.contains("notice: offline") && ended.err.contains("fetched before"), "{ended:?}");
        assert!(picture(name) == picture("first"));
        let told = told(name);
        assert_eq!((&told["offline"], &told["asked_error_reached"]), (&true.into(), &true.into()));
    }
    // Nearer than anybody was: what is there is drawn, and it is said what it lacks.
    let near = format!("{} --error-pixels 0.01 --timeout 30", render("near", "--disk-cache {}/kept"));
    let ended = client(folder, &near);
    assert!(ended.code == Some(1) && ended.err.contains("offline, and more was not fetched"), "{ended:?}");
    assert_eq!(told("near")["asked_error_reached"], false);
    assert!(!picture("near").is_empty());
    let ended = client(folder, &render("none", ""));
    assert_failed(&ended, 1, &["is the server running"], "no server and no cache");
    let ended = client(folder, &render("none", "--disk-cache {}/other --offline"));
    assert_failed(&ended, 1, &["/scenes/world", "fetched before"], "an empty cache");
    // What cannot be kept is told once, and the picture is drawn.
    let again = serve(&[folder.join("store")]);
    let below_a_file =
        format!("render {} -o {{}}/x.png --size 64x48 --disk-cache {{}}/first.png", again.scene("world"));
    let ended = client(folder, &below_a_file);
    assert!(ended.code == Some(0) && ended.err.matches("disk cache").count() == 1, "{ended:?}");
    let small = below_a_file.replace("first.png", "kept --disk-cache-size 1MiB");
    assert_failed(&client(folder, &small), 2, &["--disk-cache-size", "32MiB"], "too small a cache");
}

fn kept(disk: &Disk, token: Option<&str>, offline: bool) -> Options {
    let fetch = fetch::Options {
        disk: Some(disk.clone()),
        token: token.map(Into::into),
        offline,
        ..fetch::Options::default()
    };
    Options { fetch, ..Options::default() }
}

#[test]
fn a_version_built_later_is_not_mixed_with_what_is_kept_of_the_one_before() {
    let folder = tempfile::tempdir().unwrap();
    let (dem, store) = (folder.path().join("dem.tif"), folder.path().join("store"));
    sample::write(&dem, 257).unwrap();
    let disk = Disk::open(&folder.path().join("kept"), 64 << 20).unwrap();
    let mut served = None;
    let mut versions = Vec::new();
    for max_error in [4.0, 0.0] {
        let options = hierarchy::Options { max_error, ..options() };
        let built = build(&dem, &store, &ingest::Options::default(), &options).scene;
        // One address for both.
        let limits = Limits { reload: 1, grace: 0, ..Limits::default() };
        let served = served.get_or_insert_with(|| serve_within(std::slice::from_ref(&store), limits));
        let url = served.scene("world");
        let started = Instant::now();
        let fresh = &mut loop {
            let terrain = Terrain::open(&url, Options::default()).unwrap();
            if terrain.scene().version == built.version {
                break terrain;
            }
            assert!(started.elapsed() < PATIENCE, "the version built is never served");
            std::thread::sleep(Duration::from_millis(50));
        };
        let camera = headless::overview(fresh.scene(), [640, 480]);
        let plain = fresh.settle(&camera, PATIENCE);
        let mut caching = Terrain::open(&url, kept(&disk, None, false)).unwrap();
        let view = caching.settle(&camera, PATIENCE);
        assert!(view.complete && drawn(&view) == drawn(&plain));
        let offline = &mut Terrain::open(&url, kept(&disk, None, true)).unwrap();
        assert_eq!(offline.scene().version, fresh.scene().version, "the last known one");
        assert!(drawn(&offline.settle(&camera, PATIENCE)) == drawn(&plain));
        versions.push(fresh.scene().version.clone());
    }
    assert_ne!(versions[0], versions[1]);
}

#[test]
fn what_was_fetched_with_a_token_is_shown_to_nobody_without_it() {
    let world = World::sample(129, 0.0);
    let (token, hash) = http::new_token().unwrap();
    let tokens = world.folder.path().join("tokens");
    std::fs::write(&tokens, format!("world {hash}")).unwrap();
    let store = world.folder.path().join("store");
    let served = serve_with(&[store], &http::Options { tokens: Some(tokens), ..http::Options::default() });
    let url = served.scene("world");
    let disk = Disk::open(&world.folder.path().join("kept"), 64 << 20).unwrap();
    let mut terrain = Terrain::open(&url, kept(&disk, Some(&token), false)).unwrap();
    let camera = headless::overview(terrain.scene(), [320, 240]);
    let view = terrain.settle(&camera, PATIENCE);
    assert!(view.complete);
    // While the server is there, it says so itself.
    assert!(Terrain::open(&url, kept(&disk, None, false)).unwrap_err().to_string().contains("404"));
    drop(served);
    for wrong in [None, Some("0".repeat(64))] {
        let told = Terrain::open(&url, kept(&disk, wrong.as_deref(), true)).unwrap_err().to_string();
        assert!(told.contains("fetched before") && told.contains("token"), "{told}");
    }
    let mut offline = Terrain::open(&url, kept(&disk, Some(&token), true)).unwrap();
    assert!(drawn(&offline.settle(&camera, PATIENCE)) == drawn(&view));
    disk.flush();
    for file in std::fs::read_dir(world.folder.path().join("kept")).unwrap() {
        let bytes = std::fs::read(file.unwrap().path()).unwrap();
        assert!(!bytes.windows(token.len()).any(|window| window == token.as_bytes()), "the token itself");
    }
}

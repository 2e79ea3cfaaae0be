//! Scenes that were fetched before: asked for no more, drawn without the server, and with it again.

use super::*;
use crate::disk::Disk;
use crate::drawing::DrawItem;
use std::path::Path;

fn kept(folder: &Path) -> Disk {
    Disk::open(folder, 64 << 20).unwrap()
}

fn options(encoding: Encoding, disk: &Disk, offline: bool) -> Options {
    let fetch = fetch::Options { encoding, disk: Some(disk.clone()), offline, ..fetch::Options::default() };
    Options { fetch, ..Options::default() }
}

fn drawn(view: &FrameView) -> Vec<(usize, Diamond, u8, Arc<Surface>)> {
    let of = |item: &DrawItem| (item.layer, item.diamond, item.sides, Arc::clone(&item.surface));
    let mut items: Vec<_> = view.items.iter().map(of).collect();
    items.sort_unstable_by_key(|(layer, d, ..)| (*layer, *d));
    items
}

#[test]
fn the_next_session_asks_for_the_description_alone_and_offline_for_nothing() {
    for (encoding, layers) in [(Encoding::Points, 2), (Encoding::Tin, 1)] {
        let folder = tempfile::tempdir().unwrap();
        let served = Served::start(layers, Faults::default());
        let disk = kept(folder.path());
        let cold = open(&served, options(encoding, &disk, false)).settle(&above(), MINUTE);
        assert!(cold.complete && cold.stats.traffic.disk_blobs == 0 && !cold.stats.offline);
        disk.flush();
        drop(disk);
        let disk = kept(folder.path());
        let warm = open(&served, options(encoding, &disk, false)).settle(&above(), MINUTE);
        let traffic = warm.stats.traffic;
        assert_eq!((traffic.requests, traffic.round_trips), (1, 1), "{encoding:?}: {traffic:?}");
        assert!(traffic.disk_bytes > traffic.bytes, "{traffic:?}");
        assert!(drawn(&warm) == drawn(&cold));
        // By request first, then because nobody is there.
        let asked = served.state.requests.load(std::sync::atomic::Ordering::Relaxed);
        let mut forced = open(&served, options(encoding, &disk, true));
        assert!(drawn(&forced.settle(&above(), MINUTE)) == drawn(&cold));
        assert_eq!(forced.offline().as_deref(), Some("--offline"));
        assert_eq!(served.state.requests.load(std::sync::atomic::Ordering::Relaxed), asked);
        let url = served.url.clone();
        drop(served);
        let mut alone = Terrain::open(&url, options(encoding, &disk, false)).unwrap();
        let view = alone.settle(&above(), MINUTE);
        assert!(view.complete && view.stats.offline && drawn(&view) == drawn(&cold));
        assert!(alone.offline().unwrap().contains("is the server running"), "{:?}", alone.offline());
        let stranger = fetch::Options { token: Some("x".into()), ..options(encoding, &disk, true).fetch };
        let told = Terrain::open(&url, Options { fetch: stranger, ..Options::default() }).unwrap_err();
        assert!(told.to_string().contains("fetched before"), "{told}");
    }
}

#[test]
fn what_a_stream_brought_is_kept_too() {
    let folder = tempfile::tempdir().unwrap();
    let served = Served::start(1, Faults::default());
    let disk = kept(folder.path());
    let mut terrain = open(&served, options(Encoding::Points, &disk, false));
    terrain.stream(&above());
    let cold = terrain.settle(&above(), MINUTE);
    assert_eq!(cold.stats.traffic.requests, 2);
    let mut offline = open(&served, options(Encoding::Points, &disk, true));
    // It asks for one, which goes nowhere.
    offline.stream(&above());
    let view = offline.settle(&above(), MINUTE);
    assert!(view.complete && drawn(&view) == drawn(&cold) && view.stats.traffic.requests == 0);
}

#[test]
fn offline_draws_what_is_there_says_so_and_goes_online_again_by_itself() {
    let folder = tempfile::tempdir().unwrap();
    let served = Served::start(1, Faults::default());
    let disk = kept(folder.path());
    let coarse = Options { tolerance_pixels: 20.0, ..options(Encoding::Points, &disk, false) };
    let mut terrain = open(&served, coarse);
    assert!(terrain.settle(&above(), MINUTE).complete);
    let address = served.url.trim_start_matches("http://").to_owned();
    drop(served);
    terrain.set_tolerance_pixels(1.0);
    let view = terrain.settle(&above(), MINUTE);
    assert!(!view.complete && view.stats.offline && view.stats.failed == 0, "{:?}", view.stats);
    assert!(view.error_pixels > 1.0 && view.error_pixels <= 20.0 && terrain.problem().is_none());
    let _served = Served::start_at(&address, 1, Faults::default());
    let until = Instant::now() + MINUTE;
    loop {
        let view = terrain.settle(&above(), Duration::from_millis(100));
        if view.complete {
            assert!(view.error_pixels <= 1.0 && !view.stats.offline && terrain.offline().is_none());
            break;
        }
        assert!(Instant::now() < until, "{:?}", view.stats);
    }
}

#[test]
fn an_entry_that_is_whole_but_wrong_is_fetched_again() {
    let folder = tempfile::tempdir().unwrap();
    let served = Served::start(1, Faults::default());
    let disk = kept(folder.path());
    let cold = open(&served, options(Encoding::Points, &disk, false)).settle(&above(), MINUTE);
    let built = &world()[0];
    let shelf = disk.shelf(&served.url, None);
    let (mut spoilt, scene) = (0, crate::world::scene(1));
    for (_, d, ..) in drawn(&cold).into_iter().take(5) {
        let route = Encoding::Points.route(&scene, 0, d.centre());
        // Of the right length, and then of another.
        let length = if spoilt % 2 == 0 { built.payloads[&d].len() } else { 3 };
        shelf.put(route, d.level(), vec![0xA5; length].into());
        spoilt += 1;
    }
    shelf.put(Encoding::Points.index_route(&scene, 0, 0), 0, Bytes::from_static(b"no page"));
    let warm = open(&served, options(Encoding::Points, &disk, false)).settle(&above(), MINUTE);
    assert!(warm.complete && drawn(&warm) == drawn(&cold), "{:?}", warm.stats);
    let requests = warm.stats.traffic.requests;
    assert!(spoilt == 5 && (3..=12).contains(&requests), "{requests}");
    let again = open(&served, options(Encoding::Points, &disk, false)).settle(&above(), MINUTE);
    assert_eq!(again.stats.traffic.requests, 1);
}

#[test]
fn what_is_drawn_stays_within_the_gpu_whatever_has_arrived_and_moves() {
    let served = Served::start(2, Faults { slow: 0.5, ..Faults::default() });
    let whole = open(&served, Options::default()).settle(&above(), MINUTE);
    let takes = |view: &FrameView, wires| view.items.iter().map(|item| item.gpu_bytes(wires)).sum::<u64>();
    let needed = takes(&whole, false);
    assert!(!whole.limited);
    for (morph_seconds, wires) in [(0.0, false), (0.0, true), (0.5, false)] {
        let gpu_bytes = needed / 3;
        let mut terrain = open(&served, Options { gpu_bytes, morph_seconds, ..Options::default() });
        terrain.set_wires(wires);
        let mut dice = Dice(3);
        for _ in 0..12 {
            let (from, to) = (any_camera(&mut dice), any_camera(&mut dice));
            for step in 0..20 {
                let camera = Camera { eye: from.eye.lerp(to.eye, f64::from(step) / 20.0), ..above() };
                let view = terrain.frame(&camera);
                assert!(takes(&view, wires) <= gpu_bytes, "{} of {gpu_bytes}", takes(&view, wires));
                std::thread::sleep(Duration::from_millis(1));
            }
        }
        let view = terrain.settle(&above(), MINUTE);
        let taken = takes(&view, wires);
        assert!(view.complete && view.limited && view.error_pixels == view.error_pixels_goal, "{view:?}");
        // Half is each layer's; where points move, a third of that is for motions.
        assert!(taken <= gpu_bytes && taken > gpu_bytes / 5, "{taken} of {gpu_bytes}");
    }
}

/// What frames take comes first, then imagery, then diamonds.
#[test]
fn the_gpu_is_shared_by_frames_imagery_and_diamonds() {
    let served = Served::start_draped();
    let gpu_bytes = 90 << 20;
    let mut terrain = open(&served, Options { gpu_bytes, ..Options::default() });
    let shares = |terrain: &Terrain| [terrain.imagery_gpu_bytes(), terrain.layers[0].gpu_bytes];
    // A third is less than two sheets of 16 MiB.
    let [imagery, diamonds] = shares(&terrain);
    assert_eq!((imagery, diamonds), (16 << 20, (74 << 20) - (74 << 20) / 64));
    terrain.set_gpu_taken(60 << 20);
    let [imagery, diamonds] = shares(&terrain);
    assert_eq!((imagery, diamonds), (10 << 20, (20 << 20) - (20 << 20) / 64));
    terrain.set_gpu_taken(87 << 20);
    let [imagery, diamonds] = shares(&terrain);
    assert_eq!((imagery, diamonds), (4 << 20, 0), "the fewest tiles, and no more than the coarsest diamonds");
    assert_eq!(terrain.gpu_least(), 91 << 20);
    terrain.set_texture(None);
    assert_eq!(shares(&terrain), [0, (3 << 20) - (3 << 20) / 64]);
    assert_eq!(terrain.gpu_least(), 87 << 20);
    terrain.set_gpu_taken(0);
    terrain.set_texture(Some(0));
    assert_eq!(shares(&terrain)[0], 16 << 20);
}

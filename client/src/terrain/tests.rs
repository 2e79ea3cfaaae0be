//! A scene streamed from a made server, frame by frame.

mod kept;
mod steps;

use super::*;
use crate::world::{Dice, Faults, Ground, Served, above, any_camera, world};

const MINUTE: Duration = Duration::from_secs(60);

fn open(served: &Served, options: Options) -> Terrain {
    Terrain::open(&served.url, options).unwrap()
}

#[test]
fn settling_reaches_the_asked_error_in_few_round_trips() {
    for layers in [1, 2] {
        let served = Served::start(layers, Faults::default());
        let mut terrain = open(&served, Options::default());
        let camera = above();
        let view = terrain.settle(&camera, MINUTE);
        assert!(view.complete && view.error_pixels <= 1.0, "{view:?}");
        assert_eq!(view.error_pixels, view.error_pixels_goal);
        let stats = view.stats;
        println!("{layers} layers: {stats:?}");
        // Scene, roots with their pages, deeper pages, the rest. On a busy machine one wave of requests may
        // be answered before its last is sent, and count as two: so the best of a few tries.
        let tries = (0..5).map(|_| open(&served, Options::default()).settle(&camera, MINUTE));
        let mut trips = tries.map(|v| v.stats.traffic.round_trips);
        assert!(stats.traffic.round_trips <= 4 || trips.any(|t| t <= 4), "{stats:?}");
        assert!(stats.traffic.errors == 0 && stats.failed == 0 && stats.decoding == 0);
        assert!(stats.points_real > 0 && stats.points_fictitious > 0);
        assert!(stats.first_picture_seconds <= stats.asked_error_seconds);
        assert_eq!(view.items.iter().map(|item| item.layer).max(), Some(layers - 1));
        // Nothing moves, so nothing more is asked for.
        let again = terrain.frame(&camera);
        assert_eq!(again.stats.traffic.requests, stats.traffic.requests);
    }
}

#[test]
fn a_stream_shows_a_view_in_one_round_trip_and_leaves_nothing_to_wish_for() {
    for layers in [1, 2] {
        let served = Served::start(layers, Faults::default());
        let usual = open(&served, Options::default()).settle(&above(), MINUTE);
        let mut terrain = open(&served, Options::default());
        terrain.stream(&above());
        let view = terrain.settle(&above(), MINUTE);
        assert!(view.complete && view.error_pixels <= 1.0);
        assert_eq!((view.error_pixels, view.items.len()), (usual.error_pixels, usual.items.len()));
        let traffic = view.stats.traffic;
        println!("{layers} layers: {traffic:?}, without a stream {:?}", usual.stats.traffic);
        assert_eq!(traffic.requests, 1 + layers as u64, "the scene, and a stream a layer");
        assert_eq!(traffic.errors + traffic.cancelled, 0);
        assert!(traffic.round_trips <= 1 + layers as u64);
    }
}

#[test]
fn a_stream_is_drawn_while_it_comes_and_gets_better() {
    let served = Served::start(1, Faults { slow: 1.0, ..Faults::default() });
    let mut terrain = open(&served, Options::default());
    terrain.stream(&above());
    let (until, mut last, mut pictures) = (Instant::now() + MINUTE, f64::INFINITY, 0);
    while Instant::now() < until {
        let view = terrain.frame(&above());
        assert!(view.error_pixels <= last, "a still camera's picture never gets worse");
        pictures += usize::from(view.error_pixels < last);
        last = view.error_pixels;
        if view.complete {
            break;
        }
        std::thread::sleep(Duration::from_millis(3));
    }
    println!("{pictures} pictures, each with less error");
    assert!(last <= 1.0 && pictures > 5);
    assert_eq!(terrain.frame(&above()).stats.traffic.requests, 2);
}

#[test]
fn a_stream_that_fails_is_endured_and_the_rest_is_wished_for() {
    let faults = [
        Faults { status_500: 1.0, ..Faults::default() },
        Faults { truncated: 1.0, ..Faults::default() },
        Faults { damaged: 0.1, ..Faults::default() },
        Faults { silent: 1.0, ..Faults::default() },
        Faults { absurd: 0.1, ..Faults::default() },
        Faults { garbage: 1.0, ..Faults::default() },
        Faults { bomb: 1.0, ..Faults::default() },
        Faults { unasked: 0.02, ..Faults::default() },
        Faults { endless: 1.0, ..Faults::default() },
    ];
    for fault in faults {
        let served = Served::start(2, Faults { streams_alone: true, ..fault });
        let patience = Duration::from_millis(500);
        let fetch = fetch::Options { patience, ..fetch::Options::default() };
        let mut terrain = open(&served, Options { fetch, ..Options::default() });
        terrain.stream(&above());
        let view = terrain.settle(&above(), MINUTE);
        println!("{fault:?}: {:?}", view.stats.traffic);
        assert!(view.complete && view.error_pixels <= 1.0, "{fault:?}: {:?}", terrain.problem());
        assert!(view.stats.traffic.errors + view.stats.traffic.cancelled > 0, "{fault:?} did nothing");
        // What arrived before is not fetched again.
        let whole: usize = world()[..2].iter().flat_map(|b| b.payloads.values()).map(Vec::len).sum();
        assert!(fault.truncated == 0.0 || view.stats.traffic.bytes < 2 * whole as u64);
    }
}

#[test]
fn a_stream_of_a_scene_that_is_gone_is_noticed() {
    let served = Served::start(1, Faults::default());
    let mut terrain = open(&served, Options::default());
    served.misbehave(Faults { gone: true, ..Faults::default() });
    terrain.stream(&above());
    let view = terrain.settle(&above(), MINUTE);
    assert!(terrain.scene_changed() && !view.complete);
}

#[test]
fn a_stream_for_a_view_that_moved_away_or_that_memory_cannot_hold_is_dropped() {
    let served = Served::start(1, Faults { slow: 1.0, ..Faults::default() });
    let memory_bytes = 100 * Points::bytes(&world()[0].layer.forest, 0);
    let mut terrain = open(&served, Options { memory_bytes, ..Options::default() });
    terrain.stream(&above());
    let view = terrain.settle(&above(), MINUTE);
    assert!(view.complete && view.error_pixels == view.error_pixels_goal);
    assert!(view.stats.resident_bytes <= memory_bytes);
    let mut terrain = open(&served, Options { tolerance_pixels: 0.2, ..Options::default() });
    terrain.stream(&above());
    let away = Camera { target: above().eye + DVec3::Z, ..above() };
    let until = Instant::now() + MINUTE;
    while terrain.fetcher.is_streaming() && Instant::now() < until {
        terrain.frame(&away);
        std::thread::sleep(Duration::from_millis(2));
    }
    assert_eq!(terrain.frame(&away).stats.traffic.cancelled, 1);
}

#[test]
fn a_stream_waits_for_frames_that_do_not_come() {
    let served = Served::start(1, Faults { heavy: true, ..Faults::default() });
    let mut terrain = open(&served, Options::default());
    terrain.stream(&above());
    // Until nothing more arrives, on a machine that others keep busy, too.
    let mut last = (0, Instant::now());
    while last.1.elapsed() < Duration::from_secs(3) {
        let bytes = terrain.fetcher.traffic().bytes;
        if bytes != last.0 {
            last = (bytes, Instant::now());
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    println!("{} bytes, then it waits", last.0);
    // Pages of the index take more while they wait than they did on the wire.
    assert!(last.0 > 7 << 19 && last.0 < 8 << 20, "{}", last.0);
    assert!(terrain.fetcher.is_streaming());
}

#[test]
fn from_the_first_picture_on_something_is_always_drawn_and_it_gets_better() {
    let served = Served::start(2, Faults { slow: 0.5, ..Faults::default() });
    let mut terrain = open(&served, Options::default());
    let camera = above();
    let until = Instant::now() + MINUTE;
    let mut last = f64::INFINITY;
    let mut pictures = 0;
    while Instant::now() < until {
        let view = terrain.frame(&camera);
        assert!(view.error_pixels <= last, "a still camera's picture never gets worse");
        assert!(view.error_pixels.is_finite() || pictures == 0);
        pictures += usize::from(view.error_pixels < last);
        last = view.error_pixels;
        if view.complete {
            break;
        }
        std::thread::sleep(Duration::from_millis(3));
    }
    println!("{pictures} pictures, each with less error");
    assert!(last <= 1.0 && pictures > 2);
}

#[test]
fn a_flight_in_little_memory_stays_within_it_and_never_shows_nothing() {
    let served = Served::start(1, Faults::default());
    let memory_bytes = 400 * Points::bytes(&world()[0].layer.forest, 0);
    let mut terrain = open(&served, Options { memory_bytes, ..Options::default() });
    terrain.settle(&above(), MINUTE);
    let mut dice = Dice(5);
    for _ in 0..25 {
        let (from, to) = (any_camera(&mut dice), any_camera(&mut dice));
        for step in 0..20 {
            let eye = from.eye.lerp(to.eye, f64::from(step) / 20.0);
            let target = DVec3::new(505_000.0, 4_002_000.0, 100.0);
            let view = terrain.frame(&Camera { eye, target, ..from });
            assert!(!view.items.is_empty());
            assert!(view.stats.resident_bytes <= memory_bytes);
            assert!(view.stats.frame_seconds < 0.05, "{}", view.stats.frame_seconds);
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    let view = terrain.settle(&above(), MINUTE);
    assert!(view.complete && view.stats.splits_drawn <= 300);
    assert_eq!(view.error_pixels, view.error_pixels_goal, "the best that the memory allows");
}

/// What this thread has worked, whoever else was at work meanwhile.
fn worked() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

/// Streams from a server that misbehaves; the view at the end, and the problem. No frame takes long: the most work in one
/// is told, and none waits, neither for what never comes nor until that is given up.
fn endure(faults: Faults, seconds: u64) -> (FrameView, f64, Option<String>) {
    let served = Served::start(2, faults);
    let patience = Duration::from_millis(500);
    let fetch = fetch::Options { patience, ..fetch::Options::default() };
    let mut terrain = open(&served, Options { fetch, ..Options::default() });
    let until = Instant::now() + Duration::from_secs(seconds);
    let (mut most, mut longest) = (0.0f64, Duration::ZERO);
    loop {
        let (started, before) = (Instant::now(), worked());
        let view = terrain.frame(&above());
        most = most.max(worked() - before);
        longest = longest.max(started.elapsed());
        if view.complete || Instant::now() > until {
            println!("{faults:?}: {:.1} ms at most, {longest:?}, {:?}", most * 1e3, view.stats.traffic);
            assert!(longest < patience, "{longest:?} {faults:?}");
            return (view, most, terrain.problem().map(str::to_owned));
        }
        std::thread::sleep(Duration::from_millis(3));
    }
}

#[test]
fn a_server_that_misbehaves_now_and_then_is_endured_without_a_slow_frame() {
    let some = 0.25;
    let faults = [
        Faults { status_500: some, ..Faults::default() },
        Faults { truncated: some, ..Faults::default() },
        Faults { damaged: some / 5.0, ..Faults::default() },
        Faults { silent: some, ..Faults::default() },
        Faults { absurd: some / 20.0, ..Faults::default() },
        Faults { garbage: some, ..Faults::default() },
        Faults { bomb: some, ..Faults::default() },
    ];
    std::thread::scope(|scope| {
        for faults in faults {
            scope.spawn(move || {
                // Room for wishes that were unlucky five times and rest.
                let (view, most, problem) = endure(faults, 60);
                assert!(view.complete && view.error_pixels <= 1.0, "{faults:?} {problem:?}");
                assert!(most < 0.05, "{most} s {faults:?}");
            });
        }
    });
}

#[test]
fn a_server_that_always_misbehaves_is_reported_without_a_slow_frame() {
    let faults = [
        Faults { status_500: 1.0, ..Faults::default() },
        Faults { damaged: 1.0, ..Faults::default() },
        Faults { garbage: 1.0, ..Faults::default() },
        Faults { bomb: 1.0, ..Faults::default() },
        Faults { silent: 1.0, ..Faults::default() },
    ];
    std::thread::scope(|scope| {
        for faults in faults {
            scope.spawn(move || {
                let (view, most, problem) = endure(faults, 9);
                assert!(!view.complete && view.stats.failed > 0 && problem.is_some(), "{faults:?}");
                assert!(most < 0.05, "{most} s {faults:?}");
                assert_eq!(view.items.is_empty(), faults.bomb == 0.0, "roots alone make a picture");
            });
        }
    });
}

#[test]
fn settling_ends_early_where_nothing_more_can_come() {
    let served = Served::start(1, Faults { status_500: 0.0, ..Faults::default() });
    let mut terrain = open(&served, Options::default());
    served.misbehave(Faults { status_500: 1.0, ..Faults::default() });
    let started = Instant::now();
    let view = terrain.settle(&above(), MINUTE);
    assert!(!view.complete && started.elapsed() < Duration::from_secs(15));
    assert!(terrain.problem().unwrap().contains("500"));
}

#[test]
fn a_new_version_of_the_scene_is_noticed_and_the_picture_stays() {
    let served = Served::start(1, Faults::default());
    let mut terrain = open(&served, Options { tolerance_pixels: 20.0, ..Options::default() });
    let view = terrain.settle(&above(), MINUTE);
    assert!(view.complete && !terrain.scene_changed());
    served.misbehave(Faults { gone: true, ..Faults::default() });
    terrain.set_tolerance_pixels(1.0);
    let view = terrain.settle(&above(), MINUTE);
    assert!(terrain.scene_changed() && !view.items.is_empty() && !view.complete);
}

/// Lattice points of the terrain, far from what has no data.
fn places() -> impl Iterator<Item = [i64; 2]> {
    (20..470).step_by(5).flat_map(|y| (440..750).step_by(5).map(move |x| [x, y]))
}

/// Flies in and out again above resident data. The largest change of a height from one frame to the next, in
/// metres, and the number of frames in which something moved.
fn largest_step(morph_seconds: f64) -> (f64, usize) {
    let served = Served::start(1, Faults::default());
    let mut terrain = open(&served, Options { tolerance_pixels: 4.0, ..Options::default() });
    let low = above().target + DVec3::new(0.0, -1500.0, 1800.0);
    // In, a rest, and out.
    let camera = |frame: i32| {
        let part = (f64::from(frame) / 25.0).min(1.0).min(f64::from(75 - frame) / 25.0);
        Camera { eye: above().eye.lerp(low, part), ..above() }
    };
    for frame in 0..=25 {
        assert!(terrain.settle(&camera(frame), MINUTE).complete);
    }
    // All is there: the same frames, with motions and without.
    terrain.layers[0].morphs = Morphs::new(morph_seconds);
    terrain.planes = None;
    let layer = terrain.scene.layers[0].clone();
    let (mut last, mut most, mut moving) = (None::<Vec<f64>>, 0.0f64, 0);
    for frame in 0..=75 {
        let camera = camera(frame);
        let view = terrain.frame_at(&camera, 1000.0 + f64::from(frame) / 60.0);
        let planes = camera.planes();
        moving += usize::from(view.moving > 0);
        assert!(
            view.complete && view.error_pixels.is_finite() && view.error_pixels >= view.error_pixels_goal
        );
        assert!(view.stats.frame_seconds < 0.1, "{}", view.stats.frame_seconds);
        let mut ground = Ground::new(layer.forest, &view.items);
        let heights: Vec<f64> = places()
            .map(|p| {
                let [x, y] = layer.position(p.map(|i| u32::try_from(i).unwrap()));
                // Items out of view are left out.
                let sees = planes.iter().all(|s| s.normal.dot(DVec3::new(x, y, 300.0)) + s.offset > 400.0);
                if sees { ground.height(p).unwrap() * layer.quantum } else { f64::NAN }
            })
            .collect();
        for (a, b) in last.iter().flatten().zip(&heights) {
            most = most.max((a - b).abs());
        }
        last = Some(heights);
    }
    (most, moving)
}

#[test]
fn a_flight_with_motions_never_jumps() {
    let (jump, none) = largest_step(0.0);
    let (step, moving) = largest_step(0.3);
    println!("{jump:.2} m at once, {step:.2} m in the largest step of motions, which {moving} frames had");
    assert_eq!(none, 0);
    // 18 frames a motion, one and a half times as fast in its middle: a twelfth.
    assert!(jump > 1.0 && step < jump / 10.0 && moving > 40, "{jump} {step} {moving}");
}

#[test]
fn what_moves_is_told_counts_as_unsplit_and_is_waited_for() {
    let served = Served::start(1, Faults::default());
    let mut terrain =
        open(&served, Options { morph_seconds: 0.5, tolerance_pixels: 8.0, ..Options::default() });
    let view = terrain.settle(&above(), MINUTE);
    assert!(view.complete && view.moving == 0 && view.error_pixels <= 8.0);
    terrain.set_tolerance_pixels(2.0);
    let (mut frames, mut last) = (0, view.error_pixels);
    let until = Instant::now() + MINUTE;
    let view = loop {
        let view = terrain.frame(&above());
        frames += usize::from(view.moving > 0);
        if view.moving > 0 && view.complete {
            assert!(view.error_pixels > 2.0, "{}", view.error_pixels);
        }
        last = last.max(view.error_pixels);
        if (view.complete && view.moving == 0) || Instant::now() > until {
            break view;
        }
        std::thread::sleep(Duration::from_millis(5));
    };
    println!("{frames} frames with motions, largest error {last:.2} pixels");
    assert!(frames > 5 && view.complete && view.error_pixels <= 2.0);
    // What the last frame did not see has nothing to move from.
    let away = Camera { target: above().eye + DVec3::Z, ..above() };
    terrain.frame(&away);
    terrain.set_tolerance_pixels(8.0);
    let view = terrain.frame(&above());
    assert_eq!((view.moving, view.complete), (0, true));
    for morph_seconds in [-1.0, f64::NAN, 61.0] {
        let options = Options { morph_seconds, ..Options::default() };
        assert!(matches!(Terrain::open(&served.url, options), Err(TerrainError::Morph(_))));
    }
}

#[test]
fn wrong_options_are_refused() {
    let served = Served::start(2, Faults::default());
    let tin = tin_options();
    // The water has no triangles: all of a scene is streamed in one encoding, or not at all.
    let error = Terrain::open(&served.url, tin.clone()).unwrap_err().to_string();
    assert!(error.contains("'water' is offered as points, asked for as tin: build"), "{error}");
    let served = Served::start(1, Faults::default());
    assert!(Terrain::open(&served.url, tin).is_ok());
    let zero = Options { tolerance_pixels: 0.0, ..Options::default() };
    assert!(matches!(Terrain::open(&served.url, zero), Err(TerrainError::Tolerance(_))));
}

fn tin_options() -> Options {
    let fetch = fetch::Options { encoding: Encoding::Tin, ..fetch::Options::default() };
    Options { fetch, ..Options::default() }
}

#[test]
fn irregular_triangles_settle_at_the_asked_error_within_their_memory() {
    let served = Served::start(1, Faults::default());
    let mut terrain = open(&served, tin_options());
    let view = terrain.settle(&above(), MINUTE);
    assert!(view.complete && view.error_pixels <= 1.0, "{:?}", terrain.problem());
    let stats = view.stats;
    println!("{stats:?}");
    assert!(stats.triangles > 0 && stats.points_real == 0 && stats.traffic.errors == 0);
    assert!(view.items.iter().all(|item| item.surface.tin().is_some()), "one encoding in a cut");
    // In a third of the memory, it shows the best that fits.
    let memory_bytes = stats.resident_bytes / 3;
    let mut terrain = open(&served, Options { memory_bytes, ..tin_options() });
    let less = terrain.settle(&above(), MINUTE);
    assert!(less.complete && less.stats.resident_bytes <= memory_bytes, "{:?}", less.stats);
    assert!(less.error_pixels > view.error_pixels && less.error_pixels == less.error_pixels_goal);
    // Streams hold points: asking for one changes nothing.
    terrain.stream(&above());
    assert!(!terrain.fetcher.is_streaming());
}

#[test]
fn irregular_triangles_that_are_damaged_are_refused_and_fetched_again() {
    for faults in
        [Faults { damaged: 0.05, ..Faults::default() }, Faults { garbage: 0.2, ..Faults::default() }]
    {
        let served = Served::start(1, faults);
        let mut terrain = open(&served, tin_options());
        let view = terrain.settle(&above(), MINUTE);
        assert!(view.complete && view.error_pixels <= 1.0, "{faults:?}: {:?}", terrain.problem());
        assert!(view.stats.traffic.errors > 0, "{faults:?} did nothing");
    }
}

/// A checksum does not help against a server that means it.
#[test]
fn hostile_triangles_are_refused() {
    let served = Served::start(1, Faults { forged: 0.1, ..Faults::default() });
    let mut terrain = open(&served, tin_options());
    let until = Instant::now() + MINUTE;
    let mut view = terrain.settle(&above(), MINUTE);
    // Of some four thousand payloads one may be forged five times in a row: then it rests, and is asked for again.
    while !view.complete && Instant::now() < until {
        std::thread::sleep(Duration::from_millis(100));
        view = terrain.settle(&above(), MINUTE);
    }
    assert!(view.complete, "{:?}", terrain.problem());
    assert!(view.stats.traffic.errors > 0);
    let served = Served::start(1, Faults { forged: 1.0, ..Faults::default() });
    let mut terrain = open(&served, tin_options());
    let view = terrain.settle(&above(), MINUTE);
    assert!(!view.complete, "{:?}", view.stats);
    assert!(view.items.is_empty(), "{:?}", view.stats);
    assert!(terrain.problem().is_some(), "{:?}", view.stats);
}

#[test]
fn a_hidden_layer_is_neither_drawn_nor_fetched_and_comes_back_without_its_neighbour_suffering() {
    let served = Served::start(2, Faults::default());
    let layers_of = |view: &FrameView| view.items.iter().map(|item| item.layer).collect::<HashSet<_>>();
    let both = open(&served, Options::default()).settle(&above(), MINUTE);
    assert_eq!(layers_of(&both), HashSet::from([0, 1]));
    // From the beginning: not a byte of it.
    let alone = Options { layers: Some(vec!["terrain".into()]), ..Options::default() };
    let mut terrain = open(&served, alone);
    assert_eq!((terrain.is_shown(0), terrain.is_shown(1), terrain.is_shown(2)), (true, false, false));
    assert_eq!(terrain.shown_scene().layers.len(), 1);
    let view = terrain.settle(&above(), MINUTE);
    assert!(view.complete && view.error_pixels <= 1.0);
    assert_eq!(layers_of(&view), HashSet::from([0]));
    assert!(view.stats.traffic.bytes < both.stats.traffic.bytes, "{:?}", view.stats.traffic);
    assert_eq!(view.items.len(), both.items.iter().filter(|item| item.layer == 0).count());
    // A stream, too, is of what is shown.
    let mut streamed = open(&served, Options { layers: Some(vec!["water".into()]), ..Options::default() });
    streamed.stream(&above());
    let water = streamed.settle(&above(), MINUTE);
    assert_eq!((layers_of(&water), water.stats.traffic.requests), (HashSet::from([1]), 2));
    // Shown, it comes, and all of it.
    let before = view.stats.traffic.requests;
    terrain.set_shown(1, true);
    let view = terrain.settle(&above(), MINUTE);
    assert_eq!((layers_of(&view), view.items.len()), (HashSet::from([0, 1]), both.items.len()));
    assert!(view.stats.traffic.requests > before);
    // Hidden while nothing has arrived yet: nothing more is asked for.
    terrain.set_shown(0, false);
    terrain.set_shown(1, false);
    let none = terrain.settle(&above(), MINUTE);
    assert!(none.complete && none.items.is_empty() && none.error_pixels == 0.0, "{none:?}");
    assert_eq!(none.stats.traffic.requests, view.stats.traffic.requests);
    terrain.set_shown(0, true);
    let again = terrain.settle(&above(), MINUTE);
    assert_eq!(layers_of(&again), HashSet::from([0]));
    assert_eq!(
        again.stats.traffic.requests, view.stats.traffic.requests,
        "what is resident is not fetched again"
    );
}

#[test]
fn a_layer_that_the_scene_has_not_is_refused_with_those_it_has() {
    let served = Served::start(2, Faults::default());
    let asked = Options { layers: Some(vec!["terrain".into(), "lava".into()]), ..Options::default() };
    let error = Terrain::open(&served.url, asked).unwrap_err().to_string();
    assert!(error.contains("no layer 'lava'") && error.contains("terrain, water"), "{error}");
}

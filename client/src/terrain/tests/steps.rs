//! A series of waves: one step is drawn, without holes, and the next are there in time.

use super::*;
use crate::player::Course;
use crate::world::{BEFORE_WAVES, WAVES};

const ALL: usize = BEFORE_WAVES + WAVES;
const FORWARD: Option<Course> = Some(Course { is_backward: false, is_round: false });

/// The steps that a frame draws.
fn steps_of(view: &FrameView) -> Vec<usize> {
    let steps = view.items.iter().filter_map(|item| item.layer.checked_sub(BEFORE_WAVES));
    steps.collect::<std::collections::BTreeSet<_>>().into_iter().collect()
}

/// Frames until so many steps are there ahead.
fn look_ahead(terrain: &mut Terrain, steps: usize) -> FrameView {
    let until = Instant::now() + MINUTE;
    loop {
        let view = terrain.frame(&above());
        if view.stats.steps_ahead == steps && view.complete {
            return view;
        }
        assert!(Instant::now() < until, "{:?}", view.stats);
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn one_step_is_drawn_and_nothing_of_the_others_is_fetched() {
    let served = Served::start(ALL, Faults::default());
    let mut terrain = open(&served, Options::default());
    let view = terrain.settle(&above(), MINUTE);
    assert!(view.complete && view.error_pixels <= 1.0 && view.late == 0);
    assert_eq!((steps_of(&view), terrain.step_drawn(0), view.stats.steps_ahead), (vec![0], Some(0), 0));
    for layer in BEFORE_WAVES + 1..ALL {
        assert_eq!(terrain.layers[layer].index.pages(), 0);
        assert!(!terrain.is_ready_at(10.0 * (layer - BEFORE_WAVES) as f64));
    }
    assert!(terrain.is_ready_at(9.9), "the same step");
    let named = |terrain: &Terrain| -> Vec<String> {
        terrain.drawn_layers().into_iter().map(|layer| layer.name).collect()
    };
    assert_eq!(named(&terrain), ["terrain", "water", "waves"]);
    // Another time, and back: what was drawn before is still there.
    terrain.set_time(20.0, None);
    let later = terrain.settle(&above(), MINUTE);
    assert!(later.complete && later.error_pixels <= 1.0);
    assert_eq!(steps_of(&later), [2]);
    assert_eq!(named(&terrain), ["terrain", "water", "waves"]);
    terrain.set_time(0.0, None);
    let again = terrain.frame(&above());
    assert_eq!((steps_of(&again), again.items.len()), (vec![0], view.items.len()));
    let again = terrain.settle(&above(), MINUTE);
    assert!(again.complete);
    assert_eq!(again.stats.traffic.requests, later.stats.traffic.requests);
    // Opened at a time, it begins there; and a stream is of that step.
    let mut terrain = open(&served, Options { time: 30.0, ..Options::default() });
    terrain.stream(&above());
    let view = terrain.settle(&above(), MINUTE);
    assert_eq!((steps_of(&view), view.stats.traffic.requests), (vec![3], 4), "the scene and three streams");
    // Hidden by its name, or alone.
    terrain.set_shown(BEFORE_WAVES, false);
    assert!(steps_of(&terrain.settle(&above(), MINUTE)).is_empty() && terrain.is_ready_at(0.0));
    let mut alone = open(&served, Options { layers: Some(vec!["waves".into()]), ..Options::default() });
    let view = alone.settle(&above(), MINUTE);
    assert!(view.complete && view.items.iter().all(|item| item.layer == BEFORE_WAVES));
    let step = Options { layers: Some(vec!["waves.1".into()]), ..Options::default() };
    let error = Terrain::open(&served.url, step).unwrap_err().to_string();
    assert!(error.contains("terrain, water, waves"), "{error}");
}

#[test]
fn the_step_before_stays_until_the_next_covers_the_view() {
    let served = Served::start(ALL, Faults::default());
    let mut terrain = open(&served, Options::default());
    let first = terrain.settle(&above(), MINUTE);
    served.misbehave(Faults { slow: 1.0, ..Faults::default() });
    terrain.set_time(20.0, None);
    let (until, mut late) = (Instant::now() + MINUTE, 0);
    loop {
        let view = terrain.frame(&above());
        let steps = steps_of(&view);
        assert!(view.error_pixels.is_finite() && steps.len() == 1, "{steps:?}: always one, and a whole one");
        if steps == [0] {
            assert!(view.late == 1 && !view.complete && terrain.step_drawn(0) == Some(0));
            assert_eq!(view.items.len(), first.items.len(), "as exact as it was");
            late += 1;
        } else {
            assert_eq!((steps, view.late), (vec![2], 0));
            if view.complete {
                break;
            }
        }
        assert!(Instant::now() < until, "{:?}", view.stats);
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(late > 3, "{late} frames with the step before");
    // Nothing is known of a step: it is not drawn, whatever the time says.
    served.misbehave(Faults { status_500: 1.0, ..Faults::default() });
    terrain.set_time(30.0, None);
    let view = terrain.settle(&above(), MINUTE);
    assert!(!view.complete && view.late == 1 && steps_of(&view) == [2], "{:?}", view.stats);
    assert!(terrain.problem().is_some());
}

#[test]
fn while_time_runs_the_next_steps_are_fetched_and_are_there_at_once() {
    let served = Served::start(ALL, Faults::default());
    let mut terrain = open(&served, Options { morph_seconds: 0.2, ..Options::default() });
    terrain.settle(&above(), MINUTE);
    terrain.set_time(0.0, FORWARD);
    let view = look_ahead(&mut terrain, 3);
    assert_eq!(steps_of(&view), [0], "nothing more is drawn for it");
    assert!(terrain.is_ready_at(10.0) && terrain.is_ready_at(30.0));
    let requests = view.stats.traffic.requests;
    for step in 1..WAVES {
        terrain.set_time(10.0 * step as f64, FORWARD);
        let view = terrain.frame(&above());
        assert!(view.complete && view.error_pixels <= 1.0 && view.late == 0, "step {step}: {view:?}");
        assert_eq!((steps_of(&view), view.moving), (vec![step], 0), "it does not move there");
        assert_eq!(view.stats.traffic.requests, requests);
    }
    // Round and round, and the other way: what comes next differs.
    terrain.set_time(30.0, Some(Course { is_backward: false, is_round: true }));
    terrain.frame(&above());
    let names: Vec<usize> = terrain.steps.ahead().into_iter().map(|layer| layer - BEFORE_WAVES).collect();
    assert_eq!(names, [0, 1, 2]);
    terrain.set_time(20.0, Some(Course { is_backward: true, is_round: false }));
    terrain.frame(&above());
    let names: Vec<usize> = terrain.steps.ahead().into_iter().map(|layer| layer - BEFORE_WAVES).collect();
    assert_eq!(names, [1, 0]);
    // What cannot be had is not waited for.
    let mut terrain = open(&served, Options::default());
    terrain.settle(&above(), MINUTE);
    served.misbehave(Faults { status_500: 1.0, ..Faults::default() });
    terrain.set_time(0.0, FORWARD);
    let until = Instant::now() + MINUTE;
    while !terrain.is_ready_at(10.0) {
        assert!(terrain.frame(&above()).complete && Instant::now() < until);
        std::thread::sleep(Duration::from_millis(5));
    }
    assert!(terrain.problem().is_some());
}

#[test]
fn what_is_drawn_has_the_first_right_to_the_memory() {
    let served = Served::start(ALL, Faults::default());
    let mut dice = Dice(5);
    let surface = Points::bytes(&world()[BEFORE_WAVES].layer.forest, 0);
    for surfaces in [30, 120, 1000] {
        let memory_bytes = surfaces * surface * 4;
        let options = Options { memory_bytes, tolerance_pixels: 0.2, ..Options::default() };
        let [mut still, mut playing] = [0, 1].map(|_| open(&served, options.clone()));
        let mut seconds = 0.0;
        for _ in 0..6 {
            let camera = any_camera(&mut dice);
            still.set_time(seconds, None);
            playing.set_time(seconds, FORWARD);
            let expected = still.settle(&camera, MINUTE);
            let found = playing.settle(&camera, MINUTE);
            assert!(expected.complete && found.complete);
            assert_eq!(found.error_pixels, expected.error_pixels, "nothing is taken from it");
            assert_eq!(found.items.len(), expected.items.len());
            for _ in 0..8 {
                playing.frame(&camera);
            }
            let of = |layer: usize| playing.layers[layer].ideal.bytes();
            let all: usize = (BEFORE_WAVES..ALL).map(of).sum();
            // The roots of what is drawn and of the next step, whatever the memory.
            assert!(all <= playing.layers[BEFORE_WAVES].memory_bytes + 2 * surface, "{all}");
            seconds = (seconds + 10.0) % 40.0;
        }
    }
}

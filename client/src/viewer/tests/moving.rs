//! What moves the eye: mouse, wheel, fingers, keys, and where it begins.

use super::*;

#[test]
fn what_is_grabbed_goes_with_the_mouse() {
    let mut hand = Hand::new(Some(looking_down()));
    let [from, to] = hand.solid();
    let (grabbed, before) = (hand.seen_at(from), hand.camera());
    hand.drag(from, to, PointerButton::Primary, Modifiers::NONE);
    let moved = hand.camera().eye - before.eye;
    assert!(moved.truncate().length() > 1.0 && moved.z == 0.0, "{moved}");
    let clip = hand.camera().clip_from_eye(0.1).project_point3((grabbed - hand.camera().eye).as_vec3());
    let at = [500.0 + 500.0 * clip.x, 350.0 - 350.0 * clip.y];
    assert!((at[0] - to.x).hypot(at[1] - to.y) < 1.0, "{at:?}");
}

#[test]
fn a_drag_with_control_or_the_middle_button_turns_around_what_is_grabbed() {
    for (button, modifiers) in [
        (PointerButton::Primary, Modifiers::COMMAND),
        (PointerButton::Middle, Modifiers::NONE),
        (PointerButton::Secondary, Modifiers::NONE),
    ] {
        let mut hand = Hand::new(Some(looking_down()));
        let [from, to] = hand.solid();
        let (grabbed, before) = (hand.seen_at(from), hand.camera());
        hand.drag(from, to + vec2(60.0, 40.0), button, modifiers);
        let [old, new] = [before, hand.camera()].map(|camera| (camera.eye - grabbed).length());
        assert!((old - new).abs() < 1e-6 * old, "{button:?}: the distance stays");
        assert!((hand.camera().eye - before.eye).length() > 0.05 * old, "{button:?}: the eye moves");
    }
}

#[test]
fn the_wheel_goes_to_the_cursor() {
    let mut hand = Hand::new(Some(looking_down()));
    let [at, _] = hand.solid();
    let (point, before) = (hand.seen_at(at), hand.camera());
    let wheel = Event::MouseWheel {
        unit: egui::MouseWheelUnit::Line,
        delta: vec2(0.0, 3.0),
        modifiers: Modifiers::NONE,
        phase: egui::TouchPhase::Move,
        source: egui::MouseWheelSource::Wheel,
    };
    hand.frame(&[Event::PointerMoved(at)]);
    hand.frame(&[wheel]);
    (0..60).for_each(|_| hand.frame(&[]));
    let [old, new] = [before, hand.camera()].map(|camera| (camera.eye - point).length());
    assert!(new < 0.9 * old, "{old} {new}");
    let apart = (hand.seen_at(at) - point).length();
    assert!(apart < 0.02 * new, "the point stays under the cursor: {apart} of {new}");
}

#[test]
fn keys_fly_and_go_home() {
    let mut hand = Hand::new(None);
    let home = hand.camera();
    hand.key(Key::W, true);
    (0..30).for_each(|_| hand.frame(&[]));
    hand.key(Key::W, false);
    let flown = hand.camera().eye - home.eye;
    assert!(flown.y > 0.0 && flown.x.abs() < 1e-6 * flown.y, "north: {flown}");
    let stopped = hand.camera();
    hand.frame(&[]);
    assert_eq!(hand.camera(), stopped);
    // Down into the ground: not below it.
    hand.key(Key::Q, true);
    (0..600).for_each(|_| hand.frame(&[]));
    hand.key(Key::Q, false);
    let (eye, look) = (hand.camera().eye, hand.viewer.look.exaggeration);
    let items = hand.viewer.items();
    let layers = &hand.viewer.terrain.scene().layers;
    if let Some(ground) = hand.viewer.picker.ground(layers, &items, look, eye.truncate()) {
        assert!(eye.z >= ground, "{eye} under {ground}");
    }
    hand.key(Key::H, true);
    hand.settle();
    assert!((hand.camera().eye - home.eye).length() < 1e-6, "home again");
}

#[test]
fn a_double_click_flies_there() {
    let mut hand = Hand::new(Some(looking_down()));
    let [at, _] = hand.solid();
    let (point, before) = (hand.seen_at(at), hand.camera());
    hand.click(at);
    hand.click(at);
    assert!(hand.viewer.controls.is_gliding());
    hand.settle();
    assert!((hand.camera().target - point).length() < 1e-6);
    assert!((hand.camera().eye - point).length() < 0.5 * (before.eye - point).length());
}

/// The places that are measured stay as they were, whatever was clicked before.
#[test]
fn a_double_click_marks_nothing() {
    let mut hand = Hand::new(Some(looking_down()));
    let [a, b] = hand.solid();
    let twice = |hand: &mut Hand, at: Pos2| {
        hand.seconds += 5.0;
        hand.click(at);
        hand.click(at);
        assert!(hand.viewer.controls.is_gliding());
        // It does not go on, so that places stay where they are seen.
        hand.viewer.controls = Controls::new(hand.camera());
    };
    twice(&mut hand, a);
    assert!(hand.viewer.marks().is_empty(), "{:?}", hand.viewer.marks());
    for at in [a, b] {
        hand.seconds += 5.0;
        hand.click(at);
    }
    let marks = hand.viewer.marks().to_vec();
    assert_eq!(marks.len(), 2);
    let [c, _] = hand.solid();
    twice(&mut hand, c);
    assert_eq!(hand.viewer.marks(), marks);
    twice(&mut hand, c);
    assert_eq!(hand.viewer.marks(), marks, "nor the next one");
}

#[test]
fn two_fingers_turn_what_is_between_them() {
    let mut hand = Hand::new(None);
    let [at, _] = hand.solid();
    let before = hand.camera();
    let heading = hand.viewer.controls.heading();
    let touch = |id: u64, phase: egui::TouchPhase, pos: Pos2| Event::Touch {
        device_id: egui::TouchDeviceId(1),
        id: egui::TouchId(id),
        phase,
        pos,
        force: None,
    };
    let fingers = |angle: f32| [1.0, -1.0].map(|side| at + side * 60.0 * vec2(angle.cos(), angle.sin()));
    let [a, b] = fingers(0.0);
    // The first finger is the pointer, too.
    hand.frame(&[Event::PointerMoved(a)]);
    hand.frame(&[touch(1, egui::TouchPhase::Start, a), touch(2, egui::TouchPhase::Start, b)]);
    for i in 1..=10 {
        let [a, b] = fingers(0.05 * i as f32);
        hand.frame(&[touch(1, egui::TouchPhase::Move, a), touch(2, egui::TouchPhase::Move, b)]);
    }
    // Clockwise on the screen: the view turns to the left.
    let turned = hand.viewer.controls.heading() - heading;
    assert!((turned + 0.5).abs() < 0.1, "{turned}");
    let distance = |camera: &Camera| (camera.target - camera.eye).length();
    assert!((distance(&hand.camera()) / distance(&before) - 1.0).abs() < 0.1, "they did not spread");
    // They part, as a window tells of it: the first of them is a button held down, too.
    hand.frame(&[touch(1, egui::TouchPhase::End, a), touch(2, egui::TouchPhase::End, b)]);
    hand.settle();
    let (before, heading) = (hand.camera(), hand.viewer.controls.heading());
    let [at, _] = hand.solid();
    let point = hand.seen_at(at);
    let fingers = |apart: f32| [1.0, -1.0].map(|side| at + vec2(side * apart, 0.0));
    let [a, b] = fingers(40.0);
    let modifiers = Modifiers::NONE;
    let press = |pos: Pos2, pressed: bool| Event::PointerButton {
        pos,
        button: PointerButton::Primary,
        pressed,
        modifiers,
    };
    hand.frame(&[touch(1, egui::TouchPhase::Start, a), Event::PointerMoved(a), press(a, true)]);
    hand.frame(&[touch(2, egui::TouchPhase::Start, b)]);
    for i in 1..=10 {
        let [a, b] = fingers(40.0 + 4.0 * i as f32);
        hand.frame(&[
            touch(1, egui::TouchPhase::Move, a),
            Event::PointerMoved(a),
            touch(2, egui::TouchPhase::Move, b),
        ]);
    }
    let [old, new] = [before, hand.camera()].map(|camera| (camera.eye - point).length());
    assert!((new / old - 0.5).abs() < 0.1, "{old} {new}");
    assert!((hand.viewer.controls.heading() - heading).abs() < 0.05);
}

#[test]
fn what_is_in_the_middle_stays_there_while_heights_grow() {
    let mut hand = Hand::new(Some(looking_down()));
    let before = hand.camera();
    let ground = hand.viewer.reach(hand.viewer.middle());
    hand.viewer.set_exaggeration(4.0);
    let after = hand.camera();
    let drawn = ground.with_z(4.0 * ground.z);
    assert!(((after.eye - drawn) - (before.eye - ground)).length() < 1e-6, "{} {}", before.eye, after.eye);
    hand.settle();
    let found = hand.viewer.reach(hand.viewer.middle());
    assert!((found - drawn).length() < 0.05 * (after.eye - drawn).length(), "{found} {drawn}");
}

#[test]
fn the_whole_scene_lies_beside_the_panel() {
    let mut hand = Hand::new(None);
    let covered = hand.viewer.covered;
    assert!(covered > 200 && covered < 400, "{covered}");
    let camera = hand.camera();
    let scene = hand.viewer.terrain.shown_scene();
    let [low, high] = overview::extent(&scene);
    for i in 0..8 {
        let corner = DVec3::select(glam::BVec3::new(i & 1 > 0, i & 2 > 0, i & 4 > 0), high, low);
        let [at, _] = boxes::seen(&camera, [corner; 2]).unwrap();
        assert!(at.x > 0.0 && at.x < f64::from(SIZE[0] - covered), "{at}");
    }
    // Without it, in the middle.
    hand.key(Key::Tab, true);
    hand.key(Key::Tab, false);
    hand.frame(&[]);
    hand.key(Key::H, true);
    hand.settle();
    assert_eq!(hand.viewer.covered, 0);
    assert!((hand.camera().target.x - f64::midpoint(low.x, high.x)).abs() < 1e-6 * (high.x - low.x));
}

#[test]
fn a_zoom_beside_the_ground_comes_to_rest_above_it_and_not_through_it() {
    let mut hand = Hand::new(None);
    let at = pos2(8.0, 8.0);
    for towards in [at, pos2(8.0, 690.0)] {
        hand.key(Key::H, true);
        hand.settle();
        assert!(hand.viewer.pick(DVec2::new(towards.x.into(), towards.y.into())).is_none());
        let bounds = hand.viewer.bounds();
        let far = bounds.distance(hand.camera().eye);
        for _ in 0..60 {
            let (unit, phase) = (egui::MouseWheelUnit::Point, egui::TouchPhase::Move);
            let (source, modifiers) = (egui::MouseWheelSource::Wheel, Modifiers::NONE);
            let wheel = Event::MouseWheel { unit, delta: vec2(0.0, 50.0), modifiers, phase, source };
            hand.frame(&[Event::PointerMoved(towards), wheel]);
        }
        let eye = hand.camera().eye;
        assert!(eye.z > bounds.min.z, "{eye} {bounds:?}");
        let seen = bounds.max - bounds.min;
        assert!(bounds.distance(eye) < 4.0 * far.max(seen.length()), "{eye} {bounds:?}");
    }
}

#[test]
fn north_comes_up_on_the_spot_where_the_sky_is_in_the_middle() {
    let mut hand = Hand::new(Some(looking_down()));
    let [eye, ahead] = [hand.camera().eye, DVec3::new(1.0, 0.4, 0.3)];
    hand.viewer.controls = Controls::new(Camera { target: eye + ahead, ..hand.camera() });
    hand.key(Key::N, true);
    hand.settle();
    assert!((hand.camera().eye - eye).length() < 1e-6 && hand.viewer.controls.heading().abs() < 1e-6);
}

#[test]
fn what_begins_with_all_of_the_scene_shows_it_in_whatever_size_until_it_is_moved() {
    let mut hand = Hand::new(None);
    let home = hand.camera();
    hand.viewer.resize([640, 700]);
    hand.frame(&[]);
    let smaller = hand.viewer.whole(&hand.viewer.terrain.shown_scene());
    assert!(hand.camera() == smaller && smaller.eye != home.eye);
    hand.key(Key::E, true);
    hand.key(Key::E, false);
    let moved = hand.camera();
    hand.viewer.resize(SIZE);
    hand.frame(&[]);
    assert_eq!(hand.camera().eye, moved.eye);
}

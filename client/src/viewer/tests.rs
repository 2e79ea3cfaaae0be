//! Keys and a mouse without a window, over a scene from a made server.

use super::*;
use crate::fetch;
use crate::terrain::Options;
use crate::world::{Faults, Served, above, world};
use egui::{Pos2, RawInput, Rect, pos2, vec2};
use std::time::{Duration, Instant};

const SIZE: [u32; 2] = [1000, 700];

/// A viewer with its own clock, and what is put into it.
struct Hand {
    viewer: Viewer,
    context: egui::Context,
    seconds: f64,
    /// The window's size, in points.
    points: egui::Vec2,
    served: Served,
}

fn view_at(camera: Camera) -> View {
    View { camera, seconds: None, exaggeration: None }
}

impl Hand {
    fn new(camera: Option<Camera>) -> Self {
        Self::of(1, camera)
    }

    /// Over a scene with so many layers.
    fn of(layers: usize, camera: Option<Camera>) -> Self {
        Self::with(layers, Look::default(), camera)
    }

    fn with(layers: usize, look: Look, camera: Option<Camera>) -> Self {
        let served = Served::start(layers, Faults::default());
        let terrain =
            Terrain::open(&served.url, Options { fetch: fetch::Options::default(), ..Options::default() });
        let viewer = Viewer::new(terrain.unwrap(), &served.url, look, SIZE, camera.map(view_at));
        let points = vec2(SIZE[0] as f32, SIZE[1] as f32);
        let mut hand = Self { viewer, context: egui::Context::default(), seconds: 0.0, points, served };
        hand.settle();
        hand
    }

    /// A frame of a sixtieth of a second with these events.
    fn frame(&mut self, events: &[Event]) {
        self.frame_with(Modifiers::NONE, events);
    }

    fn frame_with(&mut self, modifiers: Modifiers, events: &[Event]) {
        self.frame_after(1.0 / 60.0, modifiers, events);
    }

    fn frame_after(&mut self, seconds: f64, modifiers: Modifiers, events: &[Event]) {
        self.seconds += seconds;
        let input = RawInput {
            screen_rect: Some(Rect::from_min_size(Pos2::ZERO, self.points)),
            time: Some(self.seconds),
            predicted_dt: 1.0 / 60.0,
            events: [&[Event::ModifiersChanged(modifiers)], events].concat(),
            focused: true,
            ..RawInput::default()
        };
        let viewer = &mut self.viewer;
        self.context.run_ui(input, |ui| viewer.update(ui)).drop_without_applying_deltas();
    }

    /// Frames until nothing is missing and nothing moves.
    fn settle(&mut self) {
        let until = Instant::now() + Duration::from_secs(60);
        loop {
            self.frame(&[]);
            let frame = self.viewer.frame();
            if frame.complete && frame.moving == 0 && !self.viewer.controls.is_gliding() {
                return;
            }
            assert!(Instant::now() < until, "{:?}", self.viewer.frame().stats);
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    fn button(&mut self, at: Pos2, button: PointerButton, pressed: bool, modifiers: Modifiers) {
        self.frame_with(modifiers, &[Event::PointerButton { pos: at, button, pressed, modifiers }]);
    }

    fn drag(&mut self, from: Pos2, to: Pos2, button: PointerButton, modifiers: Modifiers) {
        self.frame_with(modifiers, &[Event::PointerMoved(from)]);
        self.button(from, button, true, modifiers);
        for i in 1..=8 {
            self.frame_with(modifiers, &[Event::PointerMoved(from.lerp(to, i as f32 / 8.0))]);
        }
        self.button(to, button, false, modifiers);
    }

    fn click(&mut self, at: Pos2) {
        self.frame(&[Event::PointerMoved(at)]);
        self.button(at, PointerButton::Primary, true, Modifiers::NONE);
        self.button(at, PointerButton::Primary, false, Modifiers::NONE);
    }

    fn key(&mut self, key: Key, pressed: bool) {
        let modifiers = Modifiers::NONE;
        self.frame(&[Event::Key { key, physical_key: None, pressed, repeat: false, modifiers }]);
    }

    fn camera(&self) -> Camera {
        *self.viewer.camera()
    }

    /// Two places of the picture, apart from each other, where there is ground all around.
    fn solid(&mut self) -> [Pos2; 2] {
        let places = (4..14).flat_map(|y| (4..16).map(move |x| pos2(40.0 * x as f32, 40.0 * y as f32)));
        let near = [vec2(0.0, 0.0), vec2(30.0, 0.0), vec2(-30.0, 0.0), vec2(0.0, 30.0), vec2(0.0, -30.0)];
        let pixel = |p: Pos2| DVec2::new(p.x.into(), p.y.into());
        let solid: Vec<Pos2> =
            places.filter(|p| near.iter().all(|by| self.viewer.pick(pixel(*p + *by)).is_some())).collect();
        assert!(solid.len() > 20, "little to be seen: {}", solid.len());
        [solid[solid.len() / 3], solid[solid.len() * 2 / 3]]
    }

    fn seen_at(&mut self, at: Pos2) -> DVec3 {
        self.viewer.pick(DVec2::new(at.x.into(), at.y.into())).unwrap().point
    }
}

fn looking_down() -> Camera {
    Camera { size: SIZE, ..above() }
}

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
fn the_panel_comes_and_goes_and_leaves_the_keys_alone() {
    let mut hand = Hand::new(Some(looking_down()));
    for is_open in [false, true] {
        hand.key(Key::Tab, true);
        hand.key(Key::Tab, false);
        assert_eq!(hand.viewer.panel_is_open, is_open);
        let before = hand.camera();
        hand.key(Key::W, true);
        (0..5).for_each(|_| hand.frame(&[]));
        hand.key(Key::W, false);
        assert!(hand.camera().eye != before.eye, "keys fly");
    }
}

#[test]
fn a_click_tells_the_height_and_its_error() {
    let mut hand = Hand::new(Some(looking_down()));
    // The finest there is, so that the height is that of the source.
    hand.viewer.terrain.set_tolerance_pixels(1e-6);
    hand.settle();
    let places = hand.solid();
    hand.click(places[0]);
    // Long enough apart not to be a double click.
    (0..60).for_each(|_| hand.frame(&[]));
    hand.click(places[1]);
    let marks = hand.viewer.marks().to_vec();
    assert_eq!(marks.len(), 2);
    let layer = &world()[0].layer;
    for mark in marks {
        assert!(mark.error.unwrap() <= f64::from(layer.finest_error) + 1e-6, "{mark:?}");
        assert!((layer.heights[0]..=layer.heights[1]).contains(&mark.place.z), "{mark:?}");
        let items = hand.viewer.items();
        let layers = &hand.viewer.terrain.scene().layers;
        let ground = hand.viewer.picker.ground(layers, &items, 1.0, mark.place.truncate()).unwrap();
        assert!((ground - mark.place.z).abs() < 1e-3, "{ground} {mark:?}");
    }
    hand.key(Key::Escape, true);
    assert!(hand.viewer.marks().is_empty());
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

#[test]
fn an_address_opens_the_same_view_again() {
    let mut hand = Hand::new(Some(looking_down()));
    hand.drag(pos2(350.0, 350.0), pos2(450.0, 300.0), PointerButton::Middle, Modifiers::NONE);
    hand.viewer.set_exaggeration(2.5);
    let address = hand.viewer.address();
    let (url, view) = address.split_once('#').unwrap();
    assert_eq!(url, hand.viewer.url);
    let read = View::parse(view, SIZE).unwrap();
    assert_eq!((read.exaggeration, read.seconds), (Some(2.5), None));
    let mut again = Hand::new(None);
    assert!(again.viewer.go_to(view));
    again.settle();
    let [a, b] = [&hand, &again].map(Hand::camera);
    assert!((a.eye - b.eye).length() < 0.1, "{} {}", a.eye, b.eye);
    let [ahead, also] = [a, b].map(|camera| (camera.target - camera.eye).normalize());
    assert!((ahead - also).length() < 1e-4, "{ahead} {also}");
    assert_eq!(again.viewer.look().exaggeration, 2.5);
    // Opened with it, it is there at once; and nothing is multiplied where only what was measured is shown.
    let opened = |look: Look| {
        let terrain = Terrain::open(&hand.served.url, Options::default()).unwrap();
        Viewer::new(terrain, url, look, SIZE, Some(read))
    };
    assert_eq!(opened(Look::default()).view(), view);
    assert_eq!(opened(Look::default().truthful()).look().exaggeration, 1.0);
    for wrong in [
        "",
        "1,2,3",
        "1,2,3,4,x",
        "1,2,nan,0,0",
        "1,2,3,0,95",
        "1,2,3,4,5,x",
        "1,2,3,4,5,6,7",
        "1,2,3,4,5&exaggeration=0",
        "1,2,3,4,5&exaggeration=x",
        "1,2,3,4,5&other=1",
    ] {
        assert!(View::parse(wrong, SIZE).is_none(), "{wrong}");
    }
}

#[test]
fn a_frozen_cut_stays_while_the_eye_moves() {
    let mut hand = Hand::new(Some(looking_down()));
    let before: Vec<_> = hand.viewer.items().iter().map(|item| (item.diamond, item.sides)).collect();
    hand.viewer.frozen = Some(hand.viewer.items());
    hand.key(Key::F, true);
    hand.settle();
    let items = |viewer: &Viewer| viewer.items().iter().map(|i| (i.diamond, i.sides)).collect::<Vec<_>>();
    assert_eq!(items(&hand.viewer), before);
    hand.viewer.frozen = None;
    assert_ne!(items(&hand.viewer), before);
    hand.viewer.terrain.set_shown(0, false);
    assert!(hand.viewer.items().is_empty());
}

#[test]
fn two_clicks_tell_the_profile_between_them() {
    let mut hand = Hand::new(Some(looking_down()));
    let [a, b] = hand.solid();
    hand.click(a);
    hand.settle();
    assert!(hand.viewer.profile.heights().is_empty(), "one place has no profile");
    hand.click(b);
    hand.settle();
    hand.frame(&[]);
    let heights = hand.viewer.profile.heights().to_vec();
    let [first, last] = hand.viewer.marks()[..] else { panic!("two marks") };
    assert!(heights.len() > 100);
    for (height, mark) in [(heights[0], first), (heights[heights.len() - 1], last)] {
        assert!((height.unwrap() - mark.place.z).abs() < 0.5, "{height:?} {mark:?}");
    }
    let middle = first.place.lerp(last.place, 0.5).truncate();
    let layers = hand.viewer.terrain.scene().layers.clone();
    let ground = hand.viewer.picker.ground(&layers, &hand.viewer.frame.items, 1.0, middle);
    assert_eq!(heights[heights.len() / 2], ground);
    hand.key(Key::Escape, true);
    hand.frame(&[]);
    assert!(hand.viewer.profile.heights().is_empty());
}

#[test]
fn views_are_kept_and_found_again() {
    let mut hand = Hand::new(None);
    let home = hand.camera();
    hand.viewer.keep();
    hand.viewer.fly_to(&looking_down());
    hand.settle();
    hand.viewer.keep();
    let texts: Vec<String> = hand
        .viewer
        .take_asks()
        .into_iter()
        .filter_map(|ask| if let Ask::Keep(text) = ask { Some(text) } else { None })
        .collect();
    assert_eq!(texts.len(), 2);
    let mut again = Hand::new(Some(looking_down()));
    again.viewer.recall(read_bookmarks(&texts[1]));
    let names: Vec<&str> = again.viewer.bookmarks().iter().map(|one| one.name.as_str()).collect();
    assert_eq!(names, ["view 1", "view 2"]);
    let first = again.viewer.bookmarks()[0].view.clone();
    assert!(again.viewer.go_to(&first));
    again.settle();
    assert!((again.camera().eye - home.eye).length() < 0.1, "{:?}", again.camera());
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
fn boxes_are_drawn_around_what_is_drawn() {
    let mut hand = Hand::new(None);
    let lines = |hand: &mut Hand| {
        shapes(hand).iter().filter(|shape| matches!(shape, egui::Shape::LineSegment { .. })).count()
    };
    let without = lines(&mut hand);
    hand.viewer.shows_boxes = true;
    assert!(lines(&mut hand) >= without + 12);
}

/// What was frozen of a scene before was drawn where the layers of the one after it lie, and a mark on a layer that the other
/// has not ended the program.
#[test]
fn nothing_of_a_scene_before_outlives_it() {
    let mut hand = Hand::new(Some(looking_down()));
    let place = hand.viewer.camera().target;
    hand.viewer.marks.push(Mark { place, lonlat: None, error: None, layer: 0 });
    hand.viewer.frozen = Some(hand.viewer.items());
    hand.served.misbehave(Faults { gone: true, ..Faults::default() });
    hand.viewer.terrain.set_tolerance_pixels(0.3);
    let until = Instant::now() + Duration::from_secs(60);
    while hand.viewer.frame().stats.reloads == 0 {
        hand.frame(&[]);
        if hand.viewer.terrain.scene_changed() {
            hand.served.misbehave(Faults::default());
        }
        assert!(Instant::now() < until, "{:?}", hand.viewer.terrain.problem());
        std::thread::sleep(Duration::from_millis(2));
    }
    assert!(hand.viewer.marks().is_empty() && hand.viewer.frozen.is_none());
    assert!(!hand.viewer.items().is_empty(), "its layers are seen");
}

#[test]
fn the_true_view_is_plain_and_can_be_left_again() {
    let mut hand = Hand::new(Some(looking_down()));
    hand.viewer.set_exaggeration(3.0);
    hand.viewer.terrain.set_morph_seconds(0.3);
    let (before, eye) = (*hand.viewer.look(), hand.camera().eye);
    let ground = hand.viewer.reach(hand.viewer.middle());
    assert!(!hand.viewer.is_true());
    hand.viewer.set_true(true);
    let look = *hand.viewer.look();
    assert!(hand.viewer.is_true() && look.exaggeration == 1.0 && look.haze == 0.0, "{look:?}");
    assert!(!look.water.reflecting && look.background != crate::render::Background::Sky, "{look:?}");
    assert_eq!(hand.viewer.terrain.morph_seconds(), 0.0);
    let here = ground.with_z(ground.z / 3.0);
    assert!(((hand.camera().eye - here) - (eye - ground)).length() < 1e-6, "the view stays");
    hand.settle();
    hand.viewer.look.colours = crate::render::Colours::Slope;
    hand.viewer.set_true(false);
    let expected = Look { colours: crate::render::Colours::Slope, ..before };
    assert_eq!((*hand.viewer.look(), hand.viewer.terrain.morph_seconds()), (expected, 0.3));
    assert!((hand.camera().eye - eye).length() < 0.01 * (eye - ground).length());
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

#[test]
fn the_panel_has_a_button_and_is_closed_where_there_is_no_room() {
    let mut hand = Hand::new(Some(looking_down()));
    assert!(hand.viewer.panel_is_open);
    // In its upper right corner.
    hand.click(pos2(972.0, 22.0));
    assert!(!hand.viewer.panel_is_open);
    hand.frame(&[]);
    hand.click(pos2(976.0, 20.0));
    assert!(hand.viewer.panel_is_open && hand.viewer.marks().is_empty());

    let mut hand = Hand::new(Some(looking_down()));
    hand.points = vec2(390.0, 700.0);
    hand.frame(&[]);
    assert!(!hand.viewer.panel_is_open);
}

#[test]
fn of_one_place_there_is_no_profile_and_slow_double_clicks_fly() {
    let mut hand = Hand::new(Some(looking_down()));
    let [at, _] = hand.solid();
    hand.click(at);
    (0..30).for_each(|_| hand.frame(&[]));
    hand.click(at);
    assert_eq!((hand.viewer.marks().len(), hand.viewer.profile.heights().len()), (2, 0));
    hand.key(Key::Escape, true);
    (0..30).for_each(|_| hand.frame(&[]));
    let click = |pressed| {
        let (button, modifiers) = (PointerButton::Primary, Modifiers::NONE);
        Event::PointerButton { pos: at, button, pressed, modifiers }
    };
    for _ in 0..2 {
        hand.frame_after(0.7, Modifiers::NONE, &[click(true), click(false)]);
    }
    assert!(hand.viewer.controls.is_gliding());
}

#[test]
fn slow_frames_are_told_and_messages_go() {
    let mut hand = Hand::new(Some(looking_down()));
    hand.viewer.tell("saved");
    // It moves as long as the key is held, so each frame asks for the next.
    hand.key(Key::W, true);
    (0..4).for_each(|_| hand.frame_after(0.5, Modifiers::NONE, &[]));
    let rate = hand.viewer.history.rate().unwrap();
    assert!((rate - 2.0).abs() < 0.01, "{rate} frames a second");
    assert!(hand.viewer.message.is_some());
    hand.key(Key::W, false);
    hand.settle();
    // After a rest the time since the last frame is not what a frame takes, nor does anything jump.
    let before = hand.camera();
    hand.frame_after(MESSAGE_SECONDS, Modifiers::NONE, &[]);
    hand.frame(&[]);
    assert!(hand.viewer.history.rate().unwrap() < 100.0);
    assert_eq!(hand.camera(), before);
}

#[test]
fn what_was_clicked_is_marked_in_the_picture() {
    let mut hand = Hand::new(Some(looking_down()));
    let [a, b] = hand.solid();
    let near = |shapes: &[egui::Shape], at: Pos2| {
        shapes.iter().any(|s| matches!(s, egui::Shape::Circle(c) if c.center.distance(at) < 1.5))
    };
    let lines = |shapes: &[egui::Shape]| {
        shapes.iter().filter(|shape| matches!(shape, egui::Shape::LineSegment { .. })).count()
    };
    let before = shapes(&mut hand);
    assert!(!near(&before, a));
    hand.click(a);
    hand.seconds += 1.0;
    hand.click(b);
    let after = shapes(&mut hand);
    assert!(near(&after, a) && near(&after, b), "{:?} at {a} and {b}", hand.viewer.marks());
    assert!(lines(&after) > lines(&before) + 100, "the profile between them");
}

/// Whoever has all of a version asks for nothing, and yet learns of the next one.
#[test]
fn a_new_version_is_noticed_while_nothing_is_missing() {
    let served = Served::start(1, Faults::default());
    let fetch = fetch::Options { follow: Some(Duration::from_millis(20)), ..fetch::Options::default() };
    let terrain = Terrain::open(&served.url, Options { fetch, ..Options::default() }).unwrap();
    let viewer = Viewer::new(terrain, &served.url, Look::default(), SIZE, Some(view_at(looking_down())));
    let points = vec2(SIZE[0] as f32, SIZE[1] as f32);
    let mut hand = Hand { viewer, context: egui::Context::default(), seconds: 0.0, points, served };
    hand.settle();
    for _ in 0..50 {
        hand.frame(&[]);
        std::thread::sleep(Duration::from_millis(2));
    }
    assert!(!hand.viewer.terrain.scene_changed(), "the same version is none");
    hand.served.misbehave(Faults { gone: true, ..Faults::default() });
    let until = Instant::now() + Duration::from_secs(60);
    while !hand.viewer.terrain.scene_changed() {
        hand.frame(&[]);
        assert!(Instant::now() < until);
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// What is drawn over the picture in a frame.
fn shapes(hand: &mut Hand) -> Vec<egui::Shape> {
    let input = RawInput {
        screen_rect: Some(Rect::from_min_size(Pos2::ZERO, vec2(SIZE[0] as f32, SIZE[1] as f32))),
        time: Some(hand.seconds + 1.0),
        ..RawInput::default()
    };
    let viewer = &mut hand.viewer;
    let output = hand.context.run_ui(input, |ui| viewer.update(ui));
    let shapes = output.shapes.iter().map(|shape| shape.shape.clone()).collect();
    output.drop_without_applying_deltas();
    shapes
}

/// What is written in a frame, and where.
fn texts(hand: &mut Hand, with_panel: bool) -> Vec<(String, Pos2)> {
    let input = RawInput {
        screen_rect: Some(Rect::from_min_size(Pos2::ZERO, vec2(SIZE[0] as f32, SIZE[1] as f32))),
        time: Some(hand.seconds + 1.0),
        ..RawInput::default()
    };
    let viewer = &mut hand.viewer;
    let output = hand.context.run_ui(input, |ui| viewer.frame_of(ui, with_panel));
    texts_of(output)
}

/// The texts of a frame, and where they begin.
fn texts_of(output: egui::FullOutput) -> Vec<(String, Pos2)> {
    let texts = output.shapes.iter().filter_map(|s| match &s.shape {
        egui::Shape::Text(text) => Some((text.galley.text().to_owned(), text.pos)),
        _ => None,
    });
    let texts = texts.collect();
    output.drop_without_applying_deltas();
    texts
}

fn find(texts: &[(String, Pos2)], text: &str) -> Option<Pos2> {
    texts.iter().find(|(found, _)| found == text).map(|(_, at)| *at)
}

#[test]
fn water_plays_in_time_from_the_panel_and_its_address_tells_when() {
    use crate::world::{BEFORE_WAVES, WAVES};
    let mut hand = Hand::of(BEFORE_WAVES + WAVES, Some(looking_down()));
    let is_drawn = |hand: &Hand, step: usize| {
        let steps =
            hand.viewer.items().into_iter().map(|item| item.layer).filter(|layer| *layer >= BEFORE_WAVES);
        steps.collect::<std::collections::HashSet<_>>() == [BEFORE_WAVES + step].into()
    };
    assert!(is_drawn(&hand, 0));
    assert!(hand.viewer.address().ends_with(",0.000"), "{}", hand.viewer.address());
    // One box for the series, and what there is to press; the panel is longer than this window.
    let written = texts(&mut hand, true);
    assert!(find(&written, "waves").is_some() && find(&written, "waves.1").is_none(), "{written:?}");
    let requests = hand.viewer.frame().stats.traffic.requests;
    for _ in 0..20 {
        hand.frame(&[]);
    }
    assert_eq!(
        hand.viewer.frame().stats.traffic.requests,
        requests,
        "nothing is fetched ahead while time stands"
    );
    // Space plays. Ten times as fast, ten seconds take sixty frames.
    hand.viewer.player.speed = 10.0;
    hand.key(Key::Space, true);
    assert!(hand.viewer.player().plays);
    let until = Instant::now() + Duration::from_secs(60);
    let mut seen = vec![0];
    while hand.viewer.player().plays {
        hand.frame(&[]);
        let step = hand.viewer.terrain().step_drawn(0).unwrap();
        assert!(is_drawn(&hand, step), "one step, whole, in every frame");
        if seen.last() != Some(&step) {
            assert!(hand.viewer.frame().complete, "time waits for what it shows");
            seen.push(step);
        }
        assert!(Instant::now() < until, "{:?}", hand.viewer.player());
        std::thread::sleep(Duration::from_millis(1));
    }
    assert_eq!(seen, [0, 1, 2, 3], "each step is seen, in order");
    assert!(hand.viewer.address().ends_with(",30.000"), "{}", hand.viewer.address());
    // An address tells when, too, and so does a bookmark.
    hand.viewer.keep();
    let kept = hand.viewer.bookmarks()[0].view.clone();
    assert!(
        kept.ends_with(",30.000")
            && bookmarks::read(&format!(r#"[{{"name":"a","view":"{kept}"}}]"#)).len() == 1
    );
    let view = hand.viewer.view();
    let earlier = format!("{},10.5", view.rsplit_once(',').unwrap().0);
    assert!(hand.viewer.go_to(&earlier));
    hand.settle();
    assert!(is_drawn(&hand, 1) && hand.viewer.player().seconds == 10.5);
    assert!(!hand.viewer.go_to("1,2,3"));
    let time = |view: &str| View::parse(view, SIZE).unwrap().seconds;
    assert_eq!((time("1,2,3,4,5"), time("1,2,3,4,5,-6"), time("1,2,3,4,5, 6")), (None, None, Some(6.0)));
}

#[test]
fn the_panel_has_a_clock_where_water_changes_with_time_and_nowhere_else() {
    use crate::world::{BEFORE_WAVES, WAVES};
    // The clock alone, so that it lies within the window; what is written in it.
    let clock = |hand: &mut Hand, events: &[Event]| -> Vec<(String, Pos2)> {
        let size = vec2(SIZE[0] as f32, SIZE[1] as f32);
        let screen_rect = Some(Rect::from_min_size(Pos2::ZERO, size));
        hand.seconds += 1.0 / 60.0;
        let (time, events) = (Some(hand.seconds), events.to_vec());
        let input = RawInput { screen_rect, time, events, focused: true, ..RawInput::default() };
        let viewer = &mut hand.viewer;
        let output = hand.context.run_ui(input, |ui| time::show(viewer, ui));
        texts_of(output)
    };
    let press = |hand: &mut Hand, text: &str| {
        let pos = find(&clock(hand, &[]), text).unwrap() + vec2(4.0, 6.0);
        let button = |pressed| Event::PointerButton {
            pos,
            button: PointerButton::Primary,
            pressed,
            modifiers: Modifiers::NONE,
        };
        for event in [Event::PointerMoved(pos), button(true), button(false)] {
            clock(hand, &[event]);
        }
    };
    let mut still = Hand::new(Some(looking_down()));
    assert!(clock(&mut still, &[]).is_empty());
    assert!(!still.viewer.address().ends_with(",0.000"), "{}", still.viewer.address());
    let mut hand = Hand::of(BEFORE_WAVES + WAVES, Some(looking_down()));
    assert!(find(&clock(&mut hand, &[]), "waves: step 0 of 0 to 3").is_some());
    press(&mut hand, "+1");
    press(&mut hand, "+1");
    assert_eq!(hand.viewer.player().seconds, 20.0);
    hand.frame(&[]);
    let late = clock(&mut hand, &[]);
    assert!(find(&late, "waves: step 0 until 2 is there").is_some(), "{late:?}");
    hand.settle();
    press(&mut hand, "-1");
    hand.settle();
    assert!(find(&clock(&mut hand, &[]), "waves: step 1 of 0 to 3").is_some());
    press(&mut hand, "Play");
    press(&mut hand, "loop");
    assert!(hand.viewer.player().plays && hand.viewer.player().is_round);
    assert!(find(&clock(&mut hand, &[]), "Pause").is_some());
    // The slider itself: to its left end.
    let at = find(&clock(&mut hand, &[]), "time [s]").unwrap();
    press(&mut hand, "Pause");
    assert!(!hand.viewer.player().plays);
    let start = pos2(10.0, at.y + 6.0);
    let button = |pressed| Event::PointerButton {
        pos: start,
        button: PointerButton::Primary,
        pressed,
        modifiers: Modifiers::NONE,
    };
    for event in [Event::PointerMoved(start), button(true), button(false)] {
        clock(&mut hand, &[event]);
    }
    assert!(hand.viewer.player().seconds < 5.0, "{}", hand.viewer.player().seconds);
}

#[test]
fn the_panel_writes_over_the_picture() {
    let mut hand = Hand::new(Some(looking_down()));
    assert!(find(&texts(&mut hand, true), "Height [m]").is_none());
    hand.viewer.look.annotations = crate::render::Annotations::ALL;
    let beside = texts(&mut hand, true);
    let legend = find(&beside, "Height [m]").unwrap();
    assert!(find(&beside, "N").is_some() && find(&beside, "View").unwrap().x > legend.x, "left of the panel");
    // In a picture there is no panel, and it goes to the side.
    let alone = texts(&mut hand, false);
    assert!(find(&alone, "Height [m]").unwrap().x > legend.x && find(&alone, "View").is_none());
    assert!(alone.iter().any(|(text, _)| text.starts_with("at the cross (") && !text.contains("no ground")));
}

#[test]
fn a_few_huge_values_leave_a_plot_readable() {
    let mut values: std::collections::VecDeque<f32> =
        (0..200).map(|i| 1.0 + (i % 10) as f32 / 10.0).collect();
    assert_eq!(panel::top(&values), 1.9);
    values.extend([f32::INFINITY, 9000.0, 8000.0, 7000.0]);
    assert!(panel::top(&values) < 3.0, "{}", panel::top(&values));
    assert_eq!(panel::top(&[0.0, 0.0, 5.0].into()), 5.0);
    assert_eq!(panel::top(&std::collections::VecDeque::new()), 0.0);
}

//! Keys and a mouse without a window, over a scene from a made server.

mod moving;
mod panel;

use super::*;
use crate::fetch;
use crate::terrain::{Imagery, Options};
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
        Self::over(Served::start(layers, Faults::default()), Imagery::First, look, camera)
    }

    fn over(served: Served, imagery: Imagery, look: Look, camera: Option<Camera>) -> Self {
        let options = Options { fetch: fetch::Options::default(), imagery, ..Options::default() };
        let terrain = Terrain::open(&served.url, options);
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
    // What is out of sight stays as it was seen.
    let eye = hand.camera().eye;
    hand.viewer.controls.glide_to(Camera { target: eye + DVec3::Z + 0.01 * DVec3::Y, ..hand.camera() });
    while hand.viewer.controls.is_gliding() {
        hand.frame(&[]);
    }
    hand.settle();
    hand.frame(&[]);
    let near = first.place.truncate();
    assert!(hand.viewer.picker.ground(&layers, &hand.viewer.frame.items, 1.0, near).is_none());
    let known = |heights: &[Option<f64>]| heights.iter().map(Option::is_some).collect::<Vec<_>>();
    assert_eq!(known(hand.viewer.profile.heights()), known(&heights));
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
    again.viewer.set_exaggeration(3.0);
    assert!(again.viewer.go_to(&first));
    again.settle();
    assert_eq!(again.viewer.look().exaggeration, 1.0, "heights are as they were");
    assert!((again.camera().eye - home.eye).length() < 0.1, "{:?}", again.camera());
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
fn the_true_view_leaves_imagery_out() {
    let camera = Some(looking_down());
    let mut hand = Hand::over(Served::start_draped(), Imagery::None, Look::default(), camera);
    let laid = |hand: &Hand| hand.viewer.terrain.texture_name().map(str::to_owned);
    let photo = Some("photo".to_owned());
    hand.viewer.terrain.set_texture(Some(0));
    assert_eq!(laid(&hand), photo);
    hand.viewer.set_true(true);
    assert!(hand.viewer.is_true() && laid(&hand).is_none(), "colours tell heights");
    hand.viewer.set_true(false);
    assert_eq!(laid(&hand), photo, "as before");
    // What is asked for in between stays.
    hand.viewer.terrain.set_texture(None);
    hand.viewer.set_true(true);
    hand.viewer.terrain.set_texture(Some(0));
    hand.viewer.set_true(false);
    assert_eq!(laid(&hand), photo, "as chosen");
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

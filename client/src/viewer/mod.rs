//! The viewer: terrain, a mouse and keys that move the eye, and a panel. What it runs in is another module's matter.
//!
//! | module | what it holds |
//! |---|---|
//! | `panel` | sliders, choices, figures, and what was clicked |
//! | `pivot` | what the view moves around |
//! | `truth` | the switch that shows nothing but what was measured |
//! | `time` | the clock of water that changes with time |
//! | `display` | a window or a canvas, and what draws on it |
//! | [`window`] | a native window: events in, pictures out |
//!
//! ```text
//! events ──► ui: panel, keys, mouse ──► controls ──► camera ──► terrain's frame ──► what to draw
//! ```
//!
//! All input comes through egui, so the same code serves a window and whatever else egui runs in, and a test can press
//! keys and drag without any window.

mod address;
mod bookmarks;
mod boxes;
pub(crate) mod display;
mod measure;
mod panel;
mod pivot;
#[cfg(not(target_arch = "wasm32"))]
mod shelf;
mod time;
mod truth;
#[cfg(not(target_arch = "wasm32"))]
pub mod window;

pub use address::View;
pub use bookmarks::{Bookmark, read as read_bookmarks};
pub use measure::Mark;

use crate::annotate::{self, Subject};
use crate::camera::Camera;
use crate::controls::{self, Controls, Thrust};
use crate::drawing::{DrawItem, Mirror};
use crate::globe::Globe;
use crate::overview;
use crate::pick::{Hit, Picker, Ray};
use crate::player::Player;
use crate::render::{FrameStats, Look};
use crate::terrain::{FrameView, Terrain};
use crate::texture::Drape;
use bookmarks::Bookmarks;
use diamantina_protocol::message::{Kind, Scene};
use egui::{Event, Key, Modifiers, Painter, PointerButton, Rect, Sense, Ui};
use glam::{DVec2, DVec3};
use measure::Profile;
use panel::History;
use std::path::PathBuf;
use std::time::Duration;
use truth::Untrue;

/// Radians that the view turns for a point (of 1/96 inch, about) of a drag.
const TURN_PER_POINT: f64 = 0.005;

/// Radians that arrow keys turn in a second.
const TURN_PER_SECOND: f64 = 0.8;

/// Part of the distance that a wheel's notch goes, of about 50 points.
const ZOOM_PER_POINT: f64 = 0.004;

/// The eye's least height above the ground, in cells of the finest layer, ...
const CLEARANCE_CELLS: f64 = 0.5;

/// ... and the least distance to what it zooms to.
const NEAREST_CELLS: f64 = 3.0;

/// How often a scene that is looked at is compared with the server's.
pub const FOLLOW: Duration = Duration::from_secs(10);

/// Seconds that points move, where nothing else was asked for.
const MORPH_SECONDS: f64 = 0.3;

/// Points at the window's lower side that messages take.
const MESSAGE_POINTS: f32 = 26.0;

/// The width of a window, in points, that has room for the panel beside the ground.
const NARROW_POINTS: f32 = 450.0;

/// Pixels by which the panel has to change for the view that it lies beside to do so.
const COVERED_MORE: u32 = 40;

/// Seconds that a message stays.
const MESSAGE_SECONDS: f64 = 8.0;

/// The longest step of what moves the eye, in seconds: after a frame that took longer it is not far away at once.
const STEP_SECONDS: f64 = 0.25;

/// Seconds between two clicks that are one double click, where frames take no time.
const CLICK_SECONDS: f64 = 0.3;

/// What whoever shows the viewer is asked to do.
#[derive(Debug, Clone, PartialEq)]
pub enum Ask {
    /// To save a picture of the terrain with its annotations, without the panel.
    Screenshot(PathBuf),
    /// To put a text on the clipboard.
    Copy(String),
    /// To keep the scene's bookmarks, as [`read_bookmarks`] reads them, until the viewer is opened again.
    Keep(String),
    /// To end.
    Quit,
}

/// What became of something, and how many more seconds it is told.
struct Message {
    text: String,
    seconds: f64,
}

/// The viewer of a scene.
pub struct Viewer {
    terrain: Terrain,
    /// The scene's address.
    url: String,
    controls: Controls,
    /// Whether it is where it begins, until it is moved: there all is seen, however large the picture turns out to be,
    /// and however much of it the panel covers.
    begins: bool,
    /// The camera that it begins with, as it was set, and how much was covered then.
    home: Option<(Camera, u32)>,
    picker: Picker,
    look: Look,
    /// What is beautiful and not shown, while nothing but what was measured is.
    untrue: Option<Untrue>,
    frame: FrameView,
    /// What is drawn while the cut stands still.
    frozen: Option<Vec<DrawItem>>,
    /// What is being dragged.
    grabbed: Option<DVec3>,
    /// The last two places that were clicked.
    marks: Vec<Mark>,
    /// Those before the last click, which may turn out to be the first half of a double click.
    marks_before: Vec<Mark>,
    profile: Profile,
    globe: Option<Globe>,
    bookmarks: Bookmarks,
    panel_is_open: bool,
    /// Whether somebody said so.
    panel_is_chosen: bool,
    /// Pixels of the picture's width that the panel covers.
    covered: u32,
    shows_boxes: bool,
    history: History,
    player: Player,
    drawn: FrameStats,
    /// Whether the last frame asked for this one: then the time between them is what a frame takes.
    goes_on: bool,
    message: Option<Message>,
    asks: Vec<Ask>,
}

impl Viewer {
    /// A viewer of the scene at `url` that begins with a view, or with an overview.
    #[must_use]
    pub fn new(mut terrain: Terrain, url: &str, mut look: Look, size: [u32; 2], view: Option<View>) -> Self {
        if let Some(exaggeration) =
            view.and_then(|view| view.exaggeration).filter(|_| look != look.truthful())
        {
            look.exaggeration = exaggeration;
        }
        terrain.set_exaggeration(look.exaggeration);
        let home = overview::stretched_overview(&terrain.shown_scene(), size, look.exaggeration);
        let stretched = |c: Camera| Camera { size, ..overview::stretched(&c, look.exaggeration) };
        let globe = Globe::of(&terrain.scene().frame);
        let time = terrain.time();
        let camera = view.map_or(home, |view| stretched(view.camera));
        let mut viewer = Self {
            controls: Controls::new(camera),
            begins: view.is_none(),
            home: None,
            terrain,
            url: url.to_owned(),
            picker: Picker::default(),
            look,
            untrue: None,
            frame: FrameView::default(),
            frozen: None,
            grabbed: None,
            marks: Vec::new(),
            marks_before: Vec::new(),
            profile: Profile::default(),
            globe,
            bookmarks: Bookmarks::default(),
            panel_is_open: true,
            panel_is_chosen: false,
            covered: 0,
            shows_boxes: false,
            history: History::default(),
            player: Player::at(time),
            drawn: FrameStats::default(),
            goes_on: false,
            message: None,
            asks: Vec::new(),
        };
        viewer.set_time(view.and_then(|view| view.seconds));
        viewer
    }

    /// The camera now; its heights are stretched as the look says.
    #[must_use]
    pub fn camera(&self) -> &Camera {
        self.controls.camera()
    }

    /// How frames look now.
    #[must_use]
    pub fn look(&self) -> &Look {
        &self.look
    }

    /// The scene's address.
    #[must_use]
    pub fn url(&self) -> &str {
        &self.url
    }

    /// The terrain.
    #[must_use]
    pub fn terrain(&self) -> &Terrain {
        &self.terrain
    }

    /// See [`Terrain::suit_blocks`].
    pub fn suit_blocks(&mut self, suits: bool) {
        self.terrain.suit_blocks(suits);
    }

    /// See [`Terrain::set_gpu_taken`].
    pub fn set_gpu_taken(&mut self, bytes: u64) {
        self.terrain.set_gpu_taken(bytes);
    }

    /// What the last frame shows.
    #[must_use]
    pub fn frame(&self) -> &FrameView {
        &self.frame
    }

    /// What was clicked, the last two.
    #[must_use]
    pub fn marks(&self) -> &[Mark] {
        &self.marks
    }

    /// What to draw: of the layers that are shown, the cut of this frame, or the frozen one.
    #[must_use]
    pub fn items(&self) -> Vec<DrawItem> {
        let items = self.frozen.as_ref().unwrap_or(&self.frame.items);
        items.iter().filter(|item| self.terrain.is_shown(item.layer)).cloned().collect()
    }

    /// What water mirrors; where the cut is frozen, that is drawn.
    #[must_use]
    pub fn mirrors(&self) -> &[Mirror] {
        if self.frozen.is_some() { &[] } else { &self.frame.mirrors }
    }

    /// The imagery on what is drawn.
    #[must_use]
    pub fn drape(&self) -> Option<&Drape> {
        self.frame.drape.as_ref()
    }

    /// What is asked for since the last call.
    pub fn take_asks(&mut self) -> Vec<Ask> {
        std::mem::take(&mut self.asks)
    }

    /// Says what became of something.
    pub fn tell(&mut self, message: impl Into<String>) {
        self.message = Some(Message { text: message.into(), seconds: MESSAGE_SECONDS });
    }

    /// Takes in what a frame cost.
    pub fn note(&mut self, drawn: FrameStats) {
        self.drawn = drawn;
    }

    /// The picture's size in pixels.
    pub fn resize(&mut self, size: [u32; 2]) {
        self.controls.resize(size);
    }

    /// Flies to where another camera is, whose heights are as they are.
    pub fn fly_to(&mut self, camera: &Camera) {
        let size = self.camera().size;
        self.controls.glide_to(Camera { size, ..overview::stretched(camera, self.look.exaggeration) });
    }

    /// What drawing the last frame took.
    #[must_use]
    pub fn drawn(&self) -> &FrameStats {
        &self.drawn
    }

    /// One frame: the panel, what keys and mouse do, and what the terrain shows then. Never waits.
    pub fn update(&mut self, ui: &mut Ui) {
        self.frame_of(ui, true);
    }

    /// The same; without the panel and all that is no part of a picture, where one is taken.
    pub(crate) fn frame_of(&mut self, ui: &mut Ui, with_panel: bool) {
        // After a rest nobody knows when the first frame of a movement should have been.
        let [since, usual] = ui.input(|input| [input.unstable_dt, input.stable_dt].map(f64::from));
        let seconds = if self.goes_on { since } else { usual.min(STEP_SECONDS) };
        if with_panel {
            let width = ui.available_rect_before_wrap().width();
            if !self.panel_is_chosen {
                self.panel_is_open = width >= NARROW_POINTS;
            }
            panel::show(self, ui);
            let covered = width - ui.available_rect_before_wrap().width();
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a part of a width")]
            let covered = (covered * ui.ctx().pixels_per_point()).max(0.0) as u32;
            self.covered = covered;
        }
        self.begin();
        self.switch_panel(ui);
        // Frames may take longer than two clicks. And a finger or a button that has long been held may still move the ground.
        let delay = CLICK_SECONDS + since.min(1.0);
        ui.ctx().options_mut(|options| {
            options.input_options.max_double_click_delay = delay;
            options.input_options.max_click_duration = f64::INFINITY;
        });
        self.steer(ui, seconds.min(STEP_SECONDS));
        self.controls.step(seconds.min(STEP_SECONDS));
        let ground = self.ground();
        self.controls.stay_above(ground, CLEARANCE_CELLS * self.cell());
        let (reloads, is_replaced) = (self.frame.stats.reloads, self.terrain.scene_changed());
        self.terrain.set_wires(self.look.wireframe);
        self.terrain.set_mirrors(self.look.mirrors().then_some(self.look.water.mirror_error));
        self.pass(seconds);
        self.frame = self.terrain.frame(self.controls.camera());
        if self.frame.stats.reloads != reloads {
            // Of whatever encoding, its surfaces are the frame's before.
            self.frozen = None;
            if is_replaced {
                self.go_over();
            }
        }
        let has_more = measure::follow(self);
        if with_panel {
            if self.shows_boxes {
                boxes::show(self, ui);
            }
            measure::show_places(self, ui);
        }
        // Above the message at the lower left, beside the panel.
        let mut area = ui.available_rect_before_wrap();
        area.max.y -= if with_panel { MESSAGE_POINTS } else { 0.0 };
        self.annotate(ui.painter(), area);
        self.history.note(self.goes_on.then_some(seconds), &self.frame);
        self.age_message(ui, seconds);
        let has_waves = self.has_waves();
        if has_waves {
            self.look.water.seconds += seconds;
        }
        let is_moving = self.frame.moving > 0 || self.controls.is_gliding() || has_waves || self.player.plays;
        self.goes_on = !self.frame.complete || is_moving || has_more;
        if self.goes_on {
            ui.ctx().request_repaint();
        }
    }

    /// A message that is old goes.
    fn age_message(&mut self, ui: &Ui, seconds: f64) {
        let Some(message) = &mut self.message else { return };
        message.seconds -= seconds;
        if message.seconds > 0.0 {
            ui.ctx().request_repaint_after(Duration::from_secs_f64(message.seconds));
        } else {
            self.message = None;
            ui.ctx().request_repaint();
        }
    }

    /// Writes over the picture what the look asks for, within an area in points.
    pub(crate) fn annotate(&mut self, painter: &Painter, area: Rect) {
        if !self.look.annotations.is_any() {
            return;
        }
        let camera = self.controls.camera();
        let items = self.items();
        let layers = &self.terrain.scene().layers;
        let centre = annotate::centre(&mut self.picker, layers, &items, &self.look, camera);
        let layers = self.terrain.drawn_layers();
        let (imagery, globe) = (self.terrain.texture_name(), self.globe.as_ref());
        let subject = Subject { camera, look: &self.look, layers: &layers, imagery, globe, centre };
        annotate::show(painter, area, &subject);
    }

    /// Forgets what was of the version of the scene before: layers may be others now, and lie elsewhere.
    fn go_over(&mut self) {
        self.clear_marks();
        self.profile = Profile::default();
        self.globe = Globe::of(&self.terrain.scene().frame);
    }

    /// Whether there is water in view whose waves move.
    fn has_waves(&self) -> bool {
        let water = &self.look.water;
        let layers = &self.terrain.scene().layers;
        let is_water = |item: &DrawItem| layers[item.layer].kind == Kind::Water;
        water.reflecting && water.waves > 0.0 && !self.look.wireframe && self.frame.items.iter().any(is_water)
    }

    /// Metres of the finest layer's cells.
    fn cell(&self) -> f64 {
        let cells = self.terrain.scene().layers.iter().flat_map(|layer| layer.cell);
        cells.map(f64::abs).fold(f64::INFINITY, f64::min).min(1e6)
    }

    /// What is under a place of the picture, in pixels.
    fn pick(&mut self, at: DVec2) -> Option<Hit> {
        let camera = self.controls.camera();
        let ray = Ray { origin: camera.eye, direction: controls::ray(camera, at) };
        let items = self.items();
        self.picker.pick(&self.terrain.scene().layers, &items, self.look.exaggeration, &ray)
    }

    fn steer(&mut self, ui: &mut Ui, seconds: f64) {
        let scale = f64::from(ui.ctx().pixels_per_point());
        let rect = ui.available_rect_before_wrap();
        let response = ui.interact(rect, ui.scope_id().with("terrain"), Sense::click_and_drag());
        let pixel = |p: egui::Pos2| DVec2::new(f64::from(p.x), f64::from(p.y)) * scale;
        let nearest = NEAREST_CELLS * self.cell();
        let modifiers = ui.input(|input| input.modifiers);
        let pointer = response.interact_pointer_pos();
        if response.drag_started()
            && let Some(origin) = ui.input(|input| input.pointer.press_origin())
        {
            self.grabbed = Some(self.reach(pixel(origin)));
        }
        if let (Some(grabbed), Some(at)) = (self.grabbed, pointer) {
            let turns = response.dragged_by(PointerButton::Middle)
                || response.dragged_by(PointerButton::Secondary)
                || response.dragged_by(PointerButton::Primary) && modifiers.command_only();
            if turns {
                let by = response.drag_delta();
                let [right, up] = [-by.x, -by.y].map(|points| f64::from(points) * TURN_PER_POINT);
                self.controls.turn(grabbed, right, up);
            } else if response.dragged_by(PointerButton::Primary) {
                self.controls.pan(grabbed, pixel(at));
            }
        }
        if response.drag_stopped() {
            self.grabbed = None;
        }
        let fingers =
            ui.input(egui::InputState::multi_touch).filter(|fingers| rect.contains(fingers.start_pos));
        if let Some(fingers) = fingers {
            // Two of them turn, tilt and spread what is between them.
            let middle = pixel(fingers.center_pos);
            let point = self.pivot(middle).unwrap_or(self.camera().eye);
            let tilt = f64::from(fingers.translation_delta.y) * TURN_PER_POINT;
            // The ground turns as the fingers do, so the view the other way.
            self.controls.turn(point, -f64::from(fingers.rotation_delta), -tilt);
            self.zoom(middle, 1.0 / f64::from(fingers.zoom_delta), nearest);
            self.grabbed = None;
        } else if let Some(at) = response.hover_pos() {
            let (scroll, pinch) = ui.input(|input| (input.smooth_scroll_delta().y, input.zoom_delta()));
            self.zoom(pixel(at), (-f64::from(scroll) * ZOOM_PER_POINT).exp() / f64::from(pinch), nearest);
        }
        if response.double_clicked() {
            // Its first half was no mark.
            self.marks.clone_from(&self.marks_before);
            if let Some(hit) = pointer.and_then(|at| self.pick(pixel(at))) {
                self.controls.glide_near(hit.point, nearest);
            }
        } else if response.clicked()
            && !response.triple_clicked()
            && let Some(hit) = pointer.and_then(|at| self.pick(pixel(at)))
        {
            self.mark(&hit);
        }
        // A button that has the focus takes no letters.
        if !ui.ctx().text_edit_focused() {
            self.keys(ui, seconds);
        }
    }

    /// Brings the eye so many times as far from what is at a place of the picture, in pixels, but no nearer than `nearest`.
    fn zoom(&mut self, at: DVec2, factor: f64, nearest: f64) {
        if factor != 1.0 {
            let point = self.reach(at);
            self.controls.zoom(point, factor, nearest);
        }
    }

    fn clear_marks(&mut self) {
        self.marks.clear();
        self.marks_before.clear();
    }

    fn mark(&mut self, hit: &Hit) {
        let error = self.terrain.error_metres(hit.layer, hit.diamond, hit.side);
        let place = hit.point.with_z(hit.point.z / self.look.exaggeration);
        let lonlat = self.globe.as_ref().and_then(|globe| globe.lonlat(place));
        self.marks_before.clone_from(&self.marks);
        self.marks.push(Mark { place, lonlat, error, layer: hit.layer });
        if self.marks.len() > 2 {
            self.marks.remove(0);
        }
    }

    /// Opens the panel or closes it.
    fn switch_panel(&mut self, ui: &Ui) {
        if !is_pressed(ui, Key::Tab) {
            return;
        }
        self.open_panel(!self.panel_is_open);
        // To egui the key means the next widget.
        ui.memory_mut(|memory| {
            if let Some(focused) = memory.focused() {
                memory.surrender_focus(focused);
            }
        });
    }

    fn open_panel(&mut self, opens: bool) {
        (self.panel_is_open, self.panel_is_chosen) = (opens, true);
    }

    fn keys(&mut self, ui: &Ui, seconds: f64) {
        let (held, fast) = ui.input(|input| {
            let held = |key: Key| f64::from(u8::from(input.key_down(key) && !input.modifiers.command));
            let axis = |more: Key, less: Key| held(more) - held(less);
            (
                [
                    axis(Key::D, Key::A),
                    axis(Key::W, Key::S),
                    axis(Key::E, Key::Q),
                    axis(Key::ArrowRight, Key::ArrowLeft),
                    axis(Key::ArrowUp, Key::ArrowDown),
                ],
                input.modifiers.shift,
            )
        });
        let [right, ahead, up, turn, tilt] = held;
        if held != [0.0; 5] {
            let height = (self.camera().eye.z - self.ground()).abs().max(5.0 * self.cell());
            self.controls.fly(&Thrust { right, ahead, up, fast }, height, seconds);
            if [turn, tilt] != [0.0; 2] {
                let by = TURN_PER_SECOND * seconds;
                self.controls.turn(self.controls.camera().eye, turn * by, tilt * by);
            }
            ui.ctx().request_repaint();
        }
        let pressed = |key: Key| is_pressed(ui, key);
        if pressed(Key::H) {
            self.go_home();
        }
        if pressed(Key::N) {
            self.north_up();
        }
        if pressed(Key::F) {
            self.frame_scene();
        }
        if pressed(Key::P) {
            self.ask_screenshot();
        }
        // A button that has the focus takes the key for itself.
        if pressed(Key::Space) && ui.memory(|memory| memory.focused().is_none()) {
            self.play();
        }
        if pressed(Key::Escape) {
            self.clear_marks();
            self.message = None;
        }
        let is_quit = |event: &Event| matches!(event, Event::Key { key: Key::Q, pressed: true, modifiers, .. } if modifiers.command);
        if ui.input(|input| input.events.iter().any(is_quit)) {
            self.asks.push(Ask::Quit);
        }
        if ui.input(|input| input.events.iter().any(|event| matches!(event, Event::Copy))) {
            self.asks.push(Ask::Copy(self.address()));
        }
    }

    /// Flies to where all of the scene is seen, as where the viewer begins.
    fn go_home(&mut self) {
        self.controls.glide_to(self.whole(self.terrain.scene()));
    }

    /// The camera that sees all of a scene beside the panel.
    fn whole(&self, scene: &Scene) -> Camera {
        let size = self.camera().size;
        // In a window that is hardly wider than the panel, under it.
        let covered = if 2 * self.covered > size[0] { 0 } else { self.covered };
        let exaggeration = self.look.exaggeration;
        overview::stretched(&overview::overview_beside(scene, size, covered, exaggeration), exaggeration)
    }

    /// Where it begins all is seen, until it is moved.
    fn begin(&mut self) {
        if !self.begins {
            return;
        }
        let size = self.camera().size;
        if let Some((home, covered)) = self.home {
            self.begins = Camera { size, ..home } == *self.camera() && !self.controls.is_gliding();
            // The panel is a little wider or narrower now and then.
            if !self.begins || home.size == size && covered.abs_diff(self.covered) < COVERED_MORE {
                return;
            }
        }
        let home = self.whole(&self.terrain.shown_scene());
        self.home = Some((home, self.covered));
        self.controls = Controls::new(home);
    }

    /// Turns until north is up, around the middle of the picture; on the spot where that is the sky.
    fn north_up(&mut self) {
        let pivot = self.pivot(self.middle()).unwrap_or(self.camera().eye);
        self.controls.glide_north(pivot);
    }

    /// Flies to where all is seen that is shown.
    fn frame_scene(&mut self) {
        self.controls.glide_to(self.whole(&self.terrain.shown_scene()));
    }

    fn ask_screenshot(&mut self) {
        let mut number = 1;
        let name = |number: u32| PathBuf::from(format!("{}-{number:03}.png", self.terrain.scene().name));
        while name(number).exists() {
            number += 1;
        }
        let path = name(number);
        self.asks.push(Ask::Screenshot(path));
    }

    /// The ground in the middle of the picture stays there, and as far away; where that is the sky, the ground below the eye.
    fn set_exaggeration(&mut self, exaggeration: f64) {
        let by = exaggeration / self.look.exaggeration;
        let ground = self.pivot(self.middle()).map(|point| point.z);
        let ground = ground.unwrap_or_else(|| self.ground());
        self.look.exaggeration = exaggeration;
        self.terrain.set_exaggeration(exaggeration);
        self.controls.lift(ground * (by - 1.0));
        self.frozen = None;
    }

    /// The middle of the picture, in pixels.
    fn middle(&self) -> DVec2 {
        DVec2::from(self.camera().size.map(|s| f64::from(s) / 2.0))
    }
}

/// Whether a key has just gone down, alone or with Shift.
fn is_pressed(ui: &Ui, key: Key) -> bool {
    let is_it = |event: &Event| {
        matches!(event, Event::Key { key: found, pressed: true, repeat: false, modifiers, .. }
            if *found == key && matches!(*modifiers, Modifiers::NONE | Modifiers::SHIFT))
    };
    ui.input(|input| input.events.iter().any(is_it))
}

#[cfg(test)]
mod tests;

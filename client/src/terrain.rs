//! One frame of streaming: what has arrived is taken in, the cut is made, what it lacks is asked for.
//!
//! ```text
//!  fetch's threads ──payloads, pages──► frame ──► cut ──► draw list
//!        ▲                                │ ▲       │
//!        └─────────── wishes ─────────────│─│───────┘
//!                                         ▼ │ surfaces
//!                                 decoding threads
//! ```
//!
//! A frame never waits: not for the network, not for a decoder. A payload can be decoded once its parents'
//! surfaces are there; the decoding threads hold it till then and go on from parent to child by
//! themselves, so a whole branch that arrived in one answer is decoded between two frames.
//!
//! A scene that is replaced on the server while it is looked at is opened again by itself: see `reload`. Of a series of
//! water surfaces in time one is drawn, and the next are fetched ahead: see `steps`.

mod decoders;
mod imagery;
mod mirrors;
mod options;
mod reload;
mod shares;
mod shown;
mod stats;
mod steps;
mod view;

use crate::cache::{Cache, Index, Key};
use crate::camera::{Camera, Plane};
use crate::cut::{self, Ask, Drawing, Gpu, Ideal, Wish};
use crate::drawing::{DrawItem, Mirror};
use crate::encoding::Encoding;
use crate::fetch::{self, Event, FetchError, Fetcher, ROOT_BYTES, Traffic, Want};
use crate::morph::{self, Change, Moment, Morphs};
use crate::surface::{Points, Surface, Tin};
use crate::texture::{Drape, Draping};
use bytes::Bytes;
use decoders::{Decoders, Job};
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::{Layer, Scene, StreamAsk, StreamView};
use diamantina_protocol::zone::Zone;
use foldhash::fast::RandomState;
use glam::DVec3;
pub use imagery::Imagery;
pub use options::{Options, TerrainError};
use reload::Reload;
use shares::Shares;
pub use stats::Stats;
use std::collections::{HashMap, HashSet};
use std::sync::Arc;
#[cfg(not(target_arch = "wasm32"))]
use std::time::Duration;
pub use steps::AHEAD_MAX;
use steps::{Role, Steps};
use view::ZoneView;
use web_time::Instant;

/// Wishes that are made however much is held: payloads may be waiting for these.
const WISHES_MIN: usize = 64;

/// What a frame takes in however much is held: the parents of what is held may be among it.
const EVENTS_MIN: usize = 64;

/// Payloads of a stream that come one after another and are not wanted, until it is dropped: the eye has moved
/// away, or there is no memory for more.
const STRAYS_MAX: usize = 256;

/// What a frame shows.
#[derive(Debug, Clone, Default)]
pub struct FrameView {
    /// The triangles to draw; together they cover whatever of the scene is in view, once all roots are
    /// there.
    pub items: Vec<DrawItem>,
    /// What water mirrors, where [`Terrain::set_mirrors`] has asked for it.
    pub mirrors: Vec<Mirror>,
    /// The imagery on them, once some of it is there.
    pub drape: Option<Drape>,
    /// The largest declared error of what is drawn, in pixels, as it looks from no nearer than the near plane;
    /// infinite while a layer lacks a root.
    pub error_pixels: f64,
    /// The same, once all that the ideal cut wants has arrived, as far as the index tells already.
    pub error_pixels_goal: f64,
    /// Whether all that the ideal cut wants is there.
    pub complete: bool,
    /// Whether memory, here or on the GPU, keeps the ideal cut from the tolerance.
    pub limited: bool,
    /// Series of which an earlier step is drawn, since that of the present time has not arrived.
    pub late: usize,
    /// Diamonds in motion, or about to be, and tiles of imagery: the next frame looks different, even if nothing arrives. The error counts
    /// them as not yet split.
    pub moving: usize,
    /// What has happened so far.
    pub stats: Stats,
}

/// A scene that is being streamed.
///
/// Takes [`Options::memory_bytes`] (or, if more, the root diamonds and what a frame needs to get on), besides the pages of
/// the index that the cut looks at and 80 bytes for each diamond that it looks at.
#[derive(Debug)]
pub struct Terrain {
    /// Of the scene itself, also where it was opened as a server's only one.
    url: String,
    scene: Arc<Scene>,
    options: Options,
    layers: Vec<LayerState>,
    cache: Cache,
    shares: Shares,
    fetcher: Fetcher,
    decoders: Decoders,
    /// Payloads handed to the decoders, with their bytes, and the sum.
    pending: HashMap<Key, usize, RandomState>,
    pending_bytes: usize,
    /// Unwanted payloads of streams in a row.
    strays: usize,
    failed: HashSet<fetch::Key, RandomState>,
    problem: Option<String>,
    scene_changed: bool,
    /// How the scene is to be streamed from now on, until it is.
    chosen: Option<Options>,
    /// The version that takes over, once this one has been replaced.
    reload: Option<Reload>,
    /// The declared error of the last frame.
    error_pixels: f64,
    /// What went over the wire for the versions before.
    traffic_before: Traffic,
    opened: Instant,
    /// Whether the lines around triangles are drawn, which take room on the GPU.
    wires: bool,
    /// What frames take of the GPU's memory besides imagery and diamonds.
    gpu_taken: u64,
    /// How many times the error what is mirrored may have, where it is asked for.
    mirrors: Option<f64>,
    /// What the last frame saw; nothing before the first.
    planes: Option<[Plane; 5]>,
    stats: Stats,
    view: Option<ZoneView>,
    draping: Option<Draping>,
    steps: Steps,
}

#[derive(Debug)]
struct LayerState {
    index: Index,
    ideal: Ideal,
    /// What is mirrored of it, for each layer of water.
    mirrored: Vec<Ideal>,
    /// What the cut may take of the memory.
    memory_bytes: usize,
    /// What of it may be drawn, motions included, in bytes on the GPU.
    gpu_bytes: u64,
    /// Pages of the index that are kept beyond those in use.
    pages_max: usize,
    morphs: Morphs,
    /// Whether it is streamed and drawn, or in its turn if it is a step.
    shown: bool,
    /// What it is for, of a series.
    role: Role,
    /// What is wanted ahead of it, once it has been looked at.
    ahead: Option<Vec<Wish>>,
    /// Whether some of that is missing.
    lacks: bool,
    /// Whether another step was drawn before it: nothing of it moves in its first frame.
    appears: bool,
}

impl Terrain {
    /// As [`Terrain::connect`], waiting for it.
    ///
    /// # Errors
    /// When there is no such scene, or this build cannot show it.
    #[cfg(not(target_arch = "wasm32"))]
    pub fn open(url: &str, options: Options) -> Result<Self, TerrainError> {
        pollster::block_on(Self::connect(url, options))
    }

    /// Opens a scene: reads its description, and starts what fetches and decodes. `url` as for [`Fetcher::connect`].
    ///
    /// # Errors
    /// When there is no such scene, or this build cannot show it.
    pub async fn connect(url: &str, options: Options) -> Result<Self, TerrainError> {
        if options.tolerance_pixels.is_nan() || options.tolerance_pixels <= 0.0 {
            return Err(TerrainError::Tolerance(options.tolerance_pixels));
        }
        if !(0.0..=morph::SECONDS_MAX).contains(&options.morph_seconds) {
            return Err(TerrainError::Morph(options.morph_seconds));
        }
        let opened = Instant::now();
        let (fetcher, scene) = Fetcher::connect(url, &options.fetch).await?;
        let encoding = options.fetch.encoding;
        if let Some(layer) = scene.layers.iter().find(|layer| encoding.layer(layer).is_none()) {
            return Err(TerrainError::Encoding {
                layer: layer.name.clone(),
                offered: layer.encodings.clone(),
                asked: encoding.name(),
            });
        }
        fetch::check_layers(&scene, options.layers.as_deref().unwrap_or_default())?;
        let view = match options.zone.as_deref() {
            Some(name) => {
                let zone = ZoneView::find(&scene, name)?;
                Some(ZoneView { masks: fetcher.masks(name).await?, zone })
            }
            None => None,
        };
        let texture = options.imagery.find(&scene)?;
        let state = |layer: &Layer| LayerState {
            index: Index::new(layer.forest),
            ideal: Ideal::default(),
            mirrored: Vec::new(),
            memory_bytes: 0,
            gpu_bytes: 0,
            pages_max: 0,
            morphs: Morphs::new(options.morph_seconds),
            shown: true,
            role: Role::Drawn,
            ahead: None,
            lacks: true,
            appears: false,
        };
        let layers = scene.layers.iter().map(state).collect();
        let forests: Vec<_> = scene.layers.iter().map(|layer| layer.forest).collect();
        let shares = Shares::of(options.memory_bytes, &forests);
        let cache = Cache::new(forests, shares.surfaces);
        let scene = Arc::new(scene);
        let shown = options.layers.clone();
        let steps = Steps::of(&scene, options.time);
        let mut terrain = Self {
            url: fetcher.address(),
            layers,
            cache,
            fetcher,
            shares,
            decoders: Decoders::start(&scene, encoding, shares.done)?,
            scene,
            options,
            pending: HashMap::default(),
            pending_bytes: 0,
            strays: 0,
            failed: HashSet::default(),
            problem: None,
            scene_changed: false,
            chosen: None,
            reload: None,
            error_pixels: f64::INFINITY,
            traffic_before: Traffic::default(),
            opened,
            wires: false,
            gpu_taken: 0,
            mirrors: None,
            planes: None,
            stats: Stats::default(),
            view,
            draping: None,
            steps,
        };
        terrain.turn_steps();
        terrain.draping = texture.map(|number| terrain.drape(number)).transpose()?;
        terrain.show_only(shown);
        Ok(terrain)
    }

    /// The scene's description.
    #[must_use]
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Whether the server has another version of the scene: what is here stays, and nothing more of it comes. The other
    /// one is being loaded, and takes over with one of the next frames: then [`Terrain::scene`] is that one.
    #[must_use]
    pub fn scene_changed(&self) -> bool {
        self.scene_changed
    }

    /// How diamonds are encoded.
    #[must_use]
    pub fn encoding(&self) -> Encoding {
        self.options.fetch.encoding
    }

    /// The zone that was asked for.
    #[must_use]
    pub fn zone(&self) -> Option<&Zone> {
        self.view.as_ref().map(|view| &view.zone)
    }

    /// The last thing that failed for good, in words.
    #[must_use]
    pub fn problem(&self) -> Option<&str> {
        self.problem.as_deref()
    }

    /// How far the triangles over a side of a split diamond may be off, in metres: the declared error of whatever would
    /// split them further, or of the finest level. `None` where the index does not tell yet.
    #[must_use]
    pub fn error_metres(&self, layer: usize, diamond: Diamond, side: usize) -> Option<f64> {
        let layer_is = self.scene.layers.get(layer)?;
        let child = layer_is.forest.children(diamond).get(side).copied()?;
        let error = match child {
            Some(child) => self.layers[layer].index.get(child)?.error_metres,
            None => layer_is.finest_error,
        };
        Some(f64::from(error))
    }

    /// The error to reach, in pixels.
    #[must_use]
    pub fn tolerance_pixels(&self) -> f64 {
        self.options.tolerance_pixels
    }

    /// Sets the error to reach, in pixels; what is no number above 0 changes nothing.
    pub fn set_tolerance_pixels(&mut self, pixels: f64) {
        if pixels > 0.0 {
            self.options.tolerance_pixels = pixels;
        }
    }

    /// Seconds that points take to move, and triangles to appear, where the level of detail changes.
    #[must_use]
    pub fn morph_seconds(&self) -> f64 {
        self.options.morph_seconds
    }

    /// Sets them, from 0 to [`morph::SECONDS_MAX`]; what is on its way jumps.
    pub fn set_morph_seconds(&mut self, seconds: f64) {
        let seconds = seconds.clamp(0.0, morph::SECONDS_MAX);
        self.options.morph_seconds = seconds;
        if let Some(chosen) = &mut self.chosen {
            chosen.morph_seconds = seconds;
        }
        for state in &mut self.layers {
            state.morphs = Morphs::new(seconds);
        }
    }

    /// Sets what heights are multiplied by; what is no number above 0 changes nothing.
    pub fn set_exaggeration(&mut self, exaggeration: f64) {
        if exaggeration > 0.0 && exaggeration.is_finite() {
            self.options.exaggeration = exaggeration;
        }
    }

    /// Says whether the lines around triangles are drawn, which take room on the GPU.
    pub fn set_wires(&mut self, wires: bool) {
        self.wires = wires;
    }

    /// Why the server is not asked, if it is not: it cannot be reached, or nobody wants it to be. What is drawn then was
    /// fetched before.
    #[must_use]
    pub fn offline(&self) -> Option<String> {
        self.fetcher.away()
    }

    /// Asks for all that a view needs in one request a layer, the largest errors first: on the way, each frame
    /// draws what is there, and once it has ended, frames ask for what is still missing. It is dropped where
    /// most of it turns out not to be wanted. The camera is as for [`Terrain::frame`]. Streams are of points: in
    /// another encoding this asks for nothing.
    pub fn stream(&mut self, camera: &Camera) {
        if self.options.fetch.encoding != Encoding::Points {
            return;
        }
        // A little less than the tolerance, for the rounding of both ends.
        let angle = self.options.tolerance_pixels / camera.pixels_per_radian() * (1.0 - 1e-9);
        // The server knows heights as they are: the same view, from where a camera of such heights would be.
        // Where heights are exaggerated it asks for no more than the cut wants, which asks for the rest.
        let exaggeration = self.options.exaggeration;
        let flat = |plane: &Plane| (plane.normal * DVec3::new(1.0, 1.0, exaggeration)).normalize().to_array();
        let sides = camera.planes().iter().map(flat).collect();
        let eye = camera.eye.with_z(camera.eye.z / exaggeration).to_array();
        let view = StreamView { eye, angle, sides, vertical: self.options.sight.vertical };
        let is_asked = |layer: &usize| self.layers[*layer].shown && self.steps.is_wanted(*layer);
        for layer in (0..self.layers.len()).filter(is_asked) {
            self.fetcher.stream(layer, StreamAsk { view: Some(view.clone()), ..StreamAsk::default() });
        }
        self.strays = 0;
    }

    /// Takes in what has arrived, says what to draw, and asks for what is missing. The camera's heights are
    /// multiplied, if those of the terrain are. Never waits; takes about a microsecond for each diamond that
    /// the cut looks at, and 1.5 ms where as many motions begin as may: [`morph::STARTS_MAX`].
    pub fn frame(&mut self, camera: &Camera) -> FrameView {
        self.frame_at(camera, self.opened.elapsed().as_secs_f64())
    }

    /// As [`Terrain::frame`], at a moment of the caller's clock, which runs forward: seconds from any beginning, the same
    /// for all frames. Only motions depend on it.
    pub fn frame_at(&mut self, camera: &Camera, seconds: f64) -> FrameView {
        if self.is_leaving()
            && let Some(view) = self.go_over(camera, seconds)
        {
            return view;
        }
        self.draw_at(camera, seconds)
    }

    /// A frame of this version.
    fn draw_at(&mut self, camera: &Camera, seconds: f64) -> FrameView {
        let now = Moment::at(seconds);
        let started = Instant::now();
        self.take_decoded();
        self.take_tiles();
        let arrived = self.take_fetched();
        self.turn_steps();
        // What comes of another version is still to come.
        let mut view = FrameView { complete: !self.is_leaving(), ..FrameView::default() };
        let mut wishes = Vec::new();
        (self.stats.splits_ideal, self.stats.splits_drawn) = (0, 0);
        // Heights that are multiplied, all of them, leave hidden what is hidden.
        let eye = camera.eye.with_z(camera.eye.z / self.options.exaggeration);
        let zone = self.view.as_ref().filter(|view| view.zone.contains(eye.to_array()));
        self.stats.zone_in_effect = zone.is_some();
        let tolerance = self.options.tolerance_pixels / camera.pixels_per_radian();
        let [parts, own] = self.beside_mirrors();
        for (number, role) in self.steps.order(&self.layers) {
            let memory_bytes = self.steps.room(number, &self.layers) / parts * own;
            let state = &mut self.layers[number];
            let gpu_bytes_of = |d| self.cache.get((number, d)).map(|surface| surface.gpu_bytes(self.wires));
            // What moves is drawn beside what it becomes.
            let gpu_bytes = state.gpu_bytes / parts as u64 * own as u64;
            let gpu_bytes = if state.morphs.is_on() { gpu_bytes / 3 * 2 } else { gpu_bytes };
            let ask = Ask {
                layer: &self.scene.layers[number],
                encoding: self.options.fetch.encoding,
                camera,
                exaggeration: self.options.exaggeration,
                tolerance_pixels: self.options.tolerance_pixels,
                sight: self.options.sight,
                seen: zone.map(|zone| zone.seen(number, tolerance)),
                memory_bytes,
                gpu: Some(Gpu { bytes: gpu_bytes, of: &gpu_bytes_of }),
            };
            state.ideal = cut::choose(&ask, |d| state.index.get(d));
            let surface = |d| self.cache.get((number, d)).cloned();
            let mut drawing = cut::draw(number, &ask, &state.ideal, surface);
            let mirrored = state.mirrored.iter().flat_map(Ideal::seen);
            state.index.trim(state.pages_max, state.ideal.seen().chain(mirrored));
            if role == Role::Ahead {
                state.ahead = Some(drawing.wishes);
                continue;
            }
            if role == Role::Stays {
                // What it lacks by now is not worth fetching.
                drawing.wishes.clear();
            } else {
                view.complete &= drawing.wishes.is_empty() && state.ideal.pages().is_empty();
                view.limited |= state.ideal.is_limited();
                view.error_pixels_goal = view.error_pixels_goal.max(drawing.error_pixels_goal);
            }
            wishes.extend(drawing.wishes.drain(..).map(|wish| (number, wish)));
            if role == Role::Awaited {
                view.late += 1;
                continue;
            }
            if state.morphs.is_on() {
                let last = if state.appears { None } else { self.planes.as_ref() };
                state.appears = false;
                view.moving += state.move_on(&ask, number, now, &surface, last, self.wires, &mut drawing);
            }
            self.stats.splits_ideal += state.ideal.len();
            self.stats.splits_drawn += drawing.splits.len();
            view.items.extend(drawing.items);
            view.error_pixels = view.error_pixels.max(drawing.error_pixels);
        }
        self.mirror(camera, &mut view, &mut wishes);
        self.fit_ahead();
        self.planes = Some(camera.planes());
        self.judge_streams(&arrived);
        let layers = self.layers.iter().enumerate();
        self.cache.want(layers.flat_map(|(number, state)| state.wanted().map(move |d| (number, d))));
        let imagery = self.imagery(camera, seconds, &mut view);
        self.wish(wishes, imagery);
        self.note(&view, started);
        view.stats = self.stats;
        view
    }

    /// What a cut at another tolerance would draw, if all of it is there, whatever else is. Asks for nothing.
    #[cfg(not(target_arch = "wasm32"))]
    pub(crate) fn drawn_at(&self, camera: &Camera, tolerance_pixels: f64) -> Option<Vec<DrawItem>> {
        let mut items = Vec::new();
        let drawn = |(_, state): &(usize, &LayerState)| matches!(state.role, Role::Drawn | Role::Stays);
        for (number, state) in self.layers.iter().enumerate().filter(drawn) {
            let ask = Ask {
                layer: &self.scene.layers[number],
                encoding: self.options.fetch.encoding,
                camera,
                exaggeration: self.options.exaggeration,
                tolerance_pixels,
                sight: self.options.sight,
                seen: None,
                memory_bytes: state.memory_bytes,
                gpu: None,
            };
            let ideal = cut::choose(&ask, |d| state.index.get(d));
            let drawing = cut::draw(number, &ask, &ideal, |d| self.cache.get((number, d)).cloned());
            if !drawing.wishes.is_empty() || !ideal.pages().is_empty() {
                return None;
            }
            items.extend(drawing.items);
        }
        Some(items)
    }

    /// Repeats frames until all that the ideal cut wants is there and stands still, or nothing more can come, or the
    /// time is up. For pictures without a window.
    #[cfg(not(target_arch = "wasm32"))]
    pub fn settle(&mut self, camera: &Camera, timeout: Duration) -> FrameView {
        self.wait(camera, None, timeout)
    }

    /// As [`Terrain::settle`], at one moment of the caller's clock: what moves does not come to rest meanwhile.
    #[cfg(not(target_arch = "wasm32"))]
    pub fn settle_at(&mut self, camera: &Camera, seconds: f64, timeout: Duration) -> FrameView {
        self.wait(camera, Some(seconds), timeout)
    }

    #[cfg(not(target_arch = "wasm32"))]
    fn wait(&mut self, camera: &Camera, seconds: Option<f64>, timeout: Duration) -> FrameView {
        let until = Instant::now() + timeout;
        loop {
            let view = match seconds {
                Some(seconds) => self.frame_at(camera, seconds),
                None => self.frame(camera),
            };
            let stuck = match &self.reload {
                Some(reload) => reload.is_stuck(),
                None => !self.is_leaving() && self.is_stuck(),
            };
            let still = view.moving == 0 || seconds.is_some();
            if (still && (view.complete || stuck)) || Instant::now() >= until {
                return view;
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// Whether nothing more comes for now.
    fn is_stuck(&self) -> bool {
        let is_idle = self.decoders.is_idle() && self.draping.as_ref().is_none_or(Draping::is_idle);
        is_idle && self.fetcher.is_stuck()
    }

    fn take_decoded(&mut self) {
        for ((number, d), result) in self.decoders.take() {
            let key = (number, d);
            self.pending_bytes -= self.pending.remove(&key).unwrap_or(0);
            match result {
                Ok(surface) => {
                    self.fetcher.accept(fetch::Key::Diamond(number, d));
                    let tally = surface.points().map(Points::tally).unwrap_or_default();
                    self.stats.triangles += surface.tin().map_or(0, Tin::triangles) as u64;
                    self.stats.points_real += u64::from(tally.real);
                    self.stats.points_fictitious += u64::from(tally.fictitious);
                    self.stats.points_corrected += u64::from(tally.corrected);
                    // What finds no room is wished for again when it is needed.
                    self.cache.insert(key, surface, self.layers[number].wants(d));
                }
                Err(error) => {
                    tracing::debug!(%error, centre = ?d.centre(), "payload refused");
                    self.fetcher.refuse(fetch::Key::Diamond(number, d), &FetchError::Damaged(d.centre()));
                }
            }
        }
    }

    /// Takes what has been fetched, as far as there is room; the payloads among it.
    fn take_fetched(&mut self) -> Vec<Key> {
        let (mut arrived, mut events) = (Vec::new(), 0);
        while self.pending_bytes < self.shares.held || events < EVENTS_MIN {
            let Some(event) = self.fetcher.poll() else { break };
            events += 1;
            match event {
                Event::Page(layer, page, entries) => {
                    self.failed.remove(&fetch::Key::Page(layer, page));
                    self.layers[layer].index.insert(page, entries);
                }
                Event::Payload(layer, d, payload) => {
                    self.failed.remove(&fetch::Key::Diamond(layer, d));
                    self.decode((layer, d), payload);
                    arrived.push((layer, d));
                }
                Event::Coverage(number, coverage) => {
                    self.failed.remove(&fetch::Key::Coverage(number));
                    if let Some(draping) = self.draping.as_mut().filter(|d| d.number() == number) {
                        draping.set_coverage(coverage);
                    }
                }
                Event::Tile(number, tile, picture) => {
                    self.failed.remove(&fetch::Key::Tile(number, tile));
                    if let Some(draping) = self.draping.as_mut().filter(|d| d.number() == number) {
                        draping.take(tile, picture);
                    }
                }
                Event::Failed(key, error) => {
                    tracing::warn!(%error, "given up for now");
                    self.failed.insert(key);
                    self.problem = Some(error.to_string());
                }
                Event::SceneChanged => self.scene_changed = true,
            }
        }
        arrived
    }

    /// Drops streams that bring what the cut does not want.
    fn judge_streams(&mut self, arrived: &[Key]) {
        if !self.fetcher.is_streaming() {
            return;
        }
        for (number, d) in arrived {
            let wanted = self.layers[*number].ideal.contains(*d);
            self.strays = if wanted { 0 } else { self.strays + 1 };
        }
        if self.strays >= STRAYS_MAX {
            self.fetcher.end_streams();
        }
    }

    fn decode(&mut self, key: Key, payload: Bytes) {
        if self.pending.contains_key(&key) || self.cache.get(key).is_some() {
            return;
        }
        self.pending.insert(key, payload.len());
        self.pending_bytes += payload.len();
        let parents = self.scene.layers[key.0].forest.parents(key.1);
        let parents = parents.map(|parent| (parent, self.cache.get((key.0, parent)).cloned())).collect();
        self.decoders.submit(key, Job { payload, parents });
    }

    /// Asks for what the cut lacks: roots of all layers, pages, then payloads as they are urgent.
    fn wish(&mut self, mut wishes: Vec<(usize, Wish)>, imagery: Vec<Want>) {
        for key in self.decoders.forget(|(number, d)| self.layers[number].wants(d)) {
            self.pending_bytes -= self.pending.remove(&key).unwrap_or(0);
        }
        if self.layers.len() > 1 {
            wishes.sort_by(|(_, a), (_, b)| a.order(b));
        }
        // They are few, and do not stand in one another's way.
        let mut wants = imagery;
        wants.reserve(wishes.len());
        let mut room = self.shares.held.saturating_sub(self.pending_bytes);
        let mut payloads = wishes.into_iter().peekable();
        while let Some((number, wish)) = payloads.next_if(|(_, wish)| wish.diamond.level() == 0) {
            self.want((number, wish), &mut wants, &mut room);
        }
        let asked = |(_, state): &(usize, &LayerState)| matches!(state.role, Role::Drawn | Role::Awaited);
        for (number, state) in self.layers.iter().enumerate().filter(asked) {
            let mirrored = state.mirrored.iter().flat_map(Ideal::pages);
            let pages = state.ideal.pages().iter().chain(mirrored);
            wants.extend(pages.map(|p| Want { key: fetch::Key::Page(number, *p), bytes: None }));
        }
        let pages_and_roots = wants.len();
        for wish in payloads {
            if room == 0 && wants.len() >= pages_and_roots + WISHES_MIN {
                break;
            }
            self.want(wish, &mut wants, &mut room);
        }
        let pressing = wants.len();
        self.want_ahead(&mut wants, &mut room);
        self.fetcher.wish_ahead(wants, pressing);
    }

    fn want(&mut self, (number, wish): (usize, Wish), wants: &mut Vec<Want>, room: &mut usize) {
        let key = (number, wish.diamond);
        if self.pending.contains_key(&key) {
            return;
        }
        if wish.bytes == Some(0) {
            // Nothing to fetch: it follows from its parents.
            self.decode(key, Bytes::new());
            return;
        }
        *room = room.saturating_sub(wish.bytes.unwrap_or(ROOT_BYTES) as usize);
        wants.push(Want { key: fetch::Key::Diamond(number, wish.diamond), bytes: wish.bytes });
    }
}

impl LayerState {
    /// Goes on with the motions that lead to `drawing`, and puts what they look like `now` in its place. Returns how
    /// many diamonds move; none where the GPU has no room for them.
    #[allow(clippy::too_many_arguments, reason = "a change is told by so many things, each of its own type")]
    fn move_on(
        &mut self,
        ask: &Ask,
        number: usize,
        now: Moment,
        surface: &impl Fn(Diamond) -> Option<Arc<Surface>>,
        last: Option<&[Plane; 5]>,
        wires: bool,
        drawing: &mut Drawing,
    ) -> usize {
        // Nothing is drawn while a root is missing, and where nothing was drawn, nothing moves.
        let wanted = if drawing.items.is_empty() { &[] } else { drawing.splits.as_slice() };
        let entry = |d| self.index.get(d);
        let sight = |d| match last {
            Some(last) => cut::sight(ask, &self.ideal, d, entry(d), last),
            None => morph::Sight { visible: false, error_metres: 0.0 },
        };
        let cut = self.morphs.step(&Change { layer: ask.layer, now, wanted, surface, sight: &sight });
        let moving = cut.moving();
        if moving > 0 {
            let showing = cut::show(number, ask, &self.ideal, entry, &cut, now);
            // Those of a diamond follow one another, and share its surface.
            let of_diamonds = showing.items.chunk_by(|a, b| a.diamond == b.diamond).map(|items| &items[0]);
            if of_diamonds.map(|item| item.gpu_bytes(wires)).sum::<u64>() > self.gpu_bytes {
                self.morphs.jump(&drawing.splits);
                return 0;
            }
            drawing.items = showing.items;
            drawing.error_pixels = drawing.error_pixels.max(showing.error_pixels);
            drawing.splits = cut.shown.iter().map(|shown| shown.diamond).collect();
        }
        moving
    }
}

#[cfg(test)]
mod tests;

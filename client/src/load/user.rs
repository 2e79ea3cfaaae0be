//! One user: looks at one view after another, and asks for what its cut lacks.

use super::Options;
use super::ledger::WrongError;
use super::tally::Tally;
use super::versions::{Version, Versions};
use crate::cache::{Cache, Index, PAGES_MAX};
use crate::camera::Camera;
use crate::cut::{self, Ask};
use crate::encoding::Encoding;
use crate::fetch::{Answer, Ask as Request, FetchError, one};
use crate::headless::{Dice, FlightPath, PathKey};
use crate::overview::extent;
use crate::sight::Sight;
use bytes::Bytes;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::Scene;
use futures_util::StreamExt as _;
use reqwest::Client;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How long a connection may be silent.
pub(super) const PATIENCE: Duration = Duration::from_secs(30);

/// How long a user waits for a view before going on.
const VIEW_PATIENCE: Duration = Duration::from_secs(30);

/// The pause after a failure.
const PAUSE: Duration = Duration::from_millis(500);

/// Places that a user without a path looks at, again and again.
const PLACES: u32 = 512;

/// Somewhere else again and again: mostly near the last place, as people look around, and low over the ground.
fn wandering(scene: &Scene, dice: &mut Dice) -> FlightPath {
    let [low, high] = extent(scene);
    let span = (high - low).truncate();
    let mut place = low.truncate() + span * glam::DVec2::new(dice.roll(), dice.roll());
    let keys = (0..PLACES).map(|i| {
        let reach = if dice.roll() < 0.2 { 1.0 } else { 0.1 };
        let step = span * reach * glam::DVec2::new(dice.roll() - 0.5, dice.roll() - 0.5);
        place = (place + step).clamp(low.truncate(), high.truncate());
        // From a hundredth to a half of the scene's size above its highest ground.
        let above = span.max_element() * 0.01 * 50f64.powf(dice.roll());
        let angle = std::f64::consts::TAU * dice.roll();
        let ahead = glam::DVec2::from_angle(angle) * above * (1.0 + 3.0 * dice.roll());
        let eye = place.extend(high.z + above);
        let target = (place + ahead).extend(low.z.midpoint(high.z));
        PathKey { seconds: f64::from(i), eye: eye.to_array(), target: target.to_array() }
    });
    FlightPath { keys: keys.collect() }
}

struct Layer {
    index: Index,
    memory_bytes: usize,
}

/// One user, who has not arrived yet.
pub(super) struct User {
    versions: Arc<Versions>,
    client: Client,
    version: Arc<Version>,
    encoding: Encoding,
    layers: Vec<Layer>,
    cache: Cache,
    memory_bytes: usize,
    path: FlightPath,
    /// Whether the path is the user's own, made for the scene.
    wanders: bool,
    views: u32,
    first: u32,
    think: Duration,
    size: [u32; 2],
    tolerance_pixels: f64,
    requests_max: usize,
    dice: Dice,
}

/// What a user has of a version, at first: nothing.
fn nothing(scene: &Scene, memory_bytes: usize) -> (Vec<Layer>, Cache) {
    let share = memory_bytes / scene.layers.len() / 4 * 3;
    let layer = |forest| Layer { index: Index::new(forest), memory_bytes: share };
    let layers = scene.layers.iter().map(|of| layer(of.forest)).collect();
    (layers, Cache::new(scene.layers.iter().map(|of| of.forest).collect(), memory_bytes))
}

impl User {
    pub(super) fn new(
        number: u32,
        versions: &Arc<Versions>,
        client: Client,
        version: Arc<Version>,
        options: &Options,
    ) -> Self {
        let mut dice = Dice(options.seed ^ u64::from(number).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let given = options.paths.get(number as usize % options.paths.len().max(1));
        let (path, views, first) = match given {
            // Not all at the same place at once.
            Some(path) => (path.clone(), options.views, number.wrapping_mul(7919) % options.views.max(1)),
            None => (wandering(&version.scene, &mut dice), PLACES, 0),
        };
        let (layers, cache) = nothing(&version.scene, options.memory_bytes);
        Self {
            versions: Arc::clone(versions),
            client,
            version,
            encoding: options.encoding,
            layers,
            cache,
            memory_bytes: options.memory_bytes,
            path,
            wanders: given.is_none(),
            views,
            first,
            think: options.think,
            size: options.size,
            tolerance_pixels: options.tolerance_pixels,
            requests_max: options.requests_max.max(1),
            dice,
        }
    }

    /// Looks at views until there is enough.
    pub(super) async fn run(mut self, tally: &Tally, stopping: &AtomicBool) {
        for view in self.first.. {
            if stopping.load(Ordering::Relaxed) {
                return;
            }
            tally.looks();
            let part = f64::from(view % self.views) / f64::from((self.views - 1).max(1));
            let settled = self.settle(part, tally, stopping).await;
            if !stopping.load(Ordering::Relaxed) {
                tally.viewed(settled);
            }
            tokio::time::sleep(self.think.mul_f64(0.5 + self.dice.roll())).await;
        }
    }

    /// Asks for what a view lacks until nothing is missing; how long that took, or `None` if it did not come to an end. The view is
    /// that at a part of the path.
    async fn settle(&mut self, part: f64, tally: &Tally, stopping: &AtomicBool) -> Option<Duration> {
        let began = Instant::now();
        while began.elapsed() < VIEW_PATIENCE && !stopping.load(Ordering::Relaxed) {
            let camera = self.path.camera(part, self.size);
            let (requests, empty) = self.missing(&camera);
            let is_settled = requests.is_empty() && empty.is_empty();
            if is_settled {
                return Some(began.elapsed());
            }
            let mut arrived: Vec<(usize, Diamond, Bytes)> =
                empty.into_iter().map(|(layer, d)| (layer, d, Bytes::new())).collect();
            let base = &*self.versions.source.root;
            let (client, scene, encoding) = (&self.client, &self.version.scene, self.encoding);
            let mut answers = futures_util::stream::iter(requests)
                .map(|request| async move { one(client, base, scene, encoding, &request).await })
                .buffer_unordered(self.requests_max);
            let [mut has_failed, mut is_gone] = [false; 2];
            let mut pages = Vec::new();
            while let Some(answer) = answers.next().await {
                match answer {
                    Ok(Answer { took, times, bytes, page, payloads }) => {
                        tally.answered(took, &times, bytes);
                        pages.extend(page);
                        arrived.extend(payloads);
                    }
                    Err(FetchError::Status { status: 410, .. }) => is_gone = true,
                    Err(error) => {
                        tally.refused(&error);
                        has_failed = true;
                    }
                }
            }
            drop(answers);
            for (layer, number, entries) in pages {
                self.layers[layer].index.insert(number, entries);
            }
            self.take(arrived, tally);
            if is_gone {
                has_failed |= !self.go_over(tally).await;
            }
            if has_failed {
                tokio::time::sleep(PAUSE.mul_f64(1.0 + self.dice.roll())).await;
            }
        }
        None
    }

    /// Goes over to the version that took the place of this one; whether there is one.
    async fn go_over(&mut self, tally: &Tally) -> bool {
        match self.versions.after(&self.version).await {
            Ok(Some(newer)) => {
                (self.layers, self.cache) = nothing(&newer.scene, self.memory_bytes);
                if self.wanders {
                    self.path = wandering(&newer.scene, &mut self.dice);
                }
                self.version = newer;
                tally.went_over();
                return true;
            }
            Ok(None) => {
                tally.failed("status 410, of a version that the server still describes as its newest")
            }
            Err(error) => tally.refused(&error),
        }
        false
    }

    /// What the cut of a view lacks: requests, most urgent first, and diamonds without a payload.
    fn missing(&mut self, camera: &Camera) -> (Vec<Request>, Vec<(usize, Diamond)>) {
        let (mut pages, mut wishes, mut wanted) = (Vec::new(), Vec::new(), Vec::new());
        for (number, state) in self.layers.iter_mut().enumerate() {
            let ask = Ask {
                layer: &self.version.scene.layers[number],
                encoding: self.encoding,
                camera,
                exaggeration: 1.0,
                tolerance_pixels: self.tolerance_pixels,
                sight: Sight::default(),
                seen: None,
                memory_bytes: state.memory_bytes,
                gpu: None,
            };
            let ideal = cut::choose(&ask, |d| state.index.get(d));
            let drawing = cut::draw(number, &ask, &ideal, |d| self.cache.get((number, d)).cloned());
            pages.extend(ideal.pages().iter().map(|page| Request::Page(number, *page)));
            wishes.extend(drawing.wishes.into_iter().map(|wish| (number, wish)));
            wanted.extend(ideal.splits().map(|d| (number, d)));
            state.index.trim(PAGES_MAX, ideal.seen());
        }
        self.cache.want(wanted.into_iter());
        wishes.sort_by(|(_, a), (_, b)| a.order(b));
        let (empty, full): (Vec<_>, Vec<_>) = wishes.into_iter().partition(|(_, wish)| wish.bytes == Some(0));
        let wants = full.into_iter().map(|(layer, wish)| (layer, wish.diamond, wish.bytes));
        let mut requests = pages;
        requests.extend(Request::batches(
            &self.versions.source.root,
            &self.version.scene,
            self.encoding,
            wants,
        ));
        // What is not asked for now is asked for by the next cut, which knows more.
        requests.truncate(self.requests_max);
        (requests, empty.into_iter().map(|(layer, wish)| (layer, wish.diamond)).collect())
    }

    /// Takes payloads in, parents before children.
    fn take(&mut self, mut arrived: Vec<(usize, Diamond, Bytes)>, tally: &Tally) {
        arrived.sort_by_key(|(layer, d, _)| (d.level(), *layer));
        for (layer, d, payload) in arrived {
            let held = |d: Diamond| self.cache.get((layer, d)).cloned();
            match self.version.ledger.surface((layer, d), &payload, held) {
                Ok(surface) => {
                    self.cache.insert((layer, d), surface, true);
                }
                // Its parents are in an answer that did not come: it is asked for again after them.
                Err(WrongError::Early(_)) => {}
                Err(error) => tally.failed(&error.to_string()),
            }
        }
    }
}

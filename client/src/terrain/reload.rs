//! Going over to another version of a scene that was replaced while it was looked at.
//!
//! What is here stays on the screen. Meanwhile the scene is opened again, in the background, and what the view needs of it is
//! loaded, beside what is drawn; once it is as exact, it takes over, in one frame. While both are there, they take
//! twice the memory. The same way another encoding of the same version is gone over to, or another zone.

use super::{FrameView, Imagery, Options, Terrain, TerrainError};
use crate::background::aside;
use crate::camera::Camera;
use crate::encoding::Encoding;
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::time::Duration;
use web_time::Instant;

/// How long before a scene that could not be opened again is tried once more.
const PAUSE: Duration = Duration::from_secs(5);

/// The other version.
#[derive(Debug)]
pub(super) enum Reload {
    Opening(Receiver<Result<Terrain, TerrainError>>),
    Loading(Box<Terrain>),
    /// It could not be opened, and is not tried before this moment.
    Failed(Instant),
}

/// Opens a scene in the background. A build drops zones: without the one asked for, all of it counts.
fn open(url: &str, options: &Options) -> Reload {
    let (sender, receiver) = sync_channel(1);
    // The other version may have other layers.
    let (url, options) = (url.to_owned(), Options { layers: None, ..options.clone() });
    let started = aside("diamantina-reload", async move {
        let mut options = options;
        let opened = loop {
            match Terrain::connect(&url, options.clone()).await {
                Err(TerrainError::Zone { .. }) if options.zone.is_some() => options.zone = None,
                Err(TerrainError::Texture { .. }) => options.imagery = Imagery::First,
                other => break other,
            }
        };
        // Nobody waits for it any more when the terrain is dropped.
        let _ = sender.send(opened);
    });
    started.map_or_else(|_| Reload::Failed(Instant::now() + PAUSE), |_| Reload::Opening(receiver))
}

impl Reload {
    /// Whether nothing more comes for now.
    #[cfg(not(target_arch = "wasm32"))]
    pub(super) fn is_stuck(&self) -> bool {
        match self {
            Self::Opening(_) => false,
            Self::Loading(next) => next.is_stuck(),
            Self::Failed(_) => true,
        }
    }
}

impl Terrain {
    /// Streams the scene in an encoding, and for a zone or none, from one of the next frames on: what is drawn stays until
    /// the other is as exact. [`Terrain::problem`] says so if that cannot be had; then it goes on as before.
    pub fn choose(&mut self, encoding: Encoding, zone: Option<String>) {
        self.reload = None;
        let is_so = encoding == self.encoding() && zone == self.options.zone;
        let mut options = Options { zone, ..self.options.clone() };
        options.fetch.encoding = encoding;
        self.chosen = (!is_so).then_some(options);
    }

    /// The encoding and the zone that were chosen: what is streamed, or will be.
    #[must_use]
    pub fn choice(&self) -> (Encoding, Option<&str>) {
        let options = self.next_options();
        (options.fetch.encoding, options.zone.as_deref())
    }

    fn next_options(&self) -> &Options {
        self.chosen.as_ref().unwrap_or(&self.options)
    }

    /// Whether another takes over as soon as it is ready.
    pub(super) fn is_leaving(&self) -> bool {
        self.scene_changed || self.chosen.is_some()
    }

    /// A frame of the version that took this one's place, if it is ready, or else `None`. It takes over then.
    pub(super) fn go_over(&mut self, camera: &Camera, seconds: f64) -> Option<FrameView> {
        let mut reload = match self.reload.take() {
            None => open(&self.url, self.next_options()),
            Some(Reload::Failed(until)) if Instant::now() >= until => open(&self.url, self.next_options()),
            Some(Reload::Opening(receiver)) => match receiver.try_recv() {
                Ok(Ok(next)) => Reload::Loading(Box::new(next)),
                Ok(Err(error)) => {
                    self.problem = Some(error.to_string());
                    // What was chosen is not there.
                    if self.chosen.take().is_some() && !self.scene_changed {
                        return None;
                    }
                    Reload::Failed(Instant::now() + PAUSE)
                }
                Err(TryRecvError::Empty) => Reload::Opening(receiver),
                Err(TryRecvError::Disconnected) => Reload::Failed(Instant::now() + PAUSE),
            },
            Some(other) => other,
        };
        let mut ready = None;
        if let Reload::Loading(next) = &mut reload {
            next.options.tolerance_pixels = self.options.tolerance_pixels;
            next.options.exaggeration = self.options.exaggeration;
            next.wires = self.wires;
            next.set_gpu_taken(self.gpu_taken);
            next.show_only(self.options.layers.clone());
            next.set_time(self.time(), self.steps.course);
            let view = next.draw_at(camera, seconds);
            let is_as_exact = view.error_pixels <= self.error_pixels || view.complete || next.is_stuck();
            // Nor is imagery missing for a while.
            let is_draped = view.drape.is_some() || next.draping.is_none() || next.is_stuck();
            if view.error_pixels.is_finite() && is_as_exact && is_draped {
                ready = Some(view);
            }
        }
        // Replaced again already, or caches on the way do not agree on what there is.
        if matches!(&reload, Reload::Loading(next) if next.scene_changed) {
            reload = Reload::Failed(Instant::now() + PAUSE);
        }
        match (ready, reload) {
            (Some(mut view), Reload::Loading(next)) => {
                self.become_next(*next);
                self.note_traffic();
                view.stats = self.stats;
                Some(view)
            }
            (_, reload) => {
                self.reload = Some(reload);
                None
            }
        }
    }

    /// Goes on as another version. What was counted counts on.
    fn become_next(&mut self, mut next: Self) {
        next.opened = self.opened;
        if next.morph_seconds() != self.morph_seconds() {
            next.set_morph_seconds(self.morph_seconds());
        }
        next.traffic_before = self.traffic_before.plus(&self.fetcher.traffic());
        next.stats.reloads = self.stats.reloads + 1;
        next.stats.first_picture_seconds = self.stats.first_picture_seconds;
        next.stats.asked_error_seconds = self.stats.asked_error_seconds;
        let before = std::mem::replace(self, next);
        tracing::info!(version = self.scene.version, "another version of the scene took over");
        // Its threads end by and by: no frame waits for them.
        if let Err(error) = aside("diamantina-drop", async move { drop(before) }) {
            tracing::warn!(%error, "the version before ends within a frame");
        }
    }
}

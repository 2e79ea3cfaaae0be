//! What a terrain counts.

use super::{FrameView, Terrain};
use crate::cache::Asked;
use crate::fetch::Traffic;
use web_time::Instant;

/// What has happened since the scene was opened.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize)]
pub struct Stats {
    /// What has gone over the wire.
    pub traffic: Traffic,
    /// Points decoded whose height was sent.
    pub points_real: u64,
    /// Points decoded whose height was deduced.
    pub points_fictitious: u64,
    /// Older points made more precise.
    pub points_corrected: u64,
    /// Irregular triangles decoded.
    pub triangles: u64,
    /// Surfaces resident.
    pub resident: usize,
    /// Bytes of memory that they take.
    pub resident_bytes: usize,
    /// Bytes that they may take.
    pub budget_bytes: usize,
    /// How often diamonds that were wanted anew were resident.
    pub asked: Asked,
    /// Tiles of imagery in memory.
    pub texture_tiles: usize,
    /// Bytes that they take.
    pub texture_bytes: usize,
    /// Pages of the index resident.
    pub pages: usize,
    /// Payloads that are being decoded or wait for their parents.
    pub decoding: usize,
    /// Diamonds that the ideal cut splits.
    pub splits_ideal: usize,
    /// Diamonds that the drawn cut splits.
    pub splits_drawn: usize,
    /// Things that have failed too often and rest before they are tried again.
    pub failed: usize,
    /// Whether the server is not asked, since it cannot be reached or nobody wants it to be: what is drawn was fetched before.
    pub offline: bool,
    /// Whether the last frame's eye was in the zone that was asked for.
    pub zone_in_effect: bool,
    /// Steps of series that come next and are there already, as the view wants them.
    pub steps_ahead: usize,
    /// Seconds from opening to the first frame that drew something.
    pub first_picture_seconds: Option<f64>,
    /// Seconds from opening to the first frame whose error was within the tolerance.
    pub asked_error_seconds: Option<f64>,
    /// Seconds that the last frame took.
    pub frame_seconds: f64,
    /// Times that another version of the scene took over.
    pub reloads: u32,
}

impl Terrain {
    /// Counts what has gone over the wire.
    pub(super) fn note_traffic(&mut self) {
        self.stats.traffic = self.traffic_before.plus(&self.fetcher.traffic());
    }

    /// Counts a frame that has just been made.
    pub(super) fn note(&mut self, view: &FrameView, started: Instant) {
        let since = self.opened.elapsed().as_secs_f64();
        if !view.items.is_empty() {
            self.stats.first_picture_seconds.get_or_insert(since);
            if view.error_pixels <= self.options.tolerance_pixels {
                self.stats.asked_error_seconds.get_or_insert(since);
            }
        }
        self.error_pixels = view.error_pixels;
        self.note_traffic();
        self.stats.resident = self.cache.len();
        self.stats.resident_bytes = self.cache.bytes();
        self.stats.budget_bytes = self.cache.budget_bytes();
        self.stats.asked = self.cache.asked();
        self.stats.pages = self.layers.iter().map(|state| state.index.pages()).sum();
        self.stats.decoding = self.pending.len();
        self.stats.steps_ahead = self.steps_ahead();
        self.stats.failed = self.failed.len();
        self.stats.offline = self.fetcher.is_away();
        self.stats.frame_seconds = started.elapsed().as_secs_f64();
    }
}

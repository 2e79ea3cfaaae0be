//! A path through a scene: from a file, at random, or around.

use super::{HeadlessError, file_error};
use crate::camera::{Camera, FOV_Y};
use crate::overview::{extent, overview};
use diamantina_protocol::message::Scene;
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Most key frames of a path.
const KEYS_MAX: usize = 100_000;

/// The longest flight at random, in seconds: a day.
pub const RANDOM_SECONDS_MAX: f64 = 86_400.0;

/// Seconds between its keys.
const RANDOM_STEP: f64 = 5.0;

/// The largest file with a path, in bytes.
const PATH_BYTES_MAX: u64 = 64 << 20;

/// A path through a scene: eyes and targets at moments.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlightPath {
    /// Moments, in rising order.
    pub keys: Vec<PathKey>,
}

/// The camera at a moment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PathKey {
    /// Seconds from the start.
    pub seconds: f64,
    /// The eye, in the frame's metres.
    pub eye: [f64; 3],
    /// What the camera looks at.
    pub target: [f64; 3],
}

impl FlightPath {
    /// Reads a path from a JSON file.
    ///
    /// # Errors
    /// When the file cannot be read or holds no path.
    pub fn read(path: &Path) -> Result<Self, HeadlessError> {
        let wrong = |what: String| HeadlessError::Path { path: path.to_owned(), what };
        let bytes = std::fs::metadata(path).map_err(file_error("read", path))?.len();
        if bytes > PATH_BYTES_MAX {
            return Err(wrong(format!("{bytes} bytes, limit {PATH_BYTES_MAX}")));
        }
        let text = std::fs::read(path).map_err(file_error("read", path))?;
        let flight: Self = serde_json::from_slice(&text).map_err(|e| wrong(e.to_string()))?;
        if flight.keys.is_empty() || flight.keys.len() > KEYS_MAX {
            return Err(wrong(format!("{} keys, expected 1 to {KEYS_MAX}", flight.keys.len())));
        }
        if !flight.keys.is_sorted_by(|a, b| a.seconds < b.seconds) {
            return Err(wrong("its seconds do not rise".to_owned()));
        }
        if flight.keys.iter().any(|k| k.eye == k.target) {
            return Err(wrong("an eye is its own target".to_owned()));
        }
        Ok(flight)
    }

    /// A round over a scene: in from the overview, across it low, and out.
    #[must_use]
    pub fn round(scene: &Scene) -> Self {
        let [low, high] = extent(scene);
        let centre = (low + high) / 2.0;
        let span = high - low;
        let far = overview(scene, [16, 9]);
        let keys = (0..=12).map(|i| {
            let part = f64::from(i) / 12.0;
            let angle = part * std::f64::consts::TAU - std::f64::consts::FRAC_PI_2;
            // 0 at both ends, 1 in the middle: how far in.
            let near = (part * std::f64::consts::PI).sin();
            let around = DVec3::new(angle.cos() * span.x, angle.sin() * span.y, 0.0) * (0.9 - 0.65 * near);
            let height = high.z + (far.eye.z - high.z) * (1.0 - near) + span.truncate().length() * 0.03;
            let eye = if i % 12 == 0 { far.eye } else { (centre + around).with_z(height) };
            PathKey {
                seconds: f64::from(i) * 1.0,
                eye: eye.to_array(),
                target: centre.with_z(low.z).to_array(),
            }
        });
        Self { keys: keys.collect() }
    }

    /// A flight at random, the same for the same seed: from place to place, low over the ground and high above it, with a key
    /// every five seconds. At most [`RANDOM_SECONDS_MAX`].
    #[must_use]
    pub fn random(scene: &Scene, seed: u64, seconds: f64) -> Self {
        let [low, high] = extent(scene);
        let span = (high - low).truncate();
        let mut dice = Dice(seed);
        let seconds = seconds.clamp(1e-3, RANDOM_SECONDS_MAX);
        let count = (seconds / RANDOM_STEP).ceil().max(1.0);
        let mut place = low.truncate() + span * DVec2::new(dice.roll(), dice.roll());
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "at most some ten thousand"
        )]
        let keys = (0..=count as u32).map(|i| {
            // Mostly on to somewhere near, now and then far away.
            let reach = if dice.roll() < 0.15 { 0.6 } else { 0.08 };
            let step = span * reach * (DVec2::new(dice.roll(), dice.roll()) - 0.5);
            place = (place + step).clamp(low.truncate(), high.truncate());
            // From a two-hundredth to a third of the scene's size above its highest ground.
            let above = span.max_element() * 0.005 * 66f64.powf(dice.roll());
            let ahead =
                DVec2::from_angle(std::f64::consts::TAU * dice.roll()) * above * (1.0 + 3.0 * dice.roll());
            let (eye, target) =
                (place.extend(high.z + above), (place + ahead).extend(low.z.midpoint(high.z)));
            let at = f64::from(i) / count * seconds;
            PathKey { seconds: at, eye: eye.to_array(), target: target.to_array() }
        });
        Self { keys: keys.collect() }
    }

    /// Seconds from the first key to the last.
    #[must_use]
    pub fn seconds(&self) -> f64 {
        match (self.keys.first(), self.keys.last()) {
            (Some(first), Some(last)) => last.seconds - first.seconds,
            _ => 0.0,
        }
    }

    /// The camera at a part (0 to 1) of the path, on a smooth curve through its keys (Catmull and Rom
    /// 1974).
    #[must_use]
    pub fn camera(&self, part: f64, size: [u32; 2]) -> Camera {
        let keys = &self.keys;
        let at = |i: usize| keys[i.min(keys.len() - 1)];
        let seconds = at(0).seconds + self.seconds() * part.clamp(0.0, 1.0);
        let i = keys.partition_point(|k| k.seconds <= seconds).saturating_sub(1);
        let (p1, p2) = (at(i), at(i + 1));
        let (p0, p3) = (at(i.saturating_sub(1)), at(i + 2));
        let length = p2.seconds - p1.seconds;
        let t = if length > 0.0 { (seconds - p1.seconds) / length } else { 0.0 };
        let curve = |f: fn(&PathKey) -> [f64; 3]| {
            let [a, b, c, d] = [p0, p1, p2, p3].map(|k| DVec3::from_array(f(&k)));
            let (t2, t3) = (t * t, t * t * t);
            0.5 * (2.0 * b
                + (c - a) * t
                + (2.0 * a - 5.0 * b + 4.0 * c - d) * t2
                + (3.0 * b - a - 3.0 * c + d) * t3)
        };
        Camera { eye: curve(|k| k.eye), target: curve(|k| k.target), fov_y: FOV_Y, size }
    }
}

/// Numbers that look random, the same from the same beginning (splitmix64).
pub(crate) struct Dice(pub(crate) u64);

impl Dice {
    /// From 0 to below 1.
    pub(crate) fn roll(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut v = self.0;
        v = (v ^ v >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        v = (v ^ v >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((v ^ v >> 31) >> 11) as f64 / (1u64 << 53) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(seconds: f64, x: f64) -> PathKey {
        PathKey { seconds, eye: [x, 0.0, 100.0], target: [x, 500.0, 0.0] }
    }

    #[test]
    fn a_path_passes_through_its_keys() {
        let path = FlightPath { keys: vec![key(0.0, 0.0), key(1.0, 10.0), key(4.0, 5.0)] };
        for (part, x) in [(0.0, 0.0), (0.25, 10.0), (1.0, 5.0), (2.0, 5.0)] {
            assert!((path.camera(part, [4, 3]).eye.x - x).abs() < 1e-9, "{part}");
        }
        let lone = FlightPath { keys: vec![key(3.0, 7.0)] };
        assert_eq!(lone.camera(0.5, [4, 3]).eye.x, 7.0);
    }

    #[test]
    fn a_path_that_makes_no_sense_is_refused_with_its_name() {
        let folder = std::env::temp_dir().join(format!("diamantina-paths-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        for (text, word) in [
            ("", "EOF"),
            ("{\"keys\": []}", "0 keys"),
            (
                "{\"keys\": [{\"seconds\":1,\"eye\":[0,0,1],\"target\":[0,0,0]},{\"seconds\":1,\"eye\":[0,0,1],\"target\":[0,0,0]}]}",
                "rise",
            ),
            ("{\"keys\": [{\"seconds\":1,\"eye\":[0,0,0],\"target\":[0,0,0]}]}", "its own target"),
        ] {
            let path = folder.join("path.json");
            std::fs::write(&path, text).unwrap();
            let message = FlightPath::read(&path).unwrap_err().to_string();
            assert!(message.contains("path.json") && message.contains(word), "{message}");
        }
        std::fs::remove_dir_all(&folder).unwrap();
    }
}

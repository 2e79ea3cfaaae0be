//! Views as addresses and bookmarks have them.

use super::Viewer;
use crate::camera::{Camera, FOV_Y};
use glam::DVec3;
use std::ops::RangeInclusive;

/// What heights may be multiplied by.
pub(super) const EXAGGERATIONS: RangeInclusive<f64> = 0.1..=20.0;

/// What follows the `#` of an address.
#[derive(Debug, Clone, Copy)]
pub struct View {
    /// Where the eye is, heights as they are.
    pub camera: Camera,
    /// Which time it is, where water changes with time.
    pub seconds: Option<f64>,
    /// What heights are multiplied by, where it says so.
    pub exaggeration: Option<f64>,
}

impl View {
    /// Reads `x,y,z,heading,pitch`, metres and degrees, which may go on with `,seconds`, and then with
    /// `&exaggeration=FACTOR`. `None` if it is no view.
    #[must_use]
    pub fn parse(text: &str, size: [u32; 2]) -> Option<Self> {
        let (place, rest) = text.trim().split_once('&').map_or((text, None), |(at, rest)| (at, Some(rest)));
        let numbers: Vec<f64> =
            place.trim().split(',').map(|n| n.trim().parse().ok()).collect::<Option<_>>()?;
        let (&[x, y, z, heading, pitch] | &[x, y, z, heading, pitch, _]) = numbers.as_slice() else {
            return None;
        };
        let exaggeration = match rest {
            None => None,
            Some(rest) => {
                let factor = rest.strip_prefix("exaggeration=")?.parse().ok()?;
                Some(factor).filter(|factor| EXAGGERATIONS.contains(factor)).map(Some)?
            }
        };
        if !numbers.iter().all(|n| n.is_finite()) || !(-90.0..=90.0).contains(&pitch) {
            return None;
        }
        let (heading, pitch) = (heading.to_radians(), pitch.to_radians());
        let ahead = DVec3::new(heading.sin() * pitch.cos(), heading.cos() * pitch.cos(), -pitch.sin());
        let eye = DVec3::new(x, y, z);
        let camera = Camera { eye, target: eye + ahead * z.abs().max(1.0), fov_y: FOV_Y, size };
        let seconds = numbers.get(5).copied().filter(|seconds| *seconds >= 0.0);
        Some(Self { camera, seconds, exaggeration })
    }
}

impl Viewer {
    /// The scene's address with the view: `URL#x,y,z,heading,pitch`, and what else [`View::parse`] reads.
    #[must_use]
    pub fn address(&self) -> String {
        format!("{}#{}", self.url, self.view())
    }

    /// What follows the `#` of its address.
    #[must_use]
    pub fn view(&self) -> String {
        let (eye, exaggeration) = (self.camera().eye, self.look.exaggeration);
        // As they are where heights are not multiplied.
        let z = eye.z / exaggeration;
        let (down, ahead) = self.controls.pitch().sin_cos();
        let pitch = (down / exaggeration).atan2(ahead).to_degrees();
        let heading = self.controls.heading().to_degrees().rem_euclid(360.0);
        let mut view = format!("{:.2},{:.2},{z:.2},{heading:.3},{pitch:.3}", eye.x, eye.y);
        if !self.terrain.scene().series.is_empty() {
            view += &format!(",{:.3}", self.player.seconds);
        }
        if exaggeration != 1.0 {
            view += &format!("&exaggeration={}", (exaggeration * 1e3).round() / 1e3);
        }
        view
    }

    /// Goes to what follows the `#` of an address: flies there, sets what heights are multiplied by, 1 unless it tells of that,
    /// and the time, if it tells of it. Whether it is a view.
    pub fn go_to(&mut self, view: &str) -> bool {
        let Some(view) = View::parse(view, self.camera().size) else { return false };
        if !self.is_true() {
            self.set_exaggeration(view.exaggeration.unwrap_or(1.0));
        }
        self.fly_to(&view.camera);
        self.set_time(view.seconds);
        true
    }

    pub(super) fn set_time(&mut self, seconds: Option<f64>) {
        if let Some(seconds) = seconds {
            self.player.set(seconds, &self.terrain.scene().series);
        }
    }
}

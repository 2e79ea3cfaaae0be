//! What the view moves around: the ground under the cursor, or beside it the level of the lowest ground.
//!
//! So a zoom beside the ground comes to rest above that level, as one over the ground does, and what is dragged there
//! moves as the ground would. Towards the sky there is nothing to turn around; there a zoom goes as far as the ground is away.

use super::Viewer;
use crate::camera::Bounds;
use crate::controls;
use crate::overview;
use glam::{DVec2, DVec3};

/// How far away the level beside the ground may be met, in distances to the ground: it goes on for ever.
const LEVEL_MAX: f64 = 4.0;

impl Viewer {
    /// The box around the scene, stretched as it is drawn.
    pub(super) fn bounds(&self) -> Bounds {
        let [min, max] = overview::extent(self.terrain.scene());
        Bounds { min, max }.stretched(self.look.exaggeration)
    }

    /// What to turn around at a place of the picture, in pixels; none where that is the sky.
    pub(super) fn pivot(&mut self, at: DVec2) -> Option<DVec3> {
        if let Some(hit) = self.pick(at) {
            return Some(hit.point);
        }
        let camera = self.controls.camera();
        let ray = controls::ray(camera, at);
        let along = (self.bounds().min.z - camera.eye.z) / ray.z;
        let is_met = along.is_finite() && along > 0.0 && along <= LEVEL_MAX * self.away();
        is_met.then(|| camera.eye + ray * along)
    }

    /// The height of the ground below the eye, stretched as it is drawn; beside it, that of the lowest.
    pub(super) fn ground(&mut self) -> f64 {
        let (layers, exaggeration) = (&self.terrain.scene().layers, self.look.exaggeration);
        let eye = self.controls.camera().eye.truncate();
        let ground = self.picker.ground(layers, &self.frame.items, exaggeration, eye);
        ground.unwrap_or_else(|| self.bounds().min.z)
    }

    /// What to go towards at a place of the picture, in pixels.
    pub(super) fn reach(&mut self, at: DVec2) -> DVec3 {
        self.pivot(at).unwrap_or_else(|| {
            let camera = self.controls.camera();
            camera.eye + controls::ray(camera, at) * self.away()
        })
    }

    /// How far the ground is away: in the box around it, as far as the eye is above its lowest.
    fn away(&self) -> f64 {
        let (eye, bounds) = (self.camera().eye, self.bounds());
        bounds.distance(eye).max(eye.z - bounds.min.z).max(self.cell())
    }
}

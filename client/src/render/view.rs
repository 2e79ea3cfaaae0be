//! Where a pass draws from: the eye of the picture, or that eye mirrored in a level plane.
//!
//! What is mirrored in water is what an eye as far below the surface as the real one is above it would see, upside down.
//! With M the mirroring of heights at the plane, a point p is drawn where the camera sees M p: so the mirrored picture
//! fits the real one pixel by pixel, and a pixel of level water shows what the same pixel of the mirrored picture holds.

use crate::camera::{Camera, Plane};
use glam::{DVec3, Mat4, Vec3};

/// The eye of a pass.
#[derive(Debug, Clone, Copy)]
pub(super) struct View {
    camera: Camera,
    /// The height in metres, stretched, at which it is mirrored.
    mirror: Option<f64>,
}

impl View {
    /// As the camera sees.
    pub(super) fn straight(camera: &Camera) -> Self {
        Self { camera: *camera, mirror: None }
    }

    /// What a camera sees in a mirror at a height, in metres, stretched.
    pub(super) fn mirrored(camera: &Camera, height: f64) -> Self {
        Self { camera: *camera, mirror: Some(height) }
    }

    /// Where the eye is.
    pub(super) fn eye(&self) -> DVec3 {
        let eye = self.camera.eye;
        self.mirror.map_or(eye, |height| DVec3::new(eye.x, eye.y, 2.0 * height - eye.z))
    }

    /// Pixels of the middle of the picture for each radian.
    pub(super) fn pixels_per_radian(&self) -> f64 {
        self.camera.pixels_per_radian()
    }

    /// What the sides of a view are multiplied by.
    fn flip(&self) -> DVec3 {
        if self.mirror.is_some() { DVec3::new(1.0, 1.0, -1.0) } else { DVec3::ONE }
    }

    /// Right, up and forward: a ray is forward + x right + y up, with x and y from -1 to 1.
    pub(super) fn rays(&self) -> [DVec3; 3] {
        let [right, up, backward] = self.camera.axes().map(|axis| axis * self.flip());
        let tan = (self.camera.fov_y / 2.0).tan();
        let [width, height] = self.camera.size.map(|s| f64::from(s.max(1)));
        [right * tan * width / height, up * tan, -backward]
    }

    /// Clip coordinates of a position relative to the eye. See [`Camera::clip_from_eye`].
    pub(super) fn clip_from_eye(&self, near: f32) -> Mat4 {
        let straight = self.camera.clip_from_eye(near);
        if self.mirror.is_none() { straight } else { straight * Mat4::from_scale(Vec3::new(1.0, 1.0, -1.0)) }
    }

    /// What is drawn lies inside of all these; below a mirror nothing is.
    pub(super) fn planes(&self) -> Vec<Plane> {
        let mut planes = self.camera.planes().to_vec();
        if let Some(height) = self.mirror {
            for plane in &mut planes {
                plane.offset += 2.0 * height * plane.normal.z;
                plane.normal.z = -plane.normal.z;
            }
            planes.push(Plane { normal: DVec3::Z, offset: -height });
        }
        planes
    }

    /// Metres from the eye up to the height below which nothing is drawn; far down where there is no mirror.
    pub(super) fn lowest(&self) -> f64 {
        self.mirror.map_or(-1e30, |height| height - self.eye().z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Bounds, FOV_Y};

    #[test]
    fn a_mirrored_point_is_where_its_image_is_seen() {
        let camera = Camera {
            eye: DVec3::new(5e5, 4e6, 900.0),
            target: DVec3::new(5e5 + 800.0, 4e6 + 1e3, 600.0),
            fov_y: FOV_Y,
            size: [800, 600],
        };
        let mirror = 500.0;
        let (straight, mirrored) = (View::straight(&camera), View::mirrored(&camera, mirror));
        assert_eq!(mirrored.eye().z, 100.0);
        for offset in [DVec3::new(700.0, 900.0, -200.0), DVec3::new(2500.0, 1900.0, 300.0)] {
            let p = camera.eye + offset;
            let image = DVec3::new(p.x, p.y, 2.0 * mirror - p.z);
            let seen = mirrored.clip_from_eye(1.0).project_point3((p - mirrored.eye()).as_vec3());
            let direct = straight.clip_from_eye(1.0).project_point3((image - straight.eye()).as_vec3());
            assert!((seen - direct).abs().max_element() < 1e-5, "{seen} {direct}");
            let inside = |view: &View, p: DVec3| Bounds { min: p, max: p }.touches(&view.planes());
            assert_eq!(inside(&mirrored, p), inside(&straight, image) && p.z >= mirror);
            // A ray through a place of the picture points at what is drawn there.
            let [right, up, forward] = mirrored.rays();
            let ray = forward + right * f64::from(seen.x) + up * f64::from(seen.y);
            let towards = (p - mirrored.eye()).normalize();
            assert!((ray.normalize() - towards).length() < 1e-5);
        }
        assert!((mirrored.lowest() - 400.0).abs() < 1e-9);
    }
}

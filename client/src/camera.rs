//! Where the eye is, and how large a metre looks from there.
//!
//! Positions are `f64` in the frame's metres (x east, y north, z up); only what is relative to the eye is
//! ever handed to the GPU as `f32`, so a scene may lie millions of metres from its origin.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "what is relative to the eye needs no more than f32"
)]

use glam::{DMat3, DVec3, Mat4, Vec4};

/// A perspective camera whose up is the frame's up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// The eye, in the frame's metres.
    pub eye: DVec3,
    /// A point in the middle of the picture, in the frame's metres.
    pub target: DVec3,
    /// The vertical field of view, in radians, above 0 and below pi.
    pub fov_y: f64,
    /// Width and height of the picture, in pixels.
    pub size: [u32; 2],
}

/// The vertical field of view of a camera that nobody said more of: 45 degrees.
pub const FOV_Y: f64 = std::f64::consts::FRAC_PI_4;

/// The nearest to the eye, in metres, that anything is drawn whose cells have these sides: as far as the near
/// plane comes.
#[must_use]
pub fn nearest_drawn(cells: impl IntoIterator<Item = f64>) -> f64 {
    cells.into_iter().fold(0.05, f64::min)
}

/// A half space: points with `normal . p + offset >= 0`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    /// The unit normal, pointing inside.
    pub normal: DVec3,
    /// The distance of the plane from the frame's origin, along the normal, negated.
    pub offset: f64,
}

/// An axis-aligned box in the frame's metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// The least corner.
    pub min: DVec3,
    /// The greatest corner.
    pub max: DVec3,
}

impl Bounds {
    /// The distance from a point to the box, in metres; 0 inside.
    #[must_use]
    pub fn distance(&self, p: DVec3) -> f64 {
        (p.clamp(self.min, self.max) - p).length()
    }

    /// The box with its heights multiplied.
    #[must_use]
    pub fn stretched(&self, exaggeration: f64) -> Self {
        let by = DVec3::new(1.0, 1.0, exaggeration);
        Self { min: self.min * by, max: self.max * by }
    }

    /// Whether any of the box may lie inside all planes.
    #[must_use]
    pub fn touches(&self, planes: &[Plane]) -> bool {
        planes.iter().all(|plane| {
            let farthest = DVec3::select(plane.normal.cmpge(DVec3::ZERO), self.max, self.min);
            plane.normal.dot(farthest) + plane.offset >= 0.0
        })
    }
}

impl Camera {
    /// The camera's axes as the rows right, up, backward.
    #[must_use]
    pub fn axes(&self) -> [DVec3; 3] {
        let backward = (self.eye - self.target).try_normalize().unwrap_or(DVec3::Z);
        // Looking straight down or up, the picture's top is north.
        let up = if backward.z.abs() > 0.999_999 { DVec3::Y } else { DVec3::Z };
        let right = up.cross(backward).normalize();
        [right, backward.cross(right), backward]
    }

    /// Clip coordinates of a position relative to the eye: no translation, infinite far plane, and depth
    /// reversed (1 at `near` metres, 0 at infinity), which spreads `f32` depth evenly.
    #[must_use]
    pub fn clip_from_eye(&self, near: f32) -> Mat4 {
        let [right, up, backward] = self.axes();
        let rotation = DMat3::from_cols(right, up, backward).transpose();
        let [width, height] = self.size.map(|s| f64::from(s.max(1)));
        let f = 1.0 / (self.fov_y / 2.0).tan();
        let projection = Mat4::from_cols(
            Vec4::new((f * height / width) as f32, 0.0, 0.0, 0.0),
            Vec4::new(0.0, f as f32, 0.0, 0.0),
            Vec4::new(0.0, 0.0, 0.0, -1.0),
            Vec4::new(0.0, 0.0, near, 0.0),
        );
        projection * Mat4::from_mat3(rotation.as_mat3())
    }

    /// Pixels that a metre covers at a distance of one metre, in the middle of the picture.
    #[must_use]
    pub fn pixels_per_radian(&self) -> f64 {
        f64::from(self.size[1]) / (2.0 * (self.fov_y / 2.0).tan())
    }

    /// The four sides of the view and the plane of the eye, pointing inside.
    #[must_use]
    pub fn planes(&self) -> [Plane; 5] {
        let [right, up, backward] = self.axes();
        let forward = -backward;
        let tan_y = (self.fov_y / 2.0).tan();
        let tan_x = tan_y * f64::from(self.size[0].max(1)) / f64::from(self.size[1].max(1));
        let through_eye = |normal: DVec3| Plane { normal, offset: -normal.dot(self.eye) };
        let side = |axis: DVec3, tan: f64| through_eye((forward * tan + axis).normalize());
        [side(right, tan_x), side(-right, tan_x), side(up, tan_y), side(-up, tan_y), through_eye(forward)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera {
            eye: DVec3::new(5e5, 4e6, 3000.0),
            target: DVec3::new(5e5, 4e6 + 1e4, 500.0),
            fov_y: FOV_Y,
            size: [1380, 768],
        }
    }

    #[test]
    fn the_target_is_in_the_middle_and_right_is_east() {
        let camera = camera();
        let clip = camera.clip_from_eye(1.0);
        let middle = clip.project_point3((camera.target - camera.eye).as_vec3());
        assert!(middle.x.abs() < 1e-5 && middle.y.abs() < 1e-5 && middle.z > 0.0 && middle.z < 1.0);
        let east = clip.project_point3((camera.target + DVec3::X * 1000.0 - camera.eye).as_vec3());
        assert!(east.x > 0.01 && east.y.abs() < 1e-4, "looking north, east is on the right");
        let above = clip.project_point3((camera.target + DVec3::Z * 1000.0 - camera.eye).as_vec3());
        assert!(above.y > 0.01);
    }

    #[test]
    fn looking_straight_down_north_is_up() {
        let camera = Camera { target: camera().eye - DVec3::Z, ..camera() };
        let north = camera.clip_from_eye(1.0).project_point3((DVec3::Y - DVec3::Z * 10.0).as_vec3());
        assert!(north.y > 0.0 && north.x.abs() < 1e-6);
    }

    #[test]
    fn planes_agree_with_the_projection() {
        let camera = camera();
        let [right, up, backward] = camera.axes();
        for (x, y, inside) in [(0.0, 0.0, true), (0.9, 0.9, true), (1.1, 0.0, false), (0.0, -1.1, false)] {
            let tan = (camera.fov_y / 2.0).tan();
            let p = camera.eye + (right * x * tan * 1380.0 / 768.0 + up * y * tan - backward) * 5000.0;
            let point = Bounds { min: p, max: p };
            assert_eq!(point.touches(&camera.planes()), inside, "{x} {y}");
        }
        let behind = camera.eye + backward * 10.0;
        assert!(!Bounds { min: behind, max: behind }.touches(&camera.planes()));
    }

    #[test]
    fn a_metre_shrinks_with_distance() {
        let camera = camera();
        let near = camera.pixels_per_radian() / 1000.0;
        assert!((near - 0.927).abs() < 1e-3, "{near}");
    }
}

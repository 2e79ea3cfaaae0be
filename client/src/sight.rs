//! How large an error looks on the screen: metres and a box become pixels.
//!
//! The plain measure takes an error for a sphere: as large as it looks from the nearest point of the box,
//! whatever the direction. An error of heights is bounded more tightly, as [`diamantina_protocol::sight`] tells. Pure
//! functions.

use crate::camera::{Bounds, Camera};
use diamantina_protocol::sight::vertical_angle;

/// How errors count.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sight {
    /// Whether a vertical error is measured as such, and not as a sphere of its size.
    pub vertical: bool,
    /// How many times as large an error may look at the corners of the picture as in the middle; 1 or more.
    pub foveation: f64,
}

impl Default for Sight {
    /// Vertical errors as such, the same all over the picture.
    fn default() -> Self {
        Self { vertical: true, foveation: 1.0 }
    }
}

/// An error that some of a box is drawn with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Error {
    /// Metres, of the heights as they are drawn.
    pub metres: f64,
    /// Whether heights alone err, and not outlines.
    pub vertical: bool,
    /// What counts of it, 0 to 1: less than all where little is seen.
    pub share: f64,
}

impl Sight {
    /// The largest apparent size of an error anywhere in a box, in pixels of the middle of the picture. Nothing
    /// nearer to the eye than `nearest` metres is drawn; so it is finite, unless the error is not.
    #[must_use]
    pub fn pixels(&self, camera: &Camera, error: Error, bounds: &Bounds, nearest: f64) -> f64 {
        if error.metres <= 0.0 {
            return 0.0;
        }
        let mut angle = error.metres / bounds.distance(camera.eye).max(nearest);
        if self.vertical && error.vertical {
            angle = angle.min(vertical_angle(
                camera.eye.to_array(),
                error.metres,
                bounds.min.to_array(),
                bounds.max.to_array(),
            ));
        }
        // What is hidden must not rise above what hides it: that bounds it in all of the picture alike.
        let counts = if error.share < 1.0 { error.share } else { self.weight(camera, bounds) };
        angle * camera.pixels_per_radian() * counts
    }

    /// What errors of a box count for: 1 in the middle of the picture, less towards its corners and beyond.
    fn weight(&self, camera: &Camera, bounds: &Bounds) -> f64 {
        if self.foveation <= 1.0 {
            return 1.0;
        }
        let [_, _, backward] = camera.axes();
        let (middle, radius) = (bounds.min.midpoint(bounds.max), (bounds.max - bounds.min).length() / 2.0);
        let towards = middle - camera.eye;
        let distance = towards.length();
        if distance <= radius {
            return 1.0;
        }
        // From the view's middle to the nearest point of the sphere around the box.
        let aside = (-backward).angle_between(towards) - (radius / distance).asin();
        let tan = (camera.fov_y / 2.0).tan();
        let across = f64::from(camera.size[0].max(1)) / f64::from(camera.size[1].max(1));
        let corner = (tan * across.hypot(1.0)).atan();
        let part = (aside / corner).clamp(0.0, 1.0);
        1.0 / (1.0 + (self.foveation - 1.0) * part * part)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::FOV_Y;
    use glam::DVec3;
    use proptest::prelude::*;

    fn camera(eye: DVec3, target: DVec3) -> Camera {
        Camera { eye, target, fov_y: FOV_Y, size: [1380, 768] }
    }

    fn in_box(bounds: &Bounds, [x, y, z]: [f64; 3]) -> DVec3 {
        bounds.min + (bounds.max - bounds.min) * DVec3::new(x, y, z)
    }

    fn unit3() -> impl Strategy<Value = [f64; 3]> {
        prop::array::uniform3(0.0..=1.0)
    }

    fn any_bounds() -> impl Strategy<Value = Bounds> {
        (prop::array::uniform3(-1e3..1e3f64), prop::array::uniform3(0.0..800.0f64)).prop_map(|(min, size)| {
            let min = DVec3::from_array(min);
            Bounds { min, max: min + DVec3::from_array(size) }
        })
    }

    proptest! {
        /// What lies in a box looks no larger than the box's own errors: a cut's parents come first.
        #[test]
        fn a_part_of_a_box_with_less_error_looks_no_larger(
            outer in any_bounds(),
            eye in prop::array::uniform3(-3e3..3e3f64),
            target in prop::array::uniform3(-1e3..1e3f64),
            corners in (unit3(), unit3()),
            error in 0.1..200.0f64,
            less in 0.0..=1.0f64,
            foveation in 1.0..8.0f64,
        ) {
            let (a, b) = (in_box(&outer, corners.0), in_box(&outer, corners.1));
            let inner = Bounds { min: a.min(b), max: a.max(b) };
            let camera = camera(DVec3::from_array(eye), DVec3::from_array(target));
            let of = |metres| Error { metres, vertical: true, share: 1.0 };
            // Foveation takes spheres around boxes for boxes, and a box's may stick out of its parent's.
            for sight in [Sight::default(), Sight { vertical: false, foveation: 1.0 }] {
                let (part, whole) = (
                    sight.pixels(&camera, of(error * less), &inner, 0.05),
                    sight.pixels(&camera, of(error), &outer, 0.05),
                );
                prop_assert!(part <= whole * (1.0 + 1e-12), "{} > {}", part, whole);
            }
            let plain = Sight { vertical: false, foveation: 1.0 };
            let sphere = plain.pixels(&camera, of(error), &outer, 0.05);
            prop_assert!(Sight::default().pixels(&camera, of(error), &outer, 0.05) <= sphere);
            let aside = Sight { vertical: false, foveation }.pixels(&camera, of(error), &outer, 0.05);
            prop_assert!(aside <= sphere && aside * foveation >= sphere * (1.0 - 1e-12));
        }
    }

    #[test]
    fn seen_from_far_above_heights_hardly_move() {
        let bounds = Bounds { min: DVec3::new(-10.0, -10.0, 0.0), max: DVec3::new(10.0, 10.0, 5.0) };
        let camera = camera(DVec3::new(0.0, 0.0, 1005.0), DVec3::ZERO);
        let error = Error { metres: 1.0, vertical: true, share: 1.0 };
        let sphere = Sight { vertical: false, foveation: 1.0 }.pixels(&camera, error, &bounds, 0.05);
        let vertical = Sight::default().pixels(&camera, error, &bounds, 0.05);
        assert!(vertical < sphere / 50.0, "{vertical} and {sphere} pixels");
        let outline = Error { vertical: false, ..error };
        assert_eq!(Sight::default().pixels(&camera, outline, &bounds, 0.05), sphere, "outlines move aside");
    }

    #[test]
    fn seen_from_the_side_heights_move_as_spheres_do() {
        let bounds = Bounds { min: DVec3::new(-10.0, 1000.0, 0.0), max: DVec3::new(10.0, 1020.0, 50.0) };
        let camera = camera(DVec3::new(0.0, 0.0, 20.0), DVec3::new(0.0, 1000.0, 20.0));
        let error = Error { metres: 1.0, vertical: true, share: 1.0 };
        let sphere = Sight { vertical: false, foveation: 1.0 }.pixels(&camera, error, &bounds, 0.05);
        assert_eq!(Sight::default().pixels(&camera, error, &bounds, 0.05), sphere);
    }

    #[test]
    fn the_middle_of_the_picture_counts_whole_and_its_corners_least() {
        let camera = camera(DVec3::ZERO, DVec3::Y);
        let sight = Sight { foveation: 4.0, ..Sight::default() };
        let weight = |x: f64| {
            let p = DVec3::new(x, 1.0, 0.0) * 1000.0;
            sight.weight(&camera, &Bounds { min: p, max: p })
        };
        assert_eq!(weight(0.0), 1.0);
        assert!(weight(0.3) < 1.0 && weight(0.6) < weight(0.3) && weight(5.0) == 0.25);
        let around = Bounds { min: DVec3::splat(-1.0), max: DVec3::splat(1.0) };
        assert_eq!(sight.weight(&camera, &around), 1.0, "the eye is in it");
    }
}

//! What level water mirrors: the plane it mirrors in, and the eye that sees what is mirrored.

use crate::camera::{Bounds, Camera};
use diamantina_protocol::diamond::Diamond;
use glam::DVec3;

impl Camera {
    /// The camera that sees what this one sees in a mirror at a height, upside down. What lies within one's sides lies, mirrored,
    /// within the other's.
    #[must_use]
    pub fn mirrored(&self, height: f64) -> Self {
        let mirrored = |p: DVec3| p.with_z(2.0 * height - p.z);
        Self { eye: mirrored(self.eye), target: mirrored(self.target), ..*self }
    }
}

/// The mean height of parts of a surface, in the units of their boxes: each counts as large as it looks. Nothing of no parts.
#[must_use]
pub fn mean_height(parts: impl IntoIterator<Item = (Diamond, Bounds)>, eye: DVec3) -> Option<f64> {
    let mut parts: Vec<_> = parts
        .into_iter()
        .map(|(diamond, bounds)| {
            let size = bounds.max - bounds.min;
            let distance = bounds.distance(eye).max(size.truncate().length()).max(1e-9);
            let weight = (size.x * size.y).max(1e-9) / (distance * distance);
            (diamond, weight, bounds.min.z.midpoint(bounds.max.z))
        })
        .collect();
    // Sums depend on the order, if only in their last bits: the same view is the same picture.
    parts.sort_unstable_by_key(|(diamond, ..)| *diamond);
    let (sum, weights) =
        parts.iter().fold((0.0, 0.0), |(sum, weights), (_, w, height)| (sum + w * height, weights + w));
    (weights > 0.0).then(|| sum / weights)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamantina_protocol::bintree::Forest;
    use proptest::prelude::*;

    fn coordinate() -> impl Strategy<Value = f64> {
        -5000.0..5000.0f64
    }

    proptest! {
        #[test]
        fn the_mirrored_camera_sees_the_images_of_what_the_camera_sees(
            eye in [coordinate(), coordinate(), coordinate()],
            target in [coordinate(), coordinate(), coordinate()],
            p in [coordinate(), coordinate(), coordinate()],
            height in -500.0..500.0f64,
        ) {
            let [eye, target, p] = [eye, target, p].map(DVec3::from);
            prop_assume!((eye - target).truncate().length() > 1.0);
            let camera = Camera { eye, target, fov_y: 0.8, size: [600, 400] };
            let image = p.with_z(2.0 * height - p.z);
            let [straight, mirrored] = [(camera, p), (camera.mirrored(height), image)].map(|(camera, p)| {
                camera.planes().map(|plane| plane.normal.dot(p) + plane.offset)
            });
            // Upper and lower sides change places.
            let sorted = |mut distances: [f64; 5]| { distances.sort_by(f64::total_cmp); distances };
            for (a, b) in sorted(straight).into_iter().zip(sorted(mirrored)) {
                prop_assert!((a - b).abs() < 1e-6, "{straight:?} {mirrored:?}");
            }
        }
    }

    #[test]
    fn what_is_near_counts_most() {
        let at = |x: f64, z: f64| Bounds { min: DVec3::new(x, 0.0, z), max: DVec3::new(x + 10.0, 10.0, z) };
        let roots: Vec<Diamond> = Forest::new(6, 5, [1, 2]).unwrap().root_diamonds().collect();
        let parts = [(roots[0], at(10_000.0, 100.0)), (roots[1], at(0.0, 10.0))];
        let height = mean_height(parts, DVec3::new(0.0, 0.0, 15.0)).unwrap();
        assert!(height > 10.0 && height < 10.1, "{height}");
        assert_eq!(mean_height([], DVec3::ZERO), None);
    }
}

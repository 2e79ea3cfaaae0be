//! Where a whole scene is seen from.

use crate::camera::{Camera, FOV_Y};
use diamantina_protocol::message::Scene;
use glam::DVec3;

/// The box around a scene, in frame coordinates and metres: south-west-lowest and north-east-highest.
#[must_use]
pub fn extent(scene: &Scene) -> [DVec3; 2] {
    let boxes = scene.layers.iter().map(|l| {
        let [x0, y0] = l.origin;
        let [x1, y1] = l.position(l.samples.map(|s| s - 1));
        [DVec3::new(x0, y0, l.heights[0]), DVec3::new(x1, y1, l.heights[1])]
    });
    boxes.reduce(|[a, b], [c, d]| [a.min(c), b.max(d)]).unwrap_or([DVec3::ZERO, DVec3::ONE])
}

/// Degrees below the horizon that an overview may look down: as flat as mountains look best, and as steep
/// as maps.
const TILTS: [u32; 2] = [30, 54];

/// The part of the picture's width or height that an overview fills.
const FILLED: f64 = 0.95;

/// A camera that sees a whole scene, from the south and above, as near as the box around it allows.
#[must_use]
pub fn overview(scene: &Scene, size: [u32; 2]) -> Camera {
    around_box(extent(scene), &Room::whole(size), 1.0)
}

fn around_box(bounds: [DVec3; 2], room: &Room, exaggeration: f64) -> Camera {
    around(&corners(bounds), room, exaggeration)
}

/// The corners of a box.
fn corners([low, high]: [DVec3; 2]) -> [DVec3; 8] {
    std::array::from_fn(|i| DVec3::select(glam::BVec3::new(i & 1 > 0, i & 2 > 0, i & 4 > 0), high, low))
}

/// As [`overview`], of a scene whose heights are multiplied by `exaggeration` (but the camera's are not).
#[must_use]
pub fn stretched_overview(scene: &Scene, size: [u32; 2], exaggeration: f64) -> Camera {
    around_box(extent(scene), &Room::whole(size), exaggeration)
}

/// As [`stretched_overview`], in a picture of which so many pixels at its right are covered.
pub(crate) fn overview_beside(scene: &Scene, size: [u32; 2], covered: u32, exaggeration: f64) -> Camera {
    around_box(extent(scene), &Room { size, covered }, exaggeration)
}

/// A picture, and what of it there is to fill.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Room {
    /// Width and height in pixels.
    size: [u32; 2],
    /// Pixels at the right that are covered: fewer than its width.
    covered: u32,
}

impl Room {
    /// A picture of which nothing is covered.
    pub(crate) fn whole(size: [u32; 2]) -> Self {
        Self { size, covered: 0 }
    }
}

/// The camera from the south and above that holds all points as large as can be. Of the tilts, it takes the
/// one at which they fill the picture best.
pub(crate) fn around(points: &[DVec3], room: &Room, exaggeration: f64) -> Camera {
    let points: Vec<DVec3> = points.iter().map(|p| p.with_z(p.z * exaggeration)).collect();
    let low = points.iter().copied().fold(DVec3::INFINITY, DVec3::min);
    let high = points.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
    let filled = |camera: &Camera| {
        // The ground's trapezium, in parts of the picture.
        let [right, up, backward] = camera.axes();
        let corners = [[low.x, low.y], [high.x, low.y], [high.x, high.y], [low.x, high.y]].map(|[x, y]| {
            let p = DVec3::new(x, y, f64::midpoint(low.z, high.z)) - camera.eye;
            glam::DVec2::new(p.dot(right), p.dot(up)) / p.dot(-backward)
        });
        (corners[2] - corners[0]).perp_dot(corners[3] - corners[1])
    };
    let cameras = (TILTS[0]..=TILTS[1]).step_by(3).map(|tilt| fit(&points, tilt, room));
    let best = cameras.max_by(|a, b| filled(a).total_cmp(&filled(b)));
    let best = best.unwrap_or_else(|| fit(&points, TILTS[0], room));
    let flat = |p: DVec3| p.with_z(p.z / exaggeration);
    Camera { eye: flat(best.eye), target: flat(best.target), ..best }
}

/// The camera that looks down by `tilt` degrees and holds all points as large as can be.
fn fit(points: &[DVec3], tilt: u32, room: &Room) -> Camera {
    let Room { size, covered } = *room;
    let tilt = f64::from(tilt).to_radians();
    let backward = DVec3::new(0.0, -tilt.cos(), tilt.sin());
    let axes = Camera { eye: backward, target: DVec3::ZERO, fov_y: FOV_Y, size }.axes();
    let tan_y = (FOV_Y / 2.0).tan();
    let tan_x = tan_y * f64::from(size[0].max(1)) / f64::from(size[1].max(1));
    // Half of what is free, and how far its middle is to the right of the picture's.
    let free = 1.0 - f64::from(covered) / f64::from(size[0].max(1));
    let middle = tan_x * (free - 1.0);
    // Relative to one of the points, for precision.
    let base = points.first().copied().unwrap_or_default();
    // Of an eye at (x, y, back) along the axes, the point at (px, py, pback) is seen if
    // |px - x - middle (back - pback)| <= tan_x (back - pback), and so for y: four linear bounds.
    let side = |axis: DVec3, tan: f64| {
        let bound = |p: &DVec3| (*p - base).dot(axis) + tan * (*p - base).dot(axes[2]);
        points.iter().map(bound).fold(f64::NEG_INFINITY, f64::max)
    };
    let (tan_x, tan_y) = (tan_x * free * FILLED, tan_y * FILLED);
    let (east, west) = (side(axes[0], tan_x + middle), side(-axes[0], tan_x - middle));
    let [top, bottom] = [axes[1], -axes[1]].map(|axis| side(axis, tan_y));
    let back = ((east + west) / (2.0 * tan_x)).max((top + bottom) / (2.0 * tan_y));
    let [x, y] = [(east - west) / 2.0 - middle * back, (top - bottom) / 2.0];
    let eye = base + axes[0] * x + axes[1] * y + axes[2] * back;
    // Half way into the scene.
    let depth = |p: &DVec3| (eye - *p).dot(axes[2]);
    let nearest = points.iter().map(depth).fold(f64::INFINITY, f64::min);
    let farthest = points.iter().map(depth).fold(0.0, f64::max);
    // A single point has no size to look at.
    let ahead = f64::midpoint(nearest, farthest).max(1e-3);
    Camera {
        eye: eye + backward * if back > 0.0 { 0.0 } else { 1.0 },
        target: eye - backward * ahead,
        fov_y: FOV_Y,
        size,
    }
}

/// The camera of a picture whose heights are multiplied: its own heights are, too.
pub(crate) fn stretched(camera: &Camera, exaggeration: f64) -> Camera {
    let stretch = |p: DVec3| p.with_z(p.z * exaggeration);
    Camera { eye: stretch(camera.eye), target: stretch(camera.target), ..*camera }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Clip coordinates of a point, with 1 at the picture's sides.
    fn seen(camera: &Camera, p: DVec3) -> [f64; 3] {
        let [right, up, backward] = camera.axes();
        let (tan, from) = ((camera.fov_y / 2.0).tan(), p - camera.eye);
        let depth = -from.dot(backward);
        let aspect = f64::from(camera.size[0]) / f64::from(camera.size[1]);
        [from.dot(right) / depth / tan / aspect, from.dot(up) / depth / tan, depth]
    }

    #[test]
    fn an_overview_holds_the_box_tightly() {
        let boxes = [
            [DVec3::new(5e5, 4e6, 0.0), DVec3::new(5.6e5, 4.06e6, 3500.0)],
            [DVec3::new(0.0, 0.0, -0.135), DVec3::new(5.5, 3.4, 0.125)],
            [DVec3::new(-1e6, 2e6, -4800.0), DVec3::new(-3e4, 2.97e6, 5900.0)],
            [DVec3::new(4e5, 4e6, 100.0), DVec3::new(4.1e5, 4.09e6, 900.0)],
            [DVec3::new(4e5, 4e6, 100.0), DVec3::new(4.9e5, 4.01e6, 900.0)],
        ];
        for size in [[1380, 768], [400, 900]] {
            for (bounds, part) in boxes.into_iter().flat_map(|bounds| [0, 1, 2, 3].map(|part| (bounds, part)))
            {
                let room = Room { size, covered: size[0] * part / 5 };
                let camera = around_box(bounds, &room, 1.0);
                // In what is free, with 1 at its sides.
                let free = 1.0 - f64::from(part) / 5.0;
                let seen = corners(bounds).map(|p| seen(&camera, p));
                let seen = seen.map(|[x, y, depth]| [(x + 1.0 - free) / free, y, depth]);
                assert!(seen.iter().all(|s| s[2] > 0.0), "{camera:?}");
                let most = |i: usize| seen.iter().map(|s| s[i].abs()).fold(0.0, f64::max);
                let widest = most(0).max(most(1));
                assert!((widest - FILLED).abs() < 1e-6, "{widest} {camera:?}");
                assert!(camera.eye.y < bounds[0].y && camera.eye.z > bounds[1].z, "from the south and above");
            }
        }
    }

    #[test]
    fn a_lone_point_has_an_overview() {
        let camera = around(&[DVec3::new(5e5, 4e6, 100.0)], &Room::whole([4, 3]), 1.0);
        assert!(camera.eye.is_finite() && camera.eye != camera.target, "{camera:?}");
    }
}

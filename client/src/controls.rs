//! Moving the eye as people know it from maps and globes.
//!
//! What is grabbed stays under the cursor: a pan slides the grabbed point along its horizontal plane, a turn goes
//! around it, and a zoom goes towards it. So nothing jumps, however far away the ground is. All positions are of
//! stretched heights, as the camera's are; the eye never comes nearer to the ground than a clearance.

use crate::camera::Camera;
use glam::{DQuat, DVec2, DVec3};

/// The steepest and the flattest view: sines of the angle below the horizon. Not straight down, where north is not told.
const STEEPNESS: [f64; 2] = [-0.6, 0.999_9];

/// How far a pan may carry the eye, in distances to what is grabbed: near the horizon a pixel is a country.
const PAN_MAX: f64 = 2.0;

/// Heights above the ground that the eye flies in a second.
const SPEED: f64 = 1.2;

/// How much faster it flies if told so.
const FASTER: f64 = 5.0;

/// Seconds that a flight to a place takes.
const GLIDE_SECONDS: f64 = 1.2;

/// What keys ask for: parts of full speed along the axes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Thrust {
    /// To the right.
    pub right: f64,
    /// Ahead, on the level.
    pub ahead: f64,
    /// Up.
    pub up: f64,
    /// Whether to hurry.
    pub fast: bool,
}

/// A camera on its way to another.
#[derive(Debug, Clone, Copy)]
struct Glide {
    from: Camera,
    to: Camera,
    seconds: f64,
}

/// A camera that is moved.
#[derive(Debug, Clone)]
pub struct Controls {
    camera: Camera,
    glide: Option<Glide>,
}

impl Controls {
    /// Begins with a camera.
    #[must_use]
    pub fn new(camera: Camera) -> Self {
        Self { camera, glide: None }
    }

    /// The camera now.
    #[must_use]
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// Sets the picture's size in pixels.
    pub fn resize(&mut self, size: [u32; 2]) {
        self.camera.size = size.map(|s| s.max(1));
    }

    /// Lifts the camera, as the terrain below it is.
    pub fn lift(&mut self, by: f64) {
        self.glide = None;
        self.shift(DVec3::Z * by);
    }

    /// Whether the camera is on its way.
    #[must_use]
    pub fn is_gliding(&self) -> bool {
        self.glide.is_some()
    }

    /// The unit vector from the eye through a place of the picture, in pixels from its upper left corner.
    #[must_use]
    pub fn ray(&self, at: DVec2) -> DVec3 {
        ray(&self.camera, at)
    }

    /// Slides the grabbed point to the cursor, along its horizontal plane.
    pub fn pan(&mut self, grabbed: DVec3, cursor: DVec2) {
        self.glide = None;
        let (eye, ray) = (self.camera.eye, self.ray(cursor));
        let farthest = PAN_MAX * (grabbed - eye).length();
        let down = (grabbed.z - eye.z) / ray.z;
        // Towards the horizon the plane is not met, or too far away: then as far as may be.
        let reached =
            if down.is_finite() && down > 0.0 { ray * down } else { ray.with_z(0.0) * f64::INFINITY };
        let flat = if reached.is_finite() {
            reached.truncate().clamp_length_max(farthest)
        } else {
            ray.truncate().normalize_or_zero() * farthest
        };
        let by = (grabbed - eye).truncate() - flat;
        self.shift(by.clamp_length_max(farthest).extend(0.0));
    }

    /// Turns the view around a point: radians to the right, and up.
    pub fn turn(&mut self, pivot: DVec3, right: f64, up: f64) {
        self.glide = None;
        let [axis, ..] = self.camera.axes();
        let ahead = (self.camera.target - self.camera.eye).normalize_or(-DVec3::Z);
        // What may be left of the turn up: views do not roll over, nor look under the ground.
        let steep = (-ahead.z).clamp(-1.0, 1.0).asin();
        let [low, high] = STEEPNESS.map(f64::asin);
        let up = up.clamp((steep - high).min(0.0), (steep - low).max(0.0));
        let turn = DQuat::from_rotation_z(-right) * DQuat::from_axis_angle(axis, up);
        let around = |p: DVec3| pivot + turn * (p - pivot);
        (self.camera.eye, self.camera.target) = (around(self.camera.eye), around(self.camera.target));
    }

    /// Goes to `factor` times the distance from a point, with the same heading; no nearer than `nearest` metres.
    pub fn zoom(&mut self, point: DVec3, factor: f64, nearest: f64) {
        self.glide = None;
        let away = point - self.camera.eye;
        let length = away.length();
        if length > 0.0 && factor.is_finite() && factor > 0.0 {
            let factor = factor.max((nearest / length).min(1.0));
            self.shift(away * (1.0 - factor));
        }
    }

    /// Flies for some seconds, faster the higher above the ground (metres).
    pub fn fly(&mut self, thrust: &Thrust, height: f64, seconds: f64) {
        let Thrust { right, ahead, up, fast } = *thrust;
        if [right, ahead, up] == [0.0; 3] {
            return;
        }
        self.glide = None;
        let [axis, ..] = self.camera.axes();
        let level = DVec3::Z.cross(axis);
        let speed = SPEED * height * if fast { FASTER } else { 1.0 };
        self.shift((axis * right + level * ahead + DVec3::Z * up) * (speed * seconds));
    }

    /// Lifts the camera to a height above the ground below it, if it is lower.
    pub fn stay_above(&mut self, ground: f64, clearance: f64) {
        let missing = ground + clearance - self.camera.eye.z;
        if missing > 0.0 {
            self.shift(DVec3::Z * missing);
        }
    }

    /// Flies to where another camera is.
    pub fn glide_to(&mut self, to: Camera) {
        self.glide = Some(Glide { from: self.camera, to, seconds: 0.0 });
    }

    /// Flies towards a point, to a third of its distance, until it is in the middle of the picture.
    pub fn glide_near(&mut self, point: DVec3, nearest: f64) {
        let camera = self.camera;
        let ahead = (camera.target - camera.eye).normalize_or(-DVec3::Z);
        let distance = ((point - camera.eye).length() / 3.0).max(nearest);
        self.glide_to(Camera { eye: point - ahead * distance, target: point, ..camera });
    }

    /// Turns until north is up, around a point.
    pub fn glide_north(&mut self, pivot: DVec3) {
        let mut turned = self.clone();
        turned.turn(pivot, -self.heading(), 0.0);
        self.glide_to(turned.camera);
    }

    /// Goes on with a flight.
    pub fn step(&mut self, seconds: f64) {
        let size = self.camera.size;
        let Some(glide) = &mut self.glide else { return };
        glide.seconds += seconds;
        let part = (glide.seconds / GLIDE_SECONDS).min(1.0);
        self.camera = Camera { size, ..between(&glide.from, &glide.to, part * part * (3.0 - 2.0 * part)) };
        if part >= 1.0 {
            self.glide = None;
        }
    }

    /// Radians from north to where the view looks, clockwise.
    #[must_use]
    pub fn heading(&self) -> f64 {
        let [right, ..] = self.camera.axes();
        let ahead = DVec3::Z.cross(right);
        ahead.x.atan2(ahead.y)
    }

    /// Radians that the view looks below the horizon.
    #[must_use]
    pub fn pitch(&self) -> f64 {
        let ahead = (self.camera.target - self.camera.eye).normalize_or(-DVec3::Z);
        (-ahead.z).clamp(-1.0, 1.0).asin()
    }

    fn shift(&mut self, by: DVec3) {
        if by.is_finite() {
            self.camera.eye += by;
            self.camera.target += by;
        }
    }
}

/// The unit vector from a camera's eye through a place of its picture.
#[must_use]
pub fn ray(camera: &Camera, at: DVec2) -> DVec3 {
    let [right, up, backward] = camera.axes();
    let size = DVec2::from(camera.size.map(|s| f64::from(s.max(1))));
    let tan = (camera.fov_y / 2.0).tan();
    let clip = (at / size * 2.0 - 1.0) * DVec2::new(tan * size.x / size.y, -tan);
    (right * clip.x + up * clip.y - backward).normalize()
}

/// A camera between two: what is looked at moves evenly, directions turn, and distances grow by factors.
fn between(from: &Camera, to: &Camera, part: f64) -> Camera {
    let offset = |camera: &Camera| camera.eye - camera.target;
    let [a, b] = [offset(from), offset(to)];
    let turn = DQuat::from_rotation_arc(a.normalize_or(DVec3::Z), b.normalize_or(DVec3::Z));
    let direction = DQuat::IDENTITY.slerp(turn, part) * a.normalize_or(DVec3::Z);
    let distance = a.length().max(1e-9).powf(1.0 - part) * b.length().max(1e-9).powf(part);
    let target = from.target.lerp(to.target, part);
    if part >= 1.0 {
        return *to;
    }
    Camera { eye: target + direction * distance, target, ..*to }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::FOV_Y;

    fn camera() -> Camera {
        Camera {
            eye: DVec3::new(5e5, 4e6 - 6000.0, 5000.0),
            target: DVec3::new(5e5, 4e6, 500.0),
            fov_y: FOV_Y,
            size: [1280, 720],
        }
    }

    /// Where a point is in the picture, in pixels.
    fn seen(camera: &Camera, point: DVec3) -> DVec2 {
        let clip = camera.clip_from_eye(1.0).project_point3((point - camera.eye).as_vec3());
        DVec2::new(f64::from(clip.x) * 0.5 + 0.5, 0.5 - f64::from(clip.y) * 0.5)
            * DVec2::from(camera.size.map(f64::from))
    }

    #[test]
    fn a_ray_through_a_pixel_is_seen_at_that_pixel() {
        let controls = Controls::new(camera());
        for at in [DVec2::new(640.0, 360.0), DVec2::new(3.0, 700.0), DVec2::new(1200.0, 20.0)] {
            let found = seen(&camera(), camera().eye + controls.ray(at) * 4000.0);
            assert!((found - at).length() < 1e-2, "{at} {found}");
        }
    }

    #[test]
    fn what_is_grabbed_stays_under_the_cursor() {
        let mut controls = Controls::new(camera());
        let grabbed = DVec3::new(5e5 + 900.0, 4e6 - 800.0, 300.0);
        for cursor in [DVec2::new(500.0, 400.0), DVec2::new(900.0, 650.0), DVec2::new(640.0, 300.0)] {
            controls.pan(grabbed, cursor);
            let found = seen(controls.camera(), grabbed);
            assert!((found - cursor).length() < 1e-2, "{cursor} {found}");
            assert_eq!(controls.camera().eye.z, 5000.0, "a pan keeps the height");
        }
        // Into the sky it goes no farther than allowed.
        let before = controls.camera().eye;
        controls.pan(grabbed, DVec2::new(640.0, -2000.0));
        let moved = (controls.camera().eye - before).length();
        assert!(moved.is_finite() && moved <= 3.0 * PAN_MAX * (grabbed - before).length(), "{moved}");
    }

    #[test]
    fn a_turn_keeps_its_pivot_and_does_not_roll_over() {
        let mut controls = Controls::new(camera());
        let pivot = camera().target;
        controls.turn(pivot, 0.7, 0.2);
        assert!((seen(controls.camera(), pivot) - DVec2::new(640.0, 360.0)).length() < 1e-2);
        assert!(
            (controls.heading().to_degrees() - 0.7f64.to_degrees()).abs() < 1e-6,
            "{}",
            controls.heading()
        );
        for up in [9.0, -9.0] {
            controls.turn(pivot, 0.0, up);
            let steep = controls.pitch().sin();
            assert!((STEEPNESS[0] - 1e-6..=STEEPNESS[1] + 1e-6).contains(&steep), "{steep}");
            let [right, above, _] = controls.camera().axes();
            assert!(above.z > 0.0 && right.z.abs() < 1e-9, "upright");
        }
        let distance = (camera().eye - pivot).length();
        assert!(((controls.camera().eye - pivot).length() - distance).abs() < 1e-6);
    }

    #[test]
    fn a_zoom_goes_towards_its_point_and_not_through_it() {
        let mut controls = Controls::new(camera());
        let point = DVec3::new(5e5 + 300.0, 4e6 + 200.0, 600.0);
        let (at, before) = (seen(&camera(), point), (point - camera().eye).length());
        controls.zoom(point, 0.5, 10.0);
        assert!((seen(controls.camera(), point) - at).length() < 1e-2, "the point stays where it is seen");
        assert!(((point - controls.camera().eye).length() - before / 2.0).abs() < 1e-6);
        (0..60).for_each(|_| controls.zoom(point, 0.5, 10.0));
        assert!(((point - controls.camera().eye).length() - 10.0).abs() < 1e-3);
        controls.zoom(point, f64::NAN, 10.0);
        assert!(controls.camera().eye.is_finite());
    }

    #[test]
    fn flying_follows_the_heading_and_stays_above_the_ground() {
        let mut controls = Controls::new(camera());
        controls.turn(camera().eye, std::f64::consts::FRAC_PI_2, 0.0);
        controls.fly(&Thrust { ahead: 1.0, ..Thrust::default() }, 1000.0, 1.0);
        let moved = controls.camera().eye - camera().eye;
        assert!((moved - DVec3::X * SPEED * 1000.0).length() < 1e-6, "east: {moved}");
        controls.fly(&Thrust { up: -1.0, fast: true, ..Thrust::default() }, 1000.0, 9.0);
        controls.stay_above(700.0, 20.0);
        assert!((controls.camera().eye.z - 720.0).abs() < 1e-9);
        let before = *controls.camera();
        controls.stay_above(-100.0, 20.0);
        assert_eq!(*controls.camera(), before);
    }

    #[test]
    fn a_glide_arrives_and_is_smooth() {
        let mut controls = Controls::new(camera());
        let point = DVec3::new(5e5 + 2000.0, 4e6 + 1500.0, 900.0);
        controls.glide_near(point, 5.0);
        let (mut last, mut longest) = (controls.camera().eye, 0.0f64);
        for _ in 0..200 {
            controls.step(0.01);
            longest = longest.max((controls.camera().eye - last).length());
            last = controls.camera().eye;
        }
        assert!(!controls.is_gliding() && controls.camera().target == point);
        let distance = (point - camera().eye).length();
        assert!(((point - last).length() - distance / 3.0).abs() < 1e-6);
        assert!(longest < distance / 20.0, "no jump: {longest} of {distance}");
        controls.turn(point, 2.0, 0.0);
        controls.glide_north(point);
        (0..200).for_each(|_| controls.step(0.01));
        assert!(
            controls.heading().abs() < 1e-6
                && ((last - point).length() - (controls.camera().eye - point).length()).abs() < 1e-3
        );
    }
}

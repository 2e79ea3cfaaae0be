//! The bounding boxes of what is drawn, as lines over the picture.

use super::Viewer;
use crate::camera::{Bounds, Camera};
use crate::drawing::DrawItem;
use crate::surface::Surface;
use diamantina_protocol::NODATA;
use diamantina_protocol::message::Layer;
use egui::{Color32, Pos2, Stroke, Ui};
use glam::{DVec2, DVec3};

/// The edges of a box: pairs of corners, of which bit 0 is east, bit 1 north, bit 2 up.
const EDGES: [[usize; 2]; 12] =
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];

/// Draws the box of each diamond that is drawn, in the colour of its level.
pub(super) fn show(viewer: &Viewer, ui: &Ui) {
    let camera = viewer.camera();
    let scale = f64::from(ui.ctx().pixels_per_point());
    let planes = camera.planes();
    // Not over the panel.
    let painter = ui.painter().with_clip_rect(ui.available_rect_before_wrap());
    for item in viewer.items() {
        let Some(layer) = viewer.terrain.scene().layers.get(item.layer) else { continue };
        let Some(bounds) = bounds(layer, &item) else { continue };
        let bounds = bounds.stretched(viewer.look.exaggeration);
        if !bounds.touches(&planes) {
            continue;
        }
        let stroke = Stroke::new(1.0, colour(item.diamond.level()));
        for edge in edges(&bounds) {
            if let Some(line) = seen(camera, edge) {
                #[allow(clippy::cast_possible_truncation, reason = "for a line")]
                let points = line.map(|p| Pos2::new((p.x / scale) as f32, (p.y / scale) as f32));
                painter.line_segment(points, stroke);
            }
        }
    }
}

/// The box around a diamond as it is drawn; `None` if nothing of it is.
fn bounds(layer: &Layer, item: &DrawItem) -> Option<Bounds> {
    let range = |heights: &mut dyn Iterator<Item = i32>| {
        heights.fold(None, |range: Option<[i32; 2]>, h| {
            let [low, high] = range.unwrap_or([h; 2]);
            Some([low.min(h), high.max(h)])
        })
    };
    let [lowest, highest] = match &*item.surface {
        Surface::Points(points) => {
            range(&mut points.block().heights().iter().copied().filter(|h| *h != NODATA))
        }
        Surface::Tin(tin) => range(&mut tin.corners().iter().map(|corner| corner.height)),
    }?
    .map(|height| layer.metres(height));
    let [a, b] = layer.forest.bounds(item.diamond).map(|p| DVec2::from(layer.position(p)));
    Some(Bounds { min: a.min(b).extend(lowest), max: a.max(b).extend(highest) })
}

fn edges(bounds: &Bounds) -> impl Iterator<Item = [DVec3; 2]> {
    let ends = [bounds.min, bounds.max];
    let corner = move |i: usize| DVec3::new(ends[i & 1].x, ends[i >> 1 & 1].y, ends[i >> 2 & 1].z);
    EDGES.into_iter().map(move |edge| edge.map(corner))
}

/// The part of a line that is ahead of the eye, in pixels.
pub(super) fn seen(camera: &Camera, line: [DVec3; 2]) -> Option<[DVec2; 2]> {
    let [right, up, backward] = camera.axes();
    let [width, height] = camera.size.map(f64::from);
    let focal = camera.pixels_per_radian();
    let [a, b] = line.map(|p| p - camera.eye);
    let ahead = [-backward.dot(a), -backward.dot(b)];
    // A plane a little before the eye, as far as the line is long: what is behind it has no place on the screen.
    let near = 1e-3 * (a - b).length();
    if ahead[0].max(ahead[1]) <= near {
        return None;
    }
    let cut = |from: DVec3, to: DVec3, [d, e]: [f64; 2]| {
        if d >= near { from } else { from.lerp(to, (near - d) / (e - d)) }
    };
    let ends = [cut(a, b, ahead), cut(b, a, [ahead[1], ahead[0]])];
    Some(ends.map(|p| {
        let d = -backward.dot(p);
        DVec2::new(width / 2.0 + focal * right.dot(p) / d, height / 2.0 - focal * up.dot(p) / d)
    }))
}

/// Six hues in turn, as where levels are tinted.
fn colour(level: u32) -> Color32 {
    let turn = f64::from(level) / 6.0;
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "from 0 to 255")]
    let [r, g, b] = [0.0, 0.333, 0.667].map(|shift| {
        (127.5 + 127.5 * (std::f64::consts::TAU * (turn + shift)).cos()).round().clamp(0.0, 255.0) as u8
    });
    Color32::from_rgb(r, g, b)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::FOV_Y;

    #[test]
    fn lines_end_where_the_eye_does_not_see() {
        let camera = Camera { eye: DVec3::ZERO, target: DVec3::Y, fov_y: FOV_Y, size: [200, 100] };
        let ahead = seen(&camera, [DVec3::new(0.0, 10.0, 0.0), DVec3::new(0.0, 20.0, 0.0)]).unwrap();
        assert!(ahead.iter().all(|p| (*p - DVec2::new(100.0, 50.0)).length() < 1e-9));
        assert!(seen(&camera, [DVec3::new(1.0, -10.0, 0.0), DVec3::new(2.0, -1.0, 0.0)]).is_none());
        // From behind to ahead on the right: it runs out of the picture there, not through its middle.
        let [a, b] = seen(&camera, [DVec3::new(5.0, -10.0, 0.0), DVec3::new(5.0, 50.0, 0.0)]).unwrap();
        assert!(a.x > 1000.0 && b.x > 100.0 && a.y == 50.0, "{a} {b}");
        let unit = Bounds { min: DVec3::ZERO, max: DVec3::ONE };
        let lengths: Vec<f64> = edges(&unit).map(|[a, b]| (a - b).length()).collect();
        assert_eq!(lengths, [1.0; 12]);
    }
}

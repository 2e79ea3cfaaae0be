//! A north arrow: a compass that lies on the level where the middle of the picture is, as it is seen from there.
//!
//! Its needle points to the north pole where the frame's place on the globe is known, else along the frame's y axis. It is
//! foreshortened as level ground is; where the camera looks down by less than 20 degrees, or up, it is drawn as from 20
//! degrees above, or its needle would be a line, or upside down.

use super::{Anchor, Ink, Subject, on_screen, put, text};
use egui::{Align2, Color32, Mesh, Painter, Pos2, Rect, Shape, Stroke, vec2};
use glam::DVec2;

/// The sine of the flattest angle at which it is drawn.
const FLATTEST: f64 = 0.342;

/// Points from the compass's middle to the needle's tip.
const RADIUS: f64 = 27.0;

/// The direction to north at the anchor, a unit vector of the frame.
pub(super) fn direction(subject: &Subject<'_>, anchor: Anchor) -> DVec2 {
    subject.globe.and_then(|globe| globe.north(anchor.place)).unwrap_or(DVec2::Y)
}

/// Half of the needle. Its outline is drawn side by side: as one it would be pointed, and the points of a narrow one shoot far
/// out of it.
fn half(painter: &Painter, corners: [Pos2; 3], colour: Color32, is_filled: bool) {
    if is_filled {
        let mut inside = Mesh::default();
        corners.iter().for_each(|corner| inside.colored_vertex(*corner, colour));
        inside.add_triangle(0, 1, 2);
        painter.add(inside);
    }
    let [a, b, c] = corners;
    for side in [[a, b], [b, c], [c, a]] {
        painter.line_segment(side, Stroke::new(1.0, colour));
    }
}

pub(super) fn show(painter: &Painter, area: Rect, ink: &Ink, subject: &Subject<'_>, anchor: Anchor) {
    let north = direction(subject, anchor);
    let east = -north.perp();
    let rect = ink.plate(painter, area, Align2::RIGHT_TOP, vec2(78.0, 78.0));
    let middle = rect.center();
    #[allow(clippy::cast_possible_truncation, reason = "points on a screen")]
    let at = |along: f64, across: f64| -> Pos2 {
        let p = on_screen(subject.camera, north * along + east * across, FLATTEST) * RADIUS;
        middle + vec2(p.x as f32, p.y as f32)
    };
    let ring = (0..72).map(|i| {
        let (sin, cos) = (f64::from(i) * std::f64::consts::TAU / 72.0).sin_cos();
        at(0.72 * cos, 0.72 * sin)
    });
    painter.add(Shape::closed_line(ring.collect(), Stroke::new(1.0, ink.faint)));
    for (along, across) in [(0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)] {
        let mark = [at(0.64 * along, 0.64 * across), at(0.8 * along, 0.8 * across)];
        painter.line_segment(mark, Stroke::new(1.0, ink.faint));
    }
    // One half filled, as on printed maps.
    for (side, is_filled) in [(0.3, true), (-0.3, false)] {
        half(painter, [at(1.0, 0.0), at(-0.62, side), at(-0.36, 0.0)], ink.text, is_filled);
    }
    let tip = at(1.0, 0.0);
    let ahead = (tip - middle).normalized();
    put(painter, tip + 8.5 * ahead, Align2::CENTER_CENTER, text(painter, "N", 13.0, ink.text));
}

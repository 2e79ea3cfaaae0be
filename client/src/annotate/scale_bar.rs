//! A scale bar: a round length, as long on the screen as it is across the picture where the middle of the picture is.
//!
//! A level line from left to right in the picture, at the depth of the anchor, measures the same number of pixels for each
//! metre wherever it is in the picture: a perspective picture shrinks with depth alone, which is counted along the
//! camera's axis. So the bar may stand at the picture's side.

use super::{Anchor, Ink, Subject, metres, put, round_down, text, value};
use egui::{Align2, Color32, Painter, Rect, Stroke, StrokeKind, pos2, vec2};
use glam::DVec3;

/// The part of the picture's width that the bar takes at most.
const PART_MAX: f64 = 0.24;

/// Points of the bar's thickness.
const THICKNESS: f32 = 6.0;

/// A scale bar.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Bar {
    /// The first digit of its length in metres, and the power of ten: 1, 2 or 5 times it.
    pub(super) length: (u32, i32),
    /// How long it is on the screen.
    pub(super) pixels: f64,
    /// Metres from the eye to the anchor, heights as they are.
    pub(super) distance: f64,
}

impl Bar {
    /// The longest of at most so many pixels. `None` where the anchor is not ahead of the eye.
    pub(super) fn new(subject: &Subject<'_>, anchor: Anchor, pixels_max: f64) -> Option<Self> {
        let camera = subject.camera;
        let [right, _, backward] = camera.axes();
        let from_eye = anchor.place - camera.eye;
        let depth = -from_eye.dot(backward);
        if depth.is_nan() || depth <= 0.0 {
            return None;
        }
        let along = right.truncate().normalize();
        let ground = subject.globe.and_then(|globe| globe.ground_metres(anchor.place, along)).unwrap_or(1.0);
        // Pixels of a metre on the ground.
        let scale = camera.pixels_per_radian() / depth / ground;
        let length = round_down(pixels_max / scale);
        let real = DVec3::new(from_eye.x, from_eye.y, from_eye.z / subject.look.exaggeration);
        Some(Self { length, pixels: value(length) * scale, distance: real.length() })
    }

    /// Parts of alternating colour: as many as give round lengths.
    fn parts(&self) -> u16 {
        if self.length.0 == 5 { 5 } else { 4 }
    }
}

pub(super) fn show(painter: &Painter, area: Rect, ink: &Ink, subject: &Subject<'_>, anchor: Anchor) {
    let scale = f64::from(painter.pixels_per_point());
    let widest = f64::from(subject.camera.size[0]).min(f64::from(area.width()) * scale);
    let Some(bar) = Bar::new(subject, anchor, (PART_MAX * widest).max(60.0)) else { return };
    #[allow(clippy::cast_possible_truncation, reason = "points on a screen")]
    let length = (bar.pixels / scale) as f32;
    let zero = text(painter, "0", 12.0, ink.text);
    let end = text(painter, metres(value(bar.length)), 12.0, ink.text);
    let place = if anchor.is_ground { "" } else { "no ground there; " };
    let mut note = format!("at the cross ({place}{} away)", metres(bar.distance));
    if subject.look.exaggeration != 1.0 {
        note = format!("{note}, heights × {}", subject.look.exaggeration);
    }
    let note = text(painter, note, 10.5, ink.faint);
    let line = end.size().y;
    // The end's text stands in the middle of the end, and goes beyond it.
    let overhang = [zero.size().x / 2.0, end.size().x / 2.0];
    let width = (overhang[0] + length + overhang[1]).max(note.size().x);
    let content = vec2(width, line + 3.0 + THICKNESS + 3.0 + note.size().y);
    let rect = ink.plate(painter, area, Align2::LEFT_BOTTOM, content);
    let left = rect.left() + overhang[0];
    put(painter, pos2(left, rect.top()), Align2::CENTER_TOP, zero);
    put(painter, pos2(left + length, rect.top()), Align2::CENTER_TOP, end);
    let top = rect.top() + line + 3.0;
    let whole = Rect::from_min_size(pos2(left, top), vec2(length, THICKNESS));
    painter.rect_filled(whole, 0.0, Color32::WHITE);
    let part = length / f32::from(bar.parts());
    for i in (0..bar.parts()).step_by(2) {
        let from = left + part * f32::from(i);
        painter.rect_filled(
            Rect::from_min_size(pos2(from, top), vec2(part, THICKNESS)),
            0.0,
            Color32::from_gray(20),
        );
    }
    painter.rect_stroke(whole, 0.0, Stroke::new(1.0, ink.text), StrokeKind::Outside);
    put(painter, rect.left_bottom(), Align2::LEFT_BOTTOM, note);
}

//! A legend: what colours mean, with units, for each layer that is drawn.

use super::{Ink, Subject, put, round_down, text, value};
use crate::render::{Quantity, Scale, Shading, water_colour};
use diamantina_protocol::message::{Kind, Layer};
use egui::{Align2, Color32, Mesh, Painter, Rect, Shape, Stroke, StrokeKind, Vec2, pos2, vec2};

/// Layers that have a legend each; more would hide the picture.
const LAYERS_MAX: usize = 3;

/// Points of the bar of colours: its width, and its height at most.
const BAR: Vec2 = vec2(16.0, 190.0);

/// Points between labels at least.
const SPACING: f32 = 15.0;

/// Points of the wedge of an end beyond which there are more values.
const WEDGE: f32 = 9.0;

pub(super) fn show(painter: &Painter, area: Rect, ink: &Ink, subject: &Subject<'_>) {
    let (look, mut left) = (subject.look, area);
    let (terrain, water): (Vec<&Layer>, Vec<&Layer>) =
        subject.layers.iter().partition(|layer| layer.kind == Kind::Terrain);
    // A mirror has no colour of its own, nor has water that is lit as ground is.
    let water: Vec<&Layer> =
        water.into_iter().filter(|_| !look.water.reflecting && look.shading != Shading::Soft).collect();
    let is_grey = look.colours == crate::render::Colours::Flat && look.shading != Shading::Hillshade;
    let terrain = if is_grey { Vec::new() } else { terrain };
    // Where they look alike, one tells of all.
    let shown: Vec<&Layer> = terrain.iter().rev().take(LAYERS_MAX).rev().copied().collect();
    if shown.is_empty() && !water.is_empty() {
        swatches(painter, left, ink, &water);
        return;
    }
    for (i, layer) in shown.iter().enumerate().rev() {
        let below = if i + 1 == shown.len() { &water[..] } else { &[] };
        let taken = ramp(painter, left, ink, subject, layer, below);
        left.set_right(left.right() - taken - 6.0);
    }
}

/// The legend of a layer; how wide it is.
fn ramp(
    painter: &Painter,
    area: Rect,
    ink: &Ink,
    subject: &Subject<'_>,
    layer: &Layer,
    water: &[&Layer],
) -> f32 {
    let look = subject.look;
    let scale = Scale::of(look, layer);
    let heading = text(painter, layer.name.as_str(), 13.0, ink.text);
    let unit = text(painter, unit(&scale), 12.0, ink.text);
    let light = (look.shading == Shading::Hillshade).then(|| {
        let sun = look.sun;
        let note = format!("lit from {:.0}°, {:.0}° high", sun.azimuth_degrees, sun.altitude_degrees);
        text(painter, note, 10.5, ink.faint)
    });
    // Imagery has colours of its own, and may cover a part alone.
    let except = subject.imagery.map(|name| text(painter, format!("but not under {name}"), 10.5, ink.faint));
    let waters: Vec<_> =
        water.iter().map(|layer| text(painter, layer.name.as_str(), 12.0, ink.text)).collect();
    let notes = [light.as_ref(), except.as_ref()].into_iter().flatten();
    let head = heading.size().y + unit.size().y + notes.map(|note| note.size().y).sum::<f32>() + 6.0;
    let foot = 20.0 * waters.len() as f32;
    let wedges = scale.beyond().map(|beyond| if beyond { WEDGE } else { 0.0 });
    let room = area.height() - 2.0 * super::PADDING - head - foot - wedges[0] - wedges[1] - SPACING;
    let bar_height = room.clamp(40.0, BAR.y);
    let labels = labels(&scale, bar_height);
    let labels: Vec<_> =
        labels.into_iter().map(|(at, label)| (at, text(painter, label, 12.0, ink.text))).collect();
    let widest = labels.iter().map(|(_, label)| label.size().x).fold(0.0, f32::max);
    let texts = [Some(&heading), Some(&unit), light.as_ref(), except.as_ref()];
    let texts = texts.into_iter().flatten().map(|galley| galley.size().x);
    let swatch = waters.iter().map(|galley| BAR.x + 7.0 + galley.size().x);
    let width = texts.chain(swatch).fold(BAR.x + 7.0 + widest, f32::max);
    let height = head + wedges[0] + wedges[1] + bar_height + SPACING + foot;
    let rect = ink.plate(painter, area, Align2::RIGHT_BOTTOM, vec2(width, height));
    let mut y = rect.top();
    for galley in [Some(heading), Some(unit), light, except].into_iter().flatten() {
        let next = y + galley.size().y;
        put(painter, pos2(rect.left(), y), Align2::LEFT_TOP, galley);
        y = next;
    }
    // The highest label stands half above the bar's end.
    let top = rect.top() + head + SPACING / 2.0 + wedges[1];
    let bar = snapped(painter, Rect::from_min_size(pos2(rect.left(), top), vec2(BAR.x, bar_height)));
    colours(painter, bar, &scale);
    for (beyond, end) in [(wedges[1], bar.top()), (-wedges[0], bar.bottom())] {
        if beyond != 0.0 {
            let value = scale.range()[usize::from(beyond > 0.0)];
            let tip = pos2(bar.center().x, end - beyond);
            let wedge = vec![pos2(bar.left(), end), tip, pos2(bar.right(), end)];
            painter.add(Shape::convex_polygon(wedge, colour(&scale, value), Stroke::new(1.0, ink.text)));
        }
    }
    painter.rect_stroke(bar, 0.0, Stroke::new(1.0, ink.text), StrokeKind::Outside);
    for (at, label) in labels {
        let y = bar.bottom() - at * bar.height();
        painter.line_segment([pos2(bar.right(), y), pos2(bar.right() + 4.0, y)], Stroke::new(1.0, ink.text));
        put(painter, pos2(bar.right() + 7.0, y), Align2::LEFT_CENTER, label);
    }
    let mut y = rect.bottom() - foot + 6.0;
    for galley in waters {
        y = patch(painter, pos2(rect.left(), y), ink, galley);
    }
    rect.width() + 2.0 * super::PADDING
}

/// The legend where water alone is drawn.
fn swatches(painter: &Painter, area: Rect, ink: &Ink, water: &[&Layer]) {
    let names: Vec<_> =
        water.iter().map(|layer| text(painter, layer.name.as_str(), 12.0, ink.text)).collect();
    let width = names.iter().map(|galley| galley.size().x).fold(0.0, f32::max);
    let content = vec2(BAR.x + 7.0 + width, 20.0 * names.len() as f32 - 6.0);
    let rect = ink.plate(painter, area, Align2::RIGHT_BOTTOM, content);
    let mut y = rect.top();
    for galley in names {
        y = patch(painter, pos2(rect.left(), y), ink, galley);
    }
}

/// A patch of the colour of water, and a name; where the next goes.
fn patch(painter: &Painter, at: egui::Pos2, ink: &Ink, name: std::sync::Arc<egui::Galley>) -> f32 {
    let [r, g, b] = water_colour();
    let patch = Rect::from_min_size(at, vec2(BAR.x, 14.0));
    painter.rect_filled(patch, 0.0, Color32::from_rgb(r, g, b));
    painter.rect_stroke(patch, 0.0, Stroke::new(1.0, ink.text), StrokeKind::Outside);
    put(painter, patch.right_center() + vec2(7.0, 0.0), Align2::LEFT_CENTER, name);
    at.y + 20.0
}

fn unit(scale: &Scale) -> &'static str {
    match scale.quantity() {
        Quantity::Height if scale.has_sea() => "Height and depth [m]",
        Quantity::Height => "Height [m]",
        Quantity::Slope => "Slope [°]",
        Quantity::Light => "Hillshade",
    }
}

fn colour(scale: &Scale, value: f64) -> Color32 {
    let [r, g, b] = scale.colour(value);
    Color32::from_rgb(r, g, b)
}

/// A rectangle whose sides lie between pixels.
fn snapped(painter: &Painter, rect: Rect) -> Rect {
    let scale = painter.pixels_per_point();
    let round = |p: egui::Pos2| pos2((p.x * scale).round() / scale, (p.y * scale).round() / scale);
    Rect::from_min_max(round(rect.min), round(rect.max))
}

/// The colours of a scale, the highest value at the top: each row of pixels has that of the value in its middle, exactly.
fn colours(painter: &Painter, bar: Rect, scale: &Scale) {
    let pixel = 1.0 / painter.pixels_per_point();
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a few hundred")]
    let rows = (bar.height() / pixel).round() as u16;
    let [low, high] = scale.range();
    let mut mesh = Mesh::default();
    for row in 0..rows {
        let part = (f64::from(row) + 0.5) / f64::from(rows);
        let top = bar.top() + f32::from(row) * pixel;
        let line = Rect::from_min_max(pos2(bar.left(), top), pos2(bar.right(), top + pixel));
        mesh.add_colored_rect(line, colour(scale, high + (low - high) * part));
    }
    painter.add(Shape::mesh(mesh));
}

/// What stands beside a bar of so many points: places from 0 to 1, and texts. Round values, and both ends where there is
/// room.
pub(super) fn labels(scale: &Scale, points: f32) -> Vec<(f32, String)> {
    let [low, high] = scale.range();
    if high - low <= 0.0 || !(high - low).is_finite() {
        return vec![(0.5, number(low, 3))];
    }
    let most = f64::from((points / (1.6 * SPACING)).max(2.0));
    let step = (high - low) / most;
    // The next round step up.
    let step = match round_down(step) {
        round if value(round) >= step * (1.0 - 1e-9) => round,
        (1, power) => (2, power),
        (2, power) => (5, power),
        (_, power) => (1, power + 1),
    };
    let decimals = usize::try_from(-step.1).unwrap_or(0);
    let length = value(step);
    #[allow(clippy::cast_possible_truncation, reason = "at most some dozens of steps from a finite number")]
    let [first, last] = [(low / length - 1e-9).ceil() as i64, (high / length + 1e-9).floor() as i64];
    let place = |value: f64| ((value - low) / (high - low)).clamp(0.0, 1.0);
    #[allow(clippy::cast_possible_truncation, reason = "from 0 to 1")]
    let mut found: Vec<(f32, String)> = (first..=last)
        .map(|i| (place(i as f64 * length) as f32, number(i as f64 * length, decimals)))
        .collect();
    for (at, end) in [(0.0, low), (1.0, high)] {
        if found.iter().all(|(other, _)| (other - at).abs() * points >= SPACING) {
            found.push((at, number(end, decimals)));
        }
    }
    found
}

/// With a true minus, and none before 0.
fn number(value: f64, decimals: usize) -> String {
    let text = format!("{:.decimals$}", value.abs());
    let is_zero = text.bytes().all(|b| b == b'0' || b == b'.');
    if value < 0.0 && !is_zero { format!("−{text}") } else { text }
}

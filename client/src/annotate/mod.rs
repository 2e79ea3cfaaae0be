//! What is written over pictures: a scale bar, a north arrow, a legend.
//!
//! All of it is drawn by egui's painter, in the viewer as in pictures without a window, so both look the same. Where it
//! goes: the bar at the lower left, the arrow at the upper right, the legend at the lower right, each on a plate of its own
//! that keeps it legible over whatever is behind.
//!
//! **In perspective** a length has one size on the screen only at one distance, and a direction one angle only at one
//! place. Both are told where the *middle of the picture* meets the ground, or, where it meets none, at the camera's
//! target; a cross marks the place, and the bar says how far away it is.
//!
//! | module | what it holds |
//! |---|---|
//! | `scale_bar` | a round length across the picture |
//! | `north` | where north is |
//! | `legend` | colours and what they mean |

mod legend;
mod north;
mod scale_bar;

use crate::camera::Camera;
use crate::drawing::DrawItem;
use crate::globe::Globe;
use crate::pick::{Picker, Ray};
use crate::render::{Background, Look};
use diamantina_protocol::message::Layer;
use egui::{
    Align2, Color32, CornerRadius, FontId, Painter, Pos2, Rect, Stroke, StrokeKind, Vec2, pos2, vec2,
};
use glam::{DVec2, DVec3};

/// The smallest picture that annotations leave anything of, in pixels.
pub const SIZE_MIN: [u32; 2] = [160, 120];

/// Points between annotations and the picture's sides.
const MARGIN: f32 = 14.0;

/// Points between a plate's side and what is on it.
const PADDING: f32 = 8.0;

/// What annotations tell of.
#[derive(Debug, Clone, Copy)]
pub struct Subject<'a> {
    /// The camera, its heights stretched as the look says.
    pub camera: &'a Camera,
    /// How the picture looks, and what is to be written.
    pub look: &'a Look,
    /// The layers that are drawn.
    pub layers: &'a [Layer],
    /// The name of the imagery that lies on the ground, if any does.
    pub imagery: Option<&'a str>,
    /// Where the frame lies on the globe, if that is known: else the y axis is north, and metres are the frame's.
    pub globe: Option<&'a Globe>,
    /// What is seen in the middle of the picture, as [`centre`] finds it.
    pub centre: Option<DVec3>,
}

/// The place that scale and north are told of.
#[derive(Debug, Clone, Copy)]
struct Anchor {
    /// In the frame's metres, heights stretched.
    place: DVec3,
    /// Whether it is the ground, and not what the camera was pointed at.
    is_ground: bool,
}

/// What the middle of a picture shows: a place of the frame, heights stretched. `None` where that is no ground.
pub fn centre(
    picker: &mut Picker,
    layers: &[Layer],
    items: &[DrawItem],
    look: &Look,
    camera: &Camera,
) -> Option<DVec3> {
    let [.., backward] = camera.axes();
    let ray = Ray { origin: camera.eye, direction: -backward };
    Some(picker.pick(layers, items, look.exaggeration, &ray)?.point)
}

/// Pixels of a point (a unit of text and lines) in a picture: annotations take the same part of pictures of any size.
#[must_use]
pub fn pixels_per_point([width, height]: [u32; 2]) -> f32 {
    ((width as f32 / 1.5).min(height as f32) / 720.0).clamp(0.6, 16.0)
}

/// Draws what the look asks for. `area`: the part of the picture, in points, that annotations keep to.
pub fn show(painter: &Painter, area: Rect, subject: &Subject<'_>) {
    let wanted = subject.look.annotations;
    if !wanted.is_any() {
        return;
    }
    let anchor = Anchor {
        place: subject.centre.unwrap_or(subject.camera.target),
        is_ground: subject.centre.is_some(),
    };
    let area = area.shrink(MARGIN);
    let ink = Ink::over(subject.look.background);
    if wanted.scale_bar || wanted.north_arrow {
        cross(painter, subject.camera);
    }
    if wanted.scale_bar {
        scale_bar::show(painter, area, &ink, subject, anchor);
    }
    if wanted.north_arrow {
        north::show(painter, area, &ink, subject, anchor);
    }
    if wanted.legend {
        legend::show(painter, area, &ink, subject);
    }
}

/// Marks the middle of the picture, and leaves it free.
fn cross(painter: &Painter, camera: &Camera) {
    let [x, y] = camera.size.map(|s| s as f32 / 2.0 / painter.pixels_per_point());
    let middle = pos2(x, y);
    for (width, colour) in [(3.0, Color32::from_white_alpha(200)), (1.2, Color32::BLACK)] {
        for (dx, dy) in [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)] {
            let along = vec2(dx, dy);
            // The halo is a little longer, so that the ends have one, too.
            let [from, to] = [3.0, 9.0].map(|at| if width > 2.0 { at + (at - 6.0) / 3.0 } else { at });
            painter.line_segment([middle + from * along, middle + to * along], Stroke::new(width, colour));
        }
    }
}

/// The colours of annotations.
#[derive(Debug, Clone, Copy)]
struct Ink {
    text: Color32,
    faint: Color32,
    plate: Color32,
    border: Color32,
}

impl Ink {
    /// Dark on light plates, but light on dark ones before a dark background.
    fn over(background: Background) -> Self {
        let is_dark = match background {
            Background::Sky => false,
            Background::Colour([r, g, b, _]) => 0.2126 * r + 0.7152 * g + 0.0722 * b < 0.18,
        };
        if is_dark {
            Self {
                text: Color32::from_gray(240),
                faint: Color32::from_gray(185),
                plate: Color32::from_rgba_unmultiplied(16, 17, 19, 230),
                border: Color32::from_white_alpha(60),
            }
        } else {
            Self {
                text: Color32::from_gray(16),
                faint: Color32::from_gray(70),
                plate: Color32::from_rgba_unmultiplied(255, 255, 255, 238),
                border: Color32::from_black_alpha(70),
            }
        }
    }

    /// A plate around a content of a size, in a corner of an area; where the content goes.
    fn plate(&self, painter: &Painter, area: Rect, corner: Align2, content: Vec2) -> Rect {
        let rect = corner.align_size_within_rect(content + Vec2::splat(2.0 * PADDING), area);
        painter.rect(
            rect,
            CornerRadius::same(3),
            self.plate,
            Stroke::new(0.8, self.border),
            StrokeKind::Inside,
        );
        rect.shrink(PADDING)
    }
}

/// A text that has been laid out but not placed.
fn text(
    painter: &Painter,
    text: impl Into<String>,
    size: f32,
    colour: Color32,
) -> std::sync::Arc<egui::Galley> {
    painter.layout_no_wrap(text.into(), FontId::proportional(size), colour)
}

/// Draws a text with a point of its box at a place.
fn put(painter: &Painter, at: Pos2, anchor: Align2, galley: std::sync::Arc<egui::Galley>) {
    let min = anchor.anchor_size(at, galley.size()).min;
    painter.galley(min, galley, Color32::PLACEHOLDER);
}

/// The largest of 1, 2 or 5 times a power of ten that is at most `most`, which is above 0: its first digit, and the power.
fn round_down(most: f64) -> (u32, i32) {
    #[allow(clippy::cast_possible_truncation, reason = "a logarithm is small")]
    let power = most.log10().floor() as i32;
    let mut candidates =
        [power - 1, power, power + 1].into_iter().flat_map(|p| [1, 2, 5].map(|digit| (digit, p)));
    // Rounding must not lose the power itself.
    let fits = |(digit, p): &(u32, i32)| value((*digit, *p)) <= most * (1.0 + 1e-9);
    candidates.rfind(fits).unwrap_or((1, power))
}

/// A digit times a power of ten.
fn value((digit, power): (u32, i32)) -> f64 {
    if power < 0 { f64::from(digit) / 10f64.powi(-power) } else { f64::from(digit) * 10f64.powi(power) }
}

/// Metres or kilometres with three digits that count.
fn metres(length: f64) -> String {
    let (number, unit) = if length >= 1000.0 { (length / 1000.0, "km") } else { (length, "m") };
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped just before")]
    let decimals = (2.0 - number.max(1e-9).log10().floor()).clamp(0.0, 6.0) as usize;
    let text = format!("{number:.decimals$}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    format!("{text} {unit}")
}

/// Where a direction on the level points on the screen, right and down, seen from far away in the direction of the camera:
/// of length 1 across the picture, and shorter towards its depth. `flattest`: the sine of the angle above the level from
/// which it is seen at least.
fn on_screen(camera: &Camera, direction: DVec2, flattest: f64) -> DVec2 {
    let [right, up, _] = camera.axes();
    // The picture's right is level; what lies ahead of the eye goes up the picture.
    let ahead = DVec3::Z.cross(right);
    let rise = up.dot(ahead).max(flattest);
    let direction = direction.extend(0.0);
    DVec2::new(direction.dot(right), -direction.dot(ahead) * rise)
}

#[cfg(test)]
mod tests;

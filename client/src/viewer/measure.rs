//! What was clicked: places on the ground, and the profile between the last two.

use super::Viewer;
use super::boxes::seen;
use crate::camera::Camera;
use egui::{Align2, Color32, FontId, RichText, Stroke, Ui};
use glam::DVec3;

/// Places of a profile.
const SAMPLES: usize = 200;

/// Cells of the finest layer that two places of a profile are apart at least.
const APART_CELLS: f64 = 0.1;

/// Frames after which a profile is looked at again while data arrives for the first time.
const FRAMES: u32 = 20;

/// A place that was clicked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mark {
    /// In the frame's metres, its height as it is.
    pub place: DVec3,
    /// Longitude and latitude in degrees, if the frame has such.
    pub lonlat: Option<[f64; 2]>,
    /// How far its height may be off the finest surface's, in metres, if that is known.
    pub error: Option<f64>,
    /// The layer.
    pub layer: usize,
}

/// The ground between the last two marks.
#[derive(Debug, Default)]
pub(super) struct Profile {
    ends: Option<[DVec3; 2]>,
    /// The height at places evenly spread from the first to the last, in metres, as it was last seen; `None` where there is no
    /// ground or none was seen.
    heights: Vec<Option<f64>>,
    /// From where it was looked at when all that was asked for was there.
    seen_from: Option<Camera>,
    /// From where the last frame was seen, and frames since it was looked at.
    eye: Option<Camera>,
    age: u32,
}

impl Profile {
    /// The heights, evenly spread.
    #[cfg(test)]
    pub(super) fn heights(&self) -> &[Option<f64>] {
        &self.heights
    }

    /// Metres on the level from one of the places to the next.
    fn step(&self) -> f64 {
        let Some([first, last]) = self.ends else { return 0.0 };
        (last - first).truncate().length() / (self.heights.len().max(2) - 1) as f64
    }

    /// Metres on the level without ground, or where none was seen.
    fn unseen(&self) -> f64 {
        let gaps = self.heights.windows(2).filter(|pair| pair.contains(&None)).count();
        self.step() * gaps as f64
    }

    /// Metres from the first place to the last, over the ground: each step counts as long as it is, and is level where there is
    /// none.
    fn length(&self) -> f64 {
        let step = self.step();
        let rises = self.heights.windows(2).map(|pair| match pair {
            [Some(a), Some(b)] => b - a,
            _ => 0.0,
        });
        rises.map(|rise| rise.hypot(step)).sum()
    }
}

/// Looks at the ground between the last two marks, where there are two and something may have changed. Whether it is to be looked
/// at again, though nothing else changes.
pub(super) fn follow(viewer: &mut Viewer) -> bool {
    let [first, last] = viewer.marks[..] else {
        viewer.profile = Profile::default();
        return false;
    };
    // Of one place there is no profile.
    if (last.place - first.place).truncate().length() < APART_CELLS * viewer.cell() {
        viewer.profile = Profile::default();
        return false;
    }
    let ends = Some([first.place, last.place]);
    let camera = *viewer.camera();
    let profile = &mut viewer.profile;
    profile.age += 1;
    let stands = profile.eye.replace(camera) == Some(camera);
    // On the way to another view the ground is drawn as coarse as may be: once all was there, that tells nothing better.
    let is_glimpse_due = profile.age >= FRAMES && profile.seen_from.is_none();
    let is_due = is_glimpse_due || (viewer.frame.complete && stands);
    let is_new = profile.ends != ends;
    if !is_new && (profile.seen_from == Some(camera) || !is_due) {
        return profile.seen_from != Some(camera);
    }
    let (layers, exaggeration) = (&viewer.terrain.scene().layers, viewer.look.exaggeration);
    // What is out of sight now stays as it was seen.
    let before = if is_new { Vec::new() } else { std::mem::take(&mut viewer.profile.heights) };
    let heights = (0..=SAMPLES).map(|i| {
        let place = first.place.lerp(last.place, i as f64 / SAMPLES as f64).truncate();
        let drawn = viewer.picker.ground(layers, &viewer.frame.items, exaggeration, place);
        drawn.map(|height| height / exaggeration).or_else(|| before.get(i).copied().flatten())
    });
    let heights = heights.collect();
    let seen_from = viewer.frame.complete.then_some(camera);
    viewer.profile = Profile { ends, heights, seen_from, eye: Some(camera), age: 0 };
    seen_from.is_none()
}

/// Digits after the point of metres in a scene with such cells: a hundredth of one is told.
fn decimals(cell: f64) -> usize {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "from 1 to 6")]
    let digits = (2.0 - cell.max(1e-9).log10()).floor().clamp(1.0, 6.0) as usize;
    digits
}

/// Metres with so many digits after the point, and no minus before a zero.
fn metres(value: f64, digits: usize) -> String {
    let text = format!("{value:.digits$}");
    match text.strip_prefix('-') {
        Some(zero) if !zero.contains(|c: char| c.is_ascii_digit() && c != '0') => zero.to_owned(),
        _ => text,
    }
}

/// Where marks lie in the picture, and the ground between them.
pub(super) fn show_places(viewer: &Viewer, ui: &Ui) {
    let camera = viewer.camera();
    let scale = f64::from(ui.ctx().pixels_per_point());
    let painter = ui.painter().with_clip_rect(ui.available_rect_before_wrap());
    let drawn = |place: DVec3| place.with_z(place.z * viewer.look.exaggeration);
    let points = |line: [DVec3; 2]| {
        #[allow(clippy::cast_possible_truncation, reason = "for a line")]
        let point = |p: glam::DVec2| egui::pos2((p.x / scale) as f32, (p.y / scale) as f32);
        Some(seen(camera, line.map(drawn))?.map(point))
    };
    let (light, dark) = (Color32::from_rgb(255, 240, 120), Color32::from_black_alpha(160));
    if let Some([first, last]) = viewer.profile.ends {
        let steps = (viewer.profile.heights.len().max(2) - 1) as f64;
        let places = viewer.profile.heights.iter().enumerate();
        let places: Vec<Option<DVec3>> =
            places.map(|(i, height)| Some(first.lerp(last, i as f64 / steps).with_z((*height)?))).collect();
        for stroke in [Stroke::new(4.0, dark), Stroke::new(2.0, light)] {
            for pair in places.windows(2) {
                if let [Some(a), Some(b)] = *pair
                    && let Some(line) = points([a, b])
                {
                    painter.line_segment(line, stroke);
                }
            }
        }
    }
    for mark in viewer.marks() {
        if let Some([at, _]) = points([mark.place; 2]) {
            painter.circle(at, 5.0, light, Stroke::new(2.0, dark));
        }
    }
}

/// What was clicked, in the panel.
pub(super) fn show(viewer: &Viewer, ui: &mut Ui) {
    let digits = decimals(viewer.cell());
    let metres = |value: f64| metres(value, digits);
    let row = |ui: &mut Ui, mark: &Mark| {
        let error = mark.error.map_or(String::new(), |error| format!(" ± {}", metres(error)));
        ui.monospace(format!("{}, {}", metres(mark.place.x), metres(mark.place.y)));
        if let Some([lon, lat]) = mark.lonlat {
            ui.monospace(degrees(lon, lat));
        }
        let layer = &viewer.terrain.scene().layers[mark.layer].name;
        ui.monospace(format!("height {}{error} m, {layer}", metres(mark.place.z)));
    };
    match viewer.marks() {
        [] => {
            ui.label(RichText::new("Click the ground for its height, twice for a profile.").weak());
        }
        [one] => row(ui, one),
        [first, last, ..] => {
            row(ui, first);
            row(ui, last);
            let by = last.place - first.place;
            let (apart, way) = (metres(by.truncate().length()), if by.z < 0.0 { "down" } else { "up" });
            ui.monospace(format!("{apart} m apart on the level, {} m {way}", metres(by.z.abs())));
            if viewer.profile.ends.is_some() {
                ui.monospace(format!("{} m over the ground", metres(viewer.profile.length())));
                let unseen = viewer.profile.unseen();
                if unseen > 0.0 {
                    ui.monospace(format!("{} m of them were not seen, and count as level", metres(unseen)));
                }
                plot(&viewer.profile, digits, ui);
            }
        }
    }
}

/// Degrees as maps write them, to about a decimetre.
fn degrees(lon: f64, lat: f64) -> String {
    let [east, north] = [if lon < 0.0 { 'W' } else { 'E' }, if lat < 0.0 { 'S' } else { 'N' }];
    format!("{:.6}° {north}, {:.6}° {east}", lat.abs(), lon.abs())
}

/// The profile, from the first mark at the left to the last.
fn plot(profile: &Profile, digits: usize, ui: &mut Ui) {
    let size = egui::vec2(ui.available_width(), 90.0);
    let (rect, response) = ui.allocate_exact_size(size, egui::Sense::hover());
    let painter = ui.painter_at(rect);
    painter.rect_filled(rect, 3.0, ui.visuals().extreme_bg_color);
    let known = || profile.heights.iter().flatten().copied();
    let (low, high) = (known().fold(f64::INFINITY, f64::min), known().fold(f64::NEG_INFINITY, f64::max));
    if low > high {
        return;
    }
    let (steps, range) = (profile.heights.len().max(2) - 1, (high - low).max(1e-9));
    #[allow(clippy::cast_possible_truncation, reason = "for a plot")]
    let at = |i: usize, height: f64| {
        let x = rect.left() + rect.width() * i as f32 / steps as f32;
        egui::pos2(x, rect.bottom() - 6.0 - ((height - low) / range) as f32 * (rect.height() - 24.0))
    };
    let stroke = Stroke::new(1.4, ui.visuals().hyperlink_color);
    // In runs: where there is no ground there is a gap.
    let heights: Vec<(usize, Option<f64>)> = profile.heights.iter().copied().enumerate().collect();
    for run in heights.split(|(_, height)| height.is_none()) {
        let points = run.iter().filter_map(|(i, height)| Some(at(*i, (*height)?)));
        painter.line(points.collect(), stroke);
    }
    let (font, colour) = (FontId::proportional(10.0), ui.visuals().weak_text_color());
    let corner = |align: Align2, text: String| {
        let place = align.pos_in_rect(&rect.shrink2(egui::vec2(4.0, 1.0)));
        painter.text(place, align, text, font.clone(), colour);
    };
    corner(Align2::LEFT_TOP, format!("{} m", metres(high, digits)));
    corner(Align2::LEFT_BOTTOM, format!("{} m", metres(low, digits)));
    if let Some([first, last]) = profile.ends {
        let length = (last - first).truncate().length();
        corner(Align2::RIGHT_BOTTOM, format!("{} m", metres(length, digits - 1)));
    }
    if let (Some(pointer), Some([first, last])) = (response.hover_pos(), profile.ends) {
        let part = f64::from(((pointer.x - rect.left()) / rect.width()).clamp(0.0, 1.0));
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "from 0 to 1 of so many steps"
        )]
        let i = (part * steps as f64).round() as usize;
        if let Some(Some(height)) = profile.heights.get(i) {
            painter.circle_filled(at(i, *height), 3.0, ui.visuals().strong_text_color());
            let along = (last - first).truncate().length() * part;
            let along = metres(along, digits - 1);
            corner(Align2::RIGHT_TOP, format!("{} m after {along} m", metres(*height, digits)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metres_have_the_digits_that_cells_of_a_size_need() {
        let of = |value: f64, cell: f64| metres(value, decimals(cell));
        assert_eq!(
            [of(1234.56, 90.0), of(1234.567, 1.0), of(0.01234, 0.014)],
            ["1234.6", "1234.57", "0.012"]
        );
        assert_eq!([of(-0.04, 90.0), of(-0.05001, 90.0), of(-10.0, 90.0)], ["0.0", "-0.1", "-10.0"]);
    }

    #[test]
    fn degrees_are_written_as_on_maps() {
        assert_eq!(degrees(-9.5, -45.25), "45.250000° S, 9.500000° W");
    }

    #[test]
    fn the_way_over_the_ground_is_longer_than_the_level_one() {
        let ends = Some([DVec3::ZERO, DVec3::new(200.0, 0.0, 0.0)]);
        let of = |heights: Vec<Option<f64>>| Profile { ends, heights, ..Profile::default() }.length();
        assert_eq!(of(vec![Some(5.0); 3]), 200.0);
        // 3, 4, 5: a hundred metres on the level and 75 up.
        assert_eq!(of(vec![Some(0.0), Some(75.0), Some(0.0)]), 250.0);
        assert_eq!(of(vec![Some(0.0), None, Some(75.0)]), 200.0);
        let heights = vec![Some(0.0), Some(75.0), None, None, None];
        assert_eq!(Profile { ends, heights, ..Profile::default() }.unseen(), 150.0);
    }
}

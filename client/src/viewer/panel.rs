//! The panel: what can be chosen, figures, and what was clicked.

use super::address::EXAGGERATIONS;
use super::{Ask, Viewer, bookmarks, measure, time};
use crate::encoding::Encoding;
use crate::render::{Background, Colours, Shading};
use crate::terrain::FrameView;
use diamantina_protocol::message::Kind;
use egui::style::ScrollStyle;
use egui::{
    Align2, Area, Checkbox, Color32, ComboBox, Frame, Panel, RichText, ScrollArea, Slider, Stroke, Ui,
};
use std::collections::VecDeque;

/// Frames that the plots show.
const HISTORY: usize = 240;

/// What has been seen frame by frame.
#[derive(Debug, Default)]
pub(super) struct History {
    milliseconds: VecDeque<f32>,
    errors: VecDeque<f32>,
    kilobytes: VecDeque<f32>,
    bytes: u64,
}

impl History {
    /// `seconds`: since the frame before, if that asked for this one.
    pub(super) fn note(&mut self, seconds: Option<f64>, frame: &FrameView) {
        let bytes = frame.stats.traffic.bytes;
        let kilobytes = bytes.saturating_sub(self.bytes) as f64 / 1e3;
        self.bytes = bytes;
        for (list, value) in [
            (&mut self.milliseconds, seconds.map(|seconds| seconds * 1e3)),
            (&mut self.errors, Some(frame.error_pixels)),
            (&mut self.kilobytes, Some(kilobytes)),
        ] {
            #[allow(clippy::cast_possible_truncation, reason = "for a plot")]
            let Some(value) = value.map(|value| value as f32) else { continue };
            list.push_back(value);
            if list.len() > HISTORY {
                list.pop_front();
            }
        }
    }

    /// Frames a second, over the last ones of half a second together, or the last one.
    pub(super) fn rate(&self) -> Option<f32> {
        let (mut count, mut sum) = (0.0, 0.0);
        for milliseconds in self.milliseconds.iter().rev() {
            count += 1.0;
            sum += milliseconds;
            if sum >= 500.0 {
                break;
            }
        }
        (sum > 0.0).then(|| 1e3 * count / sum)
    }
}

/// Draws the panel, the bar of progress, and the scale of what was clicked.
pub(super) fn show(viewer: &mut Viewer, ui: &mut Ui) {
    progress(viewer, ui);
    if !viewer.panel_is_open {
        let corner = Area::new(ui.scope_id().with("open panel")).anchor(Align2::RIGHT_TOP, [-10.0, 10.0]);
        corner.show(ui.ctx(), |ui| {
            if ui.button("Panel").on_hover_text("Tab").clicked() {
                viewer.open_panel(true);
            }
        });
        return;
    }
    let fill = ui.visuals().panel_fill.gamma_multiply(0.94);
    let frame = Frame::new().fill(fill).inner_margin(10);
    Panel::right("panel").frame(frame).resizable(true).default_size(270.0).show(ui, |ui| {
        // Beside the figures, not over them.
        ui.spacing_mut().scroll = ScrollStyle::solid();
        ScrollArea::vertical().show(ui, |ui| {
            scene(viewer, ui);
            view(viewer, ui);
            light(viewer, ui);
            water(viewer, ui);
            time::show(viewer, ui);
            annotations(viewer, ui);
            heading(ui, "Clicked");
            measure::show(viewer, ui);
            heading(ui, "Bookmarks");
            bookmarks::show(viewer, ui);
            figures(viewer, ui);
            keys(ui);
        });
    });
}

pub(super) fn heading(ui: &mut Ui, text: &str) {
    ui.add_space(8.0);
    ui.label(RichText::new(text).strong());
}

fn scene(viewer: &mut Viewer, ui: &mut Ui) {
    let scene = viewer.terrain.scene();
    let name = scene.name.clone();
    ui.horizontal(|ui| {
        ui.heading(name);
        ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
            if ui.button("Hide").on_hover_text("The panel: Tab").clicked() {
                viewer.open_panel(false);
            }
        });
    });
    let scene = viewer.terrain.scene();
    ui.label(RichText::new(format!("version {}", scene.version)).weak().small());
    // Of a series one step stands for all.
    let position = |name: &str| scene.layers.iter().position(|layer| scene.chosen_as(&layer.name) == name);
    let named = |name: &&str| Some((position(name)?, (*name).to_owned()));
    let choices: Vec<(usize, String)> = scene.choices().iter().filter_map(named).collect();
    for (number, name) in choices {
        let mut shown = viewer.terrain.is_shown(number);
        if ui.checkbox(&mut shown, name).on_hover_text("What is hidden is not fetched").changed() {
            viewer.terrain.set_shown(number, shown);
        }
    }
    ui.horizontal(|ui| {
        if ui.button("Home").on_hover_text("H").clicked() {
            viewer.go_home();
        }
        if ui.button("North up").on_hover_text("N").clicked() {
            viewer.north_up();
        }
        if ui.button("Whole scene").on_hover_text("F").clicked() {
            viewer.frame_scene();
        }
    });
    ui.horizontal(|ui| {
        if ui.button("Save picture").on_hover_text("P").clicked() {
            viewer.ask_screenshot();
        }
        if ui.button("Copy view").on_hover_text("Ctrl+C: its address, to be opened again").clicked() {
            viewer.asks.push(Ask::Copy(viewer.address()));
        }
    });
}

fn view(viewer: &mut Viewer, ui: &mut Ui) {
    heading(ui, "View");
    let mut pixels = viewer.terrain.tolerance_pixels();
    if ui.add(Slider::new(&mut pixels, 0.25..=32.0).logarithmic(true).text("error [px]")).changed() {
        viewer.terrain.set_tolerance_pixels(pixels);
    }
    let mut is_true = viewer.is_true();
    let told = "Nothing but what was measured: no sky, haze, waves, mirrors, motions or exaggeration; colours of the ramp alone";
    if ui.checkbox(&mut is_true, "true").on_hover_text(told).changed() {
        viewer.set_true(is_true);
    }
    let mut exaggeration = viewer.look.exaggeration;
    let slider = Slider::new(&mut exaggeration, EXAGGERATIONS).logarithmic(true).text("exaggeration");
    if ui.add_enabled(!is_true, slider).changed() {
        viewer.set_exaggeration(exaggeration);
    }
    streaming(viewer, ui);
    imagery(viewer, ui);
    let name = |colours: Colours| match colours {
        Colours::Auto => "as the heights suggest",
        Colours::Terrain => "terrain",
        Colours::Bathymetry => "terrain and sea",
        Colours::Grey => "grey by height",
        Colours::Batlow => "batlow by height",
        Colours::Viridis => "viridis by height",
        Colours::Magma => "magma by height",
        Colours::Slope => "slope",
        Colours::Flat => "none: light alone",
    };
    ComboBox::from_label("colours").selected_text(name(viewer.look.colours)).show_ui(ui, |ui| {
        for colours in Colours::ALL {
            ui.selectable_value(&mut viewer.look.colours, colours, name(colours));
        }
    });
    let name = |shading: Shading| match shading {
        Shading::Soft => "sun and sky",
        Shading::Hillshade => "hillshade",
        Shading::Unlit => "none: colours to be read",
    };
    ComboBox::from_label("shading").selected_text(name(viewer.look.shading)).show_ui(ui, |ui| {
        for shading in [Shading::Soft, Shading::Hillshade, Shading::Unlit] {
            if shading != Shading::Soft || !is_true {
                ui.selectable_value(&mut viewer.look.shading, shading, name(shading));
            }
        }
    });
    ui.checkbox(&mut viewer.look.wireframe, "wireframe");
    ui.add_enabled(!is_true, Checkbox::new(&mut viewer.look.show_levels, "levels as colours"));
    ui.checkbox(&mut viewer.shows_boxes, "bounding boxes");
    let mut is_frozen = viewer.frozen.is_some();
    if ui.checkbox(&mut is_frozen, "freeze what is drawn").changed() {
        viewer.frozen = is_frozen.then(|| viewer.frame.items.clone());
    }
}

/// Which imagery lies on the terrain, where there is any.
fn imagery(viewer: &mut Viewer, ui: &mut Ui) {
    let textures = &viewer.terrain.scene().textures;
    if textures.is_empty() {
        return;
    }
    let names: Vec<String> = textures.iter().map(|texture| texture.name.clone()).collect();
    let before = viewer.terrain.texture();
    let mut chosen = before;
    let text = chosen.map_or("none", |number| &names[number]);
    ComboBox::from_label("imagery").selected_text(text).show_ui(ui, |ui| {
        ui.selectable_value(&mut chosen, None, "none");
        for (number, name) in names.iter().enumerate() {
            ui.selectable_value(&mut chosen, Some(number), name);
        }
    });
    if chosen != before {
        viewer.terrain.set_texture(chosen);
    }
    if chosen.is_some() {
        let look = &mut viewer.look.imagery;
        ui.add(Slider::new(&mut look.opacity, 0.0..=1.0).text("opacity"));
        ui.add(Slider::new(&mut look.light, 0.0..=1.0).text("light on it"));
    }
}

/// How the scene is streamed, where there is a choice.
fn streaming(viewer: &mut Viewer, ui: &mut Ui) {
    let scene = viewer.terrain.scene();
    let is_offered = |encoding: &Encoding| {
        scene.layers.iter().all(|layer| layer.encodings.iter().any(|name| name == encoding.name()))
    };
    let encodings: Vec<Encoding> = [Encoding::Points, Encoding::Tin].into_iter().filter(is_offered).collect();
    let zones: Vec<String> = scene.zones.iter().map(|zone| zone.name.clone()).collect();
    let (encoding, zone) = viewer.terrain.choice();
    let (mut encoding, mut zone) = (encoding, zone.map(str::to_owned));
    let before = (encoding, zone.clone());
    if encodings.len() > 1 {
        let name = |encoding| match encoding {
            Encoding::Points => "points: fewest bytes",
            Encoding::Tin => "tin: fewest triangles",
        };
        ComboBox::from_label("encoding").selected_text(name(encoding)).show_ui(ui, |ui| {
            for one in encodings {
                ui.selectable_value(&mut encoding, one, name(one));
            }
        });
    }
    if !zones.is_empty() {
        let text = zone.clone().unwrap_or_else(|| "none".to_owned());
        ComboBox::from_label("zone").selected_text(text).show_ui(ui, |ui| {
            ui.selectable_value(&mut zone, None, "none");
            for one in zones {
                ui.selectable_value(&mut zone, Some(one.clone()), one);
            }
        });
    }
    if (encoding, zone.clone()) != before {
        viewer.terrain.choose(encoding, zone);
    }
}

/// Only where there is any.
fn water(viewer: &mut Viewer, ui: &mut Ui) {
    if !viewer.terrain.scene().layers.iter().any(|layer| layer.kind == Kind::Water) {
        return;
    }
    heading(ui, "Water");
    let is_true = viewer.is_true();
    let water = &mut viewer.look.water;
    ui.add_enabled(!is_true, Checkbox::new(&mut water.reflecting, "mirrors, and shows its bed"));
    ui.add_enabled_ui(water.reflecting && !is_true, |ui| {
        ui.add(Slider::new(&mut water.waves, 0.0..=3.0).text("waves"));
        let mut clarity = water.clarity.unwrap_or_default();
        let slider = Slider::new(&mut clarity, 0.0..=100.0).logarithmic(true).smallest_positive(0.01);
        if ui
            .add(slider.text("clear to [m]"))
            .on_hover_text("A third of the light comes down so deep; 0: as fits the depths")
            .changed()
        {
            water.clarity = (clarity > 0.0).then_some(clarity);
        }
    });
}

/// What is written over the picture, and over those that are saved.
fn annotations(viewer: &mut Viewer, ui: &mut Ui) {
    heading(ui, "Written over the picture");
    let annotations = &mut viewer.look.annotations;
    ui.checkbox(&mut annotations.scale_bar, "scale bar").on_hover_text("As long as it is at the cross");
    ui.checkbox(&mut annotations.north_arrow, "north arrow").on_hover_text("As it lies on the level there");
    ui.checkbox(&mut annotations.legend, "legend");
}

fn light(viewer: &mut Viewer, ui: &mut Ui) {
    heading(ui, "Light");
    let is_true = viewer.is_true();
    let sun = &mut viewer.look.sun;
    ui.add(Slider::new(&mut sun.azimuth_degrees, 0.0..=360.0).text("sun from [°]"));
    ui.add(Slider::new(&mut sun.altitude_degrees, 0.0..=90.0).text("sun above [°]"));
    ui.add_enabled(!is_true, Slider::new(&mut viewer.look.haze, 0.0..=4.0).text("haze"));
    let mut has_sky = viewer.look.background == Background::Sky;
    if ui.add_enabled(!is_true, Checkbox::new(&mut has_sky, "sky")).changed() {
        viewer.look.background =
            if has_sky { Background::Sky } else { Background::Colour([0.003, 0.003, 0.004, 1.0]) };
    }
}

fn figures(viewer: &Viewer, ui: &mut Ui) {
    heading(ui, "Figures");
    let frame = &viewer.frame;
    let stats = &frame.stats;
    let mut row = |name: &str, value: String| {
        ui.horizontal(|ui| {
            ui.label(RichText::new(name).weak());
            ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| ui.monospace(value));
        });
    };
    let rate = viewer.history.rate();
    row(
        "frames a second",
        rate.map_or("-".to_owned(), |rate| format!("{rate:.*}", usize::from(rate < 10.0))),
    );
    row("largest error", format!("{:.2} px", frame.error_pixels));
    row("triangles", grouped(viewer.drawn.triangles));
    row("diamonds drawn", grouped(frame.items.len() as u64));
    row("diamonds resident", grouped(stats.resident as u64));
    row("received", format!("{:.2} MB", stats.traffic.bytes as f64 / 1e6));
    row("requests", format!("{} in {} round trips", stats.traffic.requests, stats.traffic.round_trips));
    let [resident, budget] = [stats.resident_bytes, stats.budget_bytes].map(|b| b as f64 / 1e6);
    row("memory", format!("{resident:.0} of {budget:.0} MB"));
    let share = stats.asked.found_share();
    row("found in memory", share.map_or("-".to_owned(), |share| format!("{:.0} %", 100.0 * share)));
    if !viewer.terrain.scene().series.is_empty() {
        row("steps fetched ahead", stats.steps_ahead.to_string());
    }
    if stats.texture_tiles > 0 {
        row("imagery", format!("{} tiles, {:.0} MB", stats.texture_tiles, stats.texture_bytes as f64 / 1e6));
    }
    let graphics = [viewer.drawn.total_bytes(), viewer.terrain.gpu_budget()];
    let [taken, budget] = graphics.map(|b| b as f64 / 1e6);
    row("graphics memory", format!("{taken:.0} of {budget:.0} MB"));
    if stats.traffic.disk_blobs > 0 {
        row("fetched before", format!("{:.2} MB", stats.traffic.disk_bytes as f64 / 1e6));
    }
    let history = &viewer.history;
    plot(ui, "ms a frame", &history.milliseconds);
    plot(ui, "error [px]", &history.errors);
    plot(ui, "kB a frame", &history.kilobytes);
    let warning = Color32::from_rgb(220, 120, 60);
    if let Some(reason) = viewer.terrain.offline() {
        ui.colored_label(warning, "Offline: what was fetched before.").on_hover_text(reason);
    } else if let Some(problem) = viewer.terrain.problem() {
        ui.colored_label(warning, problem);
    }
    if graphics[0] > graphics[1] {
        ui.colored_label(
            warning,
            "A window of this size needs more graphics memory than --gpu-memory gives.",
        );
    } else if frame.limited {
        ui.colored_label(warning, "There is no memory for less error.");
    }
    if viewer.terrain.scene_changed() {
        ui.colored_label(
            Color32::from_rgb(220, 120, 60),
            "The server has another version, which is being loaded.",
        );
    }
}

/// A number with a space at each three digits.
fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(' ');
        }
        text.push(digit);
    }
    text
}

/// The top of a plot's scale: what nine of ten values are below, and a quarter more. A few that are far larger, as errors
/// are until the first data are there, would press all others flat; they leave the plot at its top.
pub(super) fn top(values: &VecDeque<f32>) -> f32 {
    let mut known: Vec<f32> = values.iter().copied().filter(|v| v.is_finite()).collect();
    known.sort_unstable_by(f32::total_cmp);
    let most = known.last().copied().unwrap_or(0.0);
    let usual = known.get(known.len() * 9 / 10).copied().unwrap_or(0.0);
    if usual > 0.0 { most.min(1.25 * usual) } else { most }
}

/// Values over time, the newest at the right.
fn plot(ui: &mut Ui, name: &str, values: &VecDeque<f32>) {
    let size = egui::vec2(ui.available_width(), 34.0);
    let (rect, _) = ui.allocate_exact_size(size, egui::Sense::hover());
    let painter = ui.painter_at(rect);
    painter.rect_filled(rect, 3.0, ui.visuals().extreme_bg_color);
    let top = top(values);
    let points: Vec<egui::Pos2> = values
        .iter()
        .enumerate()
        .filter(|(_, v)| v.is_finite())
        .map(|(i, v)| {
            let x = rect.right() - (values.len() - 1 - i) as f32 / HISTORY as f32 * rect.width();
            egui::pos2(x, rect.bottom() - 2.0 - (v / top.max(1e-6)).min(1.0) * (rect.height() - 6.0))
        })
        .collect();
    painter.line(points, Stroke::new(1.2, ui.visuals().hyperlink_color));
    let text = format!("{name}, up to {top:.1}");
    let font = egui::FontId::proportional(10.0);
    painter.text(
        rect.left_top() + egui::vec2(4.0, 2.0),
        egui::Align2::LEFT_TOP,
        text,
        font,
        ui.visuals().weak_text_color(),
    );
}

fn keys(ui: &mut Ui) {
    heading(ui, "Keys and mouse");
    for (what, does) in [
        ("drag", "moves the ground"),
        ("Ctrl, right or middle drag", "turns around it"),
        ("wheel, or two fingers", "goes to the cursor; fingers turn and tilt, too"),
        ("double click", "flies there"),
        ("W A S D, Q E", "fly (Shift: faster)"),
        ("arrows", "look around"),
        ("H, N, F", "home, north, whole scene"),
        ("P, Tab, Esc", "picture, panel, clear"),
        ("Space", "plays water in time, and stops it"),
        if cfg!(target_arch = "wasm32") {
            ("Ctrl+C", "copies the view")
        } else {
            ("Ctrl+C, Ctrl+Q", "copy the view, quit")
        },
    ] {
        ui.horizontal_wrapped(|ui| {
            ui.label(RichText::new(what).small().strong());
            ui.label(RichText::new(does).small().weak());
        });
    }
}

/// A thin line at the bottom while data arrives, and what there is to say.
fn progress(viewer: &Viewer, ui: &mut Ui) {
    let frame = &viewer.frame;
    let rect = ui.max_rect();
    let painter = ui.painter();
    let mut text = viewer.message.as_ref().map(|message| message.text.clone());
    if !frame.complete {
        let goal = frame.error_pixels_goal.max(viewer.terrain.tolerance_pixels());
        // By the order of size of what is still wrong.
        let part = if frame.error_pixels.is_finite() {
            1.0 / (1.0 + (frame.error_pixels / goal).max(1.0).log2())
        } else {
            0.02
        };
        #[allow(clippy::cast_possible_truncation, reason = "a part of a line")]
        let width = rect.width() * part as f32;
        let line = egui::Rect::from_min_max(
            rect.left_bottom() - egui::vec2(0.0, 3.0),
            egui::pos2(rect.left() + width, rect.bottom()),
        );
        painter.rect_filled(line, 0.0, Color32::from_rgb(80, 150, 230));
        let error = if frame.error_pixels.is_finite() {
            format!("error {:.1} px", frame.error_pixels)
        } else {
            "waiting for the first data".to_owned()
        };
        text = Some(text.map_or(error.clone(), |text| format!("{text}    {error}")));
    }
    if let Some(text) = text {
        let at = rect.left_bottom() + egui::vec2(10.0, -10.0);
        let font = egui::FontId::proportional(13.0);
        for (by, colour) in [(1.0, Color32::from_black_alpha(180)), (0.0, Color32::WHITE)] {
            let at = at + egui::vec2(by, by);
            painter.text(at, egui::Align2::LEFT_BOTTOM, &text, font.clone(), colour);
        }
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn numbers_are_grouped_by_three_digits() {
        for (number, text) in [(0, "0"), (999, "999"), (1000, "1 000"), (1_234_567, "1 234 567")] {
            assert_eq!(super::grouped(number), text);
        }
    }
}

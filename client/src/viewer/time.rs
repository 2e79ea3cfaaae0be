//! Water that changes with time, in the viewer: a slider, and a clock that plays.

use super::Viewer;
use super::panel::heading;
use crate::player::{self, SPEED};
use egui::{Button, RichText, Slider, Ui};

/// The panel's part; only where there is a series.
pub(super) fn show(viewer: &mut Viewer, ui: &mut Ui) {
    let series = &viewer.terrain.scene().series;
    if series.is_empty() {
        return;
    }
    heading(ui, "Water in time");
    let last = player::last(series);
    let player = &mut viewer.player;
    ui.horizontal(|ui| {
        let (name, told) = if player.plays { ("Pause", "Space: stops") } else { ("Play", "Space: goes on") };
        if ui.add_enabled(last > 0.0, Button::new(name)).on_hover_text(told).clicked() {
            player.switch(series);
        }
        for (text, told, by) in [("-1", "the step before", -1.0), ("+1", "the next step", 1.0)] {
            if ui.small_button(text).on_hover_text(told).clicked() {
                player.plays = false;
                player.set(beside(player.seconds, series, by), series);
            }
        }
        ui.checkbox(&mut player.is_round, "loop").on_hover_text("From the last step to the first, and on");
    });
    let mut seconds = player.seconds;
    let slider = Slider::new(&mut seconds, 0.0..=last).text("time [s]");
    if ui.add_enabled(last > 0.0, slider).changed() {
        player.set(seconds, series);
    }
    let speed = Slider::new(&mut player.speed, SPEED).logarithmic(true).text("speed");
    ui.add(speed).on_hover_text("Seconds of the series in one of yours");
    for (number, one) in series.iter().enumerate() {
        let (at, steps) = (one.step_at(viewer.player.seconds), one.layers.len());
        let words = match viewer.terrain.step_drawn(number) {
            Some(drawn) if drawn == at => format!("{}: step {at} of 0 to {}", one.name, steps - 1),
            Some(drawn) => format!("{}: step {drawn} until {at} is there", one.name),
            None => format!("{}: waiting for step {at}", one.name),
        };
        ui.label(RichText::new(words).weak());
    }
    if viewer.player.waits {
        ui.label(RichText::new("time waits for data").weak());
    }
}

/// The time at which the step before or after begins, of the series with the shortest steps.
fn beside(seconds: f64, series: &[diamantina_protocol::series::Series], by: f64) -> f64 {
    let shortest = series.iter().min_by(|a, b| a.step_seconds.total_cmp(&b.step_seconds));
    shortest.map_or(0.0, |one| {
        let step = one.step_at(seconds) as f64 + by;
        step.max(0.0) * one.step_seconds
    })
}

impl Viewer {
    /// The time of the scene's series, in seconds, and whether it runs.
    #[must_use]
    pub fn player(&self) -> &player::Player {
        &self.player
    }

    /// Runs the time of the scene's series, or stops it.
    pub(super) fn play(&mut self) {
        self.player.switch(&self.terrain.scene().series);
    }

    /// Lets time go on.
    pub(super) fn pass(&mut self, seconds: f64) {
        let (terrain, player) = (&mut self.terrain, &mut self.player);
        player.go_on(seconds, &terrain.scene().series, |at| terrain.is_ready_at(at));
        terrain.set_time(player.seconds, player.course());
    }
}

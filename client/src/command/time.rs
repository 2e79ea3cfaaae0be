//! What the command line says of water that changes with time.

use super::Failure;
use clap::Args;
use diamantina_client::headless::Play;
use diamantina_client::player;
use diamantina_client::terrain::Terrain;

#[derive(Args, Clone)]
pub(super) struct TimeArgs {
    /// The time to show of water that changes with time, in seconds from its first step [default: 0]
    #[arg(long, value_name = "SECONDS")]
    time: Option<f64>,
}

#[derive(Args, Clone)]
pub(super) struct PlayArgs {
    /// Let water change with time on the way: seconds of it for a second of the path, below 0 for backwards
    #[arg(long, default_value_t = 0.0, value_name = "SPEED")]
    play: f64,
    /// Begin again after the last step; else it stays
    #[arg(long = "loop", requires = "play")]
    is_round: bool,
}

impl TimeArgs {
    /// The time at which a scene begins; checked with [`TimeArgs::check`] once the scene is there.
    pub(super) fn seconds(&self) -> f64 {
        self.time.unwrap_or(0.0)
    }

    /// Refuses a time that the scene has not.
    pub(super) fn check(&self, terrain: &Terrain) -> Result<(), Failure> {
        let Some(time) = self.time else { return Ok(()) };
        let scene = terrain.scene();
        let length = player::length(&scene.series);
        if scene.series.is_empty() {
            let name = &scene.name;
            return Err(Failure(
                2,
                format!(
                    "--time {time}: scene '{name}' has no water that changes with time: leave --time out"
                ),
            ));
        }
        if !(0.0..=length).contains(&time) {
            return Err(Failure(
                2,
                format!("--time {time}: expected seconds from 0 to {length}, when the last step ends"),
            ));
        }
        Ok(())
    }
}

impl PlayArgs {
    /// How time goes on a flight.
    pub(super) fn play(&self) -> Result<Play, Failure> {
        if !self.play.is_finite() {
            return Err(Failure(2, format!("--play {}: expected a number, such as 1 or -0.5", self.play)));
        }
        Ok(Play { speed: self.play, is_round: self.is_round })
    }
}

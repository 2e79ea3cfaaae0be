//! A surface at several times: a step is a layer of its own, with its own index and payloads.
//!
//! So each step is fetched, kept and drawn as any layer is, and nothing else of the protocol knows of time. A series
//! only says which layers are the steps of one surface, and when each begins. Step 0 begins at 0 seconds.

use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

/// What [`Series::step_seconds`] may be.
pub const STEP_SECONDS: RangeInclusive<f64> = 1e-6..=1e9;

/// A part of a step: a time that is nearer than this to the beginning of one belongs to it, however it was computed.
const ROUNDING: f64 = 1e-6;

/// A surface at several times.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Series {
    /// What it is called. No layer of the scene has this name.
    pub name: String,
    /// The names of its layers, a step each, the earliest first.
    pub layers: Vec<String>,
    /// Seconds from the beginning of a step to that of the next.
    pub step_seconds: f64,
}

/// Why a list of series is none of a scene.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SeriesError {
    /// The name of a layer, or of another series.
    #[error("series '{0}' has the name of a layer or of another series: expected a name of its own")]
    Name(String),
    /// Without any step.
    #[error("series '{0}' has no steps, expected 1 at least")]
    Empty(String),
    /// A step that is no layer of water, or is a step already.
    #[error("series '{series}': step '{layer}' {found}, expected a layer of water of its own")]
    Step {
        /// The series.
        series: String,
        /// The step.
        layer: String,
        /// What it is instead.
        found: &'static str,
    },
    /// No time.
    #[error(
        "series '{series}' has steps of {found} s, expected {} to {} s",
        STEP_SECONDS.start(),
        STEP_SECONDS.end()
    )]
    Seconds {
        /// The series.
        series: String,
        /// The seconds found, in words.
        found: String,
    },
}

impl Series {
    /// The step at a time in seconds: the last that has begun, or the first before any has.
    #[must_use]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates, and is clamped")]
    pub fn step_at(&self, seconds: f64) -> usize {
        ((seconds / self.step_seconds + ROUNDING).floor() as usize).min(self.last())
    }

    /// The time in seconds at which a step begins.
    #[must_use]
    pub fn begins(&self, step: usize) -> f64 {
        step as f64 * self.step_seconds
    }

    /// The last step.
    #[must_use]
    pub fn last(&self) -> usize {
        self.layers.len().saturating_sub(1)
    }

    /// Of each series the positions of its steps among the layers of a scene, of which each is told by its name and by
    /// whether it is water. They may come from anywhere.
    ///
    /// # Errors
    /// When these series are none of such a scene.
    pub fn positions<'a>(
        all: &[Self],
        layers: impl Iterator<Item = (&'a str, bool)>,
    ) -> Result<Vec<Vec<usize>>, SeriesError> {
        let layers: Vec<(&str, bool)> = layers.collect();
        let mut is_step = vec![false; layers.len()];
        let mut positions = Vec::with_capacity(all.len());
        for (number, series) in all.iter().enumerate() {
            let is_layer = layers.iter().any(|(name, _)| *name == series.name);
            if is_layer || all[..number].iter().any(|other| other.name == series.name) {
                return Err(SeriesError::Name(series.name.clone()));
            }
            if series.layers.is_empty() {
                return Err(SeriesError::Empty(series.name.clone()));
            }
            if !STEP_SECONDS.contains(&series.step_seconds) {
                let (series, found) = (series.name.clone(), series.step_seconds.to_string());
                return Err(SeriesError::Seconds { series, found });
            }
            let mut steps = Vec::new();
            for step in &series.layers {
                let wrong =
                    |found| SeriesError::Step { series: series.name.clone(), layer: step.clone(), found };
                let at = layers.iter().position(|(name, _)| name == step);
                let at = at.ok_or_else(|| wrong("is no layer of the scene"))?;
                if !layers[at].1 {
                    return Err(wrong("is ground"));
                }
                if std::mem::replace(&mut is_step[at], true) {
                    return Err(wrong("is a step already"));
                }
                steps.push(at);
            }
            positions.push(steps);
        }
        Ok(positions)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn series(name: &str, layers: &[&str], step_seconds: f64) -> Series {
        Series { name: name.into(), layers: layers.iter().map(|&l| l.into()).collect(), step_seconds }
    }

    proptest! {
        #[test]
        fn a_step_lasts_from_its_beginning_to_the_next(
            count in 1usize..300, step_seconds in 1e-3f64..1e5, at in 0usize..300, part in 0.0f64..0.999,
        ) {
            let series = Series { name: "sea".into(), layers: vec!["x".into(); count], step_seconds };
            let at = at.min(series.last());
            prop_assert_eq!(series.step_at(series.begins(at)), at);
            prop_assert_eq!(series.step_at(series.begins(at) + part * step_seconds), at);
        }
    }

    #[test]
    fn times_before_and_after_all_steps_are_the_first_and_the_last() {
        let sea = series("sea", &["sea.0", "sea.1", "sea.2"], 0.1);
        for (seconds, step) in [(-1.0, 0), (0.0, 0), (0.1, 1), (0.3, 2), (0.2, 2), (1e300, 2), (f64::NAN, 0)]
        {
            assert_eq!(sea.step_at(seconds), step, "{seconds}");
        }
        // 3 x 0.1 is a little more than 0.3.
        let long = series("sea", &["x"; 8], 0.1);
        assert_eq!((long.step_at(0.3), long.step_at(0.7)), (3, 7));
    }

    #[test]
    fn what_is_no_series_of_a_scene_is_named() {
        let layers = [("terrain", false), ("sea.0", true), ("sea.1", true), ("pond", true)];
        let found = |all: &[Series]| Series::positions(all, layers.into_iter());
        let sea = series("sea", &["sea.1", "sea.0"], 2.0);
        assert_eq!(found(&[]), Ok(vec![]));
        assert_eq!(found(&[sea.clone(), series("lake", &["pond"], 1.0)]), Ok(vec![vec![2, 1], vec![3]]));
        for (wrong, word) in [
            (vec![series("pond", &["sea.0"], 1.0)], "'pond' has the name of a layer"),
            (vec![sea.clone(), series("sea", &["pond"], 1.0)], "of another series"),
            (vec![series("sea", &[], 1.0)], "no steps"),
            (vec![series("sea", &["sea.2"], 1.0)], "'sea.2' is no layer"),
            (vec![series("sea", &["terrain"], 1.0)], "is ground"),
            (vec![series("sea", &["sea.0", "sea.0"], 1.0)], "is a step already"),
            (vec![sea, series("lake", &["sea.0"], 1.0)], "is a step already"),
            (vec![series("sea", &["sea.0"], 0.0)], "steps of 0 s"),
            (vec![series("sea", &["sea.0"], f64::NAN)], "NaN"),
            (vec![series("sea", &["sea.0"], f64::INFINITY)], "steps of inf s"),
        ] {
            let error = found(&wrong).unwrap_err().to_string();
            assert!(error.contains(word), "{wrong:?}: {error}");
        }
    }
}

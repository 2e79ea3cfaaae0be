//! How large an error of heights looks: a bound that sender and receiver share.
//!
//! The plain measure takes an error for a sphere: as large as it looks from the nearest point of a box,
//! whatever the direction. But what errs is a height, and a point that moves up or down does not move on the
//! screen for an eye that looks along the vertical. The trick is a bound that knows it, over a whole box:
//!
//! ```text
//!    eye +--------- r ---------+         An eye t above a point, r away from it on the ground, sees the
//!        |                     |         point's height change by dt as an angle of r dt / (r^2 + t^2).
//!        t                     :         Where t may be anything from t0 on and r from r0 to r1, that is
//!        |                     :         most at t = t0 and r = t0, or at the end of r0..r1 nearest to it.
//!        +---------------------* dt
//! ```
//!
//! Heights err by at most `error`, so t0 is the eye's distance, along the vertical, from the box with `error`
//! added above and below: all of the way of a point from the drawn height to the true one lies in it, and the
//! angle is the integral of what is bounded here.

use crate::bintree::Forest;

/// The largest angle, in radians, by which a point of the box from `low` to `high` moves as seen from `eye` when
/// its height changes by at most `error`, all in metres; infinite where the eye may be as near as that.
#[must_use]
pub fn vertical_angle(eye: [f64; 3], error: f64, low: [f64; 3], high: [f64; 3]) -> f64 {
    let above = (low[2] - error - eye[2]).max(eye[2] - high[2] - error).max(0.0);
    let nearest = [0, 1].map(|i| (low[i] - eye[i]).max(eye[i] - high[i]).max(0.0));
    let farthest = [0, 1].map(|i| (low[i] - eye[i]).abs().max((high[i] - eye[i]).abs()));
    let away = above.clamp(nearest[0].hypot(nearest[1]), farthest[0].hypot(farthest[1]));
    let squares = away * away + above * above;
    if squares > 0.0 { error * away / squares } else { f64::INFINITY }
}

/// Whether a declared error, of what triangles of a level draw, is of heights alone, and so are all below it: where
/// outlines differ an error holds the length of a hypotenuse, and the least is that of the finest level. `cell`: metres
/// of a lattice step along x and y.
///
/// The same length for all levels, so that what is split never looks worse than before: its children's errors are
/// no larger, and so of heights, too.
#[must_use]
pub fn is_vertical(forest: &Forest, level: u32, error_metres: f32, cell: [f64; 2]) -> bool {
    level >= forest.levels() || f64::from(error_metres) < forest.hypotenuse(forest.levels(), cell)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The angle between the directions to two points.
    fn between(eye: [f64; 3], a: [f64; 3], b: [f64; 3]) -> f64 {
        let [u, v] = [a, b].map(|p| [0, 1, 2].map(|i| p[i] - eye[i]));
        let dot: f64 = (0..3).map(|i| u[i] * v[i]).sum();
        let cross = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        cross.iter().map(|c| c * c).sum::<f64>().sqrt().atan2(dot)
    }

    proptest! {
        /// No point of the box that is drawn too high or too low by the error, or less, is seen farther from its
        /// true place than the bound says.
        #[test]
        fn no_vertical_error_looks_larger_than_its_bound(
            low in prop::array::uniform3(-1e3..1e3f64),
            size in prop::array::uniform3(0.0..800.0f64),
            eye in prop::array::uniform3(-3e3..3e3f64),
            is_above in any::<bool>(),
            error in 0.0..200.0f64,
            at in prop::array::uniform3(0.0..=1.0f64),
            part in -1.0..=1.0f64,
        ) {
            let high = [0, 1, 2].map(|i| low[i] + size[i]);
            let truth = [0, 1, 2].map(|i| low[i] + size[i] * at[i]);
            // Straight above or below some point of it the bound differs most from the sphere's.
            let eye = if is_above { [truth[0], truth[1], eye[2]] } else { eye };
            let drawn = [truth[0], truth[1], truth[2] + error * part];
            let (seen, bound) = (between(eye, truth, drawn), vertical_angle(eye, error, low, high));
            prop_assert!(seen <= bound * (1.0 + 1e-9) + 1e-9, "{} > {}", seen, bound);
        }
    }

    #[test]
    fn an_error_below_a_hypotenuse_is_of_heights() {
        let forest = Forest::covering(1025, 1025, 6).unwrap();
        let least = forest.hypotenuse(forest.levels(), [30.0, 20.0]);
        assert!((0..forest.levels()).all(|level| forest.hypotenuse(level, [30.0, 20.0]) >= least));
        #[allow(clippy::cast_possible_truncation, reason = "metres")]
        let of = |metres: f64| is_vertical(&forest, 3, metres as f32, [30.0, 20.0]);
        assert!(of(least * 0.999) && !of(least * 1.001));
        assert!(is_vertical(&forest, forest.levels(), f32::MAX, [30.0, 20.0]), "there are no finer outlines");
    }
}

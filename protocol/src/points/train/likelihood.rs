//! Weights under which the numbers seen are likeliest, and so cost the fewest bits.
//!
//! Least squares ask for the smallest mean square of what is missing, which the few far off decide. What a
//! number costs is the logarithm of its share. So the weights are moved on from where least squares leave
//! them, by damped Gauss-Newton steps (Levenberg 1944, Marquardt 1963; the sum of the squares of the gradients
//! stands for the second derivatives, as Berndt, Hall, Hall and Hausman 1974 do), to the maximum of the
//! likelihood of what was seen. The distribution of what is missing is taken as a logistic one whose place
//! and spread are both weighted sums of what the neighbours say.
//!
//! Exponentials and logarithms are `libm`'s: those of the system may differ from machine to machine, and a
//! source is to give the same store on all.

use super::fit::Fit;

/// How many numbers are looked at for one set of weights: with more of them the weights hardly change.
pub(super) const SEEN: usize = 6_000;
const STEPS: usize = 10;
/// As many of the numbers that say something as the first weights count for. With all numbers instead, of ground
/// that is nearly flat the few that are not zero decide alone: then stores of it grew by up to a sixth.
const PRIOR_SAMPLES: f64 = 20.0;
/// Steps end where a number becomes cheaper by less than this, in nats.
const GAIN_LEAST: f64 = 1e-5;
/// Below, a logistic distribution is the exponential of its argument to a double's last digit.
const TAIL: f64 = -40.0;
/// The smallest spread, in steps of the numbers.
const SPREAD_LEAST: f64 = 0.04;
/// How many times a logistic distribution's spread the mean distance from its middle is: 2 ln 2.
pub(super) const MEAN_TO_SPREAD: f64 = 2.0 * std::f64::consts::LN_2;

/// A number seen.
pub(super) struct Seen<const N: usize> {
    /// What the weights multiply, in steps.
    pub(super) parts: [f64; N],
    /// What it stands for, in steps.
    pub(super) interval: [f64; 2],
    /// How many like it there were.
    pub(super) weight: f64,
}

/// What was seen for one set of weights; the first `places` of them give the place, all others the spread.
pub(super) struct Likelihood<const N: usize> {
    pub(super) places: usize,
    /// The ends of all that is possible, if there are any.
    pub(super) possible: Option<[f64; 2]>,
    pub(super) seen: Vec<Seen<N>>,
}

impl<const N: usize> Likelihood<N> {
    /// The likeliest weights near `start`.
    pub(super) fn likeliest(&self, start: [f64; N]) -> [f64; N] {
        let all: f64 = self.seen.iter().map(|seen| seen.weight).sum();
        if all == 0.0 {
            return start;
        }
        let (mut weights, mut damping) = (start, 1e-3);
        let (mut best, mut fit) = self.cost(&weights);
        let prior = PRIOR_SAMPLES / self.telling(&weights);
        let pulls = fit.diagonal().map(|square| square * prior);
        pulls.iter().enumerate().for_each(|(i, pull)| fit.pull(i, *pull, 0.0));
        for _ in 0..STEPS {
            let Some(step) = fit.clone().solve_damped(damping) else { break };
            let tried = std::array::from_fn(|i| weights[i] - step[i]);
            let (mut cost, mut next) = self.cost(&tried);
            for (i, pull) in pulls.into_iter().enumerate() {
                let away = tried[i] - start[i];
                cost += 0.5 * pull * away * away;
                next.pull(i, pull, pull * away);
            }
            if cost < best {
                let gain = best - cost;
                (weights, best, fit) = (tried, cost, next);
                damping = (damping * 0.3).max(1e-6);
                if gain < GAIN_LEAST * all {
                    break;
                }
            } else {
                damping *= 8.0;
            }
        }
        weights
    }

    /// How many numbers say something of where their places are: the square of the sum of what they say, by the sum of
    /// its squares.
    fn telling(&self, weights: &[f64; N]) -> f64 {
        let (mut sum, mut squares) = (0.0, 0.0);
        for Seen { parts, interval, weight } in &self.seen {
            let place = product(&weights[..self.places], &parts[..self.places]);
            let spread = product(&weights[self.places..], &parts[self.places..]).max(SPREAD_LEAST);
            let own = Share::of(*interval, place, spread).gradient[0];
            let all = self.possible.map_or(0.0, |possible| Share::of(possible, place, spread).gradient[0]);
            let told = (all - own) * (all - own);
            sum += weight * told;
            squares += weight * told * told;
        }
        (sum * sum / squares.max(1e-300)).max(1.0)
    }

    /// What all numbers cost, in nats, and its first and second derivatives.
    fn cost(&self, weights: &[f64; N]) -> (f64, Fit<N>) {
        let (mut sum, mut fit) = (0.0, Fit::new());
        for Seen { parts, interval, weight } in &self.seen {
            let place = product(&weights[..self.places], &parts[..self.places]);
            let spread = product(&weights[self.places..], &parts[self.places..]);
            let is_least = spread <= SPREAD_LEAST;
            let spread = spread.max(SPREAD_LEAST);
            let own = Share::of(*interval, place, spread);
            let (mut nats, [mut by_place, mut by_spread]) = (-own.log, own.gradient.map(|g| -g));
            if let Some(possible) = self.possible {
                let all = Share::of(possible, place, spread);
                nats += all.log;
                by_place += all.gradient[0];
                by_spread += all.gradient[1];
            }
            // At the smallest spread only growing counts.
            if is_least {
                by_spread = by_spread.min(0.0);
            }
            let gradient =
                std::array::from_fn(|i| parts[i] * if i < self.places { by_place } else { by_spread });
            fit.add(&gradient, 1.0, *weight);
            sum += weight * nats;
        }
        (sum, fit)
    }
}

pub(super) fn product(weights: &[f64], parts: &[f64]) -> f64 {
    weights.iter().zip(parts).map(|(w, p)| w * p).sum()
}

/// The logarithm of the share of an interval, and its derivatives by the place and by the spread.
struct Share {
    log: f64,
    gradient: [f64; 2],
}

impl Share {
    fn of(interval: [f64; 2], place: f64, spread: f64) -> Self {
        let mut ends = interval.map(|end| (end - place) / spread);
        // Both ends in the lower half, where the distribution's values are small and their difference exact.
        let is_mirrored = ends[0] + ends[1] > 0.0;
        if is_mirrored {
            ends = [-ends[1], -ends[0]];
        }
        let [below, above] = ends;
        // The logarithm, and the densities at both ends by the share.
        let (log, densities) = if above < TAIL {
            // The distribution is the exponential there.
            let part = -libm::expm1(below - above);
            (above + libm::log(part), [(1.0 - part) / part, 1.0 / part])
        } else {
            let [f, g] = [below, above].map(|z| 1.0 / (1.0 + libm::exp(-z)));
            (libm::log(g - f), [f * (1.0 - f), g * (1.0 - g)].map(|density| density / (g - f)))
        };
        let by_place = (densities[0] - densities[1]) / spread;
        let by_spread = (densities[0] * below - densities[1] * above) / spread;
        Self { log, gradient: [if is_mirrored { -by_place } else { by_place }, by_spread] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::points::train::sampler::evenly_spread;

    const PLACES: usize = 2;

    /// Numbers that logistic noise makes of these weights' places and spreads; corrections are those of three.
    fn drawn(weights: [f64; 4], are_corrections: bool) -> Likelihood<4> {
        let mut dice = 0;
        let mut roll = || {
            dice += 1;
            evenly_spread(dice).min(1.0 - 1e-9)
        };
        let seen = (0..20_000).map(|_| {
            let parts = [4.0 * roll() - 2.0, 2.0 * roll() - 1.0, 2.0 * roll(), 1.0];
            let f = roll();
            let noise = product(&weights[PLACES..], &parts[PLACES..]) * (f / (1.0 - f)).ln();
            let number = (product(&weights[..PLACES], &parts[..PLACES]) + noise).round();
            Seen { parts, interval: [number - 0.5, number + 0.5], weight: 1.0 }
        });
        let possible = are_corrections.then_some([-1.5, 1.5]);
        let seen =
            seen.filter(|s| possible.is_none_or(|[low, high]| s.interval[0] >= low && s.interval[1] <= high));
        Likelihood { places: PLACES, possible, seen: seen.collect() }
    }

    #[test]
    fn the_weights_that_numbers_were_drawn_by_are_found_again() {
        // Of three numbers, those widely spread are nearly alike whatever their spread is.
        for (weights, are_corrections) in [([0.8, -0.5, 0.6, 0.2], false), ([0.8, -0.5, 0.2, 0.1], true)] {
            let found = drawn(weights, are_corrections).likeliest([0.3, 0.0, 0.3, 0.3]);
            for (found, weight) in found.iter().zip(weights) {
                assert!((found - weight).abs() < 0.05, "{are_corrections}: {found} instead of {weight}");
            }
        }
    }

    #[test]
    fn gradients_are_what_small_changes_make() {
        const H: f64 = 1e-6;
        for interval in [[-0.5, 0.5], [2.5, 3.5], [-9.5, -8.5], [-1.5, 1.5], [998.5, 999.5]] {
            for (place, spread) in [(0.0, 1.0), (0.7, 0.3), (-1.2, 2.0), (70.0, 0.1)] {
                let share = Share::of(interval, place, spread);
                let by = |dp: f64, ds: f64| Share::of(interval, place + dp, spread + ds).log;
                let changes = [by(H, 0.0) - by(-H, 0.0), by(0.0, H) - by(0.0, -H)].map(|d| d / (2.0 * H));
                for (gradient, change) in share.gradient.into_iter().zip(changes) {
                    assert!(
                        (gradient - change).abs() < 1e-5 * (1.0 + change.abs()),
                        "{gradient} for {change}"
                    );
                }
            }
        }
    }

    #[test]
    fn nothing_seen_changes_nothing() {
        let start = [0.5, 0.0, 1.0, 0.2];
        assert_eq!(Likelihood { places: PLACES, possible: None, seen: Vec::new() }.likeliest(start), start);
    }
}

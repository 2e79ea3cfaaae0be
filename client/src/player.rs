//! The clock of a scene's series: it runs, waits for data, and ends or begins again.
//!
//! Pure: how much time has passed is told, and whether a step is there is asked. Time never goes on to a step that is
//! not there yet: it stands at the end of the one before, and all steps are seen, however slow the network is.

use diamantina_protocol::series::Series;

/// Seconds of the series for a second of the viewer's.
pub const SPEED: std::ops::RangeInclusive<f64> = 0.01..=1000.0;

/// Steps that one frame goes on at most. At this many it is no play any more.
const STEPS_MAX: usize = 256;

/// Where time goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Course {
    /// From later to earlier steps.
    pub is_backward: bool,
    /// From the last step to the first, and on.
    pub is_round: bool,
}

/// The clock.
#[derive(Debug, Clone, PartialEq)]
pub struct Player {
    /// The time now, in seconds of the series.
    pub seconds: f64,
    /// Whether it runs.
    pub plays: bool,
    /// Seconds of the series for a second, within [`SPEED`].
    pub speed: f64,
    /// Whether it begins again after the last step.
    pub is_round: bool,
    /// Whether it stands since the next step is not there yet.
    pub waits: bool,
}

impl Player {
    /// A clock that stands at a time.
    #[must_use]
    pub fn at(seconds: f64) -> Self {
        Self { seconds, plays: false, speed: 1.0, is_round: false, waits: false }
    }

    /// Where time goes, if it does.
    #[must_use]
    pub fn course(&self) -> Option<Course> {
        self.plays.then_some(Course { is_backward: false, is_round: self.is_round })
    }

    /// Sets it to a time, within those of the series; running or not.
    pub fn set(&mut self, seconds: f64, series: &[Series]) {
        if seconds.is_finite() {
            self.seconds = seconds.clamp(0.0, last(series));
        }
        self.waits = false;
    }

    /// Runs it, from the beginning if it is at the end, or stops it.
    pub fn switch(&mut self, series: &[Series]) {
        self.plays = !self.plays;
        self.waits = false;
        if self.plays && self.seconds >= last(series) && !self.is_round {
            self.seconds = 0.0;
        }
    }

    /// Goes on for so many seconds of the viewer's. `is_ready` says whether all series have what they show at a time.
    pub fn go_on(&mut self, elapsed: f64, series: &[Series], is_ready: impl Fn(f64) -> bool) {
        self.waits = false;
        if !self.plays || series.is_empty() {
            return;
        }
        let end = if self.is_round { length(series) } else { last(series) };
        let mut goal = self.seconds + elapsed * self.speed;
        for _ in 0..STEPS_MAX {
            let next = next(series, self.seconds).min(end);
            if goal < next {
                self.seconds = goal;
                return;
            }
            let is_end = next >= end;
            let to = if is_end && self.is_round { 0.0 } else { next };
            if !is_ready(to) {
                self.waits = true;
                return;
            }
            self.seconds = to;
            if is_end && !self.is_round {
                self.plays = false;
                return;
            }
            goal -= if is_end { end } else { 0.0 };
        }
    }
}

/// When the last step of all series begins.
#[must_use]
pub fn last(series: &[Series]) -> f64 {
    series.iter().map(|series| series.begins(series.last())).fold(0.0, f64::max)
}

/// When the last step of all series ends: as long after its beginning as any other.
#[must_use]
pub fn length(series: &[Series]) -> f64 {
    series.iter().map(|series| series.begins(series.layers.len())).fold(0.0, f64::max)
}

/// The next time at which a step begins; infinite after the last.
fn next(series: &[Series], seconds: f64) -> f64 {
    let of = |series: &Series| {
        let step = series.step_at(seconds) + 1;
        if step < series.layers.len() { series.begins(step) } else { f64::INFINITY }
    };
    series.iter().map(of).fold(f64::INFINITY, f64::min)
}

/// The time after `elapsed` seconds from `start` on, at a speed that may be below 0: within those of the series, or round
/// and round.
#[must_use]
pub fn time_at(series: &[Series], start: f64, elapsed: f64, speed: f64, is_round: bool) -> f64 {
    let seconds = start + elapsed * speed;
    let length = length(series);
    if is_round && length > 0.0 { seconds.rem_euclid(length) } else { seconds.clamp(0.0, last(series)) }
}

/// The steps that come after one, the next first: at most `count`, and it is not among them.
#[must_use]
pub fn coming(at: usize, steps: usize, course: Course, count: usize) -> Vec<usize> {
    let next = |step: usize| match (course.is_backward, course.is_round) {
        (false, true) => Some((step + 1) % steps.max(1)),
        (false, false) => Some(step + 1).filter(|next| *next < steps),
        (true, true) => Some(step.checked_sub(1).unwrap_or(steps.saturating_sub(1))),
        (true, false) => step.checked_sub(1),
    };
    std::iter::successors(next(at), |step| next(*step)).take_while(|step| *step != at).take(count).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;

    fn series(steps: usize, step_seconds: f64) -> Series {
        Series { name: "sea".into(), layers: vec!["x".into(); steps], step_seconds }
    }

    fn playing(seconds: f64) -> Player {
        Player { plays: true, ..Player::at(seconds) }
    }

    #[test]
    fn time_runs_to_the_end_and_begins_again_where_asked() {
        let sea = [series(4, 10.0)];
        let mut player = Player { speed: 5.0, ..playing(0.0) };
        player.go_on(1.0, &sea, |_| true);
        assert_eq!((player.seconds, player.plays, player.waits), (5.0, true, false));
        player.go_on(4.5, &sea, |_| true);
        assert_eq!(player.seconds, 27.5, "over two borders at once");
        player.go_on(100.0, &sea, |_| true);
        assert_eq!((player.seconds, player.plays), (30.0, false), "the last step begins, and that is all");
        player.switch(&sea);
        assert_eq!((player.seconds, player.plays), (0.0, true), "from the beginning");
        player.is_round = true;
        player.set(38.0, &sea);
        assert_eq!(player.seconds, 30.0);
        player.go_on(1.9, &sea, |_| true);
        assert_eq!(player.seconds, 39.5, "the last step lasts as long as any other");
        player.go_on(0.4, &sea, |_| true);
        assert_eq!((player.seconds, player.plays), (1.5, true));
        assert_eq!(player.course(), Some(Course { is_backward: false, is_round: true }));
        player.switch(&sea);
        player.go_on(1.0, &sea, |_| true);
        assert_eq!((player.seconds, player.course()), (1.5, None));
        // However fast, it ends within a frame.
        player.switch(&sea);
        player.go_on(1e12, &sea, |_| true);
        assert!((0.0..40.0).contains(&player.seconds));
    }

    #[test]
    fn time_waits_at_the_end_of_a_step_until_the_next_is_there() {
        let sea = [series(4, 10.0), series(3, 7.0)];
        let asked = RefCell::new(Vec::new());
        let mut player = playing(6.0);
        let until = |end: f64| {
            let asked = &asked;
            move |seconds: f64| {
                asked.borrow_mut().push(seconds);
                seconds < end
            }
        };
        player.go_on(5.0, &sea, until(10.0));
        assert_eq!((player.seconds, player.waits), (7.0, true), "at the last that is there");
        assert_eq!(asked.take(), [7.0, 10.0], "whichever series goes on");
        for _ in 0..3 {
            player.go_on(2.0, &sea, until(10.0));
            assert!((7.0..10.0).contains(&player.seconds), "{}", player.seconds);
        }
        assert!(player.waits);
        player.go_on(2.0, &sea, until(20.0));
        assert!(!player.waits && player.seconds >= 10.0);
        // The first step again is waited for, too.
        let mut player = Player { is_round: true, ..playing(39.0) };
        player.go_on(2.0, &sea, |seconds| seconds > 0.0);
        assert_eq!((player.seconds, player.waits), (39.0, true));
    }

    #[test]
    fn what_comes_next_follows_the_course() {
        let of = |is_backward, is_round| Course { is_backward, is_round };
        for (at, steps, course, expected) in [
            (0, 5, of(false, false), &[1, 2, 3][..]),
            (3, 5, of(false, false), &[4]),
            (4, 5, of(false, false), &[]),
            (3, 5, of(false, true), &[4, 0, 1]),
            (1, 5, of(true, false), &[0]),
            (1, 5, of(true, true), &[0, 4, 3]),
            (0, 2, of(false, true), &[1]),
            (0, 1, of(false, true), &[]),
        ] {
            assert_eq!(coming(at, steps, course, 3), expected, "{at} of {steps}, {course:?}");
        }
    }

    #[test]
    fn a_flights_time_stays_within_the_series() {
        let sea = [series(4, 10.0)];
        for (start, elapsed, speed, is_round, expected) in [
            (0.0, 3.0, 2.0, false, 6.0),
            (5.0, 100.0, 2.0, false, 30.0),
            (5.0, 100.0, -2.0, false, 0.0),
            (5.0, 20.0, 2.0, true, 5.0),
            (5.0, 5.0, -2.0, true, 35.0),
        ] {
            assert_eq!(time_at(&sea, start, elapsed, speed, is_round), expected);
        }
        assert_eq!((time_at(&[], 0.0, 9.0, 1.0, true), last(&[]), length(&sea)), (0.0, 0.0, 40.0));
    }
}

//! How far something long has come, and whether it should go on: a bar on standard error where that is a
//! terminal, else (with `RUST_LOG=info`) a line every few seconds.

use indicatif::{ProgressBar, ProgressState, ProgressStyle};
use std::io::IsTerminal;
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

/// Between two lines of the log.
const LOG_INTERVAL: Duration = Duration::from_secs(5);

/// How long what is under way may go on once a stop was asked for. The rest of the ten seconds that an
/// interrupt may take is for the disk.
const PATIENCE: Duration = Duration::from_secs(3);

/// The progress of a build, shared by its threads.
#[derive(Debug)]
pub struct Progress {
    stage: Mutex<Stage>,
    /// What of several things the next stages are of.
    of: Mutex<Option<String>>,
    shown: bool,
    /// Whether the log is told.
    told: bool,
    stop: OnceLock<Instant>,
}

#[derive(Debug)]
struct Stage {
    bar: ProgressBar,
    name: String,
    unit: &'static str,
    total: u64,
    /// Done before this run.
    before: u64,
    done: u64,
    started: Instant,
    logged: Instant,
}

impl Progress {
    /// A bar if standard error is a terminal.
    #[must_use]
    pub fn new() -> Self {
        Self::with(std::io::stderr().is_terminal(), true)
    }

    /// No bar and no log, whatever standard error is.
    #[must_use]
    pub fn hidden() -> Self {
        Self::with(false, false)
    }

    fn with(shown: bool, told: bool) -> Self {
        let now = Instant::now();
        let stage = Stage {
            bar: ProgressBar::hidden(),
            name: String::new(),
            unit: "",
            total: 0,
            before: 0,
            done: 0,
            started: now,
            logged: now,
        };
        Self { stage: Mutex::new(stage), of: Mutex::default(), shown, told, stop: OnceLock::new() }
    }

    /// Says which of several things the next stages are of, such as a layer; `None`: of all.
    pub fn of(&self, thing: Option<&str>) {
        *self.of.lock().unwrap_or_else(PoisonError::into_inner) = thing.map(str::to_owned);
    }

    /// Starts the next stage, of `total` of a `unit` such as samples (0: unknown), `before` of which were
    /// done by an earlier run.
    pub fn stage(&self, name: &'static str, unit: &'static str, total: u64, before: u64) {
        let of = self.of.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let name = of.map_or_else(|| name.to_owned(), |thing| format!("{thing}: {name}"));
        let mut stage = self.lock();
        stage.bar.finish_and_clear();
        if self.told {
            tracing::info!(stage = name, total, done = before, unit, "building");
        }
        let bar = if self.shown { shown_bar(&name, unit, total, before) } else { ProgressBar::hidden() };
        let now = Instant::now();
        *stage = Stage { bar, name, unit, total, before, done: before, started: now, logged: now };
    }

    /// Notes that some more are done.
    pub fn advance(&self, count: u64) {
        let mut stage = self.lock();
        stage.bar.inc(count);
        stage.done += count;
        if self.told && !self.shown && stage.logged.elapsed() >= LOG_INTERVAL {
            stage.logged = Instant::now();
            let rate = (stage.done - stage.before) as f64 / stage.started.elapsed().as_secs_f64();
            let left = stage.total.saturating_sub(stage.done) as f64 / rate;
            tracing::info!(
                stage = stage.name,
                done = stage.done,
                of = stage.total,
                unit = stage.unit,
                millions_per_second = format_args!("{:.2}", rate / 1e6),
                seconds_left = format_args!("{left:.0}"),
                "building"
            );
        }
    }

    /// Says something on standard error, beside the bar.
    pub fn say(&self, text: &str) {
        // Nothing is left to do if standard error is closed.
        self.lock().bar.suspend(|| {
            let _ = std::io::Write::write_all(&mut std::io::stderr(), format!("{text}\n").as_bytes());
        });
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.lock().bar.finish_and_clear();
    }

    /// Asks whoever works to stop, at a place from where it can go on another time.
    pub fn stop(&self) {
        self.stop.get_or_init(Instant::now);
    }

    /// Whether nothing new should be started.
    #[must_use]
    pub fn is_stopping(&self) -> bool {
        self.stop.get().is_some()
    }

    /// Whether even what is under way should be given up.
    #[must_use]
    pub fn is_out_of_patience(&self) -> bool {
        self.stop.get().is_some_and(|since| since.elapsed() >= PATIENCE)
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Stage> {
        self.stage.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn shown_bar(name: &str, unit: &'static str, total: u64, before: u64) -> ProgressBar {
    let template = "{msg:8} {wide_bar} {percent:>3}% {rate}, {eta} left";
    let rate = move |state: &ProgressState, out: &mut dyn std::fmt::Write| {
        // A bar that cannot be written is no reason to stop.
        let _ = if state.per_sec() >= 1e5 {
            write!(out, "{:.2} M{unit}/s", state.per_sec() / 1e6)
        } else {
            write!(out, "{:.0} {unit}/s", state.per_sec())
        };
    };
    let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
    let bar = ProgressBar::new(total).with_style(style.with_key("rate", rate)).with_message(name.to_owned());
    bar.set_position(before);
    // What was done before says nothing of the rate.
    bar.reset_eta();
    bar
}

impl Default for Progress {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_is_final_and_patience_comes_after_it() {
        let progress = Progress::hidden();
        assert!(!progress.is_stopping() && !progress.is_out_of_patience());
        progress.stop();
        progress.stop();
        assert!(progress.is_stopping() && !progress.is_out_of_patience(), "what is under way may end");
    }
}

//! A bar on standard error while something long goes on; silent where there is no terminal.

use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::sync::Mutex;

/// The progress of a build, shared by its threads.
#[derive(Debug)]
pub struct Progress {
    bar: Mutex<ProgressBar>,
    shown: bool,
}

impl Progress {
    /// A bar if standard error is a terminal.
    #[must_use]
    pub fn new() -> Self {
        Self { bar: Mutex::new(ProgressBar::hidden()), shown: std::io::stderr().is_terminal() }
    }

    /// No bar, whatever standard error is.
    #[must_use]
    pub fn hidden() -> Self {
        Self { bar: Mutex::new(ProgressBar::hidden()), shown: false }
    }

    /// Starts the next stage, of `samples` samples (0: unknown).
    pub fn stage(&self, name: &'static str, samples: u64) {
        let mut bar = self.bar.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        bar.finish_and_clear();
        tracing::info!(stage = name, samples, "building");
        if self.shown {
            let template = "{msg:8} {wide_bar} {percent:>3}% {per_sec} samples, {eta} left";
            let style =
                ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
            *bar = ProgressBar::new(samples).with_style(style).with_message(name);
        }
    }

    /// Notes that some more samples are done.
    pub fn advance(&self, samples: u64) {
        self.bar.lock().unwrap_or_else(std::sync::PoisonError::into_inner).inc(samples);
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.lock().unwrap_or_else(std::sync::PoisonError::into_inner).finish_and_clear();
    }
}

impl Default for Progress {
    fn default() -> Self {
        Self::new()
    }
}

//! What users found, counted together.

use crate::fetch::FetchError;
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// How long something took, of many: milliseconds.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Latencies {
    /// How many there were.
    pub count: usize,
    /// Half of them took no longer.
    pub p50: f64,
    /// Nine of ten took no longer.
    pub p90: f64,
    /// Ninety-nine of a hundred took no longer.
    pub p99: f64,
    /// The longest.
    pub max: f64,
}

impl Latencies {
    fn of(list: &[f32]) -> Self {
        let mut list = list.to_vec();
        list.sort_unstable_by(f32::total_cmp);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "an index of the list")]
        let at = |part: f64| {
            let index = (part * list.len() as f64).ceil() as usize;
            list.get(index.saturating_sub(1)).map_or(0.0, |v| f64::from(*v))
        };
        Self { count: list.len(), p50: at(0.5), p90: at(0.9), p99: at(0.99), max: at(1.0) }
    }
}

/// How a server fared, so far or in all.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Report {
    /// Users in all.
    pub users: u32,
    /// Seconds since the first of them arrived.
    pub seconds: f64,
    /// Of requests, to their last byte.
    pub requests: Latencies,
    /// Of diamonds, from the request to the diamond's last byte.
    pub diamonds: Latencies,
    /// Of views, until all is there that their cuts want.
    pub views: Latencies,
    /// Views that had not settled when the user went on.
    pub unsettled: u64,
    /// Views that were still looked at.
    pub under_way: u64,
    /// Times that a user went over to another version of the scene.
    pub went_over: u64,
    /// Bytes of answers, without their headers.
    pub bytes: u64,
    /// The same, for each user.
    pub bytes_a_user: f64,
    /// Answers a second.
    pub requests_a_second: f64,
    /// Diamonds a second.
    pub diamonds_a_second: f64,
    /// Payloads that differ, and their bytes: what was decoded.
    pub decoded: (usize, usize),
    /// What went wrong, and how often.
    pub errors: BTreeMap<String, u64>,
}

#[derive(Debug, Default)]
struct Counts {
    requests: Vec<f32>,
    diamonds: Vec<f32>,
    views: Vec<f32>,
    begun: u64,
    unsettled: u64,
    went_over: u64,
    bytes: u64,
    errors: BTreeMap<String, u64>,
}

/// Counts what users find.
#[derive(Debug, Default)]
pub(super) struct Tally(Mutex<Counts>);

fn milliseconds(time: Duration) -> f32 {
    1e3 * time.as_secs_f32()
}

impl Tally {
    fn with<T>(&self, change: impl FnOnce(&mut Counts) -> T) -> T {
        change(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// An answer came: how long it and its diamonds took, and its bytes.
    pub(super) fn answered(&self, took: Duration, diamonds: &[Duration], bytes: usize) {
        self.with(|counts| {
            counts.requests.push(milliseconds(took));
            counts.diamonds.extend(diamonds.iter().map(|time| milliseconds(*time)));
            counts.bytes += bytes as u64;
        });
    }

    /// A user looks at another view.
    pub(super) fn looks(&self) {
        self.with(|counts| counts.begun += 1);
    }

    /// A user went over to another version.
    pub(super) fn went_over(&self) {
        self.with(|counts| counts.went_over += 1);
    }

    /// A view has settled after some time, or not at all.
    pub(super) fn viewed(&self, settled: Option<Duration>) {
        self.with(|counts| match settled {
            Some(after) => counts.views.push(milliseconds(after)),
            None => counts.unsettled += 1,
        });
    }

    /// Something went wrong.
    pub(super) fn failed(&self, error: &str) {
        self.with(|counts| *counts.errors.entry(error.to_owned()).or_default() += 1);
    }

    /// A request went wrong: told by its kind, not by its address.
    pub(super) fn refused(&self, error: &FetchError) {
        let kind = match error {
            FetchError::Status { status, .. } => format!("status {status}"),
            FetchError::Transport(text) => text.rsplit(": ").next().unwrap_or(text).to_owned(),
            FetchError::Early(_) => "an answer that ends early".to_owned(),
            FetchError::Damaged(_) => "a payload that is damaged".to_owned(),
            FetchError::Missing(_) => "a payload that is missing".to_owned(),
            other => other.to_string(),
        };
        self.failed(&kind);
    }

    pub(super) fn report(&self, users: u32, elapsed: Duration, decoded: (usize, usize)) -> Report {
        let seconds = elapsed.as_secs_f64();
        self.with(|counts| Report {
            users,
            seconds,
            requests: Latencies::of(&counts.requests),
            diamonds: Latencies::of(&counts.diamonds),
            views: Latencies::of(&counts.views),
            unsettled: counts.unsettled,
            under_way: counts.begun - counts.unsettled - counts.views.len() as u64,
            went_over: counts.went_over,
            bytes: counts.bytes,
            bytes_a_user: counts.bytes as f64 / f64::from(users.max(1)),
            requests_a_second: counts.requests.len() as f64 / seconds.max(1e-9),
            diamonds_a_second: counts.diamonds.len() as f64 / seconds.max(1e-9),
            decoded,
            errors: counts.errors.clone(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_the_sorted_list() {
        let list: Vec<f32> = (1..=100u16).rev().map(f32::from).collect();
        let found = Latencies::of(&list);
        assert_eq!((found.p50, found.p90, found.p99, found.max), (50.0, 90.0, 99.0, 100.0));
        assert_eq!(Latencies::of(&[]), Latencies::default());
        let one = Latencies::of(&[7.0]);
        assert_eq!((one.count, one.p50, one.max), (1, 7.0, 7.0));
    }
}

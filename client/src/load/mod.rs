//! `load`: many users at once, to see what a server bears.
//!
//! Each has a cut, an index and a cache of its own, as the viewer has, and connections of its own, and looks at one
//! place after another with time to think between. What it asks for follows from its cut; what it is sent is checked:
//! checksums, the index's sizes, and by decoding (`ledger`). Nothing is drawn.
//!
//! Where another version of the scene takes over, users who are told so (410) load its description and go on there.
//!
//! A request's latency is from when it is sent to its answer's last byte, a diamond's to its own last byte. A view has settled when
//! all is there that its cut wants.

mod ledger;
mod tally;
mod user;
mod versions;

use crate::encoding::Encoding;
use crate::fetch::{FetchError, connect, parse_address};
use crate::headless::FlightPath;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tally::Tally;
pub use tally::{Latencies, Report};
use user::User;
use versions::{Source, Versions};

/// How to load a server.
#[derive(Debug, Clone)]
pub struct Options {
    /// How many users.
    pub users: u32,
    /// For how long.
    pub duration: Duration,
    /// The time in which all of them arrive, one after another.
    pub arrival: Duration,
    /// The mean pause of a user between two views; each is between half and one and a half times as long.
    pub think: Duration,
    /// The paths that users take turns in following; of none each wanders by itself.
    pub paths: Vec<FlightPath>,
    /// Views of a path that a user looks at, evenly spread.
    pub views: u32,
    /// Width and height of a user's picture, in pixels.
    pub size: [u32; 2],
    /// The error to reach, in pixels.
    pub tolerance_pixels: f64,
    /// What each user's cache may hold, in bytes as the viewer counts them.
    pub memory_bytes: usize,
    /// The names of the layers that users look at; none: all.
    pub layers: Option<Vec<String>>,
    /// How diamonds are encoded.
    pub encoding: Encoding,
    /// Requests that a user has in flight at once.
    pub requests_max: usize,
    /// One connection a user, of HTTP/2.
    pub http2: bool,
    /// Shown with each request, for private scenes.
    pub token: Option<Arc<str>>,
    /// Where random numbers begin.
    pub seed: u64,
}

/// Why there is no load.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// The scene cannot be had.
    #[error(transparent)]
    Fetch(#[from] FetchError),
    /// Not in the encoding asked for.
    #[error(
        "layer '{0}' is not offered as {1}: build the store with --encoding points,tin, or leave --encoding out"
    )]
    Encoding(String, &'static str),
    /// No runtime.
    #[error("cannot start: {0}")]
    Start(#[from] std::io::Error),
}

/// Loads a server, and says how it fared. `tell` is told once a second how it fares.
///
/// # Errors
/// When the scene cannot be had. What fails afterwards is counted.
pub fn run(url: &str, options: &Options, mut tell: impl FnMut(&Report)) -> Result<Report, LoadError> {
    let (base, name) = parse_address(url)?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let client = |_| {
        let builder = connect::builder(&base, options.token.as_deref())?.read_timeout(user::PATIENCE);
        let builder = if options.http2 { builder.http2_prior_knowledge() } else { builder };
        builder.build().map_err(|e| FetchError::Start(e.to_string()))
    };
    let root = base.as_str().trim_end_matches('/').to_owned();
    let source = Source { client: client(0)?, root, name };
    let versions = Arc::new(runtime.block_on(Versions::open(source, options))?);
    let first = runtime.block_on(versions.newest());
    let tally = Arc::new(Tally::default());
    let stopping = Arc::new(AtomicBool::new(false));
    let began = Instant::now();
    let mut users = Vec::new();
    for number in 0..options.users {
        let user = User::new(number, &versions, client(number)?, Arc::clone(&first), options);
        let (tally, stopping) = (Arc::clone(&tally), Arc::clone(&stopping));
        let after = options.arrival.mul_f64(f64::from(number) / f64::from(options.users));
        users.push(runtime.spawn(async move {
            tokio::time::sleep(after).await;
            user.run(&tally, &stopping).await;
        }));
    }
    let report = || tally.report(options.users, began.elapsed(), runtime.block_on(versions.size()));
    while began.elapsed() < options.duration {
        std::thread::sleep(Duration::from_secs(1).min(options.duration.saturating_sub(began.elapsed())));
        tell(&report());
    }
    stopping.store(true, Ordering::Relaxed);
    let report = report();
    users.iter().for_each(tokio::task::JoinHandle::abort);
    runtime.shutdown_background();
    Ok(report)
}

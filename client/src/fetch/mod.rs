//! Requests: by priority, a few at a time, retried, dropped when nobody wants them any more.
//!
//! A frame tells what it wishes for, in order, and takes what has arrived; it never waits. The work is done
//! by a few tasks on threads of their own, or by the browser. Each takes the first wish that nobody is fetching:
//! a page of the index, or as many diamonds as make a good batch. A batch is read frame by frame as its
//! bytes arrive, so a slow answer gives its first diamonds early.
//!
//! **Nothing is fetched twice.** A frame's wishes may be older than the latest arrivals. So events are
//! numbered, wishes say which event their author has seen, and what arrived since is not asked for again.
//!
//! **Whatever the server does**, an answer's size is limited before it is kept, each payload's checksum is
//! verified, and a wish that fails [`TRIES_MAX`] times is reported and rests for [`REST`].
//!
//! | module | what it holds |
//! |---|---|
//! | `connect` | how a server is reached: encryption, proxies, tokens |
//! | `http` | addresses, answers and their limits, what goes over the wire |
//! | `tasks` | the wishes and the tasks that fulfil them |
//! | `kept` | what was fetched before, and what to do while the server is away |
//! | `stream` | what comes without being wished for, and when it ends |
//! | `once` | one request, sent once and timed |
//! | `batch` | batches: put together, and cut from a stream of bytes |
//! | `unpack` | zstd |
//! | `error` | why something was not fetched |

mod batch;
pub(crate) mod connect;
mod error;
mod http;
mod kept;
#[cfg(not(target_arch = "wasm32"))]
mod once;
mod stream;
mod tasks;
mod unpack;

#[cfg(test)]
mod tests;

pub use batch::ROOT_BYTES;
pub use error::FetchError;
pub(crate) use http::parse_address;
#[cfg(not(target_arch = "wasm32"))]
pub(crate) use http::{check as check_scene, decode_page, transport};
#[cfg(not(target_arch = "wasm32"))]
pub(crate) use once::{Answer, Ask, describe, one};

use crate::background::Background;
use crate::disk::Disk;
use crate::encoding::Encoding;
use bytes::Bytes;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::Entry;
use diamantina_protocol::message::{Scene, StreamAsk, scene_route};
use diamantina_protocol::texture::{Coverage, Tile};
use diamantina_protocol::zone::Mask;
use foldhash::fast::RandomState;
use http::{Counters, Http};
use std::collections::HashSet;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::time::Duration;
use tasks::{Shared, State, work};
use tokio::sync::{Notify, oneshot};

/// Bytes of payloads asked for in one batch, where the index tells: about a second at 2 Mbit/s.
pub const BATCH_BYTES: u64 = 256 << 10;

/// The most wishes that are kept; the rest can wait for a later frame.
pub const WISHES_MAX: usize = 8192;

/// Failures in a row after which a wish is reported and rests. With the pauses between, some three seconds.
pub const TRIES_MAX: u32 = 5;

/// How long a wish rests that failed [`TRIES_MAX`] times.
pub const REST: Duration = Duration::from_secs(20);

/// Failures remembered; beyond, those that nobody wishes for are forgotten.
const FAILURES_MAX: usize = 4 * WISHES_MAX;

/// How to fetch.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Options {
    /// Requests in flight at once, 1 to 64; of them, half at most are for diamonds.
    pub requests_max: usize,
    /// How long a connection may be silent before the request is given up.
    pub patience: Duration,
    /// How diamonds are encoded.
    pub encoding: Encoding,
    /// Shown with each request, for private scenes.
    pub token: Option<Arc<str>>,
    /// Where what is fetched is kept, and looked for before it is asked for.
    pub disk: Option<Disk>,
    /// Ask the disk alone, and never the network.
    pub offline: bool,
    /// How often to ask whether the scene has another version, where nothing else is asked for that would tell. `None`: never.
    pub follow: Option<Duration>,
}

impl Default for Options {
    fn default() -> Self {
        let encoding = Encoding::default();
        let (disk, offline) = (None, false);
        let patience = Duration::from_secs(15);
        Self { requests_max: 8, patience, encoding, token: None, disk, offline, follow: None }
    }
}

/// Something that can be fetched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Key {
    /// A page of a layer's index.
    Page(usize, u32),
    /// The payload of a layer's diamond.
    Diamond(usize, Diamond),
    /// Which tiles a texture has.
    Coverage(usize),
    /// A tile of a texture.
    Tile(usize, Tile),
}

/// Something to fetch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Want {
    /// What.
    pub key: Key,
    /// The payload's bytes, where the index tells; above 0.
    pub bytes: Option<u32>,
}

/// What arrived.
#[derive(Debug)]
pub enum Event {
    /// A page of a layer's index.
    Page(usize, u32, Vec<(Diamond, Entry)>),
    /// The payload of a layer's diamond; empty where the server has none and the index did not tell.
    Payload(usize, Diamond, Bytes),
    /// Which tiles a texture has.
    Coverage(usize, Coverage),
    /// The picture of a tile of a texture.
    Tile(usize, Tile, Bytes),
    /// This has failed [`TRIES_MAX`] times in a row. It is tried again after [`REST`], if still wished for.
    Failed(Key, FetchError),
    /// The scene has another version now: open it again. Nothing more is fetched.
    SceneChanged,
}

/// What has gone over the wire so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct Traffic {
    /// Bytes of answers, without their headers.
    pub bytes: u64,
    /// Requests sent.
    pub requests: u64,
    /// Requests sent while no other was in flight: how often the network's latency was paid.
    pub round_trips: u64,
    /// Requests that failed, in whole or in part.
    pub errors: u64,
    /// Requests dropped because nobody wanted the answer any more.
    pub cancelled: u64,
    /// What was found on the disk instead, in bytes ...
    pub disk_bytes: u64,
    /// ... and in payloads and pages.
    pub disk_blobs: u64,
}

impl Traffic {
    /// Both together.
    #[must_use]
    pub fn plus(&self, other: &Self) -> Self {
        Self {
            bytes: self.bytes + other.bytes,
            requests: self.requests + other.requests,
            round_trips: self.round_trips + other.round_trips,
            errors: self.errors + other.errors,
            cancelled: self.cancelled + other.cancelled,
            disk_bytes: self.disk_bytes + other.disk_bytes,
            disk_blobs: self.disk_blobs + other.disk_blobs,
        }
    }
}

/// Makes sure that a scene has all layers that are asked for by name; the steps of a series by its own.
///
/// # Errors
/// When it has not.
pub(crate) fn check_layers(scene: &Scene, asked: &[String]) -> Result<(), FetchError> {
    let choices = scene.choices();
    match asked.iter().find(|name| !choices.contains(&name.as_str())) {
        None => Ok(()),
        Some(unknown) => Err(FetchError::Layer {
            scene: scene.name.clone(),
            asked: unknown.clone(),
            layers: choices.into_iter().map(str::to_owned).collect(),
        }),
    }
}

/// Fetches a scene. Dropping it drops its requests, without waiting.
///
/// Holds the wishes and, for each request in flight, at most one payload or page beyond what is handed out.
#[derive(Debug)]
pub struct Fetcher {
    shared: Arc<Shared>,
    events: mpsc::Receiver<(u64, Event)>,
    /// The last event that was taken.
    seen: u64,
    background: Background,
}

impl Fetcher {
    /// Reads the scene's description and starts. `url` is that of a scene, `http://HOST:PORT/scenes/NAME` (or https),
    /// or of a server with only one. Where a disk keeps it and the server is away, it is the description of the last time:
    /// see [`Fetcher::away`]. Layers that are offered in the encoding asked for come as they are streamed in it: see
    /// [`Encoding::layer`].
    ///
    /// # Errors
    /// When there is no such scene, or it cannot be shown.
    pub async fn connect(url: &str, options: &Options) -> Result<(Self, Scene), FetchError> {
        let (base, name) = parse_address(url)?;
        let start = |e: &dyn std::fmt::Display| FetchError::Start(e.to_string());
        let background = Background::start("diamantina-fetch").map_err(|e| start(&e))?;
        let http = Http {
            client: connect::client(&base, options.token.as_deref())?,
            base: base.as_str().trim_end_matches('/').to_owned(),
            patience: options.patience,
            traffic: Counters::default(),
        };
        let shelf = options.disk.as_ref().map(|disk| disk.shelf(&http.base, options.token.as_deref()));
        let (place, offline) = (shelf.clone(), options.offline);
        // Whoever awaits this may stand in a runtime of its own, or in none.
        let (sender, receiver) = oneshot::channel();
        background.spawn(async move {
            let found = kept::describe(&http, place.as_ref(), name.as_deref(), offline).await;
            // Whoever asked waits for this.
            let _ = sender.send((http, found));
        });
        let (http, found) = receiver.await.map_err(|e| start(&e))?;
        let (mut scene, away) = found?;
        let is_watched = shelf.is_some() && !offline;
        let forests = scene.layers.iter().map(|layer| layer.forest).collect();
        for layer in &mut scene.layers {
            if let Some(streamed) = options.encoding.layer(layer) {
                *layer = streamed;
            }
        }
        let requests_max = options.requests_max.clamp(1, 64);
        let (sender, events) = mpsc::channel();
        let shared = Arc::new(Shared {
            http,
            scene: scene.clone(),
            encoding: options.encoding,
            forests,
            requests_max,
            shelf,
            state: Mutex::new(State::new(away)),
            changed: Notify::new(),
            taken: Notify::new(),
            waiting_bytes: AtomicUsize::new(0),
            sender,
        });
        for _ in 0..requests_max {
            background.spawn(work(Arc::clone(&shared)));
        }
        if is_watched {
            background.spawn(kept::watch(Arc::clone(&shared)));
        }
        if let Some(pause) = options.follow.filter(|_| !offline) {
            background.spawn(tasks::follow(Arc::clone(&shared), pause));
        }
        Ok((Self { shared, events, seen: 0, background }, scene))
    }

    /// As [`Fetcher::connect`], waiting for it.
    ///
    /// # Errors
    /// When there is no such scene, or it cannot be shown.
    #[cfg(not(target_arch = "wasm32"))]
    pub fn open(url: &str, options: &Options) -> Result<(Self, Scene), FetchError> {
        pollster::block_on(Self::connect(url, options))
    }

    /// The scene's address.
    #[must_use]
    pub fn address(&self) -> String {
        let Shared { http, scene, .. } = &*self.shared;
        format!("{}{}", http.base, scene_route(&scene.name))
    }

    /// The masks of one of the scene's zones, one a layer, of the diamonds of its points.
    ///
    /// # Errors
    /// When they do not come, or are none.
    pub fn masks(&self, zone: &str) -> impl Future<Output = Result<Vec<Mask>, FetchError>> + use<> {
        let (sender, receiver) = oneshot::channel();
        let (shared, zone) = (Arc::clone(&self.shared), zone.to_owned());
        self.background.spawn(async move {
            // Whoever asked waits for this.
            let _ = sender.send(shared.masks(&zone).await);
        });
        async { receiver.await.map_err(|e| FetchError::Start(e.to_string()))? }
    }

    /// The next event that has arrived, without waiting.
    pub fn poll(&mut self) -> Option<Event> {
        let (serial, event) = self.events.try_recv().ok()?;
        self.seen = serial;
        self.shared.waiting_bytes.fetch_sub(stream::weight(&event), Ordering::Relaxed);
        self.shared.taken.notify_waiters();
        Some(event)
    }

    /// Replaces the wishes, most urgent first, of which at most [`WISHES_MAX`] count. Requests of which
    /// nothing is wished for any more are dropped.
    pub fn wish(&mut self, wishes: Vec<Want>) {
        let pressing = wishes.len();
        self.wish_ahead(wishes, pressing);
    }

    /// As [`Fetcher::wish`]; what comes after the first `pressing` wishes is for later: a quarter of the requests at most
    /// are for diamonds of it, so that what presses soon has its turn.
    pub fn wish_ahead(&mut self, mut wishes: Vec<Want>, pressing: usize) {
        wishes.truncate(WISHES_MAX);
        let mut state = self.shared.lock();
        state.pressing = pressing;
        let seen = self.seen;
        state.delivered.retain(|_, serial| *serial > seen);
        if wishes.is_empty() && state.wishes.is_empty() {
            return;
        }
        if state.wishes != wishes {
            let wished: HashSet<Key, RandomState> = wishes.iter().map(|want| want.key).collect();
            let wanted: HashSet<u64> =
                state.flying.iter().filter(|(key, _)| wished.contains(key)).map(|(_, id)| *id).collect();
            for (_, flight) in
                state.flights.iter().filter(|(id, f)| f.stream.is_none() && !wanted.contains(id))
            {
                flight.cancel.notify_one();
            }
            if state.failures.len() > FAILURES_MAX {
                state.failures.retain(|key, _| wished.contains(key));
            }
            state.wishes = wishes;
        }
        drop(state);
        self.shared.changed.notify_waiters();
    }

    /// Asks for what is worth the most, in one request of its own, ahead of all wishes. While it is under way,
    /// wishes for its layer rest. It replaces the layer's last one.
    pub fn stream(&mut self, layer: usize, ask: StreamAsk) {
        let mut state = self.shared.lock();
        state.end_streams(|other| other == layer);
        state.streams.push_back((layer, ask));
        drop(state);
        self.shared.changed.notify_waiters();
    }

    /// Drops all streams. What has arrived of them stays.
    pub fn end_streams(&mut self) {
        self.shared.lock().end_streams(|_| true);
        self.shared.changed.notify_waiters();
    }

    /// Whether a stream is under way, or about to be.
    #[must_use]
    pub fn is_streaming(&self) -> bool {
        let state = self.shared.lock();
        !state.streams.is_empty() || state.flights.values().any(|flight| flight.stream.is_some())
    }

    /// Says that the payload that arrived for `key` was good: its failures are forgotten.
    pub fn accept(&mut self, key: Key) {
        self.shared.lock().failures.remove(&key);
    }

    /// Says that what arrived for `key` was no good. It is fetched again, after a pause.
    pub fn refuse(&mut self, key: Key, error: &FetchError) {
        self.shared.forget(|| self.shared.route(key));
        let mut state = self.shared.lock();
        state.delivered.remove(&key);
        self.shared.fail(&mut state, &[key], error);
    }

    /// Whether all that is wished for has failed too often and rests, and every event of it has been taken: who stops
    /// waiting knows why.
    #[must_use]
    pub fn is_stuck(&self) -> bool {
        let state = self.shared.lock();
        if state.serial != self.seen {
            return false;
        }
        let rests = |want: &Want| state.failures.get(&want.key).is_some_and(|f| f.tries >= TRIES_MAX);
        state.flights.is_empty()
            && state.streams.is_empty()
            && !state.wishes.is_empty()
            && state.wishes.iter().all(rests)
    }

    /// Why the server is not asked, if it is not: it cannot be reached, or nobody wants it to be. What was fetched before is
    /// there all the same.
    #[must_use]
    pub fn away(&self) -> Option<String> {
        self.shared.lock().away.clone()
    }

    /// Whether the server is not asked: see [`Fetcher::away`].
    #[must_use]
    pub fn is_away(&self) -> bool {
        self.shared.lock().away.is_some()
    }

    /// What has gone over the wire so far.
    #[must_use]
    pub fn traffic(&self) -> Traffic {
        self.shared.http.traffic.read()
    }
}

//! Requests: by priority, a few at a time, retried, dropped when nobody wants them any more.
//!
//! A frame tells what it wishes for, in order, and takes what has arrived; it never waits. The work is done
//! by a few tasks on a runtime with threads of its own. Each takes the first wish that nobody is fetching:
//! a page of the index, or as many diamonds as make a good batch. A batch is read frame by frame as its
//! bytes arrive, so a slow answer gives its first diamonds early.
//!
//! **Nothing is fetched twice.** A frame's wishes may be older than the latest arrivals. So events are
//! numbered, wishes say which event their author has seen, and what arrived since is not asked for again.
//!
//! **Whatever the server does**, an answer's size is limited before it is kept, each payload's checksum is
//! verified, and a wish that fails [`TRIES_MAX`] times is reported and rests for [`REST`].

use bytes::{Buf, Bytes, BytesMut};
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::{self, Entry, PageError};
use diamantina_protocol::message::{self, Catalogue, FrameHeader, Layer, Scene, Status};
use diamantina_protocol::wire::WireError;
use foldhash::fast::RandomState;
use reqwest::{Client, Response, StatusCode, Url};
use std::collections::{HashMap, HashSet};
use std::hash::BuildHasher;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::time::{Duration, Instant};
use tokio::sync::Notify;

/// Bytes of payloads asked for in one batch, where the index tells: about a second at 2 Mbit/s.
pub const BATCH_BYTES: u64 = 256 << 10;

/// The most wishes that are kept; the rest can wait for a later frame.
pub const WISHES_MAX: usize = 8192;

/// Failures in a row after which a wish is reported and rests. With the pauses between, some three seconds.
pub const TRIES_MAX: u32 = 5;

/// How long a wish rests that failed [`TRIES_MAX`] times.
pub const REST: Duration = Duration::from_secs(20);

/// The pause after the first failure; it doubles with each, up to [`PAUSE_MAX`].
const PAUSE: Duration = Duration::from_millis(100);

/// The longest pause, also where the server asks for a longer one.
const PAUSE_MAX: Duration = Duration::from_secs(10);

/// The largest answer in JSON, in bytes.
const JSON_BYTES_MAX: usize = 4 << 20;

/// The largest page of the index before and after decompression, in bytes.
const PAGE_BYTES_MAX: usize = 4 * index::PAGE_BYTES_MAX;

/// Failures remembered; beyond, those that nobody wishes for are forgotten.
const FAILURES_MAX: usize = 4 * WISHES_MAX;

/// The most layers of a scene.
pub const LAYERS_MAX: usize = 64;

/// How to fetch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Options {
    /// Requests in flight at once, 1 to 64.
    pub requests_max: usize,
    /// How long a connection may be silent before the request is given up.
    pub patience: Duration,
}

impl Default for Options {
    fn default() -> Self {
        Self { requests_max: 4, patience: Duration::from_secs(15) }
    }
}

/// Something that can be fetched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Key {
    /// A page of a layer's index.
    Page(usize, u32),
    /// The payload of a layer's diamond.
    Diamond(usize, Diamond),
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
}

/// Why something was not fetched.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FetchError {
    /// Not an address of a server or scene.
    #[error("'{url}' is not the address of a scene ({reason}): expected http://HOST:PORT/scenes/NAME")]
    Address {
        /// The address found.
        url: String,
        /// What is wrong with it.
        reason: String,
    },
    /// No connection, or it broke.
    #[error("{0}: is the server running, and the address right?")]
    Transport(String),
    /// An error of the server.
    #[error("{route}: the server answers {status}")]
    Status {
        /// What was asked for.
        route: String,
        /// The status found.
        status: u16,
        /// The pause that the server asks for.
        retry_after: Option<Duration>,
    },
    /// An answer that is longer than any right one.
    #[error("{route}: answer of more than {limit} bytes refused")]
    TooLarge {
        /// What was asked for.
        route: String,
        /// The limit in bytes.
        limit: usize,
    },
    /// The answer ended before all was there.
    #[error("{0}: the answer ends early")]
    Early(String),
    /// The answer holds what was not asked for.
    #[error("answer has a payload for {0:?}, which was not asked for")]
    Unasked([u32; 2]),
    /// The server has no payload, or a damaged one, where the index tells of one.
    #[error("the server has no good payload for the diamond at {0:?}: run `inspect --verify` there")]
    Missing([u32; 2]),
    /// A payload differs from what the index or its checksum tells.
    #[error("payload of the diamond at {0:?} is damaged")]
    Damaged([u32; 2]),
    /// A batch that is none.
    #[error("batch: {0}")]
    Wire(#[from] WireError),
    /// A page that is none.
    #[error(transparent)]
    Page(#[from] PageError),
    /// A page that does not decompress.
    #[error("index page {0} does not decompress to at most {PAGE_BYTES_MAX} bytes")]
    Compression(u32),
    /// Not the JSON expected.
    #[error("{route}: {reason}: is this a Diamantina server of the same version?")]
    Json {
        /// What was asked for.
        route: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A scene that this build cannot show.
    #[error("scene '{scene}': {reason}")]
    Scene {
        /// The scene's name.
        scene: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The address names no scene and the server has several, or none.
    #[error("the address names no scene: add /scenes/NAME, with NAME one of: {}", .0.join(", "))]
    Choose(Vec<String>),
    /// No thread or no HTTP client.
    #[error("cannot start fetching: {0}")]
    Start(String),
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
    runtime: Option<tokio::runtime::Runtime>,
}

impl Fetcher {
    /// Reads the scene's description, waiting for it, and starts. `url` is that of a scene,
    /// `http://HOST:PORT/scenes/NAME`, or of a server with only one.
    ///
    /// # Errors
    /// When there is no such scene, or it cannot be shown.
    pub fn open(url: &str, options: Options) -> Result<(Self, Scene), FetchError> {
        let (base, name) = parse_address(url)?;
        let start = |e: &dyn std::fmt::Display| FetchError::Start(e.to_string());
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .thread_name("diamantina-fetch")
            .enable_all()
            .build()
            .map_err(|e| start(&e))?;
        let local = matches!(base.host_str(), Some("localhost" | "127.0.0.1" | "[::1]"));
        let builder = Client::builder().connect_timeout(options.patience).read_timeout(options.patience);
        let builder = if local { builder.no_proxy() } else { builder };
        let http = Http {
            client: builder.build().map_err(|e| start(&e))?,
            base: base.as_str().trim_end_matches('/').to_owned(),
            traffic: Counters::default(),
        };
        // Not block_on: the caller may stand in a runtime of its own.
        let (sender, receiver) = mpsc::sync_channel(1);
        runtime.spawn(async move {
            let found = http.scene(name.as_deref()).await;
            // Whoever asked waits for this.
            let _ = sender.send((http, found));
        });
        let (http, scene) = receiver.recv().map_err(|e| start(&e))?;
        let scene = match scene {
            Ok(scene) => scene,
            Err(e) => {
                runtime.shutdown_background();
                return Err(e);
            }
        };
        let requests_max = options.requests_max.clamp(1, 64);
        let (sender, events) = mpsc::channel();
        let shared = Arc::new(Shared {
            http,
            scene: scene.clone(),
            requests_max,
            state: Mutex::default(),
            changed: Notify::new(),
            sender,
        });
        for _ in 0..requests_max {
            runtime.spawn(work(Arc::clone(&shared)));
        }
        Ok((Self { shared, events, seen: 0, runtime: Some(runtime) }, scene))
    }

    /// The next event that has arrived, without waiting.
    pub fn poll(&mut self) -> Option<Event> {
        let (serial, event) = self.events.try_recv().ok()?;
        self.seen = serial;
        Some(event)
    }

    /// Replaces the wishes, most urgent first, of which at most [`WISHES_MAX`] count. Requests of which
    /// nothing is wished for any more are dropped.
    pub fn wish(&mut self, mut wishes: Vec<Want>) {
        wishes.truncate(WISHES_MAX);
        let mut state = self.shared.lock();
        let seen = self.seen;
        state.delivered.retain(|_, serial| *serial > seen);
        if wishes.is_empty() && state.wishes.is_empty() {
            return;
        }
        if state.wishes != wishes {
            let wished: HashSet<Key, RandomState> = wishes.iter().map(|want| want.key).collect();
            let wanted: HashSet<u64> =
                state.flying.iter().filter(|(key, _)| wished.contains(key)).map(|(_, id)| *id).collect();
            for (_, flight) in state.flights.iter().filter(|(id, _)| !wanted.contains(id)) {
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

    /// Says that what arrived for `key` was no good. It is fetched again, after a pause.
    pub fn refuse(&mut self, key: Key, error: &FetchError) {
        let mut state = self.shared.lock();
        state.delivered.remove(&key);
        self.shared.fail(&mut state, &[key], error);
    }

    /// Whether all that is wished for has failed too often and rests.
    #[must_use]
    pub fn is_stuck(&self) -> bool {
        let state = self.shared.lock();
        let rests = |want: &Want| state.failures.get(&want.key).is_some_and(|f| f.tries >= TRIES_MAX);
        state.flights.is_empty() && !state.wishes.is_empty() && state.wishes.iter().all(rests)
    }

    /// What has gone over the wire so far.
    #[must_use]
    pub fn traffic(&self) -> Traffic {
        self.shared.http.traffic.read()
    }
}

impl Drop for Fetcher {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

/// The base of an address, and the scene that it names.
fn parse_address(text: &str) -> Result<(Url, Option<String>), FetchError> {
    let wrong = |reason: &str| FetchError::Address { url: text.to_owned(), reason: reason.to_owned() };
    let mut url = Url::parse(text).map_err(|e| wrong(&e.to_string()))?;
    if url.scheme() != "http" {
        return Err(wrong("this build speaks http only"));
    }
    if url.host_str().is_none() {
        return Err(wrong("it has no host"));
    }
    url.set_query(None);
    url.set_fragment(None);
    let path = url.path().trim_end_matches('/').to_owned();
    let (prefix, name) = match path.rsplit_once("/scenes/") {
        Some((prefix, name)) => (prefix, Some(name)),
        None => (path.strip_suffix("/scenes").unwrap_or(&path), None),
    };
    if name.is_some_and(|name| !message::is_name(name)) {
        return Err(wrong("after /scenes/ comes one name"));
    }
    url.set_path(prefix);
    Ok((url, name.map(str::to_owned)))
}

/// Why a scene cannot be shown, if so: it comes from outside.
fn check(scene: &Scene) -> Result<(), String> {
    if scene.layers.is_empty() || scene.layers.len() > LAYERS_MAX {
        return Err(format!("{} layers, expected 1 to {LAYERS_MAX}", scene.layers.len()));
    }
    if !message::is_name(&scene.name) || !message::is_name(&scene.version) {
        return Err("its name or version is none".into());
    }
    for layer in &scene.layers {
        let Layer { name, forest, coding, origin, cell, heights, .. } = layer;
        if !message::is_name(name) {
            return Err("a layer's name is none".into());
        }
        if coding.levels() != forest.levels() {
            return Err(format!(
                "layer '{name}': coding for {} levels, forest of {}",
                coding.levels(),
                forest.levels()
            ));
        }
        let finite = [origin[0], origin[1], layer.height_offset, heights[0], heights[1]];
        let positive = [cell[0], cell[1], layer.quantum];
        if !finite.iter().chain(&positive).all(|x| x.abs() < 1e12)
            || !positive.iter().all(|x| *x > 0.0)
            || !layer.finest_error.is_finite()
        {
            return Err(format!("layer '{name}': numbers beyond all measure"));
        }
    }
    Ok(())
}

#[derive(Debug, Default)]
struct Counters {
    bytes: AtomicU64,
    requests: AtomicU64,
    round_trips: AtomicU64,
    errors: AtomicU64,
    cancelled: AtomicU64,
}

impl Counters {
    fn read(&self) -> Traffic {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        Traffic {
            bytes: read(&self.bytes),
            requests: read(&self.requests),
            round_trips: read(&self.round_trips),
            errors: read(&self.errors),
            cancelled: read(&self.cancelled),
        }
    }
}

fn count(counter: &AtomicU64, more: usize) {
    counter.fetch_add(more as u64, Ordering::Relaxed);
}

/// The HTTP client, with its limits and counters.
#[derive(Debug)]
struct Http {
    client: Client,
    base: String,
    traffic: Counters,
}

impl Http {
    async fn get(&self, route: &str) -> Result<Response, FetchError> {
        count(&self.traffic.requests, 1);
        let response =
            self.client.get(format!("{}{route}", self.base)).send().await.map_err(|e| transport(&e))?;
        if response.status() == StatusCode::OK {
            return Ok(response);
        }
        let retry_after = response.headers().get("retry-after").and_then(|v| v.to_str().ok()?.parse().ok());
        Err(FetchError::Status {
            route: shortened(route),
            status: response.status().as_u16(),
            retry_after: retry_after.map(Duration::from_secs),
        })
    }

    async fn chunk(&self, response: &mut Response) -> Result<Option<Bytes>, FetchError> {
        let chunk = response.chunk().await.map_err(|e| transport(&e))?;
        count(&self.traffic.bytes, chunk.as_ref().map_or(0, Bytes::len));
        Ok(chunk)
    }

    async fn whole(&self, route: &str, limit: usize) -> Result<Vec<u8>, FetchError> {
        let mut response = self.get(route).await?;
        let mut body = Vec::new();
        while let Some(chunk) = self.chunk(&mut response).await? {
            if body.len() + chunk.len() > limit {
                return Err(FetchError::TooLarge { route: shortened(route), limit });
            }
            body.extend_from_slice(&chunk);
        }
        Ok(body)
    }

    async fn json<T: serde::de::DeserializeOwned>(&self, route: &str) -> Result<T, FetchError> {
        let body = self.whole(route, JSON_BYTES_MAX).await?;
        serde_json::from_slice(&body)
            .map_err(|e| FetchError::Json { route: route.to_owned(), reason: e.to_string() })
    }

    /// The description of the scene of this name, or of the only one.
    async fn scene(&self, name: Option<&str>) -> Result<Scene, FetchError> {
        count(&self.traffic.round_trips, 1);
        let mut tries = 0;
        let scene = loop {
            let answer = match name {
                Some(name) => self.json::<Scene>(&message::scene_route(name)).await,
                None => self.json::<Catalogue>("/scenes").await.and_then(only),
            };
            tries += 1;
            match answer {
                Err(FetchError::Status { status: 429 | 500.., retry_after, .. }) if tries < TRIES_MAX => {
                    count(&self.traffic.errors, 1);
                    tokio::time::sleep(pause(tries, retry_after)).await;
                }
                answer => break answer?,
            }
        };
        check(&scene).map_err(|reason| FetchError::Scene { scene: shortened(&scene.name), reason })?;
        Ok(scene)
    }
}

fn only(mut catalogue: Catalogue) -> Result<Scene, FetchError> {
    match catalogue.scenes.pop() {
        Some(scene) if catalogue.scenes.is_empty() => Ok(scene),
        last => Err(FetchError::Choose(catalogue.scenes.into_iter().chain(last).map(|s| s.name).collect())),
    }
}

/// The error with its causes: the outermost one alone says nothing.
fn transport(error: &reqwest::Error) -> FetchError {
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(next) = cause {
        text = format!("{text}: {next}");
        cause = next.source();
    }
    FetchError::Transport(text)
}

/// A route fit for a message: a batch's goes on for kilobytes.
fn shortened(route: &str) -> String {
    route.chars().take(120).collect()
}

/// The pause after a number of failures in a row: doubling, and up to twice that by chance, so that many
/// clients do not come back at once.
fn pause(tries: u32, asked: Option<Duration>) -> Duration {
    let doubled = PAUSE.saturating_mul(1 << (tries.clamp(1, 16) - 1));
    let chance = (std::hash::RandomState::new().hash_one(tries) % 1000) as f64 / 1000.0;
    doubled.mul_f64(1.0 + chance).max(asked.unwrap_or_default()).min(PAUSE_MAX)
}

#[derive(Debug)]
struct Shared {
    http: Http,
    scene: Scene,
    requests_max: usize,
    // A std Mutex: nothing awaits while it is held, nor does more than look through the wishes.
    state: Mutex<State>,
    changed: Notify,
    sender: mpsc::Sender<(u64, Event)>,
}

#[derive(Debug, Default)]
struct State {
    wishes: Vec<Want>,
    flights: HashMap<u64, Flight>,
    /// What requests in flight still owe, with the request's number.
    flying: HashMap<Key, u64, RandomState>,
    /// What arrived, with the number of its event, until the frame has seen it.
    delivered: HashMap<Key, u64, RandomState>,
    failures: HashMap<Key, Failure, RandomState>,
    /// Events and requests so far.
    serial: u64,
    flight: u64,
    stopped: bool,
}

#[derive(Debug)]
struct Flight {
    cancel: Arc<Notify>,
    is_page: bool,
    /// Whether something of it has arrived.
    useful: bool,
}

#[derive(Debug)]
struct Failure {
    tries: u32,
    not_before: Instant,
}

/// What a task does next.
enum Next {
    Fetch { id: u64, cancel: Arc<Notify>, request: Request },
    Wait(Option<Instant>),
}

enum Request {
    Page(usize, u32),
    Batch(usize, Vec<(Diamond, Option<u32>)>),
}

/// One of the tasks that fetch.
async fn work(shared: Arc<Shared>) {
    loop {
        // Before looking, so that no change is missed.
        let mut changed = std::pin::pin!(shared.changed.notified());
        changed.as_mut().enable();
        match shared.next() {
            Next::Wait(None) => changed.await,
            Next::Wait(Some(until)) => {
                let _ = tokio::time::timeout_at(until.into(), changed).await;
            }
            Next::Fetch { id, cancel, request } => {
                let done = tokio::select! {
                    done = shared.fetch(&request) => Some(done),
                    () = cancel.notified() => None,
                };
                let gone = matches!(&done, Some(Err(FetchError::Status { status: 404 | 410, .. })));
                if gone && shared.is_replaced().await {
                    shared.stop();
                    return;
                }
                shared.land(id, done);
            }
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        // A panic elsewhere is no reason for one here: the state is whole between any two statements.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The most urgent request that may be sent now.
    fn next(&self) -> Next {
        let mut guard = self.lock();
        let state = &mut *guard;
        if state.stopped {
            return Next::Wait(None);
        }
        let now = Instant::now();
        let mut soonest: Option<Instant> = None;
        let mut page = None;
        let mut batch: Option<Batch> = None;
        for want in &state.wishes {
            if state.flying.contains_key(&want.key) || state.delivered.contains_key(&want.key) {
                continue;
            }
            if let Some(failure) = state.failures.get(&want.key).filter(|f| f.not_before > now) {
                soonest = Some(soonest.map_or(failure.not_before, |s| s.min(failure.not_before)));
                continue;
            }
            match want.key {
                Key::Page(layer, number) => {
                    page.get_or_insert((layer, number, batch.is_none()));
                }
                Key::Diamond(layer, d) => {
                    let batch = batch.get_or_insert_with(|| Batch::new(&self.http.base, &self.scene, layer));
                    if batch.layer == layer && !batch.push(d, want.bytes) {
                        break;
                    }
                }
            }
        }
        // Of several tasks, one is left for diamonds: pages alone draw nothing.
        let pages = state.flights.values().filter(|flight| flight.is_page).count();
        let request = match (page, batch) {
            (Some((layer, number, first)), batch)
                if batch.is_none() || (first && pages + 1 < self.requests_max) =>
            {
                Request::Page(layer, number)
            }
            (_, Some(batch)) => Request::Batch(batch.layer, batch.wants),
            _ => return Next::Wait(soonest),
        };
        if state.flights.is_empty() {
            count(&self.http.traffic.round_trips, 1);
        }
        state.flight += 1;
        let id = state.flight;
        match &request {
            Request::Page(layer, number) => {
                state.flying.insert(Key::Page(*layer, *number), id);
            }
            Request::Batch(layer, wants) => {
                state.flying.extend(wants.iter().map(|(d, _)| (Key::Diamond(*layer, *d), id)));
            }
        }
        let cancel = Arc::new(Notify::new());
        let is_page = matches!(request, Request::Page(..));
        state.flights.insert(id, Flight { cancel: Arc::clone(&cancel), is_page, useful: false });
        Next::Fetch { id, cancel, request }
    }

    async fn fetch(&self, request: &Request) -> Result<(), FetchError> {
        let Scene { name, version, layers, .. } = &self.scene;
        match request {
            Request::Page(layer, number) => {
                let layer_of = &layers[*layer];
                let route = message::index_route(name, version, &layer_of.name, *number);
                let body = self.http.whole(&route, PAGE_BYTES_MAX).await?;
                // Stops at the limit, whatever the bytes claim to become.
                let page = zstd::bulk::decompress(&body, PAGE_BYTES_MAX)
                    .map_err(|_| FetchError::Compression(*number))?;
                let entries = index::decode(&layer_of.forest, *number, &page)?;
                self.deliver(Key::Page(*layer, *number), Event::Page(*layer, *number, entries));
                Ok(())
            }
            Request::Batch(layer, wants) => {
                let centres: Vec<_> = wants.iter().map(|(d, _)| d.centre()).collect();
                let route = message::batch_route(name, version, &layers[*layer].name, &centres);
                let mut response = self.http.get(&route).await?;
                let mut owed: HashMap<[u32; 2], (Diamond, Option<u32>)> =
                    wants.iter().map(|want| (want.0.centre(), *want)).collect();
                let mut frames = Frames::default();
                let mut bad = None;
                while let Some(chunk) = self.http.chunk(&mut response).await? {
                    frames.push(&chunk);
                    while let Some((header, payload)) = frames.take()? {
                        let centre = header.centre;
                        let (d, bytes) = owed.remove(&centre).ok_or(FetchError::Unasked(centre))?;
                        // A bad payload is still owed; the others are none the worse.
                        bad = self.receive(*layer, d, bytes, &header, payload).err().or(bad);
                    }
                }
                match bad {
                    Some(error) => Err(error),
                    None if owed.is_empty() => Ok(()),
                    None => Err(FetchError::Early(shortened(&route))),
                }
            }
        }
    }

    /// Takes one payload of a batch, and hands it on if it is good.
    fn receive(
        &self,
        layer: usize,
        d: Diamond,
        bytes: Option<u32>,
        header: &FrameHeader,
        payload: Bytes,
    ) -> Result<(), FetchError> {
        match header.status {
            Status::Ok if header.checksum != message::checksum(&payload) => {
                return Err(FetchError::Damaged(d.centre()));
            }
            Status::Ok if bytes.is_some_and(|b| b != header.length) => {
                return Err(FetchError::Damaged(d.centre()));
            }
            // The index was not there to tell that there is none.
            Status::Missing if bytes.is_none() && header.length == 0 => {}
            Status::Missing | Status::Damaged => return Err(FetchError::Missing(d.centre())),
            Status::Ok => {}
        }
        self.deliver(Key::Diamond(layer, d), Event::Payload(layer, d, payload));
        Ok(())
    }

    fn deliver(&self, key: Key, event: Event) {
        let mut state = self.lock();
        if let Some(id) = state.flying.remove(&key)
            && let Some(flight) = state.flights.get_mut(&id)
        {
            flight.useful = true;
        }
        state.failures.remove(&key);
        state.serial += 1;
        let serial = state.serial;
        state.delivered.insert(key, serial);
        // Nobody listens any more when the fetcher is dropped.
        let _ = self.sender.send((serial, event));
    }

    /// Puts wishes that failed together off, and reports those that have failed too often. One pause serves
    /// them all, or else a batch that failed would come back as many.
    fn fail(&self, state: &mut State, keys: &[Key], error: &FetchError) {
        count(&self.http.traffic.errors, 1);
        let asked = if let FetchError::Status { retry_after, .. } = error { *retry_after } else { None };
        let tries = |key: &Key| state.failures.get(key).map_or(0, |failure| failure.tries);
        let now = Instant::now();
        let again = now + pause(1 + keys.iter().map(tries).max().unwrap_or(0), asked);
        for key in keys {
            self.fail_one(state, *key, error, now, again);
        }
    }

    fn fail_one(&self, state: &mut State, key: Key, error: &FetchError, now: Instant, again: Instant) {
        let failure = state.failures.entry(key).or_insert(Failure { tries: 0, not_before: now });
        // A wish that has rested rests again at once.
        failure.tries = (failure.tries + 1).min(TRIES_MAX);
        let rest = failure.tries == TRIES_MAX;
        failure.not_before = if rest { now + REST } else { again };
        if rest {
            state.serial += 1;
            // As above.
            let _ = self.sender.send((state.serial, Event::Failed(key, error.clone())));
        }
    }

    /// Ends a request; `done` is `None` if it was dropped.
    fn land(&self, id: u64, done: Option<Result<(), FetchError>>) {
        let mut state = self.lock();
        let useful = state.flights.remove(&id).is_some_and(|flight| flight.useful);
        let owed: Vec<Key> = state.flying.iter().filter(|(_, f)| **f == id).map(|(key, _)| *key).collect();
        for key in &owed {
            state.flying.remove(key);
        }
        match done {
            None => count(&self.http.traffic.cancelled, 1),
            Some(Ok(())) => {}
            // Cut off, but not in vain: what it owes has not failed in itself.
            Some(Err(FetchError::Early(_) | FetchError::Transport(_))) if useful => {
                count(&self.http.traffic.errors, 1);
                let not_before = Instant::now() + pause(1, None);
                for key in owed {
                    state.failures.entry(key).or_insert(Failure { tries: 0, not_before }).not_before =
                        not_before;
                }
            }
            Some(Err(error)) => {
                self.fail(&mut state, &owed, &error);
            }
        }
        drop(state);
        self.changed.notify_waiters();
    }

    /// Whether the scene is gone or has another version, so that nothing under this one can be had.
    async fn is_replaced(&self) -> bool {
        match self.http.json::<Scene>(&message::scene_route(&self.scene.name)).await {
            Ok(scene) => scene.version != self.scene.version,
            Err(FetchError::Status { status: 404 | 410, .. }) => true,
            Err(_) => false,
        }
    }

    fn stop(&self) {
        let mut state = self.lock();
        if !state.stopped {
            state.stopped = true;
            state.flights.clear();
            state.flying.clear();
            state.serial += 1;
            // As above.
            let _ = self.sender.send((state.serial, Event::SceneChanged));
        }
    }
}

/// A batch being put together.
struct Batch {
    layer: usize,
    wants: Vec<(Diamond, Option<u32>)>,
    bytes: u64,
    target_bytes: usize,
}

impl Batch {
    fn new(base: &str, scene: &Scene, layer: usize) -> Self {
        let route = message::batch_route(&scene.name, &scene.version, &scene.layers[layer].name, &[]);
        Self { layer, wants: Vec::new(), bytes: 0, target_bytes: base.len() + route.len() }
    }

    /// Adds a diamond; whether there was room.
    fn push(&mut self, d: Diamond, bytes: Option<u32>) -> bool {
        let digits = |n: u32| n.checked_ilog10().unwrap_or(0) as usize + 1;
        let [x, y] = d.centre();
        let target_bytes = self.target_bytes + digits(x) + digits(y) + 2;
        let total = self.bytes + u64::from(bytes.unwrap_or(ROOT_BYTES));
        let full = self.wants.len() == message::BATCH_MAX
            || target_bytes > message::TARGET_BYTES_MAX
            || total > BATCH_BYTES;
        if full && !self.wants.is_empty() {
            return false;
        }
        (self.target_bytes, self.bytes) = (target_bytes, total);
        self.wants.push((d, bytes));
        true
    }
}

/// What a payload is taken to have where the index does not tell, in bytes: it is a root's.
pub const ROOT_BYTES: u32 = 8 << 10;

/// The frames of a batch, cut from a stream of bytes that may be hostile.
///
/// Holds less than a frame and a chunk.
#[derive(Debug, Default)]
struct Frames {
    buffer: BytesMut,
    header: Option<FrameHeader>,
}

impl Frames {
    fn push(&mut self, chunk: &[u8]) {
        self.buffer.extend_from_slice(chunk);
    }

    /// The next frame, if all of it is there.
    fn take(&mut self) -> Result<Option<(FrameHeader, Bytes)>, WireError> {
        if self.header.is_none()
            && let Some((header, used)) = FrameHeader::read(&self.buffer)?
        {
            self.buffer.advance(used);
            self.header = Some(header);
        }
        let Some(header) = self.header.as_ref() else { return Ok(None) };
        // At most PAYLOAD_BYTES_MAX, which `read` has seen to.
        let length = header.length as usize;
        if self.buffer.len() < length {
            return Ok(None);
        }
        // A copy, so that a payload that is kept does not keep the chunks around it.
        let payload = Bytes::copy_from_slice(&self.buffer[..length]);
        self.buffer.advance(length);
        Ok(self.header.take().map(|header| (header, payload)))
    }
}

#[cfg(test)]
#[allow(clippy::cast_possible_truncation, reason = "small numbers")]
mod tests {
    use super::*;
    use crate::world::{Faults, Served, scene, world};

    #[test]
    fn addresses_of_servers_and_scenes_are_told_apart() {
        let parse = |text| parse_address(text).map(|(url, name)| (url.to_string(), name));
        let at = |base: &str, name: Option<&str>| (base.to_owned(), name.map(str::to_owned));
        assert_eq!(parse("http://h:80/").unwrap(), at("http://h/", None));
        assert_eq!(parse("http://h:8080").unwrap(), at("http://h:8080/", None));
        assert_eq!(parse("http://h/scenes").unwrap(), at("http://h/", None));
        assert_eq!(parse("http://h/scenes/alps/").unwrap(), at("http://h/", Some("alps")));
        assert_eq!(parse("http://h/deep/scenes/alps?x#y").unwrap(), at("http://h/deep", Some("alps")));
        for bad in ["", "h:80", "ftp://h/", "https://h/", "http://h/scenes/a/b/c", "http://h/scenes/.x"] {
            assert!(matches!(parse(bad), Err(FetchError::Address { .. })), "{bad}");
        }
    }

    #[test]
    fn frames_come_out_whole_wherever_the_stream_is_cut() {
        let payloads: Vec<Vec<u8>> = (0..40usize).map(|i| vec![i as u8; i * i]).collect();
        let mut stream = Vec::new();
        for (i, payload) in payloads.iter().enumerate() {
            FrameHeader::of([i as u32, 300], payload).write(&mut stream);
            stream.extend(payload);
        }
        for size in [1, 2, 7, 100, 5000, stream.len()] {
            let mut frames = Frames::default();
            let mut found = Vec::new();
            for chunk in stream.chunks(size) {
                frames.push(chunk);
                while let Some((header, payload)) = frames.take().unwrap() {
                    assert_eq!(header.checksum, message::checksum(&payload));
                    found.push(payload.to_vec());
                }
            }
            assert_eq!(found, payloads);
        }
    }

    #[test]
    fn absurd_frames_are_refused_before_their_bytes_are_awaited() {
        let mut bytes = Vec::new();
        FrameHeader { length: u32::MAX, ..FrameHeader::of([1, 1], &[]) }.write(&mut bytes);
        bytes.resize(message::FRAME_HEADER_BYTES_MAX, 0);
        let mut frames = Frames::default();
        frames.push(&bytes);
        assert!(frames.take().is_err());
    }

    #[test]
    fn scenes_with_impossible_numbers_are_refused() {
        assert_eq!(check(&scene(2)), Ok(()));
        let with = |change: &dyn Fn(&mut Scene)| {
            let mut scene = scene(2);
            change(&mut scene);
            check(&scene)
        };
        assert!(with(&|s| s.layers.clear()).is_err());
        assert!(with(&|s| s.version = "../x".into()).is_err());
        assert!(with(&|s| s.layers[1].name = "a/b".into()).is_err());
        assert!(with(&|s| s.layers[0].quantum = 0.0).is_err());
        assert!(with(&|s| s.layers[0].cell[1] = f64::NAN).is_err());
        assert!(with(&|s| s.layers[0].origin[1] = 1e300).is_err());
        assert!(with(&|s| s.layers[0].coding = s.layers[1].coding.clone()).is_err());
    }

    #[test]
    fn several_scenes_are_listed() {
        let catalogue =
            Catalogue { scenes: ["a", "b"].map(|name| Scene { name: name.into(), ..scene(1) }).to_vec() };
        let text = only(catalogue).unwrap_err().to_string();
        assert!(text.ends_with("a, b"), "{text}");
        assert!(only(Catalogue { scenes: Vec::new() }).is_err());
    }

    #[test]
    fn pauses_double_within_bounds() {
        for tries in 1..40 {
            let paused = pause(tries, None);
            let least = PAUSE.saturating_mul(1 << (tries - 1).min(12)).min(PAUSE_MAX);
            assert!(paused >= least && paused <= (least * 2).min(PAUSE_MAX), "{tries}: {paused:?}");
        }
        assert_eq!(pause(1, Some(Duration::from_secs(3600))), PAUSE_MAX);
        assert_eq!(pause(1, Some(Duration::from_secs(2))), Duration::from_secs(2));
    }

    fn wants(level: u32) -> Vec<Want> {
        let built = &world()[0];
        let diamonds = built.layer.forest.diamonds(level).filter(|d| built.entries[d].bytes > 0);
        diamonds.map(|d| Want { key: Key::Diamond(0, d), bytes: Some(built.entries[&d].bytes) }).collect()
    }

    /// Events until `count` have come or some seconds have passed.
    fn events(fetcher: &mut Fetcher, count: usize) -> Vec<Event> {
        let until = Instant::now() + Duration::from_secs(20);
        let mut list = Vec::new();
        while list.len() < count && Instant::now() < until {
            match fetcher.poll() {
                Some(event) => list.push(event),
                None => std::thread::sleep(Duration::from_millis(1)),
            }
        }
        list
    }

    #[test]
    fn what_arrived_is_not_fetched_again_until_it_is_wished_for_knowingly() {
        let served = Served::start(1, Faults::default());
        let (mut fetcher, _) = Fetcher::open(&served.url, Options::default()).unwrap();
        let wants = wants(4);
        fetcher.wish(wants.clone());
        // Wishes by an author who has not looked at the arrivals yet.
        for _ in 0..100 {
            fetcher.wish(wants.clone());
            std::thread::sleep(Duration::from_millis(2));
        }
        assert_eq!(fetcher.traffic().requests, 2, "the scene and one batch");
        let arrived = events(&mut fetcher, wants.len());
        for (want, event) in wants.iter().zip(&arrived) {
            let Event::Payload(0, d, payload) = event else { panic!("{event:?}") };
            assert_eq!(Key::Diamond(0, *d), want.key, "in the order of the wishes");
            assert_eq!(payload, &world()[0].payloads[d]);
        }
        fetcher.wish(wants[..3].to_vec());
        assert_eq!(events(&mut fetcher, 3).len(), 3, "now its author means it");
        assert_eq!(fetcher.traffic().round_trips, 3);
    }

    #[test]
    fn requests_that_nobody_wants_any_more_are_dropped() {
        let served = Served::start(1, Faults { slow: 1.0, ..Faults::default() });
        let (mut fetcher, _) = Fetcher::open(&served.url, Options::default()).unwrap();
        fetcher.wish(wants(9));
        std::thread::sleep(Duration::from_millis(200));
        let flights = fetcher.shared.lock().flights.len();
        assert!(flights > 1);
        fetcher.wish(Vec::new());
        std::thread::sleep(Duration::from_millis(200));
        assert_eq!(fetcher.shared.lock().flights.len(), 0);
        assert!(fetcher.shared.lock().flying.is_empty());
        assert_eq!(fetcher.traffic().cancelled, flights as u64);
    }

    #[test]
    fn batches_stay_within_their_limits() {
        let served = Served::start(1, Faults::default());
        let (mut fetcher, _) = Fetcher::open(&served.url, Options::default()).unwrap();
        // The server of the tests panics, and so answers nothing, where a batch is too long.
        let wants = wants(9);
        fetcher.wish(wants.clone());
        assert_eq!(events(&mut fetcher, wants.len()).len(), wants.len());
        let requests = fetcher.traffic().requests as usize - 1;
        assert!(requests >= wants.len().div_ceil(message::BATCH_MAX) && requests <= 2 + wants.len() / 200);
        assert_eq!(fetcher.traffic().errors, 0);
    }

    #[test]
    fn a_wish_that_keeps_failing_is_reported_and_rests() {
        let served = Served::start(1, Faults { status_500: 1.0, ..Faults::default() });
        let (mut fetcher, _) = Fetcher::open(&served.url, Options::default()).unwrap();
        fetcher.wish(vec![wants(4)[0], Want { key: Key::Page(0, 0), bytes: None }]);
        let reported = events(&mut fetcher, 2);
        assert!(reported.iter().all(|event| matches!(event, Event::Failed(..))), "{reported:?}");
        std::thread::sleep(Duration::from_millis(300));
        assert!(fetcher.is_stuck());
        assert_eq!(fetcher.traffic().requests, 1 + 2 * u64::from(TRIES_MAX));
    }

    #[test]
    fn a_page_that_is_a_bomb_is_refused() {
        let served = Served::start(1, Faults { bomb: 1.0, ..Faults::default() });
        let (mut fetcher, _) = Fetcher::open(&served.url, Options::default()).unwrap();
        fetcher.wish(vec![Want { key: Key::Page(0, 0), bytes: None }]);
        let reported = events(&mut fetcher, 1);
        let [Event::Failed(Key::Page(0, 0), error)] = reported.as_slice() else { panic!("{reported:?}") };
        assert!(error.to_string().contains("does not decompress"), "{error}");
    }

    #[test]
    fn no_server_is_said_plainly() {
        let error = Fetcher::open("http://127.0.0.1:9", Options::default()).unwrap_err().to_string();
        assert!(error.contains("is the server running"), "{error}");
    }
}

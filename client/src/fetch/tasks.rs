//! The wishes, and the tasks that fulfil them: each takes the most urgent that nobody is fetching.

use super::batch::{Batch, Frames};
use super::http::{Http, PAGE_BYTES_MAX, count, decode_page, good_payload, pause, shortened};
use super::stream::weight;
use super::unpack::unpack;
use super::{Event, FetchError, Key, REST, TRIES_MAX, Want};
use crate::background::{sleep, within};
use crate::disk::Shelf;
use crate::encoding::Encoding;
use bytes::Bytes;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::{self, FrameHeader, Scene, StreamAsk};
use diamantina_protocol::texture::{COVERAGE_BYTES_MAX, Coverage, TILE_BYTES_MAX, Tile, coverage_bytes};
use foldhash::fast::RandomState;
use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::time::Duration;
use tokio::sync::Notify;
use web_time::Instant;

#[derive(Debug)]
pub(super) struct Shared {
    pub(super) http: Http,
    /// With its layers as they are streamed.
    pub(super) scene: Scene,
    pub(super) encoding: Encoding,
    /// Those of the layers' points.
    pub(super) forests: Vec<Forest>,
    pub(super) requests_max: usize,
    /// What was fetched before.
    pub(super) shelf: Option<Shelf>,
    // A std Mutex: nothing awaits while it is held, nor does more than look through the wishes.
    pub(super) state: Mutex<State>,
    pub(super) changed: Notify,
    /// Tells streams that an event has been taken.
    pub(super) taken: Notify,
    /// Bytes of events that no frame has taken yet.
    pub(super) waiting_bytes: AtomicUsize,
    pub(super) sender: mpsc::Sender<(u64, Event)>,
}

#[derive(Debug, Default)]
pub(super) struct State {
    pub(super) wishes: Vec<Want>,
    /// How many of the wishes, the first, are not for later.
    pub(super) pressing: usize,
    /// Streams that have not begun: at most one a layer.
    pub(super) streams: VecDeque<(usize, StreamAsk)>,
    pub(super) flights: HashMap<u64, Flight>,
    /// What requests in flight still owe, with the request's number.
    pub(super) flying: HashMap<Key, u64, RandomState>,
    /// What arrived, with the number of its event, until the frame has seen it.
    pub(super) delivered: HashMap<Key, u64, RandomState>,
    pub(super) failures: HashMap<Key, Failure, RandomState>,
    /// Whether requests end at the disk, and why.
    pub(super) away: Option<String>,
    /// When the first of the requests failed that have not reached the server.
    pub(super) silent_since: Option<Instant>,
    /// Events sent so far.
    pub(super) serial: u64,
    flight: u64,
    stopped: bool,
}

#[derive(Debug)]
pub(super) struct Flight {
    pub(super) cancel: Arc<Notify>,
    is_page: bool,
    is_tile: bool,
    /// Whether it is a batch for later.
    is_ahead: bool,
    /// The layer, if it is a stream.
    pub(super) stream: Option<usize>,
    /// Whether something of it has arrived.
    useful: bool,
    /// Whether it has gone to the network.
    pub(super) is_out: bool,
}

#[derive(Debug)]
pub(super) struct Failure {
    pub(super) tries: u32,
    pub(super) not_before: Instant,
}

/// What a task does next.
enum Next {
    Fetch { id: u64, cancel: Arc<Notify>, request: Request },
    Wait(Option<Instant>),
}

pub(super) enum Request {
    Page(usize, u32),
    Coverage(usize),
    Tile(usize, Tile),
    Batch(usize, Vec<(Diamond, Option<u32>)>),
    Stream(usize, StreamAsk),
}

impl State {
    /// Where nothing has been wished for yet.
    pub(super) fn new(away: Option<String>) -> Self {
        Self { away, ..Self::default() }
    }

    /// Drops the streams of some layers.
    pub(super) fn end_streams(&mut self, of: impl Fn(usize) -> bool) {
        self.streams.retain(|(layer, _)| !of(*layer));
        for flight in self.flights.values().filter(|flight| flight.stream.is_some_and(&of)) {
            flight.cancel.notify_one();
        }
    }

    /// Whether a layer's wishes rest, since a stream may bring them.
    fn rests(&self, layer: usize) -> bool {
        let flies = |flight: &Flight| flight.stream == Some(layer);
        self.streams.iter().any(|(l, _)| *l == layer) || self.flights.values().any(flies)
    }
}

/// Looks every now and then whether the scene has another version, until it has: whoever has all of this one asks for nothing
/// that would tell.
pub(super) async fn follow(shared: Arc<Shared>, pause: Duration) {
    let route = message::scene_route(&shared.scene.name);
    let mut known = None;
    while !shared.lock().stopped {
        sleep(pause).await;
        if shared.lock().away.is_some() {
            continue;
        }
        let gone = match shared.http.tag(&route).await {
            Ok(tag) if tag.is_some() && tag == known => continue,
            Ok(tag) => {
                known = tag;
                false
            }
            Err(FetchError::Status { status: 404 | 410, .. }) => true,
            Err(_) => continue,
        };
        if gone || shared.is_replaced().await {
            shared.stop();
        }
    }
}

/// One of the tasks that fetch.
pub(super) async fn work(shared: Arc<Shared>) {
    loop {
        // Before looking, so that no change is missed.
        let mut changed = std::pin::pin!(shared.changed.notified());
        changed.as_mut().enable();
        match shared.next() {
            Next::Wait(None) => changed.await,
            Next::Wait(Some(until)) => {
                let _ = within(until.saturating_duration_since(Instant::now()), changed).await;
            }
            Next::Fetch { id, cancel, request } => {
                let done = tokio::select! {
                    done = shared.fetch(id, &request) => Some(done),
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
    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
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
        let mut imagery = None;
        let stream = state.streams.pop_front();
        let resting: Vec<bool> = (0..self.scene.layers.len()).map(|layer| state.rests(layer)).collect();
        let wishes = if stream.is_none() { state.wishes.as_slice() } else { &[] };
        // Batches share the line, so each further one delays those that are more urgent: half of the tasks keep it
        // busy. Pages are small, and it is their round trips that cost.
        let is_batch = |f: &&Flight| !f.is_page && !f.is_tile && f.stream.is_none();
        let half = self.requests_max.div_ceil(2);
        let may_batch = state.flights.values().filter(is_batch).count() < half;
        // Pictures share the line with heights.
        let may_tile = state.flights.values().filter(|f| f.is_tile).count() < half;
        let quarter = self.requests_max.div_ceil(4);
        let may_look_ahead = state.flights.values().filter(|f| f.is_ahead).count() < quarter;
        let mut is_ahead = false;
        for (number, want) in wishes.iter().enumerate() {
            let rests = match want.key {
                Key::Page(layer, _) | Key::Diamond(layer, _) => resting[layer],
                Key::Coverage(_) | Key::Tile(..) => !may_tile || imagery.is_some(),
            };
            if rests || state.flying.contains_key(&want.key) || state.delivered.contains_key(&want.key) {
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
                Key::Coverage(texture) => imagery = Some(Request::Coverage(texture)),
                Key::Tile(texture, tile) => imagery = Some(Request::Tile(texture, tile)),
                Key::Diamond(..) if !may_batch => {}
                Key::Diamond(..) if number >= state.pressing && !may_look_ahead => {}
                Key::Diamond(layer, d) => {
                    let batch = batch.get_or_insert_with(|| {
                        is_ahead = number >= state.pressing;
                        Batch::new(&self.http.base, &self.scene, self.encoding, layer)
                    });
                    if batch.layer == layer && !batch.push(d, want.bytes) {
                        break;
                    }
                }
            }
        }
        // Of several tasks, one is left for diamonds: pages alone draw nothing.
        let pages = state.flights.values().filter(|flight| flight.is_page).count();
        let request = match (page, batch, stream) {
            (_, _, Some((layer, ask))) => Request::Stream(layer, ask),
            (Some((layer, number, first)), batch, None)
                if batch.is_none() || (first && pages + 1 < self.requests_max) =>
            {
                Request::Page(layer, number)
            }
            (_, Some(batch), None) => Request::Batch(batch.layer, batch.wants),
            (_, None, None) if imagery.is_some() => match imagery {
                Some(request) => request,
                None => return Next::Wait(soonest),
            },
            _ => return Next::Wait(soonest),
        };
        state.flight += 1;
        let id = state.flight;
        match &request {
            Request::Page(layer, number) => {
                state.flying.insert(Key::Page(*layer, *number), id);
            }
            Request::Batch(layer, wants) => {
                state.flying.extend(wants.iter().map(|(d, _)| (Key::Diamond(*layer, *d), id)));
            }
            Request::Coverage(texture) => {
                state.flying.insert(Key::Coverage(*texture), id);
            }
            Request::Tile(texture, tile) => {
                state.flying.insert(Key::Tile(*texture, *tile), id);
            }
            Request::Stream(..) => {}
        }
        let cancel = Arc::new(Notify::new());
        let is_page = matches!(request, Request::Page(..));
        let is_ahead = is_ahead && matches!(request, Request::Batch(..));
        let is_tile = matches!(request, Request::Coverage(_) | Request::Tile(..));
        let stream = if let Request::Stream(layer, _) = &request { Some(*layer) } else { None };
        let flight = Flight {
            cancel: Arc::clone(&cancel),
            is_page,
            is_tile,
            is_ahead,
            stream,
            useful: false,
            is_out: false,
        };
        state.flights.insert(id, flight);
        Next::Fetch { id, cancel, request }
    }

    async fn fetch(&self, id: u64, request: &Request) -> Result<(), FetchError> {
        let Scene { layers, .. } = &self.scene;
        match request {
            Request::Page(layer, number) => {
                let layer_of = &layers[*layer];
                let route = self.encoding.index_route(&self.scene, *layer, *number);
                if let Some(blob) = self.kept(&route).await {
                    if let Ok(entries) = decode_page(&layer_of.forest, *number, &blob) {
                        self.deliver(Key::Page(*layer, *number), Event::Page(*layer, *number, entries));
                        return Ok(());
                    }
                    self.forget(|| route.clone());
                }
                self.go_out(id, request)?;
                let body = self.http.whole(&route, PAGE_BYTES_MAX).await?;
                let entries = decode_page(&layer_of.forest, *number, &body)?;
                self.keep(|| route, 0, &body.into());
                self.deliver(Key::Page(*layer, *number), Event::Page(*layer, *number, entries));
                Ok(())
            }
            Request::Coverage(number) => {
                let texture = &self.scene.textures[*number];
                let route = self.route(Key::Coverage(*number));
                let read = |packed: &[u8]| {
                    let bytes = unpack(packed, coverage_bytes(texture))?;
                    Coverage::decode(texture, &bytes).ok()
                };
                if let Some(coverage) = self.kept(&route).await.and_then(|packed| read(&packed)) {
                    self.deliver(Key::Coverage(*number), Event::Coverage(*number, coverage));
                    return Ok(());
                }
                self.go_out(id, request)?;
                let body = self.http.whole(&route, COVERAGE_BYTES_MAX).await?;
                let coverage = read(&body).ok_or_else(|| FetchError::Coverage(texture.name.clone()))?;
                self.keep(|| route, 0, &body.into());
                self.deliver(Key::Coverage(*number), Event::Coverage(*number, coverage));
                Ok(())
            }
            Request::Tile(number, tile) => {
                let key = Key::Tile(*number, *tile);
                let route = self.route(key);
                if let Some(picture) = self.kept(&route).await {
                    self.deliver(key, Event::Tile(*number, *tile, picture));
                    return Ok(());
                }
                self.go_out(id, request)?;
                let picture: Bytes = self.http.whole(&route, TILE_BYTES_MAX).await?.into();
                // A level halves texels along both sides, as two levels of diamonds do.
                self.keep(|| route, 2 * tile.level, &picture);
                self.deliver(key, Event::Tile(*number, *tile, picture));
                Ok(())
            }
            Request::Batch(layer, wants) => {
                let wants = self.deliver_kept(*layer, wants).await;
                if wants.is_empty() {
                    return Ok(());
                }
                self.go_out(id, request)?;
                let centres: Vec<_> = wants.iter().map(|(d, _)| d.centre()).collect();
                let route = self.encoding.batch_route(&self.scene, *layer, &centres);
                let mut chunks = self.http.get(&route).await?;
                let mut owed: HashMap<[u32; 2], (Diamond, Option<u32>)> =
                    wants.iter().map(|want| (want.0.centre(), *want)).collect();
                let mut frames = Frames::default();
                let mut bad = None;
                while let Some(chunk) = self.http.chunk(&mut chunks).await? {
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
            Request::Stream(layer, ask) => {
                self.go_out(id, request)?;
                self.stream(*layer, ask).await
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
        good_payload(d, bytes, header, &payload)?;
        self.keep(|| self.route(Key::Diamond(layer, d)), d.level(), &payload);
        self.deliver(Key::Diamond(layer, d), Event::Payload(layer, d, payload));
        Ok(())
    }

    pub(super) fn waiting_bytes(&self) -> usize {
        self.waiting_bytes.load(Ordering::Relaxed)
    }

    pub(super) fn deliver(&self, key: Key, event: Event) {
        let mut state = self.lock();
        if let Some(id) = state.flying.remove(&key)
            && let Some(flight) = state.flights.get_mut(&id)
        {
            flight.useful = true;
        }
        // Whether a payload is any good is not known before it is decoded.
        if let Key::Page(..) | Key::Coverage(_) = key {
            state.failures.remove(&key);
        }
        state.serial += 1;
        let serial = state.serial;
        state.delivered.insert(key, serial);
        self.waiting_bytes.fetch_add(weight(&event), Ordering::Relaxed);
        // Nobody listens any more when the fetcher is dropped.
        let _ = self.sender.send((serial, event));
    }

    /// Puts wishes that failed together off, and reports those that have failed too often. One pause serves
    /// them all, or else a batch that failed would come back as many.
    pub(super) fn fail(&self, state: &mut State, keys: &[Key], error: &FetchError) {
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
        let flight = state.flights.remove(&id);
        let useful = flight.as_ref().is_some_and(|flight| flight.useful);
        if flight.is_some_and(|flight| flight.is_out) {
            self.judge(&mut state, done.as_ref());
        }
        let owed: Vec<Key> = state.flying.iter().filter(|(_, f)| **f == id).map(|(key, _)| *key).collect();
        for key in &owed {
            state.flying.remove(key);
        }
        match done {
            None => count(&self.http.traffic.cancelled, 1),
            Some(Ok(())) => {}
            // Wherever it failed: until the server is back there is no use in trying.
            Some(Err(_)) if state.away.is_some() => self.rest(&mut state, &owed),
            // Cut off, or garbled from some byte on, but not in vain: what it owes has not failed in itself.
            Some(Err(
                FetchError::Early(_)
                | FetchError::Transport(_)
                | FetchError::Wire(_)
                | FetchError::Unasked(_),
            )) if useful => {
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

    /// Ends: the scene has another version.
    pub(super) fn stop(&self) {
        let mut state = self.lock();
        if !state.stopped {
            state.stopped = true;
            state.flights.clear();
            state.flying.clear();
            state.streams.clear();
            state.serial += 1;
            // As above.
            let _ = self.sender.send((state.serial, Event::SceneChanged));
        }
    }
}

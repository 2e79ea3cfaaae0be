//! What needs no network: what was fetched before, and what to do while the server is away.
//!
//! A request asks the disk first, and the network for the rest. While the server cannot be reached, requests end there; what is
//! not kept rests until it is back, which [`watch`] finds out.

use super::http::{Http, count, decode_masks};
use super::tasks::{Failure, Request, Shared, State};
use super::{Event, FetchError, Key, REST, TRIES_MAX};
use crate::background::sleep;
use crate::disk::Shelf;
use bytes::Bytes;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::{self, Catalogue, Scene};
use diamantina_protocol::zone::Mask;
use std::sync::Arc;
use std::time::Duration;
use web_time::Instant;

/// How long nothing may come of any request before the server counts as away, where there is a disk to do without it: less
/// than a wish is tried for.
const AWAY: Duration = Duration::from_secs(1);

/// How often a server that is away is looked for.
const LOOK: Duration = Duration::from_secs(2);

/// A scene's description, from the server or, if that is away, as it was the last time, and then why.
pub(super) async fn describe(
    http: &Http,
    shelf: Option<&Shelf>,
    name: Option<&str>,
    offline: bool,
) -> Result<(Scene, Option<String>), FetchError> {
    let route = name.map_or_else(|| "/scenes".to_owned(), message::scene_route);
    let failed = if offline {
        FetchError::NotKept { route: route.clone() }
    } else {
        match http.scene(name).await {
            Ok(scene) => {
                if let Some(shelf) = shelf {
                    keep_description(shelf, name.is_none(), &scene);
                }
                return Ok((scene, None));
            }
            Err(error) => error,
        }
    };
    let is_away =
        offline || matches!(failed, FetchError::Transport(_) | FetchError::Status { status: 502..=504, .. });
    let Some(shelf) = shelf.filter(|_| is_away) else { return Err(failed) };
    let kept = shelf.get(vec![route]).await.pop().flatten();
    let scene = kept.and_then(|json| match name {
        Some(_) => serde_json::from_slice(&json).ok(),
        None => serde_json::from_slice::<Catalogue>(&json).ok().and_then(|mut all| all.scenes.pop()),
    });
    let Some(scene) = scene.filter(|scene| super::http::check(scene).is_ok()) else { return Err(failed) };
    let reason = if offline { "--offline".to_owned() } else { failed.to_string() };
    Ok((scene, Some(reason)))
}

fn keep_description(shelf: &Shelf, is_only: bool, scene: &Scene) {
    let put = |route: String, json: serde_json::Result<Vec<u8>>| {
        if let Ok(json) = json {
            shelf.put(route, 0, json.into());
        }
    };
    put(message::scene_route(&scene.name), serde_json::to_vec(scene));
    if is_only {
        put("/scenes".to_owned(), serde_json::to_vec(&Catalogue { scenes: vec![scene.clone()] }));
    }
    shelf.set_current(&scene.name, &scene.version);
}

/// Looks for the server whenever it is away, until the scene turns out to be another.
pub(super) async fn watch(shared: Arc<Shared>) {
    loop {
        // Before looking, so that no change is missed.
        let mut changed = std::pin::pin!(shared.changed.notified());
        changed.as_mut().enable();
        if shared.lock().away.is_none() {
            changed.await;
            continue;
        }
        sleep(LOOK).await;
        match shared.http.json::<Scene>(&message::scene_route(&shared.scene.name)).await {
            Ok(scene) if scene.version == shared.scene.version => shared.come_back(),
            Ok(_) | Err(FetchError::Status { status: 404 | 410, .. }) => {
                shared.stop();
                return;
            }
            Err(_) => count(&shared.http.traffic.errors, 1),
        }
    }
}

impl Shared {
    /// What is kept of one route.
    pub(super) async fn kept(&self, route: &str) -> Option<Bytes> {
        let blob = self.shelf.as_ref()?.get(vec![route.to_owned()]).await.pop().flatten()?;
        self.http.traffic.found(blob.len());
        Some(blob)
    }

    /// Keeps what came for a route, if anything is kept.
    pub(super) fn keep(&self, route: impl FnOnce() -> String, rank: u32, blob: &Bytes) {
        if let Some(shelf) = &self.shelf {
            shelf.put(route(), rank, blob.clone());
        }
    }

    pub(super) fn forget(&self, route: impl FnOnce() -> String) {
        if let Some(shelf) = &self.shelf {
            shelf.forget(route());
        }
    }

    /// The route of one thing.
    pub(super) fn route(&self, key: Key) -> String {
        match key {
            Key::Page(layer, page) => self.encoding.index_route(&self.scene, layer, page),
            Key::Diamond(layer, d) => self.encoding.route(&self.scene, layer, d.centre()),
            Key::Coverage(texture) => {
                let Scene { name, version, textures, .. } = &self.scene;
                message::index_route(name, version, &textures[texture].name, 0)
            }
            Key::Tile(texture, tile) => {
                let Scene { name, version, textures, .. } = &self.scene;
                message::tile_route(name, version, &textures[texture].name, tile)
            }
        }
    }

    /// Hands on those of the wanted diamonds that are kept; the others, in their order.
    pub(super) async fn deliver_kept(
        &self,
        layer: usize,
        wants: &[(Diamond, Option<u32>)],
    ) -> Vec<(Diamond, Option<u32>)> {
        let Some(shelf) = &self.shelf else { return wants.to_vec() };
        let routes = wants.iter().map(|(d, _)| self.route(Key::Diamond(layer, *d))).collect();
        let mut missing = Vec::new();
        for ((d, bytes), kept) in wants.iter().zip(shelf.get(routes).await) {
            let is_it = |payload: &Bytes| bytes.is_none_or(|bytes| bytes as usize == payload.len());
            match kept {
                Some(payload) if is_it(&payload) => {
                    self.http.traffic.found(payload.len());
                    self.deliver(Key::Diamond(layer, *d), Event::Payload(layer, *d, payload));
                }
                Some(_) => {
                    self.forget(|| self.route(Key::Diamond(layer, *d)));
                    missing.push((*d, *bytes));
                }
                None => missing.push((*d, *bytes)),
            }
        }
        missing
    }

    /// The masks of a zone, one a layer, of the diamonds of its points.
    pub(super) async fn masks(&self, zone: &str) -> Result<Vec<Mask>, FetchError> {
        let route = message::zone_route(&self.scene.name, &self.scene.version, zone);
        if let Some(blob) = self.kept(&route).await {
            if let Ok(masks) = decode_masks(&self.forests, zone, &blob) {
                return Ok(masks);
            }
            self.forget(|| route.clone());
        }
        if self.lock().away.is_some() {
            return Err(FetchError::NotKept { route });
        }
        let blob = self.http.masks(&route).await?;
        let masks = decode_masks(&self.forests, zone, &blob)?;
        self.keep(|| route, 0, &blob.into());
        Ok(masks)
    }

    /// Lets a request go to the network, unless the server is away.
    pub(super) fn go_out(&self, id: u64, request: &Request) -> Result<(), FetchError> {
        let mut state = self.lock();
        if state.away.is_some() {
            let route = match request {
                Request::Page(layer, page) => self.route(Key::Page(*layer, *page)),
                Request::Coverage(texture) => self.route(Key::Coverage(*texture)),
                Request::Tile(texture, tile) => self.route(Key::Tile(*texture, *tile)),
                Request::Batch(layer, wants) => {
                    wants.first().map(|(d, _)| self.route(Key::Diamond(*layer, *d))).unwrap_or_default()
                }
                Request::Stream(..) => "a stream".to_owned(),
            };
            return Err(FetchError::NotKept { route });
        }
        if !state.flights.values().any(|flight| flight.is_out) {
            count(&self.http.traffic.round_trips, 1);
        }
        if let Some(flight) = state.flights.get_mut(&id) {
            flight.is_out = true;
        }
        Ok(())
    }

    /// Takes note of what became of a request that went out: after a while without an answer the server is away.
    pub(super) fn judge(&self, state: &mut State, done: Option<&Result<(), FetchError>>) {
        if self.shelf.is_none() {
            return;
        }
        match done {
            Some(Err(error @ FetchError::Transport(_))) => {
                let since = *state.silent_since.get_or_insert_with(Instant::now);
                if state.away.is_none() && since.elapsed() >= AWAY {
                    let reason = error.to_string();
                    tracing::warn!(reason, "offline: what was fetched before is used");
                    state.away = Some(reason);
                }
            }
            Some(Err(FetchError::NotKept { .. })) | None => {}
            Some(_) => state.silent_since = None,
        }
    }

    /// Lets wishes rest that are not kept. Nothing has failed that anybody should be told of.
    pub(super) fn rest(&self, state: &mut State, keys: &[Key]) {
        let not_before = Instant::now() + REST;
        for key in keys {
            state.failures.insert(*key, Failure { tries: TRIES_MAX, not_before });
        }
    }

    fn come_back(&self) {
        let mut state = self.lock();
        if state.away.take().is_some() {
            tracing::info!("online again");
        }
        state.silent_since = None;
        // All that rested may be had now.
        state.failures.clear();
        drop(state);
        self.changed.notify_waiters();
    }
}

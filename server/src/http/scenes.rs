//! The scenes that are served, each at its newest version that is sound, and the versions before for a while.
//!
//! A build publishes by renaming `scene.json`. The server looks at it now and then; a version that it does not know is
//! opened and read through before anybody is sent to it, so that a bad one never replaces a good one. Who is at the
//! version before goes on with it: its files stay open even where the build has removed them.

use super::ServeError;
use super::answer::Told;
use super::metrics::Metrics;
use crate::store::{Shared, Store, StoreError};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, Instant};

/// How long a version that is not sound is left alone.
const LEFT_ALONE: Duration = Duration::from_secs(60);

/// Scenes by name.
#[derive(Debug)]
pub(super) struct Scenes(RwLock<BTreeMap<String, Shown>>);

#[derive(Debug)]
struct Shown {
    now: Arc<Store>,
    /// What `now` is, as it is told: up to a megabyte for a series of hundreds of steps.
    told: Arc<Told>,
    /// Versions before, and until when they are served.
    before: Vec<(Arc<Store>, Instant)>,
    /// A version that is not sound, and since when that is known.
    refused: Option<(String, Instant)>,
}

/// What there is at a version.
pub(super) enum Found {
    Store(Arc<Store>),
    /// Another version took its place.
    Gone(String),
}

impl Scenes {
    /// Opens the stores.
    pub(super) fn open(stores: &[PathBuf], shared: &Arc<Shared>) -> Result<Self, ServeError> {
        let mut scenes: BTreeMap<String, Shown> = BTreeMap::new();
        for path in stores {
            let store = Store::open_sharing(path, shared)?;
            let name = store.scene().name.clone();
            if let Some(first) = scenes.get(&name) {
                let (first, second) = (first.now.root().to_owned(), path.clone());
                return Err(ServeError::SameName { name, first, second });
            }
            let told = Arc::new(Told::of(store.scene()));
            scenes.insert(name, Shown { now: Arc::new(store), told, before: Vec::new(), refused: None });
        }
        Ok(Self(RwLock::new(scenes)))
    }

    fn read<T>(&self, look: impl FnOnce(&BTreeMap<String, Shown>) -> T) -> T {
        look(&self.0.read().unwrap_or_else(PoisonError::into_inner))
    }

    fn change(&self, name: &str, change: impl FnOnce(&mut Shown)) {
        if let Some(shown) = self.0.write().unwrap_or_else(PoisonError::into_inner).get_mut(name) {
            change(shown);
        }
    }

    /// The newest version of every scene.
    pub(super) fn all(&self) -> Vec<Arc<Store>> {
        self.read(|scenes| scenes.values().map(|shown| Arc::clone(&shown.now)).collect())
    }

    /// The newest version of a scene.
    pub(super) fn newest(&self, name: &str) -> Option<Arc<Store>> {
        self.read(|scenes| scenes.get(name).map(|shown| Arc::clone(&shown.now)))
    }

    /// The names of all scenes, in order.
    pub(super) fn names(&self) -> Vec<String> {
        self.read(|scenes| scenes.keys().cloned().collect())
    }

    /// What a scene is at its newest version.
    pub(super) fn told(&self, name: &str) -> Option<Arc<Told>> {
        self.read(|scenes| scenes.get(name).map(|shown| Arc::clone(&shown.told)))
    }

    /// A scene at a version.
    pub(super) fn at(&self, name: &str, version: &str) -> Option<Found> {
        self.read(|scenes| {
            let shown = scenes.get(name)?;
            let is_asked = |store: &Arc<Store>| store.scene().version == version;
            if is_asked(&shown.now) {
                return Some(Found::Store(Arc::clone(&shown.now)));
            }
            let now = Instant::now();
            let before = shown.before.iter().find(|(store, until)| is_asked(store) && *until > now);
            Some(before.map_or_else(
                || Found::Gone(shown.now.scene().version.clone()),
                |(store, _)| Found::Store(Arc::clone(store)),
            ))
        })
    }

    /// Looks whether another version of a store's scene was published, and goes over to it if that is sound. The version
    /// before is served for `grace` more.
    pub(super) fn refresh(&self, store: &Store, grace: Duration, metrics: &Metrics) {
        let name = &store.scene().name;
        self.change(name, |shown| shown.before.retain(|(_, until)| *until > Instant::now()));
        let leave_alone = |version: &str| {
            self.change(name, |shown| shown.refused = Some((version.to_owned(), Instant::now())))
        };
        let refuse = |version: &str, reason: &dyn std::fmt::Display| {
            tracing::error!(scene = name, version, %reason, "another version was published, and is not served");
            metrics.swaps_refused.inc();
            leave_alone(version);
        };
        let version = match store.newer() {
            Ok(None) => return,
            Ok(Some(version)) => version,
            // That is told elsewhere, and says nothing of what is published.
            Err(StoreError::Away { .. } | StoreError::Unanswered { .. }) => return,
            // Neither does this.
            Err(error @ StoreError::Io { .. }) => {
                return self.refuse_once(name, "", || {
                    tracing::error!(scene = name, %error, "whether there is another version cannot be seen");
                    metrics.failed(&error);
                    leave_alone("");
                });
            }
            Err(error) => return self.refuse_once(name, "", || refuse("", &error)),
        };
        self.refuse_once(name, &version, || match sound(store) {
            Ok(newer) if newer.scene().name == *name => {
                tracing::info!(scene = name, version = newer.scene().version, "another version is served");
                metrics.swaps.inc();
                let told = Arc::new(Told::of(newer.scene()));
                self.change(name, |shown| {
                    shown.told = told;
                    let before = std::mem::replace(&mut shown.now, Arc::new(newer));
                    shown.before.push((before, Instant::now() + grace));
                    shown.refused = None;
                });
            }
            Ok(newer) => refuse(&version, &format!("it is of a scene named '{}'", newer.scene().name)),
            // It is looked at again the next time.
            Err(error @ (StoreError::Away { .. } | StoreError::Unanswered { .. })) => {
                tracing::warn!(scene = name, version, %error, "another version cannot be read through yet");
            }
            Err(error) => {
                metrics.failed(&error);
                refuse(&version, &error);
            }
        });
    }

    /// Does something about a version, unless it was refused not long ago.
    fn refuse_once(&self, name: &str, version: &str, act: impl FnOnce()) {
        let is_refused = self.read(|scenes| {
            let refused = scenes.get(name).and_then(|shown| shown.refused.as_ref());
            refused.is_some_and(|(refused, since)| refused == version && since.elapsed() < LEFT_ALONE)
        });
        if !is_refused {
            act();
        }
    }
}

/// What is published where a store is from, if every blob of it is as it was written. From an object store not all of it
/// is read, only a blob of each pack: it was published by something that had checked, and costs by the request.
fn sound(store: &Store) -> Result<Store, StoreError> {
    let newer = store.reopen()?;
    if newer.is_remote() {
        newer.probe()?;
        return Ok(newer);
    }
    let keys: Vec<_> = newer.keys().map(|(key, _)| key).collect();
    for key in keys {
        newer.get(key)?;
    }
    Ok(newer)
}

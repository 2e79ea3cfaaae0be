//! Blobs of stores, the hot ones kept in memory.
//!
//! A blob is read from its store, and checked there, at most once as long as it is kept; answers share its bytes. What is
//! asked for again and again stays, what is asked for once soon goes (quick_cache's S3-FIFO), and the budget is of bytes.
//! What is asked for again by itself also lies where the kernel can take it from.

use super::metrics::Metrics;
use super::sendfile::{Filed, Files, PAGE};
use crate::store::{Key, Store, StoreError, number};
use bytes::Bytes;
use quick_cache::sync::{Cache, DefaultLifecycle};
use quick_cache::{DefaultHashBuilder, OptionsBuilder, Weighter};
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

/// What a blob takes in memory beside its bytes: its key, its place among the others, its allocation.
const OVERHEAD_BYTES: u64 = 128;

/// Parts of the cache that do not wait for one another. Blobs larger than a part's budget are not kept.
const SHARDS: usize = 8;

/// What came of reading a blob.
pub(super) type Read = Result<Option<Bytes>, StoreError>;

/// A blob of a version of a scene; a version is a hash of all its content.
type Name = (u64, Key);

/// A blob, and its copy for the kernel, if there is one.
#[derive(Debug, Clone)]
pub(super) struct Blob {
    pub(super) bytes: Bytes,
    pub(super) filed: Option<Arc<Filed>>,
}

impl From<Bytes> for Blob {
    fn from(bytes: Bytes) -> Self {
        Self { bytes, filed: None }
    }
}

#[derive(Debug, Clone)]
struct ByBytes;

impl Weighter<Name, Blob> for ByBytes {
    fn weight(&self, _: &Name, blob: &Blob) -> u64 {
        let copy = blob.filed.as_ref().map_or(0, |filed| filed.weight());
        blob.bytes.len() as u64 + copy + OVERHEAD_BYTES
    }
}

/// Reads blobs, and keeps some.
#[derive(Debug)]
pub(super) struct Blobs {
    cache: Option<Cache<Name, Blob, ByBytes>>,
    files: Option<Arc<Files>>,
    /// Bytes of a blob up to which it is kept together with its copy.
    copied_max: u64,
    metrics: Arc<Metrics>,
}

fn name(store: &Store, key: Key) -> Name {
    (number(&store.scene().version), key)
}

impl Blobs {
    /// Keeps blobs of at most `budget` bytes, their copies in `files` included; 0 keeps none.
    pub(super) fn new(budget: u64, files: Option<Arc<Files>>, metrics: Arc<Metrics>) -> Self {
        let mut options = OptionsBuilder::new();
        // The number of items is a hint for the first allocation alone.
        options.weight_capacity(budget).estimated_items_capacity(1024).shards(SHARDS);
        let cache = options.build().ok().filter(|_| budget > 0).map(|options| {
            Cache::with_options(options, ByBytes, DefaultHashBuilder::default(), DefaultLifecycle::default())
        });
        // Twice the blob, and the rest of its last page.
        let copied_max = (budget / SHARDS as u64).saturating_sub(PAGE + OVERHEAD_BYTES) / 2;
        Self { cache, files, copied_max, metrics }
    }

    /// The blob, if it is kept.
    pub(super) fn held(&self, store: &Store, key: Key) -> Option<Bytes> {
        Some(self.kept(name(store, key))?.bytes)
    }

    fn kept(&self, name: Name) -> Option<Blob> {
        let found = self.cache.as_ref()?.get(&name);
        if found.is_some() {
            self.metrics.cache_hits.inc();
        }
        found
    }

    /// The blob, if it is kept, with a copy for the kernel from now on.
    fn filed(&self, name: Name) -> Option<Blob> {
        let mut blob = self.kept(name)?;
        if blob.filed.is_none()
            && blob.bytes.len() as u64 <= self.copied_max
            && let (Some(cache), Some(files)) = (&self.cache, &self.files)
            && let Some(filed) = files.put(&blob.bytes)
        {
            blob.filed = Some(filed);
            cache.insert(name, blob.clone());
        }
        Some(blob)
    }

    /// Reads the blob of a key from its store, checked; `None` if there is none. It waits for the disk.
    ///
    /// # Errors
    /// When the disk fails or the blob does not match its checksum.
    pub(super) fn read(&self, store: &Store, key: Key) -> Result<Option<Bytes>, StoreError> {
        let started = Instant::now();
        let read = store.get(key);
        self.took(store, key, &read, started.elapsed().as_secs_f64());
        read
    }

    /// Counts a blob that was read, and keeps it.
    fn took(&self, store: &Store, key: Key, read: &Read, seconds: f64) {
        match read {
            Ok(None) => {}
            Ok(Some(blob)) => {
                self.metrics.cache_misses.inc();
                self.metrics.store_reads.inc();
                self.metrics.store_read_bytes.inc_by(blob.len() as u64);
                self.metrics.store_read_seconds.observe(seconds);
                if let Some(cache) = &self.cache {
                    cache.insert(name(store, key), blob.clone().into());
                }
            }
            Err(error) => self.failed(error),
        }
    }

    /// Reads those of some blobs that are not kept, near ones together, where they come from an object store: afterwards
    /// they are in `at_hand`, with what went wrong. Elsewhere it does nothing.
    pub(super) async fn fetch(&self, store: &Store, keys: &[Key], at_hand: &mut HashMap<Key, Read>) {
        if !store.is_remote() {
            return;
        }
        let is_missing = |key: &Key| !at_hand.contains_key(key) && self.held(store, *key).is_none();
        let missing: Vec<Key> = keys.iter().copied().filter(is_missing).collect();
        if missing.is_empty() {
            return;
        }
        let started = Instant::now();
        let Some(blobs) = store.fetch(&missing).await else { return };
        let seconds = started.elapsed().as_secs_f64();
        for (key, read) in missing.into_iter().zip(blobs) {
            self.took(store, key, &read, seconds);
            at_hand.insert(key, read);
        }
    }

    /// Counts a blob that could not be read.
    pub(super) fn failed(&self, error: &StoreError) {
        self.metrics.failed(error);
    }

    /// The blob of a key; `None` if there is none. Only who waits for the disk leaves the async thread.
    ///
    /// # Errors
    /// As [`Blobs::read`].
    pub(super) async fn get(
        self: &Arc<Self>,
        store: &Arc<Store>,
        key: Key,
    ) -> Result<Option<Blob>, StoreError> {
        if !store.has(key) {
            return Ok(None);
        }
        if let Some(blob) = self.at_once(store, key) {
            return Ok(Some(blob));
        }
        let mut at_hand = HashMap::new();
        self.fetch(store, &[key], &mut at_hand).await;
        let read = match at_hand.remove(&key) {
            Some(read) => read,
            None => {
                let (blobs, at) = (Arc::clone(self), Arc::clone(store));
                // If it does not end, the runtime does, and nobody waits for this.
                tokio::task::spawn_blocking(move || blobs.read(&at, key)).await.unwrap_or(Ok(None))
            }
        };
        read.map(|blob| blob.map(Blob::from))
    }

    /// The blob of a key, if it is kept; it has a copy for the kernel from now on.
    pub(super) fn at_once(&self, store: &Store, key: Key) -> Option<Blob> {
        self.filed(name(store, key))
    }

    /// Tells the metrics how full the cache is.
    pub(super) fn measure(&self) {
        let (blobs, bytes) = self.cache.as_ref().map_or((0, 0), |cache| (cache.len() as u64, cache.weight()));
        self.metrics.cache_blobs.set(i64::try_from(blobs).unwrap_or(i64::MAX));
        self.metrics.cache_bytes.set(i64::try_from(bytes).unwrap_or(i64::MAX));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::Kind;

    fn name(number: u32) -> Name {
        (7, Key { layer: 0, kind: Kind::Points, a: number, b: 0 })
    }

    #[test]
    fn what_is_kept_stays_within_its_bytes_and_what_is_asked_for_stays() {
        let blobs = Blobs::new(8 << 20, None, Arc::new(Metrics::new(Arc::default())));
        let cache = blobs.cache.as_ref().unwrap();
        let blob = Blob::from(Bytes::from(vec![0; 10_000]));
        for number in 0..5000 {
            cache.insert(name(number), blob.clone());
            // These ten are hot.
            for hot in 0..10 {
                if cache.get(&name(hot)).is_none() {
                    assert!(number < 200, "what is hot went at {number}");
                    cache.insert(name(hot), blob.clone());
                }
            }
            assert!(cache.weight() <= 8 << 20, "{}", cache.weight());
        }
        assert!(cache.len() > 400 && cache.get(&name(4999)).is_some());
        blobs.measure();
        assert!(blobs.metrics.cache_bytes.get() > 4 << 20);
    }

    #[test]
    fn what_is_asked_for_again_has_a_copy_that_counts() {
        let blobs = Blobs::new(8 << 20, Files::new(), Arc::new(Metrics::new(Arc::default())));
        let cache = blobs.cache.as_ref().unwrap();
        for number in 0..5000 {
            cache.insert(name(number), Bytes::from(vec![0; 20_000]).into());
            assert!(
                blobs.filed(name(number)).is_none_or(|blob| blob.filed.is_some() == blobs.files.is_some())
            );
            assert!(cache.weight() <= 8 << 20, "{}", cache.weight());
        }
        if blobs.files.is_some() {
            assert!(cache.len() < (8 << 20) / (20_000 + 20_480));
        }
        assert!(cache.len() > 100 && blobs.kept(name(4999)).is_some());
    }

    #[test]
    fn in_a_small_cache_a_copy_does_not_drive_out_its_blob() {
        let blobs = Blobs::new(256 << 10, Files::new(), Arc::new(Metrics::new(Arc::default())));
        let cache = blobs.cache.as_ref().unwrap();
        // A part of the cache has 32 KiB: none, one and two of these, or one with its copy.
        for (length, kept) in [(40_000, false), (20_000, true), (16_384, true)] {
            cache.insert(name(length), Bytes::from(vec![0; length as usize]).into());
            for _ in 0..3 {
                assert_eq!(blobs.filed(name(length)).is_some(), kept, "{length}");
            }
        }
    }

    #[test]
    fn without_a_budget_nothing_is_kept() {
        assert!(Blobs::new(0, None, Arc::new(Metrics::new(Arc::default()))).cache.is_none());
    }
}

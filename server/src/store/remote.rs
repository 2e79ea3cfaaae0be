//! Blobs of a scene that lies in an object store, by ranges of its packs.
//!
//! Blobs that lie near one another are asked for together. With a disk cache whole pieces of packs are asked for, and kept
//! there. A blob that does not match its checksum, or of which too little came, is asked for once more, by itself and past the
//! cache; the pieces that it came from are dropped.

use super::disk::{Disk, PIECE_BYTES, Piece};
use super::objects::{Failure, Objects};
use super::{Key, Place, StoreError, damaged_blob, pack_name};
use bytes::Bytes;
use futures_util::StreamExt;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use tokio::sync::Mutex;
use xxhash_rust::xxh3::xxh3_64;

/// Bytes between two blobs that are read and thrown away rather than asked twice: some milliseconds' worth.
const GAP_BYTES: u64 = 64 << 10;

/// Bytes of one request, but for a single blob that is larger. With the requests at once, 64 MiB a store.
const RANGE_BYTES: u64 = 2 << 20;

/// Requests at once for one answer.
const RANGES_AT_ONCE: usize = 8;

/// Locks for those who ask for pieces.
pub(super) const ASKING: usize = 64;

/// What is counted of all remote stores of a server.
#[derive(Debug, Default)]
pub struct Counts {
    /// Ranges that were asked for.
    pub requests: AtomicU64,
    /// Bytes of these.
    pub bytes: AtomicU64,
    /// Ranges that could not be had.
    pub failures: AtomicU64,
    /// Blobs that were asked for again since they did not match their checksums, or came short.
    pub rereads: AtomicU64,
    /// Pieces found in the disk cache.
    pub disk_hits: AtomicU64,
    /// Pieces not found there.
    pub disk_misses: AtomicU64,
}

/// What the stores of a server share.
#[derive(Debug, Default)]
pub struct Shared {
    /// Where pieces of remote stores are kept.
    pub disk: Option<Disk>,
    /// What is counted.
    pub counts: Counts,
}

impl Counts {
    fn add(counter: &AtomicU64, count: u64) {
        counter.fetch_add(count, Ordering::Relaxed);
    }
}

/// A version of a scene in an object store.
#[derive(Debug)]
pub(super) struct Remote {
    pub(super) objects: Objects,
    pub(super) version: String,
    /// The version as a number, for the disk cache.
    pub(super) number: u64,
    pub(super) pack_bytes: Vec<u64>,
    /// The ETag of the description that was read.
    pub(super) e_tag: Option<String>,
    pub(super) shared: Arc<Shared>,
    /// Held by those who ask for pieces, each for many of them.
    pub(super) asking: [Mutex<()>; ASKING],
}

/// Part of a pack.
#[derive(Debug)]
struct Part {
    end: u64,
    bytes: Option<Result<Bytes, Failure>>,
    is_fresh: bool,
}

/// Parts by pack and first byte.
type Parts = BTreeMap<(u32, u64), Part>;

impl Remote {
    fn below(&self, pack: u32) -> String {
        format!("{}/{}", self.version, pack_name(pack as usize))
    }

    /// The starts of the parts that hold a blob, and the ends.
    fn parts_of(&self, place: &Place) -> Vec<(u64, u64)> {
        let (start, end) = (u64::from(place.offset), u64::from(place.offset) + u64::from(place.bytes));
        if self.shared.disk.is_none() || start == end {
            return vec![(start, end)];
        }
        let all = self.pack_bytes.get(place.pack as usize).copied().unwrap_or(end);
        let pieces = start / PIECE_BYTES..end.div_ceil(PIECE_BYTES);
        pieces.map(|piece| (piece * PIECE_BYTES, ((piece + 1) * PIECE_BYTES).min(all))).collect()
    }

    fn piece(&self, pack: u32, start: u64) -> Piece {
        (self.number, pack, u32::try_from(start / PIECE_BYTES).unwrap_or(u32::MAX))
    }

    /// Blobs, checked, in the order of the places.
    pub(super) async fn blobs(self: &Arc<Self>, wanted: &[(Key, Place)]) -> Vec<Result<Bytes, StoreError>> {
        let mut parts = Parts::new();
        for (_, place) in wanted.iter().filter(|(_, place)| place.bytes > 0) {
            for (start, end) in self.parts_of(place) {
                parts.insert((place.pack, start), Part { end, bytes: None, is_fresh: false });
            }
        }
        let found = self.look_on_disk(&mut parts).await;
        Counts::add(&self.shared.counts.disk_hits, found);
        // Whoever needs what somebody else is asking for waits for that.
        let turns = self.turns(&parts);
        let mut guards = Vec::with_capacity(turns.len());
        for turn in turns {
            guards.push(self.asking[turn].lock().await);
        }
        if !guards.is_empty() {
            let found = self.look_on_disk(&mut parts).await;
            let missing = parts.values().filter(|part| part.bytes.is_none()).count();
            Counts::add(&self.shared.counts.disk_hits, found);
            Counts::add(&self.shared.counts.disk_misses, missing as u64);
        }
        self.ask(&mut parts).await;
        let mut blobs = Vec::with_capacity(wanted.len());
        for (key, place) in wanted {
            let blob = match self.assemble(&parts, place) {
                Ok(blob) if xxh3_64(&blob) == place.checksum => Ok(blob),
                // What was asked for together with others may be there without them.
                Ok(_) | Err(Failure::Short) => {
                    for (start, _) in self.parts_of(place) {
                        if let Some(part) = parts.get_mut(&(place.pack, start)) {
                            part.is_fresh = false;
                        }
                        if let Some(disk) = &self.shared.disk {
                            disk.forget(self.piece(place.pack, start));
                        }
                    }
                    self.once_more(*key, place).await
                }
                Err(failure) => Err(failure.of_blob(self.objects.address(&self.below(place.pack)), *key)),
            };
            blobs.push(blob);
        }
        self.keep_on_disk(parts).await;
        blobs
    }

    /// The locks of the pieces that are missing, in order, so that nobody waits in a circle. Without a disk cache there is
    /// nothing to find once it is one's turn.
    fn turns(&self, parts: &Parts) -> BTreeSet<usize> {
        let missing = parts.iter().filter(|(_, part)| part.bytes.is_none() && self.shared.disk.is_some());
        let turn = |(pack, start): &(u32, u64)| {
            let piece = u64::from(*pack) * 128 + start / PIECE_BYTES;
            usize::try_from(piece % self.asking.len() as u64).unwrap_or(0)
        };
        missing.map(|(at, _)| turn(at)).collect()
    }

    /// Takes what is missing from the disk cache; how many parts it had.
    async fn look_on_disk(self: &Arc<Self>, parts: &mut Parts) -> u64 {
        if self.shared.disk.is_none() {
            return 0;
        }
        let missing = parts.iter().filter(|(_, part)| part.bytes.is_none());
        let asked: Vec<_> = missing.map(|((pack, start), part)| (*pack, *start, part.end)).collect();
        let this = Arc::clone(self);
        let looked = tokio::task::spawn_blocking(move || {
            let disk = this.shared.disk.as_ref();
            let look = |(pack, start, end): (u32, u64, u64)| {
                Some(((pack, start), disk?.get(this.piece(pack, start), end - start)?))
            };
            asked.into_iter().filter_map(look).collect::<Vec<_>>()
        });
        let found = looked.await.unwrap_or_default();
        let count = found.len() as u64;
        for (at, bytes) in found {
            if let Some(part) = parts.get_mut(&at) {
                part.bytes = Some(Ok(bytes));
            }
        }
        count
    }

    async fn keep_on_disk(self: &Arc<Self>, parts: Parts) {
        if self.shared.disk.is_none() {
            return;
        }
        let this = Arc::clone(self);
        let fresh = parts.into_iter().filter(|(_, part)| part.is_fresh);
        let fresh: Vec<_> = fresh.filter_map(|(at, part)| Some((at, part.bytes?.ok()?))).collect();
        if fresh.is_empty() {
            return;
        }
        let kept = tokio::task::spawn_blocking(move || {
            for ((pack, start), bytes) in fresh {
                if let Some(disk) = &this.shared.disk {
                    disk.put(this.piece(pack, start), &bytes);
                }
            }
        });
        // That it is kept is no condition of an answer.
        let _ = kept.await;
    }

    /// Asks the store for the parts that are still missing.
    async fn ask(&self, parts: &mut Parts) {
        let missing = parts.iter().filter(|(_, part)| part.bytes.is_none());
        let runs = together(missing.map(|((pack, start), part)| (*pack, *start, part.end)));
        let asked = runs.into_iter().map(|(pack, start, end)| async move {
            ((pack, start, end), self.range(pack, start, end).await)
        });
        let mut asked = futures_util::stream::iter(asked).buffer_unordered(RANGES_AT_ONCE);
        while let Some(((pack, start, end), found)) = asked.next().await {
            for ((_, at), part) in parts.range_mut((pack, start)..(pack, end)) {
                if part.bytes.is_some() {
                    continue;
                }
                let slice = |bytes: &Bytes| {
                    let [from, to] =
                        [*at, part.end].map(|x| usize::try_from(x - start).unwrap_or(usize::MAX));
                    bytes.slice(from..to)
                };
                (part.bytes, part.is_fresh) = (Some(found.as_ref().map(slice).map_err(Clone::clone)), true);
            }
        }
    }

    async fn range(&self, pack: u32, start: u64, end: u64) -> Result<Bytes, Failure> {
        let counts = &self.shared.counts;
        Counts::add(&counts.requests, 1);
        let found = self.objects.range(&self.below(pack), start..end).await;
        match &found {
            Ok(bytes) => Counts::add(&counts.bytes, bytes.len() as u64),
            Err(_) => Counts::add(&counts.failures, 1),
        }
        found
    }

    /// A blob of parts. Its bytes are its own: a part may be far larger, and would be kept as long as it.
    fn assemble(&self, parts: &Parts, place: &Place) -> Result<Bytes, Failure> {
        let (start, end) = (u64::from(place.offset), u64::from(place.offset) + u64::from(place.bytes));
        let mut blob = Vec::with_capacity(place.bytes as usize);
        for (from, to) in self.parts_of(place).into_iter().filter(|_| place.bytes > 0) {
            let found = parts.get(&(place.pack, from)).and_then(|part| part.bytes.as_ref());
            let bytes = found.ok_or(Failure::Missing)?.as_ref().map_err(Clone::clone)?;
            let [first, last] = [start.max(from) - from, end.min(to) - from]
                .map(|x| usize::try_from(x).unwrap_or(usize::MAX));
            blob.extend_from_slice(bytes.get(first..last).ok_or(Failure::Short)?);
        }
        Ok(blob.into())
    }

    /// A blob that was wrong, from the store itself.
    async fn once_more(&self, key: Key, place: &Place) -> Result<Bytes, StoreError> {
        Counts::add(&self.shared.counts.rereads, 1);
        let address = || self.objects.address(&self.below(place.pack));
        let (start, end) = (u64::from(place.offset), u64::from(place.offset) + u64::from(place.bytes));
        let blob =
            self.range(place.pack, start, end).await.map_err(|failure| failure.of_blob(address(), key))?;
        let found = xxh3_64(&blob);
        if found == place.checksum {
            Ok(blob)
        } else {
            Err(damaged_blob(address().into(), key, place, found))
        }
    }
}

/// Ranges of packs, in order, that hold these parts, which come in order.
fn together(parts: impl Iterator<Item = (u32, u64, u64)>) -> Vec<(u32, u64, u64)> {
    let mut runs: Vec<(u32, u64, u64)> = Vec::new();
    for (pack, start, end) in parts {
        match runs.last_mut() {
            Some(last) if last.0 == pack && start <= last.2 + GAP_BYTES && end - last.1 <= RANGE_BYTES => {
                last.2 = last.2.max(end);
            }
            _ => runs.push((pack, start, end)),
        }
    }
    runs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_lies_together_is_asked_for_together_and_no_request_is_too_large() {
        let parts =
            [(0, 0, 10), (0, 10, 30), (0, 70_000, 70_010), (0, 800_000, 800_001), (1, 800_002, 800_003)];
        assert_eq!(
            together(parts.into_iter()),
            [(0, 0, 30), (0, 70_000, 70_010), (0, 800_000, 800_001), (1, 800_002, 800_003)]
        );
        assert_eq!(together([(0, 0, 10), (0, 65_000, 65_001)].into_iter()), [(0, 0, 65_001)]);
        let many = (0..1000).map(|i| (3, i * 10_000, i * 10_000 + 9_000));
        let runs = together(many);
        assert!(runs.iter().all(|(_, start, end)| end - start <= RANGE_BYTES) && runs.len() == 5, "{runs:?}");
        assert_eq!(together([(0, 0, 5 << 20)].into_iter()), [(0, 0, 5 << 20)]);
    }
}

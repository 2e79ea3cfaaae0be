//! Answers with many diamonds: made piece by piece as they are read, so that a slow reader holds little.
//!
//! What is damaged comes last, in a frame that says so, and then the answer is cut off: whoever reads it has all the
//! others, and no cache on the way keeps it.

use super::answer::Refusal;
use super::blobs::{Blobs, Read};
use crate::inspect::InspectError;
use crate::store::{Key, Kind, Store, StoreError};
use crate::stream::Stream;
use axum::body::{Body, Bytes};
use diamantina_protocol::message::{self, FrameHeader, PAYLOAD_BYTES_MAX, Status};
use std::collections::HashMap;
use std::io;
use std::sync::Arc;
use std::time::Duration;

/// Bytes that are made at once: what waits for a slow reader, but for one frame more.
const PIECE_BYTES: usize = 16 << 10;

/// How long before it is cut off an answer with something damaged waits for its bytes to go out.
const FAREWELL: Duration = Duration::from_millis(100);

/// Things of an answer that could not be had, of which the log tells by name.
const NAMED_MAX: usize = 16;

/// Diamonds of a batch that are asked of an object store at once.
const AHEAD: usize = 64;

/// A batch that is being read.
pub(super) struct Batch {
    pub(super) blobs: Arc<Blobs>,
    pub(super) store: Arc<Store>,
    pub(super) layer: u8,
    pub(super) kind: Kind,
    /// In the order in which they are sent.
    pub(super) centres: Vec<[u32; 2]>,
}

struct Progress {
    batch: Batch,
    next: usize,
    damaged: Vec<[u32; 2]>,
    errors: Errors,
    /// What an object store was asked for ahead.
    at_hand: HashMap<Key, Read>,
}

/// What went wrong with an answer.
#[derive(Default)]
struct Errors {
    named: Vec<String>,
    more: usize,
}

impl Errors {
    fn add(&mut self, error: String) {
        if self.named.len() < NAMED_MAX {
            self.named.push(error);
        } else {
            self.more += 1;
        }
    }

    /// All of it in words, if there is anything.
    fn told(&self) -> Option<String> {
        let more = if self.more > 0 { format!("; and {} more", self.more) } else { String::new() };
        (!self.named.is_empty()).then(|| self.named.join("; ") + &more)
    }
}

/// The body of a batch.
///
/// # Errors
/// When it comes from an object store that cannot be reached: then nothing has been sent, and 503 can be said.
pub(super) async fn batch(batch: Batch) -> Result<Body, Refusal> {
    let at_hand = HashMap::new();
    let mut begun = Progress { batch, next: 0, damaged: Vec::new(), errors: Errors::default(), at_hand };
    begun.fetch().await;
    if begun.at_hand.values().any(|read| matches!(read, Err(StoreError::Away { .. }))) {
        return Err(Refusal::away());
    }
    Ok(Body::from_stream(futures_util::stream::unfold(Some(begun), |progress| async move {
        let mut progress = progress?;
        // What is in memory needs no thread.
        let mut piece = Vec::new();
        progress.fill(&mut piece, false);
        if piece.is_empty() && !progress.is_over() && progress.batch.store.is_remote() {
            progress.fetch().await;
            progress.fill(&mut piece, false);
        }
        if piece.is_empty() && !progress.is_over() {
            let filled = tokio::task::spawn_blocking(move || {
                progress.fill(&mut piece, true);
                (piece, progress)
            });
            (piece, progress) = match filled.await {
                Ok(filled) => filled,
                Err(error) => return Some((Err(io::Error::other(error)), None)),
            };
        }
        if piece.is_empty() {
            // All that is sound has gone out.
            for centre in progress.damaged.drain(..) {
                FrameHeader::without(centre, Status::Damaged).write(&mut piece);
            }
        }
        if !piece.is_empty() {
            return Some((Ok(Bytes::from(piece)), Some(progress)));
        }
        let error = progress.errors.told()?;
        // What was written goes out before the connection is dropped.
        tokio::time::sleep(FAREWELL).await;
        Some((Err(io::Error::other(error)), None))
    })))
}

impl Progress {
    fn key(&self, [a, b]: [u32; 2]) -> Key {
        Key { layer: self.batch.layer, kind: self.batch.kind, a, b }
    }

    /// Asks an object store for those that come next.
    async fn fetch(&mut self) {
        let next = self.batch.centres.iter().skip(self.next).take(AHEAD);
        let keys: Vec<Key> = next.map(|centre| self.key(*centre)).collect();
        self.batch.blobs.fetch(&self.batch.store, &keys, &mut self.at_hand).await;
    }

    fn is_over(&self) -> bool {
        self.next == self.batch.centres.len()
    }

    /// Adds frames until there is a piece, or, unless it may wait for the disk, until one is not in memory.
    fn fill(&mut self, piece: &mut Vec<u8>, may_wait: bool) {
        let Batch { blobs, store, layer, kind, centres } = &self.batch;
        while let Some(centre) = centres.get(self.next).filter(|_| piece.len() < PIECE_BYTES) {
            let key = Key { layer: *layer, kind: *kind, a: centre[0], b: centre[1] };
            let blob = match (self.at_hand.remove(&key), may_wait) {
                (Some(read), _) => read,
                (None, may_wait) => match (blobs.held(store, key), may_wait) {
                    (Some(blob), _) => Ok(Some(blob)),
                    (None, _) if !store.has(key) => Ok(None),
                    (None, true) => blobs.read(store, key),
                    (None, false) => return,
                },
            };
            self.next += 1;
            match blob {
                Ok(Some(payload)) if payload.len() as u64 <= u64::from(PAYLOAD_BYTES_MAX) => {
                    piece.reserve(payload.len() + message::FRAME_HEADER_BYTES_MAX);
                    FrameHeader::of(*centre, &payload).write(piece);
                    piece.extend_from_slice(&payload);
                }
                Ok(None) => FrameHeader::without(*centre, Status::Missing).write(piece),
                Ok(Some(_)) => {
                    self.damaged.push(*centre);
                    self.errors.add(format!("{key:?} is larger than any payload"));
                }
                // What is to come is there, though not now: cut off, the answer is asked for again.
                Err(error @ StoreError::Away { .. }) => {
                    self.next = centres.len();
                    self.errors.add(error.to_string());
                }
                Err(error) => {
                    self.damaged.push(*centre);
                    self.errors.add(error.to_string());
                }
            }
        }
    }
}

/// The body of a stream. The first piece is made before anything is answered, so that what cannot be had is said by a
/// status; each further one when the one before has gone out, on a thread that it leaves at once: a slow reader keeps what the
/// stream remembers and one piece, and no thread.
///
/// # Errors
/// When not even the first piece can be had.
pub(super) async fn stream(stream: Stream, blobs: &Arc<Blobs>) -> Result<Body, Refusal> {
    let (piece, stream) = match make(stream).await {
        Ok((Ok(Some(piece)), stream)) => (piece, stream),
        Ok((Ok(None), _)) => return Ok(Body::empty()),
        Ok((Err(InspectError::Store(error)), _)) => {
            blobs.failed(&error);
            return Err(error.into());
        }
        Ok((Err(error), _)) => return Err(Refusal::damaged(&error)),
        // The runtime ends, and nobody waits for this.
        Err(error) => return Err(Refusal::damaged(&error)),
    };
    let begun = (stream, Arc::clone(blobs), Some(piece));
    Ok(Body::from_stream(futures_util::stream::unfold(Some(begun), |begun| async move {
        let (stream, blobs, first) = begun?;
        let made = match first {
            Some(piece) => Ok((Ok(Some(piece)), stream)),
            None => make(stream).await,
        };
        match made {
            Ok((Ok(piece), stream)) => piece.map(|piece| (Ok(piece), Some((stream, blobs, None)))),
            // The answer is cut off, so that the reader knows.
            Ok((Err(error), _)) => {
                tokio::time::sleep(FAREWELL).await;
                if let InspectError::Store(error) = &error {
                    blobs.failed(error);
                }
                Some((Err(io::Error::other(error.to_string())), None))
            }
            Err(error) => Some((Err(io::Error::other(error)), None)),
        }
    })))
}

type Made = (Result<Option<Bytes>, InspectError>, Stream);

/// The next piece, by a thread that may wait.
async fn make(mut stream: Stream) -> Result<Made, tokio::task::JoinError> {
    tokio::task::spawn_blocking(move || (stream.next_piece(PIECE_BYTES), stream)).await
}

//! Answers with many diamonds: made piece by piece as they are read, so that a slow reader holds little.
//!
//! What is damaged comes last, in a frame that says so, and then the answer is cut off: whoever reads it has all the
//! others, and no cache on the way keeps it.

use super::blobs::Blobs;
use crate::inspect::InspectError;
use crate::store::{Key, Kind, Store};
use crate::stream::Stream;
use axum::body::{Body, Bytes};
use diamantina_protocol::message::{self, FrameHeader, PAYLOAD_BYTES_MAX, Status};
use std::io;
use std::sync::Arc;
use std::time::Duration;

/// Bytes that are made at once: what waits for a slow reader, but for one frame more.
const PIECE_BYTES: usize = 16 << 10;

/// How long before it is cut off an answer with something damaged waits for its bytes to go out.
const FAREWELL: Duration = Duration::from_millis(100);

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
    last_error: Option<String>,
}

/// The body of a batch.
pub(super) fn batch(batch: Batch) -> Body {
    let begun = Progress { batch, next: 0, damaged: Vec::new(), last_error: None };
    Body::from_stream(futures_util::stream::unfold(Some(begun), |progress| async move {
        let mut progress = progress?;
        // What is in memory needs no thread.
        let mut piece = Vec::new();
        progress.fill(&mut piece, false);
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
        let error = progress.last_error?;
        // What was written goes out before the connection is dropped.
        tokio::time::sleep(FAREWELL).await;
        Some((Err(io::Error::other(error)), None))
    }))
}

impl Progress {
    fn is_over(&self) -> bool {
        self.next == self.batch.centres.len()
    }

    /// Adds frames until there is a piece, or, unless it may wait for the disk, until one is not in memory.
    fn fill(&mut self, piece: &mut Vec<u8>, may_wait: bool) {
        let Batch { blobs, store, layer, kind, centres } = &self.batch;
        while let Some(centre) = centres.get(self.next).filter(|_| piece.len() < PIECE_BYTES) {
            let key = Key { layer: *layer, kind: *kind, a: centre[0], b: centre[1] };
            let blob = match (blobs.held(store, key), may_wait) {
                (Some(blob), _) => Ok(Some(blob)),
                (None, _) if !store.has(key) => Ok(None),
                (None, true) => blobs.read(store, key),
                (None, false) => return,
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
                    self.last_error = Some(format!("{key:?} is larger than any payload"));
                }
                Err(error) => {
                    self.damaged.push(*centre);
                    self.last_error = Some(error.to_string());
                }
            }
        }
    }
}

/// The body of a stream. Each piece is made when the one before has gone out, on a thread that it leaves at once: a
/// slow reader keeps what the stream remembers and one piece, and no thread.
pub(super) fn stream(stream: Stream, blobs: &Arc<Blobs>) -> Body {
    let begun = (stream, Arc::clone(blobs));
    Body::from_stream(futures_util::stream::unfold(Some(begun), |begun| async move {
        let (mut stream, blobs) = begun?;
        let made = tokio::task::spawn_blocking(move || (stream.next_piece(PIECE_BYTES), stream)).await;
        match made {
            Ok((Ok(piece), stream)) => piece.map(|piece| (Ok(piece), Some((stream, blobs)))),
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
    }))
}

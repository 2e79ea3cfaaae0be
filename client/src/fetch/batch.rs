//! Batches: put together from wishes, and cut from a stream of bytes.

use super::BATCH_BYTES;
use crate::encoding::Encoding;
use bytes::{Buf, Bytes, BytesMut};
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::{self, FrameHeader, Scene};
use diamantina_protocol::wire::WireError;

/// A batch being put together.
pub(super) struct Batch {
    pub(super) layer: usize,
    pub(super) wants: Vec<(Diamond, Option<u32>)>,
    bytes: u64,
    target_bytes: usize,
}

impl Batch {
    pub(super) fn new(base: &str, scene: &Scene, encoding: Encoding, layer: usize) -> Self {
        let route = encoding.batch_route(scene, layer, &[]);
        Self { layer, wants: Vec::new(), bytes: 0, target_bytes: base.len() + route.len() }
    }

    /// Adds a diamond; whether there was room.
    pub(super) fn push(&mut self, d: Diamond, bytes: Option<u32>) -> bool {
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
pub(super) struct Frames {
    buffer: BytesMut,
    header: Option<FrameHeader>,
}

impl Frames {
    pub(super) fn push(&mut self, chunk: &[u8]) {
        self.buffer.extend_from_slice(chunk);
    }

    /// Whether all bytes so far belonged to frames that have been taken.
    pub(super) fn is_empty(&self) -> bool {
        self.buffer.is_empty() && self.header.is_none()
    }

    /// The next frame, if all of it is there.
    pub(super) fn take(&mut self) -> Result<Option<(FrameHeader, Bytes)>, WireError> {
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
}

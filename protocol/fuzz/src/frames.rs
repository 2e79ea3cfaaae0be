//! Frames of a batch, read as a client reads them: the bytes arrive in pieces, and what is read does not
//! depend on where they are cut.

use diamantina_protocol::message::{FrameHeader, PAYLOAD_BYTES_MAX};

/// One input.
pub fn run(data: &[u8]) {
    let [piece, stream @ ..] = data else { return };
    let pieces = read(stream, usize::from(*piece).max(1));
    assert_eq!(pieces, read(stream, stream.len().max(1)));
}

/// The headers of a stream that arrives `piece` bytes at a time, and whether it ended in an error.
fn read(stream: &[u8], piece: usize) -> (Vec<FrameHeader>, bool) {
    let (mut headers, mut at, mut end) = (Vec::new(), 0, 0);
    loop {
        match FrameHeader::read(&stream[at.min(end)..end]) {
            Err(_) => return (headers, true),
            Ok(Some((header, used))) if at <= end => {
                assert!(used <= end - at && header.length <= PAYLOAD_BYTES_MAX);
                at += used + header.length as usize;
                headers.push(header);
            }
            _ if end == stream.len() => return (headers, false),
            _ => end = (end + piece).min(stream.len()),
        }
        // A payload that goes beyond what is there: the rest is still to come.
        while at > end {
            if end == stream.len() {
                return (headers, false);
            }
            end = (end + piece).min(stream.len());
        }
    }
}

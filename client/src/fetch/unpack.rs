//! zstd, as pages and masks are compressed. Natively by the C library; a browser has none, and no compiler for it
//! need be there, so it is decoded in Rust, at half the speed.

/// The bytes that `packed` becomes, at most `limit`, whatever they claim to become; `None` if they are no zstd, or more.
#[cfg(not(target_arch = "wasm32"))]
pub(super) fn unpack(packed: &[u8], limit: usize) -> Option<Vec<u8>> {
    zstd::bulk::decompress(packed, limit).ok()
}

#[cfg(target_arch = "wasm32")]
pub(super) use in_rust as unpack;

#[cfg(any(test, target_arch = "wasm32"))]
pub(super) fn in_rust(packed: &[u8], limit: usize) -> Option<Vec<u8>> {
    use std::io::Read as _;
    // Refuses windows beyond 100 MiB, and takes no more than what it has decoded.
    let mut decoder = ruzstd::decoding::StreamingDecoder::new(packed).ok()?;
    let mut bytes = Vec::new();
    decoder.by_ref().take(limit as u64 + 1).read_to_end(&mut bytes).ok()?;
    (bytes.len() <= limit).then_some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_ways_give_the_same_and_stop_at_the_limit() {
        let bytes: Vec<u8> = (0..200_000u64).map(|i| (i * i).to_le_bytes()[1]).collect();
        for level in [1, 3, 19] {
            let packed = zstd::bulk::compress(&bytes, level).unwrap();
            for way in [unpack, in_rust] {
                assert_eq!(way(&packed, bytes.len()).as_ref(), Some(&bytes));
                assert_eq!(way(&packed, bytes.len() - 1), None);
                assert_eq!(way(&packed[..packed.len() / 2], bytes.len()), None);
                assert_eq!(way(b"no zstd at all", 100), None);
            }
        }
        let bomb = zstd::bulk::compress(&vec![0u8; 64 << 20], 1).unwrap();
        assert_eq!((unpack(&bomb, 1 << 20), in_rust(&bomb, 1 << 20)), (None, None));
    }
}

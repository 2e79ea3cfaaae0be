//! zstd, as pages and masks are compressed. Natively by the C library; a browser has none, and no compiler for it
//! need be there, so it is decoded in Rust, at half the speed. Where there is a checksum of the content, as the server writes it,
//! it is compared.

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
    // The C library compares them by itself.
    let told = decoder.decoder.get_checksum_from_data();
    let is_right = told.is_none() || told == decoder.decoder.get_calculated_checksum();
    (bytes.len() <= limit && is_right).then_some(bytes)
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
        let mut compressor = zstd::bulk::Compressor::new(12).unwrap();
        compressor.include_checksum(true).unwrap();
        let packed = compressor.compress(&bytes[..2000]).unwrap();
        for way in [unpack, in_rust] {
            assert_eq!(way(&packed, 2000).as_deref(), Some(&bytes[..2000]));
            for bit in 0..8 * packed.len() {
                let mut flipped = packed.clone();
                flipped[bit / 8] ^= 1 << (bit % 8);
                assert!(way(&flipped, 4000).is_none_or(|found| found == bytes[..2000]), "bit {bit}");
            }
        }
        let bomb = zstd::bulk::compress(&vec![0u8; 64 << 20], 1).unwrap();
        assert_eq!((unpack(&bomb, 1 << 20), in_rust(&bomb, 1 << 20)), (None, None));
    }
}

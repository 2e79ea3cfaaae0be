//! How pages of the index and masks of zones are compressed: by zstd, with a checksum of what was compressed.
//!
//! On their way they have no other: answers with many diamonds have one in each frame, an answer with one page has none. Whoever
//! decompresses compares it, so a page is what was written or none.

use std::io;
use zstd::bulk::Compressor;

/// zstd's level: it is done once, and read for ever.
const LEVEL: i32 = 12;

/// The bytes, compressed.
///
/// # Errors
/// When there is no memory for it.
pub fn compress(bytes: &[u8]) -> io::Result<Vec<u8>> {
    let mut compressor = Compressor::new(LEVEL)?;
    compressor.include_checksum(true)?;
    compressor.compress(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flipped_bit_is_found() {
        // As in pages: columns of values that are alike, and some noise.
        let bytes: Vec<u8> = (0..3000u32).map(|i| (i / 100 + i * i % 7).to_le_bytes()[0]).collect();
        let packed = compress(&bytes).unwrap();
        assert!(packed.len() < bytes.len());
        let mut unseen_without = 0;
        let bare = zstd::bulk::compress(&bytes, LEVEL).unwrap();
        for bit in 0..8 * packed.len() {
            let flipped = |whole: &[u8]| {
                let mut whole = whole.to_vec();
                whole[bit / 8] ^= 1 << (bit % 8);
                zstd::bulk::decompress(&whole, 2 * bytes.len())
            };
            assert!(
                flipped(&packed).is_ok_and(|found| found == bytes) || flipped(&packed).is_err(),
                "bit {bit}"
            );
            if bit < 8 * bare.len() {
                unseen_without += u32::from(flipped(&bare).is_ok_and(|found| found != bytes));
            }
        }
        assert!(unseen_without > 0, "the checksum is of no use here");
    }
}

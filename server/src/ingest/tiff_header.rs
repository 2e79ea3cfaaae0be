//! The first directory of a TIFF, read with bounds before any other code trusts it.
//!
//! The `tiff` crate allocates what a header claims; this reader first proves that every claim lies inside
//! the file, so that a header of 4e9 x 4e9 samples costs nothing but an error.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::Path;

use super::error::{Result, broken, io_error};

/// Entries of a directory, at most; real ones have some twenty.
const ENTRIES_MAX: u64 = 4096;
/// Strips or tiles of one image, at most: 2e12 samples in 512 x 512 tiles. 16 bytes of memory each.
pub(super) const CHUNKS_MAX: u64 = 8_000_000;
/// Values of any other tag, at most (GeoKeys and metadata have some hundreds).
pub(super) const VALUES_MAX: u64 = 1 << 16;

const REMEDY: &str = "fetch or write the file again";

/// One entry: a tag, its type and where its values lie.
#[derive(Clone, Copy, Debug)]
struct Entry {
    tag: u16,
    kind: u16,
    count: u64,
    at: u64,
}

/// The first directory.
pub(super) struct Header<'a> {
    path: &'a Path,
    file: &'a File,
    pub(super) length: u64,
    pub(super) big_endian: bool,
    big: bool,
    entries: Vec<Entry>,
    /// Where the next directory is; 0 if there is none.
    next: u64,
}

/// Directories after the first that are looked at, at most: overviews and masks, one for each halving.
const DIRECTORIES_MAX: usize = 64;

impl<'a> Header<'a> {
    /// Reads the directory; every entry's values lie inside the file afterwards.
    pub(super) fn read(path: &'a Path, file: &'a File) -> Result<Self> {
        let length = file.metadata().map_err(io_error(path, "ask for its length"))?.len();
        let mut header =
            Self { path, file, length, big_endian: false, big: false, entries: Vec::new(), next: 0 };
        let start: [u8; 16] = header.bytes(0, if length < 16 { 8 } else { 16 })?;
        header.big_endian = &start[..2] == b"MM";
        let big = header.number(&start[2..4]) == 43;
        let at = header.number(if big { &start[8..16] } else { &start[4..8] });
        let (count_bytes, entry_bytes, inline) = if big { (8, 20, 8) } else { (2, 12, 4) };
        let count: [u8; 8] = header.bytes(at, count_bytes)?;
        let count = header.number(&count[..count_bytes]);
        if count > ENTRIES_MAX {
            return Err(header.broken(format!("at most {ENTRIES_MAX} tags"), format!("{count}")));
        }
        for i in 0..count {
            // Far from overflow: `at` lies inside the file, checked by the read above.
            let place = at + count_bytes as u64 + i * entry_bytes as u64;
            let e: [u8; 20] = header.bytes(place, entry_bytes)?;
            let (tag, kind) = (header.short(&e[..2]), header.short(&e[2..4]));
            let count = header.number(&e[4..4 + inline]);
            let value_place = place + 4 + inline as u64;
            let total = count.saturating_mul(size_of_kind(kind));
            let at = if total <= inline as u64 {
                value_place
            } else {
                header.number(&e[4 + inline..4 + 2 * inline])
            };
            if at.checked_add(total).is_none_or(|end| end > length) {
                let found = format!("{count} values of tag {tag} at byte {at} of {length}");
                return Err(header.broken("every tag inside the file".to_owned(), found));
            }
            header.entries.push(Entry { tag, kind, count, at });
        }
        let next: Result<[u8; 8]> =
            header.bytes(at + count_bytes as u64 + count * entry_bytes as u64, inline);
        // Files exist that end with their last entry: then no other follows.
        header.next = next.map_or(0, |bytes| header.number(&bytes[..inline]));
        header.big = big;
        Ok(header)
    }

    /// Whether a later directory holds a mask that says which samples of the first are valid.
    pub(super) fn has_mask(&self) -> bool {
        let (count_bytes, entry_bytes, inline) = if self.big { (8, 20, 8) } else { (2, 12, 4) };
        let mut at = self.next;
        for _ in 0..DIRECTORIES_MAX {
            if at == 0 {
                return false;
            }
            let Ok(count) = self.bytes::<8>(at, count_bytes) else { return false };
            let count = self.number(&count[..count_bytes]).min(ENTRIES_MAX);
            for i in 0..count {
                let place = at + count_bytes as u64 + i * entry_bytes as u64;
                let Ok(e) = self.bytes::<20>(place, entry_bytes) else { return false };
                // NewSubfileType, whose bit 2 says "transparency mask"; it comes first, as the least tag.
                let kind = usize::try_from(size_of_kind(self.short(&e[2..4]))).unwrap_or(4);
                if self.short(&e[..2]) == 254
                    && self.number(&e[4 + inline..4 + inline + kind.min(inline)]) & 4 != 0
                {
                    return true;
                }
            }
            let end = at + count_bytes as u64 + count * entry_bytes as u64;
            let Ok(next) = self.bytes::<8>(end, inline) else { return false };
            at = self.number(&next[..inline]);
        }
        false
    }

    /// How many values a tag has; 0 without the tag.
    pub(super) fn count(&self, tag: u16) -> u64 {
        self.entry(tag).map_or(0, |e| e.count)
    }

    /// The first value of a whole-number tag.
    pub(super) fn integer(&self, tag: u16) -> Result<Option<u64>> {
        Ok(self.integers(tag, 1)?.first().copied())
    }

    /// The first values of a whole-number tag, `max` at most; empty without the tag.
    pub(super) fn integers(&self, tag: u16, max: u64) -> Result<Vec<u64>> {
        let Some((entry, bytes)) = self.values(tag, max)? else { return Ok(Vec::new()) };
        if !matches!(entry.kind, 1 | 3 | 4 | 13 | 16 | 18) {
            return Err(self.broken(format!("whole numbers in tag {tag}"), format!("type {}", entry.kind)));
        }
        let size = usize::try_from(size_of_kind(entry.kind)).unwrap_or(1);
        Ok(bytes.chunks_exact(size).map(|b| self.number(b)).collect())
    }

    /// The first values of a floating-point tag, `max` at most; empty without the tag.
    pub(super) fn reals(&self, tag: u16, max: u64) -> Result<Vec<f64>> {
        let Some((entry, bytes)) = self.values(tag, max)? else { return Ok(Vec::new()) };
        if entry.kind != 12 {
            return Err(self.broken(format!("doubles in tag {tag}"), format!("type {}", entry.kind)));
        }
        Ok(bytes.as_chunks::<8>().0.iter().map(|b| f64::from_bits(self.number(b))).collect())
    }

    /// The text of a tag, up to its first NUL.
    pub(super) fn text(&self, tag: u16) -> Result<Option<String>> {
        let Some((_, bytes)) = self.values(tag, VALUES_MAX)? else { return Ok(None) };
        let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
        Ok(Some(String::from_utf8_lossy(&bytes[..end]).trim().to_owned()))
    }

    fn entry(&self, tag: u16) -> Option<Entry> {
        self.entries.iter().copied().find(|e| e.tag == tag)
    }

    fn values(&self, tag: u16, max: u64) -> Result<Option<(Entry, Vec<u8>)>> {
        let Some(entry) = self.entry(tag) else { return Ok(None) };
        let bytes = entry.count.min(max) * size_of_kind(entry.kind);
        let mut out = vec![0; usize::try_from(bytes).unwrap_or(0)];
        self.file.read_exact_at(&mut out, entry.at).map_err(io_error(self.path, "read a tag"))?;
        Ok(Some((entry, out)))
    }

    fn bytes<const N: usize>(&self, at: u64, count: usize) -> Result<[u8; N]> {
        let mut out = [0; N];
        if at.checked_add(count as u64).is_none_or(|end| end > self.length) {
            let found = format!("a directory at byte {at} of {}", self.length);
            return Err(self.broken("a TIFF directory inside the file".to_owned(), found));
        }
        self.file.read_exact_at(&mut out[..count], at).map_err(io_error(self.path, "read its header"))?;
        Ok(out)
    }

    /// A number of up to 8 bytes in the file's byte order.
    fn number(&self, bytes: &[u8]) -> u64 {
        let fold = |n: u64, b: &u8| n << 8 | u64::from(*b);
        if self.big_endian { bytes.iter().fold(0, fold) } else { bytes.iter().rev().fold(0, fold) }
    }

    fn short(&self, bytes: &[u8]) -> u16 {
        u16::try_from(self.number(bytes)).unwrap_or(0)
    }

    pub(super) fn broken(&self, expected: String, found: String) -> super::IngestError {
        broken(self.path, expected, found, REMEDY)
    }
}

/// Bytes of one value of a TIFF type; 1 for unknown types, which are never read.
fn size_of_kind(kind: u16) -> u64 {
    match kind {
        3 | 8 => 2,
        4 | 9 | 11 | 13 => 4,
        5 | 10 | 12 | 16 | 17 | 18 => 8,
        _ => 1,
    }
}

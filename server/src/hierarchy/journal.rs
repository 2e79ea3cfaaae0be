//! What of a build is done, on disk, so that a killed one goes on where it ended.
//!
//! The journal lies in the work folder and only grows. It opens with a fingerprint of the source and of
//! the options that matter; each record behind it is a finished band of a layer's canvas, a finished chunk, or a finished
//! tile of a level of triangles.
//! A record is written only once what it speaks of is on the disk, so whatever can be read back is true.
//! A torn or damaged record ends the journal: it and what follows is done again.
//!
//! Records wait in memory and are synced together every few seconds: a kill costs no more than that, and
//! the disk is not asked to sync a thousand times. Memory: some 60 bytes a diamond of what waits.
//!
//! | offset | size | field | valid range |
//! |---|---|---|---|
//! | 0 | 8 | magic | `DMTJRN04` |
//! | 8 | 32 | fingerprint, BLAKE3 | |
//! | 40 | .. | records | |
//!
//! | offset in a record | size | field | valid range |
//! |---|---|---|---|
//! | 0 | 4 | bytes of content | at most 2^28 |
//! | 4 | 8 | XXH3 of the content | |
//! | 12 | 1 | kind | 1 [`Band`], 2 [`Chunk`], 3 [`Tile`] |
//! | 13 | 1 | position of the layer in the scene | |
//! | 14 | .. | its fields in order, little-endian | |
//!
//! The content begins with the kind.

use super::tins::Place;
use crate::measure::Found;
use crate::store::Spot;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};
use xxhash_rust::xxh3::xxh3_64;

/// The name of the journal in the work folder.
const NAME: &str = "journal";
const MAGIC: &[u8; 8] = b"DMTJRN04";
/// The largest content of a record: a chunk of 2^16 cells a side has 400,000 diamonds of 60 bytes.
const CONTENT_BYTES_MAX: u32 = 1 << 28;

/// A hash of all that a build's result depends on.
pub(super) type Fingerprint = [u8; 32];

/// Rows of the source that are on the canvas, and what was found in them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Band {
    pub(super) y0: u32,
    pub(super) rows: u32,
    pub(super) low: i32,
    pub(super) high: i32,
    pub(super) valid: u64,
    pub(super) rounding: f64,
}

/// A diamond that a chunk coded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Coded {
    pub(super) centre: [u32; 2],
    pub(super) low: i32,
    pub(super) high: i32,
    /// Where its payload is, if it has one.
    pub(super) spot: Option<Spot>,
}

/// A chunk that is done.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Chunk {
    /// Its position among all chunks.
    pub(super) number: u32,
    /// The largest distance at the finest level, in quanta.
    pub(super) finest: f64,
    /// The diamonds that it owns.
    pub(super) coded: Vec<Coded>,
    /// What it found of all that overlap it.
    pub(super) found: Vec<([u32; 2], Found)>,
}

/// A diamond that has its triangles.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Triangulated {
    pub(super) centre: [u32; 2],
    pub(super) low: i32,
    pub(super) high: i32,
    /// Of its payload.
    pub(super) triangles: u32,
    /// Where its payload is, if it has one.
    pub(super) spot: Option<Spot>,
    /// The largest distance between the samples and its halves, in quanta.
    pub(super) vertical: f64,
    /// The largest distance between borders, in metres.
    pub(super) apart: f64,
    /// Where its halves are.
    pub(super) halves: Place,
}

/// A tile of a level of triangles that is done.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Tile {
    pub(super) level: u32,
    /// Its position among the tiles of its level.
    pub(super) number: u32,
    /// Of what is drawn where all is split: the largest vertical distance, in quanta, and between borders, in metres.
    pub(super) finest: [f64; 2],
    /// Its diamonds.
    pub(super) done: Vec<Triangulated>,
}

/// What a journal says.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Record {
    /// Rows that are on the canvas.
    Band(Band),
    /// A chunk whose blobs are in the spool.
    Chunk(Chunk),
    /// A tile whose blobs are in the spool, and halves in the file of its level.
    Tile(Tile),
}

/// A journal being written.
#[derive(Debug)]
pub(super) struct Journal {
    interval: Duration,
    pending: Mutex<Pending>,
    /// Held by whoever makes a checkpoint.
    file: Mutex<File>,
}

#[derive(Debug)]
struct Pending {
    records: Vec<u8>,
    since: Instant,
}

impl Journal {
    /// Starts an empty journal.
    pub(super) fn create(folder: &Path, fingerprint: &Fingerprint, interval: Duration) -> io::Result<Self> {
        let (path, fresh) = (folder.join(NAME), folder.join("journal-new"));
        let mut file = File::create(&fresh)?;
        file.write_all(MAGIC)?;
        file.write_all(fingerprint)?;
        // Whoever finds a journal finds its head whole.
        std::fs::rename(&fresh, &path)?;
        Ok(Self::with(file, interval))
    }

    /// Reads the journal that an earlier run left, record by record. `None` if there is none, or not for
    /// this fingerprint; `take` is then never called. It gets the position of a layer and what is done of it; when it
    /// says no, that record and all behind it count as damaged.
    pub(super) fn reopen<E>(
        folder: &Path,
        fingerprint: &Fingerprint,
        interval: Duration,
        mut take: impl FnMut(u8, Record) -> Result<bool, E>,
        failed: impl Fn(io::Error) -> E,
    ) -> Result<Option<Self>, E> {
        let path = folder.join(NAME);
        let mut file = match File::options().read(true).write(true).open(&path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            file => file.map_err(&failed)?,
        };
        let mut reader = BufReader::with_capacity(1 << 20, &file);
        let mut head = [0; 40];
        let whole = read_whole(&mut reader, &mut head).map_err(&failed)?;
        if !whole || head[..8] != *MAGIC || head[8..] != *fingerprint {
            return Ok(None);
        }
        let mut intact = 40;
        while let Some((layer, record, bytes)) = next_record(&mut reader).map_err(&failed)? {
            if !take(layer, record)? {
                break;
            }
            intact += bytes;
        }
        file.set_len(intact).map_err(&failed)?;
        file.seek(SeekFrom::Start(intact)).map_err(&failed)?;
        Ok(Some(Self::with(file, interval)))
    }

    /// Whether an earlier run left a journal, of whatever build.
    pub(super) fn exists(folder: &Path) -> bool {
        folder.join(NAME).exists()
    }

    fn with(file: File, interval: Duration) -> Self {
        let pending = Pending { records: Vec::new(), since: Instant::now() };
        Self { interval, pending: Mutex::new(pending), file: Mutex::new(file) }
    }

    /// Notes that something of a layer is done; true if a checkpoint is due.
    pub(super) fn note(&self, layer: u8, record: &Record) -> bool {
        let content = content(layer, record);
        let mut pending = self.pending();
        // Larger than any chunk can have: it would be read back as damage.
        debug_assert!(content.len() <= CONTENT_BYTES_MAX as usize);
        let length = u32::try_from(content.len()).unwrap_or(u32::MAX);
        pending.records.extend(length.to_le_bytes());
        pending.records.extend(xxh3_64(&content).to_le_bytes());
        pending.records.extend(content);
        pending.since.elapsed() >= self.interval
    }

    /// Writes what was noted to the disk, after `sync` has put there what it speaks of. If another thread is
    /// at it already, nothing happens.
    pub(super) fn checkpoint<E>(
        &self,
        sync: impl FnOnce() -> Result<(), E>,
        failed: impl FnOnce(io::Error) -> E,
    ) -> Result<(), E> {
        let mut file = match self.file.try_lock() {
            Ok(file) => file,
            Err(std::sync::TryLockError::Poisoned(file)) => file.into_inner(),
            Err(std::sync::TryLockError::WouldBlock) => return Ok(()),
        };
        let records = {
            let mut pending = self.pending();
            pending.since = Instant::now();
            std::mem::take(&mut pending.records)
        };
        if records.is_empty() {
            return Ok(());
        }
        sync()?;
        file.write_all(&records).and_then(|()| file.sync_data()).map_err(failed)
    }

    fn pending(&self) -> std::sync::MutexGuard<'_, Pending> {
        self.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The next intact record with its layer, and its length; `None` at the end and at the first damage.
fn next_record(reader: &mut impl Read) -> io::Result<Option<(u8, Record, u64)>> {
    let mut head = [0; 12];
    if !read_whole(reader, &mut head)? {
        return Ok(None);
    }
    let mut fields = Fields(&head);
    let (Some(length), Some(checksum)) = (fields.u32(), fields.u64()) else { return Ok(None) };
    if length > CONTENT_BYTES_MAX {
        return Ok(None);
    }
    // Grows with what is there: a damaged length takes no memory.
    let mut content = Vec::new();
    reader.by_ref().take(length.into()).read_to_end(&mut content)?;
    if content.len() as u64 != u64::from(length) || xxh3_64(&content) != checksum {
        return Ok(None);
    }
    Ok(parse(&content).map(|(layer, record)| (layer, record, 12 + u64::from(length))))
}

/// Fills `bytes`; false if the file ends before.
fn read_whole(reader: &mut impl Read, bytes: &mut [u8]) -> io::Result<bool> {
    match reader.read_exact(bytes) {
        Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => Ok(false),
        other => other.map(|()| true),
    }
}

fn content(layer: u8, record: &Record) -> Vec<u8> {
    let mut out = Vec::new();
    match record {
        Record::Band(band) => {
            out.extend([1, layer]);
            out.extend(band.y0.to_le_bytes());
            out.extend(band.rows.to_le_bytes());
            out.extend(band.low.to_le_bytes());
            out.extend(band.high.to_le_bytes());
            out.extend(band.valid.to_le_bytes());
            out.extend(band.rounding.to_le_bytes());
        }
        Record::Chunk(chunk) => {
            out.reserve(21 + chunk.coded.len() * 36 + chunk.found.len() * 17);
            out.extend([2, layer]);
            out.extend(chunk.number.to_le_bytes());
            out.extend(chunk.finest.to_le_bytes());
            out.extend(u32::try_from(chunk.coded.len()).unwrap_or(u32::MAX).to_le_bytes());
            for c in &chunk.coded {
                let spot = c.spot.unwrap_or(Spot { offset: 0, bytes: 0, checksum: 0 });
                out.extend(c.centre.map(u32::to_le_bytes).as_flattened());
                out.extend(c.low.to_le_bytes());
                out.extend(c.high.to_le_bytes());
                out.extend(spot.bytes.to_le_bytes());
                out.extend(spot.offset.to_le_bytes());
                out.extend(spot.checksum.to_le_bytes());
            }
            out.extend(u32::try_from(chunk.found.len()).unwrap_or(u32::MAX).to_le_bytes());
            for (centre, found) in &chunk.found {
                out.extend(centre.map(u32::to_le_bytes).as_flattened());
                out.extend(found.vertical.to_le_bytes());
                out.push(found.outline.into());
            }
        }
        Record::Tile(tile) => {
            out.reserve(29 + tile.done.len() * 72);
            out.extend([3, layer]);
            out.extend(tile.level.to_le_bytes());
            out.extend(tile.number.to_le_bytes());
            out.extend(tile.finest.map(f64::to_le_bytes).as_flattened());
            out.extend(u32::try_from(tile.done.len()).unwrap_or(u32::MAX).to_le_bytes());
            for one in &tile.done {
                let spot = one.spot.unwrap_or(Spot { offset: 0, bytes: 0, checksum: 0 });
                out.extend(one.centre.map(u32::to_le_bytes).as_flattened());
                out.extend(one.low.to_le_bytes());
                out.extend(one.high.to_le_bytes());
                out.extend(one.triangles.to_le_bytes());
                out.extend(spot.bytes.to_le_bytes());
                out.extend(spot.offset.to_le_bytes());
                out.extend(spot.checksum.to_le_bytes());
                out.extend(one.vertical.to_le_bytes());
                out.extend(one.apart.to_le_bytes());
                out.extend(one.halves.offset.to_le_bytes());
                out.extend(one.halves.bytes.map(u32::to_le_bytes).as_flattened());
            }
        }
    }
    out
}

/// Bytes not yet taken apart.
struct Fields<'a>(&'a [u8]);

impl Fields<'_> {
    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (first, rest) = self.0.split_first_chunk::<N>()?;
        self.0 = rest;
        Some(*first)
    }
    fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }
    fn i32(&mut self) -> Option<i32> {
        self.array().map(i32::from_le_bytes)
    }
    fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }
    fn f64(&mut self) -> Option<f64> {
        self.array().map(f64::from_le_bytes)
    }
    fn centre(&mut self) -> Option<[u32; 2]> {
        Some([self.u32()?, self.u32()?])
    }
}

fn parse(content: &[u8]) -> Option<(u8, Record)> {
    let ([kind, layer], rest) = content.split_first_chunk()?;
    let mut f = Fields(rest);
    let record = match kind {
        1 => Record::Band(Band {
            y0: f.u32()?,
            rows: f.u32()?,
            low: f.i32()?,
            high: f.i32()?,
            valid: f.u64()?,
            rounding: f.f64()?,
        }),
        2 => {
            let mut chunk = Chunk { number: f.u32()?, finest: f.f64()?, ..Chunk::default() };
            for _ in 0..f.u32()? {
                let (centre, low, high) = (f.centre()?, f.i32()?, f.i32()?);
                let (bytes, offset, checksum) = (f.u32()?, f.u64()?, f.u64()?);
                let spot = (bytes > 0).then_some(Spot { offset, bytes, checksum });
                chunk.coded.push(Coded { centre, low, high, spot });
            }
            for _ in 0..f.u32()? {
                let (centre, vertical, [outline]) = (f.centre()?, f.f64()?, f.array()?);
                chunk.found.push((centre, Found { vertical, outline: outline != 0 }));
            }
            Record::Chunk(chunk)
        }
        3 => {
            let mut tile =
                Tile { level: f.u32()?, number: f.u32()?, finest: [f.f64()?, f.f64()?], done: vec![] };
            for _ in 0..f.u32()? {
                let (centre, low, high, triangles) = (f.centre()?, f.i32()?, f.i32()?, f.u32()?);
                let (bytes, offset, checksum) = (f.u32()?, f.u64()?, f.u64()?);
                let spot = (bytes > 0).then_some(Spot { offset, bytes, checksum });
                let (vertical, apart) = (f.f64()?, f.f64()?);
                let halves = Place { offset: f.u64()?, bytes: f.centre()? };
                tile.done.push(Triangulated { centre, low, high, triangles, spot, vertical, apart, halves });
            }
            Record::Tile(tile)
        }
        _ => return None,
    };
    f.0.is_empty().then_some((*layer, record))
}

#[cfg(test)]
mod tests {
    use super::*;

    const FINGERPRINT: Fingerprint = [7; 32];

    fn records() -> Vec<Record> {
        let spot = Some(Spot { offset: 1 << 40, bytes: 12, checksum: u64::MAX });
        vec![
            Record::Band(Band { y0: 0, rows: 256, low: -5, high: 9000, valid: 1 << 33, rounding: 0.004 }),
            Record::Chunk(Chunk {
                number: 3,
                finest: 0.5,
                coded: vec![
                    Coded { centre: [64, 192], low: 1, high: 2, spot },
                    Coded { centre: [0, 64], low: i32::MAX, high: i32::MIN, spot: None },
                ],
                found: vec![([64, 192], Found { vertical: 12.25, outline: true })],
            }),
            Record::Band(Band { y0: 256, rows: 1, low: 0, high: 0, valid: 0, rounding: 0.0 }),
            Record::Tile(Tile {
                level: 7,
                number: 2,
                finest: [0.25, 30.0],
                done: vec![
                    Triangulated {
                        centre: [32, 96],
                        low: -3,
                        high: 8,
                        triangles: 77,
                        spot,
                        vertical: 1.5,
                        apart: 42.0,
                        halves: Place { offset: 1 << 41, bytes: [5, 0] },
                    },
                    Triangulated { centre: [0, 32], ..Triangulated::default() },
                ],
            }),
        ]
    }

    /// A folder with a journal of all records, and where each ends in it.
    fn written() -> (tempfile::TempDir, Vec<u64>) {
        let folder = tempfile::tempdir().unwrap();
        let journal = Journal::create(folder.path(), &FINGERPRINT, Duration::ZERO).unwrap();
        let mut ends = vec![40];
        for (layer, record) in (0..).zip(records()) {
            assert!(journal.note(layer, &record), "with no interval each record is due at once");
            journal.checkpoint(|| Ok(()), |e| e).unwrap();
            ends.push(std::fs::metadata(folder.path().join(NAME)).unwrap().len());
        }
        (folder, ends)
    }

    fn read(folder: &Path) -> Option<Vec<Record>> {
        let mut found = Vec::new();
        let take = |layer, record| {
            assert_eq!(usize::from(layer), found.len() % 4, "the layer goes with the record");
            found.push(record);
            Ok(true)
        };
        Journal::reopen(folder, &FINGERPRINT, Duration::ZERO, take, |e| e).unwrap().map(|_| found)
    }

    #[test]
    fn what_was_synced_is_read_back() {
        let (folder, _) = written();
        assert_eq!(read(folder.path()), Some(records()));
        // And goes on from there.
        let journal = Journal::reopen(folder.path(), &FINGERPRINT, Duration::ZERO, |_, _| Ok(true), |e| e);
        let journal = journal.unwrap().unwrap();
        journal.note(0, &records()[0]);
        journal.checkpoint(|| Ok(()), |e: io::Error| e).unwrap();
        assert_eq!(read(folder.path()).unwrap().len(), 5);
    }

    #[test]
    fn nothing_is_written_that_is_not_synced() {
        let folder = tempfile::tempdir().unwrap();
        let journal = Journal::create(folder.path(), &FINGERPRINT, Duration::ZERO).unwrap();
        journal.note(0, &records()[0]);
        let failed = journal.checkpoint(|| Err(io::Error::other("no room")), |e| e);
        assert!(failed.is_err());
        assert_eq!(read(folder.path()), Some(vec![]));
    }

    #[test]
    fn a_torn_tail_costs_the_torn_record_alone() {
        let (folder, ends) = written();
        let path = folder.path().join(NAME);
        let whole = std::fs::read(&path).unwrap();
        for length in (0..whole.len()).rev() {
            std::fs::write(&path, &whole[..length]).unwrap();
            let intact = ends.iter().filter(|end| **end <= length as u64).count();
            let expected = (intact > 0).then(|| records()[..intact - 1].to_vec());
            assert_eq!(read(folder.path()), expected, "{length} bytes");
            if intact > 0 {
                let left = std::fs::metadata(&path).unwrap().len();
                assert_eq!(left, ends[intact - 1], "the torn tail is cut off");
            }
        }
    }

    #[test]
    fn a_flipped_bit_costs_what_follows_and_invents_nothing() {
        let (folder, ends) = written();
        let path = folder.path().join(NAME);
        let whole = std::fs::read(&path).unwrap();
        for byte in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[byte] ^= 1 << (byte % 8);
            std::fs::write(&path, damaged).unwrap();
            let intact = ends.iter().filter(|end| **end <= byte as u64).count();
            let expected = (intact > 0).then(|| records()[..intact - 1].to_vec());
            assert_eq!(read(folder.path()), expected, "byte {byte}");
        }
    }

    #[test]
    fn another_fingerprint_is_another_build() {
        let (folder, _) = written();
        let other =
            Journal::reopen(folder.path(), &[8; 32], Duration::ZERO, |_, _| panic!("not ours"), |e| e);
        let other = other.unwrap();
        assert!(other.is_none());
        assert_eq!(read(folder.path()), Some(records()), "and is left as it is");
    }
}

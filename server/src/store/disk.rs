//! Pieces of packs of remote stores, kept on a local disk.
//!
//! ```text
//! FOLDER/.lock                    held by the one server that uses the folder
//! FOLDER/<version>/<pack>-<piece> a piece; written under another name first
//! ```
//!
//! Pieces rather than blobs: a hundred blobs that lie together, as those of one region and level do, are one file and
//! one request. What is kept is forgotten by quick_cache's S3-FIFO once it is more than the budget. Nothing
//! here is trusted: blobs are checked whenever they are read, and a piece that a bad one came from is dropped. So nothing has to be
//! synced, and a kill or a loss of power costs what was being written.

use super::{StoreError, io_at};
use crate::seldom::Seldom;
use bytes::Bytes;
use quick_cache::sync::Cache;
use quick_cache::{DefaultHashBuilder, Lifecycle, OptionsBuilder, Weighter};
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Bytes of a piece; the last of a pack has fewer.
pub(super) const PIECE_BYTES: u64 = 256 << 10;

/// What disks give files by.
const BLOCK_BYTES: u64 = 4 << 10;

/// The least budget: some pieces in each part of the cache.
const BUDGET_MIN: u64 = 16 << 20;

/// Parts of the cache that do not wait for one another.
const SHARDS: usize = 4;

/// A piece of a pack of a version.
pub(super) type Piece = (u64, u32, u32);

#[derive(Debug, Clone)]
struct ByBlocks;

impl Weighter<Piece, u32> for ByBlocks {
    fn weight(&self, _: &Piece, bytes: &u32) -> u64 {
        u64::from(*bytes).next_multiple_of(BLOCK_BYTES).max(BLOCK_BYTES)
    }
}

/// Removes the files of what is forgotten.
#[derive(Debug, Clone)]
struct Remove(PathBuf);

/// Files to remove, once nobody waits for the cache.
#[derive(Debug, Default)]
struct Files(Vec<PathBuf>);

impl Drop for Files {
    fn drop(&mut self) {
        for path in &self.0 {
            let _ = fs::remove_file(path);
        }
    }
}

impl Lifecycle<Piece, u32> for Remove {
    type RequestState = Files;

    fn on_evict(&self, files: &mut Files, piece: Piece, _: u32) {
        files.0.push(path(&self.0, piece));
    }
}

fn path(root: &Path, (version, pack, piece): Piece) -> PathBuf {
    root.join(format!("{version:016x}")).join(format!("{pack:05}-{piece:05}"))
}

/// A disk cache. Takes some 100 bytes of memory a piece.
#[derive(Debug)]
pub struct Disk {
    root: PathBuf,
    budget: u64,
    cache: Cache<Piece, u32, ByBlocks, DefaultHashBuilder, Remove>,
    written: AtomicU64,
    failed: AtomicU64,
    seldom: Seldom,
    _lock: File,
}

impl Disk {
    /// Whether so many bytes are enough.
    ///
    /// # Errors
    /// When they are not.
    pub fn check_budget(root: &Path, budget: u64) -> Result<(), StoreError> {
        if budget >= BUDGET_MIN {
            return Ok(());
        }
        let what = format!("--disk-cache-size {budget}: expected at least {BUDGET_MIN} bytes");
        Err(StoreError::DiskCache { path: root.to_owned(), what })
    }

    /// Uses a folder, which no other server may use; what an earlier one kept there stays.
    ///
    /// # Errors
    /// When the folder cannot be written, another program uses it, it holds something else, or the budget is too small.
    pub fn open(root: &Path, budget: u64) -> Result<Self, StoreError> {
        Self::check_budget(root, budget)?;
        let refused = |what: String| StoreError::DiskCache { path: root.to_owned(), what };
        fs::create_dir_all(root)
            .map_err(|e| refused(format!("the folder cannot be made ({e}): choose another one")))?;
        let mut kept = Vec::new();
        for entry in fs::read_dir(root).map_err(io_at("list", root))? {
            let entry = entry.map_err(io_at("list", root))?;
            let name = entry.file_name().to_string_lossy().into_owned();
            match u64::from_str_radix(&name, 16).ok().filter(|_| name.len() == 16) {
                Some(version) => kept.push((version, entry.path())),
                None if name == super::LOCK_FILE || name == "lost+found" => {}
                None => return Err(refused(format!("expected a folder of its own, found '{name}' in it"))),
            }
        }
        let lock = super::lock(root).map_err(|error| match error {
            StoreError::Busy(_) => {
                refused("another server uses it: give each a folder of its own".to_owned())
            }
            other => other,
        })?;
        let mut options = OptionsBuilder::new();
        // The number of items is a hint for the first allocation alone.
        options.weight_capacity(budget).estimated_items_capacity(1024).shards(SHARDS);
        let options = options.build().map_err(|e| refused(e.to_string()))?;
        let remove = Remove(root.to_owned());
        let cache = Cache::with_options(options, ByBlocks, DefaultHashBuilder::default(), remove);
        for (version, folder) in kept {
            for entry in fs::read_dir(&folder).map_err(io_at("list", &folder))?.flatten() {
                let name = entry.file_name().to_string_lossy().into_owned();
                let numbers =
                    name.split_once('-').and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
                let bytes = entry.metadata().ok().and_then(|data| u32::try_from(data.len()).ok());
                match (numbers, bytes) {
                    (Some((pack, piece)), Some(bytes)) => cache.insert((version, pack, piece), bytes),
                    // What was being written.
                    _ => drop(fs::remove_file(entry.path())),
                }
            }
            // Only if nothing is in it.
            let _ = fs::remove_dir(&folder);
        }
        let root = root.to_owned();
        let [written, failed] = [0, 0].map(AtomicU64::new);
        Ok(Self { root, budget, cache, written, failed, seldom: Seldom::default(), _lock: lock })
    }

    /// The piece, if it is kept with that many bytes. Waits for the disk.
    pub(super) fn get(&self, piece: Piece, bytes: u64) -> Option<Bytes> {
        self.cache.get(&piece)?;
        match fs::read(path(&self.root, piece)) {
            Ok(found) if found.len() as u64 == bytes => Some(found.into()),
            _ => {
                self.forget(piece);
                None
            }
        }
    }

    /// Keeps a piece. That the disk fails is counted and told in the log, and nothing else comes of it.
    pub(super) fn put(&self, piece: Piece, bytes: &[u8]) {
        let path = path(&self.root, piece);
        let number = self.written.fetch_add(1, Ordering::Relaxed);
        let fresh = path.with_file_name(format!("new{number}"));
        let write = || {
            if let Some(folder) = path.parent() {
                fs::create_dir_all(folder)?;
            }
            fs::write(&fresh, bytes)?;
            fs::rename(&fresh, &path)
        };
        match write() {
            Ok(()) => self.cache.insert(piece, u32::try_from(bytes.len()).unwrap_or(u32::MAX)),
            Err(error) => {
                let _ = fs::remove_file(&fresh);
                self.failed.fetch_add(1, Ordering::Relaxed);
                if let Some(times) = self.seldom.happened() {
                    tracing::warn!(path = %path.display(), %error, times, "the disk cache cannot be written");
                }
            }
        }
    }

    /// Drops a piece.
    pub(super) fn forget(&self, piece: Piece) {
        self.cache.remove(&piece);
        let _ = fs::remove_file(path(&self.root, piece));
    }

    /// Pieces that could not be written.
    #[must_use]
    pub fn failed(&self) -> u64 {
        self.failed.load(Ordering::Relaxed)
    }

    /// Bytes that are kept, in whole blocks, and the most that may be.
    #[must_use]
    pub fn bytes(&self) -> [u64; 2] {
        [self.cache.weight(), self.budget]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn on_disk(root: &Path) -> u64 {
        let folders = fs::read_dir(root).unwrap().flatten().filter(|e| e.path().is_dir());
        let files = folders.flat_map(|e| fs::read_dir(e.path()).unwrap().flatten());
        files.map(|e| e.metadata().unwrap().len()).sum()
    }

    #[test]
    fn what_is_kept_stays_within_its_budget_also_for_the_next_server() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("cache");
        let piece = vec![7; 250_000];
        {
            let disk = Disk::open(&root, 16 << 20).unwrap();
            for number in 0..200 {
                disk.put((1, number % 3, number), &piece);
                assert!(disk.bytes()[0] <= 16 << 20);
                assert!(disk.get((1, 0, 0), 250_000).is_some(), "what is asked for stays");
            }
            assert!(on_disk(&root) <= 16 << 20 && on_disk(&root) > 8 << 20, "{}", on_disk(&root));
            let told = Disk::open(&root, 16 << 20).unwrap_err().to_string();
            assert!(told.contains("another server"), "{told}");
        }
        // A kill in the middle of a write.
        fs::write(root.join("0000000000000001/new7"), "x").unwrap();
        let kept = on_disk(&root);
        let disk = Disk::open(&root, 32 << 20).unwrap();
        assert_eq!(on_disk(&root), kept - 1);
        assert_eq!(disk.get((1, 0, 0), 250_000).unwrap(), piece);
        // Of another length it is not the piece.
        assert!(disk.get((1, 0, 0), 249_999).is_none() && disk.get((1, 0, 0), 250_000).is_none());
        drop(disk);
        drop(Disk::open(&root, 16 << 20).unwrap());
        assert!(on_disk(&root) <= 16 << 20);
    }

    #[test]
    fn what_cannot_be_written_is_counted_and_not_kept() {
        let folder = tempfile::tempdir().unwrap();
        let disk = Disk::open(folder.path(), 16 << 20).unwrap();
        // No folder can be made where a file is.
        fs::write(folder.path().join(format!("{:016x}", 1)), "x").unwrap();
        for number in 0..3 {
            disk.put((1, 0, number), b"piece");
        }
        disk.put((2, 0, 0), b"piece");
        assert_eq!(disk.failed(), 3);
        assert!(disk.get((1, 0, 0), 5).is_none() && disk.get((2, 0, 0), 5).is_some());
    }

    #[test]
    fn a_folder_with_something_else_in_it_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("thesis.tex"), "x").unwrap();
        let told = Disk::open(folder.path(), 1 << 30).unwrap_err().to_string();
        assert!(told.contains("thesis.tex"), "{told}");
        let told = Disk::open(&folder.path().join("thesis.tex/x"), 1 << 30).unwrap_err().to_string();
        assert!(told.contains("no disk cache") && told.contains("choose another"), "{told}");
        assert!(Disk::open(&folder.path().join("x"), 1000).unwrap_err().to_string().contains("16777216"));
    }
}

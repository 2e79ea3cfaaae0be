//! A scene on disk: packed blobs found by key. It knows no geometry.
//!
//! ```text
//! STORE/scene.json               what the scene is; names the version; replaced atomically
//! STORE/<version>/directory      where each blob lies, sorted by key
//! STORE/<version>/pack-00000     blobs in the order in which a viewer descends
//! STORE/.lock                    held by the one build that may write
//! STORE/.building                a build's work folder; an interrupted build goes on with it
//! STORE/.zoning                  the next version while its zones are written: see [`zones`]
//! ```
//!
//! `<version>` is a hash of the directory (which holds every blob's checksum) and of the scene, so any
//! change of content changes it, and opening a store checks both. A build writes the version's folder,
//! syncs it, and only then renames a new `scene.json` over the old one: whoever opens the store finds
//! the old scene or the new one. The disk is assumed to keep what it was asked to sync.
//!
//! While a build runs, its blobs lie in the work folder's `spool`, in the order in which they come; they are
//! laid into packs at the end. What of the spool is to be trusted after a kill is the builder's to know: it
//! notes a [`Spot`] once [`Writer::sync`] has returned, and hands it to [`Writer::adopt`] when it goes on.
//!
//! The directory is little-endian:
//!
//! | offset | size | field | valid range |
//! |---|---|---|---|
//! | 0 | 8 | magic | `DMTDIR01` |
//! | 8 | 4 | entries | as many as follow |
//! | 12 + 32 i | 1 + 1 + 2 | layer, kind, 0 | |
//! | 16 + 32 i | 4 + 4 | two numbers that complete the key | |
//! | 24 + 32 i | 4 | pack | below the number of packs |
//! | 28 + 32 i | 4 + 4 | offset in the pack, bytes | inside the pack |
//! | 36 + 32 i | 8 | XXH3 of the blob | |

mod disk;
mod objects;
mod publish;
mod remote;
pub mod repair;
mod transport;
pub mod zones;

pub use disk::Disk;
pub use objects::is_address;
pub use publish::{Published, Publisher};
pub use remote::{Counts, Shared};

use bytes::Bytes;
use diamantina_protocol::message::Scene;
use objects::{Failure, Manner, Objects, folder, runtime};
use remote::Remote;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{self, BufWriter, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use xxhash_rust::xxh3::xxh3_64;

/// The format that this build writes, and the only one that it reads.
pub const FORMAT: u32 = 3;

/// A pack is closed once it holds this many bytes.
const PACK_BYTES: u64 = 32 << 20;

/// The largest blob, in bytes; a key that claims more is damaged.
const BLOB_BYTES_MAX: u32 = 16 << 20;

/// The largest `scene.json`, in bytes.
const SCENE_BYTES_MAX: u64 = 4 << 20;

const MAGIC: &[u8; 8] = b"DMTDIR01";
const ENTRY_BYTES: usize = 32;
const SCENE_FILE: &str = "scene.json";
const WORK_FOLDER: &str = ".building";
const LOCK_FILE: &str = ".lock";
/// The work folder while it is being removed.
const GONE_FOLDER: &str = ".building-gone";

/// The name of a blob.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Key {
    /// Position of the layer in the scene.
    pub layer: u8,
    /// What the blob is.
    pub kind: Kind,
    /// The page, or the diamond's x.
    pub a: u32,
    /// 0, or the diamond's y.
    pub b: u32,
}

/// What a blob is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Kind {
    /// A page of the index, zstd-compressed.
    Index,
    /// The points of a diamond.
    Points,
    /// The triangles of a diamond.
    Tin,
    /// A page of the index of triangles, zstd-compressed.
    TinIndex,
    /// A zone's masks, zstd-compressed; the key has layer 255 and the zone's position in the scene.
    Zone,
}

/// Why a store could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The file system said no.
    #[error("{path}: cannot {action}: {error}; {}", remedy(action, error))]
    Io {
        /// What was being done.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// There is no store here.
    #[error(
        "{0}: not a store: expected a folder with a {SCENE_FILE} in it; build one with `diamantina-server build DEM -o {0}`"
    )]
    NotAStore(PathBuf),
    /// Another build holds the lock.
    #[error("{0}: another program is writing this store: wait for it, or choose another folder")]
    Busy(PathBuf),
    /// The folder holds what no build left there.
    #[error(
        "{path}: expected an empty folder or a store, found '{found}' in it: choose another folder with -o"
    )]
    Foreign {
        /// The folder.
        path: PathBuf,
        /// The first of what is in it.
        found: String,
    },
    /// What an interrupted build left is not what it wrote.
    #[error(
        "{path}: damaged since it was written ({key:?} does not match its checksum): build again with --fresh"
    )]
    Spool {
        /// The spool.
        path: PathBuf,
        /// The blob.
        key: Key,
    },
    /// Written by another version.
    #[error("{path}: store has format {found}, this program reads {FORMAT}: build it again")]
    Format {
        /// The store.
        path: PathBuf,
        /// The format found.
        found: u32,
    },
    /// The description would be too long to be read again.
    #[error(
        "{path}: {SCENE_FILE} would have {found} bytes, at most {SCENE_BYTES_MAX}: give its zones fewer corners"
    )]
    Description {
        /// The store.
        path: PathBuf,
        /// Bytes.
        found: usize,
    },
    /// A blob is larger than any that is read.
    #[error(
        "{path}: the masks of zone '{zone}' have {found} bytes, at most {BLOB_BYTES_MAX}: give it a larger --hidden"
    )]
    Blob {
        /// The store.
        path: PathBuf,
        /// The zone.
        zone: String,
        /// Bytes.
        found: usize,
    },
    /// What should name an object store does not.
    #[error("{address}: {reason}")]
    Address {
        /// What was given.
        address: String,
        /// What is wrong with it.
        reason: String,
    },
    /// An object store does not let us.
    #[error(
        "{address}: access denied ({reason}): set the credentials of the object store in the environment (AWS_..., \
         GOOGLE_..., AZURE_...), with the right to read there, and to write for whoever publishes"
    )]
    Denied {
        /// Where.
        address: String,
        /// What the store said.
        reason: String,
    },
    /// An object store cannot be reached.
    #[error(
        "{address}: the object store cannot be reached ({reason}): check the address, AWS_ENDPOINT and the like, the network and the store"
    )]
    Away {
        /// Where.
        address: String,
        /// What happened.
        reason: String,
    },
    /// Somebody else published.
    #[error(
        "{address}: somebody else has published another version there in the meantime: that one stays; look at it, and \
         publish again to replace it"
    )]
    Overtaken {
        /// The description.
        address: String,
    },
    /// The disk cache cannot be used.
    #[error("{path}: no disk cache: {what}")]
    DiskCache {
        /// The folder.
        path: PathBuf,
        /// Why not.
        what: String,
    },
    /// The content does not match its hashes.
    #[error(
        "{path}: damaged: {what}; mend the store from a copy with `diamantina-server repair`, or build it again"
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What was expected and what was found.
        what: String,
    },
}

fn remedy(action: &str, error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            "free some space and build again: the same command goes on where this one ended (the old scene, if any, is untouched)"
        }
        io::ErrorKind::ReadOnlyFilesystem => "choose a folder on a disk that can be written",
        kind if matches!(action, "open" | "read") => match kind {
            io::ErrorKind::PermissionDenied => "ask for the right to read it",
            _ => "build the store again, or copy it again from where it is intact",
        },
        io::ErrorKind::PermissionDenied => "choose a folder that you may write to",
        _ => "check the disk, or choose another folder with -o (the old scene, if any, is untouched)",
    }
}

/// The first thing in a folder that neither a build nor the making of a file system left there, unless the
/// folder is a store already.
fn foreign(root: &Path) -> Option<String> {
    // What cannot be looked into cannot be made a store either: that is said when it is tried.
    let names =
        fs::read_dir(root).ok()?.filter_map(|e| Some(e.ok()?.file_name().to_string_lossy().into_owned()));
    let mut names: Vec<String> = names.collect();
    names.sort();
    // A store is one whatever else its owner keeps in it.
    if matches!(Manifest::read(root), Ok(_) | Err(StoreError::Format { .. })) {
        return None;
    }
    let built_here = names.iter().any(|name| name == LOCK_FILE);
    names.into_iter().find(|name| match name.as_str() {
        LOCK_FILE | WORK_FOLDER | zones::WORK_FOLDER | "lost+found" => false,
        // A damaged description, and versions whose build was killed before it was there.
        SCENE_FILE => !built_here,
        other => !(built_here && is_version(other)),
    })
}

fn io_at<'a>(action: &'static str, path: &'a Path) -> impl Fn(io::Error) -> StoreError + 'a {
    move |error| StoreError::Io { action, path: path.to_owned(), error }
}

/// `scene.json`: the scene and what is needed to check and read the rest.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Manifest {
    format: u32,
    directory_hash: String,
    pack_bytes: Vec<u64>,
    scene: Scene,
}

impl Manifest {
    /// The version that the content has: a hash of everything but the version itself.
    fn version(&self) -> String {
        let mut nameless = self.clone();
        nameless.scene.version = String::new();
        // Our own types always serialise.
        let json = serde_json::to_vec(&nameless).unwrap_or_default();
        blake3::hash(&json).to_hex()[..16].to_owned()
    }
}

/// Where a blob lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Place {
    pack: u32,
    offset: u32,
    bytes: u32,
    checksum: u64,
}

fn kind_code(kind: Kind) -> u8 {
    match kind {
        Kind::Index => 1,
        Kind::Points => 2,
        Kind::Tin => 3,
        Kind::TinIndex => 4,
        Kind::Zone => 16,
    }
}

fn directory_bytes(entries: &[(Key, Place)]) -> Vec<u8> {
    let mut out = Vec::with_capacity(12 + entries.len() * ENTRY_BYTES);
    out.extend(MAGIC);
    out.extend(u32::try_from(entries.len()).unwrap_or(u32::MAX).to_le_bytes());
    for (key, place) in entries {
        out.extend([key.layer, kind_code(key.kind), 0, 0]);
        for number in [key.a, key.b, place.pack, place.offset, place.bytes] {
            out.extend(number.to_le_bytes());
        }
        out.extend(place.checksum.to_le_bytes());
    }
    out
}

fn read_directory(bytes: &[u8], pack_bytes: &[u64]) -> Result<Vec<(Key, Place)>, String> {
    let (head, rest) = bytes.split_first_chunk::<12>().ok_or("directory is cut off")?;
    if head[..8] != *MAGIC {
        return Err(format!("directory starts with {:02x?}, expected {MAGIC:02x?}", &head[..8]));
    }
    let (entries, tail) = rest.as_chunks::<ENTRY_BYTES>();
    let count = u32::from_le_bytes([head[8], head[9], head[10], head[11]]);
    if !tail.is_empty() || entries.len() != count as usize {
        return Err(format!("directory claims {count} blobs and lists {}", entries.len()));
    }
    let mut list = Vec::with_capacity(entries.len());
    for e in entries {
        let number = |i: usize| u32::from_le_bytes([e[i], e[i + 1], e[i + 2], e[i + 3]]);
        let kind = match e[1] {
            1 => Kind::Index,
            2 => Kind::Points,
            3 => Kind::Tin,
            4 => Kind::TinIndex,
            16 => Kind::Zone,
            other => return Err(format!("directory has a blob of kind {other}")),
        };
        let key = Key { layer: e[0], kind, a: number(4), b: number(8) };
        let checksum = u64::from(number(24)) | u64::from(number(28)) << 32;
        let place = Place { pack: number(12), offset: number(16), bytes: number(20), checksum };
        let room = pack_bytes.get(place.pack as usize).copied().unwrap_or(0);
        if place.bytes > BLOB_BYTES_MAX || u64::from(place.offset) + u64::from(place.bytes) > room {
            return Err(format!("{key:?} lies outside of its pack"));
        }
        list.push((key, place));
    }
    Ok(list)
}

/// Where a blob lies in the spool of a build under way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Spot {
    /// Bytes before it.
    pub offset: u64,
    /// Its length.
    pub bytes: u32,
    /// Its XXH3.
    pub checksum: u64,
}

/// A store being written. Dropped, it leaves nothing behind but what was published, unless told to
/// [`Writer::keep`] the work for another run.
///
/// Takes 40 bytes of memory a blob, and 80 more while it publishes.
#[derive(Debug)]
pub struct Writer {
    root: PathBuf,
    work: PathBuf,
    /// Keeps the lock while the writer lives.
    _lock: File,
    spool: Mutex<Spool>,
    kept: AtomicBool,
}

#[derive(Debug)]
struct Spool {
    file: BufWriter<File>,
    bytes: u64,
    blobs: Vec<Spooled>,
}

#[derive(Debug, Clone, Copy)]
struct Spooled {
    order: u64,
    key: Key,
    spot: Spot,
}

impl Writer {
    /// Starts a store at `root`, which may hold an older one: that stays as it is until
    /// [`Writer::publish`]. What an interrupted build left in the work folder stays until
    /// [`Writer::clear`] or the end.
    ///
    /// # Errors
    /// When another program is at work there or the folder cannot be written.
    pub fn create(root: &Path) -> Result<Self, StoreError> {
        if is_address(root) {
            return Err(StoreError::Address {
                address: root.to_string_lossy().into_owned(),
                reason: "a store is built in a folder, and published from there".to_owned(),
            });
        }
        let root = folder(root);
        if let Some(found) = foreign(root) {
            return Err(StoreError::Foreign { path: root.to_owned(), found });
        }
        fs::create_dir_all(root).map_err(io_at("create the folder", root))?;
        let lock = lock(root)?;
        // Whoever left something here is gone, since the lock was free.
        let gone = root.join(GONE_FOLDER);
        if gone.exists() {
            fs::remove_dir_all(&gone).map_err(io_at("remove the leftovers in", &gone))?;
        }
        let work = root.join(WORK_FOLDER);
        fs::create_dir_all(&work).map_err(io_at("create the folder", &work))?;
        let path = work.join("spool");
        let spool = File::options().create(true).truncate(false).read(true).write(true).open(&path);
        let file = BufWriter::with_capacity(1 << 20, spool.map_err(io_at("create", &path))?);
        let spool = Mutex::new(Spool { file, bytes: 0, blobs: Vec::new() });
        Ok(Self { root: root.to_owned(), work, _lock: lock, spool, kept: AtomicBool::new(false) })
    }

    /// A folder for the builder's own files; it goes with the work folder.
    #[must_use]
    pub fn work_folder(&self) -> &Path {
        &self.work
    }

    /// Leaves the work folder behind for another run to go on with.
    pub fn keep(&self) {
        self.kept.store(true, Ordering::Relaxed);
    }

    /// Removes what an earlier build left in the work folder.
    ///
    /// # Errors
    /// When something cannot be removed.
    pub fn clear(&self) -> Result<(), StoreError> {
        let entries = fs::read_dir(&self.work).map_err(io_at("list", &self.work))?;
        for entry in entries {
            let path = entry.map_err(io_at("list", &self.work))?.path();
            if path.ends_with("spool") {
                continue;
            }
            let removed = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
            removed.map_err(io_at("remove the leftovers in", &path))?;
        }
        self.settle()
    }

    /// Takes over blobs that an earlier run put and synced; `false`, with none taken, if the spool has not that
    /// many bytes. Whether the bytes are still the same is found when they are laid into a pack.
    ///
    /// # Errors
    /// When the spool cannot be asked for its length.
    pub fn adopt(&self, blobs: &[(Key, u64, Spot)]) -> Result<bool, StoreError> {
        let mut spool = self.spool();
        let path = self.work.join("spool");
        let length = spool.file.get_ref().metadata().map_err(io_at("read", &path))?.len();
        let end = |spot: &Spot| spot.offset.saturating_add(spot.bytes.into());
        if blobs.iter().any(|(.., spot)| end(spot) > length) {
            return Ok(false);
        }
        for (key, order, spot) in blobs {
            spool.bytes = spool.bytes.max(end(spot));
            spool.blobs.push(Spooled { order: *order, key: *key, spot: *spot });
        }
        Ok(true)
    }

    /// Cuts off what the spool has behind the blobs that were adopted, and puts on from there.
    ///
    /// # Errors
    /// When the disk fails.
    pub fn settle(&self) -> Result<(), StoreError> {
        let mut spool = self.spool();
        let path = self.work.join("spool");
        let end = spool.bytes;
        spool.file.get_ref().set_len(end).map_err(io_at("shorten", &path))?;
        spool.file.seek(SeekFrom::Start(end)).map_err(io_at("write", &path))?;
        Ok(())
    }

    /// Adds a blob. Blobs are laid down by `order`, then key, whatever the order of the calls.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn put(&self, key: Key, order: u64, blob: &[u8]) -> Result<Spot, StoreError> {
        let checksum = xxh3_64(blob);
        let mut spool = self.spool();
        spool.file.write_all(blob).map_err(io_at("write", &self.work.join("spool")))?;
        let bytes = u32::try_from(blob.len()).unwrap_or(u32::MAX);
        let spot = Spot { offset: spool.bytes, bytes, checksum };
        spool.bytes += blob.len() as u64;
        spool.blobs.push(Spooled { order, key, spot });
        Ok(spot)
    }

    /// Makes sure that what was put is on the disk.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn sync(&self) -> Result<(), StoreError> {
        let path = self.work.join("spool");
        let file = {
            let mut spool = self.spool();
            spool.file.flush().map_err(io_at("write", &path))?;
            spool.file.get_ref().try_clone().map_err(io_at("sync", &path))?
        };
        // Others may put on meanwhile.
        file.sync_data().map_err(io_at("sync", &path))
    }

    fn spool(&self) -> std::sync::MutexGuard<'_, Spool> {
        self.spool.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    /// Lays the blobs into packs and makes the scene the store's own, atomically. `scene.version` is
    /// filled in; the result is the scene as published, or `None` if `go_on`, asked before each pack with the
    /// bytes of the one before, said no. Folders of other versions are removed.
    ///
    /// # Errors
    /// When the disk is full or fails: the old scene, if any, is then untouched.
    pub fn publish(&self, scene: Scene, go_on: impl Fn(u64) -> bool) -> Result<Option<Scene>, StoreError> {
        let mut spool = self.spool();
        let spool_path = self.work.join("spool");
        spool.file.flush().map_err(io_at("write", &spool_path))?;
        spool.blobs.sort_unstable_by_key(|b| (b.order, b.key));
        let data = self.work.join("data");
        // A kill may have come while an earlier run was here.
        if data.exists() {
            fs::remove_dir_all(&data).map_err(io_at("remove the leftovers in", &data))?;
        }
        fs::create_dir(&data).map_err(io_at("create the folder", &data))?;
        let packed = lay_packs(spool.file.get_ref(), &spool_path, &spool.blobs, &data, go_on)?;
        let Some((mut entries, pack_bytes)) = packed else { return Ok(None) };
        make_current(&self.root, &self.work, &mut entries, pack_bytes, scene).map(Some)
    }
}

/// The right to write a store, until dropped.
fn lock(root: &Path) -> Result<File, StoreError> {
    let path = root.join(LOCK_FILE);
    let file = File::options().create(true).append(true).open(&path).map_err(io_at("create", &path))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(fs::TryLockError::WouldBlock) => Err(StoreError::Busy(root.to_owned())),
        Err(fs::TryLockError::Error(error)) => Err(io_at("lock", &path)(error)),
    }
}

/// Completes the version whose packs lie in the folder `data` of `work`, moves it into place and makes it
/// current, atomically; folders of other versions are removed. The result is the scene with its version.
fn make_current(
    root: &Path,
    work: &Path,
    entries: &mut [(Key, Place)],
    pack_bytes: Vec<u64>,
    mut scene: Scene,
) -> Result<Scene, StoreError> {
    let data = work.join("data");
    entries.sort_unstable_by_key(|(key, _)| *key);
    let directory = directory_bytes(entries);
    write_synced(&data.join("directory"), &directory)?;
    let directory_hash = blake3::hash(&directory).to_hex().to_string();
    scene.version = String::new();
    let mut manifest = Manifest { format: FORMAT, directory_hash, pack_bytes, scene };
    manifest.scene.version = manifest.version();
    let json = serde_json::to_vec_pretty(&manifest).unwrap_or_default();
    if json.len() as u64 > SCENE_BYTES_MAX {
        return Err(StoreError::Description { path: root.to_owned(), found: json.len() });
    }
    sync_folder(&data)?;
    move_into_place(&data, &root.join(&manifest.scene.version))?;
    sync_folder(root)?;
    let fresh = work.join(SCENE_FILE);
    write_synced(&fresh, &json)?;
    let current = root.join(SCENE_FILE);
    fs::rename(&fresh, &current).map_err(io_at("publish", &current))?;
    sync_folder(root)?;
    remove_others(root, &manifest.scene.version);
    Ok(manifest.scene)
}

impl Drop for Writer {
    fn drop(&mut self) {
        if !self.kept.load(Ordering::Relaxed) {
            // In one step, so that a kill leaves no half of a work folder for anyone to go on with.
            let gone = self.root.join(GONE_FOLDER);
            let _ = fs::rename(&self.work, &gone).and_then(|()| fs::remove_dir_all(&gone));
        }
    }
}

/// Moves a finished version into place. Where the same content is already, its files are replaced one by
/// one: they may be the current scene's, which must be whole at every moment.
fn move_into_place(data: &Path, place: &Path) -> Result<(), StoreError> {
    if !place.exists() {
        return fs::rename(data, place).map_err(io_at("move into place", place));
    }
    for entry in fs::read_dir(data).map_err(io_at("list", data))? {
        let entry = entry.map_err(io_at("list", data))?;
        let target = place.join(entry.file_name());
        fs::rename(entry.path(), &target).map_err(io_at("replace", &target))?;
    }
    sync_folder(place)
}

/// Removes the folders of versions that are not current: the one before, and what a kill left of others.
/// A server that has one open keeps its files; who cannot remove one only keeps some bytes more.
fn remove_others(root: &Path, current: &str) {
    for entry in fs::read_dir(root).into_iter().flatten().flatten() {
        let name = entry.file_name();
        if name.to_str().is_some_and(is_version) && name != current && entry.path().join("directory").exists()
        {
            let _ = fs::remove_dir_all(entry.path());
        }
    }
}

/// Where each blob went, and the bytes of each pack.
type Packed = (Vec<(Key, Place)>, Vec<u64>);

/// Copies the blobs, in order, into packs; `None` if `go_on`, asked before each, said no.
fn lay_packs(
    spool: &File,
    spool_path: &Path,
    blobs: &[Spooled],
    data: &Path,
    go_on: impl Fn(u64) -> bool,
) -> Result<Option<Packed>, StoreError> {
    let mut entries = Vec::with_capacity(blobs.len());
    let mut pack_bytes = Vec::new();
    let mut buffer = Vec::new();
    let mut rest = blobs;
    while !rest.is_empty() {
        if !go_on(pack_bytes.last().copied().unwrap_or(0)) {
            return Ok(None);
        }
        let path = data.join(pack_name(pack_bytes.len()));
        let file = File::create_new(&path).map_err(io_at("create", &path))?;
        let mut out = BufWriter::with_capacity(1 << 20, file);
        let mut written = 0u64;
        while let Some((Spooled { key, spot, .. }, more)) = rest.split_first() {
            if written > 0 && written + u64::from(spot.bytes) > PACK_BYTES {
                break;
            }
            buffer.resize(spot.bytes as usize, 0);
            spool.read_exact_at(&mut buffer, spot.offset).map_err(io_at("read", spool_path))?;
            if xxh3_64(&buffer) != spot.checksum {
                return Err(StoreError::Spool { path: spool_path.to_owned(), key: *key });
            }
            out.write_all(&buffer).map_err(io_at("write", &path))?;
            let place = Place {
                pack: u32::try_from(pack_bytes.len()).unwrap_or(u32::MAX),
                offset: u32::try_from(written).unwrap_or(u32::MAX),
                bytes: spot.bytes,
                checksum: spot.checksum,
            };
            entries.push((*key, place));
            written += u64::from(spot.bytes);
            rest = more;
        }
        let file = out.into_inner().map_err(|e| io_at("write", &path)(e.into_error()))?;
        file.sync_all().map_err(io_at("sync", &path))?;
        pack_bytes.push(written);
    }
    Ok(Some((entries, pack_bytes)))
}

/// Whether something is named as a version is.
fn is_version(name: &str) -> bool {
    name.len() == 16 && name.bytes().all(|b| b.is_ascii_hexdigit())
}

fn pack_name(number: usize) -> String {
    format!("pack-{number:05}")
}

fn write_synced(path: &Path, bytes: &[u8]) -> Result<(), StoreError> {
    let mut file = File::create(path).map_err(io_at("create", path))?;
    file.write_all(bytes).map_err(io_at("write", path))?;
    file.sync_all().map_err(io_at("sync", path))
}

fn sync_folder(path: &Path) -> Result<(), StoreError> {
    File::open(path).and_then(|f| f.sync_all()).map_err(io_at("sync the folder", path))
}

impl Manifest {
    /// Where the blobs lie, as the directory at `path` says.
    fn places(&self, directory: &[u8], path: &Path) -> Result<HashMap<Key, Place>, StoreError> {
        let damaged = |what: String| StoreError::Damaged { path: path.to_owned(), what };
        if blake3::hash(directory).to_hex().as_str() != self.directory_hash {
            return Err(damaged("it does not match the hash in scene.json".to_owned()));
        }
        Ok(read_directory(directory, &self.pack_bytes).map_err(damaged)?.into_iter().collect())
    }

    fn read(root: &Path) -> Result<Self, StoreError> {
        let path = root.join(SCENE_FILE);
        let mut file = match File::open(&path) {
            Ok(file) => file,
            Err(e) if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
                return Err(StoreError::NotAStore(root.to_owned()));
            }
            Err(e) => return Err(io_at("open", &path)(e)),
        };
        let mut text = Vec::new();
        Read::by_ref(&mut file).take(SCENE_BYTES_MAX).read_to_end(&mut text).map_err(io_at("read", &path))?;
        Self::parse(&text, &path, root)
    }

    /// What the text of a description at `path` says, of the store at `root`.
    fn parse(text: &[u8], path: &Path, root: &Path) -> Result<Self, StoreError> {
        let damaged = |what: String| StoreError::Damaged { path: path.to_owned(), what };
        let value: serde_json::Value =
            serde_json::from_slice(text).map_err(|e| damaged(format!("not JSON ({e})")))?;
        match value.get("format").and_then(serde_json::Value::as_u64) {
            Some(format) if format == u64::from(FORMAT) => {}
            Some(format) => {
                let found = u32::try_from(format).unwrap_or(u32::MAX);
                return Err(StoreError::Format { path: root.to_owned(), found });
            }
            None => return Err(damaged("no format number".to_owned())),
        }
        let manifest: Self = serde_json::from_value(value).map_err(|e| damaged(e.to_string()))?;
        // The hash below is of values; what reads as the same values but was not written so is damage too.
        if serde_json::to_vec_pretty(&manifest).ok().as_deref() != Some(text) {
            return Err(damaged("its text is not as it was written".to_owned()));
        }
        if manifest.version() != manifest.scene.version {
            return Err(damaged(format!(
                "says version {}, its content has {}",
                manifest.scene.version,
                manifest.version()
            )));
        }
        Ok(manifest)
    }
}

/// Bytes of a directory that are read at once from an object store.
const DIRECTORY_PIECE: u64 = 4 << 20;

/// Where blobs are read from.
#[derive(Debug)]
enum Source {
    /// Files, open.
    Packs(Vec<(PathBuf, File)>),
    Remote(Arc<Remote>),
}

/// A store opened for reading. Cheap to share; reads do not block one another.
#[derive(Debug)]
pub struct Store {
    root: PathBuf,
    scene: Scene,
    source: Source,
    places: HashMap<Key, Place>,
    shared: Arc<Shared>,
}

fn damaged_blob(path: PathBuf, key: Key, place: &Place, found: u64) -> StoreError {
    let what = format!(
        "blob {key:?} at byte {} has checksum {found:016x}, expected {:016x}",
        place.offset, place.checksum
    );
    StoreError::Damaged { path, what }
}

impl Store {
    /// Opens the scene that is current at `root`, a folder or the address of an object store, checking the description
    /// and the directory against their hashes. Takes about 60 bytes of memory a blob.
    ///
    /// # Errors
    /// When there is no store, it is of another format, or damaged.
    pub fn open(root: &Path) -> Result<Self, StoreError> {
        Self::open_sharing(root, &Arc::default())
    }

    /// The same, with what stores share.
    ///
    /// # Errors
    /// As [`Store::open`].
    pub fn open_sharing(root: &Path, shared: &Arc<Shared>) -> Result<Self, StoreError> {
        if is_address(root) {
            return Self::open_remote(root, Objects::open(root, Manner::Serving)?, shared);
        }
        let root = folder(root);
        let manifest = Manifest::read(root)?;
        let data = root.join(&manifest.scene.version);
        let path = data.join("directory");
        let bytes = fs::read(&path).map_err(io_at("read", &path))?;
        let places = manifest.places(&bytes, &path)?;
        let mut packs = Vec::new();
        for (i, expected) in manifest.pack_bytes.iter().enumerate() {
            let path = data.join(pack_name(i));
            let mut file = File::open(&path).map_err(io_at("open", &path))?;
            let found = file.seek(SeekFrom::End(0)).map_err(io_at("read", &path))?;
            if found != *expected {
                let what = format!("has {found} bytes, expected {expected}");
                return Err(StoreError::Damaged { path, what });
            }
            packs.push((path, file));
        }
        let (source, shared) = (Source::Packs(packs), Arc::clone(shared));
        Ok(Self { root: root.to_owned(), scene: manifest.scene, source, places, shared })
    }

    fn open_remote(root: &Path, objects: Objects, shared: &Arc<Shared>) -> Result<Self, StoreError> {
        runtime()?.block_on(async {
            let path = objects.address(SCENE_FILE);
            let described =
                objects.read(SCENE_FILE, SCENE_BYTES_MAX).await.map_err(|failure| match failure {
                    Failure::Missing => StoreError::NotAStore(root.to_owned()),
                    other => other.at(path.clone()),
                })?;
            let manifest = Manifest::parse(&described.bytes, Path::new(&path), root)?;
            let version = manifest.scene.version.clone();
            let below = format!("{version}/directory");
            let path = objects.address(&below);
            let bytes = objects.read_long(&below, DIRECTORY_PIECE).await.map_err(|f| f.at(path.clone()))?;
            let places = manifest.places(&bytes, Path::new(&path))?;
            let remote = Remote {
                objects,
                number: number(&version),
                version,
                pack_bytes: manifest.pack_bytes,
                e_tag: described.version.e_tag,
                shared: Arc::clone(shared),
                asking: std::array::from_fn(|_| tokio::sync::Mutex::new(())),
            };
            let (source, shared) = (Source::Remote(Arc::new(remote)), Arc::clone(shared));
            Ok(Self { root: root.to_owned(), scene: manifest.scene, source, places, shared })
        })
    }

    /// Opens what is current now where this store is from.
    ///
    /// # Errors
    /// As [`Store::open`].
    pub fn reopen(&self) -> Result<Self, StoreError> {
        match &self.source {
            Source::Packs(_) => Self::open_sharing(&self.root, &self.shared),
            // With its connections, and what is known of it.
            Source::Remote(remote) => Self::open_remote(&self.root, remote.objects.clone(), &self.shared),
        }
    }

    /// The version that is published where this store is from, if it is another one.
    ///
    /// # Errors
    /// When there is no store, or one of another format, or it cannot be reached.
    pub fn newer(&self) -> Result<Option<String>, StoreError> {
        let manifest = match &self.source {
            Source::Packs(_) => Some(Manifest::read(&self.root)?),
            Source::Remote(remote) => runtime()?.block_on(async {
                let path = remote.objects.address(SCENE_FILE);
                let known = remote.e_tag.as_deref();
                let read = remote.objects.read_newer(SCENE_FILE, SCENE_BYTES_MAX, known).await;
                let thing = read.map_err(|failure| failure.at(path.clone()))?;
                thing.map(|thing| Manifest::parse(&thing.bytes, Path::new(&path), &self.root)).transpose()
            })?,
        };
        Ok(manifest.map(|manifest| manifest.scene.version).filter(|version| *version != self.scene.version))
    }

    /// Whether blobs come from an object store.
    #[must_use]
    pub fn is_remote(&self) -> bool {
        matches!(self.source, Source::Remote(_))
    }

    /// How long the object store has not been reached, if it is one and that is so.
    #[must_use]
    pub fn away(&self) -> Option<std::time::Duration> {
        match &self.source {
            Source::Packs(_) => None,
            Source::Remote(remote) => remote.objects.away(),
        }
    }

    /// What stores that were opened together share.
    #[must_use]
    pub fn shared(&self) -> &Arc<Shared> {
        &self.shared
    }

    /// The folder, or the address.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// What the scene is.
    #[must_use]
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Whether there is a blob of a key.
    #[must_use]
    pub fn has(&self, key: Key) -> bool {
        self.places.contains_key(&key)
    }

    /// The blob of a key, checked; `None` if there is none. Waits for the disk or the network: never to be called by a
    /// task of an async runtime.
    ///
    /// # Errors
    /// When the disk or the object store fails or the blob does not match its checksum.
    pub fn get(&self, key: Key) -> Result<Option<Bytes>, StoreError> {
        let Some(place) = self.places.get(&key) else { return Ok(None) };
        let packs = match &self.source {
            Source::Packs(packs) => packs,
            Source::Remote(remote) => {
                let blobs = runtime()?.block_on(remote.blobs(&[(key, *place)]));
                return blobs.into_iter().next().transpose();
            }
        };
        let (path, file) = &packs[place.pack as usize];
        let mut blob = vec![0; place.bytes as usize];
        file.read_exact_at(&mut blob, place.offset.into()).map_err(io_at("read", path))?;
        let found = xxh3_64(&blob);
        if found != place.checksum {
            return Err(damaged_blob(path.clone(), key, place, found));
        }
        Ok(Some(blob.into()))
    }

    /// As [`Store::get`], for many; those that lie together in an object store are asked for together.
    pub fn get_many(&self, keys: &[Key]) -> Vec<Result<Option<Bytes>, StoreError>> {
        let Source::Remote(remote) = &self.source else {
            return keys.iter().map(|key| self.get(*key)).collect();
        };
        let wanted = self.wanted(keys);
        match runtime() {
            Ok(runtime) => in_place(&wanted, runtime.block_on(remote.blobs(&found(&wanted)))),
            // It says why each time.
            Err(_) => keys.iter().map(|key| self.get(*key)).collect(),
        }
    }

    /// As [`Store::get_many`], without a thread that waits, where blobs come from an object store; `None` elsewhere.
    pub async fn fetch(&self, keys: &[Key]) -> Option<Vec<Result<Option<Bytes>, StoreError>>> {
        let Source::Remote(remote) = &self.source else { return None };
        let wanted = self.wanted(keys);
        let (remote, asked) = (Arc::clone(remote), found(&wanted));
        let blobs = runtime().ok()?.spawn(async move { remote.blobs(&asked).await }).await.ok()?;
        Some(in_place(&wanted, blobs))
    }

    fn wanted(&self, keys: &[Key]) -> Vec<Option<(Key, Place)>> {
        keys.iter().map(|key| self.places.get(key).map(|place| (*key, *place))).collect()
    }

    /// Every key with its size in bytes, in no order.
    pub fn keys(&self) -> impl Iterator<Item = (Key, u32)> {
        self.places.iter().map(|(key, place)| (*key, place.bytes))
    }

    /// Reads the last blob of each pack: that it is there and whole.
    ///
    /// # Errors
    /// As [`Store::get`].
    pub fn probe(&self) -> Result<(), StoreError> {
        let mut last: HashMap<u32, (u32, Key)> = HashMap::new();
        for (key, place) in &self.places {
            let found = last.entry(place.pack).or_insert((place.offset, *key));
            *found = (*found).max((place.offset, *key));
        }
        let keys: Vec<Key> = last.into_values().map(|(_, key)| key).collect();
        for keys in keys.chunks(64) {
            self.get_many(keys).into_iter().try_for_each(|blob| blob.map(drop))?;
        }
        Ok(())
    }

    /// Every key, as the blobs lie.
    #[must_use]
    pub fn keys_in_order(&self) -> Vec<Key> {
        let mut keys: Vec<(u32, u32, Key)> =
            self.places.iter().map(|(k, p)| (p.pack, p.offset, *k)).collect();
        keys.sort_unstable();
        keys.into_iter().map(|(.., key)| key).collect()
    }
}

fn found(wanted: &[Option<(Key, Place)>]) -> Vec<(Key, Place)> {
    wanted.iter().flatten().copied().collect()
}

/// Puts blobs where their keys were, with nothing between where there is none.
fn in_place(
    wanted: &[Option<(Key, Place)>],
    blobs: Vec<Result<Bytes, StoreError>>,
) -> Vec<Result<Option<Bytes>, StoreError>> {
    let mut blobs = blobs.into_iter();
    wanted.iter().map(|found| found.as_ref().and_then(|_| blobs.next()).transpose()).collect()
}

/// A version, which is a hash, as a number.
#[must_use]
pub fn number(version: &str) -> u64 {
    u64::from_str_radix(version, 16).unwrap_or_else(|_| xxh3_64(version.as_bytes()))
}

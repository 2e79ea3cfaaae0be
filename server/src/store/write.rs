//! Writing a store: blobs are put, spooled, laid into packs and published at once.

use super::error::io_at;
use super::format::{
    FORMAT, Manifest, Place, SCENE_BYTES_MAX, SCENE_FILE, directory_bytes, is_version, pack_name,
};
use super::objects::{folder, is_address};
use super::{Key, StoreError, zones};
use diamantina_protocol::message::Scene;
use std::fs::{self, File};
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use xxhash_rust::xxh3::xxh3_64;

/// A pack is closed once it holds this many bytes.
const PACK_BYTES: u64 = 32 << 20;

const WORK_FOLDER: &str = ".building";
pub(super) const LOCK_FILE: &str = ".lock";
/// The work folder while it is being removed.
const GONE_FOLDER: &str = ".building-gone";

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
pub(super) fn lock(root: &Path) -> Result<File, StoreError> {
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
pub(super) fn make_current(
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
/// A server that has one open keeps its files; who cannot remove one only keeps some bytes more. Each goes under another name
/// first: of half a version nobody would know later that it was one.
fn remove_others(root: &Path, current: &str) {
    let gone = root.join(GONE_FOLDER);
    let _ = fs::remove_dir_all(&gone);
    for entry in fs::read_dir(root).into_iter().flatten().flatten() {
        let name = entry.file_name();
        if name.to_str().is_some_and(is_version) && name != current && entry.path().join("directory").exists()
        {
            let _ = fs::rename(entry.path(), &gone).and_then(|()| fs::remove_dir_all(&gone));
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

pub(super) fn write_synced(path: &Path, bytes: &[u8]) -> Result<(), StoreError> {
    let mut file = File::create(path).map_err(io_at("create", path))?;
    file.write_all(bytes).map_err(io_at("write", path))?;
    file.sync_all().map_err(io_at("sync", path))
}

pub(super) fn sync_folder(path: &Path) -> Result<(), StoreError> {
    File::open(path).and_then(|f| f.sync_all()).map_err(io_at("sync the folder", path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn of_other_versions_nothing_is_left_though_a_removal_was_cut_off() {
        let folder = tempfile::tempdir().unwrap();
        let version = |digit: u8| char::from(digit).to_string().repeat(16);
        let put = |name: &str, file: &str| {
            let path = folder.path().join(name);
            fs::create_dir_all(&path).unwrap();
            fs::write(path.join(file), b"x").unwrap();
        };
        put(&version(b'a'), "directory");
        for other in [b'b', b'c'] {
            put(&version(other), "directory");
            put(&version(other), "pack-00000");
        }
        // A kill left half of one, and somebody's own folder looks like a version.
        put(GONE_FOLDER, "pack-00000");
        put(&version(b'd'), "photos");
        remove_others(folder.path(), &version(b'a'));
        let left = fs::read_dir(folder.path()).unwrap();
        let left: BTreeSet<_> = left.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        assert_eq!(left, [version(b'a'), version(b'd')].into());
    }
}

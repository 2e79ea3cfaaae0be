//! Zones come to a store, and go, without a build: the next version has the same packs, by hard links, and one
//! more for the zones' masks.
//!
//! The pack of the zones comes last and holds nothing else, so that a store whose zones are all gone again has
//! its first version back, to the byte. What is under way lies in `.zoning`; it is published as a build is, so a
//! kill leaves the old version or the new one.

use super::{
    BLOB_BYTES_MAX, Key, Kind, Manifest, Place, Source, Store, StoreError, folder, io_at, is_address, lock,
    make_current, pack_name, write_synced,
};
use bytes::Bytes;
use diamantina_protocol::message::Scene;
use diamantina_protocol::zone::Zone;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use xxhash_rust::xxh3::xxh3_64;

/// The folder of what is under way.
pub(super) const WORK_FOLDER: &str = ".zoning";

/// The key of the masks of the zone at a position in the scene.
#[must_use]
pub fn key(position: usize) -> Key {
    Key { layer: u8::MAX, kind: Kind::Zone, a: u32::try_from(position).unwrap_or(u32::MAX), b: 0 }
}

/// The right to change the zones of a store, until dropped. Readers are not disturbed.
#[derive(Debug)]
pub struct Zones {
    _lock: File,
    store: Store,
}

impl Zones {
    /// Waits for nobody: takes the right that a build takes.
    ///
    /// # Errors
    /// When there is no store, it is damaged, or something else writes it.
    pub fn open(root: &Path) -> Result<Self, StoreError> {
        if is_address(root) {
            return Err(StoreError::Address {
                address: root.to_string_lossy().into_owned(),
                reason: "zones are added in a folder: add them there, then `diamantina-server publish` it"
                    .to_owned(),
            });
        }
        let root = folder(root);
        // Before anything is left in a folder that is none.
        Manifest::read(root)?;
        let lock = lock(root)?;
        Ok(Self { _lock: lock, store: Store::open(root)? })
    }

    /// The store as it is.
    #[must_use]
    pub fn store(&self) -> &Store {
        &self.store
    }

    /// The zones as they are, with their masks.
    ///
    /// # Errors
    /// When a mask is missing or damaged.
    pub fn read(&self) -> Result<Vec<(Zone, Bytes)>, StoreError> {
        let with_masks = |(i, zone): (usize, &Zone)| {
            let blob = self.store.get(key(i))?.ok_or_else(|| StoreError::Damaged {
                path: self.store.root().to_owned(),
                what: format!("the masks of zone '{}' are missing", zone.name),
            })?;
            Ok((zone.clone(), blob))
        };
        self.store.scene().zones.iter().enumerate().map(with_masks).collect()
    }

    /// Publishes the scene with these zones in place of those that it has, atomically. The result is the scene as
    /// published.
    ///
    /// # Errors
    /// When the disk is full or fails, or a mask is too large: the old version is then untouched.
    pub fn publish(&self, zones: &[(Zone, Bytes)]) -> Result<Scene, StoreError> {
        let root = self.store.root();
        let work = Work::create(root)?;
        let data = work.0.join("data");
        fs::create_dir(&data).map_err(io_at("create the folder", &data))?;
        let kept = self.store.places.iter().filter(|(key, _)| key.kind != Kind::Zone);
        let mut entries: Vec<(Key, Place)> = kept.map(|(key, place)| (*key, *place)).collect();
        let packs = entries.iter().map(|(_, place)| place.pack as usize + 1).max().unwrap_or(0);
        let mut pack_bytes = Vec::with_capacity(packs + 1);
        let Source::Packs(files) = &self.store.source else {
            return Err(StoreError::NotAStore(root.to_owned()));
        };
        for (i, (path, file)) in files.iter().take(packs).enumerate() {
            let to = data.join(pack_name(i));
            // A file system without links gets a copy.
            fs::hard_link(path, &to)
                .or_else(|_| fs::copy(path, &to).and_then(|_| File::open(&to)?.sync_all()))
                .map_err(io_at("link", &to))?;
            pack_bytes.push(file.metadata().map_err(io_at("read", path))?.len());
        }
        let mut pack = Vec::new();
        for (i, (zone, blob)) in zones.iter().enumerate() {
            let bytes = u32::try_from(blob.len()).ok().filter(|bytes| *bytes <= BLOB_BYTES_MAX);
            let too_large =
                || StoreError::Blob { path: root.to_owned(), zone: zone.name.clone(), found: blob.len() };
            let place = Place {
                pack: u32::try_from(packs).unwrap_or(u32::MAX),
                // At most 64 zones of 16 MiB.
                offset: u32::try_from(pack.len()).unwrap_or(u32::MAX),
                bytes: bytes.ok_or_else(too_large)?,
                checksum: xxh3_64(blob),
            };
            pack.extend_from_slice(blob);
            entries.push((key(i), place));
        }
        if !pack.is_empty() {
            write_synced(&data.join(pack_name(packs)), &pack)?;
            pack_bytes.push(pack.len() as u64);
        }
        let zones = zones.iter().map(|(zone, _)| zone.clone()).collect();
        let scene = Scene { zones, ..self.store.scene().clone() };
        make_current(root, &work.0, &mut entries, pack_bytes, scene)
    }
}

/// The work folder, empty at first and gone at the end.
struct Work(PathBuf);

impl Work {
    fn create(root: &Path) -> Result<Self, StoreError> {
        let path = root.join(WORK_FOLDER);
        // A kill may have left one; whoever left it is gone, since the lock was free.
        if path.exists() {
            fs::remove_dir_all(&path).map_err(io_at("remove the leftovers in", &path))?;
        }
        fs::create_dir(&path).map_err(io_at("create the folder", &path))?;
        Ok(Self(path))
    }
}

impl Drop for Work {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

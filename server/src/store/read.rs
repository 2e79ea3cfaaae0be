//! Reading a store, from a folder or an object store: blobs by key, each checked.

use super::error::io_at;
use super::format::{Manifest, Place, SCENE_BYTES_MAX, SCENE_FILE, pack_name};
use super::objects::{Failure, Manner, Objects, folder, is_address, runtime};
use super::remote::{Remote, Shared};
use super::{Key, StoreError};
use bytes::Bytes;
use diamantina_protocol::message::Scene;
use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{Seek, SeekFrom};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use xxhash_rust::xxh3::xxh3_64;

/// Bytes of a directory that are read at once from an object store.
pub(super) const DIRECTORY_PIECE: u64 = 4 << 20;

/// Times that a store is opened where it is replaced meanwhile.
const OPENINGS_MAX: u32 = 8;

/// Where blobs are read from.
#[derive(Debug)]
pub(super) enum Source {
    /// Files, open.
    Packs(Vec<(PathBuf, File)>),
    Remote(Arc<Remote>),
}

/// A store opened for reading. Cheap to share; reads do not block one another.
#[derive(Debug)]
pub struct Store {
    pub(super) root: PathBuf,
    pub(super) scene: Scene,
    pub(super) source: Source,
    pub(super) places: HashMap<Key, Place>,
    shared: Arc<Shared>,
}

pub(super) fn damaged_blob(path: PathBuf, key: Key, place: &Place, found: u64) -> StoreError {
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
        for _ in 0..OPENINGS_MAX {
            let manifest = Manifest::read(root)?;
            let version = manifest.scene.version.clone();
            match Self::open_packs(root, manifest, shared) {
                // A build that publishes removes the version before: then there is another one to open.
                Err(_) if Manifest::read(root).is_ok_and(|now| now.scene.version != version) => {}
                opened => return opened,
            }
        }
        Self::open_packs(root, Manifest::read(root)?, shared)
    }

    /// Opens the version that a description names.
    fn open_packs(root: &Path, manifest: Manifest, shared: &Arc<Shared>) -> Result<Self, StoreError> {
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

    /// Files that are open as long as the store is.
    #[must_use]
    pub fn open_files(&self) -> u64 {
        match &self.source {
            Source::Packs(packs) => packs.len() as u64,
            Source::Remote(_) => 0,
        }
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
        file.read_exact_at(&mut blob, place.offset.into()).map_err(|error| StoreError::Unread {
            path: path.clone(),
            key,
            error,
        })?;
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

#[cfg(test)]
mod tests {
    use super::super::{Kind, Writer};
    use super::*;
    use std::sync::atomic::{AtomicBool, Ordering};

    const SCENE: &str =
        r#"{"name":"made","version":"","frame":{"crs":null,"vertical_unit":"metre"},"layers":[]}"#;

    fn key(number: u32) -> Key {
        Key { layer: 0, kind: Kind::Points, a: number, b: 7 }
    }

    fn publish(root: &Path, blobs: u32) -> Scene {
        let writer = Writer::create(root).unwrap();
        for number in 0..blobs {
            writer.put(key(number), number.into(), &number.to_le_bytes()).unwrap();
        }
        writer.publish(serde_json::from_str(SCENE).unwrap(), |_| true).unwrap().unwrap()
    }

    /// The memory of this very process, read where none is: the system then says what it says of a broken disk.
    #[cfg(target_os = "linux")]
    #[test]
    fn what_a_disk_refuses_is_named_and_read_again_the_next_time() {
        let folder = tempfile::tempdir().unwrap();
        publish(folder.path(), 5);
        let mut store = Store::open(folder.path()).unwrap();
        let Source::Packs(packs) = &mut store.source else { panic!("it is a folder") };
        let sound = std::mem::replace(&mut packs[0].1, File::open("/proc/self/mem").unwrap());
        let error = store.get(key(3)).unwrap_err();
        assert!(
            matches!(&error, StoreError::Unread { error, .. } if error.raw_os_error() == Some(5)),
            "{error}"
        );
        let told = error.to_string();
        assert!(told.contains("pack-00000") && told.contains("a: 3, b: 7"), "{told}");
        let Source::Packs(packs) = &mut store.source else { panic!("it is a folder") };
        packs[0].1 = sound;
        assert_eq!(store.get(key(3)).unwrap().as_deref(), Some(&3u32.to_le_bytes()[..]));
    }

    /// Who read the description before a build published found the version's files gone after it.
    #[test]
    fn a_store_that_is_replaced_while_it_is_opened_is_opened_all_the_same() {
        let folder = tempfile::tempdir().unwrap();
        publish(folder.path(), 1);
        let over = AtomicBool::new(false);
        std::thread::scope(|threads| {
            let opener = threads.spawn(|| {
                let mut opened = 0;
                while !over.load(Ordering::Relaxed) {
                    let store = Store::open(folder.path()).unwrap_or_else(|e| panic!("{e}"));
                    assert!(store.get(key(0)).unwrap().is_some());
                    opened += 1;
                }
                opened
            });
            for blobs in 2..150 {
                publish(folder.path(), blobs);
            }
            over.store(true, Ordering::Relaxed);
            assert!(opener.join().unwrap() > 0);
        });
    }
}

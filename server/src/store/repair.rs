//! Damaged stores mended from another copy of the same version.
//!
//! What is damaged is told by checksums alone, and what another copy gives counts only if it has the checksum that the
//! directory says. A pack in a folder is mended in place: only bytes that are wrong are written, so a kill leaves it no worse, the
//! next run goes on, and servers that have it open see it whole at once. In an object store, and where a file is missing,
//! the whole file is put in the place of the one before, at once.

use super::objects::{Manner, Objects, runtime};
use super::{
    BLOB_BYTES_MAX, DIRECTORY_PIECE, Key, Kind, Manifest, Place, SCENE_BYTES_MAX, SCENE_FILE, Source, Store,
    StoreError, folder, io_at, is_address, lock, pack_name, sync_folder, write_synced,
};
use bytes::Bytes;
use diamantina_protocol::message::{
    Scene, index_route, points_route, scene_route, tile_route, tin_index_route, tin_route, zone_route,
};
use diamantina_protocol::texture::Tile;
use futures_util::StreamExt;
use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Blobs that are asked of another copy at once.
const AT_ONCE: usize = 64;

/// Requests at once to a server.
const REQUESTS: usize = 8;

/// What became of a store.
#[derive(Debug)]
pub struct Report {
    /// The version.
    pub version: String,
    /// Blobs that were read.
    pub blobs: usize,
    /// Those of them that were wrong or missing, and are as they were written now.
    pub mended: usize,
    /// Those that still are wrong or missing, and where they lie.
    pub lost: Vec<String>,
    /// Whether the directory was replaced.
    pub directory: bool,
}

/// Where blobs may come from.
enum Copy {
    Store(Box<Store>),
    /// A server of the same version.
    Server {
        objects: Objects,
        scene: Box<Scene>,
    },
}

/// What is mended.
enum Patient {
    Folder(PathBuf),
    Objects(Objects),
}

type Found = Vec<(Key, Place)>;

fn damaged(path: &Path, what: impl Into<String>) -> StoreError {
    StoreError::Damaged { path: path.to_owned(), what: what.into() }
}

/// Checks every blob of the store at `root`, a folder or an address, and mends those that are wrong from `from`: a folder, the
/// address of an object store, or `http://HOST:PORT` of a server. Without `from` nothing is written. `advance` is told of each
/// blob that was checked.
///
/// # Errors
/// When the description cannot be read, the directory is damaged and there is no copy of it, something else writes the
/// store, `from` holds another version, or a disk or network fails.
pub fn repair(root: &Path, from: Option<&Path>, advance: impl Fn(u64)) -> Result<Report, StoreError> {
    let (patient, manifest, _lock) = admit(root)?;
    let scene = &manifest.scene;
    let copy = from.map(|from| Copy::open(from, scene)).transpose()?;
    let (places, directory) = patient.directory(&manifest, copy.as_ref())?;
    let mut by_pack: BTreeMap<u32, Found> = BTreeMap::new();
    for (key, place) in places {
        by_pack.entry(place.pack).or_default().push((key, place));
    }
    let mut report =
        Report { version: scene.version.clone(), blobs: 0, mended: 0, lost: Vec::new(), directory };
    for (pack, mut blobs) in by_pack {
        blobs.sort_unstable_by_key(|(_, place)| place.offset);
        let below = format!("{}/{}", scene.version, pack_name(pack as usize));
        let bytes = manifest.pack_bytes.get(pack as usize).copied().unwrap_or(0);
        let wrong = patient.wrong(&below, bytes, &blobs)?;
        report.blobs += blobs.len();
        let mut sound = Vec::new();
        for some in wrong.chunks(AT_ONCE) {
            let found = copy.as_ref().map_or_else(|| Ok(HashMap::new()), |copy| copy.blobs(some))?;
            for (key, place) in some {
                match found.get(key) {
                    Some(blob) => sound.push((*place, blob.clone())),
                    None => report.lost.push(format!("{key:?} at byte {} of {below}", place.offset)),
                }
            }
        }
        report.mended += sound.len();
        if !sound.is_empty() {
            patient.mend(&below, bytes, &sound)?;
        } else if wrong.is_empty()
            && let Some(found) = patient.other_length(&below, bytes)?
        {
            // All blobs are sound, but no store with such a pack is opened.
            if copy.is_some() {
                patient.mend(&below, bytes, &[])?;
                report.mended += 1;
            } else {
                report.lost.push(format!("the end of {below}: {found} bytes, expected {bytes}"));
            }
        }
        advance(blobs.len() as u64);
    }
    Ok(report)
}

/// The store, its description, and the right to write it.
fn admit(root: &Path) -> Result<(Patient, Manifest, Option<File>), StoreError> {
    if is_address(root) {
        let objects = Objects::open(root, Manner::Publishing)?;
        let read = runtime()?.block_on(objects.read(SCENE_FILE, SCENE_BYTES_MAX));
        let path = objects.address(SCENE_FILE);
        let text = read.map_err(|failure| failure.at(path.clone()))?.bytes;
        let manifest = Manifest::parse(&text, Path::new(&path), root)?;
        return Ok((Patient::Objects(objects), manifest, None));
    }
    let root = folder(root);
    let manifest = Manifest::read(root)?;
    let lock = lock(root)?;
    fs::create_dir_all(root.join(&manifest.scene.version)).map_err(io_at("create the folder", root))?;
    Ok((Patient::Folder(root.to_owned()), manifest, Some(lock)))
}

impl Patient {
    fn read(&self, below: &str) -> Result<Vec<u8>, StoreError> {
        match self {
            Self::Folder(root) => {
                let path = root.join(below);
                fs::read(&path).map_err(io_at("read", &path))
            }
            Self::Objects(objects) => {
                let read = runtime()?.block_on(objects.read_long(below, DIRECTORY_PIECE));
                read.map_err(|failure| failure.at(objects.address(below)))
            }
        }
    }

    /// Puts a whole file in the place of the one before, at once.
    fn replace(&self, below: &str, bytes: Vec<u8>) -> Result<(), StoreError> {
        match self {
            Self::Folder(root) => {
                let path = root.join(below);
                let fresh = path.with_extension("mended");
                write_synced(&fresh, &bytes)?;
                fs::rename(&fresh, &path).map_err(io_at("replace", &path))?;
                path.parent().map_or(Ok(()), sync_folder)
            }
            Self::Objects(objects) => {
                // What is damaged may still have the size and the hash that it was sent with.
                let put = runtime()?.block_on(super::publish::replace(objects, below, bytes.into()));
                put.map_err(|failure| failure.at(objects.address(below)))
            }
        }
    }

    /// Where the blobs lie, and whether that had to be had from the copy.
    fn directory(
        &self,
        manifest: &Manifest,
        copy: Option<&Copy>,
    ) -> Result<(HashMap<Key, Place>, bool), StoreError> {
        let below = format!("{}/directory", manifest.scene.version);
        let path = PathBuf::from(&below);
        let wrong = match self.read(&below).and_then(|bytes| manifest.places(&bytes, &path)) {
            Ok(places) => return Ok((places, false)),
            Err(
                error @ (StoreError::Away { .. } | StoreError::Unanswered { .. } | StoreError::Denied { .. }),
            ) => return Err(error),
            Err(error) => error,
        };
        let Some(Copy::Store(store)) = copy else {
            return Err(match copy {
                None => wrong,
                Some(_) => damaged(
                    &path,
                    "the directory, which no server gives: mend from a folder or an object store",
                ),
            });
        };
        let bytes = store.directory()?;
        let places = manifest.places(&bytes, &path)?;
        self.replace(&below, bytes)?;
        Ok((places, true))
    }

    /// The blobs of a pack that are not as they were written.
    fn wrong(&self, below: &str, bytes: u64, blobs: &Found) -> Result<Found, StoreError> {
        match self {
            Self::Folder(root) => {
                // One by one: where a disk fails it fails in places.
                let file = File::open(root.join(below)).ok();
                let read = |place: &Place| -> Option<Vec<u8>> {
                    let mut blob = vec![0; place.bytes as usize];
                    file.as_ref()?.read_exact_at(&mut blob, place.offset.into()).ok()?;
                    Some(blob)
                };
                Ok(blobs
                    .iter()
                    .filter(|(_, place)| read(place).is_none_or(|blob| !place.is_of(&blob)))
                    .copied()
                    .collect())
            }
            Self::Objects(_) => match self.read(below) {
                Ok(whole) if whole.len() as u64 <= bytes => {
                    Ok(blobs.iter().filter(|(_, place)| !place.is_sound_in(&whole)).copied().collect())
                }
                Ok(_) | Err(StoreError::Damaged { .. }) => Ok(blobs.clone()),
                Err(error) => Err(error),
            },
        }
    }

    /// The length of a pack in a folder, if it is not the one that it was written with. Those of object stores count as
    /// wrong as a whole then.
    fn other_length(&self, below: &str, bytes: u64) -> Result<Option<u64>, StoreError> {
        let Self::Folder(root) = self else { return Ok(None) };
        let path = root.join(below);
        let found = fs::metadata(&path).map_err(io_at("read", &path))?.len();
        Ok(Some(found).filter(|found| *found != bytes))
    }

    /// Writes blobs to their places in a pack, which has its length then.
    fn mend(&self, below: &str, bytes: u64, blobs: &[(Place, Bytes)]) -> Result<(), StoreError> {
        if let Self::Folder(root) = self {
            let path = root.join(below);
            if let Ok(file) = File::options().write(true).open(&path) {
                file.set_len(bytes).map_err(io_at("write", &path))?;
                for (place, blob) in blobs {
                    file.write_all_at(blob, place.offset.into()).map_err(io_at("write", &path))?;
                }
                return file.sync_all().map_err(io_at("sync", &path));
            }
        }
        let mut whole = match self.read(below) {
            Ok(whole) => whole,
            Err(StoreError::Damaged { .. } | StoreError::Io { .. }) => Vec::new(),
            Err(error) => return Err(error),
        };
        whole.resize(usize::try_from(bytes).unwrap_or(usize::MAX), 0);
        for (place, blob) in blobs {
            let start = place.offset as usize;
            whole[start..start + blob.len()].copy_from_slice(blob);
        }
        self.replace(below, whole)
    }
}

impl Copy {
    fn open(from: &Path, scene: &Scene) -> Result<Self, StoreError> {
        let text = from.to_string_lossy();
        let other = |found: &str| StoreError::Address {
            address: text.clone().into_owned(),
            reason: format!("expected a copy of version {}, found {found}", scene.version),
        };
        if !text.starts_with("http://") && !text.starts_with("https://") {
            let store = Store::open(from)?;
            return match store.scene().version.as_str() {
                version if version == scene.version => Ok(Self::Store(Box::new(store))),
                version => Err(other(&format!("version {version}"))),
            };
        }
        let objects =
            Objects::open(Path::new(text.split("/scenes").next().unwrap_or(&text)), Manner::Publishing)?;
        let below = scene_route(&scene.name);
        let read = runtime()?.block_on(objects.read(&below, SCENE_BYTES_MAX));
        let bytes = read.map_err(|failure| failure.at(objects.address(below.trim_start_matches('/'))))?.bytes;
        let found: Scene =
            serde_json::from_slice(&bytes).map_err(|e| other(&format!("no description ({e})")))?;
        if found.version != scene.version {
            return Err(other(&format!("version {}", found.version)));
        }
        Ok(Self::Server { objects, scene: Box::new(scene.clone()) })
    }

    /// Those of some blobs that the copy has as they were written.
    fn blobs(&self, wanted: &[(Key, Place)]) -> Result<HashMap<Key, Bytes>, StoreError> {
        match self {
            Self::Store(store) => {
                let keys: Vec<Key> = wanted.iter().map(|(key, _)| *key).collect();
                let mut found = HashMap::new();
                for ((key, place), blob) in wanted.iter().zip(store.get_many(&keys)) {
                    match blob {
                        Ok(Some(blob)) if place.is_of(&blob) => drop(found.insert(*key, blob)),
                        // The copy may be damaged, too.
                        Ok(_) | Err(StoreError::Damaged { .. } | StoreError::Unread { .. }) => {}
                        Err(error) => return Err(error),
                    }
                }
                Ok(found)
            }
            Self::Server { objects, scene } => {
                let asked = wanted.iter().map(|(key, place)| (*key, *place, route(scene, *key)));
                let asked: Vec<_> = asked.filter_map(|(k, p, route)| Some((k, p, route?))).collect();
                let objects = Arc::new(objects.clone());
                runtime()?.block_on(async move {
                    let ask = asked.into_iter().map(|(key, place, route)| {
                        let objects = Arc::clone(&objects);
                        async move { (key, place, objects.read(&route, BLOB_BYTES_MAX.into()).await) }
                    });
                    let mut answers = futures_util::stream::iter(ask).buffer_unordered(REQUESTS);
                    let mut found = HashMap::new();
                    while let Some((key, place, read)) = answers.next().await {
                        if let Ok(thing) = read
                            && place.is_of(&thing.bytes)
                        {
                            found.insert(key, thing.bytes);
                        }
                    }
                    Ok(found)
                })
            }
        }
    }
}

/// Where a server has a blob.
fn route(scene: &Scene, key: Key) -> Option<String> {
    let (name, version) = (&scene.name, &scene.version);
    if key.kind == Kind::Zone {
        return Some(zone_route(name, version, &scene.zones.get(key.a as usize)?.name));
    }
    if matches!(key.kind, Kind::Texture | Kind::TextureIndex) {
        let texture = &scene.textures.get(usize::from(key.layer))?.name;
        let tile = Tile { level: key.a, x: key.b & 0xffff, y: key.b >> 16 };
        return Some(match key.kind {
            Kind::Texture => tile_route(name, version, texture, tile),
            _ => index_route(name, version, texture, 0),
        });
    }
    let layer = &scene.layers.get(usize::from(key.layer))?.name;
    let centre = [key.a, key.b];
    Some(match key.kind {
        Kind::Index => index_route(name, version, layer, key.a),
        Kind::TinIndex => tin_index_route(name, version, layer, key.a),
        Kind::Points => points_route(name, version, layer, centre),
        Kind::Tin => tin_route(name, version, layer, centre),
        Kind::Texture | Kind::TextureIndex | Kind::Zone => return None,
    })
}

impl Store {
    /// The directory as it was written, which was checked when the store was opened.
    fn directory(&self) -> Result<Vec<u8>, StoreError> {
        let version = &self.scene.version;
        match &self.source {
            Source::Packs(_) => {
                let path = self.root.join(version).join("directory");
                fs::read(&path).map_err(io_at("read", &path))
            }
            Source::Remote(remote) => {
                let below = format!("{version}/directory");
                let read = runtime()?.block_on(remote.objects.read_long(&below, DIRECTORY_PIECE));
                read.map_err(|failure| failure.at(remote.objects.address(&below)))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Spot, Writer};
    use super::*;

    fn scene() -> Scene {
        Scene { name: "made".to_owned(), ..serde_json::from_str(SCENE).unwrap() }
    }

    const SCENE: &str =
        r#"{"name":"made","version":"","frame":{"crs":null,"vertical_unit":"metre"},"layers":[]}"#;

    /// A store of a hundred blobs, some of which lie in a second pack.
    fn made(root: &Path) -> Vec<Spot> {
        let writer = Writer::create(root).unwrap();
        let blob = |i: u32| vec![u8::try_from(i).unwrap(); 400_000 + i as usize];
        let key = |i: u32| Key { layer: 0, kind: Kind::Points, a: i, b: 0 };
        let spots = (0..100).map(|i| writer.put(key(i), i.into(), &blob(i)).unwrap()).collect();
        writer.publish(scene(), |_| true).unwrap().unwrap();
        spots
    }

    #[test]
    fn whatever_is_damaged_is_found_and_mended_from_a_copy_and_nothing_else_is_touched() {
        let folder = tempfile::tempdir().unwrap();
        let [store, copy] = ["store", "copy"].map(|name| folder.path().join(name));
        made(&store);
        made(&copy);
        let version = Store::open(&copy).unwrap().scene().version.clone();
        let at = |root: &Path, name: &str| root.join(&version).join(name);
        let whole =
            |root: &Path| ["pack-00000", "pack-00001", "directory"].map(|n| fs::read(at(root, n)).ok());
        let sound = whole(&copy);
        assert!(sound.iter().all(Option::is_some));
        let untouched = repair(&store, Some(&copy), |_| {}).unwrap();
        assert_eq!((untouched.blobs, untouched.mended, untouched.lost.len()), (100, 0, 0));
        type Damage = fn(&Path);
        let harms: [(&str, Damage); 5] = [
            ("pack-00000", |p| {
                let file = File::options().write(true).open(p).unwrap();
                file.write_all_at(b"xyz", 17).unwrap();
                file.write_all_at(b"xyz", 9_000_000).unwrap();
            }),
            ("pack-00001", |p| File::options().write(true).open(p).unwrap().set_len(1000).unwrap()),
            ("pack-00001", |p| {
                // A byte too many, and all else as it was.
                let file = File::options().write(true).open(p).unwrap();
                file.set_len(file.metadata().unwrap().len() + 1).unwrap();
            }),
            ("pack-00001", |p| fs::remove_file(p).unwrap()),
            ("directory", |p| fs::write(p, "x").unwrap()),
        ];
        for (name, harm) in harms {
            harm(&at(&store, name));
            if name != "directory" {
                let told = repair(&store, None, |_| {}).unwrap();
                assert!(told.mended == 0 && !told.lost.is_empty(), "{told:?}");
                assert!(whole(&store) != sound, "without a copy nothing is written");
            }
            let told = repair(&store, Some(&copy), |_| {}).unwrap();
            assert!(told.lost.is_empty() && (told.mended > 0 || told.directory), "{name}: {told:?}");
            assert!(whole(&store) == sound, "{name} is not as it was");
        }
        // What the copy lacks as well is told.
        for root in [&store, &copy] {
            harms[0].1(&at(root, "pack-00000"));
        }
        let told = repair(&store, Some(&copy), |_| {}).unwrap();
        assert!(told.mended == 0 && told.lost.len() == 2 && told.lost[0].contains("pack-00000"), "{told:?}");
    }
}

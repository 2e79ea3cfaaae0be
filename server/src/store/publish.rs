//! A built store put into an object store.
//!
//! Packs and the directory go first, under the version's own name; `scene.json` comes last, by a conditional put: only if
//! what is published there is still what was there when the publisher was opened. So a kill leaves the scene before, two
//! publishers cannot overwrite each other unseen, and publishing again sends what is missing: what is there with the right
//! size and hash is not sent again. Versions before stay, since servers may still be at them, until they are pruned.

use super::objects::{Failure, Manner, Objects, runtime};
use super::{
    Key, Manifest, Place, SCENE_BYTES_MAX, SCENE_FILE, StoreError, folder, io_at, is_version, pack_name,
};
use bytes::Bytes;
use diamantina_protocol::message::Scene;
use futures_util::TryStreamExt;
use object_store::{
    Attribute, Attributes, GetOptions, ObjectStoreExt, PutMode, PutMultipartOptions, PutOptions,
    UpdateVersion, WriteMultipart,
};
use std::collections::HashMap;
use std::fs;
use std::path::Path;

/// What is larger goes in parts, each of which can be tried again alone.
const PART_BYTES: usize = 8 << 20;

/// Parts that are sent at once.
const PARTS_AT_ONCE: usize = 4;

/// The attribute that says what an object holds.
const HASH: &str = "blake3";

/// Bytes of an object without the attribute that are read at once, to find out.
const PIECE_BYTES: u64 = 8 << 20;

/// What publishing did.
#[derive(Debug, Clone)]
pub struct Published {
    /// The scene.
    pub scene: Scene,
    /// Bytes that were sent.
    pub sent: u64,
    /// Bytes that were there already.
    pub kept: u64,
    /// Objects of other versions that were removed.
    pub pruned: u64,
}

/// The right to replace what was published at an address when this was opened, and nothing else.
#[derive(Debug)]
pub struct Publisher {
    objects: Objects,
    before: Option<UpdateVersion>,
}

impl Publisher {
    /// Looks at what is published at an address.
    ///
    /// # Errors
    /// When the address is none, or the store cannot be reached or does not let us.
    pub fn open(address: &Path) -> Result<Self, StoreError> {
        Self::of(Objects::open(address, Manner::Publishing)?)
    }

    fn of(objects: Objects) -> Result<Self, StoreError> {
        let before = match runtime()?.block_on(objects.read(SCENE_FILE, SCENE_BYTES_MAX)) {
            Ok(thing) => Some(thing.version),
            Err(Failure::Missing) => None,
            Err(failure) => return Err(failure.at(objects.address(SCENE_FILE))),
        };
        Ok(Self { objects, before })
    }

    /// Bytes of what a store holds, for progress.
    ///
    /// # Errors
    /// When there is no store.
    pub fn bytes(root: &Path) -> Result<u64, StoreError> {
        Ok(Manifest::read(folder(root))?.pack_bytes.iter().sum())
    }

    /// Publishes the store in a folder; `None` if `go_on`, asked before each object with the bytes of the one before, said
    /// no. With `prune`, versions but this one and the one before are removed then.
    ///
    /// # Errors
    /// When the folder holds no store or a damaged one, the object store fails, or somebody else has published there
    /// ([`StoreError::Overtaken`]): what is published is then as it was.
    pub fn publish(
        &self,
        root: &Path,
        prune: bool,
        go_on: impl Fn(u64) -> bool,
    ) -> Result<Option<Published>, StoreError> {
        let root = folder(root);
        let manifest = Manifest::read(root)?;
        let version = manifest.scene.version.clone();
        let read = |path: &Path| fs::read(path).map(Bytes::from).map_err(io_at("read", path));
        let path = root.join(&version).join("directory");
        let directory = read(&path)?;
        let places = manifest.places(&directory, &path)?;
        let mut by_pack: HashMap<u32, Vec<(Key, Place)>> = HashMap::new();
        for (key, place) in places {
            by_pack.entry(place.pack).or_default().push((key, place));
        }
        let packs = (0..).zip(&manifest.pack_bytes).map(|(number, bytes)| {
            (pack_name(number as usize), Some((*bytes, by_pack.remove(&number).unwrap_or_default())))
        });
        let (mut sent, mut kept, mut last) = (0, 0, 0);
        for (name, expected) in packs.chain([("directory".to_owned(), None)]) {
            if !go_on(last) {
                return Ok(None);
            }
            let path = root.join(&version).join(&name);
            let bytes = match expected {
                Some((length, blobs)) => {
                    let pack = read(&path)?;
                    check(&path, &pack, length, &blobs)?;
                    pack
                }
                None => directory.clone(),
            };
            last = bytes.len() as u64;
            let below = format!("{version}/{name}");
            let put = runtime()?.block_on(put(&self.objects, &below, bytes));
            match put.map_err(|failure| failure.at(self.objects.address(&below)))? {
                true => sent += last,
                false => kept += last,
            }
        }
        if !go_on(last) {
            return Ok(None);
        }
        let text = read(&root.join(SCENE_FILE))?;
        let before = runtime()?
            .block_on(self.make_current(text))
            .map_err(|failure| failure.at(self.objects.address(SCENE_FILE)))?;
        let pruned = if prune {
            let keep = [version, before.unwrap_or_default()];
            runtime()?.block_on(self.prune(&keep)).map_err(|failure| failure.at(self.objects.address("")))?
        } else {
            0
        };
        Ok(Some(Published { scene: manifest.scene, sent, kept, pruned }))
    }

    /// Replaces the description; the version that was there before.
    async fn make_current(&self, text: Bytes) -> Result<Option<String>, Failure> {
        let version = |text: &[u8]| {
            Manifest::parse(text, Path::new(SCENE_FILE), Path::new(SCENE_FILE)).ok().map(|m| m.scene.version)
        };
        let before = match self.objects.read(SCENE_FILE, SCENE_BYTES_MAX).await {
            Ok(thing) if thing.bytes == text => return Ok(version(&text)),
            Ok(thing) => version(&thing.bytes),
            Err(Failure::Missing) => None,
            Err(failure) => return Err(failure),
        };
        let attributes = Attributes::from_iter([
            (Attribute::ContentType, "application/json"),
            (Attribute::CacheControl, "no-cache"),
        ]);
        let mode = self.before.clone().map_or(PutMode::Create, PutMode::Update);
        let options = PutOptions { mode, attributes, ..PutOptions::default() };
        let name = self.objects.name(SCENE_FILE);
        let put = self
            .objects
            .ask(async { self.objects.store().put_opts(&name, text.clone().into(), options).await })
            .await;
        match put {
            Ok(_) => Ok(before),
            // Where the answer to a put was lost and it was tried again, it is ours that is there.
            Err(Failure::Changed) => match self.objects.read(SCENE_FILE, SCENE_BYTES_MAX).await {
                Ok(thing) if thing.bytes == text => Ok(before),
                _ => Err(Failure::Changed),
            },
            Err(failure) => Err(failure),
        }
    }

    /// Removes all versions but these; how many objects went.
    async fn prune(&self, keep: &[String]) -> Result<u64, Failure> {
        let (store, root) = (self.objects.store(), self.objects.name(""));
        let listed = self.objects.ask(async { store.list_with_delimiter(Some(&root)).await }).await?;
        let mut pruned = 0;
        for prefix in listed.common_prefixes {
            let name = prefix.filename().unwrap_or_default();
            if !is_version(name) || keep.iter().any(|version| version == name) {
                continue;
            }
            pruned += self
                .objects
                .ask(async {
                    let objects: Vec<_> = store.list(Some(&prefix)).try_collect().await?;
                    for object in &objects {
                        store.delete(&object.location).await?;
                    }
                    Ok(objects.len() as u64)
                })
                .await?;
        }
        Ok(pruned)
    }
}

/// Makes sure that there is an object with this content; whether it had to be sent.
pub(super) async fn put(objects: &Objects, below: &str, bytes: Bytes) -> Result<bool, Failure> {
    let hash = blake3::hash(&bytes).to_hex().to_string();
    if is_there(objects, below, bytes.len() as u64, &hash).await? {
        return Ok(false);
    }
    send(objects, below, bytes, hash).await?;
    Ok(true)
}

/// Puts an object in the place of what is there, whatever that says of itself.
pub(super) async fn replace(objects: &Objects, below: &str, bytes: Bytes) -> Result<(), Failure> {
    let hash = blake3::hash(&bytes).to_hex().to_string();
    send(objects, below, bytes, hash).await
}

async fn send(objects: &Objects, below: &str, bytes: Bytes, hash: String) -> Result<(), Failure> {
    let name = objects.name(below);
    let attributes = Attributes::from_iter([
        (Attribute::ContentType, "application/octet-stream".to_owned()),
        (Attribute::CacheControl, "public, max-age=31536000, immutable".to_owned()),
        (Attribute::Metadata(HASH.into()), hash),
    ]);
    let store = objects.store();
    objects
        .ask(async {
            if bytes.len() <= PART_BYTES {
                let options = PutOptions { attributes, ..PutOptions::default() };
                return store.put_opts(&name, bytes.into(), options).await.map(drop);
            }
            let options = PutMultipartOptions { attributes, ..PutMultipartOptions::default() };
            let upload = store.put_multipart_opts(&name, options).await?;
            let mut parts = WriteMultipart::new_with_chunk_size(upload, PART_BYTES);
            let mut rest = bytes;
            while !rest.is_empty() {
                if let Err(error) = parts.wait_for_capacity(PARTS_AT_ONCE).await {
                    // Its parts would be kept, and paid for.
                    let _ = parts.abort().await;
                    return Err(error);
                }
                parts.put(rest.split_to(PART_BYTES.min(rest.len())));
            }
            parts.finish().await.map(drop)
        })
        .await
}

/// Whether a pack is as it was written: servers that go over to a new version read one blob of each alone.
fn check(path: &Path, pack: &[u8], length: u64, blobs: &[(Key, Place)]) -> Result<(), StoreError> {
    let damaged = |what: String| {
        let what = format!("{what}: mend it from a copy with `diamantina-server repair`, or build it again");
        Err(StoreError::Damaged { path: path.to_owned(), what })
    };
    if pack.len() as u64 != length {
        return damaged(format!("has {} bytes, expected {length}", pack.len()));
    }
    for (key, place) in blobs {
        if !place.is_sound_in(pack) {
            return damaged(format!("{key:?} at byte {} does not match its checksum", place.offset));
        }
    }
    Ok(())
}

/// Whether there is an object with this content, as far as it says itself.
async fn is_there(objects: &Objects, below: &str, size: u64, hash: &str) -> Result<bool, Failure> {
    let name = objects.name(below);
    let options = GetOptions::new().with_head(true);
    let looked = objects.ask(async { objects.store().get_opts(&name, options).await }).await;
    let found = match looked {
        Ok(found) => found,
        Err(Failure::Missing) => return Ok(false),
        Err(failure) => return Err(failure),
    };
    if found.meta.size != size {
        return Ok(false);
    }
    if let Some(told) = found.attributes.get(&Attribute::Metadata(HASH.into())) {
        return Ok(told.as_ref() == hash);
    }
    // Somebody else's tool has put it there.
    let bytes = objects.read_long(below, PIECE_BYTES).await?;
    Ok(blake3::hash(&bytes).to_hex().as_str() == hash)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::Kind;
    use xxhash_rust::xxh3::xxh3_64;

    #[test]
    fn a_pack_with_a_wrong_byte_or_one_too_many_or_too_few_is_damaged() {
        let pack = b"one and another";
        let blob = |offset: u32, bytes: u32| {
            let key = Key { layer: 0, kind: Kind::Points, a: offset, b: 0 };
            let checksum = xxh3_64(&pack[offset as usize..][..bytes as usize]);
            (key, Place { pack: 0, offset, bytes, checksum })
        };
        let blobs = [blob(0, 4), blob(4, 11)];
        let told = |bytes: &[u8]| {
            check(Path::new("pack"), bytes, pack.len() as u64, &blobs).map_err(|error| error.to_string())
        };
        assert_eq!(told(pack), Ok(()));
        for at in 0..pack.len() {
            let mut other = *pack;
            other[at] ^= 1;
            assert!(told(&other).unwrap_err().contains("checksum"), "{at}");
        }
        for other in [&pack[..14], b"one and another.", b""] {
            assert!(told(other).unwrap_err().contains("expected 15"));
        }
    }
}

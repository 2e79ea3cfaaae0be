//! What is on disk: the description of a scene, the directory of its blobs, and the names of its files.
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

use super::error::io_at;
use super::{Key, Kind, StoreError};
use diamantina_protocol::message::Scene;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;
use xxhash_rust::xxh3::xxh3_64;

/// The format that this build writes, and the only one that it reads.
pub const FORMAT: u32 = 3;

/// The largest blob, in bytes; a key that claims more is damaged.
pub(super) const BLOB_BYTES_MAX: u32 = 16 << 20;

/// The largest `scene.json`, in bytes.
pub(super) const SCENE_BYTES_MAX: u64 = 16 << 20;

const MAGIC: &[u8; 8] = b"DMTDIR01";
const ENTRY_BYTES: usize = 32;
pub(super) const SCENE_FILE: &str = "scene.json";

/// `scene.json`: the scene and what is needed to check and read the rest.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Manifest {
    pub(super) format: u32,
    pub(super) directory_hash: String,
    pub(super) pack_bytes: Vec<u64>,
    pub(super) scene: Scene,
}

impl Manifest {
    /// The version that the content has: a hash of everything but the version itself.
    pub(super) fn version(&self) -> String {
        let mut nameless = self.clone();
        nameless.scene.version = String::new();
        // Our own types always serialise.
        let json = serde_json::to_vec(&nameless).unwrap_or_default();
        blake3::hash(&json).to_hex()[..16].to_owned()
    }
}

/// Where a blob lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Place {
    pub(super) pack: u32,
    pub(super) offset: u32,
    pub(super) bytes: u32,
    pub(super) checksum: u64,
}

impl Place {
    /// Whether a blob is the one that was written there.
    pub(super) fn is_of(&self, blob: &[u8]) -> bool {
        xxh3_64(blob) == self.checksum
    }

    /// Whether a whole pack has the blob there as it was written.
    pub(super) fn is_sound_in(&self, pack: &[u8]) -> bool {
        let start = self.offset as usize;
        pack.get(start..start + self.bytes as usize).is_some_and(|blob| self.is_of(blob))
    }
}

fn kind_code(kind: Kind) -> u8 {
    match kind {
        Kind::Index => 1,
        Kind::Points => 2,
        Kind::Tin => 3,
        Kind::TinIndex => 4,
        Kind::Texture => 5,
        Kind::TextureIndex => 6,
        Kind::Zone => 16,
    }
}

pub(super) fn directory_bytes(entries: &[(Key, Place)]) -> Vec<u8> {
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
            5 => Kind::Texture,
            6 => Kind::TextureIndex,
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

impl Manifest {
    /// Where the blobs lie, as the directory at `path` says.
    pub(super) fn places(&self, directory: &[u8], path: &Path) -> Result<HashMap<Key, Place>, StoreError> {
        let damaged = |what: String| StoreError::Damaged { path: path.to_owned(), what };
        if blake3::hash(directory).to_hex().as_str() != self.directory_hash {
            return Err(damaged("it does not match the hash in scene.json".to_owned()));
        }
        Ok(read_directory(directory, &self.pack_bytes).map_err(damaged)?.into_iter().collect())
    }

    pub(super) fn read(root: &Path) -> Result<Self, StoreError> {
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
    pub(super) fn parse(text: &[u8], path: &Path, root: &Path) -> Result<Self, StoreError> {
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

/// Whether something is named as a version is.
pub(super) fn is_version(name: &str) -> bool {
    name.len() == 16 && name.bytes().all(|b| b.is_ascii_hexdigit())
}

pub(super) fn pack_name(number: usize) -> String {
    format!("pack-{number:05}")
}

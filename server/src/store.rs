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
//! | module | what it holds |
//! |---|---|
//! | `format` | the description, the directory byte by byte, names |
//! | `error` | what may go wrong, and what to do |
//! | `write` | [`Writer`], and how a version is published |
//! | `read` | [`Store`] |
//! | `compress` | how pages and masks are compressed |
//! | `objects`, `transport`, `remote`, `disk`, [`publish`](Publisher) | object stores |
//! | [`zones`], [`repair`] | what is added to a store that is built, and what is mended |

mod compress;
mod disk;
mod error;
mod format;
mod objects;
mod publish;
mod read;
mod remote;
pub mod repair;
mod transport;
mod write;
pub mod zones;

pub use compress::compress;
pub use disk::Disk;
pub use error::StoreError;
pub use format::FORMAT;
pub use objects::{is_address, without_credentials};
pub use publish::{Published, Publisher};
pub use read::{Store, number};
pub use remote::{Counts, Shared};
pub use write::{Spot, Writer};

use diamantina_protocol::texture::Tile;
use error::io_at;
use format::{BLOB_BYTES_MAX, Manifest, Place, SCENE_BYTES_MAX, SCENE_FILE, is_version, pack_name};
use objects::folder;
use read::{DIRECTORY_PIECE, Source, damaged_blob};
use write::{LOCK_FILE, lock, make_current, sync_folder, write_synced};

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

impl Key {
    /// The name of a tile of the `number`th texture of the scene.
    #[must_use]
    pub fn tile(number: u8, tile: Tile) -> Self {
        // A level has less than 2^16 tiles along each side.
        Self { layer: number, kind: Kind::Texture, a: tile.level, b: tile.y << 16 | tile.x }
    }

    /// The name of the coverage of the `number`th texture of the scene.
    #[must_use]
    pub fn coverage(number: u8) -> Self {
        Self { layer: number, kind: Kind::TextureIndex, a: 0, b: 0 }
    }
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
    /// A tile of a texture: the key has the texture's position in the scene, the level, and the tile's y and x.
    Texture,
    /// Which tiles a texture has, zstd-compressed.
    TextureIndex,
    /// A zone's masks, zstd-compressed; the key has layer 255 and the zone's position in the scene.
    Zone,
}

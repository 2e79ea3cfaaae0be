//! Why something was not fetched.

use super::http::PAGE_BYTES_MAX;
use diamantina_protocol::index::PageError;
use diamantina_protocol::texture::Tile;
use diamantina_protocol::wire::WireError;
use std::time::Duration;

/// Why something was not fetched.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FetchError {
    /// Not an address of a server or scene.
    #[error("'{url}' is not the address of a scene ({reason}): expected http://HOST:PORT/scenes/NAME")]
    Address {
        /// The address found.
        url: String,
        /// What is wrong with it.
        reason: String,
    },
    /// No connection, or it broke.
    #[error("{0}: is the server running, and the address right?")]
    Transport(String),
    /// An error of the server.
    #[error("{route}: the server answers {status}: {}", match status {
        404 => "is the name right? GET /scenes lists the scenes; a private one needs its token",
        400..500 => "is this a Diamantina server of the same version?",
        _ => "try again later; its log says why",
    })]
    Status {
        /// What was asked for.
        route: String,
        /// The status found.
        status: u16,
        /// The pause that the server asks for.
        retry_after: Option<Duration>,
    },
    /// An answer that is longer than any right one.
    #[error("{route}: answer of more than {limit} bytes refused: is this a Diamantina server?")]
    TooLarge {
        /// What was asked for.
        route: String,
        /// The limit in bytes.
        limit: usize,
    },
    /// The answer ended before all was there.
    #[error("{0}: the answer ends early: is there a proxy or a time limit between?")]
    Early(String),
    /// The answer holds what was not asked for.
    #[error("answer has a payload for {0:?}, which was not asked for: is there a proxy between?")]
    Unasked([u32; 2]),
    /// The server has no payload, or a damaged one, where the index tells of one.
    #[error("the server has no good payload for the diamond at {0:?}: run `inspect --verify` there")]
    Missing([u32; 2]),
    /// A payload differs from what the index or its checksum tells.
    #[error("payload of the diamond at {0:?} is damaged: run `inspect --verify` at the server")]
    Damaged([u32; 2]),
    /// The list of a texture's tiles is none.
    #[error("the index of texture '{0}' is damaged: run `inspect --verify` at the server")]
    Coverage(String),
    /// A tile that is no picture of one.
    #[error(
        "tile {tile:?} of texture '{texture}' is damaged ({reason}): run `inspect --verify` at the server"
    )]
    Tile {
        /// The texture.
        texture: String,
        /// The tile.
        tile: Tile,
        /// What is wrong with it.
        reason: String,
    },
    /// A batch that is none.
    #[error("batch: {0}")]
    Wire(#[from] WireError),
    /// A page that is none.
    #[error(transparent)]
    Page(#[from] PageError),
    /// A page that does not decompress.
    #[error(
        "index page {0} does not decompress to at most {PAGE_BYTES_MAX} bytes: run `inspect --verify` at the server"
    )]
    Compression(u32),
    /// Not the JSON expected.
    #[error("{route}: {reason}: is this a Diamantina server of the same version?")]
    Json {
        /// What was asked for.
        route: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A scene that this build cannot show.
    #[error("scene '{scene}': {reason}: is the server of the same version?")]
    Scene {
        /// The scene's name.
        scene: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The masks of a zone that are none.
    #[error("zone '{zone}': {reason}: run `inspect --verify` at the server")]
    Zone {
        /// The zone.
        zone: String,
        /// What is wrong with them.
        reason: String,
    },
    /// The address names no scene and the server has several, or none.
    #[error("the address names no scene: add /scenes/NAME, with NAME one of: {}", .0.join(", "))]
    Choose(Vec<String>),
    /// Layers were named, and one is none of the scene's.
    #[error("scene '{scene}' has no layer '{asked}': it has {}", .layers.join(", "))]
    Layer {
        /// The scene's name.
        scene: String,
        /// The layer asked for.
        asked: String,
        /// The layers that there are.
        layers: Vec<String>,
    },
    /// The server is not asked, and it was never fetched.
    #[error(
        "{route} is not among what was fetched before: open the scene once while the server can be reached, with the same \
         --disk-cache and token"
    )]
    NotKept {
        /// What was asked for.
        route: String,
    },
    /// No thread or no HTTP client.
    #[error("cannot start fetching: {0}: close other programs, or raise the limit on threads (ulimit -u)")]
    Start(String),
}

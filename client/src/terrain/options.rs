//! What is asked of a streamed scene, and why it cannot be had.

use super::Imagery;
use crate::fetch::{self, FetchError};
use crate::morph;
use crate::sight::Sight;
use crate::texture::Coding;

/// How to stream a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// The error to reach, in pixels.
    pub tolerance_pixels: f64,
    /// What heights are multiplied by, and errors with them.
    pub exaggeration: f64,
    /// How errors count on the screen.
    pub sight: Sight,
    /// Memory for surfaces and what is on its way to become one, in bytes. What the cut wants takes at most three quarters
    /// of it: where that is too little for the tolerance, the largest errors are reduced first.
    pub memory_bytes: usize,
    /// GPU memory for all that is drawn, in bytes: first what frames need in any case, which [`Terrain::set_gpu_taken`] tells, then
    /// imagery, then surfaces and their motions. Where it is too little for the tolerance, the largest errors are reduced first;
    /// where it is too little for motions, points jump.
    ///
    /// [`Terrain::set_gpu_taken`]: super::Terrain::set_gpu_taken
    pub gpu_bytes: u64,
    /// Seconds that points take to move, and triangles to appear, from one cut to the next, at most [`morph::SECONDS_MAX`]; 0: they jump.
    pub morph_seconds: f64,
    /// The names of the layers to stream and draw; none: all.
    pub layers: Option<Vec<String>>,
    /// The time that series of water surfaces show at first, in seconds.
    pub time: f64,
    /// The name of a zone: while the eye is in it, less is asked for where nothing is seen from there.
    pub zone: Option<String>,
    /// What lies on the terrain.
    pub imagery: Imagery,
    /// Memory for tiles of imagery, in bytes; as much again on the GPU, if that is no more than a third of what frames leave there.
    pub texture_bytes: usize,
    /// How their texels are coded.
    pub texture_coding: Coding,
    /// Seconds in which a tile of imagery takes the place of a coarser one; 0: at once.
    pub fade_seconds: f64,
    /// How to fetch, and in which encoding.
    pub fetch: fetch::Options,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            tolerance_pixels: 1.0,
            exaggeration: 1.0,
            sight: Sight::default(),
            memory_bytes: 512 << 20,
            gpu_bytes: 512 << 20,
            morph_seconds: 0.0,
            layers: None,
            time: 0.0,
            zone: None,
            imagery: Imagery::First,
            texture_bytes: 128 << 20,
            texture_coding: Coding::Plain,
            fade_seconds: 0.0,
            fetch: fetch::Options::default(),
        }
    }
}

/// Why a scene cannot be streamed.
#[derive(Debug, thiserror::Error)]
pub enum TerrainError {
    /// It cannot be fetched.
    #[error(transparent)]
    Fetch(#[from] FetchError),
    /// Not in the encoding asked for.
    #[error(
        "layer '{layer}' is offered as {}, asked for as {asked}: build the store with --encoding points,tin, or \
         leave --encoding {asked} out",
        .offered.join(", ")
    )]
    Encoding {
        /// The layer.
        layer: String,
        /// Encodings that the server offers.
        offered: Vec<String>,
        /// The encoding asked for.
        asked: &'static str,
    },
    /// There is no such zone.
    #[error(
        "scene '{scene}' has no zone '{asked}'{}",
        if .zones.is_empty() {
            "; it has none at all: compute one with `diamantina-server zone`".to_owned()
        } else {
            format!(": it has {}", .zones.join(", "))
        }
    )]
    Zone {
        /// The scene.
        scene: String,
        /// The zone asked for.
        asked: String,
        /// The zones that there are.
        zones: Vec<String>,
    },
    /// There is no such texture.
    #[error(
        "scene '{scene}' has no texture '{asked}'{}",
        if .textures.is_empty() {
            "; it has none at all: build it with --layer NAME=texture:PICTURE".to_owned()
        } else {
            format!(": it has {}", .textures.join(", "))
        }
    )]
    Texture {
        /// The scene.
        scene: String,
        /// The texture asked for.
        asked: String,
        /// The textures that there are.
        textures: Vec<String>,
    },
    /// Not a number of pixels.
    #[error("tolerance of {0} pixels: expected a number above 0")]
    Tolerance(f64),
    /// Not a number of seconds.
    #[error("motions of {0} seconds: expected a number from 0 to {max}", max = morph::SECONDS_MAX)]
    Morph(f64),
    /// No threads.
    #[error(
        "cannot start a decoding thread: {0}: close other programs, or raise the limit on threads (ulimit -u)"
    )]
    Thread(#[from] std::io::Error),
}

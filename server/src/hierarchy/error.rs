//! Why a scene could not be built: the file, what was expected, what was found and what to do.

use super::transcribe::HEIGHT_METRES_MAX;
use crate::ingest::IngestError;
use crate::store::StoreError;
use crate::texture::TextureError;
use diamantina_protocol::bintree::ForestError;
use diamantina_protocol::message::PAYLOAD_BYTES_MAX;
use diamantina_protocol::points::{CodingError, SOURCE_MAX};
use diamantina_protocol::series::SeriesError;
use diamantina_protocol::texture::TEXTURES_MAX;
use diamantina_protocol::tin::PatchError;
use diamantina_protocol::zone::LAYERS_MAX;
use std::io;
use std::path::PathBuf;

/// Why a scene could not be built.
#[derive(Debug, thiserror::Error)]
pub enum BuildError {
    /// The source could not be read.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// The store could not be written.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The working files could not be written.
    #[error("{path}: cannot write the working files: {error}; {}", work_remedy(error))]
    Work {
        /// The work folder.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// What went wrong with one of several layers.
    #[error("layer '{layer}': {error}")]
    Layer {
        /// Its name.
        layer: String,
        /// What it was.
        error: Box<Self>,
    },
    /// What went wrong with a texture.
    #[error("texture '{texture}': {error}")]
    Texture {
        /// Its name.
        texture: String,
        /// What it was.
        error: Box<TextureError>,
    },
    /// More than a scene may have.
    #[error("{0} textures, expected at most {TEXTURES_MAX}: build several scenes")]
    Textures(usize),
    /// No quality.
    #[error("--texture-quality {0}: expected 1 to 100")]
    TextureQuality(u8),
    /// More than a scene may have.
    #[error(
        "{0} layers, the steps of series among them, expected at most {LAYERS_MAX}: build several scenes"
    )]
    Layers(usize),
    /// Series that are none.
    #[error(transparent)]
    Series(#[from] SeriesError),
    /// No name, or that of another layer.
    #[error(
        "layer '{0}': expected a name that no other layer or texture has, of 1 to 64 letters, digits, '-', '_' or '.', not starting \
         with '.', and not 'zones'"
    )]
    LayerName(String),
    /// Somebody asked for a stop.
    #[error(
        "interrupted: {done} of {chunks} chunks are done; the same command goes on from there (--fresh starts anew)"
    )]
    Interrupted {
        /// Chunks done.
        done: u64,
        /// All chunks.
        chunks: u64,
    },
    /// No sample has a height.
    #[error(
        "the source has no data: all {0} samples are nodata; check its nodata value, or give another with --nodata"
    )]
    AllNodata(u64),
    /// Heights do not fit in the integers of the format.
    #[error("height {value} is {} quanta of {quantum} m, beyond {SOURCE_MAX}: if it stands for nodata, say --nodata; else give a larger --quantum", (value / quantum).round())]
    Range {
        /// Metres.
        value: f64,
        /// Metres of a quantum.
        quantum: f64,
    },
    /// The quantum makes no sense.
    #[error("--quantum {0}: expected metres above 0 and below {HEIGHT_METRES_MAX}")]
    Quantum(f64),
    /// The asked error is out of range.
    #[error("--max-error {asked}: expected 0 to {limit} m for a quantum of {quantum} m")]
    MaxError {
        /// Metres asked.
        asked: f64,
        /// The largest that can be coded.
        limit: f64,
        /// Metres of a quantum.
        quantum: f64,
    },
    /// Too large, or too thin, for a forest.
    #[error(
        "the source has {width} x {height} samples: {error}; cut it into pieces and build a store of each"
    )]
    Forest {
        /// Samples along x.
        width: u32,
        /// Samples along y.
        height: u32,
        /// Why not.
        error: ForestError,
    },
    /// Patches of triangles do not fit.
    #[error("the forest of triangles: {0}; give another --patch-triangles, or build points alone")]
    TinForest(ForestError),
    /// An option of triangles is out of range.
    #[error("{name} {found}: expected {expected}")]
    TinOption {
        /// The option.
        name: &'static str,
        /// The value.
        found: f64,
        /// What it may be.
        expected: &'static str,
    },
    /// An error at each collapse needs all samples of the largest diamond.
    #[error(
        "--patch-error looks at all {side} x {side} samples of the largest diamonds at each collapse, in half of --memory {}: say --memory {} or more, or --patch-triangles instead of it, which takes no more however large the source is",
        mebibytes(*asked), mebibytes(*needed)
    )]
    PatchErrorMemory {
        /// Samples along a side.
        side: u64,
        /// Bytes asked.
        asked: u64,
        /// Bytes needed.
        needed: u64,
    },
    /// A patch is larger than the format allows.
    #[error(
        "the triangles of diamond {centre:?}: {error}; give a larger --patch-error, or --patch-triangles instead of it"
    )]
    Patch {
        /// The diamond.
        centre: [u32; 2],
        /// Why it cannot be coded.
        error: PatchError,
    },
    /// A patch takes more bytes than a client reads.
    #[error(
        "the triangles of diamond {centre:?} take {bytes} bytes, limit {PAYLOAD_BYTES_MAX}; give a smaller --patch-triangles or a larger --quantum"
    )]
    Payload {
        /// The diamond.
        centre: [u32; 2],
        /// Bytes.
        bytes: usize,
    },
    /// Our own steps were refused.
    #[error("steps: {0}")]
    Coding(#[from] CodingError),
    /// The memory asked for is too little.
    #[error("--memory {}: too little for this source: say --memory {} or more", mebibytes(*asked), mebibytes(*needed))]
    Memory {
        /// Bytes asked.
        asked: u64,
        /// Bytes needed.
        needed: u64,
    },
}

/// Bytes as the command line takes them, rounded up.
fn mebibytes(bytes: u64) -> String {
    format!("{}MiB", bytes.div_ceil(1 << 20))
}

fn work_remedy(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            "free some space (16/3 bytes a sample) and build again: the same command goes on where this one \
             ended (the old scene, if any, is untouched)"
        }
        _ => "check the disk, or choose another folder with -o",
    }
}

impl BuildError {
    /// What went wrong, whatever the layer.
    #[must_use]
    pub fn cause(&self) -> &Self {
        match self {
            Self::Layer { error, .. } => error.cause(),
            other => other,
        }
    }

    /// The same of a layer beside others that take so many bytes, where so many are granted to all.
    pub(super) fn beside(self, others: u64, asked: u64) -> Self {
        match self {
            Self::Memory { needed, .. } => Self::Memory { asked, needed: needed.saturating_add(others) },
            Self::PatchErrorMemory { side, needed, .. } => {
                Self::PatchErrorMemory { side, asked, needed: needed.saturating_add(others) }
            }
            other => other,
        }
    }

    /// Bytes that would suffice, if there are too few.
    pub(super) fn memory_needed(&self) -> Option<u64> {
        match self {
            Self::Memory { needed, .. } | Self::PatchErrorMemory { needed, .. } => Some(*needed),
            _ => None,
        }
    }

    /// Whether the work folder is of use to another run: the source and the options are not to blame.
    pub(super) fn keeps_work(&self) -> bool {
        match self.cause() {
            // Layers are done before textures.
            Self::Work { .. } | Self::Interrupted { .. } | Self::Texture { .. } => true,
            Self::Store(error) => !matches!(error, StoreError::Spool { .. }),
            _ => false,
        }
    }
}

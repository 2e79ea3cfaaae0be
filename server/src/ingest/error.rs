//! Why a DEM was refused. Every message names the file, what was expected, what was found and the remedy.

use std::io;
use std::path::{Path, PathBuf};

/// Why a source could not be opened or read. Messages are for the user of the command line.
#[derive(Debug, thiserror::Error)]
pub enum IngestError {
    /// No path was given.
    #[error("expected at least one DEM file, found none: name one or several files")]
    NoInput,
    /// The operating system refused.
    #[error("{}: expected a readable file, found an error while trying to {doing} ({source}): check the path, \
             the permissions and the space for temporary files", file.display())]
    Io {
        /// The file.
        file: PathBuf,
        /// What was being done.
        doing: &'static str,
        /// What the system said.
        source: io::Error,
    },
    /// The content contradicts its own format: damaged, cut short or hostile.
    #[error("{}: expected {expected}, found {found}: {remedy}", file.display())]
    Broken {
        /// The file.
        file: PathBuf,
        /// What a whole file has.
        expected: String,
        /// What this one has.
        found: String,
        /// What to do.
        remedy: String,
    },
    /// A valid file of a kind that is not read.
    #[error("{}: expected {expected}, found {found}: {remedy}", file.display())]
    Unsupported {
        /// The file.
        file: PathBuf,
        /// What is read.
        expected: String,
        /// What this file is.
        found: String,
        /// What to do.
        remedy: String,
    },
    /// The file is fine but the options do not fit it.
    #[error("{}: expected {expected}, found {found}: {remedy}", file.display())]
    Options {
        /// The file.
        file: PathBuf,
        /// What this file needs.
        expected: String,
        /// What was asked.
        found: String,
        /// What to do.
        remedy: String,
    },
    /// Two files do not lie on one grid.
    #[error("{} and {}: expected one grid, {expected}, found {found}: reproject or crop one of them, or build \
             each into a store of its own", first.display(), second.display())]
    Mosaic {
        /// The first file.
        first: PathBuf,
        /// The file that does not fit.
        second: PathBuf,
        /// What the first has.
        expected: String,
        /// What the second has.
        found: String,
    },
    /// A caller asked for samples beyond the grid.
    #[error("expected a window inside {width} x {height} samples, found {found}: ask for less")]
    Window {
        /// Samples of the grid, west to east.
        width: u32,
        /// Samples of the grid, south to north.
        height: u32,
        /// The window.
        found: String,
    },
}

pub(super) type Result<T> = std::result::Result<T, IngestError>;

pub(super) fn broken(
    file: &Path,
    expected: impl Into<String>,
    found: impl Into<String>,
    remedy: impl Into<String>,
) -> IngestError {
    IngestError::Broken {
        file: file.to_owned(),
        expected: expected.into(),
        found: found.into(),
        remedy: remedy.into(),
    }
}

pub(super) fn unsupported(
    file: &Path,
    expected: impl Into<String>,
    found: impl Into<String>,
    remedy: impl Into<String>,
) -> IngestError {
    IngestError::Unsupported {
        file: file.to_owned(),
        expected: expected.into(),
        found: found.into(),
        remedy: remedy.into(),
    }
}

pub(super) fn options(
    file: &Path,
    expected: impl Into<String>,
    found: impl Into<String>,
    remedy: impl Into<String>,
) -> IngestError {
    IngestError::Options {
        file: file.to_owned(),
        expected: expected.into(),
        found: found.into(),
        remedy: remedy.into(),
    }
}

/// Turns an I/O error into one that names the file.
pub(super) fn io_error(file: &Path, doing: &'static str) -> impl Fn(io::Error) -> IngestError {
    move |source| IngestError::Io { file: file.to_owned(), doing, source }
}

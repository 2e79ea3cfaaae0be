//! Why a store could not be written or read, and what to do about it.

use super::Key;
use super::format::{BLOB_BYTES_MAX, FORMAT, SCENE_BYTES_MAX, SCENE_FILE};
use std::io;
use std::path::{Path, PathBuf};

/// Why a store could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The file system said no.
    #[error("{path}: cannot {action}: {error}; {}", remedy(action, error))]
    Io {
        /// What was being done.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// The file system would not give a blob.
    #[error("{path}: cannot read blob {key:?}: {error}; {}", remedy("read", error))]
    Unread {
        /// The pack.
        path: PathBuf,
        /// The blob.
        key: Key,
        /// What the system said.
        error: io::Error,
    },
    /// There is no store here.
    #[error(
        "{0}: not a store: expected a folder with a {SCENE_FILE} in it; build one with `diamantina-server build DEM -o {0}`"
    )]
    NotAStore(PathBuf),
    /// Another build holds the lock.
    #[error("{0}: another program is writing this store: wait for it, or choose another folder")]
    Busy(PathBuf),
    /// The folder holds what no build left there.
    #[error(
        "{path}: expected an empty folder or a store, found '{found}' in it: choose another folder with -o"
    )]
    Foreign {
        /// The folder.
        path: PathBuf,
        /// The first of what is in it.
        found: String,
    },
    /// What an interrupted build left is not what it wrote.
    #[error(
        "{path}: damaged since it was written ({key:?} does not match its checksum): build again with --fresh"
    )]
    Spool {
        /// The spool.
        path: PathBuf,
        /// The blob.
        key: Key,
    },
    /// Written by another version.
    #[error("{path}: store has format {found}, this program reads {FORMAT}: build it again")]
    Format {
        /// The store.
        path: PathBuf,
        /// The format found.
        found: u32,
    },
    /// The description would be too long to be read again.
    #[error(
        "{path}: {SCENE_FILE} would have {found} bytes, at most {SCENE_BYTES_MAX}: give its zones fewer corners, or its series fewer steps"
    )]
    Description {
        /// The store.
        path: PathBuf,
        /// Bytes.
        found: usize,
    },
    /// A blob is larger than any that is read.
    #[error(
        "{path}: the masks of zone '{zone}' have {found} bytes, at most {BLOB_BYTES_MAX}: give it a larger --hidden"
    )]
    Blob {
        /// The store.
        path: PathBuf,
        /// The zone.
        zone: String,
        /// Bytes.
        found: usize,
    },
    /// What should name an object store does not.
    #[error("{address}: {reason}")]
    Address {
        /// What was given.
        address: String,
        /// What is wrong with it.
        reason: String,
    },
    /// An object store does not let us.
    #[error(
        "{address}: access denied ({reason}): set the credentials of the object store in the environment (AWS_..., \
         GOOGLE_..., AZURE_...), with the right to read there, and to write for whoever publishes"
    )]
    Denied {
        /// Where.
        address: String,
        /// What the store said.
        reason: String,
    },
    /// An object store cannot be reached.
    #[error(
        "{address}: the object store cannot be reached ({reason}): check the address, AWS_ENDPOINT and the like, the network and the store"
    )]
    Away {
        /// Where.
        address: String,
        /// What happened.
        reason: String,
    },
    /// An object store answers, but not this.
    #[error(
        "{address}: the object store answers other requests, but not this one ({reason}): look into its log"
    )]
    Unanswered {
        /// Where.
        address: String,
        /// What happened.
        reason: String,
    },
    /// Somebody else published.
    #[error(
        "{address}: somebody else has published another version there in the meantime: that one stays; look at it, and \
         publish again to replace it"
    )]
    Overtaken {
        /// The description.
        address: String,
    },
    /// The disk cache cannot be used.
    #[error("{path}: no disk cache: {what}")]
    DiskCache {
        /// The folder.
        path: PathBuf,
        /// Why not.
        what: String,
    },
    /// The content does not match its hashes.
    #[error(
        "{path}: damaged: {what}; mend the store from a copy with `diamantina-server repair`, or build it again"
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What was expected and what was found.
        what: String,
    },
}

fn remedy(action: &str, error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            "free some space and build again: the same command goes on where this one ended (the old scene, if any, is untouched)"
        }
        io::ErrorKind::ReadOnlyFilesystem => "choose a folder on a disk that can be written",
        kind if matches!(action, "open" | "read") => match kind {
            io::ErrorKind::PermissionDenied => "ask for the right to read it",
            _ => "build the store again, or copy it again from where it is intact",
        },
        io::ErrorKind::PermissionDenied => "choose a folder that you may write to",
        _ => "check the disk, or choose another folder with -o (the old scene, if any, is untouched)",
    }
}

pub(super) fn io_at<'a>(action: &'static str, path: &'a Path) -> impl Fn(io::Error) -> StoreError + 'a {
    move |error| StoreError::Io { action, path: path.to_owned(), error }
}

//! What was fetched, kept on the disk: for the next session, and for when the server cannot be reached.
//!
//! An entry is a blob by its route, as it came: payloads, pages of the index, masks, descriptions of scenes. Whatever has a route below
//! a version never changes, so nothing expires. A route counts together with the server's address and a hash of
//! the token: what was fetched with a token is found with the same token alone.
//!
//! Nothing here is trusted, nor needed: each entry has a checksum, and one that does not fit is as good as none; a disk that is
//! full, slow or read-only costs nothing but what is not kept.
//!
//! | module | what it holds |
//! |---|---|
//! | `entries` | the entries, in a file of SQLite, under a limit |
//! | `keeper` | the thread that reads and writes them |

mod entries;
mod keeper;

#[cfg(test)]
mod tests;

use bytes::Bytes;
use entries::{Entries, Key, LOG_BYTES, Origin};
use keeper::{Keeper, Order, WAITING_BYTES_MAX, Watch};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::sync::{Arc, mpsc};
use std::time::Duration;
use tokio::sync::oneshot;

/// The least that a folder may have for its entries, in bytes.
pub const LIMIT_MIN: u64 = 4 * LOG_BYTES;

/// How long [`Disk::flush`] waits.
const FLUSH: Duration = Duration::from_secs(5);

/// Why nothing can be kept in a folder.
#[derive(Debug, thiserror::Error)]
pub enum DiskError {
    /// The folder, or the file in it.
    #[error("{folder}: cannot be used as a disk cache: {reason}; choose another with --disk-cache")]
    Folder {
        /// The folder.
        folder: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Too little.
    #[error("--disk-cache-size {0}: expected at least {LIMIT_MIN} bytes (32MiB)")]
    Limit(u64),
}

/// A folder in which what is fetched is kept. Cheap to clone: all are the same one.
///
/// Takes up to 17 MiB of memory for what is not written yet, and a thread. Several programs may use a folder at once.
#[derive(Debug, Clone)]
pub struct Disk(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    orders: mpsc::Sender<Order>,
    watch: Arc<Watch>,
}

impl PartialEq for Disk {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}

impl Eq for Disk {}

impl Disk {
    /// Keeps things in a folder, which is made if need be: at most `limit_bytes`, all its files together. Waits for the
    /// disk. Where the folder may not be written, what is there is used.
    ///
    /// # Errors
    /// When the folder can be neither made nor read, or the limit is below [`LIMIT_MIN`].
    pub fn open(folder: &Path, limit_bytes: u64) -> Result<Self, DiskError> {
        if limit_bytes < LIMIT_MIN {
            return Err(DiskError::Limit(limit_bytes));
        }
        let entries = Entries::open(folder, limit_bytes)?;
        let (orders, receiver) = mpsc::channel();
        let watch = Arc::new(Watch::default());
        let keeper = Keeper::new(entries, Arc::clone(&watch));
        let thread = std::thread::Builder::new().name("diamantina-disk".into());
        let started = thread.spawn(move || keeper.run(&receiver));
        let reason =
            |e: std::io::Error| DiskError::Folder { folder: folder.to_owned(), reason: e.to_string() };
        started.map_err(reason)?;
        Ok(Self(Arc::new(Inner { orders, watch })))
    }

    /// Waits until what was fetched so far is on the disk, some seconds at most; how many bytes of it are taken. Before a
    /// program ends: the last fifth of a second would be lost.
    #[allow(clippy::must_use_candidate, reason = "it is called for what it does")]
    pub fn flush(&self) -> u64 {
        let (sender, receiver) = mpsc::channel();
        self.order(Order::Flush(sender));
        receiver.recv_timeout(FLUSH).unwrap_or_default()
    }

    /// What keeps things from being kept, in words; it was logged once.
    #[must_use]
    pub fn problem(&self) -> Option<String> {
        self.0.watch.problem()
    }

    /// What is kept of the server at `base`, as whoever has this token sees it.
    pub(crate) fn shelf(&self, base: &str, token: Option<&str>) -> Shelf {
        let mut hasher = blake3::Hasher::new_derive_key("diamantina client disk cache 1");
        hasher.update(base.as_bytes()).update(&[0]).update(token.unwrap_or_default().as_bytes());
        let mut origin = Origin::default();
        origin.copy_from_slice(&hasher.finalize().as_bytes()[..16]);
        Shelf { disk: self.clone(), origin }
    }

    fn order(&self, order: Order) {
        // A thread that is gone keeps nothing.
        let _ = self.0.orders.send(order);
    }
}

/// What is kept of one server, as one user sees it.
#[derive(Debug, Clone)]
pub(crate) struct Shelf {
    disk: Disk,
    origin: Origin,
}

impl Shelf {
    fn key(&self, route: String) -> Key {
        Key { origin: self.origin, route }
    }

    /// What is kept of each of these routes.
    pub(crate) async fn get(&self, routes: Vec<String>) -> Vec<Option<Bytes>> {
        let (sender, receiver) = oneshot::channel();
        let count = routes.len();
        self.disk.order(Order::Get(routes.into_iter().map(|route| self.key(route)).collect(), sender));
        receiver.await.unwrap_or_else(|_| vec![None; count])
    }

    /// Keeps what came for a route. Where room is needed, higher ranks go first: a diamond's is its level.
    pub(crate) fn put(&self, route: String, rank: u32, blob: Bytes) {
        let waiting = &self.disk.0.watch.waiting;
        let bytes = blob.len() as u64;
        if waiting.fetch_add(bytes, Ordering::Relaxed) + bytes > WAITING_BYTES_MAX {
            waiting.fetch_sub(bytes, Ordering::Relaxed);
        } else {
            self.disk.order(Order::Put(self.key(route), rank, blob));
        }
    }

    /// Forgets what came for a route: it was no good.
    pub(crate) fn forget(&self, route: String) {
        self.disk.order(Order::Forget(self.key(route)));
    }

    /// Says which version of a scene is current: others are forgotten before all else.
    pub(crate) fn set_current(&self, scene: &str, version: &str) {
        self.disk.order(Order::SetCurrent(self.origin, scene.to_owned(), version.to_owned()));
    }
}

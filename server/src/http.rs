//! Stores over HTTP. `router(stores)` is a plain function of what it serves; errors become statuses here
//! and nowhere else.
//!
//! Everything under a version never changes, and says so to caches. Metadata is revalidated by its ETag.
//!
//! | module | what it holds |
//! |---|---|
//! | `accept`, `still` | the loop that accepts connections, and the end of those that take too long |
//! | `sendfile` | blobs that the kernel sends by itself |
//! | `tls` | encryption, with a certificate that changes |
//! | `limits`, `open_files` | what is allowed, by us and by the system |
//! | `front` | what every request meets before the routes, and every answer after them |
//! | `access` | who may see which scenes, and how often |
//! | `routes`, `answer`, `many` | what each kind of address is answered with |
//! | `contract` | the same, told as OpenAPI |
//! | `scenes`, `blobs` | what is served: versions that change, and blobs, the hot ones in memory |
//! | `viewer` | the browser's viewer: its page and files |
//! | `metrics` | what is counted |

mod accept;
mod access;
mod answer;
mod blobs;
mod contract;
mod front;
mod limits;
mod many;
mod metrics;
mod open_files;
mod routes;
mod scenes;
mod sendfile;
mod still;
mod tls;
mod viewer;

pub use access::{TokensError, new_token};
pub use limits::Limits;
pub use tls::TlsError;
pub use viewer::ViewerError;

use crate::height::Decoded;
use crate::store::{Disk, Shared, StoreError};
use access::{Access, Caller};
use answer::Told;
use blobs::Blobs;
use front::Front;
use metrics::Metrics;
use scenes::Scenes;
use sendfile::Files;
use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tls::Tls;
use viewer::Viewer;

/// Why a server cannot start or stops.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// A store cannot be opened.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Two stores hold scenes of one name.
    #[error(
        "{first} and {second} both hold a scene named '{name}': build one of them again with another --scene NAME"
    )]
    SameName {
        /// The name.
        name: String,
        /// A store.
        first: PathBuf,
        /// Another.
        second: PathBuf,
    },
    /// The tokens cannot be read.
    #[error(transparent)]
    Tokens(#[from] TokensError),
    /// The certificate cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// The browser's viewer cannot be read.
    #[error(transparent)]
    Viewer(#[from] ViewerError),
    /// The address cannot be listened on.
    #[error("cannot listen on {address}: {error}{}", match error.kind() {
        std::io::ErrorKind::AddrInUse => "; another program has that port: choose another with --listen, for instance --listen 127.0.0.1:0 for any free one",
        std::io::ErrorKind::PermissionDenied => "; ports below 1024 need rights: choose a higher one with --listen",
        std::io::ErrorKind::AddrNotAvailable => "; this machine does not have that address: choose another with --listen",
        _ => "",
    })]
    Listen {
        /// The address.
        address: SocketAddr,
        /// What the system said.
        error: std::io::Error,
    },
    /// The server's loop failed.
    #[error("server: {0}")]
    Run(#[from] std::io::Error),
}

/// How to serve.
#[derive(Debug, Clone, Default)]
pub struct Options {
    /// What is allowed, and when something is looked for again.
    pub limits: Limits,
    /// Scenes that only those with a token may see: a file with a line for each token.
    pub tokens: Option<PathBuf>,
    /// The files of a certificate and its key, both PEM: with them, what is sent is encrypted.
    pub certificate: Option<(PathBuf, PathBuf)>,
    /// The folder with the browser's viewer, which `make web` writes.
    pub web: Option<PathBuf>,
    /// A folder for pieces of object stores, and how many bytes it may take.
    pub disk_cache: Option<(PathBuf, u64)>,
}

impl Options {
    /// What the stores of a server share.
    fn shared(&self) -> Result<Arc<Shared>, StoreError> {
        let disk = self.disk_cache.as_ref().map(|(folder, bytes)| Disk::open(folder, *bytes)).transpose()?;
        Ok(Arc::new(Shared { disk, ..Shared::default() }))
    }
}

/// What is served, and to whom.
#[derive(Debug)]
struct Site {
    scenes: Scenes,
    blobs: Arc<Blobs>,
    decoded: Arc<Decoded>,
    access: Access,
    viewer: Option<Viewer>,
    metrics: Arc<Metrics>,
}

impl Site {
    /// The names of the scenes that somebody may see.
    fn visible(&self, caller: Caller) -> Vec<String> {
        let mut names = self.scenes.names();
        names.retain(|name| self.access.allows(caller, name));
        names
    }

    /// What these scenes are at their newest versions.
    fn told(&self, caller: Caller) -> Vec<Arc<Told>> {
        self.visible(caller).iter().filter_map(|name| self.scenes.told(name)).collect()
    }
}

/// A server that has its stores open and its port bound.
#[derive(Debug)]
pub struct Server {
    scenes: Scenes,
    shared: Arc<Shared>,
    access: Access,
    viewer: Option<Viewer>,
    tls: Option<Arc<Tls>>,
    listener: TcpListener,
    address: SocketAddr,
    limits: Limits,
}

impl Server {
    /// Opens the stores and binds the address; port 0 takes a free one.
    ///
    /// # Errors
    /// When a store is missing or damaged, or the port is in use.
    pub fn open(stores: &[PathBuf], listen: SocketAddr) -> Result<Self, ServeError> {
        Self::open_with(stores, listen, &Options::default())
    }

    /// The same, as told.
    ///
    /// # Errors
    /// As [`Server::open`], and when a file of the options is none.
    pub fn open_with(stores: &[PathBuf], listen: SocketAddr, options: &Options) -> Result<Self, ServeError> {
        let access = Access::open(options.tokens.as_deref())?;
        let tls = options.certificate.as_ref().map(|(certificate, key)| Tls::open(certificate, key));
        let tls = tls.transpose()?.map(Arc::new);
        let shared = options.shared()?;
        // Packs are files, too.
        let files = open_files::raise();
        let scenes = Scenes::open(stores, &shared)?;
        let packs = scenes.all().iter().map(|store| store.open_files()).sum();
        let limits = files.map_or(options.limits, |files| open_files::fit(options.limits, files, packs));
        let viewer = options.web.as_deref().map(Viewer::open).transpose()?;
        let failed = |error| ServeError::Listen { address: listen, error };
        let listener = TcpListener::bind(listen).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        Ok(Self { scenes, shared, access, viewer, tls, listener, address, limits })
    }

    /// Where the server listens, as a URL.
    #[must_use]
    pub fn address(&self) -> String {
        format!("http{}://{}", if self.tls.is_some() { "s" } else { "" }, self.address)
    }

    /// Whether the browser's viewer is at its address.
    #[must_use]
    pub fn has_viewer(&self) -> bool {
        self.viewer.is_some()
    }

    /// The names of its scenes.
    #[must_use]
    pub fn scenes(&self) -> Vec<String> {
        self.scenes.names()
    }

    /// Serves until the process is interrupted or terminated, then lets answers under way end.
    ///
    /// # Errors
    /// When the async runtime cannot start.
    pub fn run_until_signal(self) -> Result<(), ServeError> {
        self.run(async {
            let interrupted = tokio::signal::ctrl_c();
            let terminated = async {
                match tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate()) {
                    Ok(mut signal) => signal.recv().await,
                    Err(_) => std::future::pending().await,
                }
            };
            tokio::select! { _ = interrupted => {}, _ = terminated => {} }
        })
    }

    /// Serves until `stop` is done.
    ///
    /// # Errors
    /// When the async runtime cannot start.
    pub fn run(self, stop: impl Future<Output = ()> + Send + 'static) -> Result<(), ServeError> {
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        let ended = runtime.block_on(async move {
            let listener = tokio::net::TcpListener::from_std(self.listener)?;
            let metrics = Arc::new(Metrics::new(self.shared));
            // What is encrypted is written by this process in any case.
            sendfile::outlive_limits()?;
            let files = if self.tls.is_none() { Files::new() } else { None };
            let blobs = Arc::new(Blobs::new(self.limits.cache, files, Arc::clone(&metrics)));
            let decoded = Arc::new(Decoded::new(self.limits.cache / 16));
            let (scenes, access, viewer) = (self.scenes, self.access, self.viewer);
            let site = Arc::new(Site { scenes, blobs, decoded, access, viewer, metrics });
            let front = Arc::new(Front::new(Arc::clone(&site), &self.limits));
            for name in site.scenes.names() {
                tokio::spawn(watch_scene(Arc::clone(&site), name, self.limits));
            }
            tokio::spawn(watch_access(site, Arc::clone(&front), self.tls.clone(), self.limits));
            accept::serve(listener, front, self.tls, self.limits, stop).await;
            Ok(())
        });
        // Whoever still waits for a disk or an object store is not waited for.
        runtime.shutdown_background();
        ended
    }
}

/// Opens all that a server would open, but for its port and its disk cache, and says which scenes it would serve.
///
/// # Errors
/// As [`Server::open_with`].
pub fn check(stores: &[PathBuf], options: &Options) -> Result<Vec<String>, ServeError> {
    Access::open(options.tokens.as_deref())?;
    if let Some((certificate, key)) = &options.certificate {
        Tls::open(certificate, key)?;
    }
    options.web.as_deref().map(Viewer::open).transpose()?;
    // The disk cache may be in use by the server that these settings are for.
    if let Some((folder, bytes)) = &options.disk_cache {
        Disk::check_budget(folder, *bytes)?;
    }
    Ok(Scenes::open(stores, &Arc::default())?.names())
}

fn ticks(limits: &Limits) -> tokio::time::Interval {
    let every = if limits.reload > 0 { limits.reload.into() } else { 60 };
    let mut ticks = tokio::time::interval(Duration::from_secs(every));
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    ticks
}

/// Does what waits for disks or networks, where others need not wait for it.
async fn aside(look: impl FnOnce() + Send + 'static) {
    if tokio::task::spawn_blocking(look).await.is_err() {
        tracing::error!("looking for what has changed failed; it is tried again");
    }
}

/// Looks for other versions of a scene, as long as the server runs. Each scene is looked at by itself: a store that does not answer,
/// or is being read through, holds up no other.
async fn watch_scene(site: Arc<Site>, name: String, limits: Limits) {
    let grace = Duration::from_secs(limits.grace.into());
    let mut ticks = ticks(&limits);
    if limits.reload == 0 {
        return;
    }
    loop {
        ticks.tick().await;
        let Some(store) = site.scenes.newest(&name) else { return };
        let site = Arc::clone(&site);
        aside(move || site.scenes.refresh(&store, grace, &site.metrics)).await;
    }
}

/// Looks for other tokens and certificates, as long as the server runs: no scene holds that up.
async fn watch_access(site: Arc<Site>, front: Arc<Front>, tls: Option<Arc<Tls>>, limits: Limits) {
    let mut ticks = ticks(&limits);
    loop {
        ticks.tick().await;
        front.tidy();
        if limits.reload > 0 {
            let (site, tls) = (Arc::clone(&site), tls.clone());
            aside(move || {
                site.access.refresh();
                if let Some(tls) = tls {
                    tls.refresh();
                }
            })
            .await;
        }
    }
}

/// Where the browser's viewer lies if nobody says: beside this program, or where `make web` has put it.
#[must_use]
pub fn web_folder() -> Option<PathBuf> {
    let program = std::env::current_exe().ok()?;
    let beside = program.ancestors().skip(1).take(2).map(|folder| folder.join("web"));
    beside.into_iter().find(|folder| folder.join("index.html").is_file())
}

/// Asks the server at `address` whether it is well.
///
/// # Errors
/// When it does not say so within five seconds.
pub fn ask_health(address: SocketAddr) -> Result<(), String> {
    let patience = Duration::from_secs(5);
    let ask = || -> std::io::Result<String> {
        let mut stream = TcpStream::connect_timeout(&address, patience)?;
        stream.set_read_timeout(Some(patience))?;
        write!(stream, "GET /health HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")?;
        let mut answer = String::new();
        stream.take(4096).read_to_string(&mut answer)?;
        Ok(answer)
    };
    match ask() {
        Ok(answer) if answer.starts_with("HTTP/1.1 200") => Ok(()),
        Ok(answer) => Err(format!("{address}: not well: {}", answer.lines().next().unwrap_or("no answer"))),
        Err(e) => Err(format!("{address}: no answer ({e}): is the server running there?")),
    }
}

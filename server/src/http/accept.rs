//! The loop that accepts connections, within limits.
//!
//! axum's own loop sets no deadlines and no bounds. Here each connection has a place among all and among those of its
//! address, and is given up when it stands still or takes too long to ask. It stays with one thread as long as it lasts.

use super::access::subscriber;
use super::front::{Connection, Front};
use super::limits::{HEAD_BYTES_MAX, Limits, STREAMS_MAX, URI_BYTES_MAX};
use super::metrics::Metrics;
use super::sendfile::{Outbox, Sender};
use super::still::{Activity, Noted, Patience, Watched};
use super::tls::Tls;
use crate::seldom::Seldom;
use http_body::Body as _;
use hyper::service::service_fn;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto;
use hyper_util::server::graceful::{GracefulShutdown, Watcher};
use std::cell::Cell;
use std::collections::HashMap;
use std::convert::Infallible;
use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot};

/// The pause after the system refused to accept, for want of files or memory.
const ACCEPT_PAUSE: Duration = Duration::from_millis(50);

/// What a thread does in one turn where there is more to do than a machine can, in requests of small answers: from then on it
/// lets others have the core once all are answered. Else answers pile up that nobody gets to read, and the latest are late by
/// whole turns of the scheduler. Where there is less to do it is this thread that would be late.
const MANY: u64 = 6;

/// Bytes of an answer that are as much to do for whoever reads it as another request.
const AS_MUCH: u64 = 32 << 10;

thread_local! {
    /// What this thread has done since it last had nothing to do.
    static DONE: Cell<u64> = const { Cell::new(0) };
}

fn done(more: u64) {
    DONE.set(DONE.get().saturating_add(more));
}

/// Serves what is behind `front` on connections of `listener` until `stop` is done and the answers under way have ended,
/// or had [`Limits::drain`] to do so.
pub(super) async fn serve(
    listener: TcpListener,
    front: Arc<Front>,
    tls: Option<Arc<Tls>>,
    limits: Limits,
    stop: impl Future<Output = ()>,
) {
    let crew = match Crew::start() {
        Ok(crew) => crew,
        Err(error) => return tracing::error!(%error, "no threads to serve with"),
    };
    let door = Door {
        crew,
        builder: builder(&limits),
        front: Arc::clone(&front),
        places: Places::new(&limits, Arc::clone(front.metrics())),
        graceful: GracefulShutdown::new(),
        patience: Patience::from(&limits),
        tls,
        handshake: limits.head,
        refused: Seldom::default(),
    };
    door.accept(&listener, stop).await;
    front.stop();
    door.accept(&listener, tokio::time::sleep(Duration::from_secs(limits.shutdown_notice.into()))).await;
    drop(listener);
    if tokio::time::timeout(limits.drain, door.graceful.shutdown()).await.is_err() {
        tracing::warn!("answers were cut off that took longer than {} s to end", limits.drain.as_secs());
    }
}

fn builder(limits: &Limits) -> Arc<auto::Builder<TokioExecutor>> {
    let mut builder = auto::Builder::new(TokioExecutor::new());
    // Heads have their deadline from `Watched`: hyper's timer would begin with the answer before.
    builder
        .http1()
        .timer(TokioTimer::new())
        .header_read_timeout(None)
        .max_buf_size(HEAD_BYTES_MAX.max(URI_BYTES_MAX));
    builder
        .http2()
        .timer(TokioTimer::new())
        .max_concurrent_streams(STREAMS_MAX)
        .max_header_list_size(u32::try_from(HEAD_BYTES_MAX).unwrap_or(u32::MAX))
        .keep_alive_interval(limits.still / 2)
        .keep_alive_timeout(limits.head);
    Arc::new(builder)
}

/// Where connections come in.
struct Door {
    crew: Crew,
    builder: Arc<auto::Builder<TokioExecutor>>,
    front: Arc<Front>,
    places: Places,
    graceful: GracefulShutdown,
    patience: Patience,
    tls: Option<Arc<Tls>>,
    /// How long it may take until a connection is encrypted.
    handshake: Duration,
    /// By the system.
    refused: Seldom,
}

impl Door {
    /// Accepts connections until `stop` is done, and leaves each to a task of its own.
    async fn accept(&self, listener: &TcpListener, stop: impl Future<Output = ()>) {
        let mut stop = std::pin::pin!(stop);
        loop {
            let accepted =
                tokio::select! { accepted = listener.accept() => accepted, () = &mut stop => return };
            match accepted {
                Ok((stream, from)) => self.admit(stream, from),
                Err(error) => {
                    self.front.metrics().rejected("accept");
                    if let Some(times) = self.refused.happened() {
                        tracing::warn!(%error, times, "the system refuses to accept connections");
                    }
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
    }

    fn admit(&self, stream: TcpStream, from: SocketAddr) {
        let place = match self.places.take(subscriber(from.ip())) {
            Ok(place) => place,
            Err(reason) => {
                self.front.metrics().rejected(reason);
                tracing::debug!(%from, reason, "no place for a connection");
                return;
            }
        };
        // Frames of a batch are small, and wait for nothing.
        let _ = stream.set_nodelay(true);
        let acceptor = self.tls.as_ref().map(|tls| (tls.acceptor(), self.handshake));
        let outbox = Arc::new(Outbox::new(self.front.metrics().sent_uncopied_bytes.clone()));
        let visit = Visit {
            builder: Arc::clone(&self.builder),
            front: Arc::clone(&self.front),
            watcher: self.graceful.watcher(),
            connection: Arc::new(Connection {
                activity: Activity::new(),
                from,
                outbox: Arc::clone(&outbox),
                answers: Arc::clone(&place.answers),
            }),
            patience: self.patience,
        };
        let Ok(stream) = stream.into_std() else { return };
        self.crew.spawn(async move {
            let _place = place;
            let Ok(stream) = TcpStream::from_std(stream) else { return };
            let Some((acceptor, patience)) = acceptor else {
                return visit.serve(Sender::new(stream, outbox)).await;
            };
            let noted = Noted::new(stream, Arc::clone(&visit.connection.activity));
            match tokio::time::timeout(patience, acceptor.accept(noted)).await {
                Ok(Ok(encrypted)) => visit.serve(encrypted).await,
                Ok(Err(error)) => tracing::debug!(%error, %from, "handshake"),
                Err(_) => tracing::debug!(%from, "the handshake took too long"),
            }
        });
    }
}

/// Threads that serve connections, each with a runtime of its own: what comes in on a connection wakes one thread, and no
/// other that might take the work from it.
struct Crew {
    members: Vec<(Handle, oneshot::Sender<()>)>,
    next: AtomicUsize,
}

impl Crew {
    fn start() -> std::io::Result<Self> {
        let count = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let member = |number: usize| {
            let mut builder = tokio::runtime::Builder::new_current_thread();
            builder.enable_all();
            builder.on_thread_park(|| {
                if DONE.replace(0) >= MANY {
                    std::thread::yield_now();
                }
            });
            let runtime = builder.build()?;
            let (handle, (leave, left)) = (runtime.handle().clone(), oneshot::channel::<()>());
            std::thread::Builder::new().name(format!("serve-{number}")).spawn(move || {
                // Until the crew is dropped.
                let _ = runtime.block_on(left);
                // Whoever still waits for the disk is not waited for.
                runtime.shutdown_background();
            })?;
            Ok((handle, leave))
        };
        let members = (0..count).map(member).collect::<std::io::Result<_>>()?;
        Ok(Self { members, next: AtomicUsize::new(0) })
    }

    /// Leaves a connection to the next member.
    fn spawn(&self, visit: impl Future<Output = ()> + Send + 'static) {
        let number = self.next.fetch_add(1, Ordering::Relaxed) % self.members.len();
        self.members[number].0.spawn(visit);
    }
}

/// A connection that has its place, and all that serves it.
struct Visit {
    builder: Arc<auto::Builder<TokioExecutor>>,
    front: Arc<Front>,
    watcher: Watcher,
    connection: Arc<Connection>,
    patience: Patience,
}

impl Visit {
    /// Answers what is asked on a connection, until it ends.
    async fn serve(self, stream: impl AsyncRead + AsyncWrite + Send + 'static) {
        let Self { builder, front, watcher, connection, patience } = self;
        let (from, metrics) = (connection.from, Arc::clone(front.metrics()));
        let io = TokioIo::new(Box::pin(Watched::new(stream, Arc::clone(&connection.activity), patience)));
        let service = service_fn(move |request| {
            let (front, connection) = (Arc::clone(&front), Arc::clone(&connection));
            async move {
                let answer = front.answer(&connection, request).await;
                done(1 + answer.body().size_hint().lower() / AS_MUCH);
                Ok::<_, Infallible>(answer)
            }
        });
        let served = builder.serve_connection(io, service).into_owned();
        if let Err(error) = watcher.watch(served).await {
            // Such a head never becomes a request that the front could count.
            if error.downcast_ref::<hyper::Error>().is_some_and(hyper::Error::is_parse_too_large) {
                metrics.rejected("head");
            }
            tracing::debug!(%error, %from, "connection");
        }
    }
}

/// Places for connections, in all and by address.
struct Places {
    all: Arc<Semaphore>,
    by_address: Arc<Mutex<HashMap<IpAddr, OfAddress>>>,
    most: u32,
    metrics: Arc<Metrics>,
}

/// What an address has.
struct OfAddress {
    connections: u32,
    /// Room for its answers under way. Over HTTP/1.1 a connection has one; without a bound, a few connections of HTTP/2 could
    /// take all that there is for everybody.
    answers: Arc<Semaphore>,
}

/// A place for a connection; free again once dropped.
struct Place {
    _all: OwnedSemaphorePermit,
    by_address: Arc<Mutex<HashMap<IpAddr, OfAddress>>>,
    address: IpAddr,
    answers: Arc<Semaphore>,
    metrics: Arc<Metrics>,
}

impl Places {
    fn new(limits: &Limits, metrics: Arc<Metrics>) -> Self {
        let all = Arc::new(Semaphore::new(limits.max_connections as usize));
        Self { all, by_address: Arc::default(), most: limits.max_connections_per_address, metrics }
    }

    /// A place, or which limit leaves none.
    fn take(&self, address: IpAddr) -> Result<Place, &'static str> {
        let all = Arc::clone(&self.all).try_acquire_owned().map_err(|_| "connections")?;
        let mut by_address = self.by_address.lock().unwrap_or_else(PoisonError::into_inner);
        let of_address = by_address.entry(address).or_insert_with(|| {
            let answers = Arc::new(Semaphore::new(self.most as usize));
            OfAddress { connections: 0, answers }
        });
        if of_address.connections >= self.most {
            return Err("connections_of_address");
        }
        of_address.connections += 1;
        self.metrics.connections.inc();
        let answers = Arc::clone(&of_address.answers);
        let (by_address, metrics) = (Arc::clone(&self.by_address), Arc::clone(&self.metrics));
        Ok(Place { _all: all, by_address, address, answers, metrics })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.metrics.connections.dec();
        let mut by_address = self.by_address.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(of_address) = by_address.get_mut(&self.address) {
            of_address.connections -= 1;
            if of_address.connections == 0 {
                by_address.remove(&self.address);
            }
        }
    }
}

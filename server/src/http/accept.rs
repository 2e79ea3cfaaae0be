//! The loop that accepts connections, within limits.
//!
//! axum's own loop sets no deadlines and no bounds. Here each connection has a place among all and among those of its
//! address, a deadline for the head of a request, and is given up when it stands still. Each answer has a place, which it
//! holds until its last byte is gone, and a deadline for all of it.

use super::limits::{HEAD_BYTES_MAX, Limits, RETRY_AFTER, STREAMS_MAX, URI_BYTES_MAX};
use super::still::Watched;
use super::{Refusal, common_headers};
use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{Request, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use http_body::{Body as _, Frame, SizeHint};
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto;
use hyper_util::server::graceful::GracefulShutdown;
use hyper_util::service::TowerToHyperService;
use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::Instant;

/// The pause after the system refused to accept, for want of files or memory.
const ACCEPT_PAUSE: Duration = Duration::from_millis(50);

/// Answers under way, and whether more are wanted.
#[derive(Clone)]
struct Gate {
    places: Arc<Semaphore>,
    stopping: Arc<AtomicBool>,
    answer: Duration,
}

/// Serves `router` on connections of `listener` until `stop` is done and the answers under way have ended, or had
/// [`Limits::drain`] to do so.
pub(super) async fn serve(
    listener: TcpListener,
    router: Router,
    limits: Limits,
    stop: impl Future<Output = ()>,
) {
    let gate = Gate {
        places: Arc::new(Semaphore::new(limits.max_in_flight as usize)),
        stopping: Arc::default(),
        answer: limits.answer,
    };
    let stopping = Arc::clone(&gate.stopping);
    // Refusals have the headers of all answers.
    let router =
        router.layer(middleware::from_fn_with_state(gate, pass)).layer(middleware::from_fn(common_headers));
    let door = Door {
        builder: builder(&limits),
        service: TowerToHyperService::new(router),
        places: Places::new(&limits),
        graceful: GracefulShutdown::new(),
        still: limits.still,
    };
    door.accept(&listener, stop).await;
    stopping.store(true, Ordering::Relaxed);
    door.accept(&listener, tokio::time::sleep(Duration::from_secs(limits.shutdown_notice.into()))).await;
    drop(listener);
    if tokio::time::timeout(limits.drain, door.graceful.shutdown()).await.is_err() {
        tracing::warn!("answers were cut off that took longer than {} s to end", limits.drain.as_secs());
    }
}

fn builder(limits: &Limits) -> Arc<auto::Builder<TokioExecutor>> {
    let mut builder = auto::Builder::new(TokioExecutor::new());
    builder
        .http1()
        .timer(TokioTimer::new())
        .header_read_timeout(limits.head)
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
    builder: Arc<auto::Builder<TokioExecutor>>,
    service: TowerToHyperService<Router>,
    places: Places,
    graceful: GracefulShutdown,
    still: Duration,
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
                    tracing::warn!(%error, "accept");
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
    }

    fn admit(&self, stream: TcpStream, from: SocketAddr) {
        let Some(place) = self.places.take(from.ip()) else {
            tracing::debug!(%from, "no place for this connection");
            return;
        };
        // Frames of a batch are small, and wait for nothing.
        let _ = stream.set_nodelay(true);
        let (builder, service) = (Arc::clone(&self.builder), self.service.clone());
        let (watcher, still) = (self.graceful.watcher(), self.still);
        tokio::spawn(async move {
            let _place = place;
            let io = TokioIo::new(Box::pin(Watched::new(stream, still)));
            let connection = builder.serve_connection(io, service).into_owned();
            if let Err(error) = watcher.watch(connection).await {
                tracing::debug!(%error, %from, "connection");
            }
        });
    }
}

/// Lets a request through if it is one that this server answers and there is room for its answer.
async fn pass(State(gate): State<Gate>, request: Request, next: Next) -> Response {
    if gate.stopping.load(Ordering::Relaxed) && request.uri().path() == "/ready" {
        return Refusal::new(StatusCode::SERVICE_UNAVAILABLE, "this server is about to stop").into_response();
    }
    if request.uri().to_string().len() > URI_BYTES_MAX {
        let detail = format!("an address has at most {URI_BYTES_MAX} bytes: ask for fewer diamonds at once");
        return Refusal::new(StatusCode::URI_TOO_LONG, detail).into_response();
    }
    if !request.body().is_end_stream() {
        let refusal = Refusal::new(StatusCode::PAYLOAD_TOO_LARGE, "no request here has a body");
        // What follows is not read.
        return ([(header::CONNECTION, "close")], refusal).into_response();
    }
    let Ok(place) = Arc::clone(&gate.places).try_acquire_owned() else {
        let refusal = Refusal::new(StatusCode::SERVICE_UNAVAILABLE, "too much to do: ask again in a moment");
        let mut response = refusal.into_response();
        response.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from_static(RETRY_AFTER));
        return response;
    };
    let due = Instant::now() + gate.answer;
    next.run(request).await.map(|body| Body::new(Held { body, due, _place: place }))
}

/// The body of an answer, which holds its place until it is gone.
struct Held {
    body: Body,
    due: Instant,
    _place: OwnedSemaphorePermit,
}

impl http_body::Body for Held {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        if Instant::now() > self.due {
            return Poll::Ready(Some(Err(axum::Error::new("this answer took too long"))));
        }
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// Places for connections, in all and by address.
struct Places {
    all: Arc<Semaphore>,
    by_address: Arc<Mutex<HashMap<IpAddr, u32>>>,
    most: u32,
}

/// One of them; free again once dropped.
struct Place {
    _all: OwnedSemaphorePermit,
    by_address: Arc<Mutex<HashMap<IpAddr, u32>>>,
    address: IpAddr,
}

impl Places {
    fn new(limits: &Limits) -> Self {
        let all = Arc::new(Semaphore::new(limits.max_connections as usize));
        Self { all, by_address: Arc::default(), most: limits.max_connections_per_address }
    }

    fn take(&self, address: IpAddr) -> Option<Place> {
        let all = Arc::clone(&self.all).try_acquire_owned().ok()?;
        let mut by_address = self.by_address.lock().unwrap_or_else(PoisonError::into_inner);
        let count = by_address.entry(address).or_insert(0);
        if *count >= self.most {
            return None;
        }
        *count += 1;
        Some(Place { _all: all, by_address: Arc::clone(&self.by_address), address })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut by_address = self.by_address.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(count) = by_address.get_mut(&self.address) {
            *count -= 1;
            if *count == 0 {
                by_address.remove(&self.address);
            }
        }
    }
}

//! What every request meets before the routes, and every answer after them.
//!
//! Each answer has a name for the log, a place, which it holds until its last byte is gone, and a deadline for all of
//! it. It is counted and logged once it has ended.

use super::Site;
use super::access::{Rates, RequestIds};
use super::answer::{Cause, Refusal};
use super::limits::{Limits, RETRY_AFTER, URI_BYTES_MAX};
use super::metrics::{Metrics, NO_ROUTE, Route};
use super::routes;
use super::sendfile::Outbox;
use super::still::{Activity, Answering};
use axum::Router;
use axum::body::{Body, Bytes};
use axum::http::{
    HeaderMap, HeaderName, HeaderValue, Method, Request, Response, StatusCode, Uri, Version, header,
};
use axum::response::IntoResponse;
use http_body::{Body as _, Frame, SizeHint};
use hyper::body::Incoming;
use hyper::service::Service as _;
use hyper_util::service::TowerToHyperService;
use std::net::SocketAddr;
use std::num::NonZeroU32;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::Instant;

/// Bytes of a path that the log shows.
const PATH_SHOWN: usize = 200;

/// Headers of answers that pages of other sites may read.
const EXPOSED: &str = "etag, content-length, retry-after, server-timing, x-request-id";

/// Headers of requests that pages of other sites may send.
const ACCEPTED: &str = "authorization, if-match, if-none-match, x-request-id";

const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");
const SERVER_TIMING: HeaderName = HeaderName::from_static("server-timing");
const TIMING_ALLOW_ORIGIN: HeaderName = HeaderName::from_static("timing-allow-origin");

/// The routes, and who may get to them.
pub(super) struct Front {
    routes: TowerToHyperService<Router>,
    site: Arc<Site>,
    places: Arc<Semaphore>,
    most_of_address: usize,
    rates: Option<Rates>,
    ids: RequestIds,
    stopping: AtomicBool,
    longest: Duration,
}

/// What is known of a connection.
pub(super) struct Connection {
    pub(super) activity: Arc<Activity>,
    pub(super) from: SocketAddr,
    pub(super) outbox: Arc<Outbox>,
    /// Room for answers under way to its address.
    pub(super) answers: Arc<Semaphore>,
}

impl Front {
    pub(super) fn new(site: Arc<Site>, limits: &Limits) -> Self {
        let rates = NonZeroU32::new(limits.rate).zip(NonZeroU32::new(limits.burst));
        Self {
            routes: TowerToHyperService::new(routes::router(Arc::clone(&site))),
            site,
            places: Arc::new(Semaphore::new(limits.max_in_flight as usize)),
            most_of_address: limits.max_connections_per_address as usize,
            rates: rates.map(|(rate, burst)| Rates::new(rate, burst)),
            ids: RequestIds::new(),
            stopping: AtomicBool::new(false),
            longest: limits.answer,
        }
    }

    pub(super) fn metrics(&self) -> &Arc<Metrics> {
        &self.site.metrics
    }

    /// From now on this server is not to be counted on.
    pub(super) fn stop(&self) {
        self.stopping.store(true, Ordering::Relaxed);
    }

    /// Forgets what is of no more use.
    pub(super) fn tidy(&self) {
        if let Some(rates) = &self.rates {
            rates.forget();
        }
    }

    /// Answers a request that came on a connection.
    pub(super) async fn answer(&self, connection: &Connection, request: Request<Incoming>) -> Response<Body> {
        let mut ended = Ended {
            metrics: Arc::clone(&self.site.metrics),
            answering: connection.activity.begin(),
            places: None,
            began: Instant::now(),
            from: connection.from,
            id: self.ids.of(request.headers().get(REQUEST_ID).and_then(|value| value.to_str().ok())),
            method: request.method().clone(),
            uri: request.uri().clone(),
            route: NO_ROUTE,
            status: StatusCode::OK,
            sent: 0,
            is_whole: false,
        };
        ended.metrics.in_flight.inc();
        let mut response = match self.admit(connection, &request) {
            Err(refused) => *refused,
            Ok(places) => {
                ended.places = places;
                match routes::at_once(&self.site, &request) {
                    Some(response) => response,
                    None => {
                        // The body is empty.
                        let Ok(response) = self.routes.call(request.map(|_| Body::empty())).await;
                        response
                    }
                }
            }
        };
        if let Some(Cause(cause)) = response.extensions_mut().remove() {
            tracing::error!(id = ended.id, path = ended.path(), %cause, "store");
        }
        let filed = response.extensions_mut().remove();
        // Answers without a body never take it off.
        if let Some(filed) =
            filed.filter(|_| ended.method != Method::HEAD && response.status() == StatusCode::OK)
        {
            connection.outbox.expect(filed);
        }
        ended.route = response.extensions_mut().remove().map_or(NO_ROUTE, |Route(template)| template);
        ended.status = response.status();
        let seconds = ended.began.elapsed().as_secs_f64();
        ended.metrics.answered(ended.route, ended.status.as_u16(), seconds);
        common_headers(response.headers_mut(), &ended.id, seconds);
        let due = ended.began + self.longest;
        response.map(|body| Body::new(Held { body, due, ended }))
    }

    /// Places for the answer to a request, of its address's and of all, if it is one that this server answers and there is
    /// room. Who asks how the server is has to be told, above all when there is much to do: that takes no place, and counts for
    /// no rate.
    fn admit(
        &self,
        connection: &Connection,
        request: &Request<Incoming>,
    ) -> Result<Option<[OwnedSemaphorePermit; 2]>, Box<Response<Body>>> {
        let uri = request.uri();
        if self.stopping.load(Ordering::Relaxed) && uri.path() == "/ready" {
            let detail = "this server is about to stop";
            return Err(Box::new(Refusal::new(StatusCode::SERVICE_UNAVAILABLE, detail).into_response()));
        }
        // With two of them a proxy on the way may have gone by the other one.
        let hosts = request.headers().get_all(header::HOST).iter().count();
        if hosts > 1 || hosts == 0 && request.version() == Version::HTTP_11 {
            let detail =
                "a request of HTTP/1.1 has one Host header, and none has more (RFC 9112, section 3.2)";
            return Err(Box::new(Refusal::new(StatusCode::BAD_REQUEST, detail).into_response()));
        }
        if request.method() == Method::OPTIONS {
            return Err(Box::new(preflight()));
        }
        if uri.path_and_query().map_or(0, |p| p.as_str().len()) > URI_BYTES_MAX {
            self.site.metrics.rejected("address");
            let detail =
                format!("an address has at most {URI_BYTES_MAX} bytes: ask for fewer diamonds at once");
            return Err(Box::new(Refusal::new(StatusCode::URI_TOO_LONG, detail).into_response()));
        }
        if !request.body().is_end_stream() {
            self.site.metrics.rejected("body");
            let refusal = Refusal::new(StatusCode::PAYLOAD_TOO_LARGE, "no request here has a body");
            // What follows is not read.
            return Err(Box::new(([(header::CONNECTION, "close")], refusal).into_response()));
        }
        if matches!(uri.path(), "/health" | "/ready" | "/metrics") {
            return Ok(None);
        }
        if let Some(rates) = &self.rates {
            let caller = self.site.access.caller(request.headers());
            if let Err(wait) = rates.take(connection.from.ip(), &self.site.access, caller) {
                self.site.metrics.rejected("rate");
                let detail = "more requests than one may make: ask again in a moment";
                return Err(Box::new(later(StatusCode::TOO_MANY_REQUESTS, detail, 1 + wait.as_secs())));
            }
        }
        self.places(connection).map(Some).map_err(|reason| {
            self.site.metrics.rejected(reason);
            let detail = "too much to do: ask again in a moment";
            Box::new(later(StatusCode::SERVICE_UNAVAILABLE, detail, RETRY_AFTER))
        })
    }

    /// Places for an answer, or which limit leaves none.
    ///
    /// An address has no more of them than are free: one alone gets half of all, and each that takes all it can leaves as much for
    /// the others (Choudhury and Hahne's dynamic thresholds for switches with a shared memory, 1998, with alpha = 1).
    /// So it takes a dozen of them to fill what four could else.
    fn places(&self, connection: &Connection) -> Result<[OwnedSemaphorePermit; 2], &'static str> {
        let taken = self.most_of_address.saturating_sub(connection.answers.available_permits());
        let free = self.places.available_permits();
        if free == 0 {
            return Err("in_flight");
        }
        if taken >= free {
            return Err("in_flight_of_address");
        }
        let take =
            |places: &Arc<Semaphore>, reason| Arc::clone(places).try_acquire_owned().map_err(|_| reason);
        Ok([take(&connection.answers, "in_flight_of_address")?, take(&self.places, "in_flight")?])
    }
}

fn later(status: StatusCode, detail: &str, seconds: u64) -> Response<Body> {
    ([(header::RETRY_AFTER, seconds.to_string())], Refusal::new(status, detail)).into_response()
}

/// What browsers ask before a page of another site sends a token.
fn preflight() -> Response<Body> {
    let headers = [
        (header::ALLOW, "GET, HEAD, OPTIONS"),
        (header::ACCESS_CONTROL_ALLOW_METHODS, "GET, HEAD"),
        (header::ACCESS_CONTROL_ALLOW_HEADERS, ACCEPTED),
        (header::ACCESS_CONTROL_MAX_AGE, "86400"),
    ];
    (StatusCode::NO_CONTENT, headers).into_response()
}

/// Headers that every answer has: any page may read it, no proxy may guess its type, and the log knows its name.
fn common_headers(headers: &mut HeaderMap, id: &str, seconds: f64) {
    headers.insert(header::ACCESS_CONTROL_ALLOW_ORIGIN, HeaderValue::from_static("*"));
    headers.insert(header::ACCESS_CONTROL_EXPOSE_HEADERS, HeaderValue::from_static(EXPOSED));
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(TIMING_ALLOW_ORIGIN, HeaderValue::from_static("*"));
    // Both are made of what headers may hold.
    if let Ok(id) = HeaderValue::from_str(id) {
        headers.insert(REQUEST_ID, id);
    }
    if let Ok(timing) = HeaderValue::try_from(format!("app;dur={:.3}", 1000.0 * seconds)) {
        headers.insert(SERVER_TIMING, timing);
    }
}

/// What happens when an answer has ended, whether its last byte was sent or not.
struct Ended {
    metrics: Arc<Metrics>,
    answering: Answering,
    places: Option<[OwnedSemaphorePermit; 2]>,
    began: Instant,
    from: SocketAddr,
    id: String,
    method: Method,
    uri: Uri,
    route: &'static str,
    status: StatusCode,
    sent: u64,
    is_whole: bool,
}

impl Ended {
    /// What the log shows of the address: not the query, where secrets might be.
    fn path(&self) -> &str {
        let path = self.uri.path();
        path.char_indices().nth(PATH_SHOWN).map_or(path, |(end, _)| &path[..end])
    }
}

impl Drop for Ended {
    fn drop(&mut self) {
        let seconds = self.began.elapsed().as_secs_f64();
        self.places.take();
        self.metrics.in_flight.dec();
        self.metrics.ended(self.route, self.sent, seconds);
        tracing::info!(
            id = self.id,
            from = %self.from,
            method = %self.method,
            path = self.path(),
            route = self.route,
            status = self.status.as_u16(),
            bytes = self.sent,
            milliseconds = 1000.0 * seconds,
            whole = self.is_whole,
            "answered"
        );
    }
}

/// The body of an answer, which holds its place until it is gone.
struct Held {
    body: Body,
    due: Instant,
    ended: Ended,
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
        let polled = Pin::new(&mut self.body).poll_frame(context);
        match &polled {
            Poll::Ready(Some(Ok(frame))) => {
                self.ended.sent += frame.data_ref().map_or(0, |data| data.len() as u64);
                self.ended.answering.goes_on();
                self.ended.is_whole = self.body.is_end_stream();
            }
            Poll::Ready(Some(Err(error))) => {
                tracing::error!(id = self.ended.id, path = self.ended.path(), %error, "an answer is cut off");
            }
            Poll::Ready(None) => self.ended.is_whole = true,
            Poll::Pending => {}
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

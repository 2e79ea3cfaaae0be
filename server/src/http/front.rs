//! What every request meets before the routes, and every answer after them.
//!
//! Each answer has a place, which it holds until its last byte is gone, and a deadline for all of it.

use super::Refusal;
use super::limits::{Limits, RETRY_AFTER, URI_BYTES_MAX};
use super::still::{Activity, Answering};
use axum::Router;
use axum::body::{Body, Bytes};
use axum::http::{HeaderValue, Method, Request, Response, StatusCode, header};
use axum::response::IntoResponse;
use http_body::{Body as _, Frame, SizeHint};
use hyper::body::Incoming;
use hyper::service::Service as _;
use hyper_util::service::TowerToHyperService;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::Instant;

/// The routes, and who may get to them.
pub(super) struct Front {
    routes: TowerToHyperService<Router>,
    places: Arc<Semaphore>,
    stopping: AtomicBool,
    longest: Duration,
}

impl Front {
    pub(super) fn new(routes: Router, limits: &Limits) -> Self {
        Self {
            routes: TowerToHyperService::new(routes),
            places: Arc::new(Semaphore::new(limits.max_in_flight as usize)),
            stopping: AtomicBool::new(false),
            longest: limits.answer,
        }
    }

    /// From now on this server is not to be counted on.
    pub(super) fn stop(&self) {
        self.stopping.store(true, Ordering::Relaxed);
    }

    /// Answers a request that came on a connection.
    pub(super) async fn answer(
        &self,
        activity: &Arc<Activity>,
        request: Request<Incoming>,
    ) -> Response<Body> {
        let answering = activity.begin();
        let due = Instant::now() + self.longest;
        let is_readable = matches!(*request.method(), Method::GET | Method::HEAD | Method::OPTIONS);
        let (mut response, place) = match self.admit(&request) {
            Err(refused) => (refused, None),
            Ok(place) => {
                // The body is empty.
                let Ok(response) = self.routes.call(request.map(|_| Body::empty())).await;
                (response, Some(place))
            }
        };
        let headers = response.headers_mut();
        headers.insert(header::ACCESS_CONTROL_ALLOW_ORIGIN, HeaderValue::from_static("*"));
        headers
            .insert(header::ACCESS_CONTROL_EXPOSE_HEADERS, HeaderValue::from_static("etag, content-length"));
        headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
        if !is_readable {
            headers.insert(header::ALLOW, HeaderValue::from_static("GET, HEAD"));
        }
        response.map(|body| Body::new(Held { body, due, _place: place, _answering: answering }))
    }

    /// A place for the answer to a request, if it is one that this server answers and there is room.
    fn admit(&self, request: &Request<Incoming>) -> Result<OwnedSemaphorePermit, Response<Body>> {
        let uri = request.uri();
        if self.stopping.load(Ordering::Relaxed) && uri.path() == "/ready" {
            let detail = "this server is about to stop";
            return Err(Refusal::new(StatusCode::SERVICE_UNAVAILABLE, detail).into_response());
        }
        if uri.path_and_query().map_or(0, |p| p.as_str().len()) > URI_BYTES_MAX {
            let detail =
                format!("an address has at most {URI_BYTES_MAX} bytes: ask for fewer diamonds at once");
            return Err(Refusal::new(StatusCode::URI_TOO_LONG, detail).into_response());
        }
        if !request.body().is_end_stream() {
            let refusal = Refusal::new(StatusCode::PAYLOAD_TOO_LARGE, "no request here has a body");
            // What follows is not read.
            return Err(([(header::CONNECTION, "close")], refusal).into_response());
        }
        Arc::clone(&self.places).try_acquire_owned().map_err(|_| {
            let detail = "too much to do: ask again in a moment";
            let refusal = Refusal::new(StatusCode::SERVICE_UNAVAILABLE, detail);
            ([(header::RETRY_AFTER, RETRY_AFTER)], refusal).into_response()
        })
    }
}

/// The body of an answer, which holds its place until it is gone.
struct Held {
    body: Body,
    due: Instant,
    _place: Option<OwnedSemaphorePermit>,
    _answering: Answering,
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

//! What answers are made of: refusals in words, tags, and who has something already.

use crate::store::StoreError;
use axum::body::Body;
use axum::extract::{self, FromRequestParts};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use diamantina_protocol::message::Problem;
use serde::de::DeserializeOwned;
use std::sync::Arc;

/// For what never changes.
pub(super) const IMMUTABLE: &str = "public, max-age=31536000, immutable";

/// For the same of a private scene: no cache that others share may keep it.
pub(super) const IMMUTABLE_PRIVATE: &str = "private, max-age=31536000, immutable";

/// Seconds after which whoever asked for what could not be had from an object store may ask again.
const AWAY_RETRY_AFTER: u64 = 2;

pub(super) const OCTETS: &str = "application/octet-stream";

/// A refusal, sent as problem+json (RFC 9457).
pub(super) struct Refusal {
    status: StatusCode,
    detail: String,
    /// What the log is told and the answer is not.
    cause: Option<Cause>,
    /// Seconds after which it may be asked again.
    later: Option<u64>,
}

/// What went wrong on our side, in the extensions of an answer.
#[derive(Debug, Clone)]
pub(super) struct Cause(pub(super) Arc<str>);

impl Refusal {
    pub(super) fn new(status: StatusCode, detail: impl Into<String>) -> Self {
        Self { status, detail: detail.into(), cause: None, later: None }
    }

    /// What is served here is damaged. The log says where; the answer does not tell strangers about our disks.
    pub(super) fn damaged(cause: &dyn std::fmt::Display) -> Self {
        let refusal =
            Self::new(StatusCode::INTERNAL_SERVER_ERROR, "the store is damaged here: the log says where");
        Self { cause: Some(Cause(cause.to_string().into())), ..refusal }
    }
}

impl Refusal {
    /// What is served here comes from a store that cannot be reached now.
    pub(super) fn away() -> Self {
        let detail = "where this comes from cannot be reached now: ask again in a moment";
        Self { later: Some(AWAY_RETRY_AFTER), ..Self::new(StatusCode::SERVICE_UNAVAILABLE, detail) }
    }

    /// The system does not give what is served here. The log says why.
    fn unread(cause: &StoreError) -> Self {
        let detail = "this cannot be read here: the log says why";
        let refusal = Self::new(StatusCode::INTERNAL_SERVER_ERROR, detail);
        Self { cause: Some(Cause(cause.to_string().into())), ..refusal }
    }
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        let title = self.status.canonical_reason().unwrap_or("Error").to_owned();
        let problem = Problem { title, status: self.status.as_u16(), detail: self.detail };
        let body = serde_json::to_vec(&problem).unwrap_or_default();
        let headers =
            [(header::CONTENT_TYPE, "application/problem+json"), (header::CACHE_CONTROL, "no-store")];
        let mut response = (self.status, headers, body).into_response();
        if let Some(seconds) = self.later {
            response.headers_mut().insert(header::RETRY_AFTER, seconds.into());
        }
        if let Some(cause) = self.cause {
            response.extensions_mut().insert(cause);
        }
        response
    }
}

impl From<StoreError> for Refusal {
    fn from(error: StoreError) -> Self {
        match &error {
            // The log says it once, of the store.
            StoreError::Away { .. } => Self::away(),
            StoreError::Unanswered { .. } => {
                Self { cause: Some(Cause(error.to_string().into())), ..Self::away() }
            }
            StoreError::Unread { .. } => Self::unread(&error),
            _ => Self::damaged(&error),
        }
    }
}

/// There is nothing with this address.
pub(super) fn no_address() -> Refusal {
    Refusal::new(StatusCode::NOT_FOUND, "no such address: GET /scenes lists what there is")
}

/// What the parts of an address name: axum's own, but refused as all else is, where a part is no text.
pub(super) struct Path<T>(pub(super) T);

impl<T: DeserializeOwned + Send, S: Send + Sync> FromRequestParts<S> for Path<T> {
    type Rejection = Refusal;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Refusal> {
        let found = extract::Path::from_request_parts(parts, state).await;
        found.map(|extract::Path(names)| Self(names)).map_err(|_| no_address())
    }
}

/// An answer with an ETag; 304 where the client has it already, 412 where it wants only another.
pub(super) fn tagged(
    headers: &HeaderMap,
    tag: &str,
    cache: &'static str,
    kind: &'static str,
    body: impl FnOnce() -> Body,
) -> Response {
    if headers.contains_key(header::IF_MATCH) && !names(headers, &header::IF_MATCH, tag) {
        let detail = format!("this has the tag \"{tag}\", which If-Match does not name");
        return Refusal::new(StatusCode::PRECONDITION_FAILED, detail).into_response();
    }
    let common = ([(header::ETAG, format!("\"{tag}\""))], [(header::CACHE_CONTROL, cache)]);
    if names(headers, &header::IF_NONE_MATCH, tag) {
        return (StatusCode::NOT_MODIFIED, common).into_response();
    }
    (common, [(header::CONTENT_TYPE, kind)], body()).into_response()
}

/// Whether a header names this tag. Tags here are strong; only `If-None-Match` takes weak ones for the same.
fn names(headers: &HeaderMap, header: &HeaderName, tag: &str) -> bool {
    let lists = headers.get_all(header).iter().filter_map(|value| value.to_str().ok());
    lists.flat_map(|list| list.split(',')).any(|item| {
        let item = item.trim();
        let item = if *header == header::IF_NONE_MATCH { item.trim_start_matches("W/") } else { item };
        item == "*" || item.strip_prefix('"').and_then(|rest| rest.strip_suffix('"')) == Some(tag)
    })
}

/// JSON that is asked for again each time, by its ETag.
pub(super) fn json(headers: &HeaderMap, value: &impl serde::Serialize) -> Response {
    let body = serde_json::to_vec(value).unwrap_or_default();
    let hash = blake3::hash(&body).to_hex();
    tagged(headers, &hash[..16], "no-cache", "application/json", || body.into())
}

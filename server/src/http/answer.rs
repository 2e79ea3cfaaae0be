//! What answers are made of: refusals in words, tags, and who has something already.

use crate::store::StoreError;
use axum::body::{Body, Bytes};
use axum::extract::{self, FromRequestParts};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use diamantina_protocol::message::Problem;
use http_body::{Frame, SizeHint};
use serde::de::DeserializeOwned;
use std::collections::VecDeque;
use std::convert::Infallible;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

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

/// JSON that is made once, is shared by all answers that it is in, and is asked for again each time, by its ETag.
#[derive(Debug, Clone)]
pub(super) struct Told {
    pieces: Vec<Bytes>,
    tag: String,
}

impl Told {
    pub(super) fn of(value: &impl serde::Serialize) -> Self {
        let text = serde_json::to_vec(value).unwrap_or_default();
        let tag = tag_of(&text);
        Self { pieces: vec![text.into()], tag }
    }

    /// All scenes, of what is told of each: a [`Catalogue`](diamantina_protocol::message::Catalogue).
    pub(super) fn catalogue(scenes: &[Arc<Self>]) -> Self {
        let mut pieces = vec![Bytes::from_static(b"{\"scenes\":[")];
        for (number, scene) in scenes.iter().enumerate() {
            if number > 0 {
                pieces.push(Bytes::from_static(b","));
            }
            pieces.extend_from_slice(&scene.pieces);
        }
        pieces.push(Bytes::from_static(b"]}"));
        let tags: Vec<&str> = scenes.iter().map(|scene| &*scene.tag).collect();
        Self { pieces, tag: tag_of(tags.join(" ").as_bytes()) }
    }

    /// The answer to who asks with these headers.
    pub(super) fn answer(&self, headers: &HeaderMap) -> Response {
        let body = || Body::new(Pieces(self.pieces.clone().into()));
        tagged(headers, &self.tag, "no-cache", "application/json", body)
    }
}

fn tag_of(bytes: &[u8]) -> String {
    blake3::hash(bytes).to_hex()[..16].to_owned()
}

/// A body of several pieces, none of which is copied.
struct Pieces(VecDeque<Bytes>);

impl http_body::Body for Pieces {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        _: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        Poll::Ready(self.0.pop_front().map(|piece| Ok(Frame::data(piece))))
    }

    fn is_end_stream(&self) -> bool {
        self.0.is_empty()
    }

    fn size_hint(&self) -> SizeHint {
        SizeHint::with_exact(self.0.iter().map(|piece| piece.len() as u64).sum())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::body::to_bytes;
    use diamantina_protocol::message::{Catalogue, Frame, Scene};

    fn scene(name: &str) -> Scene {
        let frame = Frame { crs: None, vertical_unit: "metre".to_owned() };
        let (name, version) = (name.to_owned(), "0123456789abcdef".to_owned());
        Scene { name, version, frame, layers: vec![], zones: vec![], textures: vec![], series: vec![] }
    }

    #[tokio::test]
    async fn a_catalogue_of_what_is_told_of_scenes_is_that_of_the_scenes() {
        for names in [&[][..], &["a"], &["a", "b", "c"]] {
            let scenes: Vec<Scene> = names.iter().map(|name| scene(name)).collect();
            let told: Vec<_> = scenes.iter().map(|scene| Arc::new(Told::of(scene))).collect();
            let answer = Told::catalogue(&told).answer(&HeaderMap::new());
            let body = to_bytes(answer.into_body(), 1 << 20).await.unwrap();
            assert_eq!(body, serde_json::to_vec(&Catalogue { scenes }).unwrap(), "{names:?}");
        }
    }
}

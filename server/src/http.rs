//! Stores over HTTP. `router(stores)` is a plain function of what it serves; errors become statuses here
//! and nowhere else.
//!
//! Everything under a version never changes, and says so to caches. Metadata is revalidated by its ETag.
//! The handlers read from local files, which the system caches: a read takes microseconds, so only whole
//! batches and heights leave the async threads.

mod accept;
mod front;
mod limits;
mod scenes;
mod still;

pub use limits::Limits;
pub use scenes::Scenes;

use crate::height::{self, HeightError};
use crate::store::{Key, Kind, Store, StoreError, zones};
use crate::stream::Stream;
use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{Path as UrlPath, Query, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::{MethodRouter, get};
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::index;
use diamantina_protocol::message::{
    self, BATCH_MAX, Catalogue, FrameHeader, Layer, PAYLOAD_BYTES_MAX, Problem, STREAM_MAX, Scene, Status,
};
use front::Front;
use scenes::Found;
use std::collections::HashMap;
use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

/// Frames of a batch that may wait for a slow reader.
const FRAMES_AHEAD: usize = 16;

/// Bytes of a stream that are made at once: what waits for a slow reader, but for one frame more.
const STREAM_PIECE_BYTES: usize = 16 << 10;

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

/// A server that has its stores open and its port bound.
#[derive(Debug)]
pub struct Server {
    scenes: Arc<Scenes>,
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
        let scenes = Scenes::open(stores)?;
        let failed = |error| ServeError::Listen { address: listen, error };
        let listener = TcpListener::bind(listen).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        Ok(Self { scenes: Arc::new(scenes), listener, address, limits: Limits::default() })
    }

    /// The same with other limits than [`Limits::default`].
    #[must_use]
    pub fn within(self, limits: Limits) -> Self {
        Self { limits, ..self }
    }

    /// Where the server listens, as a URL.
    #[must_use]
    pub fn address(&self) -> String {
        format!("http://{}", self.address)
    }

    /// The names of its scenes.
    #[must_use]
    pub fn scenes(&self) -> Vec<String> {
        self.scenes.all().iter().map(|store| store.scene().name.clone()).collect()
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
        runtime.block_on(async move {
            let listener = tokio::net::TcpListener::from_std(self.listener)?;
            if self.limits.reload > 0 {
                tokio::spawn(watch(Arc::clone(&self.scenes), self.limits));
            }
            let front = Front::new(router(self.scenes), &self.limits);
            accept::serve(listener, front, self.limits, stop).await;
            Ok(())
        })
    }
}

/// Looks for other versions of the scenes, as long as the server runs.
async fn watch(scenes: Arc<Scenes>, limits: Limits) {
    let mut ticks = tokio::time::interval(Duration::from_secs(limits.reload.into()));
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        let (scenes, grace) = (Arc::clone(&scenes), Duration::from_secs(limits.grace.into()));
        // Reading a whole store takes its time, and none of the others'.
        if tokio::task::spawn_blocking(move || scenes.refresh(grace)).await.is_err() {
            tracing::error!("looking for other versions failed; it is tried again");
        }
    }
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

/// The requests that the scenes answer.
pub fn router(scenes: Arc<Scenes>) -> Router {
    Router::new()
        .route("/", get(front_page))
        .route("/health", get(|| async { "ok\n" }))
        .route("/ready", get(|| async { "ok\n" }))
        .route("/scenes", get(catalogue))
        .route("/scenes/{scene}", get(scene))
        .route("/scenes/{scene}/{layer}/height", get(height_at))
        .route("/scenes/{scene}/{version}/zones/{zone}", get(zone))
        .route("/scenes/{scene}/{version}/{layer}/index/{page}", pages(points))
        .route("/scenes/{scene}/{version}/{layer}/points", batches(points))
        .route("/scenes/{scene}/{version}/{layer}/points/{x}/{y}", diamonds(points))
        .route("/scenes/{scene}/{version}/{layer}/tin/index/{page}", pages(tin))
        .route("/scenes/{scene}/{version}/{layer}/tin", batches(tin))
        .route("/scenes/{scene}/{version}/{layer}/tin/{x}/{y}", diamonds(tin))
        .route("/scenes/{scene}/{version}/{layer}/stream", get(stream))
        .fallback(|| async {
            Refusal::new(StatusCode::NOT_FOUND, "no such address: GET /scenes lists what there is")
        })
        .method_not_allowed_fallback(|| async {
            Refusal::new(StatusCode::METHOD_NOT_ALLOWED, "only GET and HEAD are answered")
        })
        .with_state(scenes)
}

/// A refusal, sent as problem+json (RFC 9457).
struct Refusal {
    status: StatusCode,
    detail: String,
}

impl Refusal {
    fn new(status: StatusCode, detail: impl Into<String>) -> Self {
        Self { status, detail: detail.into() }
    }
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        let title = self.status.canonical_reason().unwrap_or("Error").to_owned();
        let problem = Problem { title, status: self.status.as_u16(), detail: self.detail };
        let body = serde_json::to_vec(&problem).unwrap_or_default();
        let headers =
            [(header::CONTENT_TYPE, "application/problem+json"), (header::CACHE_CONTROL, "no-store")];
        (self.status, headers, body).into_response()
    }
}

impl From<StoreError> for Refusal {
    fn from(error: StoreError) -> Self {
        // The log names the blob; the answer does not tell strangers about our disks.
        tracing::error!(%error, "store");
        Self::new(StatusCode::INTERNAL_SERVER_ERROR, "the store is damaged here: the log says where")
    }
}

/// An answer with an ETag, or 304 where the client has it already.
fn tagged(
    headers: &HeaderMap,
    tag: &str,
    cache: &'static str,
    kind: &'static str,
    body: impl FnOnce() -> Body,
) -> Response {
    let common = [(header::ETAG, format!("\"{tag}\"")), (header::CACHE_CONTROL, cache.to_owned())];
    if is_known(headers, tag) {
        return (StatusCode::NOT_MODIFIED, common).into_response();
    }
    (common, [(header::CONTENT_TYPE, kind)], body()).into_response()
}

/// Whether the client has the answer with this tag already.
fn is_known(headers: &HeaderMap, tag: &str) -> bool {
    let tag = format!("\"{tag}\"");
    let known = headers.get_all(header::IF_NONE_MATCH).iter().filter_map(|v| v.to_str().ok());
    known
        .flat_map(|v| v.split(','))
        .any(|v| matches!(v.trim(), "*") || v.trim().trim_start_matches("W/") == tag)
}

const IMMUTABLE: &str = "public, max-age=31536000, immutable";
const OCTETS: &str = "application/octet-stream";

fn json(headers: &HeaderMap, value: &impl serde::Serialize) -> Response {
    let body = serde_json::to_vec(value).unwrap_or_default();
    let hash = blake3::hash(&body).to_hex();
    tagged(headers, &hash[..16], "no-cache", "application/json", || body.into())
}

async fn front_page(State(scenes): State<Arc<Scenes>>) -> Html<String> {
    let mut page = String::from(
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content=\"width=device-width\"><title>Diamantina</title>\
         <style>body{font:16px/1.5 system-ui;max-width:44rem;margin:3rem auto;padding:0 1rem}code{background:#eee;padding:.1em .3em}</style>\
         <h1>Diamantina</h1><p>This server streams terrain. Open a scene with the client:</p><ul>",
    );
    for store in scenes.all() {
        let name = &store.scene().name;
        // Names are letters, digits, '-', '_' and '.': nothing to escape.
        page += &format!(
            "<li><a href=/scenes/{name}>{name}</a> <code>diamantina-client render http://THIS-SERVER/scenes/{name} -o {name}.png</code>"
        );
    }
    page += "</ul><p><a href=/scenes>All scenes as JSON</a></html>";
    Html(page)
}

async fn catalogue(State(scenes): State<Arc<Scenes>>, headers: HeaderMap) -> Response {
    let scenes: Vec<Scene> = scenes.all().iter().map(|s| s.scene().clone()).collect();
    json(&headers, &Catalogue { scenes })
}

fn find_scene(scenes: &Scenes, name: &str) -> Result<Arc<Store>, Refusal> {
    scenes.newest(name).ok_or_else(no_scene)
}

fn no_scene() -> Refusal {
    Refusal::new(StatusCode::NOT_FOUND, "no such scene: GET /scenes lists them")
}

/// The layer of an address, with its number.
fn find_layer<'a>(store: &'a Store, name: &str) -> Result<(u8, &'a Layer), Refusal> {
    let found = store.scene().layers.iter().enumerate().find(|(_, l)| l.name == name);
    let (number, layer) =
        found.ok_or_else(|| Refusal::new(StatusCode::NOT_FOUND, "no such layer in this scene"))?;
    Ok((u8::try_from(number).unwrap_or(u8::MAX), layer))
}

/// The store of an address with a version.
fn find_version(scenes: &Scenes, name: &str, version: &str) -> Result<Arc<Store>, Refusal> {
    match scenes.at(name, version).ok_or_else(no_scene)? {
        Found::Store(store) => Ok(store),
        Found::Gone(current) => Err(Refusal::new(
            StatusCode::GONE,
            format!("scene '{name}' is now at version {current}: load its description again"),
        )),
    }
}

async fn scene(
    State(scenes): State<Arc<Scenes>>,
    UrlPath(name): UrlPath<String>,
    headers: HeaderMap,
) -> Result<Response, Refusal> {
    Ok(json(&headers, find_scene(&scenes, &name)?.scene()))
}

/// One of the encodings of a layer.
#[derive(Clone, Copy)]
struct Encoding {
    forest: Forest,
    payload: Kind,
    page: Kind,
    /// What ETags of its payloads and pages have in front.
    letters: [&'static str; 2],
}

/// The encoding `points` of a layer.
fn points(layer: &Layer) -> Result<Encoding, Refusal> {
    if !layer.encodings.iter().any(|e| e == "points") {
        return Err(Refusal::new(
            StatusCode::NOT_FOUND,
            "this layer has no points, only what its encodings list",
        ));
    }
    Ok(Encoding { forest: layer.forest, payload: Kind::Points, page: Kind::Index, letters: ["p", "i"] })
}

/// The encoding `tin` of a layer.
fn tin(layer: &Layer) -> Result<Encoding, Refusal> {
    let Some(tin) = &layer.tin else {
        return Err(Refusal::new(
            StatusCode::NOT_FOUND,
            "this layer has no triangles: build it with --encoding points,tin",
        ));
    };
    Ok(Encoding { forest: tin.forest, payload: Kind::Tin, page: Kind::TinIndex, letters: ["t", "j"] })
}

type PagePath = UrlPath<(String, String, String, String)>;
type DiamondPath = UrlPath<(String, String, String, String, String)>;
type BatchPath = UrlPath<(String, String, String)>;
type Ask = Query<HashMap<String, String>>;

/// Finds one of the encodings of a layer.
type Find = fn(&Layer) -> Result<Encoding, Refusal>;

/// Answers with pages of the index of an encoding.
fn pages(encoding: Find) -> MethodRouter<Arc<Scenes>> {
    get(move |State(scenes): State<Arc<Scenes>>, path: PagePath, headers: HeaderMap| async move {
        page_of(&scenes, path, &headers, encoding)
    })
}

/// Answers with diamonds of an encoding, one by one.
fn diamonds(encoding: Find) -> MethodRouter<Arc<Scenes>> {
    get(move |State(scenes): State<Arc<Scenes>>, path: DiamondPath, headers: HeaderMap| async move {
        diamond_of(&scenes, path, &headers, encoding)
    })
}

/// Answers with many diamonds of an encoding at once.
fn batches(encoding: Find) -> MethodRouter<Arc<Scenes>> {
    get(move |State(scenes): State<Arc<Scenes>>, path: BatchPath, query: Ask| async move {
        batch_of(&scenes, path, &query, encoding)
    })
}

fn page_of(
    scenes: &Scenes,
    UrlPath((name, version, layer, page)): PagePath,
    headers: &HeaderMap,
    encoding: Find,
) -> Result<Response, Refusal> {
    let store = find_version(scenes, &name, &version)?;
    let (number, layer) = find_layer(&store, &layer)?;
    let encoding = encoding(layer)?;
    let pages = index::pages(&encoding.forest);
    let missing = || {
        Refusal::new(StatusCode::NOT_FOUND, format!("no such page: the index has pages 0 to {}", pages - 1))
    };
    let page: u32 = page.parse().map_err(|_| missing())?;
    let blob = store.get(Key { layer: number, kind: encoding.page, a: page, b: 0 })?.ok_or_else(missing)?;
    let tag = format!("{version}-{number}-{}{page}", encoding.letters[1]);
    Ok(tagged(headers, &tag, IMMUTABLE, OCTETS, || blob.into()))
}

async fn zone(
    State(scenes): State<Arc<Scenes>>,
    UrlPath((name, version, zone)): UrlPath<(String, String, String)>,
    headers: HeaderMap,
) -> Result<Response, Refusal> {
    let store = find_version(&scenes, &name, &version)?;
    let missing =
        || Refusal::new(StatusCode::NOT_FOUND, "no such zone: the scene's description lists its zones");
    let position = store.scene().zones.iter().position(|z| z.name == zone).ok_or_else(missing)?;
    let blob = store.get(zones::key(position))?.ok_or_else(missing)?;
    Ok(tagged(&headers, &format!("{version}-z{position}"), IMMUTABLE, OCTETS, || blob.into()))
}

fn diamond_of(
    scenes: &Scenes,
    UrlPath((name, version, layer, x, y)): DiamondPath,
    headers: &HeaderMap,
    encoding: Find,
) -> Result<Response, Refusal> {
    let store = find_version(scenes, &name, &version)?;
    let (number, layer) = find_layer(&store, &layer)?;
    let encoding = encoding(layer)?;
    let no_diamond = || Refusal::new(StatusCode::NOT_FOUND, "no diamond with a payload has its centre there");
    let centre = [x.parse().map_err(|_| no_diamond())?, y.parse().map_err(|_| no_diamond())?];
    encoding.forest.diamond(centre).ok_or_else(no_diamond)?;
    let blob = store
        .get(Key { layer: number, kind: encoding.payload, a: centre[0], b: centre[1] })?
        .ok_or_else(no_diamond)?;
    let tag = format!("{version}-{number}-{}{x}-{y}", encoding.letters[0]);
    Ok(tagged(headers, &tag, IMMUTABLE, OCTETS, || blob.into()))
}

fn batch_of(
    scenes: &Scenes,
    UrlPath((name, version, layer)): BatchPath,
    query: &HashMap<String, String>,
    encoding: Find,
) -> Result<Response, Refusal> {
    let store = find_version(scenes, &name, &version)?;
    let (number, Encoding { forest, payload, .. }) = {
        let (number, layer) = find_layer(&store, &layer)?;
        (number, encoding(layer)?)
    };
    let list =
        query.get("d").ok_or_else(|| Refusal::new(StatusCode::BAD_REQUEST, "expected ?d=x,y;x,y;..."))?;
    let centres = message::parse_batch(list).map_err(|e| match e {
        message::BatchError::Many => Refusal::new(
            StatusCode::PAYLOAD_TOO_LARGE,
            format!("at most {BATCH_MAX} diamonds in one request"),
        ),
        message::BatchError::Syntax(_) => Refusal::new(StatusCode::BAD_REQUEST, e.to_string()),
    })?;
    // Coarse first, so that whatever arrives can be decoded; unknown centres last.
    let mut order: Vec<_> =
        centres.into_iter().map(|c| (forest.diamond(c).map_or(u32::MAX, |d| d.level()), c)).collect();
    order.sort_by_key(|(level, _)| *level);
    let (sender, receiver) = tokio::sync::mpsc::channel::<Result<Bytes, std::io::Error>>(FRAMES_AHEAD);
    tokio::task::spawn_blocking(move || {
        for (_, centre) in order {
            // The reader went away: stop reading for it.
            if sender.blocking_send(Ok(batch_frame(&store, number, payload, centre))).is_err() {
                break;
            }
        }
    });
    let frames =
        futures_util::stream::unfold(receiver, |mut r| async move { r.recv().await.map(|frame| (frame, r)) });
    let headers = [(header::CONTENT_TYPE, OCTETS), (header::CACHE_CONTROL, IMMUTABLE)];
    Ok((headers, Body::from_stream(frames)).into_response())
}

/// One frame of a batch: header and payload.
fn batch_frame(store: &Store, layer: u8, kind: Kind, centre: [u32; 2]) -> Bytes {
    let blob = store.get(Key { layer, kind, a: centre[0], b: centre[1] });
    let mut out = Vec::new();
    match blob {
        Ok(Some(payload)) if payload.len() as u64 <= u64::from(PAYLOAD_BYTES_MAX) => {
            out.reserve(payload.len() + message::FRAME_HEADER_BYTES_MAX);
            FrameHeader::of(centre, &payload).write(&mut out);
            out.extend_from_slice(&payload);
        }
        Ok(None) => FrameHeader::without(centre, Status::Missing).write(&mut out),
        Ok(Some(_)) => FrameHeader::without(centre, Status::Damaged).write(&mut out),
        Err(error) => {
            tracing::error!(%error, ?centre, "store");
            FrameHeader::without(centre, Status::Damaged).write(&mut out);
        }
    }
    out.into()
}

async fn stream(
    State(scenes): State<Arc<Scenes>>,
    UrlPath((name, version, layer)): UrlPath<(String, String, String)>,
    Query(query): Query<Vec<(String, String)>>,
    headers: HeaderMap,
) -> Result<Response, Refusal> {
    let store = find_version(&scenes, &name, &version)?;
    let (number, layer) = find_layer(&store, &layer)?;
    points(layer)?;
    let ask = message::parse_stream(query.iter().map(|(name, value)| (name.as_str(), value.as_str())))
        .map_err(|e| Refusal::new(StatusCode::BAD_REQUEST, e.to_string()))?;
    // However it was written, the same question has the same tag.
    let asked = blake3::hash(message::stream_route("", "", "", &ask).as_bytes()).to_hex();
    let tag = format!("{version}-{number}-s{}", &asked[..16]);
    let stream = Stream::new(Arc::clone(&store), number, layer, ask, STREAM_MAX);
    Ok(tagged(&headers, &tag, IMMUTABLE, OCTETS, || Body::from_stream(pieces(stream))))
}

/// The bytes of a stream. Each piece is made when the one before has gone out, on a thread that it leaves at
/// once: a slow reader keeps what the stream remembers and one piece, and no thread.
fn pieces(stream: Stream) -> impl futures_util::Stream<Item = Result<Bytes, std::io::Error>> {
    futures_util::stream::unfold(Some(stream), |stream| async move {
        let mut stream = stream?;
        let made = tokio::task::spawn_blocking(move || (stream.next_piece(STREAM_PIECE_BYTES), stream)).await;
        match made {
            Ok((Ok(piece), stream)) => piece.map(|piece| (Ok(piece), Some(stream))),
            Ok((Err(error), _)) => {
                tracing::error!(%error, "stream");
                // The answer is cut off, so that the reader knows.
                Some((Err(std::io::Error::other("the store is damaged here")), None))
            }
            Err(error) => Some((Err(std::io::Error::other(error)), None)),
        }
    })
}

async fn height_at(
    State(scenes): State<Arc<Scenes>>,
    UrlPath((name, layer)): UrlPath<(String, String)>,
    Query(query): Query<HashMap<String, String>>,
) -> Result<Response, Refusal> {
    let store = find_scene(&scenes, &name)?;
    points(find_layer(&store, &layer)?.1)?;
    let number = |key: &str| -> Result<Option<f64>, Refusal> {
        let Some(text) = query.get(key) else { return Ok(None) };
        let value = text.parse::<f64>().ok().filter(|v| v.is_finite());
        value.map(Some).ok_or_else(|| Refusal::new(StatusCode::BAD_REQUEST, format!("{key} is not a number")))
    };
    let asked = (number("x")?, number("y")?, number("lon")?, number("lat")?);
    let answer = tokio::task::spawn_blocking(move || {
        let crs = store.scene().frame.crs.as_ref();
        let place = match asked {
            (Some(x), Some(y), None, None) => [x, y],
            (None, None, Some(lon), Some(lat)) => height::to_frame(crs, lon, lat).map_err(refuse_height)?,
            _ => {
                return Err(Refusal::new(
                    StatusCode::BAD_REQUEST,
                    "expected ?x=&y= in metres or ?lon=&lat= in degrees",
                ));
            }
        };
        let (number, layer) = find_layer(&store, &layer)?;
        height::height(&store, number, layer, crs, place).map_err(refuse_height)
    });
    let answer = answer
        .await
        .map_err(|_| Refusal::new(StatusCode::INTERNAL_SERVER_ERROR, "the height could not be computed"))??;
    Ok(([(header::CACHE_CONTROL, "no-cache")], axum::Json(answer)).into_response())
}

fn refuse_height(error: HeightError) -> Refusal {
    match error {
        HeightError::Outside { .. } | HeightError::NoProjection(_) | HeightError::Unprojectable { .. } => {
            Refusal::new(StatusCode::NOT_FOUND, error.to_string())
        }
        HeightError::Store(e) => e.into(),
        HeightError::Damaged(_) => {
            tracing::error!(%error, "height");
            Refusal::new(StatusCode::INTERNAL_SERVER_ERROR, "the store is damaged here: the log says where")
        }
    }
}

//! What each kind of address is answered with. One function answers for each, whatever the encoding.

use super::Site;
use super::access::Caller;
use super::answer::{IMMUTABLE, IMMUTABLE_PRIVATE, OCTETS, Path, Refusal, Told, no_address, tagged};
use super::blobs::Blob;
use super::contract::{self, About, Form, Holds};
use super::many::{self, Batch};
use super::metrics::{Route, metrics};
use super::scenes::Found;
use super::viewer;
use crate::height::{self, HeightError};
use crate::store::{Key, Kind, Store, zones};
use crate::stream::Stream;
use axum::Router;
use axum::body::Body;
use axum::extract::{Query, State};
use axum::http::{HeaderMap, Method, Request, StatusCode, header};
use axum::middleware::map_response;
use axum::response::{Html, IntoResponse, Response};
use axum::routing::{MethodRouter, get};
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::index;
use diamantina_protocol::message::{self, BATCH_MAX, Layer, STREAM_MAX};
use diamantina_protocol::texture::Tile;
use std::collections::HashMap;
use std::sync::Arc;

type Methods = MethodRouter<Arc<Site>>;

/// A route: its template, what is told of it, who answers.
type Line = (&'static str, About, Methods);

const fn about(summary: &'static str, holds: Holds) -> About {
    About { summary, holds, query: &[], refusals: &[] }
}

/// About something of a version, or of a scene.
const fn below(summary: &'static str, refusals: &'static [u16]) -> About {
    About { summary, holds: Holds::Octets, query: &[], refusals }
}

/// About many diamonds at once.
const BATCH: About = About {
    query: &[("d", true, Form::Centres)],
    ..below("Many diamonds, coarse first, in frames", &[400, 404, 410])
};

const STREAM: About = About {
    query: &[
        ("bbox", false, Form::Numbers),
        ("error", false, Form::Number),
        ("limit", false, Form::Bytes),
        ("eye", false, Form::Numbers),
        ("angle", false, Form::Number),
        ("sides", false, Form::Numbers),
        ("vertical", false, Form::Text),
    ],
    ..below("A region or a view, the largest errors first, in frames", &[400, 404, 410, 500])
};

const HEIGHT: About = About {
    query: &[
        ("x", false, Form::Number),
        ("y", false, Form::Number),
        ("lon", false, Form::Number),
        ("lat", false, Form::Number),
    ],
    refusals: &[400, 404, 500],
    ..about("The height at a place, x and y in metres or lon and lat in degrees", Holds::Computed)
};

/// The routes of diamonds.
const POINTS: &str = "/scenes/{scene}/{version}/{layer}/points/{x}/{y}";
const TIN: &str = "/scenes/{scene}/{version}/{layer}/tin/{x}/{y}";

/// All routes.
fn lines() -> Vec<Line> {
    let well = || get(|| async { ([(header::CACHE_CONTROL, "no-store")], "ok\n") });
    let page = below("A page of the index, zstd-compressed", &[404, 410, 500]);
    let diamond = below("One diamond, named by its centre", &[404, 410, 500]);
    vec![
        (
            "/",
            about("The viewer, for browsers; where it is not built, what there is, for people", Holds::Html),
            get(front_page),
        ),
        (
            "/web/{hash}/{file}",
            About { refusals: &[404], ..about("A file of the viewer", Holds::Files) },
            get(viewer_file),
        ),
        ("/health", about("Whether the server answers", Holds::Text), well()),
        ("/ready", about("Whether it will go on", Holds::Text), get(ready)),
        ("/metrics", about("What was counted", Holds::Metrics), get(metrics)),
        ("/scenes", about("All scenes", Holds::Json), get(catalogue)),
        (
            "/scenes/{scene}",
            About { refusals: &[404], ..about("A scene at its newest version", Holds::Json) },
            get(scene),
        ),
        ("/scenes/{scene}/{layer}/height", HEIGHT, get(height_at)),
        (
            "/scenes/{scene}/{version}/{layer}/texture/{level}/{x}/{y}",
            About {
                holds: Holds::Picture,
                ..below("A tile of a texture, level 0 being the coarsest", &[404, 410, 500])
            },
            get(tile),
        ),
        (
            "/scenes/{scene}/{version}/zones/{zone}",
            below("What is seen from a zone, zstd-compressed", &[404, 410, 500]),
            get(zone),
        ),
        ("/scenes/{scene}/{version}/{layer}/index/{page}", page, get(index_page)),
        ("/scenes/{scene}/{version}/{layer}/points", BATCH, batches(points)),
        (POINTS, diamond, diamonds(points)),
        ("/scenes/{scene}/{version}/{layer}/tin/index/{page}", page, pages(tin)),
        ("/scenes/{scene}/{version}/{layer}/tin", BATCH, batches(tin)),
        (TIN, diamond, diamonds(tin)),
        ("/scenes/{scene}/{version}/{layer}/stream", STREAM, get(stream)),
    ]
}

/// The requests that a site answers.
pub(super) fn router(site: Arc<Site>) -> Router {
    let mut lines = lines();
    let ours = ("/openapi.json", about("This document", Holds::Json));
    let told = lines.iter().map(|(template, about, _)| (*template, about)).chain([(ours.0, &ours.1)]);
    let document = Arc::new(Told::of(&contract::document(told)));
    let tell = get(move |headers: HeaderMap| async move { document.answer(&headers) });
    lines.push((ours.0, ours.1, tell));
    let mut router = Router::new();
    for (template, _, methods) in lines {
        let named = move |mut response: Response| async move {
            response.extensions_mut().insert(Route(template));
            response
        };
        router = router.route(template, methods.layer(map_response(named)));
    }
    router
        .fallback(|| async { no_address() })
        .method_not_allowed_fallback(|| async {
            let refusal = Refusal::new(StatusCode::METHOD_NOT_ALLOWED, "only GET and HEAD are answered");
            ([(header::ALLOW, "GET, HEAD, OPTIONS")], refusal)
        })
        .with_state(site)
}

/// That the server can do its work. Where an object store cannot be reached it says so, but does not ask to be taken out:
/// all servers of that store would be, and none would be left for what they have in memory.
async fn ready(State(site): State<Arc<Site>>) -> Response {
    let stores = site.scenes.all();
    let away: Vec<_> = stores.iter().filter_map(|store| store.away()).collect();
    let text = away.iter().max().map_or_else(
        || "ok\n".to_owned(),
        |longest| {
            let (scenes, seconds) = (away.len(), longest.as_secs());
            format!("ok, but the object stores of {scenes} scenes cannot be reached, for {seconds} s by now: only what is cached is served of them\n")
        },
    );
    ([(header::CACHE_CONTROL, "no-store")], text).into_response()
}

async fn front_page(State(site): State<Arc<Site>>, caller: Caller, headers: HeaderMap) -> Response {
    if let Some(viewer) = &site.viewer {
        return viewer.page(&headers);
    }
    let mut page = String::from(
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content=\"width=device-width\"><title>Diamantina</title>\
         <style>body{font:16px/1.5 system-ui;max-width:44rem;margin:3rem auto;padding:0 1rem}code{background:#eee;padding:.1em .3em}</style>\
         <h1>Diamantina</h1><p>This server streams terrain. The viewer for browsers is not built here: <code>make web</code> builds \
         it, and says what it needs; then start the server again. Or open a scene with the client:</p><ul>",
    );
    for name in site.visible(caller) {
        // Names are letters, digits, '-', '_' and '.': nothing to escape.
        page += &format!(
            "<li><a href=/scenes/{name}>{name}</a> <code>diamantina-client view http://THIS-SERVER/scenes/{name}</code>"
        );
    }
    page += "</ul><p><a href=/scenes>All scenes as JSON</a></html>";
    Html(page).into_response()
}

async fn viewer_file(
    State(site): State<Arc<Site>>,
    Path((hash, file)): Path<(String, String)>,
    headers: HeaderMap,
) -> Response {
    match &site.viewer {
        Some(viewer) => viewer.file(&headers, &hash, &file),
        None => viewer::none().into_response(),
    }
}

async fn catalogue(State(site): State<Arc<Site>>, caller: Caller, headers: HeaderMap) -> Response {
    Told::catalogue(&site.told(caller)).answer(&headers)
}

/// The newest version of a scene.
fn find_scene(site: &Site, caller: Caller, name: &str) -> Result<Arc<Store>, Refusal> {
    site.scenes.newest(name).filter(|_| site.access.allows(caller, name)).ok_or_else(no_scene)
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

/// The store of an address with a version, and what caches may do with what is in it.
fn find_version(
    site: &Site,
    caller: Caller,
    name: &str,
    version: &str,
) -> Result<(Arc<Store>, &'static str), Refusal> {
    let found = site.scenes.at(name, version).filter(|_| site.access.allows(caller, name));
    match found.ok_or_else(no_scene)? {
        Found::Store(store) if site.access.is_private(name) => Ok((store, IMMUTABLE_PRIVATE)),
        Found::Store(store) => Ok((store, IMMUTABLE)),
        Found::Gone(current) => Err(Refusal::new(
            StatusCode::GONE,
            format!("scene '{name}' is now at version {current}: load its description again"),
        )),
    }
}

async fn scene(
    State(site): State<Arc<Site>>,
    caller: Caller,
    Path(name): Path<String>,
    headers: HeaderMap,
) -> Result<Response, Refusal> {
    let told = site.scenes.told(&name).filter(|_| site.access.allows(caller, &name));
    Ok(told.ok_or_else(no_scene)?.answer(&headers))
}

/// A number of an address as it is written here, so that what it names has one address.
fn digits(text: &str) -> Option<u32> {
    let is_plain = text == "0" || text.starts_with(|first| matches!(first, '1'..='9'));
    text.parse().ok().filter(|_| is_plain)
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
            "this layer has no points, only what its encodings list: build it with --encoding points,tin",
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

/// An answer that is a blob.
fn whole(headers: &HeaderMap, tag: &str, cache: &'static str, kind: &'static str, blob: Blob) -> Response {
    let Blob { bytes, filed } = blob;
    let mut response = tagged(headers, tag, cache, kind, || bytes.into());
    if let Some(filed) = filed {
        response.extensions_mut().insert(filed);
    }
    response
}

type PagePath = Path<(String, String, String, String)>;
type DiamondPath = Path<(String, String, String, String, String)>;
type BatchPath = Path<(String, String, String)>;
type Ask = Query<HashMap<String, String>>;

/// Finds one of the encodings of a layer.
type Find = fn(&Layer) -> Result<Encoding, Refusal>;

/// Answers with pages of the index of an encoding.
fn pages(encoding: Find) -> Methods {
    get(move |State(site): State<Arc<Site>>, caller: Caller, path: PagePath, headers: HeaderMap| async move {
        page_of(&site, caller, path, &headers, encoding).await
    })
}

/// Answers with diamonds of an encoding, one by one.
fn diamonds(encoding: Find) -> Methods {
    get(
        move |State(site): State<Arc<Site>>, caller: Caller, path: DiamondPath, headers: HeaderMap| async move {
            diamond_of(&site, caller, path, &headers, encoding).await
        },
    )
}

/// Answers with many diamonds of an encoding at once.
fn batches(encoding: Find) -> Methods {
    get(
        move |State(site): State<Arc<Site>>,
              caller: Caller,
              path: BatchPath,
              query: Ask,
              headers: HeaderMap| async move {
            batch_of(&site, caller, path, &query, &headers, encoding).await
        },
    )
}

async fn page_of(
    site: &Site,
    caller: Caller,
    Path((name, version, layer, page)): PagePath,
    headers: &HeaderMap,
    encoding: Find,
) -> Result<Response, Refusal> {
    let (store, cache) = find_version(site, caller, &name, &version)?;
    let (number, layer) = find_layer(&store, &layer)?;
    let encoding = encoding(layer)?;
    let pages = index::pages(&encoding.forest);
    let missing = || {
        Refusal::new(StatusCode::NOT_FOUND, format!("no such page: the index has pages 0 to {}", pages - 1))
    };
    let page = digits(&page).ok_or_else(missing)?;
    let key = Key { layer: number, kind: encoding.page, a: page, b: 0 };
    let blob = site.blobs.get(&store, key).await?.ok_or_else(missing)?;
    let tag = format!("{version}-{number}-{}{page}", encoding.letters[1]);
    Ok(whole(headers, &tag, cache, OCTETS, blob))
}

/// A page of a layer's points; or the only one of a texture, which tells of all tiles.
async fn index_page(
    State(site): State<Arc<Site>>,
    caller: Caller,
    path: PagePath,
    headers: HeaderMap,
) -> Result<Response, Refusal> {
    let Path((name, version, texture, page)) = &path;
    let (store, cache) = find_version(&site, caller, name, version)?;
    let Some(number) = find_texture(&store, texture) else {
        return page_of(&site, caller, path, &headers, points).await;
    };
    let missing = || Refusal::new(StatusCode::NOT_FOUND, "no such page: the index of a texture is page 0");
    if digits(page) != Some(0) {
        return Err(missing());
    }
    let blob = site.blobs.get(&store, Key::coverage(number)).await?.ok_or_else(missing)?;
    Ok(whole(&headers, &format!("{version}-x{number}"), cache, OCTETS, blob))
}

fn find_texture(store: &Store, name: &str) -> Option<u8> {
    let position = store.scene().textures.iter().position(|texture| texture.name == name)?;
    u8::try_from(position).ok()
}

async fn tile(
    State(site): State<Arc<Site>>,
    caller: Caller,
    Path((name, version, texture, level, x, y)): Path<(String, String, String, String, String, String)>,
    headers: HeaderMap,
) -> Result<Response, Refusal> {
    let (store, cache) = find_version(&site, caller, &name, &version)?;
    let missing = |detail: &'static str| Refusal::new(StatusCode::NOT_FOUND, detail);
    let number = find_texture(&store, &texture)
        .ok_or_else(|| missing("no such texture: the scene's description lists them"))?;
    let no_tile = || missing("no such tile: the texture's index tells which there are");
    let part = |text: &str| digits(text).ok_or_else(no_tile);
    let tile = Tile { level: part(&level)?, x: part(&x)?, y: part(&y)? };
    if !store.scene().textures[usize::from(number)].holds(tile) {
        return Err(no_tile());
    }
    let blob = site.blobs.get(&store, Key::tile(number, tile)).await?.ok_or_else(no_tile)?;
    let tag = format!("{version}-x{number}-{}-{}-{}", tile.level, tile.x, tile.y);
    Ok(whole(&headers, &tag, cache, "image/webp", blob))
}

async fn zone(
    State(site): State<Arc<Site>>,
    caller: Caller,
    Path((name, version, zone)): Path<(String, String, String)>,
    headers: HeaderMap,
) -> Result<Response, Refusal> {
    let (store, cache) = find_version(&site, caller, &name, &version)?;
    let missing =
        || Refusal::new(StatusCode::NOT_FOUND, "no such zone: the scene's description lists its zones");
    let position = store.scene().zones.iter().position(|z| z.name == zone).ok_or_else(missing)?;
    let blob = site.blobs.get(&store, zones::key(position)).await?.ok_or_else(missing)?;
    Ok(whole(&headers, &format!("{version}-z{position}"), cache, OCTETS, blob))
}

/// A diamond's payload as it is asked for.
struct Asked {
    store: Arc<Store>,
    key: Key,
    tag: String,
    /// What caches may do with it.
    cache: &'static str,
}

fn no_diamond() -> Refusal {
    Refusal::new(StatusCode::NOT_FOUND, "no diamond with a payload has its centre there")
}

/// Finds out which payload an address names: of a scene, a version, a layer, and a centre.
fn find_diamond(
    site: &Site,
    caller: Caller,
    [name, version, layer, x, y]: [&str; 5],
    encoding: Find,
) -> Result<Asked, Refusal> {
    let (store, cache) = find_version(site, caller, name, version)?;
    let (number, layer) = find_layer(&store, layer)?;
    let encoding = encoding(layer)?;
    let centre = [digits(x).ok_or_else(no_diamond)?, digits(y).ok_or_else(no_diamond)?];
    encoding.forest.diamond(centre).ok_or_else(no_diamond)?;
    let key = Key { layer: number, kind: encoding.payload, a: centre[0], b: centre[1] };
    let tag = format!("{version}-{number}-{}{}-{}", encoding.letters[0], centre[0], centre[1]);
    Ok(Asked { store, key, tag, cache })
}

async fn diamond_of(
    site: &Site,
    caller: Caller,
    Path((name, version, layer, x, y)): DiamondPath,
    headers: &HeaderMap,
    encoding: Find,
) -> Result<Response, Refusal> {
    let Asked { store, key, tag, cache } =
        find_diamond(site, caller, [&name, &version, &layer, &x, &y], encoding)?;
    let blob = site.blobs.get(&store, key).await?.ok_or_else(no_diamond)?;
    Ok(whole(headers, &tag, cache, OCTETS, blob))
}

/// The answer to what is asked for most, a diamond that is kept in memory, without the router, which takes a quarter of
/// the time of an answer: the same answer. `None` of whatever else is asked, which the router answers.
pub(super) fn at_once<B>(site: &Site, request: &Request<B>) -> Option<Response> {
    let path = request.uri().path();
    // What is written in another way is for the router to read.
    if request.method() != Method::GET || path.contains('%') {
        return None;
    }
    let mut parts = path.strip_prefix("/scenes/")?.split('/');
    let mut next = || parts.next();
    let [name, version, layer] = [next()?, next()?, next()?];
    let (find, template): (Find, _) = match next()? {
        "points" => (points, POINTS),
        "tin" => (tin, TIN),
        _ => return None,
    };
    let named = [name, version, layer, next()?, next()?];
    if next().is_some() {
        return None;
    }
    let caller = site.access.caller(request.headers());
    let Asked { store, key, tag, cache } = find_diamond(site, caller, named, find).ok()?;
    let blob = site.blobs.at_once(&store, key)?;
    let mut response = whole(request.headers(), &tag, cache, OCTETS, blob);
    response.extensions_mut().insert(Route(template));
    Some(response)
}

/// A short name for a question: however it was written, the same one has the same.
fn question(text: &str) -> String {
    blake3::hash(text.as_bytes()).to_hex()[..16].to_owned()
}

async fn batch_of(
    site: &Site,
    caller: Caller,
    Path((name, version, layer)): BatchPath,
    query: &HashMap<String, String>,
    headers: &HeaderMap,
    encoding: Find,
) -> Result<Response, Refusal> {
    let (store, cache) = find_version(site, caller, &name, &version)?;
    let (number, Encoding { forest, payload, letters, .. }) = {
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
    let centres = order.into_iter().map(|(_, centre)| centre).collect();
    let tag = format!("{version}-{number}-{}b{}", letters[0], question(list));
    let blobs = Arc::clone(&site.blobs);
    let batch = Batch { blobs, store, layer: number, kind: payload, centres };
    let mut response = tagged(headers, &tag, cache, OCTETS, Body::empty);
    if response.status() == StatusCode::OK {
        *response.body_mut() = many::batch(batch).await?;
    }
    Ok(response)
}

async fn stream(
    State(site): State<Arc<Site>>,
    caller: Caller,
    Path((name, version, layer)): Path<(String, String, String)>,
    Query(query): Query<Vec<(String, String)>>,
    headers: HeaderMap,
) -> Result<Response, Refusal> {
    let (store, cache) = find_version(&site, caller, &name, &version)?;
    let (number, layer) = find_layer(&store, &layer)?;
    points(layer)?;
    let ask = message::parse_stream(query.iter().map(|(name, value)| (name.as_str(), value.as_str())))
        .map_err(|e| Refusal::new(StatusCode::BAD_REQUEST, e.to_string()))?;
    let tag = format!("{version}-{number}-s{}", question(&message::stream_route("", "", "", &ask)));
    let stream = Stream::new(Arc::clone(&store), number, layer, ask, STREAM_MAX);
    let mut response = tagged(&headers, &tag, cache, OCTETS, Body::empty);
    if response.status() == StatusCode::OK {
        *response.body_mut() = many::stream(stream, &site.blobs).await?;
    }
    Ok(response)
}

async fn height_at(
    State(site): State<Arc<Site>>,
    caller: Caller,
    Path((name, layer)): Path<(String, String)>,
    Query(query): Query<HashMap<String, String>>,
) -> Result<Response, Refusal> {
    let store = find_scene(&site, caller, &name)?;
    points(find_layer(&store, &layer)?.1)?;
    let (blobs, decoded) = (Arc::clone(&site.blobs), Arc::clone(&site.decoded));
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
        height::height(&decoded, &store, number, layer, crs, place).map_err(|error| {
            if let HeightError::Store(error) = &error {
                blobs.failed(error);
            }
            refuse_height(error)
        })
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
        HeightError::Damaged(_) => Refusal::damaged(&error),
    }
}

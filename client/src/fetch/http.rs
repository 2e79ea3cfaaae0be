//! One server over HTTP: addresses, answers and their limits, and what has gone over the wire.

use super::unpack::unpack;
use super::{FetchError, TRIES_MAX, Traffic};
use crate::background::{sleep, within};
use bytes::Bytes;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::message::{self, Catalogue, FrameHeader, Kind, Layer, Scene, Status};
use diamantina_protocol::series::Series;
use diamantina_protocol::texture::TEXTURES_MAX;
use diamantina_protocol::zone::{self, LAYERS_MAX, Mask};
use futures_util::StreamExt as _;
use reqwest::{Client, Response, StatusCode, Url};
use std::hash::BuildHasher;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use web_time::Instant;

/// The pause after the first failure; it doubles with each, up to [`PAUSE_MAX`].
const PAUSE: Duration = Duration::from_millis(100);

/// The longest pause, also where the server asks for a longer one.
const PAUSE_MAX: Duration = Duration::from_secs(10);

/// Times that a scene's description is asked for that does not come whole: half a second at most without a server.
const OPENINGS_MAX: u32 = 3;

/// How long it is asked for again.
const OPENING: Duration = Duration::from_secs(5);

/// The largest answer in JSON, in bytes.
const JSON_BYTES_MAX: usize = 4 << 20;

/// The largest page of the index before and after decompression, in bytes.
pub(super) const PAGE_BYTES_MAX: usize = 4 * index::PAGE_BYTES_MAX;

/// The largest masks of a zone, compressed, in bytes: what a store may hold.
const ZONE_BYTES_MAX: usize = 16 << 20;

/// The base of an address, and the scene that it names.
pub(crate) fn parse_address(text: &str) -> Result<(Url, Option<String>), FetchError> {
    let wrong = |reason: &str| FetchError::Address { url: text.to_owned(), reason: reason.to_owned() };
    let mut url = Url::parse(text).map_err(|e| wrong(&e.to_string()))?;
    if !matches!(url.scheme(), "http" | "https") {
        return Err(wrong("it is neither http nor https"));
    }
    if url.host_str().is_none() {
        return Err(wrong("it has no host"));
    }
    // As the page in a browser names a scene.
    let asked = url.query_pairs().find(|(word, _)| word == "scene").map(|(_, name)| name.into_owned());
    url.set_query(None);
    url.set_fragment(None);
    let path = url.path().trim_end_matches('/').to_owned();
    let (prefix, name) = match path.rsplit_once("/scenes/") {
        Some((prefix, name)) => (prefix, Some(name)),
        None => (path.strip_suffix("/scenes").unwrap_or(&path), asked.as_deref()),
    };
    if name.is_some_and(|name| !message::is_name(name)) {
        return Err(wrong("after /scenes/ or ?scene= comes one name"));
    }
    url.set_path(prefix);
    Ok((url, name.map(str::to_owned)))
}

/// Why a scene cannot be shown, if so: it comes from outside.
pub(crate) fn check(scene: &Scene) -> Result<(), String> {
    if scene.layers.is_empty() || scene.layers.len() > LAYERS_MAX {
        return Err(format!("{} layers, expected 1 to {LAYERS_MAX}", scene.layers.len()));
    }
    if !message::is_name(&scene.name) || !message::is_name(&scene.version) {
        return Err("its name or version is none".into());
    }
    for layer in &scene.layers {
        let Layer { name, forest, coding, origin, cell, heights, .. } = layer;
        if !message::is_name(name) {
            return Err("a layer's name is none".into());
        }
        if coding.levels() != forest.levels() {
            return Err(format!(
                "layer '{name}': coding for {} levels, forest of {}",
                coding.levels(),
                forest.levels()
            ));
        }
        if let Some(tin) = &layer.tin {
            let same = (tin.forest.root_log2(), tin.forest.roots()) == (forest.root_log2(), forest.roots());
            if !same || tin.forest.levels() != tin.forest.lattice_levels() || !tin.finest_error.is_finite() {
                return Err(format!("layer '{name}': another frame for tin than for points"));
            }
        }
        let finite = [origin[0], origin[1], layer.height_offset, heights[0], heights[1]];
        let positive = [cell[0], cell[1], layer.quantum];
        if !finite.iter().chain(&positive).all(|x| x.abs() < 1e12)
            || !positive.iter().all(|x| *x > 0.0)
            || !layer.finest_error.is_finite()
        {
            return Err(format!("layer '{name}': numbers beyond all measure"));
        }
    }
    if let Some(series) = scene.series.iter().find(|series| !message::is_name(&series.name)) {
        return Err(format!("series '{}': expected another name", series.name.escape_debug()));
    }
    let layers = scene.layers.iter().map(|layer| (layer.name.as_str(), layer.kind == Kind::Water));
    Series::positions(&scene.series, layers).map_err(|e| e.to_string())?;
    if scene.textures.len() > TEXTURES_MAX {
        return Err(format!("{} textures, expected at most {TEXTURES_MAX}", scene.textures.len()));
    }
    for texture in &scene.textures {
        if !message::is_name(&texture.name) {
            return Err("a texture's name is none".into());
        }
        texture.check()?;
    }
    if scene.zones.len() > zone::ZONES_MAX {
        return Err(format!("{} zones, expected at most {}", scene.zones.len(), zone::ZONES_MAX));
    }
    for zone in &scene.zones {
        let corners: usize = zone.parts.iter().flat_map(|part| &part.rings).map(Vec::len).sum();
        let numbers =
            zone.parts.iter().flat_map(|part| part.rings.iter().flatten().flatten().chain([&part.ceiling]));
        let shares = (0.0..1.0).contains(&zone.hidden) && (0.0..=1.0).contains(&zone.angle);
        if !message::is_name(&zone.name) || corners > zone::CORNERS_MAX || !shares {
            return Err("a zone is none".into());
        }
        if !numbers.chain([&zone.eye]).all(|x| x.abs() < 1e12) {
            return Err(format!("zone '{}': numbers beyond all measure", zone.name));
        }
    }
    Ok(())
}

#[derive(Debug, Default)]
pub(super) struct Counters {
    bytes: AtomicU64,
    requests: AtomicU64,
    pub(super) round_trips: AtomicU64,
    pub(super) errors: AtomicU64,
    pub(super) cancelled: AtomicU64,
    disk_bytes: AtomicU64,
    disk_blobs: AtomicU64,
}

impl Counters {
    pub(super) fn read(&self) -> Traffic {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        Traffic {
            bytes: read(&self.bytes),
            requests: read(&self.requests),
            round_trips: read(&self.round_trips),
            errors: read(&self.errors),
            cancelled: read(&self.cancelled),
            disk_bytes: read(&self.disk_bytes),
            disk_blobs: read(&self.disk_blobs),
        }
    }

    /// Counts what was found on the disk.
    pub(super) fn found(&self, bytes: usize) {
        count(&self.disk_bytes, bytes);
        count(&self.disk_blobs, 1);
    }
}

pub(super) fn count(counter: &AtomicU64, more: usize) {
    counter.fetch_add(more as u64, Ordering::Relaxed);
}

/// The HTTP client, with its limits and counters.
#[derive(Debug)]
pub(super) struct Http {
    pub(super) client: Client,
    pub(super) base: String,
    /// How long nothing may come before a request is given up.
    pub(super) patience: Duration,
    pub(super) traffic: Counters,
}

/// The body of an answer, as it comes. In a browser it stays with the thread that asked.
#[cfg(not(target_arch = "wasm32"))]
type Chunks = futures_util::stream::BoxStream<'static, reqwest::Result<Bytes>>;
#[cfg(target_arch = "wasm32")]
type Chunks = futures_util::stream::LocalBoxStream<'static, reqwest::Result<Bytes>>;

impl Http {
    pub(super) async fn get(&self, route: &str) -> Result<Chunks, FetchError> {
        count(&self.traffic.requests, 1);
        let sent = self.client.get(format!("{}{route}", self.base)).send();
        let response = self.in_time(sent).await?;
        if response.status() == StatusCode::OK {
            return Ok(Box::pin(response.bytes_stream()));
        }
        Err(refusal(route, &response))
    }

    /// The ETag of an answer, if it has one, without its body.
    pub(super) async fn tag(&self, route: &str) -> Result<Option<String>, FetchError> {
        count(&self.traffic.requests, 1);
        let sent = self.client.head(format!("{}{route}", self.base)).send();
        let response = self.in_time(sent).await?;
        if response.status() == StatusCode::OK {
            let tag = response.headers().get(reqwest::header::ETAG);
            return Ok(tag.and_then(|tag| tag.to_str().ok()).map(str::to_owned));
        }
        Err(refusal(route, &response))
    }

    async fn in_time<T>(&self, coming: impl Future<Output = reqwest::Result<T>>) -> Result<T, FetchError> {
        match within(self.patience, coming).await {
            Some(come) => come.map_err(|e| transport(&e)),
            None => Err(FetchError::Transport(format!("nothing came for {:.0?}", self.patience))),
        }
    }

    pub(super) async fn chunk(&self, chunks: &mut Chunks) -> Result<Option<Bytes>, FetchError> {
        let chunk = self.in_time(async { chunks.next().await.transpose() }).await?;
        count(&self.traffic.bytes, chunk.as_ref().map_or(0, Bytes::len));
        Ok(chunk)
    }

    pub(super) async fn whole(&self, route: &str, limit: usize) -> Result<Vec<u8>, FetchError> {
        let mut chunks = self.get(route).await?;
        let mut body = Vec::new();
        while let Some(chunk) = self.chunk(&mut chunks).await? {
            if body.len() + chunk.len() > limit {
                return Err(FetchError::TooLarge { route: shortened(route), limit });
            }
            body.extend_from_slice(&chunk);
        }
        Ok(body)
    }

    pub(super) async fn json<T: serde::de::DeserializeOwned>(&self, route: &str) -> Result<T, FetchError> {
        let body = self.whole(route, JSON_BYTES_MAX).await?;
        serde_json::from_slice(&body)
            .map_err(|e| FetchError::Json { route: route.to_owned(), reason: e.to_string() })
    }

    /// The masks of a scene's zone as they come.
    pub(super) async fn masks(&self, route: &str) -> Result<Vec<u8>, FetchError> {
        count(&self.traffic.round_trips, 1);
        let mut tries = 0;
        loop {
            tries += 1;
            match self.whole(route, ZONE_BYTES_MAX).await {
                Err(error) if tries < TRIES_MAX && is_passing(&error) => {
                    count(&self.traffic.errors, 1);
                    let asked =
                        if let FetchError::Status { retry_after, .. } = error { retry_after } else { None };
                    sleep(pause(tries, asked)).await;
                }
                answer => return answer,
            }
        }
    }

    /// The description of the scene of this name, or of the only one.
    pub(super) async fn scene(&self, name: Option<&str>) -> Result<Scene, FetchError> {
        count(&self.traffic.round_trips, 1);
        let started = Instant::now();
        let mut tries = 0;
        let scene = loop {
            let answer = match name {
                Some(name) => self.json::<Scene>(&message::scene_route(name)).await,
                None => self.json::<Catalogue>("/scenes").await.and_then(only),
            };
            tries += 1;
            let (tries_max, asked) = match &answer {
                Err(FetchError::Status { status: 429 | 500.., retry_after, .. }) => (TRIES_MAX, *retry_after),
                // Cut off on the way, or garbled; but who has the address wrong is not kept waiting.
                Err(FetchError::Transport(_) | FetchError::Json { .. }) if started.elapsed() < OPENING => {
                    (OPENINGS_MAX, None)
                }
                _ => (0, None),
            };
            if tries >= tries_max {
                break answer?;
            }
            count(&self.traffic.errors, 1);
            sleep(pause(tries, asked)).await;
        };
        check(&scene).map_err(|reason| FetchError::Scene { scene: shortened(&scene.name), reason })?;
        Ok(scene)
    }
}

/// The masks of a zone, one a layer, of the diamonds of these forests, from what came over the wire.
pub(super) fn decode_masks(forests: &[Forest], zone: &str, blob: &[u8]) -> Result<Vec<Mask>, FetchError> {
    let wrong = |reason: String| FetchError::Zone { zone: zone.to_owned(), reason };
    let limit = zone::bytes_max(forests);
    let bytes = unpack(blob, limit)
        .ok_or_else(|| wrong(format!("they do not decompress to at most {limit} bytes")))?;
    zone::decode(forests, &bytes).map_err(|e| wrong(e.to_string()))
}

/// Whether the same request may succeed a little later.
fn is_passing(error: &FetchError) -> bool {
    matches!(error, FetchError::Transport(_) | FetchError::Status { status: 429 | 500.., .. })
}

pub(super) fn only(mut catalogue: Catalogue) -> Result<Scene, FetchError> {
    match catalogue.scenes.pop() {
        Some(scene) if catalogue.scenes.is_empty() => Ok(scene),
        last => Err(FetchError::Choose(catalogue.scenes.into_iter().chain(last).map(|s| s.name).collect())),
    }
}

/// Whether a frame's payload is what was asked for, as far as its header and the index tell.
pub(super) fn good_payload(
    d: Diamond,
    bytes: Option<u32>,
    header: &FrameHeader,
    payload: &Bytes,
) -> Result<(), FetchError> {
    match header.status {
        Status::Ok if header.checksum != message::checksum(payload) => Err(FetchError::Damaged(d.centre())),
        Status::Ok if bytes.is_some_and(|b| b != header.length) => Err(FetchError::Damaged(d.centre())),
        // The index was not there to tell that there is none.
        Status::Missing if bytes.is_none() && header.length == 0 => Ok(()),
        Status::Missing | Status::Damaged => Err(FetchError::Missing(d.centre())),
        Status::Page => Err(FetchError::Unasked(d.centre())),
        Status::Ok => Ok(()),
    }
}

/// What an answer that is no 200 means.
pub(super) fn refusal(route: &str, response: &Response) -> FetchError {
    let retry_after = response.headers().get("retry-after").and_then(|v| v.to_str().ok()?.parse().ok());
    FetchError::Status {
        route: shortened(route),
        status: response.status().as_u16(),
        retry_after: retry_after.map(Duration::from_secs),
    }
}

/// The entries of a page of the index, as it comes over the wire. Decompression stops at a limit, whatever the bytes
/// claim to become.
pub(crate) fn decode_page(
    forest: &Forest,
    number: u32,
    blob: &[u8],
) -> Result<Vec<(Diamond, Entry)>, FetchError> {
    let page = unpack(blob, PAGE_BYTES_MAX).ok_or(FetchError::Compression(number))?;
    Ok(index::decode(forest, number, &page)?)
}

/// The error with its causes: the outermost one alone says nothing.
pub(crate) fn transport(error: &reqwest::Error) -> FetchError {
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(next) = cause {
        text = format!("{text}: {next}");
        cause = next.source();
    }
    FetchError::Transport(text)
}

/// A route fit for a message: a batch's goes on for kilobytes.
pub(super) fn shortened(route: &str) -> String {
    route.chars().take(120).collect()
}

/// The pause after a number of failures in a row: doubling, and up to twice that by chance, so that many
/// clients do not come back at once.
pub(super) fn pause(tries: u32, asked: Option<Duration>) -> Duration {
    let doubled = PAUSE.saturating_mul(1 << (tries.clamp(1, 16) - 1));
    let chance = (std::hash::RandomState::new().hash_one(tries) % 1000) as f64 / 1000.0;
    doubled.mul_f64(1.0 + chance).max(asked.unwrap_or_default()).min(PAUSE_MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::scene;

    #[test]
    fn addresses_of_servers_and_scenes_are_told_apart() {
        let parse = |text| parse_address(text).map(|(url, name)| (url.to_string(), name));
        let at = |base: &str, name: Option<&str>| (base.to_owned(), name.map(str::to_owned));
        assert_eq!(parse("http://h:80/").unwrap(), at("http://h/", None));
        assert_eq!(parse("http://h:8080").unwrap(), at("http://h:8080/", None));
        assert_eq!(parse("http://h/scenes").unwrap(), at("http://h/", None));
        assert_eq!(parse("http://h/scenes/alps/").unwrap(), at("http://h/", Some("alps")));
        assert_eq!(
            parse("https://h/scenes/alps").unwrap(),
            ("https://h/".to_owned(), Some("alps".to_owned()))
        );
        assert_eq!(parse("http://h/deep/scenes/alps?x#y").unwrap(), at("http://h/deep", Some("alps")));
        assert_eq!(
            parse("http://h:80/?scene=alps&error=2#1,2,3,4,5").unwrap(),
            at("http://h/", Some("alps"))
        );
        assert_eq!(parse("http://h/deep/?scene=alps").unwrap(), at("http://h/deep", Some("alps")));
        for bad in
            ["http://h/?scene=../x", "", "h:80", "ftp://h/", "http://h/scenes/a/b/c", "http://h/scenes/.x"]
        {
            assert!(matches!(parse(bad), Err(FetchError::Address { .. })), "{bad}");
        }
    }

    #[test]
    fn scenes_with_impossible_numbers_are_refused() {
        assert_eq!(check(&scene(2)), Ok(()));
        let with = |change: &dyn Fn(&mut Scene)| {
            let mut scene = scene(2);
            change(&mut scene);
            check(&scene)
        };
        assert!(with(&|s| s.layers.clear()).is_err());
        assert!(with(&|s| s.version = "../x".into()).is_err());
        assert!(with(&|s| s.layers[1].name = "a/b".into()).is_err());
        assert!(with(&|s| s.layers[0].quantum = 0.0).is_err());
        assert!(with(&|s| s.layers[0].cell[1] = f64::NAN).is_err());
        assert!(with(&|s| s.layers[0].origin[1] = 1e300).is_err());
        assert!(with(&|s| s.layers[0].coding = s.layers[1].coding.clone()).is_err());
        assert_eq!(check(&scene(4)), Ok(()), "with a series");
        for change in [
            (|s| s.series[0].name = "a/b".into()) as fn(&mut Scene),
            |s| s.series[0].name = "water".into(),
            |s| s.series[0].layers[0] = "terrain".into(),
            |s| s.series[0].step_seconds = -1.0,
            |s| s.series[0].layers.clear(),
        ] {
            let mut scene = scene(4);
            change(&mut scene);
            assert!(check(&scene).unwrap_err().contains("series"));
        }
    }

    #[test]
    fn several_scenes_are_listed() {
        let catalogue =
            Catalogue { scenes: ["a", "b"].map(|name| Scene { name: name.into(), ..scene(1) }).to_vec() };
        let text = only(catalogue).unwrap_err().to_string();
        assert!(text.ends_with("a, b"), "{text}");
        assert!(only(Catalogue { scenes: Vec::new() }).is_err());
    }

    #[test]
    fn pauses_double_within_bounds() {
        for tries in 1..40 {
            let paused = pause(tries, None);
            let least = PAUSE.saturating_mul(1 << (tries - 1).min(12)).min(PAUSE_MAX);
            assert!(paused >= least && paused <= (least * 2).min(PAUSE_MAX), "{tries}: {paused:?}");
        }
        assert_eq!(pause(1, Some(Duration::from_secs(3600))), PAUSE_MAX);
        assert_eq!(pause(1, Some(Duration::from_secs(2))), Duration::from_secs(2));
    }
}

//! The checks, each a function that asks and tells.

use super::{Answer, Finding, Server, Verdict, answer};
use crate::encoding::Encoding;
use crate::fetch::{check_scene, decode_page};
use crate::surface::Surface;
use diamantina_protocol::bintree::Point;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::{self, BATCH_MAX, Catalogue, Scene, TARGET_BYTES_MAX};
use reqwest::header::{
    ACCEPT_ENCODING, ACCESS_CONTROL_REQUEST_HEADERS, ACCESS_CONTROL_REQUEST_METHOD, IF_NONE_MATCH, ORIGIN,
    RANGE,
};
use reqwest::{Client, Method, StatusCode, Version};
use std::time::SystemTime;

/// Seconds for which what never changes may be kept at least: a month.
const KEPT_MIN: u64 = 30 * 86400;

/// Seconds that clocks may be apart.
const CLOCKS_APART_MAX: u64 = 300;

/// Where a page of another site might come from.
const ELSEWHERE: &str = "https://elsewhere.example";

/// Headers that such a page has to be able to read.
const READ: [&str; 2] = ["etag", "retry-after"];

type Tell<'a> = dyn FnMut(Finding) + 'a;

fn good(check: &'static str, found: impl Into<String>) -> Finding {
    Finding { check, verdict: Verdict::Good, found: found.into(), remedy: None }
}

fn warning(check: &'static str, found: impl Into<String>, remedy: &'static str) -> Finding {
    Finding { check, verdict: Verdict::Warning, found: found.into(), remedy: Some(remedy) }
}

fn bad(check: &'static str, found: impl Into<String>, remedy: &'static str) -> Finding {
    Finding { check, verdict: Verdict::Bad, found: found.into(), remedy: Some(remedy) }
}

/// What an examination is made with.
pub(super) struct Subject<'a> {
    server: &'a Server,
    /// The scene, its first layer as it is streamed in `encoding`.
    scene: Scene,
    encoding: Encoding,
    /// A root with a payload, if the index tells of one.
    root: Option<Diamond>,
    /// The route of that payload, or else of a page of the index.
    sample: String,
    page: String,
    batch: String,
}

impl<'a> Subject<'a> {
    /// Reaches the server and finds the scene; `None` where that is not to be had, which is told.
    pub(super) async fn find(server: &'a Server, name: Option<&str>, tell: &mut Tell<'_>) -> Option<Self> {
        let first = match server.get("/health").await {
            Ok(first) => first,
            Err(why) => {
                tell(bad(
                    "reach",
                    why,
                    "is the server running, the address right, and the way to it open (DNS, firewall, certificate)?",
                ));
                return None;
            }
        };
        if first.status != StatusCode::OK || first.body != b"ok\n" {
            let found = format!(
                "/health answers {} and {} bytes, expected 200 and `ok`",
                first.status,
                first.body.len()
            );
            tell(bad("reach", found, "let the proxy pass /health; is there a Diamantina server behind it?"));
        } else {
            let again = server.get("/health").await.map_or(f64::NAN, |answer| answer.seconds);
            let [first, again] = [first.seconds, again].map(|seconds| 1e3 * seconds);
            tell(good(
                "reach",
                format!("answers in {first:.1} ms, then in {again:.1} ms on the same connection"),
            ));
        }
        let route = name.map_or_else(|| "/scenes".to_owned(), message::scene_route);
        let remedy =
            "GET /scenes lists what there is; private scenes need a token; a proxy has to pass /scenes/*";
        let found = match server.get(&route).await {
            Ok(found) if found.status == StatusCode::OK => found,
            Ok(other) => {
                tell(bad("scene", format!("{route} answers {}, expected 200", other.status), remedy));
                return None;
            }
            Err(why) => {
                tell(bad("scene", why, remedy));
                return None;
            }
        };
        let scene = match name {
            Some(_) => serde_json::from_slice::<Scene>(&found.body).map_err(|e| e.to_string()),
            None => {
                serde_json::from_slice::<Catalogue>(&found.body).map_err(|e| e.to_string()).and_then(one_of)
            }
        };
        match scene.and_then(|scene| check_scene(&scene).map(|()| scene)) {
            Ok(scene) => {
                let layers = scene.choices();
                let (name, version) = (&scene.name, &scene.version);
                tell(good("scene", format!("{name} at version {version}, layers {}", layers.join(", "))));
                Self::of(server, scene, tell).await
            }
            Err(why) => {
                let remedy =
                    "name one scene of the list; if it is one, client and server are of different versions";
                tell(bad("scene", format!("{route}: {why}"), remedy));
                None
            }
        }
    }

    /// Reads the first page of the first layer's index, and finds a payload there.
    async fn of(server: &'a Server, mut scene: Scene, tell: &mut Tell<'_>) -> Option<Self> {
        let remedy = "look into the server's log; `diamantina-server inspect --verify` checks the store";
        let streamed = [Encoding::Points, Encoding::Tin]
            .into_iter()
            .find_map(|encoding| Some((encoding, encoding.layer(&scene.layers[0])?)));
        let Some((encoding, layer)) = streamed else {
            let found = format!(
                "layer '{}' is offered as {}",
                scene.layers[0].name,
                scene.layers[0].encodings.join(", ")
            );
            tell(bad("index", found, "this client is older than the server: update it"));
            return None;
        };
        let forest = layer.forest;
        scene.layers[0] = layer;
        let page = encoding.index_route(&scene, 0, 0);
        let found = match server.get(&page).await {
            Ok(found) if found.status == StatusCode::OK => {
                decode_page(&forest, 0, &found.body).map_err(|e| e.to_string())
            }
            Ok(other) => Err(format!("{page} answers {}, expected 200", other.status)),
            Err(why) => Err(why),
        };
        let entries = match found {
            Ok(entries) => entries,
            Err(why) => {
                tell(bad("index", why, remedy));
                return None;
            }
        };
        tell(good("index", format!("the first page tells of {} diamonds", entries.len())));
        let root =
            forest.root_diamonds().find(|root| entries.iter().any(|(d, entry)| d == root && entry.bytes > 0));
        let (name, version, layer) = (&scene.name, &scene.version, &scene.layers[0].name);
        let route = match encoding {
            Encoding::Points => message::points_route,
            Encoding::Tin => message::tin_route,
        };
        let sample = root.map_or_else(|| page.clone(), |root| route(name, version, layer, root.centre()));
        let centres: Vec<Point> = (0..forest.levels())
            .flat_map(|level| forest.diamonds(level))
            .map(|diamond| diamond.centre())
            .take(BATCH_MAX)
            .collect();
        let batch = long(&centres, |some| encoding.batch_route(&scene, 0, some));
        Some(Self { server, scene, encoding, root, sample, page, batch })
    }

    /// All that can be checked with a scene.
    pub(super) async fn examine(&self, http2: Option<&Client>, tell: &mut Tell<'_>) {
        self.version(tell).await;
        self.http2(http2, tell).await;
        if let Some(payload) = self.payload(tell).await {
            self.caching(&payload, tell).await;
            self.vary(&payload, tell);
            self.head(&payload, tell).await;
            self.ranges(&payload, tell).await;
            self.clock(&payload, tell);
        }
        self.compression(tell).await;
        self.description(tell).await;
        self.refusals(tell).await;
        self.long_addresses(tell).await;
        self.origins(tell).await;
    }

    async fn version(&self, tell: &mut Tell<'_>) {
        let ours = env!("CARGO_PKG_VERSION");
        let told =
            self.server.get("/openapi.json").await.ok().filter(|answer| answer.status == StatusCode::OK);
        let document = told.and_then(|answer| serde_json::from_slice::<serde_json::Value>(&answer.body).ok());
        let theirs = document.as_ref().and_then(|document| document["info"]["version"].as_str());
        tell(match theirs {
            Some(theirs) if theirs == ours => good("version", format!("client and server are {ours}")),
            Some(theirs) => warning(
                "version",
                format!("the server is {theirs}, this client {ours}"),
                "scenes of another version may be refused: update the older of the two",
            ),
            None => warning(
                "version",
                "/openapi.json does not tell the server's version",
                "let the proxy pass it, or update the server",
            ),
        });
    }

    async fn http2(&self, http2: Option<&Client>, tell: &mut Tell<'_>) {
        let Some(prior) = http2 else {
            // Encrypted: both sides agree while they greet each other.
            let version = self.server.get("/health").await.map(|answer| answer.version);
            tell(if version == Ok(Version::HTTP_2) {
                good("http/2", "agreed on")
            } else {
                warning(
                    "http/2",
                    format!("not agreed on (ALPN): {}", version.map_or_else(|e| e, |v| format!("{v:?}"))),
                    "switch it on at whatever ends the encryption, as `http2 on` in nginx: browsers then ask over one \
                     connection instead of six",
                )
            });
            return;
        };
        let answer = answer(prior.get(format!("{}/health", self.server.base))).await;
        tell(match answer {
            Ok(answer) if answer.status == StatusCode::OK => good("http/2", "spoken without encryption, too"),
            _ => good("http/2", "not spoken without encryption, which browsers do not do anyway"),
        });
    }

    /// A payload as a client fetches it; decoded.
    async fn payload(&self, tell: &mut Tell<'_>) -> Option<Answer> {
        let remedy = "look into the server's log; `diamantina-server inspect --verify` checks the store";
        let found = match self.server.get(&self.sample).await {
            Ok(found) if found.status == StatusCode::OK => found,
            Ok(other) => {
                tell(bad(
                    "payload",
                    format!("{} answers {}, expected 200", self.sample, other.status),
                    remedy,
                ));
                return None;
            }
            Err(why) => {
                tell(bad("payload", format!("{}: {why}", self.sample), remedy));
                return None;
            }
        };
        let Some(root) = self.root else { return Some(found) };
        match Surface::split(self.encoding, &self.scene.layers[0], root, &[], &found.body) {
            Ok(_) => tell(good("payload", format!("{} bytes, which decode", found.body.len()))),
            Err(why) => tell(bad(
                "payload",
                format!("{}: {why}", self.sample),
                "is there a proxy that changes answers? else `diamantina-server inspect --verify` checks the store",
            )),
        }
        Some(found)
    }

    /// Whether what never changes may be kept, and is known by its tag.
    async fn caching(&self, payload: &Answer, tell: &mut Tell<'_>) {
        let control = payload.header("cache-control");
        let age =
            control.split(',').find_map(|part| part.trim().strip_prefix("max-age=")?.parse::<u64>().ok());
        let is_kept = age.is_some_and(|age| age >= KEPT_MIN)
            && !control.contains("no-store")
            && !control.contains("no-cache");
        tell(if is_kept && control.contains("immutable") {
            good("caching", format!("payloads: {control}"))
        } else {
            warning(
                "caching",
                format!(
                    "payloads come with `cache-control: {control}`, expected max-age=31536000, immutable"
                ),
                "let the proxy pass Cache-Control as it is: each viewer now fetches again what never changes",
            )
        });
        let tag = payload.header("etag");
        if tag.is_empty() || tag.starts_with("w/") {
            let found = if tag.is_empty() {
                "payloads have no ETag".to_owned()
            } else {
                format!("the ETag is weak: {tag}")
            };
            tell(warning(
                "tags",
                found,
                "a proxy that compresses or rewrites answers does this: exempt /scenes/",
            ));
            return;
        }
        let again = self.server.request(Method::GET, &self.sample);
        // Tags are compared as they came, not in small letters.
        let Some(tag) = payload.headers.get("etag") else { return };
        let again = answer(again.header(IF_NONE_MATCH, tag)).await;
        tell(match again {
            Ok(again) if again.status == StatusCode::NOT_MODIFIED && again.body.is_empty() => {
                good("tags", "who has a payload already gets 304 and no bytes")
            }
            Ok(again) => warning(
                "tags",
                format!(
                    "If-None-Match is answered with {} and {} bytes, expected 304",
                    again.status,
                    again.body.len()
                ),
                "let the proxy pass If-None-Match and ETag",
            ),
            Err(why) => {
                bad("tags", why, "the connection broke on a conditional request: look into the proxy's log")
            }
        });
        let shared = ["age", "x-cache", "cf-cache-status", "x-cache-status", "via"];
        let told: Vec<String> = match self.server.get(&self.sample).await {
            Ok(again) => shared
                .iter()
                .filter(|name| again.headers.contains_key(**name))
                .map(|name| format!("{name}: {}", again.header(name)))
                .collect(),
            Err(_) => Vec::new(),
        };
        if !told.is_empty() {
            tell(good("shared cache", told.join("; ")));
        }
    }

    /// What splits shared caches.
    fn vary(&self, payload: &Answer, tell: &mut Tell<'_>) {
        let vary = payload.header("vary");
        let splits: Vec<&str> = vary
            .split(',')
            .map(str::trim)
            .filter(|name| !matches!(*name, "" | "origin" | "accept-encoding" | "authorization"))
            .collect();
        tell(if splits.is_empty() {
            good("vary", "one copy of a payload serves all")
        } else {
            warning(
                "vary",
                format!("payloads come with `vary: {vary}`"),
                "drop that header: shared caches keep a copy for each kind of viewer, or none",
            )
        });
    }

    async fn head(&self, payload: &Answer, tell: &mut Tell<'_>) {
        let length = payload.header("content-length");
        let head = answer(self.server.request(Method::HEAD, &self.sample)).await;
        tell(match head {
            Ok(head)
                if head.status == StatusCode::OK
                    && head.body.is_empty()
                    && head.header("content-length") == payload.body.len().to_string()
                    && length == payload.body.len().to_string() =>
            {
                good("lengths", "told before the bytes, and to HEAD")
            }
            Ok(head) => warning(
                "lengths",
                format!(
                    "content-length is `{length}` for {} bytes, and `{}` for HEAD, which is answered {}",
                    payload.body.len(),
                    head.header("content-length"),
                    head.status
                ),
                "let the proxy pass HEAD and keep Content-Length: without it a broken answer looks complete",
            ),
            Err(why) => bad("lengths", why, "the connection broke on HEAD: look into the proxy's log"),
        });
    }

    /// Nothing here needs ranges, but a cache that answers them has to answer rightly.
    async fn ranges(&self, payload: &Answer, tell: &mut Tell<'_>) {
        let last = payload.body.len().min(8) - usize::from(!payload.body.is_empty());
        let asked = self.server.request(Method::GET, &self.sample).header(RANGE, format!("bytes=0-{last}"));
        tell(match answer(asked).await {
            Ok(whole) if whole.status == StatusCode::OK && whole.body == payload.body => {
                good("ranges", "a part is answered with the whole, as the server does")
            }
            Ok(part)
                if part.status == StatusCode::PARTIAL_CONTENT
                    && payload.body.get(..=last) == Some(part.body.as_slice()) =>
            {
                good("ranges", "answered by a cache, rightly")
            }
            Ok(other) => bad(
                "ranges",
                format!(
                    "a range is answered with {} and {} bytes that are not it",
                    other.status,
                    other.body.len()
                ),
                "switch ranges off at the proxy or cache (nginx: max_ranges 0)",
            ),
            Err(why) => bad("ranges", why, "the connection broke on a range: look into the proxy's log"),
        });
    }

    fn clock(&self, payload: &Answer, tell: &mut Tell<'_>) {
        let date =
            payload.headers.get("date").and_then(|date| httpdate::parse_http_date(date.to_str().ok()?).ok());
        let Some(date) = date else {
            tell(warning(
                "clock",
                "answers have no Date",
                "let the proxy pass it: caches count ages from it",
            ));
            return;
        };
        let now = SystemTime::now();
        let apart = now.duration_since(date).unwrap_or_else(|e| e.duration()).as_secs();
        tell(if apart <= CLOCKS_APART_MAX {
            good("clock", format!("{apart} s apart"))
        } else {
            warning(
                "clock",
                format!("the server's clock is {apart} s off this machine's"),
                "set both by NTP: caches and certificates go by them",
            )
        });
    }

    /// What compresses what is compressed already.
    async fn compression(&self, tell: &mut Tell<'_>) {
        let mut packed = Vec::new();
        for route in [&self.sample, &self.page, &self.batch] {
            let asked =
                self.server.request(Method::GET, route).header(ACCEPT_ENCODING, "gzip, br, zstd, deflate");
            let Ok(found) = answer(asked).await else { continue };
            let encoding = found.header("content-encoding");
            if !matches!(encoding.as_str(), "" | "identity") {
                packed.push(encoding);
            }
        }
        tell(if packed.is_empty() {
            good("compression", "payloads and pages come as they are")
        } else {
            warning(
                "compression",
                format!("a proxy compresses payloads again ({})", packed.join(", ")),
                "exempt application/octet-stream: it costs time, lengths and tags, and saves nothing",
            )
        });
    }

    async fn description(&self, tell: &mut Tell<'_>) {
        let Ok(found) = self.server.get(&message::scene_route(&self.scene.name)).await else {
            tell(bad("description", "does not come again", "look into the server's log"));
            return;
        };
        let control = found.header("cache-control");
        tell(if control.contains("no-cache") || control.contains("max-age=0") {
            good("description", format!("asked for again each time: {control}"))
        } else {
            warning(
                "description",
                format!("comes with `cache-control: {control}`, expected no-cache"),
                "exempt /scenes and /scenes/NAME from caching: viewers would open an old version of a scene",
            )
        });
        if found.headers.get("age").is_some_and(|age| age != "0") {
            tell(warning(
                "description",
                format!("a cache answers with one of {} s ago", found.header("age")),
                "exempt /scenes and /scenes/NAME from caching",
            ));
        }
    }

    /// Refusals have to come through, in words, and must not be kept.
    async fn refusals(&self, tell: &mut Tell<'_>) {
        let (name, layer) = (&self.scene.name, &self.scene.layers[0].name);
        let route = message::points_route(name, "0000000000000000", layer, [0, 0]);
        let remedy =
            "let the proxy pass errors as they are (nginx: proxy_intercept_errors off), and keep none";
        tell(match self.server.get(&route).await {
            Ok(gone) if gone.status == StatusCode::GONE => {
                let kept = gone.header("cache-control");
                let names = String::from_utf8_lossy(&gone.body).contains(&self.scene.version);
                if kept.contains("no-store") && names {
                    good("replaced versions", "410, which names the new one")
                } else {
                    let found = format!("410 with `cache-control: {kept}`, naming the new version: {names}");
                    warning("replaced versions", found, remedy)
                }
            }
            Ok(other) => warning(
                "replaced versions",
                format!("an unknown version is answered with {}, expected 410", other.status),
                remedy,
            ),
            Err(why) => bad("replaced versions", why, remedy),
        });
    }

    /// Batches have addresses of up to 8000 bytes.
    async fn long_addresses(&self, tell: &mut Tell<'_>) {
        let bytes = self.batch.len();
        let remedy = "raise the limit on addresses to 16 KiB (nginx: large_client_header_buffers 4 17k, and \
             proxy_buffer_size 32k where it keeps answers)";
        tell(match self.server.get(&self.batch).await {
            Ok(found) if found.status == StatusCode::OK && !found.body.is_empty() => {
                good("long addresses", format!("one of {bytes} bytes gets through"))
            }
            Ok(other) => bad(
                "long addresses",
                format!("one of {bytes} bytes is answered with {}", other.status),
                remedy,
            ),
            Err(why) => bad("long addresses", format!("one of {bytes} bytes: {why}"), remedy),
        });
        debug_assert!(bytes <= TARGET_BYTES_MAX);
    }

    /// What pages of other sites may do.
    async fn origins(&self, tell: &mut Tell<'_>) {
        let remedy = "let the proxy pass Access-Control-* headers and OPTIONS as they are: pages of other sites cannot show \
                      this scene";
        let asked = self.server.request(Method::GET, &self.sample).header(ORIGIN, ELSEWHERE);
        let found = match answer(asked).await {
            Ok(found) => found,
            Err(why) => return tell(bad("other sites", why, remedy)),
        };
        let [allowed, exposed] =
            ["access-control-allow-origin", "access-control-expose-headers"].map(|name| found.header(name));
        let hidden: Vec<&str> =
            READ.into_iter().filter(|name| exposed != "*" && !exposed.contains(name)).collect();
        if allowed != "*" && allowed != ELSEWHERE {
            return tell(warning("other sites", format!("`access-control-allow-origin: {allowed}`"), remedy));
        }
        if !hidden.is_empty() {
            let found = format!("pages of other sites cannot read {}", hidden.join(", "));
            return tell(warning("other sites", found, remedy));
        }
        let asked = self
            .server
            .request(Method::OPTIONS, &self.sample)
            .header(ORIGIN, ELSEWHERE)
            .header(ACCESS_CONTROL_REQUEST_METHOD, "GET")
            .header(ACCESS_CONTROL_REQUEST_HEADERS, "authorization");
        tell(match answer(asked).await {
            Ok(found)
                if found.status.is_success()
                    && found.header("access-control-allow-headers").contains("authorization") =>
            {
                good("other sites", "may show this scene, with a token, too")
            }
            Ok(found) => {
                let found = format!(
                    "may show this scene, but not with a token: OPTIONS is answered {}",
                    found.status
                );
                warning("other sites", found, remedy)
            }
            Err(why) => warning("other sites", why, remedy),
        });
    }
}

/// The only scene of a server, or the first one.
fn one_of(catalogue: Catalogue) -> Result<Scene, String> {
    catalogue.scenes.into_iter().next().ok_or_else(|| "the server has no scene that is public".to_owned())
}

/// The longest batch of some diamonds that fits into an address.
fn long(centres: &[Point], route: impl Fn(&[Point]) -> String) -> String {
    let fits = |count: &usize| route(&centres[..*count]).len() <= TARGET_BYTES_MAX;
    let most = (1..=centres.len()).rev().find(fits).unwrap_or(1);
    route(&centres[..most])
}

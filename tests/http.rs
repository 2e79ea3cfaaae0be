//! What the server answers to whom: routes, caches, refusals, heights.

use crate::world::{Dice, World, build, options, serve, write_raw};
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::message::{
    self, BATCH_MAX, FrameHeader, HeightAnswer, Layer, Problem, Status, StreamAsk,
};
use diamantina_server::projection::{self, Projection};
use diamantina_server::store::Store;
use diamantina_server::{ingest, inspect};
use reqwest::header::{
    ACCESS_CONTROL_ALLOW_ORIGIN, CACHE_CONTROL, CONTENT_LENGTH, CONTENT_TYPE, ETAG, HeaderMap, HeaderName,
    IF_MATCH, IF_NONE_MATCH,
};
use reqwest::{Method, StatusCode};
use std::sync::Arc;

const IMMUTABLE: &str = "public, max-age=31536000, immutable";

/// An answer with all its bytes.
pub(crate) struct Answer {
    pub(crate) status: StatusCode,
    headers: HeaderMap,
    pub(crate) body: Vec<u8>,
}

impl Answer {
    pub(crate) fn header(&self, name: &HeaderName) -> &str {
        self.headers.get(name).map_or("", |v| v.to_str().unwrap())
    }

    pub(crate) fn json(&self) -> serde_json::Value {
        serde_json::from_slice(&self.body).unwrap()
    }
}

async fn ask(method: Method, url: &str, headers: &[(HeaderName, &str)]) -> Answer {
    let client = crate::world::asker().build().unwrap();
    let mut request = client.request(method, url);
    for (name, value) in headers {
        request = request.header(name, *value);
    }
    let response = request.send().await.unwrap();
    let (status, headers) = (response.status(), response.headers().clone());
    Answer { status, headers, body: response.bytes().await.unwrap().to_vec() }
}

pub(crate) async fn get(url: &str) -> Answer {
    ask(Method::GET, url, &[]).await
}

pub(crate) fn block<T>(future: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap().block_on(future)
}

/// A refusal is a problem+json with the status, words, and nothing that a cache may keep.
fn assert_refused(answer: &Answer, status: u16, word: &str) {
    let text = String::from_utf8_lossy(&answer.body);
    assert_eq!(answer.status.as_u16(), status, "{text}");
    assert_eq!(answer.header(&CONTENT_TYPE), "application/problem+json");
    assert_eq!(answer.header(&CACHE_CONTROL), "no-store");
    assert_eq!(answer.header(&ACCESS_CONTROL_ALLOW_ORIGIN), "*");
    let problem: Problem = serde_json::from_slice(&answer.body).unwrap();
    assert_eq!(problem.status, status);
    assert!(!problem.title.is_empty() && problem.detail.contains(word), "{problem:?} lacks '{word}'");
}

struct Site {
    world: World,
    layer: Layer,
    version: String,
    /// Diamonds with a payload, coarse first.
    diamonds: Vec<(Diamond, Entry)>,
}

fn site() -> Site {
    let world = World::sample(513, 0.0);
    let store = Store::open(&world.folder.path().join("store")).unwrap();
    let layer = store.scene().layers[0].clone();
    let entries = inspect::entries(&store, 0, &layer).unwrap();
    let mut diamonds: Vec<_> = entries.into_iter().filter(|(_, e)| e.bytes > 0).collect();
    diamonds.sort_by_key(|(d, _)| (d.level(), d.centre()));
    Site { version: world.report.scene.version.clone(), layer, diamonds, world }
}

impl Site {
    fn url(&self, route: &str) -> String {
        format!("{}{route}", self.world.served.address)
    }

    fn points(&self, d: Diamond) -> String {
        self.url(&message::points_route("world", &self.version, "terrain", d.centre()))
    }
}

#[test]
fn immutable_things_say_so_and_answer_304_to_who_has_them() {
    let site = site();
    block(async {
        let page = site.url(&message::index_route("world", &site.version, "terrain", 0));
        for url in [page, site.points(site.diamonds[0].0)] {
            let answer = get(&url).await;
            assert_eq!(answer.status, 200, "{url}");
            assert_eq!(answer.header(&CACHE_CONTROL), IMMUTABLE);
            assert_eq!(answer.header(&CONTENT_TYPE), "application/octet-stream");
            assert_eq!(answer.header(&ACCESS_CONTROL_ALLOW_ORIGIN), "*");
            assert_eq!(answer.header(&CONTENT_LENGTH), answer.body.len().to_string());
            let tag = answer.header(&ETAG).to_owned();
            assert!(tag.starts_with('"') && tag.ends_with('"') && tag.len() > 10, "a strong tag: {tag}");
            for known in [tag.clone(), format!("W/{tag}"), format!("\"other\", {tag}"), "*".to_owned()] {
                let again = ask(Method::GET, &url, &[(IF_NONE_MATCH, &known)]).await;
                assert_eq!((again.status.as_u16(), again.body.len()), (304, 0), "{known}");
                assert_eq!(again.header(&ETAG), tag);
                assert_eq!(again.header(&CACHE_CONTROL), IMMUTABLE);
            }
            let stale = ask(Method::GET, &url, &[(IF_NONE_MATCH, "\"other\"")]).await;
            assert_eq!((stale.status.as_u16(), &stale.body), (200, &answer.body));
            let head = ask(Method::HEAD, &url, &[]).await;
            assert_eq!((head.status.as_u16(), head.body.len()), (200, 0));
            assert_eq!(head.header(&ETAG), tag);
            assert_eq!(head.header(&CONTENT_LENGTH), answer.body.len().to_string());
        }
    });
}

/// What is asked for most has a shorter way through the server; an address that is written in another way has not.
#[test]
fn both_ways_to_a_diamond_give_the_same_answer() {
    let site = site();
    let told = |answer: &Answer| {
        let mut headers = answer.headers.clone();
        for name in ["date", "server-timing", "x-request-id"] {
            assert!(headers.remove(name).is_some(), "{name}");
        }
        (answer.status, headers, answer.body.clone())
    };
    block(async {
        let d = site.diamonds[3].0;
        let url = site.points(d);
        // From the disk; what follows is kept.
        let first = get(&url).await;
        let tag = first.header(&ETAG).to_owned();
        let [beside, behind, gone] = [
            url.replace(&d.centre()[0].to_string(), "9999999"),
            format!("{url}/"),
            url.replace(&site.version, "0123456789abcdef"),
        ];
        let conditions = [
            vec![],
            vec![(IF_NONE_MATCH, &*tag)],
            vec![(IF_NONE_MATCH, "\"a\", *")],
            vec![(IF_MATCH, "\"a\"")],
        ];
        for url in [&url, &beside, &behind, &gone] {
            let long = url.replace("/scenes/world/", "/scenes/%77orld/");
            assert_ne!(*url, long);
            for headers in &conditions {
                let [short, long] =
                    [ask(Method::GET, url, headers).await, ask(Method::GET, &long, headers).await];
                assert_eq!(told(&short), told(&long), "{url} {headers:?}");
            }
        }
        assert_eq!(told(&get(&url).await), told(&first));
        for (url, status) in [&beside, &behind, &gone].into_iter().zip([404, 404, 410]) {
            assert_eq!(get(url).await.status.as_u16(), status, "{url}");
        }
        let metrics = String::from_utf8(get(&site.url("/metrics")).await.body).unwrap();
        let line = "diamantina_requests_total{route=\"/scenes/{scene}/{version}/{layer}/points/{x}/{y}\",status=\"200\"}";
        let count = metrics.lines().find_map(|l| l.strip_prefix(line)).unwrap();
        // The first, one each way, and the last.
        assert_eq!(count.trim(), "4", "{metrics}");
    });
}

#[test]
fn metadata_is_revalidated() {
    let site = site();
    block(async {
        for route in ["/scenes", "/scenes/world"] {
            let answer = get(&site.url(route)).await;
            assert_eq!(answer.status, 200);
            assert_eq!(answer.header(&CACHE_CONTROL), "no-cache");
            assert_eq!(answer.header(&CONTENT_TYPE), "application/json");
            let tag = answer.header(&ETAG).to_owned();
            let again = ask(Method::GET, &site.url(route), &[(IF_NONE_MATCH, &tag)]).await;
            assert_eq!((again.status.as_u16(), again.body.len()), (304, 0), "{route}");
        }
        let scene = get(&site.url("/scenes/world")).await.json();
        assert_eq!(scene["version"], site.version.as_str());
        assert_eq!(get(&site.url("/scenes")).await.json()["scenes"][0], scene);
        for route in ["/health", "/ready", "/"] {
            assert_eq!(get(&site.url(route)).await.status, 200, "{route}");
            assert_eq!(ask(Method::HEAD, &site.url(route), &[]).await.status, 200, "{route}");
        }
    });
}

#[test]
fn what_is_not_there_is_refused_in_words() {
    let site = site();
    let v = &site.version;
    let deep = site.layer.forest.size()[0];
    let [root_x, root_y] = site.layer.forest.diamonds(0).next().unwrap().centre();
    let pages = index::pages(&site.layer.forest);
    block(async {
        assert_eq!(
            get(&site.url(&format!("/scenes/world/{v}/terrain/points/{root_x}/{root_y}"))).await.status,
            200
        );
        for (route, status, word) in [
            ("/nothing".to_owned(), 404, "/scenes"),
            ("/scenes/mars".to_owned(), 404, "/scenes"),
            // Bytes that are no text.
            ("/%ff".to_owned(), 404, "/scenes"),
            ("/scenes/%ff".to_owned(), 404, "/scenes"),
            ("/web/%ff/page.js".to_owned(), 404, "/scenes"),
            ("/scenes/world/%ff/height?x=1&y=1".to_owned(), 404, "/scenes"),
            (format!("/scenes/world/{v}/terrain/points/%ff/1"), 404, "/scenes"),
            (format!("/scenes/world/{v}/terrain/points?d=%ff"), 400, "centre"),
            (format!("/scenes/world/{v}/terrain/stream?%ff=1"), 400, "no parameter"),
            (format!("/scenes/world/{v}/water/index/0"), 404, "layer"),
            (format!("/scenes/world/{v}/terrain/index/{pages}"), 404, "pages 0 to"),
            (format!("/scenes/world/{v}/terrain/index/-1"), 404, "page"),
            // The same blob at another address would be kept twice by caches.
            (format!("/scenes/world/{v}/terrain/index/00"), 404, "page"),
            (format!("/scenes/world/{v}/terrain/index/+0"), 404, "page"),
            (format!("/scenes/world/{v}/terrain/points/0{root_x}/{root_y}"), 404, "diamond"),
            (format!("/scenes/world/{v}/terrain/points/{root_x}/+{root_y}"), 404, "diamond"),
            (format!("/scenes/world/{v}/terrain/index/99999999999999999999"), 404, "page"),
            (format!("/scenes/world/{v}/terrain/points/1/1"), 404, "diamond"),
            (format!("/scenes/world/{v}/terrain/points/{deep}/{deep}"), 404, "diamond"),
            (format!("/scenes/world/{v}/terrain/points/4294967295/4294967295"), 404, "diamond"),
            (format!("/scenes/world/{v}/terrain/points/a/b"), 404, "diamond"),
            (format!("/scenes/world/{v}/terrain/points"), 400, "d="),
            (format!("/scenes/world/{v}/terrain/points?d="), 400, "centre"),
            (format!("/scenes/world/{v}/terrain/points?d=1"), 400, "centre"),
            (format!("/scenes/world/{v}/terrain/points?d=1,2;x,y"), 400, "centre"),
            (format!("/scenes/world/{v}/terrain/points?d=-1,2"), 400, "centre"),
            (format!("/scenes/world/{v}/terrain/points?d={}", ["1,2"; BATCH_MAX + 1].join(";")), 413, "384"),
            ("/scenes/world/0123456789abcdef/terrain/index/0".to_owned(), 410, v),
            ("/scenes/world/0123456789abcdef/terrain/points/1/1".to_owned(), 410, v),
            ("/scenes/world/0123456789abcdef/terrain/points?d=1,1".to_owned(), 410, v),
            (format!("/scenes/world/{v}/water/stream"), 404, "layer"),
            (format!("/scenes/world/{v}/terrain/stream?bbox=1,2,3"), 400, "x0,y0,x1,y1"),
            (format!("/scenes/world/{v}/terrain/stream?bbox=3,0,1,9"), 400, "x0 <= x1"),
            (format!("/scenes/world/{v}/terrain/stream?bbox=0,9,1,3"), 400, "y0 <= y1"),
            (format!("/scenes/world/{v}/terrain/stream?bbox=0,NaN,1,3"), 400, "bbox=0,NaN,1,3"),
            (format!("/scenes/world/{v}/terrain/stream?error=nan"), 400, "error=nan"),
            (format!("/scenes/world/{v}/terrain/stream?error=-0.5"), 400, "0 or more"),
            (format!("/scenes/world/{v}/terrain/stream?error=inf"), 400, "0 or more"),
            (format!("/scenes/world/{v}/terrain/stream?error=1&error=2"), 400, "at most once"),
            (format!("/scenes/world/{v}/terrain/stream?limit=0"), 400, "1 or more"),
            (format!("/scenes/world/{v}/terrain/stream?eye=0,0,9"), 400, "angle="),
            (format!("/scenes/world/{v}/terrain/stream?eye=0,0,9&angle=0"), 400, "above 0"),
            (format!("/scenes/world/{v}/terrain/stream?eye=0,0,9&angle=1&sides=1,2"), 400, "x,y,z"),
            (format!("/scenes/world/{v}/terrain/stream?tolerance=3"), 400, "no parameter"),
            ("/scenes/world/0123456789abcdef/terrain/stream?error=1".to_owned(), 410, v),
            ("/scenes/world/terrain/height".to_owned(), 400, "lon"),
            ("/scenes/world/terrain/height?x=1".to_owned(), 400, "x"),
            ("/scenes/world/terrain/height?x=1&y=two".to_owned(), 400, "y"),
            ("/scenes/world/terrain/height?x=nan&y=1".to_owned(), 400, "x"),
            ("/scenes/world/terrain/height?x=1&y=1&lon=2&lat=2".to_owned(), 400, "lon"),
            ("/scenes/world/terrain/height?x=-1e300&y=1".to_owned(), 404, "outside"),
            ("/scenes/world/terrain/height?lon=0&lat=0".to_owned(), 404, ""),
            ("/scenes/world/terrain/height?lon=0&lat=95".to_owned(), 404, ""),
            ("/scenes/world/water/height?x=1&y=1".to_owned(), 404, "layer"),
        ] {
            println!("{route}");
            assert_refused(&get(&site.url(&route)).await, status, word);
        }
        for method in [Method::POST, Method::PUT, Method::DELETE] {
            assert_refused(&ask(method, &site.url("/scenes"), &[]).await, 405, "GET");
        }
    });
}

#[test]
fn a_batch_comes_coarse_first_with_the_payloads_of_single_requests() {
    let site = site();
    let mut dice = Dice(3);
    // Fine first, in disorder, with one that is not there.
    let mut centres: Vec<_> =
        site.diamonds.iter().rev().map(|(d, _)| d.centre()).take(BATCH_MAX - 10).collect();
    centres.extend(site.diamonds.iter().take(9).map(|(d, _)| d.centre()));
    for i in (1..centres.len()).rev() {
        centres.swap(i, dice.below(i as u64 + 1) as usize);
    }
    centres.insert(5, [1, 1]);
    block(async {
        let answer = get(&site.url(&message::batch_route("world", &site.version, "terrain", &centres))).await;
        assert_eq!((answer.status.as_u16(), answer.header(&CACHE_CONTROL)), (200, IMMUTABLE));
        let mut rest = answer.body.as_slice();
        let (mut seen, mut last, mut missing) = (0, 0, 0);
        while let Some((header, used)) = FrameHeader::read(rest).unwrap() {
            let (payload, more) = rest[used..].split_at(header.length as usize);
            rest = more;
            seen += 1;
            if header.status == Status::Missing {
                assert_eq!((header.centre, header.length), ([1, 1], 0));
                missing += 1;
                continue;
            }
            assert_eq!(header.status, Status::Ok);
            assert_eq!(header.checksum, message::checksum(payload));
            let d = site.layer.forest.diamond(header.centre).unwrap();
            assert!(d.level() >= last, "level {} after level {last}", d.level());
            last = d.level();
            if seen % 16 == 0 {
                assert_eq!(get(&site.points(d)).await.body, payload);
            }
        }
        assert!(rest.is_empty());
        assert_eq!((seen, missing), (centres.len(), 1));
    });
}

#[test]
fn a_stream_is_immutable_however_it_is_asked_for_and_holds_what_single_requests_do() {
    let site = site();
    block(async {
        let route = |query: &str| site.url(&format!("/scenes/world/{}/terrain/stream?{query}", site.version));
        let [x, y] = site.layer.origin;
        let bbox = [x, y, x + 9000.0, y + 4000.0];
        let ask = StreamAsk { error: 0.5, bbox: Some(bbox), ..StreamAsk::default() };
        let answer = get(&site.url(&message::stream_route("world", &site.version, "terrain", &ask))).await;
        assert_eq!((answer.status.as_u16(), answer.header(&CACHE_CONTROL)), (200, IMMUTABLE));
        assert_eq!(answer.header(&CONTENT_TYPE), "application/octet-stream");
        let tag = answer.header(&ETAG).to_owned();
        // Another order of parameters, percent signs and more digits ask for the same.
        let [x0, y0, x1, y1] = bbox;
        let same = [
            format!("bbox={x0:e},{y0},{x1:.3},{y1}&error=5e-1"),
            format!("error=0.50&bbox={x0}%2C{y0}%2C{x1}%2C{y1}"),
        ];
        for same in &same {
            let again = get(&route(same)).await;
            assert_eq!((again.header(&ETAG), &again.body), (tag.as_str(), &answer.body), "{same}");
            let known = self::ask(Method::GET, &route(same), &[(IF_NONE_MATCH, &tag)]).await;
            assert_eq!((known.status.as_u16(), known.body.len()), (304, 0), "{same}");
        }
        assert_ne!(get(&route("error=6")).await.header(&ETAG), tag);
        let head = self::ask(Method::HEAD, &route("error=5"), &[]).await;
        assert_eq!((head.status.as_u16(), head.body.len()), (200, 0));
        let (mut rest, mut seen, mut pages) = (answer.body.as_slice(), 0, 0);
        while let Some((header, used)) = FrameHeader::read(rest).unwrap() {
            let (blob, more) = rest[used..].split_at(header.length as usize);
            rest = more;
            assert_eq!(header.checksum, message::checksum(blob));
            if header.status == Status::Page {
                pages += 1;
                let page = message::index_route("world", &site.version, "terrain", header.centre[0]);
                assert_eq!(get(&site.url(&page)).await.body, blob);
                continue;
            }
            assert_eq!(header.status, Status::Ok);
            let d = site.layer.forest.diamond(header.centre).unwrap();
            seen += 1;
            if seen % 8 == 0 && !blob.is_empty() {
                assert_eq!(get(&site.points(d)).await.body, blob);
            }
        }
        println!("{} bytes: {seen} of {} diamonds, {pages} pages", answer.body.len(), site.diamonds.len());
        assert!(rest.is_empty() && pages > 0 && seen > 10 && seen < site.diamonds.len());
        let limited = get(&route(&format!("limit=20000&{}", same[0]))).await;
        assert!(limited.body.len() >= 20_000 && answer.body.starts_with(&limited.body));
        assert!(limited.body.len() < answer.body.len());
    });
}

#[test]
fn many_readers_at_once_get_what_one_gets() {
    let site = Arc::new(site());
    block(async {
        let some: Vec<_> = site.diamonds.iter().step_by(site.diamonds.len() / 24).map(|(d, _)| *d).collect();
        let mut alone = Vec::new();
        for d in &some {
            alone.push(get(&site.points(*d)).await.body);
        }
        let (some, alone) = (Arc::new(some), Arc::new(alone));
        let readers: Vec<_> = (0..32u64)
            .map(|reader| {
                let (site, some, alone) = (Arc::clone(&site), Arc::clone(&some), Arc::clone(&alone));
                tokio::spawn(async move {
                    let mut dice = Dice(reader);
                    for _ in 0..12 {
                        let i = dice.below(some.len() as u64) as usize;
                        assert_eq!(get(&site.points(some[i])).await.body, alone[i]);
                    }
                })
            })
            .collect();
        for reader in readers {
            reader.await.unwrap();
        }
    });
}

#[test]
fn a_lossless_height_is_the_sources_own_sample() {
    let folder = tempfile::tempdir().unwrap();
    let (dem, store) = (folder.path().join("dem.raw"), folder.path().join("world"));
    let ingest = write_raw(&dem, [700, 300], crate::seams::islands);
    let report = build(&dem, &store, &ingest, &options());
    let layer = &report.scene.layers[0];
    let served = serve(&[store]);
    let mut dice = Dice(8);
    block(async {
        let (mut heights, mut holes) = (0, 0);
        for _ in 0..200 {
            let [x, y] = [dice.below(700) as u32, dice.below(300) as u32];
            let [fx, fy] = layer.position([x, y]);
            let answer = get(&format!("{}/terrain/height?x={fx}&y={fy}", served.scene("world"))).await;
            assert_eq!(answer.status, 200);
            let answer: HeightAnswer = serde_json::from_slice(&answer.body).unwrap();
            let truth = crate::seams::islands(x, y).map(f64::from);
            assert_eq!((answer.height, answer.nodata), (truth, truth.is_none()), "at {x}, {y}");
            assert_eq!((answer.error, answer.lon), (0.0, None));
            heights += usize::from(truth.is_some());
            holes += usize::from(truth.is_none());
        }
        assert!(heights > 50 && holes > 20);
        let outside = format!("{}/terrain/height?x={}&y=0", served.scene("world"), 30 * 700);
        assert_refused(&get(&outside).await, 404, "outside");
    });
}

#[test]
fn longitude_and_latitude_lead_to_the_same_height() {
    let site = site();
    let source =
        ingest::open(&[site.world.folder.path().join("dem.tif")], &ingest::Options::default()).unwrap();
    let mut samples = Vec::new();
    source.read(0, 0, 513, 513, &mut samples).unwrap();
    // What the sample says of itself, without the store: UTM 23 south, 30 m cells from a known corner.
    let utm = Projection::new(projection::epsg(32723).unwrap()).unwrap();
    let corner = [620_000.0, 7_990_000.0 - 30.0 * 512.0];
    let mut dice = Dice(9);
    block(async {
        let mut compared = 0;
        for _ in 0..60 {
            let [i, j] = [1 + dice.below(510), 1 + dice.below(510)];
            let (x, y) = (corner[0] + 30.0 * i as f64, corner[1] + 30.0 * j as f64);
            let (lon, lat) = utm.inverse(x, y).unwrap();
            let answer =
                get(&format!("{}/terrain/height?lon={lon}&lat={lat}", site.url("/scenes/world"))).await;
            assert_eq!(answer.status, 200, "{}", String::from_utf8_lossy(&answer.body));
            let answer: HeightAnswer = serde_json::from_slice(&answer.body).unwrap();
            let sample = |i: u64, j: u64| samples[(j * 513 + i) as usize];
            let around =
                [(i, j), (i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1), (i + 1, j + 1), (i - 1, j - 1)];
            let around = [around.as_slice(), &[(i + 1, j - 1), (i - 1, j + 1)]].concat();
            if around.iter().any(|(i, j)| sample(*i, *j).is_nan()) {
                continue;
            }
            compared += 1;
            // A micrometre beside the sample the surface is another by less than a millimetre.
            let found = answer.height.unwrap();
            let truth = sample(i, j);
            assert!((found - truth).abs() <= answer.error + 1e-3, "{found} for {truth} at {i}, {j}");
            assert!((answer.lon.unwrap() - lon).abs() < 1e-9 && (answer.lat.unwrap() - lat).abs() < 1e-9);
        }
        assert!(compared > 20);
    });
}

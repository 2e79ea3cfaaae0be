//! What an operator relies on: headers, counters, logs, encryption, tokens, rates, settings.

use crate::hostile::{Ended, end, start};
use crate::limits::{answer, connect};
use crate::world::{
    Served, World, asker, build, options, programs, serve, serve_with, serve_within, write_raw,
};
use diamantina_protocol::message;
use diamantina_server::hierarchy;
use diamantina_server::http::{self, Limits, Options};
use diamantina_server::inspect;
use diamantina_server::store::Store;
use reqwest::header::{AUTHORIZATION, CACHE_CONTROL, ETAG, HeaderMap, HeaderName, IF_MATCH, VARY};
use reqwest::{Method, StatusCode};
use std::ffi::OsString;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::{ClientConfig, RootCertStore, crypto::ring};

const PATIENCE: Duration = Duration::from_secs(20);

fn block<T>(future: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap().block_on(future)
}

struct Answer {
    status: StatusCode,
    headers: HeaderMap,
    body: Vec<u8>,
    /// Whether the whole body came.
    is_whole: bool,
}

impl Answer {
    fn header(&self, name: &str) -> &str {
        self.headers.get(name).map_or("", |value| value.to_str().unwrap())
    }

    fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }
}

fn ask(method: Method, url: &str, headers: &[(HeaderName, &str)]) -> Answer {
    block(async {
        let client = asker().build().unwrap();
        let mut request = client.request(method, url);
        for (name, value) in headers {
            request = request.header(name, *value);
        }
        let mut response = request.send().await.unwrap();
        let (status, headers) = (response.status(), response.headers().clone());
        let mut body = Vec::new();
        let is_whole = loop {
            match response.chunk().await {
                Ok(Some(chunk)) => body.extend_from_slice(&chunk),
                Ok(None) => break true,
                Err(_) => break false,
            }
        };
        Answer { status, headers, body, is_whole }
    })
}

fn get(url: &str) -> Answer {
    ask(Method::GET, url, &[])
}

fn store(world: &World) -> PathBuf {
    world.folder.path().join("store")
}

/// The routes of some diamonds with a payload, coarse first, and one that asks for them all.
fn diamonds(world: &World, count: usize) -> (Vec<String>, String) {
    diamonds_of(&store(world), count)
}

fn diamonds_of(store: &Path, count: usize) -> (Vec<String>, String) {
    let store = Store::open(store).unwrap();
    let layer = &store.scene().layers[0];
    let entries = inspect::entries(&store, 0, layer).unwrap();
    let mut found: Vec<_> = entries.into_iter().filter(|(_, entry)| entry.bytes > 0).collect();
    found.sort_by_key(|(d, _)| (d.level(), d.centre()));
    let centres: Vec<_> = found.iter().take(count).map(|(d, _)| d.centre()).collect();
    let version = &store.scene().version;
    let routes = centres.iter().map(|c| message::points_route("world", version, &layer.name, *c)).collect();
    (routes, message::batch_route("world", version, &layer.name, &centres))
}

/// A counter, or a line of another metric, as `/metrics` shows it.
pub(crate) fn metric(served: &Served, line: &str) -> f64 {
    let text = get(&format!("{}/metrics", served.address)).text();
    let found = text.lines().find_map(|l| l.strip_prefix(line)?.strip_prefix(' ')?.parse().ok());
    found.unwrap_or(0.0)
}

#[test]
fn every_answer_has_a_name_and_its_time_and_pages_may_read_them() {
    let world = World::sample(129, 0.0);
    let id = HeaderName::from_static("x-request-id");
    let (routes, batch) = diamonds(&world, 3);
    for route in ["/health", "/scenes", "/nothing", "/metrics", &routes[0], &batch] {
        let url = format!("{}{route}", world.served.address);
        for method in [Method::GET, Method::HEAD] {
            let answer = ask(method.clone(), &url, &[(id.clone(), "my-1.name")]);
            assert_eq!(answer.header("x-request-id"), "my-1.name", "{method} {route}");
            let timing = answer.header("server-timing").strip_prefix("app;dur=").unwrap();
            assert!(timing.parse::<f64>().unwrap() < 10_000.0);
            assert_eq!(answer.header("timing-allow-origin"), "*");
            let exposed = answer.header("access-control-expose-headers");
            assert!(
                ["etag", "server-timing", "x-request-id", "retry-after"].iter().all(|h| exposed.contains(h))
            );
            assert!(!answer.headers.contains_key(VARY), "{method} {route}");
            assert_eq!(answer.body.is_empty(), method == Method::HEAD);
        }
        let (one, other) = (get(&url), ask(Method::GET, &url, &[(id.clone(), "not fit")]));
        assert_eq!((one.header("x-request-id").len(), other.header("x-request-id").len()), (16, 16));
        assert_ne!(one.header("x-request-id"), other.header("x-request-id"));
    }
    let preflight = ask(Method::OPTIONS, &format!("{}{}", world.served.address, routes[0]), &[]);
    assert_eq!(preflight.status, 204);
    assert!(preflight.header("access-control-allow-headers").contains("authorization"));
    assert_eq!(preflight.header("access-control-allow-methods"), "GET, HEAD");
    assert_eq!(preflight.header("access-control-allow-origin"), "*");
}

#[test]
fn conditions_are_kept() {
    let world = World::sample(129, 0.0);
    let (routes, batch) = diamonds(&world, 3);
    for route in ["/scenes", "/scenes/world", &routes[0], &batch] {
        let url = format!("{}{route}", world.served.address);
        let answer = get(&url);
        let tag = answer.headers[ETAG].to_str().unwrap().to_owned();
        for (condition, status) in [
            (tag.clone(), 200),
            ("*".to_owned(), 200),
            (format!("\"other\", {tag}"), 200),
            ("\"other\"".to_owned(), 412),
            (format!("W/{tag}"), 412),
        ] {
            let found = ask(Method::GET, &url, &[(IF_MATCH, &condition)]);
            assert_eq!(found.status.as_u16(), status, "{route} {condition}");
            assert!(status == 412 || found.body == answer.body);
        }
        let known = ask(Method::GET, &url, &[(reqwest::header::IF_NONE_MATCH, &tag)]);
        assert_eq!((known.status.as_u16(), known.body.len()), (304, 0), "{route}");
    }
}

#[test]
fn what_is_asked_for_again_is_not_read_again_and_all_of_it_is_counted() {
    let world = World::sample(513, 0.0);
    let (routes, batch) = diamonds(&world, 20);
    let urls: Vec<String> = routes.iter().map(|route| format!("{}{route}", world.served.address)).collect();
    let first: Vec<Vec<u8>> = urls.iter().map(|url| get(url).body).collect();
    let bytes: usize = first.iter().map(Vec::len).sum();
    let served = &world.served;
    assert_eq!(metric(served, "diamantina_store_reads_total"), 20.0);
    assert_eq!(metric(served, "diamantina_store_read_bytes_total"), bytes as f64);
    let again: Vec<Vec<u8>> = urls.iter().map(|url| get(url).body).collect();
    assert!(again == first);
    assert!(get(&format!("{}{batch}", served.address)).body.len() > bytes);
    assert_eq!(metric(served, "diamantina_store_reads_total"), 20.0, "all of it is in memory");
    assert_eq!(metric(served, "diamantina_cache_hits_total"), 40.0);
    assert_eq!(metric(served, "diamantina_cache_blobs"), 20.0);
    assert!(metric(served, "diamantina_cache_bytes") >= bytes as f64);
    let route = "route=\"/scenes/{scene}/{version}/{layer}/points/{x}/{y}\"";
    assert_eq!(metric(served, &format!("diamantina_requests_total{{{route},status=\"200\"}}")), 40.0);
    assert_eq!(metric(served, &format!("diamantina_sent_bytes_total{{{route}}}")), 2.0 * bytes as f64);
    assert_eq!(metric(served, &format!("diamantina_head_seconds_count{{{route}}}")), 40.0);
    assert_eq!(metric(served, &format!("diamantina_answer_seconds_count{{{route}}}")), 40.0);
    assert_eq!(metric(served, "diamantina_in_flight"), 1.0, "this very request");
    assert!(metric(served, "diamantina_connections") >= 1.0);
    assert_eq!(metric(served, "diamantina_scenes"), 1.0);
    assert!(metric(served, "diamantina_process_open_files") > 3.0);
    get(&format!("{}/nothing", served.address));
    assert_eq!(metric(served, "diamantina_requests_total{route=\"none\",status=\"404\"}"), 1.0);
    let text = get(&format!("{}/metrics", served.address)).text();
    assert!(text.contains(&format!("diamantina_build_info{{version=\"{}\"}} 1", env!("CARGO_PKG_VERSION"))));
    assert!(!text.contains("world"), "no label names a scene");

    let none = serve_within(&[store(&world)], Limits { cache: 0, ..Limits::default() });
    for _ in 0..2 {
        assert!(get(&format!("{}{}", none.address, routes[0])).body == first[0]);
    }
    assert_eq!(metric(&none, "diamantina_store_reads_total"), 2.0, "nothing is kept without a budget");
}

/// Blobs too large to be copied into the kernel each time, of noise.
#[test]
#[cfg(target_os = "linux")]
fn large_blobs_that_are_asked_for_again_are_sent_by_the_kernel_and_are_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let (dem, at) = (folder.path().join("dem.raw"), folder.path().join("store"));
    let noise = |x: u32, y: u32| x.wrapping_mul(0x9e37_79b1).wrapping_add(y.wrapping_mul(0x85eb_ca6b));
    let ingest = write_raw(&dem, [257, 257], |x, y| {
        let mixed = noise(x, y) ^ (noise(x, y) >> 15);
        Some((mixed.wrapping_mul(0x2c1b_3c6d) >> 9) as f32)
    });
    build(&dem, &at, &ingest, &hierarchy::Options { patch_log2: 7, max_error: 0.0, ..options() });
    let (routes, _) = diamonds_of(&at, usize::MAX);
    let served = serve(&[at]);
    let urls: Vec<String> = routes.iter().map(|route| format!("{}{route}", served.address)).collect();
    let first: Vec<Vec<u8>> = urls.iter().map(|url| get(url).body).collect();
    let large: usize = first.iter().map(Vec::len).filter(|length| *length >= 16 << 10).sum();
    assert!(large > 0, "{:?}", first.iter().map(Vec::len).collect::<Vec<_>>());
    let taken = || metric(&served, "diamantina_sent_uncopied_bytes_total");
    assert_eq!(taken(), 0.0, "nothing was asked for again");
    for round in 1..3 {
        for (url, first) in urls.iter().zip(&first) {
            assert!(ask(Method::HEAD, url, &[]).body.is_empty());
            assert!(get(url).body == *first);
        }
        // An answer may have come before it is counted.
        let begun = Instant::now();
        while taken() < (round * large) as f64 && begun.elapsed() < Duration::from_secs(10) {
            std::thread::sleep(Duration::from_millis(5));
        }
        assert_eq!(taken(), (round * large) as f64);
    }
}

#[test]
fn a_damaged_blob_is_never_served_and_the_rest_of_its_batch_is() {
    let world = World::sample(513, 0.0);
    let (routes, batch) = diamonds(&world, 20);
    let served = &world.served;
    let path = format!("{}{}", served.address, routes[7]);
    // The server has the pack open: what is written into the file is what it reads.
    let payload = get(&path).body;
    let pack = store(&world).join(&world.report.scene.version).join("pack-00000");
    let mut bytes = std::fs::read(&pack).unwrap();
    let at = bytes.windows(payload.len()).position(|window| window == payload).unwrap();
    bytes[at] ^= 1;
    std::fs::write(&pack, bytes).unwrap();
    let fresh = serve_with(&[store(&world)], &Options::default());
    let single = get(&format!("{}{}", fresh.address, routes[7]));
    assert_eq!((single.status.as_u16(), single.header("cache-control")), (500, "no-store"));
    assert!(!single.text().contains("pack"), "strangers are not told about our disks");
    assert_eq!(metric(&fresh, "diamantina_checksum_failures_total"), 1.0);
    let all = get(&format!("{}{batch}", fresh.address));
    assert!(!all.is_whole, "no cache may keep it");
    let (mut rest, mut sound, mut damaged) = (all.body.as_slice(), 0, 0);
    while !rest.is_empty() {
        let (header, used) = message::FrameHeader::read(rest).unwrap().unwrap();
        rest = &rest[used..];
        let (payload, more) = rest.split_at(header.length as usize);
        rest = more;
        match header.status {
            message::Status::Ok => {
                assert_eq!(message::checksum(payload), header.checksum);
                assert_eq!(damaged, 0, "what is damaged comes last");
                sound += 1;
            }
            _ => damaged += 1,
        }
    }
    assert_eq!((sound, damaged), (19, 1));
    assert_eq!(metric(&fresh, "diamantina_checksum_failures_total"), 2.0);
}

/// The real server, with all that it says.
pub(crate) struct Program {
    child: std::process::Child,
    /// `http://127.0.0.1:PORT`.
    pub(crate) address: String,
    log: std::thread::JoinHandle<String>,
}

impl Program {
    pub(crate) fn start(args: &[&str], variables: &[(&str, &str)]) -> Self {
        Self::start_at("127.0.0.1:0", args, variables)
    }

    /// The same, at an address that may be another's that has ended.
    pub(crate) fn start_at(listen: &str, args: &[&str], variables: &[(&str, &str)]) -> Self {
        let mut command = Command::new(&programs().server);
        command.arg("serve").args(args).args(["--listen", listen]);
        command.envs(variables.iter().copied()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let mut first = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut first).unwrap();
        let mut errors = child.stderr.take().unwrap();
        let log = std::thread::spawn(move || {
            let mut text = String::new();
            let _ = errors.read_to_string(&mut text);
            text
        });
        let address = first.split_whitespace().last().unwrap_or_default().to_owned();
        Self { child, address, log }
    }

    /// Kills it, and says what it wrote to its log.
    pub(crate) fn kill(mut self) -> String {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
        self.log.join().unwrap()
    }

    /// Stops it, and says what it wrote to its log.
    pub(crate) fn stop(mut self) -> String {
        let _ = Command::new("kill").arg(self.child.id().to_string()).status();
        assert!(self.child.wait().unwrap().success());
        self.log.join().unwrap()
    }
}

#[test]
fn the_log_has_a_line_for_each_request_and_no_secret() {
    let world = World::sample(129, 0.0);
    let (token, hash) = http::new_token().unwrap();
    let tokens = world.folder.path().join("tokens");
    std::fs::write(&tokens, format!("world {hash}")).unwrap();
    let (folder, file) = (store(&world), tokens.to_str().unwrap());
    let args = [folder.to_str().unwrap(), "--log-format", "json", "--tokens", file];
    let server = Program::start(&args, &[("RUST_LOG", "info")]);
    let url = format!("{}/scenes/world?token={token}", server.address);
    let bearer = format!("Bearer {token}");
    let headers = [(AUTHORIZATION, bearer.as_str()), (HeaderName::from_static("x-request-id"), "find-me")];
    assert_eq!(ask(Method::GET, &url, &headers).status, 200);
    assert_eq!(get(&url).status, 404);
    let log = server.stop();
    assert!(!log.contains(&token) && !log.contains(&hash), "{log}");
    let lines: Vec<serde_json::Value> = log
        .lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{e}: {line}")))
        .collect();
    let line = lines.iter().find(|line| line["id"] == "find-me").unwrap_or_else(|| panic!("{log}"));
    assert_eq!((&line["status"], &line["method"]), (&200.into(), &"GET".into()));
    assert_eq!((&line["path"], &line["route"]), (&"/scenes/world".into(), &"/scenes/{scene}".into()));
    assert!(line["bytes"].as_u64().unwrap() > 100 && line["milliseconds"].is_number());
    assert!(lines.iter().any(|line| line["status"] == 404));
}

#[test]
fn a_private_scene_is_not_there_but_for_its_token() {
    let world = World::sample(129, 0.0);
    let (token, hash) = http::new_token().unwrap();
    let tokens = world.folder.path().join("tokens");
    std::fs::write(&tokens, format!("world {hash} # for the test\n")).unwrap();
    let options = Options { tokens: Some(tokens), ..Options::default() };
    let served = serve_with(&[store(&world)], &options);
    let (routes, batch) = diamonds(&world, 3);
    let version = &world.report.scene.version;
    let stream = format!("/scenes/world/{version}/terrain/stream?error=1");
    let page = format!("/scenes/world/{version}/terrain/index/0");
    let [x, y] = world.report.scene.layers[0].position([64, 64]);
    let height = format!("/scenes/world/terrain/height?x={x}&y={y}");
    let inside = ["/scenes/world", &routes[0], &batch, &stream, &page, &height];
    let outside = "/scenes/world/0123456789abcdef/terrain/index/0";
    let bearer = format!("Bearer {token}");
    for route in inside.into_iter().chain([outside, "/scenes/%77orld"]) {
        let url = format!("{}{route}", served.address);
        let other =
            format!("{}{}", served.address, route.replace("world", "other").replace("%77orld", "other"));
        let (refused, missing) = (get(&url), get(&other));
        assert_eq!((refused.status.as_u16(), &refused.body), (404, &missing.body), "{route}");
        let wrong = ask(Method::GET, &url, &[(AUTHORIZATION, &bearer.replace(&token[..4], "0000"))]);
        assert_eq!(wrong.status, 404, "{route}");
        let status = if route == outside { 410 } else { 200 };
        assert_eq!(ask(Method::GET, &url, &[(AUTHORIZATION, &bearer)]).status.as_u16(), status, "{route}");
    }
    let diamond = ask(Method::GET, &format!("{}{}", served.address, routes[0]), &[(AUTHORIZATION, &bearer)]);
    assert!(diamond.headers[CACHE_CONTROL].to_str().unwrap().starts_with("private, "));
    for list in ["/scenes", "/"] {
        let url = format!("{}{list}", served.address);
        assert!(!get(&url).text().contains("world"), "{list}");
        assert!(ask(Method::GET, &url, &[(AUTHORIZATION, &bearer)]).text().contains("world"), "{list}");
    }
}

#[test]
fn who_asks_too_often_is_told_when_to_come_back() {
    let world = World::sample(129, 0.0);
    let limits = Limits { rate: 2, burst: 3, ..Limits::default() };
    let served = serve_within(&[store(&world)], limits);
    let found: Vec<Answer> = (0..12).map(|_| get(&format!("{}/scenes", served.address))).collect();
    let refused: Vec<&Answer> = found.iter().filter(|answer| answer.status == 429).collect();
    assert!(refused.len() >= 5 && found[..3].iter().all(|answer| answer.status == 200));
    assert!(refused.iter().all(|answer| answer.header("retry-after") == "1"));
    assert_eq!(metric(&served, "diamantina_rejections_total{reason=\"rate\"}"), refused.len() as f64);
    assert_eq!(
        get(&format!("{}/health", served.address)).status,
        200,
        "health is asked as often as one likes"
    );
    let started = Instant::now();
    while get(&format!("{}/scenes", served.address)).status == 429 {
        assert!(started.elapsed() < PATIENCE, "the bucket never fills");
        std::thread::sleep(Duration::from_millis(200));
    }
}

/// Writes a new certificate for this machine, and its key.
pub(crate) fn certify(folder: &Path) -> (CertificateDer<'static>, PathBuf, PathBuf) {
    let made = rcgen::generate_simple_self_signed(["localhost".to_owned()]).unwrap();
    let (certificate, key) = (folder.join("cert.pem"), folder.join("key.pem"));
    std::fs::write(&certificate, made.cert.pem()).unwrap();
    std::fs::write(&key, made.signing_key.serialize_pem()).unwrap();
    (made.cert.der().clone(), certificate, key)
}

/// Asks over TLS, trusting one certificate; what was agreed on, and the answer's first bytes.
async fn ask_encrypted(
    address: &str,
    trusted: &CertificateDer<'static>,
    protocols: &[&str],
) -> std::io::Result<(Option<Vec<u8>>, String)> {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let mut roots = RootCertStore::empty();
    roots.add(trusted.clone()).unwrap();
    let mut config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    config.alpn_protocols = protocols.iter().map(|p| p.as_bytes().to_vec()).collect();
    let tcp = tokio::net::TcpStream::connect(address.trim_start_matches("https://")).await?;
    let name = "localhost".try_into().unwrap();
    let mut stream = TlsConnector::from(Arc::new(config)).connect(name, tcp).await?;
    let agreed = stream.get_ref().1.alpn_protocol().map(<[u8]>::to_vec);
    if agreed.as_deref() == Some(b"h2") {
        // The preface and empty settings: the server answers with its own.
        stream.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0").await?;
    } else {
        stream.write_all(b"GET /scenes HTTP/1.1\r\nHost: localhost\r\n\r\n").await?;
    }
    let mut bytes = [0; 4096];
    let count = stream.read(&mut bytes).await?;
    Ok((agreed, String::from_utf8_lossy(&bytes[..count]).into_owned()))
}

#[test]
fn what_is_sent_is_encrypted_by_the_newest_certificate() {
    let world = World::sample(129, 0.0);
    let folder = world.folder.path();
    let (first, certificate, key) = certify(folder);
    let limits = Limits { reload: 1, head: Duration::from_millis(500), ..Limits::default() };
    let options =
        Options { limits, certificate: Some((certificate.clone(), key.clone())), ..Options::default() };
    let served = serve_with(&[store(&world)], &options);
    assert!(served.address.starts_with("https://"));
    block(async {
        let ask = |trusted: &CertificateDer<'static>, protocols: &'static [&'static str]| {
            let (address, trusted) = (served.address.clone(), trusted.clone());
            async move { ask_encrypted(&address, &trusted, protocols).await }
        };
        let (agreed, answer) = ask(&first, &["h2", "http/1.1"]).await.unwrap();
        assert_eq!(agreed.as_deref(), Some(b"h2".as_slice()));
        assert_eq!(&answer.as_bytes()[3..4], [4], "settings: {answer:?}");
        let (agreed, answer) = ask(&first, &["http/1.1"]).await.unwrap();
        assert!(agreed.as_deref() == Some(b"http/1.1") && answer.starts_with("HTTP/1.1 200"), "{answer}");
        assert!(ask(&first, &[]).await.unwrap().1.starts_with("HTTP/1.1 200"));
        // Renewed: a key that does not fit yet changes nothing, the pair does.
        let wait = || tokio::time::sleep(Duration::from_millis(1500));
        let later = |path: &Path, minutes: u64| {
            let at = SystemTime::now() + Duration::from_secs(60 * minutes);
            std::fs::File::options().write(true).open(path).unwrap().set_modified(at).unwrap();
        };
        let old_key = std::fs::read(&key).unwrap();
        let (second, ..) = certify(folder);
        let new_key = std::fs::read(&key).unwrap();
        std::fs::write(&key, &old_key).unwrap();
        later(&certificate, 1);
        wait().await;
        assert!(ask(&first, &[]).await.is_ok(), "half a pair is no pair");
        std::fs::write(&key, &new_key).unwrap();
        later(&key, 2);
        let started = Instant::now();
        while ask(&second, &[]).await.is_err() {
            assert!(started.elapsed() < PATIENCE, "the new certificate is never used");
            wait().await;
        }
        assert!(ask(&first, &[]).await.is_err(), "the old one is no longer shown");
    });
    // Who does not encrypt, or not in time, is cut off.
    let plain = served.address.replace("https", "http");
    let mut stream = connect(&plain);
    // The server has seen enough after the first bytes.
    let _ = stream.write_all(b"GET /health HTTP/1.1\r\nHost: here\r\n\r\n");
    assert!(!answer(&mut stream).contains("200"));
    let mut silent = connect(&plain);
    assert_eq!(answer(&mut silent), "");
}

#[test]
fn settings_come_from_files_variables_and_flags_through_the_real_program() {
    let world = World::sample(129, 0.0);
    let folder = world.folder.path();
    let file = folder.join("serve.toml");
    let (file_name, store_name) = (file.to_str().unwrap().to_owned(), store(&world));
    let write = |text: String| std::fs::write(&file, text).unwrap();
    let server = |args: &[&str]| -> Ended {
        end(start(&programs().server, &args.iter().map(OsString::from).collect::<Vec<_>>()))
    };
    write(format!("stores = [{:?}]\nrate = 5\nburst = 2\n", store_name.to_str().unwrap()));
    let checked = server(&["config", "check", "--config", &file_name]);
    assert!(checked.code == Some(0) && checked.out.contains("world"), "{checked:?}");
    let printed = server(&["config", "print", "--config", &file_name, "--rate", "7"]);
    assert!(printed.code == Some(0) && printed.out.contains("rate = 7 # flag"), "{printed:?}");
    assert!(
        printed.out.contains("burst = 2 # file") && printed.out.contains("\nreload = 5\n"),
        "{printed:?}"
    );
    let running = Program::start(&["--config", &file_name], &[("DIAMANTINA_BURST", "1")]);
    let statuses: Vec<u16> =
        (0..2).map(|_| get(&format!("{}/scenes", running.address)).status.as_u16()).collect();
    assert_eq!(statuses, [200, 429]);
    running.stop();

    for (text, words) in [
        ("stors = []", "did you mean 'stores'?"),
        ("stores = [\"nowhere\"]", "nowhere"),
        ("max_connections = 2\nmax-connections = 1", "'max-connections' and 'max_connections'"),
        ("rate = \"often\"", "often"),
        ("tokens = \"none\"", "no store"),
        ("x", "TOML"),
    ] {
        write(text.to_owned());
        for args in [&["config", "check", "--config", &file_name][..], &["serve", "--config", &file_name]] {
            let refused = server(args);
            assert!(matches!(refused.code, Some(1 | 2)) && refused.err.contains(words), "{refused:?}");
        }
    }
    let made = server(&["token", "world"]);
    let words: Vec<&str> = made.out.split_whitespace().collect();
    let (hash, token) = (words[words.len() - 1], words.iter().find(|word| word.len() == 64).unwrap());
    let tokens = folder.join("tokens");
    std::fs::write(&tokens, format!("world {hash}")).unwrap();
    let served = serve_with(&[store(&world)], &Options { tokens: Some(tokens), ..Options::default() });
    let url = format!("{}/scenes/world", served.address);
    assert_eq!(get(&url).status, 404);
    assert_eq!(ask(Method::GET, &url, &[(AUTHORIZATION, &format!("Bearer {token}"))]).status, 200);
    assert_eq!(server(&["token", "../x"]).code, Some(2));
}

/// Fills a template of the contract: the parameters of its path by name, those behind the question mark as given.
fn filled(template: &str, values: &dyn Fn(&str) -> String, query: &str) -> String {
    let part = |part: &str| match part.strip_prefix('{').and_then(|p| p.strip_suffix('}')) {
        Some(name) => values(name),
        None => part.to_owned(),
    };
    format!("{}{query}", template.split('/').map(part).collect::<Vec<_>>().join("/"))
}

#[test]
fn the_contract_tells_every_answer_that_is_given() {
    let world = World::sample(129, 0.0);
    let web = tempfile::tempdir().unwrap();
    std::fs::create_dir(web.path().join("0")).unwrap();
    for name in ["index.html", "0/page.js"] {
        std::fs::write(web.path().join(name), "some").unwrap();
    }
    let options = Options { web: Some(web.path().to_owned()), ..Options::default() };
    let served = serve_with(&[store(&world)], &options);
    let (version, size) = (&world.report.scene.version, world.report.scene.layers[0].forest.size());
    let answer = get(&format!("{}/openapi.json", served.address));
    let contract: serde_json::Value = serde_json::from_slice(&answer.body).unwrap();
    assert_eq!((&contract["openapi"], answer.header("content-type")), (&"3.1.0".into(), "application/json"));
    let paths = contract["paths"].as_object().unwrap();
    assert_eq!(paths.len(), 18);
    let good = |name: &str| match name {
        "scene" => "world".to_owned(),
        "version" => version.clone(),
        "layer" => "terrain".to_owned(),
        "x" => (size[0] / 2).to_string(),
        "y" => (size[1] / 2).to_string(),
        "file" => "page.js".to_owned(),
        _ => "0".to_owned(),
    };
    let old = |name: &str| if name == "version" { "0123456789abcdef".to_owned() } else { good(name) };
    let none = |name: &str| if name == "scene" { "none".to_owned() } else { good(name) };
    let odd =
        |name: &str| if matches!(name, "x" | "page" | "layer") { "..%2f".to_owned() } else { good(name) };
    let raw = |name: &str| if matches!(name, "scene" | "hash") { "%ff".to_owned() } else { good(name) };
    let long = format!("?d={}", "1,1;".repeat(500));
    let [x, y] = world.report.scene.layers[0].position([64, 64]);
    let place = format!("?x={x}&y={y}");
    let queries =
        ["", "?d=1,1;0,0", "?d=x", &long, "?error=1", "?error=-1", &place, "?x=a&y=1", "?lon=0&lat=0"];
    let mut seen = std::collections::BTreeSet::new();
    assert_eq!(contract["components"]["securitySchemes"]["token"]["scheme"], "bearer");
    for (template, item) in paths {
        let responses = item["get"]["responses"].as_object().unwrap();
        // Who has a token may send it wherever there may be a private scene.
        let security = if template.starts_with("/scenes") {
            serde_json::json!([{}, { "token": [] }])
        } else {
            ().into()
        };
        assert_eq!(item["get"]["security"], security, "{template}");
        let values: [&dyn Fn(&str) -> String; 5] = [&good, &old, &none, &odd, &raw];
        for (values, query) in values.into_iter().flat_map(|v| queries.map(|q| (v, q))) {
            let route = filled(template, values, query);
            for method in [Method::GET, Method::HEAD, Method::DELETE] {
                let answer = ask(method.clone(), &format!("{}{route}", served.address), &[]);
                let status = answer.status.as_u16().to_string();
                let told = &responses.get(&status).unwrap_or_else(|| panic!("{method} {route}: {status}"))["content"];
                let kind = answer.header("content-type").split(';').next().unwrap();
                let any = told.get(kind).or(told.get("*/*"));
                assert!(any.is_some(), "{method} {route}: {status} is {kind}, told: {told}");
                if status == "200" && method == Method::GET {
                    // Only of what has a tag it is told who has it.
                    let is_tagged = !answer.header("etag").is_empty();
                    assert_eq!(["304", "412"].map(|s| responses.contains_key(s)), [is_tagged; 2], "{route}");
                }
                if kind == "application/problem+json" {
                    assert_eq!(answer.header("cache-control"), "no-store", "{method} {route}");
                }
                if method == Method::GET && kind == "application/problem+json" {
                    let problem: serde_json::Value = serde_json::from_slice(&answer.body).unwrap();
                    assert_eq!(problem["status"].to_string(), status);
                }
                seen.insert((template.clone(), status));
            }
        }
    }
    // Each route was seen to answer (this scene has neither triangles nor a zone nor imagery), and all kinds of refusals.
    for template in
        paths.keys().filter(|t| !["tin", "zone", "texture"].iter().any(|lacking| t.contains(lacking)))
    {
        assert!(seen.contains(&(template.clone(), "200".to_owned())), "{template}: {seen:?}");
    }
    for status in ["400", "404", "405", "410", "413"] {
        assert!(seen.iter().any(|(_, s)| s == status), "{status}: {seen:?}");
    }
}

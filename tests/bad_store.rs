//! Stores that cannot be read, or not right, under the real server: whatever it sends is right, what it cannot have it says,
//! counts and logs by name, all else goes on being served, and once the fault is over so is everything.
//!
//! Faults of a disk are made in the files that the server has open. Those of an object store are made by one of our own,
//! which spoils its answers as a seed says: the server asks it over HTTP, as it does any other.

use crate::service::Program;
use crate::world::{Dice, World, asker, serve};
use diamantina_protocol::message::{self, FrameHeader, Status, StreamAsk};
use diamantina_server::store::{Key, Kind, Store};
use reqwest::header::{CACHE_CONTROL, CONTENT_TYPE, HeaderName};
use std::collections::{BTreeMap, HashSet};
use std::io::{self, BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(20);

/// Requests of a test at once.
const AT_ONCE: usize = 8;

/// What an object store does to ranges of packs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fault {
    /// A bit is another one.
    Flip,
    /// The connection is closed in the middle.
    Cut,
    /// There are fewer bytes than were asked for, and the store says that the pack ends there.
    Short,
    /// The store says 500: it could not read.
    Error,
    /// It takes its time.
    Slow,
    /// The pack is not there.
    Missing,
}

/// Which ranges are spoilt.
#[derive(Debug, Clone)]
enum Where {
    /// One of so many, by the dice.
    Some(f64),
    /// Those that hold one of these bytes.
    Bytes(Vec<u64>),
}

/// An object store: a folder over HTTP. Its threads end with the process.
struct Objects {
    address: String,
    fault: Arc<Mutex<Option<(Fault, Where)>>>,
}

impl Objects {
    fn start(folder: &Path, seed: u64) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("http://{}/store", listener.local_addr().unwrap());
        let fault: Arc<Mutex<Option<(Fault, Where)>>> = Arc::default();
        let (folder, shared, number) =
            (folder.to_owned(), Arc::clone(&fault), Arc::new(AtomicU64::new(seed)));
        std::thread::spawn(move || {
            for client in listener.incoming().flatten() {
                let (folder, fault, number) = (folder.clone(), Arc::clone(&shared), Arc::clone(&number));
                std::thread::spawn(move || carry(client, &folder, &fault, &number));
            }
        });
        Self { address, fault }
    }

    fn set(&self, fault: Option<(Fault, Where)>) {
        *self.fault.lock().unwrap() = fault;
    }
}

/// Answers what comes on a connection.
fn carry(
    mut client: TcpStream,
    folder: &Path,
    fault: &Mutex<Option<(Fault, Where)>>,
    number: &AtomicU64,
) -> io::Result<()> {
    client.set_nodelay(true)?;
    let mut asked = BufReader::new(client.try_clone()?);
    loop {
        let (mut lines, mut line) = (Vec::new(), String::new());
        while asked.read_line(&mut line)? > 2 {
            lines.push(std::mem::take(&mut line));
        }
        let Some(name) = lines.first().and_then(|line| line.strip_prefix("GET /store/")?.split(' ').next())
        else {
            return Ok(());
        };
        let header = |name: &str| {
            let mut found = lines.iter().filter_map(|line| line.split_once(": "));
            found.find(|(found, _)| found.eq_ignore_ascii_case(name)).map(|(_, value)| value.trim())
        };
        let Ok(whole) = std::fs::read(folder.join(name)) else {
            client.write_all(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")?;
            continue;
        };
        let tag = format!("\"{:x}\"", message::checksum(&whole));
        if header("if-none-match") == Some(tag.as_str()) {
            client.write_all(b"HTTP/1.1 304 Not Modified\r\n\r\n")?;
            continue;
        }
        let range = header("range").and_then(|text| text.strip_prefix("bytes=")?.split_once('-'));
        let range = range.and_then(|(a, b)| Some((a.parse::<usize>().ok()?, b.parse::<usize>().ok()?)));
        let (start, end) = range.map_or((0, whole.len()), |(a, b)| (a, whole.len().min(b + 1)));
        let mut dice = Dice(number.fetch_add(0x9E37_79B9_7F4A_7C15, Ordering::Relaxed));
        let fault = fault.lock().unwrap().clone().filter(|(_, places)| match places {
            Where::Some(chance) => dice.roll() < *chance,
            Where::Bytes(bytes) => bytes.iter().any(|at| (start..end).contains(&(*at as usize))),
        });
        let fault = fault.filter(|_| name.contains("/pack-"));
        let mut body = whole[start..end].to_vec();
        let mut size = whole.len();
        let told = match fault.as_ref().map(|(fault, _)| fault) {
            Some(Fault::Error) => {
                client.write_all(b"HTTP/1.1 500 Internal Server Error\r\nContent-Length: 3\r\n\r\nEIO")?;
                continue;
            }
            Some(Fault::Missing) => {
                client.write_all(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")?;
                continue;
            }
            Some(Fault::Flip) => {
                let at = match &fault {
                    Some((_, Where::Bytes(bytes))) => {
                        let here = bytes.iter().map(|at| *at as usize).find(|at| (start..end).contains(at));
                        here.unwrap_or(start) - start
                    }
                    _ => dice.below(body.len() as u64) as usize,
                };
                body[at] ^= 1 << dice.below(8);
                body.len()
            }
            Some(Fault::Short) => {
                body.truncate(1 + dice.below(body.len() as u64) as usize);
                size = start + body.len();
                body.len()
            }
            Some(Fault::Cut) => {
                let told = body.len();
                body.truncate(dice.below(told as u64) as usize);
                told
            }
            Some(Fault::Slow) => {
                std::thread::sleep(Duration::from_millis(100 + dice.below(500)));
                body.len()
            }
            None => body.len(),
        };
        let status = if range.is_some() { "206 Partial Content" } else { "200 OK" };
        let last = (start + told).saturating_sub(1);
        let place = if range.is_some() {
            format!("Content-Range: bytes {start}-{last}/{size}\r\n")
        } else {
            String::new()
        };
        let head = format!("HTTP/1.1 {status}\r\nContent-Length: {told}\r\nETag: {tag}\r\n{place}\r\n");
        client.write_all(head.as_bytes())?;
        client.write_all(&body)?;
        if body.len() < told {
            return Ok(());
        }
    }
}

/// What came of a question.
#[derive(Debug, Clone)]
struct Answer {
    status: u16,
    kind: String,
    cache: String,
    body: Vec<u8>,
    is_whole: bool,
}

/// Asks, a few questions at a time.
struct Asker {
    runtime: tokio::runtime::Runtime,
    client: reqwest::Client,
}

impl Asker {
    fn new() -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
        let client = asker().build().unwrap();
        Self { runtime, client }
    }

    /// Answers in the order of the routes.
    fn all(&self, address: &str, routes: &[&str]) -> Vec<Answer> {
        let mut answers = Vec::new();
        for some in routes.chunks(AT_ONCE) {
            answers.extend(self.runtime.block_on(async {
                let asked: Vec<_> = some
                    .iter()
                    .map(|route| tokio::spawn(get(self.client.clone(), format!("{address}{route}"))))
                    .collect();
                let mut answers = Vec::new();
                for answer in asked {
                    answers.push(answer.await.unwrap());
                }
                answers
            }));
        }
        answers
    }

    fn one(&self, address: &str, route: &str) -> Answer {
        self.all(address, &[route]).remove(0)
    }

    /// The sum of some counters.
    fn counted(&self, address: &str, names: &[&str]) -> f64 {
        let text = String::from_utf8(self.one(address, "/metrics").body).unwrap();
        let of =
            |name: &str| text.lines().find_map(|l| l.strip_prefix(name)?.strip_prefix(' ')?.parse().ok());
        names.iter().map(|name| of(&format!("diamantina_{name}_total")).unwrap_or(0.0)).sum()
    }
}

async fn get(client: reqwest::Client, url: String) -> Answer {
    let mut response = client.get(&url).send().await.unwrap_or_else(|e| panic!("{url}: {e}"));
    let header = |name: HeaderName| {
        let value = response.headers().get(name);
        value.map_or_else(String::new, |v| v.to_str().unwrap().to_owned())
    };
    let (status, kind, cache) = (response.status().as_u16(), header(CONTENT_TYPE), header(CACHE_CONTROL));
    let mut body = Vec::new();
    let is_whole = loop {
        match response.chunk().await {
            Ok(Some(chunk)) => body.extend_from_slice(&chunk),
            Ok(None) => break true,
            Err(_) => break false,
        }
    };
    Answer { status, kind, cache, body, is_whole }
}

/// A store, and what a server of it has to say.
struct Truth {
    world: World,
    /// Of each blob: its address, its bytes, and its key as the log names it.
    blobs: Vec<(String, Vec<u8>, String)>,
    batch: (String, Vec<u8>),
    stream: (String, Vec<u8>),
    height: (String, Vec<u8>),
}

impl Truth {
    /// With every so manyth of the blobs.
    fn some(stride: usize) -> Self {
        let mut all = Self::new();
        all.blobs = all.blobs.into_iter().step_by(stride).collect();
        all
    }

    fn new() -> Self {
        let world = World::whole(513);
        let folder = world.folder.path().join("store");
        let store = Store::open(&folder).unwrap();
        let (scene, asker) = (store.scene(), Asker::new());
        let version = &scene.version;
        let mut blobs: Vec<(String, Vec<u8>, String)> = Vec::new();
        let mut centres = Vec::new();
        for key in store.keys_in_order() {
            let Key { a, b, .. } = key;
            let route = match key.kind {
                Kind::Index => message::index_route("world", version, "terrain", a),
                _ => message::points_route("world", version, "terrain", [a, b]),
            };
            if key.kind == Kind::Points {
                centres.push([a, b]);
            }
            let blob = store.get(key).unwrap().unwrap().to_vec();
            blobs.push((route, blob, format!("{key:?}")));
        }
        let served = serve(&[folder]);
        let known = |route: String| {
            let answer = asker.one(&served.address, &route);
            assert!(answer.status == 200 && answer.is_whole, "{route}: {answer:?}");
            (route, answer.body)
        };
        let stride = centres.len() / 60;
        let some: Vec<_> = centres.iter().step_by(stride.max(1)).copied().collect();
        let batch = known(message::batch_route("world", version, "terrain", &some));
        let stream = known(message::stream_route("world", version, "terrain", &StreamAsk::default()));
        let [x, y] = scene.layers[0].position([255, 129]);
        let height = known(format!("/scenes/world/terrain/height?x={x}&y={y}"));
        Self { blobs, batch, stream, height, world }
    }

    fn store(&self) -> PathBuf {
        self.world.folder.path().join("store")
    }

    fn pack(&self) -> PathBuf {
        self.store().join(&self.world.report.scene.version).join("pack-00000")
    }

    fn routes(&self) -> Vec<&str> {
        self.blobs.iter().map(|(route, ..)| route.as_str()).collect()
    }

    /// Whether it is a refusal, which has to be a proper one.
    fn is_refused(answer: &Answer, what: &str) -> bool {
        if !matches!(answer.status, 500 | 503) {
            return false;
        }
        assert_eq!((answer.kind.as_str(), answer.cache.as_str()), ("application/problem+json", "no-store"));
        let problem: serde_json::Value = serde_json::from_slice(&answer.body).unwrap();
        assert_eq!(problem["status"], answer.status, "{what}: {problem}");
        assert!(!problem.to_string().contains("pack"), "{what}: strangers are told of our disks: {problem}");
        true
    }

    /// Asks for all blobs; what comes is right or refused. The blobs that were refused, with their statuses.
    fn blobs_of(&self, asker: &Asker, address: &str, what: &str) -> BTreeMap<usize, u16> {
        let mut refused = BTreeMap::new();
        for (number, answer) in asker.all(address, &self.routes()).iter().enumerate() {
            let (route, expected, _) = &self.blobs[number];
            if Self::is_refused(answer, what) {
                refused.insert(number, answer.status);
            } else {
                let is_right = answer.status == 200 && answer.is_whole && answer.body == *expected;
                assert!(is_right, "{what}: {route} is answered with {}", answer.status);
            }
        }
        refused
    }

    /// Asks for a batch, a stream and a height; what comes is right, refused, or cut off. How many came whole.
    fn others_of(&self, asker: &Asker, address: &str, what: &str) -> usize {
        let answer = asker.one(address, &self.height.0);
        let mut whole = usize::from(!Self::is_refused(&answer, what));
        assert!(whole == 0 || answer.body == self.height.1, "{what}: another height");
        let answer = asker.one(address, &self.stream.0);
        if !Self::is_refused(&answer, what) {
            assert!(self.stream.1.starts_with(&answer.body), "{what}: another stream");
            assert_eq!(answer.is_whole, answer.body.len() == self.stream.1.len(), "{what}: a stream's end");
            whole += usize::from(answer.is_whole);
        }
        let answer = asker.one(address, &self.batch.0);
        if !Self::is_refused(&answer, what) {
            let known: BTreeMap<_, _> = frames(&self.batch.1).into_iter().collect();
            let (mut sound, mut damaged) = (HashSet::new(), 0);
            for (centre, (status, payload)) in frames(&answer.body) {
                if status == Status::Damaged {
                    damaged += 1;
                    continue;
                }
                assert!(known[&centre] == (status, payload), "{what}: another payload of {centre:?}");
                assert!(damaged == 0 && sound.insert(centre), "{what}: {centre:?} comes late or twice");
            }
            assert_eq!(answer.is_whole, sound.len() == known.len(), "{what}: a batch's end");
            whole += usize::from(answer.is_whole);
        }
        whole
    }

    /// All is right, at the latest after a while: whoever could not be reached may be left alone for a moment.
    fn assert_well(&self, asker: &Asker, address: &str, what: &str) {
        let started = Instant::now();
        while asker.one(address, &self.height.0).status != 200 {
            assert!(started.elapsed() < PATIENCE, "{what}: it does not recover");
            std::thread::sleep(Duration::from_millis(100));
        }
        let what = format!("{what}, once it is over");
        assert_eq!(self.blobs_of(asker, address, &what), BTreeMap::new(), "{what}");
        assert_eq!(self.others_of(asker, address, &what), 3, "{what}");
    }
}

type Payload = (Status, Vec<u8>);

/// The whole frames of an answer.
fn frames(mut bytes: &[u8]) -> Vec<([u32; 2], Payload)> {
    let mut found = Vec::new();
    while let Some((header, used)) = FrameHeader::read(bytes).unwrap() {
        let Some(payload) = bytes.get(used..used + header.length as usize) else { break };
        assert_eq!(message::checksum(payload), header.checksum);
        found.push((header.centre, (header.status, payload.to_vec())));
        bytes = &bytes[used + header.length as usize..];
    }
    found
}

/// What counts failures of stores.
const COUNTERS: [&str; 3] = ["checksum_failures", "store_errors", "store_away"];

#[test]
fn what_a_disk_gives_wrong_or_not_at_all_is_refused_by_name_and_all_else_is_served() {
    const SEED: u64 = 71;
    println!("seed {SEED}");
    let (truth, asker, mut dice) = (Truth::new(), Asker::new(), Dice(SEED));
    let sound = std::fs::read(truth.pack()).unwrap();
    // Where each blob lies, as far as its bytes tell.
    let mut places = BTreeMap::new();
    for (number, (_, blob, _)) in truth.blobs.iter().enumerate().filter(|(_, (_, blob, _))| blob.len() > 40) {
        let at = sound.windows(blob.len()).position(|window| window == blob.as_slice()).unwrap();
        places.insert(number, at..at + blob.len());
    }
    assert!(places.len() > 100);
    let numbers: Vec<usize> = places.keys().copied().collect();
    for fault in ["flipped bits", "lost sectors", "a short file"] {
        let mut bytes = sound.clone();
        match fault {
            "flipped bits" => {
                for _ in 0..12 {
                    let number = numbers[dice.below(numbers.len() as u64) as usize];
                    let place = &places[&number];
                    bytes[place.start + dice.below(place.len() as u64) as usize] ^= 1 << dice.below(8);
                }
            }
            "lost sectors" => {
                for _ in 0..4 {
                    let at = dice.below(sound.len() as u64 / 512) as usize * 512;
                    bytes[at..(at + 512).min(sound.len())].fill(0xE5);
                }
            }
            _ => bytes.truncate(sound.len() / 2),
        }
        let is_hurt =
            |place: &std::ops::Range<usize>| bytes.get(place.clone()) != Some(&sound[place.clone()]);
        let hurt: Vec<usize> = numbers.iter().copied().filter(|number| is_hurt(&places[number])).collect();
        for cache in [&["--cache", "0"][..], &[]] {
            let what = format!("{fault}, {cache:?}");
            let folder = truth.store();
            let server = Program::start(&[&[folder.to_str().unwrap()], cache].concat(), &[]);
            let address = &server.address;
            // The server has the file open: what is written into it is what it reads.
            let file = std::fs::File::options().write(true).open(truth.pack()).unwrap();
            let write = |bytes: &[u8]| {
                file.write_all_at(bytes, 0).unwrap();
                file.set_len(bytes.len() as u64).unwrap();
            };
            write(&bytes);
            let refused = truth.blobs_of(&asker, address, &what);
            assert!(hurt.len() >= 3 && hurt.iter().all(|number| refused.get(number) == Some(&500)), "{what}");
            let found = numbers.iter().filter(|number| refused.contains_key(number)).count();
            assert_eq!(found, hurt.len(), "{what}: what is sound is refused");
            assert!(asker.counted(address, &COUNTERS) >= refused.len() as f64, "{what}: it is not counted");
            let before = asker.counted(address, &COUNTERS);
            assert!(truth.others_of(&asker, address, &what) < 3, "{what}: nothing of it is missed");
            assert!(
                asker.counted(address, &COUNTERS) > before,
                "{what}: streams and batches are not counted"
            );
            write(&sound);
            truth.assert_well(&asker, address, &what);
            let log = server.stop();
            for number in refused.keys() {
                let (_, _, name) = &truth.blobs[*number];
                assert!(log.contains(name), "{what}: the log does not name {name}: {log}");
            }
        }
    }
}

#[test]
fn heights_that_cannot_be_told_are_counted() {
    let (truth, asker) = (Truth::new(), Asker::new());
    let served = serve(&[truth.store()]);
    let sound = std::fs::read(truth.pack()).unwrap();
    std::fs::write(truth.pack(), vec![0; sound.len()]).unwrap();
    let answer = asker.one(&served.address, &truth.height.0);
    assert!(Truth::is_refused(&answer, "a height") && answer.status == 500);
    assert_eq!(asker.counted(&served.address, &["checksum_failures"]), 1.0);
    // And a stream that cannot even begin says so.
    let answer = asker.one(&served.address, &truth.stream.0);
    assert!(Truth::is_refused(&answer, "a stream") && answer.status == 500);
    assert_eq!(asker.counted(&served.address, &["checksum_failures"]), 2.0);
    std::fs::write(truth.pack(), sound).unwrap();
    assert_eq!(truth.others_of(&asker, &served.address, "mended"), 3);
}

#[test]
fn what_an_object_store_gives_wrong_late_or_not_at_all_is_never_sent_and_nothing_of_it_is_kept() {
    const SEED: u64 = 72;
    println!("seed {SEED}");
    let (truth, asker) = (Truth::some(4), Asker::new());
    let objects = Objects::start(&truth.store(), SEED);
    for (fault, chance) in [
        (Fault::Flip, 0.6),
        (Fault::Cut, 0.6),
        (Fault::Short, 0.6),
        (Fault::Missing, 0.3),
        (Fault::Slow, 0.2),
        (Fault::Error, 0.7),
    ] {
        for disk in [false, true] {
            let what = format!("{fault:?}, {}", if disk { "all caches" } else { "no cache" });
            let cache = truth.world.folder.path().join(format!("{fault:?}"));
            let caches = ["--disk-cache", cache.to_str().unwrap()];
            let caches = if disk { &caches[..] } else { &["--cache", "0"] };
            let server = Program::start(&[&[objects.address.as_str()], caches].concat(), &[]);
            let address = &server.address;
            objects.set(Some((fault, Where::Some(chance))));
            let refused = truth.blobs_of(&asker, address, &what);
            truth.others_of(&asker, address, &what);
            let counted = asker.counted(address, &COUNTERS);
            assert!(counted >= refused.len() as f64, "{what}: {counted} counted of {}", refused.len());
            if !disk && matches!(fault, Fault::Flip | Fault::Short | Fault::Missing | Fault::Error) {
                assert!(!refused.is_empty(), "{what}: nothing went wrong");
            }
            if fault == Fault::Slow {
                assert_eq!(refused, BTreeMap::new(), "{what}: what comes late comes");
            }
            objects.set(None);
            truth.assert_well(&asker, address, &what);
            let log = server.stop();
            for (number, status) in &refused {
                let (_, _, name) = &truth.blobs[*number];
                let is_away = *status == 503 && log.contains("the object store cannot be reached");
                assert!(is_away || log.contains(name), "{what}: the log does not name {name}: {log}");
            }
        }
    }
}

/// A store that could not read one pack's bytes was taken for one that is away: for a second at a time nothing else of it
/// was served.
#[test]
fn what_an_object_store_cannot_read_keeps_nobody_from_the_rest() {
    const SEED: u64 = 73;
    println!("seed {SEED}");
    let (truth, asker, mut dice) = (Truth::new(), Asker::new(), Dice(SEED));
    let objects = Objects::start(&truth.store(), SEED);
    let sound = std::fs::read(truth.pack()).unwrap();
    let long: Vec<usize> = (0..truth.blobs.len()).filter(|n| truth.blobs[*n].1.len() > 40).collect();
    let mut bad = BTreeMap::new();
    while bad.len() < 4 {
        // Not among the last, so that others are asked for meanwhile.
        let number = long[dice.below(long.len() as u64 * 3 / 4) as usize];
        let blob = truth.blobs[number].1.as_slice();
        let at = sound.windows(blob.len()).position(|window| window == blob).unwrap();
        bad.insert(number, at as u64 + dice.below(blob.len() as u64));
    }
    for (fault, status) in [(Fault::Flip, 500), (Fault::Missing, 500), (Fault::Error, 503)] {
        let what = format!("{fault:?}");
        let server = Program::start(&[&objects.address, "--cache", "0"], &[]);
        objects.set(Some((fault, Where::Bytes(bad.values().copied().collect()))));
        let expected: BTreeMap<usize, u16> = bad.keys().map(|number| (*number, status)).collect();
        assert_eq!(truth.blobs_of(&asker, &server.address, &what), expected, "{what}");
        objects.set(None);
        truth.assert_well(&asker, &server.address, &what);
        let log = server.stop();
        for number in bad.keys() {
            let (_, _, name) = &truth.blobs[*number];
            assert!(log.contains(name), "{what}: the log does not name {name}: {log}");
        }
    }
}

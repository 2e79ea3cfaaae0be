//! Progressive streams: any prefix is a surface that holds its promises, the server keeps little for a reader
//! and the client needs one round trip.

use crate::seams::{self, Loaded, assert_no_cracks};
use crate::truth::{Check, Samples, Verdict};
use crate::world::{Dice, Faults, Proxy, World, build, options, programs, write_raw};
use diamantina_client::camera::Camera;
use diamantina_client::cut::{self, Ask};
use diamantina_client::encoding::Encoding;
use diamantina_client::sight::Sight;
use diamantina_client::terrain::{self, Terrain};
use diamantina_client::{fetch, headless};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::message::{
    self, FrameHeader, Layer, STREAM_MAX, Status, StreamAsk, StreamView, stream_route,
};
use diamantina_protocol::points;
use diamantina_protocol::sight;
use diamantina_server::curve;
use diamantina_server::hierarchy;
use diamantina_server::ingest;
use diamantina_server::store::{Key, Kind, Store};
use diamantina_server::stream::{Stream, Subject};
use glam::DVec3;
use std::collections::{HashMap, HashSet};
use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// The archipelago of several roots, built with small patches, and its DEM.
struct Archipelago {
    folder: tempfile::TempDir,
    ingest: ingest::Options,
    store: Arc<Store>,
    layer: Layer,
}

fn archipelago(max_error: f64) -> Archipelago {
    let folder = tempfile::tempdir().unwrap();
    let dem = folder.path().join("dem.raw");
    let ingest = write_raw(&dem, [1100, 300], seams::islands);
    let place = folder.path().join("store");
    build(&dem, &place, &ingest, &hierarchy::Options { max_error, patch_log2: 5, ..options() });
    let store = Arc::new(Store::open(&place).unwrap());
    let layer = store.scene().layers[0].clone();
    Archipelago { folder, ingest, store, layer }
}

/// Questions of all kinds about a layer.
fn questions(layer: &Layer) -> Vec<StreamAsk> {
    let [low, high] = [layer.position([0, 0]), layer.position(layer.samples)];
    let at = |x: f64, y: f64| [low[0] + (high[0] - low[0]) * x, low[1] + (high[1] - low[1]) * y];
    let bbox = |x0, y0, x1, y1| {
        let ([x0, y0], [x1, y1]) = (at(x0, y0), at(x1, y1));
        Some([x0, y0, x1, y1])
    };
    let [x, y] = at(0.2, 0.1);
    let around =
        StreamView { eye: [x, y, layer.heights[1] + 500.0], angle: 1e-3, sides: Vec::new(), vertical: false };
    let sides = vec![[1.0, 0.3, 0.0], [-0.4, 1.0, 0.1]];
    let ahead = StreamView { sides, angle: 3e-4, ..around };
    let all = StreamAsk::default();
    vec![
        StreamAsk { error: 20.0, ..all.clone() },
        StreamAsk { bbox: bbox(0.1, 0.3, 0.2, 0.5), error: 2.0, ..all.clone() },
        // A point, a line, and what lies wholly outside.
        StreamAsk { bbox: bbox(0.25, 0.25, 0.25, 0.25), ..all.clone() },
        StreamAsk { bbox: bbox(-1.0, 0.5, 2.0, 0.5), error: 5.0, ..all.clone() },
        StreamAsk { bbox: bbox(-3.0, -3.0, -2.0, -2.0), ..all.clone() },
        StreamAsk { view: Some(StreamView { vertical: true, ..around.clone() }), ..all.clone() },
        StreamAsk { view: Some(around), ..all.clone() },
        StreamAsk { view: Some(ahead.clone()), error: 1.0, ..all.clone() },
        StreamAsk { view: Some(ahead), bbox: bbox(0.0, 0.0, 0.5, 1.0), ..all.clone() },
        StreamAsk { limit: Some(20_000), ..all.clone() },
        all,
    ]
}

fn stream(place: &Archipelago, ask: &StreamAsk) -> Stream {
    Stream::new(Arc::clone(&place.store), 0, &place.layer, ask.clone(), STREAM_MAX)
}

/// What a reader has of a stream, read from nothing but its bytes.
struct Reader<'a> {
    layer: &'a Layer,
    entries: HashMap<Diamond, Entry>,
    pages: HashSet<u32>,
    order: Vec<Diamond>,
    split: HashSet<Diamond>,
    payloads: HashMap<Diamond, Vec<u8>>,
}

impl<'a> Reader<'a> {
    fn new(layer: &'a Layer) -> Self {
        let (entries, payloads) = (HashMap::new(), HashMap::new());
        Self { layer, entries, pages: HashSet::new(), order: Vec::new(), split: HashSet::new(), payloads }
    }

    /// Takes the frame in front of `bytes`, holding it to its promises; what is left.
    fn take<'b>(&mut self, bytes: &'b [u8]) -> &'b [u8] {
        let (header, used) = FrameHeader::read(bytes).unwrap().unwrap();
        let (blob, rest) = bytes[used..].split_at(header.length as usize);
        assert_eq!(header.checksum, message::checksum(blob));
        let forest = self.layer.forest;
        match header.status {
            Status::Page => {
                let page = header.centre[0];
                assert!(header.centre[1] == 0 && self.pages.insert(page), "page {page} comes twice");
                let bytes = zstd::bulk::decompress(blob, 1 << 20).unwrap();
                self.entries.extend(index::decode(&forest, page, &bytes).unwrap());
            }
            Status::Ok => {
                let d = forest.diamond(header.centre).unwrap();
                assert!(forest.parents(d).all(|p| self.split.contains(&p)), "{d:?} before its parents");
                assert!(self.split.insert(d), "{d:?} comes twice");
                // What any prefix needs to tell its own errors.
                let around = forest.children(d).into_iter().flatten().chain([d]);
                assert!(around.into_iter().all(|d| self.entries.contains_key(&d)), "{d:?} before its pages");
                assert_eq!(self.entries[&d].bytes as usize, blob.len());
                assert!(!self.entries[&d].is_empty());
                self.order.push(d);
                self.payloads.insert(d, blob.to_vec());
            }
            other => panic!("a frame of {other:?}"),
        }
        rest
    }

    /// The children of what is split that are not split themselves: what is drawn.
    fn drawn(&self) -> impl Iterator<Item = Diamond> + '_ {
        let children = self.order.iter().flat_map(|d| self.layer.forest.children(*d)).flatten();
        children.filter(|c| !self.split.contains(c) && !self.entries[c].is_empty())
    }

    /// The error that the answer is ordered by, if it is asked for at all; as message.rs defines it.
    fn wanted(&self, ask: &StreamAsk, d: Diamond) -> Option<f64> {
        let entry = self.entries[&d];
        let [low, high] = self.layer.forest.bounds(d).map(|p| self.layer.position(p));
        let (low, high) = (
            DVec3::new(low[0], low[1], self.layer.metres(entry.low)),
            DVec3::new(high[0], high[1], self.layer.metres(entry.high)),
        );
        let error = f64::from(entry.error_metres);
        let touches = ask
            .bbox
            .is_none_or(|[x0, y0, x1, y1]| low.x <= x1 && high.x >= x0 && low.y <= y1 && high.y >= y0);
        if !touches || error <= ask.error {
            return None;
        }
        let Some(view) = &ask.view else { return Some(error) };
        let eye = DVec3::from_array(view.eye);
        let corners =
            (0..8).map(|i| DVec3::select(glam::BVec3::new(i & 1 > 0, i & 2 > 0, i & 4 > 0), high, low));
        let seen = view
            .sides
            .iter()
            .all(|side| corners.clone().any(|corner| DVec3::from_array(*side).dot(corner - eye) >= 0.0));
        let mut apparent = error / (eye.clamp(low, high) - eye).length();
        if view.vertical
            && sight::is_vertical(&self.layer.forest, d.level(), entry.error_metres, self.layer.cell)
        {
            apparent = apparent.min(sight::vertical_angle(view.eye, error, low.to_array(), high.to_array()));
        }
        (seen && apparent > view.angle).then_some(apparent)
    }
}

#[test]
fn any_prefix_is_closed_and_tells_its_errors_and_the_largest_never_rises() {
    for max_error in [0.0, 2.0] {
        let place = archipelago(max_error);
        let roots = place.layer.forest.root_diamonds().count();
        assert!(roots >= 3);
        for ask in questions(&place.layer) {
            let mut reader = Reader::new(&place.layer);
            let mut stream = stream(&place, &ask);
            let (mut largest, mut bytes, mut last, mut forced) = (f64::INFINITY, 0, None, 0);
            while let Some(frame) = stream.next_frame().unwrap() {
                assert!(reader.take(&frame.bytes).is_empty());
                bytes += frame.bytes.len() as u64;
                let Subject::Diamond(d) = frame.subject else { continue };
                if d.level() == 0 {
                    assert!(last.is_none(), "a root after a finer diamond");
                    continue;
                }
                // Where nothing limits the order, it is that of the errors alone, of equal ones the coarse first.
                let error = reader.entries[&d].error_metres;
                if ask.bbox.is_none() && ask.view.is_none() {
                    let before = last.unwrap_or((f32::INFINITY, 0));
                    assert!(
                        (before.0, d.level()) >= (error, before.1) || before.0 > error,
                        "{before:?} {d:?}"
                    );
                }
                last = Some((error, d.level()));
                forced += usize::from(reader.wanted(&ask, d).is_none());
                // In a view the test by half spaces passes boxes beyond its corners, whose parents may not pass.
                if ask.view.as_ref().is_none_or(|view| view.sides.is_empty()) {
                    let now = reader.drawn().filter_map(|d| reader.wanted(&ask, d)).fold(0.0, f64::max);
                    assert!(now <= largest, "{ask:?}: {now} after {largest}");
                    largest = now;
                }
            }
            println!(
                "{ask:?}: {bytes} bytes, {} diamonds, {forced} for their children's sake",
                reader.order.len()
            );
            assert!(stream.next_frame().unwrap().is_none(), "the end stays the end");
            assert!(ask.bbox.is_some() || ask.view.is_some() || forced == 0);
            let left = reader.drawn().filter(|d| reader.wanted(&ask, *d).is_some()).count();
            match ask.limit {
                None => assert_eq!(left, 0, "{ask:?}"),
                Some(limit) => assert!(left > 0 && bytes >= limit && bytes < limit + 20_000),
            }
            // Nothing is sent for nothing: each diamond is asked for, or a child of it is.
            for d in reader.order.iter().filter(|d| d.level() > 0 && reader.wanted(&ask, **d).is_none()) {
                let children = place.layer.forest.children(*d).into_iter().flatten();
                assert!(children.into_iter().any(|c| reader.split.contains(&c)), "{d:?} is for nobody");
            }
        }
    }
}

#[test]
fn every_prefix_is_within_the_error_that_it_declares_of_every_sample() {
    for max_error in [0.0, 2.0] {
        let place = archipelago(max_error);
        let source = ingest::open(&[place.folder.path().join("dem.raw")], &place.ingest).unwrap();
        let samples = Samples::read(&source);
        let (forest, verdict) = (place.layer.forest, Verdict::default());
        for ask in questions(&place.layer) {
            let mut reader = Reader::new(&place.layer);
            let mut blocks: HashMap<Diamond, Block> = HashMap::new();
            let mut stream = stream(&place, &ask);
            while let Some(frame) = stream.next_frame().unwrap() {
                reader.take(&frame.bytes);
                let Subject::Diamond(d) = frame.subject else { continue };
                // Decoded from what came before, and held at once to what the pages so far declare: each
                // triangle that this split adds is drawn until its own diamond comes.
                let mut block = Block::empty(&forest, d.level());
                for parent in forest.parents(d) {
                    block.inherit(&forest, d, parent, &blocks[&parent]);
                }
                points::decode(&forest, &place.layer.coding, d, &mut block, &reader.payloads[&d]).unwrap();
                let check = Check {
                    layer: &place.layer,
                    forest,
                    samples: &samples,
                    entries: &reader.entries,
                    verdict: &verdict,
                };
                check.split(d, &block);
                blocks.insert(d, block);
            }
        }
        let compared = verdict.compared.load(Ordering::Relaxed);
        let examples = verdict.examples.lock().unwrap().join("\n");
        assert_eq!(verdict.wrong.load(Ordering::Relaxed), 0, "{examples}");
        assert!(compared > 3 * u64::from(samples.width * samples.height), "{compared}");
    }
}

#[test]
fn every_prefix_covers_the_forest_once_without_cracks() {
    let place = archipelago(0.0);
    let Loaded { layer, entries, surfaces } = seams::load(&place.store, 0);
    let [low, high] = [layer.position([0, 0]), layer.position(layer.forest.size())];
    let eye = DVec3::new((low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, 60_000.0);
    let camera = Camera { eye, target: eye - DVec3::Z, fov_y: 2.7, size: [1380, 768] };
    let ask = Ask {
        layer: &layer,
        encoding: Encoding::Points,
        camera: &camera,
        exaggeration: 1.0,
        tolerance_pixels: 1e-9,
        sight: Sight::default(),
        seen: None,
        memory_bytes: usize::MAX,
        gpu: None,
    };
    let ideal = cut::choose(&ask, |d| Some(entries[&d]));
    for question in questions(&layer) {
        let (mut stream, mut reader, mut shared) = (stream(&place, &question), Reader::new(&layer), 0);
        let mut roots = 0;
        while let Some(frame) = stream.next_frame().unwrap() {
            reader.take(&frame.bytes);
            roots += usize::from(matches!(frame.subject, Subject::Diamond(d) if d.level() == 0));
            // Each prefix at first, then a tenth of them.
            if reader.order.len() > 40 && reader.order.len() % 10 != 0 {
                continue;
            }
            let arrived = |d| surfaces.get(&d).filter(|_| reader.split.contains(&d)).cloned();
            let drawing = cut::draw(0, &ask, &ideal, arrived);
            shared += assert_no_cracks(&layer, &drawing.items, false);
            let all_roots = roots == layer.forest.root_diamonds().filter(|r| !entries[r].is_empty()).count();
            assert_eq!(drawing.items.is_empty(), !all_roots, "something is drawn from the last root on");
            assert!(!all_roots || drawing.splits.len() == reader.order.len(), "all that arrived is drawn");
        }
        assert!(shared > 0, "{question:?}");
    }
}

/// A server of a store in a process of its own.
struct Process {
    child: std::process::Child,
    address: String,
}

impl Process {
    fn serve(store: &Path) -> Self {
        let mut child = Command::new(&programs().server)
            .args(["serve", "--listen", "127.0.0.1:0"])
            .arg(store)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let address = line.trim().rsplit_once("http://").unwrap().1.to_owned();
        Self { child, address }
    }

    /// Bytes that it has read so far, from files and sockets.
    fn bytes_read(&self) -> u64 {
        let text = std::fs::read_to_string(format!("/proc/{}/io", self.child.id())).unwrap();
        text.lines().find_map(|l| l.strip_prefix("rchar: ")).unwrap().parse().unwrap()
    }

    /// A number that the system tells of it.
    fn status(&self, name: &str) -> u64 {
        let text = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = text.lines().find_map(|l| l.strip_prefix(name)).unwrap();
        line.trim().trim_end_matches(" kB").parse().unwrap()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn readers_that_do_not_read_hold_neither_memory_nor_threads() {
    // Noise, so that an answer is larger than what the kernel takes off the server's hands: some 3 MB here.
    let folder = tempfile::tempdir().unwrap();
    let (dem, place) = (folder.path().join("dem.raw"), folder.path().join("store"));
    let ingest = write_raw(&dem, [2049, 2049], |x, y| {
        Some(Dice(u64::from(x) << 32 | u64::from(y)).below(1 << 14) as f32)
    });
    let report = build(&dem, &place, &ingest, &options());
    let answer = report.point_bytes + report.index_bytes;
    assert!(answer > 7_000_000, "{answer}");
    let process = Process::serve(&place);
    let route = stream_route("world", &report.scene.version, "terrain", &StreamAsk::default());
    let request = format!("GET {route} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n");
    const READERS: u64 = 60;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let before = (process.bytes_read(), process.status("VmHWM:") * 1024, process.status("Threads:"));
    let mut readers = runtime.block_on(async {
        use tokio::io::AsyncWriteExt;
        let mut readers = Vec::new();
        for _ in 0..READERS {
            let socket = tokio::net::TcpSocket::new_v4().unwrap();
            socket.set_recv_buffer_size(4096).unwrap();
            let mut reader = socket.connect(process.address.parse().unwrap()).await.unwrap();
            reader.write_all(request.as_bytes()).await.unwrap();
            readers.push(reader);
        }
        readers
    });
    // Until nothing moves any more, and threads that have nothing to do are gone.
    let (mut last, started) = (0, Instant::now());
    let stalled = |last| process.bytes_read() == last && process.status("Threads:") < before.2 + READERS / 4;
    while !stalled(last) && started.elapsed() < Duration::from_secs(60) {
        last = process.bytes_read();
        std::thread::sleep(Duration::from_millis(500));
    }
    let (read, memory) = (last - before.0, process.status("VmHWM:") * 1024 - before.1);
    let threads = process.status("Threads:");
    println!(
        "{READERS} readers of {answer} bytes: {} read and {} of memory for each, {threads} threads",
        read / READERS,
        memory / READERS
    );
    assert!(threads < before.2 + READERS / 4, "{threads} threads");
    assert!(read / READERS < answer * 2 / 3, "{} of {answer} bytes are made for who waits", read / READERS);
    // What the stream remembers, 0.4 MB that the HTTP library holds before it lets the body wait, and what the
    // allocator keeps of the threads that were busy at first.
    assert!(memory / READERS < answer / 4, "{} bytes of memory for each", memory / READERS);
    // Others are served meanwhile, and who begins to read gets all.
    let mut other = std::net::TcpStream::connect(&process.address).unwrap();
    other.write_all(request.as_bytes()).unwrap();
    let mut whole = Vec::new();
    other.read_to_end(&mut whole).unwrap();
    assert!(whole.len() as u64 > answer);
    runtime.block_on(async {
        use tokio::io::AsyncReadExt;
        let mut late = Vec::new();
        readers.pop().unwrap().read_to_end(&mut late).await.unwrap();
        let body = |bytes: &[u8]| bytes[bytes.windows(4).position(|w| w == b"\r\n\r\n").unwrap()..].to_vec();
        // Pieces are cut alike: the chunked bodies are the same.
        assert!(body(&late) == body(&whole));
    });
}

#[test]
fn of_a_hundred_thousand_diamonds_the_first_come_at_once_and_no_more_than_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let (dem, place) = (folder.path().join("dem.raw"), folder.path().join("store"));
    let ingest = write_raw(&dem, [2049, 1025], |x, y| {
        Some((f64::from(x) / 9.0).sin().mul_add(100.0, (f64::from(y) / 5.0).cos() * 70.0) as f32)
    });
    let report = build(&dem, &place, &ingest, &hierarchy::Options { patch_log2: 2, ..options() });
    assert!(report.diamonds > 100_000, "{}", report.diamonds);
    let store = Arc::new(Store::open(&place).unwrap());
    let layer = store.scene().layers[0].clone();
    let mut stream = Stream::new(Arc::clone(&store), 0, &layer, StreamAsk::default(), STREAM_MAX);
    let started = Instant::now();
    let mut piece = stream.next_piece(1).unwrap();
    let first = started.elapsed();
    let (mut reader, mut bytes) = (Reader::new(&layer), 0);
    let mut whole = first;
    while let Some(frames) = piece {
        let mut rest = frames.as_ref();
        while !rest.is_empty() {
            rest = reader.take(rest);
        }
        bytes += frames.len();
        let started = Instant::now();
        piece = stream.next_piece(16 << 10).unwrap();
        whole += started.elapsed();
    }
    println!("first {first:?}, all {whole:?}: {} diamonds, {bytes} bytes", reader.order.len());
    assert_eq!(reader.order.len(), STREAM_MAX);
    assert!(first < whole / 20, "{first:?} of {whole:?}");
}

#[test]
fn a_damaged_store_cuts_the_answer_off_where_it_is_damaged() {
    let place = archipelago(0.0);
    let mut whole = stream(&place, &StreamAsk::default());
    let mut order = Vec::new();
    while let Some(frame) = whole.next_frame().unwrap() {
        if let Subject::Diamond(d) = frame.subject {
            order.push(d);
        }
    }
    // The payload of a diamond in the middle gets a flipped bit; some have none.
    let find = |d: &Diamond| {
        let [a, b] = d.centre();
        place.store.get(Key { layer: 0, kind: Kind::Points, a, b }).unwrap()
    };
    let middle = order.len() / 2;
    let found = order[middle..].iter().enumerate().find_map(|(i, d)| Some((middle + i, find(d)?)));
    let (victim, payload) = found.unwrap();
    let pack = place.folder.path().join("store").join(&place.store.scene().version).join("pack-00000");
    let mut bytes = std::fs::read(&pack).unwrap();
    let at = bytes.windows(payload.len()).position(|w| w == payload).unwrap();
    bytes[at] ^= 1;
    std::fs::write(&pack, bytes).unwrap();
    let mut cut = stream(&place, &StreamAsk::default());
    let mut seen = Vec::new();
    let error = loop {
        match cut.next_frame() {
            Ok(frame) => match frame.unwrap().subject {
                Subject::Diamond(d) => seen.push(d),
                Subject::Page(_) => {}
            },
            Err(error) => break error.to_string(),
        }
    };
    assert_eq!(seen, order[..victim]);
    assert!(error.contains("checksum") && error.contains("pack-00000"), "{error}");
}

/// What is drawn of some split diamonds at each sample: NaN where nothing is.
fn surface(layer: &Layer, split: &[Diamond], blocks: &HashMap<Diamond, Block>) -> Vec<f64> {
    let [width, height] = layer.samples.map(i64::from);
    let mut values = vec![f64::NAN; (width * height) as usize];
    for d in split {
        let (local, block) = (layer.forest.local(*d), &blocks[d]);
        let n = block.segments() as i64;
        let height_at = |p: [i64; 2]| block.heights()[Block::slot(n as usize, p[0] as usize, p[1] as usize)];
        // Cells of old points, each cut into four by its centre, or in two where that is no point; coarse
        // diamonds first, so that finer ones overwrite what they split.
        for v in 0..n {
            for u in 0..n {
                let ring = [[2 * u, 2 * v], [2 * u + 2, 2 * v], [2 * u + 2, 2 * v + 2], [2 * u, 2 * v + 2]];
                let m = [2 * u + 1, 2 * v + 1];
                let rising = (u + v) % 2 == 0;
                let triangles: Vec<[[i64; 2]; 3]> = if block.has_centres() {
                    (0..4).map(|i| [ring[i], ring[(i + 1) % 4], m]).collect()
                } else if rising {
                    vec![[ring[0], ring[1], ring[2]], [ring[0], ring[2], ring[3]]]
                } else {
                    vec![[ring[0], ring[1], ring[3]], [ring[1], ring[2], ring[3]]]
                };
                for corners in triangles {
                    if !local.upper && corners.iter().any(|[p, q]| q > p) {
                        continue;
                    }
                    let places = corners.map(|p| local.lattice2(p));
                    let heights = corners.map(height_at);
                    fill(places, heights, [width, height], &mut values);
                }
            }
        }
    }
    values
}

/// Writes a triangle's plane at the samples in and on it. Corners without a height leave the sides between
/// the others.
fn fill(places: [[i64; 2]; 3], heights: [i32; 3], size: [i64; 2], values: &mut [f64]) {
    let [a, b, c] = places;
    let cross =
        |o: [i64; 2], p: [i64; 2], q: [i64; 2]| (p[0] - o[0]) * (q[1] - o[1]) - (p[1] - o[1]) * (q[0] - o[0]);
    let area = cross(a, b, c);
    let span = |k: usize| a[k].min(b[k]).min(c[k])..=a[k].max(b[k]).max(c[k]).min(size[k] - 1);
    for y in span(1) {
        for x in span(0) {
            let s = [x, y];
            let weights = [cross(b, c, s), cross(c, a, s), cross(a, b, s)].map(|w| w * area.signum());
            if weights.iter().any(|w| *w < 0) {
                continue;
            }
            let parts: Vec<(i64, i32)> = weights.into_iter().zip(heights).filter(|(w, _)| *w > 0).collect();
            let sum: f64 = parts.iter().map(|(w, h)| *w as f64 * f64::from(*h) / area.abs() as f64).sum();
            let known = parts.iter().all(|(_, h)| *h != NODATA);
            values[(y * size[0] + x) as usize] = if known { sum } else { f64::NAN };
        }
    }
}

#[test]
fn the_curve_tells_what_a_painter_finds_and_never_more_than_is_declared() {
    for max_error in [0.0, 3.0] {
        let place = archipelago(max_error);
        let layer = &place.layer;
        let rows = curve::curve(&place.store, 0, layer).unwrap();
        assert!(rows.len() > 20, "{}", rows.len());
        let slack = f64::from(layer.finest_error);
        for pair in rows.windows(2) {
            assert!(pair[0].bytes < pair[1].bytes && pair[0].diamonds < pair[1].diamonds);
            assert!(pair[0].declared > pair[1].declared);
        }
        // Declared errors are those of the samples; the finest surface is within `slack` of them.
        assert!(rows.iter().all(|r| r.max <= r.declared + slack + 1e-9 && r.rms <= r.max));
        let last = rows[rows.len() - 1];
        assert!(last.max <= 1e-9 && last.rms <= 1e-9 && (last.missing, last.surplus) == (0, 0), "{last:?}");
        assert_eq!(last.compared, layer.valid_samples);
        let compared = if max_error == 0.0 { "samples" } else { "finest surface" };
        assert!(curve::truth(layer).starts_with(compared));
        // A painter paints some prefixes over one another, coarse to fine, and looks at each sample.
        let mut stream = stream(&place, &StreamAsk::default());
        let (mut reader, mut blocks, mut bytes) = (Reader::new(layer), HashMap::new(), 0);
        let mut prefixes = HashMap::new();
        while let Some(frame) = stream.next_frame().unwrap() {
            reader.take(&frame.bytes);
            bytes += frame.bytes.len() as u64;
            let Subject::Diamond(d) = frame.subject else { continue };
            let mut block = Block::empty(&layer.forest, d.level());
            for parent in layer.forest.parents(d) {
                block.inherit(&layer.forest, d, parent, &blocks[&parent]);
            }
            points::decode(&layer.forest, &layer.coding, d, &mut block, &reader.payloads[&d]).unwrap();
            blocks.insert(d, block);
            prefixes.insert(reader.order.len() as u64, bytes);
        }
        let painted = |count: usize| {
            let mut split = reader.order[..count].to_vec();
            split.sort_by_key(|d| d.level());
            surface(layer, &split, &blocks)
        };
        let truth = painted(reader.order.len());
        for row in rows.iter().step_by(rows.len() / 12) {
            assert_eq!(prefixes[&row.diamonds], row.bytes);
            let now = painted(row.diamonds as usize);
            let (mut max, mut squares, mut compared, mut missing, mut surplus) = (0f64, 0.0, 0u64, 0, 0);
            for (truth, now) in truth.iter().zip(now) {
                match (now.is_nan(), truth.is_nan()) {
                    (false, false) => {
                        max = max.max((now - truth).abs());
                        squares += (now - truth) * (now - truth);
                        compared += 1;
                    }
                    (true, false) => missing += 1,
                    (false, true) => surplus += 1,
                    (true, true) => {}
                }
            }
            let rms = (squares / compared as f64).sqrt() * layer.quantum;
            println!("{row:?}: painted {max} {rms} {compared} {missing} {surplus}");
            assert_eq!((row.compared, row.missing, row.surplus), (compared, missing, surplus));
            assert!((row.max - max * layer.quantum).abs() <= 1e-9 * max, "{row:?} {max}");
            assert!((row.rms - rms).abs() <= 1e-6 * rms, "{row:?} {rms}");
        }
    }
}

/// Renders with the program; the report and the picture.
fn render(world: &World, name: &str, more: &[&str]) -> (serde_json::Value, Vec<u8>) {
    let (png, json) = (world.folder.path().join(name), world.folder.path().join("out.json"));
    let output = Command::new(&programs().client)
        .args(["render", &world.served.scene("world"), "--size", "640x360"])
        .args(more)
        .arg("-o")
        .arg(&png)
        .arg("--json")
        .arg(&json)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report = serde_json::from_slice(&std::fs::read(&json).unwrap()).unwrap();
    (report, std::fs::read(&png).unwrap())
}

#[test]
fn a_picture_from_a_stream_is_the_same_picture_in_one_round_trip() {
    let world = World::sample(1025, 0.0);
    // Low over the south, so that some is near, some far and some out of view.
    let [low, high] = headless::extent(&world.report.scene);
    let at = |x: f64, y: f64, z: f64| {
        let p = low + (high - low) * DVec3::new(x, y, 0.0);
        format!("{},{},{}", p.x, p.y, high.z + z)
    };
    let (eye, target) = (at(0.3, 0.1, 300.0), at(0.6, 0.6, -500.0));
    let view = ["--eye", &eye, "--target", &target];
    let (usual, picture) = render(&world, "usual.png", &view);
    let (streamed, same) = render(&world, "streamed.png", &[view.as_slice(), &["--stream"]].concat());
    println!("usual: {usual}\nstreamed: {streamed}");
    assert!(picture == same, "another picture");
    for key in ["complete", "largest_error_pixels", "triangles_drawn"] {
        assert_eq!(usual[key], streamed[key], "{key}");
    }
    assert_eq!(
        (&streamed["requests"], &streamed["round_trips"]),
        (&2.into(), &2.into()),
        "the scene and the stream"
    );
    // Its round trips may overlap, and then count as one: its requests do not.
    assert!(usual["requests"].as_u64() > Some(2));
    // A stream costs no more than what it replaces, but for the rounding of what is in view.
    let bytes = |report: &serde_json::Value| report["bytes"].as_f64().unwrap();
    assert!(bytes(&streamed) < 1.1 * bytes(&usual), "{} and {}", bytes(&streamed), bytes(&usual));
    // Where the eye is found from the terrain itself, more follows.
    let (usual, _) = render(&world, "usual.png", &[]);
    let (streamed, _) = render(&world, "streamed.png", &["--stream"]);
    println!("overview: usual: {usual}\nstreamed: {streamed}");
    assert!(streamed["complete"] == true && streamed["largest_error_pixels"].as_f64() <= Some(1.0));
    assert!(bytes(&streamed) < 1.2 * bytes(&usual));
}

#[test]
fn a_stream_cut_off_anywhere_is_completed_by_ordinary_requests() {
    let world = World::sample(1025, 0.0);
    // One connection brings the description and then the stream, if it is free again by then; else another one the stream.
    for first_cut_at in [9_000, 15_000, 30_000, 60_000] {
        let faults = Faults { first_cut_at: Some(first_cut_at), ..Faults::default() };
        let proxy = Proxy::start(&world.served.address, faults, 1);
        let options = terrain::Options { fetch: fetch::Options::default(), ..terrain::Options::default() };
        let mut terrain = Terrain::open(&format!("{}/scenes/world", proxy.address), options).unwrap();
        let camera = headless::overview(terrain.scene(), [640, 360]);
        terrain.stream(&camera);
        let view = terrain.settle(&camera, Duration::from_secs(60));
        assert!(view.complete && view.error_pixels <= 1.0, "{:?}", terrain.problem());
        let traffic = view.stats.traffic;
        println!("cut at {first_cut_at}: {traffic:?}");
        assert_eq!(proxy.faults_done.load(Ordering::Relaxed), 1, "the network behaved");
        assert!(traffic.errors > 0 && traffic.requests > 2);
        // What arrived is not fetched again.
        assert!(traffic.bytes < world.report.point_bytes + world.report.index_bytes + 100_000);
    }
}

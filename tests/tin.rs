//! The encoding `tin` of built stores: nothing is farther from the source than the index says, all borders fit, and
//! neither threads nor kills change a byte.
//!
//! Distances are found here anew, from payloads and `ingest` alone: each sample in a triangle is compared with its
//! plane, by whole numbers. A sample that no triangle covers, though the source's own mesh has it, lies as near to one.

use crate::determinism::files;
use crate::hostile::{assert_failed, end, server, signal, start, words};
use crate::truth::{Samples, dems};
use crate::world::{build, data, options, programs, serve};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::message::{self, FrameHeader, Layer, Status, TinLayer};
use diamantina_protocol::tin::{self, Patch, Vertex};
use diamantina_server::hierarchy::{self, TinOptions};
use diamantina_server::ingest::{self, CrsChoice};
use diamantina_server::store::{Key, Kind, Store};
use diamantina_server::tin::Metric;
use diamantina_server::{inspect, sample};
use rayon::prelude::*;
use std::collections::HashMap;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

/// Samples without a triangle of which a patch is asked how near they are: each takes a walk through it.
const ASKED_MAX: usize = 40;

fn twice(a: [i64; 2], b: [i64; 2], c: [i64; 2]) -> i64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

fn flat(v: Vertex) -> [i64; 2] {
    [v.x.into(), v.y.into()]
}

/// Which samples of a rectangle lie in a triangle.
struct Covered {
    low: [u32; 2],
    columns: u32,
    set: Vec<bool>,
}

impl Covered {
    fn new([low, high]: [[u32; 2]; 2]) -> Self {
        let columns = high[0] - low[0] + 1;
        Self { low, columns, set: vec![false; (columns * (high[1] - low[1] + 1)) as usize] }
    }

    fn place(&self, [x, y]: [u32; 2]) -> usize {
        ((y - self.low[1]) * self.columns + x - self.low[0]) as usize
    }

    fn at(&self, p: [u32; 2]) -> bool {
        self.set[self.place(p)]
    }

    fn set(&mut self, p: [u32; 2]) {
        let place = self.place(p);
        self.set[place] = true;
    }
}

/// A store with the samples that it was made of.
struct Check<'a> {
    store: &'a Store,
    layer: &'a Layer,
    tin: &'a TinLayer,
    samples: &'a Samples,
    entries: HashMap<Diamond, Entry>,
}

impl Check<'_> {
    fn patch(&self, d: Diamond) -> Patch {
        let [a, b] = d.centre();
        let payload = self.store.get(Key { layer: 0, kind: Kind::Tin, a, b }).unwrap().unwrap_or_default();
        assert_eq!(payload.len(), self.entries[&d].bytes as usize);
        tin::decode(&self.tin.forest, d, &payload).unwrap()
    }

    /// The error declared of a child triangle of a diamond.
    fn declared(&self, d: Diamond, child: usize) -> Option<f32> {
        if d.level() + 1 == self.tin.forest.levels() {
            return Some(self.tin.finest_error);
        }
        Some(self.entries[&self.tin.forest.children(d)[child]?].error_metres)
    }

    /// What is wrong with a diamond's payload, given how much errors count.
    fn wrong(&self, d: Diamond, share: f64) -> Option<String> {
        let patch = self.patch(d);
        let [low, high] = self.tin.forest.bounds(d);
        let entry = self.entries[&d];
        let mut covered = Covered::new([low, high]);
        for child in 0..4 {
            let Some(declared) = self.declared(d, child) else { continue };
            let error = f64::from(declared) * share;
            for t in &patch.triangles[patch.range(child)] {
                let corners = t.map(|v| patch.vertices[v as usize]);
                if corners.iter().any(|v| !(entry.low..=entry.high).contains(&v.height)) {
                    return Some(format!("{corners:?} beyond the range of {d:?}"));
                }
                let off = self.distance(corners, &mut covered);
                if off.is_none_or(|off| off > error + 1e-9) {
                    return Some(format!("{off:?} m from {corners:?} of {d:?}, declared {declared}"));
                }
            }
        }
        let missing = (low[1]..=high[1]).flat_map(|y| (low[0]..=high[0]).map(move |x| [x, y]));
        let missing = missing.filter(|p| !covered.at(*p) && self.is_meshed(*p) && self.is_inside(d, *p));
        let worst = (0..4).filter_map(|child| self.declared(d, child)).fold(0.0, f32::max);
        let neighbours = self.around(d, &patch);
        let found: Vec<[u32; 2]> = missing.collect();
        let step = found.len().div_ceil(ASKED_MAX).max(1);
        let far = found.into_iter().step_by(step).find(|p| !self.is_near(*p, &neighbours, f64::from(worst)));
        far.map(|p| format!("a sample at {p:?} of {d:?} is farther than {worst} m from any triangle"))
    }

    /// The triangles of a diamond, and those beyond its sides that stand or fall with them.
    fn around(&self, d: Diamond, patch: &Patch) -> Vec<[Vertex; 3]> {
        let corners = |patch: &Patch| -> Vec<[Vertex; 3]> {
            patch.triangles.iter().map(|t| t.map(|v| patch.vertices[v as usize])).collect()
        };
        let mut all = corners(patch);
        for child in self.tin.forest.children(d).into_iter().flatten() {
            for parent in self.tin.forest.parents(child).filter(|p| *p != d) {
                all.extend(corners(&self.patch(parent)));
            }
        }
        all
    }

    fn is_inside(&self, d: Diamond, [x, y]: [u32; 2]) -> bool {
        let local = self.tin.forest.local(d);
        let way = [i64::from(x) - local.origin[0], i64::from(y) - local.origin[1]];
        let dot = |a: [i64; 2], b: [i64; 2]| a[0] * b[0] + a[1] * b[1];
        let (p, q) = (dot(way, local.u), dot(way, local.v));
        let side = self.tin.forest.segments_at(d.level()) as i64 * dot(local.u, local.u);
        // Samples on the sides may belong to triangles beyond them alone.
        (1..side).contains(&p) && (1..side).contains(&q) && (local.upper || q < p)
    }

    /// Whether a sample is a corner of some triangle of the source's own mesh.
    fn is_meshed(&self, [x, y]: [u32; 2]) -> bool {
        let (x, y) = (i64::from(x), i64::from(y));
        let has = |dx: i64, dy: i64| x + dx >= 0 && y + dy >= 0 && !self.samples.at(x + dx, y + dy).is_nan();
        if !has(0, 0) {
            return false;
        }
        let ring = [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]];
        (0..8).any(|i| {
            let (a, b): ([i64; 2], [i64; 2]) = (ring[i], ring[(i + 1) % 8]);
            // Where coordinates sum to an odd number no diagonal meets, and triangles span a quarter of the ring.
            if (x + y) % 2 == 0 {
                has(a[0], a[1]) && has(b[0], b[1])
            } else {
                let c = ring[(i + 2) % 8];
                i % 2 == 0 && has(a[0], a[1]) && has(c[0], c[1])
            }
        })
    }

    /// The largest distance between a triangle and the samples in it, in metres; `None` if one has no data.
    fn distance(&self, corners: [Vertex; 3], covered: &mut Covered) -> Option<f64> {
        let [a, b, c] = corners.map(flat);
        let doubled = twice(a, b, c);
        let (xs, ys) = (corners.map(|v| v.x), corners.map(|v| v.y));
        let mut worst = 0.0f64;
        for y in *ys.iter().min()?..=*ys.iter().max()? {
            for x in *xs.iter().min()?..=*xs.iter().max()? {
                let p = [i64::from(x), i64::from(y)];
                let shares = [twice(b, c, p), twice(c, a, p), twice(a, b, p)];
                if shares.iter().any(|s| *s < 0) {
                    continue;
                }
                let sample = self.samples.at(p[0], p[1]);
                if sample.is_nan() {
                    return None;
                }
                let sum: i128 = (0..3).map(|i| i128::from(shares[i]) * i128::from(corners[i].height)).sum();
                let drawn = sum as f64 / doubled as f64 * self.layer.quantum;
                worst = worst.max((drawn - sample).abs());
                covered.set([x, y]);
            }
        }
        Some(worst)
    }

    fn is_near(&self, [x, y]: [u32; 2], triangles: &[[Vertex; 3]], metres: f64) -> bool {
        let [cx, cy] = self.layer.cell;
        let at = |v: Vertex| [(f64::from(v.x) - f64::from(x)) * cx, (f64::from(v.y) - f64::from(y)) * cy];
        triangles.iter().any(|t| {
            (0..3).any(|i| {
                let (p, q) = (at(t[i]), at(t[(i + 1) % 3]));
                let along = [q[0] - p[0], q[1] - p[1]];
                let share =
                    -(p[0] * along[0] + p[1] * along[1]) / (along[0] * along[0] + along[1] * along[1]);
                let share = share.clamp(0.0, 1.0);
                (p[0] + share * along[0]).hypot(p[1] + share * along[1]) <= metres + 1e-9
            })
        })
    }
}

/// All that is wrong with a store's triangles, given how much errors of a level count.
fn judge(store: &Store, samples: &Samples, share: impl Fn(u32) -> f64 + Sync) -> Vec<String> {
    let layer = &store.scene().layers[0];
    let tin = layer.tin.as_ref().unwrap();
    let mut entries = HashMap::new();
    for page in 0..index::pages(&tin.forest) {
        entries.extend(inspect::read_page(store, 0, layer, Kind::TinIndex, page).unwrap());
    }
    let check = Check { store, layer, tin, samples, entries };
    for level in 0..tin.forest.levels() {
        for d in tin.forest.diamonds(level) {
            for child in tin.forest.children(d).into_iter().flatten() {
                assert!(check.entries[&d].error_metres >= check.entries[&child].error_metres, "{d:?}");
            }
        }
    }
    let all: Vec<Diamond> = (0..tin.forest.levels()).flat_map(|level| tin.forest.diamonds(level)).collect();
    all.par_iter().filter_map(|d| check.wrong(*d, share(d.level() + 1))).collect()
}

fn check(dem: &Path, ingest: &ingest::Options, tin: TinOptions, max_error: f64) {
    let folder = tempfile::tempdir().unwrap();
    let options = hierarchy::Options { max_error, points: false, tin: Some(tin), ..options() };
    build(dem, folder.path(), ingest, &options);
    let store = Store::open(folder.path()).unwrap();
    let samples = Samples::read(&ingest::open(&[dem.to_owned()], ingest).unwrap());
    let wrong = judge(&store, &samples, |_| 1.0);
    assert!(
        wrong.is_empty(),
        "{}: {} wrong: {:#?}",
        dem.display(),
        wrong.len(),
        &wrong[..wrong.len().min(5)]
    );
    // No cracks, nothing missing, nothing too much.
    let found = inspect::inspect(&store, true).unwrap();
    let counted: u64 = found.layers[0].tin.as_ref().unwrap().levels.iter().filter_map(|l| l.triangles).sum();
    assert_eq!(counted, store.scene().layers[0].tin.as_ref().unwrap().triangles);
}

fn small() -> TinOptions {
    TinOptions { patch_triangles: 256, ..TinOptions::default() }
}

#[test]
fn every_sample_of_real_dems_is_within_the_declared_error_and_borders_fit() {
    let Some(folder) = data() else { return };
    // Whole ones, ragged outlines, seas, voids.
    let chosen = ["jacksboro", "dtm.tif", "4_msh1013", "OK03", "qgis_training", "SainteHelens"];
    let mut seen = 0;
    for (dem, ingest) in dems(&folder) {
        if chosen.iter().any(|name| dem.to_string_lossy().contains(name)) {
            check(&dem, &ingest, small(), 0.0);
            seen += 1;
        }
    }
    assert_eq!(seen, chosen.len());
}

/// Minutes to an hour: as a reader asks for it, and for docs/BENCHMARKS.md.
#[test]
#[ignore = "builds and compares every DEM of the data: too long for each change; `make test-long` runs it"]
fn every_sample_of_every_real_dem_is_within_the_declared_error_of_triangles() {
    let Some(folder) = data() else { return };
    let mut all = dems(&folder);
    // The largest come last.
    all.sort_by_key(|(dem, _)| std::fs::metadata(dem).unwrap().len());
    for (dem, ingest) in &all {
        for max_error in [0.0, 1.0] {
            let started = Instant::now();
            check(dem, ingest, TinOptions::default(), max_error);
            println!("{}, within {max_error} m: {:.0?}", dem.display(), started.elapsed());
        }
    }
    assert!(!all.is_empty());
}

#[test]
fn too_little_memory_for_an_error_at_each_collapse_is_refused_before_anything_is_done() {
    let folder = tempfile::tempdir().unwrap();
    let dem = folder.path().join("dem.raw");
    std::fs::write(&dem, vec![0; 2 * 4097 * 4097]).unwrap();
    let arguments =
        "build {}/dem.raw --raw 4097x4097:i16 --cell 30 -o {}/store --encoding tin --patch-error 5";
    let refused = server(folder.path(), &format!("{arguments} --memory 127MiB"));
    let wanted = ["--patch-error", "--memory 129MiB", "--patch-triangles", "4097 x 4097"];
    assert_failed(&refused, 2, &wanted, "an error at each collapse in too little memory");
    assert!(!folder.path().join("store").exists(), "something was written");
}

#[test]
fn other_rules_keep_the_declared_error_as_well() {
    let Some(folder) = data() else { return };
    let dem = folder.join("sthelens_dome/4_msh1013_83.tif");
    let ingest = ingest::Options { crs: CrsChoice::Source, ..ingest::Options::default() };
    check(&dem, &ingest, TinOptions { metric: Metric::Quadric, ..small() }, 0.0);
    check(&dem, &ingest, TinOptions { lambda: 0.0, ..small() }, 0.5);
    check(&dem, &ingest, TinOptions { patch_error: Some(0.25), ..small() }, 0.1);
}

#[test]
fn a_made_archipelago_keeps_the_declared_error() {
    let folder = tempfile::tempdir().unwrap();
    let dem = folder.path().join("dem.raw");
    let ingest = crate::world::write_raw(&dem, [700, 300], crate::seams::islands);
    check(&dem, &ingest, small(), 0.0);
    check(&dem, &ingest, TinOptions { patch_triangles: 64, ..small() }, 2.0);
}

#[test]
fn an_error_declared_a_tenth_too_small_would_be_found_at_every_level() {
    let folder = tempfile::tempdir().unwrap();
    let (dem, store) = (folder.path().join("dem.raw"), folder.path().join("store"));
    let ingest = crate::world::write_raw(&dem, [257, 257], |x, y| {
        Some((f64::from(x) / 9.0).sin().mul_add(100.0, (f64::from(y) / 5.0).cos() * 70.0) as f32)
    });
    build(&dem, &store, &ingest, &hierarchy::Options { points: false, tin: Some(small()), ..options() });
    let samples = Samples::read(&ingest::open(&[dem], &ingest).unwrap());
    let store = Store::open(&store).unwrap();
    let forest = store.scene().layers[0].tin.as_ref().unwrap().forest;
    assert!(judge(&store, &samples, |_| 1.0).is_empty());
    for level in 1..forest.levels() {
        assert!(!judge(&store, &samples, |l| if l == level { 0.9 } else { 1.0 }).is_empty(), "level {level}");
    }
}

#[test]
fn neither_threads_nor_memory_nor_kills_change_a_byte_of_triangles() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    sample::write(&folder.join("dem.tif"), 700).unwrap();
    let build = "build {}/dem.tif --scene same --encoding points,tin --checkpoint 0";
    let ended = server(folder, &format!("{build} -o {{}}/unbroken --threads 1"));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let expected = files(&folder.join("unbroken"));
    let ended = server(folder, &format!("{build} -o {{}}/other --threads 4 --memory 400MiB"));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(expected == files(&folder.join("other")), "threads or memory changed something");
    // Killed again and again, each time a little further on.
    let journal = folder.join("broken/.building/journal");
    let length = || std::fs::metadata(&journal).map_or(0, |m| m.len());
    let command = format!("{build} -o {{}}/broken --threads 2");
    let mut kills = 0;
    for _ in 0..6 {
        let (before, started) = (length(), Instant::now());
        let mut child = start(&programs().server, &words(folder, &command));
        let ended_by_itself = loop {
            if child.try_wait().unwrap().is_some() {
                break true;
            }
            assert!(started.elapsed() < Duration::from_secs(120), "the journal does not grow");
            if length() > before + 4000 {
                break false;
            }
            std::thread::sleep(Duration::from_millis(1));
        };
        if ended_by_itself {
            end(child);
            break;
        }
        signal(&child, "KILL");
        kills += usize::from(end(child).code.is_none());
    }
    assert!(kills >= 3, "killed {kills} times");
    let ended = server(folder, &command);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(expected == files(&folder.join("broken")), "kills changed something");
}

#[test]
fn triangles_are_served_and_what_is_not_built_is_refused() {
    let scratch = tempfile::tempdir().unwrap();
    let dem = scratch.path().join("dem.tif");
    sample::write(&dem, 513).unwrap();
    let plain = ingest::Options::default();
    let stores = ["both", "tin", "points"].map(|name| scratch.path().join(name));
    for (store, points, tin) in
        [(&stores[0], true, true), (&stores[1], false, true), (&stores[2], true, false)]
    {
        let name = store.file_name().unwrap().to_str().unwrap();
        let tin = tin.then(small);
        let options = hierarchy::Options { points, tin, ..hierarchy::Options::new(name) };
        build(&dem, store, &plain, &options);
    }
    let served = serve(&stores);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let client = crate::world::asker().build().unwrap();
    let get = |route: &str| {
        runtime.block_on(async {
            let answer = client.get(format!("{}{route}", served.address)).send().await.unwrap();
            (answer.status().as_u16(), answer.bytes().await.unwrap())
        })
    };
    let store = Store::open(&stores[0]).unwrap();
    let (scene, layer) = (store.scene(), &store.scene().layers[0]);
    assert_eq!(layer.encodings, ["points", "tin"]);
    let forest = layer.tin.as_ref().unwrap().forest;
    let (status, page) = get(&message::tin_index_route("both", &scene.version, &layer.name, 0));
    assert_eq!(status, 200);
    let page = zstd::bulk::decompress(&page, 4 * index::PAGE_BYTES_MAX).unwrap();
    let entries = index::decode(&forest, 0, &page).unwrap();
    let centres: Vec<[u32; 2]> =
        entries.iter().filter(|(_, e)| e.bytes > 0).map(|(d, _)| d.centre()).take(30).collect();
    let (status, batch) = get(&message::tin_batch_route("both", &scene.version, &layer.name, &centres));
    assert_eq!(status, 200);
    let mut rest = &batch[..];
    let mut frames = 0;
    while let Some((header, used)) = FrameHeader::read(rest).unwrap() {
        let payload = &rest[used..used + header.length as usize];
        assert!(header.status == Status::Ok && header.checksum == message::checksum(payload));
        let d = forest.diamond(header.centre).unwrap();
        let patch = tin::decode(&forest, d, payload).unwrap();
        assert!(patch.vertices.iter().all(|v| v.height != NODATA));
        let (_, alone) = get(&message::tin_route("both", &scene.version, &layer.name, header.centre));
        assert_eq!(alone, payload);
        rest = &rest[used + payload.len()..];
        frames += 1;
    }
    assert_eq!(frames, centres.len());
    // What a layer has not is refused in words.
    let version = |i: usize| Store::open(&stores[i]).unwrap().scene().version.clone();
    for (route, word) in [
        (message::tin_index_route("points", &version(2), "terrain", 0), "no triangles"),
        (message::tin_route("points", &version(2), "terrain", centres[0]), "no triangles"),
        (message::index_route("tin", &version(1), "terrain", 0), "no points"),
        (message::points_route("tin", &version(1), "terrain", centres[0]), "no points"),
        ("/scenes/tin/terrain/height?x=100&y=100".to_owned(), "no points"),
        (format!("/scenes/tin/{}/terrain/stream?error=5", version(1)), "no points"),
    ] {
        let (status, body) = get(&route);
        assert_eq!(status, 404, "{route}");
        assert!(String::from_utf8_lossy(&body).contains(word), "{route}: {body:?}");
    }
    let polygon = scratch.path().join("zone.geojson");
    std::fs::write(
        &polygon,
        r#"{"type":"Polygon","coordinates":[[[900,900],[1500,900],[900,1500],[900,900]]]}"#,
    )
    .unwrap();
    let words = ["--name", "z", "--eye", "3", "--coordinates", "frame", "--polygon"];
    let output =
        Command::new(&programs().server).arg("zone").arg(&stores[1]).args(words).arg(&polygon).output();
    let said = String::from_utf8(output.unwrap().stderr).unwrap();
    assert!(said.contains("terrain has no points") && said.contains("--encoding points"), "{said}");
    // The same ground, with the same errors, whatever else is in the store.
    let alone = Store::open(&stores[1]).unwrap();
    assert_eq!(alone.scene().layers[0].tin, layer.tin);
}

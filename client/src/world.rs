//! A small scene made by code, and a server of it that can misbehave: for the tests of this crate.

use crate::camera::{Camera, FOV_Y};
use crate::drawing::DrawItem;
use crate::encoding::Encoding;
use crate::surface::Surface;
use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{Path, Query, RawQuery, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::index::{self, Entry};
use diamantina_protocol::message::{
    self, Catalogue, Frame, FrameHeader, Kind, Layer, Scene, Status, StreamAsk, TinLayer,
};
use diamantina_protocol::points::{self, Coding, Rule};
use diamantina_protocol::series::Series;
use diamantina_protocol::sight;
use diamantina_protocol::texture::Texture;
use diamantina_protocol::tin::{self, Patch};
use glam::DVec3;
use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

/// A layer with all that a store would have of it.
pub(crate) struct Built {
    pub(crate) layer: Layer,
    pub(crate) entries: HashMap<Diamond, Entry>,
    pub(crate) payloads: HashMap<Diamond, Vec<u8>>,
    /// Parents before children.
    pub(crate) diamonds: Vec<Diamond>,
    /// The same as irregular triangles, if it is offered so.
    pub(crate) tin: Option<BuiltTin>,
}

/// What a store would have of a layer's irregular triangles.
pub(crate) struct BuiltTin {
    /// As it is streamed.
    pub(crate) layer: Layer,
    pub(crate) entries: HashMap<Diamond, Entry>,
    pub(crate) payloads: HashMap<Diamond, Vec<u8>>,
    /// Parents before children.
    pub(crate) diamonds: Vec<Diamond>,
}

impl Built {
    fn entries_of(&self, encoding: Encoding) -> (&Forest, &HashMap<Diamond, Entry>) {
        match (encoding, &self.tin) {
            (Encoding::Tin, Some(tin)) => (&tin.layer.forest, &tin.entries),
            _ => (&self.layer.forest, &self.entries),
        }
    }

    fn payloads_of(&self, encoding: Encoding) -> (&Forest, &HashMap<Diamond, Vec<u8>>) {
        match (encoding, &self.tin) {
            (Encoding::Tin, Some(tin)) => (&tin.layer.forest, &tin.payloads),
            _ => (&self.layer.forest, &self.payloads),
        }
    }
}

/// Hills with a coast in the east, a round lake without data, and a margin without data in the north.
fn hills(x: u32, y: u32) -> i32 {
    let (fx, fy) = (f64::from(x), f64::from(y));
    let coast = 880.0 + 60.0 * (fy / 37.0).sin();
    let lake = (fx - 300.0).hypot(fy - 200.0) < 70.0;
    if fx > coast || lake || y > 490 {
        return NODATA;
    }
    relief(x, y)
}

/// The same hills with outlines that every level's cells follow, as those of simplified triangles do: a square lake, and
/// straight coasts.
fn blocks(x: u32, y: u32) -> i32 {
    let lake = (193..320).contains(&x) && (129..256).contains(&y);
    if lake || x > 832 || y > 448 { NODATA } else { relief(x, y) }
}

fn relief(x: u32, y: u32) -> i32 {
    let (fx, fy) = (f64::from(x), f64::from(y));
    let noise = (x.wrapping_mul(374_761_393) ^ y.wrapping_mul(668_265_263)).wrapping_mul(1_274_126_177) >> 24;
    let hills = 900.0 * (fx / 90.0).sin() * (fy / 70.0).cos() + 240.0 * (fx / 13.0).cos() * (fy / 17.0).sin();
    (hills + 3000.0) as i32 + (noise % 40) as i32
}

fn pond(x: u32, y: u32) -> i32 {
    if (f64::from(x) - 150.0).hypot(f64::from(y) - 100.0) < 40.0 { 2900 + (x / 8) as i32 } else { NODATA }
}

/// A wave that is farther in the east with each step, over all of the west.
fn wave<const STEP: u32>(x: u32, y: u32) -> i32 {
    let from_crest = (f64::from(x) - 20.0 - 25.0 * f64::from(STEP)) / 8.0;
    3000 + (600.0 * (-from_crest * from_crest).exp() * (1.0 + f64::from(y) / 200.0)) as i32
}

/// Steps of the series of waves.
pub(crate) const WAVES: usize = 4;

/// Layers before the first of them.
pub(crate) const BEFORE_WAVES: usize = 2;

fn forest(root_log2: u8, patch_log2: u8, roots: [u32; 2], precision: u8) -> Forest {
    Forest::new(root_log2, patch_log2, roots).unwrap().with_precision(precision).unwrap()
}

/// The scene, made once: terrain of 1024 x 512 cells with two root squares, a pond, and the steps of a series of waves.
pub(crate) fn world() -> &'static [Built] {
    static WORLD: OnceLock<Vec<Built>> = OnceLock::new();
    WORLD.get_or_init(|| {
        vec![
            with_tin(
                build("terrain", Kind::Terrain, forest(9, 4, [2, 1], 2), [10.0, 10.0], hills),
                forest(9, 3, [2, 1], 0),
                blocks,
            ),
            build("water", Kind::Water, forest(9, 3, [1, 1], 1), [10.0, 10.0], pond),
            build("waves.0", Kind::Water, forest(7, 3, [1, 1], 0), [40.0, 40.0], wave::<0>),
            build("waves.1", Kind::Water, forest(7, 3, [1, 1], 0), [40.0, 40.0], wave::<1>),
            build("waves.2", Kind::Water, forest(7, 3, [1, 1], 0), [40.0, 40.0], wave::<2>),
            build("waves.3", Kind::Water, forest(7, 3, [1, 1], 0), [40.0, 40.0], wave::<3>),
        ]
    })
}

/// So many layers of it; those beyond terrain and pond are a series, with a step each 10 seconds.
pub(crate) fn scene(layers: usize) -> Scene {
    let waves = world()[..layers].iter().skip(BEFORE_WAVES).map(|built| built.layer.name.clone());
    let waves = Series { name: "waves".into(), layers: waves.collect(), step_seconds: 10.0 };
    Scene {
        name: "hills".into(),
        version: "v1".into(),
        frame: Frame { crs: None, vertical_unit: "metre".into() },
        layers: world()[..layers].iter().map(|built| built.layer.clone()).collect(),
        zones: Vec::new(),
        textures: Vec::new(),
        series: if waves.layers.is_empty() { Vec::new() } else { vec![waves] },
    }
}

fn build(name: &str, kind: Kind, forest: Forest, cell: [f64; 2], height: fn(u32, u32) -> i32) -> Built {
    let levels = forest.levels();
    // All that is past the lattice, and some of what is on it, corrects.
    let lattice = forest.lattice_levels();
    let exponent = |l: u32| (levels - l.max(lattice)) + (lattice.saturating_sub(l) / 4).min(2);
    let exponents = (0..=levels).map(|l| exponent(l) as u8).collect();
    let coding = Coding::new(Rule::Smooth, 3, exponents).unwrap();
    let quantum = 0.1;
    let diamonds: Vec<Diamond> = (0..levels).flat_map(|l| forest.diamonds(l)).collect();
    let mut blocks: HashMap<Diamond, Block> = HashMap::new();
    let (mut payloads, mut entries) = (HashMap::new(), HashMap::new());
    for d in &diamonds {
        let (mut block, mut source) = (Block::empty(&forest, d.level()), Block::empty(&forest, d.level()));
        for parent in forest.parents(*d) {
            block.inherit(&forest, *d, parent, &blocks[&parent]);
        }
        source.fill(&forest.local(*d), height);
        let before = block.clone();
        payloads.insert(*d, points::encode(&forest, &coding, *d, &mut block, &source));
        entries.insert(*d, entry(&before, &block, &source, d.level() == 0, quantum, payloads[d].len()));
        blocks.insert(*d, block);
    }
    // Errors of a split and of all below add up to a bound; ranges and bytes of children are within.
    let finest_error = (1.0 * quantum) as f32;
    for d in diamonds.iter().rev() {
        let mut entry = entries[d];
        let mut below = finest_error;
        for child in forest.children(*d).into_iter().flatten().map(|c| entries[&c]) {
            below = below.max(child.error_metres);
            if !child.is_empty() {
                let is_empty = entry.is_empty();
                entry.low = if is_empty { child.low } else { entry.low.min(child.low) };
                entry.high = if is_empty { child.high } else { entry.high.max(child.high) };
            }
        }
        entry.error_metres = index::declared(entry.error_metres + below);
        if entry.is_empty() {
            entry = Entry::EMPTY;
        }
        entries.insert(*d, entry);
    }
    let layer = Layer {
        name: name.into(),
        kind,
        forest,
        origin: [500_000.0, 4_000_000.0],
        cell,
        samples: forest.size().map(|s| s + 1),
        valid_samples: 1,
        quantum,
        height_offset: 12.5,
        heights: [0.0, 500.0],
        max_error: 0.1,
        finest_error,
        encodings: vec!["points".into()],
        coding,
        bytes: payloads.values().map(|p| p.len() as u64).sum(),
        resampled: false,
        errors: "bound".into(),
        tin: None,
    };
    Built { layer, entries, payloads, diamonds, tin: None }
}

/// The same layer offered as irregular triangles, too.
fn with_tin(built: Built, forest: Forest, height: fn(u32, u32) -> i32) -> Built {
    let quantum = built.layer.quantum;
    let diamonds: Vec<Diamond> = (0..forest.levels()).flat_map(|l| forest.diamonds(l)).collect();
    let (mut payloads, mut entries) = (HashMap::new(), HashMap::<Diamond, Entry>::new());
    let mut dice = Dice(77);
    for d in diamonds.iter().rev() {
        let regular = Patch::regular(&forest, *d, forest.segments(), |[x, y]| {
            Some(height(x, y)).filter(|h| *h != NODATA)
        });
        let is_finest = d.level() + 1 == forest.levels();
        let patch = if is_finest { regular } else { thinned(&forest, *d, &regular, &mut dice) };
        let payload = tin::encode(&forest, *d, &patch).unwrap();
        // Whatever is drawn lies within the range of heights.
        let children: Vec<Entry> = forest
            .children(*d)
            .into_iter()
            .flatten()
            .map(|c| entries[&c])
            .filter(|e| !e.is_empty())
            .collect();
        let lows = patch.vertices.iter().map(|v| v.height).chain(children.iter().map(|e| e.low));
        let highs = patch.vertices.iter().map(|v| v.height).chain(children.iter().map(|e| e.high));
        let entry = match (lows.min(), highs.max()) {
            (Some(low), Some(high)) => {
                let below = children.iter().map(|e| e.error_metres).fold(0.0, f32::max);
                let error_metres = index::declared((f64::from(high - low) * quantum) as f32).max(below);
                Entry { error_metres, low, high, bytes: payload.len() as u32 }
            }
            _ => Entry::EMPTY,
        };
        entries.insert(*d, entry);
        payloads.insert(*d, payload);
    }
    let offer = TinLayer {
        forest,
        finest_error: 0.0,
        triangles: 0,
        bytes: payloads.values().map(|p| p.len() as u64).sum(),
        patch_triangles: 0,
        borders: Vec::new(),
        metric: "none".into(),
        lambda: 1.0,
        patch_error: None,
        errors: "bound".into(),
    };
    let encodings = vec!["points".into(), "tin".into()];
    let layer = Layer { encodings, tin: Some(offer), ..built.layer };
    let streamed = Encoding::Tin.layer(&layer).unwrap();
    Built { layer, tin: Some(BuiltTin { layer: streamed, entries, payloads, diamonds }), ..built }
}

/// A regular patch in which some cells, off the diagonals, have two triangles rather than four, cut at random.
fn thinned(forest: &Forest, d: Diamond, regular: &Patch, dice: &mut Dice) -> Patch {
    let local = forest.local(d);
    let mut around: HashMap<u32, Vec<[u32; 3]>> = HashMap::new();
    for triangle in &regular.triangles {
        around.entry(triangle[2]).or_default().push(*triangle);
    }
    let turns: HashMap<u32, f64> =
        (0..regular.vertices.len() as u32).map(|middle| (middle, dice.roll())).collect();
    let mut patch = Patch { vertices: regular.vertices.clone(), ..Patch::default() };
    for child in 0..4 {
        for triangle in &regular.triangles[regular.range(child)] {
            // Of a cell's triangles, whose third vertex is its middle, the first ones come in the order of their sides.
            let cell = &around[&triangle[2]];
            let middle = regular.vertices[triangle[2] as usize];
            let [p, q] = local.local2([i64::from(middle.x), i64::from(middle.y)]);
            let n = forest.segments() as i64;
            let diagonal = p == q || p + q == 2 * n;
            let is_first = cell.first() == Some(triangle);
            let turn = turns[&triangle[2]];
            if diagonal || cell.len() < 4 || turn < 0.4 {
                patch.triangles.push(*triangle);
            } else if is_first {
                let [a, b, c, d] = std::array::from_fn(|side| cell[side][0]);
                patch.triangles.extend(if turn < 0.7 {
                    [[a, b, c], [a, c, d]]
                } else {
                    [[b, c, d], [b, d, a]]
                });
            }
        }
        patch.ends[child] = patch.triangles.len() as u32;
    }
    patch
}

/// What one split changes at most, and the range of heights.
fn entry(before: &Block, after: &Block, source: &Block, root: bool, quantum: f64, bytes: usize) -> Entry {
    let n = after.segments();
    let (old, new) = before.parts();
    let (old, _) = if root { after.parts() } else { (old, new) };
    let (mut most, mut rows) = (0, 0..n);
    if before.parts().1.iter().any(|h| *h != NODATA) || !after.has_centres() {
        // Past the lattice known points move, and that is all.
        rows = 0..0;
        let moves = before.parts().1.iter().zip(after.parts().1).filter(|(a, _)| **a != NODATA);
        most = moves.map(|(a, b)| (a - b).abs()).max().unwrap_or(0);
    }
    for v in rows {
        for u in 0..n {
            let at = v * (n + 1) + u;
            let corners = [old[at], old[at + 1], old[at + n + 2], old[at + n + 1]];
            let height = after.parts().1[v * n + u];
            for corner in corners.into_iter().filter(|h| *h != NODATA && height != NODATA) {
                most = most.max((corner - height).abs());
            }
        }
    }
    for (a, b) in old.iter().zip(after.parts().0).filter(|(a, b)| **a != NODATA && **b != NODATA) {
        most = most.max((a - b).abs());
    }
    let heights = || old.iter().chain(after.heights()).chain(source.heights()).filter(|h| **h != NODATA);
    Entry {
        error_metres: (f64::from(most) * quantum) as f32,
        low: heights().min().copied().unwrap_or(0),
        high: heights().max().copied().unwrap_or(-1),
        bytes: bytes as u32,
    }
}

/// The surface of each diamond that has all its ancestors among `wanted`, decoded.
pub(crate) fn surfaces(built: &Built, wanted: impl Fn(Diamond) -> bool) -> HashMap<Diamond, Arc<Surface>> {
    let mut surfaces: HashMap<Diamond, Arc<Surface>> = HashMap::new();
    for d in built.diamonds.iter().copied().filter(|d| wanted(*d)) {
        let parents: Option<Vec<_>> =
            built.layer.forest.parents(d).map(|p| Some((p, &**surfaces.get(&p)?))).collect();
        if let Some(parents) = parents {
            let surface =
                Surface::split(Encoding::Points, &built.layer, d, &parents, &built.payloads[&d]).unwrap();
            surfaces.insert(d, Arc::new(surface));
        }
    }
    surfaces
}

/// Likewise of irregular triangles.
pub(crate) fn tin_surfaces(
    built: &BuiltTin,
    wanted: impl Fn(Diamond) -> bool,
) -> HashMap<Diamond, Arc<Surface>> {
    let mut surfaces: HashMap<Diamond, Arc<Surface>> = HashMap::new();
    for d in built.diamonds.iter().copied().filter(|d| wanted(*d)) {
        let parents: Option<Vec<_>> =
            built.layer.forest.parents(d).map(|p| Some((p, &**surfaces.get(&p)?))).collect();
        if let Some(parents) = parents {
            let payload = &built.payloads[&d];
            let surface = Surface::split(Encoding::Tin, &built.layer, d, &parents, payload).unwrap();
            surfaces.insert(d, Arc::new(surface));
        }
    }
    surfaces
}

/// What is drawn at the points of the lattice, motions included, in quanta.
pub(crate) struct Ground {
    forest: Forest,
    heights: HashMap<[i64; 2], Option<f64>>,
}

impl Ground {
    /// The ground of a frame's items of one layer. Asserts that patches give a point that they share the same height
    /// and normal.
    pub(crate) fn new(forest: Forest, items: &[DrawItem]) -> Self {
        let mut points: HashMap<[i64; 2], (i32, u32, [i16; 2])> = HashMap::new();
        for item in items {
            let surface = item.surface.points().unwrap();
            let (local, block) = (forest.local(item.diamond), surface.block());
            let n = block.segments();
            for [p, q] in block.places() {
                // In which triangles of the split the point lies.
                let (x, y) = (p as i64 - n as i64, q as i64 - n as i64);
                let sides = [-y >= x.abs(), x >= y.abs(), y >= x.abs(), -x >= y.abs()];
                let count = if local.upper { 4 } else { 2 };
                if !(0..count).any(|side| sides[side] && item.sides & (1 << side) != 0) {
                    continue;
                }
                let slot = Block::slot(n, p, q);
                let (height, normal) = (block.heights()[slot], surface.normals()[slot]);
                if height == NODATA {
                    continue;
                }
                let drawn = match &item.moving {
                    None => (height, 0.0f32.to_bits(), normal),
                    Some(moving) => {
                        let (record, duration) = (moving.motion.records()[slot], moving.motion.duration());
                        let (lift, normal) = record.drawn(moving.now, duration);
                        (height, lift.to_bits(), normal)
                    }
                };
                let at = local.lattice2([p as i64, q as i64]);
                let mut before = *points.entry(at).or_insert(drawn);
                // Root squares know nothing of each other's heights: along their sides, their normals differ.
                if at.iter().any(|i| i % (1i64 << forest.root_log2()) == 0) {
                    before.2 = drawn.2;
                }
                assert_eq!(before, drawn, "two patches draw {at:?}, one of them {:?}", item.diamond);
            }
        }
        let height =
            |(height, lift, _): (i32, u32, [i16; 2])| f64::from(height) + f64::from(f32::from_bits(lift));
        let heights = points.into_iter().map(|(at, drawn)| (at, Some(height(drawn)))).collect();
        Self { forest, heights }
    }

    /// The height drawn at a lattice point: that of a vertex, or between the two ends of the hypotenuse that it
    /// halves; `None` where nothing is drawn.
    pub(crate) fn height(&mut self, [x, y]: [i64; 2]) -> Option<f64> {
        if let Some(height) = self.heights.get(&[x, y]) {
            return *height;
        }
        let zeros = (x | y).trailing_zeros();
        if zeros >= self.forest.root_log2() {
            return None;
        }
        let h = 1i64 << zeros;
        let ends = match ((x / h) % 2 == 1, (y / h) % 2 == 1) {
            (true, true) if (x / (2 * h) + y / (2 * h)) % 2 == 0 => [[x - h, y - h], [x + h, y + h]],
            (true, true) => [[x + h, y - h], [x - h, y + h]],
            (true, false) => [[x - h, y], [x + h, y]],
            _ => [[x, y - h], [x, y + h]],
        };
        let height = self.height(ends[0]).zip(self.height(ends[1])).map(|(a, b)| f64::midpoint(a, b));
        self.heights.insert([x, y], height);
        height
    }
}

/// Numbers that look random, the same each time.
pub(crate) struct Dice(pub(crate) u64);

impl Dice {
    pub(crate) fn roll(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as f64 / f64::from(1u32 << 31)
    }
}

/// A camera somewhere in or around the terrain.
pub(crate) fn any_camera(dice: &mut Dice) -> Camera {
    let mut point = |margin: f64, z: f64| {
        let along = |size: f64, roll: f64| size * (roll * (1.0 + 2.0 * margin) - margin);
        DVec3::new(
            500_000.0 + along(10_240.0, dice.roll()),
            4_000_000.0 + along(5120.0, dice.roll()),
            z * dice.roll(),
        )
    };
    Camera { eye: point(0.3, 6000.0), target: point(0.0, 300.0), fov_y: FOV_Y, size: [1380, 768] }
}

/// A camera that sees all of the terrain.
pub(crate) fn above() -> Camera {
    let target = DVec3::new(505_120.0, 4_002_560.0, 300.0);
    Camera { eye: target + DVec3::new(0.0, -6000.0, 9000.0), target, fov_y: FOV_Y, size: [1380, 768] }
}

/// How a server misbehaves. Each is a chance from 0 to 1 for an answer (or, for `damaged`, a payload).
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Faults {
    pub(crate) status_500: f64,
    pub(crate) truncated: f64,
    pub(crate) damaged: f64,
    pub(crate) slow: f64,
    pub(crate) silent: f64,
    pub(crate) absurd: f64,
    pub(crate) garbage: f64,
    pub(crate) bomb: f64,
    /// Payloads of batches are others than they should be, and their checksums say that they are right.
    pub(crate) forged: f64,
    /// A frame that does not belong into a stream, before any of its frames.
    pub(crate) unasked: f64,
    /// The stream begins again when it is at its end.
    pub(crate) endless: f64,
    pub(crate) gone: bool,
    /// The payloads of streams are large and make no sense.
    pub(crate) heavy: bool,
    /// Of the answers, streams alone are spoilt.
    pub(crate) streams_alone: bool,
}

/// A server of the scene on a free port, on a runtime of its own.
pub(crate) struct Served {
    pub(crate) url: String,
    pub(crate) state: Arc<Serving>,
    runtime: Option<tokio::runtime::Runtime>,
}

pub(crate) struct Serving {
    scene: Scene,
    pub(crate) faults: Mutex<Faults>,
    pub(crate) requests: AtomicUsize,
    dice: AtomicU64,
}

impl Serving {
    fn happens(&self, chance: f64) -> bool {
        Dice(self.dice.fetch_add(0x9E37_79B9_7F4A_7C15, Ordering::Relaxed)).roll() < chance
    }

    fn faults(&self) -> Faults {
        *self.faults.lock().unwrap()
    }

    /// The faults of answers other than streams.
    fn common_faults(&self) -> Faults {
        let faults = self.faults();
        if faults.streams_alone { Faults { gone: faults.gone, ..Faults::default() } } else { faults }
    }
}

/// Imagery of no tiles.
pub(crate) fn photo() -> Texture {
    Texture {
        name: "photo".to_owned(),
        origin: [0.0, 0.0],
        texel: [10.0, 10.0],
        size: [1024, 512],
        format: "webp".to_owned(),
        quality: 80,
        tiles: 0,
        bytes: 0,
        resampled: false,
    }
}

impl Served {
    pub(crate) fn start(layers: usize, faults: Faults) -> Self {
        Self::start_at("127.0.0.1:0", layers, faults)
    }

    /// As [`Served::start`], where another one was before.
    pub(crate) fn start_at(address: &str, layers: usize, faults: Faults) -> Self {
        Self::start_with(address, scene(layers), faults)
    }

    /// Terrain and imagery of it, none of whose tiles there are.
    pub(crate) fn start_draped() -> Self {
        Self::start_with("127.0.0.1:0", Scene { textures: vec![photo()], ..scene(1) }, Faults::default())
    }

    fn start_with(address: &str, scene: Scene, faults: Faults) -> Self {
        let state = Arc::new(Serving {
            scene,
            faults: Mutex::new(faults),
            requests: AtomicUsize::new(0),
            dice: AtomicU64::new(1),
        });
        let router = Router::new()
            .route("/scenes", get(catalogue))
            .route("/scenes/{scene}", get(description))
            .route(
                "/scenes/{scene}/{version}/{layer}/index/{page}",
                get(|state, path| page(Encoding::Points, state, path)),
            )
            .route(
                "/scenes/{scene}/{version}/{layer}/tin/index/{page}",
                get(|state, path| page(Encoding::Tin, state, path)),
            )
            .route(
                "/scenes/{scene}/{version}/{layer}/points",
                get(|state, path, query| batch(Encoding::Points, state, path, query)),
            )
            .route(
                "/scenes/{scene}/{version}/{layer}/tin",
                get(|state, path, query| batch(Encoding::Tin, state, path, query)),
            )
            .route("/scenes/{scene}/{version}/{layer}/stream", get(stream))
            .with_state(Arc::clone(&state));
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
        let listener = runtime.block_on(tokio::net::TcpListener::bind(address)).unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        runtime.spawn(async move { axum::serve(listener, router).await });
        Self { url, state, runtime: Some(runtime) }
    }

    pub(crate) fn misbehave(&self, faults: Faults) {
        *self.state.faults.lock().unwrap() = faults;
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

type Shared = State<Arc<Serving>>;

async fn catalogue(State(state): Shared) -> Response {
    let catalogue = Catalogue { scenes: vec![state.scene.clone()] };
    serde_json::to_vec(&catalogue).unwrap().into_response()
}

async fn description(State(state): Shared, Path(name): Path<String>) -> Response {
    let mut scene = state.scene.clone();
    if name != scene.name {
        return StatusCode::NOT_FOUND.into_response();
    }
    if state.faults().gone {
        scene.version = "v2".into();
    }
    serde_json::to_vec(&scene).unwrap().into_response()
}

/// Faults that any answer may have.
async fn common(state: &Serving, faults: &Faults) -> Option<Response> {
    state.requests.fetch_add(1, Ordering::Relaxed);
    if faults.gone {
        return Some(StatusCode::GONE.into_response());
    }
    if state.happens(faults.status_500) {
        return Some(StatusCode::INTERNAL_SERVER_ERROR.into_response());
    }
    if state.happens(faults.garbage) {
        return Some(vec![0xFFu8; 5000].into_response());
    }
    if state.happens(faults.silent) {
        tokio::time::sleep(Duration::from_secs(60)).await;
    }
    None
}

async fn page(
    encoding: Encoding,
    State(state): Shared,
    Path((_, _, layer, page)): Path<(String, String, String, u32)>,
) -> Response {
    let faults = state.common_faults();
    if let Some(fault) = common(&state, &faults).await {
        return fault;
    }
    if state.happens(faults.bomb) {
        return zstd::bulk::compress(&vec![0u8; 64 << 20], 1).unwrap().into_response();
    }
    let built = world().iter().find(|built| built.layer.name == layer).unwrap();
    page_blob(built, encoding, page).into_response()
}

fn page_blob(built: &Built, encoding: Encoding, page: u32) -> Vec<u8> {
    let (forest, entries) = built.entries_of(encoding);
    let diamonds = index::page_diamonds(forest, page).unwrap();
    let entries: Vec<Entry> = diamonds.iter().map(|d| entries[d]).collect();
    zstd::bulk::compress(&index::encode(&entries), 3).unwrap()
}

async fn batch(
    encoding: Encoding,
    State(state): Shared,
    Path((_, _, layer)): Path<(String, String, String)>,
    RawQuery(query): RawQuery,
) -> Response {
    let faults = state.common_faults();
    if let Some(fault) = common(&state, &faults).await {
        return fault;
    }
    let built = world().iter().find(|built| built.layer.name == layer).unwrap();
    let centres = message::parse_batch(query.unwrap().strip_prefix("d=").unwrap()).unwrap();
    let mut body = Vec::new();
    for centre in centres {
        let (forest, payloads) = built.payloads_of(encoding);
        let mut payload = payloads[&forest.diamond(centre).unwrap()].clone();
        if payload.is_empty() {
            FrameHeader::without(centre, Status::Missing).write(&mut body);
            continue;
        }
        if state.happens(faults.forged) {
            // Not the header, but what it announces.
            for byte in &mut payload[1..] {
                *byte = byte.wrapping_mul(31) ^ 0x5a;
            }
        }
        let mut header = FrameHeader::of(centre, &payload);
        if state.happens(faults.damaged) {
            damage(&mut payload);
        }
        if state.happens(faults.absurd / 8.0) {
            header.length = u32::MAX;
        }
        header.write(&mut body);
        body.extend(payload);
    }
    in_pieces(&state, &faults, body)
}

/// Flips a bit: of the format, where there is little more.
fn damage(payload: &mut [u8]) {
    let at = if payload.len() > 3 { 3 } else { 0 };
    payload[at] ^= 64;
}

/// The answer in pieces, cut off or late if so it happens.
fn in_pieces(state: &Serving, faults: &Faults, mut body: Vec<u8>) -> Response {
    if state.happens(faults.truncated) {
        body.truncate(body.len() / 2);
    }
    let slow = state.happens(faults.slow);
    let chunks: Vec<Vec<u8>> = body.chunks(1000).map(<[u8]>::to_vec).collect();
    let stream = futures_util::stream::unfold(chunks.into_iter(), move |mut chunks| async move {
        let chunk = chunks.next()?;
        if slow {
            tokio::time::sleep(Duration::from_millis(30)).await;
        }
        Some((Ok::<_, std::io::Error>(Bytes::from(chunk)), chunks))
    });
    Body::from_stream(stream).into_response()
}

/// What a view wants, in the order of levels; not that of errors, which no client may count on.
fn wanted(built: &Built, ask: &StreamAsk) -> Vec<Diamond> {
    let (layer, view) = (&built.layer, ask.view.as_ref().unwrap());
    let is_seen = |d: &Diamond| {
        let entry = built.entries[d];
        let [low, high] = layer.forest.bounds(*d).map(|p| layer.position(p));
        let low = DVec3::new(low[0], low[1], layer.metres(entry.low));
        let high = DVec3::new(high[0], high[1], layer.metres(entry.high));
        let eye = DVec3::from_array(view.eye);
        let error = f64::from(entry.error_metres);
        let mut angle = error / (eye.clamp(low, high) - eye).length();
        if view.vertical && sight::is_vertical(&layer.forest, d.level(), entry.error_metres, layer.cell) {
            angle = angle.min(sight::vertical_angle(view.eye, error, low.to_array(), high.to_array()));
        }
        !entry.is_empty() && (d.level() == 0 || angle > view.angle)
    };
    let mut wanted: HashSet<Diamond> = built.diamonds.iter().copied().filter(is_seen).collect();
    for d in built.diamonds.iter().rev() {
        if wanted.contains(d) {
            wanted.extend(layer.forest.parents(*d));
        }
    }
    built.diamonds.iter().copied().filter(|d| wanted.contains(d)).collect()
}

async fn stream(
    State(state): Shared,
    Path((_, _, layer)): Path<(String, String, String)>,
    Query(query): Query<HashMap<String, String>>,
) -> Response {
    let faults = state.faults();
    if let Some(fault) = common(&state, &faults).await {
        return fault;
    }
    let built = world().iter().find(|built| built.layer.name == layer).unwrap();
    let forest = &built.layer.forest;
    let ask = message::parse_stream(query.iter().map(|(k, v)| (k.as_str(), v.as_str()))).unwrap();
    let mut body = Vec::new();
    let mut pages = HashSet::new();
    // 20 MB are as good as any number.
    let most = if faults.heavy { 100 } else { usize::MAX };
    for d in wanted(built, &ask).into_iter().take(most) {
        for around in forest.children(d).into_iter().flatten().chain([d]) {
            let page = index::page_of(forest, around);
            if pages.insert(page) {
                let bomb = state.happens(faults.bomb);
                let blob = if bomb {
                    zstd::bulk::compress(&vec![0u8; 64 << 20], 1).unwrap()
                } else {
                    page_blob(built, Encoding::Points, page)
                };
                FrameHeader::of_page(page, &blob).write(&mut body);
                body.extend(blob);
            }
        }
        if state.happens(faults.unasked) {
            FrameHeader::of([1, 1], &[]).write(&mut body);
        }
        let mut payload = if faults.heavy { vec![1; 200 << 10] } else { built.payloads[&d].clone() };
        let mut header = FrameHeader::of(d.centre(), &payload);
        if state.happens(faults.damaged) && !payload.is_empty() {
            damage(&mut payload);
        }
        if state.happens(faults.absurd / 8.0) {
            header.length = u32::MAX;
        }
        header.write(&mut body);
        body.extend(payload);
    }
    if state.happens(faults.endless) {
        let again =
            futures_util::stream::repeat_with(move || Ok::<_, std::io::Error>(Bytes::from(body.clone())));
        return Body::from_stream(again).into_response();
    }
    in_pieces(&state, &faults, body)
}

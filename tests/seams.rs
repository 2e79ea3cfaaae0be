//! Law 2, through a built store: whatever cut is chosen and whatever of it is missing, the triangles drawn
//! cover the forest once and neighbours share every point and every height of their edge.

use crate::world::{Dice, Faults, Proxy, World, build, options, write_raw};
use diamantina_client::camera::Camera;
use diamantina_client::cut::{self, Ask};
use diamantina_client::drawing::DrawItem;
use diamantina_client::encoding::Encoding;
use diamantina_client::headless;
use diamantina_client::sight::Sight;
use diamantina_client::surface::{self, Surface};
use diamantina_client::terrain::{self, Terrain};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::index::Entry;
use diamantina_protocol::message::Layer;
use diamantina_server::hierarchy;
use diamantina_server::inspect;
use diamantina_server::store::{Key, Kind, Store};
use glam::DVec3;
use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Hills with holes of all sizes: a lake, a diagonal strait one sample wide, a chequered shore, lone samples,
/// a wall one sample thick, and nothing in the north-east, where roots stay empty.
pub(crate) fn islands(x: u32, y: u32) -> Option<f32> {
    let mut dice = Dice(u64::from(x) << 32 | u64::from(y));
    let (fx, fy) = (f64::from(x), f64::from(y));
    let lake = (fx - 200.0).hypot(fy - 120.0) < 45.0;
    let strait = x == y + 60;
    let shore = (420..470).contains(&x) && dice.roll() < (fx - 420.0) / 50.0;
    let sea = x >= 470;
    let lone = sea && x < 560 && dice.roll() < 0.01;
    let wall = sea && x < 600 && y == 77;
    if (lake || strait || shore || sea) && !lone && !wall {
        return None;
    }
    let waves = 300.0 * (fx / 40.0).sin() * (fy / 31.0).cos() + 60.0 * (fx / 7.0).cos();
    Some((waves + 500.0 + 20.0 * dice.roll()).round() as f32)
}

/// A layer with all that its store has of it, decoded as the client decodes it.
pub(crate) struct Loaded {
    pub(crate) layer: Layer,
    pub(crate) entries: HashMap<Diamond, Entry>,
    pub(crate) surfaces: HashMap<Diamond, Arc<Surface>>,
}

/// The layer at a position of the scene.
pub(crate) fn load(store: &Store, number: u8) -> Loaded {
    let layer = store.scene().layers[usize::from(number)].clone();
    let entries = inspect::entries(store, number, &layer).unwrap();
    let mut surfaces: HashMap<Diamond, Arc<Surface>> = HashMap::new();
    let forest = layer.forest;
    for d in (0..forest.levels()).flat_map(|level| forest.diamonds(level)) {
        if entries[&d].is_empty() {
            continue;
        }
        let [a, b] = d.centre();
        let payload = store.get(Key { layer: number, kind: Kind::Points, a, b }).unwrap().unwrap_or_default();
        // Parents are saturated, so whatever has a height has parents that have.
        let parents: Vec<_> = forest.parents(d).map(|p| (p, Arc::clone(&surfaces[&p]))).collect();
        let parents: Vec<_> = parents.iter().map(|(p, s)| (*p, s.as_ref())).collect();
        surfaces
            .insert(d, Arc::new(Surface::split(Encoding::Points, &layer, d, &parents, &payload).unwrap()));
    }
    Loaded { layer, entries, surfaces }
}

/// The points of an edge, from the lesser end.
type Points = Vec<[i64; 2]>;

/// Each edge of the drawn triangles, with the heights that each of its triangles has along it, and the sum
/// of the doubled areas.
fn edges(layer: &Layer, items: &[DrawItem]) -> (HashMap<Points, Vec<Vec<i32>>>, i64) {
    let mut edges: HashMap<Points, Vec<Vec<i32>>> = HashMap::new();
    let mut area = 0;
    for item in items {
        let (local, block) = (layer.forest.local(item.diamond), item.surface.points().unwrap().block());
        let n = block.segments();
        // Where centres are no points, half of a diagonal has half as many segments.
        let inner = if block.has_centres() { n } else { n / 2 };
        let m = 2 * n as i64;
        let corners = [[0, 0], [m, 0], [m, m], [0, m]];
        for side in (0..4).filter(|side| item.sides & 1 << side != 0) {
            let (a, b, centre) = (corners[side], corners[(side + 1) % 4], [m / 2, m / 2]);
            let [la, lb, lc] = [a, b, centre].map(|p| local.lattice2(p));
            area += ((lb[0] - la[0]) * (lc[1] - la[1]) - (lb[1] - la[1]) * (lc[0] - la[0])).abs();
            for (from, to, count) in [(a, b, n), (b, centre, inner), (centre, a, inner)] {
                let mut edge: Vec<([i64; 2], i32)> = (0..=count as i64)
                    .map(|i| {
                        let p = [0, 1].map(|k| from[k] + (to[k] - from[k]) * i / count as i64);
                        let slot = Block::slot(n, p[0] as usize, p[1] as usize);
                        (local.lattice2(p), block.heights()[slot])
                    })
                    .collect();
                if edge[0].0 > edge[count].0 {
                    edge.reverse();
                }
                let (points, heights) = edge.into_iter().unzip();
                edges.entry(points).or_default().push(heights);
            }
        }
    }
    (edges, area)
}

/// Neighbours share every height of their edge; what has no neighbour lies on the forest's border, or has
/// nothing beyond it, or (where `clipped`) may have a neighbour out of view. The number of shared edges.
pub(crate) fn assert_no_cracks(layer: &Layer, items: &[DrawItem], clipped: bool) -> usize {
    let [w, h] = layer.forest.size().map(i64::from);
    let mut shared = 0;
    for (points, heights) in edges(layer, items).0 {
        let on = |axis: usize, at: i64| points.iter().all(|p| p[axis] == at);
        let border = on(0, 0) || on(0, w) || on(1, 0) || on(1, h);
        match heights.as_slice() {
            [a, b] => {
                assert!(!border, "two triangles along the border {points:?}");
                assert_eq!(a, b, "a crack along {points:?}");
                shared += 1;
            }
            [a] => assert!(
                clipped || border || a.iter().all(|h| *h == NODATA),
                "nothing beyond {points:?}, which has heights {a:?}"
            ),
            more => panic!("{} triangles along {points:?}", more.len()),
        }
    }
    shared
}

#[test]
fn any_cut_of_a_built_store_with_anything_missing_has_no_cracks() {
    let folder = tempfile::tempdir().unwrap();
    let dem = folder.path().join("dem.raw");
    let ingest = write_raw(&dem, [1700, 300], islands);
    let mut dice = Dice(20);
    let mut shared = 0;
    for (patch_log2, max_error) in [(5, 0.0), (5, 2.0), (6, 1.0)] {
        let store = folder.path().join(format!("store-{patch_log2}-{max_error}"));
        build(&dem, &store, &ingest, &hierarchy::Options { max_error, patch_log2, ..options() });
        let Loaded { layer, entries, surfaces } = load(&Store::open(&store).unwrap(), 0);
        let forest = layer.forest;
        assert!(forest.roots()[0] >= 4, "several roots");
        // Saturation reaches a root square's width beyond the last height, so the fourth is the first empty one.
        let roots: Vec<Entry> = forest.root_diamonds().map(|root| entries[&root]).collect();
        assert!(roots.iter().any(Entry::is_empty), "an empty root: {roots:?}");
        let largest = surface::Points::bytes(&forest, 0);
        let [low, high] = [layer.position([0, 0]), layer.position(layer.samples)];
        for round in 0..60 {
            // An eye somewhere above that sees everything, so that nothing is clipped.
            let place = |axis: usize, part: f64| low[axis] + (high[axis] - low[axis]) * part;
            let eye =
                DVec3::new(place(0, dice.roll()), place(1, dice.roll()), 20_000.0 + 10_000.0 * dice.roll());
            let camera = Camera { eye, target: eye - DVec3::Z, fov_y: 2.7, size: [1380, 768] };
            let ask = Ask {
                layer: &layer,
                encoding: Encoding::Points,
                camera: &camera,
                exaggeration: 1.0,
                tolerance_pixels: 0.005 * 300f64.powf(dice.roll()),
                sight: Sight { vertical: round % 2 == 0, foveation: if round % 3 == 0 { 4.0 } else { 1.0 } },
                seen: None,
                memory_bytes: if round % 7 == 6 { 40 * largest } else { usize::MAX },
                gpu: None,
            };
            let ideal = cut::choose(&ask, |d| Some(entries[&d]));
            let arrived = if round % 5 == 0 { 1.0 } else { 0.6 + 0.4 * dice.roll() };
            let missing: HashSet<Diamond> =
                ideal.splits().filter(|d| d.level() > 0 && dice.roll() >= arrived).collect();
            let drawing =
                cut::draw(0, &ask, &ideal, |d| surfaces.get(&d).filter(|_| !missing.contains(&d)).cloned());
            assert!(!drawing.items.is_empty());
            shared += assert_no_cracks(&layer, &drawing.items, false);
            // Covered once: the drawn triangles and those without any height make up the forest.
            let mut void = 0;
            for root in forest.root_diamonds().filter(|root| entries[root].is_empty()) {
                let [a, b] = forest.bounds(root);
                void += 2 * i64::from(b[0] - a[0]) * i64::from(b[1] - a[1]);
            }
            let drawn: HashSet<Diamond> = ideal
                .splits()
                .scan(HashSet::new(), |drawn, d| {
                    let here = !missing.contains(&d) && forest.parents(d).all(|p| drawn.contains(&p));
                    if here {
                        drawn.insert(d);
                    }
                    Some(here.then_some(d))
                })
                .flatten()
                .collect();
            for d in &drawn {
                let local = forest.local(*d);
                let n = forest.segments_at(d.level()) as i64;
                let quarter = (local.u[0] * local.v[1] - local.u[1] * local.v[0]).abs() * n * n / 2;
                let empty = forest.children(*d).into_iter().flatten().filter(|c| entries[c].is_empty());
                void += quarter * empty.count() as i64;
            }
            let [w, h] = forest.size().map(i64::from);
            assert_eq!(edges(&layer, &drawing.items).1 + void, 2 * w * h, "covered once");
            assert!(arrived < 1.0 || drawing.error_pixels == drawing.error_pixels_goal);
        }
    }
    assert!(shared > 10_000, "only {shared} shared edges looked at");
}

#[test]
fn every_frame_of_a_scene_that_streams_in_has_no_cracks() {
    let world = World::sample(513, 0.5);
    let faults = Faults { delay: Duration::from_millis(60), cut: 0.3, ..Faults::default() };
    let proxy = Proxy::start(&world.served.address, faults, 5);
    let options = terrain::Options { tolerance_pixels: 0.5, ..terrain::Options::default() };
    let mut terrain = Terrain::open(&format!("{}/scenes/world", proxy.address), options).unwrap();
    let layer = terrain.scene().layers[0].clone();
    let mut camera = headless::overview(terrain.scene(), [900, 600]);
    let (mut shared, mut pictures) = (0, 0);
    let started = Instant::now();
    for round in 0.. {
        // Every so often the eye moves, so that what was asked for is no longer what is wanted.
        if round % 40 == 39 {
            camera.eye += (camera.target - camera.eye) * 0.15;
        }
        let view = terrain.frame(&camera);
        pictures += usize::from(!view.items.is_empty() && !view.complete);
        shared += assert_no_cracks(&layer, &view.items, true);
        if round >= 300 && (view.complete || started.elapsed() > Duration::from_secs(60)) {
            break;
        }
        std::thread::sleep(Duration::from_millis(4));
    }
    assert!(pictures > 10, "the network was too fast: {pictures} unfinished pictures");
    assert!(shared > 1000);
}

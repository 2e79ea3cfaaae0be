//! Pictures of made-up terrain, on any adapter, software included.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "made-up numbers, small and positive"
)]

mod legible;
mod motion;
mod room;
mod truth;
mod water;

use super::pipelines::RECORD;
use super::*;
use crate::camera::FOV_Y;
use crate::drawing::{Moving, Share};
use crate::encoding::Encoding;
use crate::morph::{self, Change, Moment, Morphs, Sight};
use crate::picture::Picture;
use crate::surface::Surface;
use crate::world::{Dice, Ground};
use diamantina_protocol::NODATA;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::message::{Kind, Scene};
use diamantina_protocol::points::{self, Coding, Rule};
use diamantina_protocol::tin::{self, Patch};
use glam::DVec3;
use std::collections::{HashMap, HashSet};
use std::sync::Arc;

const MAGENTA: Background = Background::Colour([1.0, 0.0, 1.0, 1.0]);

/// Without haze and over magenta.
const PLAIN: Look = Look {
    background: MAGENTA,
    sun: Sun { azimuth_degrees: 315.0, altitude_degrees: 45.0 },
    colours: Colours::Terrain,
    range: None,
    shading: Shading::Soft,
    haze: 0.0,
    exaggeration: 1.0,
    show_levels: false,
    wireframe: false,
    water: Water {
        reflecting: true,
        refractive_index: 1.33,
        waves: 0.0,
        seconds: 0.0,
        clarity: None,
        mirror_scale: 1.0,
        mirror_error: 1.0,
    },
    imagery: Imagery { light: 0.0, opacity: 1.0 },
    annotations: Annotations { scale_bar: false, north_arrow: false, legend: false },
};

/// A layer with all surfaces of its forest, decoded from payloads as a client does.
struct World {
    layer: Layer,
    surfaces: HashMap<Diamond, Arc<Surface>>,
}

impl World {
    /// `height` gives quanta, of 0.1 m, at lattice points.
    fn new(forest: Forest, cell: f64, height: impl Fn(u32, u32) -> i32) -> Self {
        // Past the lattice there is something to correct.
        let (levels, lattice) = (forest.levels(), forest.lattice_levels());
        let exponents = (0..=levels).map(|l| (levels - l.max(lattice)) as u8).collect();
        let coding = Coding::new(Rule::Smooth, 3, exponents).unwrap();
        let mut blocks: HashMap<Diamond, Block> = HashMap::new();
        let mut payloads = Vec::new();
        let mut range = [i32::MAX, i32::MIN];
        for level in 0..forest.levels() {
            for d in forest.diamonds(level) {
                let mut source = Block::empty(&forest, level);
                source.fill(&forest.local(d), |x, y| {
                    let h = height(x, y);
                    if h != NODATA {
                        range = [range[0].min(h), range[1].max(h)];
                    }
                    h
                });
                let mut block = Block::empty(&forest, level);
                for parent in forest.parents(d) {
                    block.inherit(&forest, d, parent, &blocks[&parent]);
                }
                payloads.push((d, points::encode(&forest, &coding, d, &mut block, &source)));
                blocks.insert(d, block);
            }
        }
        let [width, depth] = forest.size();
        let layer = Layer {
            name: "terrain".into(),
            kind: Kind::Terrain,
            forest,
            // Far from the frame's origin, as in a projected system.
            origin: [612_345.25, 4_512_345.75],
            cell: [cell, cell],
            samples: [width + 1, depth + 1],
            valid_samples: u64::from(width + 1) * u64::from(depth + 1),
            quantum: 0.1,
            height_offset: 0.0,
            heights: range.map(|h| f64::from(h) * 0.1),
            max_error: 0.1,
            finest_error: 0.1,
            encodings: vec!["points".into()],
            coding,
            bytes: 0,
            resampled: false,
            errors: "exact".into(),
            tin: None,
        };
        let mut surfaces: HashMap<Diamond, Arc<Surface>> = HashMap::new();
        for (d, payload) in payloads {
            let surface = {
                let parents: Vec<_> = forest.parents(d).map(|p| (p, &*surfaces[&p])).collect();
                Surface::split(Encoding::Points, &layer, d, &parents, &payload).unwrap()
            };
            surfaces.insert(d, Arc::new(surface));
        }
        Self { layer, surfaces }
    }

    /// The same layer, with irregular triangles: those of the regular patches of fewer segments.
    fn tin(forest: Forest, cell: f64, height: impl Fn(u32, u32) -> i32) -> Self {
        let Self { layer, .. } = Self::new(forest, cell, &height);
        let layer = Layer { forest: Forest::new(6, 2, forest.roots()).unwrap(), ..layer };
        assert_eq!(layer.forest.size(), forest.size(), "made for forests of this size");
        let forest = layer.forest;
        let mut surfaces: HashMap<Diamond, Arc<Surface>> = HashMap::new();
        for d in (0..forest.levels()).flat_map(|level| forest.diamonds(level)) {
            let patch = Patch::regular(&forest, d, forest.segments(), |[x, y]| {
                Some(height(x, y)).filter(|h| *h != NODATA)
            });
            let payload = tin::encode(&forest, d, &patch).unwrap();
            let parents: Vec<_> = forest.parents(d).map(|p| (p, &*surfaces[&p])).collect();
            let surface = Surface::split(Encoding::Tin, &layer, d, &parents, &payload).unwrap();
            surfaces.insert(d, Arc::new(surface));
        }
        Self { layer, surfaces }
    }

    /// What is drawn if exactly these diamonds are split: the sides where no split child is.
    fn cut(&self, split: &HashSet<Diamond>) -> Vec<DrawItem> {
        let forest = self.layer.forest;
        let items = split.iter().map(|d| {
            let children = forest.children(*d);
            let sides = (0..4)
                .filter(|side| !children[*side].is_some_and(|c| split.contains(&c)))
                .fold(0u8, |sides, side| sides | 1 << side);
            DrawItem {
                layer: 0,
                diamond: *d,
                surface: Arc::clone(&self.surfaces[d]),
                sides,
                moving: None,
                share: Share::ALL,
            }
        });
        items.filter(|item| item.sides != 0).collect()
    }

    /// Those of `split` in the order that a cut has.
    fn sorted(split: &HashSet<Diamond>) -> Vec<Diamond> {
        let mut sorted: Vec<_> = split.iter().copied().collect();
        sorted.sort_unstable();
        sorted
    }

    /// The cut that splits all diamonds above a level.
    fn level(&self, level: u32) -> Vec<DrawItem> {
        self.cut(&self.surfaces.keys().copied().filter(|d| d.level() < level).collect())
    }

    /// A cut that splits each diamond whose parents are split with a chance of `numerator` in 8.
    fn random_cut(&self, seed: u64, numerator: u64) -> Vec<DrawItem> {
        let forest = self.layer.forest;
        let mut state = seed;
        let mut split: HashSet<_> = forest.root_diamonds().collect();
        for level in 1..forest.levels() {
            for d in forest.diamonds(level) {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                if (state >> 40) % 8 < numerator && forest.parents(d).all(|p| split.contains(&p)) {
                    split.insert(d);
                }
            }
        }
        self.cut(&split)
    }

    /// The frame's coordinates of a place in the forest: 0 to 1 east and north, and metres up.
    fn place(&self, east: f64, north: f64, up: f64) -> DVec3 {
        let [w, h] = self.layer.forest.size().map(f64::from);
        let (origin, cell) = (self.layer.origin, self.layer.cell);
        DVec3::new(origin[0] + east * w * cell[0], origin[1] + north * h * cell[1], up)
    }

    /// A camera straight above the middle that sees the whole forest, with a margin.
    fn overhead(&self, size: [u32; 2]) -> Camera {
        let [w, h] = self.layer.forest.size().map(f64::from);
        let extent = (w * self.layer.cell[0]).max(h * self.layer.cell[1]);
        let eye = self.place(0.5, 0.5, self.layer.heights[1] + 1.6 * extent);
        Camera { eye, target: self.place(0.5, 0.5, 0.0), fov_y: FOV_Y, size }
    }
}

fn offscreen(samples: u32, budget_bytes: u64) -> Offscreen {
    let options = Options { samples, budget_bytes, ..Options::default() };
    Offscreen::new(&options).unwrap_or_else(|e| panic!("{e}"))
}

fn picture(world: &World, camera: &Camera, items: &[DrawItem], look: &Look) -> Picture {
    let mut offscreen = offscreen(1, 1 << 30);
    offscreen.draw(std::slice::from_ref(&world.layer), camera, items, look).unwrap();
    offscreen.read().unwrap()
}

fn is_background(picture: &Picture, x: u32, y: u32) -> bool {
    picture.pixel([x, y]) == Some([255, 0, 255, 255])
}

/// Where a point of the frame lies in the picture.
fn pixel_of(camera: &Camera, p: DVec3) -> [f64; 2] {
    let clip = camera.clip_from_eye(1.0).project_point3((p - camera.eye).as_vec3());
    let [w, h] = camera.size.map(f64::from);
    [(f64::from(clip.x) + 1.0) / 2.0 * w, (1.0 - f64::from(clip.y)) / 2.0 * h]
}

/// Smooth noise of about 0 to 1: values at whole numbers, interpolated, in octaves.
fn noise(x: f64, y: f64, octaves: u32) -> f64 {
    let value = |i: i64, j: i64, k: u32| {
        let mut h =
            (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (j as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
        h ^= u64::from(k).wrapping_mul(0x1656_67b1_9e37_79f9);
        h = (h ^ h >> 31).wrapping_mul(0x7fb5_d329_728e_a185);
        h = (h ^ h >> 27).wrapping_mul(0x81da_def4_bc2d_d44d);
        (h >> 11) as f64 / (1u64 << 53) as f64
    };
    let (mut sum, mut weight, mut scale, mut total) = (0.0, 1.0, 1.0, 0.0);
    for k in 0..octaves {
        let (x, y) = (x * scale + f64::from(k) * 17.3, y * scale + f64::from(k) * 9.1);
        let (i, j) = (x.floor(), y.floor());
        let fade = |t: f64| t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
        let (s, t) = (fade(x - i), fade(y - j));
        let at = |di: i64, dj: i64| value(i as i64 + di, j as i64 + dj, k);
        let low = at(0, 0) + (at(1, 0) - at(0, 0)) * s;
        let high = at(0, 1) + (at(1, 1) - at(0, 1)) * s;
        sum += (low + (high - low) * t) * weight;
        total += weight;
        weight *= 0.5;
        scale *= 2.03;
    }
    sum / total
}

fn rough(x: u32, y: u32) -> i32 {
    (noise(f64::from(x) / 13.0, f64::from(y) / 13.0, 4) * 4000.0) as i32
}

#[test]
fn the_whole_forest_is_covered_and_nothing_else() {
    // Heights fall to 0 at the border, gently enough that nothing leans over the outline.
    let forest = Forest::new(6, 4, [2, 1]).unwrap().with_precision(3).unwrap();
    let [w, h] = forest.size();
    let to_border = |x: u32, y: u32| x.min(y).min(w - x).min(h - y).cast_signed();
    let height = |x: u32, y: u32| rough(x, y).min(60 * to_border(x, y));
    for world in [World::new(forest, 30.0, height), World::tin(forest, 30.0, height)] {
        assert_covered(&world);
    }
}

/// Each picture shows terrain just where the forest is.
fn assert_covered(world: &World) {
    let forest = world.layer.forest;
    let camera = world.overhead([320, 240]);
    let (a, b) =
        (pixel_of(&camera, world.place(0.0, 1.0, 0.0)), pixel_of(&camera, world.place(1.0, 0.0, 0.0)));
    for level in 1..=forest.levels() {
        let picture = picture(world, &camera, &world.level(level), &PLAIN);
        let mut inside = 0;
        for y in 0..240 {
            for x in 0..320 {
                let (px, py) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
                let within = |margin: f64| {
                    px > a[0] + margin && px < b[0] - margin && py > a[1] + margin && py < b[1] - margin
                };
                if within(0.01) {
                    inside += 1;
                    assert!(!is_background(&picture, x, y), "hole at {x} {y}, level {level}");
                } else if !within(-0.01) {
                    assert!(is_background(&picture, x, y), "terrain at {x} {y}, level {level}");
                }
            }
        }
        assert!(inside > 10_000, "{inside}");
    }
}

#[test]
fn mixed_levels_have_no_cracks() {
    let forest = Forest::new(6, 2, [3, 2]).unwrap().with_precision(3).unwrap();
    let (points, tin) = (World::new(forest, 30.0, rough), World::tin(forest, 30.0, rough));
    let camera = Camera {
        eye: points.place(0.5, 0.25, 900.0),
        target: points.place(0.5, 0.5, 100.0),
        fov_y: 0.5,
        size: [640, 400],
    };
    for seed in 0..12 {
        let world = if seed % 2 == 0 { &points } else { &tin };
        let items = world.random_cut(seed, 5 + seed % 3);
        let picture = picture(world, &camera, &items, &PLAIN);
        let holes = (0..400).flat_map(|y| (0..640).map(move |x| (x, y)));
        let holes: Vec<_> = holes.filter(|(x, y)| is_background(&picture, *x, *y)).collect();
        assert!(holes.is_empty(), "seed {seed}: {} holes, first {:?}", holes.len(), holes[0]);
    }
}

/// Mean red, green and blue around a place of the picture, 0 to 1 from the left and from the top.
fn mean(picture: &Picture, x: f64, y: f64) -> [f64; 3] {
    let [w, h] = picture.size.map(f64::from);
    let (x, y) = ((x * w) as u32, (y * h) as u32);
    let mut sum = [0.0; 3];
    for dy in 0..9 {
        for dx in 0..9 {
            let pixel = picture.pixel([x + dx - 4, y + dy - 4]).unwrap();
            (0..3).for_each(|i| sum[i] += f64::from(pixel[i]) / 81.0);
        }
    }
    sum
}

#[test]
fn north_is_up_and_east_is_right() {
    // A high plateau in the north-east, the rest low.
    let forest = Forest::new(6, 4, [1, 1]).unwrap();
    let height = |x, y| if x > 36 && y > 36 { 35_000 } else { 0 };
    for world in [World::new(forest, 1500.0, height), World::tin(forest, 1500.0, height)] {
        let picture = picture(&world, &world.overhead([300, 300]), &world.level(4), &PLAIN);
        let corners =
            [(0.65, 0.35), (0.35, 0.35), (0.35, 0.65), (0.65, 0.65)].map(|(x, y)| mean(&picture, x, y));
        assert!(corners[0].iter().all(|c| *c > 190.0), "summits are white: {corners:?}");
        for low in &corners[1..] {
            assert!(low[1] > low[0] * 1.2 && low[1] > low[2] * 1.2, "lowlands are green: {corners:?}");
        }
    }
}

#[test]
fn light_comes_from_the_north_west() {
    // A cone: its north-western face looks at the sun.
    let forest = Forest::new(6, 4, [1, 1]).unwrap();
    let height = |x, y| {
        let (dx, dy) = (f64::from(x) - 32.0, f64::from(y) - 32.0);
        5000 - (dx.hypot(dy) * 100.0) as i32
    };
    let look = Look { colours: Colours::Flat, ..PLAIN };
    let light = [World::new(forest, 15.0, height), World::tin(forest, 15.0, height)].map(|world| {
        let picture = picture(&world, &world.overhead([300, 300]), &world.level(4), &look);
        [(0.4, 0.4), (0.6, 0.6)].map(|(x, y)| mean(&picture, x, y)[1])
    });
    assert!(light.iter().all(|[north_west, south_east]| *north_west > south_east + 60.0), "{light:?}");
    // Both encodings are lit alike.
    assert!((0..2).all(|i| (light[0][i] - light[1][i]).abs() < 4.0), "{light:?}");
}

#[test]
fn nodata_stays_background() {
    let forest = Forest::new(6, 4, [1, 1]).unwrap();
    let hole = |x: u32, y: u32| (20..=40).contains(&x) && (24..=44).contains(&y);
    let height = |x, y| if hole(x, y) { NODATA } else { 300 };
    for world in [World::new(forest, 15.0, height), World::tin(forest, 15.0, height)] {
        let camera = world.overhead([300, 300]);
        for items in [world.level(world.layer.forest.levels()), world.level(3), world.random_cut(3, 6)] {
            let picture = picture(&world, &camera, &items, &PLAIN);
            let at = |x: f64, y: f64| {
                let [px, py] = pixel_of(&camera, world.place(x / 64.0, y / 64.0, 30.0));
                is_background(&picture, px as u32, py as u32)
            };
            for (x, y) in [(30.0, 34.0), (20.4, 24.4), (39.6, 43.6)] {
                assert!(at(x, y), "no terrain in the hole at {x} {y}");
            }
            for (x, y) in [(4.0, 34.0), (60.0, 34.0), (30.0, 4.0), (30.0, 60.0)] {
                assert!(!at(x, y), "terrain at {x} {y}");
            }
        }
    }
}

#[test]
fn the_eye_may_be_very_near_or_very_far() {
    let world = World::new(Forest::new(5, 3, [1, 1]).unwrap(), 30.0, |_, _| 1000);
    for above in [0.2, 5.0, 1e3, 1e6] {
        let eye = world.place(0.5, 0.5, 100.0 + above);
        let fov_y = (2.0 * 100.0f64.atan2(above)).min(FOV_Y);
        let camera = Camera { eye, target: eye - DVec3::Z, fov_y, size: [64, 64] };
        let picture = picture(&world, &camera, &world.level(4), &PLAIN);
        assert!(!is_background(&picture, 32, 32), "{above} m above");
    }
}

/// The first diamond that had heights but no triangle ended the program: an empty buffer cannot be bound.
#[test]
fn lone_points_draw_nothing() {
    let world = World::new(Forest::new(5, 3, [1, 1]).unwrap(), 30.0, |x, y| {
        if x % 8 == 4 && y % 8 == 4 { 300 } else { NODATA }
    });
    let camera = world.overhead([64, 64]);
    for level in 1..=4 {
        let picture = picture(&world, &camera, &world.level(level), &PLAIN);
        assert!((0..64).all(|i| is_background(&picture, i, i)), "level {level}");
    }
}

#[test]
fn wires_lie_on_the_sides_of_triangles_and_nowhere_else() {
    let forest = Forest::new(6, 4, [1, 1]).unwrap();
    for world in [World::new(forest, 30.0, |_, _| 300), World::tin(forest, 30.0, |_, _| 300)] {
        let camera = world.overhead([400, 400]);
        let items = world.level(1);
        let look = Look { colours: Colours::Flat, wireframe: true, ..PLAIN };
        let picture = picture(&world, &camera, &items, &look);
        let shade = |x: f64, y: f64| {
            let [px, py] = pixel_of(&camera, world.place(x / 64.0, y / 64.0, 30.0));
            picture.pixel([px as u32, py as u32]).unwrap()[1]
        };
        // Cells of the root: 4 wide for points, 16 for triangles. Their diagonals are sides, too.
        let cell = if items[0].surface.tin().is_some() { 16.0 } else { 4.0 };
        let (mut dark, mut light) = (0, 0);
        for i in 0..(64.0 / cell) as i32 {
            let from = f64::from(i) * cell;
            // A wire is a pixel wide: one of those around it.
            let near = [-0.2, -0.1, 0.0, 0.1, 0.2].map(|off| shade(from + off, 0.3 * cell));
            dark += i32::from(i > 0 && near.iter().any(|c| *c < 60));
            light += i32::from(shade(from + 0.2 * cell, 0.5 * cell) > 100);
        }
        let cells = (64.0 / cell) as i32;
        assert_eq!((dark, light), (cells - 1, cells));
        let holes = (60..340).flat_map(|y| (60..340).map(move |x| (x, y)));
        assert_eq!(holes.filter(|(x, y)| is_background(&picture, *x, *y)).count(), 0);
        // Seen from aside, wires do not sink into the ground.
        let low =
            Camera { eye: world.place(0.5, -0.4, 300.0), target: world.place(0.5, 0.5, 30.0), ..camera };
        let dark_of = |look: &Look| {
            let picture = self::picture(&world, &low, &items, look);
            let pixels = (0..400).flat_map(|y| (0..400).map(move |x| [x, y]));
            pixels.filter(|p| picture.pixel(*p).is_some_and(|c| c[1] < 60 && c[0] < 60)).count()
        };
        let plain = Look { wireframe: false, ..look };
        assert!(dark_of(&look) > 1000 && dark_of(&plain) == 0, "{} {}", dark_of(&look), dark_of(&plain));
    }
}

#[test]
fn exaggeration_stretches_heights() {
    // A wall across the middle, seen from the south: the outline of its top rises as its height does.
    let world = World::new(Forest::new(5, 3, [1, 1]).unwrap(), 30.0, |_, y| if y == 16 { 400 } else { 0 });
    let camera = Camera {
        eye: world.place(0.5, -1.0, 300.0),
        target: world.place(0.5, 0.5, 0.0),
        fov_y: FOV_Y,
        size: [200, 200],
    };
    for exaggeration in [1.0, 5.0] {
        let look = Look { exaggeration, ..PLAIN };
        let picture = picture(&world, &camera, &world.level(4), &look);
        let back = pixel_of(&camera, world.place(0.5, 1.0, 0.0))[1];
        let wall = pixel_of(&camera, world.place(0.5, 0.5, 40.0 * exaggeration))[1];
        let top = (0..200).find(|y| !is_background(&picture, 100, *y)).unwrap();
        assert!((f64::from(top) - wall.min(back)).abs() < 1.5, "{exaggeration}: {top} {wall} {back}");
    }
}

#[test]
fn other_bodies_are_grey() {
    use diamantina_protocol::message::{Crs, Frame};
    let look = |proj4: Option<&str>| {
        let proj4 = proj4.map(str::to_owned);
        let crs = Crs { name: String::new(), proj4, origin: [0.0; 2], per_metre: [1.0; 2] };
        let frame = Frame { crs: Some(crs), vertical_unit: "metre".into() };
        Look::of(&Scene {
            name: "s".into(),
            version: "v".into(),
            frame,
            layers: vec![],
            zones: vec![],
            textures: vec![],
            series: vec![],
        })
    };
    for earth in [None, Some("+proj=utm +zone=11 +datum=WGS84"), Some("+proj=merc +a=6378137 +b=6378137")] {
        assert_eq!(look(earth), Look::default());
    }
    for other in ["+proj=eqc +lat_ts=0 +R=1737400", "+proj=tmerc +a=3396190 +b=3376200"] {
        let look = look(Some(other));
        assert!(look.colours == Colours::Grey && look.haze == 0.0, "{look:?}");
    }
}

#[test]
fn surfaces_are_uploaded_once_and_dropped_over_budget() {
    let world = World::new(Forest::new(5, 2, [1, 1]).unwrap(), 30.0, rough);
    let layers = std::slice::from_ref(&world.layer);
    let camera = world.overhead([64, 64]);
    let (coarse, fine) = (world.level(1), world.level(6));
    let one = (5 * 5 + 4 * 4) * 8;
    let all_else = offscreen(1, 0).frame_bytes(layers, camera.size, &PLAIN, 0);
    let fine_bytes = one * fine.len() as u64;
    // There is no room for the coarse one beside them, whatever the places of diamonds take.
    let budget_bytes = all_else + (fine_bytes + one / 2) * 64 / 63;
    let mut offscreen = offscreen(1, budget_bytes);
    let stats = offscreen.draw(layers, &camera, &coarse, &PLAIN).unwrap();
    let fixed_bytes = stats.fixed_bytes;
    assert_eq!(
        stats,
        FrameStats { triangles: 64, draws: 1, uploaded_bytes: one, gpu_bytes: one, fixed_bytes }
    );
    assert!(fixed_bytes > 64 * 64 * 4, "depth, and the index lists that all share");
    assert_eq!(offscreen.draw(layers, &camera, &coarse, &PLAIN).unwrap().uploaded_bytes, 0);
    // Another surface of the same diamond takes the place of the first.
    let again: Vec<_> = coarse
        .iter()
        .map(|item| DrawItem { surface: Arc::new((*item.surface).clone()), ..item.clone() })
        .collect();
    let stats = offscreen.draw(layers, &camera, &again, &PLAIN).unwrap();
    assert_eq!((stats.uploaded_bytes, stats.gpu_bytes), (one, one));
    let stats = offscreen.draw(layers, &camera, &fine, &PLAIN).unwrap();
    assert_eq!(stats.gpu_bytes, fine_bytes, "the coarse one went, what is drawn stayed");
    assert_eq!(stats.triangles, 32 * 32 * 2);
}

#[test]
fn sizes_and_unknown_layers_are_refused() {
    let world = World::new(Forest::new(4, 2, [1, 1]).unwrap(), 30.0, rough);
    let mut offscreen = offscreen(4, 1 << 30);
    let empty = Camera { size: [0, 4], ..world.overhead([4, 4]) };
    let result = offscreen.draw(&[], &empty, &[], &PLAIN);
    assert!(matches!(result, Err(RenderError::Size { found: [0, 4], .. })));
    // Nothing is drawn without its layer.
    let stats = offscreen.draw(&[], &world.overhead([5, 3]), &world.level(1), &PLAIN).unwrap();
    let fixed_bytes = stats.fixed_bytes;
    assert_eq!(stats, FrameStats { fixed_bytes, ..FrameStats::default() });
    assert!(is_background(&offscreen.read().unwrap(), 4, 2));
}

#[test]
fn runs_join_neighbouring_sides() {
    let sides = [0..3, 3..6, 6..9, 9..12];
    let found = |chosen| runs(&sides, chosen).map(|r| [r.start, r.end]).collect::<Vec<_>>();
    assert_eq!(found(0b1111), [[0, 12]]);
    assert_eq!(found(0b0110), [[3, 9]]);
    assert_eq!(found(0b1011), [[0, 6], [9, 12]]);
    assert_eq!(found(0b0101), [[0, 3], [6, 9]]);
    assert!(found(0).is_empty());
}

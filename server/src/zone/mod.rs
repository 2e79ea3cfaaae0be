//! Zones: which parts of a scene are seen from a region where the viewer stays, found by casting rays.
//!
//! ```text
//! polygon ──► view: eyes along the contour, at the ceiling ─┐
//! store ──► relief: heights of every sample ────────────────┴─► cast ─► a share for each sample
//!                                       the largest of each diamond ◄──┘   └─► zones of the store
//! ```
//!
//! | module | what it holds |
//! |---|---|
//! | [`polygon`] | GeoJSON to rings in the frame's metres |
//! | [`relief`] | the finest surface as a raster with a pyramid of blocks |
//! | [`tiled`] | rasters whose samples lie tile by tile in memory |
//! | [`view`] | where the eyes of a zone stand, and why that is enough |
//! | [`cast`] | what of a relief is seen from eyes, and how well the rest is hidden |
//!
//! Of each layer of terrain it is found by its own heights. Water hides nothing, and counts as seen.
//!
//! After Cifuentes, D'Amato, García Bauza, Vénere, Lotito and Clausse, *Ray casting para la definición de zonas de
//! interés en simplificación topográfica* (2007). Theirs is a binary mask; here, what is hidden by little counts for
//! more than what is hidden well: an error is let grow only as far as it stays behind what hides it.

pub mod cast;
pub mod polygon;
pub mod relief;
pub mod tiled;
pub mod view;

use crate::inspect::InspectError;
use crate::progress::Progress;
use crate::store::zones::Zones;
use crate::store::{Store, StoreError, compress};
use cast::{BEND, Eye, Optics};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::message::{Kind, Layer, Scene, is_name};
use diamantina_protocol::zone::{self, LAYERS_MAX, Mask, Part, ZONES_MAX, Zone, pack};
use polygon::{Coordinates, PolygonError, Rings, contour, perimeter};
use rayon::prelude::*;
use relief::Relief;
use std::path::{Path, PathBuf};
use std::time::Instant;
use tiled::Tiled;
use view::Ground;

/// The visibility of what is hidden, unless told otherwise: errors may be twenty times as large.
pub const HIDDEN: f64 = 0.05;

/// The angle of a pixel, unless told otherwise, in radians: that of 45 degrees over 785 pixels.
pub const ANGLE: f64 = 1e-3;

/// The least apparent width of a triangle that counts, unless told otherwise: as much, so that two rays pass a pixel.
pub const EPSILON: f64 = ANGLE;

/// Cells between eyes, unless told otherwise, ...
pub const SPACING_CELLS: f64 = 4.0;

/// ... and the most eyes along all contours then.
pub const EYES: f64 = 200.0;

/// The most eyes, however told.
pub(crate) const EYES_MAX: usize = 1 << 16;

/// Bytes of memory for a sample: its height, its share of the blocks, its visibility.
const SAMPLE_BYTES: f64 = 5.8;

/// Bytes of memory for a diamond while its layer is read: an entry of the index.
const DIAMOND_BYTES: u64 = 50;

/// Bytes of memory of a thread that decodes a chunk.
const DECODER_BYTES: u64 = 64 << 20;

/// Diamonds whose samples are looked at together.
const DIAMONDS_AT_ONCE: usize = 1 << 16;

/// What zone to compute.
#[derive(Debug, Clone)]
pub struct Options {
    /// The name in addresses.
    pub name: String,
    /// The file with the polygon.
    pub polygon: PathBuf,
    /// What its numbers mean.
    pub coordinates: Coordinates,
    /// Metres of the eye above the highest ground.
    pub eye: f64,
    /// The height of the ground in metres where the layers have none (and at least, where they have), as of a lake.
    pub level: Option<f64>,
    /// The visibility of what is hidden: 0 to below 1.
    pub hidden: f64,
    /// See [`Optics::angle`].
    pub angle: f64,
    /// See [`Optics::epsilon`].
    pub epsilon: f64,
    /// Metres between eyes along the contour.
    pub spacing: Option<f64>,
    /// Whether the Earth is round.
    pub curvature: bool,
    /// Whether a zone of this name is replaced.
    pub replace: bool,
    /// The most memory, in bytes.
    pub memory: u64,
}

/// Why there is no zone.
#[derive(Debug, thiserror::Error)]
pub enum ZoneError {
    /// The store cannot be read or written.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The store is damaged.
    #[error(transparent)]
    Inspect(#[from] InspectError),
    /// The polygon is none.
    #[error(transparent)]
    Polygon(#[from] PolygonError),
    /// An option makes no sense.
    #[error("{option} {found}: expected {expected}")]
    Option {
        /// The option.
        option: &'static str,
        /// What it says.
        found: String,
        /// What is expected.
        expected: String,
    },
    /// There is one.
    #[error("scene '{scene}' has a zone '{name}' already: give it another --name, or say --replace")]
    Exists {
        /// The scene.
        scene: String,
        /// The zone.
        name: String,
    },
    /// There is none.
    #[error("scene '{scene}' has no zone '{name}'{}", if .zones.is_empty() { "; it has none at all".to_owned() } else { format!(": it has {}", .zones.join(", ")) })]
    Unknown {
        /// The scene.
        scene: String,
        /// The zone.
        name: String,
        /// Those that there are.
        zones: Vec<String>,
    },
    /// Too many.
    #[error("scene '{0}' has {ZONES_MAX} zones already: remove one with --remove")]
    Many(String),
    /// The polygon lies elsewhere.
    #[error(
        "{path}: the zone reaches from ({}, {}) to ({}, {}) in the frame's metres, the terrain from ({}, {}) to ({}, {}): \
         expected a polygon within it{}",
        .zone[0][0].round(), .zone[0][1].round(), .zone[1][0].round(), .zone[1][1].round(),
        .scene[0][0].round(), .scene[0][1].round(), .scene[1][0].round(), .scene[1][1].round(),
        if *.degrees { "" } else { " (its coordinates were taken for metres of the frame)" }
    )]
    Outside {
        /// The file.
        path: PathBuf,
        /// The box around the polygon.
        zone: [[f64; 2]; 2],
        /// The box around the terrain.
        scene: [[f64; 2]; 2],
        /// Whether the scene's frame has a projection.
        degrees: bool,
    },
    /// Nowhere to stand.
    #[error("{path}: polygon {number} has no heights in it: say how high its surface is with --level METRES")]
    Bottomless {
        /// The file.
        path: PathBuf,
        /// From 1.
        number: usize,
    },
    /// Too many eyes.
    #[error("{eyes} places along the contour, at most {EYES_MAX}: choose a larger --spacing")]
    Eyes {
        /// How many.
        eyes: usize,
    },
    /// Too little memory.
    #[error(
        "needs {needed} bytes of memory ({SAMPLE_BYTES} a sample, {DIAMOND_BYTES} a diamond, {DECODER_BYTES} a thread), \
         --memory allows {given}: allow more, or fewer --threads"
    )]
    Memory {
        /// Bytes needed.
        needed: u64,
        /// Bytes allowed.
        given: u64,
    },
    /// The compressor failed.
    #[error("cannot compress the masks: {0}")]
    Compression(std::io::Error),
    /// Told to stop.
    #[error("interrupted: the store is as it was")]
    Interrupted,
}

/// What was computed.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Report {
    /// The scene's name.
    pub scene: String,
    /// Its version now.
    pub version: String,
    /// Its version before.
    pub version_before: String,
    /// The zone, as the scene tells it.
    pub zone: Zone,
    /// Metres between the lowest and the highest ceiling of its parts.
    pub ceilings_apart: f64,
    /// Eyes along the contour.
    pub eyes: usize,
    /// Metres between them.
    pub spacing: f64,
    /// Azimuths that were looked at, over all eyes.
    pub azimuths: u64,
    /// Samples of the terrain that have data.
    pub samples: u64,
    /// Samples that are seen, or by their angle as good as seen.
    pub samples_seen: u64,
    /// Samples that are hidden.
    pub samples_hidden: u64,
    /// Diamonds of the terrain's finest level that have data.
    pub diamonds: u64,
    /// Those of them that are hidden.
    pub diamonds_hidden: u64,
    /// Bytes of the masks before compression.
    pub mask_bytes: u64,
    /// Seconds to read the heights.
    pub seconds_reading: f64,
    /// Seconds to cast the rays.
    pub seconds_casting: f64,
    /// Seconds in all.
    pub seconds: f64,
}

/// Computes a zone and adds it to the store at `root`. The scene has another version then; it is published
/// atomically.
///
/// # Errors
/// When the options or the polygon make no sense for the scene, memory does not suffice, the disk fails, or
/// `progress` is told to stop. The store is then as it was.
pub fn add(root: &Path, options: &Options, progress: &Progress) -> Result<Report, ZoneError> {
    let started = Instant::now();
    check(options)?;
    let zones = Zones::open(root)?;
    let store = zones.store();
    let scene = store.scene();
    let is_there = scene.zones.iter().any(|zone| zone.name == options.name);
    if is_there && !options.replace {
        return Err(ZoneError::Exists { scene: scene.name.clone(), name: options.name.clone() });
    }
    if !is_there && scene.zones.len() >= ZONES_MAX {
        return Err(ZoneError::Many(scene.name.clone()));
    }
    let polygons = polygon::read(&options.polygon, scene.frame.crs.as_ref(), options.coordinates)?;
    check_memory(scene, options)?;
    let (grounds, highest) = read(store, &polygons, progress)?;
    refuse_outside(scene, &grounds, &polygons, options)?;
    let seconds_reading = started.elapsed().as_secs_f64();
    let parts = parts(&grounds, &highest, &polygons, options)?;
    let (eyes, spacing) = eyes(&grounds, &parts, options)?;
    let mut tally = Tally::default();
    let mut masks = Vec::with_capacity(grounds.len());
    progress.stage("zone", "eyes", (eyes.len() * grounds.len()) as u64, 0);
    let mut grounds = grounds.iter();
    let floor = pack(options.hidden);
    for layer in &scene.layers {
        let ground = if is_step(scene, layer) { None } else { grounds.next() };
        let (shares, relief) = match (layer.kind, ground) {
            (Kind::Terrain, Some(ground)) => {
                tally.azimuths +=
                    eyes.iter().map(|(p, z)| azimuths(ground, ground.eye(*p, *z), options)).sum::<u64>();
                let shares = shares(ground, &polygons, &eyes, options, progress);
                (shares.ok_or(ZoneError::Interrupted)?, Some(&ground.relief))
            }
            // Water is seen through, so it hides nothing, itself included; and what ground hides of it is not looked at.
            _ => {
                progress.advance(if ground.is_some() { eyes.len() as u64 } else { 0 });
                (Tiled::filled(layer.samples.map(|side| side as usize), u8::MAX), None)
            }
        };
        let finest = finest_shares(layer, &shares, relief, floor);
        if let Some(relief) = relief {
            tally.samples(&shares, relief, floor);
            tally.diamonds(&finest, floor);
        }
        let finest = finest.into_iter().map(|share| share.unwrap_or(floor)).collect();
        masks.push(Mask::saturated(layer.forest, floor, scene.layers.len(), finest));
    }
    progress.finish();
    let seconds_casting = started.elapsed().as_secs_f64() - seconds_reading;
    let bytes = zone::encode(&masks);
    let blob = compress(&bytes).map_err(ZoneError::Compression)?;
    let ceilings = parts.iter().map(|part| part.ceiling);
    let ceilings_apart =
        ceilings.clone().fold(f64::NEG_INFINITY, f64::max) - ceilings.fold(f64::INFINITY, f64::min);
    let zone = Zone {
        name: options.name.clone(),
        eye: options.eye,
        hidden: options.hidden,
        angle: options.angle,
        curvature: options.curvature,
        parts,
        bytes: blob.len() as u64,
    };
    let mut all = zones.read()?;
    all.retain(|(other, _)| other.name != zone.name);
    all.push((zone.clone(), blob.into()));
    all.sort_by(|(a, _), (b, _)| a.name.cmp(&b.name));
    let published = zones.publish(&all)?;
    Ok(Report {
        scene: scene.name.clone(),
        version: published.version,
        version_before: scene.version.clone(),
        zone,
        ceilings_apart,
        eyes: eyes.len(),
        spacing,
        azimuths: tally.azimuths,
        samples: tally.samples,
        samples_seen: tally.samples_seen,
        samples_hidden: tally.samples_hidden,
        diamonds: tally.diamonds,
        diamonds_hidden: tally.diamonds_hidden,
        mask_bytes: bytes.len() as u64,
        seconds_reading,
        seconds_casting,
        seconds: started.elapsed().as_secs_f64(),
    })
}

/// Removes a zone from the store at `root`; the scene as it is then. Without zones it has the version that it had
/// before the first.
///
/// # Errors
/// When there is no such zone or store, or the disk fails.
pub fn remove(root: &Path, name: &str) -> Result<Scene, ZoneError> {
    let zones = Zones::open(root)?;
    let mut all = zones.read()?;
    let scene = zones.store().scene();
    if !scene.zones.iter().any(|zone| zone.name == name) {
        let zones = scene.zones.iter().map(|zone| zone.name.clone()).collect();
        return Err(ZoneError::Unknown { scene: scene.name.clone(), name: name.to_owned(), zones });
    }
    all.retain(|(zone, _)| zone.name != name);
    Ok(zones.publish(&all)?)
}

fn check(options: &Options) -> Result<(), ZoneError> {
    let wrong = |option, found: &dyn std::fmt::Display, expected: &str| {
        Err(ZoneError::Option { option, found: found.to_string(), expected: expected.to_owned() })
    };
    let Options { name, eye, hidden, angle, epsilon, spacing, level, .. } = options;
    if !is_name(name) {
        return wrong(
            "--name",
            &format!("'{name}'"),
            "1 to 64 letters, digits, '-', '_' or '.', not starting with '.'",
        );
    }
    if !(*eye > 0.0 && *eye <= 1e6) {
        return wrong("--eye", eye, "metres above the ground, above 0 and at most a million");
    }
    if !(0.0..1.0).contains(hidden) || pack(*hidden) == u8::MAX {
        return wrong(
            "--hidden",
            hidden,
            "0 to 0.996: what the errors of hidden ground count for, in 255ths",
        );
    }
    if !(0.0..=0.1).contains(angle) {
        return wrong("--angle", angle, "radians, 0 to 0.1");
    }
    if !(1e-6..=0.1).contains(epsilon) {
        return wrong("--epsilon", epsilon, "radians, 0.000001 to 0.1");
    }
    if let Some(spacing) = spacing.filter(|s| !(*s > 0.0 && s.is_finite())) {
        return wrong("--spacing", &spacing, "metres, above 0");
    }
    if let Some(level) = level.filter(|l| l.is_nan() || l.abs() > 1e6) {
        return wrong("--level", &level, "metres, as the scene's heights are");
    }
    Ok(())
}

fn check_memory(scene: &Scene, options: &Options) -> Result<(), ZoneError> {
    let of = |layer: &Layer| layer.samples.iter().map(|s| u64::from(*s)).product::<u64>();
    let (steps, others): (Vec<&Layer>, Vec<&Layer>) =
        scene.layers.iter().partition(|layer| is_step(scene, layer));
    // One step of a series after the other.
    let samples: u64 = others.into_iter().map(of).sum::<u64>() + steps.into_iter().map(of).max().unwrap_or(0);
    let diamonds: u64 = scene.layers.iter().map(|l| zone::bytes_max(&[l.forest]) as u64).max().unwrap_or(0);
    // Readers of chunks are done before rays are cast.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "below 2^60, and an estimate")]
    let needed = (samples as f64 * SAMPLE_BYTES) as u64
        + diamonds * DIAMOND_BYTES
        + rayon::current_num_threads() as u64 * DECODER_BYTES;
    if needed > options.memory || scene.layers.len() > LAYERS_MAX {
        return Err(ZoneError::Memory { needed, given: options.memory });
    }
    Ok(())
}

/// Whether a layer is a step of a series.
fn is_step(scene: &Scene, layer: &Layer) -> bool {
    scene.series.iter().any(|series| series.layers.contains(&layer.name))
}

/// Of each polygon the highest that is known of it so far.
type Highest = Vec<Option<f64>>;

/// The finest surfaces of all layers but the steps of series, and how high those are in the polygons: steps hide nothing,
/// and all of them at once would take as many times the memory.
fn read(store: &Store, polygons: &[Rings], progress: &Progress) -> Result<(Vec<Ground>, Highest), ZoneError> {
    let scene = store.scene();
    let layers = &scene.layers;
    let mut highest = vec![None; polygons.len()];
    progress.stage("read", "layers", layers.len() as u64, 0);
    let mut grounds = Vec::with_capacity(layers.len());
    for (number, layer) in layers.iter().enumerate() {
        // Rays are cast over samples, which triangles have not.
        if !layer.encodings.iter().any(|name| name == "points") {
            let (layer, has) = (layer.name.clone(), layer.encodings.clone());
            return Err(InspectError::NoEncoding { layer, has }.into());
        }
        let relief = Relief::read(store, u8::try_from(number).unwrap_or(u8::MAX), layer)?;
        let Layer { origin, cell, quantum, height_offset, .. } = layer;
        let ground =
            Ground { relief, origin: *origin, cell: *cell, quantum: *quantum, height_offset: *height_offset };
        if is_step(scene, layer) {
            for (rings, highest) in polygons.iter().zip(&mut highest) {
                let held = ground.holds(std::slice::from_ref(rings));
                let here = if held { ground.highest(rings) } else { None };
                *highest = (*highest).into_iter().chain(here).reduce(f64::max);
            }
        } else {
            grounds.push(ground);
        }
        progress.advance(1);
        if progress.is_stopping() {
            return Err(ZoneError::Interrupted);
        }
    }
    Ok((grounds, highest))
}

/// A zone lies within the terrain; other layers may reach less far.
fn refuse_outside(
    scene: &Scene,
    grounds: &[Ground],
    polygons: &[Rings],
    options: &Options,
) -> Result<(), ZoneError> {
    let terrains = scene.layers.iter().zip(grounds).filter(|(layer, _)| layer.kind == Kind::Terrain);
    let mut terrains = terrains.map(|(_, ground)| ground).peekable();
    let extent = terrains.peek().map_or([[0.0; 2]; 2], |ground| ground.extent());
    if terrains.any(|ground| ground.holds(polygons)) {
        return Ok(());
    }
    let corners = polygons.iter().flatten().flatten();
    let zone = corners.fold([[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]], |[low, high], p| {
        [[low[0].min(p[0]), low[1].min(p[1])], [high[0].max(p[0]), high[1].max(p[1])]]
    });
    let degrees = options.coordinates != Coordinates::Frame
        && scene.frame.crs.as_ref().is_some_and(|crs| crs.proj4.is_some());
    Err(ZoneError::Outside { path: options.polygon.clone(), zone, scene: extent, degrees })
}

/// The polygons with their ceilings.
fn parts(
    grounds: &[Ground],
    steps: &Highest,
    polygons: &[Rings],
    options: &Options,
) -> Result<Vec<Part>, ZoneError> {
    let part = |(i, rings): (usize, &Rings)| {
        let held = grounds.iter().filter(|ground| ground.holds(std::slice::from_ref(rings)));
        let all = held.filter_map(|ground| ground.highest(rings)).chain(steps[i]).chain(options.level);
        let highest = all.reduce(f64::max);
        let bottomless = || ZoneError::Bottomless { path: options.polygon.clone(), number: i + 1 };
        let ceiling = highest.ok_or_else(bottomless)? + options.eye;
        Ok(Part { ceiling: (ceiling * 1e3).ceil() / 1e3, rings: rings.clone() })
    };
    polygons.iter().enumerate().map(part).collect()
}

/// A place in the frame and a height, in metres.
type Post = ([f64; 2], f64);

/// The eyes of all parts, and how far apart they are.
fn eyes(grounds: &[Ground], parts: &[Part], options: &Options) -> Result<(Vec<Post>, f64), ZoneError> {
    let cells = grounds.iter().flat_map(|ground| ground.cell);
    let cell = cells.fold(f64::INFINITY, f64::min);
    let around: f64 = parts.iter().map(|part| perimeter(&part.rings)).sum();
    let spacing = options.spacing.unwrap_or((SPACING_CELLS * cell).max(around / EYES));
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates, and is a bound")]
    let count = (around / spacing) as usize;
    if count > EYES_MAX {
        return Err(ZoneError::Eyes { eyes: count });
    }
    let of = |part: &Part| {
        let ceiling = part.ceiling;
        contour(&part.rings, spacing).into_iter().map(move |point| (point, ceiling))
    };
    Ok((parts.iter().flat_map(of).collect(), spacing))
}

fn optics(ground: &Ground, options: &Options) -> Optics {
    Optics {
        cell: ground.cell,
        quantum: ground.quantum,
        bend: if options.curvature { BEND } else { 0.0 },
        epsilon: options.epsilon,
        hidden: options.hidden,
        angle: options.angle,
    }
}

fn azimuths(ground: &Ground, eye: Eye, options: &Options) -> u64 {
    optics(ground, options).azimuths(&ground.relief, eye.place) as u64
}

/// The visibility of each sample of a layer, in 255ths; `None` if told to stop. A layer that does not reach all of
/// the zone counts as seen.
#[must_use]
pub fn shares(
    ground: &Ground,
    polygons: &[Rings],
    eyes: &[Post],
    options: &Options,
    progress: &Progress,
) -> Option<Tiled<u8>> {
    if !ground.holds(polygons) {
        progress.advance(eyes.len() as u64);
        return Some(Tiled::filled(ground.relief.size(), u8::MAX));
    }
    let placed: Vec<Eye> = eyes.iter().map(|(point, metres)| ground.eye(*point, *metres)).collect();
    let mut shares = cast::cast(&ground.relief, &optics(ground, options), &placed, progress)?;
    for rings in polygons {
        ground.own(rings, |at| shares.set(at, u8::MAX));
    }
    Some(shares)
}

/// What has data, and how much of it is seen.
#[derive(Default)]
struct Tally {
    azimuths: u64,
    samples: u64,
    samples_seen: u64,
    samples_hidden: u64,
    diamonds: u64,
    diamonds_hidden: u64,
}

impl Tally {
    fn samples(&mut self, shares: &Tiled<u8>, relief: &Relief, floor: u8) {
        let [width, height] = relief.size();
        let places = (0..height).flat_map(|y| (0..width).map(move |x| [x, y]));
        for at in places.filter(|at| relief.at(*at) != NODATA) {
            let share = shares.at(at);
            self.samples += 1;
            self.samples_seen += u64::from(share == u8::MAX);
            self.samples_hidden += u64::from(share == floor);
        }
    }

    fn diamonds(&mut self, finest: &[Option<u8>], floor: u8) {
        self.diamonds += finest.iter().flatten().count() as u64;
        self.diamonds_hidden += finest.iter().flatten().filter(|share| **share == floor).count() as u64;
    }
}

/// The visibility of each diamond of the finest level: the largest of its samples, borders included; `None` where none
/// has data. Of a layer without relief nothing is known, and all of it is as visible as its shares say.
fn finest_shares(layer: &Layer, shares: &Tiled<u8>, relief: Option<&Relief>, floor: u8) -> Vec<Option<u8>> {
    let forest = &layer.forest;
    let level = forest.levels() - 1;
    let [width, height] = layer.samples.map(i64::from);
    let places: Vec<[usize; 2]> = Block::empty(forest, level).places().collect();
    let largest = |d: &Diamond| {
        let local = forest.local(*d);
        let mut largest = None;
        for [p, q] in places.iter().filter(|[p, q]| local.upper || q <= p) {
            #[allow(clippy::cast_possible_wrap, reason = "at most 256")]
            let [x, y] = local.lattice2([*p as i64, *q as i64]);
            if x < width && y < height {
                #[allow(
                    clippy::cast_possible_truncation,
                    clippy::cast_sign_loss,
                    reason = "within the layer"
                )]
                let at = [x as usize, y as usize];
                if relief.is_none_or(|relief| relief.at(at) != NODATA) {
                    largest = largest.max(Some(shares.at(at).max(floor)));
                }
            }
        }
        largest
    };
    let mut finest = Vec::new();
    let mut diamonds = forest.diamonds(level).peekable();
    while diamonds.peek().is_some() {
        let some: Vec<Diamond> = diamonds.by_ref().take(DIAMONDS_AT_ONCE).collect();
        finest.par_extend(some.par_iter().map(largest));
    }
    finest
}

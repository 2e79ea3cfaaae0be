//! What a store holds: levels, bytes, errors; and, on request, whether every blob is intact.

mod texture;
mod tin;

pub use tin::{TinInspection, TinLevel};

use crate::chunks::Chunks;
use crate::store::{Key, Kind, Store, StoreError, zones};
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::index::{self, Entry, PageError};
use diamantina_protocol::message::{Layer, Scene};
use diamantina_protocol::points::{self, DecodeError, Tally};
use diamantina_protocol::zone::{self, Mask};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};

/// Base-2 logarithm of the side of the chunks that are verified at once: some tens of megabytes each.
const VERIFY_CHUNK_LOG2: u32 = 10;

/// Blobs whose checksums are compared at once.
const BLOBS_AT_ONCE: usize = 64;

/// Why a store could not be inspected, or what is wrong with it.
#[derive(Debug, thiserror::Error)]
pub enum InspectError {
    /// The store cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A page of the index is not there.
    #[error("layer {layer}: index page {page} is missing; build the store again")]
    NoPage {
        /// The layer.
        layer: String,
        /// The page.
        page: u32,
    },
    /// The layer was built without points.
    #[error(
        "layer {layer} has no points, only {has:?}: build the store again with --encoding points, or with both"
    )]
    NoEncoding {
        /// The layer.
        layer: String,
        /// What it has.
        has: Vec<String>,
    },
    /// A page of the index cannot be read.
    #[error("layer {layer}: {error}")]
    Page {
        /// The layer.
        layer: String,
        /// Why not.
        error: PageError,
    },
    /// A page cannot be decompressed.
    #[error("layer {layer}: index page {page} is no zstd frame ({error}); build the store again")]
    Compression {
        /// The layer.
        layer: String,
        /// The page.
        page: u32,
        /// What the decompressor said.
        error: std::io::Error,
    },
    /// A payload is not there.
    #[error("layer {layer}: the payload of diamond {centre:?} is missing; build the store again")]
    NoPoints {
        /// The layer.
        layer: String,
        /// The diamond.
        centre: [u32; 2],
    },
    /// A payload is not what the index says.
    #[error(
        "layer {layer}: the payload of diamond {centre:?} has {found} bytes, the index says {expected}; build the store again"
    )]
    Size {
        /// The layer.
        layer: String,
        /// The diamond.
        centre: [u32; 2],
        /// Bytes found.
        found: u32,
        /// Bytes expected.
        expected: u32,
    },
    /// A payload cannot be decoded.
    #[error("layer {layer}: the points of diamond {centre:?}: {error}")]
    Points {
        /// The layer.
        layer: String,
        /// The diamond.
        centre: [u32; 2],
        /// Why not.
        error: DecodeError,
    },
    /// Triangles cannot be decoded.
    #[error("layer {layer}: the triangles of diamond {centre:?}: {error}")]
    Triangles {
        /// The layer.
        layer: String,
        /// The diamond.
        centre: [u32; 2],
        /// Why not.
        error: diamantina_protocol::tin::DecodeError,
    },
    /// Triangles do not fit their neighbours.
    #[error(
        "layer {layer}: the triangles of diamond {centre:?} do not fit their neighbours' along the line {line:?}; build the store again"
    )]
    Crack {
        /// The layer.
        layer: String,
        /// The diamond.
        centre: [u32; 2],
        /// From where to where.
        line: [[u32; 2]; 2],
    },
    /// The masks of a zone are missing or wrong.
    #[error("zone '{zone}': {what}; compute it again with --replace")]
    Zone {
        /// The zone.
        zone: String,
        /// What is wrong.
        what: String,
    },
    /// The tiles of a texture are missing or wrong.
    #[error("texture '{texture}': {what}; build the store again")]
    Texture {
        /// The texture.
        texture: String,
        /// What is wrong.
        what: String,
    },
    /// Something is in the store that nobody asks for.
    #[error("layer {layer}: {count} blobs belong to no diamond; build the store again")]
    Strays {
        /// The layer.
        layer: String,
        /// How many.
        count: usize,
    },
}

/// A store in numbers.
#[derive(Debug, Serialize)]
pub struct Inspection {
    /// The scene.
    pub scene: Scene,
    /// Its layers.
    pub layers: Vec<LayerInspection>,
    /// Whether every blob was read, checked and decoded.
    pub verified: bool,
}

/// A layer in numbers.
#[derive(Debug, Serialize)]
pub struct LayerInspection {
    /// The layer's name.
    pub name: String,
    /// Samples of the source with a height.
    pub valid_samples: u64,
    /// Bytes of all points.
    pub point_bytes: u64,
    /// Bytes of the index.
    pub index_bytes: u64,
    /// Bits of points a sample with a height.
    pub bits_per_sample: f64,
    /// By level of diamonds.
    pub levels: Vec<LevelInspection>,
    /// The largest error, in metres, where every diamond is split.
    pub finest_error: f32,
    /// How errors were found.
    pub errors: String,
    /// New points by kind, if the blobs were verified.
    pub real_points: Option<u64>,
    /// See `real_points`.
    pub fictitious_points: Option<u64>,
    /// The encoding `tin`, if the layer has it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tin: Option<TinInspection>,
}

/// The diamonds of a level in numbers.
#[derive(Debug, Default, Serialize)]
pub struct LevelInspection {
    /// The level.
    pub level: u32,
    /// Diamonds with some height below them.
    pub diamonds: u64,
    /// Bytes of their points.
    pub bytes: u64,
    /// Steps, in metres: of most points that the level adds.
    pub step: f64,
    /// The least declared error, in metres.
    pub error_min: f32,
    /// The largest declared error, in metres.
    pub error_max: f32,
}

/// All entries of a layer's index.
///
/// # Errors
/// When a page is missing or damaged.
pub fn entries(store: &Store, number: u8, layer: &Layer) -> Result<HashMap<Diamond, Entry>, InspectError> {
    let mut all = HashMap::new();
    for page in 0..index::pages(&layer.forest) {
        all.extend(read_page(store, number, layer, Kind::Index, page)?);
    }
    Ok(all)
}

/// One page of a layer's index: of points, or of triangles ([`Kind::TinIndex`]).
///
/// # Errors
/// When it is missing or damaged.
pub fn read_page(
    store: &Store,
    number: u8,
    layer: &Layer,
    kind: Kind,
    page: u32,
) -> Result<Vec<(Diamond, Entry)>, InspectError> {
    let name = || layer.name.clone();
    let forest =
        layer.tin.as_ref().filter(|_| kind == Kind::TinIndex).map_or(&layer.forest, |tin| &tin.forest);
    let key = Key { layer: number, kind, a: page, b: 0 };
    let blob = store.get(key)?.ok_or_else(|| InspectError::NoPage { layer: name(), page })?;
    let bytes = zstd::bulk::decompress(&blob, 4 * index::PAGE_BYTES_MAX)
        .map_err(|error| InspectError::Compression { layer: name(), page, error })?;
    index::decode(forest, page, &bytes).map_err(|error| InspectError::Page { layer: name(), error })
}

/// Reads the index of a store and, with `verify`, every blob: checksums, sizes, and that each payload
/// decodes from its ancestors.
///
/// # Errors
/// At the first thing that is wrong.
pub fn inspect(store: &Store, verify: bool) -> Result<Inspection, InspectError> {
    let mut layers = Vec::new();
    for (number, layer) in store.scene().layers.iter().enumerate() {
        let number = u8::try_from(number).unwrap_or(u8::MAX);
        let has_points = layer.encodings.iter().any(|e| e == "points");
        let entries = if has_points { entries(store, number, layer)? } else { HashMap::new() };
        let index_bytes = sizes(store, number, layer, &entries)?;
        let tally =
            if verify && has_points { Some(verify_layer(store, number, layer, &entries)?) } else { None };
        let triangles =
            layer.tin.as_ref().map(|tin| tin::inspect(store, number, layer, tin, verify)).transpose()?;
        layers.push(LayerInspection { tin: triangles, ..summary(layer, &entries, index_bytes, tally) });
    }
    for (number, texture) in (0u8..).zip(&store.scene().textures) {
        texture::inspect(store, number, texture, verify)?;
    }
    for position in 0..if verify { store.scene().zones.len() } else { 0 } {
        masks(store, position)?;
    }
    Ok(Inspection { scene: store.scene().clone(), layers, verified: verify })
}

/// What is wrong with blobs by their checksums, or by what the disk says of them: of all there are, as they lie.
#[must_use]
pub fn damaged(store: &Store) -> Vec<StoreError> {
    let wrong = |keys: &[Key]| store.get_many(keys).into_iter().filter_map(Result::err).collect::<Vec<_>>();
    store.keys_in_order().par_chunks(BLOBS_AT_ONCE).flat_map_iter(wrong).collect()
}

/// Compares the sizes of a layer's points with its index; the bytes of the pages.
fn sizes(
    store: &Store,
    number: u8,
    layer: &Layer,
    entries: &HashMap<Diamond, Entry>,
) -> Result<u64, InspectError> {
    let (mut index_bytes, mut strays) = (0, 0);
    for (key, found) in store.keys().filter(|(key, _)| key.layer == number) {
        match key.kind {
            Kind::Index => index_bytes += u64::from(found),
            Kind::Points => {
                let centre = [key.a, key.b];
                match layer.forest.diamond(centre).and_then(|d| entries.get(&d)) {
                    Some(e) if e.bytes == found => {}
                    Some(e) => {
                        let (layer, expected) = (layer.name.clone(), e.bytes);
                        return Err(InspectError::Size { layer, centre, found, expected });
                    }
                    None => strays += 1,
                }
            }
            Kind::Zone | Kind::Tin | Kind::TinIndex | Kind::Texture | Kind::TextureIndex => {}
        }
    }
    if strays > 0 {
        return Err(InspectError::Strays { layer: layer.name.clone(), count: strays });
    }
    Ok(index_bytes)
}

/// The masks of the zone at a position in the scene, one a layer.
///
/// # Errors
/// When they are missing or damaged.
pub fn masks(store: &Store, position: usize) -> Result<Vec<Mask>, InspectError> {
    let scene = store.scene();
    let name = scene.zones.get(position).map_or_else(String::new, |zone| zone.name.clone());
    let wrong = |what: String| InspectError::Zone { zone: name.clone(), what };
    let blob = store.get(zones::key(position))?.ok_or_else(|| wrong("its masks are missing".to_owned()))?;
    let forests: Vec<_> = scene.layers.iter().map(|layer| layer.forest).collect();
    let bytes = zstd::bulk::decompress(&blob, zone::bytes_max(&forests))
        .map_err(|e| wrong(format!("its masks do not decompress ({e})")))?;
    zone::decode(&forests, &bytes).map_err(|e| wrong(e.to_string()))
}

fn summary(
    layer: &Layer,
    entries: &HashMap<Diamond, Entry>,
    index_bytes: u64,
    tally: Option<(u64, u64)>,
) -> LayerInspection {
    let mut levels: Vec<LevelInspection> = (0..layer.forest.levels())
        .map(|level| LevelInspection {
            level,
            error_min: f32::MAX,
            step: f64::from(layer.coding.level_step(level)) * layer.quantum,
            ..LevelInspection::default()
        })
        .collect();
    for (d, e) in entries.iter().filter(|(_, e)| !e.is_empty()) {
        let level = &mut levels[d.level() as usize];
        level.diamonds += 1;
        level.bytes += u64::from(e.bytes);
        level.error_min = level.error_min.min(e.error_metres);
        level.error_max = level.error_max.max(e.error_metres);
    }
    for level in levels.iter_mut().filter(|l| l.diamonds == 0) {
        level.error_min = 0.0;
    }
    let point_bytes = levels.iter().map(|l| l.bytes).sum();
    LayerInspection {
        name: layer.name.clone(),
        valid_samples: layer.valid_samples,
        point_bytes,
        index_bytes,
        bits_per_sample: point_bytes as f64 * 8.0 / layer.valid_samples as f64,
        levels,
        finest_error: layer.finest_error,
        errors: layer.errors.clone(),
        real_points: tally.map(|t| t.0),
        fictitious_points: tally.map(|t| t.1),
        tin: None,
    }
}

/// A layer's payloads, to be decoded.
struct Payloads<'a> {
    store: &'a Store,
    number: u8,
    layer: &'a Layer,
    entries: &'a HashMap<Diamond, Entry>,
}

impl Payloads<'_> {
    /// Decodes some diamonds of a level, given the blocks of the level before. Diamonds without any height
    /// are left out.
    fn decode(
        &self,
        diamonds: impl IntoParallelIterator<Item = Diamond>,
        before: &HashMap<Diamond, Block>,
    ) -> Result<Vec<(Diamond, Block, Tally)>, InspectError> {
        let forest = &self.layer.forest;
        let filled = diamonds.into_par_iter().filter(|d| self.entries.get(d).is_some_and(|e| !e.is_empty()));
        filled
            .map(|d| {
                let mut block = Block::empty(forest, d.level());
                for parent in forest.parents(d) {
                    if let Some(from) = before.get(&parent) {
                        block.inherit(forest, d, parent, from);
                    }
                }
                let [a, b] = d.centre();
                let (layer, centre) = (|| self.layer.name.clone(), [a, b]);
                let payload = self.store.get(Key { layer: self.number, kind: Kind::Points, a, b })?;
                if payload.is_none() && self.entries.get(&d).is_some_and(|e| e.bytes > 0) {
                    return Err(InspectError::NoPoints { layer: layer(), centre });
                }
                let tally =
                    points::decode(forest, &self.layer.coding, d, &mut block, &payload.unwrap_or_default())
                        .map_err(|error| InspectError::Points { layer: layer(), centre, error })?;
                Ok((d, block, tally))
            })
            .collect()
    }
}

fn blocks(decoded: Vec<(Diamond, Block, Tally)>) -> HashMap<Diamond, Block> {
    decoded.into_iter().map(|(d, block, _)| (d, block)).collect()
}

/// Decodes every diamond of a layer, chunk by chunk; the real and the fictitious points.
fn verify_layer(
    store: &Store,
    number: u8,
    layer: &Layer,
    entries: &HashMap<Diamond, Entry>,
) -> Result<(u64, u64), InspectError> {
    let payloads = Payloads { store, number, layer, entries };
    let chunks = Chunks::new(layer.forest, VERIFY_CHUNK_LOG2);
    let (real, fictitious) = (AtomicU64::new(0), AtomicU64::new(0));
    by_chunks(&payloads, &chunks, |corner, decoded| {
        let owned = decoded.iter().filter(|(d, _, _)| corner.is_none_or(|corner| chunks.owns(corner, *d)));
        for (_, _, tally) in owned {
            real.fetch_add(u64::from(tally.real), Ordering::Relaxed);
            fictitious.fetch_add(u64::from(tally.fictitious), Ordering::Relaxed);
        }
    })?;
    Ok((real.into_inner(), fictitious.into_inner()))
}

/// Decodes a layer, chunk by chunk, and shows the blocks of its finest level to `visit`, some more than once and
/// in any order: their heights are those of every sample. Takes some 50 MB a thread besides the index.
///
/// # Errors
/// When the index or a payload is missing or damaged.
pub fn decode_finest(
    store: &Store,
    number: u8,
    layer: &Layer,
    visit: impl Fn(&[(Diamond, Block, Tally)]) + Sync,
) -> Result<(), InspectError> {
    let entries = entries(store, number, layer)?;
    let payloads = Payloads { store, number, layer, entries: &entries };
    let chunks = Chunks::new(layer.forest, VERIFY_CHUNK_LOG2);
    by_chunks(&payloads, &chunks, |_, decoded| {
        if decoded.first().is_some_and(|(d, _, _)| d.level() + 1 == layer.forest.levels()) {
            visit(decoded);
        }
    })
}

/// Decodes a layer level by level: the coarse levels, then each chunk, many at once. `visit` sees what was
/// decoded of a level, and in which chunk.
fn by_chunks(
    payloads: &Payloads<'_>,
    chunks: &Chunks,
    visit: impl Fn(Option<[u32; 2]>, &[(Diamond, Block, Tally)]) + Sync,
) -> Result<(), InspectError> {
    let forest = &payloads.layer.forest;
    let mut coarse = HashMap::new();
    for level in 0..chunks.level() {
        let decoded = payloads.decode(forest.diamonds(level).collect::<Vec<_>>(), &coarse)?;
        visit(None, &decoded);
        coarse = blocks(decoded);
    }
    chunks.corners().into_par_iter().try_for_each(|corner| {
        let mut before = None;
        for diamonds in chunks.needed(corner) {
            let decoded = payloads.decode(diamonds, before.as_ref().unwrap_or(&coarse))?;
            visit(Some(corner), &decoded);
            before = Some(blocks(decoded));
        }
        Ok(())
    })
}

/// Decodes a layer level by level and shows each level's blocks to `visit`, coarse to fine. For scenes
/// that fit in memory: two levels of blocks, up to 24 bytes a sample.
///
/// # Errors
/// When a payload is missing or damaged.
pub fn decode_levels(
    store: &Store,
    number: u8,
    layer: &Layer,
    entries: &HashMap<Diamond, Entry>,
    mut visit: impl FnMut(u32, &[(Diamond, Block, Tally)]),
) -> Result<(), InspectError> {
    let payloads = Payloads { store, number, layer, entries };
    let mut before = HashMap::new();
    for level in 0..layer.forest.levels() {
        let decoded = payloads.decode(layer.forest.diamonds(level).collect::<Vec<_>>(), &before)?;
        visit(level, &decoded);
        before = blocks(decoded);
    }
    Ok(())
}

//! Builds the pyramid of a texture: imagery → tiles → store.
//!
//! The finest level is read from the imagery, a row of a few tiles at a time; while its tiles are encoded, its texels are
//! averaged two by two into a plane on disk, from which the next level is made in the same way. So each pixel of the
//! source is read once (those under gutters twice), memory is a few rows of tiles a thread, and the disk holds a third
//! of the image's texels, 4 bytes each.
//!
//! Tiles are a function of the imagery and the quality, whatever the number of threads.

mod colour;
mod plane;

use crate::ingest::{Imagery, IngestError};
use crate::progress::Progress;
use crate::store::{Key, StoreError, Writer, compress};
use colour::Averages;
use diamantina_protocol::texture::{Coverage, GUTTER, INNER, SIDE, TILE_BYTES_MAX, Texture, Tile};
use plane::Plane;
use rayon::prelude::*;
use std::io;
use std::sync::Mutex;
use std::sync::PoisonError;
use std::sync::atomic::{AtomicU64, Ordering};

/// How well tiles keep the image, unless told otherwise.
pub const QUALITY: u8 = 80;

/// Of 100, tiles are the image, byte by byte.
const LOSSLESS: u8 = 100;

/// Tiles side by side that are made at once.
const RUN: u32 = 4;

/// Behind the diamonds of all layers, in the order of blobs.
const BEHIND: u64 = 3 << 62;

/// A texture to be built.
#[derive(Debug, Clone, Copy)]
pub struct TextureSource<'a> {
    /// The name in addresses.
    pub name: &'a str,
    /// Its pictures.
    pub imagery: &'a Imagery,
}

/// Why a texture could not be built.
#[derive(Debug, thiserror::Error)]
pub enum TextureError {
    /// The imagery could not be read.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// The store could not be written.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The levels could not be kept on disk.
    #[error("cannot write the working files: {0}: free some space, or choose another folder for the store")]
    Work(#[from] io::Error),
    /// More texels than a pyramid holds.
    #[error("{0}: give coarser pictures, or several textures")]
    Size(String),
    /// The encoder refused.
    #[error("tile {0:?} cannot be encoded: {1}: this is an error of the program")]
    Encode(Tile, String),
    /// Nothing is to be seen on it.
    #[error("the pictures are transparent everywhere: check their nodata value and their bands")]
    Transparent,
}

/// Texels of one level, wherever they are.
enum Level<'a> {
    Imagery(&'a Imagery),
    Plane(Plane),
}

impl Level<'_> {
    /// Texels of a window, row by row from the south; transparent beyond the image.
    fn read(&self, from: [i64; 2], size: [u32; 2], out: &mut Vec<[u8; 4]>) -> Result<(), TextureError> {
        match self {
            Self::Imagery(imagery) => Ok(imagery.read(from, size, out)?),
            Self::Plane(plane) => Ok(plane.read(from, size, out)?),
        }
    }
}

/// What a texture will be, but for what only building tells.
///
/// # Errors
/// When it is larger than a pyramid may be.
pub fn describe(source: TextureSource<'_>, quality: u8) -> Result<Texture, TextureError> {
    let grid = source.imagery.grid();
    let texture = Texture {
        name: source.name.to_owned(),
        origin: [0, 1].map(|axis| grid.origin[axis] - grid.cell[axis] / 2.0),
        texel: grid.cell,
        size: [grid.width, grid.height],
        format: "webp".to_owned(),
        quality,
        tiles: 0,
        bytes: 0,
        resampled: grid.resampled,
    };
    texture.check().map_err(TextureError::Size)?;
    Ok(texture)
}

/// Builds the tiles of the `number`th texture of a scene; `None` if `progress` was told to stop.
///
/// # Errors
/// When the imagery or the disk fails, or there is nothing to be seen.
pub fn build(
    source: TextureSource<'_>,
    number: u8,
    quality: u8,
    writer: &Writer,
    progress: &Progress,
) -> Result<Option<Texture>, TextureError> {
    let mut texture = describe(source, quality)?;
    progress.stage("tiles", "tiles", texture.grid_tiles(), 0);
    let work = Pyramid {
        number,
        texture: &texture,
        writer,
        progress,
        averages: Averages::new(),
        coverage: Mutex::new(Coverage::empty(&texture)),
        bytes: AtomicU64::new(0),
    };
    let mut level = Level::Imagery(source.imagery);
    for number in (0..texture.levels()).rev() {
        match work.level(number, &level)? {
            Some(coarser) => level = Level::Plane(coarser),
            None if progress.is_stopping() => return Ok(None),
            None => {}
        }
    }
    let coverage = work.coverage.into_inner().unwrap_or_else(PoisonError::into_inner);
    let tile_bytes = work.bytes.into_inner();
    let tiles = coverage.tiles().count() as u64;
    if tiles == 0 {
        return Err(TextureError::Transparent);
    }
    let page = compress(coverage.bytes())?;
    writer.put(Key::coverage(number), BEHIND, &page)?;
    (texture.tiles, texture.bytes) = (tiles, tile_bytes + page.len() as u64);
    Ok(Some(texture))
}

/// A pyramid being built.
struct Pyramid<'a> {
    number: u8,
    texture: &'a Texture,
    writer: &'a Writer,
    progress: &'a Progress,
    averages: Averages,
    coverage: Mutex<Coverage>,
    bytes: AtomicU64,
}

impl Pyramid<'_> {
    /// Makes the tiles of a level, and the texels of the next coarser one; nothing if there is none, or if told to stop.
    fn level(&self, level: u32, texels: &Level<'_>) -> Result<Option<Plane>, TextureError> {
        let [across, up] = self.texture.grid(level);
        let coarser = match level.checked_sub(1) {
            Some(next) => Some(Plane::new(self.writer.work_folder(), self.texture.texels(next))?),
            None => None,
        };
        let runs: Vec<(u32, u32)> =
            (0..up).flat_map(|y| (0..across.div_ceil(RUN)).map(move |run| (run * RUN, y))).collect();
        // In the order of rows, so that strips of the source are still in the cache for the next run.
        runs.par_iter().with_max_len(1).try_for_each_init(Vec::new, |window, (x, y)| {
            if self.progress.is_stopping() {
                return Ok(());
            }
            self.run(level, texels, [*x, *y], RUN.min(across - x), coarser.as_ref(), window)
        })?;
        Ok(coarser.filter(|_| !self.progress.is_stopping()))
    }

    /// Makes some tiles side by side.
    fn run(
        &self,
        level: u32,
        texels: &Level<'_>,
        [x, y]: [u32; 2],
        count: u32,
        coarser: Option<&Plane>,
        window: &mut Vec<[u8; 4]>,
    ) -> Result<(), TextureError> {
        let size = [count * INNER + 2 * GUTTER, SIDE];
        let from = [x, y].map(|tiles| i64::from(tiles) * i64::from(INNER) - i64::from(GUTTER));
        texels.read(from, size, window)?;
        let width = size[0] as usize;
        let (side, inner, gutter) = (SIDE as usize, INNER as usize, GUTTER as usize);
        for number in 0..count {
            let tile = Tile { level, x: x + number, y };
            let left = number as usize * inner;
            let row = |row: usize, margin: usize| {
                let start = row * width + left + margin;
                &window[start..start + side - 2 * margin]
            };
            let is_seen = (gutter..gutter + inner).any(|y| row(y, gutter).iter().any(|texel| texel[3] != 0));
            // Averages of a few texels among none may come to nothing; what is finer is reached through it all the same.
            let is_needed = || {
                let coverage = self.coverage.lock().unwrap_or_else(PoisonError::into_inner);
                tile.children().into_iter().any(|child| coverage.has(child))
            };
            if is_seen || is_needed() {
                let rows_from_north: Vec<[u8; 4]> =
                    (0..side).rev().flat_map(|y| row(y, 0).to_vec()).collect();
                self.put(tile, &rows_from_north)?;
            }
            self.progress.advance(1);
        }
        if let Some(plane) = coarser {
            let inner_width = count as usize * inner;
            let rows: Vec<&[[u8; 4]]> = (gutter..gutter + inner)
                .map(|y| &window[y * width + gutter..y * width + gutter + inner_width])
                .collect();
            // Texels beyond the image do not count.
            let within = [0, 1].map(|axis| {
                let left = self.texture.texels(level)[axis].saturating_sub([x, y][axis] * INNER) as usize;
                left.min([inner_width, inner][axis])
            });
            let halved = self.averages.halve(&rows, within);
            plane.write(
                [x, y].map(|tiles| tiles * INNER / 2),
                within.map(|texels| texels.div_ceil(2)),
                &halved,
            )?;
        }
        Ok(())
    }

    /// Encodes a tile's picture and keeps it.
    fn put(&self, tile: Tile, texels: &[[u8; 4]]) -> Result<(), TextureError> {
        let refused = |what: String| TextureError::Encode(tile, what);
        let mut config =
            webp::WebPConfig::new().map_err(|()| refused("no configuration of it".to_owned()))?;
        config.quality = f32::from(self.texture.quality.min(LOSSLESS));
        config.lossless = i32::from(self.texture.quality >= LOSSLESS);
        // Colours under what is transparent are nobody's: they are read as if they were not there.
        let is_opaque = texels.iter().all(|texel| texel[3] == u8::MAX);
        let picture = if is_opaque {
            let colours: Vec<u8> = texels.iter().flat_map(|[r, g, b, _]| [*r, *g, *b]).collect();
            webp::Encoder::from_rgb(&colours, SIDE, SIDE).encode_advanced(&config)
        } else {
            webp::Encoder::from_rgba(texels.as_flattened(), SIDE, SIDE).encode_advanced(&config)
        };
        let picture = picture.map_err(|error| refused(format!("{error:?}")))?;
        if picture.len() > TILE_BYTES_MAX {
            return Err(refused(format!("{} bytes, limit {TILE_BYTES_MAX}", picture.len())));
        }
        self.writer.put(Key::tile(self.number, tile), order(tile), &picture)?;
        self.bytes.fetch_add(picture.len() as u64, Ordering::Relaxed);
        self.coverage.lock().unwrap_or_else(PoisonError::into_inner).insert(tile);
        Ok(())
    }
}

/// Coarse first, then along the Morton curve.
fn order(tile: Tile) -> u64 {
    let spread = |v: u32| (0..16).fold(0u64, |out, bit| out | u64::from(v >> bit & 1) << (2 * bit));
    BEHIND | u64::from(tile.level + 1) << 32 | spread(tile.x) | spread(tile.y) << 1
}

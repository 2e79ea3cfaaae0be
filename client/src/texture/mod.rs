//! Imagery on the terrain: which tiles of a texture are wanted, which are there, and what of them is shown.
//!
//! ```text
//!  what is drawn ──► choose ──wanted──► Draping ──wishes──► fetch
//!                                          ▲ │
//!                          pictures ──► decode └──► Drape: what the renderer shows
//! ```
//!
//! The tiles shown hold the parents of each of their members, as diamonds do, so each place shows the finest tile that is
//! there, and what is coarser until then. How fine tiles have to be follows from what is drawn and from where it is seen:
//! a texel is to be as large as a pixel. Where all that is wanted is more than there is room for, what would look the
//! coarsest comes first.

mod choose;
mod coding;
mod decode;

pub use choose::{wanted, within};
pub use coding::Coding;
pub(crate) use coding::plain;
pub use decode::TileImage;

use crate::camera::{Bounds, Camera};
use bytes::Bytes;
use decode::Decoder;
use diamantina_protocol::texture::{Coverage, Texture, Tile};
use foldhash::fast::RandomState;
use std::collections::{HashMap, HashSet};
use std::sync::Arc;

/// Tiles wished for at once: the eye may have moved on before more of them have come.
const WISHES_MAX: usize = 48;

/// Tiles that begin to be shown in one frame, since each is sent to the GPU for it: 4 MiB.
const STARTS_MAX: usize = 16;

/// Tiles being decoded at once.
const DECODING_MAX: usize = 32;

/// Seconds in which a tile takes its parent's place.
pub const FADE_SECONDS: f64 = 0.3;

/// A tile that is shown.
#[derive(Debug, Clone)]
pub struct DrapedTile {
    /// Which.
    pub tile: Tile,
    /// Its picture.
    pub image: Arc<TileImage>,
    /// How much of it is seen, and not of its parent: 0 to 1.
    pub weight: f32,
}

/// What a frame shows of a texture, as plain data.
#[derive(Debug, Clone)]
pub struct Drape {
    /// Where it lies.
    pub texture: Arc<Texture>,
    /// Coarse first: each with its parent before it.
    pub tiles: Vec<DrapedTile>,
    /// The most tiles that any frame shows.
    pub capacity: usize,
    /// How the texels of all of them are coded.
    pub coding: Coding,
}

/// Pictures of tiles in a row of what holds them on the GPU.
pub const ROW: usize = 8;

/// Rows of them in a sheet: 2048 texels, which any GPU can have.
pub const SHEET_ROWS: usize = 8;

/// The fewest tiles that are worth showing, and the least that imagery takes: two rows.
pub const TILES_MIN: usize = 2 * ROW;

/// How many tiles fit into so many bytes.
#[must_use]
pub fn capacity(bytes: usize, coding: Coding) -> usize {
    (bytes / coding.tile_bytes()).clamp(TILES_MIN, choose::TILES_MAX)
}

/// How many tiles fit into so many bytes on the GPU, where they lie in whole rows, and beyond one sheet in whole sheets.
fn capacity_on_gpu(bytes: u64, coding: Coding) -> usize {
    let tiles = usize::try_from(bytes).unwrap_or(usize::MAX) / coding.tile_bytes();
    let whole = if tiles < ROW * SHEET_ROWS { ROW } else { ROW * SHEET_ROWS };
    (tiles - tiles % whole).clamp(TILES_MIN, choose::TILES_MAX)
}

/// The sheets on the GPU that hold so many tiles: rows of each, and how many.
#[must_use]
pub fn sheets(capacity: usize) -> [usize; 2] {
    let rows = capacity.div_ceil(ROW).max(1);
    [rows.min(SHEET_ROWS), rows.div_ceil(SHEET_ROWS)]
}

/// Bytes of GPU memory that the pictures of so many tiles take, shown or not.
#[must_use]
pub fn gpu_bytes(capacity: usize, coding: Coding) -> u64 {
    let [rows, sheets] = sheets(capacity);
    (rows * ROW * sheets * coding.tile_bytes()) as u64
}

#[derive(Debug)]
struct Held {
    image: Arc<TileImage>,
    /// The frame that last wanted it.
    used: u64,
    /// The moment since which it is shown, if it is.
    shown: Option<f64>,
}

/// A texture being streamed.
#[derive(Debug)]
pub struct Draping {
    /// Its position in the scene.
    number: usize,
    texture: Arc<Texture>,
    /// Once it has come.
    coverage: Option<Coverage>,
    /// Tiles that memory has room for.
    capacity_here: usize,
    /// The same, as far as the GPU has room for them, too.
    capacity: usize,
    coding: Coding,
    frame: u64,
    held: HashMap<Tile, Held, RandomState>,
    decoder: Decoder,
    decoding: HashSet<Tile, RandomState>,
    /// What the last frame wanted.
    wanted: HashSet<Tile, RandomState>,
    fade_seconds: f64,
}

/// What a frame has of a texture, and lacks.
#[derive(Debug, Default)]
pub struct Step {
    /// What to show; nothing before the coarsest tile is there.
    pub drape: Option<Drape>,
    /// Tiles to ask for, most urgent first.
    pub wishes: Vec<Tile>,
    /// Whether the coverage has to be asked for.
    pub lacks_coverage: bool,
    /// Whether all that is wanted is shown.
    pub complete: bool,
    /// Tiles on their way into the picture.
    pub fading: usize,
}

impl Draping {
    /// A texture, by its position in the scene, of which as many tiles are kept as fit into so many bytes in a coding, and taken
    /// in within so many seconds.
    ///
    /// # Errors
    /// When there are no threads to decode with.
    pub fn start(
        number: usize,
        texture: &Texture,
        bytes: usize,
        coding: Coding,
        fade_seconds: f64,
    ) -> std::io::Result<Self> {
        Ok(Self {
            number,
            texture: Arc::new(texture.clone()),
            coverage: None,
            capacity_here: capacity(bytes, coding),
            capacity: capacity(bytes, coding),
            coding,
            frame: 0,
            held: HashMap::default(),
            decoder: Decoder::start(coding)?,
            decoding: HashSet::default(),
            wanted: HashSet::default(),
            fade_seconds,
        })
    }

    /// Its position in the scene.
    #[must_use]
    pub fn number(&self) -> usize {
        self.number
    }

    /// The texture.
    #[must_use]
    pub fn texture(&self) -> &Texture {
        &self.texture
    }

    /// Shows no more tiles than fit into so many bytes of the GPU's memory, though [`TILES_MIN`] in any case.
    pub fn fit_gpu(&mut self, bytes: u64) {
        self.capacity = self.capacity_here.min(capacity_on_gpu(bytes, self.coding));
    }

    /// Bytes of GPU memory that its pictures take, once the first is shown.
    #[must_use]
    pub fn gpu_bytes(&self) -> u64 {
        gpu_bytes(self.capacity, self.coding)
    }

    /// Tiles in memory.
    #[must_use]
    pub fn tiles(&self) -> usize {
        self.held.len()
    }

    /// Bytes that they take.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.held.values().map(|held| held.image.texels().len()).sum()
    }

    /// Takes the coverage.
    pub fn set_coverage(&mut self, coverage: Coverage) {
        self.coverage = Some(coverage);
    }

    /// Takes a tile that has been fetched.
    pub fn take(&mut self, tile: Tile, picture: Bytes) {
        if !self.held.contains_key(&tile) && self.decoding.insert(tile) {
            self.decoder.submit(tile, picture);
        }
    }

    /// Takes what has been decoded. Returns what could not be, and what could.
    pub fn take_decoded(&mut self) -> Vec<(Tile, Result<(), String>)> {
        let mut taken = Vec::new();
        while let Some((tile, decoded)) = self.decoder.poll() {
            self.decoding.remove(&tile);
            let result = decoded.map(|image| {
                let held = Held { image: Arc::new(image), used: self.frame, shown: None };
                self.held.insert(tile, held);
            });
            taken.push((tile, result));
        }
        taken
    }

    /// Whether something is being decoded.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        self.decoding.is_empty()
    }

    /// A frame that draws terrain in these boxes, with its heights as they are drawn, at a moment in seconds.
    pub fn step(&mut self, camera: &Camera, boxes: &[Bounds], nearest: f64, seconds: f64) -> Step {
        let Some(coverage) = &self.coverage else {
            return Step { lacks_coverage: true, ..Step::default() };
        };
        self.frame += 1;
        let wanted = wanted(&self.texture, coverage, camera, boxes, nearest, self.capacity);
        self.wanted = wanted.iter().copied().collect();
        let mut step = Step::default();
        let mut room = WISHES_MAX.min(DECODING_MAX.saturating_sub(self.decoding.len()).max(1));
        for tile in &wanted {
            if let Some(held) = self.held.get_mut(tile) {
                held.used = self.frame;
            } else if !self.decoding.contains(tile) && room > 0 {
                room -= 1;
                step.wishes.push(*tile);
            }
        }
        self.evict();
        step.complete = wanted.iter().all(|tile| self.held.contains_key(tile));
        let mut shown = self.show(seconds, &mut step);
        shown.sort_unstable_by_key(|draped| draped.tile);
        step.drape = (!shown.is_empty()).then(|| Drape {
            texture: Arc::clone(&self.texture),
            tiles: shown,
            capacity: self.capacity,
            coding: self.coding,
        });
        step
    }

    /// Drops what is wanted the least, the longest unused first, until there is room for all that is wanted.
    fn evict(&mut self) {
        if self.held.len() <= self.capacity {
            return;
        }
        // A parent is used whenever its children are: among those of one age, the finest go first.
        let mut by_use: Vec<(u64, Tile)> = self.held.iter().map(|(tile, held)| (held.used, *tile)).collect();
        by_use.sort_unstable_by(|(a, fine), (b, coarse)| {
            a.cmp(b).then(coarse.level.cmp(&fine.level)).then(fine.cmp(coarse))
        });
        for (_, tile) in by_use.iter().take(self.held.len() - self.capacity) {
            self.held.remove(tile);
        }
    }

    /// The tiles whose parents are shown as well, as many of them new as one frame may send to the GPU.
    fn show(&mut self, seconds: f64, step: &mut Step) -> Vec<DrapedTile> {
        let mut tiles: Vec<Tile> = self.held.keys().copied().collect();
        tiles.sort_unstable();
        let mut room = STARTS_MAX;
        let mut shown: HashSet<Tile, RandomState> = HashSet::default();
        let mut draped = Vec::with_capacity(tiles.len());
        for tile in tiles {
            let has_parent = tile.parent().is_none_or(|parent| shown.contains(&parent));
            let Some(held) = self.held.get_mut(&tile) else { continue };
            if !has_parent {
                // Once its parent is back, it comes in anew.
                held.shown = None;
                step.complete &= !self.wanted.contains(&tile);
                continue;
            }
            if held.shown.is_none() {
                if room == 0 {
                    step.complete &= !self.wanted.contains(&tile);
                    step.fading += 1;
                    continue;
                }
                room -= 1;
                held.shown = Some(seconds);
            }
            let age = seconds - held.shown.unwrap_or(seconds);
            let part = if self.fade_seconds > 0.0 && tile.level > 0 {
                (age / self.fade_seconds).clamp(0.0, 1.0)
            } else {
                1.0
            };
            step.fading += usize::from(part < 1.0);
            #[allow(clippy::cast_possible_truncation, reason = "a part of 1")]
            let weight = (part * part * (3.0 - 2.0 * part)) as f32;
            shown.insert(tile);
            draped.push(DrapedTile { tile, image: Arc::clone(&held.image), weight });
        }
        draped
    }
}

#[cfg(test)]
mod tests;

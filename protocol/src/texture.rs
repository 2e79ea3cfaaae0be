//! Imagery draped on terrain: a pyramid of square tiles.
//!
//! A pyramid halves the finest image again and again until it fits one tile. Level 0 is that tile, the last level the
//! image itself. All levels begin at the image's south-west corner; tile (x, y) of a level is the x-th to the east and
//! the y-th to the north from there.
//!
//! **A tile's picture** is [`SIDE`] texels a side, of which the tile itself has [`INNER`]: around it lie [`GUTTER`] texels
//! of its neighbours, so that whoever interpolates between texels sees no seam. Rows run from north to south, as in any
//! picture. Where the image has nothing it is transparent; a tile that is wholly so is not stored.
//!
//! **The coverage** tells which tiles there are: a bit for each tile, level by level from 0, in each row by row from the
//! south, from west to east, the first bit of a byte being its lowest.

use serde::{Deserialize, Serialize};

/// Texels of a tile's picture, along each side.
pub const SIDE: u32 = 256;

/// Texels around a tile that its picture shows besides.
pub const GUTTER: u32 = 4;

/// Texels of a tile, along each side.
pub const INNER: u32 = SIDE - 2 * GUTTER;

/// The most levels: 16 million texels a side.
pub const LEVELS_MAX: u32 = 17;

/// The most tiles of all levels: 250 thousand million texels. Their coverage takes 700 kB.
pub const TILES_MAX: u64 = 5_600_000;

/// The largest coverage as it is sent, in bytes: compressed, it is hardly larger than its bits.
pub const COVERAGE_BYTES_MAX: usize = 704 << 10;

/// The most textures of a scene.
pub const TEXTURES_MAX: usize = 64;

/// The largest picture of a tile, in bytes: somewhat more than its texels.
pub const TILE_BYTES_MAX: usize = 384 << 10;

/// Imagery over the frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Texture {
    /// The name in the address.
    pub name: String,
    /// Frame coordinates of the image's south-west corner, in metres.
    pub origin: [f64; 2],
    /// Metres of a texel of the finest level along x and y.
    pub texel: [f64; 2],
    /// Texels of the finest level along x and y.
    pub size: [u32; 2],
    /// The format of the tiles' pictures: "webp".
    pub format: String,
    /// How well the pictures keep the image: 1 to 99; 100 is lossless.
    pub quality: u8,
    /// Tiles stored.
    pub tiles: u64,
    /// Bytes of all tiles and of their coverage.
    pub bytes: u64,
    /// Whether the image was resampled to the frame's grid.
    pub resampled: bool,
}

/// A tile of a pyramid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Tile {
    /// 0 is the coarsest.
    pub level: u32,
    /// Tiles to the east.
    pub x: u32,
    /// Tiles to the north.
    pub y: u32,
}

impl Tile {
    /// The only tile of level 0.
    pub const ROOT: Self = Self { level: 0, x: 0, y: 0 };

    /// The tile that it is a quarter of.
    #[must_use]
    pub fn parent(self) -> Option<Self> {
        let level = self.level.checked_sub(1)?;
        Some(Self { level, x: self.x / 2, y: self.y / 2 })
    }

    /// Its quarters: south-west, south-east, north-west, north-east.
    #[must_use]
    pub fn children(self) -> [Self; 4] {
        [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(x, y)| Self {
            level: self.level + 1,
            x: 2 * self.x + x,
            y: 2 * self.y + y,
        })
    }

    /// Which quarter of its parent it is.
    #[must_use]
    pub fn quarter(self) -> usize {
        (self.x % 2 + 2 * (self.y % 2)) as usize
    }
}

impl Texture {
    /// Levels of a pyramid over an image of such a size.
    #[must_use]
    pub fn levels_of(size: [u32; 2]) -> u32 {
        let tiles = size[0].max(size[1]).max(1).div_ceil(INNER);
        1 + tiles.next_power_of_two().ilog2()
    }

    /// Levels of the pyramid.
    #[must_use]
    pub fn levels(&self) -> u32 {
        Self::levels_of(self.size)
    }

    /// Texels of a level along x and y.
    #[must_use]
    pub fn texels(&self, level: u32) -> [u32; 2] {
        let halvings = self.levels().saturating_sub(level + 1);
        self.size.map(|texels| texels.div_ceil(1 << halvings))
    }

    /// Tiles of a level along x and y, whether stored or not.
    #[must_use]
    pub fn grid(&self, level: u32) -> [u32; 2] {
        self.texels(level).map(|texels| texels.div_ceil(INNER))
    }

    /// Tiles of all levels, whether stored or not.
    #[must_use]
    pub fn grid_tiles(&self) -> u64 {
        (0..self.levels()).map(|level| self.grid(level).map(u64::from).iter().product::<u64>()).sum()
    }

    /// Whether there may be such a tile.
    #[must_use]
    pub fn holds(&self, tile: Tile) -> bool {
        let within = || {
            let [across, up] = self.grid(tile.level);
            tile.x < across && tile.y < up
        };
        tile.level < self.levels() && within()
    }

    /// Metres of a texel of a level, along x and y.
    #[must_use]
    pub fn texel_at(&self, level: u32) -> [f64; 2] {
        let halvings = self.levels().saturating_sub(level + 1);
        self.texel.map(|metres| metres * f64::from(1u32 << halvings))
    }

    /// Frame coordinates of the south-west corner of a tile without its gutter, in metres.
    #[must_use]
    pub fn corner(&self, tile: Tile) -> [f64; 2] {
        let texel = self.texel_at(tile.level);
        let along =
            |axis: usize, tiles: u32| self.origin[axis] + f64::from(tiles) * f64::from(INNER) * texel[axis];
        [along(0, tile.x), along(1, tile.y)]
    }

    /// Metres of a tile of a level without its gutter, along x and y.
    #[must_use]
    pub fn extent(&self, level: u32) -> [f64; 2] {
        self.texel_at(level).map(|metres| metres * f64::from(INNER))
    }

    /// Whether all numbers are such as can be worked with; else what is wrong.
    ///
    /// # Errors
    /// When they are not.
    pub fn check(&self) -> Result<(), String> {
        let is_metre = |v: &f64| v.is_finite() && *v > 1e-9 && *v < 1e9;
        if !self.texel.iter().all(is_metre) || !self.origin.iter().all(|v| v.abs() < 1e12) {
            return Err(format!(
                "texture '{}' lies at {:?} with texels of {:?} m",
                self.name, self.origin, self.texel
            ));
        }
        if self.size.contains(&0) || self.levels() > LEVELS_MAX || self.grid_tiles() > TILES_MAX {
            return Err(format!("texture '{}' has {} x {} texels", self.name, self.size[0], self.size[1]));
        }
        if self.format != "webp" {
            return Err(format!("texture '{}' is '{}', expected webp", self.name, self.format));
        }
        Ok(())
    }
}

/// The light of an sRGB value, both from 0 to 1 (IEC 61966-2-1).
#[must_use]
pub fn light(srgb: f64) -> f64 {
    if srgb <= 0.040_45 { srgb / 12.92 } else { ((srgb + 0.055) / 1.055).powf(2.4) }
}

/// The sRGB value of light, both from 0 to 1: see [`light`].
#[must_use]
pub fn srgb(light: f64) -> f64 {
    if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
}

/// Which tiles of a pyramid are stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Coverage {
    bits: Vec<u8>,
    /// Tiles of the levels before each level, and along x in it.
    levels: Vec<(u64, [u32; 2])>,
}

/// Why bytes are no coverage.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CoverageError {
    /// Not as many as the pyramid's tiles take.
    #[error("coverage of {found} bytes, expected {expected}")]
    Length {
        /// Bytes found.
        found: usize,
        /// Bytes expected.
        expected: usize,
    },
    /// A tile without its parent: nothing could be drawn before it.
    #[error("the coverage has tile {0:?} without its parent")]
    Orphan(Tile),
}

/// Bytes of the coverage of a texture.
#[must_use]
pub fn coverage_bytes(texture: &Texture) -> usize {
    // At most TILES_MAX / 8, which `check` has seen to.
    usize::try_from(texture.grid_tiles().div_ceil(8)).unwrap_or(usize::MAX)
}

impl Coverage {
    /// That of no tile.
    #[must_use]
    pub fn empty(texture: &Texture) -> Self {
        let mut before = 0;
        let mut levels = Vec::new();
        for level in 0..texture.levels() {
            let grid = texture.grid(level);
            levels.push((before, grid));
            before += grid.map(u64::from).iter().product::<u64>();
        }
        Self { bits: vec![0; coverage_bytes(texture)], levels }
    }

    /// Reads one, which may be hostile, of a texture that has been [`check`](Texture::check)ed.
    ///
    /// # Errors
    /// When it does not fit the texture.
    pub fn decode(texture: &Texture, bytes: &[u8]) -> Result<Self, CoverageError> {
        let mut coverage = Self::empty(texture);
        if bytes.len() != coverage.bits.len() {
            return Err(CoverageError::Length { found: bytes.len(), expected: coverage.bits.len() });
        }
        coverage.bits.copy_from_slice(bytes);
        let lacks_parent = |tile: &Tile| tile.parent().is_some_and(|parent| !coverage.has(parent));
        let orphan = coverage.tiles().find(lacks_parent);
        orphan.map_or(Ok(coverage), |orphan| Err(CoverageError::Orphan(orphan)))
    }

    /// Its bytes.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.bits
    }

    fn place(&self, tile: Tile) -> Option<(usize, u8)> {
        let (before, [across, up]) = *self.levels.get(tile.level as usize)?;
        if tile.x >= across || tile.y >= up {
            return None;
        }
        let number = before + u64::from(tile.y) * u64::from(across) + u64::from(tile.x);
        Some((usize::try_from(number / 8).ok()?, 1 << (number % 8)))
    }

    /// Whether a tile is stored.
    #[must_use]
    pub fn has(&self, tile: Tile) -> bool {
        self.place(tile).is_some_and(|(byte, bit)| self.bits[byte] & bit != 0)
    }

    /// Says that a tile is stored. One that the pyramid has no place for changes nothing.
    pub fn insert(&mut self, tile: Tile) {
        if let Some((byte, bit)) = self.place(tile) {
            self.bits[byte] |= bit;
        }
    }

    /// All tiles that are stored, coarse first.
    pub fn tiles(&self) -> impl Iterator<Item = Tile> {
        let levels = (0u32..).zip(&self.levels);
        levels.flat_map(move |(level, (_, [across, up]))| {
            let across = *across;
            let all = (0..*up).flat_map(move |y| (0..across).map(move |x| Tile { level, x, y }));
            all.filter(|tile| self.has(*tile))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn texture(size: [u32; 2]) -> Texture {
        Texture {
            name: "photo".to_owned(),
            origin: [500.0, -200.0],
            texel: [0.5, 0.25],
            size,
            format: "webp".to_owned(),
            quality: 80,
            tiles: 0,
            bytes: 0,
            resampled: false,
        }
    }

    #[test]
    fn the_coarsest_level_is_one_tile_and_the_finest_the_image() {
        for (size, levels) in
            [([1, 1], 1), ([248, 100], 1), ([249, 1], 2), ([496, 496], 2), ([497, 3], 3), ([100_000, 7], 10)]
        {
            let texture = texture(size);
            assert_eq!(texture.levels(), levels, "{size:?}");
            assert_eq!(texture.grid(0), [1, 1]);
            assert_eq!(texture.texels(levels - 1), size);
            assert_eq!(texture.texel_at(levels - 1), texture.texel);
            assert_eq!(texture.check(), Ok(()));
        }
    }

    #[test]
    fn light_and_srgb_are_each_other_s_inverse() {
        for byte in 0..=255u8 {
            let value = f64::from(byte) / 255.0;
            assert!((srgb(light(value)) - value).abs() < 1e-6, "{byte}");
        }
        assert!((light(128.0 / 255.0) - 0.215_86).abs() < 1e-4);
    }

    #[test]
    fn absurd_textures_are_refused() {
        for change in [
            |t: &mut Texture| t.size = [0, 4],
            |t: &mut Texture| t.size = [u32::MAX, 4],
            |t: &mut Texture| t.size = [1 << 22, 1 << 22],
            |t: &mut Texture| t.texel[1] = f64::NAN,
            |t: &mut Texture| t.texel[0] = -1.0,
            |t: &mut Texture| t.origin[0] = f64::INFINITY,
            |t: &mut Texture| t.format = "exe".to_owned(),
        ] {
            let mut texture = texture([1000, 1000]);
            change(&mut texture);
            assert!(texture.check().is_err(), "{texture:?}");
        }
    }

    proptest! {
        #[test]
        fn children_cover_their_parent_exactly(x in 0u32..300, y in 0u32..300, level in 0u32..10) {
            let (texture, tile) = (texture([200_000, 170_000]), Tile { level, x, y });
            let corner = texture.corner(tile);
            let extent = texture.extent(level);
            for (quarter, child) in tile.children().into_iter().enumerate() {
                prop_assert_eq!(child.parent(), Some(tile));
                prop_assert_eq!(child.quarter(), quarter);
                let expected = [corner[0] + extent[0] / 2.0 * f64::from(child.x % 2), corner[1] + extent[1] / 2.0 * f64::from(child.y % 2)];
                let found = texture.corner(child);
                prop_assert!((0..2).all(|i| (found[i] - expected[i]).abs() < 1e-6), "{:?} {:?}", found, expected);
            }
            // Whatever the finer level has, the coarser has a tile over it.
            prop_assert!(!texture.holds(tile) || tile.parent().is_none_or(|parent| texture.holds(parent)));
        }

        #[test]
        fn a_coverage_comes_back_as_it_went(size in [1u32..3000, 1u32..3000], chosen in prop::collection::vec(any::<prop::sample::Index>(), 0..40)) {
            let texture = texture(size);
            let mut coverage = Coverage::empty(&texture);
            let finest = texture.levels() - 1;
            let [across, up] = texture.grid(finest);
            let mut tiles = std::collections::BTreeSet::new();
            for index in chosen {
                let number = u32::try_from(index.index((across * up) as usize)).unwrap();
                let mut next = Some(Tile { level: finest, x: number % across, y: number / across });
                while let Some(tile) = next {
                    coverage.insert(tile);
                    tiles.insert(tile);
                    next = tile.parent();
                }
            }
            let back = Coverage::decode(&texture, coverage.bytes()).unwrap();
            prop_assert_eq!(&back, &coverage);
            prop_assert_eq!(back.tiles().collect::<std::collections::BTreeSet<_>>(), tiles);
        }

        #[test]
        fn any_bytes_are_a_coverage_or_an_error(size in [1u32..2000, 1u32..2000], bytes in prop::collection::vec(any::<u8>(), 0..60)) {
            let texture = texture(size);
            if let Ok(coverage) = Coverage::decode(&texture, &bytes) {
                prop_assert!(coverage.tiles().all(|tile| texture.holds(tile)));
            }
        }
    }
}

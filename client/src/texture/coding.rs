//! How the texels of a tile lie in memory and on the GPU.

use diamantina_protocol::texture::SIDE;

/// Texels of a tile.
const TEXELS: usize = (SIDE * SIDE) as usize;

/// How texels are coded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Coding {
    /// Each by itself, in four bytes.
    #[default]
    Plain,
    /// Squares of 4 x 4 in 16 bytes (BC7), which most GPUs of desktops read as they are: four times as many tiles in the
    /// same memory, some 1 of 255 off in the mean. Not in browsers, where there is no thread to spare for coding.
    Blocks,
}

impl Coding {
    /// Blocks where they are wanted and can be made.
    #[must_use]
    pub fn blocks_if(wanted: bool) -> Self {
        if wanted && cfg!(not(target_arch = "wasm32")) { Self::Blocks } else { Self::Plain }
    }

    /// Bytes of a tile's texels.
    #[must_use]
    pub const fn tile_bytes(self) -> usize {
        match self {
            Self::Plain => 4 * TEXELS,
            Self::Blocks => TEXELS,
        }
    }
}

#[cfg(not(target_arch = "wasm32"))]
mod blocks {
    use super::{Coding, SIDE};
    use block_compression::decode::decompress_blocks_as_rgba8;
    use block_compression::encode::compress_rgba8;
    use block_compression::{BC7Settings, CompressionVariant};

    /// A tile's plain texels as blocks. Some 5 ms of a core, five times that where opacity varies; better settings take
    /// twenty times as long for a third less error.
    pub(in crate::texture) fn blocks(texels: &[u8]) -> Vec<u8> {
        let is_opaque = texels.as_chunks::<4>().0.iter().all(|texel| texel[3] == u8::MAX);
        let settings =
            if is_opaque { BC7Settings::opaque_ultra_fast() } else { BC7Settings::alpha_ultrafast() };
        let mut blocks = vec![0; Coding::Blocks.tile_bytes()];
        compress_rgba8(CompressionVariant::BC7(settings), texels, &mut blocks, SIDE, SIDE, 4 * SIDE);
        blocks
    }

    /// The plain texels of a tile's blocks.
    pub(crate) fn plain(blocks: &[u8]) -> Vec<u8> {
        let mut texels = vec![0; Coding::Plain.tile_bytes()];
        let variant = CompressionVariant::BC7(BC7Settings::opaque_ultra_fast());
        decompress_blocks_as_rgba8(variant, SIDE, SIDE, blocks, &mut texels);
        texels
    }
}

#[cfg(target_arch = "wasm32")]
mod blocks {
    // There are no blocks: see [`super::Coding::blocks_if`].

    pub(in crate::texture) fn blocks(texels: &[u8]) -> Vec<u8> {
        texels.to_vec()
    }

    pub(crate) fn plain(blocks: &[u8]) -> Vec<u8> {
        blocks.to_vec()
    }
}

pub(super) use blocks::blocks;
pub(crate) use blocks::plain;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::texture::TileImage;

    /// A tile of slopes and of rough ground, half of it, if asked, less and less opaque.
    fn tile(fades: bool) -> TileImage {
        let texel = |i: u32| {
            let [x, y] = [i % SIDE, i / SIDE];
            let rough = (x.wrapping_mul(0x9E37_79B1) ^ y.wrapping_mul(0x85EB_CA77)) >> 29;
            let byte = |value: u32| u8::try_from(value.min(255)).unwrap();
            let opacity = if fades { byte(255 - x / 2) } else { 255 };
            [byte(x / 2 + rough), byte(40 + y / 2 + rough), byte(90 + (x + y) / 8), opacity]
        };
        TileImage::new((0..SIDE * SIDE).flat_map(texel).collect()).unwrap()
    }

    #[test]
    fn blocks_are_a_quarter_and_hardly_off() {
        for fades in [false, true] {
            let before = tile(fades);
            let texels = before.texels().to_vec();
            let blocks = before.coded(Coding::Blocks);
            assert_eq!(blocks.texels().len() * 4, texels.len());
            assert_eq!(blocks.coding(), Coding::Blocks);
            let after = blocks.coded(Coding::Plain);
            let off = |(a, b): (&u8, &u8)| f64::from(a.abs_diff(*b)).powi(2);
            let mean = texels.iter().zip(after.texels()).map(off).sum::<f64>() / texels.len() as f64;
            assert!(mean.sqrt() < 2.0, "{} of 255 off", mean.sqrt());
            let worst = texels.iter().zip(after.texels()).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
            assert!(worst <= 16, "{worst} of 255 off");
        }
    }
}

//! How the memory that a scene is given is shared out.
//!
//! | what | of the memory | at most |
//! |---|---|---|
//! | surfaces that the cut wants; a quarter of it is for what water mirrors, where any does | 3/4 | |
//! | surfaces, those included | 27/32 | |
//! | payloads that are wished for or wait for their parents | 1/32 | 16 MiB, some 20 000 typical payloads |
//! | decoded surfaces that wait for a frame | 1/32 | 256, 25 MB for n = 64 |
//! | pages of the index beyond those in use | 1/32 | [`PAGES_MAX`] a layer |
//! | motions | 1/16 | [`MOTIONS_MAX`] a layer |
//!
//! And how the GPU's is:
//!
//! | what | of the memory | at most |
//! |---|---|---|
//! | pictures that frames are made of, index lists that all diamonds share | as they need | |
//! | imagery, where there is any | 1/3 of the rest | what tiles may take of the memory; at least [`TILES_MIN`] |
//! | surfaces and their motions | what is left, but for 1/64 | |

use super::LayerState;
use super::steps::Steps;
use crate::cache::PAGES_MAX;
use crate::morph::{MOTIONS_MAX, Record, STARTS_MAX};
use crate::surface::Points;
#[cfg(doc)]
use crate::texture::TILES_MIN;
use diamantina_protocol::bintree::Forest;

/// Bytes of payloads that are wished for or wait for their parents, however much memory there is.
const HELD_BYTES_MAX: usize = 16 << 20;

/// Decoded surfaces that wait for a frame to take them, however much memory there is; the decoders pause there.
const DONE_MAX: usize = 256;

/// The same, however little: a frame must get on.
const DONE_MIN: usize = 16;

/// What a page of the index takes, about.
const PAGE_BYTES: usize = 40_000;

/// The least number of pages beyond those in use.
const PAGES_MIN: usize = 16;

/// Of what frames leave of the GPU's memory, the part that imagery may take.
const IMAGERY_PART: u64 = 3;

/// The least number of motions.
const MOTIONS_MIN: usize = 16;

/// What imagery may take of the GPU's memory, where frames need so much of it.
pub(super) fn of_imagery(gpu_bytes: u64, taken: u64) -> u64 {
    gpu_bytes.saturating_sub(taken) / IMAGERY_PART
}

/// The shares of a scene's memory.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shares {
    /// All surfaces, in bytes.
    pub(super) surfaces: usize,
    /// The surfaces that the layers' cuts want, in bytes.
    pub(super) cut: usize,
    /// Payloads on their way, in bytes.
    pub(super) held: usize,
    /// Decoded surfaces on their way.
    pub(super) done: usize,
    /// Pages of the index of all layers.
    pages: usize,
    /// Motions of all layers.
    motions: usize,
}

impl Shares {
    /// Those of so much memory, where a surface takes at most what one of these forests' lattice does.
    pub(super) fn of(memory_bytes: usize, forests: &[Forest]) -> Self {
        let bytes = forests.iter().map(|forest| Points::bytes(forest, 0)).max().unwrap_or(1);
        // A surface has 12 bytes a point.
        let motion_bytes = bytes / 12 * size_of::<Record>();
        let part = memory_bytes / 32;
        Self {
            surfaces: memory_bytes - 5 * part,
            cut: memory_bytes / 4 * 3,
            held: part.min(HELD_BYTES_MAX),
            done: (part / bytes).clamp(DONE_MIN, DONE_MAX),
            pages: part / PAGE_BYTES,
            motions: 2 * part / motion_bytes,
        }
    }

    /// Gives each of the layers that are shown its own; the steps of a series have one together.
    pub(super) fn share_out(&self, layers: &mut [LayerState], steps: &Steps, gpu_bytes: u64) {
        let is_counted = |(number, state): &(usize, &LayerState)| state.shown && steps.is_wanted(*number);
        let shown = layers.iter().enumerate().filter(|layer| is_counted(layer)).count().max(1);
        for state in layers {
            state.memory_bytes = self.cut / shown;
            state.gpu_bytes = gpu_bytes / shown as u64;
            state.pages_max = (self.pages / shown).clamp(PAGES_MIN, PAGES_MAX);
            state.morphs.set_motions_max((self.motions / shown).clamp(MOTIONS_MIN, MOTIONS_MAX));
            state.morphs.set_starts_max(STARTS_MAX / shown);
        }
    }
}

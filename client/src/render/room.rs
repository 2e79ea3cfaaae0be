//! What frames take of the GPU's memory besides diamonds and imagery, before any of it is made.
//!
//! All follows from the picture's size, the look, and how many layers of water may be in view: so a scene can be given
//! the rest of a budget, and does not have to be told anew whenever water comes into view.

use super::drape::Drapes;
use super::water::WaterPasses;
use super::{Look, Renderer};
use crate::surface::triangles::Form;
use diamantina_protocol::bintree::Forest;
use diamantina_protocol::message::Layer;
use std::collections::HashSet;

/// Pixels of a picture.
pub(super) fn pixels(size: [u32; 2]) -> u64 {
    size.map(u64::from).iter().product()
}

/// Bytes that the samples of a pixel take: of each four of depth and, where there are several, as many of colour.
pub(super) fn samples_bytes(samples: u32) -> u64 {
    u64::from(samples) * if samples > 1 { 8 } else { 4 }
}

/// Index lists that all diamonds of these layers share, once diamonds of all levels are drawn.
fn shared_bytes(layers: &[Layer], wires: bool) -> u64 {
    // The steps of a series, of which there may be hundreds, have one.
    let forests = layers.chunk_by(|a, b| a.forest == b.forest).map(|alike| alike[0].forest);
    let forms = |forest: Forest| (0..forest.levels()).map(move |level| Form::at(&forest, level));
    let forms: HashSet<Form> = forests.flat_map(forms).collect();
    forms.into_iter().map(|form| form.gpu_bytes(wires)).sum()
}

impl Renderer {
    /// Bytes of GPU memory that frames of such a size take at most besides diamonds and imagery, where no more than so many
    /// layers of water are drawn: what [`FrameStats::fixed_bytes`](super::FrameStats::fixed_bytes) tells, but for the pictures of tiles
    /// and what tells where diamonds are.
    #[must_use]
    pub fn frame_bytes(&self, layers: &[Layer], size: [u32; 2], look: &Look, waters: usize) -> u64 {
        let samples = self.options.samples;
        let waters = if look.mirrors() { waters } else { 0 };
        let held = self.water.as_ref().map_or(0, WaterPasses::bytes);
        pixels(size) * (samples_bytes(samples) + self.target_bytes)
            + held.max(WaterPasses::bytes_of(size, look, samples, waters))
            + Drapes::least_bytes()
            + shared_bytes(layers, look.wireframe).max(self.residents.shared_bytes())
            + self.beside_bytes
    }

    /// Counts what the caller takes for each pixel of the pictures that it has drawn to, and besides them, in bytes.
    pub fn count_targets(&mut self, bytes_a_pixel: u64, beside_bytes: u64) {
        (self.target_bytes, self.beside_bytes) = (bytes_a_pixel, beside_bytes);
    }
}

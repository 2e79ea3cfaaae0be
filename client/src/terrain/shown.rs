//! Which layers are streamed and drawn.
//!
//! One that is hidden keeps its index, and what is resident of it until the room is needed; no more of it is asked for.
//! The steps of a series are shown together, by its name.

use super::{Layer, Scene, Terrain, shares};
use crate::cut::Ideal;
use crate::drawing::left_for_diamonds;
use crate::morph::Morphs;
use crate::texture::{Draping, TILES_MIN};
use diamantina_protocol::message::Kind;
use std::collections::HashSet;

impl Terrain {
    /// Whether a layer, by its position in the scene, is streamed and drawn.
    #[must_use]
    pub fn is_shown(&self, layer: usize) -> bool {
        self.layers.get(layer).is_some_and(|state| state.shown)
    }

    /// Shows a layer from the next frame on, or hides it, and with a step its whole series. What the layers' surfaces may
    /// take of the memory is shared by those that are shown.
    pub fn set_shown(&mut self, layer: usize, shown: bool) {
        let Some(of) = self.scene.layers.get(layer).map(|layer| self.scene.chosen_as(&layer.name)) else {
            return;
        };
        let is_shown = |name: &str| {
            let mut layers = self.scene.layers.iter().zip(&self.layers);
            layers.any(|(layer, state)| state.shown && self.scene.chosen_as(&layer.name) == name)
        };
        let choices = self.scene.choices();
        let wanted = choices.iter().filter(|name| if **name == of { shown } else { is_shown(name) });
        let names: Vec<String> = wanted.map(|name| (*name).to_owned()).collect();
        // All are all of another version, too.
        let is_all = names.len() == choices.len();
        self.show_only((!is_all).then_some(names));
    }

    /// Shows the layers of these names, or all. Where there is none of them, as in a version with other layers, all.
    pub(super) fn show_only(&mut self, names: Option<Vec<String>>) {
        let choices = self.scene.choices();
        let is_there = |name: &String| choices.contains(&name.as_str());
        let names = names.filter(|names| names.is_empty() || names.iter().any(is_there));
        let wanted = |layer: &Layer| {
            let of = self.scene.chosen_as(&layer.name);
            names.as_ref().is_none_or(|names| names.iter().any(|name| name == of))
        };
        for (layer, state) in self.scene.layers.iter().zip(&mut self.layers) {
            if wanted(layer) != state.shown {
                state.shown = wanted(layer);
                // Nothing is wanted of it any more, or nothing was.
                state.ideal = Ideal::default();
                state.morphs = Morphs::new(self.options.morph_seconds);
            }
        }
        self.share_out();
        self.options.layers = names;
    }

    /// Gives imagery and each layer their shares of the memory.
    pub(super) fn share_out(&mut self) {
        let budget = self.options.gpu_bytes;
        if let Some(draping) = &mut self.draping {
            draping.fit_gpu(shares::of_imagery(budget, self.gpu_taken));
        }
        let left = left_for_diamonds(budget, self.gpu_taken.saturating_add(self.imagery_gpu_bytes()));
        self.shares.share_out(&mut self.layers, &self.steps, left);
    }

    /// Says how much of the GPU's memory frames take besides imagery and diamonds, from the next one on: it is taken off
    /// [`Options::gpu_bytes`](super::Options::gpu_bytes) first.
    pub fn set_gpu_taken(&mut self, bytes: u64) {
        if bytes != self.gpu_taken {
            self.gpu_taken = bytes;
            self.share_out();
        }
    }

    /// The least of the GPU's memory that frames can do with, besides the coarsest diamonds: what they take, and with imagery
    /// the fewest tiles.
    #[must_use]
    pub fn gpu_least(&self) -> u64 {
        let least = |_| crate::texture::gpu_bytes(TILES_MIN, self.options.texture_coding);
        self.gpu_taken + self.draping.as_ref().map_or(0, least)
    }

    /// The GPU's memory that all that is drawn may take.
    #[must_use]
    pub fn gpu_budget(&self) -> u64 {
        self.options.gpu_bytes
    }

    /// Layers of water that frames may draw at once: of a series one.
    #[must_use]
    pub fn waters(&self) -> usize {
        let names: HashSet<&str> = self
            .scene
            .layers
            .iter()
            .zip(&self.layers)
            .filter(|(layer, state)| state.shown && layer.kind == Kind::Water)
            .map(|(layer, _)| self.scene.chosen_as(&layer.name))
            .collect();
        names.len()
    }

    /// What the pictures of tiles take of the GPU's memory, once the first is shown.
    pub(super) fn imagery_gpu_bytes(&self) -> u64 {
        self.draping.as_ref().map_or(0, Draping::gpu_bytes)
    }

    /// The scene with no layers but those that are shown; with all, where none is. For its extent: positions of layers are
    /// those of [`Terrain::scene`].
    #[must_use]
    pub fn shown_scene(&self) -> Scene {
        let mut scene = Scene::clone(&self.scene);
        if self.layers.iter().any(|state| state.shown) {
            let mut shown = self.layers.iter().map(|state| state.shown);
            scene.layers.retain(|_| shown.next().unwrap_or(true));
        }
        scene
    }
}

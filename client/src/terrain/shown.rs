//! Which layers are streamed and drawn.
//!
//! One that is hidden keeps its index, and what is resident of it until the room is needed; no more of it is asked for.

use super::{Layer, LayerState, Scene, Terrain};
use crate::cut::Ideal;
use crate::morph::Morphs;

impl Terrain {
    /// Whether a layer, by its position in the scene, is streamed and drawn.
    #[must_use]
    pub fn is_shown(&self, layer: usize) -> bool {
        self.layers.get(layer).is_some_and(|state| state.shown)
    }

    /// Shows a layer from the next frame on, or hides it. What the layers' surfaces may take of the memory is shared by
    /// those that are shown.
    pub fn set_shown(&mut self, layer: usize, shown: bool) {
        let wanted = |number: usize, state: &LayerState| if number == layer { shown } else { state.shown };
        let layers = self.scene.layers.iter().zip(&self.layers).enumerate();
        let names = layers.filter(|(number, (_, state))| wanted(*number, state));
        let names: Vec<String> = names.map(|(_, (layer, _))| layer.name.clone()).collect();
        // All are all of another version, too.
        let is_all = names.len() == self.layers.len();
        self.show_only((!is_all).then_some(names));
    }

    /// Shows the layers of these names, or all. Where there is none of them, as in a version with other layers, all.
    pub(super) fn show_only(&mut self, names: Option<Vec<String>>) {
        let is_there = |name: &String| self.scene.layers.iter().any(|layer| layer.name == *name);
        let names = names.filter(|names| names.is_empty() || names.iter().any(is_there));
        let wanted = |layer: &Layer| names.as_ref().is_none_or(|names| names.contains(&layer.name));
        for (layer, state) in self.scene.layers.iter().zip(&mut self.layers) {
            if wanted(layer) != state.shown {
                state.shown = wanted(layer);
                // Nothing is wanted of it any more, or nothing was.
                state.ideal = Ideal::default();
                state.morphs = Morphs::new(self.options.morph_seconds);
            }
        }
        self.shares.share_out(&mut self.layers, self.options.gpu_bytes);
        self.options.layers = names;
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

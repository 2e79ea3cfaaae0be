//! What water mirrors: a cut of its own, as an eye below the surface sees the land.
//!
//! It may be coarser than what is seen straight, since waves and a faint mirror hide that, and draws what lies
//! out of the picture but shows in the water. What it lacks is asked for after what the picture itself lacks as much.

use super::steps::Role;
use super::{FrameView, Terrain};
use crate::camera::Camera;
use crate::cut::{self, Ask, Gpu, Ideal, Wish};
use crate::drawing::Mirror;
use crate::mirror::mean_height;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::Entry;
use diamantina_protocol::message::{Kind, Layer};

/// Of what the cut of a layer may take, the part that is kept for what is mirrored: it shares most of what it draws with the
/// picture itself.
const PART: usize = 4;

/// How urgent what is mirrored is, beside what is seen straight with the same error.
const URGENCY: f64 = 0.5;

impl Terrain {
    /// Has frames tell what layers of water mirror, with so many times the error in pixels; or not.
    pub fn set_mirrors(&mut self, coarser: Option<f64>) {
        self.mirrors = coarser.filter(|coarser| *coarser >= 1.0);
    }

    /// What the layers' cuts may take of their share, beside what is mirrored: of so many parts so many.
    pub(super) fn beside_mirrors(&self) -> [usize; 2] {
        let is_any = (0..self.layers.len()).any(|number| self.is_mirror(number));
        if is_any { [PART, PART - 1] } else { [1, 1] }
    }

    fn is_mirror(&self, number: usize) -> bool {
        let state = &self.layers[number];
        let is_water = self.scene.layers[number].kind == Kind::Water;
        // Of water that changes with time, the step that is drawn.
        let is_drawn = state.shown && matches!(state.role, Role::Drawn | Role::Stays);
        self.mirrors.is_some() && is_water && is_drawn
    }

    /// Says what the water that a frame draws mirrors, and what is missing for that.
    pub(super) fn mirror(&mut self, camera: &Camera, view: &mut FrameView, wishes: &mut Vec<(usize, Wish)>) {
        for state in &mut self.layers {
            state.mirrored.clear();
        }
        let Some(coarser) = self.mirrors else { return };
        let waters: Vec<usize> = (0..self.layers.len()).filter(|number| self.is_mirror(*number)).collect();
        let share = PART * waters.len().max(1);
        for number in waters {
            let Some(height) = self.water_height(number, camera, view) else { continue };
            if camera.eye.z <= height {
                // Nothing is mirrored on the way up.
                continue;
            }
            let below = camera.mirrored(height);
            let mut items = Vec::new();
            for (land, state) in self.layers.iter_mut().enumerate() {
                let layer = &self.scene.layers[land];
                if !state.shown || layer.kind != Kind::Terrain {
                    continue;
                }
                let gpu_bytes_of = |d| self.cache.get((land, d)).map(|surface| surface.gpu_bytes(self.wires));
                let ask = Ask {
                    layer,
                    encoding: self.options.fetch.encoding,
                    camera: &below,
                    exaggeration: self.options.exaggeration,
                    tolerance_pixels: self.options.tolerance_pixels * coarser,
                    sight: self.options.sight,
                    seen: None,
                    memory_bytes: state.memory_bytes / share,
                    gpu: Some(Gpu { bytes: state.gpu_bytes / share as u64, of: &gpu_bytes_of }),
                };
                let drowned = |d, entry| drowned(layer, d, entry, self.options.exaggeration, height);
                let ideal = cut::choose(&ask, |d| state.index.get(d).map(|entry| drowned(d, entry)));
                let drawing = cut::draw(land, &ask, &ideal, |d| self.cache.get((land, d)).cloned());
                view.complete &= drawing.wishes.is_empty() && ideal.pages().is_empty();
                let is_new = |wish: &Wish| !state.wants(wish.diamond);
                let wished = drawing.wishes.into_iter().filter(is_new);
                wishes.extend(wished.map(|w| (land, Wish { priority: URGENCY * w.priority, ..w })));
                items.extend(drawing.items);
                state.mirrored.push(ideal);
            }
            view.mirrors.push(Mirror { layer: number, height, items });
        }
    }

    /// The height of what a frame draws of a layer of water, in metres, stretched.
    fn water_height(&self, number: usize, camera: &Camera, view: &FrameView) -> Option<f64> {
        let (layer, state) = (&self.scene.layers[number], &self.layers[number]);
        let drawn = view.items.iter().filter(|item| item.layer == number);
        let parts = drawn.filter_map(|item| {
            let bounds = cut::bounds(layer, item.diamond, &state.index.get(item.diamond)?);
            Some((item.diamond, bounds.stretched(self.options.exaggeration)))
        });
        mean_height(parts, camera.eye)
    }
}

/// What lies below the mirror as a whole is not seen in it, however wrong it is.
fn drowned(layer: &Layer, d: Diamond, entry: Entry, exaggeration: f64, height: f64) -> Entry {
    let is_below = cut::bounds(layer, d, &entry).stretched(exaggeration).max.z < height;
    if is_below { Entry { error_metres: 0.0, ..entry } } else { entry }
}

impl super::LayerState {
    /// Whether a diamond is wanted as split, for whatever is drawn.
    pub(super) fn wants(&self, d: Diamond) -> bool {
        self.ideal.contains(d) || self.mirrored.iter().any(|ideal| ideal.contains(d))
    }

    /// All that is wanted as split.
    pub(super) fn wanted(&self) -> impl Iterator<Item = Diamond> + '_ {
        self.ideal.splits().chain(self.mirrored.iter().flat_map(Ideal::splits))
    }
}

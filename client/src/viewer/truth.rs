//! The switch that shows nothing but what was measured, and back.

use super::Viewer;
use crate::render::Look;

/// What comes back when the switch goes off.
#[derive(Debug, Clone, Copy)]
pub(super) struct Untrue {
    look: Look,
    morph_seconds: f64,
    texture: Option<usize>,
}

impl Viewer {
    /// Whether nothing but what was measured is shown.
    #[must_use]
    pub fn is_true(&self) -> bool {
        let Look { background, .. } = self.look;
        Look { background, ..self.look.truthful() } == self.look
            && background != crate::render::Background::Sky
            && self.terrain.morph_seconds() == 0.0
    }

    /// Shows nothing but what was measured, as `--true` does, or all again as it was before. The edges of a window stay
    /// smoothed, as they were when it was opened; pictures that are saved have one sample a pixel.
    pub fn set_true(&mut self, is_true: bool) {
        if is_true {
            self.untrue = Some(Untrue {
                look: self.look,
                morph_seconds: self.terrain.morph_seconds(),
                texture: self.terrain.texture(),
            });
            self.set_exaggeration(1.0);
            self.look = self.look.truthful();
            self.terrain.set_morph_seconds(0.0);
            // Colours tell heights, unless a picture is asked for from now on.
            self.terrain.set_texture(None);
            return;
        }
        let before = self.untrue.take();
        // A viewer that was opened so has nothing to go back to but what is usual.
        let usual = Look { annotations: self.look.annotations, ..Look::of(self.terrain.scene()) };
        let look = before.map_or(usual, |before| before.look);
        self.set_exaggeration(look.exaggeration);
        // What may be chosen in between stays as it was chosen.
        let Look { sun, colours, range, wireframe, annotations, .. } = self.look;
        self.look = Look { sun, colours, range, wireframe, annotations, ..look };
        if let (Some(Untrue { texture, .. }), None) = (before, self.terrain.texture()) {
            self.terrain.set_texture(texture);
        }
        self.terrain.set_morph_seconds(before.map_or(super::MORPH_SECONDS, |before| before.morph_seconds));
    }
}

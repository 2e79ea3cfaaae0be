//! What one frame draws, as plain data: the cut writes it, the renderer reads it.

use crate::morph::{Moment, Motion};
use crate::surface::Surface;
use diamantina_protocol::diamond::Diamond;
use std::sync::Arc;

/// One diamond to draw in a frame: some of the four triangles of its split.
#[derive(Debug, Clone)]
pub struct DrawItem {
    /// Index of the layer in the scene.
    pub layer: usize,
    /// The diamond that is split.
    pub diamond: Diamond,
    /// The geometry of its split.
    pub surface: Arc<Surface>,
    /// Bit q: draw the triangle whose hypotenuse is side q of the diamond's local grid and whose apex is
    /// its centre.
    pub sides: u8,
    /// How its points move, if they do.
    pub moving: Option<Moving>,
    /// The pixels that show it, where irregular triangles appear or go.
    pub share: Share,
}

/// Pixels of a picture, which all have numbers from 0 to below 1: those of which it is not below the first number, and below the
/// second one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Share(pub [f32; 2]);

impl Share {
    /// All pixels.
    pub const ALL: Self = Self([0.0, 1.0]);

    /// Whether they are all of a picture's.
    #[must_use]
    pub fn is_all(&self) -> bool {
        self.0[0] <= 0.0 && self.0[1] >= 1.0
    }
}

impl DrawItem {
    /// Bytes of GPU memory that it takes at most; with `wires` also the lines around its triangles.
    #[must_use]
    pub fn gpu_bytes(&self, wires: bool) -> u64 {
        self.surface.gpu_bytes(wires) + self.motion_bytes()
    }

    /// Bytes of GPU memory that its motion takes, if it moves.
    #[must_use]
    pub fn motion_bytes(&self) -> u64 {
        self.moving.as_ref().map_or(0, |moving| size_of_val(moving.motion.records()) as u64)
    }
}

/// What diamonds and their motions may take of the GPU's memory, where all else takes so much of it: the rest, but for a part that
/// their places take, which are told anew for each pass of a frame.
#[must_use]
pub fn left_for_diamonds(gpu_bytes: u64, taken: u64) -> u64 {
    let left = gpu_bytes.saturating_sub(taken);
    left - left / 64
}

/// What a layer of water mirrors in a frame.
#[derive(Debug, Clone)]
pub struct Mirror {
    /// Index of the layer of water in the scene.
    pub layer: usize,
    /// The height that it mirrors at, in metres, stretched as all heights are.
    pub height: f64,
    /// The triangles to draw; they cover whatever is in view in the mirror.
    pub items: Vec<DrawItem>,
}

/// A motion at a moment.
#[derive(Debug, Clone)]
pub struct Moving {
    /// The motion.
    pub motion: Arc<Motion>,
    /// The moment to draw: the same for all items of a frame, or there are cracks.
    pub now: Moment,
}

//! What is drawn of a diamond: the message from the cut to the renderer.

use crate::surface::Surface;
use diamantina_protocol::diamond::Diamond;
use std::sync::Arc;

/// Triangles of one split diamond, to be drawn as they are.
#[derive(Debug, Clone)]
pub struct DrawItem {
    /// The layer's number in the scene.
    pub layer: usize,
    /// The diamond.
    pub diamond: Diamond,
    /// Its heights and slopes.
    pub surface: Arc<Surface>,
    /// Bit q: triangle q of the split, whose hypotenuse is side q of the local grid and whose apex is
    /// the centre.
    pub sides: u8,
}

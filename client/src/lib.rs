//! Draws streamed terrain.

pub mod camera;
pub mod surface;

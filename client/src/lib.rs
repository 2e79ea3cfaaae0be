//! Draws streamed terrain.

pub mod camera;
pub mod drawing;
pub mod picture;
pub mod render;
pub mod surface;

//! Draws streamed terrain.

pub mod cache;
pub mod camera;
pub mod cut;
pub mod drawing;
pub mod fetch;
pub mod surface;
pub mod terrain;
#[cfg(test)]
mod world;

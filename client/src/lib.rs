//! Draws streamed terrain.

pub mod cache;
pub mod camera;
pub mod cut;
pub mod drawing;
pub mod fetch;
pub mod surface;
pub mod terrain;
#[cfg(test)]
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "small numbers"
)]
mod world;

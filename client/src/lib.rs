//! Draws streamed terrain.

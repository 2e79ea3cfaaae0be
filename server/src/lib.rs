//! Builds and serves streamed terrain.

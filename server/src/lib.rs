//! Builds and serves streamed terrain.

pub mod ingest;
pub mod projection;

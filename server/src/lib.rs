//! Builds and serves streamed terrain.

pub mod canvas;
pub mod hierarchy;
pub mod ingest;
pub mod measure;
pub mod progress;
pub mod projection;
pub mod store;

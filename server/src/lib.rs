//! Builds and serves streamed terrain.

pub mod canvas;
pub mod chunks;
pub mod client_program;
pub mod curve;
pub mod demo;
pub mod experiment;
pub mod height;
pub mod hierarchy;
pub mod http;
pub mod ingest;
pub mod inspect;
pub mod measure;
pub mod progress;
pub mod projection;
pub mod sample;
mod seldom;
pub mod settings;
pub mod size;
pub mod store;
pub mod stream;
pub mod texture;
pub mod tin;
pub mod zone;

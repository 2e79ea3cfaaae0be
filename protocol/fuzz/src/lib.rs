//! What is asked of each decoder, whatever it is given. The fuzzer asks it of inputs that it makes up, and
//! `tests/corpora.rs` of the seeds and of some inputs like them, with every run of the tests.

pub mod batch_query;
pub mod coverage;
pub mod frames;
pub mod index_page;
pub mod points;
pub mod scene;
pub mod stream_query;
pub mod tin;
pub mod zone;

//! What is asked of a server, whatever it is sent, and of a store, whatever lies in its folder. The fuzzer asks it of
//! inputs that it makes up, and `tests/corpora.rs` of the seeds and of some inputs like them, with every run of the tests.

pub mod directory;
mod made;
pub mod request;

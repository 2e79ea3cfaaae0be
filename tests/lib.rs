//! End-to-end tests of Diamantina live in this package; see `e2e.rs`.

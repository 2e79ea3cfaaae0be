//! See `src/batch_query.rs`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| diamantina_fuzz::batch_query::run(data));

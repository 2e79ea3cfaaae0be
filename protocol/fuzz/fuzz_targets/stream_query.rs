//! See `src/stream_query.rs`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| diamantina_fuzz::stream_query::run(data));

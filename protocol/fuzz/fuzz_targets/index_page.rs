//! See `src/index_page.rs`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| diamantina_fuzz::index_page::run(data));

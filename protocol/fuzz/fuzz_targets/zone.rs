//! See `src/zone.rs`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| diamantina_fuzz::zone::run(data));

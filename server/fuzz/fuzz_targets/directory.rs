//! See `src/directory.rs`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| diamantina_server_fuzz::directory::run(data));

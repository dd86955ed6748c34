//! See `fuzz::together`.
#![no_main]
libfuzzer_sys::fuzz_target!(|data: &[u8]| fuzz::together::target(data));

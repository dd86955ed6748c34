//! See `fuzz::folders`.
#![no_main]
libfuzzer_sys::fuzz_target!(|data: &[u8]| fuzz::folders::target(data));

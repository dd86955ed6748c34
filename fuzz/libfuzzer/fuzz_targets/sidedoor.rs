//! See `fuzz::sidedoor`.
#![no_main]
libfuzzer_sys::fuzz_target!(|data: &[u8]| fuzz::sidedoor::target(data));

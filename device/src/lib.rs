//! The layer that both images share: link, data kept over a reset, settings in flash, watchdog. The images pass in the
//! parts that differ: the safe state, the urgent stop, the rules of the settings.
//!
//! Everything outside the folder `chip` is pure and tested on the host.
#![no_std]
#![deny(unsafe_code)]

#[cfg(target_os = "none")]
pub mod chip;
pub mod common;
pub mod due;
pub mod fingerprint;
pub mod half_periods;
pub mod identity;
pub mod last_words;
pub mod mark;
pub mod option_bytes;
pub mod retained;
pub mod service;
pub mod settings;
pub mod store;
pub mod supervision;

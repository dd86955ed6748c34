//! What both images share, below either of them: how a device talks, what it keeps over a reset, its settings in
//! flash, its watchdog. Whatever differs is passed in: the safe state, the urgent stop, the rules of the settings.
//!
//! Everything beside the folder `chip` is pure and tested on the host.
#![no_std]
#![deny(unsafe_code)]

#[cfg(target_os = "none")]
pub mod chip;
pub mod common;
pub mod due;
pub mod half_periods;
pub mod identity;
pub mod last_words;
pub mod option_bytes;
pub mod retained;
pub mod service;
pub mod settings;
pub mod store;
pub mod supervision;

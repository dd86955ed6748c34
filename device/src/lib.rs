//! What both images share, below either of them: how a device talks, what it keeps over a reset, its settings in
//! flash, its watchdog. Whatever differs is passed in: the safe state, the urgent stop, the rules of the settings.
//!
//! Everything beside the folder `chip` is pure and tested on the host.
#![no_std]
#![deny(unsafe_code)]

#[cfg(all(feature = "stm32f411re", feature = "stm32l412tb"))]
compile_error!(
    "two chips are chosen: for another board than the default add `--no-default-features`"
);
#[cfg(all(
    target_os = "none",
    not(any(feature = "stm32f411re", feature = "stm32l412tb"))
))]
compile_error!("no chip is chosen: add `--features stm32f411re` or `--features stm32l412tb`");

#[cfg(all(
    target_os = "none",
    any(feature = "stm32f411re", feature = "stm32l412tb")
))]
pub mod chip;
pub mod common;
pub mod double_words;
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

//! The capsule's logic without its hardware. The host tests it; the image in `main.rs` wires it to the STM32F411.
//!
//! The worm holds, so **the count is the position**. Force ends one motion only, the calibration. A fold is believed
//! only after its thread was felt.
//!
//! `machine` has the states and the motions as lists of phases, `orders` what each state accepts, `phase` where a phase
//! ends and how fast it goes. `guards`, `feel` and `speed` serve the present phase; `known` alone outlives it. `control`
//! is the task around them, fed by `sense`.
#![no_std]
#![forbid(unsafe_code)]

pub mod commands;
pub mod control;
pub mod feel;
pub mod guards;
pub mod known;
pub mod machine;
mod orders;
pub mod phase;
pub mod record;
pub mod sense;
pub mod settings;
pub mod speed;
pub mod units;

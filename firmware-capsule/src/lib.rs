//! The capsule's logic without its hardware. The host tests it; the image in `main.rs` wires it to the STM32F411.
//!
//! The worm holds, so **the count is the position**. Force ends one motion only, the calibration. A fold is believed
//! only after its thread was felt.
//!
//! | file | what |
//! |---|---|
//! | `units` | counts of the encoder, length of thread |
//! | `known` | what is known of the thread, in RAM and in flash |
//! | `phase` | one phase of a motion as data, and where it ends |
//! | `machine` | states, motions as lists of phases, faults |
//! | `orders` | which motion each state accepts |
//! | `feel` | measurements on the way: the thread's pull, and its rise at the folded end |
//! | `guards` | what ends any phase at once, in a fixed order |
//! | `speed` | the speed loop, with the current bounded by the motor's equation |
//! | `control` | the task: readings, requests, flash |
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

//! The capsule's logic without its hardware: mechanics, detection, state machine, commands. The host tests it. The
//! image in `main.rs` wires it to the STM32F411.
#![no_std]
#![forbid(unsafe_code)]

pub mod calibration;
pub mod circuit;
pub mod commands;
pub mod control;
pub mod detect;
pub mod fold;
pub mod governor;
pub mod kept;
pub mod leg;
pub mod mechanics;
mod record;
pub mod sample;
pub mod sense;
pub mod settings;
pub mod trace;
pub mod window;

//! The rig's logic without its hardware: state machine, requests, execution of paths, settings. Tested on the host;
//! the image in `main.rs` wires it to the STM32F411.
#![no_std]
#![forbid(unsafe_code)]

pub mod commands;
pub mod control;
pub mod execution;
pub mod machine;
pub mod periods;
pub mod settings;

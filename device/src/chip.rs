//! The STM32F411 as both images use it: everything of this crate that touches registers or shares state.

#![allow(unsafe_code)]

pub mod channels;
pub mod flash;
pub mod image;
pub mod last_resort;
pub mod link;
pub mod retained;
pub mod start;
pub mod supply;
pub mod surroundings;
pub mod telemetry;
pub mod watchdog;

//! The microcontroller: all code of this crate that touches registers or shares state between tasks.

#![allow(unsafe_code)]

mod stm32f411re;

pub use stm32f411re::{clock, flash, serial, supply};

pub mod channels;
pub mod image;
pub mod last_resort;
pub mod link;
pub mod retained;
pub mod start;
pub mod surroundings;
pub mod telemetry;
pub mod watchdog;

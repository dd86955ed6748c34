//! The microcontroller as the images use it: everything of this crate that touches registers or shares state.
//!
//! What differs from chip to chip is in the folder of the chip, chosen by a feature: `part` below.

#![allow(unsafe_code)]

#[cfg(feature = "stm32f411re")]
mod stm32f411re;
#[cfg(feature = "stm32f411re")]
use stm32f411re as part;
#[cfg(feature = "stm32f411re")]
pub use stm32f411re::clock;

#[cfg(feature = "stm32l412tb")]
mod stm32l412tb;
#[cfg(feature = "stm32l412tb")]
use stm32l412tb as part;

pub use part::{flash, serial, supply};

pub mod channels;
pub mod image;
pub mod last_resort;
pub mod link;
pub mod retained;
pub mod start;
pub mod surroundings;
pub mod telemetry;
pub mod watchdog;

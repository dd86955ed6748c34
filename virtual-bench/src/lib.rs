//! The virtual bench: both machines around the unmodified firmware images on an emulated STM32, judged from their
//! pins.
//!
//! ```text
//!  host tool --link-- [ serial | chip | board ] -- plant        verdicts <-- pins
//!                        the ELF that is flashed
//! ```
//!
//! The bench never uses the firmware's arithmetic: it has its own.

pub mod bench;
pub mod boards;
pub mod bus;
pub mod connector;
pub mod demo;
pub mod emulator;
pub mod fault_injection;
pub mod faults;
pub mod figures;
pub mod fixture;
pub mod link;
pub mod log;
mod pace;
pub mod pins;
pub mod plants;
pub mod serial;
pub mod serve;
pub mod verdicts;
pub mod warm;

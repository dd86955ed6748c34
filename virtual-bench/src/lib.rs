//! The virtual bench: both machines around the unmodified firmware images on an emulated STM32, judged from their
//! pins.
//!
//! ```text
//!  host tool --link-- [ serial | chip | board ] -- plant        verdicts <-- pins
//!                        the ELF that is flashed
//! ```
//!
//! The bench never uses the firmware's arithmetic: it computes the expected run by itself.

pub mod bench;
pub mod boards;
#[cfg(unix)]
mod browser;
pub mod bus;
pub mod connector;
#[cfg(unix)]
mod crowd;
pub mod demo;
pub mod emulator;
pub mod faults;
pub mod figures;
pub mod hands;
#[cfg(unix)]
pub mod killed;
pub mod link;
pub mod log;
mod pace;
pub mod pins;
pub mod plants;
pub mod population;
#[cfg(unix)]
pub mod processes;
pub mod sabotage;
pub mod serial;
pub mod serve;
#[cfg(unix)]
mod server;
#[cfg(unix)]
pub mod sidedoor;
pub mod torture;
pub mod verdicts;
pub mod warm;
#[cfg(unix)]
pub mod webpage;

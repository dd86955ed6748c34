//! One machine over a line: what is sent, what comes back, and whose line it is.
//!
//! * [`Device`]: typed requests, events, telemetry, waiting, stops.
//! * [`address`]: where a machine is.
//! * [`link`]: a byte pipe with its own clock: serial port, TCP, memory, or the virtual bench.
//! * [`door`]: one process owns a line, others look through its door and can stop.
//! * [`diagnosis`]: the other end when no machine answers.
//! * [`error`]: why a request failed, and what to do about it.
//! * [`identity`]: names of machines, images and versions.
//! * [`named`]: the user's names for machines.
//! * [`subject`]: the machine that results are about.
//! * [`wording`]: refusals in people's units.
//! * [`decimal`]: decimal numbers as people write them, exact.
//! * [`limited`]: files that are read up to a limit.
#![forbid(unsafe_code)]

pub mod address;
pub mod decimal;
mod device;
pub mod diagnosis;
pub mod door;
pub mod error;
pub mod identity;
pub mod limited;
pub mod link;
pub mod named;
pub mod subject;
pub mod wording;

pub use device::observer::{
    Begun, Both, Clock, Homed, Interrupt, Observer, Pace, Pacer, Progress, Unobserved,
};
pub use device::waiting::{Recorded, homing_limit_us, while_moving};
pub use device::{Device, KEEP_ALIVE_US, matches};

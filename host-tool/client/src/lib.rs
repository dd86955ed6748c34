//! Client of one machine over a line: requests, answers, and the ownership of the line.
//!
//! * [`Device`]: typed requests, events, telemetry, waiting, stops.
//! * [`address`]: addresses of machines.
//! * [`link`]: a byte pipe with its own clock: serial port, TCP, memory, or the virtual bench.
//! * [`broker`]: one process owns a line, others use its broker and can stop.
//! * [`diagnosis`]: the other end when no machine answers.
//! * [`error`]: the reason why a request failed, and the remedy.
//! * [`identity`]: names of machines, images and versions.
//! * [`exit`]: exit codes.
//! * [`subject`]: the machine that results are about.
//! * [`wording`]: refusals in people's units.
//! * [`decimal`]: decimal numbers as people write them, exact.
//! * [`pairs`]: JSON objects whose names may be repeated.
//! * [`limited`]: reads files up to a size limit. [`named`]: files that the user names. [`plain`]: files of a folder.
#![forbid(unsafe_code)]

pub mod address;
pub mod broker;
pub mod decimal;
mod device;
pub mod diagnosis;
pub mod error;
pub mod exit;
pub mod identity;
pub mod limited;
pub mod link;
pub mod named;
pub mod pairs;
pub mod plain;
pub mod subject;
pub mod visible;
pub mod wording;

pub use device::observer::{
    Begun, Both, Clock, Homed, Interrupt, Observer, Pace, Pacer, Progress, Unobserved,
};
pub use device::waiting::{Recorded, homing_limit_us, while_moving};
pub use device::{Device, KEEP_ALIVE_US, matches, moves};

//! The client library of both machines, and the command line tool on top of it.
//!
//! * [`link`]: a byte pipe with its own clock: serial port, TCP, memory, or the virtual bench.
//! * [`client`]: one machine: typed requests, events, telemetry, waiting, stops.
//! * [`error`]: why something was not done, and what to do about it.
//! * [`connector`]: where links come from.
//! * [`decimal`]: numbers as people write them, exact.
#![forbid(unsafe_code)]

pub mod client;
pub mod connector;
pub mod decimal;
pub mod error;
pub mod identity;
pub mod link;

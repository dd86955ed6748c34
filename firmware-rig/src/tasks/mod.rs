//! The tasks: each file is one.

pub mod control;
pub mod link;
pub mod motion;
pub mod telemetry;
pub mod watchdog;

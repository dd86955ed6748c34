//! The work of a laboratory with both machines: find one, record its actions, carry out a campaign, commission a board.
//!
//! * [`operations`]: shared by the command line and the server: machines, failures and stops.
//! * [`trials`]: actions that are executed once and recorded.
//! * [`campaign`]: a plan of trials over days.
//! * [`commissioning`]: the steps from a new board to a machine that may run.
#![forbid(unsafe_code)]

pub mod campaign;
pub mod commissioning;
pub mod operations;
pub mod trials;

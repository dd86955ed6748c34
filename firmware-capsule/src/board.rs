//! The capsule's hardware: everything that touches registers, shares state or waits. The files beside this folder
//! make the decisions.

pub(crate) mod channels;
pub(crate) mod drive_train;
pub(crate) mod pins;
mod start;
pub(crate) mod tasks;
mod timers;

device::last_resort!(pins::outputs_off);

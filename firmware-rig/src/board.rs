//! The rig's hardware: everything that touches registers, shares state or waits. The logic is beside this folder.

pub mod captures;
pub mod channels;
mod clock;
pub mod pins;
pub mod step_generator;
pub mod switches;
pub mod tasks;

device::last_resort!(pins::outputs_off);

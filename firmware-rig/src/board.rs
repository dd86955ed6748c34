//! The rig's hardware: registers, shared state and tasks. The logic is in the library.

pub mod captures;
pub mod channels;
mod clock;
pub mod pins;
pub mod step_generator;
pub mod switches;
pub mod tasks;

device::last_resort!(pins::outputs_off);

//! The images on the bench. One program: its tests share what they are built from, and none of two cores waits for the
//! longest test of a file.

mod common;

mod accepted;
mod campaign;
mod capsule;
mod capsule_settings;
mod clock;
mod commission;
mod coordination;
mod edge_timing;
mod estop;
mod faults;
mod limits;
mod link;
mod measurements;
mod random;
mod rig;
mod settings;
mod silicon;
mod speed;
mod stepwise;
mod stop_in_real_time;
mod watchdog;
mod wires;

//! The boards: what is connected to which pin.

pub mod capsule;
pub mod rig;

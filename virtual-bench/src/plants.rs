//! The machines without their electronics: what moves, and what the sensors report.

pub mod capsule;
pub mod contact;
pub mod rig;
pub mod wire;

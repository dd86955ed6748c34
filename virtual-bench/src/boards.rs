//! Which pin goes where.

pub mod capsule;
pub mod rig;

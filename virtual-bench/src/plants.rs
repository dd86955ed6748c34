//! The machines themselves, without a chip in sight: what moves, and what its sensors say.

pub mod capsule;
pub mod contact;
pub mod rig;

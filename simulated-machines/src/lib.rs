//! Both machines in this process, in virtual time, for tests and fuzzing: the firmware's own libraries, with models of
//! everything around them.
//!
//! * [`chip`]: the flash, with a supply that can fail.
//! * [`dice`]: random choices from a seed.
//! * [`carriage`]: the rig's screw, step ring and switches. [`plant`]: the capsule's bridge, motor and thread.
//! * [`machine`]: a whole machine behind a bad line, with feature `links`; [`link`]: the host's end of it.
#![forbid(unsafe_code)]
#![allow(missing_docs)]

pub mod carriage;
pub mod chip;
pub mod dice;
#[cfg(feature = "links")]
pub mod link;
#[cfg(feature = "links")]
pub mod machine;
pub mod plant;

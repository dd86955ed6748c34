//! What the command line and the server share: the way to a machine, and how its actions fail and stop.
//!
//! * [`arguments`]: arguments of commands, which are the fields of requests.
//! * [`connector`]: where links come from. [`names`] and [`places`]: which machine is meant, and a session with it.
//! * [`failure`]: why a command failed, its remedy and exit code.
//! * [`interrupt`], [`stops`], [`delivery`]: what the operator wants stopped, and what became of it.
//! * [`folding`], [`ending`], [`reached`], [`left`]: before and after a motion.
//! * [`panel`]: what is known of a machine that is watched.
#![forbid(unsafe_code)]

pub mod arguments;
pub mod connector;
pub mod delivery;
pub mod ending;
pub mod failure;
pub mod folding;
pub mod interrupt;
pub mod left;
pub mod names;
pub mod panel;
pub mod places;
pub mod reached;
pub mod stops;

//! Shared by the command line and the server: access to machines, and failures and stops of their actions.
//!
//! * [`arguments`]: arguments of commands, which are the fields of requests.
//! * [`connector`]: sources of links. [`finder`]: finds the machine and opens a session with it.
//! * [`failure`]: the reason why a command failed, its remedy and exit code.
//! * [`interrupt`], [`stops`], [`delivery`]: stops, from the operator's request to the confirmation.
//! * [`folding`], [`ending`], [`reached`]: tasks before and after a motion.
//! * [`panel`]: the known state of an observed machine. [`output`]: text for people and programs.

pub mod arguments;
pub mod connector;
pub mod delivery;
pub mod ending;
pub mod failure;
pub mod finder;
pub mod folding;
pub mod interrupt;
pub mod output;
pub mod panel;
pub mod reached;
pub mod stops;

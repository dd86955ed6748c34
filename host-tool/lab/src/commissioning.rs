//! Commissioning of a new board: the manual's steps, measured where possible.
//!
//! ```text
//! session     carries steps out and writes the record
//! warning     warnings before a run, from the record
//! rig, capsule  the measurements; device: those that both share
//! procedure   which step is next, and whether a result still counts, from a record alone
//! step        what a step shows, and what its result depends on; the steps of each machine
//! work        helpers for all measurements: asking the operator, finding the board again; work::rig: homing, running
//! record      the results: a JSON file, one per board
//! operator    presses, pulls and measures: a person, or the virtual bench's fixture
//! halt        why a measurement was aborted
//! image       the mark and the fingerprint of an image file
//! ```
//!
//! Each module uses only those below it. A step passes only if its effect was observed; otherwise it is recorded as not
//! shown.

pub mod capsule;
mod device;
pub mod halt;
pub mod image;
pub mod operator;
pub mod procedure;
pub mod record;
pub mod rig;
pub mod session;
pub mod step;
pub mod warning;
pub mod work;

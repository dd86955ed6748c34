//! Commissioning of a new board: the manual's steps, measured where they can be measured.
//!
//! ```text
//!   session     carries steps out and writes the record
//!   warning     warnings before a run, from the record
//!   rig, capsule  the measurements; device: those that both share
//!   procedure   which step is next, and whether a result still counts, from a record alone
//!   step        what there is to show, and what its result depends on; the steps of each machine
//!   work        helpers for all measurements: asking for a hand, finding the board again; work::rig: homing, running
//!   record      what was found: a JSON file, one per board
//!   operator    presses, pulls and measures: a person, or the virtual bench's fixture
//!   halt        why a measurement was broken off
//!   image       the fingerprint of an image file
//! ```
//!
//! Each module uses only those below it. A step passes only if its effect was observed; otherwise it is recorded as
//! not shown.

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

//! Commissioning of a new board: the manual's steps, measured where they can be measured.
//!
//! ```text
//!   session     carries steps out and writes the record
//!   warning     what a run should know of the record
//!   steps       the steps of each machine
//!   rig, capsule  the measurements; device: those that both share
//!   procedure   which step is next, and whether a result still counts, from a record alone
//!   step        what there is to show, and what its result depends on
//!   work        what all measurements need: asking for a hand, finding the board again; work::rig: homing, running
//!   record      what was found: a JSON file, one per board
//!   hands       who presses, pulls and measures: a person, or the bench
//!   halt        why a measurement ended before its end
//!   image       the fingerprint of an image file
//!   flashing    which image may be flashed
//! ```
//!
//! Each uses only what stands below it. A step counts as passed only if its effect was observed. What nobody has shown
//! is recorded as not shown.
#![forbid(unsafe_code)]

pub mod capsule;
mod device;
pub mod flashing;
pub mod halt;
pub mod hands;
pub mod image;
pub mod procedure;
pub mod record;
pub mod rig;
pub mod session;
pub mod step;
pub mod steps;
pub mod warning;
pub mod work;

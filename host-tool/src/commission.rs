//! Commissioning of a new board: the manual's steps, measured where they can be measured.
//!
//! ```text
//!   steps       what there is to show, and what each result depends on
//!   procedure   which step is next, from a record alone
//!   record      what was found: a JSON file, one per board
//!   session     carries steps out and writes the record
//!   work        what all measurements need: homing, running, asking for a hand
//!   rig, capsule  the measurements
//!   hands       who presses, pulls and measures: a person, or the bench
//!   image       the fingerprint of an image file
//! ```
//!
//! A step counts as passed only if its effect was observed. What nobody has shown is recorded as not shown.

pub mod capsule;
pub mod hands;
pub mod image;
pub mod procedure;
pub mod record;
pub mod rig;
pub mod session;
pub mod steps;
pub mod work;

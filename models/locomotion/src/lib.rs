//! The paper's mathematics: the origami's kinematics, its body in a travelling wave, the roller rig, the pressurised
//! tube and the folded body.
//!
//! No clock, no allocation and no randomness. The steps use only `+ - * /` and square roots, so that a run gives the
//! same bits every time. Lengths are in millimetres, pressures in pascals. The load of a wave on the body is given as
//! the indentation of the wall in millimetres.
//!
//! # Axes and signs
//! The intestine lies along x. Its marked left end is x = 0, the right end of the roller's travel x = 130 mm. The body
//! lies with its tail at the left and its head to the right. The **antegrade** wave runs from right to left; a
//! **positive displacement is headward**, to the right, against that wave: the paper's retrograde motion. The carriage
//! is counted as on the rig, 0 = home = right end, positive to the left, so the roller is at `x = stroke - carriage`.
//!
//! # Where a number comes from
//! Every parameter has a row in [`model::SETTINGS`] with its [`parameter::Label`] and its source. `docs/science.md`
//! says what that means for the results.
#![doc = include_str!("../README.md")]
#![no_std]
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate std;

pub mod body;
pub mod folded;
pub mod kinematics;
pub mod model;
pub mod paper;
pub mod parameter;
pub mod range;
pub mod roller;
pub mod tube;

//! Bayesian calibration of the locomotion model's body from displacements that were measured on the rig. No files, no
//! clock; all chance comes from a seed.
//!
//! * [`observation`]: what was measured, and its repeats.
//! * [`prior`]: what is unknown, and what is assumed of it.
//! * [`prediction`]: what the model says.
//! * [`table`]: the same, worked out beforehand.
//! * [`target`]: prior times likelihood.
//! * [`sampler`]: draws from it.
//! * [`diagnostics`]: whether the draws can be relied on.
//! * [`fit`]: all that together.
//! * [`predictive`]: what the posterior says of trials, beside what they gave.
//! * [`synthetic`]: trials of a known body.
//! * [`belief`]: what is held of the unknowns before a trial.
//! * [`information`]: how much one number tells.
//! * [`tabulated`]: the model worked out beforehand for a belief.
//! * [`history`]: one course that a series of trials may take.
//! * [`design`]: which trials tell most.
//! * [`chance`]: streams of a seed.
//!
//! `docs/science.md` says what is assumed and what the tests have shown.
#![forbid(unsafe_code)]

pub mod belief;
pub mod chance;
pub mod design;
pub mod diagnostics;
pub mod fit;
pub mod history;
pub mod information;
pub mod observation;
pub mod prediction;
pub mod predictive;
pub mod prior;
pub mod sampler;
pub mod synthetic;
pub mod table;
pub mod tabulated;
pub mod target;

//! Bayesian calibration of the locomotion model's body from displacements measured on the rig. No files, no clock;
//! all random numbers come from a seed.
//!
//! * [`observation`]: measurements and their repeats.
//! * [`prior`]: the unknowns and their priors.
//! * [`prediction`]: displacements by the model.
//! * [`table`]: the model tabulated.
//! * [`target`]: prior times likelihood.
//! * [`sampler`]: draws from the posterior.
//! * [`diagnostics`]: whether the draws are reliable.
//! * [`fit`]: the whole calibration.
//! * [`verdict`]: whether the fit may be believed, with the reasons not to.
//! * [`plausible`]: data in another unit or with the opposite sign.
//! * [`descent`]: the body nearest to the data.
//! * [`predictive`]: predictions of the posterior beside the measurements.
//! * [`replicated`]: predictions of single draws.
//! * [`synthetic`]: trials of a known body.
//! * [`belief`]: knowledge of the unknowns before a trial.
//! * [`information`]: information of one measurement.
//! * [`tabulated`]: the model tabulated for a belief.
//! * [`history`]: one possible course of a series of trials.
//! * [`design`]: which trials tell most.
//! * [`chance`]: random streams of a seed.
//!
//! `docs/model-calibration.md` states the assumptions and the results of the tests.
#![forbid(unsafe_code)]

pub mod belief;
pub mod chance;
pub mod descent;
pub mod design;
pub mod diagnostics;
pub mod fit;
pub mod history;
pub mod information;
pub mod observation;
pub mod plausible;
pub mod prediction;
pub mod predictive;
pub mod prior;
pub mod replicated;
pub mod sampler;
pub mod synthetic;
pub mod table;
pub mod tabulated;
pub mod target;
pub mod verdict;

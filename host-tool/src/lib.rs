//! The client library of both machines, and the command line tool on top of it. `examples/paper_run.rs` uses the
//! library alone.
//!
//! * [`connector`]: where links come from.
//! * [`campaign`]: a plan of trials carried out over days: order, ledger, readings, folder, manifest.
//! * [`chance`]: chance from a seed.
//! * [`trial`]: the record of an action: telemetry CSV and JSON sidecar.
//! * [`experiment`]: recorded actions, and the paper's experiment.
//! * [`fetched`]: what a machine itself still knows of its last action.
//! * [`endurance`]: folds and unfoldings in turn, and what drifts.
//! * [`force`]: force against thread from a recording.
//! * [`identify`]: a capsule's parameters, from its recordings.
//! * [`plan`]: a run, calculated before it is sent.
//! * [`report`]: recorded trials as one HTML file.
//! * [`statistics`]: mean, deviation, and a line with its band.
//! * [`science`]: the paper's design, simulations and series, without a machine.
//! * [`commission`]: the steps from a new board to a machine that may run, measured and recorded.
//! * [`coordination`]: an actuation that begins at a place of a run, its [`cue`].
//! * [`image`]: what may be flashed.
//! * [`progress`]: progress for people, as a bar or as lines.
//! * [`serve`]: both machines for browsers and programs, over HTTP.
//! * [`catalogue`]: campaigns and trials by date, specimen, outcome.
//! * [`cli`]: the command line, a thin layer over all this.
#![forbid(unsafe_code)]

pub mod campaign;
pub mod catalogue;
pub mod chance;
pub mod cli;
pub mod commission;
pub mod connector;
pub mod coordination;
pub mod cue;
pub mod endurance;
pub mod experiment;
pub mod fetched;
pub mod force;
pub mod identify;
pub mod image;
pub mod left;
pub mod plan;
pub mod progress;
pub mod report;
pub mod science;
pub mod serve;
pub mod statistics;
pub mod stops;
pub mod trial;
mod writer;

//! The client library of both machines, and the command line tool on top of it. `examples/paper_run.rs` uses the
//! library alone.
//!
//! * [`link`]: a byte pipe with its own clock: serial port, TCP, memory, or the virtual bench.
//! * [`client`]: one machine: typed requests, events, telemetry, waiting, stops.
//! * [`diagnosis`]: what is there when no machine answers.
//! * [`door`]: one process owns a line, others look through its door and can stop.
//! * [`error`]: why a request failed, and what to do about it.
//! * [`connector`]: where links come from.
//! * [`decimal`]: decimal numbers as people write them, exact.
//! * [`campaign`]: a plan of trials carried out over days: order, ledger, readings, folder, manifest.
//! * [`chance`]: chance from a seed.
//! * [`trial`]: the record of an action: telemetry CSV and JSON sidecar.
//! * [`experiment`]: recorded actions, and the paper's experiment.
//! * [`fetched`]: what a machine itself still knows of its last action.
//! * [`endurance`]: folds and unfoldings in turn, and what drifts.
//! * [`force`]: force against thread from a recording.
//! * [`identify`]: a capsule's parameters, from its recordings.
//! * [`identity`]: names of machines, images and versions.
//! * [`plan`]: a run, calculated before it is sent.
//! * [`report`]: recorded trials as one HTML file.
//! * [`statistics`]: mean, deviation, and a line with its band.
//! * [`science`]: the paper's design, simulations and series, without a machine.
//! * [`commission`]: the steps from a new board to a machine that may run, measured and recorded.
//! * [`coordination`]: an actuation that begins at a place of a run, its [`cue`].
//! * [`wording`]: refusals in people's units.
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
pub mod client;
pub mod commission;
pub mod connector;
pub mod coordination;
pub mod cue;
pub mod decimal;
pub mod diagnosis;
pub mod door;
pub mod endurance;
pub mod error;
pub mod experiment;
pub mod fetched;
pub mod force;
pub mod identify;
pub mod identity;
pub mod image;
pub mod left;
mod limited;
pub mod link;
pub mod named;
pub mod plan;
pub mod progress;
pub mod report;
pub mod science;
pub mod serve;
pub mod statistics;
pub mod stops;
pub mod trial;
pub mod wording;
mod writer;

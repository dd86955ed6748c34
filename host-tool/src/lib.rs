//! The client library of both machines, and the command line tool on top of it. `examples/paper_run.rs` uses the
//! library alone.
//!
//! * [`connector`]: where links come from.
//! * [`campaign`]: a plan of trials carried out over days: order, ledger, readings, folder, manifest.
//! * [`chance`]: chance from a seed.
//! * [`report`]: recorded trials as one HTML file.
//! * [`statistics`]: mean, deviation, and a line with its band.
//! * [`science`]: the paper's design, simulations and series, without a machine.
//! * [`commission`]: the steps from a new board to a machine that may run, measured and recorded.
//! * [`image`]: what may be flashed.
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
pub mod image;
pub mod left;
pub mod report;
pub mod science;
pub mod serve;
pub mod statistics;
pub mod stops;

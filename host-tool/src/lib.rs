//! The client library of both machines, and the command line tool on top of it. `examples/paper_run.rs` uses the
//! library alone.
//!
//! * [`connector`]: where links come from.
//! * [`report`]: recorded trials as one HTML file.
//! * [`science`]: the paper's design, simulations and series, without a machine.
//! * [`commission`]: the steps from a new board to a machine that may run, measured and recorded.
//! * [`image`]: what may be flashed.
//! * [`serve`]: both machines for browsers and programs, over HTTP.
//! * [`cli`]: the command line, a thin layer over all this.
#![forbid(unsafe_code)]

pub mod cli;
pub mod commission;
pub mod connector;
pub mod image;
pub mod left;
pub mod report;
pub mod science;
pub mod serve;
pub mod stops;

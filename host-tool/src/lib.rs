//! The client library of both machines, and the command line tool on top of it. `examples/paper_run.rs` uses the
//! library alone.
//!
//! * [`connector`]: where links come from.
//! * [`serve`]: both machines for browsers and programs, over HTTP.
//! * [`cli`]: the command line, a thin layer over all this.
#![forbid(unsafe_code)]

pub mod cli;
pub mod connector;
pub mod left;
pub mod serve;
pub mod stops;

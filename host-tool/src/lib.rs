//! The command line tool of both machines: one file for each command, over the crates beside this one.
//! `examples/paper_run.rs` uses those alone.
#![forbid(unsafe_code)]

pub mod cli;

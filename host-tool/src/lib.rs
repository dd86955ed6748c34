//! The command line tool of both machines: one file for each command, over the crates beside this one.
//! `examples/paper_run.rs` uses those alone.
#![forbid(unsafe_code)]

pub mod cli;

/// What `--version` says after the name: version, and revision of the sources.
const VERSION: &str = concat!(
    env!("CARGO_PKG_VERSION"),
    " (",
    env!("RETROGRADE_REVISION"),
    ")"
);

/// Has all records name this build, until the process ends.
pub fn sign_records() {
    let _ = client::identity::TOOL.set(VERSION);
}

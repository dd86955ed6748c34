//! Properties of machines and tool that must hold for arbitrary bytes. Each target is a function over bytes that
//! panics on a violation. `cargo xtask fuzz` passes them to libFuzzer, and `tests/bounded.rs` tries some of them in
//! every `cargo test`. docs/testing.md describes the method and the findings.
//!
//! * [`stream`]: any bytes into the device's receiver.
//! * [`bodies`]: good frames with any body into both machines.
//! * [`host`]: a device's messages into the host.
//! * [`sidedoor`]: a second process at the door of a line.
//! * [`http`]: requests to `retrograde serve`.
//! * [`records`]: changed records into `verify` and the report's check.
//! * [`documents`]: changed plans, settings, models, owner files and records of commissionings.
//! * [`folders`]: changed folders of campaigns, with links and pipes.
//! * [`together`]: crowds of requests to `retrograde serve`, and machines that die.
#![forbid(unsafe_code)]

mod bench;
pub mod bodies;
mod command;
pub mod documents;
mod door;
mod exemplary;
pub mod folders;
pub mod host;
pub mod http;
pub mod model;
pub mod records;
pub mod script;
mod server;
pub mod sidedoor;
pub mod stream;
pub mod text;
pub mod together;

/// Longest input, bytes: enough for two dozen steps, and short enough that changing one of them often has an effect.
pub const MAX_LEN: usize = 256;

/// All targets: their modules, each with its `target`, and their corpus folders.
pub const TARGETS: [&str; 9] = [
    "stream",
    "bodies",
    "host",
    "sidedoor",
    "http",
    "records",
    "documents",
    "folders",
    "together",
];

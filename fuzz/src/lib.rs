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

/// A fuzz target.
#[derive(Clone, Copy, Debug)]
pub struct Target {
    /// Name of its module and of its corpus folder.
    pub name: &'static str,
    /// Runs it on these bytes.
    pub run: fn(&[u8]),
}

/// All targets.
pub const TARGETS: [Target; 9] = [
    Target {
        name: "stream",
        run: stream::target,
    },
    Target {
        name: "bodies",
        run: bodies::target,
    },
    Target {
        name: "host",
        run: host::target,
    },
    Target {
        name: "sidedoor",
        run: sidedoor::target,
    },
    Target {
        name: "http",
        run: http::target,
    },
    Target {
        name: "records",
        run: records::target,
    },
    Target {
        name: "documents",
        run: documents::target,
    },
    Target {
        name: "folders",
        run: folders::target,
    },
    Target {
        name: "together",
        run: together::target,
    },
];

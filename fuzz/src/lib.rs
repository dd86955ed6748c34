//! What arbitrary bytes must never do to a machine or to the tool. Each target is a function over bytes that panics when
//! something is wrong; `cargo xtask fuzz` hands them to libFuzzer, `tests/bounded.rs` tries some of them in every
//! `cargo test`. docs/testing.md says how, and what was found.
//!
//! * [`stream`]: any bytes into the device's receiver.
//! * [`bodies`]: good frames with any body into both machines.
//! * [`host`]: what a device says to the host.
//! * [`sidedoor`]: what a second process says at the door of a line.
//! * [`http`]: requests to `retrograde serve`.
//! * [`records`]: changed records into `verify` and the report's check.
#![forbid(unsafe_code)]

pub mod bodies;
mod door;
mod exemplary;
pub mod host;
pub mod http;
pub mod model;
pub mod records;
pub mod script;
mod server;
pub mod sidedoor;
pub mod stream;

/// The longest input, bytes: scripts of two dozen steps, in which a change of one still has a chance.
pub const MAX_LEN: usize = 256;

/// A target.
#[derive(Clone, Copy, Debug)]
pub struct Target {
    /// Of its file here, and of the folder of its corpus.
    pub name: &'static str,
    /// Tries these bytes.
    pub run: fn(&[u8]),
}

/// All targets.
pub const TARGETS: [Target; 6] = [
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
];

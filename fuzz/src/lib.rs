//! Properties of machines and tool that must hold for arbitrary bytes. Each target is a function over bytes that
//! panics on a violation. `cargo +nightly fuzz run` passes them to libFuzzer, and `tests/bounded.rs` tries some of them
//! in every `cargo test`. docs/testing.md describes the method and the findings.
//!
//! * [`stream`]: any bytes into the device's receiver.
//! * [`host`]: a device's messages into the host.
//! * [`http`]: requests to `retrograde serve`.
#![forbid(unsafe_code)]

mod bench;
mod command;
mod exemplary;
pub mod host;
pub mod http;
mod model;
mod script;
mod server;
pub mod stream;

/// Longest input, bytes: enough for two dozen steps, and short enough that a change of one of them often has an effect.
pub const MAX_LEN: usize = 256;

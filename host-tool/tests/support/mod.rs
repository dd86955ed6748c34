//! Shared by the groups of tests.
// Each group uses only a part of it.
#![allow(dead_code, missing_docs, unreachable_pub)]

pub mod asked;
#[cfg(unix)]
pub mod bench;
pub mod mishap;
pub mod offline;
#[cfg(unix)]
pub mod others;
pub mod plan;
#[cfg(unix)]
pub mod server;
#[cfg(unix)]
pub mod signal;
#[cfg(unix)]
pub mod terminal;
pub mod tool;

//! The program in a pseudo-terminal.
#![cfg(unix)]

#[path = "../support/mod.rs"]
mod support;

mod keys;

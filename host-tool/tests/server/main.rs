//! `retrograde serve`, queried over TCP.
#![cfg(unix)]

#[path = "../support/mod.rs"]
mod support;

mod page;
mod serve;

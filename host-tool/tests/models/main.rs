//! Commands that calculate.

#[path = "../support/mod.rs"]
mod support;

mod files;
mod science;

//! Commands that calculate.

#[path = "../support/mod.rs"]
mod support;

mod crescent;
mod files;
mod fit;
mod optimise;
mod plan_experiment;
mod science;
mod verdict;

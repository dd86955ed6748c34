//! Commands in this process, over machines in memory.

#[path = "../support/mod.rs"]
mod support;

mod by_hand;
mod cli;
mod commission;
mod coordination;
mod cycle;
mod fetched;
mod fresh;
mod loopback;
mod lost;
mod names;
mod records;
mod report;
mod settings;
mod stop_model;
mod stops;
mod suspended;

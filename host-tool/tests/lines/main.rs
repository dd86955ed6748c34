//! The program itself at lines shared by several processes.
#![cfg(unix)]

#[path = "../support/mod.rs"]
mod support;

mod bad_inputs;
mod broker;
mod doctor;
mod held_up;
mod leaving;
mod remedies;
mod stopping;
mod watch;

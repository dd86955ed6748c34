//! Consequences of kills, full disks and faults of cable and clock.
#![cfg(unix)]

#[path = "../support/mod.rs"]
mod support;

mod campaign_process;
mod full_disk;
mod host_faults;

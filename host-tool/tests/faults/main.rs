//! What kills, full disks and faults of cable and clock leave.
#![cfg(unix)]

#[path = "../support/mod.rs"]
mod support;

mod campaign_process;
mod full_disk;
mod host_faults;

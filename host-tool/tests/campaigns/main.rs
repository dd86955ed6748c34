//! Campaigns from plan to report, without a second process.

#[path = "../support/mod.rs"]
mod support;

mod campaign;
mod campaign_report;
mod campaign_run;
mod counting;
mod gone;
#[cfg(unix)]
mod hostile;
mod pictures;
mod told;

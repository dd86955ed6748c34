//! Campaigns from plan to report, without a second process.

#[path = "../support/mod.rs"]
mod support;

mod campaign;
mod campaign_report;
mod campaign_run;
#[cfg(unix)]
mod hostile;

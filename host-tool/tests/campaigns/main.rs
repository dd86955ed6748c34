//! Campaigns from plan to report, without a second process.

#[path = "../support/mod.rs"]
mod support;

mod attempts;
mod bounds;
mod campaign;
mod campaign_report;
mod campaign_run;
mod counting;
mod folded;
mod gone;
#[cfg(unix)]
mod hostile;
mod in_python;
mod notices;
mod observers;
mod pictures;
mod stopped;

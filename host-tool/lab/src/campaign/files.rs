//! Names of the files in the folder of a campaign, and of those of any record.

use crate::trials::experiment::{ACTUATIONS, stem};

pub const PLAN: &str = "plan.toml";
pub const ORDER: &str = "order.csv";
pub const TRIALS: &str = "trials.csv";
pub const READINGS: &str = "readings.csv";
/// Locked by the process that writes to the folder. The file is empty and not in the manifest.
pub const LOCK: &str = ".lock";
pub const ATTEMPTS: &str = "trials";

/// First part of the name of a run's record.
pub const RUN: &str = "run";

/// Whether a file's name is one that the record of an action gets, of either machine.
pub fn is_record(name: &str) -> bool {
    let mut stems = std::iter::once(RUN).chain(ACTUATIONS.map(stem));
    stems.any(|stem| is_of(name, stem))
}

pub(crate) fn is_of(name: &str, stem: &str) -> bool {
    let rest = name.strip_prefix(stem);
    rest.is_some_and(|rest| rest.starts_with('-'))
}

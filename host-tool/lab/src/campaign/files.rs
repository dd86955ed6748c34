//! File names in the folder of a campaign, and of records in general.

use crate::trials::experiment::{ACTUATIONS, stem};

pub const PLAN: &str = "plan.toml";
pub const ORDER: &str = "order.csv";
pub const TRIALS: &str = "trials.csv";
pub const READINGS: &str = "readings.csv";
/// Locked by the process that writes to the folder. The file is empty and not in the manifest.
pub const LOCK: &str = ".lock";
pub const ATTEMPTS: &str = "trials";

/// Prefix of the names of a run's record.
pub const RUN: &str = "run";

/// Whether a file name is that of an action's record, of either machine.
pub fn is_record(name: &str) -> bool {
    let mut stems = std::iter::once(RUN).chain(ACTUATIONS.map(stem));
    stems.any(|stem| is_of(name, stem))
}

pub(crate) fn is_of(name: &str, stem: &str) -> bool {
    let rest = name.strip_prefix(stem);
    rest.is_some_and(|rest| rest.starts_with('-'))
}

//! Names of the files in the folder of a campaign.

/// The plan as the user wrote it.
pub const PLAN: &str = trials::trial::CAMPAIGN_PLAN;
/// The trials in their order.
pub const ORDER: &str = "order.csv";
/// The ledger.
pub const TRIALS: &str = "trials.csv";
/// The caliper's readings.
pub const READINGS: &str = "readings.csv";
/// Locked by the process that writes to the folder. The file is empty and not in the manifest.
pub const LOCK: &str = ".lock";
/// A folder for each attempt at a trial.
pub const ATTEMPTS: &str = "trials";

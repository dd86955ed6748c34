//! Names of the files in the folder of a campaign.

/// The plan, as it was given.
pub const PLAN: &str = trials::trial::CAMPAIGN_PLAN;
/// The trials in their order.
pub const ORDER: &str = "order.csv";
/// The ledger.
pub const TRIALS: &str = "trials.csv";
/// The caliper's readings.
pub const READINGS: &str = "readings.csv";
/// Whoever writes holds its lock. It is empty, and not in the manifest.
pub const LOCK: &str = ".lock";
/// A folder for each attempt at a trial.
pub const ATTEMPTS: &str = "trials";

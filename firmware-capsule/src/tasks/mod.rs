//! The tasks; the table in this package's README says how often each runs and why.

pub(crate) mod control;
pub(crate) mod link;
pub(crate) mod motor;
pub(crate) mod telemetry;

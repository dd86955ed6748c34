//! Results shown beside the records.

use std::path::PathBuf;

/// A table of results that are not in the records, such as a verdict from the pins or a modelled displacement.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Remark {
    /// Sidecar of the trial it belongs to; none for a remark on the whole report.
    pub sidecar: Option<PathBuf>,
    pub title: String,
    pub rows: Vec<(String, String)>,
}

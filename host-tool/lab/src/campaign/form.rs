//! The body's shape during a run.

use serde::{Deserialize, Serialize};

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Form {
    /// The waves carry it headward.
    Unfolded,
    /// The same waves carry it the other way.
    Folded,
    /// It is unfolded at first, and folds while the carriage runs.
    Folding,
}

impl Form {
    pub const fn name(self) -> &'static str {
        match self {
            Self::Unfolded => "unfolded",
            Self::Folded => "folded",
            Self::Folding => "folding",
        }
    }
}

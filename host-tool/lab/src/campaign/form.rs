//! The body's shape during a run.

use serde::{Deserialize, Serialize};

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Form {
    /// The waves carry the body headward.
    Unfolded,
    /// The same waves carry the body tailward.
    Folded,
    /// The body is unfolded at first, and folds while the carriage runs.
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

//! The body's shape during a run.

use crate::trials::experiment::Shape;
use serde::{Deserialize, Serialize};

/// The body's shape during a run.
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
    /// The name in ledgers.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Unfolded => Shape::Unfolded.name(),
            Self::Folded => Shape::Folded.name(),
            Self::Folding => "folding",
        }
    }
}

impl From<Shape> for Form {
    fn from(shape: Shape) -> Self {
        match shape {
            Shape::Unfolded => Self::Unfolded,
            Shape::Folded => Self::Folded,
        }
    }
}

//! Value, unit and origin of each number of a model, as data for documents and reports.

use core::fmt;

/// How far a number can be trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Label {
    /// Stated in the paper's text.
    Paper,
    /// Follows from the paper by calculation.
    Derived,
    /// Fitted to a sentence of the paper. A result that agrees with that sentence is no evidence.
    Calibrated,
    /// Chosen; there is no source.
    Assumed,
    /// Set by a person for one calculation.
    Given,
}

impl fmt::Display for Label {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Paper => "paper",
            Self::Derived => "derived",
            Self::Calibrated => "cal",
            Self::Assumed => "assumed",
            Self::Given => "given",
        })
    }
}

/// One parameter of a model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Parameter {
    /// Section and name, as in a model file.
    pub name: &'static str,
    /// Value in `unit`.
    pub value: f64,
    /// The word that set it, if a word did; the value then follows from other parameters.
    pub word: Option<&'static str>,
    /// Unit; empty for a pure number.
    pub unit: &'static str,
    /// How far the number can be trusted.
    pub label: Label,
    /// Section or sentence of the paper, or the reason for the choice.
    pub source: &'static str,
}

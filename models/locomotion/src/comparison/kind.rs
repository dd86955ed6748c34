//! Kind of a row: the worth of its agreement, by where its value comes from and by the bodies that meet it.

use core::fmt;

use crate::comparison::{Evidence, Odds, Row, Share};

/// Share of the prior's bodies from which on a sentence tells no body from another: nine of ten meet it.
pub const NEARLY_ALL: f64 = 0.9;

/// Kind of a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Every body gives the same value: only the equations were checked.
    Arithmetic,
    /// The paper's number was put in.
    Input,
    /// The bodies were chosen or fitted by this sentence: that they meet it is no evidence.
    ChosenByIt,
    /// The prior's bodies meet it in at least `NEARLY_ALL` of all cases: it tells none from another.
    NearlyAll,
    /// It could have come out differently.
    Evidence,
    /// The model's value does not meet the condition.
    Miss,
    /// The sentence puts no condition on the value.
    Unstated,
    /// The models have nothing to compare.
    Outside,
}

impl Kind {
    /// The kinds of rows with a condition, in the order of their report.
    pub const JUDGED: [Self; 6] = [
        Self::Arithmetic,
        Self::Input,
        Self::ChosenByIt,
        Self::NearlyAll,
        Self::Evidence,
        Self::Miss,
    ];

    /// The kind of a row with these odds.
    pub fn of(row: &Row, odds: &Odds) -> Self {
        let (Some(condition), Some(value)) = (row.condition, row.model) else {
            return match row.evidence {
                Evidence::Outside => Self::Outside,
                _ => Self::Unstated,
            };
        };
        let nearly_all = |share: &Share| share.part() >= NEARLY_ALL;
        match (row.evidence, odds) {
            _ if !condition.met(value) => Self::Miss,
            (Evidence::Input, _) => Self::Input,
            (_, Odds::AnyBody(_)) => Self::Arithmetic,
            (Evidence::Fitted, _) => Self::ChosenByIt,
            _ if row.chosen.is_some() => Self::ChosenByIt,
            (_, Odds::Shares { prior, .. }) if prior.as_ref().is_some_and(nearly_all) => {
                Self::NearlyAll
            }
            _ => Self::Evidence,
        }
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Arithmetic => "arithmetic",
            Self::Input => "input",
            Self::ChosenByIt => "chosen by it",
            Self::NearlyAll => "met by nearly all bodies",
            Self::Evidence => "evidence",
            Self::Miss => "miss",
            Self::Unstated => "no condition",
            Self::Outside => "outside",
        })
    }
}

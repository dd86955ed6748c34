//! Which step is next, from the record and what the record is about. No machine is involved.

use std::collections::BTreeSet;

use crate::commission::record::{Commissioning, Outcome, Subject};
use crate::commission::steps::Step;

/// Whether a step's result still counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// It passed, with this image and these settings.
    Holds,
    /// It has not passed yet.
    NotPassed,
    /// It passed with another image.
    OtherImage,
    /// It passed with another value of this setting.
    OtherSetting(&'static str),
}

/// Whether the result of `step` in `record` counts for `subject`.
#[must_use]
pub fn standing(step: &Step, record: &Commissioning, subject: &Subject) -> Standing {
    let Some(result) = record.result(step.name) else {
        return Standing::NotPassed;
    };
    if result.outcome != Outcome::Passed {
        return Standing::NotPassed;
    }
    if step.of_image && result.image.as_ref() != Some(&subject.image) {
        return Standing::OtherImage;
    }
    let changed = step.settings.iter().find(|key| {
        let name = key.name();
        result.settings.get(name) != subject.settings.get(name)
    });
    changed.map_or(Standing::Holds, |key| Standing::OtherSetting(key.name()))
}

/// Goes through the steps once. A step that holds is not repeated; one that was carried out in this session is not
/// begun again, whatever came of it.
#[derive(Debug)]
pub struct Procedure {
    steps: &'static [Step],
    tried: BTreeSet<&'static str>,
}

impl Procedure {
    /// A new session.
    #[must_use]
    pub fn new(steps: &'static [Step]) -> Self {
        Self {
            steps,
            tried: BTreeSet::new(),
        }
    }

    /// The next step to carry out with its number from 1; none at the end.
    pub fn next(
        &mut self,
        record: &Commissioning,
        subject: &Subject,
    ) -> Option<(usize, &'static Step)> {
        let (number, step) = (1..).zip(self.steps).find(|(_, step)| {
            !self.tried.contains(step.name) && standing(step, record, subject) != Standing::Holds
        })?;
        self.tried.insert(step.name);
        Some((number, step))
    }
}

/// The steps that do not hold, with the reason.
#[must_use]
pub fn open(
    steps: &'static [Step],
    record: &Commissioning,
    subject: &Subject,
) -> Vec<(&'static Step, Standing)> {
    steps
        .iter()
        .map(|step| (step, standing(step, record, subject)))
        .filter(|(_, standing)| *standing != Standing::Holds)
        .collect()
}

//! Decides which step is next, from the record and its subject alone, without a machine.

use std::collections::BTreeSet;

use client::subject::Subject;
use jiff::Timestamp;

use crate::commissioning::record::{Commissioning, Finding, StepOutcome, StepResult};
use crate::commissioning::step::ProcedureStep;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StepStatus {
    /// The step passed, with this image and these settings.
    Holds,
    NotPassed,
    OtherImage,
    /// The step passed with another value of this setting.
    OtherSetting(&'static str),
}

/// Whether the result of `step` in `record` counts for `subject`.
pub fn status(step: &ProcedureStep, record: &Commissioning, subject: &Subject) -> StepStatus {
    let Some(result) = record.result(step.name) else {
        return StepStatus::NotPassed;
    };
    if result.outcome != StepOutcome::Passed {
        return StepStatus::NotPassed;
    }
    if step.of_image && result.image.as_ref() != Some(&subject.image) {
        return StepStatus::OtherImage;
    }
    let changed = step.settings.iter().find(|key| {
        let name = key.name();
        result.settings.get(name) != subject.settings.get(name)
    });
    changed.map_or(StepStatus::Holds, |key| {
        StepStatus::OtherSetting(key.name())
    })
}

/// Goes through the steps once. Skips a step whose result holds, and does not repeat a step that was carried out in
/// this session, whatever its result.
#[derive(Debug)]
pub struct Procedure {
    steps: &'static [ProcedureStep],
    tried: BTreeSet<&'static str>,
}

impl Procedure {
    pub fn new(steps: &'static [ProcedureStep]) -> Self {
        Self {
            steps,
            tried: BTreeSet::new(),
        }
    }

    /// The next step with its number from 1; none at the end.
    pub fn next(
        &mut self,
        record: &Commissioning,
        subject: &Subject,
    ) -> Option<(usize, &'static ProcedureStep)> {
        let (number, step) = (1..).zip(self.steps).find(|(_, step)| {
            !self.tried.contains(step.name) && status(step, record, subject) != StepStatus::Holds
        })?;
        self.tried.insert(step.name);
        Some((number, step))
    }

    /// Enters the result of `step` into `record`, in the order of the steps.
    pub fn enter(
        &self,
        record: &mut Commissioning,
        step: &ProcedureStep,
        finding: Finding,
        subject: &Subject,
        now: Timestamp,
    ) {
        let depends = step.settings.iter().map(|key| {
            let name = key.name().to_owned();
            (name, subject.setting(*key))
        });
        let result = StepResult {
            step: step.name.to_owned(),
            shows: step.shows.to_owned(),
            outcome: finding.outcome,
            reason: finding.reason,
            measured: finding.measured,
            date_utc: now,
            image: step.of_image.then(|| subject.image.clone()),
            settings: depends.collect(),
        };
        record.steps.retain(|known| known.step != step.name);
        record.steps.push(result);
        // Results of unknown steps come last.
        record.steps.sort_by_key(|result| {
            let mut names = self.steps.iter().map(|step| step.name);
            names
                .position(|name| name == result.step)
                .unwrap_or(usize::MAX)
        });
        *record = Commissioning {
            begun_utc: record.begun_utc,
            complete: open(self.steps, record, subject).is_empty(),
            steps: std::mem::take(&mut record.steps),
            ..Commissioning::new(subject, now)
        };
    }
}

/// The steps whose results do not hold, with the reason.
pub fn open(
    steps: &'static [ProcedureStep],
    record: &Commissioning,
    subject: &Subject,
) -> Vec<(&'static ProcedureStep, StepStatus)> {
    steps
        .iter()
        .map(|step| (step, status(step, record, subject)))
        .filter(|(_, status)| *status != StepStatus::Holds)
        .collect()
}

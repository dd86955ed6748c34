//! The ledger: one row per event, never changed afterwards; and the state that follows from the rows.
//!
//! A trial is done when one of its attempts was completed and has a displacement. Attempts that were refused, stopped,
//! lost or repeated stay listed and never count. Replaying the rows finds every gap, repetition and contradiction.

use std::collections::BTreeMap;

use crate::outcomes;
use crate::trials::trial::Status;
use client::identity::Origin;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use crate::campaign::order::{Condition, Planned};
use crate::campaign::plan::Millimetres;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LedgerEvent {
    /// An attempt at a trial begins; nothing has moved yet.
    Began,
    Ended,
    /// The displacement of the tail was entered. A later one of the same attempt corrects it.
    Displacement,
    Undone,
    /// The attempt does not count, and the trial is done again.
    Repeated,
    Skipped,
    /// The trial was done, and is excluded from the evaluation.
    Excluded,
    /// The trial is no longer skipped or excluded.
    Included,
    Note,
}

impl LedgerEvent {
    /// The event as a participle, for a refusal: `trial 3 is done, not to be begun`.
    const fn words(self) -> &'static str {
        match self {
            Self::Began => "begun",
            Self::Ended => "ended",
            Self::Displacement => "measured",
            Self::Undone => "taken back",
            Self::Repeated => "repeated",
            Self::Skipped => "skipped",
            Self::Excluded => "excluded",
            Self::Included => "included again",
            Self::Note => "remarked on",
        }
    }
}

outcomes! {
    AttemptOutcome {
        Complete: "complete",
        Refused: "refused",
        Stopped: "stopped",
        /// The machine stopped by itself because it no longer heard from the tool.
        LinkLost: "link_lost",
        Faulted: "faulted",
        /// The tool ended during the attempt, or lost the machine.
        Lost: "lost",
    }
}

impl From<Status> for AttemptOutcome {
    fn from(status: Status) -> Self {
        match status {
            Status::Complete => Self::Complete,
            Status::Refused => Self::Refused,
            Status::Stopped => Self::Stopped,
            Status::LinkLost => Self::LinkLost,
            Status::Faulted => Self::Faulted,
            Status::Running | Status::Unknown => Self::Lost,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    Measured,
    Model,
    /// A model calculated it, and the plan's scatter was added.
    ModelWithScatter,
}

/// A row of `trials.csv`. Columns that do not apply to the event are empty.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LedgerRow {
    /// Numbered from 1, without gaps.
    pub row: u32,
    pub time_utc: Timestamp,
    pub event: LedgerEvent,
    /// The trial; empty for a note on the whole campaign.
    pub trial: Option<u32>,
    /// The attempt at it, from 1.
    pub attempt: Option<u32>,
    /// With `ended`: how it ended.
    pub outcome: Option<AttemptOutcome>,
    /// With `displacement`: of the tail since the start, positive headward.
    pub displacement_mm: Option<Millimetres>,
    pub source: Option<Source>,
    /// With `began`: the set of readings in `readings.csv` that gives the indentation.
    pub readings_set: Option<u32>,
    /// With `began`: a_n by Eq. 8, from these readings.
    pub indentation_mm: Option<Millimetres>,
    /// With `began`: the camera's file.
    pub camera_file: Option<String>,
    /// A reason or a remark.
    pub text: Option<String>,
    pub origin: Origin,
}

impl LedgerRow {
    /// A row about a trial; the ledger adds its number.
    pub fn of(event: LedgerEvent, trial: u32, attempt: Option<u32>) -> Self {
        Self {
            row: 0,
            time_utc: Timestamp::UNIX_EPOCH,
            event,
            trial: Some(trial),
            attempt,
            outcome: None,
            displacement_mm: None,
            source: None,
            readings_set: None,
            indentation_mm: None,
            camera_file: None,
            text: None,
            origin: Origin::Unknown,
        }
    }

    #[must_use]
    pub fn saying(mut self, text: Option<String>) -> Self {
        self.text = text.filter(|text| !text.is_empty());
        self
    }
}

#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("row {row}: {why}")]
pub struct Contradiction {
    /// Number of the row in the file, from 1.
    pub row: u32,
    pub why: String,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Displacement {
    /// Of the tail, positive headward.
    pub value: Millimetres,
    pub source: Source,
    /// Number of entries: more than one if it was corrected.
    pub entered: u32,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Attempt {
    pub number: u32,
    pub began: Timestamp,
    pub ended: Option<Timestamp>,
    /// None while the attempt is in progress.
    pub outcome: Option<AttemptOutcome>,
    pub reason: Option<String>,
    pub displacement: Option<Displacement>,
    /// Number of displacements entered, including those taken back.
    pub entries: u32,
    /// Why the operator repeats it; none if the operator does not.
    pub given_up: Option<String>,
    /// The set of readings that gives the indentation.
    pub readings_set: Option<u32>,
    pub indentation_mm: Option<Millimetres>,
    pub camera_file: Option<String>,
}

impl Attempt {
    /// Whether the attempt was completed and is not repeated.
    pub fn stands(&self) -> bool {
        self.outcome == Some(AttemptOutcome::Complete) && self.given_up.is_none()
    }

    pub fn folder(trial: u32, attempt: u32) -> String {
        format!("{trial:03}-{attempt}")
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrialStatus {
    Open,
    UnderWay,
    /// Run, but without a displacement.
    Unmeasured,
    /// Counts in the evaluation.
    Done,
    /// Done, but excluded from the evaluation.
    Excluded,
    Skipped,
}

impl TrialStatus {
    const fn words(self) -> &'static str {
        match self {
            Self::Open => "not done yet",
            Self::UnderWay => "under way",
            Self::Unmeasured => "not measured yet",
            Self::Done => "done",
            Self::Excluded => "excluded",
            Self::Skipped => "skipped",
        }
    }

    /// Why a trial in this state does not accept the event.
    fn refusal(self, trial: u32, event: LedgerEvent) -> String {
        format!(
            "trial {trial} is {} and cannot be {}",
            self.words(),
            event.words()
        )
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct TrialState {
    pub planned: Planned,
    /// All attempts, including those that do not count.
    pub attempts: Vec<Attempt>,
    pub skipped: Option<String>,
    pub excluded: Option<String>,
    pub notes: Vec<String>,
}

impl TrialState {
    /// The attempt that counts, if there is one.
    pub fn attempt(&self) -> Option<&Attempt> {
        self.attempts.last().filter(|attempt| attempt.stands())
    }

    pub fn status(&self) -> TrialStatus {
        if self.skipped.is_some() {
            return TrialStatus::Skipped;
        }
        match self.attempts.last() {
            Some(last) if last.outcome.is_none() => TrialStatus::UnderWay,
            Some(last) if last.stands() => match (last.displacement, &self.excluded) {
                (_, Some(_)) => TrialStatus::Excluded,
                (None, None) => TrialStatus::Unmeasured,
                (Some(_), None) => TrialStatus::Done,
            },
            _ => TrialStatus::Open,
        }
    }

    fn not_counted(&self) -> Option<&'static str> {
        match self.status() {
            TrialStatus::Skipped => Some("skipped"),
            TrialStatus::Excluded => Some("excluded"),
            _ => None,
        }
    }

    pub fn counted(&self) -> Option<Displacement> {
        (self.status() == TrialStatus::Done)
            .then(|| self.attempt()?.displacement)
            .flatten()
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct Tally {
    pub condition: Condition,
    pub planned: u32,
    /// Trials that count: n.
    pub counted: Vec<Displacement>,
    pub excluded: u32,
    pub skipped: u32,
}

/// Row numbers and origin, as checked in `trials.csv` and `readings.csv`: numbers from 1 without gaps, and one origin
/// for all.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sequence {
    rows: u32,
    origin: Option<Origin>,
}

impl Sequence {
    pub fn next_row(&self) -> u32 {
        self.rows + 1
    }

    pub fn origin(&self) -> Option<Origin> {
        self.origin
    }

    /// Checks whether a row with this number and origin can come next. The error is the reason.
    pub(crate) fn check(&self, row: u32, origin: Origin) -> Result<(), String> {
        if row != self.next_row() {
            return Err(format!("it is numbered {row}"));
        }
        match self.origin {
            Some(before) if before != origin => Err(format!(
                "its origin is {origin}, that of the rows before it {before}"
            )),
            _ => Ok(()),
        }
    }

    pub(crate) fn take(&mut self, origin: Origin) {
        self.rows += 1;
        self.origin = Some(origin);
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct CampaignState {
    pub trials: Vec<TrialState>,
    pub notes: Vec<String>,
    pub sequence: Sequence,
}

impl CampaignState {
    pub fn new(order: &[Planned]) -> Self {
        let trial = |planned: &Planned| TrialState {
            planned: planned.clone(),
            attempts: vec![],
            skipped: None,
            excluded: None,
            notes: vec![],
        };
        Self {
            trials: order.iter().map(trial).collect(),
            notes: vec![],
            sequence: Sequence::default(),
        }
    }

    /// State after all these rows.
    ///
    /// # Errors
    /// The first row that cannot follow the earlier ones.
    pub fn replay(order: &[Planned], rows: &[LedgerRow]) -> Result<Self, Contradiction> {
        let mut state = Self::new(order);
        for row in rows {
            state.apply(row)?;
        }
        Ok(state)
    }

    /// Applies one more row.
    ///
    /// # Errors
    /// The row cannot come next; nothing has changed.
    pub fn apply(&mut self, row: &LedgerRow) -> Result<(), Contradiction> {
        let number = self.sequence.next_row();
        let wrong = |why: String| Contradiction { row: number, why };
        self.sequence.check(row.row, row.origin).map_err(wrong)?;
        match row.trial {
            None if row.event == LedgerEvent::Note => {
                self.notes.push(row.text.clone().unwrap_or_default());
            }
            None => return Err(wrong("it names no trial".to_owned())),
            Some(trial) => {
                let Some(state) = (trial as usize)
                    .checked_sub(1)
                    .and_then(|index| self.trials.get_mut(index))
                else {
                    return Err(wrong(format!("there is no trial {trial}")));
                };
                let not_counted = state
                    .not_counted()
                    .filter(|_| row.event == LedgerEvent::Undone);
                if let Some(how) = not_counted {
                    return Err(wrong(format!(
                        "trial {trial} is {how}: `include {trial}` takes it in again"
                    )));
                }
                state.apply(row).map_err(wrong)?;
            }
        }
        self.sequence.take(row.origin);
        Ok(())
    }

    /// The next trial: the first without a displacement, then a new one.
    pub fn next(&self) -> Option<&TrialState> {
        let with = |wanted: TrialStatus| {
            self.trials
                .iter()
                .find(move |trial| trial.status() == wanted)
        };
        with(TrialStatus::UnderWay)
            .or_else(|| with(TrialStatus::Unmeasured))
            .or_else(|| with(TrialStatus::Open))
    }

    pub fn trial(&self, number: u32) -> Option<&TrialState> {
        self.trials.get((number as usize).checked_sub(1)?)
    }

    /// Trial and attempt of the latest displacement that was not taken back.
    pub fn last_measured(&self, rows: &[LedgerRow]) -> Option<(u32, u32)> {
        rows.iter().rev().find_map(|row| {
            let (trial, attempt) = (row.trial?, row.attempt?);
            let last = self.trial(trial)?.attempt()?;
            (row.event == LedgerEvent::Displacement
                && last.number == attempt
                && last.displacement.is_some())
            .then_some((trial, attempt))
        })
    }

    /// All conditions in the order of purpose, lubrication and shape; indentations in the order of `rank`.
    pub fn tallies(&self, rank: impl Fn(&str) -> usize) -> Vec<Tally> {
        let mut tallies = BTreeMap::new();
        for trial in &self.trials {
            let condition = trial.planned.condition();
            let key = (
                condition.purpose,
                condition.lubrication,
                rank(&condition.indentation),
                condition.shape,
            );
            let tally = tallies.entry(key).or_insert_with(|| Tally {
                condition,
                planned: 0,
                counted: vec![],
                excluded: 0,
                skipped: 0,
            });
            tally.planned += 1;
            match trial.status() {
                TrialStatus::Excluded => tally.excluded += 1,
                TrialStatus::Skipped => tally.skipped += 1,
                _ => tally.counted.extend(trial.counted()),
            }
        }
        tallies.into_values().collect()
    }
}

impl TrialState {
    fn apply(&mut self, row: &LedgerRow) -> Result<(), String> {
        let number = self.planned.trial;
        match row.event {
            LedgerEvent::Began => return self.begin(row),
            LedgerEvent::Note => {
                self.notes.push(row.text.clone().unwrap_or_default());
                return Ok(());
            }
            LedgerEvent::Skipped => {
                return match self.status() {
                    TrialStatus::Open | TrialStatus::Unmeasured => {
                        self.skipped = Some(row.text.clone().unwrap_or_default());
                        Ok(())
                    }
                    status => Err(status.refusal(number, row.event)),
                };
            }
            LedgerEvent::Included => {
                let was = self.skipped.take().or(self.excluded.take());
                return match was {
                    Some(_) => Ok(()),
                    None => Err(format!("trial {number} is neither skipped nor excluded")),
                };
            }
            LedgerEvent::Ended
            | LedgerEvent::Displacement
            | LedgerEvent::Undone
            | LedgerEvent::Repeated
            | LedgerEvent::Excluded => {}
        }
        let status = self.status();
        let attempts = self.attempts.len();
        let Some(last) = self.attempts.last_mut() else {
            return Err(format!("trial {number} has no attempt"));
        };
        if row.attempt != Some(last.number) {
            return Err(format!("trial {number} is at attempt {attempts}"));
        }
        match (row.event, status) {
            (LedgerEvent::Ended, TrialStatus::UnderWay) => {
                let Some(outcome) = row.outcome else {
                    return Err("an end without an outcome".to_owned());
                };
                last.outcome = Some(outcome);
                last.ended = Some(row.time_utc);
                last.reason = row.text.clone();
            }
            (
                LedgerEvent::Displacement,
                TrialStatus::Unmeasured | TrialStatus::Done | TrialStatus::Excluded,
            ) => {
                let (Some(value), Some(source)) = (row.displacement_mm, row.source) else {
                    return Err("a displacement without a value or a source".to_owned());
                };
                last.entries += 1;
                last.displacement = Some(Displacement {
                    value,
                    source,
                    entered: last.entries,
                });
            }
            (LedgerEvent::Undone, TrialStatus::Done) => last.displacement = None,
            (
                LedgerEvent::Repeated,
                TrialStatus::Unmeasured | TrialStatus::Done | TrialStatus::Excluded,
            ) => {
                last.given_up = Some(row.text.clone().unwrap_or_default());
                self.excluded = None;
            }
            (LedgerEvent::Excluded, TrialStatus::Done | TrialStatus::Unmeasured) => {
                let Some(reason) = row.text.clone() else {
                    return Err("excluded without a reason".to_owned());
                };
                self.excluded = Some(reason);
            }
            (event, status) => return Err(status.refusal(number, event)),
        }
        Ok(())
    }

    fn begin(&mut self, row: &LedgerRow) -> Result<(), String> {
        let number = self.planned.trial;
        let next = self.attempts.len() as u32 + 1;
        if self.status() != TrialStatus::Open {
            return Err(self.status().refusal(number, row.event));
        }
        if row.attempt != Some(next) {
            return Err(format!("attempt {next} of trial {number} comes next"));
        }
        self.attempts.push(Attempt {
            number: next,
            began: row.time_utc,
            ended: None,
            outcome: None,
            reason: None,
            displacement: None,
            entries: 0,
            given_up: None,
            readings_set: row.readings_set,
            indentation_mm: row.indentation_mm,
            camera_file: row.camera_file.clone(),
        });
        Ok(())
    }
}

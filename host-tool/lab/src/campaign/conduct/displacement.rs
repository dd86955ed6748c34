//! Enters the displacement of a completed trial, from the operator or a model, and handles other answers.

use client::Device;
use client::identity::Origin;
use protocol::capsule::{ActuationKind, CapsuleState};

use crate::campaign::conduct::modelled::{self, Modelled};
use crate::campaign::conduct::{Broken, Conduct, Next};
use crate::campaign::form::Form;
use crate::campaign::ledger::{Attempt, AttemptOutcome, LedgerEvent, LedgerRow, Source};
use crate::campaign::order::Planned;
use crate::campaign::plan::Millimetres;
use crate::campaign::prompts::{Answer, Question};

impl Conduct<'_> {
    pub(super) fn measure(&mut self, planned: &Planned, attempt: u32) -> Result<Next, Broken> {
        let trial = planned.trial;
        let modelled = match self.machines.origin {
            Origin::Virtual => Some(self.model(planned, attempt)?),
            Origin::Board | Origin::Unknown => None,
        };
        let question = Question::Displacement {
            planned,
            attempt,
            of: self.folder.campaign().order.len(),
            model: modelled.as_ref().map(|modelled| modelled.value),
        };
        let Some(answer) = self.ask(&question)? else {
            return Ok(Next::Quit);
        };
        let mut row = LedgerRow::of(LedgerEvent::Displacement, trial, Some(attempt));
        match (answer, modelled) {
            (Answer::Enter, Some(modelled)) => {
                row.displacement_mm = Some(modelled.value);
                row.source = Some(modelled.source);
                self.row(row.saying(Some(modelled.text)))?;
                return self.unfold_after(planned, attempt);
            }
            (Answer::Length(_), Some(_)) => self.prompter.say(
                "  nothing can be measured on the virtual bench: Enter takes the model's value",
            ),
            (Answer::Length(value), None) => {
                let allowed = self.folder.campaign().plan.displacement;
                if let Some(why) = allowed.refusal(value) {
                    self.prompter.say(&format!("  {why}"));
                    return Ok(Next::Reread);
                }
                row.displacement_mm = Some(value);
                row.source = Some(Source::Measured);
                self.row(row)?;
                return self.unfold_after(planned, attempt);
            }
            (Answer::Enter | Answer::Yes | Answer::Again, None) => {
                self.prompter.say("  the displacement is needed here");
            }
            (answer, _) => return self.instead(planned, attempt, answer),
        }
        Ok(Next::Reread)
    }

    fn instead(&mut self, planned: &Planned, attempt: u32, answer: Answer) -> Result<Next, Broken> {
        let trial = planned.trial;
        let mut ends = false;
        match answer {
            Answer::Undo => self.undo()?,
            Answer::Repeat(reason) => {
                let row =
                    LedgerRow::of(LedgerEvent::Repeated, trial, Some(attempt)).saying(Some(reason));
                self.row(row)?;
                self.prompter.say(&format!(
                    "  attempt {attempt} does not count; the trial is done again"
                ));
                ends = true;
            }
            Answer::Skip(reason) => {
                self.row(LedgerRow::of(LedgerEvent::Skipped, trial, None).saying(Some(reason)))?;
                self.prompter.say(&format!(
                    "  trial {trial} is skipped; undo takes it in again"
                ));
                ends = true;
            }
            Answer::Exclude(reason) => {
                let row =
                    LedgerRow::of(LedgerEvent::Excluded, trial, Some(attempt)).saying(Some(reason));
                self.row(row)?;
                self.prompter.say(&format!("  trial {trial} is excluded"));
                ends = true;
            }
            Answer::Note(text) => self.note(trial, text)?,
            Answer::Camera(_) | Answer::Clamp => {
                self.prompter.say("  that is for the next trial");
            }
            Answer::Enter
            | Answer::Length(_)
            | Answer::Yes
            | Answer::Again
            | Answer::Quit
            | Answer::Unclear(_) => self.prompter.say("  the displacement is needed here"),
        }
        if ends {
            return self.unfold_after(planned, attempt);
        }
        Ok(Next::Reread)
    }

    fn model(&self, planned: &Planned, attempt: u32) -> Result<Modelled, Broken> {
        let campaign = self.folder.campaign();
        let sidecar = campaign
            .run_sidecar(planned.trial, attempt)
            .unwrap_or_default();
        let a_mm = campaign
            .state
            .trial(planned.trial)
            .and_then(|trial| trial.attempt()?.indentation_mm)
            .map_or(0.0, Millimetres::mm);
        let modelled = modelled::displacement(&campaign.plan, planned, attempt, a_mm, &sidecar);
        modelled.map_err(|error| {
            let folder = Attempt::folder(planned.trial, attempt);
            Broken::NotReady {
                why: format!("{folder} has no displacement: {error}"),
                help: "change the plan to what the models cover, and begin another campaign"
                    .to_owned(),
            }
        })
    }

    /// Unfolds the capsule at the end of a fold trial, so that the thread does not stay under tension.
    fn unfold_after(&mut self, planned: &Planned, attempt: u32) -> Result<Next, Broken> {
        let campaign = self.folder.campaign();
        let began = |row: &&LedgerRow| row.event == LedgerEvent::Began;
        // Unfold only for the latest attempt: correcting an older displacement says nothing about the present state of
        // the capsule.
        let is_last =
            campaign.rows.iter().rfind(began).is_some_and(|row| {
                (row.trial, row.attempt) == (Some(planned.trial), Some(attempt))
            });
        let folder = campaign.attempt_folder(planned.trial, attempt);
        let capsule = self.machines.capsule.as_mut();
        let Some(capsule) = capsule.filter(|_| planned.shape != Form::Unfolded && is_last) else {
            return Ok(Next::Reread);
        };
        match capsule.capsule_status() {
            Ok(status) if status.state == CapsuleState::Folded => {}
            Ok(_) => return Ok(Next::Reread),
            // The trial has ended nevertheless, and the next one may not need the capsule.
            Err(error) => {
                self.gone = true;
                self.prompter.say(&format!(
                    "  {error}; was the capsule left folded? Its thread pulls: leave, then `retrograde unfold`"
                ));
                return Ok(Next::Reread);
            }
        }
        // A stop that came while the question waited is newer than the question.
        let then = self.report_stop()?;
        if !matches!(then, Next::Proceed) {
            self.prompter.say(
                "  the capsule stays folded, and its thread pulls: leave, then `retrograde unfold`",
            );
            return Ok(then);
        }
        let unfolded = self.actuate(ActuationKind::Unfold, &folder);
        self.folder.seal_attempt(planned.trial, attempt)?;
        match unfolded {
            Err(broken) if broken.outcome() == AttemptOutcome::Stopped => Ok(Next::Quit),
            unfolded => unfolded.map(|()| Next::Reread),
        }
    }

    /// Reports that the capsule is folded or half folded: its thread pulls until somebody unfolds it.
    pub(super) fn tell_folded(&mut self) {
        let capsule = self.machines.capsule.as_mut();
        let Some(Ok(status)) = capsule.map(Device::capsule_status) else {
            return;
        };
        self.prompter.say(match status.state {
            CapsuleState::Folded => {
                "The capsule is folded still, and its thread pulls: `retrograde unfold`."
            }
            CapsuleState::Stopped => {
                "The capsule stands between its ends, and its thread may pull: `retrograde unfold`."
            }
            _ => return,
        });
    }
}

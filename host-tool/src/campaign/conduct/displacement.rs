//! The displacement of a trial that was completed: asked for, or that of a model, and what may be answered instead.

use protocol::capsule::{ActuationKind, CapsuleState};

use crate::campaign::conduct::{Broken, Conduct, Then};
use crate::campaign::ledger::{Attempt, Event, Outcome, Row, Source};
use crate::campaign::model::{self, Modelled};
use crate::campaign::order::{Form, Planned};
use crate::campaign::plan::Millimetres;
use crate::campaign::prompts::{Answer, Question};
use crate::identity::Origin;

impl Conduct<'_> {
    /// Asks for the displacement of an attempt that was completed.
    pub(super) fn measure(&mut self, planned: &Planned, attempt: u32) -> Result<Then, Broken> {
        let trial = planned.trial;
        let modelled = match self.machines.origin {
            Origin::Virtual => Some(self.model(planned, attempt)?),
            Origin::Board | Origin::Unknown => None,
        };
        let question = Question::Displacement {
            planned,
            attempt,
            model: modelled.as_ref().map(|modelled| modelled.value),
        };
        let Some(answer) = self.ask(&question)? else {
            return Ok(Then::Leave);
        };
        let mut row = Row::of(Event::Displacement, trial, Some(attempt));
        match (answer, modelled) {
            (Answer::Enter, Some(modelled)) => {
                row.displacement_mm = Some(modelled.value);
                row.source = Some(modelled.source);
                self.row(row.saying(Some(modelled.text)))?;
                return self.unfold_after(planned, attempt);
            }
            (Answer::Length(_), Some(_)) => {
                self.desk.say(
                    "  nothing can be measured on the virtual bench: Enter takes the model's value",
                );
            }
            (Answer::Length(value), None) => {
                let range = self.folder.campaign().plan.displacement;
                if value < range.least_mm || value > range.greatest_mm {
                    self.desk.say(&format!(
                        "  {value} mm: the plan allows {} to {} mm",
                        range.least_mm, range.greatest_mm
                    ));
                    return Ok(Then::Look);
                }
                row.displacement_mm = Some(value);
                row.source = Some(Source::Measured);
                self.row(row)?;
                return self.unfold_after(planned, attempt);
            }
            (Answer::Undo, _) => {
                let campaign = self.folder.campaign();
                match campaign.state.last_measured(&campaign.rows) {
                    None => self.desk.say("  no displacement was entered yet"),
                    Some((last, of)) => {
                        self.row(Row::of(Event::Undone, last, Some(of)))?;
                        self.desk
                            .say(&format!("  the displacement of trial {last} is taken back"));
                    }
                }
            }
            (Answer::Repeat(reason), _) => {
                let row = Row::of(Event::Repeated, trial, Some(attempt)).saying(Some(reason));
                self.row(row)?;
                self.desk.say(&format!(
                    "  attempt {attempt} does not count; the trial is done again"
                ));
            }
            (Answer::Skip(reason), _) => {
                self.row(Row::of(Event::Skipped, trial, None).saying(Some(reason)))?;
                self.desk.say(&format!("  trial {trial} is skipped"));
            }
            (Answer::Exclude(reason), _) => {
                let row = Row::of(Event::Excluded, trial, Some(attempt)).saying(Some(reason));
                self.row(row)?;
                self.desk.say(&format!("  trial {trial} is excluded"));
            }
            (Answer::Note(text), _) => {
                self.row(Row::of(Event::Note, trial, None).saying(Some(text)))?;
            }
            (Answer::Camera(_) | Answer::Clamp, _) => {
                self.desk.say("  that is for the next trial");
            }
            (
                Answer::Enter | Answer::Yes | Answer::Again | Answer::Quit | Answer::Unclear(_),
                _,
            ) => self.desk.say("  the displacement is needed here"),
        }
        Ok(Then::Look)
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
        model::displacement(&campaign.plan, planned, attempt, a_mm, &sidecar).map_err(|error| {
            let folder = Attempt::folder(planned.trial, attempt);
            Broken::NotReady {
                why: format!("{folder} has no displacement: {error}"),
                help: "change the plan to what the models cover, and begin another campaign"
                    .to_owned(),
            }
        })
    }

    /// The body has been measured: the thread need not stay under tension.
    fn unfold_after(&mut self, planned: &Planned, attempt: u32) -> Result<Then, Broken> {
        let campaign = self.folder.campaign();
        let began = |row: &&Row| row.event == Event::Began;
        // A displacement that is entered again says nothing about what the capsule does now.
        let is_last =
            campaign.rows.iter().rfind(began).is_some_and(|row| {
                (row.trial, row.attempt) == (Some(planned.trial), Some(attempt))
            });
        if planned.shape != Form::Unfolded
            && is_last
            && let Some(capsule) = &mut self.machines.capsule
            && capsule.capsule_status()?.state == CapsuleState::Folded
        {
            let folder = self
                .folder
                .campaign()
                .attempt_folder(planned.trial, attempt);
            let unfolded = self.actuate(ActuationKind::Unfold, &folder);
            self.folder.seal_attempt(planned.trial, attempt)?;
            match unfolded {
                Err(broken) if broken.outcome() == Outcome::Stopped => return Ok(Then::Leave),
                unfolded => unfolded?,
            }
        }
        Ok(Then::Look)
    }
}

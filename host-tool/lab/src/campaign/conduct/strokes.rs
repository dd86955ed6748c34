//! The displacements after the strokes of a run: asked for one by one before the net one, or left out.

use crate::campaign::conduct::modelled::Modelled;
use crate::campaign::conduct::{Broken, Conduct, Then};
use crate::campaign::ledger::{LedgerEvent, LedgerRow, Source};
use crate::campaign::order::Planned;
use crate::campaign::prompts::{Answer, Question};

impl Conduct<'_> {
    /// The first stroke without a displacement, from 1, and the number of strokes; none if none is missing.
    pub(super) fn missing_stroke(&self, planned: &Planned) -> Option<(usize, usize)> {
        let campaign = self.folder.campaign();
        let count = campaign.plan.strokes_of(planned.purpose, planned.shape)?;
        let attempt = campaign.state.trial(planned.trial)?.attempt()?;
        let there = attempt.strokes.len();
        (!attempt.strokes_left_out && there < count).then_some((there + 1, count))
    }

    /// Asks for the displacement after one stroke.
    pub(super) fn measure_stroke(
        &mut self,
        planned: &Planned,
        attempt: u32,
        (number, count): (usize, usize),
        modelled: Option<Modelled>,
    ) -> Result<Then, Broken> {
        let question = Question::Stroke {
            planned,
            attempt,
            of: self.folder.campaign().order.len(),
            number,
            count,
            model: modelled.as_ref().map(|modelled| modelled.value),
        };
        let Some(answer) = self.ask(&question)? else {
            return Ok(Then::Leave);
        };
        let mut row = LedgerRow::of(LedgerEvent::Stroke, planned.trial, Some(attempt));
        match (answer, modelled) {
            (Answer::Enter, Some(modelled)) => {
                row.displacement_mm = Some(modelled.value);
                row.source = Some(modelled.source);
                self.row(row.saying(Some(modelled.text)))?;
            }
            (Answer::Enter, None) => {
                row.event = LedgerEvent::StrokesLeftOut;
                self.row(row)?;
                self.desk
                    .say("  the strokes of this trial are left out; undo takes that back");
            }
            (Answer::Length(_), Some(_)) => self.say_virtual(),
            (Answer::Length(value), None) => {
                match self.folder.campaign().plan.displacement.refusal(value) {
                    Some(why) => self.desk.say(&format!("  {why}")),
                    None => {
                        row.displacement_mm = Some(value);
                        row.source = Some(Source::Measured);
                        self.row(row)?;
                    }
                }
            }
            (answer, _) => return self.instead(planned, attempt, answer),
        }
        Ok(Then::Look)
    }
}

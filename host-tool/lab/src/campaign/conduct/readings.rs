//! The caliper's readings of a session: those that a trial needs, and the questions that they raise.

use client::identity::Origin;
use jiff::Timestamp;

use crate::campaign::conduct::{Broken, Conduct, Next};
use crate::campaign::order::Planned;
use crate::campaign::plan::{Millimetres, TrialPurpose};
use crate::campaign::prompts::{Answer, Question};
use crate::campaign::readings::{Kind, Quantity, ReadingRow, Set, Summary, questions, refusal};

impl Conduct<'_> {
    /// Makes sure that D is known and the rollers are clamped for this trial's block.
    pub(super) fn set_up(&mut self, planned: &Planned) -> Result<Next, Broken> {
        let open = self.folder.campaign().readings.open().cloned();
        if let Some(set) = open {
            return self.read_set(set.quantity, set.indentation);
        }
        if self.folder.campaign().readings.width().is_none() {
            let count = self.folder.campaign().plan.readings.count;
            self.prompter.say("");
            let todo = vec![
                "The width of the intestine, with the rollers OFF.".to_owned(),
                format!("  {count} readings of D at as many places, with the caliper."),
            ];
            return self.prepare(todo, Quantity::Width, None);
        }
        if self.is_clamped_for(planned) {
            return Ok(Next::Proceed);
        }
        let plan = &self.folder.campaign().plan;
        let name = &planned.indentation;
        let mut todo = vec![
            String::new(),
            format!(
                "Block {}: {} at {name}{}.",
                planned.block,
                planned.lubrication.name(),
                match planned.purpose {
                    TrialPurpose::Series => "",
                    TrialPurpose::FoldTest => ", folded against unfolded",
                }
            ),
            format!("  Clamp both rollers at {name}, in the same notch on either side."),
        ];
        todo.push(format!(
            "  {} readings of i at as many places, with the caliper.",
            plan.readings.count
        ));
        self.prepare(todo, Quantity::BetweenCrests, Some(name.clone()))
    }

    /// Whether the last readings are of this indentation and were made for this block.
    fn is_clamped_for(&self, planned: &Planned) -> bool {
        let campaign = self.folder.campaign();
        let Some(set) = campaign.readings.clamped() else {
            return false;
        };
        let elsewhere = campaign.state.trials.iter().any(|trial| {
            trial.planned.block != planned.block
                && trial
                    .attempts
                    .iter()
                    .any(|attempt| attempt.readings_set == Some(set.number))
        });
        set.indentation.as_deref() == Some(&*planned.indentation) && !elsewhere
    }

    /// Discards the readings because the rollers will be clamped again; they are invalid even if no others follow.
    /// Requires homing, because handling the rollers may turn the screw.
    pub(super) fn clamp(&mut self) -> Result<(), Broken> {
        self.homed_in = None;
        let Some(set) = self.folder.campaign().readings.clamped().cloned() else {
            return Ok(());
        };
        self.reading_row(ReadingRow {
            row: 0,
            time_utc: Timestamp::UNIX_EPOCH,
            readings_set: set.number,
            quantity: set.quantity,
            indentation: set.indentation,
            event: Kind::Discarded,
            reading: None,
            value_mm: None,
            text: Some("clamped again".to_owned()),
            origin: Origin::Unknown,
        })
    }

    fn prepare(
        &mut self,
        todo: Vec<String>,
        quantity: Quantity,
        indentation: Option<String>,
    ) -> Result<Next, Broken> {
        match self.ask(&Question::Prepare { todo })? {
            None => Ok(Next::Quit),
            Some(Answer::Enter | Answer::Yes) => self.read_set(quantity, indentation),
            Some(_) => {
                self.prompter.say("  that is not for now");
                Ok(Next::Reread)
            }
        }
    }

    /// Asks for the readings that a set still needs.
    fn read_set(
        &mut self,
        quantity: Quantity,
        indentation: Option<String>,
    ) -> Result<Next, Broken> {
        loop {
            let campaign = self.folder.campaign();
            let (count, resolution) = (
                campaign.plan.readings.count,
                campaign.plan.metadata.caliper_resolution_mm,
            );
            let width_mm = campaign
                .readings
                .width()
                .and_then(|set| Some(Summary::of(&set.values)?.mean_mm));
            let open = campaign.readings.open().cloned();
            let (set, done) = open
                .as_ref()
                .map_or((campaign.readings.sets.len() as u32 + 1, 0), |open| {
                    (open.number, open.values.len() as u32)
                });
            let row = |event, text| ReadingRow {
                row: 0,
                time_utc: Timestamp::UNIX_EPOCH,
                readings_set: set,
                quantity,
                indentation: indentation.clone(),
                event,
                reading: None,
                value_mm: None,
                text,
                origin: Origin::Unknown,
            };
            if done == count {
                let Some(open) = open else {
                    return Ok(Next::Reread);
                };
                self.show(&open.values, indentation.as_deref(), &open);
                let odd = {
                    let campaign = self.folder.campaign();
                    questions(&campaign.plan, &campaign.readings, &open)
                };
                if odd.is_empty() {
                    self.reading_row(row(Kind::Accepted, None))?;
                    return Ok(Next::Reread);
                }
                match self.ask(&Question::Odd { questions: &odd })? {
                    None => return Ok(Next::Quit),
                    Some(Answer::Yes) => {
                        let text = format!("confirmed: {}", odd.join("; "));
                        self.reading_row(row(Kind::Accepted, Some(text)))?;
                        return Ok(Next::Reread);
                    }
                    Some(Answer::Again) => {
                        self.reading_row(row(Kind::Discarded, Some(odd.join("; "))))?;
                        return Ok(Next::Reread);
                    }
                    Some(Answer::Undo) => self.reading_row(row(Kind::Withdrawn, None))?,
                    Some(_) => self.prompter.say("  yes, undo or again"),
                }
                continue;
            }
            let question = Question::Reading {
                quantity,
                indentation: indentation.as_deref(),
                number: done + 1,
                count,
            };
            match self.ask(&question)? {
                None => return Ok(Next::Quit),
                Some(Answer::Undo) if done > 0 => self.reading_row(row(Kind::Withdrawn, None))?,
                Some(Answer::Length(value)) => {
                    match refusal(quantity, value, width_mm, resolution) {
                        Some(why) => self.prompter.say(&format!("  {why}")),
                        None => self.reading_row(ReadingRow {
                            reading: Some(done + 1),
                            value_mm: Some(value),
                            ..row(Kind::Reading, None)
                        })?,
                    }
                }
                Some(_) => self.prompter.say("  a number is needed here"),
            }
        }
    }

    /// Shows mean, spread and a_n of the readings so far.
    fn show(&mut self, values: &[Millimetres], indentation: Option<&str>, set: &Set) {
        let Some(summary) = Summary::of(values) else {
            return;
        };
        let a = self.folder.campaign().readings.indentation_mm(set);
        let spread = match summary.sd_mm {
            Some(sd_mm) => format!(
                "SD {sd_mm:.3} mm, {} to {} mm",
                summary.least, summary.greatest
            ),
            None => "n = 1".to_owned(),
        };
        let mut text = format!(
            "  {} = {:.3} mm, {spread}",
            indentation.map_or_else(|| "D".to_owned(), |name| format!("i at {name}")),
            summary.mean_mm,
        );
        if let (Some(a), Some(name)) = (a, indentation) {
            text.push_str(&format!("; {name} = (D - i)/2 = {a:.3} mm"));
        }
        self.prompter.say(&text);
    }
}

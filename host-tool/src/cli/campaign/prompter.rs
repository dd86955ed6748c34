//! Answers a campaign's questions: from a person at the terminal, or from the plan on the virtual bench.

use std::sync::mpsc::TryRecvError;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use client::error::ClientError;
use client::{Interrupt, Observer, Pacer};
use jiff::Timestamp;
use lab::campaign::conduct::Prompter;
use lab::campaign::plan::{CampaignPlan, Millimetres};
use lab::campaign::prompts::{Halt, Question};
use lab::campaign::readings::{Quantity, refusal};
use lab::operations::finder::Finder;
use lab::operations::interrupt;

use crate::cli::keyboard::{self, Lines, TOO_SOON, TypedLine};
use crate::cli::screen::{Keyboard, Screen};

/// Polling interval of the keyboard.
const TURN: Duration = Duration::from_millis(10);

/// Source of the answers.
pub(super) enum Respondent {
    /// A person. During a run the pacer takes the lines.
    Person(Arc<Mutex<Lines>>),
    /// The plan, if no person is present.
    Nobody(Box<CampaignPlan>),
}

impl Respondent {
    pub(super) fn person(keyboard: Keyboard, by_hand: bool) -> Self {
        Self::Person(Arc::new(Mutex::new(Lines::new(keyboard, by_hand))))
    }
}

/// Checks that the plan has every answer that a person would give, and that none of them would be refused: the plan
/// would repeat it for ever.
pub(super) fn can_answer(plan: &CampaignPlan) -> Result<(), String> {
    let because = |why: String| format!("`--yes` takes the readings from the plan, and {why}");
    let missing = |what: String| because(format!("it has no {what}"));
    let resolution = plan.metadata.caliper_resolution_mm;
    let width = (plan.readings.width_about_mm)
        .ok_or_else(|| missing("readings.width_about_mm".to_owned()))?;
    if let Some(why) = refusal(Quantity::Width, width, None, resolution) {
        return Err(because(format!("of its width_about_mm, {why}")));
    }
    for indentation in &plan.indentations {
        let name = &indentation.name;
        let about =
            (indentation.about_mm).ok_or_else(|| missing(format!("about_mm for {name}")))?;
        let between = between_crests(width, about);
        let why = refusal(
            Quantity::BetweenCrests,
            between,
            Some(width.mm()),
            resolution,
        );
        if let Some(why) = why {
            return Err(because(format!(
                "of the about_mm for {name}, i = D - 2a is {why}"
            )));
        }
    }
    Ok(())
}

/// The reading i = D - 2a between the crests, by Eq. 8.
fn between_crests(width: Millimetres, about: Millimetres) -> Millimetres {
    Millimetres::from_um(width.um - 2 * about.um)
}

/// Puts a campaign's questions to the terminal or to the plan.
pub(super) struct TerminalPrompter<'a, 'b> {
    screen: &'a mut Screen<'b>,
    finder: &'a Finder<'a>,
    respondent: Respondent,
    interrupt: Interrupt,
}

impl<'a, 'b> TerminalPrompter<'a, 'b> {
    /// From now on, Ctrl-C also ends a question.
    pub(super) fn new(
        screen: &'a mut Screen<'b>,
        finder: &'a Finder<'a>,
        respondent: Respondent,
    ) -> Self {
        Self {
            screen,
            finder,
            respondent,
            interrupt: interrupt::install(),
        }
    }
}

impl Prompter for TerminalPrompter<'_, '_> {
    fn say(&mut self, text: &str) {
        self.screen.say(text);
    }

    fn answer(
        &mut self,
        question: &Question<'_>,
        keep_alive: &mut dyn FnMut() -> Result<(), ClientError>,
    ) -> Result<String, Halt> {
        let lines = match &self.respondent {
            Respondent::Nobody(_) if (self.interrupt)().is_some() => return Err(Halt::Aborted),
            Respondent::Nobody(plan) => return Ok(by_plan(plan, question)),
            Respondent::Person(lines) => lines,
        };
        let asked = Instant::now();
        loop {
            if (self.interrupt)().is_some() {
                return Err(Halt::Aborted);
            }
            let typed = lines
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .answer(asked);
            match typed {
                Ok(TypedLine::Text(line)) => return Ok(line),
                Ok(TypedLine::TooSoon) => self.screen.say(TOO_SOON),
                Err(TryRecvError::Disconnected) => return Err(Halt::Aborted),
                Err(TryRecvError::Empty) => {
                    thread::sleep(TURN);
                    keep_alive().map_err(Halt::Client)?;
                }
            }
        }
    }

    fn is_person(&self) -> bool {
        matches!(self.respondent, Respondent::Person(_))
    }

    fn observer(&mut self) -> Box<dyn Observer + '_> {
        Box::new(self.screen.live())
    }

    fn pacer(&mut self) -> Option<Pacer> {
        let Respondent::Person(lines) = &self.respondent else {
            return None;
        };
        let lines = Arc::clone(lines);
        Some(Box::new(move || {
            let typed = lines.lock().unwrap_or_else(PoisonError::into_inner).next();
            keyboard::pace(typed.ok()?.trim(), keyboard::hint(false))
        }))
    }

    fn now(&self) -> Timestamp {
        self.finder.connector.now()
    }
}

/// The answer that a person would type on the virtual bench.
fn by_plan(plan: &CampaignPlan, question: &Question<'_>) -> String {
    let width = plan.readings.width_about_mm.unwrap_or_default();
    match question {
        Question::Reading {
            quantity: Quantity::BetweenCrests,
            indentation,
            ..
        } => {
            let about = plan
                .indentations
                .iter()
                .find(|known| Some(known.name.as_str()) == *indentation)
                .and_then(|known| known.about_mm)
                .unwrap_or_default();
            between_crests(width, about).to_string()
        }
        Question::Reading { .. } => width.to_string(),
        Question::Odd { .. } => "yes".to_owned(),
        Question::Prepare { .. } | Question::Ready { .. } | Question::Displacement { .. } => {
            String::new()
        }
    }
}

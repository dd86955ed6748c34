//! Answers a campaign's questions: a person at the terminal, or the plan on the virtual bench.

use std::sync::mpsc::TryRecvError;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use campaign::conduct::Desk;
use campaign::plan::{CampaignPlan, Millimetres};
use campaign::prompts::{Halt, Question};
use campaign::readings::Quantity;
use client::error::ClientError;
use client::{Interrupt, Observer, Pacer};
use jiff::Timestamp;
use operations::interrupt;
use operations::places::Places;

use crate::cli::keyboard::{self, Line, Lines, TOO_SOON};
use crate::cli::screen::{Keyboard, Screen};

/// Interval between two polls of the keyboard.
const TURN: Duration = Duration::from_millis(10);

/// Source of the answers.
pub(super) enum Who {
    /// A person. During a run the pacer takes the lines.
    Person(Arc<Mutex<Lines>>),
    /// The plan, when no person is there.
    Nobody(Box<CampaignPlan>),
}

impl Who {
    pub(super) fn person(keyboard: Keyboard, by_hand: bool) -> Self {
        Self::Person(Arc::new(Mutex::new(Lines::new(keyboard, by_hand))))
    }
}

/// Checks that the plan holds every answer that a person would give.
///
/// # Errors
/// Some `about_mm` is missing.
pub(super) fn can_answer(plan: &CampaignPlan) -> Result<(), String> {
    let missing =
        |what: &str| format!("`--yes` takes the readings from the plan, and it has no {what}");
    if plan.readings.width_about_mm.is_none() {
        return Err(missing("readings.width_about_mm"));
    }
    match plan
        .indentations
        .iter()
        .find(|indentation| indentation.about_mm.is_none())
    {
        Some(without) => Err(missing(&format!("about_mm for {}", without.name))),
        None => Ok(()),
    }
}

/// Puts a campaign's questions to the terminal or to the plan.
pub(super) struct Counter<'a, 'b> {
    screen: &'a mut Screen<'b>,
    places: &'a Places<'a>,
    who: Who,
    interrupt: Interrupt,
}

impl<'a, 'b> Counter<'a, 'b> {
    /// Makes Ctrl-C leave a question, too, from now on.
    pub(super) fn new(screen: &'a mut Screen<'b>, places: &'a Places<'a>, who: Who) -> Self {
        Self {
            screen,
            places,
            who,
            interrupt: interrupt::install(),
        }
    }
}

impl Desk for Counter<'_, '_> {
    fn say(&mut self, text: &str) {
        self.screen.say(text);
    }

    fn answer(
        &mut self,
        question: &Question<'_>,
        keep_alive: &mut dyn FnMut() -> Result<(), ClientError>,
    ) -> Result<String, Halt> {
        let lines = match &self.who {
            Who::Nobody(_) if (self.interrupt)().is_some() => return Err(Halt::Left),
            Who::Nobody(plan) => return Ok(by_plan(plan, question)),
            Who::Person(lines) => lines,
        };
        let asked = Instant::now();
        loop {
            if (self.interrupt)().is_some() {
                return Err(Halt::Left);
            }
            let typed = lines
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .answer(asked);
            match typed {
                Ok(Line::Text(line)) => return Ok(line),
                Ok(Line::TooSoon) => self.screen.say(TOO_SOON),
                Err(TryRecvError::Disconnected) => return Err(Halt::Left),
                Err(TryRecvError::Empty) => {
                    thread::sleep(TURN);
                    keep_alive().map_err(Halt::Client)?;
                }
            }
        }
    }

    fn is_person(&self) -> bool {
        matches!(self.who, Who::Person(_))
    }

    fn observer(&mut self) -> Box<dyn Observer + '_> {
        Box::new(self.screen.live())
    }

    fn pacer(&mut self) -> Option<Pacer> {
        let Who::Person(lines) = &self.who else {
            return None;
        };
        let lines = Arc::clone(lines);
        Some(Box::new(move || {
            let typed = lines.lock().unwrap_or_else(PoisonError::into_inner).next();
            keyboard::pace(typed.ok()?.trim(), keyboard::hint(false))
        }))
    }

    fn now(&self) -> Timestamp {
        self.places.connector.now()
    }
}

/// The answer that a person would type on the virtual bench.
fn by_plan(plan: &CampaignPlan, question: &Question<'_>) -> String {
    let width_um = plan.readings.width_about_mm.unwrap_or_default().um;
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
            Millimetres::from_um(width_um - 2 * about.um).to_string()
        }
        Question::Reading { .. } => Millimetres::from_um(width_um).to_string(),
        Question::Odd { .. } => "yes".to_owned(),
        Question::Prepare { .. }
        | Question::Ready { .. }
        | Question::Stroke { .. }
        | Question::Displacement { .. } => String::new(),
    }
}

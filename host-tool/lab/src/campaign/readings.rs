//! Readings of the caliper: the intestine's width D and, after every clamping, the distance i_n between the crests of
//! the wave. They give a_n = (D - i_n)/2, Eq. (8) of the paper.

use client::identity::Origin;
use jiff::Timestamp;
use locomotion::kinematics::indentation_from_calipers_mm;
use serde::{Deserialize, Serialize};

use crate::campaign::ledger::{Contradiction, Sequence};
use crate::campaign::plan::{CampaignPlan, Millimetres};
use crate::campaign::statistics::Spread;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Quantity {
    /// D, the distance between the walls, rollers off.
    Width,
    /// i_n, the distance between the crests of the wave.
    BetweenCrests,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    Reading,
    /// The last reading of the set was taken back.
    Withdrawn,
    Accepted,
    /// The set is not used; it was measured again.
    Discarded,
}

/// A row of `readings.csv`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReadingRow {
    /// Numbered from 1, without gaps.
    pub row: u32,
    pub time_utc: Timestamp,
    /// The set of readings, from 1. Each clamping begins a new one.
    pub readings_set: u32,
    pub quantity: Quantity,
    /// Name of the indentation; empty for the width.
    pub indentation: Option<String>,
    pub event: Kind,
    /// Number of the reading in the set, from 1.
    pub reading: Option<u32>,
    pub value_mm: Option<Millimetres>,
    /// The questions that were asked and confirmed, or why the set is not used.
    pub text: Option<String>,
    pub origin: Origin,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Set {
    pub number: u32,
    pub quantity: Quantity,
    /// Name of the indentation; none for the width.
    pub indentation: Option<String>,
    pub values: Vec<Millimetres>,
    pub accepted: bool,
    /// Whether the set was discarded, before it was accepted or because the rollers were clamped again.
    pub discarded: bool,
    /// The questions that were asked and confirmed, or why the set is not used.
    pub text: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Summary {
    pub count: usize,
    pub mean_mm: f64,
    /// Standard deviation of the sample, mm; none for a single reading.
    pub sd_mm: Option<f64>,
    pub least: Millimetres,
    pub greatest: Millimetres,
}

impl Summary {
    pub fn of(values: &[Millimetres]) -> Option<Self> {
        let (least, greatest) = (*values.iter().min()?, *values.iter().max()?);
        // Exact, because values are whole micrometres.
        let values: Vec<f64> = values.iter().map(|value| value.um as f64).collect();
        let spread = Spread::of(&values)?;
        Some(Self {
            count: spread.n,
            mean_mm: spread.mean / 1e3,
            sd_mm: spread.sd.map(|sd_um| sd_um / 1e3),
            least,
            greatest,
        })
    }

    pub fn spread(&self) -> Millimetres {
        Millimetres::from_um(self.greatest.um - self.least.um)
    }
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Readings {
    /// In the order of their numbers, from 1.
    pub sets: Vec<Set>,
    pub sequence: Sequence,
}

impl Readings {
    /// State after all these rows.
    ///
    /// # Errors
    /// The first row that cannot follow the earlier ones.
    pub fn replay(rows: &[ReadingRow]) -> Result<Self, Contradiction> {
        let mut readings = Self::default();
        for row in rows {
            readings.apply(row)?;
        }
        Ok(readings)
    }

    /// Applies one more row.
    ///
    /// # Errors
    /// The row cannot come next; nothing has changed.
    pub fn apply(&mut self, row: &ReadingRow) -> Result<(), Contradiction> {
        let number = self.sequence.next_row();
        let wrong = |why: String| Contradiction { row: number, why };
        self.sequence.check(row.row, row.origin).map_err(wrong)?;
        if (row.quantity == Quantity::BetweenCrests) != row.indentation.is_some() {
            return Err(wrong("i_n needs an indentation, D has none".to_owned()));
        }
        let sets = self.sets.len() as u32;
        if row.readings_set == sets + 1 {
            if self
                .sets
                .last()
                .is_some_and(|last| !last.accepted && !last.discarded)
            {
                return Err(wrong(format!("set {sets} is not complete")));
            }
            if row.event != Kind::Reading {
                return Err(wrong("a set begins with a reading".to_owned()));
            }
            self.sets.push(Set {
                number: sets + 1,
                quantity: row.quantity,
                indentation: row.indentation.clone(),
                values: vec![],
                accepted: false,
                discarded: false,
                text: None,
            });
        }
        let Some(set) = self.sets.last_mut().filter(|last| {
            row.readings_set == last.number
                && row.quantity == last.quantity
                && row.indentation == last.indentation
                && !last.discarded
        }) else {
            return Err(wrong(format!("it belongs to set {}", row.readings_set)));
        };
        match row.event {
            Kind::Reading if !set.accepted => {
                let (Some(value), Some(reading)) = (row.value_mm, row.reading) else {
                    return Err(wrong("a reading without a number".to_owned()));
                };
                if reading as usize != set.values.len() + 1 {
                    return Err(wrong(format!("it is reading {reading}")));
                }
                set.values.push(value);
            }
            Kind::Withdrawn if !set.accepted => {
                if set.values.pop().is_none() {
                    return Err(wrong("there is no reading to take back".to_owned()));
                }
            }
            Kind::Accepted if !set.accepted && !set.values.is_empty() => {
                set.accepted = true;
                set.text = row.text.clone();
            }
            Kind::Discarded => {
                set.discarded = true;
                if !set.accepted {
                    set.text = row.text.clone();
                }
            }
            Kind::Reading | Kind::Withdrawn | Kind::Accepted => {
                return Err(wrong(format!("set {} is complete", set.number)));
            }
        }
        self.sequence.take(row.origin);
        Ok(())
    }

    pub fn open(&self) -> Option<&Set> {
        self.sets
            .last()
            .filter(|last| !last.accepted && !last.discarded)
    }

    pub fn width(&self) -> Option<&Set> {
        self.sets
            .iter()
            .rfind(|set| set.accepted && set.quantity == Quantity::Width)
    }

    /// The last accepted set of i_n for an indentation.
    #[must_use]
    fn between_crests(&self, indentation: &str) -> Option<&Set> {
        self.sets
            .iter()
            .rfind(|set| set.accepted && set.indentation.as_deref() == Some(indentation))
    }

    /// The last complete set of i_n, which describes the present clamping of the rollers; none if it was discarded,
    /// because they have been moved since.
    pub fn clamped(&self) -> Option<&Set> {
        self.sets
            .iter()
            .rfind(|set| set.quantity == Quantity::BetweenCrests && (set.accepted || set.discarded))
            .filter(|set| !set.discarded)
    }

    /// a_n = (D - i_n)/2 from a set of i_n and the last accepted D, mm. None without D, or if they contradict each
    /// other.
    pub fn indentation_mm(&self, set: &Set) -> Option<f64> {
        let width = Summary::of(&self.width()?.values)?.mean_mm;
        let between = Summary::of(&set.values)?.mean_mm;
        indentation_from_calipers_mm(width, between)
            .ok()
            .filter(|a| *a > 0.0)
    }
}

/// Why a reading is refused; none if it is accepted. `width_mm` is the mean of D, once known.
pub fn refusal(
    quantity: Quantity,
    value: Millimetres,
    width_mm: Option<f64>,
    resolution: Millimetres,
) -> Option<String> {
    if value.um <= 0 {
        return Some(format!("{value} mm: a width is above 0"));
    }
    if value.um > 1_000_000 {
        return Some(format!("{value} mm is beyond any caliper"));
    }
    if resolution.um > 0 && value.um % resolution.um != 0 {
        return Some(format!(
            "{value} mm: the caliper's resolution is {resolution} mm"
        ));
    }
    match (quantity, width_mm) {
        (Quantity::BetweenCrests, Some(width_mm)) if value.mm() >= width_mm => Some(format!(
            "i = {value} mm is not below D = {width_mm:.3} mm: the rollers do not touch the wall"
        )),
        _ => None,
    }
}

/// Fraction of the plan's `width_about_mm` by which D may differ from it without a question.
const FAR_OFF: f64 = 0.2;

pub fn questions(plan: &CampaignPlan, readings: &Readings, set: &Set) -> Vec<String> {
    let mut questions = vec![];
    let Some(summary) = Summary::of(&set.values) else {
        return questions;
    };
    if summary.spread() > plan.readings.spread_mm {
        questions.push(format!(
            "the readings differ by {} mm, more than {} mm",
            summary.spread(),
            plan.readings.spread_mm
        ));
    }
    let Some(name) = &set.indentation else {
        let about_mm = plan.readings.width_about_mm.map(Millimetres::mm);
        if let Some(about_mm) = about_mm
            && (summary.mean_mm - about_mm).abs() > FAR_OFF * about_mm
        {
            questions.push(format!(
                "D = {:.3} mm, and the plan says about {about_mm} mm",
                summary.mean_mm
            ));
        }
        return questions;
    };
    let (Some(own), Some(rank)) = (readings.indentation_mm(set), plan.rank(name)) else {
        return questions;
    };
    for (other_rank, other) in plan.indentations.iter().enumerate() {
        let measured = readings
            .between_crests(&other.name)
            .filter(|measured| measured.number != set.number)
            .and_then(|measured| readings.indentation_mm(measured));
        let Some(measured) = measured else { continue };
        let name_of = &other.name;
        if other_rank < rank && own <= measured {
            questions.push(format!(
                "{name} = {own:.3} mm does not rise above {name_of} = {measured:.3} mm"
            ));
        }
        if other_rank > rank && own >= measured {
            questions.push(format!(
                "{name} = {own:.3} mm is not below {name_of} = {measured:.3} mm"
            ));
        }
    }
    questions
}

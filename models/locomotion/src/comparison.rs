//! Each sentence of the paper's sections II and III that states a number or a trend, beside a model's result.
//!
//! The rows are data for reports; [`Table`] prints them as the Markdown table of `docs/paper-comparison.md`. A
//! [`Condition`] says what a sentence requires of the value; [`odds`] counts how many of several bodies meet it.

mod condition;
mod figures;
mod kind;
mod odds;
mod print;
mod runs;
mod sentences;

pub use condition::Condition;
pub use kind::Kind;
pub use odds::{Asked, Odds, Share, Values, odds};
pub use print::{Bodies, Table};

use crate::model::Model;
use crate::prior::{self, Band, Words};
use crate::range::OutOfRange;
use crate::roller;

use figures::{DEEPEST_MM, Figures};
use sentences::SENTENCES;

/// Where the model's value of a row comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Evidence {
    /// The paper's number is an input of the model; the value only shows that.
    Input,
    /// A parameter was fitted to this sentence.
    Fitted,
    /// Follows from the equations or the models.
    Outcome,
    /// The models have nothing to compare.
    Outside,
}

/// How a sentence selects the bodies that agree with the words ([`crate::prior::agrees`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Chosen {
    /// A body that misses the row's condition is rejected.
    Wholly,
    /// A body has to meet only a weaker form of the row's condition.
    Partly,
}

/// One sentence of the paper beside the models' result.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// Section of the paper.
    pub section: &'static str,
    /// The sentence, paraphrased.
    pub sentence: &'static str,
    /// The quantity that is compared.
    pub quantity: &'static str,
    /// The paper's value or trend, in its own rounding.
    pub paper: &'static str,
    /// The model's value, if it has one.
    pub model: Option<f64>,
    /// Unit of both values; empty for a pure number.
    pub unit: &'static str,
    /// The condition that the sentence puts on the value; none if it states neither number nor trend.
    pub condition: Option<Condition>,
    /// The world whose runs give the value; none if it needs no run of the unfolded body.
    pub world: Option<Words>,
    /// Whether this sentence selects the bodies that agree with the words. Those bodies then meet it always, or more
    /// often, and that is no evidence.
    pub chosen: Option<Chosen>,
    /// Where the model's value comes from.
    pub evidence: Evidence,
    /// Comment; may be empty.
    pub remark: &'static str,
}

/// Number of rows.
pub const ROWS: usize = 94;

/// Default number of prior draws behind each probability: enough to know a share to 0.07.
pub const BODIES: u16 = 200;

/// The friction coefficients of section II.B: 0.08, 0.085 ... 0.20.
pub fn frictions() -> impl ExactSizeIterator<Item = f64> + Clone {
    (0..25u8).map(|i| f64::from(80 + 5 * u16::from(i)) / 1000.0)
}

/// Displacement in 40 s at the deepest indentation, over the draws that agree with the words on the rig.
fn band_on_rig(model: &Model) -> Result<Band, OutOfRange> {
    let mut values = [0.0; prior::DRAWS as usize];
    let mut count = 0;
    for (slot, draw) in values.iter_mut().zip(prior::agreeing(Words::Rig)) {
        let mut params = draw.apply(model).rig()?;
        params.step_mm = BAND_STEP_MM;
        *slot = roller::run(params, DEEPEST_MM)?;
        count += 1;
    }
    Band::of(&mut values[..count]).ok_or(OutOfRange {
        quantity: "number of draws",
        value: 0.0,
        min: 1.0,
        max: prior::DRAWS.into(),
        unit: "",
        ends: crate::range::Ends::Closed,
        because: "a band needs draws that agree with the words",
    })
}

/// Step of the roller in the band, mm: its error of at most 0.3 mm is invisible there.
const BAND_STEP_MM: f64 = 0.25;

/// Every sentence of sections II and III with a number or a trend, and two of section I, in the paper's order, each
/// with the model's value.
///
/// # Errors
/// A model with a value outside its range.
pub fn rows(model: &Model) -> Result<[Row; ROWS], OutOfRange> {
    Ok(Sheet::new(model)?.rows)
}

/// The rows of one model, kept with the values that are needed to evaluate other bodies.
#[derive(Clone, Debug, PartialEq)]
pub struct Sheet {
    /// The rows.
    pub rows: [Row; ROWS],
    /// Values that do not depend on the body.
    common: Common,
}

impl Sheet {
    /// Evaluates every row for a model.
    ///
    /// # Errors
    /// A model with a value outside its range.
    pub fn new(model: &Model) -> Result<Self, OutOfRange> {
        let common = Common {
            facets_mm: runs::over_frictions(Model::TUBE.tube()?)?,
            band: band_on_rig(model)?,
        };
        let asked = Questions {
            worlds: &[Words::Rig, Words::Tube],
            roughly: false,
        };
        let rows = evaluate(model, &asked, &common)?;
        Ok(Self { rows, common })
    }

    /// Values of another body for the rows with a condition, in these worlds. Computed with the same coarse steps as
    /// the selection of the bodies that agree with the words.
    ///
    /// # Errors
    /// A model with a value outside its range.
    pub fn values(&self, model: &Model, worlds: &[Words]) -> Result<Values, OutOfRange> {
        let asked = Questions {
            worlds,
            roughly: true,
        };
        Ok(evaluate(model, &asked, &self.common)?.map(|row| row.model))
    }
}

/// Values of the rows that do not depend on the body.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Common {
    /// Least and greatest displacement over the frictions at 7000 Pa, for the body `tube`, whose friction ratio
    /// follows from the friction.
    facets_mm: (f64, f64),
    /// Prior band on the rig.
    band: Band,
}

/// The rows to compute.
struct Questions<'a> {
    /// Rows of these worlds, and rows that belong to no world.
    worlds: &'a [Words],
    /// With coarse steps, and only the rows with a condition.
    roughly: bool,
}

impl Questions<'_> {
    fn wants(&self, world: Option<Words>, condition: Option<Condition>) -> bool {
        world.is_none_or(|world| self.worlds.contains(&world))
            && (condition.is_some() || !self.roughly)
    }
}

fn evaluate(
    model: &Model,
    asked: &Questions<'_>,
    common: &Common,
) -> Result<[Row; ROWS], OutOfRange> {
    let figures = Figures::new(model, asked, common)?;
    let mut rows = SENTENCES.each_ref().map(|sentence| Row {
        section: sentence.section,
        sentence: sentence.sentence,
        quantity: sentence.quantity,
        paper: sentence.paper,
        model: None,
        unit: sentence.unit,
        condition: sentence.condition.map(|condition| condition(&figures)),
        world: sentence.world,
        chosen: sentence.chosen,
        evidence: sentence.evidence,
        remark: sentence.remark,
    });
    for (row, sentence) in rows.iter_mut().zip(&SENTENCES) {
        if asked.wants(row.world, row.condition) {
            row.model = sentence.value.map(|value| value(&figures)).transpose()?;
        }
    }
    Ok(rows)
}

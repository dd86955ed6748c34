//! How probable it is that each of the paper's sentences is met: the bodies to evaluate, and the results as rows.

use locomotion::comparison::{
    Asked, Bodies, Chosen, Kind, Odds, ROWS, Row, Share, Sheet, Table, Values, odds,
};
use locomotion::model::Model;
use locomotion::prior::{Words, agreeing, draws};
use locomotion::range::OutOfRange;
use serde::Serialize;

use crate::science::posterior::Posterior;

/// A body to evaluate, and the worlds to evaluate it in.
#[derive(Clone, Copy, Debug)]
pub struct Question {
    model: Model,
    worlds: &'static [Words],
}

impl Question {
    /// Evaluates every row with a condition in these worlds.
    ///
    /// # Errors
    /// A model with a value outside its range.
    pub fn answer(&self, sheet: &Sheet) -> Result<Values, OutOfRange> {
        sheet.values(&self.model, self.worlds)
    }
}

/// All bodies to evaluate, in one list, so that threads share them evenly.
#[derive(Clone, Debug)]
pub struct Poll {
    /// The model itself, then draws of the prior, draws that agree with the words on the rig and on the tube, draws
    /// of a posterior.
    pub questions: Vec<Question>,
    /// Number of each.
    pub bodies: Bodies,
    /// Effective number of independent draws of the posterior.
    independent: f64,
}

const RIG: &[Words] = &[Words::Rig];
const TUBE: &[Words] = &[Words::Tube];
const BOTH: &[Words] = &[Words::Rig, Words::Tube];

impl Poll {
    /// Collects `bodies` draws of the prior, all that agree with the words, and all of a posterior; other parameters
    /// are the model's. Evaluates a posterior of trials on the rig on the rig only.
    #[must_use]
    pub fn new(model: &Model, posterior: Option<&Posterior>, bodies: u16) -> Self {
        let first = draws().take(bodies.into());
        let prior: Vec<_> = first.map(|draw| draw.apply(model)).collect();
        let kept =
            |words| -> Vec<Model> { agreeing(words).map(|draw| draw.apply(model)).collect() };
        let (rig, tube) = (kept(Words::Rig), kept(Words::Tube));
        let fitted = posterior.map_or(vec![], |posterior| posterior.bodies(model));
        let bodies = Bodies {
            prior: prior.len(),
            rig: rig.len(),
            tube: tube.len(),
            posterior: fitted.len(),
        };
        let groups = [
            (vec![*model], BOTH),
            (prior, BOTH),
            (rig, RIG),
            (tube, TUBE),
            (fitted, RIG),
        ];
        let questions = groups.into_iter().flat_map(|(models, worlds)| {
            models
                .into_iter()
                .map(move |model| Question { model, worlds })
        });
        Self {
            questions: questions.collect(),
            bodies,
            independent: posterior.map_or(0.0, |posterior| posterior.ess),
        }
    }

    /// Computes the odds of each row from the answers to all questions, in their order.
    #[must_use]
    pub fn odds(&self, sheet: &Sheet, answers: &[Values]) -> [Odds; ROWS] {
        let mut rest = answers;
        let mut next = |count: usize| {
            let (taken, left) = rest.split_at(count.min(rest.len()));
            rest = left;
            taken
        };
        let own = next(1).first().copied().unwrap_or([None; ROWS]);
        let asked = Asked {
            prior: next(self.bodies.prior),
            rig: next(self.bodies.rig),
            tube: next(self.bodies.tube),
            posterior: next(self.bodies.posterior),
            independent: self.independent,
        };
        odds(&sheet.rows, &own, &asked)
    }

    /// The Markdown table.
    #[must_use]
    pub fn table(&self, sheet: &Sheet, odds: &[Odds; ROWS]) -> String {
        let table = Table {
            rows: &sheet.rows,
            odds,
            bodies: self.bodies,
        };
        table.to_string()
    }
}

/// One row as a flat record.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Judged {
    /// Section of the paper.
    pub section: &'static str,
    /// The sentence, paraphrased.
    pub sentence: &'static str,
    /// The quantity that is compared.
    pub quantity: &'static str,
    /// The paper's value or trend.
    pub paper: &'static str,
    /// Requirement of the sentence on the value; none if it has none.
    pub condition: Option<String>,
    /// The model's value.
    pub model: Option<f64>,
    /// Unit of the value; empty for a pure number.
    pub unit: &'static str,
    /// Whether the model's value meets the condition.
    pub met: Option<bool>,
    /// Whether the evaluated bodies differ in their values. If not, the share is certainly 0 or 1 and has no
    /// interval.
    pub body_decides: Option<bool>,
    /// Share of the bodies of the prior that meet it.
    pub prior_share: Option<f64>,
    /// Lower end of the 95 % interval of that probability.
    pub prior_low: Option<f64>,
    /// Upper end.
    pub prior_high: Option<f64>,
    /// Number of bodies evaluated.
    pub prior_bodies: Option<usize>,
    /// Share of the bodies that agree with the words.
    pub words_share: Option<f64>,
    /// Lower end of the 95 % interval.
    pub words_low: Option<f64>,
    /// Upper end.
    pub words_high: Option<f64>,
    /// Number of bodies evaluated.
    pub words_bodies: Option<usize>,
    /// Whether this row selected these bodies: `wholly` or `partly`. Their share is then no evidence.
    pub words_chosen_by_it: Option<&'static str>,
    /// Share of the bodies of the posterior.
    pub posterior_share: Option<f64>,
    /// Lower end of the 95 % interval.
    pub posterior_low: Option<f64>,
    /// Upper end.
    pub posterior_high: Option<f64>,
    /// Number of bodies evaluated.
    pub posterior_bodies: Option<usize>,
    /// Kind of the row: what its agreement is worth.
    pub kind: String,
    /// Comment.
    pub remark: &'static str,
}

/// Share, lower and upper end of its interval, number of bodies.
type Cells = (Option<f64>, Option<f64>, Option<f64>, Option<usize>);

impl Judged {
    /// From a row and its odds; `fitted` if there is a posterior.
    #[must_use]
    pub fn of(row: &Row, odds: &Odds, fitted: bool) -> Self {
        let sure = |met: bool| (Some(f64::from(u8::from(met))), None, None, None);
        let (decides, prior, words, posterior) = match *odds {
            Odds::Unstated => (None, cells(None), cells(None), cells(None)),
            Odds::AnyBody(met) => {
                let fitted = if fitted { sure(met) } else { cells(None) };
                (Some(false), sure(met), sure(met), fitted)
            }
            Odds::Shares {
                prior,
                words,
                posterior,
            } => (Some(true), cells(prior), cells(words), cells(posterior)),
        };
        let met = row.condition.zip(row.model);
        Self {
            section: row.section,
            sentence: row.sentence,
            quantity: row.quantity,
            paper: row.paper,
            condition: row.condition.map(|condition| condition.to_string()),
            model: row.model,
            unit: row.unit,
            met: met.map(|(condition, value)| condition.met(value)),
            body_decides: decides,
            prior_share: prior.0,
            prior_low: prior.1,
            prior_high: prior.2,
            prior_bodies: prior.3,
            words_share: words.0,
            words_low: words.1,
            words_high: words.2,
            words_bodies: words.3,
            words_chosen_by_it: row.chosen.map(|chosen| match chosen {
                Chosen::Wholly => "wholly",
                Chosen::Partly => "partly",
            }),
            posterior_share: posterior.0,
            posterior_low: posterior.1,
            posterior_high: posterior.2,
            posterior_bodies: posterior.3,
            kind: Kind::of(row, odds).to_string(),
            remark: row.remark,
        }
    }
}

fn cells(share: Option<Share>) -> Cells {
    match share {
        Some(share) => {
            let (low, high) = share.interval;
            (
                Some(share.part()),
                Some(low),
                Some(high),
                Some(share.bodies),
            )
        }
        None => (None, None, None, None),
    }
}

//! Selects the next trials: their expected information gain on the body, over many possible histories.
//!
//! The gain of a trial after others is the information in its result, averaged over histories of those others. Each
//! gain is conditional on the trials before, so the gains of a sequence add up to its joint gain. A standard error is
//! that of the mean over the histories: it includes every random source, draws as well as truths and results.

use rayon::prelude::*;

use crate::belief::Belief;
use crate::fit::quantile;
use crate::history::{History, Response, Trial};
use crate::information::Information;
use crate::prior::{UNKNOWNS, unknowns};

/// Accuracy of the estimated gains.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Effort {
    /// Number of histories.
    pub histories: usize,
    /// Draws in each history.
    pub draws: usize,
}

impl Effort {
    /// Effort for a final answer.
    pub const FULL: Self = Self {
        histories: 128,
        draws: 512,
    };
}

/// A mean and its standard error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// The mean.
    pub mean: f64,
    /// Its standard error.
    pub error: f64,
}

/// Two estimates differ if they are more than this many standard errors of the difference apart.
const TELLING: f64 = 2.0;

impl Estimate {
    /// From at least two independent values.
    #[must_use]
    pub fn of(values: &[f64]) -> Self {
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        Self {
            mean,
            error: libm::sqrt(squares / (count - 1.0) / count),
        }
    }

    /// Whether it is significantly above 0.
    #[must_use]
    pub fn is_above_zero(&self) -> bool {
        self.mean > TELLING * self.error
    }
}

/// One step of a selection.
#[derive(Clone, Debug, PartialEq)]
pub struct Choice {
    /// The chosen candidate.
    pub chosen: usize,
    /// Gain of each candidate after the steps before, nats.
    pub gains: Vec<Estimate>,
    /// Candidates whose gain does not differ significantly from that of the chosen one.
    pub ties: Vec<usize>,
}

/// The information that a sequence of trials is expected to give.
#[derive(Clone, Debug, PartialEq)]
pub struct Judged {
    /// Gain of each trial after those before, nats.
    pub gains: Vec<Estimate>,
    /// Joint gain of each trial and all before it, nats.
    pub sums: Vec<Estimate>,
    /// Greatest mean correction of a gain for the finite number of draws, nats.
    pub correction: f64,
    /// Natural logarithm of the 95 % quantile over the 5 % quantile of each unknown, before any trial.
    pub before: [Estimate; UNKNOWNS],
    /// The same after all of them.
    pub after: [Estimate; UNKNOWNS],
}

/// Results of a sequence in one history.
struct Course {
    gains: Vec<Information>,
    before: [f64; UNKNOWNS],
    after: [f64; UNKNOWNS],
}

fn histories<'a>(
    belief: &'a Belief,
    response: &'a Response<'a>,
    effort: &Effort,
    seed: u64,
) -> Option<Vec<History<'a>>> {
    (0..effort.histories as u64)
        .into_par_iter()
        .map(|number| History::new(belief, response, effort.draws, seed, number))
        .collect()
}

/// Chooses `count` trials, each the one that tells most after those before. May choose a candidate more than once.
/// None if belief and model hardly overlap.
#[must_use]
pub fn choose(
    belief: &Belief,
    response: &Response<'_>,
    candidates: &[Trial],
    count: usize,
    effort: &Effort,
    seed: u64,
) -> Option<Vec<Choice>> {
    let mut all = histories(belief, response, effort, seed)?;
    let mut steps: Vec<Choice> = vec![];
    for _ in 0..count {
        if let Some(last) = steps.last() {
            let trial = &candidates[last.chosen];
            all.par_iter_mut()
                .for_each(|history| history.measure(trial));
        }
        let one = |history: &History<'_>| -> Vec<f64> {
            let found = history.information(candidates);
            found.iter().map(|one| one.nats).collect()
        };
        let found: Vec<Vec<f64>> = all.par_iter().map(one).collect();
        let of = |of: &dyn Fn(&[f64]) -> f64| {
            let values: Vec<f64> = found.iter().map(|gains| of(gains)).collect();
            Estimate::of(&values)
        };
        let gains: Vec<Estimate> = (0..candidates.len())
            .map(|place| of(&|gains| gains[place]))
            .collect();
        let chosen = (0..gains.len()).max_by(|one, other| {
            let order = gains[*one].mean.total_cmp(&gains[*other].mean);
            order.then(other.cmp(one))
        })?;
        let ties = (0..gains.len())
            .filter(|place| *place != chosen)
            .filter(|place| !of(&|gains| gains[chosen] - gains[*place]).is_above_zero())
            .collect();
        steps.push(Choice {
            chosen,
            gains,
            ties,
        });
    }
    Some(steps)
}

/// Values a sequence of trials. Histories of the same seed have the same truths, whatever the trials. None if belief
/// and model hardly overlap.
#[must_use]
pub fn judge(
    belief: &Belief,
    response: &Response<'_>,
    trials: &[Trial],
    effort: &Effort,
    seed: u64,
) -> Option<Judged> {
    let mut all = histories(belief, response, effort, seed)?;
    let one = |history: &mut History<'_>| {
        let before = log_widths(history);
        let mut gains = vec![];
        for trial in trials {
            gains.extend(history.information(&[*trial]));
            history.measure(trial);
        }
        Course {
            gains,
            before,
            after: log_widths(history),
        }
    };
    let found: Vec<Course> = all.par_iter_mut().map(one).collect();
    let over =
        |of: &dyn Fn(&Course) -> f64| Estimate::of(&found.iter().map(of).collect::<Vec<_>>());
    let sum = |gains: &[Information]| gains.iter().map(|one| one.nats).sum::<f64>();
    let places = 0..trials.len();
    let corrections = places
        .clone()
        .map(|place| over(&|one| one.gains[place].correction).mean);
    Some(Judged {
        gains: (places
            .clone()
            .map(|place| over(&|one| one.gains[place].nats)))
        .collect(),
        sums: (places
            .clone()
            .map(|place| over(&|one| sum(&one.gains[..=place]))))
        .collect(),
        correction: corrections.fold(0.0, f64::max),
        before: core::array::from_fn(|unknown| over(&|one| one.before[unknown])),
        after: core::array::from_fn(|unknown| over(&|one| one.after[unknown])),
    })
}

/// Logarithm of the 95 % quantile over the 5 % quantile of each unknown.
fn log_widths(history: &History<'_>) -> [f64; UNKNOWNS] {
    let unknowns = unknowns();
    core::array::from_fn(|unknown| {
        let sorted = history.sorted(unknown);
        let value = |part| unknowns[unknown].shape.value(quantile(&sorted, part));
        libm::log(value(0.95) / value(0.05))
    })
}

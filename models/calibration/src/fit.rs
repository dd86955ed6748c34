//! The calibration: from observations to a posterior, with a measure of its reliability.
//!
//! The model is tabulated at least three times: coarsely over the whole prior, then ever finer over the box that holds
//! the posterior of the previous table. A fourth table follows if the third is not accurate enough. The table's error,
//! found by running the model itself, counts as an additional error, so that a coarse table does not exclude what it
//! cannot resolve.

use locomotion::model::Model;
use locomotion::range::OutOfRange;
use rayon::prelude::*;

use crate::chance::{stream, unit};
pub use crate::diagnostics::quantile;
use crate::observation::{Case, Condition, Observation, Unusable, conditions};
use crate::plausible::{mistake, mistake_beside};
use crate::prediction::Predictor;
use crate::prior::{OF_BODY, Parts, Point, UNKNOWNS, discrepancy_mm, parts};
use crate::replicated::{Predictions, predicted};
use crate::sampler::{Draws, Effort, Mixing, sample_from};
use crate::table::{Region, Table, distinct};
use crate::target::{Target, deviation_mm};
use crate::verdict::{Verdict, judge, of_sampling};

/// Step of the rollers at which the model has converged, mm: the reference for every table.
pub const CONVERGED_STEP_MM: f64 = 0.05;
/// Greatest error of the last table in a reliable fit: root of the mean square over the posterior, in standard
/// deviations of a condition's mean. An error of one half widens the variance by a quarter.
pub const GREATEST_TABLE_ERROR: f64 = 0.5;
/// Table error above which a finer table is made.
const WANTED_TABLE_ERROR: f64 = 0.25;
/// Available steps of a table, mm, the coarsest first: the cost of a run is proportional to the number of steps.
const STEPS_MM: [f64; 3] = [0.25, 0.1, CONVERGED_STEP_MM];
/// Greatest error from the step of the last tables, measured like the error of the table.
const GREATEST_STEP_ERROR: f64 = 0.1;
/// Step of the first table, mm.
const FIRST_STEP_MM: f64 = 0.5;

/// Nodes of the tables, from coarse to fine. The last is made only if the one before is not accurate enough.
const LEVELS: [[usize; OF_BODY]; 4] = [[16, 14, 8], [12, 10, 8], [16, 14, 12], [32, 28, 24]];
/// First level whose table may be the last.
const GOOD_ENOUGH: usize = 2;
/// Number of bodies on which a table is checked.
const TRIED: usize = 48;
/// Margin of the next box around the draws, to each side, as a share of its width.
const MARGIN: f64 = 0.15;

/// How to make a calibration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Seed of all random numbers.
    pub seed: u64,
    /// Amount of sampling.
    pub effort: Effort,
}

impl Settings {
    /// For a final answer, with this seed.
    #[must_use]
    pub const fn full(seed: u64) -> Self {
        Self {
            seed,
            effort: Effort::FULL,
        }
    }
}

/// Why there is no posterior.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Unfit {
    /// The observations cannot be used.
    #[error(transparent)]
    Unusable(#[from] Unusable),
    /// The model does not cover an observation.
    #[error(transparent)]
    Range(#[from] OutOfRange),
    /// They are written down wrongly.
    #[error("no body of the prior comes near these displacements, but many do if {0}")]
    Mistaken(&'static str),
    /// No body explains them, even with the discrepancy.
    #[error(
        "no body of the prior comes near these displacements: are signs, units and uncertainties right? \
         + is headward, all in millimetres"
    )]
    Nowhere,
}

/// A posterior and its diagnostics.
#[derive(Clone, Debug)]
pub struct Fit {
    /// The conditions that were fitted.
    pub conditions: Vec<Condition>,
    /// The draws.
    pub draws: Draws,
    /// Predictions of the conditions by some of the draws.
    pub predicted: Predictions,
    /// How well each unknown is sampled.
    pub mixing: [Mixing; UNKNOWNS],
    /// Step of the rollers in the last table, mm.
    pub step_mm: f64,
    /// Error of the last table over the posterior, for the worst condition: root of the mean square, in standard
    /// deviations of the condition's mean. See [`GREATEST_TABLE_ERROR`].
    pub table_error: f64,
    /// The last table's error in each condition, mm: counts as an additional error of its mean.
    pub table_errors_mm: Vec<f64>,
    /// Number of nodes computed in the last table.
    pub nodes: usize,
    /// Whether it may be believed, and each reason not to.
    pub verdict: Verdict,
}

/// Error of `read` against the converged model, mm: body by body and case by case.
fn errors_mm(
    read: impl Fn(&Parts) -> Result<Vec<f64>, OutOfRange> + Sync,
    converged: &Predictor,
    bodies: &[Parts],
) -> Result<Vec<Vec<f64>>, OutOfRange> {
    let one = |body: &Parts| {
        let exact = converged.displacements_mm(body)?;
        Ok(read(body)?
            .iter()
            .zip(exact)
            .map(|(read, exact)| read - exact)
            .collect())
    };
    bodies.par_iter().map(one).collect()
}

fn root_mean_square(errors: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = errors.len() as f64;
    (errors.map(|error| error.powi(2)).sum::<f64>() / count).sqrt()
}

/// The worst condition's root mean square of errors over points of the posterior, in standard deviations of the
/// condition's mean.
fn worst(
    errors_mm: &[Vec<f64>],
    points: &[Point],
    conditions: &[Condition],
    places: &[usize],
) -> f64 {
    let one = |(condition, place): (&Condition, &usize)| {
        let square = |(of, point): (&Vec<f64>, &Point)| {
            let tau_mm = discrepancy_mm(point);
            (of[*place] / deviation_mm(condition, tau_mm)).powi(2)
        };
        errors_mm.iter().zip(points).map(square).sum::<f64>() / points.len() as f64
    };
    conditions
        .iter()
        .zip(places)
        .map(one)
        .fold(0.0, f64::max)
        .sqrt()
}

/// Calibrates the body of a model; takes its design, rig and rollers as known.
///
/// # Errors
/// Observations that cannot be used, or that the model does not cover or come near.
pub fn fit(base: &Model, observations: &[Observation], settings: &Settings) -> Result<Fit, Unfit> {
    fit_watched(base, observations, settings, &|_| {})
}

/// As [`fit`]; tells `watch` which table is begun, from 1 to 3 or 4.
///
/// # Errors
/// As [`fit`].
pub fn fit_watched(
    base: &Model,
    observations: &[Observation],
    settings: &Settings,
    watch: &(dyn Fn(usize) + Sync),
) -> Result<Fit, Unfit> {
    let conditions = conditions(observations)?;
    let (cases, places) = distinct(conditions.iter().map(|condition| condition.case));
    let converged = Predictor::new(base, &cases, CONVERGED_STEP_MM)?;
    let mut region = Region::WHOLE;
    let mut step_mm = FIRST_STEP_MM;
    let mut random = stream(settings.seed, 0);
    let mut tried: Vec<Parts> = (0..TRIED)
        .map(|_| core::array::from_fn(|_| unit(&mut random)))
        .collect();
    let mut before: Option<Draws> = None;
    let mut whole: Option<Table> = None;
    let mut level = 0;
    loop {
        watch(level + 1);
        let table = Table::new(converged.with_step(step_mm), region, LEVELS[level]);
        if level == 0
            && let Some(mistake) = mistake(&conditions, &places, &table, settings.seed)
        {
            return Err(Unfit::Mistaken(mistake.what));
        }
        let last = level >= GOOD_ENOUGH;
        let read = |body: &Parts| {
            // A body outside the table counts as an infinite error, which marks the fit as unreliable.
            let nothing = || vec![f64::INFINITY; cases.len()];
            Ok(table.displacements_mm(body).unwrap_or_else(nothing))
        };
        let errors = errors_mm(read, &converged, &tried)?;
        let of = |case| root_mean_square(errors.iter().map(|body: &Vec<f64>| body[case]));
        let table_errors_mm: Vec<f64> = (0..cases.len()).map(of).collect();
        let target = Target {
            conditions: &conditions,
            places: &places,
            table: &table,
            table_errors_mm: &table_errors_mm,
        };
        let effort = if last {
            settings.effort
        } else {
            settings.effort.quick()
        };
        let seed = settings.seed.wrapping_add(level as u64 + 1);
        let draws = sample_from(&target, &effort, seed, before.as_ref()).ok_or(Unfit::Nowhere)?;
        let points = draws.thinned(TRIED);
        tried = points.iter().map(parts).collect();
        let worst = |errors_mm: &[Vec<f64>]| worst(errors_mm, &points, &conditions, &places);
        if last {
            let table_error = worst(&errors_mm(read, &converged, &tried)?);
            if table_error <= WANTED_TABLE_ERROR || level + 1 == LEVELS.len() {
                let mixing = draws.mixing();
                let has_mixed = mixing.iter().all(Mixing::is_enough);
                let exact = |body: &Parts, cases: &[Case]| {
                    Predictor::new(base, cases, CONVERGED_STEP_MM)?.displacements_mm(body)
                };
                let mut verdict = judge(&target, &draws, &exact)?;
                if let (Some(one), Some(whole)) = (verdict.chi_square, &whole)
                    && let Some(mistake) =
                        mistake_beside(one.value, &conditions, &places, whole, settings.seed)
                {
                    return Err(Unfit::Mistaken(mistake.what));
                }
                of_sampling(&mut verdict, has_mixed, table_error, GREATEST_TABLE_ERROR);
                let predicted = predicted(&target, &draws, settings.seed);
                let table_errors_mm = (places.iter()).map(|case| table_errors_mm[*case]).collect();
                return Ok(Fit {
                    verdict,
                    mixing,
                    predicted,
                    conditions,
                    draws,
                    step_mm,
                    table_error,
                    table_errors_mm,
                    nodes: table.worked_out().0,
                });
            }
        } else {
            step_mm = CONVERGED_STEP_MM;
            for coarser in STEPS_MM {
                let with = converged.with_step(coarser);
                let errors = errors_mm(|body| with.displacements_mm(body), &converged, &tried)?;
                if worst(&errors) <= GREATEST_STEP_ERROR {
                    step_mm = coarser;
                    break;
                }
            }
        }
        let all: Vec<Parts> = draws.ensembles.iter().flatten().map(parts).collect();
        region = Region::around(&all, MARGIN).ok_or(Unfit::Nowhere)?;
        before = Some(draws);
        whole = whole.or(Some(table));
        level += 1;
    }
}

impl Fit {
    /// A quantile of an unknown, `0..=1`.
    #[must_use]
    pub fn quantile(&self, unknown: usize, part: f64) -> f64 {
        quantile(&self.draws.sorted(unknown), part)
    }
}

//! Predictions of the posterior beside the measured results.

use locomotion::model::Model;
use locomotion::range::OutOfRange;
use rayon::prelude::*;
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::chance::{normal, stream};
use crate::fit::{CONVERGED_STEP_MM, quantile};
use crate::observation::{Case, Condition};
use crate::prediction::Predictor;
use crate::prior::{Parts, Point, discrepancy_mm, parts};
use crate::table::distinct;
use crate::target::deviation_mm;

/// Quantiles of a distribution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Span {
    /// 5 % lie below.
    pub low: f64,
    /// Median.
    pub median: f64,
    /// 95 % lie below.
    pub high: f64,
}

impl Span {
    /// Of these values.
    #[must_use]
    pub fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        Self {
            low: quantile(&values, 0.05),
            median: quantile(&values, 0.5),
            high: quantile(&values, 0.95),
        }
    }
}

/// A condition beside the posterior's prediction of its mean.
#[derive(Clone, Debug, PartialEq)]
pub struct Check {
    /// The condition.
    pub condition: Condition,
    /// Means that a repetition of the same trials would give: with discrepancy and measurement error.
    pub replicated_mm: Span,
    /// Probability that a replicated mean lies at least as far from the middle as the measured one, to either side.
    /// If it is small, the model does not explain this condition.
    pub p_mean: f64,
    /// Probability of at least this much scatter between repeats if the stated uncertainty is true; none for a single
    /// trial. If it is small, the stated uncertainty is too small.
    pub p_scatter: Option<f64>,
}

/// Probability of a suspicious check by chance, in a fit of a true model with true uncertainties.
const BY_CHANCE: f64 = 0.05;

/// Probability below which a check is reported, for this number of conditions (Bonferroni): among many conditions
/// some are rare by chance.
#[must_use]
pub fn suspicious(conditions: usize) -> f64 {
    BY_CHANCE / conditions.max(1) as f64
}

/// Replicated means per body: enough to resolve rare ones among the many conditions of a campaign.
const REPLICATES: usize = 50;

/// Displacements of cases, mm, body by body.
fn found(
    base: &Model,
    bodies: &[Point],
    cases: &[Case],
    step_mm: f64,
) -> Result<Vec<Vec<f64>>, OutOfRange> {
    let predictor = Predictor::new(base, cases, step_mm)?;
    let bodies: Vec<Parts> = bodies.iter().map(parts).collect();
    let one = |body: &Parts| predictor.displacements_mm(body);
    bodies.par_iter().map(one).collect()
}

/// Compares every condition with the posterior's prediction, using the model itself.
///
/// # Errors
/// A condition that the model does not cover.
pub fn checks(
    base: &Model,
    conditions: &[Condition],
    bodies: &[Point],
    seed: u64,
) -> Result<Vec<Check>, OutOfRange> {
    let (cases, places) = distinct(conditions.iter().map(|condition| condition.case));
    let found = found(base, bodies, &cases, CONVERGED_STEP_MM)?;
    let mut random = stream(seed, u64::MAX);
    let check = |(condition, place): (&Condition, &usize)| {
        let mut again = vec![];
        for (point, found) in bodies.iter().zip(&found) {
            let deviation_mm = deviation_mm(condition, discrepancy_mm(point));
            let replicate = || found[*place] + deviation_mm * normal(&mut random);
            again.extend(std::iter::repeat_with(replicate).take(REPLICATES));
        }
        let below = again.iter().filter(|mm| **mm < condition.mean_mm).count();
        let part = (below as f64 + 0.5) / (again.len() as f64 + 1.0);
        Check {
            condition: condition.clone(),
            replicated_mm: Span::of(again),
            p_mean: 2.0 * part.min(1.0 - part),
            p_scatter: scatter(condition),
        }
    };
    Ok(conditions.iter().zip(&places).map(check).collect())
}

fn scatter(condition: &Condition) -> Option<f64> {
    let degrees = condition
        .repeats
        .checked_sub(1)
        .filter(|degrees| *degrees > 0)?;
    let chi_square = ChiSquared::new(degrees as f64).ok()?;
    Some(chi_square.sf(condition.scatter))
}

/// Displacements of many bodies in one case.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Band {
    /// The case.
    pub case: Case,
    /// The model's displacements, mm.
    pub model_mm: Span,
    /// With the model's discrepancy: what an exact measurement would find, mm.
    pub with_discrepancy_mm: Span,
}

/// The band of each case over these bodies.
///
/// # Errors
/// A case or a body that the model does not cover.
pub fn bands(
    base: &Model,
    bodies: &[Point],
    cases: &[Case],
    step_mm: f64,
    seed: u64,
) -> Result<Vec<Band>, OutOfRange> {
    let found = found(base, bodies, cases, step_mm)?;
    let mut random = stream(seed, u64::MAX - 1);
    let band = |(place, case): (usize, &Case)| {
        let model: Vec<f64> = found.iter().map(|one| one[place]).collect();
        let with = |(mm, point): (&f64, &Point)| {
            let tau_mm = discrepancy_mm(point);
            mm + case.kind.discrepancies() * tau_mm * normal(&mut random)
        };
        Band {
            case: *case,
            with_discrepancy_mm: Span::of(model.iter().zip(bodies).map(with).collect()),
            model_mm: Span::of(model),
        }
    };
    Ok(cases.iter().enumerate().map(band).collect())
}

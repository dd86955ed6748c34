//! Predictions of the posterior, and of the prior, beside the measured results.

use locomotion::model::Model;
use locomotion::range::OutOfRange;
use rayon::prelude::*;
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::chance::{Random, normal, stream};
use crate::fit::{CONVERGED_STEP_MM, quantile};
use crate::observation::{Case, Condition};
use crate::prediction::Predictor;
use crate::prior::{Parts, Point, discrepancy_mm, draw, parts};
use crate::sampler::{Draws, Place};
use crate::table::distinct;
use crate::target::{Target, Without, deviation_mm};

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

/// About how many draws of a posterior get predictions: whole steps of all walkers, evenly spread.
const PREDICTED: usize = 4_000;

/// What one draw predicts of a condition.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Predicted {
    /// The model's displacement, mm.
    pub model_mm: f64,
    /// Mean that a repetition of the same trials would give, mm.
    pub replicated_mm: f64,
    /// Natural logarithm of the density, 1/mm, of the measured mean, given the draw and the means of all other conditions;
    /// none for a draw of the prior.
    pub log_density: Option<f64>,
}

/// What draws predict of all conditions.
pub type Predictions = Vec<(Place, Vec<Predicted>)>;

/// Means of a repetition of all trials, mm. Conditions of a family share the model's errors, as in [`crate::target`].
fn replicated_mm(
    conditions: &[Condition],
    model_mm: &[f64],
    own_mm: &[f64],
    tau_mm: f64,
    random: &mut Random,
) -> Vec<f64> {
    let families = conditions.iter().map(|condition| condition.family + 1);
    let errors_mm: Vec<[f64; 2]> = (0..families.max().unwrap_or(0))
        .map(|_| core::array::from_fn(|_| tau_mm * normal(random)))
        .collect();
    let of = |((condition, model_mm), own_mm): ((&Condition, &f64), &f64)| {
        let [antegrade, returning] = condition.case.kind.errors();
        let [in_antegrade_mm, in_returning_mm] = errors_mm[condition.family];
        model_mm
            + antegrade * in_antegrade_mm
            + returning * in_returning_mm
            + own_mm * normal(random)
    };
    conditions
        .iter()
        .zip(model_mm)
        .zip(own_mm)
        .map(of)
        .collect()
}

/// What draws of the posterior predict of each condition, by the target's table and with its errors.
#[must_use]
pub fn predicted(target: &Target<'_>, draws: &Draws, seed: u64) -> Predictions {
    let mut random = stream(seed, u64::MAX - 2);
    let own = |(condition, place): (&Condition, &usize)| {
        libm::hypot(condition.uncertainty_mm, target.table_errors_mm[*place])
    };
    let conditions = target.conditions;
    let own_mm: Vec<f64> = conditions.iter().zip(target.places).map(own).collect();
    let every = draws.count().div_ceil(PREDICTED);
    let kept = draws.all().filter(|(place, _)| place.draw % every == 0);
    // No draw is outside the table: its density is zero there.
    kept.filter_map(|(place, point)| {
        let found_mm = target.table.displacements_mm(&parts(point))?;
        let model_mm: Vec<f64> = target.places.iter().map(|case| found_mm[*case]).collect();
        let tau_mm = discrepancy_mm(point);
        let again_mm = replicated_mm(conditions, &model_mm, &own_mm, tau_mm, &mut random);
        let without = target.without(point)?;
        let one = |((model_mm, replicated_mm), without): ((f64, f64), Without)| Predicted {
            model_mm,
            replicated_mm,
            log_density: Some(without.log_density - 0.5 * libm::log(core::f64::consts::TAU)),
        };
        let all = model_mm.into_iter().zip(again_mm).zip(without);
        Some((place, all.map(one).collect()))
    })
    .collect()
}

/// Independent draws of the prior, as one chain, and what each predicts of each condition, by the model itself with this
/// step of the rollers.
///
/// # Errors
/// A condition or a body that the model does not cover.
pub fn of_prior(
    base: &Model,
    conditions: &[Condition],
    count: usize,
    step_mm: f64,
    seed: u64,
) -> Result<(Draws, Predictions), OutOfRange> {
    let mut random = stream(seed, u64::MAX - 3);
    let points: Vec<Point> = (0..count).map(|_| draw(&mut random)).collect();
    let (cases, places) = distinct(conditions.iter().map(|condition| condition.case));
    let found = found(base, &points, &cases, step_mm)?;
    let own = |condition: &Condition| condition.uncertainty_mm;
    let own_mm: Vec<f64> = conditions.iter().map(own).collect();
    let draws = Draws {
        walkers: 1,
        ensembles: vec![points],
        accepted: 1.0,
    };
    let one = |((place, point), found_mm): ((Place, &Point), Vec<f64>)| {
        let model_mm: Vec<f64> = places.iter().map(|case| found_mm[*case]).collect();
        let tau_mm = discrepancy_mm(point);
        let again_mm = replicated_mm(conditions, &model_mm, &own_mm, tau_mm, &mut random);
        let of = |(model_mm, replicated_mm)| Predicted {
            model_mm,
            replicated_mm,
            log_density: None,
        };
        (place, model_mm.into_iter().zip(again_mm).map(of).collect())
    };
    let predicted = draws.all().zip(found).map(one).collect();
    Ok((draws, predicted))
}

//! Predictions of the conditions by single draws, for programs that read the draws: displacement, repetition, density.

use locomotion::model::Model;
use locomotion::range::OutOfRange;
use rayon::prelude::*;

use crate::chance::{Random, normal, stream};
use crate::observation::Condition;
use crate::prediction::Predictor;
use crate::prior::{Point, discrepancy_mm, draw, parts};
use crate::sampler::{Draws, Place};
use crate::table::distinct;
use crate::target::{Target, Without};

/// About how many draws of a posterior get predictions: whole steps of all walkers, evenly spread.
const PREDICTED: usize = 4_000;

/// Prediction of a condition by one draw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Predicted {
    /// The model's displacement, mm.
    pub model_mm: f64,
    /// Mean that a repetition of the same trials would give, mm.
    pub replicated_mm: f64,
    /// Natural logarithm of the density, 1/mm, of the measured mean, given the draw and the means of all other
    /// conditions; none for a draw of the prior.
    pub log_density: Option<f64>,
}

/// Predictions of all conditions, draw by draw.
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

/// Predictions of the conditions by draws of the posterior, from the target's table and with its errors.
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

/// Independent draws of the prior, as one chain, and their predictions of the conditions, by the model itself with this
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
    let predictor = Predictor::new(base, &cases, step_mm)?;
    let found = (points.par_iter())
        .map(|point| predictor.displacements_mm(&parts(point)))
        .collect::<Result<Vec<_>, _>>()?;
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

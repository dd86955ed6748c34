//! The draws of a fit as CSV, for other programs: docs/examples/arviz_posterior.py makes ArviZ's groups of them.

use calibration::fit::Fit;
use calibration::observation::Condition;
use calibration::prior::{Values, unknowns};
use calibration::replicated::Predictions;
use calibration::sampler::Draws;
use calibration::verdict::name;
use serde::Serialize;

use crate::science::table::csv_of;

/// A row of `predictions.csv`: one draw and condition.
#[derive(Serialize)]
struct PredictionRow<'a> {
    group: &'static str,
    chain: usize,
    draw: usize,
    condition: &'a str,
    model_mm: f64,
    replicated_mm: f64,
    log_density: Option<f64>,
}

/// A row of `conditions.csv`.
#[derive(Serialize)]
struct ConditionRow {
    condition: String,
    kind: String,
    lubrication: String,
    indentation_mm: f64,
    family: usize,
    repeats: usize,
    displacement_mm: f64,
    uncertainty_mm: f64,
    table_error_mm: f64,
}

/// The files of a fit's draws, by name; `prior` are draws of the prior with what they predict.
///
/// # Errors
/// None known: all rows are flat.
pub fn files(
    fit: &Fit,
    prior: &(Draws, Predictions),
    origin: &str,
) -> Result<[(&'static str, Vec<u8>); 3], csv::Error> {
    // Numbers with all their digits, so that another program finds the same bits.
    let words = ["group", "ensemble", "chain", "draw"].map(str::to_owned);
    let keys = unknowns().map(|unknown| unknown.key.to_owned());
    let mut draws: Vec<Vec<String>> = vec![words.into_iter().chain(keys).collect()];
    for (group, all) in [("posterior", &fit.draws), ("prior", &prior.0)] {
        for (place, point) in all.all() {
            let numbers = [place.ensemble, place.chain, place.draw].map(|one| one.to_string());
            let values = Values::at(point).0.map(|value| format!("{value:?}"));
            let row = [group.to_owned()].into_iter().chain(numbers).chain(values);
            draws.push(row.collect());
        }
    }
    let names: Vec<String> = fit.conditions.iter().map(name).collect();
    let mut predictions = vec![];
    for (group, all) in [("posterior", &fit.predicted), ("prior", &prior.1)] {
        for (place, of_draw) in all {
            for (one, condition) in of_draw.iter().zip(&names) {
                predictions.push(PredictionRow {
                    group,
                    chain: place.chain,
                    draw: place.draw,
                    condition,
                    model_mm: one.model_mm,
                    replicated_mm: one.replicated_mm,
                    log_density: one.log_density,
                });
            }
        }
    }
    let row = |(condition, table_error_mm): (&Condition, &f64)| ConditionRow {
        condition: name(condition),
        kind: condition.case.kind.to_string(),
        lubrication: condition.lubrication.to_string(),
        indentation_mm: condition.case.indentation_mm,
        family: condition.family,
        repeats: condition.repeats,
        displacement_mm: condition.mean_mm,
        uncertainty_mm: condition.uncertainty_mm,
        table_error_mm: *table_error_mm,
    };
    let conditions: Vec<ConditionRow> = (fit.conditions.iter())
        .zip(&fit.table_errors_mm)
        .map(row)
        .collect();
    Ok([
        ("draws.csv", csv_of(&draws, origin)?),
        ("predictions.csv", csv_of(&predictions, origin)?),
        ("conditions.csv", csv_of(&conditions, origin)?),
    ])
}

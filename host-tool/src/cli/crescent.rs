//! `simulate crescent`: the crescent as a beam. Has its own inputs and shares no other model.

use lab::operations::failure::Failure;
use locomotion::beam::{NoAnswer, Validation, band, thread};
use locomotion::paper::INDENTATIONS_MM;
use report::science::{charts, crescent, table};
use serde_json::{Value, json};

use crate::cli::calculation::Calculation;
use crate::cli::failure::Own;
use crate::cli::model::ModelArgs;

/// Minimum number of draws for a band.
const FEWEST: usize = 10;

/// Calculates and writes everything. Returns it for `--json`.
pub(crate) fn crescent(
    work: &mut Calculation<'_, '_>,
    model: &ModelArgs,
    seed: u64,
    draws: u32,
) -> Result<Value, Failure> {
    if let Some(option) = model.first() {
        return Err(Failure::input(
            format!("{option} would do nothing: the beam has inputs of its own"),
            "leave it out; crescent-parameters.csv and crescent-inputs.csv list the beam's inputs",
        ));
    }
    let unsolved = |error: NoAnswer| {
        Failure::input(
            error.to_string(),
            "the paper's wing has an answer: this is a defect of the tool, report it",
        )
    };
    let forces = crescent::forces().map_err(unsolved)?;
    let alphas = crescent::least_alphas().map_err(unsolved)?;
    let indices: Vec<u64> = (0..draws.into()).collect();
    let threads_mm = crescent::threads_mm();
    // Count a draw without an equilibrium as a result; it must not end the calculation.
    let outcomes = work.map(&indices, |index| {
        let params = band::draw(thread::Params::PAPER, seed, *index);
        Ok(band::curve(params, &threads_mm, INDENTATIONS_MM[4]))
    })?;
    let failed = outcomes.iter().filter(|outcome| outcome.is_err()).count();
    let curves: Vec<Vec<f64>> = outcomes.into_iter().flatten().flatten().collect();
    let kept = curves.len();
    if kept < FEWEST {
        return Err(Failure::input(
            format!(
                "only {kept} of {draws} draws do as the paper says of the unfolded body: too few for a band"
            ),
            "draw more: of 2000 about 60 are kept",
        ));
    }
    let rows = crescent::thread_rows(&curves);
    let origin = Validation::NotAgainstARig.to_string();
    let drawn = format!("seed {seed}: {kept} of {draws} draws kept, {failed} without an answer");
    work.screen
        .say(&format!("crescent at a = 5.05 mm: {origin}"));
    for row in &alphas {
        work.screen.say(&format!(
            "  least alpha at friction {:.2}: {:.2} deg, printed {} mm off {:.2} deg",
            row.friction,
            row.least_alpha_deg,
            crescent::PRINT_MM,
            row.least_alpha_printed_deg
        ));
    }
    work.screen.say(&format!(
        "  {drawn}\n  thread/mm  displacement/mm: 5 %   median     95 %   reversed"
    ));
    for row in &rows {
        work.screen.say(&format!(
            "  {:>9} {:>21.1} {:>8.1} {:>8.1} {:>10.2}",
            row.thread_mm, row.low_mm, row.median_mm, row.high_mm, row.reversed
        ));
    }
    work.csv("crescent-force.csv", &forces, &origin)?;
    work.csv("crescent-alpha.csv", &alphas, &origin)?;
    work.csv("crescent-thread.csv", &rows, &origin)?;
    work.csv("crescent-inputs.csv", &crescent::inputs(), &origin)?;
    let parameters: Vec<_> = thread::PARAMETERS.map(table::row).into();
    work.csv("crescent-parameters.csv", &parameters, &origin)?;
    let svg = charts::crescent(&drawn, &forces, &rows).map_err(Own::from)?;
    work.file("crescent.svg", svg.as_bytes())?;
    let files = work.say_files();
    Ok(json!({
        "origin": origin,
        "series": { "crescent": {
            "seed": seed,
            "draws": draws,
            "kept": kept,
            "without_an_answer": failed,
            "least_alpha": alphas,
            "thread": rows,
        } },
        "files": files,
    }))
}

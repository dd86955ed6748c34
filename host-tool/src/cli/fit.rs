//! `fit`: calibrates the body of the model from recorded trials, with its uncertainty.

use std::path::{Path, PathBuf};
use std::time::Duration;

use calibration::fit::{Fit, Settings, fit_watched};
use calibration::observation::{Case, Kind, Observation};
use calibration::predictive::{Band, Check, bands, checks, suspicious};
use calibration::prior::{Point, UNKNOWNS, Values, parts, unknowns, with_body};
use calibration::replicated::of_prior;
use calibration::verdict::Check as Verdict;
use clap::Args;
use client::identity::Origin;
use client::visible::wrapped;
use indicatif::{ProgressBar, ProgressStyle};
use lab::operations::failure::Failure;
use locomotion::model::{Model, Setting, Value as Given};
use report::science::observations::{self, Trials, TrialsError};
use report::science::posterior::{FORMAT, Posterior, SourceRecord};
use report::science::{charts, draws, model_file};
use serde_json::{Value, json};

use crate::cli::calculation::Calculation;
use crate::cli::failure::Own;
use crate::cli::model::ModelArgs;
use crate::cli::screen::Screen;

/// Arguments of `fit`.
#[derive(Debug, Args)]
pub struct FitArgs {
    /// Folders of campaigns, and CSV files of displacements; all of the same body.
    #[arg(required = true, value_name = "DIR|CSV")]
    pub sources: Vec<PathBuf>,
    /// Standard deviation of a displacement, in mm, of reading and repetition: instead of what a campaign's plan states, and
    /// where a row of a file states none.
    #[arg(long, value_name = "MM", value_parser = positive)]
    pub uncertainty_mm: Option<f64>,
    /// Seed of everything: the same seed makes the same bytes.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub seed: u64,
    /// Folder of model.toml, posterior.svg and the draws as CSV. Files of the same names are replaced.
    #[arg(long, value_name = "DIR", default_value = "retrograde-fit")]
    pub out: PathBuf,
    /// Number of threads, by default one per core. The result does not depend on it.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    pub threads: Option<u16>,
    /// The model whose body is fitted, and its other parameters.
    #[command(flatten)]
    pub model: ModelArgs,
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(number) if number.is_finite() && number > 0.0 => Ok(number),
        _ => Err("write a number above 0, for example 0.5".to_owned()),
    }
}

/// Number of bodies that a model file keeps.
const KEPT: usize = 200;
/// Number of positions at which the figure shows a band.
const PLACES: usize = 12;
/// Step of the rollers for the figure's bands and the prior's predictions, mm. Its error is too small to be seen there.
const FIGURE_STEP_MM: f64 = 0.25;
/// Number of draws of the prior that are written.
const OF_PRIOR: usize = 1_000;

/// The failure of observations that cannot be read.
fn unusable(error: TrialsError) -> Failure {
    let why = error.to_string();
    match error {
        TrialsError::Campaign(error) => Own::from(error).into(),
        TrialsError::Changed { folder, findings } => Own::Changed { folder, findings }.into(),
        TrialsError::Csv { .. } => Failure::input(
            why,
            "docs/model-commands.md lists the columns; rows are counted from the one after the header",
        ),
        TrialsError::NoUncertainty(_) => Failure::input(
            why,
            "`uncertainty_mm` in `[displacement]` of the next plan, or `--uncertainty-mm MM`: the standard deviation of one displacement, of reading and repetition together",
        ),
    }
}

/// Observations from all sources together.
struct Read {
    trials: Vec<Trials>,
    origin: Origin,
    base: Model,
}

fn read(args: &FitArgs) -> Result<Read, Failure> {
    let mut all: Vec<Trials> = vec![];
    for path in &args.sources {
        if !path.exists() {
            return Err(Failure::input(
                format!("{}: there is no such file or folder", path.display()),
                "`retrograde list` finds the campaigns that are there",
            ));
        }
        let new = observations::read(path, args.uncertainty_mm).map_err(unusable)?;
        if let Some(twin) = all.iter().find(|one| one.is_same(&new)) {
            return Err(Failure::input(
                format!(
                    "{} and {} are the same displacements",
                    twin.path.display(),
                    path.display()
                ),
                "name each source once: two copies would count as twice the trials",
            ));
        }
        all.push(new);
    }
    let origin = all.first().map_or(Origin::Unknown, |one| one.origin);
    if let Some(other) = all.iter().find(|one| one.origin != origin) {
        return Err(Failure::input(
            format!(
                "{} is of origin {}, {} of origin {origin}",
                other.path.display(),
                other.origin,
                all[0].path.display(),
            ),
            "measured and simulated values are never fitted together; a CSV file says its origin in the column origin",
        ));
    }
    let mut base = args.model.model()?;
    let strokes: Vec<(f64, &Path)> = (all.iter())
        .filter_map(|one| Some((one.stroke_mm?, one.path.as_path())))
        .collect();
    if let Some((stroke_mm, path)) = strokes.first() {
        if let Some((other, of)) = strokes.iter().find(|(mm, _)| mm != stroke_mm) {
            return Err(Failure::input(
                format!(
                    "{} has a stroke of {stroke_mm} mm, {} of {other} mm",
                    path.display(),
                    of.display()
                ),
                "fit campaigns of different strokes apart",
            ));
        }
        if let Some(asked) = args.model.number("rig.stroke_mm")?
            && asked != *stroke_mm
        {
            return Err(Failure::input(
                format!(
                    "the model has a stroke of {asked} mm, {} {stroke_mm} mm",
                    path.display()
                ),
                "leave rig.stroke_mm out: the campaign says it",
            ));
        }
        if let Some(setting) = Setting::named("rig.stroke_mm") {
            let _ = base.set(setting, Given::Number(*stroke_mm));
        }
        base.check()?;
    }
    Ok(Read {
        trials: all,
        origin,
        base,
    })
}

/// Shows on a terminal that something goes on, and for how long.
fn waiting(terminal: bool) -> ProgressBar {
    if !terminal {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::new_spinner();
    if let Ok(style) = ProgressStyle::with_template("  {spinner} {msg}, {elapsed}") {
        bar.set_style(style);
    }
    bar.enable_steady_tick(Duration::from_millis(200));
    bar
}

pub(crate) fn fit(args: &FitArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let Read {
        trials,
        origin,
        base,
    } = read(args)?;
    let observations: Vec<Observation> = (trials.iter())
        .flat_map(|one| one.measured.iter().map(|measured| measured.observation))
        .collect();
    say_sources(&trials, args.uncertainty_mm, screen);
    let mut work = Calculation::new(&args.out, args.threads, screen)?;
    let bar = waiting(work.screen.terminal);
    let watch = |table| bar.set_message(format!("table {table} of 3 or 4, the last take longest"));
    let (found, bodies, checked) = work.install(|| -> Result<_, Failure> {
        let settings = Settings::full(args.seed);
        let found = fit_watched(&base, &observations, &settings, &watch).map_err(|error| {
            Failure::input(
                error.to_string(),
                "`retrograde simulate isolated` shows what the model covers",
            )
        })?;
        let bodies = found.draws.thinned(KEPT);
        let checked = checks(&base, &found.conditions, &bodies, args.seed)?;
        Ok((found, bodies, checked))
    })?;
    bar.finish_and_clear();
    let point = nearest(&bodies);
    let posterior = posterior(args, &trials, origin, &found, &bodies, point);
    say_table(&found, work.screen);
    say_checks(&checked, work.screen);
    let (figure, shown) =
        work.install(|| figure(&base, &checked, &bodies, args.seed, &posterior))?;
    let prior = work.install(|| {
        of_prior(
            &base,
            &found.conditions,
            OF_PRIOR,
            FIGURE_STEP_MM,
            args.seed,
        )
    })?;
    // Use all digits, as among the samples.
    let fitted = with_body(&base, &parts(&bodies[point]));
    let model = model_file::write(&fitted, Some(&posterior));
    let mut files = vec![
        ("model.toml", model.into_bytes()),
        ("posterior.svg", figure.into_bytes()),
    ];
    let of_draws = draws::files(&found, &prior, origin.name());
    files.extend(of_draws.map_err(Failure::file(&args.out))?);
    for (name, bytes) in &files {
        work.file(name, bytes)?;
    }
    work.screen.say(&format!(
        "seed {}, {} draws\n{}",
        args.seed,
        found.draws.count(),
        tables(&found)
    ));
    let files = work.say_files();
    work.screen.say(&format!(
        "origin of the displacements: {}",
        origin.meaning()
    ));
    say_verdict(&found, work.screen);
    Ok(json!({
        "origin": origin.name(),
        "reliable": posterior.reliable,
        "reasons": posterior.reasons,
        "doubts": posterior.doubts,
        "chi_square": posterior.chi_square,
        "degrees": posterior.degrees,
        "seed": args.seed,
        "draws": found.draws.count(),
        "step_mm": found.step_mm,
        "table_error": found.table_error,
        "unknowns": rows(&found),
        "conditions": checked.iter().map(condition).collect::<Vec<_>>(),
        "bands": shown.iter().map(band).collect::<Vec<_>>(),
        "sources": posterior.source,
        "files": files,
    }))
}

/// Says which displacements are used, and which are left out.
fn say_sources(trials: &[Trials], uncertainty_mm: Option<f64>, screen: &mut Screen<'_>) {
    for one in trials {
        screen.say(&format!(
            "{}: {} displacements, {} left out; {}",
            one.path.display(),
            one.measured.len(),
            one.left_out.len(),
            one.origin.meaning()
        ));
        if let (Some(stated), Some(given)) = (one.overridden_mm, uncertainty_mm) {
            screen.say(&format!(
                "  uncertainty: {given} mm of `--uncertainty-mm`, not the {stated} mm of its plan"
            ));
        }
        for left in &one.left_out {
            screen.say(&format!("  left out: {}: {}", left.place, left.why));
        }
    }
}

/// Index of the body nearest to the medians, in coordinates with a standard normal prior, each scaled by its spread.
fn nearest(bodies: &[Point]) -> usize {
    let scale: Vec<(f64, f64)> = (0..UNKNOWNS)
        .map(|unknown| {
            let mut all: Vec<f64> = bodies.iter().map(|point| point[unknown]).collect();
            all.sort_by(f64::total_cmp);
            let span = |part| calibration::fit::quantile(&all, part);
            (span(0.5), (span(0.95) - span(0.05)).max(f64::MIN_POSITIVE))
        })
        .collect();
    let far = |point: &Point| -> f64 {
        let parts = point.iter().zip(&scale);
        parts
            .map(|(z, (middle, span))| ((z - middle) / span).powi(2))
            .sum()
    };
    (0..bodies.len())
        .min_by(|one, other| far(&bodies[*one]).total_cmp(&far(&bodies[*other])))
        .unwrap_or(0)
}

fn posterior(
    args: &FitArgs,
    trials: &[Trials],
    origin: Origin,
    found: &Fit,
    bodies: &[Point],
    point: usize,
) -> Posterior {
    let settings = Settings::full(args.seed);
    let worst = |of: fn(&calibration::sampler::Mixing) -> f64, pick: fn(f64, f64) -> f64| {
        found.mixing.iter().map(of).reduce(pick).unwrap_or(f64::NAN)
    };
    let source = |one: &Trials| {
        let used = one.measured.iter().map(|measured| measured.place.clone());
        let path = one.path.display().to_string();
        SourceRecord::new(&path, one.origin, &one.files, used.collect(), &one.left_out)
    };
    Posterior {
        format: FORMAT,
        origin,
        made_by: concat!("retrograde fit ", env!("CARGO_PKG_VERSION")).to_owned(),
        seed: args.seed,
        sampler: format!(
            "{}; {} draws; {}",
            settings.effort.text(),
            found.draws.count(),
            tables(found)
        ),
        r_hat: worst(|one| one.r_hat, f64::max),
        ess: worst(|one| one.ess.min(one.tail_ess), f64::min),
        reliable: found.verdict.is_reliable(),
        reasons: sentences(found, true),
        doubts: sentences(found, false),
        chi_square: found.verdict.chi_square.map(|one| one.value),
        degrees: found.verdict.chi_square.map(|one| one.degrees),
        point: point + 1,
        parameters: unknowns()
            .iter()
            .map(|unknown| unknown.key.to_owned())
            .collect(),
        samples: bodies
            .iter()
            .map(|body| Values::at(body).0.to_vec())
            .collect(),
        source: trials.iter().map(source).collect(),
    }
}

/// The reasons that make it unreliable, or those that raise a doubt.
fn sentences(found: &Fit, unreliable: bool) -> Vec<String> {
    let all = found.verdict.reasons.iter();
    all.filter(|reason| reason.unreliable == unreliable)
        .map(|reason| reason.sentence.clone())
        .collect()
}

fn tables(found: &Fit) -> String {
    format!(
        "model tabulated with a step of {} mm, off by {:.2} standard deviations at most",
        found.step_mm, found.table_error
    )
}

/// A number with as many digits as fit into the table.
fn short(value: f64) -> String {
    match value.abs() {
        0.0 => "0".to_owned(),
        small if small < 0.01 => format!("{value:.5}"),
        small if small < 1.0 => format!("{value:.3}"),
        small if small < 10.0 => format!("{value:.2}"),
        _ => format!("{value:.1}"),
    }
}

fn say_table(found: &Fit, screen: &mut Screen<'_>) {
    screen.say("  parameter            prior 5-95 %    posterior 5 / 50 / 95 %  R-hat   ESS  tail");
    for (place, unknown) in unknowns().iter().enumerate() {
        let prior = |part| short(unknown.shape.quantile(part));
        let at = |part| short(found.quantile(place, part));
        screen.say(&format!(
            "  {:<19} {:>7} {:>6}  {:>7} {:>7} {:>7} {:>6.3} {:>5.0} {:>5.0}",
            unknown.key,
            prior(0.05),
            prior(0.95),
            at(0.05),
            at(0.5),
            at(0.95),
            found.mixing[place].r_hat,
            found.mixing[place].ess,
            found.mixing[place].tail_ess,
        ));
    }
}

fn say_checks(checked: &[Check], screen: &mut Screen<'_>) {
    screen.say("  condition                   a/mm   n mean/mm posterior 5-95 %    p  p scatter");
    for check in checked {
        let condition = &check.condition;
        let name = format!("{}, {}", condition.case.kind, condition.lubrication);
        let scatter = check
            .p_scatter
            .map_or("-".to_owned(), |p| format!("{p:.3}"));
        screen.say(&format!(
            "  {name:<27} {:>4} {:>3} {:>7.2} {:>7.2} {:>7.2} {:>6.3}  {scatter:>8}",
            condition.case.indentation_mm,
            condition.repeats,
            condition.mean_mm,
            check.replicated_mm.low,
            check.replicated_mm.high,
            check.p_mean,
        ));
    }
    let (count, rare) = (checked.len(), suspicious(checked.len()));
    let off = (checked.iter()).filter(|check| check.p_mean < rare).count();
    if off > 0 {
        screen.say(&format!(
            "  hardly explained, p below 0.05 over {count} conditions: {off} of them. The model is wrong there, or the readings are"
        ));
    }
    let scattered = (checked.iter())
        .filter(|check| check.p_scatter.is_some_and(|p| p < rare))
        .count();
    if scattered > 0 {
        screen.say(&format!(
            "  repeats scatter more than the stated uncertainty allows, p below 0.05 over {count} conditions: {scattered} of them.\n  \
             State a larger uncertainty"
        ));
    }
}

/// Says what speaks against the posterior, and what to do.
fn say_verdict(found: &Fit, screen: &mut Screen<'_>) {
    let verdict = &found.verdict;
    if let Some(one) = verdict.chi_square {
        screen.say(&format!(
            "chi-square without tau: {:.1} at {} degrees of freedom, p {:.3}",
            one.value, one.degrees, one.p
        ));
    }
    for reason in &verdict.reasons {
        let word = if reason.unreliable {
            "WARNING: NOT RELIABLE"
        } else {
            "DOUBTED"
        };
        let text = format!("{word}: {}.", reason.sentence);
        screen.say(&wrapped(&text, 80, "  ").join("\n"));
    }
    if verdict.says(Verdict::Mixing) {
        screen.say(
            "Try another --seed; give displacements that tell more, such as isolated passes\nboth ways.",
        );
    }
    if verdict.says(Verdict::Table) {
        screen.say(
            "Is the stated uncertainty smaller than what the model's ripple of some\nhundredths of a millimetre allows?",
        );
    }
}

fn rows(found: &Fit) -> Vec<Value> {
    let row = |(place, unknown): (usize, &calibration::prior::Unknown)| {
        json!({
            "parameter": unknown.key,
            "unit": unknown.unit,
            "prior_5": unknown.shape.quantile(0.05),
            "prior_95": unknown.shape.quantile(0.95),
            "prior_because": unknown.because,
            "posterior_5": found.quantile(place, 0.05),
            "posterior_50": found.quantile(place, 0.5),
            "posterior_95": found.quantile(place, 0.95),
            "r_hat": found.mixing[place].r_hat,
            "ess": found.mixing[place].ess,
            "tail_ess": found.mixing[place].tail_ess,
        })
    };
    unknowns().iter().enumerate().map(row).collect()
}

fn condition(check: &Check) -> Value {
    let condition = &check.condition;
    json!({
        "kind": condition.case.kind.to_string(),
        "lubrication": condition.lubrication.to_string(),
        "indentation_mm": condition.case.indentation_mm,
        "repeats": condition.repeats,
        "mean_mm": condition.mean_mm,
        "uncertainty_mm": condition.uncertainty_mm,
        "posterior_5_mm": check.replicated_mm.low,
        "posterior_95_mm": check.replicated_mm.high,
        "p": check.p_mean,
        "p_scatter": check.p_scatter,
    })
}

fn band(band: &Band) -> Value {
    json!({
        "kind": band.case.kind.to_string(),
        "indentation_mm": band.case.indentation_mm,
        "model_5_mm": band.model_mm.low,
        "model_50_mm": band.model_mm.median,
        "model_95_mm": band.model_mm.high,
        "with_discrepancy_5_mm": band.with_discrepancy_mm.low,
        "with_discrepancy_95_mm": band.with_discrepancy_mm.high,
    })
}

/// Draws the figure. Returns the bands that it shows.
fn figure(
    base: &Model,
    checked: &[Check],
    bodies: &[Point],
    seed: u64,
    posterior: &Posterior,
) -> Result<(String, Vec<Band>), Failure> {
    let cases = || checked.iter().map(|one| one.condition.case);
    let mut kinds: Vec<Kind> = cases().map(|case| case.kind).collect();
    kinds.dedup();
    let deepest = cases().map(|case| case.indentation_mm).fold(0.0, f64::max);
    let greatest_mm = (deepest * 1.1).min(base.design()?.half_gap_mm());
    let case = |kind: Kind, place: usize| Case {
        kind,
        indentation_mm: greatest_mm * place as f64 / PLACES as f64,
    };
    let cases: Vec<Case> = (kinds.iter())
        .flat_map(|kind| (1..=PLACES).map(|place| case(*kind, place)))
        .collect();
    let shown = bands(base, bodies, &cases, FIGURE_STEP_MM, seed)?;
    let svg = charts::posterior(model_file::fitted_name(posterior), &shown, checked)
        .map_err(Own::from)?;
    Ok((svg, shown))
}

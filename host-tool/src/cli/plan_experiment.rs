//! `plan-experiment`: finds the next trials that tell most about the body, and compares them with the paper's
//! procedure.

use std::path::PathBuf;

use calibration::belief::{Belief, LEAST_SAMPLES};
use calibration::design::{Effort, Estimate};
use calibration::observation::{Kind, Lubrication};
use calibration::prior::{Point, Values, unknowns};
use calibration::tabulated::STEP_MM;
use clap::{Args, ValueEnum};
use lab::operations::failure::Failure;
use locomotion::paper::INDENTATIONS_MM;
use report::figures::ModelName;
use report::science::charts::trial_plan::trial_plan;
use report::science::posterior::Posterior;
use report::science::trial_plan::{self, Asked, Series, TrialPlan};
use report::science::{model_file, table, values};
use serde_json::{Value, json};

use crate::cli::calculation::Calculation;
use crate::cli::failure::Own;
use crate::cli::model::ModelArgs;
use crate::cli::screen::Screen;

/// Knowledge of the body before the plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Begin {
    /// Nothing but the prior.
    Prior,
    /// The posterior in the file of `--model`.
    Posterior,
}

/// Kinds of trial that may be planned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
pub enum Measured {
    /// Net displacement of a run.
    Net,
    /// An isolated pass from head to tail.
    AntegradePass,
    /// An isolated pass from tail to head.
    ReturningPass,
    /// The first stroke of a run, and the first way back, each by itself.
    Stroke,
}

/// The wall that trials may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Wall {
    /// Without soap.
    Dry,
    /// With soapy water.
    Lubricated,
}

/// Arguments of `plan-experiment`.
#[derive(Debug, Args)]
pub struct PlanExperimentArgs {
    /// Standard deviation of one displacement in mm: reading and repetition.
    #[arg(long, value_name = "MM")]
    pub uncertainty_mm: f64,
    /// Trials to choose, 1 to 40.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u16).range(1..=40))]
    pub trials: u16,
    /// Displacements of each trial, 1 to 1000: repeats of one condition.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=1000))]
    pub repeats: u16,
    /// Kinds of trial that may be planned; by default all.
    #[arg(long, value_enum, value_delimiter = ',', value_name = "KIND")]
    pub kinds: Vec<Measured>,
    /// Cycles of a run whose net displacement is measured.
    #[arg(long, value_name = "N", default_value_t = trial_plan::PAPER_CYCLES, value_parser = clap::value_parser!(u16).range(1..=100))]
    pub cycles: u16,
    /// Indentations that may be set, in mm; by default the paper's five.
    #[arg(long, value_name = "LIST")]
    pub indentations_mm: Option<values::Values>,
    /// Walls that may be had; by default both. The model gives both the same displacement, and takes what it gets wrong as independent.
    #[arg(long, value_enum, value_delimiter = ',', value_name = "WALL")]
    pub lubrication: Vec<Wall>,
    /// Knowledge to begin with: by default the posterior in the file of `--model`, or else the prior.
    #[arg(long, value_enum, value_name = "WHAT")]
    pub from: Option<Begin>,
    /// Histories over which gains are averaged, 16 to 4096: four times as many halve the errors, in four times the time.
    #[arg(long, value_name = "N", default_value_t = HISTORIES, value_parser = clap::value_parser!(u16).range(16..=4096))]
    pub histories: u16,
    /// Seed of everything: the same seed makes the same bytes.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub seed: u64,
    /// Folder of the files; files of the same names are replaced.
    #[arg(long, value_name = "DIR", default_value = "retrograde-plan")]
    pub out: PathBuf,
    /// Number of threads, by default one per core. The result does not depend on it.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    pub threads: Option<u16>,
    /// The model: design and rig, and its posterior.
    #[command(flatten)]
    pub model: ModelArgs,
}

/// Default number of histories.
const HISTORIES: u16 = Effort::FULL.histories as u16;
/// Smallest standard error of a trial's mean, mm: the model itself ripples by some hundredths of a millimetre.
const LEAST_ERROR_MM: f64 = 0.02;
/// Largest number of indentations.
const MOST_INDENTATIONS: usize = 20;

fn input(why: String, help: &str) -> Failure {
    Failure::input(why, help.to_owned())
}

impl PlanExperimentArgs {
    /// Checks the arguments and returns the request.
    fn asked(&self) -> Result<Asked, Failure> {
        let u = self.uncertainty_mm;
        if !(u.is_finite() && u > 0.0) {
            return Err(input(
                format!("an uncertainty of {u} mm: no measurement is exact"),
                "`--uncertainty-mm MM` above 0: the standard deviation of one displacement, of reading and repetition together",
            ));
        }
        let error_mm = u / f64::from(self.repeats).sqrt();
        if error_mm < LEAST_ERROR_MM {
            return Err(input(
                format!(
                    "{} displacements to {u} mm are known to {error_mm:.4} mm: the model ripples by more than that",
                    self.repeats
                ),
                "keep the uncertainty over the root of the repeats at 0.02 mm or more",
            ));
        }
        let indentations_mm = match &self.indentations_mm {
            Some(values) => values.0.clone(),
            None => INDENTATIONS_MM.to_vec(),
        };
        if indentations_mm.len() > MOST_INDENTATIONS {
            return Err(input(
                format!("{} indentations", indentations_mm.len()),
                "give 20 at most: near ones tell the same",
            ));
        }
        for (place, mm) in indentations_mm.iter().enumerate() {
            if *mm <= 0.0 {
                return Err(input(
                    format!("an indentation of {mm} mm does not reach the wall"),
                    "`--indentations-mm` takes numbers above 0, for example 1:5:1",
                ));
            }
            if indentations_mm[..place].contains(mm) {
                return Err(input(
                    format!("the indentation {mm} mm is there twice"),
                    "give each once: a trial can be chosen again anyway",
                ));
            }
        }
        let asked = |kind| self.kinds.is_empty() || self.kinds.contains(&kind);
        let (net, stroke) = (
            Kind::Net {
                cycles: self.cycles,
            },
            |number| Kind::Stroke { number },
        );
        let kinds = [
            (Measured::Net, net),
            (Measured::AntegradePass, Kind::AntegradePass),
            (Measured::ReturningPass, Kind::ReturningPass),
            (Measured::Stroke, stroke(1)),
            (Measured::Stroke, stroke(2)),
        ];
        let walls = [
            (Wall::Dry, Lubrication::Dry),
            (Wall::Lubricated, Lubrication::Lubricated),
        ];
        Ok(Asked {
            walls: (walls.into_iter())
                .filter(|(name, _)| self.lubrication.is_empty() || self.lubrication.contains(name))
                .map(|(_, wall)| wall)
                .collect(),
            kinds: (kinds.into_iter())
                .filter(|(name, _)| asked(*name))
                .map(|(_, kind)| kind)
                .collect(),
            indentations_mm,
            trials: self.trials.into(),
            repeats: self.repeats.into(),
            uncertainty_mm: u,
            effort: Effort {
                histories: self.histories.into(),
                ..Effort::FULL
            },
            seed: self.seed,
        })
    }

    /// The posterior to begin with; none means the prior.
    fn posterior(&self) -> Result<Option<Posterior>, Failure> {
        let file = self.model.posterior()?;
        match (self.from, file) {
            (Some(Begin::Prior), _) => Ok(None),
            (_, Some(posterior)) => Ok(Some(posterior)),
            (None, None) if !self.model.has_file() => Ok(None),
            (_, None) => Err(input(
                match self.from {
                    Some(_) if !self.model.has_file() => {
                        "--from posterior without a file".to_owned()
                    }
                    _ => "the file of --model has no [posterior]".to_owned(),
                },
                "`--model FILE` with a file that `retrograde fit` wrote; or `--from prior`, which takes design and rig from the file and the body from the prior",
            )),
        }
    }
}

/// The belief that the samples of a file represent.
fn smoothed(posterior: &Posterior) -> Result<Belief, Failure> {
    let mut points: Vec<Point> = vec![];
    for (number, sample) in (1..).zip(&posterior.samples) {
        let mut values = Values([0.0; _]);
        values.0.copy_from_slice(sample);
        let point = values.point();
        let outside = unknowns()
            .iter()
            .zip(point)
            .position(|(_, z)| !z.is_finite());
        if let Some(place) = outside {
            return Err(input(
                format!(
                    "[posterior]: sample {number}: {} = {} is not within its prior",
                    unknowns()[place].key,
                    sample[place]
                ),
                "was the file changed? fit again with this version",
            ));
        }
        points.push(point);
    }
    Belief::smoothed(&points).ok_or_else(|| {
        input(
            format!(
                "[posterior]: its {} samples are no distribution: fewer than {LEAST_SAMPLES}, or alike",
                points.len()
            ),
            "`retrograde fit` writes 200; fit again",
        )
    })
}

/// Plans and writes the results.
pub(crate) fn plan_experiment(
    args: &PlanExperimentArgs,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let asked = args.asked()?;
    let base = args.model.model()?;
    let posterior = args.posterior()?;
    if let Some(unknown) = (unknowns().iter()).find(|unknown| args.model.names(unknown.key)) {
        return Err(input(
            format!("{} is set, and is what trials are to find", unknown.key),
            "leave its `--set` out",
        ));
    }
    let belief = match &posterior {
        None => Belief::Prior,
        Some(posterior) => smoothed(posterior)?,
    };
    let origin = origin(&base, posterior.as_ref());
    let mut work = Calculation::new(&args.out, args.threads, screen)?;
    let plan = work.install(|| trial_plan::plan(&base, &belief, &asked))?;
    let plan = plan.ok_or_else(|| {
        input(
            "the model covers hardly any of these bodies".to_owned(),
            "`retrograde simulate isolated` shows what it covers",
        )
    })?;
    work.screen.say(&format!("from: {origin}"));
    say(&mut work, &plan, &asked);
    let rows = plan.rows(asked.uncertainty_mm);
    work.csv("plan-experiment.csv", &rows, &origin)?;
    let empty = trial_plan::empty(&plan.series[0], asked.uncertainty_mm);
    let name = "displacements.csv";
    let bytes = table::csv(&empty).map_err(Failure::file(&args.out.join(name)))?;
    work.file(name, &bytes)?;
    let figure = ModelName {
        short: match &posterior {
            None => "model from its prior, not validated against a rig".to_owned(),
            Some(posterior) => model_file::fitted_name(posterior).short,
        },
        full: format!(
            "{origin}; {} displacements to {} mm; seed {}, {} histories of {} draws",
            plan.series[0].displacements(),
            asked.uncertainty_mm,
            asked.seed,
            asked.effort.histories,
            asked.effort.draws,
        ),
    };
    work.file(
        "plan.svg",
        trial_plan(figure, &plan).map_err(Own::from)?.as_bytes(),
    )?;
    let files = work.say_files();
    if !plan.is_resolved() {
        work.screen.say(
            "WARNING: NOT RELIABLE. These trials are too exact for the number of draws: the gains may be off by 0.1 nats \
             and more. State a larger uncertainty.",
        );
    }
    Ok(json!({
        "origin": origin,
        "unit": "nats",
        "seed": asked.seed,
        "histories": asked.effort.histories,
        "resolved": plan.is_resolved(),
        "table_error_mm": plan.table_error_mm,
        "trials": rows,
        "series": plan.series.iter().map(series).collect::<Vec<_>>(),
        "widths": widths(&plan),
        "files": files,
    }))
}

/// Source of the numbers, for the files.
fn origin(base: &locomotion::model::Model, posterior: Option<&Posterior>) -> String {
    let from = match posterior {
        None => "body from the prior".to_owned(),
        Some(posterior) => format!(
            "body from a posterior of origin {}{}",
            posterior.origin,
            posterior.verdict()
        ),
    };
    // The file's own body does not matter: each body of the belief replaces it.
    format!("model {}, {from}, not validated against a rig", base.name)
}

fn with_error(estimate: &Estimate) -> String {
    format!("{:>6.2} +- {:.2}", estimate.mean, estimate.error)
}

fn say(work: &mut Calculation<'_, '_>, plan: &TrialPlan, asked: &Asked) {
    let each = match asked.repeats {
        1 => "1 displacement".to_owned(),
        repeats => format!("{repeats} displacements"),
    };
    work.screen.say(&format!(
        "{} candidates of {each} to {} mm, seed {}\n\
         model tabulated with a step of {STEP_MM} mm, off by {:.2} mm at most\n  \
         trial  kind and wall                a/mm     gain/nats      sum/nats  ties",
        plan.candidates.len(),
        asked.uncertainty_mm,
        asked.seed,
        plan.table_error_mm,
    ));
    let [recommended, others @ ..] = &plan.series;
    for (place, planned) in recommended.trials.iter().enumerate() {
        let trial_plan::Condition { case, lubrication } = planned.condition;
        work.screen.say(&format!(
            "  {:>5}  {:<27} {:>5}  {:>12}  {:>12}  {:>4}",
            place + 1,
            format!("{}, {lubrication}", case.kind),
            case.indentation_mm,
            with_error(&recommended.judged.gains[place]),
            with_error(&recommended.judged.sums[place]),
            plan.ties(place).len(),
        ));
    }
    for other in others {
        work.screen.say(&format!(
            "  {:<14} {:>4} displacements                    {:>12}",
            other.name,
            other.displacements(),
            with_error(&other.sum()),
        ));
    }
    work.screen.say(
        "  A gain is what is expected to be learnt of the body after the trials\n  \
         before, in nats (1 nat = 1.44 bits), +- its standard error. Ties: other\n  \
         candidates that tell as much, within two of them; plan-experiment.csv\n  \
         names them.\n\
           5 to 95 % spans a factor of  before recommended  paper, as many  paper, whole",
    );
    for (place, unknown) in unknowns().iter().enumerate() {
        let factor = |estimate: Estimate| format!("{:.2}", estimate.mean.exp());
        let after = |series: &Series| factor(series.judged.after[place]);
        work.screen.say(&format!(
            "  {:<27} {:>7} {:>11} {:>15} {:>13}",
            unknown.key,
            factor(recommended.judged.before[place]),
            after(&plan.series[0]),
            after(&plan.series[1]),
            after(&plan.series[2]),
        ));
    }
}

fn series(one: &Series) -> Value {
    json!({
        "series": one.name,
        "displacements": one.displacements(),
        "sum_nats": one.sum().mean,
        "sum_error_nats": one.sum().error,
        "correction_nats": one.judged.correction,
    })
}

/// Expected logarithm of the ratio of the 95 % to the 5 % quantile, for each unknown.
fn widths(plan: &TrialPlan) -> Vec<Value> {
    let [recommended, as_many, all] = &plan.series;
    let estimate = |one: Estimate| json!({ "mean": one.mean, "error": one.error });
    let row = |(place, unknown): (usize, &calibration::prior::Unknown)| {
        json!({
            "parameter": unknown.key,
            "quantity": "ln(q95/q5)",
            "before": estimate(recommended.judged.before[place]),
            "recommended": estimate(recommended.judged.after[place]),
            "paper_as_many": estimate(as_many.judged.after[place]),
            "paper_whole": estimate(all.judged.after[place]),
        })
    };
    unknowns().iter().enumerate().map(row).collect()
}

//! `design --optimise`: finds the designs with the largest displacement for their length within limits, and compares
//! one design with them.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::{Args, ValueEnum};
use lab::campaign::chance::Chance;
use lab::operations::failure::Failure;
use locomotion::beam::Validation;
use locomotion::kinematics::Design;
use locomotion::model::Model;
use report::figures::ModelName;
use report::science::design::{LEAST_ALPHA_DEG, PAPER_INDENTATION_MM};
use report::science::optimise::bodies::{Bodies, Care, Per};
use report::science::optimise::bounds::holding_back;
use report::science::optimise::limits::Limits;
use report::science::optimise::search::{self, FREE, Proposal};
use report::science::optimise::{self, DesignRow};
use report::science::posterior::Posterior;
use report::science::{charts, model_file};
use serde_json::{Value, json};

use crate::cli::calculation::Calculation;
use crate::cli::failure::Own;
use crate::cli::screen::Screen;

/// The unit of a displacement.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum Goal {
    /// Displacement of one wave, there and back.
    Wave,
    /// The same, divided by the number of crescents.
    Crescent,
}

/// Arguments of `design --optimise`.
#[derive(Debug, Args)]
#[command(next_help_heading = "Search for designs (with --optimise)")]
pub struct OptimiseArgs {
    /// Search the designs that go farthest for their length within the limits below, and compare this design with them.
    #[arg(long, conflicts_with_all = ["svg", "map", "force"])]
    pub optimise: bool,
    /// Unit that the displacement is compared by.
    #[arg(long, value_enum, default_value = "wave", requires = "optimise")]
    pub per: Goal,
    /// Overall length at rest in mm, at most.
    #[arg(long, value_name = "MM", default_value_t = 42.0, requires = "optimise")]
    pub most_length_mm: f64,
    /// Width in mm to which the thread has to fold it. The wave has to push it back then, so a capsule's 13 mm are too
    /// narrow for the rig; the default is what 21 mm of thread make of the paper's design.
    #[arg(
        long,
        value_name = "MM",
        default_value_t = 15.77,
        requires = "optimise"
    )]
    pub folded_width_mm: f64,
    /// Thread in mm for that, at most.
    #[arg(long, value_name = "MM", default_value_t = 23.0, requires = "optimise")]
    pub most_thread_mm: f64,
    /// Distance between crescents in mm when it is folded or under the wave, at least: room for both sides, 0.8 mm each.
    #[arg(long, value_name = "MM", default_value_t = 1.6, requires = "optimise")]
    pub least_spacing_mm: f64,
    /// Force of the wave on one wing in N, at most; by the beam model, which is not validated against a rig.
    #[arg(long, value_name = "N", default_value_t = 0.55, requires = "optimise")]
    pub most_force_n: f64,
    /// Core over width c/W, at least: no model here knows when a core bends, and the paper found 0.2.
    #[arg(
        long,
        value_name = "RATIO",
        default_value_t = 0.2,
        requires = "optimise"
    )]
    pub least_core_ratio: f64,
    /// Seed of the search.
    #[arg(long, value_name = "N", default_value_t = 1, requires = "optimise")]
    pub seed: u64,
    /// Designs to try, 100 to 100000.
    #[arg(long, value_name = "N", default_value_t = 3000, requires = "optimise",
        value_parser = clap::value_parser!(u32).range(100..=100_000))]
    pub tries: u32,
    /// Folder of optimise.csv and optimise.svg; files of these names are replaced.
    #[arg(
        long,
        value_name = "DIR",
        default_value = "retrograde-science",
        requires = "optimise"
    )]
    pub out: PathBuf,
    /// Number of threads, by default one per core. The result does not depend on it.
    #[arg(long, value_name = "N", requires = "optimise", value_parser = clap::value_parser!(u16).range(1..=256))]
    pub threads: Option<u16>,
}

/// Largest number of the front's designs in the table, beside the farthest that is no longer than the compared one.
const LISTED: usize = 20;
/// Rounds after the first third of the tries. Each searches closer to the best designs.
const ROUNDS: u32 = 8;
/// Distance of a proposal from its parents in the first and in the last round, as a share of the range.
const REACH: (f64, f64) = (0.25, 0.01);

/// Searches and writes the results.
pub(crate) fn optimise(
    args: &OptimiseArgs,
    (model, posterior): (&Model, Option<&Posterior>),
    design: Design<f64>,
    indentation_mm: Option<f64>,
    least_alpha_deg: Option<f64>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let limits = Limits {
        length_mm: args.most_length_mm,
        folded_width_mm: args.folded_width_mm,
        thread_mm: args.most_thread_mm,
        spacing_mm: args.least_spacing_mm,
        force_n: args.most_force_n,
        indentation_mm: indentation_mm.unwrap_or(PAPER_INDENTATION_MM),
        least_alpha_deg: least_alpha_deg.unwrap_or(LEAST_ALPHA_DEG),
        least_core_ratio: args.least_core_ratio,
        folded: model.folded(Some(0.0))?,
    };
    limits.check(design.width_mm())?;
    let per = match args.per {
        Goal::Wave => Per::Wave,
        Goal::Crescent => Per::Crescent,
    };
    let bodies = match posterior {
        Some(posterior) => Bodies::of_posterior(model, posterior)?,
        None => Bodies::of_prior(model)?,
    };
    let mut work = Calculation::new(&args.out, args.threads, screen)?;
    // Check the compared design first: what the model does not cover must be refused before the search.
    let name = if design == Design::paper_printed() {
        "paper"
    } else {
        "yours"
    };
    let needs = limits.needs(&design)?;
    let given = Proposal::given(design, &limits)?;
    let own = DesignRow::of(name, &design, &limits, needs, &bodies, per)?;
    let search = Search {
        limits,
        width_mm: design.width_mm(),
        known: given.unit,
        known_mm: needs.length_mm,
        bodies: &bodies,
        per,
    };
    let found = search.run(args.seed, args.tries, &work)?;
    let candidates = work.map(&found, |proposal| {
        let needs = limits.needs(&proposal.design)?;
        let mut row = DesignRow::of("front", &proposal.design, &limits, needs, &bodies, per)?;
        row.at_bound = holding_back(proposal, &limits, &bodies, per)?.join(", ");
        Ok(row)
    })?;
    let rows = optimise::ranked(candidates, own);
    let which = match posterior {
        Some(posterior) => posterior.what(),
        None => format!(
            "{} bodies that agree with the words on the rig",
            bodies.count()
        ),
    };
    let origin = format!(
        "{}, {which}; force: {}",
        model_file::short_origin(model, posterior),
        Validation::NotAgainstARig
    );
    let verdict = verdict(&rows, per, bodies.fitted());
    say(&mut work, &rows, &verdict, &origin, &limits);
    work.csv("optimise.csv", &rows, &origin)?;
    let short = match posterior {
        Some(posterior) => model_file::fitted_name(posterior).short,
        None => format!(
            "model: {} bodies that fit the words, no measurement",
            bodies.count()
        ),
    };
    let figure = ModelName {
        short,
        full: format!(
            "{}; {origin}; seed {}, {} tries; {verdict}",
            model_file::origin(model, posterior),
            args.seed,
            args.tries
        ),
    };
    work.file(
        "optimise.svg",
        charts::designs(figure, per, &rows)
            .map_err(Own::from)?
            .as_bytes(),
    )?;
    let files = work.say_files();
    Ok(json!({ "origin": origin, "designs": rows, "verdict": verdict, "files": files }))
}

/// One search.
struct Search<'a> {
    limits: Limits,
    width_mm: f64,
    /// The compared design: one proposal in ten starts from it.
    known: [f64; FREE],
    /// Length of the compared design, mm.
    known_mm: f64,
    bodies: &'a Bodies,
    per: Per,
}

/// A proposal within the limits with its length and displacement, or the limits that it breaks.
type Tried = Result<(Proposal, (f64, f64)), Vec<&'static str>>;

impl Search<'_> {
    /// Searches. Returns the proposals on the front, from short to long.
    fn run(
        &self,
        seed: u64,
        tries: u32,
        work: &Calculation<'_, '_>,
    ) -> Result<Vec<Proposal>, Failure> {
        let mut chance = Chance::new(seed);
        let mut best: Vec<(Proposal, (f64, f64))> = vec![];
        let mut broken = BTreeMap::new();
        let first = tries / 3;
        let mut left = tries - first;
        let mut units = search::hypercube(first as usize, &mut chance);
        for round in 0..=ROUNDS {
            for tried in work.map(&units, |unit| self.tried(*unit))? {
                match tried {
                    Ok(kept) => best.push(kept),
                    Err(limits) => {
                        for limit in limits {
                            *broken.entry(limit).or_insert(0_u32) += 1;
                        }
                    }
                }
            }
            let places: Vec<_> = best.iter().map(|(_, place)| *place).collect();
            best = search::front(&places)
                .into_iter()
                .map(|index| best[index].clone())
                .collect();
            if best.is_empty() {
                return Err(nothing(first, &broken));
            }
            if round == ROUNDS {
                break;
            }
            let count = left / (ROUNDS - round);
            left -= count;
            let part = f64::from(round) / f64::from(ROUNDS - 1);
            let reach = REACH.0 * (REACH.1 / REACH.0).powf(part);
            units = (0..count)
                .map(|_| {
                    let mut parent = |known: usize| match chance.below(10) {
                        number if number < known => self.known,
                        _ => best[chance.below(best.len())].0.unit,
                    };
                    let (one, other): ([f64; FREE], [f64; FREE]) = (parent(1), parent(0));
                    search::child(one, other, reach, &mut chance)
                })
                .collect();
        }
        let all: Vec<usize> = (0..best.len()).collect();
        let mut kept = search::thinned(&all, LISTED);
        // Keep the farthest design that is no longer than the compared one: it is the alternative to it.
        let short = best.partition_point(|(_, (length_mm, _))| *length_mm <= self.known_mm);
        if let Some(index) = short.checked_sub(1)
            && !kept.contains(&index)
        {
            kept.push(index);
        }
        Ok(kept
            .into_iter()
            .map(|index| best[index].0.clone())
            .collect())
    }

    fn tried(&self, unit: [f64; FREE]) -> Result<Tried, locomotion::range::OutOfRange> {
        let proposal = Proposal::new(unit, self.width_mm, &self.limits)?;
        let design = &proposal.design;
        let needs = self.limits.needs(design)?;
        let broken = self.limits.broken(design, &needs);
        if !broken.is_empty() {
            return Ok(Err(broken));
        }
        let a = self.limits.indentation_mm;
        let each_mm = self
            .bodies
            .displacements_mm(design, a, self.per, Care::Searched)?;
        let place = (needs.length_mm, optimise::mean(&each_mm));
        Ok(Ok((proposal, place)))
    }
}

/// Failure if no design keeps the limits. Names the limits that were broken most.
fn nothing(tried: u32, broken: &BTreeMap<&'static str, u32>) -> Failure {
    let mut most: Vec<_> = broken.iter().collect();
    most.sort_by_key(|(_, count)| std::cmp::Reverse(**count));
    let limits: Vec<_> = most
        .iter()
        .map(|(limit, count)| format!("--{limit} by {count}"))
        .collect();
    Failure::input(
        format!(
            "none of {tried} designs keeps the limits; broken: {}",
            limits.join(", ")
        ),
        "loosen the first of them, or try more designs: `--tries N`",
    )
}

/// Compares the compared design with the front, in a sentence.
fn verdict(rows: &[DesignRow], per: Per, fitted: bool) -> String {
    let Some((own, front)) = rows.split_last() else {
        return String::new();
    };
    let name = match own.design {
        "paper" => "the paper's design",
        _ => "your design",
    };
    let breaks = if own.breaks.is_empty() {
        String::new()
    } else {
        format!("{name} does not keep: {}; ", own.breaks)
    };
    match optimise::instead_of(front, own) {
        Some(row) if own.dominated_by > 0 => format!(
            "{breaks}no longer than {name} and no less far: {} of {} designs; the farthest of them goes {:.2} instead of \
             {:.2} mm {}, farther with {:.0} % of the {}",
            own.dominated_by,
            front.len(),
            row.displacement_mm,
            own.displacement_mm,
            per.text(),
            100.0 * row.share_beating(own),
            if fitted {
                "posterior's bodies"
            } else {
                "bodies"
            },
        ),
        _ => format!(
            "{breaks}none of the {} designs is as short as {name} and goes as far",
            front.len()
        ),
    }
}

fn say(
    work: &mut Calculation<'_, '_>,
    rows: &[DesignRow],
    verdict: &str,
    origin: &str,
    limits: &Limits,
) {
    let fitted = rows.iter().any(|row| row.posterior_5_mm.is_some());
    let band = if fitted {
        "posterior band/mm"
    } else {
        "prior band/mm"
    };
    let width = band.len();
    work.screen.say(&format!(
        "designs at a = {} mm, folded to {} mm: {origin}\n  \
         design  alpha/deg  beta/deg   c/W   m  length/mm  thread/mm  folded/mm  psi/mm  force/N  displacement/mm  {band}  farther in  at bound",
        limits.indentation_mm, limits.folded_width_mm
    ));
    for row in rows {
        let beats = row
            .beats
            .map_or("-".to_owned(), |share| format!("{:.0} %", 100.0 * share));
        work.screen.say(&format!(
            "  {:<6} {:>10.2} {:>9.2} {:>5.3} {:>3} {:>10.2} {:>10.2} {:>10.1} {:>7.2} {:>8.2} {:>16.2}  {:>width$} {beats:>11}  {}",
            row.design,
            row.alpha_deg,
            row.beta_deg,
            row.core_ratio,
            row.crescents,
            row.length_mm,
            row.thread_mm,
            row.folded_mm,
            row.spacing_mm,
            row.force_n,
            row.displacement_mm,
            match row.band_mm() {
                (Some(low), Some(high)) => format!("{low:.2} to {high:.2}"),
                _ => "-".to_owned(),
            },
            row.at_bound,
        ));
    }
    work.screen.say(&format!("  {verdict}"));
}

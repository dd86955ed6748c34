//! `simulate`: the paper's series and free sweeps, without a machine.

use std::path::PathBuf;

use calibration::observation::Kind;
use clap::{Args, Subcommand};
use lab::operations::failure::Failure;
use locomotion::comparison;
use locomotion::folded::Contact;
use locomotion::model::Model;
use locomotion::paper::INDENTATIONS_MM;
use locomotion::parameter::Label;
use locomotion::prior::Words;
use report::figures::ModelName;
use report::science::bands::{self, Bands};
use report::science::posterior::Posterior;
use report::science::series::{self, TubeCase, TubeRow, TubeRun};
use report::science::values::Values;
use report::science::{charts, model_file, snapshots, table};
use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::cli::calculation::Calculation;
use crate::cli::failure::Own;
use crate::cli::model::ModelArgs;
use crate::cli::screen::Screen;
use crate::cli::{compare, crescent};

/// Arguments of `simulate`.
#[derive(Debug, Args)]
pub struct SimulateArgs {
    /// The simulation.
    #[command(subcommand)]
    pub what: Simulation,
    /// Folder of the CSV and SVG files. Files of the same names are replaced: the same command makes the same bytes.
    #[arg(
        long,
        global = true,
        value_name = "DIR",
        default_value = "retrograde-science"
    )]
    pub out: PathBuf,
    /// Number of threads, by default one per core. The result does not depend on it.
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    pub threads: Option<u16>,
    /// The model and its parameters.
    #[command(flatten)]
    pub model: ModelArgs,
}

/// Subcommands of `simulate`.
#[derive(Debug, Subcommand)]
pub enum Simulation {
    /// The tube at friction 0.08 to 0.20 and 7000 Pa (Fig. 4a).
    Friction,
    /// The tube at 3000 to 7000 Pa and friction 0.15 (Fig. 4b).
    Pressure,
    /// The rig at five indentations, with and without lubrication (Fig. 7).
    Roller,
    /// One roller pass in each direction over a fresh body.
    Isolated,
    /// The folded body beside the unfolded one (Fig. 8).
    Fold {
        /// Indentation of the rollers in mm.
        #[arg(long, value_name = "MM", default_value_t = 5.05)]
        indentation_mm: f64,
        /// Thread drawn in, in mm; that of the model by default: 21.
        #[arg(long, value_name = "MM")]
        thread_mm: Option<f64>,
    },
    /// The crescent as a beam: force, least alpha, displacement over the thread drawn in, with a band.
    Crescent {
        /// Seed of the draws.
        #[arg(long, value_name = "N", default_value_t = 1)]
        seed: u64,
        /// Draws of the uncertain inputs, 20 to 20000; about one in thirty does as the paper says and is kept.
        #[arg(long, value_name = "N", default_value_t = 2000, value_parser = clap::value_parser!(u32).range(20..=20_000))]
        draws: u32,
    },
    /// Wall and body at several moments (Fig. 6).
    Snapshots,
    /// All of these but the crescent.
    All,
    /// Every friction with every pressure (the tube) or every indentation (the rig).
    Sweep {
        /// Friction coefficients: `0.08,0.20` or `LOW:HIGH:STEP`.
        #[arg(
            long,
            value_name = "LIST",
            default_value = "0.15",
            allow_hyphen_values = true
        )]
        frictions: Values,
        /// Pressures in Pa.
        #[arg(
            long,
            value_name = "LIST",
            allow_hyphen_values = true,
            required_unless_present = "indentations_mm",
            conflicts_with = "indentations_mm"
        )]
        pressures_pa: Option<Values>,
        /// Indentations in mm.
        #[arg(long, value_name = "LIST", allow_hyphen_values = true)]
        indentations_mm: Option<Values>,
    },
    /// Print the paper's sentences beside the models' values, and how probable it is that each is met (Markdown).
    Compare {
        /// Bodies of the prior that are asked, 20 to 4000.
        #[arg(long, value_name = "N", default_value_t = comparison::BODIES, value_parser = clap::value_parser!(u16).range(20..=4000))]
        bodies: u16,
    },
}

/// Largest number of runs in a sweep.
const MOST_RUNS: usize = 100_000;

/// Shared by all series of one `simulate` command.
struct Session<'a, 'b> {
    model: Model,
    /// The posterior that the model was drawn from, if it was fitted to trials.
    posterior: Option<Posterior>,
    work: Calculation<'a, 'b>,
    series: Map<String, Value>,
}

pub(crate) fn simulate(args: &SimulateArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    if let Simulation::Crescent { seed, draws } = args.what {
        let mut work = Calculation::new(&args.out, args.threads, screen)?;
        return crescent::crescent(&mut work, &args.model, seed, draws);
    }
    let model = args.model.model()?;
    if let Simulation::Compare { bodies } = args.what {
        let posterior = args.model.posterior()?;
        let mut work = Calculation::new(&args.out, args.threads, screen)?;
        return compare::compare(&mut work, &model, posterior.as_ref(), bodies);
    }
    let varied = matches!(
        args.what,
        Simulation::Friction | Simulation::Roller | Simulation::Sweep { .. }
    );
    if varied && args.model.names("body.friction") {
        return Err(Failure::input(
            "--set body.friction would do nothing: this series has frictions of its own",
            "leave it out, or `retrograde simulate sweep --frictions LIST`",
        ));
    }
    let mut session = Session {
        model,
        posterior: args.model.posterior()?,
        work: Calculation::new(&args.out, args.threads, screen)?,
        series: Map::new(),
    };
    match &args.what {
        Simulation::Friction => session.friction()?,
        Simulation::Pressure => session.pressure()?,
        Simulation::Roller => session.roller()?,
        Simulation::Isolated => session.isolated()?,
        Simulation::Fold {
            indentation_mm,
            thread_mm,
        } => session.fold(*indentation_mm, *thread_mm)?,
        Simulation::Snapshots => session.snapshots()?,
        Simulation::All => {
            session.friction()?;
            session.pressure()?;
            session.roller()?;
            session.isolated()?;
            session.fold(INDENTATIONS_MM[4], None)?;
            session.snapshots()?;
        }
        Simulation::Sweep {
            frictions,
            pressures_pa: Some(Values(pressures)),
            ..
        } => session.sweep_tube(&frictions.0, pressures)?,
        Simulation::Sweep {
            frictions,
            indentations_mm,
            ..
        } => {
            let indentations = indentations_mm.as_ref().map_or(&[][..], |list| &list.0);
            session.sweep_roller(&frictions.0, indentations)?;
        }
        Simulation::Crescent { .. } | Simulation::Compare { .. } => {} // returned above
    }
    session.csv("parameters.csv", &table::parameters(&model))?;
    let text = model_file::write(&model, session.posterior.as_ref());
    session.work.file("model.toml", text.as_bytes())?;
    let files = session.work.say_files();
    let origin = model_file::origin(&model, session.posterior.as_ref());
    session.work.screen.say(&origin);
    Ok(json!({
        "origin": origin,
        "series": session.series,
        "files": files,
    }))
}

impl Session<'_, '_> {
    fn friction(&mut self) -> Result<(), Failure> {
        let params = self.model.tube()?;
        let runs = self.work.map(&series::friction_cases(), |case| {
            series::tube_run(params, case)
        })?;
        let bands = self.tube_bands(&[series::FRICTION_SERIES_PA])?;
        let rows = series::tube_rows(&runs, &bands, |_| None);
        self.title("friction series, tube, 7000 Pa", "tube");
        self.tube_table(&rows);
        self.work
            .screen
            .say("  the paper's text: about 14 mm at each friction, one sentence for 25 values");
        self.keep("friction", &rows);
        self.csv("friction.csv", &rows)?;
        self.csv("friction-time.csv", &series::tube_moments(&runs))?;
        let svg = charts::friction(self.name(), &runs, &rows).map_err(Own::from)?;
        self.work.file("friction.svg", svg.as_bytes())
    }

    fn pressure(&mut self) -> Result<(), Failure> {
        let params = self.model.tube()?;
        let cases = series::pressure_cases(params.body.friction);
        let runs = self
            .work
            .map(&cases, |case| series::tube_run(params, case))?;
        let bands = self.tube_bands(
            &cases
                .iter()
                .map(|case| case.pressure_pa)
                .collect::<Vec<_>>(),
        )?;
        let rows = series::tube_rows(&runs, &bands, series::paper_on_pressure_mm);
        self.title(
            &format!("pressure series, tube, friction {}", params.body.friction),
            "tube",
        );
        self.tube_table(&rows);
        self.keep("pressure", &rows);
        self.csv("pressure.csv", &rows)?;
        self.csv("pressure-time.csv", &series::tube_moments(&runs))?;
        let svg = charts::pressure(self.name(), &runs, &rows).map_err(Own::from)?;
        self.work.file("pressure.svg", svg.as_bytes())
    }

    fn roller(&mut self) -> Result<(), Failure> {
        let (rig, pipe) = (self.model.rig()?, self.model.tube()?);
        let bands = self.rig_bands(&INDENTATIONS_MM)?;
        let rows = self.work.map(&series::lubrication_cases(), |case| {
            series::lubricated_run(rig, &bands, case)
        })?;
        // Fig. 7 shows the simulation at both ends of the friction range beside the experiment.
        let ends: Vec<TubeCase> = series::LUBRICATION
            .iter()
            .flat_map(|(_, friction)| series::pressure_cases(*friction))
            .collect();
        let tube_bands = self.tube_bands(&locomotion::paper::pressures_pa().collect::<Vec<_>>())?;
        let ends = self.work.map(&ends, |case| series::tube_run(pipe, case))?;
        let tube = series::tube_rows(&ends, &tube_bands, series::paper_on_pressure_mm);
        self.title(
            &format!(
                "roller series, {} cycles of {} mm",
                rig.cycles, rig.stroke_mm
            ),
            "rig",
        );
        let header = format!(
            "  lubrication  friction   a/mm  displacement/mm  {} band/mm",
            self.band_name()
        );
        self.work.screen.say(&header);
        for row in &rows {
            self.work.screen.say(&format!(
                "  {:<11} {:>9} {:>6} {:>16.1}  {:>13}",
                row.lubrication,
                row.friction,
                row.indentation_mm,
                row.displacement_mm,
                bands::text(row.band_mm().0, row.band_mm().1)
            ));
        }
        self.say_what_a_band_is(Words::Rig);
        self.keep("roller", &rows);
        self.csv("roller.csv", &rows)?;
        let svg = charts::comparison(self.name(), &rows, &tube).map_err(Own::from)?;
        self.work.file("roller.svg", svg.as_bytes())
    }

    fn isolated(&mut self) -> Result<(), Failure> {
        let rig = self.model.rig()?;
        let rows = self
            .work
            .map(&INDENTATIONS_MM, |a| series::isolated_run(rig, *a))?;
        self.title("isolated passes, rig, fresh body", "rig");
        self.work.screen.say("  a/mm  antegrade/mm  returning/mm");
        for row in &rows {
            self.work.screen.say(&format!(
                "  {:>4} {:>13.2} {:>13.2}",
                row.indentation_mm, row.antegrade_mm, row.returning_mm
            ));
        }
        self.keep("isolated", &rows);
        self.csv("isolated.csv", &rows)?;
        let svg = charts::isolated(self.name(), &rows).map_err(Own::from)?;
        self.work.file("isolated.svg", svg.as_bytes())
    }

    fn fold(&mut self, indentation_mm: f64, thread_mm: Option<f64>) -> Result<(), Failure> {
        let test = series::fold_test(&self.model, indentation_mm, thread_mm)?;
        let band = self.rig_bands(&[indentation_mm])?;
        self.title(
            &format!(
                "fold test, rig, {} cycles of {} mm",
                test.params.cycles, test.params.stroke_mm
            ),
            "folded",
        );
        let contact = match test.contact {
            Contact::Untouched => "the wave does not touch it".to_owned(),
            Contact::Overridden { slope } => {
                format!("the rollers ride over it (slope {slope:.3})")
            }
            Contact::Pushed { slope, ahead_mm } => {
                format!("pushed {ahead_mm:.3} mm ahead of the rollers (slope {slope:.3})")
            }
        };
        let (folded, unfolded) = test
            .course
            .last()
            .map_or((0.0, 0.0), |row| (row.folded_mm, row.unfolded_mm));
        let band = band.of_case(indentation_mm);
        let of = self.band_name();
        self.work.screen.say(&format!(
            "  folded to {:.3} mm, a = {indentation_mm} mm: {contact}\n  \
             displacement: folded {folded:.1} mm (the fold is declared, not worked out), unfolded {unfolded:.1} mm \
             ({of} band {} mm)",
            test.params.width_mm,
            bands::text(band.map(|band| band.low), band.map(|band| band.high)),
        ));
        self.series.insert(
            "fold".to_owned(),
            json!({
                "indentation_mm": indentation_mm,
                "folded_width_mm": test.params.width_mm,
                "contact": contact,
                "folded_mm": folded,
                "unfolded_mm": unfolded,
                format!("unfolded_{of}_5_mm"): band.map(|band| band.low),
                format!("unfolded_{of}_95_mm"): band.map(|band| band.high),
            }),
        );
        self.csv("fold.csv", &test.course)?;
        let svg = charts::fold(self.name(), &test).map_err(Own::from)?;
        self.work.file("fold.svg", svg.as_bytes())
    }

    fn snapshots(&mut self) -> Result<(), Failure> {
        let strips = [
            snapshots::tube(&self.model)?,
            snapshots::roller(&self.model)?,
        ];
        let rows: Vec<_> = strips.iter().flat_map(snapshots::Strip::rows).collect();
        self.csv("snapshots.csv", &rows)?;
        let origin = model_file::origin(&self.model, self.posterior.as_ref());
        for strip in &strips {
            let name = format!("snapshots-{}.svg", strip.model);
            self.work.file(&name, strip.svg(&origin).as_bytes())?;
        }
        Ok(())
    }

    fn sweep_tube(&mut self, frictions: &[f64], pressures_pa: &[f64]) -> Result<(), Failure> {
        few_enough(frictions, pressures_pa)?;
        let params = self.model.tube()?;
        let cases = series::tube_cases(frictions, pressures_pa);
        // Keep only the end of each run: the full courses of all runs would fill the memory.
        let end = |case: &TubeCase| {
            let run = series::tube_run(params, case)?;
            let course = run.course.last().copied().into_iter().collect();
            Ok(TubeRun { course, ..run })
        };
        let runs = self.work.map(&cases, end)?;
        let bands = self.tube_bands(pressures_pa)?;
        let rows: Vec<TubeRow> = series::tube_rows(&runs, &bands, |_| None);
        let points: Vec<_> = rows
            .iter()
            .map(|row| (row.friction, row.pressure_pa, row.displacement_mm))
            .collect();
        self.title(&format!("sweep of {} runs, tube", rows.len()), "tube");
        self.keep("sweep", &rows);
        self.csv("sweep-tube.csv", &rows)?;
        let (x, y) = ("peristaltic pressure / Pa", "displacement / mm");
        let svg = charts::sweep(self.name(), x, y, &points, &bands).map_err(Own::from)?;
        self.work.file("sweep-tube.svg", svg.as_bytes())
    }

    fn sweep_roller(&mut self, frictions: &[f64], indentations: &[f64]) -> Result<(), Failure> {
        few_enough(frictions, indentations)?;
        let rig = self.model.rig()?;
        let cases = series::roller_cases(frictions, indentations);
        // Run first: it refuses an indentation that the rig does not cover, before any band is calculated.
        let rows = self
            .work
            .map(&cases, |case| series::roller_run(rig, case))?;
        let bands = self.rig_bands(indentations)?;
        let rows: Vec<_> = rows.into_iter().map(|row| row.with_band(&bands)).collect();
        let points: Vec<_> = rows
            .iter()
            .map(|row| (row.friction, row.indentation_mm, row.displacement_mm))
            .collect();
        self.title(&format!("sweep of {} runs, rig", rows.len()), "rig");
        self.keep("sweep", &rows);
        self.csv("sweep-roller.csv", &rows)?;
        let (x, y) = ("peristaltic indentation / mm", "displacement / mm");
        let svg = charts::sweep(self.name(), x, y, &points, &bands).map_err(Own::from)?;
        self.work.file("sweep-roller.svg", svg.as_bytes())
    }

    fn name(&self) -> ModelName {
        model_file::name(&self.model, self.posterior.as_ref())
    }

    fn short_origin(&self) -> String {
        model_file::short_origin(&self.model, self.posterior.as_ref())
    }

    /// Name of the distribution that the rig's bands show.
    fn band_name(&self) -> &'static str {
        if self.posterior.is_some() {
            "posterior"
        } else {
            "prior"
        }
    }

    /// Bands on the rig for each indentation: of the posterior if there is one, otherwise of the prior.
    fn rig_bands(&self, indentations_mm: &[f64]) -> Result<Bands, Failure> {
        let Some(cases) = bands::few(indentations_mm) else {
            return Ok(Bands::default());
        };
        let Some(posterior) = &self.posterior else {
            let bodies = bands::bodies(&self.model, Words::Rig);
            let values = self.work.map(&bodies, |body| bands::on_rig(body, &cases))?;
            return Ok(Bands::of(&cases, &values));
        };
        let bodies = bands::fitted(&self.model, posterior);
        let values = self.work.map(&bodies, |body| bands::on_rig(body, &cases))?;
        let cycles = u16::try_from(self.model.rig()?.cycles).unwrap_or(u16::MAX);
        let passes = Kind::Net { cycles }.discrepancies();
        let deviations_mm: Vec<f64> = posterior
            .discrepancies_mm()
            .iter()
            .map(|tau| passes * tau)
            .collect();
        Ok(Bands::with_discrepancy(&cases, &values, &deviations_mm))
    }

    /// Prior bands in the tube for each pressure. Trials on the rig say nothing about the tube's wall.
    fn tube_bands(&self, pressures_pa: &[f64]) -> Result<Bands, Failure> {
        let Some(cases) = bands::few(pressures_pa) else {
            return Ok(Bands::default());
        };
        let bodies = bands::bodies(&self.model, Words::Tube);
        let values = self
            .work
            .map(&bodies, |body| bands::in_tube(body, &cases))?;
        Ok(Bands::of(&cases, &values))
    }

    /// Prints a heading that names the model and its calibrated, assumed and changed parameters, as far as they act in
    /// this world.
    fn title(&mut self, title: &str, world: &str) {
        let names = |label| {
            let all: Vec<_> = self
                .model
                .parameters()
                .filter(|parameter| parameter.label == label)
                .map(|parameter| parameter.name)
                .filter(|name| {
                    ["design", "body", world].contains(&name.split('.').next().unwrap_or_default())
                })
                .collect();
            all.join(", ")
        };
        let mut text = format!("{title}: {}", self.short_origin());
        for (word, label) in [
            ("calibrated", Label::Calibrated),
            ("assumed", Label::Assumed),
            ("changed", Label::Given),
        ] {
            let names = names(label);
            if !names.is_empty() {
                text += &format!("; {word}: {names}");
            }
        }
        self.work.screen.say(&text);
    }

    fn tube_table(&mut self, rows: &[TubeRow]) {
        self.work
            .screen
            .say("  friction  pressure/Pa  tail/mm  head/mm  prior band/mm  the paper's text/mm");
        for row in rows {
            let paper = row
                .paper_about_mm
                .map_or("-".to_owned(), |mm| format!("about {mm}"));
            self.work.screen.say(&format!(
                "  {:>8} {:>12} {:>8.1} {:>8.1}  {:>13}  {paper:>19}",
                row.friction,
                row.pressure_pa,
                row.displacement_mm,
                row.head_displacement_mm,
                bands::text(row.prior_5_mm, row.prior_95_mm),
            ));
        }
        self.say_what_a_band_is(Words::Tube);
    }

    fn say_what_a_band_is(&mut self, words: Words) {
        let text = match (&self.posterior, words) {
            (Some(posterior), Words::Rig) => format!(
                "posterior band, with the model's discrepancy: {}",
                posterior.meaning()
            ),
            _ => format!("prior band: {}", bands::meaning(words)),
        };
        self.work.screen.say(&format!("  {text}"));
    }

    fn keep(&mut self, name: &str, rows: &[impl Serialize]) {
        self.series.insert(name.to_owned(), json!(rows));
    }

    fn csv(&mut self, name: &str, rows: &[impl Serialize]) -> Result<(), Failure> {
        self.work.csv(name, rows, &self.short_origin())
    }
}

fn few_enough(one: &[f64], other: &[f64]) -> Result<(), Failure> {
    let runs = one.len() * other.len();
    if runs <= MOST_RUNS {
        return Ok(());
    }
    Err(Failure::input(
        format!("{runs} runs are too many"),
        format!("at most {MOST_RUNS}: take larger steps"),
    ))
}

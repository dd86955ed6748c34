//! `simulate`: the paper's series and free sweeps, without a machine.

use std::fs;
use std::io::Write;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use clap::{Args, Subcommand};
use client::plain;
use lab::operations::failure::Failure;
use lab::operations::output::{ERASE, Stream};
use lab::trials::progress;
use locomotion::folded::Contact;
use locomotion::model::{Model, Setting};
use locomotion::paper::INDENTATIONS_MM;
use locomotion::parameter::Label;
use locomotion::range::OutOfRange;
use report::figures::{FigureError, ModelName};
use report::science::series::{self, Axis, Case, SweepRow, TubeRow, TubeRun, Variant, Workers};
use report::science::values::Values;
use report::science::{charts, model_file, snapshots, table};
use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::cli::failure;
use crate::cli::model::{ModelArgs, key_and_value};
use crate::cli::screen::Screen;

/// Arguments of `simulate`.
#[derive(Debug, Args)]
pub struct SimulateArgs {
    /// The simulation.
    #[command(subcommand)]
    pub what: Simulation,
    /// Folder of the CSV and SVG files. Files of the same names are replaced: the same command writes the same bytes.
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
    /// The folded body beside the unfolded one (Fig. 8).
    Fold {
        /// Indentation of the rollers in mm.
        #[arg(long, value_name = "MM", default_value_t = 5.05)]
        indentation_mm: f64,
        /// Thread drawn in, in mm; that of the model by default: 21.
        #[arg(long, value_name = "MM")]
        thread_mm: Option<f64>,
    },
    /// Wall and body at several moments (Fig. 6).
    Snapshots,
    /// All of these.
    All,
    /// Every combination of parameters with every pressure (the tube) or every indentation (the rig).
    Sweep(SweepArgs),
}

/// Arguments of `simulate sweep`.
#[derive(Debug, Args)]
pub struct SweepArgs {
    /// Friction coefficients: `0.08,0.20` or `LOW:HIGH:STEP`; that of the model by default.
    #[arg(long, value_name = "LIST", allow_hyphen_values = true)]
    frictions: Option<Values>,
    /// A parameter of the model and its values, as in `--vary body.coupling=0.1:0.3:0.05`; may be repeated.
    #[arg(long, value_name = "KEY=LIST", allow_hyphen_values = true, value_parser = axis_of)]
    vary: Vec<Axis>,
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
}

fn axis_of(text: &str) -> Result<Axis, String> {
    let (setting, list) = key_and_value(text)?;
    let Values(values) = list.parse()?;
    Ok(Axis { setting, values })
}

/// Largest number of runs in a sweep.
const MOST_RUNS: usize = 100_000;
/// Maximum printed rows of a sweep; its file has all of them.
const MOST_PRINTED: usize = 200;
const FRICTION: &str = "body.friction";

/// Shared by all series of one `simulate` command.
struct Session<'a, 'b> {
    args: &'a SimulateArgs,
    model: Model,
    workers: Workers,
    screen: &'a mut Screen<'b>,
    files: Vec<String>,
    series: Map<String, Value>,
}

pub(crate) fn simulate(args: &SimulateArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let model = args.model.model()?;
    let workers = Workers::new(args.threads).map_err(|error| {
        Failure::input(format!("no threads: {error}"), "use fewer: `--threads 1`")
    })?;
    let mut session = Session {
        args,
        model,
        workers,
        screen,
        files: vec![],
        series: Map::new(),
    };
    match &args.what {
        Simulation::Friction => session.friction()?,
        Simulation::Pressure => session.pressure()?,
        Simulation::Roller => session.roller()?,
        Simulation::Fold {
            indentation_mm,
            thread_mm,
        } => session.fold(*indentation_mm, *thread_mm)?,
        Simulation::Snapshots => session.snapshots()?,
        Simulation::All => {
            session.friction()?;
            session.pressure()?;
            session.roller()?;
            session.fold(INDENTATIONS_MM[4], None)?;
            session.snapshots()?;
        }
        Simulation::Sweep(sweep) => session.sweep(sweep)?,
    }
    session.csv("parameters.csv", &table::parameters(&model))?;
    session.file("model.toml", &model_file::write(&model))?;
    session.say(&format!("files: {}", session.files.join(", ")));
    let origin = model_file::origin(&model);
    session.say(&origin);
    Ok(json!({
        "origin": origin,
        "series": session.series,
        "files": session.files,
    }))
}

impl Session<'_, '_> {
    fn friction(&mut self) -> Result<(), Failure> {
        self.own_values(FRICTION)?;
        let runs = self.tube_runs(&series::friction_cases())?;
        let rows: Vec<_> = runs.iter().map(|run| run.end).collect();
        self.title("friction series, tube, 7000 Pa", "tube");
        self.tube_table("friction", &runs, &rows)?;
        self.say("  the paper's text: about 14 mm at each friction, one sentence for 25 values");
        let svg = charts::friction(self.name(), &runs, &rows);
        self.keep("friction", &rows, svg)
    }

    fn pressure(&mut self) -> Result<(), Failure> {
        let friction = self.model.tube()?.body.friction;
        let runs = self.tube_runs(&series::pressure_cases(friction))?;
        let rows = series::beside_the_paper(&runs);
        self.title(
            &format!("pressure series, tube, friction {friction}"),
            "tube",
        );
        self.tube_table("pressure", &runs, &rows)?;
        let svg = charts::pressure(self.name(), &runs, &rows);
        self.keep("pressure", &rows, svg)
    }

    fn tube_runs(&self, cases: &[Case]) -> Result<Vec<TubeRun>, Failure> {
        let params = self.model.tube()?;
        self.map(cases, |case| series::tube_run(params, case))
    }

    /// Prints the ends of runs in the tube, and writes the runs over time.
    fn tube_table(
        &mut self,
        name: &str,
        runs: &[TubeRun],
        rows: &[TubeRow],
    ) -> Result<(), Failure> {
        self.say("  friction  pressure/Pa  tail/mm  head/mm  the paper's text/mm");
        for row in rows {
            let about = |mm| format!("about {mm}");
            let paper = row.paper_about_mm.map_or("-".to_owned(), about);
            let (tail, head) = (row.displacement_mm, row.head_displacement_mm);
            self.say(&format!(
                "  {:>8} {:>12} {tail:>8.1} {head:>8.1}  {paper:>19}",
                row.friction, row.pressure_pa
            ));
        }
        let courses: Vec<_> = runs.iter().flat_map(|run| &run.course).collect();
        self.csv(&format!("{name}-time.csv"), &courses)
    }

    fn roller(&mut self) -> Result<(), Failure> {
        self.own_values(FRICTION)?;
        let rig = self.model.rig()?;
        let rows = self.map(&series::lubrication_cases(), |case| {
            series::roller_run(rig, case)
        })?;
        // Fig. 7 shows the simulation at both ends of the friction range beside the experiment.
        let ends = series::LUBRICATION.map(|(_, friction)| series::pressure_cases(friction));
        let tube = series::beside_the_paper(&self.tube_runs(&ends.concat())?);
        let (cycles, stroke_mm) = (rig.cycles, rig.stroke_mm);
        self.title(
            &format!("roller series, {cycles} cycles of {stroke_mm} mm"),
            "rig",
        );
        self.say("  lubrication  friction   a/mm  displacement/mm");
        for row in &rows {
            self.say(&format!(
                "  {:<11} {:>9} {:>6} {:>16.1}",
                row.lubrication, row.friction, row.indentation_mm, row.displacement_mm,
            ));
        }
        let svg = charts::comparison(self.name(), &rows, &tube);
        self.keep("roller", &rows, svg)
    }

    fn fold(&mut self, indentation_mm: f64, thread_mm: Option<f64>) -> Result<(), Failure> {
        let test = series::fold_test(&self.model, indentation_mm, thread_mm)?;
        let (cycles, stroke_mm) = (test.params.cycles, test.params.stroke_mm);
        self.title(
            &format!("fold test, rig, {cycles} cycles of {stroke_mm} mm"),
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
        let end = test.course.last();
        let (folded, unfolded) = end.map_or((0.0, 0.0), |row| (row.folded_mm, row.unfolded_mm));
        self.say(&format!(
            "  folded to {:.3} mm, a = {indentation_mm} mm: {contact}\n  \
             displacement: folded {folded:.1} mm (the fold is declared, not worked out), unfolded {unfolded:.1} mm",
            test.params.width_mm,
        ));
        let svg = charts::fold(self.name(), &test);
        self.keep("fold", &test.course, svg)?;
        self.series.insert(
            "fold".to_owned(),
            json!({
                "indentation_mm": indentation_mm,
                "folded_width_mm": test.params.width_mm,
                "contact": contact,
                "folded_mm": folded,
                "unfolded_mm": unfolded,
            }),
        );
        Ok(())
    }

    fn snapshots(&mut self) -> Result<(), Failure> {
        let strips = [
            snapshots::tube(&self.model)?,
            snapshots::roller(&self.model)?,
        ];
        let rows: Vec<_> = strips.iter().flat_map(snapshots::Strip::rows).collect();
        self.csv("snapshots.csv", &rows)?;
        let origin = model_file::origin(&self.model);
        for strip in &strips {
            let name = format!("snapshots-{}.svg", strip.model);
            self.file(&name, &strip.svg(&origin))?;
        }
        Ok(())
    }

    fn sweep(&mut self, args: &SweepArgs) -> Result<(), Failure> {
        let axes = self.axes(args)?;
        let (in_tube, loads) = match (&args.pressures_pa, &args.indentations_mm) {
            (Some(Values(pressures)), _) => (true, &pressures[..]),
            (None, indentations) => (false, indentations.as_ref().map_or(&[][..], |all| &all.0)),
        };
        let counts = axes.iter().map(|axis| axis.values.len());
        let runs = counts.fold(loads.len(), usize::saturating_mul);
        if runs > MOST_RUNS {
            return Err(Failure::input(
                format!("{runs} runs are too many"),
                format!("at most {MOST_RUNS}: take larger steps"),
            ));
        }
        let variants = series::variants(&self.model, &axes)
            .map_err(|error| self.args.model.failure(&error))?;
        let with_loads = |variant| loads.iter().map(move |load| (variant, *load));
        let cases: Vec<(&Variant, f64)> = variants.iter().flat_map(with_loads).collect();
        if in_tube {
            let rows = self.map(&cases, |((model, axes), load)| {
                let params = model.tube()?;
                let (friction, load) = (params.body.friction, *load);
                let run = series::tube_run(params, &Case { friction, load })?.end;
                Ok(SweepRow::new(axes, load, run.displacement_mm, run))
            })?;
            self.swept("tube", "sweep-tube", "pressure/Pa", &rows)
        } else {
            let rows = self.map(&cases, |((model, axes), load)| {
                let params = model.rig()?;
                let (friction, load) = (params.body.friction, *load);
                let run = series::roller_run(params, &Case { friction, load })?;
                Ok(SweepRow::new(axes, load, run.displacement_mm, run))
            })?;
            self.swept("rig", "sweep-roller", "a/mm", &rows)
        }
    }

    /// The parameters that a sweep varies, each once.
    fn axes(&self, args: &SweepArgs) -> Result<Vec<Axis>, Failure> {
        let friction = Setting::named(FRICTION).zip(args.frictions.clone());
        let friction = friction.map(|(setting, Values(values))| Axis { setting, values });
        let axes: Vec<Axis> = friction.into_iter().chain(args.vary.clone()).collect();
        for (index, Axis { setting, .. }) in axes.iter().enumerate() {
            self.own_values(setting.key)?;
            let keys = [Some(setting.key), setting.other_key()];
            if (axes[..index].iter()).any(|other| keys.contains(&Some(other.setting.key))) {
                return Err(Failure::input(
                    format!("{} is varied twice", setting.key),
                    "leave one of them out",
                ));
            }
        }
        Ok(axes)
    }

    /// Prints and writes the rows of a sweep.
    fn swept<R: Serialize>(
        &mut self,
        world: &str,
        file: &str,
        load: &str,
        rows: &[SweepRow<R>],
    ) -> Result<(), Failure> {
        self.title(&format!("sweep of {} runs, {world}", rows.len()), world);
        let keys = || rows.iter().take(1).flat_map(|row| row.axes.keys());
        let header: String = keys().map(|key| format!(" {key:>12}")).collect();
        self.say(&format!(" {header} {load:>12}  displacement/mm"));
        for row in rows.iter().take(MOST_PRINTED) {
            let cell = |(key, value): (&String, &Value)| {
                format!(" {:>width$}", value.to_string(), width = key.len().max(12))
            };
            let axes: String = row.axes.iter().map(cell).collect();
            self.say(&format!(" {axes} {:>12} {:>16.1}", row.load, row.mm));
        }
        if rows.len() > MOST_PRINTED {
            let all = rows.len();
            self.say(&format!(
                "  these are the first {MOST_PRINTED} of {all} rows"
            ));
        }
        let svg = charts::sweep(self.name(), world == "tube", rows);
        self.keep(file, rows, svg)
    }

    /// Refuses an option for a parameter that the series sets itself.
    fn own_values(&self, key: &str) -> Result<(), Failure> {
        let named = Setting::named(key).is_some_and(|setting| self.args.model.names(setting));
        if named && !matches!(self.args.what, Simulation::All) {
            return Err(Failure::input(
                format!("--set {key} has no effect: this series sets its own values"),
                format!("leave it out, or `retrograde simulate sweep --vary {key}=LIST`"),
            ));
        }
        Ok(())
    }

    fn name(&self) -> ModelName {
        model_file::name(&self.model)
    }

    /// Prints a heading that names the model and its calibrated, assumed and changed parameters, if they matter in this
    /// world.
    fn title(&mut self, title: &str, world: &str) {
        let mut text = format!("{title}: {}", model_file::short_origin(&self.model));
        for (word, label) in [
            ("calibrated", Label::Calibrated),
            ("assumed", Label::Assumed),
            ("changed", Label::Given),
        ] {
            let acts = |name: &&str| {
                let section = name.split('.').next().unwrap_or_default();
                ["design", "body", world].contains(&section)
            };
            let rows = self.model.parameters().filter(|row| row.label == label);
            let names: Vec<_> = rows.map(|row| row.name).filter(acts).collect();
            if !names.is_empty() {
                text += &format!("; {word}: {}", names.join(", "));
            }
        }
        self.say(&text);
    }

    fn say(&mut self, text: &str) {
        self.screen.say(text);
    }

    /// Writes the table and the figure of a series.
    fn keep(
        &mut self,
        name: &str,
        rows: &[impl Serialize],
        svg: Result<String, FigureError>,
    ) -> Result<(), Failure> {
        // A sweep's file states its world.
        let key = name.split('-').next().unwrap_or(name);
        self.series.insert(key.to_owned(), json!(rows));
        self.csv(&format!("{name}.csv"), rows)?;
        let svg = svg.map_err(failure::figure)?;
        self.file(&format!("{name}.svg"), &svg)
    }

    /// Writes rows; the last column is the origin of their values.
    fn csv(&mut self, name: &str, rows: &[impl Serialize]) -> Result<(), Failure> {
        let origin = model_file::short_origin(&self.model);
        let bytes = table::csv_of(rows, &origin).map_err(Failure::file(&self.args.out))?;
        self.file(name, &bytes)
    }

    /// Writes one file, in place of an earlier one, and creates the folder if necessary.
    fn file(&mut self, name: &str, bytes: &(impl AsRef<[u8]> + ?Sized)) -> Result<(), Failure> {
        let path = self.args.out.join(name);
        fs::create_dir_all(&self.args.out).map_err(Failure::file(&self.args.out))?;
        plain::replace(&path, bytes.as_ref()).map_err(Failure::file(&path))?;
        self.files.push(path.display().to_string());
        Ok(())
    }

    /// Calculates all cases in parallel, with a progress bar on a terminal.
    fn map<T: Sync, R: Send>(
        &self,
        cases: &[T],
        work: impl Fn(&T) -> Result<R, OutOfRange> + Sync,
    ) -> Result<Vec<R>, Failure> {
        let (terminal, total) = (self.screen.terminal, cases.len() as u64);
        let (begin, done) = (Instant::now(), AtomicU64::new(0));
        let count = || {
            let done = done.fetch_add(1, Ordering::Relaxed) + 1;
            let remaining_s = begin.elapsed().as_secs() * (total - done) / done;
            let message = format!("{done} of {total} runs, {remaining_s} s left");
            let bar = match done == total {
                true => ERASE.to_owned(),
                false => progress::bar(done, total, &message),
            };
            if terminal {
                let _ = Stream::Err.write_all(bar.as_bytes());
            }
        };
        Ok(self.workers.map(cases, &count, work)?)
    }
}

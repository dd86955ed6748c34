//! `design` and `simulate`: the paper's science, without a machine.

use std::fs;
use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use locomotion::comparison::{self, INDENTATIONS_MM};
use locomotion::folded::Contact;
use locomotion::kinematics::Design;
use locomotion::parameter::{Label, Parameter};
use locomotion::range::{Ends, OutOfRange};
use locomotion::{folded, roller, tube};
use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::cli::failure::Failure;
use crate::cli::screen::Screen;
use crate::science::design::{self, Report};
use crate::science::series::{self, TubeCase, TubeRow, TubeRun, Workers};
use crate::science::values::Values;
use crate::science::{charts, drawing, snapshots, table};

/// Arguments of `design`. All angles are measured from the transverse axis.
#[derive(Debug, Args)]
pub struct DesignArgs {
    /// Overall width W in mm.
    #[arg(
        long,
        value_name = "MM",
        default_value_t = 24.40,
        allow_negative_numbers = true
    )]
    pub width_mm: f64,
    /// Width of the core over the overall width, c/W.
    #[arg(
        long,
        value_name = "RATIO",
        default_value_t = 0.2,
        allow_negative_numbers = true
    )]
    pub core_ratio: f64,
    /// Angle of the short side in degrees.
    #[arg(
        long,
        value_name = "DEG",
        default_value_t = 12.53,
        allow_negative_numbers = true
    )]
    pub alpha_deg: f64,
    /// Angle of the long side in degrees.
    #[arg(
        long,
        value_name = "DEG",
        default_value_t = 33.69,
        allow_negative_numbers = true
    )]
    pub beta_deg: f64,
    /// Use tan alpha = 2/9 and tan beta = 2/3; rounded to two decimals these are the paper's angles.
    #[arg(long, conflicts_with_all = ["alpha_deg", "beta_deg"])]
    pub exact_slopes: bool,
    /// Number m of crescents, 1 to 32.
    #[arg(long, value_name = "M", default_value_t = 9, value_parser = clap::value_parser!(u8).range(1..=32))]
    pub crescents: u8,
    /// Indentation a of the drawings in mm, 0 to (W-c)/2; by default 5.05, or (W-c)/4 if the design is too narrow.
    #[arg(long, value_name = "MM", allow_negative_numbers = true)]
    pub indentation_mm: Option<f64>,
    /// Smallest alpha that the material allows, in degrees; 12.53 worked in the paper.
    #[arg(long, value_name = "DEG", allow_negative_numbers = true)]
    pub least_alpha_deg: Option<f64>,
    /// Draw the structure, unsqueezed and squeezed, to this SVG file.
    #[arg(long, value_name = "FILE")]
    pub svg: Option<PathBuf>,
    /// Draw the shortening over alpha and over beta to this SVG file.
    #[arg(long, value_name = "FILE")]
    pub map: Option<PathBuf>,
}

/// Arguments of `simulate`.
#[derive(Debug, Args)]
pub struct SimulateArgs {
    /// What to simulate.
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
}

/// What to simulate.
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
        #[arg(
            long,
            value_name = "MM",
            default_value_t = 5.05,
            allow_negative_numbers = true
        )]
        indentation_mm: f64,
        /// Thread drawn in, in mm; 21 by default.
        #[arg(long, value_name = "MM", allow_negative_numbers = true)]
        thread_mm: Option<f64>,
    },
    /// Wall and body at several moments (Fig. 6).
    Snapshots,
    /// All of these.
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
    /// Print the paper's sentences beside the models' values (Markdown).
    Compare,
}

/// Most runs of a sweep.
const MOST_RUNS: usize = 100_000;

pub(crate) fn design(args: &DesignArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let ratio = args.core_ratio;
    if !(ratio > 0.0 && ratio < 1.0) {
        return Err(OutOfRange {
            quantity: "c/W",
            value: ratio,
            min: 0.0,
            max: 1.0,
            unit: "",
            ends: Ends::Open,
            because: "the crescents stand between core and wall",
        }
        .into());
    }
    let core_mm = ratio * args.width_mm;
    let design = if args.exact_slopes {
        Design::with_slopes(args.width_mm, core_mm, 2.0 / 9.0, 2.0 / 3.0, args.crescents)
    } else {
        Design::new(
            args.width_mm,
            core_mm,
            args.alpha_deg,
            args.beta_deg,
            args.crescents,
        )
    }?;
    let report = design::report(&design, args.indentation_mm, args.least_alpha_deg)?;
    screen.say(&design_text(&report));
    if let Some(path) = &args.svg {
        let svg = drawing::structure(&design, report.indentation_mm)?;
        write(path, svg.as_bytes())?;
        screen.say(&format!("drawing:  {}", path.display()));
    }
    if let Some(path) = &args.map {
        let svg = charts::maps(&design::maps(&design, args.indentation_mm)?)?;
        write(path, svg.as_bytes())?;
        screen.say(&format!("map:      {}", path.display()));
    }
    Ok(json!({ "design": report, "svg": args.svg, "map": args.map }))
}

fn design_text(report: &Report) -> String {
    let Report {
        width_mm,
        core_mm,
        core_ratio,
        half_gap_mm,
        alpha_deg,
        beta_deg,
        crescents,
        long_side_mm,
        short_side_mm,
        spacing_mm,
        core_length_mm,
        length_mm,
        largest_shortening_mm,
        ..
    } = report;
    let capsule = match report.thread_to_capsule_mm {
        Some(mm) => format!("{mm:.2} mm to the width of a 13 mm capsule"),
        None => "a 13 mm capsule is out of its range".to_owned(),
    };
    let mut text = format!(
        "\
width:    W {width_mm:.3} mm, core c {core_mm:.3} mm (c/W {core_ratio:.3}), h = (W-c)/2 {half_gap_mm:.3} mm
angles:   alpha {alpha_deg:.3} deg, beta {beta_deg:.3} deg to the transverse axis
window:   alpha above {:.0} and below {:.3} deg; beta above {:.3} and below {:.0} deg
sides:    l1 {long_side_mm:.3} mm (Eq. 1), l2 {short_side_mm:.3} mm (Eq. 2)
spacing:  phi {spacing_mm:.3} mm (Eq. 3), {crescents} crescents
length:   core m phi {core_length_mm:.3} mm, overall {length_mm:.3} mm
thread:   {largest_shortening_mm:.2} mm at most, {capsule}

       a      psi       d0        d        L      W-2a  dd0/da  dd0/dalpha  dd0/dbeta
      mm       mm       mm       mm       mm        mm       1      mm/rad     mm/rad
",
        report.alpha_window_deg.0,
        report.alpha_window_deg.1,
        report.beta_window_deg.0,
        report.beta_window_deg.1,
    );
    for row in &report.squeezed {
        text += &format!(
            "{:8.3} {:8.4} {:8.4} {:8.4} {:8.4} {:9.3} {:7.4} {:11.4} {:10.4}\n",
            row.indentation_mm,
            row.spacing_mm,
            row.shortening_per_crescent_mm,
            row.shortening_mm,
            row.length_mm,
            row.width_mm,
            row.slope_by_indentation,
            // Adding zero turns -0 into 0.
            row.slope_by_alpha_mm + 0.0,
            row.slope_by_beta_mm,
        );
    }
    text += "\nthe paper's requirements (section II.A, each \"about\"):\n";
    for rule in &report.rules {
        let verdict = match rule.objection {
            None => "as the paper".to_owned(),
            Some(objection) => format!("{:+.1} %: {objection}", rule.deviation * 100.0),
        };
        text += &format!(
            "  {:<6} {:>8.3} for {:<5} {:<4} {verdict}\n",
            rule.quantity, rule.value, rule.target, rule.unit
        );
    }
    text += &match &report.best_alpha {
        Some(best) => format!(
            "best alpha: {:.3} deg, d = {:.3} mm at a = {:.2} mm: {}\n",
            best.alpha_deg, best.shortening_mm, report.indentation_mm, best.reason
        ),
        None => format!(
            "best alpha: none known for this beta: no alpha below {} deg is known to hold (`--least-alpha-deg`)\n",
            design::LEAST_ALPHA_DEG
        ),
    };
    text += &format!(
        "Eq. (6) at a = {:.2} mm: left less right side {:.3} as printed (its units do not agree), {:.3} repaired; \
         d d0/d alpha is {:.3} mm/rad. Repaired it has no root below alpha = 51.827 deg.",
        report.indentation_mm,
        report.equation_6.printed_residual,
        report.equation_6.repaired_residual,
        report.equation_6.true_derivative_mm,
    );
    text
}

/// What all series of one `simulate` command share.
struct Session<'a, 'b> {
    out: &'a Path,
    workers: Workers,
    screen: &'a mut Screen<'b>,
    files: Vec<PathBuf>,
    series: Map<String, Value>,
}

pub(crate) fn simulate(args: &SimulateArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    if matches!(args.what, Simulation::Compare) {
        return compare(screen);
    }
    let workers = Workers::new(args.threads).map_err(|error| Failure::Input {
        why: format!("no threads: {error}"),
        help: "use fewer: `--threads 1`".to_owned(),
    })?;
    let mut session = Session {
        out: &args.out,
        workers,
        screen,
        files: vec![],
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
        Simulation::Compare => {}
    }
    session.csv("parameters.csv", &table::parameters())?;
    let files = session
        .files
        .iter()
        .map(|path| path.display().to_string())
        .collect::<Vec<_>>();
    session.screen.say(&format!("files: {}", files.join(", ")));
    Ok(json!({ "series": session.series, "files": files }))
}

fn compare(screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let rows = comparison::rows()?;
    if !screen.json {
        let text = comparison::Table(&rows).to_string();
        screen
            .out
            .write_all(text.as_bytes())
            .map_err(|io| Failure::File {
                path: "standard output".into(),
                io,
            })?;
    }
    let rows: Vec<_> = rows
        .iter()
        .map(|row| {
            json!({
                "section": row.section,
                "sentence": row.sentence,
                "quantity": row.quantity,
                "paper": row.paper,
                "model": row.model,
                "unit": row.unit,
                "worth": row.evidence.to_string(),
                "remark": row.remark,
            })
        })
        .collect();
    Ok(json!({ "comparison": rows }))
}

impl Session<'_, '_> {
    fn friction(&mut self) -> Result<(), Failure> {
        let runs = self.map(&series::friction_cases(), series::tube_run)?;
        let rows = series::tube_rows(&runs, series::paper_on_friction_mm);
        self.title("friction series, tube, 7000 Pa", &tube::PARAMETERS);
        self.tube_table(&rows);
        self.keep("friction", &rows);
        self.csv("friction.csv", &rows)?;
        self.csv("friction-time.csv", &series::tube_moments(&runs))?;
        self.file("friction.svg", charts::friction(&runs, &rows)?.as_bytes())
    }

    fn pressure(&mut self) -> Result<(), Failure> {
        let cases = series::pressure_cases(series::PRESSURE_SERIES_FRICTION);
        let runs = self.map(&cases, series::tube_run)?;
        let rows = series::tube_rows(&runs, series::paper_on_pressure_mm);
        self.title("pressure series, tube, friction 0.15", &tube::PARAMETERS);
        self.tube_table(&rows);
        self.keep("pressure", &rows);
        self.csv("pressure.csv", &rows)?;
        self.csv("pressure-time.csv", &series::tube_moments(&runs))?;
        self.file("pressure.svg", charts::pressure(&runs, &rows)?.as_bytes())
    }

    fn roller(&mut self) -> Result<(), Failure> {
        let rows = self.map(&series::lubrication_cases(), series::lubricated_run)?;
        // Fig. 7 shows the simulation at both ends of the friction range beside the experiment.
        let ends: Vec<TubeCase> = series::LUBRICATION
            .iter()
            .flat_map(|(_, friction)| series::pressure_cases(*friction))
            .collect();
        let ends = self.map(&ends, series::tube_run)?;
        let tube = series::tube_rows(&ends, series::paper_on_pressure_mm);
        self.title("roller series, five cycles of 130 mm", &roller::PARAMETERS);
        self.screen
            .say("  lubrication  friction   a/mm  displacement/mm");
        for row in &rows {
            self.screen.say(&format!(
                "  {:<11} {:>9} {:>6} {:>16.6}",
                row.lubrication, row.friction, row.indentation_mm, row.displacement_mm
            ));
        }
        self.keep("roller", &rows);
        self.csv("roller.csv", &rows)?;
        self.file("roller.svg", charts::comparison(&rows, &tube)?.as_bytes())
    }

    fn isolated(&mut self) -> Result<(), Failure> {
        let rows = self.map(&INDENTATIONS_MM, series::isolated_run)?;
        self.title("isolated passes, rig, fresh body", &roller::PARAMETERS);
        self.screen.say("  a/mm  antegrade/mm  returning/mm");
        for row in &rows {
            self.screen.say(&format!(
                "  {:>4} {:>13.3} {:>13.3}",
                row.indentation_mm, row.antegrade_mm, row.returning_mm
            ));
        }
        self.keep("isolated", &rows);
        self.csv("isolated.csv", &rows)?;
        self.file("isolated.svg", charts::isolated(&rows)?.as_bytes())
    }

    fn fold(&mut self, indentation_mm: f64, thread_mm: Option<f64>) -> Result<(), Failure> {
        let test = series::fold_test(indentation_mm, thread_mm)?;
        self.title("fold test, rig, five cycles of 130 mm", &folded::PARAMETERS);
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
        self.screen.say(&format!(
            "  folded to {:.3} mm, a = {indentation_mm} mm: {contact}\n  \
             displacement: folded {folded:.3} mm, unfolded {unfolded:.3} mm",
            test.params.width_mm
        ));
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
        self.csv("fold.csv", &test.course)?;
        self.file("fold.svg", charts::fold(&test)?.as_bytes())
    }

    fn snapshots(&mut self) -> Result<(), Failure> {
        let strips = [snapshots::tube()?, snapshots::roller()?];
        let rows: Vec<_> = strips.iter().flat_map(snapshots::Strip::rows).collect();
        self.csv("snapshots.csv", &rows)?;
        for strip in &strips {
            let name = format!("snapshots-{}.svg", strip.model);
            self.file(&name, strip.svg().as_bytes())?;
        }
        Ok(())
    }

    fn sweep_tube(&mut self, frictions: &[f64], pressures_pa: &[f64]) -> Result<(), Failure> {
        few_enough(frictions, pressures_pa)?;
        let cases = series::tube_cases(frictions, pressures_pa);
        // Only the end of each run is kept: the full courses of all runs would fill the memory.
        let end = |case: &TubeCase| {
            let run = series::tube_run(case)?;
            let course = run.course.last().copied().into_iter().collect();
            Ok(TubeRun { course, ..run })
        };
        let runs = self.map(&cases, end)?;
        let rows: Vec<TubeRow> = series::tube_rows(&runs, |_| None);
        let points: Vec<_> = rows
            .iter()
            .map(|row| (row.friction, row.pressure_pa, row.displacement_mm))
            .collect();
        self.title(
            &format!("sweep of {} runs, tube", rows.len()),
            &tube::PARAMETERS,
        );
        self.keep("sweep", &rows);
        self.csv("sweep-tube.csv", &rows)?;
        let (x, y) = ("peristaltic pressure / Pa", "displacement in 20 s / mm");
        self.file("sweep-tube.svg", charts::sweep(x, y, &points)?.as_bytes())
    }

    fn sweep_roller(&mut self, frictions: &[f64], indentations: &[f64]) -> Result<(), Failure> {
        few_enough(frictions, indentations)?;
        let cases = series::roller_cases(frictions, indentations);
        let rows = self.map(&cases, series::roller_run)?;
        let points: Vec<_> = rows
            .iter()
            .map(|row| (row.friction, row.indentation_mm, row.displacement_mm))
            .collect();
        self.title(
            &format!("sweep of {} runs, rig", rows.len()),
            &roller::PARAMETERS,
        );
        self.keep("sweep", &rows);
        self.csv("sweep-roller.csv", &rows)?;
        let (x, y) = ("peristaltic indentation / mm", "displacement in 40 s / mm");
        self.file("sweep-roller.svg", charts::sweep(x, y, &points)?.as_bytes())
    }

    /// Calculates all cases in parallel, with a progress bar on a terminal.
    fn map<T: Sync, R: Send>(
        &self,
        cases: &[T],
        work: impl Fn(&T) -> Result<R, OutOfRange> + Sync,
    ) -> Result<Vec<R>, Failure> {
        let bar = if self.screen.terminal {
            ProgressBar::new(cases.len() as u64)
        } else {
            ProgressBar::hidden()
        };
        if let Ok(style) =
            ProgressStyle::with_template("  {bar:30} {pos} of {len} runs, {eta} left")
        {
            bar.set_style(style);
        }
        let results = self.workers.map(cases, &|| bar.inc(1), work);
        bar.finish_and_clear();
        Ok(results?)
    }

    /// Prints a heading that names the calibrated and assumed parameters of the model.
    fn title(&mut self, title: &str, parameters: &[Parameter]) {
        let names = |label| {
            let all: Vec<_> = parameters
                .iter()
                .filter(|parameter| parameter.label == label)
                .map(|parameter| parameter.name.rsplit('.').next().unwrap_or_default())
                .collect();
            all.join(", ")
        };
        let mut text = format!("{title}: model values");
        for (word, label) in [
            ("calibrated", Label::Calibrated),
            ("assumed", Label::Assumed),
        ] {
            let names = names(label);
            if !names.is_empty() {
                text += &format!("; {word}: {names}");
            }
        }
        self.screen.say(&text);
    }

    fn tube_table(&mut self, rows: &[TubeRow]) {
        self.screen
            .say("  friction  pressure/Pa  displacement/mm  the paper's text/mm");
        for row in rows {
            let paper = row
                .paper_about_mm
                .map_or("-".to_owned(), |mm| format!("about {mm}"));
            self.screen.say(&format!(
                "  {:>8} {:>12} {:>16.3}  {paper:>19}",
                row.friction, row.pressure_pa, row.displacement_mm
            ));
        }
    }

    fn keep(&mut self, name: &str, rows: &[impl Serialize]) {
        self.series.insert(name.to_owned(), json!(rows));
    }

    fn csv(&mut self, name: &str, rows: &[impl Serialize]) -> Result<(), Failure> {
        let bytes = table::csv(rows).map_err(|error| Failure::File {
            path: self.out.join(name),
            io: error.into(),
        })?;
        self.file(name, &bytes)
    }

    fn file(&mut self, name: &str, bytes: &[u8]) -> Result<(), Failure> {
        let path = self.out.join(name);
        fs::create_dir_all(self.out).map_err(|io| Failure::File {
            path: self.out.to_owned(),
            io,
        })?;
        write(&path, bytes)?;
        self.files.push(path);
        Ok(())
    }
}

fn few_enough(one: &[f64], other: &[f64]) -> Result<(), Failure> {
    let runs = one.len() * other.len();
    if runs <= MOST_RUNS {
        return Ok(());
    }
    Err(Failure::Input {
        why: format!("{runs} runs are too many"),
        help: format!("at most {MOST_RUNS}: take larger steps"),
    })
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    fs::write(path, bytes).map_err(|io| Failure::File {
        path: path.to_owned(),
        io,
    })
}

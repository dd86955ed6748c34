//! The paper's experiment on both images: driven by the host tool's client, judged from the pins.

use std::io::{self, Write};
use std::path::PathBuf;

use client::Device;
use client::decimal;
use client::error::ClientError;
use client::identity;
use jiff::Timestamp;
use lab::trials::experiment::{self, ActuationTrial, ExperimentError, RecordedTrial, RunTrial};
use lab::trials::progress::Live;
use lab::trials::trial::{Recording, Status};
use locomotion::kinematics::Design;
use locomotion::range::OutOfRange;
use locomotion::{folded, roller};
use protocol::capsule::ActuationKind;
use protocol::system::DeviceKind;
use report::html;
use report::html::remark::Remark;
use report::html::{Existing, Found, ReportError};

use crate::bench::{Bench, BenchError};
use crate::boards::capsule::CapsuleBoard;
use crate::boards::rig::RigBoard;
use crate::boards::{capsule, rig};
use crate::link::VirtualLink;
use crate::pins::EdgeLog;
use crate::plants::capsule::Parameters;
use crate::plants::rig::{RigOptions, Violations};
use crate::verdicts::{Run, Verdict};

/// One tick of the step timer and one instruction slot of the emulator, ns.
const EDGE_LIMIT_NS: f64 = 10.0 + 1e9 / 65e6;
/// Limit of the run's duration against the exact one, ns.
const DURATION_LIMIT_NS: u64 = 1_000;
/// The paper's largest indentation (its a_5), mm.
const INDENTATION_MM: f64 = 5.05;
/// Slack of the thread before it pulls, mm.
const SLACK_MM: f64 = 1.0;
/// Steps per millimetre of the default rig.
const STEPS_PER_MM: f64 = 800.0;
/// The carriage's position is passed to the models every tenth of a millimetre, steps.
const SHOWN_STEPS: i64 = 80;

/// Why the demo ended early.
#[derive(Debug, thiserror::Error, miette::Diagnostic)]
pub enum DemoError {
    /// The bench.
    #[error(transparent)]
    #[diagnostic(code(bench::failed))]
    Bench(#[from] BenchError),
    /// A device or the link to it.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Client(#[from] ClientError),
    /// A step of the experiment.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Experiment(#[from] ExperimentError),
    /// The report.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Report(#[from] ReportError),
    /// The pins contradict the experiment.
    #[error("the pins do not agree with the experiment:\n{0}")]
    #[diagnostic(code(bench::verdict), help("the firmware's log is above"))]
    Verdict(String),
    /// The locomotion model does not cover these numbers.
    #[error(transparent)]
    #[diagnostic(code(bench::model))]
    Model(#[from] OutOfRange),
}

/// Where the demo leaves its data.
#[derive(Clone, Debug)]
pub struct DemoOptions {
    /// Folder of the records and the report.
    pub out: PathBuf,
    /// Start of the records.
    pub now: Timestamp,
}

/// Executes the experiment and prints its results.
///
/// # Errors
/// The first failure. Records until then are kept.
pub fn run(options: &DemoOptions, terminal: bool) -> Result<(), DemoError> {
    let rig_bench = rig::start(RigOptions::WITH_BOTH_JUMPERS)?;
    let capsule_bench = capsule::start(Parameters::nominal())?;
    // The nonce is fixed, so that two demos are identical to the byte.
    let rig = Device::connect(
        Box::new(VirtualLink::new(&rig_bench, "virtual rig")),
        DeviceKind::Rig,
        1,
    )?;
    let link = Box::new(VirtualLink::new(&capsule_bench, "virtual capsule"));
    let capsule = Device::connect(link, DeviceKind::Capsule, 1)?;
    for identity in [rig.identity(), capsule.identity()].into_iter().flatten() {
        say(&identity::line(identity));
    }
    let mut out: Box<dyn Write> = match terminal {
        true => Box::new(io::stderr()),
        false => Box::new(io::stdout()),
    };
    let mut stage = Stage {
        rig,
        capsule,
        options,
        live: Live::new(&mut *out, terminal),
        judge: Judge {
            rig: rig_bench.clone(),
            capsule: capsule_bench.clone(),
            first_edge: 0,
            remarks: Vec::new(),
            failures: Vec::new(),
        },
        sidecars: Vec::new(),
    };
    if let Err(error) = stage.experiment() {
        print_logs(&rig_bench, &capsule_bench)?;
        return Err(error);
    }
    let Stage {
        judge: Judge {
            remarks,
            mut failures,
            ..
        },
        sidecars,
        ..
    } = stage;
    for (name, bus) in [("rig", rig_bench.bus()?), ("capsule", capsule_bench.bus()?)] {
        failures.extend(bus.check(0).err().map(|why| format!("{name}: {why}")));
    }
    if !failures.is_empty() {
        print_logs(&rig_bench, &capsule_bench)?;
        return Err(DemoError::Verdict(failures.join("\n")));
    }
    let page = options.out.join("report.html");
    let found = Found {
        sidecars,
        omitted: vec![],
    };
    // The page of the demo before it, if there is one.
    html::write(&found, &remarks, &page, Existing::Replace)?;
    say("Data and report");
    for sidecar in &found.sidecars {
        say(&format!(
            "  {} and {}",
            sidecar.with_extension("csv").display(),
            sidecar.display()
        ));
    }
    say(&format!("  {}", page.display()));
    Ok(())
}

fn say(line: &str) {
    // A closed pipe does not end the demo.
    let _ = writeln!(io::stdout(), "{line}");
}

fn print_logs(rig: &Bench<RigBoard>, capsule: &Bench<CapsuleBoard>) -> Result<(), BenchError> {
    for (name, log) in [("rig", rig.log()?), ("capsule", capsule.log()?)] {
        for line in log.lines() {
            say(&format!("{name} {:>14} ns  {}", line.at_ns, line.text));
        }
    }
    Ok(())
}

/// Both machines, their records, and the judge of each step.
struct Stage<'a> {
    rig: Device,
    capsule: Device,
    options: &'a DemoOptions,
    live: Live<'a>,
    judge: Judge,
    /// Sidecars of the records, in the order of the steps.
    sidecars: Vec<PathBuf>,
}

impl Stage<'_> {
    /// The paper's experiment: reference and home; run unfolded; fold; the same run folded; unfold. Each step begins
    /// only if the previous one is complete.
    fn experiment(&mut self) -> Result<(), DemoError> {
        let reference = self.actuate("reference the capsule", ActuationKind::Reference)?;
        self.judge.show_actuation("Referenced", &reference);

        say("\n== home the rig");
        let homed = experiment::home(&mut self.rig, &mut self.live)?;
        say(&lab::operations::ending::homed_text(&homed));
        self.judge.first_edge = self
            .judge
            .rig
            .visit(|visit| visit.board().rig.edges().len())?;

        self.run("unfolded", None)?;
        let fold = self.actuate("fold the capsule", ActuationKind::Fold)?;
        self.judge.show_actuation("Folded", &fold);
        let thread_mm = f64::from(fold.record.thread_um) / 1_000.0;
        self.run("folded", Some(thread_mm))?;
        let unfold = self.actuate("unfold the capsule", ActuationKind::Unfold)?;
        self.judge.show_actuation("Unfolded", &unfold);
        Ok(())
    }

    fn actuate(&mut self, step: &str, kind: ActuationKind) -> Result<ActuationTrial, DemoError> {
        say(&format!("\n== {step}"));
        let recording = self.recording(experiment::stem(kind).to_owned(), None);
        let trial = experiment::actuate(&mut self.capsule, kind, &recording, &mut self.live)?;
        self.complete(experiment::doing(kind), &trial)?;
        Ok(trial)
    }

    /// The paper's run with the capsule in this shape; `thread_mm` is wound up if it is folded.
    fn run(&mut self, shape: &str, thread_mm: Option<f64>) -> Result<(), DemoError> {
        say(&format!("\n== run, capsule {shape}"));
        let recording = self.recording(format!("run-{shape}"), Some(format!("capsule {shape}")));
        let run = experiment::PAPER_RUN;
        let trial = experiment::run(&mut self.rig, run, &recording, &mut self.live)?;
        self.complete("the run", &trial)?;
        self.judge.judge_run(shape, thread_mm, &trial)
    }

    fn recording(&self, stem: String, note: Option<String>) -> Recording {
        Recording {
            folder: self.options.out.clone(),
            stem,
            now: self.options.now,
            note,
            telemetry_ms: experiment::DEFAULT_TELEMETRY_MS,
        }
    }

    /// Keeps the record of a step; fails unless the step is complete.
    fn complete<R>(
        &mut self,
        step: &'static str,
        recorded: &RecordedTrial<R>,
    ) -> Result<(), ExperimentError> {
        let RecordedTrial { trial, sidecar, .. } = recorded;
        if trial.status != Status::Complete {
            return Err(ExperimentError::Incomplete {
                step,
                status: trial.status,
                reason: trial.error.clone(),
                sidecar: sidecar.clone(),
            });
        }
        self.sidecars.push(sidecar.clone());
        Ok(())
    }
}

/// Judges each step from the pins.
struct Judge {
    rig: Bench<RigBoard>,
    capsule: Bench<CapsuleBoard>,
    /// Number of edges before the next run.
    first_edge: usize,
    remarks: Vec<Remark>,
    failures: Vec<String>,
}

impl Judge {
    fn judge_run(
        &mut self,
        shape: &str,
        thread_mm: Option<f64>,
        trial: &RunTrial,
    ) -> Result<(), DemoError> {
        let first = self.first_edge;
        let (edges, violations, carriage, syncs) = self.rig.visit(move |visit| {
            let rig = &visit.board().rig;
            (
                rig.edges().since(first),
                rig.violations(),
                rig.carriage(),
                rig.syncs().len(),
            )
        })?;
        self.first_edge += edges.len();
        let verdict = Verdict::of(&Run::paper(), &edges);
        let displacement_mm = displacement_mm(&edges, thread_mm)?;
        let rows = vec![
            row(
                "edges on the STEP pin",
                format!("{} of {}", verdict.edges.0, verdict.edges.1),
            ),
            row(
                "strokes",
                format!("{}, {syncs} sync pulses since the start", verdict.strokes),
            ),
            row(
                "longest deviation of an edge from the exact profile",
                format!(
                    "{:.2} ns (edge {}; one timer tick is 10 ns)",
                    verdict.worst.0, verdict.worst.1
                ),
            ),
            row(
                "duration",
                format!(
                    "{} ns, exactly {} ns",
                    verdict.duration_ns, verdict.exact_ns
                ),
            ),
            row(
                "extreme positions",
                format!(
                    "{} and {} steps, end at {}",
                    verdict.extremes.0, verdict.extremes.1, verdict.end
                ),
            ),
            row(
                "displacement of the body (model, not measured)",
                format!(
                    "{displacement_mm:+.2} mm {}",
                    if displacement_mm > 0.0 {
                        "against the wave"
                    } else {
                        "with the wave"
                    }
                ),
            ),
        ];
        say(&format!("Verdict from the pins, capsule {shape}"));
        print_rows(&rows);
        self.failures.extend(verdict.check(EDGE_LIMIT_NS).err());
        let mut expect = |holds: bool, what: &str| {
            if !holds {
                self.failures.push(format!("run, capsule {shape}: {what}"));
            }
        };
        expect(
            verdict.duration_ns.abs_diff(verdict.exact_ns) <= DURATION_LIMIT_NS,
            "its duration is off by more than 1 us",
        );
        expect(
            verdict.extremes.0 >= 0 && verdict.extremes.1 <= 104_000 && verdict.end == 0,
            "it left the stroke",
        );
        expect(carriage == 0, "the carriage is not at 0");
        expect(
            violations == Violations::default(),
            &format!("{violations:?}"),
        );
        expect(
            trial.record.counted_edges == verdict.edges.0,
            "the read-back counter disagrees with the pin",
        );
        self.remarks.push(Remark {
            sidecar: Some(trial.sidecar.clone()),
            title: "Verdict from the pins".into(),
            rows,
        });
        Ok(())
    }

    fn show_actuation(&mut self, title: &str, trial: &ActuationTrial) {
        let record = &trial.record;
        say(title);
        let mut rows = vec![
            row(
                "time",
                format!("{} s", decimal::write(record.duration_ms.into(), 3)),
            ),
            row(
                "current at the end",
                format!("{} mA", record.end_current_ma),
            ),
            row(
                "thread wound up",
                format!("{} mm", decimal::fixed(record.thread_um.into(), 3)),
            ),
            row("energy of the motor", format!("{} mJ", record.energy_mj)),
        ];
        let plant = self.capsule.visit(|visit| {
            let capsule = &visit.board().capsule;
            (capsule.travel_mm(), capsule.force_n())
        });
        if let Ok((travel_mm, force_n)) = plant {
            rows.push(row(
                "by the bench's spring",
                format!("{travel_mm:.2} mm of travel, {force_n:.1} N"),
            ));
        }
        print_rows(&rows);
        self.remarks.push(Remark {
            sidecar: Some(trial.sidecar.clone()),
            title: title.into(),
            rows,
        });
    }
}

fn row(name: &str, value: String) -> (String, String) {
    (name.to_owned(), value)
}

fn print_rows(rows: &[(String, String)]) {
    for (name, value) in rows {
        say(&format!("  {name:<52} {value}"));
    }
}

/// Displacement of the body by the locomotion models, mm, when the carriage makes exactly these steps; the body is
/// folded if thread is wound up. Positive is against the antegrade wave, the direction of the paper's unfolded body.
///
/// # Errors
/// [`OutOfRange`] if the models do not cover the rig's numbers.
fn displacement_mm(edges: &EdgeLog, thread_mm: Option<f64>) -> Result<f64, OutOfRange> {
    match thread_mm {
        None => {
            let mut body = roller::UnfoldedBody::new(roller::Params::PAPER, INDENTATION_MM)?;
            carry(edges, |at_mm| body.carriage_to(at_mm))?;
            Ok(body.displacement_mm())
        }
        Some(thread_mm) => {
            let design = Design::paper_printed();
            let params = folded::Params::PAPER.folded_by(&design, thread_mm - SLACK_MM)?;
            let mut body = folded::FoldedBody::new(params, INDENTATION_MM)?;
            carry(edges, |at_mm| body.carriage_to(at_mm))?;
            Ok(body.displacement_mm())
        }
    }
}

/// Calls `carriage_to` for every tenth of a millimetre and every reversal of the carriage.
fn carry(
    edges: &EdgeLog,
    mut carriage_to: impl FnMut(f64) -> Result<(), OutOfRange>,
) -> Result<(), OutOfRange> {
    let (mut at, mut heading) = (0_i64, None);
    for edge in edges.iter() {
        if heading
            .replace(edge.away)
            .is_some_and(|before| before != edge.away)
        {
            carriage_to(at as f64 / STEPS_PER_MM)?;
        }
        at += if edge.away { 1 } else { -1 };
        if at % SHOWN_STEPS == 0 {
            carriage_to(at as f64 / STEPS_PER_MM)?;
        }
    }
    Ok(())
}

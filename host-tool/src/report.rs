//! The report: recorded trials as one self-contained HTML file.

pub mod figures;

use std::fs;
use std::path::{Path, PathBuf};

use maud::{DOCTYPE, Markup, PreEscaped, html};
use miette::Diagnostic;
use protocol::capsule::{ActuationKind, ActuationRecord, CapsuleEvent};
use protocol::rig::{LinkLossPolicy, RigEvent, Run, RunTiming, Stroke};
use protocol::system::What;

use crate::decimal;
use crate::report::figures::{FigureError, actuation_figures, planned, run_figures};
use crate::trial::{
    Achieved, Action, CapsuleSample, Executed, RecordError, RigSample, Screw, Status, Trial,
};

/// Why the report could not be written.
#[derive(Debug, thiserror::Error, Diagnostic)]
pub enum ReportError {
    /// A record could not be read or the report could not be written.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Record(#[from] RecordError),
    /// A figure could not be drawn.
    #[error(transparent)]
    #[diagnostic(code(retrograde::figure))]
    Figure(#[from] FigureError),
    /// There are no trials.
    #[error("no trial in {path}", path = path.display())]
    #[diagnostic(
        code(retrograde::no_trials),
        help("give a folder with records of `retrograde run`, or their JSON files")
    )]
    NoTrials {
        /// Where they were looked for.
        path: PathBuf,
    },
}

/// A table of results that are not in the records, such as a verdict from the pins or a modelled displacement.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Remark {
    /// Sidecar of the trial it belongs to; none for a remark on the whole report.
    pub sidecar: Option<PathBuf>,
    /// Heading.
    pub title: String,
    /// Names and values.
    pub rows: Vec<(String, String)>,
}

/// The sidecars at these paths; a folder stands for all sidecars in it, in the order of their start.
///
/// # Errors
/// A path cannot be read, or a folder holds no trial.
pub fn sidecars(paths: &[PathBuf]) -> Result<Vec<PathBuf>, ReportError> {
    let mut all = vec![];
    for path in paths {
        if !path.is_dir() {
            all.push(path.clone());
            continue;
        }
        let entries = fs::read_dir(path).map_err(|io| RecordError::read(path, io))?;
        let mut found: Vec<_> = entries
            .flatten()
            .map(|entry| entry.path())
            .filter(|path| {
                path.extension()
                    .is_some_and(|extension| extension == "json")
            })
            .filter(|path| path.with_extension("csv").exists())
            .filter_map(|path| Some((Trial::read(&path).ok()?.started_utc, path)))
            .collect();
        found.sort();
        if found.is_empty() {
            return Err(ReportError::NoTrials { path: path.clone() });
        }
        all.extend(found.into_iter().map(|(_, path)| path));
    }
    Ok(all)
}

/// Writes the report of these sidecars.
///
/// # Errors
/// A record cannot be read or the file cannot be written.
pub fn write(sidecars: &[PathBuf], remarks: &[Remark], out: &Path) -> Result<(), ReportError> {
    let page = html(sidecars, remarks)?;
    if let Some(folder) = out.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        fs::create_dir_all(folder).map_err(|io| RecordError::write(folder, io))?;
    }
    fs::write(out, page).map_err(|io| RecordError::write(out, io))?;
    Ok(())
}

/// The report of these sidecars as HTML.
///
/// # Errors
/// A record cannot be read.
pub fn html(sidecars: &[PathBuf], remarks: &[Remark]) -> Result<String, ReportError> {
    let mut trials = vec![];
    for sidecar in sidecars {
        trials.push((sidecar, Trial::read(sidecar)?));
    }
    let mut sections = vec![];
    for (sidecar, trial) in &trials {
        let of_trial = remarks
            .iter()
            .filter(|remark| remark.sidecar.as_ref() == Some(sidecar));
        sections.push(section(sidecar, trial, of_trial)?);
    }
    let general = remarks.iter().filter(|remark| remark.sidecar.is_none());
    let title = "Retrograde: report";
    Ok(html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                h1 { (title) }
                table {
                    thead { tr { th { "trial" } th { "started (UTC)" } th { "note" } th { "ended" } th { "summary" } } }
                    tbody {
                        @for (index, (_, trial)) in trials.iter().enumerate() {
                            tr {
                                td { a href={ "#trial-" (index + 1) } { (heading(trial)) } }
                                td { (trial.started_utc) }
                                td { (trial.note.as_deref().unwrap_or("")) }
                                td { (status(trial.status)) }
                                td { (in_short(trial)) }
                            }
                        }
                    }
                }
                @for remark in general { (remark_table(remark)) }
                @for (index, section) in sections.iter().enumerate() {
                    section id={ "trial-" (index + 1) } { (section) }
                }
            }
        }
    }
    .into_string())
}

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;color:#222;max-width:60rem;margin:2rem auto;padding:0 1rem}\
h1{font-size:1.6rem}h2{font-size:1.2rem;margin:2.4rem 0 .4rem;border-top:1px solid #ddd;padding-top:1.2rem}\
h3{font-size:1rem;margin:1.2rem 0 .3rem}table{border-collapse:collapse;margin:.4rem 0 1rem;width:100%}\
th,td{border-bottom:1px solid #e4e4e4;padding:.22rem .6rem .22rem 0;text-align:left;vertical-align:top;font-variant-numeric:tabular-nums}\
th{font-weight:600;color:#555}figure{margin:.6rem 0}figcaption{color:#555;font-size:.9rem}svg{max-width:100%;height:auto}\
.ok{color:#176b2c}.bad{color:#a51d1d;font-weight:600}code{font-size:.92em}";

fn section<'a>(
    sidecar: &Path,
    trial: &Trial,
    remarks: impl Iterator<Item = &'a Remark>,
) -> Result<Markup, ReportError> {
    let body = match &trial.action {
        Action::Run {
            screw,
            requested,
            achieved,
            executed,
        } => run(
            sidecar,
            trial,
            screw,
            requested,
            achieved.as_ref(),
            executed.as_ref(),
        )?,
        Action::Actuation {
            actuation, record, ..
        } => actuation_section(sidecar, trial, *actuation, record.as_ref())?,
    };
    let device = &trial.device;
    Ok(html! {
        h2 { (heading(trial)) " " (status(trial.status)) }
        p {
            (trial.started_utc)
            @if let Some(note) = &trial.note { ", " (note) }
            @if let Some(error) = &trial.error { br; span.bad { (error) } }
        }
        (body)
        @for remark in remarks { (remark_table(remark)) }
        h3 { "Provenance" }
        (rows([
            ("device", format!("{}, UID {}", device.device, device.uid)),
            ("firmware", format!("{} ({}), start {} ({})", device.firmware, device.profile, device.boot_id, device.reset_cause)),
            ("protocol, schema", format!("{}, {}", device.protocol, device.schema_key)),
            ("host tool", format!("{}, protocol {}, schema {}", trial.tool, trial.protocol, trial.schema_key)),
            ("telemetry", format!("{} samples in {}, {} lost; {} events, {} lost", trial.samples, trial.telemetry, trial.missed_samples, trial.events.len(), trial.lost_events)),
        ]))
    })
}

fn run(
    sidecar: &Path,
    trial: &Trial,
    screw: &Screw,
    requested: &Run,
    achieved: Option<&Achieved>,
    executed: Option<&Executed>,
) -> Result<Markup, ReportError> {
    let samples: Vec<RigSample> = trial.samples(sidecar)?;
    let figures = match achieved {
        Some(achieved) => {
            let start_us = trial
                .events
                .iter()
                .find(|event| matches!(event.what, What::Rig(RigEvent::RunStarted { .. })))
                .map(|event| event.time_us)
                .or_else(|| samples.first().map(|sample| sample.time_us))
                .unwrap_or(0);
            let plan = planned(screw, requested, achieved);
            Some(run_figures(plan, &samples, start_us)?)
        }
        None => None,
    };
    let asked = |total: bool| match requested.timing {
        RunTiming::Total { total_us, .. } if total => format!("{} s", decimal::write(total_us, 6)),
        RunTiming::Speeds {
            forward_um_s,
            return_um_s,
            ..
        } if !total => format!("{} / {} mm/s", milli(forward_um_s), milli(return_um_s)),
        _ => "-".to_owned(),
    };
    let (RunTiming::Total { accel_um_s2, .. } | RunTiming::Speeds { accel_um_s2, .. }) =
        requested.timing;
    let both = |of: &dyn Fn(&Stroke) -> String| {
        achieved.map_or_else(dash, |achieved| {
            format!("{} / {}", of(&achieved.forward), of(&achieved.back))
        })
    };
    let planned_of = |of: &dyn Fn(&Achieved) -> String| achieved.map_or_else(dash, of);
    let done = |of: &dyn Fn(&Executed) -> String| executed.map_or_else(dash, of);
    Ok(html! {
        @if let Some([position, velocity]) = figures {
            figure {
                (PreEscaped(position)) (PreEscaped(velocity))
                figcaption { "Position by the read-back counter and mean velocity between samples, measured over planned. Time 0 is the first stroke's start." }
            }
        }
        table {
            thead { tr { th {} th { "requested" } th { "planned by the rig" } th { "executed" } } }
            tbody {
                (row4("strokes", (u32::from(requested.cycles) * 2).to_string(), "", done(&|e| e.strokes.to_string())))
                (row4("stroke", format!("{} mm", milli(requested.stroke_um)), both(&|s| format!("{} mm", decimal::write_signed(screw.nm(s.steps.into()), 6))), done(&|e| format!("{} to {} mm", decimal::write_signed(screw.nm(e.min_steps.into()), 6), decimal::write_signed(screw.nm(e.max_steps.into()), 6)))))
                (row4("duration", asked(true), planned_of(&|a| format!("{} s", decimal::seconds(a.total_ticks))), done(&|e| format!("{} s", decimal::seconds(e.ticks)))))
                (row4("peak speed, out / home", asked(false), both(&|s| format!("{} mm/s", milli(s.peak_um_s))), ""))
                (row4("acceleration, out / home", format!("{} mm/s²", milli(accel_um_s2)), both(&|s| format!("{} mm/s²", milli(s.accel_um_s2))), ""))
                (row4("dwell, far / home", format!("{} / {} s", decimal::write(requested.far_dwell_us.into(), 6), decimal::write(requested.home_dwell_us.into(), 6)), "", ""))
                (row4("steps", "", planned_of(&|a| a.edges.to_string()), done(&|e| format!("{} commanded, {} counted at the pin", e.commanded_edges, e.counted_edges))))
                (row4("fingerprint of the plan", "", planned_of(&|a| a.plan_hash.clone()), done(&|e| e.plan_hash.clone())))
                (row4("residual at the home flag", "", "", done(&|e| format!("{} steps at worst", e.worst_residual_steps))))
                (row4("shortest queue of the step generator", "", "", done(&|e| e.min_queue.map_or_else(|| "never short".to_owned(), |periods| periods.to_string()))))
                (row4("intervals between steps, timed at the pin", "", "", done(&intervals)))
                (row4("filtered pulses on the switches", "", "", done(&|e| e.glitches.to_string())))
                (row4("holds", "", "", done(&|e| e.holds.to_string())))
                (row4("fingerprint of the image", "", "", done(&|e| e.image_hash.clone())))
                (row4("when the host falls silent", match requested.link_loss { LinkLossPolicy::Stop => "stop", LinkLossPolicy::Finish => "finish" }, "", ""))
            }
        }
    })
}

/// What the rig found when it timed its own steps.
fn intervals(executed: &Executed) -> String {
    let Executed {
        edges_timed,
        counted_edges,
        ..
    } = executed;
    match (edges_timed, executed.worst_interval_error_ticks) {
        (0, _) => "not timed".to_owned(),
        (_, u32::MAX) => format!("{edges_timed} edges timed: more than steps"),
        (_, worst) => format!(
            "{edges_timed} of {counted_edges} steps timed, {} ns off the plan at worst",
            u64::from(worst) * 10
        ),
    }
}

fn actuation_section(
    sidecar: &Path,
    trial: &Trial,
    kind: ActuationKind,
    record: Option<&ActuationRecord>,
) -> Result<Markup, ReportError> {
    let samples: Vec<CapsuleSample> = trial.samples(sidecar)?;
    let start_us = trial
        .events
        .iter()
        .find(|event| matches!(event.what, What::Capsule(CapsuleEvent::Started { .. })))
        .map(|event| event.time_us)
        .or_else(|| samples.first().map(|sample| sample.time_us))
        .unwrap_or(0);
    let [thread, current] = actuation_figures(&samples, start_us)?;
    Ok(html! {
        figure {
            (PreEscaped(thread)) (PreEscaped(current))
            figcaption { "Thread wound up by the encoder, and motor current. Time 0 is the first drive." }
        }
        @if let Some(record) = record { (rows(actuation_rows(kind, record))) }
    })
}

/// An actuation's record as names and values with units.
#[must_use]
pub fn actuation_rows(
    kind: ActuationKind,
    record: &ActuationRecord,
) -> Vec<(&'static str, String)> {
    let mut rows = vec![
        (
            "time",
            format!("{} s", decimal::fixed(record.duration_ms.into(), 3)),
        ),
        (
            "thread at the end",
            format!("{} mm", decimal::fixed(record.thread_um.into(), 3)),
        ),
        (
            "current at the end",
            format!("{} mA", record.end_current_ma),
        ),
        ("largest current", format!("{} mA", record.peak_current_ma)),
    ];
    if kind == ActuationKind::Fold {
        let engaged = match record.engaged_um {
            0 => "never".to_owned(),
            um => format!("{} mm", decimal::fixed(um.into(), 3)),
        };
        rows.push(("load first felt at", engaged));
    }
    rows.push((
        "energy",
        format!("{} J", decimal::fixed(record.energy_mj.into(), 3)),
    ));
    rows.push((
        "lowest battery voltage",
        format!("{} V", decimal::fixed(record.min_battery_mv.into(), 3)),
    ));
    rows
}

fn heading(trial: &Trial) -> String {
    match &trial.action {
        Action::Run { requested, .. } => format!(
            "Run, {} cycles of {} mm",
            requested.cycles,
            milli(requested.stroke_um)
        ),
        Action::Actuation { actuation, .. } => match actuation {
            ActuationKind::Reference => "Reference of the thread".to_owned(),
            ActuationKind::Calibrate => "Calibration of the thread".to_owned(),
            ActuationKind::CheckFolded => "Check that it is folded".to_owned(),
            ActuationKind::Fold => "Fold".to_owned(),
            ActuationKind::Unfold => "Unfold".to_owned(),
        },
    }
}

fn in_short(trial: &Trial) -> String {
    match &trial.action {
        Action::Run {
            executed: Some(executed),
            ..
        } => format!(
            "{} strokes, {} steps, {} s",
            executed.strokes,
            executed.counted_edges,
            decimal::seconds(executed.ticks)
        ),
        Action::Actuation {
            record: Some(record),
            ..
        } => format!(
            "{} s, {} mm of thread, {} mA",
            decimal::fixed(record.duration_ms.into(), 3),
            decimal::fixed(record.thread_um.into(), 3),
            record.end_current_ma
        ),
        _ => dash(),
    }
}

fn status(status: Status) -> Markup {
    let (text, good) = match status {
        Status::Running => ("not ended: the host ended first", false),
        Status::Complete => ("complete", true),
        Status::Stopped => ("stopped on request", false),
        Status::LinkLost => ("ended by link loss", false),
        Status::Faulted => ("ended by a fault", false),
        Status::Unknown => ("outcome unknown", false),
    };
    html! { span class=(if good { "ok" } else { "bad" }) { (text) } }
}

fn remark_table(remark: &Remark) -> Markup {
    html! {
        h3 { (remark.title) }
        (rows(remark.rows.iter().map(|(name, value)| (name.as_str(), value.clone()))))
    }
}

fn rows<'a>(rows: impl IntoIterator<Item = (&'a str, String)>) -> Markup {
    html! {
        table { tbody {
            @for (name, value) in rows { tr { th { (name) } td { (value) } } }
        } }
    }
}

fn row4(name: &str, a: impl AsRef<str>, b: impl AsRef<str>, c: impl AsRef<str>) -> Markup {
    html! { tr { th { (name) } td { (a.as_ref()) } td { (b.as_ref()) } td { (c.as_ref()) } } }
}

fn milli(value: u32) -> String {
    decimal::write(value.into(), 3)
}

fn dash() -> String {
    "-".to_owned()
}

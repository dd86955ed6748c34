//! One trial of the report: its request, its result, its figures, its defects and its origin.

use std::path::Path;

use client::decimal;
use lab::trials::check::{self, Defects};
use lab::trials::sidecar::heading;
use lab::trials::trial::{
    Achieved, Action, CapsuleSample, Executed, RigSample, Screw, Status, TrialRecord,
};
use maud::{Markup, PreEscaped, html};
use protocol::capsule::{ActuationKind, ActuationRecord};
use protocol::rig::{LinkLossPolicy, Run, RunTiming, Stroke};

use crate::figures::{Curves, FigureError, planned, record_figures};
use crate::html::page;
use crate::html::remark::Remark;

/// The section of a trial and the defects of its record.
pub(crate) struct Section {
    pub(crate) defects: Defects,
    pub(crate) body: Markup,
}

/// Builds the section of a trial. Unreadable files are defects, not errors: the page lists them.
pub(crate) fn section<'a>(
    sidecar: &Path,
    trial: &TrialRecord,
    remarks: impl Iterator<Item = &'a Remark>,
) -> Result<Section, FigureError> {
    let mut curves = Curves::since(check::start_us(trial));
    let (defects, content) = match &trial.action {
        Action::Run {
            screw,
            requested,
            achieved,
            executed,
        } => {
            let number = |text: &str| text.parse().unwrap_or(f64::NAN);
            let defects = check::seen(sidecar, trial, |sample: &RigSample| {
                let values = [&sample.position_mm, &sample.speed_mm_s];
                curves.push(sample.time_us, values.map(|text| number(text)));
            });
            let (achieved, executed) = (achieved.as_ref(), executed.as_ref());
            let content = run(trial, &curves, screw, requested, achieved, executed)?;
            (defects, content)
        }
        Action::Actuation {
            actuation, record, ..
        } => {
            let mut largest_ma = None;
            let defects = check::seen(sidecar, trial, |sample: &CapsuleSample| {
                largest_ma = largest_ma.max(Some(sample.current_ma));
                let thread_mm = f64::from(sample.thread_um) / 1e3;
                curves.push(sample.time_us, [thread_mm, f64::from(sample.current_ma)]);
            });
            let record = record.as_ref();
            let content = actuation_section(trial, &curves, largest_ma, *actuation, record)?;
            (defects, content)
        }
    };
    let listed = defects.all();
    let device = &trial.device;
    let body = html! {
        h2 { (heading(trial)) " " (status(trial, &defects)) (page::tag(device.origin)) }
        p {
            (trial.started_utc)
            @if let Some(note) = &trial.note { ", " (note) }
            @if let Some(error) = &trial.error { br; span.bad { (error) } }
        }
        (reasons(&listed))
        (content)
        @for remark in remarks { (remark_table(remark)) }
        h3 { "Provenance" }
        (page::rows([
            ("origin", device.origin.meaning().to_owned()),
            ("device", format!("{}, UID {}", device.device, device.uid)),
            ("firmware", format!("{} ({}), start {} ({})", device.firmware, device.profile, device.boot_id, device.reset_cause)),
            ("protocol, schema", format!("{}, {}", device.protocol, device.schema_key)),
            ("host tool", format!("{}, protocol {}, schema {}", trial.tool, trial.protocol, trial.schema_key)),
            ("telemetry", format!("{} samples in {}, {} lost; {} events, {} lost", trial.samples, trial.telemetry, trial.missed_samples, trial.events.len(), trial.lost_events)),
        ]))
    };
    Ok(Section { defects, body })
}

pub(crate) fn reasons(defects: &[String]) -> Markup {
    html! {
        @if !defects.is_empty() {
            ul.bad { @for defect in defects { li { (defect) } } }
        }
    }
}

fn run(
    trial: &TrialRecord,
    curves: &Curves,
    screw: &Screw,
    requested: &Run,
    achieved: Option<&Achieved>,
    executed: Option<&Executed>,
) -> Result<Markup, FigureError> {
    let figures = match achieved {
        Some(achieved) if !curves.is_empty() => {
            let plan = planned(screw, requested, achieved);
            let shown = [
                ("position", "position / mm", Some(plan.position)),
                ("velocity", "velocity / (mm/s)", Some(plan.velocity)),
            ];
            Some(record_figures("Run", trial.device.origin, curves, shown)?)
        }
        _ => None,
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
                figcaption { "Position by the read-back counter and mean velocity between samples, over the plan. " (time_0(trial, requested)) }
            }
        }
        @else { p { "No telemetry: no figure." } }
        div.wide { table {
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
        } }
    })
}

/// What time 0 means in a run's figures.
fn time_0(trial: &TrialRecord, requested: &Run) -> String {
    if check::start_us(trial).is_none() {
        return "Time 0 is the first sample: the record does not say when the run began."
            .to_owned();
    }
    let start = match requested.start_delay_us {
        0 => "at once".to_owned(),
        us => format!(
            "after its start delay, at {} s",
            decimal::write(us.into(), 6)
        ),
    };
    format!("Time 0 is the run's start; its first stroke begins {start}.")
}

/// Result of the rig's timing of its own steps.
fn intervals(executed: &Executed) -> String {
    let (edges_timed, counted_edges) = (executed.edges_timed, executed.counted_edges);
    match (edges_timed, executed.worst_interval_error_ticks) {
        (0, _) => "not timed".to_owned(),
        (_, u32::MAX) => {
            format!("{edges_timed} edges timed, and not one for each of {counted_edges} steps")
        }
        (_, worst) => format!(
            "{edges_timed} of {counted_edges} steps timed, {} ns off the plan at worst",
            u64::from(worst) * 10
        ),
    }
}

fn actuation_section(
    trial: &TrialRecord,
    curves: &Curves,
    largest_ma: Option<u16>,
    kind: ActuationKind,
    record: Option<&ActuationRecord>,
) -> Result<Markup, FigureError> {
    let shown = [
        ("thread", "thread wound / mm", None),
        ("motor current", "motor current / mA", None),
    ];
    let figures = match curves.is_empty() {
        true => None,
        false => Some(record_figures(
            &heading(trial),
            trial.device.origin,
            curves,
            shown,
        )?),
    };
    let mut table = record.map_or_else(Vec::new, |record| actuation_rows(kind, record));
    if let Some(largest_ma) = largest_ma {
        let after = table.iter().position(|(name, _)| *name == AFTER_INRUSH);
        let at = after.map_or(table.len(), |at| at + 1);
        let text = format!("{largest_ma} mA");
        table.insert(
            at,
            ("largest current in the telemetry, with the inrush", text),
        );
    }
    Ok(html! {
        @if let Some([thread, current]) = figures {
            figure {
                (PreEscaped(thread)) (PreEscaped(current))
                figcaption {
                    "Thread wound up by the encoder, and motor current as sampled, with the inrush. Time 0 is the first "
                    @if check::start_us(trial).is_some() { "drive." }
                    @else { "sample: the record does not say when the motor was first driven." }
                }
            }
        }
        @else { p { "No telemetry: no figure." } }
        @if !table.is_empty() { (page::rows(table)) }
    })
}

/// The capsule ignores the inrush current when it measures its peak.
const AFTER_INRUSH: &str = "largest current after the inrush, by the capsule";

pub fn actuation_rows(
    kind: ActuationKind,
    record: &ActuationRecord,
) -> Vec<(&'static str, String)> {
    let milli = |value: i64| decimal::fixed(value, 3);
    let mut rows = vec![
        ("time", format!("{} s", milli(record.duration_ms.into()))),
        (
            "thread at the end",
            format!("{} mm", milli(record.thread_um.into())),
        ),
        (
            "current at the end",
            format!("{} mA", record.end_current_ma),
        ),
        (AFTER_INRUSH, format!("{} mA", record.peak_current_ma)),
    ];
    if kind == ActuationKind::Fold {
        let engaged = match record.engaged_um {
            0 => "never".to_owned(),
            um => format!("{} mm", milli(um.into())),
        };
        rows.push(("load first felt at", engaged));
    }
    rows.push(("energy of the motor", format!("{} mJ", record.energy_mj)));
    let battery = format!("{} V", milli(record.min_battery_mv.into()));
    rows.push(("lowest battery voltage", battery));
    rows
}

pub(crate) fn in_short(trial: &TrialRecord) -> String {
    match &trial.action {
        Action::Run {
            executed: Some(executed),
            ..
        } => format!(
            "{} strokes, {} steps, {} s",
            executed.strokes,
            executed.counted_edges,
            decimal::write(executed.ticks, 8)
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

/// How it ended, and whether its record is reliable.
pub(crate) fn status(trial: &TrialRecord, defects: &Defects) -> Markup {
    let (text, good) = match trial.status {
        Status::Running => ("no end is recorded: it is under way, or was cut off", false),
        Status::Complete => ("complete", true),
        Status::Refused => ("refused; nothing was done", false),
        Status::Stopped => ("stopped on request", false),
        Status::LinkLost => ("ended by link loss", false),
        Status::Faulted => ("ended by a fault", false),
        Status::Unknown => ("outcome unknown", false),
    };
    html! {
        @if !defects.contradictions.is_empty() {
            span.bad { "said to be “" (text) "”, but the record contradicts itself" }
        } @else if trial.not_whole().is_some() {
            span.bad { (text) @if trial.status != Status::Running { "; not recorded whole" } }
        } @else if !defects.gaps.is_empty() {
            span.bad { (text) "; a part of the telemetry is missing" }
        } @else {
            span class=(if good { "ok" } else { "bad" }) { (text) }
        }
    }
}

pub(crate) fn remark_table(remark: &Remark) -> Markup {
    html! {
        h3 { (remark.title) }
        (page::rows(remark.rows.iter().map(|(name, value)| (name.as_str(), value.clone()))))
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

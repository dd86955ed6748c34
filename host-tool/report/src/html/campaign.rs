//! The report of a campaign: one page, its figures as SVG, and its tables as CSV, in the campaign's folder `report`.
//!
//! A cell with a computed number has the attribute `data-is` with its position in the tables.
//! `docs/examples/check_report.py` recomputes each of them from the campaign's files and compares.

use std::fmt::Display;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use client::decimal;
use client::identity::Origin;
use client::plain;
use lab::campaign::CampaignError;
use lab::campaign::manifest;
use lab::campaign::plan::TrialPurpose;
use lab::campaign::readings::Quantity;
use maud::{Markup, PreEscaped, html};
use miette::Diagnostic;
use serde::Serialize;

use crate::html::campaign_figures::{Captioned, figure7, figure8, run_over_plan};
use crate::html::evaluation::{
    ConditionRow, Evaluation, NOT_DONE, Part, TrialRow, evaluate, run_of,
};
use crate::html::section::{reasons, status};
use crate::html::{Existing, ReportError, not_written, page, unwritten};
use crate::science::table;

#[derive(Debug, thiserror::Error, Diagnostic)]
pub enum CampaignReportError {
    #[error(transparent)]
    #[diagnostic(transparent)]
    Campaign(#[from] CampaignError),
    #[error(transparent)]
    #[diagnostic(transparent)]
    Report(#[from] ReportError),
    /// The page already exists; a campaign has only one path for it.
    #[error("{path} is there already; nothing was written", path = path.display())]
    #[diagnostic(code(retrograde::exists), help("`--force` replaces it"))]
    Exists { path: PathBuf },
}

/// The files written, and warnings about them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Written {
    #[serde(serialize_with = "client::wording::path")]
    pub page: PathBuf,
    #[serde(serialize_with = "client::wording::paths")]
    pub files: Vec<PathBuf>,
    pub planned: usize,
    pub counted: usize,
    pub omitted: Vec<(u32, String)>,
    /// The same as sentences, with one for all trials not done yet.
    #[serde(skip)]
    pub notices: Vec<String>,
    /// Number of done trials with unreliable records.
    pub defects: usize,
    pub findings: Vec<String>,
    pub origin: Origin,
}

const PAGE: &str = "report.html";

/// What exists at the path of a campaign's report.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Present {
    Nothing,
    /// The report of the present folder.
    Current,
    /// A report of an earlier state.
    Outdated,
    /// Not a report of this program.
    Foreign,
}

/// Examines the path of a campaign's report.
pub fn present(folder: &Path) -> Present {
    let path = report_folder(folder).join(PAGE);
    if fs::symlink_metadata(&path).is_err() {
        return Present::Nothing;
    }
    let html = plain::read_text(&path, plain::TELEMETRY).unwrap_or_default();
    if !html.contains(&format!("data-is=\"{COUNTED}\"")) {
        return Present::Foreign;
    }
    let is_current =
        manifest::hash_of_all(folder).is_ok_and(|hash| html.contains(&hash_of_list(&hash)));
    if is_current {
        Present::Current
    } else {
        Present::Outdated
    }
}

/// Line of a page that identifies the state of the folder that the page shows.
fn hash_of_list(hash: &str) -> String {
    format!("{}: SHA-256 {hash}", manifest::NAME)
}

/// The number of trials that count, for `check_report.py`. Every page has it.
const COUNTED: &str = "totals/counted";

/// Folder of a campaign's reports; `verify` ignores it.
pub fn report_folder(campaign: &Path) -> PathBuf {
    campaign.join(manifest::NOT_COVERED)
}

/// Verifies a campaign, evaluates it, and writes page, figures and tables.
///
/// # Errors
/// The campaign cannot be read, the page already exists, or a file cannot be written. Each file is written completely
/// or not at all, the page last.
pub fn write(folder: &Path, existing: Existing) -> Result<Written, CampaignReportError> {
    let into = report_folder(folder);
    let page_path = into.join(PAGE);
    if existing == Existing::Keep && fs::symlink_metadata(&page_path).is_ok() {
        return Err(CampaignReportError::Exists { path: page_path });
    }
    let evaluation = evaluate(folder)?;
    let figures = Figures {
        figure7: figure7(&evaluation).map_err(ReportError::from)?,
        figure8: figure8(&evaluation).map_err(ReportError::from)?,
    };
    let html = html(&evaluation, &figures)?;
    let failed = |name: &str| {
        let path = into.join(name);
        move |io: io::Error| not_written(&path, &io)
    };
    plain::folder_below(folder, manifest::NOT_COVERED).map_err(failed(""))?;
    let mut files = vec![];
    let mut keep = |name: &str, bytes: &[u8]| {
        // Figures and tables belong to their page, so they are replaced with it.
        plain::replace(&into.join(name), bytes).map_err(failed(name))?;
        files.push(into.join(name));
        Ok::<_, ReportError>(())
    };
    for (name, drawings) in [("figure7", &figures.figure7), ("figure8", &figures.figure8)] {
        let drawings = drawings.as_ref();
        for (ending, svg) in [
            ("", drawings.map(|drawn| &drawn.narrow)),
            ("-wide", drawings.map(|drawn| &drawn.wide)),
        ] {
            let file = format!("{name}{ending}.svg");
            match svg {
                Some(svg) => keep(&file, svg.as_bytes())?,
                // An earlier report drew this figure from trials that no longer count.
                None => plain::remove(&into.join(&file)).map_err(failed(&file))?,
            }
        }
    }
    let lines: Vec<_> = evaluation.lines.iter().map(|(row, _)| row).collect();
    for (name, bytes) in [
        ("trials.csv", table::csv(&evaluation.trials)),
        ("attempts.csv", table::csv(&evaluation.attempts)),
        ("conditions.csv", table::csv(&evaluation.conditions)),
        ("lines.csv", table::csv(&lines)),
        ("readings.csv", table::csv(&evaluation.readings)),
    ] {
        let bytes = bytes.map_err(|error| unwritten(&into.join(name), &error.into()))?;
        keep(name, &bytes)?;
    }
    match existing {
        Existing::Replace => plain::replace(&page_path, html.as_bytes()),
        Existing::Keep => plain::create(&page_path, html.as_bytes()),
    }
    .map_err(failed(PAGE))?;
    files.push(page_path.clone());
    let omitted = evaluation
        .trials
        .iter()
        .filter_map(|row| Some((row.trial, row.reason.clone()?)));
    Ok(Written {
        page: page_path,
        files,
        planned: evaluation.trials.len(),
        counted: evaluation.trials.iter().filter(|row| row.counts).count(),
        omitted: omitted.collect(),
        notices: stretches(&evaluation).into_iter().map(notice).collect(),
        defects: evaluation
            .trials
            .iter()
            .filter(|row| row.has_defect)
            .count(),
        findings: evaluation
            .findings
            .iter()
            .map(ToString::to_string)
            .collect(),
        origin: evaluation.origin,
    })
}

struct Figures {
    figure7: Option<Captioned>,
    figure8: Option<Captioned>,
}

fn html(evaluation: &Evaluation, figures: &Figures) -> Result<String, ReportError> {
    let plan = &evaluation.campaign.plan;
    let title = format!("Campaign {}", plan.name);
    let mut trials = vec![];
    for (row, parts) in evaluation.trials.iter().zip(&evaluation.parts) {
        if !parts.is_empty() {
            trials.push(trial(evaluation, row, parts)?);
        }
    }
    let body = html! {
        (origin_banner(evaluation))
        h1 { (title) (page::tag(evaluation.origin)) }
        (verified(evaluation))
        (summary(evaluation))
        section {
            h2 { "Displacement over indentation" }
            (drawn(figures.figure7.as_ref(), "No trial of the series counts yet: no figure."))
            (conditions(evaluation, TrialPurpose::Series))
            (lines(evaluation))
        }
        section {
            h2 { "Folded against unfolded" }
            (drawn(figures.figure8.as_ref(), "No trial of the fold test counts yet: no figure."))
            (conditions(evaluation, TrialPurpose::FoldTest))
        }
        section { h2 { "Omitted" } (omitted(evaluation)) }
        section { h2 { "Conditions" } (setting(evaluation)) }
        section { h2 { "Ledger, glitches, energy" } (totals(evaluation)) }
        section { h2 { "All trials" } (all_trials(evaluation)) }
        @if !trials.is_empty() { section {
            h2 { "Each trial" }
            p { "A trial opens by a click; those that do not count are open. What is closed is not printed." }
            @for trial in &trials { (trial) }
        } }
        section { h2 { "Provenance" } (provenance(evaluation)) }
    };
    Ok(page::page(&title, &body))
}

fn origin_banner(evaluation: &Evaluation) -> Markup {
    html! {
        @match evaluation.origin {
            Origin::Board => {},
            Origin::Virtual => p.banner {
                "VIRTUAL: this campaign was simulated. Its displacements are those of a model, not measurements."
                @if evaluation.campaign.plan.virtual_bench.scatter_mm.um != 0 {
                    " Scatter with a standard deviation of " (evaluation.campaign.plan.virtual_bench.scatter_mm)
                    " mm was added, seed " (evaluation.campaign.plan.virtual_bench.seed) "."
                }
            },
            Origin::Unknown => p.banner { "ORIGIN UNKNOWN: nothing was recorded yet, or the records do not say what made them." },
        }
    }
}

fn verified(evaluation: &Evaluation) -> Markup {
    html! {
        @if evaluation.findings.is_empty() {
            p.ok { "Verified: all " (evaluation.manifest.0.len()) " files are as they were written." }
        } @else {
            p.banner { "NOT AS IT WAS WRITTEN: " (evaluation.findings.len()) " findings. Numbers that rest on these files cannot be relied on." }
            (reasons(&evaluation.findings.iter().map(|finding| format!("{finding}; {}", finding.remedy)).collect::<Vec<_>>()))
        }
    }
}

fn summary(evaluation: &Evaluation) -> Markup {
    let metadata = &evaluation.campaign.plan.metadata;
    html! {
        p {
            (cell(COUNTED, evaluation.trials.iter().filter(|row| row.counts).count()))
            " of " (cell("totals/planned", evaluation.trials.len())) " trials count. Operator: " (metadata.operator)
            ". Specimen: " (metadata.specimen) "."
        }
    }
}

/// A number that `check_report.py` recomputes.
fn cell(is: &str, value: impl Display) -> Markup {
    html! { span data-is=(is) { (value.to_string()) } }
}

fn number(is: &str, value: Option<impl Display>) -> Markup {
    html! { td.n { @match value { Some(value) => (cell(is, value)), None => "-" } } }
}

fn figure(svg: Option<&str>, otherwise: &str, caption: &str) -> Markup {
    html! {
        @match svg {
            Some(svg) => figure.one { (PreEscaped(svg)) figcaption { (caption) } },
            None => p { (otherwise) },
        }
    }
}

/// A figure of the campaign, or the text that replaces it.
fn drawn(drawings: Option<&Captioned>, otherwise: &str) -> Markup {
    html! {
        @match drawings {
            Some(Captioned { narrow, wide, caption }) => figure.both {
                (PreEscaped(narrow)) (PreEscaped(wide)) figcaption { (caption) }
            },
            None => p { (otherwise) },
        }
    }
}

fn condition_key(row: &ConditionRow) -> String {
    format!(
        "conditions/{}/{}/{}/{}",
        row.purpose.name(),
        row.lubrication.name(),
        row.indentation,
        row.shape.name()
    )
}

fn conditions(evaluation: &Evaluation, purpose: TrialPurpose) -> Markup {
    let has_shapes = purpose == TrialPurpose::FoldTest;
    let rows = || {
        let rows = evaluation.conditions.iter();
        rows.filter(|row| row.purpose == purpose)
    };
    html! {
        @if rows().next().is_none() { p { "The plan has none." } }
        @else { div.wide { table {
            thead { tr {
                th { "walls" } th { "place" } @if has_shapes { th { "shape" } }
                th.n { "a / mm" } th.n { "n" } th.n { "mean / mm" } th.n { "SD / mm" }
            } }
            tbody { @for row in rows() {
                @let key = condition_key(row);
                tr {
                    td { (row.lubrication.name()) } td { (row.indentation) }
                    @if has_shapes { td { (row.shape.name()) } }
                    (number(&format!("{key}/indentation_mm"), row.indentation_mm))
                    td.n { (cell(&format!("{key}/n"), row.n)) " of " (cell(&format!("{key}/planned"), row.planned)) }
                    (number(&format!("{key}/mean_mm"), row.mean_mm))
                    (number(&format!("{key}/sd_mm"), row.sd_mm))
                }
            } }
        } } }
    }
}

fn lines(evaluation: &Evaluation) -> Markup {
    html! {
        @if !evaluation.lines.is_empty() { div.wide { table {
            thead { tr { th { "line" } th.n { "n" } th.n { "slope" } th.n { "at a = 0 / mm" } th.n { "R²" } th.n { "SD / mm" } } }
            tbody { @for (row, _) in &evaluation.lines {
                @let key = format!("lines/{}", row.lubrication.name());
                tr {
                    td { (row.lubrication.name()) }
                    (number(&format!("{key}/n"), Some(row.n)))
                    (number(&format!("{key}/slope"), Some(row.slope)))
                    (number(&format!("{key}/intercept_mm"), Some(row.intercept_mm)))
                    (number(&format!("{key}/r_squared"), row.r_squared))
                    (number(&format!("{key}/residual_sd_mm"), row.residual_sd_mm))
                }
            } }
        } } }
    }
}

/// Trials that do not count, with the reason. In the middle of a campaign most are not done yet: consecutive ones form
/// one row.
fn stretches(evaluation: &Evaluation) -> Vec<(&[TrialRow], &str)> {
    let waits = |row: &TrialRow| row.reason.as_deref() == Some(NOT_DONE);
    let together = |one: &TrialRow, next: &TrialRow| waits(one) && waits(next);
    let rows = evaluation.trials.chunk_by(together);
    rows.filter_map(|rows| Some((rows, rows.first()?.reason.as_deref()?)))
        .collect()
}

fn notice((rows, why): (&[TrialRow], &str)) -> String {
    match rows {
        [first, .., last] => format!(
            "trials {} to {} do not count: {why}",
            first.trial, last.trial
        ),
        rows => format!("trial {} does not count: {why}", rows[0].trial),
    }
}

fn omitted(evaluation: &Evaluation) -> Markup {
    let omitted = stretches(evaluation);
    let fallen = || evaluation.attempts.iter().filter(|row| !row.stands);
    html! {
        @if omitted.is_empty() { p { "Every trial of the plan counts." } }
        @else { div.wide { table {
            thead { tr { th { "trial" } th { "condition" } th { "why it does not count" } } }
            tbody { @for (rows, why) in omitted { tr {
                @match rows {
                    [first, .., last] => {
                        td { (first.trial) " to " (last.trial) }
                        td { (rows.len()) " trials" }
                    }
                    rows => {
                        td { (rows[0].trial) }
                        td { (condition_text(&rows[0])) }
                    }
                }
                td { (why) }
            } } }
        } } }
        @if fallen().next().is_some() {
            h3 { "Attempts that do not count" }
            div.wide { table {
                thead { tr { th { "trial" } th { "attempt" } th { "began (UTC)" } th { "ended" } th { "why" } } }
                tbody { @for row in fallen() { tr {
                    td { (row.trial) } td { (row.attempt) } td { (row.began_utc) }
                    td { (row.outcome.map_or("open", |outcome| outcome.name())) }
                    td { (row.reason.as_deref().unwrap_or("")) }
                } } }
            } }
        }
    }
}

fn condition_text(row: &TrialRow) -> String {
    format!(
        "{}, {}, {}, repeat {}",
        row.lubrication.name(),
        row.indentation,
        row.shape.name(),
        row.repeat
    )
}

fn setting(evaluation: &Evaluation) -> Markup {
    let plan = &evaluation.campaign.plan;
    let metadata = &plan.metadata;
    let resolution = metadata.caliper_resolution_mm;
    html! {
        (page::rows([
            ("operator", metadata.operator.clone()),
            ("specimen", metadata.specimen.clone()),
            ("silicone", metadata.silicone.clone()),
            ("soap", metadata.soap.clone()),
            ("camera", metadata.camera.clone()),
            ("caliper", format!("{}, resolves {resolution} mm", metadata.caliper)),
            ("run", format!("{} cycles of {} mm in {} s", plan.run.cycles, decimal::write(plan.run.stroke_um.into(), 3), plan.run_s())),
            ("order", format!("blocks, dry before lubricated, shuffled by seed {}", plan.seed)),
        ]))
        h3 { "Caliper" }
        @if evaluation.readings.is_empty() { p { "No accepted readings yet." } }
        @else { div.wide { table {
            thead { tr { th { "set" } th { "width" } th.n { "n" } th.n { "mean / mm" } th.n { "SD / mm" } th.n { "spread / mm" } th.n { "a = (D - i)/2 / mm" } } }
            tbody { @for row in &evaluation.readings {
                @let key = format!("readings/{}", row.readings_set);
                tr {
                    td { (row.readings_set) }
                    td { @match (row.quantity, &row.indentation) {
                        (Quantity::Width, _) => "D",
                        (Quantity::BetweenCrests, name) => { "i of " (name.as_deref().unwrap_or("-")) },
                    } }
                    (number(&format!("{key}/n"), Some(row.n)))
                    (number(&format!("{key}/mean_mm"), Some(row.mean_mm)))
                    (number(&format!("{key}/sd_mm"), row.sd_mm))
                    (number(&format!("{key}/spread_mm"), Some(row.spread_mm)))
                    (number(&format!("{key}/indentation_mm"), row.indentation_mm))
                }
            } }
        } } }
    }
}

fn totals(evaluation: &Evaluation) -> Markup {
    let rows = || evaluation.trials.iter();
    let sum = |of: fn(&TrialRow) -> Option<u64>| rows().filter_map(of).sum::<u64>();
    let worst = rows()
        .filter_map(|row| row.worst_residual_steps)
        .map(i32::unsigned_abs)
        .max();
    let deviation = rows()
        .filter_map(|row| row.greatest_deviation_mm)
        .reduce(|a, b| if b.0 > a.0 { b } else { a });
    let (commanded, counted) = (sum(|row| row.commanded_steps), sum(|row| row.counted_steps));
    let energy = rows().any(|row| row.energy_mj.is_some());
    html! {
        div.wide.short { table { tbody {
            tr { th { "trials that were run" } td.n { (cell("totals/run", rows().filter(|row| row.counted_steps.is_some()).count())) } }
            tr { th { "attempts" } td.n { (cell("totals/attempts", evaluation.attempts.len())) } }
            tr { th { "steps commanded" } td.n { (cell("totals/commanded_steps", commanded)) } }
            tr { th { "steps counted at the pin" } td.n { (cell("totals/counted_steps", counted)) } }
            tr { th { "largest residual of the step-loss check, steps" } (number("totals/worst_residual_steps", worst)) }
            tr { th { "largest difference from the plan, mm" } (number("totals/greatest_deviation_mm", deviation)) }
            tr { th { "false pulses on the limit inputs" } td.n { (cell("totals/glitches", sum(|row| row.glitches.map(u64::from)))) } }
            tr { th { "holds" } td.n { (cell("totals/holds", sum(|row| row.holds.map(u64::from)))) } }
            tr { th { "samples lost on the link" } td.n { (cell("totals/lost_samples", sum(|row| row.lost_samples))) } }
            tr { th { "energy of the capsule's motor, mJ" } (number("totals/energy_mj", energy.then(|| sum(|row| row.energy_mj.map(u64::from))))) }
        } } }
        @if commanded != counted { p.bad { "Commanded and counted steps differ." } }
    }
}

fn all_trials(evaluation: &Evaluation) -> Markup {
    html! {
        div.wide { table {
            thead { tr {
                th.n { "trial" } th { "walls" } th { "place" } th { "shape" } th.n { "a / mm" } th.n { "displacement / mm" } th.n { "steps" }
                th.n { "residual / steps" } th.n { "from plan / mm" } th { "" }
            } }
            tbody { @for row in &evaluation.trials {
                @let key = format!("trials/{}", row.trial);
                tr {
                    td.n { @if row.samples.is_some() { a href={ "#trial-" (row.trial) } { (row.trial) } } @else { (row.trial) } }
                    td { (row.lubrication.name()) } td { (row.indentation) } td { (row.shape.name()) }
                    (number(&format!("{key}/indentation_mm"), row.indentation_mm))
                    (number(&format!("{key}/displacement_mm"), row.displacement_mm))
                    (number(&format!("{key}/counted_steps"), row.counted_steps))
                    (number(&format!("{key}/worst_residual_steps"), row.worst_residual_steps))
                    (number(&format!("{key}/greatest_deviation_mm"), row.greatest_deviation_mm))
                    td { @if row.counts { span.ok { "counts" } } @else { "does not count" } }
                }
            } }
        } }
    }
}

fn trial(evaluation: &Evaluation, row: &TrialRow, parts: &[Part]) -> Result<Markup, ReportError> {
    let name = format!("Trial {}: {}", row.trial, condition_text(row));
    let svg = match run_of(parts) {
        Some(run) => run_over_plan(&name, run)?,
        None => None,
    };
    let caption = "The carriage by the read-back counter over the plan, and the one less the other. Time 0 is the run's start.";
    let key = format!("trials/{}", row.trial);
    Ok(html! {
        // The link's target is in the folded part, so that a browser opens it.
        details.trial open[row.reason.is_some()] {
            summary { (name) (page::tag(evaluation.origin)) }
            div.within id={ "trial-" (row.trial) } {
            @if let Some(why) = &row.reason { p.bad { (why) } }
            (figure(svg.as_deref(), "No telemetry with a plan: no figure.", caption))
            div.facts {
            div.wide.short { table { tbody {
                tr { th { "displacement / mm" } (number(&format!("{key}/displacement_mm"), row.displacement_mm)) }
                tr { th { "steps planned" } (number(&format!("{key}/planned_steps"), row.planned_steps)) }
                tr { th { "steps commanded" } (number(&format!("{key}/commanded_steps"), row.commanded_steps)) }
                tr { th { "steps counted at the pin" } (number(&format!("{key}/counted_steps"), row.counted_steps)) }
                tr { th { "largest difference from the plan / mm" } (number(&format!("{key}/greatest_deviation_mm"), row.greatest_deviation_mm)) }
                tr { th { "duration less the plan's, ticks of 10 ns" } (number(&format!("{key}/late_ticks"), row.late_ticks)) }
                tr { th { "false pulses" } (number(&format!("{key}/glitches"), row.glitches)) }
                tr { th { "holds" } (number(&format!("{key}/holds"), row.holds)) }
                tr { th { "samples" } (number(&format!("{key}/samples"), row.samples)) }
                tr { th { "samples lost on the link" } (number(&format!("{key}/lost_samples"), row.lost_samples)) }
                @if row.energy_mj.is_some() { tr { th { "energy of the capsule's motor / mJ" } (number(&format!("{key}/energy_mj"), row.energy_mj)) } }
            } } }
            @for part in parts {
                p {
                    (evaluation.within(&part.sidecar)) ": " (status(&part.trial, &part.defects)) br;
                    span.hash { "SHA-256 " (evaluation.hash(&part.sidecar).unwrap_or_else(|| "not listed".to_owned())) }
                }
                (reasons(&part.defects.all()))
            }
            }
            }
        }
    })
}

fn provenance(evaluation: &Evaluation) -> Markup {
    html! {
        (page::rows([
            ("origin", evaluation.origin.meaning().to_owned()),
            ("recorded by", evaluation.tools.join(", ")),
            ("reported by", client::identity::tool()),
        ]))
        @for note in &evaluation.campaign.state.notes { p { "Note: " (note) } }
        @if !evaluation.devices.is_empty() {
            h3 { "Machines" }
            div.wide { table {
                thead { tr { th { "machine" } th { "origin" } th { "UID" } th { "firmware" } th { "protocol" } th { "start" } } }
                tbody { @for device in &evaluation.devices { tr {
                    td { (device.device) } td { (device.origin) } td.hash { (device.uid) }
                    td { (device.firmware) " (" (device.profile) ")" } td { (device.protocol) }
                    td { (device.boot_id) ", " (device.reset_cause) }
                } } }
            } }
        }
        @for [name, image, commissioning] in &evaluation.rigs {
            p {
                @if name.is_empty() { "A rig without a name" } @else { "Rig " (name) }
                ", image " (image) ", commissioning: " (commissioning) "."
            }
        }
        h3 { "Files" }
        p.hash { (hash_of_list(&evaluation.manifest_sha256)) }
        details {
            summary { (evaluation.manifest.0.len()) " files, with their SHA-256" }
            div.wide { table {
                thead { tr { th { "file" } th { "SHA-256, as listed" } } }
                tbody { @for (path, hash) in &evaluation.manifest.0 { tr { td { (path) } td.hash { (manifest::hex(hash)) } } } }
            } }
        }
    }
}

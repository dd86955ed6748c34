//! The report: recorded trials as one self-contained HTML file.
//!
//! Shows contradictions in a record in red with the reason, and lists every omitted file with the reason.

pub mod campaign;
mod campaign_figures;
pub mod evaluation;
mod page;
pub mod remark;
pub mod section;

use std::fs;
use std::path::{Path, PathBuf};

use client::identity::Origin;
use client::named;
use lab::campaign::files::is_record;
use lab::trials::sidecar::{heading, other};
use lab::trials::trial::{RecordError, Status, TrialRecord};
use maud::html;
use miette::Diagnostic;

use crate::figures::FigureError;
use crate::html::remark::Remark;
use crate::html::section::{in_short, reasons, remark_table, section, status};

#[derive(Debug, thiserror::Error, Diagnostic)]
pub enum ReportError {
    #[error(transparent)]
    #[diagnostic(transparent)]
    Record(#[from] RecordError),
    #[error("{path}: {why}", path = path.display())]
    #[diagnostic(code(retrograde::report), help("{remedy}, then try again"))]
    Unwritten {
        path: PathBuf,
        why: String,
        remedy: &'static str,
    },
    #[error(transparent)]
    #[diagnostic(code(retrograde::figure))]
    Figure(#[from] FigureError),
    #[error("no trial in {path}{}", besides(.omitted), path = path.display())]
    #[diagnostic(
        code(retrograde::no_trials),
        help("give a folder with records of `retrograde run`, or their JSON files")
    )]
    NoTrials {
        path: PathBuf,
        /// Other files found at these paths.
        omitted: Vec<Omitted>,
    },
    /// The report would overwrite a record.
    #[error("{path} is one of the records; nothing was written", path = path.display())]
    #[diagnostic(
        code(retrograde::own_record),
        help("name another file: `--out FILE.html`")
    )]
    OwnRecord { path: PathBuf },
    /// A file of this name already exists.
    #[error("{path} is there already; nothing was written", path = path.display())]
    #[diagnostic(
        code(retrograde::exists),
        help("`--force` replaces it, `--out` names another")
    )]
    Exists { path: PathBuf },
}

/// Lists the other files of a folder without trials.
fn besides(omitted: &[Omitted]) -> String {
    let lines = omitted.iter().map(|omitted| format!("\n  {omitted}"));
    lines.collect()
}

/// A file that is not in the report.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error, serde::Serialize)]
#[error("{} is omitted: {why}", path.display())]
pub struct Omitted {
    #[serde(serialize_with = "client::wording::path")]
    pub path: PathBuf,
    pub why: String,
    /// Whether the file is part of a trial's record, not of another kind.
    pub is_record: bool,
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Found {
    pub sidecars: Vec<PathBuf>,
    /// Other files beside them, with the reasons for omitting them.
    pub omitted: Vec<Omitted>,
}

/// What happens to a report that already exists.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Existing {
    /// Keep it, and write nothing.
    Keep,
    /// Replace it by renaming: a reader finds the old one or the new one.
    Replace,
}

/// A trial whose record contradicts itself or is incomplete.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Damaged {
    #[serde(serialize_with = "client::wording::path")]
    pub sidecar: PathBuf,
    pub defects: Vec<String>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Report {
    pub html: String,
    /// Trials on the page with contradictory records.
    pub damaged: Vec<Damaged>,
}

/// Finds the trials at these paths; a folder stands for all its trials, in the order of their start. Lists all other
/// files of a folder with the reason.
pub fn find(paths: &[PathBuf]) -> Result<Found, ReportError> {
    let mut all = Found::default();
    for path in paths {
        if !path.is_dir() {
            all.sidecars.push(path.clone());
            continue;
        }
        let read = || fs::read_dir(path)?.map(|entry| Ok(entry?.path())).collect();
        let files: std::io::Result<Vec<_>> = read();
        let mut files = files.map_err(|io| RecordError::read(path, io))?;
        files.sort();
        let (mut trials, mut omitted) = (vec![], vec![]);
        for file in files {
            match belongs(&file) {
                Ok(Some(trial)) => trials.push((trial.started_utc, file)),
                Ok(None) => {}
                Err((why, is_record)) => omitted.push(Omitted {
                    path: file,
                    why,
                    is_record,
                }),
            }
        }
        trials.sort();
        if trials.is_empty() {
            return Err(ReportError::NoTrials {
                path: path.clone(),
                omitted,
            });
        }
        all.sidecars
            .extend(trials.into_iter().map(|(_, file)| file));
        all.omitted.extend(omitted);
    }
    Ok(all)
}

/// Classifies a file: a trial if it is a sidecar of an action that began; none if it needs no mention; otherwise why it
/// is omitted, and whether it is part of a trial's record.
fn belongs(file: &Path) -> Result<Option<TrialRecord>, (String, bool)> {
    let name = file.file_name().unwrap_or_default().to_string_lossy();
    let is_record = is_record(&name);
    let is = |wanted: &str| {
        file.extension()
            .is_some_and(|extension| extension == wanted)
    };
    if is("part") {
        return Err((
            "what is left of a write that was cut off".to_owned(),
            is_record,
        ));
    }
    if is("csv") {
        // Files beside a sidecar are reported with it.
        return if file.with_extension("json").exists() {
            Ok(None)
        } else {
            Err(("no sidecar of this name is beside it".to_owned(), is_record))
        };
    }
    if !is("json") {
        return Ok(None);
    }
    let trial = TrialRecord::read(file).map_err(|error| match other(file) {
        Some(kind) => (kind, false),
        None => (error.why, true),
    })?;
    let named = Path::new(&trial.telemetry).with_extension("json");
    let name = file.file_name().unwrap_or_default();
    if named.as_os_str() != name {
        let why = format!(
            "it was renamed: its telemetry is {}, so its name was {}",
            trial.telemetry,
            named.display()
        );
        return Err((why, true));
    }
    if trial.status == Status::Refused && !trial.has_begun() {
        let why = trial.error.unwrap_or_else(|| "it was refused".to_owned());
        return Err((format!("nothing was done: {why}"), false));
    }
    Ok(Some(trial))
}

/// Writes the report of these trials.
///
/// # Errors
/// A record cannot be read, the report already exists, or it cannot be written. Nothing has changed then.
pub fn write(
    found: &Found,
    remarks: &[Remark],
    out: &Path,
    existing: Existing,
) -> Result<Report, ReportError> {
    // Check before the work; `put` checks again at the end, in case a file has appeared.
    if existing == Existing::Keep && out.exists() && !named::is_device(out) {
        return Err(ReportError::Exists {
            path: out.to_owned(),
        });
    }
    let is_out = |file: &Path| match (file.canonicalize(), out.canonicalize()) {
        (Ok(file), Ok(out)) => file == out,
        _ => false,
    };
    let own = |file: &PathBuf| is_out(file) || is_out(&file.with_extension("csv"));
    if found.sidecars.iter().any(own) {
        return Err(ReportError::OwnRecord {
            path: out.to_owned(),
        });
    }
    let report = html(found, remarks)?;
    put(out, report.html.as_bytes(), existing)?;
    Ok(report)
}

/// Writes a file of a report completely or not at all.
fn put(path: &Path, bytes: &[u8], existing: Existing) -> Result<(), ReportError> {
    if let Some(folder) = path
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty())
    {
        fs::create_dir_all(folder).map_err(|io| unwritten(folder, &io))?;
    }
    named::write(path, existing == Existing::Replace, |out| {
        out.write_all(bytes)
    })
    .map_err(|io| not_written(path, &io))
}

pub(crate) fn unwritten(path: &Path, why: &std::io::Error) -> ReportError {
    ReportError::Unwritten {
        path: path.to_owned(),
        why: why.to_string(),
        remedy: named::remedy(why),
    }
}

/// Why a file of a report was not written.
pub(crate) fn not_written(path: &Path, io: &std::io::Error) -> ReportError {
    match io.kind() {
        std::io::ErrorKind::AlreadyExists => ReportError::Exists {
            path: path.to_owned(),
        },
        _ => unwritten(path, io),
    }
}

pub fn html(found: &Found, remarks: &[Remark]) -> Result<Report, ReportError> {
    let mut trials = vec![];
    for sidecar in &found.sidecars {
        trials.push((sidecar, TrialRecord::read(sidecar)?));
    }
    let mut sections = vec![];
    for (sidecar, trial) in &trials {
        let of_trial = remarks
            .iter()
            .filter(|remark| remark.sidecar.as_ref() == Some(sidecar));
        sections.push(section(sidecar, trial, of_trial)?);
    }
    let general = remarks.iter().filter(|remark| remark.sidecar.is_none());
    let origins: Vec<Origin> = trials
        .iter()
        .map(|(_, trial)| trial.device.origin)
        .collect();
    let title = "Retrograde: report";
    let body = html! {
        (page::banner(&origins))
        h1 { (title) }
        div.wide { table {
            thead { tr { th { "trial" } th { "started (UTC)" } th { "note" } th { "ended" } th { "summary" } } }
            tbody {
                @for (index, ((_, trial), section)) in trials.iter().zip(&sections).enumerate() {
                    tr {
                        td { a href={ "#trial-" (index + 1) } { (heading(trial)) } (page::tag(trial.device.origin)) }
                        td { (trial.started_utc.strftime("%Y-%m-%d %H:%M:%S")) }
                        td { (trial.note.as_deref().unwrap_or("")) }
                        td { (status(trial, &section.defects)) }
                        td { (in_short(trial)) }
                    }
                }
            }
        } }
        @if !found.omitted.is_empty() {
            h3 { "Omitted" }
            (reasons(&found.omitted.iter().map(ToString::to_string).collect::<Vec<_>>()))
        }
        @for remark in general { (remark_table(remark)) }
        @for (index, section) in sections.iter().enumerate() {
            section id={ "trial-" (index + 1) } { (section.body) }
        }
    };
    let damaged = found.sidecars.iter().zip(sections);
    Ok(Report {
        html: page::page(title, &body),
        damaged: damaged
            .map(|(sidecar, section)| Damaged {
                sidecar: sidecar.clone(),
                defects: section.defects.all(),
            })
            .filter(|damaged| !damaged.defects.is_empty())
            .collect(),
    })
}

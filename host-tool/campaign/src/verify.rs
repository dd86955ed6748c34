//! Finds every change of a folder since this program wrote it: compares the manifest, and the files with each other.

use std::path::Path;
use std::{fs, io};

use trials::trial::{Action, CapsuleSample, RigSample, Status, Trial};

use crate::CampaignError;
use crate::contents::Campaign;
use crate::differences::{COPY, Differences, Finding, UNKNOWN, read_manifest};
use crate::files::{ATTEMPTS, ORDER, PLAN, READINGS, TRIALS};
use crate::ledger::{Attempt, Outcome};
use crate::manifest::{self, contents};

/// Result of a verification.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Verified {
    /// Whether it is the folder of a campaign.
    pub campaign: bool,
    /// Number of files whose hashes were compared.
    pub files: usize,
    /// Number of trial records whose contents were checked.
    pub records: usize,
    /// All findings.
    pub findings: Vec<Finding>,
}

/// Looks through a folder and changes nothing.
///
/// # Errors
/// The folder cannot be read, or holds neither a campaign nor records nor a manifest.
pub fn verify(folder: &Path) -> Result<Verified, CampaignError> {
    if !folder.is_dir() {
        return Err(CampaignError::misuse(
            folder,
            "there is no such folder",
            "give the folder of a campaign, or of records",
        ));
    }
    let campaign = [PLAN, ORDER, TRIALS, READINGS]
        .iter()
        .filter(|name| folder.join(name).exists())
        .count()
        >= 2;
    let read =
        |io: io::Error| CampaignError::new(folder, io, "make the folder readable, then again");
    let mut verified = Verified {
        campaign,
        files: 0,
        records: 0,
        findings: vec![],
    };
    match read_manifest(folder) {
        Ok(Some(manifest)) => {
            let differences = Differences::between(folder, &manifest).map_err(read)?;
            verified.files = differences.compared;
            verified.findings = differences.findings(&manifest);
        }
        Ok(None) if campaign => verified.findings.push(Finding::new(
            manifest::NAME,
            "is missing",
            "restore it from a copy; without it nothing shows that the other files were not changed",
        )),
        Ok(None) => {}
        Err(error) => verified
            .findings
            .push(Finding::new(manifest::NAME, error.why, COPY)),
    }
    if campaign {
        contradictions(folder, &mut verified);
    } else {
        let records = contents(folder).map_err(read)?;
        for path in records.files {
            check_record(folder, &path, &mut verified);
        }
    }
    Ok(verified)
}

/// Adds findings on contradictions between the files of a campaign.
fn contradictions(folder: &Path, verified: &mut Verified) {
    let campaign = match Campaign::read(folder) {
        Ok(campaign) => campaign,
        Err(error) => {
            let path = error.path.strip_prefix(folder).unwrap_or(&error.path);
            let path = path.to_string_lossy().into_owned();
            // The manifest reports the change; this adds its consequence.
            verified
                .findings
                .push(Finding::new(&path, error.why, &error.remedy));
            return;
        }
    };
    let mut known = vec![];
    for trial in &campaign.state.trials {
        let number = trial.planned.trial;
        for attempt in &trial.attempts {
            let name = Attempt::folder(number, attempt.number);
            let path = format!("{ATTEMPTS}/{name}");
            known.push(name);
            let mut statuses = vec![];
            for file in list(&folder.join(&path)) {
                let file = format!("{path}/{file}");
                let is_motion = ["/run-", "/pass-"].iter().any(|stem| file.contains(stem));
                if let Some(record) = check_record(folder, &file, verified)
                    && is_motion
                {
                    statuses.push(record.status);
                }
            }
            let says = statuses.first().copied().map(Outcome::from);
            let what = match (attempt.outcome, says) {
                _ if statuses.len() > 1 => "has the records of several runs or passes".to_owned(),
                (Some(Outcome::Complete), None) => {
                    format!("{TRIALS} says that it was completed, and there is no record of it")
                }
                (Some(Outcome::Complete), Some(says)) if says != Outcome::Complete => {
                    format!(
                        "{TRIALS} says that it was completed, its record says {}",
                        says.name()
                    )
                }
                (None, _) => {
                    "the attempt has not ended: `retrograde campaign resume` ends it".to_owned()
                }
                _ => continue,
            };
            verified.findings.push(Finding::new(&path, what, COPY));
        }
    }
    for name in list(&folder.join(ATTEMPTS)) {
        if !known.contains(&name) {
            let path = format!("{ATTEMPTS}/{name}");
            let what = format!("{TRIALS} knows no such attempt");
            verified.findings.push(Finding::new(&path, what, UNKNOWN));
        }
    }
}

/// Names in a folder; none if it cannot be read.
fn list(folder: &Path) -> Vec<String> {
    let Ok(entries) = fs::read_dir(folder) else {
        return vec![];
    };
    let mut names: Vec<String> = entries
        .flatten()
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

/// Checks a trial's record; none if the path is not one.
fn check_record(folder: &Path, path: &str, verified: &mut Verified) -> Option<Trial> {
    let full = folder.join(path);
    if !path.ends_with(".json") || !full.with_extension("csv").exists() {
        return None;
    }
    match Trial::read(&full) {
        Ok(trial) => {
            verified.records += 1;
            let csv = format!("{}csv", path.strip_suffix("json").unwrap_or(path));
            if let Some(what) = telemetry(&trial, &full) {
                verified.findings.push(Finding::new(&csv, what, COPY));
            }
            Some(trial)
        }
        // Summaries of other kinds also lie beside CSV files.
        Err(_) if !is_trial(path) => None,
        Err(error) => {
            verified.findings.push(Finding::new(path, error.why, COPY));
            None
        }
    }
}

/// Whether the name is one that `run`, `fold` and similar commands give.
fn is_trial(path: &str) -> bool {
    let name = path.rsplit('/').next().unwrap_or(path);
    let stems = [
        "run-",
        "pass-",
        "fold-",
        "unfold-",
        "reference-",
        "calibrate-",
        "check-folded-",
    ];
    stems.iter().any(|stem| name.starts_with(stem))
}

/// A contradiction between sidecar and telemetry; none if the telemetry is complete and in order.
fn telemetry(trial: &Trial, sidecar: &Path) -> Option<String> {
    let beside = sidecar.with_extension("csv");
    if beside
        .file_name()
        .is_none_or(|name| name.to_string_lossy() != trial.telemetry)
    {
        return Some(format!(
            "the record names {} as its telemetry",
            trial.telemetry
        ));
    }
    let times = match &trial.action {
        Action::Run { .. } | Action::Move { .. } => trial
            .samples::<RigSample>(sidecar)
            .map(|rows| rows.iter().map(|row| row.time_us).collect::<Vec<_>>()),
        Action::Actuation { .. } => trial
            .samples::<CapsuleSample>(sidecar)
            .map(|rows| rows.iter().map(|row| row.time_us).collect()),
    };
    let times = match times {
        Ok(times) => times,
        Err(error) => return Some(error.why),
    };
    if !times.is_sorted_by(|before, after| before < after) {
        return Some("its rows are not in the order of time".to_owned());
    }
    // The number of samples is written at the end; until then the file grows.
    if trial.status != Status::Running && times.len() as u64 != trial.samples {
        return Some(format!(
            "it has {} rows, the record says {}",
            times.len(),
            trial.samples
        ));
    }
    None
}

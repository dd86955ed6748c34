//! Finds every change of a folder since this program wrote it: compares the manifest, and the files with each other.
//!
//! Whoever rebuilds the manifest and keeps all files in agreement is found by nobody but the holder of an earlier
//! [`seal`]. The report uses this too: one list of checks.

use std::path::Path;
use std::{fs, io};

use trials::check;
use trials::trial::Trial;

use crate::CampaignError;
use crate::contradictions::contradictions;
use crate::differences::{COPY, Differences, Finding, read_manifest};
use crate::files::{ORDER, PLAN, READINGS, TRIALS};
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

/// The hash of a folder's manifest, 64 hex digits: kept or sent elsewhere, it shows that the folder is still the same.
///
/// # Errors
/// There is no manifest, or it cannot be read.
pub fn seal(folder: &Path) -> Result<String, CampaignError> {
    let path = folder.join(manifest::NAME);
    let hash = manifest::hash_file(&path).map_err(|io| CampaignError::new(&path, io, COPY))?;
    Ok(manifest::hex(&hash))
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
        .filter(|name| fs::symlink_metadata(folder.join(name)).is_ok())
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

/// Checks a trial's record; none if the path is not one.
pub(crate) fn check_record(folder: &Path, path: &str, verified: &mut Verified) -> Option<Trial> {
    let full = folder.join(path);
    if !path.ends_with(".json") || fs::symlink_metadata(full.with_extension("csv")).is_err() {
        return None;
    }
    match Trial::read(&full) {
        Ok(trial) => {
            verified.records += 1;
            for what in check::contradictions(&full, &trial) {
                verified.findings.push(Finding::new(path, what, COPY));
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

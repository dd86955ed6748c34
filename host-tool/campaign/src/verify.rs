//! Finds every change of a folder since this program wrote it: compares the manifest, and the files with each other.
//!
//! It cannot find a change by somebody who rebuilds the manifest and keeps all files in agreement. The report uses the
//! same checks.

use std::path::Path;
use std::{fs, io};

use crate::CampaignError;
pub use crate::contradictions::Verified;
use crate::contradictions::{check_record, contradictions};
use crate::differences::{COPY, Differences, Finding, read_manifest};
use crate::files::{ORDER, PLAN, READINGS, TRIALS};
use crate::manifest::{self, contents};

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
        unended: vec![],
        findings: vec![],
    };
    match read_manifest(folder) {
        Ok(Some(manifest)) => {
            let differences = Differences::between(folder, &manifest).map_err(read)?;
            verified.files = differences.compared;
            verified.findings = differences.findings(folder, &manifest);
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

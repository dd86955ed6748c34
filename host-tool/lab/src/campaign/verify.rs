//! Finds every change of a folder since this program wrote it: compares the manifest, and the files with each other.
//!
//! It cannot find a change by somebody who rebuilds the manifest and keeps all files in agreement. The report uses the
//! same checks.

use std::path::Path;
use std::{fs, io};

use crate::campaign::CampaignError;
pub use crate::campaign::contradictions::Verified;
use crate::campaign::contradictions::{check_record, contradictions};
use crate::campaign::differences::{COPY, Differences, Finding, STRANGE, UNKNOWN, read_manifest};
use crate::campaign::files::{ORDER, PLAN, READINGS, TRIALS, is_record};
use crate::campaign::manifest::{self, Contents, contents};

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
        let there = contents(folder).map_err(read)?;
        for path in &there.files {
            check_record(folder, path, &mut verified);
        }
        verified.findings.extend(incomplete(&there));
    }
    Ok(verified)
}

/// Records of which a part is missing or a link. Other links in a folder of records are the user's business.
fn incomplete(there: &Contents) -> Vec<Finding> {
    let of_records = |path: &&String| is_record(path.rsplit('/').next().unwrap_or(path));
    let links = there.strange.iter().filter(of_records);
    let links = links.map(|path| Finding::new(path, STRANGE, UNKNOWN));
    // Both lists are sorted.
    let is_there = |path: &String| {
        [&there.files, &there.strange]
            .iter()
            .any(|list| list.binary_search(path).is_ok())
    };
    let halves = there.files.iter().filter(of_records).filter_map(|path| {
        let (other, what) = if let Some(stem) = path.strip_suffix(".json") {
            (format!("{stem}.csv"), "its telemetry is missing")
        } else {
            let stem = path.strip_suffix(".csv")?;
            (format!("{stem}.json"), "its sidecar is missing")
        };
        (!is_there(&other)).then(|| Finding::new(path, what, COPY))
    });
    links.chain(halves).collect()
}

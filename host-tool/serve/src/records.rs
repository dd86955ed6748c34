//! Lists records and opens them for download.

use std::path::Path as FilePath;

use client::plain;
use lab::trials::listing::Listing;
use lab::trials::sidecar::heading;
use lab::trials::trial::TrialRecord;
use serde_json::{Value, json};

/// Lists the records in a folder, the oldest first.
pub fn list(folder: &FilePath) -> Value {
    let mut found = Listing::read(folder);
    found.trials.sort_by_key(|(_, trial)| trial.started_utc);
    let name = |path: &FilePath| {
        path.file_name()
            .map(|name| name.to_string_lossy().into_owned())
    };
    let records: Vec<_> = found
        .trials
        .iter()
        .map(|(sidecar, trial)| {
            let csv = sidecar.with_extension("csv");
            json!({
                "name": name(sidecar),
                "kind": "trial",
                "started_utc": trial.started_utc,
                "what": heading(trial),
                "note": trial.note,
                "outcome": trial.status.name(),
                "whole": trial.not_whole().is_none(),
                "origin": trial.device.origin,
                "csv": plain::is_file(&csv).then(|| name(&csv)),
            })
        })
        .collect();
    json!({ "records": records, "unreadable": found.unreadable })
}

/// Whether a name has the form of this program's records.
pub fn is_record(name: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    !name.starts_with('.')
        && name.chars().all(plain)
        && (name.ends_with(".csv") || name.ends_with(".json"))
}

/// Opens a file of a trial's record. Other files in the folder are not accessible over HTTP.
pub fn open(path: &FilePath) -> Option<std::fs::File> {
    let sidecar = path.with_extension("json");
    let trial = TrialRecord::read(&sidecar).ok()?;
    let is_part = path == sidecar || *path.file_name()? == *trial.telemetry;
    is_part.then(|| plain::open(path).ok())?
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn only_files_of_a_trial_are_handed_out() {
        let place = tempfile::tempdir().expect("a folder");
        let file = |name: &str| place.path().join(name);
        fs::write(file("secret.json"), "{\"password\": 1}").expect("written");
        fs::write(file("secret.csv"), "password\n1\n").expect("written");
        for name in ["secret.json", "secret.csv", "none.json"] {
            assert!(open(&file(name)).is_none(), "{name}");
        }
    }
}

//! Lists records and hands them out.

use std::path::{Path as FilePath, PathBuf};

use campaign::catalogue::{self, Kind, Wanted};
use client::plain;
use serde_json::{Value, json};
use trials::trial::Trial;

/// Lists the records in a folder.
pub fn list(folder: &FilePath) -> Value {
    let folders = [folder.to_owned()];
    let found = catalogue::list(&folders, false, &Wanted::default());
    let name = |path: &FilePath| {
        path.file_name()
            .map(|name| name.to_string_lossy().into_owned())
    };
    let records: Vec<_> = found
        .entries
        .iter()
        .filter(|entry| entry.kind == Kind::Trial && entry.path.parent() == Some(folder))
        .map(|entry| {
            let csv = entry.path.with_extension("csv");
            json!({
                "name": name(&entry.path),
                "kind": "trial",
                "started_utc": entry.started_utc,
                "what": entry.what,
                "note": entry.specimen,
                "outcome": entry.outcome,
                "origin": entry.origin,
                "csv": plain::is_file(&csv).then(|| name(&csv)),
            })
        })
        .collect();
    json!({ "records": records, "unreadable": found.unreadable })
}

/// Whether a name has the form that this program gives to records.
pub fn is_record(name: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    !name.starts_with('.')
        && name.chars().all(plain)
        && (name.ends_with(".csv") || name.ends_with(".json"))
}

/// Opens a file of a trial's record. Other files in the folder are not for everybody who can reach the server.
pub async fn open(path: PathBuf) -> Option<std::fs::File> {
    let opened = tokio::task::spawn_blocking(move || of_trial(&path));
    opened.await.ok()?
}

fn of_trial(path: &FilePath) -> Option<std::fs::File> {
    let sidecar = path.with_extension("json");
    let trial = Trial::read(&sidecar).ok()?;
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
            assert!(of_trial(&file(name)).is_none(), "{name}");
        }
    }
}

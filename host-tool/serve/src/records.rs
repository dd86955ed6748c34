//! Lists records and hands them out.

use std::path::{Path as FilePath, PathBuf};

use campaign::catalogue::{self, Kind, Wanted};
use serde_json::{Value, json};

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
                "csv": csv.is_file().then(|| name(&csv)),
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

/// Opens the file of a record.
pub async fn open(path: PathBuf) -> Option<std::fs::File> {
    let opened = tokio::task::spawn_blocking(move || {
        // Do not follow links: they could lead out of the folder.
        let found = std::fs::symlink_metadata(&path).ok()?;
        found.is_file().then(|| std::fs::File::open(&path).ok())?
    });
    opened.await.ok()?
}

//! The trials in a folder, and its unreadable records.

use std::fs;
use std::path::{Path, PathBuf};

use client::plain;

use crate::trials::sidecar::unreadable;
use crate::trials::trial::TrialRecord;

/// The content of one folder, without the folders below it.
#[derive(Debug, Default)]
pub struct Listing {
    /// Trials with their sidecars, by name.
    pub trials: Vec<(PathBuf, TrialRecord)>,
    /// Unreadable files, with the reasons.
    pub unreadable: Vec<String>,
    /// Folders, by name; links are skipped, because they could form a cycle.
    pub folders: Vec<PathBuf>,
}

impl Listing {
    #[must_use]
    pub fn read(folder: &Path) -> Self {
        let mut listing = Self::default();
        let mut within: Vec<PathBuf> = match fs::read_dir(folder) {
            Ok(entries) => entries.flatten().map(|entry| entry.path()).collect(),
            Err(io) => {
                let why = format!("{}: {io}", folder.display());
                listing.unreadable.push(why);
                return listing;
            }
        };
        within.sort();
        for path in within {
            if plain::is_folder(&path) {
                listing.folders.push(path);
            } else if path.extension().is_some_and(|kind| kind == "json") {
                match TrialRecord::read(&path) {
                    Ok(trial) => listing.trials.push((path, trial)),
                    // Other JSON records are ignored; an unreadable trial is reported.
                    Err(error) => listing.unreadable.extend(unreadable(&path, error)),
                }
            }
        }
        listing
    }
}

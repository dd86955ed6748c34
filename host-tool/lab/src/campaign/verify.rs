//! Checks a folder: the hash of every file, each record by itself, and each attempt against the ledger. The report uses
//! the same checks.

use std::path::Path;
use std::{fs, io};

use crate::trials::check;
use crate::trials::trial::{Action, TrialRecord};
use client::plain;

use crate::campaign::contents::Campaign;
use crate::campaign::files::{ATTEMPTS, ORDER, PLAN, READINGS, TRIALS, is_record};
use crate::campaign::ledger::{Attempt, AttemptOutcome, TrialState};
use crate::campaign::manifest::{self, COPY, Contents, Differences, contents};
use crate::campaign::{CampaignError, resumption};

#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Finding {
    /// The file, relative to the folder.
    pub path: String,
    pub what: String,
    pub remedy: String,
}

impl Finding {
    fn new(path: &str, what: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self {
            path: path.to_owned(),
            what: what.into(),
            remedy: remedy.into(),
        }
    }
}

impl std::fmt::Display for Finding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.path, self.what)
    }
}

const STRANGE: &str = "is neither a file nor a folder, or has a name that cannot be listed";
const REPEAT: &str = "once nothing records it any more, repeat the motion; `retrograde records fetch` has what the machine still knows of its last one";
const UNKNOWN: &str = "was it put there by hand? Move it elsewhere";

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Verified {
    pub campaign: bool,
    pub files: usize,
    pub records: usize,
    /// What differs from what was written.
    pub findings: Vec<Finding>,
    /// Records that are unchanged but incomplete. They do not complete a trial of a campaign.
    pub not_whole: Vec<Finding>,
}

/// Checks a folder and changes nothing.
pub fn verify(folder: &Path) -> Result<Verified, CampaignError> {
    if !folder.is_dir() {
        return Err(CampaignError::misuse(
            folder,
            "there is no such folder",
            "give the folder of a campaign, or of records",
        ));
    }
    let of_campaign = [PLAN, ORDER, TRIALS, READINGS].into_iter();
    let is_there = |name: &&str| fs::symlink_metadata(folder.join(name)).is_ok();
    let mut verified = Verified {
        campaign: of_campaign.filter(is_there).count() >= 2,
        ..Verified::default()
    };
    let read = |io: io::Error| CampaignError::new(folder, io, "make the folder readable");
    let campaign = verified.campaign.then(|| Campaign::read(folder));
    match manifest::read(folder) {
        Ok(Some(manifest)) => {
            let differences = Differences::between(folder, &manifest).map_err(read)?;
            let under_way = match &campaign {
                Some(Ok(campaign)) => under_way(campaign),
                _ => None,
            };
            verified.compared(folder, &differences, under_way.as_deref());
        }
        Ok(None) if verified.campaign => verified.find(
            manifest::NAME,
            "is missing",
            "restore it from a copy; without it nothing shows that the other files were not changed",
        ),
        Ok(None) => {}
        Err(error) => verified.find(manifest::NAME, error.why, COPY),
    }
    match campaign {
        Some(Ok(campaign)) => {
            for trial in &campaign.state.trials {
                for attempt in &trial.attempts {
                    verified.attempt(&campaign, trial, attempt);
                }
            }
        }
        Some(Err(error)) => verified.unreadable(folder, error),
        None => {
            let there = contents(folder).map_err(read)?;
            for path in &there.files {
                verified.record(folder, path);
            }
            verified.halves(&there);
        }
    }
    Ok(verified)
}

fn under_way(campaign: &Campaign) -> Option<String> {
    let attempts = campaign.state.trials.iter().flat_map(|trial| {
        let number = trial.planned.trial;
        trial.attempts.iter().map(move |attempt| (number, attempt))
    });
    let mut open = attempts.filter(|(_, attempt)| attempt.outcome.is_none());
    let (trial, attempt) = open.next()?;
    Some(attempt_path(trial, attempt))
}

fn attempt_path(trial: u32, attempt: &Attempt) -> String {
    format!("{ATTEMPTS}/{}", Attempt::folder(trial, attempt.number))
}

impl Verified {
    fn find(&mut self, path: &str, what: impl Into<String>, remedy: impl Into<String>) {
        self.findings.push(Finding::new(path, what, remedy));
    }

    /// Adds the differences from the manifest. `under_way` is the attempt in progress, whose files are listed once it
    /// has ended.
    fn compared(&mut self, folder: &Path, differences: &Differences, under_way: Option<&str>) {
        self.files = differences.compared;
        for (path, what) in &differences.damaged {
            self.find(path, what, COPY);
        }
        let goes_on = format!(
            "is a session under way? Otherwise it was cut off: {} takes this up",
            resumption(folder)
        );
        for path in &differences.grown {
            let what = format!("has more lines than {} lists", manifest::NAME);
            self.find(path, what, &goes_on);
        }
        for path in &differences.added {
            let is_within = under_way.is_some_and(|open| Path::new(path).starts_with(open));
            let remedy = if is_within { &*goes_on } else { UNKNOWN };
            self.find(path, format!("is not in {}", manifest::NAME), remedy);
        }
        for path in &differences.strange {
            self.find(path, STRANGE, UNKNOWN);
        }
        if let Some(path) = under_way {
            self.find(path, "the attempt has not ended", goes_on);
        }
    }

    /// Adds why a campaign cannot be read, unless the manifest has already reported the file as missing.
    fn unreadable(&mut self, folder: &Path, error: CampaignError) {
        let path = error.path.strip_prefix(folder).unwrap_or(&error.path);
        let path = path.to_string_lossy();
        let is_gone = fs::symlink_metadata(&error.path).is_err();
        if !is_gone || self.findings.iter().all(|found| found.path != path) {
            self.find(&path, error.why, error.remedy);
        }
    }

    /// Checks the records of an attempt, and whether they match the plan and the ledger.
    fn attempt(&mut self, campaign: &Campaign, state: &TrialState, attempt: &Attempt) {
        let path = attempt_path(state.planned.trial, attempt);
        let mut records = vec![];
        for file in plain::files(&campaign.folder.join(&path)) {
            let name = file.file_name().unwrap_or_default().to_string_lossy();
            if let Some(record) = self.record(&campaign.folder, &format!("{path}/{name}")) {
                records.push((name.into_owned(), record));
            }
        }
        for (name, record) in &records {
            let Action::Run { requested, .. } = &record.action else {
                continue;
            };
            if *requested != campaign.plan.run {
                self.find(&path, format!("{name} is not the run of the plan"), COPY);
            }
            let origin = record.device.origin;
            if let Some(of) = campaign.origin().filter(|of| *of != origin) {
                let what = format!("{name} is of origin {origin}, {TRIALS} of {of}");
                self.find(&path, what, COPY);
            }
        }
        if attempt.outcome == Some(AttemptOutcome::Complete)
            && let Some(what) = state.planned.incomplete(&records)
        {
            let what = format!("{TRIALS} says that it was completed, and {what}");
            self.find(&path, what, COPY);
        }
    }

    /// Checks a trial's record; none if the path is not one.
    fn record(&mut self, folder: &Path, path: &str) -> Option<TrialRecord> {
        let full = folder.join(path);
        if !path.ends_with(".json") || fs::symlink_metadata(full.with_extension("csv")).is_err() {
            return None;
        }
        match TrialRecord::read(&full) {
            Ok(trial) => {
                self.records += 1;
                if let Some(why) = trial.not_whole() {
                    self.not_whole.push(Finding::new(path, why, REPEAT));
                }
                for what in check::record(&full, &trial).contradictions {
                    self.find(path, what, COPY);
                }
                Some(trial)
            }
            // Other kinds of summaries also have a CSV file beside them.
            Err(_) if !is_record(path.rsplit('/').next().unwrap_or(path)) => None,
            Err(error) => {
                self.find(path, error.why, COPY);
                None
            }
        }
    }

    /// Adds records of which one file is missing or a link. Other links in a folder of records belong to the user.
    fn halves(&mut self, there: &Contents) {
        let of_records = |path: &&String| is_record(path.rsplit('/').next().unwrap_or(path));
        for path in there.strange.iter().filter(of_records) {
            self.find(path, STRANGE, UNKNOWN);
        }
        for path in there.files.iter().filter(of_records) {
            let (other, what) = if let Some(stem) = path.strip_suffix(".json") {
                (format!("{stem}.csv"), "its telemetry is missing")
            } else if let Some(stem) = path.strip_suffix(".csv") {
                (format!("{stem}.json"), "its sidecar is missing")
            } else {
                continue;
            };
            // Both lists are sorted.
            let lists = [&there.files, &there.strange];
            if lists.iter().all(|list| list.binary_search(&other).is_err()) {
                self.find(path, what, COPY);
            }
        }
    }
}

//! Finds every change of a folder since this program wrote it: compares the manifest, and the files with each other.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::Path;

use client::limited;
use trials::trial::{Action, CapsuleSample, RigSample, Status, Trial};

use crate::CampaignError;
use crate::folder::{ATTEMPTS, Campaign, ORDER, PLAN, READINGS, TRIALS};
use crate::ledger::{Attempt, Outcome};
use crate::manifest::{self, Hash, Manifest, PART, contents, hash_file};

/// Files that grow line by line.
const GROWING: [&str; 2] = [READINGS, TRIALS];

/// Something that has changed since it was written.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Finding {
    /// The file, relative to the folder.
    pub path: String,
    /// The defect.
    pub what: String,
    /// Advice.
    pub remedy: String,
}

impl Finding {
    fn new(path: &str, what: impl Into<String>, remedy: &str) -> Self {
        Self {
            path: path.to_owned(),
            what: what.into(),
            remedy: remedy.to_owned(),
        }
    }
}

impl std::fmt::Display for Finding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.path, self.what)
    }
}

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

const COPY: &str = "restore it from a copy";
const UNKNOWN: &str = "was it put there by hand? Move it elsewhere";

/// Reads the manifest of a folder; none if there is none.
///
/// # Errors
/// It is unreadable or malformed.
pub fn manifest(folder: &Path) -> Result<Option<Manifest>, CampaignError> {
    let path = folder.join(manifest::NAME);
    let text = match limited::read_text(&path, limited::RECORD) {
        Ok(text) => text,
        Err(io) if io.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(io) => return Err(CampaignError::new(&path, io, COPY)),
    };
    Manifest::parse(&text)
        .map(Some)
        .map_err(|why| CampaignError::new(&path, why, COPY))
}

/// Differences between a folder and its manifest.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Differences {
    /// Files that are not in the manifest, with their hashes.
    pub added: BTreeMap<String, Hash>,
    /// Missing files, with their hashes in the manifest.
    pub missing: BTreeMap<String, Hash>,
    /// Files with changed content, with their present hashes.
    pub changed: BTreeMap<String, Hash>,
    /// Grown files: number of complete new lines, and whether an incomplete one follows.
    pub grown: BTreeMap<String, (usize, bool)>,
    /// Anything that is neither a file nor a folder.
    pub strange: Vec<String>,
    /// Number of files compared.
    pub compared: usize,
}

/// Traces of a crash.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Left {
    /// Grown files, with the number of new lines.
    pub(crate) grown: Vec<(String, usize)>,
    /// Files whose last line is incomplete.
    pub(crate) torn: Vec<String>,
    /// Files that were about to replace others.
    pub(crate) parts: Vec<String>,
    /// Folders of attempts that are missing in the manifest.
    pub(crate) attempts: Vec<String>,
}

impl Differences {
    /// Compares every file.
    ///
    /// # Errors
    /// Some part of the folder cannot be read.
    pub fn between(folder: &Path, manifest: &Manifest) -> io::Result<Self> {
        let there = contents(folder)?;
        let mut differences = Self {
            strange: there.strange,
            missing: manifest.0.clone(),
            ..Self::default()
        };
        for path in there.files {
            let Some(listed) = differences.missing.remove(&path) else {
                let hash = hash_file(&folder.join(&path))?;
                differences.added.insert(path, hash);
                continue;
            };
            differences.compared += 1;
            let hash = hash_file(&folder.join(&path))?;
            if hash == listed {
                continue;
            }
            let grown = GROWING
                .contains(&&*path)
                .then(|| grown(&folder.join(&path), &listed))
                .transpose()?
                .flatten();
            match grown {
                Some(by) => {
                    differences.grown.insert(path, by);
                }
                None => {
                    differences.changed.insert(path, hash);
                }
            }
        }
        Ok(differences)
    }

    /// The differences in words. `listed` is the manifest that was compared.
    #[must_use]
    pub fn findings(&self, listed: &Manifest) -> Vec<Finding> {
        let mut findings = vec![];
        let same = |hash: &Hash, among: &BTreeMap<String, Hash>| {
            among
                .iter()
                .find(|(_, other)| *other == hash)
                .map(|(path, _)| path.clone())
        };
        for (path, hash) in &self.missing {
            findings.push(match same(hash, &self.added) {
                Some(other) => Finding::new(
                    path,
                    format!("is missing, and {other} has its contents: was it renamed?"),
                    "give it its name again",
                ),
                None => Finding::new(path, "is missing", COPY),
            });
        }
        for (path, hash) in &self.changed {
            findings.push(match same(hash, &listed.0) {
                Some(other) => Finding::new(
                    path,
                    format!("has the contents of {other}: were files exchanged?"),
                    COPY,
                ),
                None => Finding::new(path, "was changed", COPY),
            });
        }
        for (path, (lines, torn)) in &self.grown {
            let what = match (lines, torn) {
                (0, _) => "has a part of a line more than SHA256SUMS knows".to_owned(),
                (lines, false) => format!("has {lines} whole lines more than SHA256SUMS knows"),
                (lines, true) => {
                    format!("has {lines} whole lines and a part of one more than SHA256SUMS knows")
                }
            };
            findings.push(Finding::new(
                path,
                what,
                "was the tool killed or the power lost? `retrograde campaign resume` takes them up and says so; otherwise restore it from a copy",
            ));
        }
        for path in self.added.keys() {
            findings.push(Finding::new(path, "is not in SHA256SUMS", UNKNOWN));
        }
        for path in &self.strange {
            findings.push(Finding::new(
                path,
                "is neither a file nor a folder, or has a name that cannot be listed",
                UNKNOWN,
            ));
        }
        findings
    }

    /// The traces of a crash, if they explain all differences.
    ///
    /// # Errors
    /// The first difference that a crash cannot have caused.
    pub(crate) fn left_by_a_crash(&self, campaign: &Campaign) -> Result<Left, CampaignError> {
        let mut left = Left::default();
        let other = |path: &str, what: &str| {
            CampaignError::new(
                &campaign.folder.join(path),
                format!("{what}, and no crash does that"),
                "restore it from a copy, then again; `retrograde verify` names all such files",
            )
        };
        if let Some(path) = self.missing.keys().next() {
            return Err(other(path, "it is missing"));
        }
        if let Some(path) = self.changed.keys().next() {
            return Err(other(path, "it was changed"));
        }
        if let Some(path) = self.strange.first() {
            return Err(other(path, "it is neither a file nor a folder"));
        }
        for (path, (lines, torn)) in &self.grown {
            if *lines > 0 {
                left.grown.push((path.clone(), *lines));
            }
            if *torn {
                left.torn.push(path.clone());
            }
        }
        for path in self.added.keys() {
            if path.ends_with(PART) {
                left.parts.push(path.clone());
                continue;
            }
            let attempt = path
                .strip_prefix(ATTEMPTS)
                .and_then(|path| path.strip_prefix('/'))
                .and_then(|path| path.split_once('/'))
                .map(|(attempt, _)| attempt);
            match attempt {
                Some(attempt) if is_new(attempt, campaign) => {
                    if left.attempts.last().map(String::as_str) != Some(attempt) {
                        left.attempts.push(attempt.to_owned());
                    }
                }
                _ => return Err(other(path, "it is not in SHA256SUMS")),
            }
        }
        Ok(left)
    }
}

/// Whether this is the latest attempt: no other one may have files that the manifest lacks.
fn is_new(attempt: &str, campaign: &Campaign) -> bool {
    let began = campaign.rows.iter().rev().find_map(|row| {
        (row.event == crate::ledger::Event::Began)
            .then(|| Attempt::folder(row.trial.unwrap_or(0), row.attempt.unwrap_or(0)))
    });
    began.as_deref() == Some(attempt)
}

/// Compares a file with the hash that it had. Returns the number of complete new lines and whether an incomplete one
/// follows; none if its beginning was changed.
fn grown(path: &Path, listed: &Hash) -> io::Result<Option<(usize, bool)>> {
    let bytes = limited::read(path, limited::RECORD)?;
    let mut hash = hmac_sha256::Hash::new();
    let mut lines = bytes.split_inclusive(|byte| *byte == b'\n');
    for line in lines.by_ref() {
        if !line.ends_with(b"\n") {
            return Ok(None);
        }
        hash.update(line);
        if hash.finalize() == *listed {
            let (mut whole, mut torn) = (0, false);
            for line in lines {
                match line.ends_with(b"\n") {
                    true => whole += 1,
                    false => torn = true,
                }
            }
            return Ok(Some((whole, torn)));
        }
    }
    Ok(None)
}

/// Verifies a folder and changes nothing.
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
    match manifest(folder) {
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

//! Differences between a folder and its manifest, and which of them a crash can explain.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;

use client::limited;
use client::plain;

use crate::campaign::contents::Campaign;
use crate::campaign::files::{ATTEMPTS, READINGS, TRIALS};
use crate::campaign::ledger::Attempt;
use crate::campaign::manifest::{self, Hash, Manifest, contents, hash_file};
use crate::campaign::{CampaignError, resumption};

/// Files that grow line by line.
const GROWING: [&str; 2] = [READINGS, TRIALS];

/// A file that is not as it was written.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Finding {
    /// The file, relative to the folder.
    pub path: String,
    /// The fault.
    pub what: String,
    /// Advice to the user.
    pub remedy: String,
}

impl Finding {
    pub(crate) fn new(path: &str, what: impl Into<String>, remedy: impl Into<String>) -> Self {
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

pub(crate) const COPY: &str = "restore it from a copy";
pub(crate) const STRANGE: &str =
    "is neither a file nor a folder, or has a name that cannot be listed";
pub(crate) const UNKNOWN: &str = "was it put there by hand? Move it elsewhere";

/// Reads the manifest of a folder; none if the folder has none.
///
/// # Errors
/// The file is not a manifest.
pub fn read_manifest(folder: &Path) -> Result<Option<Manifest>, CampaignError> {
    let path = folder.join(manifest::NAME);
    let text = match plain::read_text(&path, limited::RECORD) {
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
    /// Files that the manifest does not list, with their hashes.
    pub added: BTreeMap<String, Hash>,
    /// Files that are gone, with the hashes in the manifest.
    pub missing: BTreeMap<String, Hash>,
    /// Files with changed contents, with their present hashes.
    pub changed: BTreeMap<String, Hash>,
    /// Files that have grown: number of new whole lines, and whether an incomplete line follows.
    pub grown: BTreeMap<String, (usize, bool)>,
    /// Entries that are neither a file nor a folder.
    pub strange: Vec<String>,
    /// Files that cannot be read, with the reasons.
    pub unreadable: BTreeMap<String, String>,
    /// Number of files compared.
    pub compared: usize,
}

/// Leftovers that a crash can explain.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Left {
    /// Files that have grown, with the number of new lines.
    pub(crate) grown: Vec<(String, usize)>,
    /// Files whose last line is incomplete.
    pub(crate) torn: Vec<String>,
    /// Temporary files that had not yet replaced their targets.
    pub(crate) parts: Vec<String>,
    /// Folders of attempts that are not in the manifest yet.
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
            let listed = differences.missing.remove(&path);
            if let Err(io) = differences.compare(folder, &path, listed) {
                differences.unreadable.insert(path, io.to_string());
            }
        }
        Ok(differences)
    }

    /// Compares a file with its hash in the manifest.
    fn compare(&mut self, folder: &Path, path: &str, listed: Option<Hash>) -> io::Result<()> {
        let full = folder.join(path);
        let hash = hash_file(&full)?;
        let Some(listed) = listed else {
            self.added.insert(path.to_owned(), hash);
            return Ok(());
        };
        self.compared += 1;
        if hash == listed {
            return Ok(());
        }
        let grown = GROWING
            .contains(&path)
            .then(|| grown(&full, &listed))
            .transpose()?
            .flatten();
        match grown {
            Some(by) => {
                self.grown.insert(path.to_owned(), by);
            }
            None => {
                self.changed.insert(path.to_owned(), hash);
            }
        }
        Ok(())
    }

    /// Describes the differences of a folder for people. `listed` is the manifest that was compared.
    #[must_use]
    pub fn findings(&self, folder: &Path, listed: &Manifest) -> Vec<Finding> {
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
                format!(
                    "was the tool killed or the power lost? {} takes them up and says so; otherwise restore it from a copy",
                    resumption(folder)
                ),
            ));
        }
        for path in self.added.keys() {
            findings.push(Finding::new(path, "is not in SHA256SUMS", UNKNOWN));
        }
        for (path, why) in &self.unreadable {
            let what = format!("cannot be read: {why}");
            findings.push(Finding::new(path, what, COPY));
        }
        for path in &self.strange {
            findings.push(Finding::new(path, STRANGE, UNKNOWN));
        }
        findings
    }

    /// Leftovers of a crash, provided that a crash explains every difference.
    ///
    /// # Errors
    /// The first difference that a crash cannot explain.
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
        if let Some((path, why)) = self.unreadable.iter().next() {
            return Err(other(path, &format!("it cannot be read: {why}")));
        }
        let lines: usize = self.grown.values().map(|(lines, _)| lines).sum();
        if lines > 1 {
            let path = self.grown.keys().next().map_or("", String::as_str);
            let what = format!("{lines} rows are not in {}", manifest::NAME);
            return Err(other(path, &what));
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
            let within = path
                .strip_prefix(ATTEMPTS)
                .and_then(|path| path.strip_prefix('/'))
                .and_then(|path| path.split_once('/'));
            match within {
                // Only files that this tool replaces: other programs use the suffix, too.
                None if plain::of_part(path) == Some(manifest::NAME) => {
                    left.parts.push(path.clone());
                }
                Some((attempt, name)) if is_new(attempt, campaign) => {
                    if plain::of_part(name).is_some() {
                        left.parts.push(path.clone());
                        continue;
                    }
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

/// Whether the attempt may be missing in the manifest: only the latest one may.
fn is_new(attempt: &str, campaign: &Campaign) -> bool {
    let began = campaign.rows.iter().rev().find_map(|row| {
        (row.event == crate::campaign::ledger::LedgerEvent::Began)
            .then(|| Attempt::folder(row.trial.unwrap_or(0), row.attempt.unwrap_or(0)))
    });
    began.as_deref() == Some(attempt)
}

/// Number of whole lines that a file has gained since it had this hash, and whether an incomplete line follows; none
/// if its beginning has changed.
fn grown(path: &Path, listed: &Hash) -> io::Result<Option<(usize, bool)>> {
    let bytes = plain::read(path, limited::RECORD)?;
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

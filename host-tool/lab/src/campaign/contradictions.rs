//! Contradictions between the files of a campaign: ledger, readings, plan, and the records of the attempts.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use crate::trials::check;
use crate::trials::trial::{Action, Status, Trial};
use client::identity::Origin;
use client::{limited, plain, wording};
use jiff::{SignedDuration, Timestamp};
use protocol::capsule::ActuationKind;
use protocol::rig::Direction;
use serde::Deserialize;

use crate::campaign::contents::{Campaign, in_a_line, is_motion};
use crate::campaign::differences::{COPY, Finding, UNKNOWN};
use crate::campaign::files::{ATTEMPTS, READINGS, TRIALS, is_record};
use crate::campaign::form::Form;
use crate::campaign::ledger::{Attempt, AttemptOutcome, TrialState};
use crate::campaign::order::Planned;
use crate::campaign::plan::Millimetres;
use crate::campaign::readings::{Readings, Set};
use crate::campaign::resumption;

/// Result of a verification.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Verified {
    /// Whether it is the folder of a campaign.
    pub campaign: bool,
    /// Number of files whose hashes were compared.
    pub files: usize,
    /// Number of trial records whose contents were checked.
    pub records: usize,
    /// Records without an end: under way, or their recording was cut off.
    pub unended: Vec<String>,
    /// All findings.
    pub findings: Vec<Finding>,
}

/// Greatest step of the computer's clock backwards between two rows, or a row and a record: a clock that was set from
/// local time to UTC steps by up to 14 hours.
pub(crate) const CLOCK_STEP: SignedDuration = SignedDuration::from_hours(24);

/// Longest time from the beginning of an attempt to its record, or from there to its end.
const LONGEST: SignedDuration = SignedDuration::from_hours(1);

/// File of the conditions in the folder of an attempt.
const CONDITIONS: &str = "conditions.json";

/// Adds findings on contradictions between the files of a campaign.
pub(crate) fn contradictions(folder: &Path, verified: &mut Verified) {
    let campaign = match Campaign::read(folder) {
        Ok(campaign) => campaign,
        Err(error) => {
            let path = error.path.strip_prefix(folder).unwrap_or(&error.path);
            let path = path.to_string_lossy().into_owned();
            let is_gone = fs::symlink_metadata(&error.path).is_err();
            if is_gone && verified.findings.iter().any(|found| found.path == path) {
                // The manifest has said so, with the same remedy.
                return;
            }
            // The manifest reports the change; this adds its consequence.
            verified
                .findings
                .push(Finding::new(&path, error.why, &error.remedy));
            return;
        }
    };
    let rows = campaign.rows.iter().map(|row| row.time_utc);
    times(TRIALS, rows, verified);
    let rows = campaign.reading_rows.iter().map(|row| row.time_utc);
    times(READINGS, rows, verified);
    let mut known = BTreeSet::new();
    for trial in &campaign.state.trials {
        for attempt in &trial.attempts {
            known.insert(Attempt::folder(trial.planned.trial, attempt.number));
            check_attempt(&campaign, trial, attempt, verified);
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

/// Rows whose time lies before that of the row above.
fn times(name: &str, rows: impl Iterator<Item = Timestamp>, verified: &mut Verified) {
    let mut before: Option<Timestamp> = None;
    for (number, time) in (1..).zip(rows) {
        if let Some(before) = before
            && before.duration_since(time) > CLOCK_STEP
        {
            let what = format!("row {number} is of {time}, the row before it of {before}");
            verified.findings.push(Finding::new(name, what, COPY));
        }
        before = Some(time);
    }
}

/// Names in a folder; none if it cannot be read or is a link.
fn list(folder: &Path) -> Vec<String> {
    let entries = plain::is_folder(folder).then(|| fs::read_dir(folder).ok());
    let entries = entries.flatten().into_iter().flatten().flatten();
    let mut names: Vec<String> = entries
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

/// Checks the files of an attempt against each other, the ledger and the plan.
fn check_attempt(
    campaign: &Campaign,
    state: &TrialState,
    attempt: &Attempt,
    verified: &mut Verified,
) {
    let planned = &state.planned;
    let path = format!(
        "{ATTEMPTS}/{}",
        Attempt::folder(planned.trial, attempt.number)
    );
    let mut found = vec![];
    let mut say = |what: String| found.push(Finding::new(&path, what, COPY));
    let mut records = vec![];
    for name in list(&campaign.folder.join(&path)) {
        let file = format!("{path}/{name}");
        let Some(record) = check_record(&campaign.folder, &file, verified) else {
            continue;
        };
        if let Some(what) = not_within(campaign, (planned, attempt), &name, &record) {
            say(format!("{name} {what}"));
        }
        records.push((name, record));
    }
    if attempt.outcome == Some(AttemptOutcome::Complete)
        && let Some(what) = incomplete(planned, &records)
    {
        say(format!("{TRIALS} says that it was completed, and {what}"));
    }
    let motions: Vec<_> = records.iter().filter(|(name, _)| is_motion(name)).collect();
    match motions[..] {
        [] => {}
        [(name, record)] => {
            let origin = record.device.origin;
            if campaign.origin().is_some_and(|of| of != origin) {
                let of = campaign.origin().unwrap_or(Origin::Unknown);
                say(format!("{name} is of origin {origin}, {TRIALS} of {of}"));
            }
            if let Some(what) = not_planned(campaign, planned, record) {
                say(format!("{name} {what}"));
            }
        }
        _ => say("has the records of several runs or passes".to_owned()),
    }
    let conditions = campaign.folder.join(&path).join(CONDITIONS);
    if fs::symlink_metadata(&conditions).is_ok()
        && let Some(what) = conditions_differ(campaign, planned, attempt, &conditions)
    {
        say(format!("{CONDITIONS} {what}"));
    }
    if let Some(what) = indentation_differs(campaign, planned, attempt) {
        say(what);
    }
    if attempt.outcome.is_none() {
        let resume = format!(
            "if no session is under way, one was cut off: {} takes this up; change nothing by hand",
            resumption(&campaign.folder)
        );
        // Its files reach the manifest as it ends.
        let inside = format!("{path}/");
        let unlisted = |one: &&mut Finding| one.path.starts_with(&inside) && one.remedy == UNKNOWN;
        for one in verified.findings.iter_mut().filter(unlisted) {
            one.remedy.clone_from(&resume);
        }
        found.push(Finding::new(&path, "the attempt has not ended", resume));
    }
    verified.findings.append(&mut found);
}

fn unfolds(record: &Trial) -> bool {
    matches!(
        record.action,
        Action::Actuation {
            actuation: ActuationKind::Unfold,
            ..
        }
    )
}

/// Why these records, with their files' names, do not make an attempt complete. A record has an error beside a complete
/// motion if it was not recorded whole. The capsule is unfolded after a complete attempt, so an unfolding does not count.
pub(crate) fn incomplete(planned: &Planned, records: &[(String, Trial)]) -> Option<String> {
    if !records.iter().any(|(name, _)| is_motion(name)) {
        return Some("there is no record of it".to_owned());
    }
    let folds = records.iter().any(|(name, _)| name.starts_with("fold-"));
    if planned.shape == Form::Folding && !folds {
        return Some("there is no record of the fold in it".to_owned());
    }
    let counts = records.iter().filter(|(_, record)| !unfolds(record));
    let other = |(name, record): &(String, Trial)| {
        let says = AttemptOutcome::from(record.status);
        match &record.error {
            _ if says != AttemptOutcome::Complete => Some(format!("{name} says {}", says.name())),
            Some(error) => Some(format!("{name} says that {error}")),
            None => None,
        }
    };
    counts.filter_map(other).next()
}

/// Reports a record whose start is not within its attempt. A clock that was set back explains it, unless the start lies
/// within another attempt.
fn not_within(
    campaign: &Campaign,
    (planned, attempt): (&Planned, &Attempt),
    name: &str,
    record: &Trial,
) -> Option<String> {
    let start = record.started_utc;
    let began = attempt.began;
    // An attempt whose clock was set back may end before it begins.
    let first = attempt.ended.map_or(began, |ended| ended.min(began));
    // The capsule is unfolded once the body has been measured, which may be long after the attempt has ended.
    let last = attempt.ended.filter(|_| !unfolds(record));
    let last = last.map_or(start, |ended| ended.max(began));
    let (early, late) = (first.duration_since(start), start.duration_since(last));
    // An early record was made after the clock's step, by the same clock as the end of its attempt. A late one was made
    // before the step, by the clock of the attempt's beginning. By that clock it is minutes away.
    let away = match (attempt.ended, early > late) {
        (Some(ended), true) => ended.duration_since(start),
        _ => start.duration_since(began),
    };
    let outside = early.max(late);
    let is_outside = outside.is_positive() && !unfolds(record);
    let is_forged = outside > CLOCK_STEP
        || is_outside && (away > LONGEST || is_of_another(campaign, planned, (name, record)));
    is_forged.then(|| {
        format!(
            "began at {start}, and by {TRIALS} the attempt lasted from {began} to {}",
            attempt
                .ended
                .map_or_else(|| "now".to_owned(), |ended| ended.to_string())
        )
    })
}

/// Whether the start of a record with this name lies within an attempt at the same thing that is complete without it.
fn is_of_another(campaign: &Campaign, planned: &Planned, (name, record): (&str, &Trial)) -> bool {
    fn stem(name: &str) -> Option<&str> {
        name.split_once('-').map(|(stem, _)| stem)
    }
    let includes = |attempt: &Attempt, time: Timestamp| {
        attempt.began <= time && attempt.ended.is_none_or(|ended| time <= ended)
    };
    let has_its_own = |trial: u32, attempt: &Attempt| {
        let mut records = campaign.records(trial, attempt.number).into_iter();
        records.any(|(other, own)| {
            let is_copy = own == *record;
            stem(&other) == stem(name) && !is_copy && includes(attempt, own.started_utc)
        })
    };
    let same = |of: &&TrialState| {
        (of.planned.purpose, of.planned.shape) == (planned.purpose, planned.shape)
    };
    campaign.state.trials.iter().filter(same).any(|of| {
        let complete = |one: &&Attempt| one.outcome == Some(AttemptOutcome::Complete);
        let mut meanwhile = of
            .attempts
            .iter()
            .filter(complete)
            .filter(|one| includes(one, record.started_utc));
        meanwhile.any(|attempt| !has_its_own(of.planned.trial, attempt))
    })
}

/// A motion that is not the one of the plan.
fn not_planned(campaign: &Campaign, planned: &Planned, record: &Trial) -> Option<String> {
    let run = &campaign.plan.run;
    let is_planned = match (&record.action, planned.purpose.pass()) {
        (Action::Run { requested, .. }, None) => requested == run,
        (Action::Move { requested, .. }, Some(Direction::Away)) => {
            requested.position_um == run.stroke_um
        }
        (Action::Move { requested, .. }, Some(Direction::Home)) => requested.position_um == 0,
        _ => false,
    };
    (!is_planned).then(|| "is not of the motion that the plan says".to_owned())
}

/// Conditions of an attempt, as far as the ledger and the plan say the same.
#[derive(Deserialize)]
struct Conditions {
    origin: Origin,
    campaign: String,
    planned: Planned,
    attempt: u32,
    readings_set: Option<u32>,
    indentation_mm: Option<Millimetres>,
    camera_file: Option<String>,
}

/// A contradiction between the conditions of an attempt and ledger or plan.
fn conditions_differ(
    campaign: &Campaign,
    planned: &Planned,
    attempt: &Attempt,
    path: &Path,
) -> Option<String> {
    let text = match plain::read_text(path, limited::RECORD) {
        Ok(text) => text,
        Err(io) => return Some(format!("cannot be read: {io}")),
    };
    let says: Conditions = match serde_json::from_str(&text) {
        Ok(says) => says,
        Err(json) => return Some(format!("cannot be read: {}", wording::unreadable(&json))),
    };
    let differs = |what: &str| Some(format!("and {TRIALS} differ in {what}"));
    match () {
        () if says.campaign != campaign.plan.name => differs("the campaign"),
        () if says.planned != *planned || says.attempt != attempt.number => differs("the trial"),
        () if Some(says.origin) != campaign.origin() => differs("the origin"),
        () if says.readings_set != attempt.readings_set => differs("the readings"),
        () if says.indentation_mm != attempt.indentation_mm => differs("a_n"),
        () if says.camera_file.as_deref().and_then(in_a_line) != attempt.camera_file => {
            differs("the camera's file")
        }
        () => None,
    }
}

/// An a_n that its readings do not give.
fn indentation_differs(
    campaign: &Campaign,
    planned: &Planned,
    attempt: &Attempt,
) -> Option<String> {
    let has = attempt.indentation_mm?;
    let Some(number) = attempt.readings_set else {
        return Some(format!("a_n is {has} mm, and no readings give it"));
    };
    // Only the readings before the attempt: D may have been measured again since. Where the clock was set back, the
    // attempt may belong to any of the stretches between these steps.
    let rows = &campaign.reading_rows;
    let stretches = rows.chunk_by(|row, next| row.time_utc <= next.time_utc);
    let mut passed = 0;
    let contradicting = stretches.filter_map(|stretch| {
        let end = passed + stretch.partition_point(|row| row.time_utc <= attempt.began);
        passed += stretch.len();
        let readings = Readings::replay(&rows[..end]).ok()?;
        let set = (readings.sets.iter()).find(|set| set.number == number && set.accepted)?;
        Some(gives_another(&readings, set, planned, has))
    });
    if let Some(contradiction) = contradicting.reduce(Option::and) {
        return contradiction;
    }
    // If the set is there nevertheless, the clock was set back since.
    let mut sets = campaign.readings.sets.iter();
    let is_there = sets.any(|set| set.number == number && set.accepted);
    (!is_there).then(|| {
        format!("a_n is of the readings {number}, and {READINGS} has none accepted before it")
    })
}

/// Why an a_n is not the one of this set.
fn gives_another(
    readings: &Readings,
    set: &Set,
    planned: &Planned,
    has: Millimetres,
) -> Option<String> {
    let number = set.number;
    if set.indentation.as_deref() != Some(&*planned.indentation) {
        return Some(format!(
            "a_n is of the readings {number}, which are not of {}",
            planned.indentation
        ));
    }
    let gives = readings.indentation_mm(set);
    let gives = gives.map(|a_mm| Millimetres::from_um((a_mm * 1_000.0).round() as i64));
    (gives != Some(has)).then(|| {
        format!(
            "a_n is {has} mm, the readings {number} give {}",
            gives.map_or_else(|| "none".to_owned(), |a| format!("{a} mm"))
        )
    })
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
            if trial.status == Status::Running {
                verified.unended.push(path.to_owned());
            }
            for what in check::record(&full, &trial).contradictions {
                verified.findings.push(Finding::new(path, what, COPY));
            }
            Some(trial)
        }
        // Summaries of other kinds also lie beside CSV files.
        Err(_) if !is_record(path.rsplit('/').next().unwrap_or(path)) => None,
        Err(error) => {
            verified.findings.push(Finding::new(path, error.why, COPY));
            None
        }
    }
}

//! The catalogue: lists the campaigns and trials in folders by date, specimen and outcome. Only reads.

use std::path::{Path, PathBuf};

use crate::trials::listing::Listing;
use crate::trials::sidecar::heading;
use crate::trials::trial::{Status, Trial};
use client::identity::Origin;
use client::plain;
use jiff::Timestamp;
use jiff::civil::Date;
use jiff::tz::TimeZone;
use serde::Serialize;

use crate::campaign::contents::Campaign;
use crate::campaign::differences::read_manifest;
use crate::campaign::files::{ORDER, PLAN};
use crate::campaign::ledger::{AttemptOutcome, Standing, TrialState};
use crate::campaign::order::doing;

/// Greatest depth of nested folders that are searched.
const DEPTH: u32 = 3;

/// Outcome of a campaign with trials that are still to be done.
pub const OPEN: &str = "open";
/// Outcome of an attempt that has not ended.
const UNDER_WAY: &str = "under_way";

/// All outcomes of entries: of campaigns, of attempts, of trials outside campaigns.
#[must_use]
pub fn outcomes() -> Vec<&'static str> {
    let mut all = vec![OPEN, UNDER_WAY];
    let of_attempts = AttemptOutcome::ALL.iter().map(|outcome| outcome.name());
    let of_trials = Status::ALL.iter().map(|status| status.name());
    for name in of_attempts.chain(of_trials) {
        if !all.contains(&name) {
            all.push(name);
        }
    }
    all
}

/// Search criteria; an entry has to match all that are given.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    /// First day, UTC.
    pub since: Option<Date>,
    /// Last day, UTC.
    pub until: Option<Date>,
    /// Part of the specimen's description or of the note; upper and lower case match.
    pub specimen: Option<String>,
    /// An outcome, as in the list.
    pub outcome: Option<String>,
}

/// A campaign, or a trial.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Entry {
    /// `campaign`, `trial`, or `campaign_trial` for one within a campaign.
    pub kind: Kind,
    /// Its folder or its sidecar.
    #[serde(serialize_with = "client::wording::path")]
    pub path: PathBuf,
    /// Its start; none if nothing has begun.
    pub started_utc: Option<Timestamp>,
    /// Description in a few words.
    pub what: String,
    /// The specimen, or the note of a trial outside campaigns.
    pub specimen: Option<String>,
    /// Its outcome; for a campaign `complete` or `open`.
    pub outcome: String,
    /// Origin of its data.
    pub origin: Origin,
}

/// Kind of an entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A campaign.
    Campaign,
    /// A trial within one.
    CampaignTrial,
    /// A trial in an ordinary folder.
    Trial,
}

/// Result of a search.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Catalogue {
    /// Matching entries, the oldest first.
    pub entries: Vec<Entry>,
    /// Unreadable files, with the reasons.
    pub unreadable: Vec<String>,
}

impl Wanted {
    fn takes(&self, entry: &Entry) -> bool {
        let day = entry
            .started_utc
            .map(|time| time.to_zoned(TimeZone::UTC).date());
        let dated = self.since.is_some() || self.until.is_some();
        let in_time = match day {
            Some(day) => {
                self.since.is_none_or(|since| since <= day)
                    && self.until.is_none_or(|until| day <= until)
            }
            None => !dated,
        };
        let specimen = entry.specimen.as_deref().unwrap_or_default().to_lowercase();
        let is_specimen = |part: &String| specimen.contains(&part.to_lowercase());
        let is_outcome = |outcome: &String| entry.outcome.eq_ignore_ascii_case(outcome);
        in_time
            && self.specimen.as_ref().is_none_or(is_specimen)
            && self.outcome.as_ref().is_none_or(is_outcome)
    }
}

/// Searches these folders; `trials` also lists the trials within campaigns.
#[must_use]
pub fn list(folders: &[PathBuf], trials: bool, wanted: &Wanted) -> Catalogue {
    let mut catalogue = Catalogue::default();
    for folder in folders {
        catalogue.look(folder, DEPTH, trials);
    }
    catalogue.entries.retain(|entry| wanted.takes(entry));
    catalogue
        .entries
        .sort_by(|a, b| (a.started_utc, &a.path, &a.what).cmp(&(b.started_utc, &b.path, &b.what)));
    catalogue
}

impl Catalogue {
    fn look(&mut self, folder: &Path, depth: u32, trials: bool) {
        if plain::is_file(&folder.join(PLAN)) && plain::is_file(&folder.join(ORDER)) {
            match Campaign::read(folder) {
                Ok(campaign) => self.campaign(&campaign, trials),
                Err(error) => self.unreadable.push(error.to_string()),
            }
            return;
        }
        let listing = Listing::read(folder);
        let trials_here = listing.trials.iter();
        self.entries
            .extend(trials_here.map(|(sidecar, trial)| ordinary(sidecar, trial)));
        self.unreadable.extend(listing.unreadable);
        if depth > 0 {
            // Skip campaigns that were never made whole.
            let is_part = |path: &Path| path.to_string_lossy().ends_with(plain::PART);
            for folder in listing.folders.iter().filter(|folder| !is_part(folder)) {
                self.look(folder, depth - 1, trials);
            }
        }
    }

    fn campaign(&mut self, campaign: &Campaign, trials: bool) {
        let all = &campaign.state.trials;
        let count = |wanted: Standing| {
            let standing = all.iter().map(TrialState::standing);
            standing.filter(|standing| *standing == wanted).count()
        };
        let closed = [Standing::Done, Standing::Excluded, Standing::Skipped];
        let is_closed = closed.into_iter().map(count).sum::<usize>() == all.len();
        let begun = campaign.rows.iter().map(|row| row.time_utc);
        let read = campaign.reading_rows.iter().map(|row| row.time_utc);
        let specimen = &campaign.plan.metadata.specimen;
        let origin = campaign.origin().unwrap_or(Origin::Unknown);
        let sealed = matches!(read_manifest(&campaign.folder), Ok(Some(_)));
        self.entries.push(Entry {
            kind: Kind::Campaign,
            path: campaign.folder.clone(),
            started_utc: begun.chain(read).min(),
            what: format!(
                "{}: {} of {} trials done, by {}{}",
                campaign.plan.name,
                count(Standing::Done),
                all.len(),
                campaign.plan.metadata.operator,
                if sealed { "" } else { ", without hashes" }
            ),
            specimen: Some(specimen.clone()),
            outcome: if is_closed {
                AttemptOutcome::Complete.name()
            } else {
                OPEN
            }
            .to_owned(),
            origin,
        });
        if !trials {
            return;
        }
        for state in all {
            let planned = &state.planned;
            for attempt in &state.attempts {
                let outcome = attempt.outcome.map_or(UNDER_WAY, AttemptOutcome::name);
                // That of an attempt that was given up counts nowhere.
                let displacement = match &attempt.given_up {
                    None => (attempt.displacement)
                        .map(|displacement| format!(", {} mm", displacement.value)),
                    Some(_) => Some(", given up".to_owned()),
                };
                self.entries.push(Entry {
                    kind: Kind::CampaignTrial,
                    path: campaign.attempt_folder(planned.trial, attempt.number),
                    started_utc: Some(attempt.began),
                    what: format!(
                        "{} trial {}, attempt {}: {}, {}, {}{}{}",
                        campaign.plan.name,
                        planned.trial,
                        attempt.number,
                        planned.lubrication.name(),
                        planned.indentation,
                        doing(planned.purpose, planned.shape),
                        displacement.unwrap_or_default(),
                        match state.standing() {
                            Standing::Excluded => ", excluded",
                            Standing::Skipped => ", skipped",
                            _ => "",
                        }
                    ),
                    specimen: Some(specimen.clone()),
                    outcome: outcome.to_owned(),
                    origin,
                });
            }
        }
    }
}

fn ordinary(sidecar: &Path, trial: &Trial) -> Entry {
    Entry {
        kind: Kind::Trial,
        path: sidecar.to_owned(),
        started_utc: Some(trial.started_utc),
        what: heading(trial),
        specimen: trial.note.clone(),
        outcome: trial.status.name().to_owned(),
        origin: trial.device.origin,
    }
}

use std::fs;
use std::path::{Path, PathBuf};

use crate::trials::experiment::stem;
use crate::trials::trial::TrialRecord;
use client::identity::Origin;
use client::{limited, plain};
use protocol::capsule::ActuationKind;
use serde::de::DeserializeOwned;

use crate::campaign::CampaignError;
use crate::campaign::files::{ATTEMPTS, ORDER, PLAN, READINGS, RUN, TRIALS, is_of};
use crate::campaign::form::Form;
use crate::campaign::ledger::{Attempt, AttemptOutcome, CampaignState, LedgerRow};
use crate::campaign::order::{Planned, order};
use crate::campaign::plan::CampaignPlan;
use crate::campaign::readings::{ReadingRow, Readings};

pub(crate) const TRIALS_HEADER: &str = "row,time_utc,event,trial,attempt,outcome,displacement_mm,source,readings_set,indentation_mm,camera_file,text,origin\n";
pub(crate) const READINGS_HEADER: &str =
    "row,time_utc,readings_set,quantity,indentation,event,reading,value_mm,text,origin\n";

#[derive(Clone, Debug, PartialEq)]
pub struct Campaign {
    pub folder: PathBuf,
    pub plan: CampaignPlan,
    pub order: Vec<Planned>,
    pub rows: Vec<LedgerRow>,
    /// State of the trials, derived from `rows`.
    pub state: CampaignState,
    pub reading_rows: Vec<ReadingRow>,
    /// The readings in force, derived from `reading_rows`.
    pub readings: Readings,
}

impl Campaign {
    /// Reads a folder without changing it. Skips an incomplete last line, which is still being written or was cut off
    /// by a crash.
    ///
    /// # Errors
    /// The first file that cannot be read or contradicts the others. Hashes are compared by
    /// [`crate::campaign::verify::verify`].
    pub fn read(folder: &Path) -> Result<Self, CampaignError> {
        leads_nowhere_else(&folder.join(ATTEMPTS))?;
        let path = folder.join(PLAN);
        let text =
            plain::read_text(&path, limited::BY_HAND).map_err(|io| not_a_campaign(&path, io))?;
        let plan = CampaignPlan::parse(&text, &path)?;
        let order = order(&plan);
        let path = folder.join(ORDER);
        let found =
            plain::read_text(&path, limited::RECORD).map_err(|io| not_a_campaign(&path, io))?;
        if found != order_text(&order) {
            let why = || "it is not the order that the plan and its seed give".to_owned();
            let why = limited::foreign_table(&found).unwrap_or_else(why);
            return Err(CampaignError::new(&path, why, RESTORE));
        }
        let path = folder.join(TRIALS);
        let rows: Vec<LedgerRow> = rows(&path, TRIALS_HEADER)?;
        let state = CampaignState::replay(&order, &rows)
            .map_err(|error| CampaignError::new(&path, error, RESTORE))?;
        let path = folder.join(READINGS);
        let reading_rows: Vec<ReadingRow> = self::rows(&path, READINGS_HEADER)?;
        let readings = Readings::replay(&reading_rows)
            .map_err(|error| CampaignError::new(&path, error, RESTORE))?;
        if let (Some(one), Some(other)) = (state.sequence.origin(), readings.sequence.origin())
            && one != other
        {
            let why = format!("its origin is {other}, that of {TRIALS} is {one}");
            return Err(CampaignError::new(&path, why, RESTORE));
        }
        Ok(Self {
            folder: folder.to_owned(),
            plan,
            order,
            rows,
            state,
            reading_rows,
            readings,
        })
    }

    pub fn attempt_folder(&self, trial: u32, attempt: u32) -> PathBuf {
        self.folder
            .join(ATTEMPTS)
            .join(Attempt::folder(trial, attempt))
    }

    /// The sidecar of an attempt's run; none if the run did not begin.
    pub fn run_sidecar(&self, trial: u32, attempt: u32) -> Option<PathBuf> {
        let mut found = plain::files(&self.attempt_folder(trial, attempt));
        found.retain(|path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            is_of(&name, RUN) && name.ends_with(".json")
        });
        found.pop()
    }

    /// The readable records of an attempt, with their files' names.
    pub(crate) fn records(&self, trial: u32, attempt: u32) -> Vec<(String, TrialRecord)> {
        let files = plain::files(&self.attempt_folder(trial, attempt));
        let named = |path: PathBuf| {
            let name = path.file_name()?.to_str()?.to_owned();
            Some((name, TrialRecord::read(&path).ok()?))
        };
        files.into_iter().filter_map(named).collect()
    }

    /// Origin of the data, rig or simulation; none before there are any.
    pub fn origin(&self) -> Option<Origin> {
        (self.state.sequence.origin()).or(self.readings.sequence.origin())
    }
}

/// Refuses links in place of the attempts' folders, so that nothing outside is read.
fn leads_nowhere_else(attempts: &Path) -> Result<(), CampaignError> {
    let refused = |path: &Path| {
        let why = "it is a link or no folder, and nothing is read through it";
        CampaignError::new(path, why, RESTORE)
    };
    if fs::symlink_metadata(attempts).is_ok_and(|found| !found.is_dir()) {
        return Err(refused(attempts));
    }
    let entries = fs::read_dir(attempts).into_iter().flatten().flatten();
    let mut links = entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_symlink()));
    links
        .next()
        .map_or(Ok(()), |link| Err(refused(&link.path())))
}

impl Planned {
    /// Why these records, with their files' names, do not make an attempt complete. The capsule is unfolded after a
    /// complete attempt, so an unfolding does not count.
    pub(crate) fn incomplete(&self, records: &[(String, TrialRecord)]) -> Option<String> {
        let has = |stem| records.iter().any(|(name, _)| is_of(name, stem));
        if !has(RUN) {
            return Some("there is no record of it".to_owned());
        }
        if self.shape == Form::Folding && !has(stem(ActuationKind::Fold)) {
            return Some("there is no record of the fold in it".to_owned());
        }
        let unfolding = stem(ActuationKind::Unfold);
        let counts = records.iter().filter(|(name, _)| !is_of(name, unfolding));
        let other = |(name, record): &(String, TrialRecord)| {
            let says = AttemptOutcome::from(record.status);
            match record.not_whole() {
                _ if says != AttemptOutcome::Complete => {
                    Some(format!("{name} says {}", says.name()))
                }
                Some(why) => Some(format!("{name} says that {why}")),
                None => None,
            }
        };
        counts.filter_map(other).next()
    }
}

/// Remedy for a file that another program has changed.
pub(crate) const RESTORE: &str =
    "restore the folder from a copy; `retrograde verify` names every file that was changed";

/// Error for a folder that is not a usable campaign.
pub(crate) fn not_a_campaign(path: &Path, why: impl ToString) -> CampaignError {
    CampaignError::misuse(
        path,
        why,
        "give the folder of a campaign, which `retrograde campaign new PLAN.toml` makes",
    )
}

pub fn order_text(order: &[Planned]) -> String {
    let mut csv = csv::Writer::from_writer(vec![]);
    for planned in order {
        csv.serialize(planned).expect("numbers and names");
    }
    let bytes = csv.into_inner().expect("memory");
    String::from_utf8(bytes).expect("ASCII")
}

/// The complete rows of a growing file, without its header.
pub(crate) fn rows<T: DeserializeOwned>(
    path: &Path,
    header: &str,
) -> Result<Vec<T>, CampaignError> {
    let text = plain::read_text(path, limited::RECORD).map_err(|io| not_a_campaign(path, io))?;
    parse_rows(&text, header).map_err(|why| CampaignError::new(path, why, RESTORE))
}

fn parse_rows<T: DeserializeOwned>(text: &str, header: &str) -> Result<Vec<T>, String> {
    let Some(body) = text.strip_prefix(header) else {
        let why = || "its first line is not that of this format".to_owned();
        return Err(limited::foreign_table(text).unwrap_or_else(why));
    };
    let whole = body.rfind('\n').map_or(0, |end| end + 1);
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .from_reader(&body.as_bytes()[..whole]);
    let names = csv::StringRecord::from(header.trim_end().split(',').collect::<Vec<_>>());
    let mut rows = vec![];
    for (number, record) in (1..).zip(reader.records()) {
        let row = record
            .and_then(|record| record.deserialize(Some(&names)))
            .map_err(|error| format!("row {number}: {error}"))?;
        rows.push(row);
    }
    Ok(rows)
}

/// The text in one line, because people may read the CSV files line by line; none if it is empty.
pub(crate) fn in_a_line(text: &str) -> Option<String> {
    let text = text.replace(char::is_control, " ");
    let text = text.trim();
    (!text.is_empty()).then(|| text.to_owned())
}

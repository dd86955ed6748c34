//! A campaign, read from its folder.

use std::fs;
use std::path::{Path, PathBuf};

use crate::trials::trial::Trial;
use client::identity::Origin;
use client::{limited, plain};
use serde::de::DeserializeOwned;

use crate::campaign::CampaignError;
use crate::campaign::files::{ATTEMPTS, MOTIONS, ORDER, PLAN, READINGS, TRIALS, is_of};
use crate::campaign::ledger::{Attempt, CampaignState, LedgerRow};
use crate::campaign::order::{Planned, order};
use crate::campaign::plan::{CampaignPlan, Millimetres};
use crate::campaign::readings::{ReadingRow, Readings};

pub(crate) const TRIALS_HEADER: &str = "row,time_utc,event,trial,attempt,outcome,displacement_mm,source,readings_set,indentation_mm,camera_file,text,origin\n";
pub(crate) const READINGS_HEADER: &str =
    "row,time_utc,readings_set,quantity,indentation,event,reading,value_mm,text,origin\n";

/// Everything known about a campaign.
#[derive(Clone, Debug, PartialEq)]
pub struct Campaign {
    /// Its folder.
    pub folder: PathBuf,
    /// The plan as the user wrote it.
    pub plan: CampaignPlan,
    /// The planned trials in the order of execution.
    pub order: Vec<Planned>,
    /// Rows of the ledger.
    pub rows: Vec<LedgerRow>,
    /// State of the trials, derived from `rows`.
    pub state: CampaignState,
    /// Rows of the caliper's readings.
    pub reading_rows: Vec<ReadingRow>,
    /// The readings in force, derived from `reading_rows`.
    pub readings: Readings,
}

impl Campaign {
    /// Reads a folder without changing it. Skips an incomplete last line, which is still being written or was cut by
    /// a crash.
    ///
    /// # Errors
    /// The first file that cannot be read or contradicts the others. Does not compare hashes:
    /// [`crate::campaign::verify::verify`] does that.
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
            let why = "it is not the order that the plan and its seed give";
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

    /// The folder of an attempt.
    #[must_use]
    pub fn attempt_folder(&self, trial: u32, attempt: u32) -> PathBuf {
        self.folder
            .join(ATTEMPTS)
            .join(Attempt::folder(trial, attempt))
    }

    /// The sidecar of an attempt's run or pass; none if it was not begun.
    #[must_use]
    pub fn run_sidecar(&self, trial: u32, attempt: u32) -> Option<PathBuf> {
        run_sidecar(&self.attempt_folder(trial, attempt))
    }

    /// The readable records of an attempt, with their files' names.
    pub(crate) fn records(&self, trial: u32, attempt: u32) -> Vec<(String, Trial)> {
        let files = plain::files(&self.attempt_folder(trial, attempt));
        let named = |path: PathBuf| {
            let name = path.file_name()?.to_str()?.to_owned();
            Some((name, Trial::read(&path).ok()?))
        };
        files.into_iter().filter_map(named).collect()
    }

    /// Why this net displacement contradicts the displacements measured after each stroke; none if it does not, or if
    /// some of them are missing.
    #[must_use]
    pub fn disagreement(&self, trial: u32, net: Millimetres) -> Option<String> {
        let state = self.state.trial(trial)?;
        let count = (self.plan).strokes_of(state.planned.purpose, state.planned.shape)?;
        let last = *state.attempt()?.all_strokes(count)?.last()?;
        let within = self.plan.displacement.agreement();
        ((net.um - last.um).abs() > within.um).then(|| {
            format!(
                "{net} mm: after the last stroke it was {last} mm, and the two may differ by {within} mm: enter it again, or `undo` takes the last stroke back"
            )
        })
    }

    /// Where the data come from, rig or simulation; none before there are any.
    #[must_use]
    pub fn origin(&self) -> Option<Origin> {
        (self.state.sequence.origin()).or(self.readings.sequence.origin())
    }
}

/// Refuses links where the folders of the attempts belong: only these are read.
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

/// Whether the name is that of a run's or a pass's file.
pub(crate) fn is_motion(name: &str) -> bool {
    MOTIONS.iter().any(|stem| is_of(name, stem))
}

/// The sidecar of the run or the pass in the folder of an attempt.
fn run_sidecar(folder: &Path) -> Option<PathBuf> {
    let mut found = plain::files(folder);
    found.retain(|path| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        is_motion(&name) && name.ends_with(".json")
    });
    found.pop()
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

/// The text of `order.csv`.
#[must_use]
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
        return Err("its first line is not that of this format".to_owned());
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

/// The text without line breaks, because people may read the CSV files line by line; none if nothing is left of it.
pub(crate) fn in_a_line(text: &str) -> Option<String> {
    let text = text.replace(char::is_control, " ");
    let text = text.trim();
    (!text.is_empty()).then(|| text.to_owned())
}

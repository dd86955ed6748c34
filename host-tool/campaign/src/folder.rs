//! The folder of a campaign: created as a whole, readable by any process, written by one process at a time.
//!
//! `trials.csv` and `readings.csv` only grow, and each row is on the disk before anything depends on it. `SHA256SUMS`
//! is replaced after each change. [`Folder::resume`] reports what a crash has left, and repairs it if nothing but a
//! crash can be the cause.

use std::fs::{self, File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use client::identity::Origin;
use client::limited;
use jiff::Timestamp;
use serde::Serialize;
use trials::trial::{Status, Trial};
use trials::writer::replace;

use crate::CampaignError;
use crate::contents::{
    Campaign, READINGS_HEADER, RESTORE, TRIALS_HEADER, not_a_campaign, order_text,
};
use crate::differences::{Differences, read_manifest};
use crate::files::{ATTEMPTS, LOCK, ORDER, PLAN, READINGS, TRIALS};
use crate::ledger::{Attempt, Event, Outcome, Row};
use crate::manifest::{self, Manifest, PART};
use crate::order::order;
use crate::plan::Plan;
use crate::readings::ReadingRow;

/// Formats a row as a line.
fn line(row: &impl Serialize) -> Vec<u8> {
    let mut csv = csv::WriterBuilder::new()
        .has_headers(false)
        .from_writer(vec![]);
    csv.serialize(row).expect("numbers and text");
    csv.into_inner().expect("memory")
}

/// A file that grows by lines, and the hash of what it has.
struct Growing {
    path: PathBuf,
    file: File,
    hash: hmac_sha256::Hash,
}

impl Growing {
    /// Opens it at its end.
    fn open(path: PathBuf) -> Result<Self, CampaignError> {
        let failed = |io| CampaignError::write(&path, io);
        let mut file = OpenOptions::new()
            .read(true)
            .write(true)
            .open(&path)
            .map_err(failed)?;
        let mut hash = hmac_sha256::Hash::new();
        let mut piece = vec![0; 65_536];
        loop {
            let count = file.read(&mut piece).map_err(failed)?;
            if count == 0 {
                break;
            }
            hash.update(&piece[..count]);
        }
        Ok(Self { path, file, hash })
    }

    /// Adds a line; it is on the disk when this returns. After a failed write no part of it stays.
    fn append(&mut self, line: &[u8]) -> Result<(), CampaignError> {
        let written = (|| {
            let end = self.file.seek(SeekFrom::End(0))?;
            let added = self
                .file
                .write_all(line)
                .and_then(|()| self.file.sync_data());
            if added.is_err() {
                // Best effort: `resume` would take a partial line for the trace of a crash, and cut it off.
                let _ = self.file.set_len(end);
            }
            added
        })();
        written.map_err(|io| CampaignError::write(&self.path, io))?;
        self.hash.update(line);
        Ok(())
    }

    fn hash(&self) -> manifest::Hash {
        self.hash.finalize()
    }
}

/// A campaign that this process may write.
pub struct Folder {
    /// Held for its lock, which the system releases when the process ends in any way.
    _lock: File,
    campaign: Campaign,
    trials: Growing,
    readings: Growing,
    manifest: Manifest,
}

impl Folder {
    /// Creates the folder of a new campaign; its path must not exist. The folder appears as a whole or not at all.
    ///
    /// # Errors
    /// The plan cannot be carried out, or something cannot be written.
    pub fn create(folder: &Path, plan_text: &str, plan_path: &Path) -> Result<Self, CampaignError> {
        let plan = Plan::parse(plan_text, plan_path)?;
        if folder.exists() {
            let remedy = format!(
                "`retrograde campaign resume {}` goes on with it; `--out DIR` names another folder",
                folder.display()
            );
            return Err(CampaignError::misuse(folder, "it exists already", remedy));
        }
        let name = folder.file_name().ok_or_else(|| {
            CampaignError::new(folder, "it has no name", "name a new folder: `--out DIR`")
        })?;
        let mut part = name.to_owned();
        part.push(PART);
        let part = folder.with_file_name(part);
        let made = (|| {
            if part.exists() {
                // Left by a process that was killed while creating it.
                fs::remove_dir_all(&part)?;
            }
            fs::create_dir_all(part.join(ATTEMPTS))?;
            for (name, text) in [
                (PLAN, plan_text),
                (ORDER, &order_text(&order(&plan))),
                (TRIALS, TRIALS_HEADER),
                (READINGS, READINGS_HEADER),
            ] {
                let mut file = File::create_new(part.join(name))?;
                file.write_all(text.as_bytes())?;
                file.sync_all()?;
            }
            let manifest = manifest::of_folder(&part)?;
            replace(&part.join(manifest::NAME), manifest.text().as_bytes())?;
            fs::rename(&part, folder)
        })();
        made.map_err(|io: std::io::Error| {
            CampaignError::new(
                folder,
                io,
                "choose a folder that can be written, with free space: `--out DIR`",
            )
        })?;
        Self::open(folder, lock(folder)?)
    }

    /// Opens a folder for writing; it must match its manifest.
    fn open(folder: &Path, lock: File) -> Result<Self, CampaignError> {
        let path = folder.join(manifest::NAME);
        let manifest = read_manifest(folder)?
            .ok_or_else(|| CampaignError::new(&path, "it is missing", RESTORE))?;
        Ok(Self {
            _lock: lock,
            campaign: Campaign::read(folder)?,
            trials: Growing::open(folder.join(TRIALS))?,
            readings: Growing::open(folder.join(READINGS))?,
            manifest,
        })
    }

    /// Opens the folder of an existing campaign, and repairs what a crash has left. Also returns descriptions of the
    /// repairs, for the operator.
    ///
    /// # Errors
    /// Something other than a crash has changed it, or another process is writing it. Then nothing has changed.
    pub fn resume(folder: &Path, now: Timestamp) -> Result<(Self, Vec<String>), CampaignError> {
        if !folder.join(TRIALS).is_file() {
            return Err(not_a_campaign(folder, "there is no campaign in it"));
        }
        let lock = lock(folder)?;
        let manifest = read_manifest(folder)?.ok_or_else(|| {
            CampaignError::new(&folder.join(manifest::NAME), "it is missing", RESTORE)
        })?;
        let campaign = Campaign::read(folder)?;
        let read = |io| CampaignError::new(folder, io, RESTORE);
        let differences = Differences::between(folder, &manifest).map_err(read)?;
        let left = differences.left_by_a_crash(&campaign)?;
        let mut told = vec![];
        for cut in &left.torn {
            told.push(cut_off(&folder.join(cut))?);
        }
        for part in &left.parts {
            let path = folder.join(part);
            fs::remove_file(&path).map_err(|io| CampaignError::write(&path, io))?;
            told.push(format!("{part}: removed; it was not yet whole"));
        }
        for (file, lines) in &left.grown {
            told.push(format!(
                "{file}: {lines} whole lines more than {} knew; taken up",
                manifest::NAME
            ));
        }
        for attempt in &left.attempts {
            told.push(format!(
                "{ATTEMPTS}/{attempt}: its files were not in {} yet; taken up",
                manifest::NAME
            ));
        }
        let mut this = Self::open(folder, lock)?;
        this.end_lost_attempts(now, &mut told)?;
        this.seal_all()?;
        Ok((this, told))
    }

    /// Ends an attempt that was going on when the tool ended: as lost, unless its record says that it was completed.
    fn end_lost_attempts(
        &mut self,
        now: Timestamp,
        told: &mut Vec<String>,
    ) -> Result<(), CampaignError> {
        let Some(origin) = self.campaign.state.sequence.origin() else {
            return Ok(());
        };
        let open: Vec<(u32, u32)> = self
            .campaign
            .state
            .trials
            .iter()
            .filter_map(|trial| {
                let last = trial.attempts.last()?;
                last.outcome
                    .is_none()
                    .then_some((trial.planned.trial, last.number))
            })
            .collect();
        for (trial, attempt) in open {
            let sidecar = self.campaign.run_sidecar(trial, attempt);
            let record = sidecar.and_then(|path| Trial::read(&path).ok());
            let folder = Attempt::folder(trial, attempt);
            let mut row = Row::of(Event::Ended, trial, Some(attempt));
            let (outcome, text) = match record.map(|record| record.status) {
                Some(Status::Complete) => (
                    Outcome::Complete,
                    "the tool ended after the motion; its record says that it was completed",
                ),
                _ => (Outcome::Lost, "the tool ended within it"),
            };
            row.outcome = Some(outcome);
            told.push(format!("{folder}: {text}: {}", outcome.name()));
            row = row.saying(Some(text.to_owned()));
            self.append(row, now, origin)?;
        }
        Ok(())
    }

    /// The campaign as it stands.
    #[must_use]
    pub fn campaign(&self) -> &Campaign {
        &self.campaign
    }

    /// Adds a row to the ledger. It is on the disk when this returns.
    ///
    /// # Errors
    /// It contradicts the earlier rows, or cannot be written; then the ledger is unchanged.
    pub fn append(
        &mut self,
        mut row: Row,
        now: Timestamp,
        origin: Origin,
    ) -> Result<(), CampaignError> {
        row.row = self.campaign.state.sequence.next_row();
        row.time_utc = now;
        row.origin = origin;
        self.is_of(origin)?;
        row.text = row.text.as_deref().map(in_a_line);
        row.camera_file = row.camera_file.as_deref().map(in_a_line);
        let mut state = self.campaign.state.clone();
        state.apply(&row).map_err(|error| {
            CampaignError::misuse(
                &self.trials.path,
                error,
                "`retrograde campaign status` shows how each trial stands",
            )
        })?;
        self.trials.append(&line(&row))?;
        self.campaign.state = state;
        self.campaign.rows.push(row);
        self.seal()
    }

    /// Adds a row to the readings. It is on the disk when this returns.
    ///
    /// # Errors
    /// As [`Folder::append`].
    pub fn append_reading(
        &mut self,
        mut row: ReadingRow,
        now: Timestamp,
        origin: Origin,
    ) -> Result<(), CampaignError> {
        row.row = self.campaign.readings.sequence.next_row();
        row.time_utc = now;
        row.origin = origin;
        self.is_of(origin)?;
        row.text = row.text.as_deref().map(in_a_line);
        let mut readings = self.campaign.readings.clone();
        readings
            .apply(&row)
            .map_err(|error| CampaignError::new(&self.readings.path, error, RESTORE))?;
        self.readings.append(&line(&row))?;
        self.campaign.readings = readings;
        self.campaign.reading_rows.push(row);
        self.seal()
    }

    /// Refuses rows of another origin than the earlier ones.
    fn is_of(&self, origin: Origin) -> Result<(), CampaignError> {
        match self.campaign.origin() {
            Some(has) if has != origin => Err(CampaignError::misuse(
                &self.campaign.folder,
                format!("it was begun with a machine of origin {has}, and this one is {origin}"),
                "a campaign is measured or simulated, never both: begin another one with `retrograde campaign new`",
            )),
            _ => Ok(()),
        }
    }

    /// Adds the files of an attempt to the manifest.
    ///
    /// # Errors
    /// They cannot be read, or the manifest cannot be written.
    pub fn seal_attempt(&mut self, trial: u32, attempt: u32) -> Result<(), CampaignError> {
        let path = self.campaign.attempt_folder(trial, attempt);
        let within = format!("{ATTEMPTS}/{}", Attempt::folder(trial, attempt));
        if path.exists() {
            let files = manifest::of_folder(&path)
                .map_err(|io| CampaignError::write(&path, io))?
                .0;
            for (file, hash) in files {
                self.manifest.0.insert(format!("{within}/{file}"), hash);
            }
        }
        self.seal()
    }

    /// Hashes all files again.
    fn seal_all(&mut self) -> Result<(), CampaignError> {
        self.manifest = manifest::of_folder(&self.campaign.folder)
            .map_err(|io| CampaignError::write(&self.campaign.folder, io))?;
        self.seal()
    }

    /// Replaces the manifest.
    fn seal(&mut self) -> Result<(), CampaignError> {
        for growing in [(TRIALS, &self.trials), (READINGS, &self.readings)] {
            let (name, file) = growing;
            self.manifest.0.insert(name.to_owned(), file.hash());
        }
        let path = self.campaign.folder.join(manifest::NAME);
        replace(&path, self.manifest.text().as_bytes())
            .map_err(|io| CampaignError::write(&path, io))
    }
}

/// Removes line breaks from a text, because people may read the CSV files line by line.
fn in_a_line(text: &str) -> String {
    let text: String = text
        .chars()
        .map(|char| if char.is_control() { ' ' } else { char })
        .collect();
    text.trim().to_owned()
}

/// Takes the lock that lets one process write at a time. It is a file of its own, because some systems make a locked
/// file unreadable.
fn lock(folder: &Path) -> Result<File, CampaignError> {
    let path = folder.join(LOCK);
    let file = OpenOptions::new()
        .write(true)
        .create(true)
        .truncate(false)
        .open(&path)
        .map_err(|io| CampaignError::write(&path, io))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(fs::TryLockError::WouldBlock) => Err(CampaignError::misuse(
            folder,
            "another process is writing this campaign",
            "end the other `retrograde campaign`, then again; `campaign status` works meanwhile",
        )),
        Err(fs::TryLockError::Error(io)) => Err(CampaignError::write(&path, io)),
    }
}

/// Cuts off everything after the last complete line.
fn cut_off(path: &Path) -> Result<String, CampaignError> {
    let failed = |io| CampaignError::write(path, io);
    let bytes = limited::read(path, limited::RECORD).map_err(failed)?;
    let whole = bytes
        .iter()
        .rposition(|byte| *byte == b'\n')
        .map_or(0, |end| end + 1);
    let file = OpenOptions::new().write(true).open(path).map_err(failed)?;
    file.set_len(whole as u64)
        .and_then(|()| file.sync_all())
        .map_err(failed)?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    Ok(format!(
        "{name}: its last line was not whole: {} bytes cut off",
        bytes.len() - whole
    ))
}

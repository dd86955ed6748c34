//! The folder of a campaign: created as a whole, readable by any process, written by one process at a time.
//!
//! `trials.csv` and `readings.csv` only grow, and each row is on the disk before anything depends on it. `SHA256SUMS`
//! follows after each trial and at the end of a session. [`Folder::resume`] recovers what a killed session has written.

use std::fs::{self, File};
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use client::identity::Origin;
use client::limited;
use client::named;
use client::plain::{self, Locked};
use client::wording::word;
use jiff::Timestamp;
use serde::Serialize;

use crate::campaign::contents::{
    Campaign, READINGS_HEADER, RESTORE, TRIALS_HEADER, in_a_line, not_a_campaign, order_text,
};
use crate::campaign::files::{ATTEMPTS, LOCK, ORDER, PLAN, READINGS, TRIALS};
use crate::campaign::ledger::{Attempt, AttemptOutcome, CampaignState, LedgerEvent, LedgerRow};
use crate::campaign::manifest::{self, Differences, Manifest};
use crate::campaign::order::order;
use crate::campaign::plan::CampaignPlan;
use crate::campaign::readings::ReadingRow;
use crate::campaign::{CampaignError, resumption};
use crate::trials::trial::ELSEWHERE;

/// Formats a row as a line.
fn line(row: &impl Serialize) -> Vec<u8> {
    let mut csv = csv::WriterBuilder::new()
        .has_headers(false)
        .from_writer(vec![]);
    csv.serialize(row).expect("numbers and text");
    csv.into_inner().expect("memory")
}

/// A file that grows by lines, and the hash of its contents.
struct Growing {
    path: PathBuf,
    file: File,
    hash: hmac_sha256::Hash,
}

impl Growing {
    /// Opens the file at its end.
    fn open(path: PathBuf) -> Result<Self, CampaignError> {
        let failed = |io| CampaignError::write(&path, io);
        let mut file = plain::open_to_write(&path).map_err(failed)?;
        let hash = manifest::hash_of(&mut file).map_err(failed)?;
        Ok(Self { path, file, hash })
    }

    /// Adds a line; it is on the disk when this returns. A failed write leaves no part of it.
    fn append(&mut self, line: &[u8]) -> Result<(), CampaignError> {
        let written = (|| {
            let end = self.file.seek(SeekFrom::End(0))?;
            let added = self
                .file
                .write_all(line)
                .and_then(|()| self.file.sync_data());
            if added.is_err() {
                // If this fails as well, `resume` cuts the partial line off, as after a crash.
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

pub struct Folder {
    /// Held for its lock, which the system releases however the process ends.
    _lock: Locked,
    campaign: Campaign,
    trials: Growing,
    readings: Growing,
    manifest: Manifest,
    /// The manifest on the disk.
    sealed: Manifest,
    /// Computer time of the latest row, and its instant; none if another process wrote it.
    latest: Option<(Timestamp, Option<Instant>)>,
}

/// Minimum difference between elapsed time and the computer's clock that counts as a jump of the clock, s.
const JUMP_S: f64 = 60.0;

impl Folder {
    /// Creates the folder of a new campaign; its path must not exist. The folder appears as a whole or not at all.
    pub fn create(folder: &Path, plan_text: &str, plan_path: &Path) -> Result<Self, CampaignError> {
        let plan = CampaignPlan::parse(plan_text, plan_path)?;
        if fs::symlink_metadata(folder).is_ok() {
            return Err(exists(folder));
        }
        let made = (|| {
            // A separate folder, because another process may be creating a campaign of the same name.
            let part = plain::part_of_folder(folder)?;
            let within = |name| part.path().join(name);
            fs::create_dir(within(ATTEMPTS))?;
            for (name, text) in [
                (PLAN, plan_text),
                (ORDER, &order_text(&order(&plan))),
                (TRIALS, TRIALS_HEADER),
                (READINGS, READINGS_HEADER),
            ] {
                let mut file = File::create_new(within(name))?;
                file.write_all(text.as_bytes())?;
                file.sync_all()?;
            }
            let manifest = manifest::of_folder(part.path())?;
            plain::replace(&within(manifest::NAME), manifest.text().as_bytes())?;
            // Lock it before it is visible, so that no other process writes first.
            let lock = Locked::new(plain::open_or_create(&within(LOCK))?)?;
            // Fails if another process was faster: its folder is not empty.
            fs::rename(part.path(), folder)?;
            let _ = part.keep();
            plain::sync_folder_of(folder)?;
            Ok(lock)
        })();
        let lock = made.map_err(|io: std::io::Error| {
            if fs::symlink_metadata(folder).is_ok() {
                return exists(folder);
            }
            let remedy = format!("{}{ELSEWHERE}", named::remedy(&io));
            CampaignError::new(folder, io, remedy)
        })?;
        Self::open(folder, lock)
    }

    /// Opens a folder for writing; it must match its manifest.
    fn open(folder: &Path, lock: Locked) -> Result<Self, CampaignError> {
        let manifest = manifest_of(folder)?;
        let campaign = Campaign::read(folder)?;
        let rows = campaign.rows.last().map(|row| row.time_utc);
        let latest = rows.or_else(|| Some(campaign.reading_rows.last()?.time_utc));
        Ok(Self {
            _lock: lock,
            latest: latest.map(|time| (time, None)),
            campaign,
            trials: Growing::open(folder.join(TRIALS))?,
            readings: Growing::open(folder.join(READINGS))?,
            sealed: manifest.clone(),
            manifest,
        })
    }

    /// Opens the folder of an existing campaign, and recovers what a killed session has written: rows and the records
    /// of its attempt. Also returns notices about that for the operator.
    ///
    /// # Errors
    /// A listed file is missing or was changed, or another process is writing it. Nothing has changed then.
    pub fn resume(folder: &Path, now: Timestamp) -> Result<(Self, Vec<String>), CampaignError> {
        if !plain::is_file(&folder.join(TRIALS)) {
            return Err(not_a_campaign(folder, "there is no campaign in it"));
        }
        let lock = lock(folder)?;
        let manifest = manifest_of(folder)?;
        // Checks the ledger before anything is changed.
        Campaign::read(folder)?;
        let differences = Differences::between(folder, &manifest)
            .map_err(|io| CampaignError::new(folder, io, RESTORE))?;
        if let Some((path, what)) = differences.damaged.iter().next() {
            return Err(CampaignError::new(&folder.join(path), what, RESTORE));
        }
        if let Some(path) = differences.strange.first() {
            let why = "it is neither a file nor a folder";
            return Err(CampaignError::new(&folder.join(path), why, RESTORE));
        }
        let mut notices = vec![];
        for table in &differences.grown {
            notices.extend(cut_off(&folder.join(table))?);
            notices.push(format!("{table}: accepted as it is now"));
        }
        let mut this = Self::open(folder, lock)?;
        this.take_up(differences.added, &mut notices)?;
        this.end_lost_attempts(now, &mut notices)?;
        this.seal()?;
        Ok((this, notices))
    }

    /// Adds the files of the latest attempt, the only one that can have been in progress. Removes temporary files; all
    /// others stay unlisted.
    fn take_up(
        &mut self,
        added: Vec<String>,
        notices: &mut Vec<String>,
    ) -> Result<(), CampaignError> {
        let mut rows = self.campaign.rows.iter().rev();
        let began = rows.find(|row| row.event == LedgerEvent::Began);
        let latest = began.and_then(|row| row.trial.zip(row.attempt));
        let latest = latest.map(|(trial, attempt)| Attempt::folder(trial, attempt));
        let mut records = 0;
        for path in added {
            let within = latest.as_ref().and_then(|attempt| {
                let inside = path.strip_prefix(ATTEMPTS)?.strip_prefix('/')?;
                inside.strip_prefix(&**attempt)?.strip_prefix('/')
            });
            let full = self.campaign.folder.join(&path);
            let of = plain::of_part(within.unwrap_or(&path));
            // Only files that this tool replaces: other programs use the suffix, too.
            if of.is_some() && (within.is_some() || of == Some(manifest::NAME)) {
                plain::remove(&full).map_err(|io| CampaignError::write(&full, io))?;
                notices.push(format!("{path}: removed, because it was incomplete"));
            } else if within.is_some() {
                let hash = manifest::hash_file(&full);
                let hash = hash.map_err(|io| CampaignError::write(&full, io))?;
                self.manifest.0.insert(path, hash);
                records += 1;
            }
        }
        if let (Some(attempt), 1..) = (latest, records) {
            notices.push(format!(
                "{ATTEMPTS}/{attempt}: its {records} files are recovered"
            ));
        }
        Ok(())
    }

    /// Ends an attempt that was in progress when the tool ended: as lost, unless its records show that it was
    /// completed.
    fn end_lost_attempts(
        &mut self,
        now: Timestamp,
        notices: &mut Vec<String>,
    ) -> Result<(), CampaignError> {
        let Some(origin) = self.campaign.state.sequence.origin() else {
            return Ok(());
        };
        let open = self.campaign.state.trials.iter().filter_map(|trial| {
            let last = trial.attempts.last()?;
            let is_open = last.outcome.is_none();
            is_open.then(|| (trial.planned.clone(), last.number))
        });
        for (planned, attempt) in open.collect::<Vec<_>>() {
            let trial = planned.trial;
            let records = self.campaign.records(trial, attempt);
            let (outcome, text) = match planned.incomplete(&records) {
                None => (
                    AttemptOutcome::Complete,
                    "the tool ended after the motion; its records say that it was completed",
                ),
                Some(_) => (AttemptOutcome::Lost, "the tool ended within it"),
            };
            let folder = Attempt::folder(trial, attempt);
            notices.push(format!("{folder}: {text}: {}", outcome.name()));
            let mut row = LedgerRow::of(LedgerEvent::Ended, trial, Some(attempt));
            row.outcome = Some(outcome);
            self.append(row.saying(Some(text.to_owned())), now, origin)?;
        }
        Ok(())
    }

    pub fn campaign(&self) -> &Campaign {
        &self.campaign
    }

    /// Adds a row to the ledger. It is on the disk when this returns.
    ///
    /// # Errors
    /// It contradicts the earlier rows, or cannot be written; the ledger is then unchanged.
    pub fn append(
        &mut self,
        mut row: LedgerRow,
        now: Timestamp,
        origin: Origin,
    ) -> Result<(), CampaignError> {
        row.time_utc = now;
        row.origin = origin;
        row.text = row.text.as_deref().and_then(in_a_line);
        row.camera_file = row.camera_file.as_deref().and_then(in_a_line);
        self.followed_by(&mut row)?;
        self.note_jump(now, origin)?;
        let state = self.followed_by(&mut row)?;
        self.trials.append(&line(&row))?;
        self.campaign.state = state;
        self.campaign.rows.push(row);
        Ok(())
    }

    /// Numbers a row, and returns the state after it.
    fn followed_by(&self, row: &mut LedgerRow) -> Result<CampaignState, CampaignError> {
        self.is_of(row.origin)?;
        let mut state = self.campaign.state.clone();
        row.row = state.sequence.next_row();
        state.apply(row).map_err(|error| {
            CampaignError::misuse(
                &self.trials.path,
                error,
                format!(
                    "`retrograde campaign status {}` shows the status of each trial",
                    word(&self.campaign.folder)
                ),
            )
        })?;
        Ok(state)
    }

    /// Notes in the ledger that the computer's clock has jumped since the latest row. The rows stay in the order of the
    /// events.
    fn note_jump(&mut self, now: Timestamp, origin: Origin) -> Result<(), CampaignError> {
        let latest = self.latest.replace((now, Some(Instant::now())));
        let Some((before, written)) = latest else {
            return Ok(());
        };
        let clock_s = now.duration_since(before).as_secs_f64();
        // Any time may pass between two sessions.
        let jump_s = written.map_or(clock_s.min(0.0), |at| clock_s - at.elapsed().as_secs_f64());
        if jump_s.abs() < JUMP_S {
            return Ok(());
        }
        let text = format!("the computer's clock jumped by {:+.0} min", jump_s / 60.0);
        let mut note = LedgerRow::of(LedgerEvent::Note, 0, None);
        note.trial = None;
        self.append(note.saying(Some(text)), now, origin)
    }

    /// Adds a row to the readings. It is on the disk when this returns.
    pub fn append_reading(
        &mut self,
        mut row: ReadingRow,
        now: Timestamp,
        origin: Origin,
    ) -> Result<(), CampaignError> {
        self.note_jump(now, origin)?;
        row.row = self.campaign.readings.sequence.next_row();
        row.time_utc = now;
        row.origin = origin;
        self.is_of(origin)?;
        row.text = row.text.as_deref().and_then(in_a_line);
        let mut readings = self.campaign.readings.clone();
        readings
            .apply(&row)
            .map_err(|error| CampaignError::new(&self.readings.path, error, RESTORE))?;
        self.readings.append(&line(&row))?;
        self.campaign.readings = readings;
        self.campaign.reading_rows.push(row);
        Ok(())
    }

    /// Refuses rows of another origin than the earlier ones.
    fn is_of(&self, origin: Origin) -> Result<(), CampaignError> {
        match self.campaign.origin() {
            Some(has) if has != origin => Err(CampaignError::misuse(
                &self.campaign.folder,
                format!("it was begun with a machine of origin {has}, and this one is {origin}"),
                format!(
                    "a campaign is measured or simulated, never both: begin another one, `retrograde campaign new {}`",
                    word(&self.campaign.folder.join(PLAN))
                ),
            )),
            _ => Ok(()),
        }
    }

    /// Adds the files of an attempt to the manifest.
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

    /// Replaces the manifest, if anything has changed since.
    pub fn seal(&mut self) -> Result<(), CampaignError> {
        for (name, file) in [(TRIALS, &self.trials), (READINGS, &self.readings)] {
            self.manifest.0.insert(name.to_owned(), file.hash());
        }
        if self.sealed == self.manifest {
            return Ok(());
        }
        let path = self.campaign.folder.join(manifest::NAME);
        plain::replace(&path, self.manifest.text().as_bytes())
            .map_err(|io| CampaignError::write(&path, io))?;
        self.sealed.clone_from(&self.manifest);
        Ok(())
    }
}

fn exists(folder: &Path) -> CampaignError {
    let goes_on = match folder.join(ORDER).is_file() {
        true => format!("{} continues it; ", resumption(folder)),
        false => String::new(),
    };
    let remedy = format!("{goes_on}`--out DIR` names another folder");
    CampaignError::misuse(folder, "it exists already", remedy)
}

/// The manifest, which is required for writing.
fn manifest_of(folder: &Path) -> Result<Manifest, CampaignError> {
    manifest::read(folder)?
        .ok_or_else(|| CampaignError::new(&folder.join(manifest::NAME), "it is missing", RESTORE))
}

/// Takes the lock that lets one process write at a time. It is a separate file, because some systems make a locked file
/// unreadable.
fn lock(folder: &Path) -> Result<Locked, CampaignError> {
    let path = folder.join(LOCK);
    let file = plain::open_or_create(&path).map_err(|io| CampaignError::write(&path, io))?;
    match Locked::new(file) {
        Ok(locked) => Ok(locked),
        Err(fs::TryLockError::WouldBlock) => Err(CampaignError::misuse(
            folder,
            "another process is writing this campaign",
            format!(
                "end the other `retrograde campaign`, then try again; `retrograde campaign status {}` works beside it",
                word(folder)
            ),
        )),
        Err(fs::TryLockError::Error(io)) => Err(CampaignError::write(&path, io)),
    }
}

/// Cuts off everything after the last complete line. Returns a notice if there was anything.
fn cut_off(path: &Path) -> Result<Option<String>, CampaignError> {
    let failed = |io| CampaignError::write(path, io);
    let bytes = plain::read(path, limited::RECORD).map_err(failed)?;
    let end = bytes.iter().rposition(|byte| *byte == b'\n');
    let torn = bytes.len() - end.map_or(0, |end| end + 1);
    if torn == 0 {
        return Ok(None);
    }
    let file = plain::open_to_write(path).map_err(failed)?;
    file.set_len((bytes.len() - torn) as u64)
        .and_then(|()| file.sync_all())
        .map_err(failed)?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    Ok(Some(format!(
        "{name}: its last line was incomplete: {torn} bytes cut off"
    )))
}

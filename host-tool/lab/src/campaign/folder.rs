//! The folder of a campaign: created as a whole, readable by any process, written by one process at a time.
//!
//! `trials.csv` and `readings.csv` only grow, and each row is on the disk before anything depends on it. `SHA256SUMS`
//! is replaced after each change. [`Folder::resume`] reports what a crash has left, and repairs it if nothing but a
//! crash can be the cause.

use std::fs::{self, File};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use client::identity::Origin;
use client::limited;
use client::plain::{self, Locked, replace};
use client::wording::word;
use jiff::Timestamp;
use serde::Serialize;

use crate::campaign::contents::{
    Campaign, READINGS_HEADER, RESTORE, TRIALS_HEADER, in_a_line, not_a_campaign, order_text,
};
use crate::campaign::contradictions::{CLOCK_STEP, incomplete};
use crate::campaign::differences::{Differences, Left, read_manifest};
use crate::campaign::files::{ATTEMPTS, LOCK, ORDER, PLAN, READINGS, TRIALS};
use crate::campaign::ledger::{Attempt, AttemptOutcome, LedgerEvent, LedgerRow};
use crate::campaign::manifest::{self, Manifest};
use crate::campaign::order::{Planned, order};
use crate::campaign::plan::CampaignPlan;
use crate::campaign::readings::ReadingRow;
use crate::campaign::{CampaignError, resumption};

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
        let mut file = plain::open_to_write(&path).map_err(failed)?;
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
                // If this fails, too, `resume` takes the partial line for the trace of a crash and cuts it off.
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

    /// Takes the last line back, which `hash` does not cover.
    fn take_back(&mut self, line: &[u8], hash: hmac_sha256::Hash) {
        let end = self.file.seek(SeekFrom::End(0)).unwrap_or(0);
        // Best effort: otherwise `resume` shows the row and asks about it.
        let _ = self.file.set_len(end.saturating_sub(line.len() as u64));
        self.hash = hash;
    }
}

/// A campaign that this process may write.
pub struct Folder {
    /// Held for its lock, which the system releases when the process ends in any way.
    _lock: Locked,
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
        let plan = CampaignPlan::parse(plan_text, plan_path)?;
        if fs::symlink_metadata(folder).is_ok() {
            return Err(exists(folder));
        }
        let name = folder.file_name().ok_or_else(|| {
            CampaignError::new(folder, "it has no name", "name a new folder: `--out DIR`")
        })?;
        // A folder of its own: another process may be making a campaign of the same name.
        let part = folder.with_file_name(plain::part_of(Path::new(name)));
        let made = (|| {
            fs::create_dir(&part)?;
            fs::create_dir(part.join(ATTEMPTS))?;
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
            // Locked before it appears, so that nobody else writes it first. Other systems do not rename a folder in
            // which a file is open.
            let lock = cfg!(unix).then(|| plain::open_or_create(&part.join(LOCK)));
            let lock = lock.transpose()?;
            let lock = lock.map(Locked::new).transpose()?;
            // Fails if another process was faster: its folder is not empty.
            fs::rename(&part, folder)?;
            plain::sync_folder_of(folder)?;
            Ok(lock)
        })();
        let lock = made.map_err(|io: std::io::Error| {
            // Remove only the folder made here: its name is random.
            let _ = fs::remove_dir_all(&part);
            if fs::symlink_metadata(folder).is_ok() {
                return exists(folder);
            }
            CampaignError::new(
                folder,
                io,
                "choose a folder that can be written, with free space: `--out DIR`",
            )
        })?;
        let lock = lock.map_or_else(|| self::lock(folder), Ok)?;
        Self::open(folder, lock)
    }

    /// Opens a folder for writing; it must match its manifest.
    fn open(folder: &Path, lock: Locked) -> Result<Self, CampaignError> {
        let manifest = manifest_of(folder)?;
        Ok(Self {
            _lock: lock,
            campaign: Campaign::read(folder)?,
            trials: Growing::open(folder.join(TRIALS))?,
            readings: Growing::open(folder.join(READINGS))?,
            manifest,
        })
    }

    /// Opens the folder of an existing campaign, and repairs what a crash has left. Also returns descriptions of the
    /// repairs, for the operator. A crash leaves at most one row that the manifest does not know; `accepts` is asked
    /// about it.
    ///
    /// # Errors
    /// Something other than a crash has changed it, another process is writing it, or the row is not accepted. Then
    /// nothing has changed.
    pub fn resume(
        folder: &Path,
        now: Timestamp,
        accepts: &mut dyn FnMut(&str) -> bool,
    ) -> Result<(Self, Vec<String>), CampaignError> {
        if !plain::is_file(&folder.join(TRIALS)) {
            return Err(not_a_campaign(folder, "there is no campaign in it"));
        }
        let lock = lock(folder)?;
        let manifest = manifest_of(folder)?;
        let campaign = Campaign::read(folder)?;
        let read = |io| CampaignError::new(folder, io, RESTORE);
        let differences = Differences::between(folder, &manifest).map_err(read)?;
        let left = differences.left_by_a_crash(&campaign)?;
        clock_goes_on(&campaign, now)?;
        ask_about_row(&campaign, &left, now, accepts)?;
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
            let row = last_line(&folder.join(file))?;
            told.push(format!(
                "{file}: {lines} row more than {} knew, taken up: {row}",
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

    /// Ends an attempt that was going on when the tool ended: as lost, unless its records say that it was completed.
    fn end_lost_attempts(
        &mut self,
        now: Timestamp,
        told: &mut Vec<String>,
    ) -> Result<(), CampaignError> {
        let Some(origin) = self.campaign.state.sequence.origin() else {
            return Ok(());
        };
        let open: Vec<(Planned, u32)> = self
            .campaign
            .state
            .trials
            .iter()
            .filter_map(|trial| {
                let last = trial.attempts.last()?;
                last.outcome
                    .is_none()
                    .then(|| (trial.planned.clone(), last.number))
            })
            .collect();
        for (planned, attempt) in open {
            let trial = planned.trial;
            let records = self.campaign.records(trial, attempt);
            let folder = Attempt::folder(trial, attempt);
            let mut row = LedgerRow::of(LedgerEvent::Ended, trial, Some(attempt));
            let (outcome, text) = match incomplete(&planned, &records) {
                None => (
                    AttemptOutcome::Complete,
                    "the tool ended after the motion; its records say that it was completed",
                ),
                Some(_) => (AttemptOutcome::Lost, "the tool ended within it"),
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
        mut row: LedgerRow,
        now: Timestamp,
        origin: Origin,
    ) -> Result<(), CampaignError> {
        row.row = self.campaign.state.sequence.next_row();
        row.time_utc = now;
        row.origin = origin;
        self.is_of(origin)?;
        row.text = row.text.as_deref().and_then(in_a_line);
        row.camera_file = row.camera_file.as_deref().and_then(in_a_line);
        let mut state = self.campaign.state.clone();
        state.apply(&row).map_err(|error| {
            CampaignError::misuse(
                &self.trials.path,
                error,
                format!(
                    "`retrograde campaign status {}` shows how each trial stands",
                    word(&self.campaign.folder)
                ),
            )
        })?;
        let (bytes, hash) = (line(&row), self.trials.hash);
        self.trials.append(&bytes)?;
        // Without its hash in the manifest the row would look like one that was added by hand.
        if let Err(error) = self.seal() {
            self.trials.take_back(&bytes, hash);
            let _ = self.seal();
            return Err(error);
        }
        self.campaign.state = state;
        self.campaign.rows.push(row);
        Ok(())
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
        row.text = row.text.as_deref().and_then(in_a_line);
        let mut readings = self.campaign.readings.clone();
        readings
            .apply(&row)
            .map_err(|error| CampaignError::new(&self.readings.path, error, RESTORE))?;
        let (bytes, hash) = (line(&row), self.readings.hash);
        self.readings.append(&bytes)?;
        if let Err(error) = self.seal() {
            self.readings.take_back(&bytes, hash);
            let _ = self.seal();
            return Err(error);
        }
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

fn exists(folder: &Path) -> CampaignError {
    let goes_on = match folder.join(ORDER).is_file() {
        true => format!("{} goes on with it; ", resumption(folder)),
        false => String::new(),
    };
    let remedy = format!("{goes_on}`--out DIR` names another folder");
    CampaignError::misuse(folder, "it exists already", remedy)
}

/// The manifest, without which nothing is written.
fn manifest_of(folder: &Path) -> Result<Manifest, CampaignError> {
    read_manifest(folder)?
        .ok_or_else(|| CampaignError::new(&folder.join(manifest::NAME), "it is missing", RESTORE))
}

/// Times of the rows of both tables.
fn times(campaign: &Campaign) -> impl Iterator<Item = Timestamp> + '_ {
    let rows = campaign.rows.iter().map(|row| row.time_utc);
    rows.chain(campaign.reading_rows.iter().map(|row| row.time_utc))
}

/// Refuses to write rows that would lie before the present ones.
fn clock_goes_on(campaign: &Campaign, now: Timestamp) -> Result<(), CampaignError> {
    match times(campaign).max() {
        Some(last) if last.duration_since(now) > CLOCK_STEP => Err(CampaignError::misuse(
            &campaign.folder,
            format!("its last row is of {last}, and this computer's clock says {now}"),
            "set the clock, then again; if the clock is right, restore the folder from a copy",
        )),
        _ => Ok(()),
    }
}

/// Asks about a row that the manifest does not know.
fn ask_about_row(
    campaign: &Campaign,
    left: &Left,
    now: Timestamp,
    accepts: &mut dyn FnMut(&str) -> bool,
) -> Result<(), CampaignError> {
    let Some((file, _)) = left.grown.first() else {
        return Ok(());
    };
    let path = campaign.folder.join(file);
    let (time, others): (_, Vec<Timestamp>) = if file == TRIALS {
        let rows: Vec<_> = campaign.rows.iter().map(|row| row.time_utc).collect();
        split(rows)
    } else {
        let rows = campaign.reading_rows.iter().map(|row| row.time_utc);
        split(rows.collect())
    };
    let before = others.into_iter().max();
    if let Some(time) = time
        && (before.is_some_and(|before| before.duration_since(time) > CLOCK_STEP)
            || time.duration_since(now) > CLOCK_STEP)
    {
        let why = format!("a row that is not in {} is of {time}", manifest::NAME);
        return Err(CampaignError::new(&path, why, RESTORE));
    }
    let row = last_line(&path)?;
    let question = format!(
        "{file} has one row more than {} knows, as after a crash:\n  {row}\nIs it yours?",
        manifest::NAME
    );
    if accepts(&question) {
        return Ok(());
    }
    let why = format!("it has a row that is not in {}: {row}", manifest::NAME);
    let remedy = format!(
        "{} at a terminal asks whether it is yours; if it is not, restore the file from a copy",
        resumption(&campaign.folder)
    );
    Err(CampaignError::new(&path, why, remedy))
}

/// The last time, and those before it.
fn split(mut times: Vec<Timestamp>) -> (Option<Timestamp>, Vec<Timestamp>) {
    let last = times.pop();
    (last, times)
}

/// The last whole line of a file.
fn last_line(path: &Path) -> Result<String, CampaignError> {
    let text = plain::read_text(path, limited::RECORD)
        .map_err(|io| CampaignError::new(path, io, RESTORE))?;
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    Ok(whole.rsplit('\n').next().unwrap_or_default().to_owned())
}

/// Takes the lock that lets one process write at a time. It is a file of its own, because some systems make a locked
/// file unreadable.
fn lock(folder: &Path) -> Result<Locked, CampaignError> {
    let path = folder.join(LOCK);
    let file = plain::open_or_create(&path).map_err(|io| CampaignError::write(&path, io))?;
    match Locked::new(file) {
        Ok(locked) => Ok(locked),
        Err(fs::TryLockError::WouldBlock) => Err(CampaignError::misuse(
            folder,
            "another process is writing this campaign",
            format!(
                "end the other `retrograde campaign`, then again; `retrograde campaign status {}` works meanwhile",
                word(folder)
            ),
        )),
        Err(fs::TryLockError::Error(io)) => Err(CampaignError::write(&path, io)),
    }
}

/// Cuts off everything after the last complete line.
fn cut_off(path: &Path) -> Result<String, CampaignError> {
    let failed = |io| CampaignError::write(path, io);
    let bytes = plain::read(path, limited::RECORD).map_err(failed)?;
    let whole = bytes
        .iter()
        .rposition(|byte| *byte == b'\n')
        .map_or(0, |end| end + 1);
    let file = plain::open_to_write(path).map_err(failed)?;
    file.set_len(whole as u64)
        .and_then(|()| file.sync_all())
        .map_err(failed)?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    Ok(format!(
        "{name}: its last line was not whole: {} bytes cut off",
        bytes.len() - whole
    ))
}

//! Target: the folder of a campaign as somebody else may have made it: changed files, links, pipes, attempts exchanged,
//! and a manifest that was made anew for all of it.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use client::identity::Origin;
use client::{Device, Unobserved};
use jiff::Timestamp;
use lab::campaign::contents::Campaign;
use lab::campaign::files::{ATTEMPTS, LOCK, ORDER, PLAN, READINGS, TRIALS};
use lab::campaign::folder::Folder;
use lab::campaign::ledger::{AttemptOutcome, LedgerEvent, LedgerRow, Source};
use lab::campaign::manifest;
use lab::campaign::plan::Millimetres;
use lab::campaign::readings::{Kind, Quantity, ReadingRow};
use lab::campaign::verify::verify;
use lab::operations::connector::Ports;
use lab::trials::experiment;
use lab::trials::trial::Recording;
use protocol::system::DeviceKind;
use serde::{Deserialize, Serialize};
use serde_json::json;
use simulated_machines::machine::{Script, link};
use tempfile::TempDir;

use crate::command;
use crate::script::steps;
use crate::text::Change;

/// Most steps of a script that are tried.
const MOST_STEPS: usize = 8;
/// A word that stands in every file outside of the folder.
const SECRET: &str = "not-for-the-folder";
/// Trials that are done, of the three of the plan.
const DONE: u32 = 2;

/// The files of the folder as the tool writes it, in the order by which a [`Step`] counts them. Its numbers stay the
/// same after a removal.
pub const FILES: [&str; 12] = [
    LOCK,
    manifest::NAME,
    ORDER,
    PLAN,
    READINGS,
    TRIALS,
    "trials/001-1/conditions.json",
    "trials/001-1/run-20260121T125328Z.csv",
    "trials/001-1/run-20260121T125328Z.json",
    "trials/002-1/conditions.json",
    "trials/002-1/run-20260121T125332Z.csv",
    "trials/002-1/run-20260121T125332Z.json",
];

/// A change of the folder; numbers of files are those of [`FILES`].
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Step {
    /// Changes a file.
    Edit(u8, Change),
    /// A link in the place of a file, to one of `OUTSIDE`.
    Link(u8, u8),
    /// A pipe in the place of a file.
    Pipe(u8),
    /// A file goes.
    Remove(u8),
    /// Two files change their names.
    Swap(u8, u8),
    /// The files of two attempts change places.
    Exchange,
    /// The manifest is made anew.
    Seal,
    /// The campaign is resumed; true if a row that nobody knows is accepted.
    Resume(bool),
}

/// Targets of the links, relative to the place of the campaign.
const OUTSIDE: [&str; 4] = ["outside/secret.json", "outside", "/dev/zero", "nothing"];

/// Command lines that read a folder.
const LINES: [&[&str]; 4] = [
    &["verify"],
    &["list"],
    &["campaign", "status"],
    &["campaign", "status", "--json"],
];

/// An entry of the folder.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Entry {
    File(Vec<u8>),
    Link(PathBuf),
    Pipe,
}

type Entries = BTreeMap<String, Entry>;

/// A campaign as the tool wrote it, and the place where it is changed.
struct Made {
    place: TempDir,
    whole: Entries,
    /// The entries that are on the disk.
    there: Entries,
}

/// Runs a script.
///
/// # Panics
/// A change is unnoticed, something outside of the folder is read or written, or the tool panics.
pub fn target(data: &[u8]) {
    let mut made = made();
    let line = data.last().map_or(0, |byte| usize::from(*byte));
    let mut entries = made.whole.clone();
    let mut resumed = false;
    for step in steps::<Step>(data).take(MOST_STEPS) {
        match step {
            Step::Seal => {
                made.write(&entries);
                if let Ok(new) = manifest::of_folder(&made.folder()) {
                    let new = Entry::File(new.text().into());
                    entries.insert(manifest::NAME.to_owned(), new);
                }
            }
            Step::Resume(accepts) => {
                made.write(&entries);
                let mut answer = |question: &str| {
                    command::check(&client::visible::lines(question));
                    accepts
                };
                let _ = Folder::resume(&made.folder(), at(1_000), &mut answer);
                // It may have written: the judgement below is for folders that are only read.
                resumed = true;
                made.there = BTreeMap::new();
                break;
            }
            step => change(&mut entries, &step, made.place.path()),
        }
    }
    if !resumed {
        made.write(&entries);
        made.judge(&entries);
    }
    let folder = made.folder();
    let args = [LINES[line % LINES.len()], &[path_of(&folder)]].concat();
    let (_, said) = command::run(&args, &Ports);
    assert!(!said.contains(SECRET), "{said}");
    made.is_alone();
}

/// The folder, reserved until the script ends.
fn made() -> MutexGuard<'static, Made> {
    static MADE: OnceLock<Mutex<Made>> = OnceLock::new();
    let made = MADE.get_or_init(|| Mutex::new(Made::new()));
    made.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The files that a script changes, apart from a new manifest and what a resumption writes.
pub fn changed(data: &[u8]) -> Vec<&'static str> {
    let made = made();
    let mut entries = made.whole.clone();
    for step in steps::<Step>(data).take(MOST_STEPS) {
        change(&mut entries, &step, made.place.path());
    }
    let differs = |name: &&str| entries.get(*name) != made.whole.get(*name);
    FILES.into_iter().filter(differs).collect()
}

fn change(entries: &mut Entries, step: &Step, place: &Path) {
    let name = |index: u8| FILES[usize::from(index) % FILES.len()];
    match step {
        Step::Edit(file, change) => {
            if let Some(Entry::File(bytes)) = entries.get_mut(name(*file)) {
                change.make(bytes);
            }
        }
        Step::Link(file, to) => {
            let to = place.join(OUTSIDE[usize::from(*to) % OUTSIDE.len()]);
            entries.insert(name(*file).to_owned(), Entry::Link(to));
        }
        Step::Pipe(file) => drop(entries.insert(name(*file).to_owned(), Entry::Pipe)),
        Step::Remove(file) => drop(entries.remove(name(*file))),
        Step::Swap(one, other) => swap(entries, name(*one), name(*other)),
        Step::Exchange => {
            let first = |name: &&str| name.contains("/001-1/");
            for name in FILES.into_iter().filter(first) {
                swap(entries, name, &name.replace("/001-1/", "/002-1/"));
            }
        }
        Step::Seal | Step::Resume(_) => {}
    }
}

fn swap(entries: &mut Entries, one: &str, other: &str) {
    let (first, second) = (entries.remove(one), entries.remove(other));
    entries.extend(second.map(|entry| (one.to_owned(), entry)));
    entries.extend(first.map(|entry| (other.to_owned(), entry)));
}

impl Made {
    fn folder(&self) -> PathBuf {
        self.place.path().join("small")
    }

    /// Brings the disk to these entries. Whole files are compared, because most changes are in one.
    fn write(&mut self, entries: &Entries) {
        let plain = |entry: &Entry| matches!(entry, Entry::File(_));
        let folder = self.folder();
        let differ = |(name, entry): &(&String, &Entry)| self.there.get(*name) != Some(*entry);
        let same_names = self.there.keys().eq(entries.keys());
        if same_names && self.there.values().chain(entries.values()).all(plain) {
            for (name, entry) in entries.iter().filter(differ) {
                put(&folder.join(name), entry);
            }
        } else {
            let _ = fs::remove_dir_all(&folder);
            fs::create_dir_all(folder.join(ATTEMPTS)).expect("a folder");
            for (name, entry) in entries {
                put(&folder.join(name), entry);
            }
        }
        self.there = entries.clone();
    }

    fn judge(&self, entries: &Entries) {
        let folder = self.folder();
        drop(Campaign::read(&folder));
        let verified = verify(&folder).expect("a folder");
        for finding in &verified.findings {
            command::check(&client::visible::lines(&finding.to_string()));
        }
        // The lock is no part of the campaign, as long as it is an empty file.
        let covered = |entries: &Entries| {
            let is_lock = |name: &str, entry: &Entry| {
                name == LOCK && matches!(entry, Entry::File(text) if text.is_empty())
            };
            let mut entries = entries.clone();
            entries.retain(|name, entry| !is_lock(name, entry));
            entries
        };
        let entries = &covered(entries);
        if *entries == covered(&self.whole) {
            assert_eq!(verified.findings, [], "nothing was changed");
        } else if entries.get(manifest::NAME) == self.whole.get(manifest::NAME) {
            assert_ne!(verified.findings, [], "a change that nobody notices");
        } else if is_unknown(entries) {
            // Without a manifest there is nothing to compare: the tool must report exactly that.
            assert!(!verified.campaign, "no campaign is there");
            if verified.findings.is_empty() {
                let (_, said) = command::run(&["verify", path_of(&folder)], &Ports);
                assert!(said.contains("there is no SHA256SUMS"), "{said}");
            }
        } else if entries
            .values()
            .any(|entry| !matches!(entry, Entry::File(_)))
        {
            assert_ne!(verified.findings, [], "a link that nobody notices");
        }
    }

    /// Nothing outside of the folder has changed.
    fn is_alone(&self) {
        let names = |folder: &Path| -> Vec<String> {
            let entries = fs::read_dir(folder).expect("a folder").flatten();
            let mut names: Vec<_> = entries
                .map(|entry| entry.file_name().to_string_lossy().into_owned())
                .collect();
            names.sort();
            names
        };
        let place = self.place.path();
        assert_eq!(names(place), ["outside", "small"]);
        assert_eq!(names(&place.join("outside")), ["secret.json"]);
        let secret = fs::read_to_string(place.join("outside/secret.json")).expect("there");
        assert_eq!(secret, format!("{{\"{SECRET}\": 1}}"));
    }

    fn new() -> Self {
        let place = tempfile::tempdir().expect("a folder");
        let folder = place.path().join("small");
        campaign(&folder);
        fs::create_dir(place.path().join("outside")).expect("a folder");
        let secret = format!("{{\"{SECRET}\": 1}}");
        fs::write(place.path().join("outside/secret.json"), secret).expect("a folder");
        let mut whole = Entries::new();
        read(&folder, "", &mut whole);
        assert!(
            whole.keys().eq(FILES.iter()),
            "other files: {:?}",
            whole.keys()
        );
        Self {
            place,
            there: whole.clone(),
            whole,
        }
    }
}

/// Whether the folder has neither a manifest nor two of the files by which a campaign is known.
fn is_unknown(entries: &Entries) -> bool {
    let of_campaign = [ORDER, PLAN, READINGS, TRIALS].into_iter();
    let there = of_campaign.filter(|name| entries.contains_key(*name));
    !entries.contains_key(manifest::NAME) && there.count() < 2
}

fn path_of(folder: &Path) -> &str {
    folder.to_str().expect("UTF-8")
}

fn put(path: &Path, entry: &Entry) {
    fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
    match entry {
        Entry::File(bytes) => fs::write(path, bytes).expect("written"),
        Entry::Link(to) => link_to(to, path),
        Entry::Pipe => pipe(path),
    }
}

#[cfg(unix)]
fn link_to(to: &Path, path: &Path) {
    std::os::unix::fs::symlink(to, path).expect("a link");
}

#[cfg(unix)]
fn pipe(path: &Path) {
    let mode = rustix::fs::Mode::from_raw_mode(0o600);
    rustix::fs::mkfifoat(rustix::fs::CWD, path, mode).expect("a pipe");
}

/// Elsewhere a folder takes the place of both: it is no plain file either.
#[cfg(not(unix))]
fn link_to(_: &Path, path: &Path) {
    pipe(path);
}

#[cfg(not(unix))]
fn pipe(path: &Path) {
    fs::create_dir(path).expect("a folder");
}

fn read(folder: &Path, before: &str, into: &mut Entries) {
    for entry in fs::read_dir(folder).expect("a folder").flatten() {
        let name = format!("{before}{}", entry.file_name().to_string_lossy());
        match entry.file_type().expect("a kind").is_dir() {
            true => read(&entry.path(), &format!("{name}/"), into),
            false => {
                let bytes = fs::read(entry.path()).expect("a file");
                into.insert(name, Entry::File(bytes));
            }
        }
    }
}

fn at(second: i64) -> Timestamp {
    Timestamp::from_second(1_769_000_000 + second).expect("a time")
}

/// Makes a campaign in which trials are done, with readings, records and conditions.
fn campaign(path: &Path) {
    const PLAN: &str = include_str!("../plan.toml");
    let mut folder = Folder::create(path, PLAN, Path::new("plan.toml")).expect("made");
    let mut second = 0;
    let mut now = || {
        second += 1;
        at(second)
    };
    for (set, name, value_um) in [(1, None, 24_400), (2, Some("a1"), 22_400)] {
        for number in [Some(1), Some(2), None] {
            let row = ReadingRow {
                row: 0,
                time_utc: Timestamp::UNIX_EPOCH,
                readings_set: set,
                quantity: name.map_or(Quantity::Width, |_| Quantity::BetweenCrests),
                indentation: name.map(str::to_owned),
                event: number.map_or(Kind::Accepted, |_| Kind::Reading),
                reading: number,
                value_mm: number.map(|_| Millimetres::from_um(value_um)),
                text: None,
                origin: Origin::Board,
            };
            folder
                .append_reading(row, now(), Origin::Board)
                .expect("written");
        }
    }
    let mut script = Script::new(DeviceKind::Rig);
    script.ready = true;
    let mut rig = Device::connect(link(script).0, DeviceKind::Rig, 5).expect("a rig");
    for trial in 1..=DONE {
        let row = |event| LedgerRow::of(event, trial, Some(1));
        let mut began = row(LedgerEvent::Began);
        let a_mm = Millimetres::from_um(1_000);
        (began.readings_set, began.indentation_mm) = (Some(2), Some(a_mm));
        folder.append(began, now(), Origin::Board).expect("written");
        let recording = Recording {
            folder: folder.campaign().attempt_folder(trial, 1),
            stem: "run".to_owned(),
            now: now(),
            note: Some("a note".to_owned()),
            telemetry_ms: 100,
        };
        let run = folder.campaign().plan.run;
        experiment::run(&mut rig, run, &recording, &mut Unobserved).expect("a run");
        let conditions = json!({
            "format": 1,
            "origin": Origin::Board,
            "campaign": "small",
            "planned": folder.campaign().order[trial as usize - 1],
            "attempt": 1,
            "readings_set": 2,
            "indentation_mm": a_mm,
            "camera_file": null,
        });
        let conditions = serde_json::to_vec_pretty(&conditions).expect("JSON");
        fs::write(recording.folder.join("conditions.json"), conditions).expect("written");
        let mut ended = row(LedgerEvent::Ended);
        ended.outcome = Some(AttemptOutcome::Complete);
        folder.append(ended, now(), Origin::Board).expect("written");
        folder.seal_attempt(trial, 1).expect("written");
        let mut displacement = row(LedgerEvent::Displacement);
        displacement.displacement_mm = Some(Millimetres::from_um(4_200));
        displacement.source = Some(Source::Measured);
        folder
            .append(displacement, now(), Origin::Board)
            .expect("written");
    }
    let note = LedgerRow::of(LedgerEvent::Note, 2, None);
    let note = note.saying(Some("a \"note\", with a comma".to_owned()));
    folder.append(note, now(), Origin::Board).expect("written");
}

//! Target: changed records into `verify`, the report's check and the manifest. Every change of a listed file must be
//! noticed.

use std::fs;
use std::path::Path;
use std::sync::{Mutex, OnceLock, PoisonError};

use client::{Device, Unobserved};
use jiff::Timestamp;
use lab::campaign::manifest::{self, Manifest};
use lab::campaign::verify::verify;
use lab::trials::check;
use lab::trials::experiment;
use lab::trials::trial::{Recording, Trial};
use protocol::rig::{LinkLossPolicy, Run, RunTiming};
use protocol::system::DeviceKind;
use serde::{Deserialize, Serialize};
use tempfile::TempDir;

use crate::script::steps;
use crate::text;
use simulated_machines::machine::{Script, link};

/// Most steps of a script that are tried.
const MOST_STEPS: usize = 8;

/// A change. `u8` is the number of the file, `u16` the position in it, in thousandths.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Step {
    /// Replaces this many bytes by others.
    Replace(u8, u16, u8, Vec<u8>),
    /// Replaces the next number by one of [`text::NUMBERS`].
    Number(u8, u16, u8),
    /// Cuts the file off.
    Cut(u8, u16),
    /// Repeats all rows from there on.
    Twice(u8, u16),
    /// Replaces the manifest.
    Manifest(Vec<u8>),
}

/// An intact record: sidecar, telemetry, manifest.
struct Written {
    names: [String; 3],
    files: [Vec<u8>; 3],
}

/// Runs a script.
///
/// # Panics
/// A change is unnoticed, or makes the tool panic.
pub fn target(data: &[u8]) {
    static WRITTEN: OnceLock<Written> = OnceLock::new();
    static FOLDER: OnceLock<TempDir> = OnceLock::new();
    static LAST: Mutex<Option<[Vec<u8>; 3]>> = Mutex::new(None);
    let written = WRITTEN.get_or_init(Written::new);
    let folder = FOLDER
        .get_or_init(|| tempfile::tempdir().expect("a folder"))
        .path();
    manifest_of(data);
    let mut files = written.files.clone();
    for step in steps::<Step>(data).take(MOST_STEPS) {
        change(&mut files, &step);
    }
    // Write only the changed files, because most changes are in one. The lock reserves the folder until the script
    // ends.
    let mut last = LAST.lock().unwrap_or_else(PoisonError::into_inner);
    for (index, (name, bytes)) in written.names.iter().zip(&files).enumerate() {
        if last.as_ref().is_none_or(|last| last[index] != *bytes) {
            fs::write(folder.join(name), bytes).expect("a folder");
        }
    }
    *last = Some(files.clone());
    let changed = files[..2] != written.files[..2];
    let listed = files[2] == written.files[2];
    let verified = verify(folder).expect("a folder");
    assert!(
        !(changed && listed && verified.findings.is_empty()),
        "a change that nobody notices"
    );
    if files == written.files {
        assert_eq!(verified.findings, [], "nothing was changed");
    }
    look(&folder.join(&written.names[0]));
}

/// Checks a record as `verify` and the report do.
fn look(sidecar: &Path) {
    let Ok(trial) = Trial::read(sidecar) else {
        return;
    };
    drop(check::record(sidecar, &trial));
}

/// Checks that text which parses as a manifest is written back unchanged.
fn manifest_of(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else {
        return;
    };
    if let Ok(manifest) = Manifest::parse(text) {
        assert_eq!(manifest.text(), text);
    }
}

fn change(files: &mut [Vec<u8>; 3], step: &Step) {
    let index = |file: &u8| usize::from(*file) % 3;
    match step {
        Step::Replace(file, at, count, bytes) => {
            text::replace(&mut files[index(file)], *at, *count, bytes);
        }
        Step::Number(file, at, number) => text::number(&mut files[index(file)], *at, *number),
        Step::Cut(file, at) => text::cut(&mut files[index(file)], *at),
        Step::Twice(file, at) => text::twice(&mut files[index(file)], *at),
        Step::Manifest(bytes) => files[2].clone_from(bytes),
    }
}

impl Written {
    /// The record of a short run of a rig with few steps.
    fn new() -> Self {
        let mut script = Script::new(DeviceKind::Rig);
        (script.few_steps, script.ready) = (true, true);
        let (link, _log) = link(script);
        let mut rig = Device::connect(link, DeviceKind::Rig, 1).expect("a rig");
        let folder = tempfile::tempdir().expect("a folder");
        let recording = Recording {
            folder: folder.path().to_owned(),
            stem: "run".to_owned(),
            now: Timestamp::UNIX_EPOCH,
            note: None,
            telemetry_ms: 200,
        };
        let run = Run {
            cycles: 1,
            stroke_um: 20_000,
            timing: RunTiming::Speeds {
                forward_um_s: 20_000,
                return_um_s: 20_000,
                accel_um_s2: 1_000_000,
            },
            far_dwell_us: 5_000,
            home_dwell_us: 5_000,
            start_delay_us: 0,
            link_loss: LinkLossPolicy::Stop,
        };
        let trial = experiment::run(&mut rig, run, &recording, &mut Unobserved);
        let trial = trial.expect("recorded");
        let manifest = manifest::of_folder(folder.path()).expect("a folder");
        let name = |path: &Path| {
            path.file_name()
                .expect("a file")
                .to_string_lossy()
                .into_owned()
        };
        Self {
            names: [
                name(&trial.sidecar),
                name(&trial.csv),
                manifest::NAME.to_owned(),
            ],
            files: [
                fs::read(&trial.sidecar).expect("written"),
                fs::read(&trial.csv).expect("written"),
                manifest.text().into(),
            ],
        }
    }
}

//! Records on disk: read back, identical for identical runs, readable after a crash, and the paper's experiment.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use crate::support::plan::{SHORT_RUN, recording};
use crate::support::tool::device;
use client::identity::Origin;
use client::{Device, Observer, Progress, Unobserved};
use lab::trials::check;
use lab::trials::experiment::{self, ExperimentError, RunTrial};
use lab::trials::trial::{Action, Recording, RigSample, Status, TrialRecord};
use protocol::capsule::{ActuationKind, ActuationOutcome};
use protocol::rig::{RigState, Run, RunOutcome, RunTiming};
use protocol::system::{DeviceKind, Urgent};
use report::html;
use report::html::Omitted;
use simulated_machines::machine::{Script, link};

fn recorded_run(folder: &Path) -> RunTrial {
    experiment::run(
        &mut device(DeviceKind::Rig),
        SHORT_RUN,
        &recording(folder, "run", 20),
        &mut Unobserved,
    )
    .expect("recorded")
}

#[test]
fn a_recorded_run_is_read_back_whole() {
    let folder = tempfile::tempdir().expect("folder");
    let run = recorded_run(folder.path());
    let trial = TrialRecord::read(&run.sidecar).expect("sidecar");
    assert_eq!(trial, run.trial);
    assert_eq!(trial.status, Status::Complete);
    assert_eq!(trial.device.uid, "ab".repeat(12));
    assert_eq!(trial.events.len(), 6);
    assert_eq!(trial.device.origin, Origin::Board);
    let samples: Vec<RigSample> = trial.samples(&run.sidecar).expect("telemetry");
    assert_eq!(samples.len() as u64, trial.samples);
    assert!(samples.iter().all(|sample| sample.origin == Origin::Board));
    assert!(samples.len().abs_diff(200) <= 2, "{}", samples.len());
    assert!(
        samples.is_sorted_by(|a, b| b.time_us - a.time_us == 20_000),
        "every sample, in order"
    );
    for sample in &samples {
        let mm: f64 = sample.position_mm.parse().expect("a number");
        assert!((mm * 800.0 - f64::from(sample.position_steps)).abs() < 1e-9);
    }
    let Action::Run {
        executed: Some(executed),
        achieved: Some(achieved),
        ..
    } = trial.action
    else {
        panic!("a run with its record");
    };
    assert_eq!(executed.plan_hash, achieved.plan_hash);
    assert_eq!(executed.counted_edges, 4 * 8_000);
}

#[test]
fn a_record_without_an_origin_is_readable_and_of_no_board() {
    let folder = tempfile::tempdir().expect("folder");
    let run = recorded_run(folder.path());
    // A record as earlier versions of the tool wrote it.
    let old = |path: &Path, gone: &str| {
        let text = fs::read_to_string(path).expect("there");
        assert!(text.contains(gone), "{text}");
        fs::write(path, text.replace(gone, "")).expect("written");
    };
    old(&run.sidecar, "    \"origin\": \"board\",\n");
    old(&run.csv, ",origin");
    old(&run.csv, ",board");
    let trial = TrialRecord::read(&run.sidecar).expect("sidecar");
    assert_eq!(trial.device.origin, Origin::Unknown);
    let samples: Vec<RigSample> = trial.samples(&run.sidecar).expect("telemetry");
    assert!(
        samples
            .iter()
            .all(|sample| sample.origin == Origin::Unknown)
    );
    // The UID reveals a virtual machine even if the record does not say so.
    let text = fs::read_to_string(&run.sidecar).expect("there");
    let virtual_uid = "7669727475616c2072696700";
    fs::write(&run.sidecar, text.replace(&"ab".repeat(12), virtual_uid)).expect("written");
    let trial = TrialRecord::read(&run.sidecar).expect("sidecar");
    assert_eq!(trial.device.origin, Origin::Virtual);
}

#[test]
fn the_same_run_gives_the_same_bytes_and_overwrites_nothing() {
    let folder = tempfile::tempdir().expect("folder");
    let (one, two) = (recorded_run(folder.path()), recorded_run(folder.path()));
    assert_ne!(one.csv, two.csv);
    assert_eq!(
        fs::read(&one.csv).expect("one"),
        fs::read(&two.csv).expect("two")
    );
    assert!(
        one.csv.ends_with("run-19700101T000000Z.csv"),
        "{:?}",
        one.csv
    );
    assert!(
        two.csv.ends_with("run-19700101T000000Z-2.csv"),
        "{:?}",
        two.csv
    );
}

/// The run in progress is on disk up to its eighth report: 2 s at 50 Hz, less one report.
fn is_on_disk(folder: &Path) -> bool {
    let sidecar = fs::read_dir(folder)
        .expect("folder")
        .flatten()
        .map(|entry| entry.path())
        .find(|path| path.extension().is_some_and(|name| name == "json"))
        .expect("exists while the run goes on");
    let trial = TrialRecord::read(&sidecar).expect("whole");
    assert_eq!(trial.status, Status::Running);
    let samples: Vec<RigSample> = trial.samples(&sidecar).expect("readable");
    let begun = matches!(
        trial.action,
        Action::Run {
            achieved: Some(_),
            executed: None,
            ..
        }
    );
    begun && samples.len() >= 80
}

#[test]
fn a_crash_leaves_readable_data_that_nobody_takes_for_complete() {
    struct Crash<'a>(&'a Path, u32);
    impl Observer for Crash<'_> {
        fn progress(&mut self, _: &Progress) {
            self.1 += 1;
            if self.1 == 8 {
                // A crash now would leave the present content of the disk. The device's time runs faster than the
                // disk, so wait for it.
                let begin = Instant::now();
                while !is_on_disk(self.0) {
                    assert!(begin.elapsed() < Duration::from_secs(20), "never");
                    thread::sleep(Duration::from_millis(5));
                }
            }
        }
    }
    let folder = tempfile::tempdir().expect("folder");
    let mut crash = Crash(folder.path(), 0);
    let run = experiment::run(
        &mut device(DeviceKind::Rig),
        SHORT_RUN,
        &recording(folder.path(), "run", 20),
        &mut crash,
    )
    .expect("recorded");
    assert!(crash.1 > 8);

    // Cut the last row anywhere: it is left out whatever remains of it.
    let text = fs::read(&run.csv).expect("telemetry");
    let whole = run.trial.samples as usize;
    let crashed = TrialRecord {
        status: Status::Running,
        ..run.trial.clone()
    };
    for cut in 2..40 {
        fs::write(&run.csv, &text[..text.len() - cut]).expect("cut");
        let samples: Vec<RigSample> = crashed.samples(&run.sidecar).expect("readable");
        assert!(
            samples.len() == whole || samples.len() == whole - 1,
            "cut {cut}"
        );
    }
    // A damaged row in the middle is an error.
    let damaged = String::from_utf8(text)
        .expect("ASCII")
        .replacen("running", "running,,", 1);
    fs::write(&run.csv, damaged).expect("damaged");
    assert!(crashed.samples::<RigSample>(&run.sidecar).is_err());
}

/// The emergency stop is ordered while telemetry is being switched off. It reaches the rig and costs the position.
#[test]
fn an_emergency_stop_behind_the_end_is_in_the_record() {
    let folder = tempfile::tempdir().expect("folder");
    let mut script = Script::new(DeviceKind::Rig);
    script.ready = true;
    let (link, log) = link(script);
    let mut rig = Device::connect(link, DeviceKind::Rig, 5).expect("there");
    let stop_us = Mutex::new(None);
    let seen = Arc::clone(&log);
    rig.set_interrupt(Arc::new(move || {
        let log = seen.lock().expect("log");
        let count = |name: &str| log.executed.iter().filter(|one| **one == name).count();
        if count("Run") == 0 {
            return None;
        }
        let mut stop_us = stop_us.lock().expect("free");
        let stop_us = *stop_us.get_or_insert(log.now_us + 500_000);
        match count("SetTelemetry") {
            2.. => Some(Urgent::EStop),
            _ => (log.now_us >= stop_us).then_some(Urgent::Stop),
        }
    }));
    let run = experiment::run(
        &mut rig,
        SHORT_RUN,
        &recording(folder.path(), "run", 20),
        &mut Unobserved,
    )
    .expect("recorded");
    let urgent: Vec<_> = (log.lock().expect("log").urgent.iter())
        .map(|(urgent, _)| *urgent)
        .collect();
    assert_eq!(urgent, [Urgent::Stop, Urgent::EStop]);
    let told = TrialRecord::read(&run.sidecar).expect("sidecar");
    assert_eq!(told.status, Status::Faulted, "{:?}", told.error);
}

/// An emergency stop just behind a run that is complete: the record says both, and does not contradict itself.
#[test]
fn an_emergency_stop_behind_a_complete_run_is_no_contradiction() {
    let folder = tempfile::tempdir().expect("folder");
    let (link, log) = link(Script {
        ready: true,
        ..Script::new(DeviceKind::Rig)
    });
    let mut rig = Device::connect(link, DeviceKind::Rig, 5).expect("there");
    rig.set_interrupt(Arc::new(move || {
        let log = log.lock().expect("log");
        let off = |name: &&&str| **name == "SetTelemetry";
        (log.executed.iter().filter(off).count() == 2).then_some(Urgent::EStop)
    }));
    let recording = recording(folder.path(), "run", 20);
    let run = experiment::run(&mut rig, SHORT_RUN, &recording, &mut Unobserved).expect("recorded");
    assert_eq!(run.record.outcome, RunOutcome::Complete);
    let told = TrialRecord::read(&run.sidecar).expect("sidecar");
    assert_eq!(told.status, Status::Faulted);
    let found = check::record(&run.sidecar, &told);
    assert_eq!(found.contradictions, [""; 0]);
}

/// Events lost in an earlier action are not lost in the next record.
#[test]
fn events_that_were_lost_before_a_run_are_not_lost_in_it() {
    let folder = tempfile::tempdir().expect("folder");
    // More events than the rig keeps, none of which is sent by itself.
    let script = Script {
        ready: true,
        silent_events: (0..200).collect(),
        ..Script::new(DeviceKind::Rig)
    };
    let mut rig = Device::connect(link(script).0, DeviceKind::Rig, 5).expect("there");
    let many = Run {
        cycles: 60,
        timing: RunTiming::Total {
            total_us: 120_000_000,
            accel_um_s2: 100_000,
        },
        ..SHORT_RUN
    };
    rig.run(many).expect("accepted");
    rig.fall_silent(1_000_000).expect("there");
    while rig.rig_status().expect("there").state == RigState::Running {
        rig.fall_silent(300_000).expect("there");
    }
    let recording = recording(folder.path(), "run", 20);
    let run = experiment::run(&mut rig, SHORT_RUN, &recording, &mut Unobserved).expect("recorded");
    assert_eq!(run.trial.lost_events, 0);
}

/// A refused action never begins: it is recorded as refused, and no list or report counts it as a trial.
#[test]
fn a_refused_action_leaves_a_record_that_says_so() {
    let folder = tempfile::tempdir().expect("folder");
    let connected = |kind| Device::connect(link(Script::new(kind)).0, kind, 1).expect("there");
    let mut rig = connected(DeviceKind::Rig);
    let mut capsule = connected(DeviceKind::Capsule);
    let recording = |stem: &str| Recording {
        stem: stem.to_owned(),
        ..recording(folder.path(), "run", 20)
    };
    let seen = &mut Unobserved;
    let run = experiment::run(&mut rig, SHORT_RUN, &recording("run"), seen).map(drop);
    let kind = ActuationKind::Fold;
    let fold = experiment::actuate(&mut capsule, kind, &recording("fold"), seen).map(drop);
    for (stem, result, why) in [("run", run, "home first"), ("fold", fold, "no calibration")] {
        let error = result.expect_err(stem).to_string();
        assert!(error.contains(why), "{error}");
        let sidecar = folder.path().join(format!("{stem}-19700101T000000Z.json"));
        let trial = TrialRecord::read(&sidecar).expect("sidecar");
        assert_eq!(trial.status.name(), "refused", "{trial:?}");
        assert_eq!(check::record(&sidecar, &trial).all(), [""; 0]);
        assert!(trial.error.expect("why").contains(why));
    }
    let folders = [folder.path().to_owned()];
    // Alone, these records leave nothing to report. Beside a trial they are listed as left out, and none is lost.
    let none = html::find(&folders).expect_err("no trial").to_string();
    assert!(none.contains("nothing was done: "), "{none}");
    recorded_run(folder.path());
    let found = html::find(&folders).expect("a folder");
    assert_eq!(found.sidecars.len(), 1, "{found:?}");
    let omitted =
        |omitted: &Omitted| omitted.why.contains("nothing was done: ") && !omitted.is_record;
    assert_eq!(found.omitted.len(), 2, "{found:?}");
    assert!(found.omitted.iter().all(omitted), "{found:?}");
    // As the reader in Python counts.
    let package = Path::new(env!("CARGO_MANIFEST_DIR")).join("../python/src");
    let program = "import sys, retrograde.data as data; print(len(data.trials_in(sys.argv[1])))";
    let mut python = Command::new("python3");
    python.env("PYTHONDONTWRITEBYTECODE", "1");
    python.current_dir(package).args(["-c", program]);
    // Without Python there is no reader.
    if let Ok(output) = python.arg(folder.path()).output() {
        assert_eq!(String::from_utf8_lossy(&output.stdout), "1\n", "{output:?}");
    }
}

/// A ready machine with an operator who stops it under way, then presses the emergency stop once it stands and has
/// been asked how the action ended.
fn stopped_twice(kind: DeviceKind) -> Device {
    let mut script = Script::new(kind);
    script.ready = true;
    let (link, log) = link(script);
    let mut device = Device::connect(link, kind, 5).expect("there");
    device.set_interrupt(Arc::new(move || {
        let log = log.lock().expect("log");
        let asked_last = log.executed.last().copied().unwrap_or_default();
        match log.urgent.is_empty() {
            true => (log.driven_us > 500_000).then_some(Urgent::Stop),
            false if asked_last.ends_with("Record") => Some(Urgent::EStop),
            false => Some(Urgent::Stop),
        }
    }));
    device
}

/// The device's record ends before the emergency stop, but the stop still costs the position.
#[test]
fn an_emergency_stop_behind_the_stop_is_in_the_record() {
    let folder = tempfile::tempdir().expect("folder");
    let recording = recording(folder.path(), "run", 20);
    let mut rig = stopped_twice(DeviceKind::Rig);
    let run = experiment::run(&mut rig, SHORT_RUN, &recording, &mut Unobserved).expect("recorded");
    assert_eq!(run.record.outcome, RunOutcome::Stopped);
    let mut capsule = stopped_twice(DeviceKind::Capsule);
    let kind = ActuationKind::Fold;
    let fold = experiment::actuate(&mut capsule, kind, &recording, &mut Unobserved);
    let fold = fold.expect("recorded");
    assert_eq!(fold.record.outcome, ActuationOutcome::Stopped);
    for sidecar in [run.sidecar, fold.sidecar] {
        let trial = TrialRecord::read(&sidecar).expect("sidecar");
        assert_eq!(trial.status, Status::Faulted, "{trial:?}");
        let why = trial.error.expect("a reason");
        assert!(why.contains("emergency stop"), "{why}");
    }
}

#[test]
fn nothing_moves_if_the_record_cannot_be_written() {
    let folder = tempfile::tempdir().expect("folder");
    let blocked = folder.path().join("file");
    fs::write(&blocked, "").expect("file");
    let mut script = Script::new(DeviceKind::Rig);
    script.ready = true;
    let (link, log) = link(script);
    let mut rig = Device::connect(link, DeviceKind::Rig, 1).expect("there");
    let error = experiment::run(
        &mut rig,
        SHORT_RUN,
        &recording(&blocked.join("below"), "run", 20),
        &mut Unobserved,
    );
    assert!(matches!(error, Err(ExperimentError::Record(_))));
    assert!(!log.lock().expect("log").heard.contains(&"Run"));
}

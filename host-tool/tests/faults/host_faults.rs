//! Faults of the computer, the cable or the disk at a random instant of a campaign. The rig comes to rest in time,
//! the reason is reported at once and recorded, the folder stays intact, and the campaign can go on.

use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use crate::support::bench::{Bench, read, with_little_space};
use crate::support::plan::{ONE_CONDITION, PAPER, changed};
use crate::support::signal::{Signal, kill};
use client::address::Address;
use client::link::{Link, LinkError, OpenError};
use host_tool::cli::run_on;
use jiff::{SignedDuration, Timestamp};
use lab::campaign::chance::Chance;
use lab::campaign::contents::Campaign;
use lab::campaign::ledger::{AttemptOutcome, LedgerEvent, TrialStatus};
use lab::campaign::verify::verify;
use lab::operations::connector::{Connector, LinkPurpose};
use protocol::settings::SettingKey;
use protocol::system::DeviceKind;
use simulated_machines::link::{Memory, Peer};
use simulated_machines::machine::{Script, Shared, SimulatedMachine, VIRTUAL_UID};

/// Number of instants: all if RETROGRADE_CAMPAIGN is set, else only the first.
fn count(all: usize, first: usize) -> usize {
    match std::env::var_os("RETROGRADE_CAMPAIGN") {
        Some(_) => all,
        None => first,
    }
}

/// A plan of two short trials, with one run of this duration each.
fn plan(duration_s: u32) -> String {
    let duration = format!("duration_s = {duration_s}");
    let short = [
        ("repeats = 10", "repeats = 2"),
        ("duration_s = 40", &*duration),
        ("stroke_mm = 130", "stroke_mm = 20"),
    ];
    changed(&changed(PAPER, &ONE_CONDITION), &short)
}

/// Outcome and reason, from the ledger, of the attempt that did not end as planned; none if there was none. Asserts
/// that the campaign went on after it.
fn went_on(folder: &Path) -> Option<(AttemptOutcome, String)> {
    let verified = verify(folder).expect("a folder");
    assert_eq!(verified.findings, vec![], "{}", folder.display());
    let campaign = Campaign::read(folder).expect("a campaign");
    for trial in &campaign.state.trials {
        assert_eq!(trial.status(), TrialStatus::Done, "{trial:?}");
        let status = trial.attempts.iter().filter(|attempt| attempt.stands());
        assert_eq!(status.count(), 1, "{trial:?}");
    }
    let mut broken = campaign.rows.iter().filter(|row| {
        row.outcome
            .is_some_and(|outcome| outcome != AttemptOutcome::Complete)
    });
    let row = broken.next()?;
    assert_eq!(broken.next(), None, "one blow, one attempt");
    Some((row.outcome?, row.text.clone().unwrap_or_default()))
}

/// Device time of the last sample in the run of the latest attempt, us.
fn last_sample_us(folder: &Path) -> Option<u64> {
    let campaign = Campaign::read(folder).expect("a campaign");
    let mut rows = campaign.rows.iter().rev();
    let began = rows.find(|row| row.event == LedgerEvent::Began)?;
    let mut files = fs::read_dir(campaign.attempt_folder(began.trial?, began.attempt?)).ok()?;
    let csv = files.find_map(|entry| {
        let path = entry.expect("an entry").path();
        let name = path.file_name()?.to_str()?;
        (name.starts_with("run-") && name.ends_with(".csv")).then_some(path)
    })?;
    let text = fs::read_to_string(csv).expect("text");
    // Skip a row that a crash has cut off.
    let whole = &text[..text.rfind('\n')?];
    whole.lines().last()?.split(',').next()?.parse().ok()
}

// Faults of the tool in a process of its own.

/// Speed of the machine's clock relative to real time.
const SPEED: u32 = 12;
/// Link time-out: three quarters of a second of real time, which are three keep-alives of a busy computer.
const TIMEOUT_MS: u32 = 9_000;
/// Time to brake from the fastest of these runs.
const BRAKING_US: u64 = 1_000_000;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Blow {
    Signal(Signal),
    Killed,
    DiskFull,
    FolderRemoved,
}

const BLOWS: [Blow; 6] = [
    Blow::Signal(Signal::INT),
    Blow::Killed,
    Blow::DiskFull,
    Blow::Signal(Signal::TERM),
    Blow::FolderRemoved,
    Blow::Signal(Signal::HUP),
];

#[test]
fn what_happens_to_the_process_is_told_kept_and_survived() {
    // The rig is switched on with the line, so that both clocks are equal.
    let mut script = Script::new(DeviceKind::Rig);
    script.uid = VIRTUAL_UID;
    script.settings = vec![(SettingKey::LinkTimeoutMs, TIMEOUT_MS)];
    let bench = Bench::on_tcp_as(&script, SPEED);
    let place = bench.folder.path();
    fs::write(place.join("plan.toml"), plan(12)).expect("written");
    let mut chance = Chance::new(200);
    for index in 0..count(134, 6) {
        let blow = BLOWS[index % BLOWS.len()];
        let name = format!("c{index}");
        suffer(&bench, &name, blow, &mut chance);
        let folder = place.join(&name);
        if blow == Blow::FolderRemoved {
            continue;
        }
        let (code, out, err) = bench.retrograde(&["campaign", "run", &name, "--yes"]);
        assert_eq!(code, Some(0), "{blow:?}: {out}{err}");
        let first = went_on(&folder);
        let Some((outcome, reason)) = first else {
            assert_ne!(blow, Blow::DiskFull, "the file was not cut");
            continue;
        };
        let wanted = match blow {
            Blow::Signal(_) => AttemptOutcome::Stopped,
            _ => AttemptOutcome::Lost,
        };
        assert_eq!(outcome, wanted, "{blow:?}: {reason}");
        assert!(!reason.is_empty(), "{blow:?}");
    }
}

/// Begins a campaign and applies the blow during its first run.
fn suffer(bench: &Bench, name: &str, blow: Blow, chance: &mut Chance) {
    let plain = bench.command(&["campaign", "run", "plan.toml", "--out", name, "--yes"]);
    let mut command = match blow {
        // Locks and ledger stay below the limit; the telemetry does not.
        Blow::DiskFull => little_space(&plain, chance),
        _ => plain,
    };
    let folder = bench.folder.path().join(name);
    let runs = bench.count("Run");
    let mut child = command.spawn().expect("starts");
    while bench.count("Run") == runs {
        if let Some(status) = child.try_wait().expect("a child") {
            let (_, out, err) = read(child.wait_with_output().expect("ended"));
            panic!("{blow:?}: {status}: {out}{err}");
        }
        thread::sleep(Duration::from_millis(1));
    }
    // Wait by the machine's clock, which a busy computer slows down: the run takes 12 s of it.
    let now_us = || bench.log.lock().expect("log").now_us;
    let at_us = now_us() + 1_000 * chance.below(10_800) as u64;
    while now_us() < at_us {
        thread::sleep(Duration::from_millis(1));
    }
    match blow {
        Blow::Signal(signal) => kill(signal, child.id()),
        Blow::Killed => child.kill().expect("ours"),
        Blow::FolderRemoved => fs::remove_dir_all(&folder).expect("ours"),
        Blow::DiskFull => {}
    }
    let (code, out, err) = read(child.wait_with_output().expect("ends"));
    let (ended_us, heard_us) = {
        let log = bench.log.lock().expect("log");
        (log.now_us, log.heard_us)
    };
    let (wanted, words): (_, &[&str]) = match blow {
        Blow::Signal(_) => (Some(130), &["stopped"]),
        Blow::Killed => (None, &[]),
        Blow::DiskFull => (Some(1), &["NOT RECORDED", "File too large"]),
        Blow::FolderRemoved => (Some(1), &["No such file"]),
    };
    assert_eq!(code, wanted, "{blow:?}: {out}{err}");
    let said = format!("{out}{err}");
    for word in words {
        assert!(said.contains(word), "{blow:?}: {word}: {said}");
    }
    // The rig must stand once it has missed the tool for the time-out and braked.
    let deadline_us = ended_us + u64::from(TIMEOUT_MS) * 1_000 + BRAKING_US;
    while bench.log.lock().expect("log").now_us < deadline_us {
        thread::sleep(Duration::from_millis(2));
    }
    let driven_us = bench.log.lock().expect("log").driven_us;
    let at_most_us = heard_us + u64::from(TIMEOUT_MS) * 1_000 + BRAKING_US;
    assert!(
        driven_us <= at_most_us,
        "{blow:?}: driven at {driven_us}, heard at {heard_us}"
    );
}

fn little_space(command: &Command, chance: &mut Chance) -> Command {
    with_little_space(command, 512 * (24 + chance.below(60) as u32))
}

// Faults in this process, in virtual time: at every instant of a session, to the microsecond.

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// The tool panics.
    Panics,
    /// The cable is pulled, and the system reports it.
    Pulled,
    /// The cable breaks silently.
    Silent,
    /// The computer's clock goes back by a day.
    ClockSetBack,
}

const FAULTS: [Fault; 4] = [
    Fault::Panics,
    Fault::Pulled,
    Fault::Silent,
    Fault::ClockSetBack,
];

/// A computer with this fault at this instant of the link's clock.
struct Computer {
    fault: Option<(Fault, u64)>,
    folder: PathBuf,
    machine: Arc<Mutex<SimulatedMachine>>,
    clock_us: Arc<Mutex<u64>>,
    within: Arc<Mutex<Vec<u64>>>,
}

struct Faulty {
    link: Memory<Shared>,
    fault: Option<(Fault, u64)>,
    machine: Arc<Mutex<SimulatedMachine>>,
    clock_us: Arc<Mutex<u64>>,
    folder: PathBuf,
    /// When the present run began, us.
    run_since_us: Option<u64>,
    /// Instants at which a killed process must have kept samples, us.
    within: Arc<Mutex<Vec<u64>>>,
}

/// Largest age of samples not yet handed to the disk, us: the quarter of a second in which the tool collects them,
/// plus transit.
const COLLECTED_US: u64 = 300_000;
/// Time by which even a slow disk has taken the samples.
const WRITTEN: Duration = Duration::from_secs(60);

impl Faulty {
    /// Notes whether a run is in progress, and since when.
    fn watch(&mut self) {
        let runs = self.machine.lock().expect("free").is_in_a_run();
        self.run_since_us = match self.run_since_us {
            _ if !runs => None,
            None => Some(self.link.now_us()),
            since_us => since_us,
        };
        if self.oldest_kept_us().is_some() {
            let mut within = self.within.lock().expect("free");
            within.push(self.link.now_us());
        }
    }

    /// Time up to which samples must be kept, if a run is in progress, us.
    fn oldest_kept_us(&self) -> Option<u64> {
        let oldest_us = self.link.now_us().checked_sub(COLLECTED_US)?;
        (self.run_since_us? <= oldest_us).then_some(oldest_us)
    }

    /// Asserts that a process killed at this instant leaves all but the last samples on the disk.
    fn has_kept_the_samples(&self) {
        let Some(oldest_us) = self.oldest_kept_us() else {
            return;
        };
        let begin = Instant::now();
        while last_sample_us(&self.folder).is_none_or(|kept_us| kept_us < oldest_us) {
            assert!(begin.elapsed() < WRITTEN, "the samples are not kept");
            thread::sleep(Duration::from_millis(1));
        }
    }

    fn due(&self) -> Option<Fault> {
        let (fault, at_us) = self.fault?;
        (self.link.now_us() >= at_us).then_some(fault)
    }

    fn lost(&self) -> LinkError {
        LinkError::Lost {
            place: self.link.place(),
            why: "the device is gone".to_owned(),
        }
    }
}

impl Link for Faulty {
    fn place(&self) -> String {
        self.link.place()
    }

    fn now_us(&self) -> u64 {
        self.link.now_us()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        match self.due() {
            Some(Fault::Panics) => panic!("a defect of the tool"),
            Some(Fault::Pulled) => Err(self.lost()),
            Some(Fault::Silent) => Ok(()),
            Some(Fault::ClockSetBack) | None => self.link.send(bytes),
        }
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        *self.clock_us.lock().expect("free") = self.link.now_us();
        self.watch();
        match self.due() {
            Some(Fault::Panics) => {
                self.has_kept_the_samples();
                panic!("a defect of the tool")
            }
            Some(Fault::Pulled) => Err(self.lost()),
            Some(Fault::Silent) => {
                while self.link.now_us() < deadline_us {
                    self.link.receive(&mut [0; 256], deadline_us)?;
                }
                Ok(0)
            }
            Some(Fault::ClockSetBack) | None => {
                // Do not idle past the instant of the fault.
                let at_us = self.fault.map_or(u64::MAX, |(_, at_us)| at_us);
                let until_us = match self.due() {
                    None => deadline_us.min(at_us),
                    Some(_) => deadline_us,
                };
                self.link.receive(buffer, until_us)
            }
        }
    }
}

impl Connector for Computer {
    fn open(
        &self,
        _: DeviceKind,
        _: &Address,
        _: u32,
        _: LinkPurpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        Ok(Box::new(Faulty {
            link: Memory::new("test rig", Shared(Arc::clone(&self.machine))),
            fault: self.fault,
            machine: Arc::clone(&self.machine),
            clock_us: Arc::clone(&self.clock_us),
            folder: self.folder.clone(),
            run_since_us: None,
            within: Arc::clone(&self.within),
        }))
    }

    fn nonce(&self) -> u32 {
        1
    }

    fn now(&self) -> Timestamp {
        let us = *self.clock_us.lock().expect("free");
        let now = Timestamp::UNIX_EPOCH
            + SignedDuration::from_hours(500_000)
            + SignedDuration::from_micros(us as i64);
        match self.fault {
            Some((Fault::ClockSetBack, at_us)) if us >= at_us => {
                now - SignedDuration::from_hours(24)
            }
            _ => now,
        }
    }
}

/// Result of a session.
struct Session {
    /// Exit code; none after a panic.
    code: Option<u8>,
    said: String,
    /// Duration, us.
    us: u64,
    machine: Arc<Mutex<SimulatedMachine>>,
    /// Instants during its runs, us.
    within: Vec<u64>,
}

/// Waits until the writing thread has finished. A killed process would take the thread with it, but here it ends by
/// itself.
fn until_nothing_is_written(place: &Path) {
    let is_open = || {
        let files = fs::read_dir("/proc/self/fd").into_iter().flatten();
        let mut targets = files.filter_map(|file| fs::read_link(file.ok()?.path()).ok());
        targets.any(|target| target.starts_with(place))
    };
    let begin = Instant::now();
    while is_open() {
        assert!(begin.elapsed() < WRITTEN, "a file stays open");
        thread::sleep(Duration::from_millis(1));
    }
}

/// Continues the campaign in a new session at a new rig.
fn session(place: &Path, fault: Option<(Fault, u64)>) -> Session {
    let mut script = Script::new(DeviceKind::Rig);
    script.uid = VIRTUAL_UID;
    let machine = Arc::new(Mutex::new(SimulatedMachine::new(script).0));
    let computer = Computer {
        fault,
        folder: place.join("c"),
        machine: Arc::clone(&machine),
        clock_us: Arc::default(),
        within: Arc::default(),
    };
    let folder = place.join("c").display().to_string();
    let plan = place.join("plan.toml").display().to_string();
    let mut args = vec!["retrograde", "campaign"];
    match place.join("c").exists() {
        true => args.extend(["run", &folder, "--yes"]),
        false => args.extend(["run", &plan, "--out", &folder, "--yes"]),
    }
    args.extend(["--rig", "0"]);
    let (mut out, mut err) = (vec![], vec![]);
    let code = catch_unwind(AssertUnwindSafe(|| {
        let args = args.iter().map(Into::into);
        run_on(args, &computer, &mut out, &mut err, None)
    }));
    let said = String::from_utf8_lossy(&[out, err].concat()).into_owned();
    until_nothing_is_written(place);
    let us = *computer.clock_us.lock().expect("free");
    let within = std::mem::take(&mut *computer.within.lock().expect("free"));
    Session {
        code: code.ok(),
        said,
        us,
        machine,
        within,
    }
}

#[test]
fn what_happens_to_tool_cable_and_clock_is_told_kept_and_survived() {
    let new_place = || {
        let place = tempfile::tempdir().expect("a folder");
        fs::write(place.path().join("plan.toml"), plan(4)).expect("written");
        place
    };
    let place = new_place();
    let whole = session(place.path(), None);
    assert_eq!(whole.code, Some(0), "{}", whole.said);
    assert!(!whole.within.is_empty(), "no run");
    assert_eq!(went_on(&place.path().join("c")), None);

    let timeout_us = u64::from(SettingKey::LinkTimeoutMs.range().default) * 1_000;
    let mut chance = Chance::new(66);
    let mut in_runs = 0;
    for index in 0..count(66, 24) {
        let fault = FAULTS[index % FAULTS.len()];
        // Any instant; for every second panic one within a run, where samples could be lost.
        let at_us = match fault {
            Fault::Panics if index % 8 == 0 => whole.within[chance.below(whole.within.len())],
            _ => chance.below(whole.us as usize) as u64,
        };
        let place = new_place();
        let Session {
            code,
            said,
            machine,
            ..
        } = session(place.path(), Some((fault, at_us)));
        let what = format!("{fault:?} at {at_us} us: {said}");
        match fault {
            Fault::Panics => assert_eq!(code, None, "{what}"),
            Fault::Pulled => {
                assert!(matches!(code, Some(4 | 7)), "{code:?} {what}");
                assert!(said.contains("the device is gone"), "{what}");
            }
            Fault::Silent => assert!(matches!(code, Some(4 | 7)), "{code:?} {what}"),
            Fault::ClockSetBack => {
                assert_eq!(code, Some(0), "{what}");
                assert_eq!(went_on(&place.path().join("c")), None, "{what}");
                continue;
            }
        }
        // The rig must stand once it has missed the tool for the time-out.
        let mut machine = machine.lock().expect("it has not panicked");
        machine.give(at_us + timeout_us + BRAKING_US);
        let rested_us = machine.driven_us();
        assert!(
            rested_us < at_us + timeout_us + BRAKING_US,
            "{rested_us} {what}"
        );
        drop(machine);
        let folder = place.path().join("c");
        let begun = folder.exists();
        let sampled_us = begun.then(|| last_sample_us(&folder)).flatten();
        let Session { code, said, .. } = session(place.path(), None);
        assert_eq!(code, Some(0), "{what}\n{said}");
        let Some((outcome, reason)) = went_on(&folder) else {
            continue;
        };
        assert_eq!(outcome, AttemptOutcome::Lost, "{what}");
        assert!(!reason.is_empty(), "{what}");
        if let Some(sampled_us) = sampled_us {
            in_runs += 1;
            // The alarm holds at that moment only.
            assert!(!reason.contains("MAY BE MOVING"), "{reason} {what}");
            // Between the end of the run and its record there is nothing to be alarmed at.
            if fault != Fault::Panics && rested_us >= at_us {
                assert!(what.contains("MAY BE MOVING"), "{what}");
            }
            // The rig was switched on with the link, so the clocks are equal.
            assert!(
                at_us < sampled_us + 1_000_000,
                "the last sample is of {sampled_us} us: {what}"
            );
        }
    }
    assert!(in_runs > 2, "hardly any instant was within a run");
}

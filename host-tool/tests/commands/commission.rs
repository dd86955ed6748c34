//! Commissioning without the image: the next step, the record, and the view of a person at the terminal.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard};

use crate::support::tool::{Memory, ready};
use client::Device;
use client::identity::Origin;
use client::link::{Link, LinkError};
use client::subject::Subject;
use jiff::Timestamp;
use lab::commissioning::halt::Halt;
use lab::commissioning::operator::{Act, Instruction, Operator, Part, Reading, Say, Watch};
use lab::commissioning::procedure::{Procedure, StepStatus, open, status};
use lab::commissioning::record::{Commissioning, Finding, StepOutcome};
use lab::commissioning::rig::wrong_travel;
use lab::commissioning::step::{self, ProcedureStep};
use lab::commissioning::work::{Options, Work};
use protocol::settings::SettingKey;
use protocol::system::DeviceKind;
use serde_json::{Map, Value};
use simulated_machines::machine::{Script, link};

const NOW: Timestamp = Timestamp::UNIX_EPOCH;

fn subject() -> Subject {
    let settings = SettingKey::ALL.map(|key| (key.name().to_owned(), key.range().default));
    Subject {
        machine: DeviceKind::Rig,
        uid: "0123456789abcdef01234567".to_owned(),
        origin: Origin::Board,
        image: "10a2fe44".to_owned(),
        firmware: "8f1e5872".to_owned(),
        protocol: "3.0".to_owned(),
        settings: BTreeMap::from(settings),
    }
}

fn finding(outcome: StepOutcome) -> Finding {
    Finding {
        outcome,
        reason: None,
        measured: Map::new(),
    }
}

fn enter(record: &mut Commissioning, name: &str, finding: Finding, subject: &Subject) {
    let procedure = Procedure::new(step::steps(DeviceKind::Rig));
    procedure.enter(record, step(name), finding, subject, NOW);
}

/// A record in which every step has passed.
fn complete(subject: &Subject) -> Commissioning {
    let mut record = Commissioning::new(subject, NOW);
    for step in step::steps(DeviceKind::Rig) {
        enter(
            &mut record,
            step.name,
            finding(StepOutcome::Passed),
            subject,
        );
    }
    record
}

fn step(name: &str) -> &'static ProcedureStep {
    let mut all = step::steps(DeviceKind::Rig).iter();
    all.find(|step| step.name == name).expect("a step")
}

fn open_names(record: &Commissioning, subject: &Subject) -> Vec<&'static str> {
    let open = open(step::steps(subject.machine), record, subject);
    open.iter().map(|(step, _)| step.name).collect()
}

#[test]
fn a_step_holds_for_the_image_and_the_settings_that_it_was_shown_with() {
    let known = subject();
    let record = complete(&known);
    assert!(record.complete);
    assert_eq!(open_names(&record, &known), Vec::<&str>::new());

    // The firmware does not matter for the test of EN in reset.
    let mut flashed = known.clone();
    flashed.image = "00000000".to_owned();
    let open = open_names(&record, &flashed);
    assert_eq!(open.len(), record.steps.len() - 1);
    assert!(!open.contains(&"enable"));
    assert_eq!(
        status(step("home"), &record, &flashed),
        StepStatus::OtherImage
    );

    let mut set = known.clone();
    set.settings.insert("dead_man_ms".to_owned(), 200);
    assert_eq!(open_names(&record, &set), ["jog"]);
    set.settings.insert("lead_um".to_owned(), 5_000);
    let travel = status(step("travel"), &record, &set);
    assert_eq!(travel, StepStatus::OtherSetting("lead_um"));
    assert_eq!(status(step("e-stop"), &record, &set), StepStatus::Holds);

    // No step depends on the rig's name or the button's run.
    let mut button = known;
    button.settings.insert("button_cycles".to_owned(), 7);
    assert_eq!(open_names(&record, &button), Vec::<&str>::new());
}

/// The flag's place is that of position 0, and its distance the length of the short strokes. The deceleration is that
/// of a hold, of a lost link and of a jog.
#[test]
fn a_setting_opens_the_steps_that_move_by_it() {
    let record = complete(&subject());
    for (setting, steps) in [
        (
            "flag_um",
            &["read-back", "edge-timing", "stroke", "run"][..],
        ),
        ("max_residual_steps", &["read-back", "edge-timing", "run"]),
        ("stop_accel_um_s2", &["cable", "hold", "jog"]),
        ("homing_accel_um_s2", &["jog"]),
        ("stroke_um", &["jog", "stroke", "run"]),
        ("link_timeout_ms", &["cable"]),
    ] {
        let mut set = subject();
        set.settings.insert(setting.to_owned(), 901);
        let mut open = open_names(&record, &set);
        // Homing depends on most of them, and is not asked here.
        open.retain(|name| !["pulses", "home", "repeat"].contains(name));
        assert_eq!(open, steps, "{setting}");
    }
}

#[test]
fn what_failed_or_was_not_shown_is_due_once_in_each_session() {
    let subject = subject();
    let mut record = complete(&subject);
    enter(
        &mut record,
        "travel",
        finding(StepOutcome::Failed),
        &subject,
    );
    enter(
        &mut record,
        "jumper",
        finding(StepOutcome::NotShown),
        &subject,
    );
    assert!(!record.complete);
    for _ in 0..2 {
        let mut procedure = Procedure::new(step::steps(DeviceKind::Rig));
        let mut next = || procedure.next(&record, &subject).map(|(_, step)| step.name);
        assert_eq!(
            [next(), next(), next()],
            [Some("travel"), Some("jumper"), None]
        );
    }
    enter(
        &mut record,
        "travel",
        finding(StepOutcome::Passed),
        &subject,
    );
    enter(
        &mut record,
        "jumper",
        finding(StepOutcome::Passed),
        &subject,
    );
    assert!(record.complete);
    // Lists the steps in their order, whatever the order of the results.
    let order: Vec<_> = record
        .steps
        .iter()
        .map(|result| result.step.as_str())
        .collect();
    let steps: Vec<_> = step::steps(DeviceKind::Rig)
        .iter()
        .map(|step| step.name)
        .collect();
    assert_eq!(order, steps);
}

#[test]
fn names_of_steps_are_unique() {
    for machine in [DeviceKind::Rig, DeviceKind::Capsule] {
        let all = step::steps(machine);
        for (index, step) in all.iter().enumerate() {
            assert!(all[..index].iter().all(|other| other.name != step.name));
            assert!(!step.shows.is_empty(), "{}", step.name);
        }
    }
}

#[test]
fn a_record_is_read_back_as_it_was_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("new").join("record.json");
    let subject = subject();
    assert_eq!(Commissioning::read(&path).expect("none"), None);
    let mut record = Commissioning::resume(&path, &subject, NOW).expect("a new one");
    let mut travel = finding(StepOutcome::Failed);
    travel.reason = Some("wrong lead".to_owned());
    travel
        .measured
        .insert("measured_um".to_owned(), Value::from(50_000));
    enter(&mut record, "travel", travel, &subject);
    record.write(&path).expect("written");
    let read = Commissioning::resume(&path, &subject, NOW).expect("the same");
    assert_eq!(read, record);
    let json: Value =
        serde_json::from_str(&std::fs::read_to_string(&path).expect("text")).expect("JSON");
    assert_eq!(json["steps"][0]["result"], "failed");
    assert_eq!(json["steps"][0]["settings"]["lead_um"], 4_000);
    assert_eq!(json["steps"][0]["measured"]["measured_um"], 50_000);
    assert_eq!(json["board_uid"], subject.uid);

    // No other file is left beside it, and another board's record is not continued.
    let files = std::fs::read_dir(path.parent().expect("a folder")).expect("read");
    assert_eq!(files.count(), 1);
    let mut other = subject;
    other.uid = "ffffffffffffffffffffffff".to_owned();
    let error = Commissioning::resume(&path, &other, NOW).expect_err("another board");
    assert!(
        error.to_string().contains("0123456789abcdef01234567"),
        "{error}"
    );
    std::fs::write(&path, "{").expect("damaged");
    assert!(Commissioning::read(&path).is_err());
}

#[test]
fn a_measured_travel_tells_microsteps_from_lead() {
    let paper = [4_000, 200, 16];
    let says = |measured, settings| wrong_travel(40_000, measured, settings);
    for right in [39_500, 40_000, 40_500] {
        assert_eq!(says(right, paper), None, "{right}");
    }
    for (measured, settings, text) in [
        (
            20_000,
            paper,
            "The driver is strapped for 32, and microsteps is 16",
        ),
        (20_100, paper, "or the motor has 400 steps per turn"),
        (80_000, paper, "The driver is strapped for 8, and"),
        (
            80_000,
            [4_000, 400, 16],
            "or the motor has 200 steps per turn",
        ),
        (10_000, paper, "strapped for 64"),
        (50_000, paper, "lead of about 5000 um, and lead_um is 4000"),
        (30_000, paper, "lead of about 3000 um"),
        (0, paper, "did not move"),
    ] {
        let said = says(measured, settings).expect("a defect");
        assert!(said.contains(text), "{measured}: {said}");
    }
}

#[test]
fn wishes_are_read_as_they_are_written() {
    let acts = Part::ALL
        .iter()
        .flat_map(|part| [true, false].map(|on| Instruction::Do(Act { part: *part, on })));
    for wish in acts.chain(
        Reading::ALL
            .iter()
            .map(|reading| Instruction::Read(*reading)),
    ) {
        assert_eq!(wish.to_string().parse(), Ok(wish));
    }
    for text in [
        "",
        "do",
        "do e-stop",
        "do e-stop maybe",
        "do nothing on",
        "read",
        "read minds",
    ] {
        assert!(text.parse::<Instruction>().is_err(), "{text}");
    }
}

fn outcomes(record: &Path) -> BTreeMap<String, StepOutcome> {
    let record = Commissioning::read(record)
        .expect("a record")
        .expect("a file");
    let steps = record.steps.into_iter();
    steps.map(|result| (result.step, result.outcome)).collect()
}

/// The command line of a commissioning with its record at `path`.
fn commission_rig(path: &Path) -> [&str; 8] {
    let record = path.to_str().expect("UTF-8");
    [
        "--rig",
        "0",
        "commission",
        "rig",
        "--clock-s",
        "1",
        "--record",
        record,
    ]
}

#[test]
fn without_an_operator_what_needs_one_is_not_shown() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("record.json");
    let memory = Memory::with(vec![Script::new(DeviceKind::Rig)]);
    let (code, out, err) = memory.run(&[&commission_rig(&path)[..], &["--yes"]].concat());
    assert_eq!(code, 3, "{out}{err}");
    assert!(err.contains("commissioning is not complete"), "{err}");
    assert!(
        out.contains("not shown: needs a person at the machine"),
        "{out}"
    );
    let found = outcomes(&path);
    assert_eq!(found.len(), step::steps(DeviceKind::Rig).len());
    for step in step::steps(DeviceKind::Rig) {
        // This test's machine has no image, so no image can be compared.
        let passed = ["clock", "quiet"].contains(&step.name);
        let expected = if passed {
            StepOutcome::Passed
        } else {
            StepOutcome::NotShown
        };
        if step.name != "image" {
            assert_eq!(found[step.name], expected, "{}", step.name);
        }
    }
    // Nothing has moved.
    let heard = memory.heard();
    assert!(
        !heard
            .iter()
            .any(|name| ["Home", "Run", "Jog", "MoveTo"].contains(name)),
        "{heard:?}"
    );
}

#[test]
fn without_a_terminal_nobody_is_asked() {
    let memory = Memory::with(vec![Script::new(DeviceKind::Rig)]);
    let (code, _, err) = memory.run(&["--rig", "0", "commission", "rig"]);
    assert_eq!(code, 3, "{err}");
    assert!(err.contains("--yes"), "{err}");
    assert!(memory.heard().is_empty());
    let (code, _, err) = memory.run(&["--rig", "0", "commission", "rig", "--fixture", "x:1"]);
    assert_eq!(code, 2, "{err}");
}

#[test]
fn numbers_that_no_session_takes_are_refused_with_their_range() {
    for (option, range, bad) in [
        (
            "--strokes",
            "an even number from 2 to 20000",
            &["0", "1", "3", "19999", "20001", "20002", "65536", "-2", "x"][..],
        ),
        ("--cycles", "1 to 100", &["0", "101", "65536"]),
        ("--clock-s", "1 to 3600", &["0", "3601", "65536"]),
    ] {
        for number in bad {
            let memory = Memory::with(vec![Script::new(DeviceKind::Rig)]);
            let option = format!("{option}={number}");
            let (code, _, err) = memory.run(&["--rig", "0", "commission", "rig", &option]);
            assert_eq!(code, 2, "{option}: {err}");
            assert!(err.contains(range), "{option}: {err}");
            assert!(memory.heard().is_empty());
        }
    }
}

/// A person leaves, by key and by the end of the input. The results are kept, and the next session begins with the
/// rest.
#[test]
fn a_person_who_leaves_loses_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("record.json");
    let memory = Memory::with(vec![Script::new(DeviceKind::Rig)]);
    let line = commission_rig(&path);
    for (typed, at) in [
        ("q\n", "enable"),
        ("", "enable"),
        ("\nvolts\n\n0.2\n", "e-stop"),
    ] {
        let (code, out, err) = memory.run_typed(&line, typed);
        assert_eq!(code, 130, "{typed:?} {out}{err}");
        assert!(err.contains(at), "{err}");
        assert!(out.contains("Switch the MOTOR SUPPLY OFF"), "{out}");
        assert_eq!(outcomes(&path)["clock"], StepOutcome::Passed);
        let wide = out
            .lines()
            .find(|line| line.len() > 80 && !line.starts_with("Record: "));
        assert_eq!(wide, None);
    }
    let found = Commissioning::read(&path)
        .expect("a record")
        .expect("a file");
    let enable = found.result("enable").expect("a result");
    assert_eq!(enable.measured["enable_in_reset_mv"], 200);
    // This machine does not restart, so its reset button cannot have been held.
    assert_eq!(enable.outcome, StepOutcome::NotShown);
    let reason = enable.reason.as_deref().unwrap_or_default();
    assert!(reason.contains("was not reset"), "{reason}");
}

#[test]
fn a_run_says_that_its_board_was_not_commissioned() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().to_str().expect("UTF-8");
    let run = [
        "--rig",
        "0",
        "run",
        "--cycles",
        "1",
        "--stroke-mm",
        "1",
        "--duration-s",
        "2",
        "--out",
        out,
    ];
    let memory = Memory::with(vec![ready(DeviceKind::Rig)]);
    let (code, _, err) = memory.run(&run);
    assert_eq!(code, 0, "{err}");
    assert!(
        err.contains("warning: this board has no commissioning record"),
        "{err}"
    );
    // The bench's machines are no boards.
    let mut script = ready(DeviceKind::Rig);
    script.uid = *b"virtual rig1";
    let (code, _, err) = Memory::with(vec![script]).run(&run);
    assert_eq!((code, err.as_str()), (0, ""));

    // A complete record gives no warning. One of another image, or a damaged one, does.
    let mut subject = subject();
    subject.uid = "ab".repeat(12);
    subject.image = "0000cafe".to_owned();
    let path = folder.path().join(subject.file_name());
    complete(&subject).write(&path).expect("written");
    let (code, _, err) = memory.run(&run);
    assert_eq!((code, err.as_str()), (0, ""));
    subject.image = "10a2fe44".to_owned();
    complete(&subject).write(&path).expect("written");
    let (code, _, err) = memory.run(&run);
    assert_eq!(code, 0, "{err}");
    assert!(err.contains("of image 10a2fe44, this is 0000cafe"), "{err}");
    std::fs::write(&path, "{").expect("damaged");
    let (code, _, err) = memory.run(&run);
    assert_eq!(code, 0, "{err}");
    assert!(err.contains("cannot be read"), "{err}");
}

/// A machine whose cable is pulled and plugged again: it goes on meanwhile.
struct Replugged(Arc<Mutex<dyn Link>>);

impl Replugged {
    fn link(&self) -> MutexGuard<'_, dyn Link + 'static> {
        self.0.lock().expect("a link")
    }
}

impl Link for Replugged {
    fn place(&self) -> String {
        self.link().place()
    }

    fn now_us(&self) -> u64 {
        self.link().now_us()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.link().send(bytes)
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        self.link().receive(buffer, deadline_us)
    }
}

/// An operator that is quick.
struct Quick;

impl Operator for Quick {
    fn act(&mut self, _: Act, _: bool, _: &mut Say<'_>, _: &mut Watch<'_>) -> Result<(), Halt> {
        Ok(())
    }

    fn read(&mut self, _: Reading, _: &mut Say<'_>) -> Result<i64, Halt> {
        Err(Halt::NotShown("nothing to read".to_owned()))
    }
}

/// Carries out one step on a good machine that waits for its host as long as this.
fn with_timeout(machine: DeviceKind, name: &str, timeout_ms: u32) -> Result<(), Halt> {
    let (link, _) = link(Script {
        settings: vec![(SettingKey::LinkTimeoutMs, timeout_ms)],
        ..Script::new(machine)
    });
    let link = Arc::new(Mutex::new(*link));
    let sessions = Cell::new(1);
    let connect = || {
        let mut device = Device::new(Box::new(Replugged(link.clone())), 1);
        let hello = device.hello(sessions.replace(sessions.get() + 1));
        hello.map(|_| device).map_err(|error| error.to_string())
    };
    let mut device = connect().expect("it answers");
    let subject = Subject::of(&mut device).expect("it answers");
    let options = Options {
        read_back_cycles: 2,
        cycles: 1,
        clock_us: 200_000,
        image: None,
    };
    let (mut operator, mut say) = (Quick, |_: &str| {});
    let mut work = Work::new(device, subject, options, &mut operator, &mut say, &connect);
    let step = step::steps(machine).iter().find(|step| step.name == name);
    (step.expect("a step").check)(&mut work)
}

/// The longest setting is a minute. A fold is over after 4 s, which tells nothing; a run is not.
#[test]
fn a_machine_that_waits_longer_for_its_host_does_not_fail() {
    for timeout_ms in [200, 1_000, 5_000, 60_000] {
        let silence = with_timeout(DeviceKind::Capsule, "silence", timeout_ms);
        match silence {
            Ok(()) => assert!(timeout_ms <= 1_000, "{timeout_ms} ms"),
            Err(Halt::NotShown(why)) => {
                assert!(
                    timeout_ms > 1_000 && why.contains("link_timeout_ms"),
                    "{why}"
                );
            }
            other => panic!("{timeout_ms} ms: {other:?}"),
        }
        let cable = with_timeout(DeviceKind::Rig, "cable", timeout_ms);
        assert!(cable.is_ok(), "{timeout_ms} ms: {cable:?}");
    }
}

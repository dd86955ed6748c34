//! Campaigns on the command line, over the firmware's own request handling in virtual time, with a person at the
//! keyboard and without one.

use std::fs;
use std::io::{self, BufRead, Read, Write};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use crate::support::plan::{PAPER, changed};
use crate::support::tool::Memory;
use client::identity::Origin;
use host_tool::cli::run_on;
use lab::campaign::contents::Campaign;
use lab::campaign::form::Form;
use lab::campaign::ledger::{AttemptOutcome, LedgerEvent, Source, Standing};
use lab::campaign::verify::verify;
use lab::operations::connector::Connector;
use locomotion::roller::Params;
use protocol::system::DeviceKind;
use simulated_machines::machine::{Script, VIRTUAL_UID, World};

/// The paper's plan with fewer trials, shorter runs and these changes.
pub fn small_plan(changes: &[(&str, &str)]) -> String {
    let small = [
        ("repeats = 10", "repeats = 1"),
        ("duration_s = 40", "duration_s = 8"),
        ("cycles = 5", "cycles = 1"),
        (r#"["a1", "a2", "a3", "a4", "a5"]"#, r#"["a2", "a5"]"#),
        ("telemetry_ms = 10 ", "telemetry_ms = 50 "),
        ("count = 5", "count = 2"),
    ];
    changed(PAPER, &[&small, changes].concat())
}

pub fn machines(uid: Option<[u8; 12]>) -> Memory {
    Memory::with(
        [DeviceKind::Rig, DeviceKind::Capsule]
            .map(|kind| {
                let mut script = Script::new(kind);
                script.uid = uid.unwrap_or(script.uid);
                script
            })
            .to_vec(),
    )
}

pub fn place(plan: &str) -> tempfile::TempDir {
    let place = tempfile::tempdir().expect("a folder");
    fs::write(place.path().join("plan.toml"), plan).expect("written");
    place
}

pub fn path(place: &tempfile::TempDir, name: &str) -> String {
    place.path().join(name).display().to_string()
}

const AT: [&str; 4] = ["--rig", "0", "--capsule", "1"];

pub fn whole(folder: &str) -> Campaign {
    let verified = verify(Path::new(folder)).expect("a folder");
    assert_eq!(verified.findings, vec![]);
    Campaign::read(Path::new(folder)).expect("a campaign")
}

/// It said `SD 0.000 mm`.
#[test]
fn a_session_tells_one_reading_without_a_standard_deviation() {
    let place = place(&small_plan(&[("count = 2", "count = 1")]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let args = ["campaign", "run", &plan, "--out", &out, "--yes"];
    let args = [&args[..], &["--trials", "1"], &AT].concat();
    let (code, said, err) = machines(Some(VIRTUAL_UID)).run(&args);
    assert_eq!(code, 0, "{said}{err}");
    assert!(said.contains("D = 24.400 mm, n = 1\n"), "{said}");
    assert!(!said.contains("SD"), "{said}");
}

#[test]
fn nobody_carries_a_virtual_campaign_out_and_all_of_it_is_marked_so() {
    let place = place(&small_plan(&[("scatter_mm = 0 ", "scatter_mm = 0.5 ")]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let memory = machines(Some(VIRTUAL_UID));
    let args = |extra: &[&str]| -> Vec<String> {
        let all = [&["campaign"], extra, &AT[..]].concat();
        all.into_iter().map(str::to_owned).collect()
    };
    let run = |extra: &[&str]| {
        let args = args(extra);
        memory.run(&args.iter().map(String::as_str).collect::<Vec<_>>())
    };
    let (code, said, err) = run(&["run", &plan, "--out", &out, "--yes", "--trials", "3"]);
    assert_eq!(code, 0, "{said}{err}");
    assert!(said.contains("3 of 6 trials are done"), "{said}");
    assert!(
        said.contains("VIRTUAL: nothing here is a measurement"),
        "{said}"
    );
    assert!(
        said.contains("min left") || said.contains("minute left"),
        "{said}"
    );
    let (code, said, err) = run(&["run", &out, "--yes"]);
    assert_eq!(code, 0, "{said}{err}");
    assert!(
        said.contains("6 of 6 trials are done") && said.contains("Nothing is left"),
        "{said}"
    );
    let report = Path::new(&out).join("report");
    assert!(report.join("report.html").is_file() && report.join("figure7.svg").is_file());
    // Both carriages went the same way: they are one line.
    let figure8 = fs::read_to_string(report.join("figure8.svg")).expect("a figure");
    assert!(figure8.contains("unfolded, folded: the same"), "{figure8}");
    let (code, _, err) = memory.run(&["report", &out]);
    assert!(
        code == 1 && err.contains("`--force` replaces it") && !err.contains("--out"),
        "a campaign's report takes no `--out`: {err}"
    );
    let campaign = whole(&out);
    assert!(
        campaign
            .rows
            .iter()
            .all(|row| row.origin == Origin::Virtual)
    );
    assert!(
        campaign
            .reading_rows
            .iter()
            .all(|row| row.origin == Origin::Virtual)
    );
    for row in campaign
        .rows
        .iter()
        .filter(|row| row.event == LedgerEvent::Displacement)
    {
        assert_eq!(row.source, Some(Source::ModelWithScatter));
        let text = row.text.as_deref().unwrap_or_default();
        assert!(
            text.contains("model") && text.contains("scatter of 0.5 mm added, seed 1"),
            "{text}"
        );
    }
    for trial in &campaign.state.trials {
        let attempt = trial.attempt().expect("done");
        let (number, planned) = (trial.planned.trial, &trial.planned);
        let about = if planned.indentation == "a2" {
            "2"
        } else {
            "5.05"
        };
        assert_eq!(
            attempt.indentation_mm.map(|a| a.to_string()).as_deref(),
            Some(about)
        );
        let mm = trial.counted().expect("counts").value.mm();
        match planned.shape {
            Form::Unfolded => assert!(mm > 0.0, "{number}: {mm}"),
            Form::Folded => assert!(mm < -20.0, "{number}: {mm}"),
            Form::Folding => unreachable!("the plan has none"),
        }
        let folder = campaign.attempt_folder(number, 1);
        let conditions = fs::read_to_string(folder.join("conditions.json")).expect("there");
        for word in [
            "\"origin\": \"virtual\"",
            "stroke_um",
            "\"shift_steps\"",
            "\"uid\"",
        ] {
            assert!(conditions.contains(word), "{word}: {conditions}");
        }
        // Two strokes, 4 s apart.
        let pulses = fs::read_to_string(folder.join("sync.csv")).expect("there");
        let times: Vec<u64> = pulses
            .lines()
            .skip(1)
            .map(|line| {
                line.split(',')
                    .nth(1)
                    .expect("columns")
                    .parse()
                    .expect("a number")
            })
            .collect();
        assert_eq!(times.len(), 2, "{pulses}");
        assert!(
            (times[1] - times[0]).abs_diff(4_000_000) < 10_000,
            "{pulses}"
        );
    }
    // The same seed gives the same scatter.
    let again = path(&place, "again");
    assert_eq!(run(&["run", &plan, "--out", &again, "--yes"]).0, 0);
    let values = |campaign: &Campaign| {
        let trials = campaign.state.trials.iter();
        trials
            .map(|trial| trial.counted().map(|mm| mm.value))
            .collect::<Vec<_>>()
    };
    assert_eq!(values(&whole(&again)), values(&campaign));
    // The folded body is measured, then unfolded. Both records are in the attempt's folder.
    let fold = campaign
        .state
        .trials
        .iter()
        .find(|trial| trial.planned.shape == Form::Folded);
    let folder = campaign.attempt_folder(fold.expect("one").planned.trial, 1);
    let stems: Vec<String> = fs::read_dir(folder)
        .expect("there")
        .map(|entry| {
            entry
                .expect("an entry")
                .file_name()
                .to_string_lossy()
                .into_owned()
        })
        .collect();
    for stem in ["fold-", "run-", "unfold-"] {
        assert!(
            stems.iter().any(|name| name.starts_with(stem)),
            "{stem}: {stems:?}"
        );
    }
}

/// The bench's displacements are those of `simulate` and of the report's band, with the plan's own stroke and cycles.
#[test]
fn a_virtual_campaign_has_the_rollers_of_its_plan() {
    let memory = machines(Some(VIRTUAL_UID));
    for (nth, stroke_mm) in (40..=130).step_by(10).enumerate() {
        let (at, about_mm) = [("a2", 2.0), ("a5", 5.05)][nth % 2];
        let (wall, friction) = [("dry", 0.20), ("lubricated", 0.08)][nth / 2 % 2];
        let cycles = 1 + nth as u32 % 3;
        let mut plan = changed(
            PAPER,
            &[
                ("repeats = 10", "repeats = 1"),
                ("stroke_mm = 130", &format!("stroke_mm = {stroke_mm}")),
                ("cycles = 5", &format!("cycles = {cycles}")),
                (r#"["dry", "lubricated"]"#, &format!("[\"{wall}\"]")),
                (r#"["a1", "a2", "a3", "a4", "a5"]"#, &format!("[\"{at}\"]")),
                ("count = 5", "count = 2"),
            ],
        );
        let fold_test = plan.find("[fold_test]").expect("one");
        let displacement = plan.find("[displacement]").expect("one");
        plan.replace_range(fold_test..displacement, "");
        let place = place(&plan);
        let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
        let run = [&["campaign", "run", &plan, "--out", &out, "--yes"][..], &AT].concat();
        let (code, said, err) = memory.run(&run);
        assert_eq!(code, 0, "{said}{err}");
        let mm = whole(&out).state.trials[0]
            .counted()
            .expect("counts")
            .value
            .mm();
        let mut params = Params::PAPER;
        (params.stroke_mm, params.cycles) = (f64::from(stroke_mm), cycles);
        params.body.friction = friction;
        let expected = locomotion::roller::run(params, about_mm).expect("a run");
        // The telemetry misses the carriage's turns by some micrometres, the caliper reads 0.01 mm.
        assert!((mm - expected).abs() < 0.1, "{stroke_mm}: {mm} {expected}");
        assert!(
            expected > 0.5,
            "{stroke_mm}: a body that stays says nothing"
        );
    }
}

#[test]
fn the_capsule_folds_within_the_runs_that_the_plan_says() {
    let place = place(&small_plan(&[
        ("# fold_at_cycle = 3 ", "fold_at_cycle = 2 "),
        ("cycles = 1", "cycles = 3"),
        ("duration_s = 8", "duration_s = 24"),
        (r#"["dry", "lubricated"]"#, r#"["dry"]"#),
        (r#"["a2", "a5"]"#, r#"["a5"]"#),
    ]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let memory = machines(Some(VIRTUAL_UID));
    let run = [&["campaign", "run", &plan, "--out", &out, "--yes"][..], &AT].concat();
    let (code, said, err) = memory.run(&run);
    assert_eq!(code, 0, "{said}{err}");
    assert!(
        said.contains("it will be unfolded, and fold in the run")
            && said.contains("4 of 4 trials are done"),
        "{said}"
    );
    let campaign = whole(&out);
    let mm = |form: Form| {
        let mut trials = campaign.state.trials.iter();
        let trial = trials.find(|trial| trial.planned.shape == form && trial.planned.block == 2);
        let trial = trial.expect("one of each");
        let counted = trial.counted().expect("counts");
        (trial.planned.trial, counted.value.mm())
    };
    // The carriage pushes the folded body to the same end, wherever it lies.
    let ((_, unfolded), (_, folded)) = (mm(Form::Unfolded), mm(Form::Folded));
    let (number, folding) = mm(Form::Folding);
    assert!(
        unfolded > 20.0 && folded < -50.0 && (folding - folded).abs() < 0.1,
        "{folded} {folding} {unfolded}"
    );
    let row = campaign
        .rows
        .iter()
        .find(|row| (row.trial, row.event) == (Some(number), LedgerEvent::Displacement));
    let text = row.and_then(|row| row.text.as_deref()).unwrap_or_default();
    assert!(
        text.contains("roller model until the fold begins"),
        "{text}"
    );
    // The fold's record stands beside the run and says where in the run it happened.
    let of_fold = fs::read_dir(campaign.attempt_folder(number, 1))
        .expect("there")
        .map(|entry| entry.expect("an entry").path())
        .find(|path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with("fold-") && name.ends_with(".json")
        });
    let record = fs::read_to_string(of_fold.expect("a record")).expect("there");
    assert!(
        record.contains("\"cycle\": 2") && record.contains("\"latency_us\""),
        "{record}"
    );
    let report = Path::new(&out).join("report");
    let conditions = fs::read_to_string(report.join("conditions.csv")).expect("there");
    assert!(
        conditions.contains("fold_test,lubricated,a5,folding,1,1,"),
        "{conditions}"
    );
    let figure = fs::read_to_string(report.join("figure8.svg")).expect("there");
    assert!(figure.contains("folding at cycle 2, n = 1"));
}

#[test]
fn nobody_answers_for_a_board() {
    let place = place(&small_plan(&[]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let memory = machines(None);
    let args = |extra: &[&'static str]| {
        [&["campaign", "run", &plan, "--out", &out], extra, &AT]
            .concat()
            .iter()
            .map(|arg| (*arg).to_owned())
            .collect::<Vec<String>>()
    };
    let run = |args: Vec<String>| memory.run(&args.iter().map(String::as_str).collect::<Vec<_>>());
    let (code, _, err) = run(args(&[]));
    assert_eq!(code, 3, "{err}");
    assert!(
        err.contains("nobody is at a terminal") && !Path::new(&out).exists(),
        "{err}"
    );
    let (code, _, err) = run(args(&["--yes"]));
    assert_eq!(code, 3, "{err}");
    assert!(
        err.contains("displacement on a board has to be measured"),
        "{err}"
    );
    assert!(!memory.heard().contains(&"Run") && !memory.heard().contains(&"Home"));
    assert_eq!(whole(&out).rows, vec![]);
}

/// Output that a simulated person can read.
#[derive(Clone, Default)]
struct Shown(Arc<Mutex<Vec<u8>>>);

impl Write for Shown {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().expect("free").extend(bytes);
        Ok(bytes.len())
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Shown {
    fn text(&self) -> String {
        String::from_utf8_lossy(&self.0.lock().expect("free")).into_owned()
    }
}

/// A simulated person who waits for a text, then types a line.
struct Person {
    shown: Shown,
    seen: usize,
    lines: std::vec::IntoIter<(&'static str, &'static str)>,
    typing: Vec<u8>,
    /// The text that was never shown. The person reads in a thread whose panic nobody would notice.
    missed: Arc<Mutex<Option<&'static str>>>,
}

impl Read for Person {
    fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
        unreachable!("lines are read")
    }
}

impl BufRead for Person {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        if self.typing.is_empty()
            && let Some((wanted, line)) = self.lines.next()
        {
            let begin = Instant::now();
            loop {
                let text = self.shown.text();
                if let Some(place) = text[self.seen..].find(wanted) {
                    self.seen += place + wanted.len();
                    break;
                }
                if begin.elapsed() > Duration::from_secs(20) {
                    *self.missed.lock().expect("free") = Some(wanted);
                    return Ok(&[]);
                }
                thread::sleep(Duration::from_millis(1));
            }
            self.typing = format!("{line}\n").into_bytes();
        }
        Ok(&self.typing)
    }
    fn consume(&mut self, count: usize) {
        self.typing.drain(..count);
    }
}

/// Returns the exit code and everything shown.
pub fn converse(
    memory: &dyn Connector,
    args: &[&str],
    lines: Vec<(&'static str, &'static str)>,
) -> (u8, String) {
    let shown = Shown::default();
    let missed = Arc::default();
    let person = Person {
        shown: shown.clone(),
        seen: 0,
        lines: lines.into_iter(),
        typing: vec![],
        missed: Arc::clone(&missed),
    };
    let all = [&["retrograde", "campaign"], args, &AT].concat();
    let (mut out, mut err) = (shown.clone(), shown.clone());
    let code = run_on(
        all.into_iter().map(Into::into),
        memory,
        &mut out,
        &mut err,
        Some(Box::new(person)),
    );
    let missed = *missed.lock().expect("free");
    assert_eq!(missed, None, "not shown in:\n{}", shown.text());
    (code, shown.text())
}

fn standings<const N: usize>(campaign: &Campaign, trials: [u32; N]) -> [Standing; N] {
    trials.map(|trial| campaign.state.trial(trial).expect("there").standing())
}

#[test]
fn a_person_is_asked_again_until_the_answer_can_be() {
    let plan = small_plan(&[("camera = \"none\"", "camera = \"overhead\"")]);
    let place = place(&plan);
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let memory = machines(None);
    let (code, shown) = converse(
        &memory,
        &["run", &plan, "--out", &out],
        vec![
            ("rollers OFF", ""),
            ("Reading 1 of 2: D", "24,4"),
            ("has a comma", "24.4 mm"),
            ("has a unit", "2.44e1"),
            ("exponent", "0"),
            ("above 0", "24.401"),
            ("resolution is 0.01", "24.6"),
            ("Reading 2 of 2: D", "undo"),
            ("Reading 1 of 2: D", "24.4"),
            ("Reading 2 of 2: D", "25.4"),
            ("differ by 1 mm", "again"),
            ("rollers OFF", ""),
            ("Reading 1 of 2: D", "24.4"),
            ("Reading 2 of 2: D", "24.4"),
            ("D = 24.400 mm", ""),
            ("Reading 1 of 2: i", "24.4"),
            ("rollers do not touch", "20.4"),
            ("Reading 2 of 2: i", "20.4"),
            ("(D - i)/2 = 2.000 mm", "note 21 degC"),
            ("camera records, as paper-001-1", "camera IMG_1.MOV"),
            ("camera records, as IMG_1.MOV", ""),
            ("Displacement of the tail", "12,5"),
            ("has a comma", "1300"),
            ("the plan allows -130 to 130", "12.5"),
            ("Clamp both rollers", "q"),
        ],
    );
    assert_eq!(code, 130, "{shown}");
    assert!(shown.contains("campaign run"), "{shown}");
    let campaign = whole(&out);
    let first = campaign.state.trial(1).expect("there");
    assert_eq!(first.counted().map(|mm| mm.value.um), Some(12_500));
    assert_eq!(first.notes, ["21 degC"]);
    assert_eq!(first.attempts[0].camera_file.as_deref(), Some("IMG_1.MOV"));
    assert_eq!(
        campaign.rows.last().expect("some").source,
        Some(Source::Measured)
    );
    assert!(campaign.readings.sets[0].discarded && !campaign.readings.sets[1].discarded);
    assert_eq!(campaign.origin(), Some(Origin::Board));

    // The next day: the second indentation; undo, repeat, exclude, skip.
    let (code, shown) = converse(
        &memory,
        &["run", &out],
        vec![
            ("Clamp both rollers", ""),
            ("Reading 1 of 2: i", "14.3"),
            ("Reading 2 of 2: i", "14.3"),
            ("Trial 2 of 6", "undo"),
            ("Displacement of the tail", "13.5"),
            ("Trial 2 of 6", ""),
            ("Displacement of the tail", "repeat it was not at its mark"),
            ("Trial 2 of 6, attempt 2", ""),
            ("Displacement of the tail", "40"),
            ("Clamp both rollers", ""),
            ("Reading 1 of 2: i", "14.5"),
            ("Reading 2 of 2: i", "14.5"),
            ("Trial 3 of 6", "exclude the wall was torn"),
            ("Trial 3 of 6", "skip no soap"),
            ("Clamp both rollers", "q"),
        ],
    );
    assert_eq!(code, 130, "{shown}");
    let campaign = whole(&out);
    assert_eq!(
        standings(&campaign, [1, 2, 3, 4]),
        [
            Standing::Done,
            Standing::Excluded,
            Standing::Skipped,
            Standing::Open
        ]
    );
    let (_, said, _) = memory.run(&["campaign", "status", &out]);
    for line in [
        "1 of 6 trials are done",
        "attempt 1 does not count: given up: it was not at its mark",
        "trial 2 is excluded: the wall was torn",
        "trial 3 is skipped: no soap",
        "13.500 mm",
    ] {
        assert!(said.contains(line), "{line}: {said}");
    }
    for args in [
        &["include", "2"][..],
        &["displacement", "2", "-1.5", "misread"],
        &["include", "3"],
        &["note", "all", "well"],
    ] {
        let (code, said, err) = memory.run(&[&["campaign", "edit", &out], args].concat());
        assert_eq!(code, 0, "{args:?}: {said}{err}");
    }
    for args in [
        &["exclude", "5", "x"][..],
        &["displacement", "2", "140"],
        &["undo", "99"],
        &["include", "1"],
    ] {
        let (code, said, err) = memory.run(&[&["campaign", "edit", &out], args].concat());
        assert_eq!(code, 2, "{args:?}: {said}{err}");
    }
    let campaign = whole(&out);
    let second = campaign
        .state
        .trial(2)
        .expect("there")
        .counted()
        .expect("counts");
    assert_eq!((second.value.um, second.entered), (-1_500, 2));
    assert_eq!(campaign.state.notes, ["all well"]);
}

/// An answer counts that is typed while a machine does not answer. A lost machine ends the session only where it is
/// needed, and the way on is named.
#[test]
fn a_line_that_falls_silent_loses_no_answer() {
    let place = place(&small_plan(&[]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let mut rig = Script::new(DeviceKind::Rig);
    // Two keep-alives in vain, with their repetitions.
    rig.deaf_to = vec![("KeepAlive", 8)];
    let memory = Memory::with(vec![rig.clone(), Script::new(DeviceKind::Capsule)]);
    let (code, shown) = converse(
        &memory,
        &["run", &plan, "--out", &out],
        vec![
            ("waited for even so", ""),
            ("Reading 1 of 2: D", "24.4"),
            ("Reading 2 of 2: D", "q"),
        ],
    );
    assert_eq!(code, 130, "{shown}");
    let values = |campaign: &Campaign| campaign.readings.sets[0].values.clone();
    assert_eq!(values(&whole(&out)).len(), 1, "{shown}");

    rig.deaf_to = vec![("KeepAlive", u32::MAX), ("Home", u32::MAX)];
    let memory = Memory::with(vec![rig, Script::new(DeviceKind::Capsule)]);
    let (code, shown) = converse(
        &memory,
        &["run", &out],
        vec![
            ("waited for even so", "24.4"),
            ("Clamp both rollers", ""),
            ("Reading 1 of 2: i", "20.4"),
            ("Reading 2 of 2: i", "20.4"),
            ("Trial 1 of 6", ""),
        ],
    );
    assert_eq!(code, 7, "{shown}");
    let goes_on = format!("`retrograde campaign run {out}` goes on");
    assert!(shown.contains(&goes_on), "{shown}");
    let campaign = whole(&out);
    assert_eq!(values(&campaign).len(), 2);
    assert_eq!(campaign.readings.sets[1].values.len(), 2);
}

#[test]
fn an_answer_is_echoed_asked_again_refused_or_taken_back() {
    let place = place(&small_plan(&[]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let memory = machines(None);
    let (code, shown) = converse(
        &memory,
        &["run", &plan, "--out", &out],
        vec![
            ("rollers OFF", ""),
            ("Reading 1 of 2: D", "500"),
            ("Reading 2 of 2: D", "500"),
            ("the plan says about 24.4 mm", "again"),
            ("rollers OFF", ""),
            ("Reading 1 of 2: D", "24.4"),
            ("Reading 2 of 2: D", "24.4"),
            ("Clamp both rollers", ""),
            ("Reading 1 of 2: i", "20.4"),
            ("Reading 2 of 2: i", "20.4"),
            ("Trial 1 of 6", "note 21 degC"),
            ("noted on trial 1: 21 degC", "camera IMG_1.MOV"),
            ("camera = \"none\"", ""),
            ("Displacement of the tail", "12.5"),
            ("Clamp both rollers", ""),
            ("Reading 1 of 2: i", "14.3"),
            ("Reading 2 of 2: i", "14.3"),
            ("Trial 2 of 6", "skip no soap"),
            // Not the displacement of trial 1, which was entered before.
            ("Trial 3 of 6", "undo"),
            (
                "trial 2 is taken in again, as by `campaign edit ... include 2`",
                "exclude torn",
            ),
            ("trial 1 is excluded", "undo"),
            ("trial 1 is taken in again", "undo"),
            ("the displacement of trial 1 is taken back", "q"),
        ],
    );
    assert_eq!(code, 130, "{shown}");
    let campaign = whole(&out);
    assert_eq!(
        standings(&campaign, [1, 2]),
        [Standing::Unmeasured, Standing::Open],
        "{shown}"
    );
    assert_eq!(campaign.state.trials[0].attempts[0].camera_file, None);
    let edit = |args: &[&str]| memory.run(&[&["campaign", "edit", &out], args].concat());
    assert_eq!(edit(&["skip", "2"]).0, 0);
    let (code, _, err) = edit(&["undo", "2"]);
    assert!(
        code == 2 && err.contains("trial 2 is skipped: `include 2` takes it in again"),
        "{code} {err}"
    );
}

/// The questions for the width, and their answers.
pub const WIDTH: [(&str, &str); 3] = [
    ("rollers OFF", ""),
    ("Reading 1 of 2: D", "24.4"),
    ("Reading 2 of 2: D", "24.4"),
];

/// The questions for a clamping, and their answers.
pub fn clamped(between_mm: &'static str) -> [(&'static str, &'static str); 3] {
    [
        ("Clamp both rollers", ""),
        ("Reading 1 of 2: i", between_mm),
        ("Reading 2 of 2: i", between_mm),
    ]
}

/// After `clamp` the former readings no longer hold, whatever is answered next: readings that are discarded, another word
/// than Enter, a session that ends. The hand at the rollers may have turned the screw, so the rig homes again.
#[test]
fn rollers_that_are_clamped_anew_are_measured_anew() {
    let place = place(&small_plan(&[]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let memory = machines(None);
    let (code, shown) = converse(
        &memory,
        &["run", &plan, "--out", &out],
        [
            &WIDTH[..],
            &clamped("20.4")[..],
            &[
                ("Trial 1 of 6", "clamp"),
                ("Clamp both rollers", ""),
                ("Reading 1 of 2: i", "20.4"),
                ("Reading 2 of 2: i", "21.4"),
                ("Is that so?", "again"),
                ("Clamp both rollers", "20.0"),
                ("that is not for now", ""),
                ("Reading 1 of 2: i", "20.0"),
                ("Reading 2 of 2: i", "20.0"),
                ("Trial 1 of 6", "clamp"),
                ("Clamp both rollers", "q"),
            ],
        ]
        .concat(),
    );
    assert_eq!(code, 130, "{shown}");
    let homes = || {
        memory
            .heard()
            .iter()
            .filter(|heard| **heard == "Home")
            .count()
    };
    let before = homes();
    let (code, shown) = converse(
        &memory,
        &["run", &out],
        [
            &clamped("19.8")[..],
            &[
                ("Trial 1 of 6", ""),
                ("Displacement of the tail", "repeat torn"),
                ("Trial 1 of 6, attempt 2", "clamp"),
            ],
            &clamped("19.6")[..],
            &[
                ("Trial 1 of 6, attempt 2", ""),
                ("Displacement of the tail", "12.5"),
                ("Clamp both rollers", "q"),
            ],
        ]
        .concat(),
    );
    assert_eq!(code, 130, "{shown}");
    assert_eq!(homes() - before, 2, "{shown}");
    let campaign = whole(&out);
    let attempts = &campaign.state.trials[0].attempts;
    let widths_mm = attempts.iter().map(|attempt| attempt.indentation_mm);
    let expected = ["2.3", "2.4"].map(|a| Some(a.parse().expect("a length")));
    assert!(widths_mm.eq(expected), "{attempts:?}");
    // Those of the first attempt stay in the report.
    let sets = &campaign.readings.sets;
    assert!(
        sets.iter().filter(|set| set.accepted).count() >= 4,
        "{sets:?}"
    );
}

/// The rollers stand at the new notch, although its readings were discarded: those of the block before do not hold.
#[test]
fn a_clamping_whose_readings_were_discarded_is_not_the_one_before() {
    let place = place(&small_plan(&[]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let memory = machines(None);
    let (code, shown) = converse(
        &memory,
        &["run", &plan, "--out", &out],
        [
            &WIDTH[..],
            &clamped("20.4")[..],
            &[
                ("Trial 1 of 6", ""),
                ("Displacement of the tail", "12.5"),
                ("Clamp both rollers", ""),
                ("Reading 1 of 2: i", "14.3"),
                ("Reading 2 of 2: i", "15.3"),
                ("Is that so?", "again"),
                ("Clamp both rollers", "q"),
            ],
        ]
        .concat(),
    );
    assert_eq!(code, 130, "{shown}");
    let (code, _, err) = memory.run(&["campaign", "edit", &out, "repeat", "1", "torn"]);
    assert_eq!(code, 0, "{err}");
    let (code, shown) = converse(
        &memory,
        &["run", &out],
        [&clamped("20.2")[..], &[("Trial 1 of 6, attempt 2", "q")]].concat(),
    );
    assert_eq!(code, 130, "{shown}");
}

#[test]
fn an_attempt_that_is_refused_stays_listed_and_does_not_count() {
    let place = place(&small_plan(&[]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let mut rig = Script::new(DeviceKind::Rig);
    rig.uid = VIRTUAL_UID;
    let mut capsule = Script::new(DeviceKind::Capsule);
    capsule.uid = VIRTUAL_UID;
    let mut broken = rig.clone();
    // The loop opens within the first run, and stays open.
    broken.world = vec![(9_000_000, World::EStopLoop { open: true })];
    let memory = Memory::with(vec![broken, capsule.clone()]);
    let run = |memory: &Memory, args: &[&str]| memory.run(&[&["campaign"], args, &AT].concat());
    let (code, said, err) = run(&memory, &["run", &plan, "--out", &out, "--yes"]);
    assert_eq!(code, 6, "{said}{err}");
    let campaign = whole(&out);
    let first = campaign.state.trial(1).expect("there");
    assert_eq!(
        first.attempts[0].outcome,
        Some(AttemptOutcome::Faulted),
        "{said}{err}"
    );
    assert_eq!(first.standing(), Standing::Open);
    let memory = Memory::with(vec![rig, capsule]);
    let (code, said, err) = run(&memory, &["run", &out, "--yes"]);
    assert_eq!(code, 0, "{said}{err}");
    assert!(
        said.contains("trial 1, attempt 1 does not count: faulted"),
        "{said}"
    );
    assert_eq!(whole(&out).state.trial(1).expect("there").attempts.len(), 2);
}

/// The plan is fixed from then on, and the rig would refuse it only after all readings of the first trial.
#[test]
fn a_run_that_rigs_refuse_by_default_is_told_when_the_plan_is_fixed() {
    let note = "NOTE: a rig with default settings refuses this run: ";
    let fast = [
        ("cycles = 5", "cycles = 3"),
        ("stroke_mm = 130", "stroke_mm = 100"),
        ("duration_s = 40", "duration_s = 15"),
    ];
    for (plan, told) in [(PAPER.to_owned(), false), (changed(PAPER, &fast), true)] {
        let place = place(&plan);
        let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
        let memory = machines(Some(VIRTUAL_UID));
        let (code, said, err) = memory.run(&["campaign", "new", &plan, "--out", &out]);
        assert_eq!(code, 0, "{said}{err}");
        assert_eq!(said.contains(note), told, "{said}");
        assert_eq!(said.contains("allow at least 15.184898 s"), told, "{said}");
    }
}

#[test]
fn verify_says_what_is_wrong_and_what_to_do() {
    let place = place(&small_plan(&[]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let memory = machines(Some(VIRTUAL_UID));
    let (code, said, err) = memory.run(&["campaign", "new", &plan, "--out", &out]);
    assert_eq!(code, 0, "{said}{err}");
    assert!(said.contains("6 trials in 5 blocks, seed 20221"), "{said}");
    let (code, said, _) = memory.run(&["verify", &out]);
    assert_eq!(code, 0);
    assert!(said.contains("4 files are as SHA256SUMS says"), "{said}");
    fs::write(Path::new(&out).join("notes.txt"), "x").expect("written");
    let (code, said, err) = memory.run(&["verify", &out]);
    assert_eq!(code, 1, "{said}{err}");
    assert!(
        said.contains("notes.txt: is not in SHA256SUMS")
            && said.contains("remedy: was it put there by hand?"),
        "{said}"
    );
    let (code, said, _) = memory.run(&["--json", "verify", &out]);
    let json: serde_json::Value = serde_json::from_str(&said).expect("JSON");
    assert_eq!(
        (code, &json["findings"][0]["path"]),
        (1, &"notes.txt".into())
    );
    let empty = path(&place, "empty");
    fs::create_dir(&empty).expect("made");
    let (code, _, err) = memory.run(&["verify", &empty]);
    assert_eq!(code, 2, "{err}");
    assert!(err.contains("no SHA256SUMS and no record"), "{err}");
}

#[test]
fn a_virtual_capsule_makes_the_campaign_virtual() {
    let place = place(&small_plan(&[]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let mut capsule = Script::new(DeviceKind::Capsule);
    capsule.uid = VIRTUAL_UID;
    let memory = Memory::with(vec![Script::new(DeviceKind::Rig), capsule]);
    let args = [
        "campaign", "run", &plan, "--out", &out, "--yes", "--trials", "1",
    ];
    let (_, said, err) = memory.run(&[&args[..], &AT].concat());
    let origin = Campaign::read(Path::new(&out))
        .expect("a campaign")
        .origin();
    assert_eq!(origin, Some(Origin::Virtual), "{said}{err}");
}

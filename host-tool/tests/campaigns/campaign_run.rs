//! Campaigns on the command line, over the firmware's own request handling in virtual time, with a person at the
//! keyboard and without one.

use std::fs;
use std::io::{self, BufRead, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use crate::support::plan::{PAPER, changed};
use crate::support::tool::Memory;
use client::identity::Origin;
use host_tool::cli::run_on;
use lab::campaign::contents::Campaign;
use lab::campaign::form::Form;
use lab::campaign::ledger::{
    AttemptOutcome, LedgerEvent, LedgerRow, Source, TrialState, TrialStatus,
};
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

/// A folder with a plan, and the path of its campaign.
pub struct Place {
    folder: tempfile::TempDir,
    pub plan: String,
    pub out: String,
}

impl Place {
    pub fn of(plan: &str) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name| folder.path().join(name).display().to_string();
        let (plan_path, out) = (path("plan.toml"), path("c"));
        fs::write(&plan_path, plan).expect("written");
        Self {
            folder,
            plan: plan_path,
            out,
        }
    }

    pub fn path(&self, name: &str) -> String {
        self.folder.path().join(name).display().to_string()
    }

    /// Arguments that begin the campaign, or go on with it once it is there.
    fn run(&self) -> Vec<&str> {
        match Path::new(&self.out).exists() {
            true => vec!["campaign", "run", &self.out],
            false => vec!["campaign", "run", &self.plan, "--out", &self.out],
        }
    }

    /// A session with these answers, which ends with this code. Returns everything shown.
    #[track_caller]
    pub fn answered(
        &self,
        machines: &dyn Connector,
        code: u8,
        lines: Vec<(&'static str, &'static str)>,
    ) -> String {
        let (ended, shown) = converse(machines, &self.run(), lines);
        assert_eq!(ended, code, "{shown}");
        shown
    }

    /// A session without a person. Returns all that was said.
    #[track_caller]
    pub fn unattended(&self, machines: &Memory, code: u8, more: &[&str]) -> String {
        let (ended, said, err) = machines.run(&[&self.run()[..], &AT, more].concat());
        assert_eq!(ended, code, "{said}{err}");
        said + &err
    }

    pub fn read(&self) -> Campaign {
        Campaign::read(Path::new(&self.out)).expect("a campaign")
    }

    /// The campaign, in which `verify` finds nothing wrong.
    #[track_caller]
    pub fn whole(&self) -> Campaign {
        let verified = verify(Path::new(&self.out)).expect("a folder");
        assert_eq!(verified.findings, vec![]);
        self.read()
    }

    /// Contents of a file of the campaign.
    pub fn text(&self, name: &str) -> String {
        fs::read_to_string(Path::new(&self.out).join(name)).expect(name)
    }
}

const AT: [&str; 4] = ["--rig", "0", "--capsule", "1"];

#[test]
fn nobody_carries_a_virtual_campaign_out_and_all_of_it_is_marked_so() {
    let plan = small_plan(&[("scatter_mm = 0 ", "scatter_mm = 0.5 ")]);
    let at = Place::of(&plan);
    let memory = machines(Some(VIRTUAL_UID));
    let said = at.unattended(&memory, 0, &["--yes", "--trials", "3"]);
    assert!(said.contains("3 of 6 trials are done"), "{said}");
    let is_marked = said.contains("VIRTUAL: nothing here is a measurement");
    assert!(is_marked && said.contains(" left"), "{said}");
    let said = at.unattended(&memory, 0, &["--yes"]);
    let is_over = said.contains("6 of 6 trials are done") && said.contains("Nothing is left");
    assert!(is_over, "{said}");
    at.text("report/report.html");
    at.text("report/figure7.svg");
    // Both carriages went the same way: they are one line.
    let figure8 = at.text("report/figure8.svg");
    assert!(figure8.contains("unfolded, folded: the same"), "{figure8}");
    let campaign = at.whole();
    let mut origins = campaign.rows.iter().map(|row| row.origin);
    assert!(origins.all(|origin| origin == Origin::Virtual));
    let mut origins = campaign.reading_rows.iter().map(|row| row.origin);
    assert!(origins.all(|origin| origin == Origin::Virtual));
    let is_displacement = |row: &&LedgerRow| row.event == LedgerEvent::Displacement;
    for row in campaign.rows.iter().filter(is_displacement) {
        assert_eq!(row.source, Some(Source::ModelWithScatter));
        let text = row.text.as_deref().unwrap_or_default();
        let tells = text.contains("model") && text.contains("scatter of 0.5 mm added, seed 1");
        assert!(tells, "{text}");
    }
    for trial in &campaign.state.trials {
        check_simulated(&campaign, trial);
    }
    // The same seed gives the same scatter.
    let again = Place::of(&plan);
    again.unattended(&memory, 0, &["--yes"]);
    let values = |campaign: &Campaign| {
        let trials = campaign.state.trials.iter();
        trials
            .map(|trial| trial.counted().map(|mm| mm.value))
            .collect::<Vec<_>>()
    };
    assert_eq!(values(&again.whole()), values(&campaign));
}

/// What an attempt of that campaign has in its row and in its folder.
fn check_simulated(campaign: &Campaign, trial: &TrialState) {
    let (number, planned) = (trial.planned.trial, &trial.planned);
    let about = match &*planned.indentation {
        "a2" => "2",
        _ => "5.05",
    };
    let a_mm = trial.attempt().expect("done").indentation_mm;
    assert_eq!(a_mm.map(|a| a.to_string()).as_deref(), Some(about));
    let mm = trial.counted().expect("counts").value.mm();
    let is_folded = planned.shape == Form::Folded;
    let as_expected = if is_folded { mm < -20.0 } else { mm > 0.0 };
    assert!(as_expected, "{number}: {mm}");
    let folder = campaign.attempt_folder(number, 1);
    let conditions = fs::read_to_string(folder.join("conditions.json")).expect("there");
    let origin = "\"origin\": \"virtual\"";
    let tool = "\"tool\": \"retrograde ";
    for word in [origin, tool, "stroke_um", "\"shift_steps\"", "\"uid\""] {
        assert!(conditions.contains(word), "{word}: {conditions}");
    }
    // The times of the pulses to the camera: two strokes, 4 s apart.
    let pulses = fs::read_to_string(folder.join("sync.csv")).expect("there");
    let mut rows = pulses.lines().map(|row| row.split(',').collect::<Vec<_>>());
    assert_eq!(rows.next(), Some(vec!["stroke", "time_us", "origin"]));
    let rows: Vec<_> = rows.collect();
    let strokes: Vec<&str> = rows.iter().map(|row| row[0]).collect();
    assert_eq!(strokes, ["0", "1"]);
    let us = |row: usize| rows[row][1].parse::<u64>().expect("a number");
    let apart_us = us(1).saturating_sub(us(0));
    assert!(apart_us.abs_diff(4_000_000) < 10_000, "{pulses}");
    // The folded body is measured, then unfolded. Both records are in the attempt's folder.
    for stem in ["fold-", "unfold-", "run-"] {
        let is_there = file_of(&folder, stem).is_some();
        assert_eq!(is_there, is_folded || stem == "run-", "{number}: {stem}");
    }
}

/// The record of an attempt whose name begins so.
pub fn file_of(folder: &Path, stem: &str) -> Option<PathBuf> {
    let mut files = fs::read_dir(folder).expect("there").flatten();
    let file = files.find(|file| {
        let name = file.file_name().to_string_lossy().into_owned();
        name.starts_with(stem) && name.ends_with(".json")
    });
    file.map(|file| file.path())
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
        let at = Place::of(&plan);
        at.unattended(&memory, 0, &["--yes"]);
        let counted = at.whole().state.trials[0].counted();
        let mm = counted.expect("counts").value.mm();
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
    let at = Place::of(&small_plan(&[
        ("# fold_at_cycle = 3 ", "fold_at_cycle = 2 "),
        ("cycles = 1", "cycles = 3"),
        ("duration_s = 8", "duration_s = 24"),
        (r#"["dry", "lubricated"]"#, r#"["dry"]"#),
        (r#"["a2", "a5"]"#, r#"["a5"]"#),
    ]));
    let memory = machines(Some(VIRTUAL_UID));
    let said = at.unattended(&memory, 0, &["--yes"]);
    let tells = said.contains("it will be unfolded, and fold in the run");
    assert!(tells && said.contains("4 of 4 trials are done"), "{said}");
    let campaign = at.whole();
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
    let of_fold = file_of(&campaign.attempt_folder(number, 1), "fold-");
    let record = fs::read_to_string(of_fold.expect("a record")).expect("there");
    let tells = record.contains("\"cycle\": 2") && record.contains("\"latency_us\"");
    assert!(tells, "{record}");
    let conditions = at.text("report/conditions.csv");
    let condition = "fold_test,lubricated,a5,folding,1,1,";
    assert!(conditions.contains(condition), "{conditions}");
    let figure = at.text("report/figure8.svg");
    assert!(figure.contains("folding at cycle 2, n = 1"));
}

#[test]
fn nobody_answers_for_a_board() {
    let at = Place::of(&small_plan(&[]));
    let memory = machines(None);
    let said = at.unattended(&memory, 3, &[]);
    assert!(said.contains("nobody is at a terminal"), "{said}");
    assert!(!Path::new(&at.out).exists());
    let said = at.unattended(&memory, 3, &["--yes"]);
    let measured = "displacement on a board has to be measured";
    assert!(said.contains(measured), "{said}");
    assert!(!memory.heard().contains(&"Run") && !memory.heard().contains(&"Home"));
    assert_eq!(at.whole().rows, vec![]);
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

/// A session with these answers. Returns the exit code and everything shown.
fn converse(
    machines: &dyn Connector,
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
    let args = [&["retrograde"], args, &AT].concat();
    let args = args.into_iter().map(Into::into);
    let (mut out, mut err) = (shown.clone(), shown.clone());
    let code = run_on(args, machines, &mut out, &mut err, Some(Box::new(person)));
    let missed = *missed.lock().expect("free");
    assert_eq!(missed, None, "not shown in:\n{}", shown.text());
    (code, shown.text())
}

fn statuses<const N: usize>(campaign: &Campaign, trials: [u32; N]) -> [TrialStatus; N] {
    trials.map(|trial| campaign.state.trial(trial).expect("there").status())
}

#[test]
fn a_person_is_asked_again_until_the_answer_can_be() {
    let plan = small_plan(&[("camera = \"none\"", "camera = \"overhead\"")]);
    let at = Place::of(&plan);
    let memory = machines(None);
    let shown = at.answered(
        &memory,
        130,
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
    assert!(shown.contains("campaign run"), "{shown}");
    let campaign = at.whole();
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
    at.answered(
        &memory,
        130,
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
    let campaign = at.whole();
    use TrialStatus::{Done, Excluded, Open, Skipped};
    let expected = [Done, Excluded, Skipped, Open];
    assert_eq!(statuses(&campaign, [1, 2, 3, 4]), expected);
    let (_, said, _) = memory.run(&["campaign", "status", &at.out]);
    for line in [
        "1 of 6 trials are done",
        "attempt 1 does not count: given up: it was not at its mark",
        "trial 2 is excluded: the wall was torn",
        "trial 3 is skipped: no soap",
        "13.500 mm",
    ] {
        assert!(said.contains(line), "{line}: {said}");
    }
    for (code, args) in [
        (0, "include 2"),
        (0, "displacement 2 -1.5 misread"),
        (0, "include 3"),
        (0, "note all well"),
        (2, "exclude 5 x"),
        (2, "displacement 2 140"),
        (2, "undo 99"),
        (2, "include 1"),
    ] {
        let args: Vec<&str> = args.split(' ').collect();
        let (ended, said, err) = memory.run(&[&["campaign", "edit", &at.out], &args[..]].concat());
        assert_eq!(ended, code, "{args:?}: {said}{err}");
    }
    let campaign = at.whole();
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
    let at = Place::of(&small_plan(&[]));
    let mut rig = Script::new(DeviceKind::Rig);
    // Two keep-alives in vain, with their repetitions.
    rig.deaf_to = vec![("KeepAlive", 8)];
    let memory = Memory::with(vec![rig.clone(), Script::new(DeviceKind::Capsule)]);
    let shown = at.answered(
        &memory,
        130,
        vec![
            ("you can still answer", ""),
            ("Reading 1 of 2: D", "24.4"),
            ("Reading 2 of 2: D", "q"),
        ],
    );
    let values = |campaign: &Campaign| campaign.readings.sets[0].values.clone();
    assert_eq!(values(&at.whole()).len(), 1, "{shown}");

    rig.deaf_to = vec![("KeepAlive", u32::MAX), ("Home", u32::MAX)];
    let memory = Memory::with(vec![rig, Script::new(DeviceKind::Capsule)]);
    let shown = at.answered(
        &memory,
        7,
        vec![
            ("you can still answer", "24.4"),
            ("Clamp both rollers", ""),
            ("Reading 1 of 2: i", "20.4"),
            ("Reading 2 of 2: i", "20.4"),
            ("Trial 1 of 6", ""),
        ],
    );
    let goes_on = format!("`retrograde campaign run {}` continues", at.out);
    assert!(shown.contains(&goes_on), "{shown}");
    let campaign = at.whole();
    assert_eq!(values(&campaign).len(), 2);
    assert_eq!(campaign.readings.sets[1].values.len(), 2);
}

#[test]
fn an_answer_is_echoed_asked_again_refused_or_taken_back() {
    let at = Place::of(&small_plan(&[]));
    let memory = machines(None);
    let shown = at.answered(
        &memory,
        130,
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
                "trial 2 is included again, as by `campaign edit ... include 2`",
                "exclude torn",
            ),
            ("trial 1 is excluded", "undo"),
            ("trial 1 is included again", "undo"),
            ("the displacement of trial 1 is taken back", "q"),
        ],
    );
    let campaign = at.whole();
    assert_eq!(
        statuses(&campaign, [1, 2]),
        [TrialStatus::Unmeasured, TrialStatus::Open],
        "{shown}"
    );
    assert_eq!(campaign.state.trials[0].attempts[0].camera_file, None);
    let edit = |args: &[&str]| memory.run(&[&["campaign", "edit", &at.out], args].concat());
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
    let at = Place::of(&small_plan(&[]));
    let memory = machines(None);
    at.answered(
        &memory,
        130,
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
    let homes = || {
        memory
            .heard()
            .iter()
            .filter(|heard| **heard == "Home")
            .count()
    };
    let before = homes();
    let shown = at.answered(
        &memory,
        130,
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
    assert_eq!(homes() - before, 2, "{shown}");
    let campaign = at.whole();
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
    let at = Place::of(&small_plan(&[]));
    let memory = machines(None);
    at.answered(
        &memory,
        130,
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
    let (code, _, err) = memory.run(&["campaign", "edit", &at.out, "repeat", "1", "torn"]);
    assert_eq!(code, 0, "{err}");
    at.answered(
        &memory,
        130,
        [&clamped("20.2")[..], &[("Trial 1 of 6, attempt 2", "q")]].concat(),
    );
}

#[test]
fn an_attempt_that_is_refused_stays_listed_and_does_not_count() {
    let at = Place::of(&small_plan(&[]));
    let mut rig = Script::new(DeviceKind::Rig);
    rig.uid = VIRTUAL_UID;
    let mut capsule = Script::new(DeviceKind::Capsule);
    capsule.uid = VIRTUAL_UID;
    let mut broken = rig.clone();
    // The loop opens within the first run, and stays open.
    broken.world = vec![(9_000_000, World::EStopLoop { open: true })];
    let memory = Memory::with(vec![broken, capsule.clone()]);
    let said = at.unattended(&memory, 6, &["--yes"]);
    let campaign = at.whole();
    let first = campaign.state.trial(1).expect("there");
    let outcome = first.attempts[0].outcome;
    assert_eq!(outcome, Some(AttemptOutcome::Faulted), "{said}");
    assert_eq!(first.status(), TrialStatus::Open);
    let memory = Memory::with(vec![rig, capsule]);
    let said = at.unattended(&memory, 0, &["--yes"]);
    let told = "trial 1, attempt 1 does not count: faulted";
    assert!(said.contains(told), "{said}");
    assert_eq!(at.whole().state.trial(1).expect("there").attempts.len(), 2);
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
        let at = Place::of(&plan);
        let memory = machines(Some(VIRTUAL_UID));
        let (code, said, err) = memory.run(&["campaign", "new", &at.plan, "--out", &at.out]);
        assert_eq!(code, 0, "{said}{err}");
        assert_eq!(said.contains(note), told, "{said}");
        assert_eq!(said.contains("allow at least 15.184898 s"), told, "{said}");
    }
}

#[test]
fn verify_says_what_is_wrong_and_what_to_do() {
    let at = Place::of(&small_plan(&[]));
    let memory = machines(Some(VIRTUAL_UID));
    let (code, said, err) = memory.run(&["campaign", "new", &at.plan, "--out", &at.out]);
    assert_eq!(code, 0, "{said}{err}");
    assert!(said.contains("6 trials in 5 blocks, seed 20221"), "{said}");
    let (code, said, _) = memory.run(&["verify", &at.out]);
    assert_eq!(code, 0);
    assert!(said.contains("4 files are as SHA256SUMS says"), "{said}");
    fs::write(Path::new(&at.out).join("notes.txt"), "x").expect("written");
    let (code, said, err) = memory.run(&["verify", &at.out]);
    assert_eq!(code, 1, "{said}{err}");
    assert!(
        said.contains("notes.txt: is not in SHA256SUMS")
            && said.contains("remedy: was it put there by hand?"),
        "{said}"
    );
    let (code, said, _) = memory.run(&["--json", "verify", &at.out]);
    let json: serde_json::Value = serde_json::from_str(&said).expect("JSON");
    assert_eq!(
        (code, &json["findings"][0]["path"]),
        (1, &"notes.txt".into())
    );
    let empty = at.path("empty");
    fs::create_dir(&empty).expect("made");
    let (code, _, err) = memory.run(&["verify", &empty]);
    assert_eq!(code, 2, "{err}");
    assert!(err.contains("no SHA256SUMS and no record"), "{err}");
}

#[test]
fn a_virtual_capsule_makes_the_campaign_virtual() {
    let at = Place::of(&small_plan(&[]));
    let mut capsule = Script::new(DeviceKind::Capsule);
    capsule.uid = VIRTUAL_UID;
    let memory = Memory::with(vec![Script::new(DeviceKind::Rig), capsule]);
    let said = at.unattended(&memory, 0, &["--yes", "--trials", "1"]);
    assert_eq!(at.read().origin(), Some(Origin::Virtual), "{said}");
}

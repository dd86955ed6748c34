//! The capsule after a fold trial: it is unfolded whatever the answer is, or somebody is told that it is folded still.

use std::fs;
use std::path::Path;
use std::sync::{Arc, Mutex};

use client::link::{Link, LinkError};
use client::{Device, Unobserved};
use lab::campaign::form::Form;
use lab::campaign::ledger::TrialStatus;
use lab::campaign::order::order;
use lab::campaign::plan::CampaignPlan;
use lab::operations::connector::Connector;
use lab::trials::sidecar;
use protocol::capsule::ActuationKind;
use protocol::system::DeviceKind;
use report::html::evaluation::evaluate;
use simulated_machines::link::Memory;
use simulated_machines::machine::{Log, Script, SimulatedMachine, link};

use crate::campaign_run::{Place, file_of, machines};
use crate::support::mishap::{FaultyLine, Mishap, Opened};
use crate::support::plan::{PAPER, changed};
use crate::support::tool;

/// A plan of an unfolded trial and a folded one, which is the last.
fn fold_test() -> String {
    let short = [
        ("cycles = 5", "cycles = 1"),
        ("duration_s = 40", "duration_s = 8"),
        ("telemetry_ms = 10 ", "telemetry_ms = 50 "),
        ("count = 5", "count = 1"),
        ("seed = 20221", "seed = 1"),
    ];
    let plan = changed(PAPER, &short);
    let (before, series) = plan.split_once("[series]").expect("there");
    let (_, after) = series.split_once("\n\n").expect("a blank line");
    format!("{before}{after}")
}

/// The answers up to the displacement of the folded trial.
const UP_TO_THE_FOLDED_ONE: [(&str, &str); 7] = [
    ("rollers OFF", ""),
    ("Reading 1 of 1: D", "24.4"),
    ("Clamp both rollers", ""),
    ("Reading 1 of 1: i", "14.3"),
    ("it will be unfolded", ""),
    ("Displacement of the tail", "30"),
    ("it will be folded now", ""),
];

/// The session of that plan with these answers, which ends with this code.
#[track_caller]
fn session(bench: &dyn Connector, code: u8, answer: &'static str) -> (String, Place) {
    let at = Place::of(&fold_test());
    let lines = [
        &UP_TO_THE_FOLDED_ONE[..],
        &[("Displacement of the tail", answer)],
    ];
    let shown = at.answered(bench, code, lines.concat());
    (shown, at)
}

fn is_done(at: &Place) -> bool {
    at.whole().state.trial(2).expect("there").status() == TrialStatus::Done
}

/// Regression: a clock that was set within a trial turned the order of its records round.
#[test]
fn the_records_of_a_trial_are_in_the_order_of_the_machines_time() {
    let (_, at) = session(&machines(None), 0, "-60");
    let out = Path::new(&at.out);
    for entry in fs::read_dir(out.join("trials/002-1")).expect("a folder") {
        let path = entry.expect("an entry").path();
        let name = path
            .file_name()
            .expect("a name")
            .to_string_lossy()
            .into_owned();
        if name.starts_with("fold-") && name.ends_with(".json") {
            let text = fs::read_to_string(&path).expect("text");
            fs::write(&path, text.replace("1970-01-01T", "2031-01-01T")).expect("written");
        }
    }
    let parts = &evaluate(out).expect("a campaign").parts[1];
    let names = parts.iter().map(|part| sidecar::heading(&part.trial));
    let expected = ["Fold", "Unfold", "Run, 1 cycles of 130 mm"];
    assert_eq!(names.collect::<Vec<_>>(), expected);
}

const STILL_FOLDED: &str =
    "The capsule is folded still, and its thread pulls: `retrograde unfold`.";

/// Regression: only a displacement unfolded it.
#[test]
fn whatever_ends_a_fold_trial_unfolds_the_capsule() {
    for (answer, status, code) in [
        ("-60", TrialStatus::Done, 0),
        ("exclude the wall was torn", TrialStatus::Excluded, 0),
        ("skip", TrialStatus::Skipped, 0),
        ("repeat it slipped", TrialStatus::Open, 130),
    ] {
        let memory = machines(None);
        let at = Place::of(&fold_test());
        let mut lines = UP_TO_THE_FOLDED_ONE.to_vec();
        lines.push(("Displacement of the tail", answer));
        if status == TrialStatus::Open {
            lines.push(("Trial 2 of 2, attempt 2", "q"));
        }
        let shown = at.answered(&memory, code, lines);
        let heard = memory.heard();
        let unfolds = heard.iter().filter(|heard| **heard == "Unfold").count();
        assert_eq!(unfolds, 1, "{answer}: {shown}");
        assert!(!shown.contains("folded still"), "{answer}: {shown}");
        // Whoever stands beside the capsule learns what it is about to do.
        let told = shown.lines().filter(|line| line.ends_with(" the capsule."));
        let motions = ["Reference", "Fold", "Unfold"].map(|verb| format!("{verb} the capsule."));
        assert!(told.eq(motions), "{answer}: {shown}");
        let campaign = at.whole();
        let folded = campaign.state.trial(2).expect("there");
        assert_eq!(folded.status(), status, "{shown}");
        assert!(file_of(&campaign.attempt_folder(2, 1), "unfold-").is_some());
    }
}

/// Whoever leaves before the body is measured leaves the capsule folded.
#[test]
fn a_capsule_that_stays_folded_is_told_with_the_command_that_unfolds_it() {
    let memory = machines(None);
    let (shown, _) = session(&memory, 130, "q");
    assert!(!memory.heard().contains(&"Unfold"), "{shown}");
    assert!(shown.contains(STILL_FOLDED), "{shown}");
}

/// The body of the present trial is still to be measured, in the folded shape.
#[test]
fn a_corrected_trial_leaves_the_capsule_of_the_next_one_folded() {
    let mut plans = (1..100).map(|seed| {
        let plan = changed(&fold_test(), &[("repeats = 1", "repeats = 2")]);
        plan.replacen("seed = 1", &format!("seed = {seed}"), 1)
    });
    let is_last = |plan: &String| {
        let plan = CampaignPlan::parse(plan, Path::new("plan.toml")).expect("a plan");
        let shapes = order(&plan).into_iter().map(|trial| trial.shape);
        shapes.eq([Form::Unfolded, Form::Unfolded, Form::Folded, Form::Folded])
    };
    let at = Place::of(&plans.find(is_last).expect("of a hundred"));
    let lines = vec![
        ("rollers OFF", ""),
        ("Reading 1 of 1: D", "24.4"),
        ("Clamp both rollers", ""),
        ("Reading 1 of 1: i", "14.3"),
        ("it will be unfolded", ""),
        ("Displacement of the tail", "30"),
        ("it will be unfolded", ""),
        ("Displacement of the tail", "31"),
        ("it will be folded now", ""),
        ("Displacement of the tail", "-60"),
        ("it will be folded now", ""),
        ("Trial 4 of 4", "undo"),
        ("the displacement of trial 3 is taken back", ""),
        ("is needed here", "-61"),
        ("Trial 4 of 4", "q"),
    ];
    let memory = machines(None);
    let shown = at.answered(&memory, 130, lines);
    let heard = memory.heard();
    let count = |name| heard.iter().filter(|heard| **heard == name).count();
    assert_eq!((count("Fold"), count("Unfold")), (2, 1), "{shown}");
    assert!(shown.contains("The capsule is folded still"), "{shown}");
}

/// A bench to whose capsule something happens when it has heard this request, after the record of its fold was fetched.
struct Bench {
    mishap: Mishap,
    after: &'static str,
    heard: Mutex<Option<Arc<Mutex<Log>>>>,
}

impl Bench {
    fn new(mishap: Mishap, after: &'static str) -> Self {
        Self {
            mishap,
            after,
            heard: Mutex::default(),
        }
    }

    fn connector(&self) -> impl Connector {
        Opened(|kind| -> Box<dyn Link> {
            let mut script = Script::new(kind);
            if kind == DeviceKind::Rig {
                return link(script).0;
            }
            // The fold is its first actuation.
            script.ready = true;
            let after = vec!["GetActuationRecord", self.after];
            let (line, log) = FaultyLine::new(script, self.mishap, after);
            *self.heard.lock().expect("free") = Some(log);
            line
        })
    }

    fn has_unfolded(&self) -> bool {
        let log = self.heard.lock().expect("free").clone().expect("a capsule");
        log.lock().expect("free").heard.contains(&"Unfold")
    }
}

/// The last request of an attempt that folds the capsule, and the first one of its end.
const LAST: &str = "SetTelemetry";
const END: &str = "GetCapsuleStatus";

/// Regression: the session ended with an error instead.
#[test]
fn a_capsule_that_is_gone_when_it_is_to_be_unfolded_ends_no_session() {
    let bench = Bench::new(Mishap::Unplugged, LAST);
    let (shown, at) = session(&bench.connector(), 0, "-60");
    let told = "was the capsule left folded? Its thread pulls: leave, then `retrograde unfold`";
    assert!(shown.contains(told), "{shown}");
    assert!(shown.contains("2 of 2 trials are done"), "{shown}");
    at.text("report/report.html");
}

/// Regression: a stop of the capsule within the run, older than the displacement, ended the session after it.
#[test]
fn a_stop_before_the_displacement_was_asked_for_keeps_no_capsule_folded() {
    let bench = Bench::new(Mishap::Stopped, LAST);
    let (shown, at) = session(&bench.connector(), 0, "-60");
    let told = shown.find("a stop was requested").expect(&shown);
    assert!(shown[told..].contains("Unfold the capsule."), "{shown}");
    assert!(bench.has_unfolded());
    at.whole();
}

#[test]
fn a_stop_while_the_displacement_is_asked_for_leaves_the_capsule_and_tells_of_it() {
    let bench = Bench::new(Mishap::Stopped, END);
    let (shown, at) = session(&bench.connector(), 0, "-60");
    let stays = "the capsule stays folded, and its thread pulls: leave, then `retrograde unfold`";
    for told in ["a stop was requested", stays, STILL_FOLDED] {
        assert!(shown.contains(told), "{told}: {shown}");
    }
    assert!(!bench.has_unfolded() && is_done(&at));
}

/// The stop ends the session, and the body has its displacement.
#[test]
fn a_stop_while_the_capsule_unfolds_ends_the_session_in_order() {
    let bench = Bench::new(Mishap::Stopped, "Unfold");
    let (shown, at) = session(&bench.connector(), 130, "-60");
    assert!(bench.has_unfolded() && is_done(&at), "{shown}");
    let left = "aborted; everything that was entered is in";
    let told = "The capsule stands between its ends, and its thread may pull: `retrograde unfold`.";
    for said in [left, told] {
        assert!(shown.contains(said), "{said}: {shown}");
    }
}

/// A capsule that may be moving still is no end in order.
#[test]
fn a_capsule_that_is_gone_while_it_unfolds_ends_the_session_with_an_error() {
    let bench = Bench::new(Mishap::Unplugged, "Unfold");
    let (shown, at) = session(&bench.connector(), 4, "-60");
    let told = "it was unplugged: it MAY BE MOVING";
    assert!(shown.contains(told) && is_done(&at), "{shown}");
}

/// The line to a capsule that outlives the session.
struct Same(Arc<Mutex<Box<Memory<SimulatedMachine>>>>);

impl Link for Same {
    fn place(&self) -> String {
        self.0.lock().expect("free").place()
    }
    fn now_us(&self) -> u64 {
        self.0.lock().expect("free").now_us()
    }
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.0.lock().expect("free").send(bytes)
    }
    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        self.0.lock().expect("free").receive(buffer, deadline_us)
    }
}

/// A bench whose capsule is the same for every session, and for other processes.
struct Kept {
    capsule: Arc<Mutex<Box<Memory<SimulatedMachine>>>>,
    log: Arc<Mutex<Log>>,
}

impl Kept {
    fn new() -> Self {
        let (capsule, log) = link(tool::ready(DeviceKind::Capsule));
        Self {
            capsule: Arc::new(Mutex::new(capsule)),
            log,
        }
    }

    fn line(&self) -> Box<dyn Link> {
        Box::new(Same(Arc::clone(&self.capsule)))
    }

    fn connector(&self) -> impl Connector {
        Opened(|kind| match kind {
            DeviceKind::Rig => link(Script::new(kind)).0 as Box<dyn Link>,
            DeviceKind::Capsule => self.line(),
        })
    }

    /// Another process makes this motion.
    fn moved(&self, kind: ActuationKind) {
        let mut host = Device::connect(self.line(), DeviceKind::Capsule, 9).expect("a capsule");
        let accepted = match kind {
            ActuationKind::Fold => host.fold(),
            _ => host.unfold(),
        };
        let ended = host.wait_actuation(&accepted.expect("accepted"), &mut Unobserved);
        ended.expect("to its end");
    }
}

/// The record of its fold would be of no attempt, so it is folded anew; for an unfolded body it is only unfolded.
#[test]
fn a_capsule_that_was_left_folded_is_folded_anew_for_a_folded_trial_only() {
    for (first, motions) in [
        (Form::Unfolded, &["Unfold the capsule."][..]),
        (
            Form::Folded,
            &[
                "The capsule is still folded: it will be unfolded and folded again.",
                "Unfold the capsule.",
                "Fold the capsule.",
            ],
        ),
    ] {
        let mut plans = (1..100).map(|seed| {
            let seed = format!("seed = {seed}");
            fold_test().replacen("seed = 1", &seed, 1)
        });
        let begins = |plan: &String| {
            let plan = CampaignPlan::parse(plan, Path::new("plan.toml")).expect("a plan");
            order(&plan)[0].shape == first
        };
        let at = Place::of(&plans.find(begins).expect("of a hundred"));
        let bench = Kept::new();
        bench.moved(ActuationKind::Fold);
        let lines = [
            &UP_TO_THE_FOLDED_ONE[..4],
            &[
                ("the capsule is connected", ""),
                ("Displacement of the tail", "q"),
            ],
        ];
        let shown = at.answered(&bench.connector(), 130, lines.concat());
        let is_motion = |line: &&str| line.contains("old the capsule.") || line.contains("again.");
        let told: Vec<&str> = shown.lines().filter(is_motion).collect();
        assert_eq!(told, motions, "{shown}");
    }
}

/// Somebody has unfolded it meanwhile, as they were told to: then nothing is left to do.
#[test]
fn a_capsule_that_is_unfolded_by_then_is_left_alone() {
    let at = Place::of(&fold_test());
    let bench = Kept::new();
    let lines = [
        &UP_TO_THE_FOLDED_ONE[..],
        &[("Displacement of the tail", "q")],
    ];
    let shown = at.answered(&bench.connector(), 130, lines.concat());
    assert!(shown.contains("The capsule is folded still"), "{shown}");
    bench.moved(ActuationKind::Unfold);
    let lines = vec![("Displacement of the tail", "-60")];
    let shown = at.answered(&bench.connector(), 0, lines);
    let log = bench.log.lock().expect("free");
    let unfolds = log.heard.iter().filter(|heard| **heard == "Unfold");
    assert_eq!(unfolds.count(), 1, "{shown}");
}

//! Which trial a question and an answer are about, and which attempts count.

use std::fs;

use lab::campaign::contents::Campaign;
use lab::campaign::files::TRIALS;
use lab::campaign::folder::Folder;
use lab::campaign::ledger::{AttemptOutcome, TrialStatus};
use serde_json::Value;

use crate::campaign::{at, findings, relist, small};
use crate::campaign_run::{Place, machines};
use crate::support::plan::{ONE_CONDITION, PAPER, changed};

/// A plan of ten short trials in one block.
fn one_block() -> String {
    let short = [
        ("duration_s = 40", "duration_s = 8"),
        ("count = 5", "count = 1"),
    ];
    changed(PAPER, &[&ONE_CONDITION[..], &short].concat())
}

/// The answers up to the checklist of the first trial.
const UP_TO_THE_TRIALS: [(&str, &str); 4] = [
    ("rollers OFF", ""),
    ("Reading 1 of 1: D", "24.4"),
    ("Clamp both rollers", ""),
    ("Reading 1 of 1: i", "14.3"),
];

/// Regression: two displacements that were missing were asked for in the same words, so that they could be exchanged.
#[test]
fn each_displacement_is_asked_for_by_the_name_of_its_trial() {
    let at = Place::of(&one_block());
    let memory = machines(None);
    let begin = [
        ("Trial 1 of 10", ""),
        (
            "Trial 1 of 10: a5, dry, unfolded, repeat 1.\nDisplacement of the tail",
            "repeat slipped",
        ),
        ("Trial 1 of 10, attempt 2", ""),
        ("Displacement of the tail", "4.1"),
        ("Trial 2 of 10", ""),
        ("Displacement of the tail", "4.2"),
        ("Trial 3 of 10", ""),
        ("Displacement of the tail", "q"),
    ];
    let lines = [&UP_TO_THE_TRIALS[..], &begin].concat();
    at.answered(&memory, 130, lines);
    let (code, _, err) = memory.run(&["campaign", "edit", &at.out, "undo", "1"]);
    assert_eq!(code, 0, "{err}");
    let lines = vec![
        (
            "Trial 1 of 10, attempt 2: a5, dry, unfolded, repeat 1.\nDisplacement of the tail",
            "5.1",
        ),
        (
            "Trial 3 of 10: a5, dry, unfolded, repeat 3.\nDisplacement of the tail",
            "5.3",
        ),
        ("Trial 4 of 10", "q"),
    ];
    at.answered(&memory, 130, lines);
    let campaign = at.whole();
    let um = [1, 2, 3].map(|trial| {
        let counted = campaign.state.trial(trial).expect("there").counted();
        counted.expect("counts").value.um
    });
    assert_eq!(um, [5_100, 4_200, 5_300]);
}

/// Regression: it left the trial out that was corrected last.
#[test]
fn exclude_at_a_check_list_means_the_last_trial_whatever_was_corrected() {
    let at = Place::of(&one_block());
    let memory = machines(None);
    let begin = [
        ("Trial 1 of 10", "exclude torn"),
        ("no trial is done yet", ""),
        ("Displacement of the tail", "4.1"),
        ("Trial 2 of 10", ""),
        ("Displacement of the tail", "4.2"),
        ("Trial 3 of 10", "q"),
    ];
    let lines = [&UP_TO_THE_TRIALS[..], &begin].concat();
    at.answered(&memory, 130, lines);
    let (code, _, err) = memory.run(&["campaign", "edit", &at.out, "displacement", "1", "4"]);
    assert_eq!(code, 0, "{err}");
    let lines = vec![
        ("Trial 3 of 10", "exclude the wall was torn"),
        (
            "trial 2 is excluded; undo takes it in again",
            "exclude torn",
        ),
        ("trial 2 is excluded already", ""),
        ("Displacement of the tail", "repeat it slipped"),
        // Neither this attempt nor the trial before it.
        ("Trial 3 of 10, attempt 2", "exclude torn"),
        ("trial 3 does not count anyway", "q"),
    ];
    at.answered(&memory, 130, lines);
    let campaign = at.whole();
    let statuses = [1, 2, 3].map(|trial| campaign.state.trial(trial).expect("there").status());
    assert_eq!(
        statuses,
        [TrialStatus::Done, TrialStatus::Excluded, TrialStatus::Open]
    );
}

/// Regression: the record of a run on a full disk is complete by the machine's account and lacks telemetry. It counted
/// if the tool was killed before it had written the end of the attempt.
#[test]
fn a_record_that_is_not_whole_completes_no_attempt() {
    let (_place, path) = small();
    let read = Campaign::read(&path).expect("a campaign");
    let sidecar = read.run_sidecar(3, 1).expect("a record");
    let text = fs::read_to_string(&sidecar).expect("text");
    let mut record: Value = serde_json::from_str(&text).expect("JSON");
    let error = "the telemetry was not recorded whole: no space";
    record["error"] = error.into();
    fs::write(&sidecar, record.to_string()).expect("written");
    relist(&path);
    let name = sidecar.file_name().expect("a name").to_string_lossy();
    let says =
        format!("trials/003-1: {TRIALS} says that it was completed, and {name} says that {error}");
    assert_eq!(findings(&path), [says]);

    let ledger = fs::read_to_string(path.join(TRIALS)).expect("text");
    let began = ledger.find(",began,3,1,").expect("a row");
    let end = ledger[began..].find('\n').expect("a whole row") + began + 1;
    fs::write(path.join(TRIALS), &ledger[..end]).expect("written");
    relist(&path);
    let (folder, told) = Folder::resume(&path, at(99)).expect("a crash");
    assert_eq!(told, ["003-1: the tool ended within it: lost"]);
    let trial = folder.campaign().state.trial(3).expect("there");
    assert_eq!(trial.attempts[0].outcome, Some(AttemptOutcome::Lost));
    assert_eq!(trial.status(), TrialStatus::Open);
    drop(folder);
    assert_eq!(findings(&path), [""; 0]);
}

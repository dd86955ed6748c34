//! Which trial a question and an answer are about, and which attempts count.

use crate::campaign_run::{converse, machines, path, place, whole};
use crate::support::plan::{ONE_CONDITION, PAPER, changed};

/// A plan of ten short trials in one block.
fn one_block() -> String {
    let short = [
        ("duration_s = 40", "duration_s = 8"),
        ("count = 5", "count = 1"),
    ];
    changed(PAPER, &[&ONE_CONDITION[..], &short].concat())
}

/// The answers up to the check-list of the first trial.
const UP_TO_THE_TRIALS: [(&str, &str); 4] = [
    ("rollers OFF", ""),
    ("Reading 1 of 1: D", "24.4"),
    ("Clamp both rollers", ""),
    ("Reading 1 of 1: i", "14.3"),
];

/// Regression: two displacements that were missing were asked for in the same words, so that they could be exchanged.
#[test]
fn each_displacement_is_asked_for_by_the_name_of_its_trial() {
    let place = place(&one_block());
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
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
    let (code, shown) = converse(&memory, &["run", &plan, "--out", &out], lines);
    assert_eq!(code, 130, "{shown}");
    let (code, _, err) = memory.run(&["campaign", "edit", &out, "undo", "1"]);
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
    let (code, shown) = converse(&memory, &["run", &out], lines);
    assert_eq!(code, 130, "{shown}");
    let campaign = whole(&out);
    let um = [1, 2, 3].map(|trial| {
        let counted = campaign.state.trial(trial).expect("there").counted();
        counted.expect("counts").value.um
    });
    assert_eq!(um, [5_100, 4_200, 5_300]);
}

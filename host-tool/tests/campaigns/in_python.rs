//! The examples in Python, run on a campaign's folder.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use crate::campaign::relist;
use crate::campaign_report::{PLAN, made};
use lab::campaign::folder::Folder;
use report::html::evaluation::evaluate;

/// Starts a program in the folder of the examples; none without Python, which no test requires.
fn python(args: &[&str]) -> Option<Output> {
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/examples");
    let mut command = Command::new("python3");
    command.env("PYTHONDONTWRITEBYTECODE", "1");
    command.env("PYTHONPATH", examples.join("../../python/src"));
    command.current_dir(examples).args(args).output().ok()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// The report leaves it out, so a figure with it would show other trials under the same numbers.
#[test]
fn the_figure_in_python_leaves_out_a_changed_trial() {
    let (place, path) = made();
    let svg = place.path().join("figure7.svg");
    let (folder, out) = (path.to_str().expect("UTF-8"), svg.to_str().expect("UTF-8"));
    let drawn = || {
        let output = python(&["figure7.py", folder, out])?;
        assert!(output.status.success(), "{output:?}");
        // One dot for each trial of the series.
        let svg = fs::read_to_string(out).expect("a figure");
        let dots = svg.matches("<circle").count();
        Some((dots, text(&output.stdout), text(&output.stderr)))
    };
    let Some((dots, said, hints)) = drawn() else {
        return;
    };
    assert_eq!((dots, hints.as_str()), (11, ""), "{said}");
    let row = &evaluate(&path).expect("a campaign").trials[2];
    let telemetry = path.join(row.telemetry.as_ref().expect("a run"));
    let whole = fs::read_to_string(&telemetry).expect("there");
    fs::write(&telemetry, &whole[..whole.len() / 2]).expect("cut");
    let (dots, said, hints) = drawn().expect("as before");
    assert_eq!(dots, 10, "{said}");
    let walls = row.lubrication.name();
    assert!(said.contains(&format!("{walls}: n = 4,")), "{said}");
    assert!(
        hints.contains("trial 3 is left out: ") && hints.contains("not as it was written"),
        "{hints}"
    );
    // A file that was added to its folder is a change as well.
    fs::write(&telemetry, whole).expect("as before");
    let more = telemetry.with_file_name("more.txt");
    fs::write(&more, "added").expect("written");
    let (dots, _, hints) = drawn().expect("as before");
    assert_eq!(dots, 10);
    assert!(hints.contains("trial 3 is left out: "), "{hints}");
    // So is one whose record was cut by a full disk.
    fs::remove_file(&more).expect("as before");
    let sidecar = telemetry.with_extension("json");
    let trial = fs::read_to_string(&sidecar).expect("text");
    let cut = "\"error\": \"the telemetry was not recorded whole: no space\"";
    fs::write(&sidecar, trial.replacen("\"error\": null", cut, 1)).expect("written");
    relist(&path);
    assert_eq!(drawn().expect("as before").0, 10);
    assert!(!evaluate(&path).expect("a campaign").trials[2].counts);
}

/// `01` is the name of an indentation, not the number 1.
#[test]
fn names_of_digits_stay_text_in_python() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("digits");
    let plan = PLAN
        .replace("\"a1\"", "\"01\"")
        .replace("\"a2\"", "\"1e3\"")
        .replace("\"a3\"", "\"5\"");
    drop(Folder::create(&path, &plan, Path::new("digits.toml")).expect("made"));
    let program = "import sys, retrograde.data as data\n\
                   campaign = data.Campaign(sys.argv[1])\n\
                   print(sorted({trial['indentation'] for trial in campaign.trials}))\n\
                   print({type(trial['repeat']).__name__ for trial in campaign.trials})\n\
                   print([data.value(text) for text in ('7', '-0.50', '1e-05', '01', '1_0', 'nan', 'true', '')])";
    let Some(output) = python(&["-c", program, path.to_str().expect("UTF-8")]) else {
        return;
    };
    let wanted = "['01', '1e3', '5']\n{'int'}\n[7, -0.5, 1e-05, '01', '1_0', 'nan', True, None]\n";
    assert_eq!(text(&output.stdout), wanted, "{output:?}");
}

/// Regression: the examples promise Python 3.9, which has no `statistics.linear_regression`.
#[test]
fn the_figure_needs_nothing_newer_than_python_3_9() {
    let (place, path) = made();
    let svg = place.path().join("figure7.svg");
    let program = "import statistics, sys\n\
                   vars(statistics).pop('linear_regression', None)\n\
                   import figure7\n\
                   figure7.main(*sys.argv[1:])";
    let (folder, out) = (path.to_str().expect("UTF-8"), svg.to_str().expect("UTF-8"));
    let Some(output) = python(&["-c", program, folder, out]) else {
        return;
    };
    assert!(output.status.success(), "{output:?}");
}

/// Regression: a displacement whose row was cut off with half of its digits was taken as a displacement.
#[test]
fn a_row_that_was_cut_off_is_no_row_in_python() {
    let (_place, path) = made();
    let ledger = path.join("trials.csv");
    let whole = fs::read_to_string(&ledger).expect("there");
    let row = whole.find(",displacement,3,").expect("a displacement");
    let value = row + whole[row..].find(".").expect("decimals");
    fs::write(&ledger, &whole[..value]).expect("cut");
    let program = "import sys, retrograde.data as data\n\
                   trial = data.Campaign(sys.argv[1]).trials[2]\n\
                   print(trial['status'], trial['displacement_mm'])";
    let Some(output) = python(&["-c", program, path.to_str().expect("UTF-8")]) else {
        return;
    };
    assert_eq!(text(&output.stdout), "unmeasured None\n", "{output:?}");
}

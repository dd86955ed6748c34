//! The words of the commands on campaigns and records: no more than is known, and what to do.

use std::fs;
use std::path::Path;

use client::identity::Origin;
use lab::campaign::ledger::{LedgerEvent, LedgerRow};
use lab::campaign::prompts::Question;
use report::html;
use serde_json::Value;
use simulated_machines::machine::VIRTUAL_UID;

use crate::campaign::{at, campaign, findings, small};
use crate::campaign_run::{Place, machines, small_plan};
use crate::support::offline::{retrograde, text};

/// A folder with the record of one complete run, and its sidecar.
fn record(place: &tempfile::TempDir) -> std::path::PathBuf {
    drop(campaign(&place.path().join("small")));
    let records = place.path().join("small/trials/001-1");
    let files = fs::read_dir(&records).expect("a folder");
    let mut files = files.map(|entry| entry.expect("an entry").path());
    files
        .find(|file| file.extension().is_some_and(|kind| kind == "json"))
        .expect("a sidecar")
}

/// Regression: a record that a full disk had cut off was in order for `verify`, and `report` knew who had ended first.
#[test]
fn a_record_without_an_end_is_named_and_its_cause_is_not_claimed() {
    let place = tempfile::tempdir().expect("a folder");
    let sidecar = record(&place);
    let folder = sidecar.parent().expect("a folder");
    let written = fs::read_to_string(&sidecar).expect("text");
    let mut trial: Value = serde_json::from_str(&written).expect("JSON");
    trial["status"] = "running".into();
    trial["action"]["executed"] = Value::Null;
    fs::write(&sidecar, trial.to_string()).expect("written");
    let (code, out, err) = retrograde(&["verify", text(folder)]);
    assert_eq!(code, 1, "{err}");
    let name = sidecar.file_name().expect("a name").to_string_lossy();
    let says = format!("{name}: no end is recorded: it is under way, or was cut off");
    assert!(out.contains(&says), "{out}");
    let (_, out, _) = retrograde(&["--json", "verify", text(folder)]);
    let told: Value = serde_json::from_str(&out).expect("JSON");
    assert_eq!(told["findings"][0]["path"], *name, "{out}");
    let page = place.path().join("report.html");
    let (code, _, err) = retrograde(&["report", text(folder), "--out", text(&page)]);
    assert_eq!(code, 1, "{err}");
    let page = fs::read_to_string(&page).expect("a page");
    assert!(page.contains("no end is recorded: it is under way, or was cut off"));
    assert!(!page.contains("the host ended first"));
}

/// Regression: `verify` of a folder of records passed over a record that was a link, and one whose telemetry was gone.
#[test]
fn half_a_record_and_a_link_to_one_are_findings() {
    let place = tempfile::tempdir().expect("a folder");
    let sidecar = record(&place);
    let folder = sidecar.parent().expect("a folder");
    let telemetry = sidecar.with_extension("csv");
    for (file, named, what) in [
        (&sidecar, &sidecar, "is neither a file nor a folder"),
        (&telemetry, &telemetry, "is neither a file nor a folder"),
        (&telemetry, &sidecar, "its telemetry is missing"),
        (&sidecar, &telemetry, "its sidecar is missing"),
    ] {
        let elsewhere = place.path().join("elsewhere");
        fs::rename(file, &elsewhere).expect("moved");
        if what.contains("neither") {
            std::os::unix::fs::symlink(&elsewhere, file).expect("a link");
        }
        let (code, out, err) = retrograde(&["verify", text(folder)]);
        let finding = format!("{}: {what}", named.file_name().expect("a name").display());
        assert!(code == 1 && out.contains(&finding), "{finding}: {out}{err}");
        fs::rename(&elsewhere, file).expect("moved back");
    }
    let (code, _, err) = retrograde(&["verify", text(folder)]);
    assert_eq!(code, 0, "{err}");
}

/// Regression: the telemetry of a calibration without its sidecar was no lost record.
#[test]
fn a_lost_record_of_any_action_counts() {
    let place = tempfile::tempdir().expect("a folder");
    let folder = record(&place).parent().expect("a folder").to_owned();
    let lost = [
        "run",
        "fold",
        "fold-to",
        "unfold",
        "reference",
        "calibrate",
        "check-folded",
    ];
    for stem in lost {
        let name = format!("{stem}-20260131T120000Z.csv");
        fs::write(folder.join(name), "").expect("written");
    }
    for other in ["runner.csv", "trace-1-20260131T120000Z.csv"] {
        fs::write(folder.join(other), "").expect("written");
    }
    let found = html::find(std::slice::from_ref(&folder)).expect("a folder");
    let records = found.omitted.iter().filter(|omitted| omitted.is_record);
    assert_eq!((found.omitted.len(), records.count()), (9, 7));
    let page = place.path().join("report.html");
    let (code, _, err) = retrograde(&["report", text(&folder), "--out", text(&page)]);
    assert!(code == 1 && err.contains("records omitted: 7"), "{err}");
}

#[test]
fn a_file_that_is_gone_has_one_finding() {
    let (_place, folder) = small();
    for name in ["order.csv", "plan.toml", "trials.csv", "readings.csv"] {
        let kept = fs::read(folder.join(name)).expect("there");
        fs::remove_file(folder.join(name)).expect("there");
        let found = findings(&folder);
        let count = found.iter().filter(|found| found.starts_with(name)).count();
        assert_eq!(count, 1, "{found:?}");
        fs::write(folder.join(name), kept).expect("written");
    }
    assert_eq!(findings(&folder), [""; 0]);
}

#[test]
fn a_plan_that_is_none_is_told_before_anything_else() {
    let place = tempfile::tempdir().expect("a folder");
    let (folder, none) = (place.path().join("study"), place.path().join("none.toml"));
    fs::create_dir(&folder).expect("a folder");
    let (code, _, err) = retrograde(&["campaign", "new", text(&folder)]);
    assert!(
        code == 2 && err.contains("is a folder, and a plan is a TOML file"),
        "{err}"
    );
    assert!(
        err.contains(&format!("campaign run {}` continues", folder.display())),
        "{err}"
    );
    // Without a terminal, too.
    let (code, _, err) = retrograde(&["campaign", "run", text(&none)]);
    assert!(code == 2 && err.contains("No such file"), "{err}");
    assert!(!err.contains("nobody is at a terminal"), "{err}");
}

#[test]
fn a_refused_row_is_told_in_words() {
    let place = tempfile::tempdir().expect("a folder");
    let mut folder = campaign(&place.path().join("small"));
    for (event, attempt, what) in [
        (LedgerEvent::Skipped, None, "skipped"),
        (LedgerEvent::Ended, Some(1), "ended"),
        (LedgerEvent::Began, Some(2), "begun"),
    ] {
        let row = LedgerRow::of(event, 1, attempt);
        let error = folder.append(row, at(100), Origin::Board).expect_err(what);
        let says = format!("trial 1 is done and cannot be {what}");
        assert!(error.why.contains(&says), "{error:?}");
    }
}

/// Regression: `no` dropped all readings, and only `again` was among the answers; `undo` was not.
#[test]
fn a_question_lists_what_it_takes() {
    let hint = Question::Odd { questions: &[] }.hint();
    for answer in ["yes", "undo", "again", "no", "q"] {
        let mut words = hint.split(|c: char| !c.is_alphabetic());
        assert!(words.any(|word| word == answer), "{answer}: {hint}");
    }
}

/// Regression: whoever looked at a report in between was left with it at the end.
#[test]
fn the_report_of_a_finished_campaign_is_of_its_last_state() {
    let at = Place::of(&small_plan(&[]));
    let memory = machines(Some(VIRTUAL_UID));
    let run = |more: &[&str]| at.unattended(&memory, 0, &[&["--yes"], more].concat());
    run(&["--trials", "3"]);
    let (code, _, err) = memory.run(&["report", &at.out]);
    assert_eq!(code, 0, "{err}");
    let page = Path::new(&at.out).join("report/report.html");
    let read = || fs::read_to_string(&page).expect("a page");
    let early = read();
    let said = run(&[]);
    assert!(
        said.contains("report.html, written again, because it showed an earlier state"),
        "{said}"
    );
    let last = read();
    assert!(last != early && last.contains("Every trial of the plan counts."));
    // Nothing has changed since: a page with another band would be kept.
    let said = run(&[]);
    assert!(
        said.contains("report.html, of this state already"),
        "{said}"
    );
    assert_eq!(read(), last);
    let (code, _, err) = memory.run(&["campaign", "edit", &at.out, "note", "21 degC"]);
    assert_eq!(code, 0, "{err}");
    let said = run(&[]);
    assert!(said.contains("written again") && read() != last, "{said}");
    // Somebody else's page.
    fs::write(&page, "<p>mine</p>").expect("written");
    let said = run(&[]);
    assert!(
        said.contains("is not a report of this program: move it elsewhere"),
        "{said}"
    );
    assert_eq!(read(), "<p>mine</p>");
}

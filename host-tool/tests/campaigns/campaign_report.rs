//! The report of a campaign: which trials count, its numbers, its files.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use crate::campaign::{accepted, reading, relist};
use crate::campaign_run::file_of;
use crate::support::offline::{self, retrograde};
use crate::support::tool::device;
use client::Unobserved;
use client::identity::Origin;
use jiff::Timestamp;
use lab::campaign::contents::Campaign;
use lab::campaign::folder::Folder;
use lab::campaign::form::Form;
use lab::campaign::ledger::{AttemptOutcome, LedgerEvent, LedgerRow, Source};
use lab::campaign::manifest;
use lab::campaign::order::Planned;
use lab::campaign::plan::{Millimetres, TrialPurpose};
use lab::campaign::readings::{Kind, ReadingRow};
use lab::campaign::statistics::{FittedLine, Spread};
use lab::trials::experiment;
use lab::trials::trial::Recording;
use protocol::capsule::ActuationKind;
use protocol::system::DeviceKind;
use report::html::Existing;
use report::html::campaign::{Written, report_folder, write};
use report::html::evaluation::{clampings, evaluate};

/// Three indentations, dry and lubricated, twice each, and a fold test: 14 trials.
pub(crate) const PLAN: &str = r#"
format = 1
name = "small"
seed = 3
[metadata]
operator = "A. <Person> & Co"
specimen = "none"
silicone = "none"
soap = "none"
camera = "none"
caliper = "none"
caliper_resolution_mm = 0.01
[run]
cycles = 2
stroke_mm = 5
duration_s = 3
telemetry_ms = 50
[readings]
count = 2
spread_mm = 0.5
[[indentation]]
name = "a1"
[[indentation]]
name = "a2"
[[indentation]]
name = "a3"
[series]
lubrication = ["lubricated", "dry"]
indentation = ["a1", "a2", "a3"]
repeats = 2
[fold_test]
lubrication = "lubricated"
indentation = "a3"
repeats = 1
"#;

/// Displacement of a trial of this campaign, um. No two are equal, and they are not on a line.
fn displacement_um(trial: u32) -> i64 {
    let trial = i64::from(trial);
    2_000 + 731 * trial - 1_900 * (trial % 3) - 61 * trial * trial
}

struct Clock(i64);

impl Clock {
    fn now(&mut self) -> Timestamp {
        self.0 += 1;
        Timestamp::from_second(1_769_000_000 + self.0).expect("a time")
    }
}

/// Adds a row of a board to the ledger.
fn add(folder: &mut Folder, clock: &mut Clock, row: LedgerRow) {
    let added = folder.append(row, clock.now(), Origin::Board);
    added.expect("written");
}

/// The same for a row of the readings.
fn add_reading(folder: &mut Folder, clock: &mut Clock, row: ReadingRow) {
    let added = folder.append_reading(row, clock.now(), Origin::Board);
    added.expect("written");
}

/// A set of readings, which is accepted.
fn read(folder: &mut Folder, clock: &mut Clock, set: u32, name: Option<&str>, values: &[&str]) {
    for (number, value) in (1..).zip(values) {
        add_reading(folder, clock, reading(set, name, number, value));
    }
    add_reading(folder, clock, accepted(&reading(set, name, 1, "1")));
}

/// Ends the present clamping, as `clamp` at the prompt does.
fn clamped_anew(folder: &mut Folder, clock: &mut Clock) {
    let last = folder.campaign().reading_rows.last().expect("accepted");
    let row = ReadingRow {
        event: Kind::Discarded,
        text: Some("clamped again".to_owned()),
        ..last.clone()
    };
    add_reading(folder, clock, row);
    assert_eq!(folder.campaign().readings.clamped(), None);
}

/// A record of an attempt.
fn record(
    folder: &Folder,
    clock: &mut Clock,
    planned: &Planned,
    attempt: u32,
    stem: &str,
) -> Recording {
    Recording {
        folder: folder.campaign().attempt_folder(planned.trial, attempt),
        stem: stem.to_owned(),
        now: clock.now(),
        note: None,
        telemetry_ms: 50,
    }
}

/// All trials but the last are done. Trial 2 needed two attempts, trial 5 is excluded.
fn campaign(path: &Path) -> Folder {
    let mut folder = Folder::create(path, PLAN, Path::new("small.toml")).expect("made");
    let mut clock = Clock(0);
    read(&mut folder, &mut clock, 1, None, &["24.40", "24.38"]);
    let (mut rig, mut capsule) = (device(DeviceKind::Rig), device(DeviceKind::Capsule));
    let order = folder.campaign().order.clone();
    let (mut set, mut block) = (1, 0);
    for planned in &order[..order.len() - 1] {
        if planned.block != block {
            block = planned.block;
            set += 1;
            let (name, values) = match planned.indentation.as_str() {
                "a1" => ("a1", ["22.40", "22.42"]),
                "a2" => ("a2", ["18.41", "18.39"]),
                _ => ("a3", ["14.30", "14.31"]),
            };
            read(&mut folder, &mut clock, set, Some(name), &values);
            if block == 2 {
                clamped_anew(&mut folder, &mut clock);
                set += 1;
                read(&mut folder, &mut clock, set, Some(name), &values);
            }
        }
        let last = if planned.trial == 2 { 2 } else { 1 };
        for attempt in 1..=last {
            let readings = &folder.campaign().readings;
            let a_mm = readings
                .clamped()
                .and_then(|set| readings.indentation_mm(set));
            let mut row = LedgerRow::of(LedgerEvent::Began, planned.trial, Some(attempt));
            row.readings_set = Some(set);
            row.indentation_mm = a_mm.map(|a| Millimetres::from_um((a * 1e3).round() as i64));
            add(&mut folder, &mut clock, row);
            let recording =
                |stem, clock: &mut Clock| record(&folder, clock, planned, attempt, stem);
            if planned.shape == Form::Folded {
                let recording = recording("fold", &mut clock);
                let kind = ActuationKind::Fold;
                experiment::actuate(&mut capsule, kind, &recording, &mut Unobserved).expect("fold");
            }
            let run = folder.campaign().plan.run;
            let recording = recording("run", &mut clock);
            experiment::run(&mut rig, run, &recording, &mut Unobserved).expect("run");
            let mut row = LedgerRow::of(LedgerEvent::Ended, planned.trial, Some(attempt));
            row.outcome = Some(match attempt == last {
                true => AttemptOutcome::Complete,
                false => AttemptOutcome::Stopped,
            });
            add(&mut folder, &mut clock, row);
            let sealed = folder.seal_attempt(planned.trial, attempt);
            sealed.expect("written");
        }
        if planned.shape == Form::Folded {
            // The capsule is unfolded once the body has been measured: long after the attempt has ended.
            clock.0 += 60;
            let recording = record(&folder, &mut clock, planned, last, "unfold");
            let kind = ActuationKind::Unfold;
            experiment::actuate(&mut capsule, kind, &recording, &mut Unobserved).expect("unfold");
            folder.seal_attempt(planned.trial, last).expect("written");
        }
        let mut row = LedgerRow::of(LedgerEvent::Displacement, planned.trial, Some(last));
        row.displacement_mm = Some(Millimetres::from_um(displacement_um(planned.trial)));
        row.source = Some(Source::Measured);
        add(&mut folder, &mut clock, row);
    }
    let why = Some("the tail was <caught>".to_owned());
    let row = LedgerRow::of(LedgerEvent::Excluded, 5, Some(1)).saying(why);
    add(&mut folder, &mut clock, row);
    folder.seal().expect("written");
    folder
}

/// A copy of the campaign for each test.
pub(crate) fn made() -> (tempfile::TempDir, PathBuf) {
    static MADE: OnceLock<PathBuf> = OnceLock::new();
    let made = MADE.get_or_init(|| {
        let made = Path::new(env!("CARGO_TARGET_TMPDIR")).join("campaign-report");
        // Remove the folder of an earlier test run.
        let _ = fs::remove_dir_all(&made);
        drop(campaign(&made));
        made
    });
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    copy(made, &path);
    (place, path)
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("a folder");
    for entry in fs::read_dir(from).expect("a folder").flatten() {
        let to = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &to);
        } else {
            fs::copy(entry.path(), to).expect("copied");
        }
    }
}

/// The telemetry of trial 3.
fn telemetry_of(path: &Path) -> PathBuf {
    let row = &evaluate(path).expect("a campaign").trials[2];
    path.join(row.telemetry.as_ref().expect("a run"))
}

fn page(written: &Written) -> String {
    fs::read_to_string(&written.page).expect("a page")
}

#[test]
fn a_campaign_becomes_a_page_figures_and_tables() {
    let (_place, path) = made();
    let written = write(&path, Existing::Keep).expect("written");
    assert_eq!(written.findings, Vec::<String>::new());
    assert_eq!((written.planned, written.counted), (14, 12));
    let why = |trial| {
        let omitted = written
            .omitted
            .iter()
            .find(|(omitted, _)| *omitted == trial);
        omitted.map(|(_, why)| why.as_str()).unwrap_or_default()
    };
    assert_eq!(why(5), "excluded: the tail was <caught>");
    assert_eq!(why(14), "not done yet");
    let wanted = "figure7.svg figure7-wide.svg figure8.svg figure8-wide.svg trials.csv attempts.csv conditions.csv lines.csv readings.csv report.html";
    let wanted = wanted
        .split(' ')
        .map(|name| report_folder(&path).join(name));
    assert!(
        written.files.iter().cloned().eq(wanted),
        "{:?}",
        written.files
    );
    let html = page(&written);
    assert!(html.contains("A. &lt;Person&gt; &amp; Co") && html.contains("&lt;caught&gt;"));
    assert!(!html.contains("<script") && !html.contains("src=") && !html.contains("http-equiv"));
    assert!(!html.contains("class=\"banner\""), "measured and verified");
    // The campaign's two figures, narrow and wide, and one for each run.
    assert_eq!(html.matches("<svg").count(), 4 + 13);
    // The report's own files must not count as a change of the campaign.
    assert_eq!(
        write(&path, Existing::Replace).expect("again").findings,
        Vec::<String>::new()
    );
    let error = write(&path, Existing::Keep).expect_err("there");
    assert!(error.to_string().contains("is there already"), "{error}");
}

/// Regression: each trial to come had a line of its own.
#[test]
fn a_campaign_that_has_not_begun_has_a_report_without_figures() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    drop(Folder::create(&path, PLAN, Path::new("small.toml")).expect("made"));
    fs::create_dir(report_folder(&path)).expect("a folder");
    let stale = report_folder(&path).join("figure7.svg");
    fs::write(&stale, "of trials that no longer count").expect("written");
    let (code, _, err) = retrograde(&["report", offline::text(&path)]);
    assert_eq!(code, 0, "{err}");
    assert_eq!(err.trim(), "trials 1 to 14 do not count: not done yet");
    assert!(!stale.exists());
    let html = fs::read_to_string(report_folder(&path).join("report.html")).expect("a page");
    assert!(!html.contains("<svg") && html.contains("No trial of the series counts yet"));
    assert!(html.contains("ORIGIN UNKNOWN"));
    let row = "<td>1 to 14</td><td>14 trials</td><td>not done yet</td>";
    assert_eq!(html.matches("not done yet").count(), 1);
    assert!(html.contains(row), "{html}");
}

/// It said 0.0000, as if the caliper had shown the same twice.
#[test]
fn one_reading_has_no_standard_deviation() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    let plan = PLAN.replace("count = 2", "count = 1");
    let mut folder = Folder::create(&path, &plan, Path::new("small.toml")).expect("made");
    read(&mut folder, &mut Clock(0), 1, None, &["24.40"]);
    drop(folder);
    let html = page(&write(&path, Existing::Keep).expect("written"));
    let table = fs::read_to_string(report_folder(&path).join("readings.csv")).expect("a table");
    let row = table.lines().nth(1);
    assert_eq!(row, Some("1,width,,1,24.4000,,0,,board"), "{table}");
    assert!(!html.contains("readings/1/sd_mm"), "{html}");
    assert!(html.contains("data-is=\"readings/1/n\">1<"), "{html}");
    // Without Python there is no independent program to compare with.
    if let Some(output) = check_report(&path) {
        assert!(output.status.success(), "{output:?}");
    }
}

/// Starts the program in Python that recalculates a report; none without Python.
fn check_report(path: &Path) -> Option<Output> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let script = root.join("docs/examples/check_report.py");
    let mut python = Command::new("python3");
    python.env("PYTHONDONTWRITEBYTECODE", "1");
    python.env("PYTHONPATH", root.join("python/src"));
    python.arg(script).arg(path).output().ok()
}

/// Means and lines use only the trials that count.
#[test]
fn the_numbers_are_those_of_the_trials_that_count() {
    let (_place, path) = made();
    let evaluation = evaluate(&path).expect("a campaign");
    let order = Campaign::read(&path).expect("a campaign").order;
    for row in &evaluation.conditions {
        let of_it = |planned: &&Planned| {
            (planned.purpose, planned.lubrication, planned.shape)
                == (row.purpose, row.lubrication, row.shape)
                && planned.indentation == row.indentation
        };
        let all: Vec<_> = order.iter().filter(of_it).collect();
        let values: Vec<f64> = all
            .iter()
            .filter(|planned| ![5, 14].contains(&planned.trial))
            .map(|planned| displacement_um(planned.trial) as f64)
            .collect();
        assert_eq!((row.planned, row.n), (all.len(), values.len()));
        let spread = Spread::of(&values);
        let mean_mm = spread.map(|spread| spread.mean / 1e3);
        assert_eq!(row.mean_mm.map(|mean| mean.0), mean_mm);
        let sd_um = spread.and_then(|spread| spread.sd);
        assert_eq!(row.sd_mm.map(|sd| sd.0), sd_um.map(|sd| sd / 1e3));
    }
    assert_eq!(evaluation.lines.len(), 2);
    for (row, line) in &evaluation.lines {
        let points = evaluation.points(TrialPurpose::Series, row.lubrication);
        assert_eq!(FittedLine::through(&clampings(&points)), Some(*line));
        assert!(points.len() >= 5 && row.n == points.len());
    }
    let a = ["a1", "a2", "a3"].map(|name| {
        let mut rows = evaluation.conditions.iter();
        let row = rows.find(|row| row.indentation == name);
        let a = row.and_then(|row| row.indentation_mm);
        a.expect("set").to_string()
    });
    // (24.39 - 22.41)/2, (24.39 - 18.40)/2, (24.39 - 14.305)/2 to the micrometre.
    assert_eq!(a, ["0.990", "2.995", "5.043"]);
    let excluded = &evaluation.trials[4];
    assert!(!excluded.counts && excluded.purpose == TrialPurpose::Series);
    for row in &evaluation.trials[..13] {
        let steps = [row.planned_steps, row.counted_steps];
        assert_eq!(steps, [Some(16_000); 2]);
        let deviation_mm = row.greatest_deviation_mm.expect("a plan").0;
        assert!(deviation_mm < 0.05, "trial {}: {deviation_mm}", row.trial);
        assert_eq!(row.telemetry_sha256.as_ref().map(String::len), Some(64));
    }
}

/// A fold that did not end makes no folded trial, whatever its run says.
#[test]
fn an_attempt_is_as_complete_as_all_its_records() {
    let (_place, path) = made();
    let folder = path.join("trials/013-1");
    let files = fs::read_dir(&folder).expect("there").count();
    assert_eq!(files, 6, "run, fold and unfold");
    for (stem, is_found) in [("fold-", true), ("run-", true), ("unfold-", false)] {
        let file = file_of(&folder, stem).expect("a record");
        let before = fs::read_to_string(&file).expect("there");
        let after = before.replace("\"status\": \"complete\"", "\"status\": \"stopped\"");
        assert_ne!(before, after);
        fs::write(&file, after).expect("written");
        relist(&path);
        let found = crate::campaign::findings(&path);
        let says = |found: &String| found.contains("completed, and") && found.contains(stem);
        assert_eq!(found.iter().any(says), is_found, "{stem}: {found:?}");
        fs::write(&file, before).expect("written");
    }
}

#[test]
fn a_trial_whose_record_was_changed_does_not_count_and_the_page_says_so() {
    let (_place, path) = made();
    let file = telemetry_of(&path);
    let text = fs::read_to_string(&file).expect("there");
    let half = text.len() / 2;
    fs::write(&file, &text[..half]).expect("cut");
    let written = write(&path, Existing::Keep).expect("written");
    assert_eq!(written.counted, 11);
    let (_, why) = written
        .omitted
        .iter()
        .find(|(trial, _)| *trial == 3)
        .expect("left out");
    assert!(why.contains("not as it was written"), "{why}");
    assert!(!written.findings.is_empty());
    let html = page(&written);
    assert!(html.contains("NOT AS IT WAS WRITTEN") && !html.contains("class=\"ok\">Verified"));
    // An edited displacement in the ledger is a finding, too.
    fs::write(&file, text).expect("as before");
    let ledger = path.join("trials.csv");
    let text = fs::read_to_string(&ledger).expect("there");
    let edited = text.replacen(",0.77,", ",0.78,", 1);
    assert_ne!(text, edited);
    fs::write(&ledger, edited).expect("edited");
    let written = write(&path, Existing::Replace).expect("written");
    assert!(page(&written).contains("NOT AS IT WAS WRITTEN"));
    // The exit code tells a script, but the page is written all the same.
    fs::remove_file(&written.page).expect("removed");
    let (code, _, err) = retrograde(&["report", offline::text(&path)]);
    assert_eq!(code, 1, "{err}");
    let told = err.contains("is written; findings of `verify`: ");
    assert!(told && err.contains("trials.csv"), "{err}");
    assert!(page(&written).contains("NOT AS IT WAS WRITTEN"));
}

/// The same campaign as written by the virtual bench.
#[test]
fn a_virtual_campaign_cannot_pass_as_a_measurement() {
    let (_place, path) = made();
    for name in manifest::contents(&path).expect("a folder").files {
        let file = path.join(name);
        let text = fs::read_to_string(&file).expect("text");
        let marked = text
            .replace(",board\n", ",virtual\n")
            .replace("\"origin\": \"board\"", "\"origin\": \"virtual\"")
            .replace(",measured,", ",model_with_scatter,");
        fs::write(&file, marked).expect("written");
    }
    let plan = path.join("plan.toml");
    let text = fs::read_to_string(&plan).expect("text");
    fs::write(&plan, text + "[virtual]\nscatter_mm = 0.25\nseed = 77\n").expect("written");
    relist(&path);
    let written = write(&path, Existing::Keep).expect("written");
    assert_eq!((written.findings.len(), written.counted), (0, 12));
    assert_eq!(written.origin, Origin::Virtual);
    let html = page(&written);
    for says in [
        "VIRTUAL: this campaign was simulated.",
        "standard deviation of 0.25 mm was added, seed 77",
    ] {
        assert!(html.contains(says), "{says}: {html}");
    }
    assert!(!html.contains("Origin: board") && !html.contains(">measured<"));
    for file in &written.files {
        let bytes = fs::read(file).expect("there");
        let text = String::from_utf8_lossy(&bytes);
        assert!(text.contains("virtual"), "{file:?}");
        if file.extension().is_some_and(|kind| kind == "csv") {
            let mut rows = text.lines().skip(1);
            assert!(rows.all(|row| row.ends_with(",virtual")), "{file:?}");
        }
    }
    // One run of another origin must not be counted with them.
    let sidecar = telemetry_of(&path).with_extension("json");
    let text = fs::read_to_string(&sidecar).expect("text");
    fs::write(&sidecar, text.replace("\"virtual\"", "\"board\"")).expect("written");
    relist(&path);
    let written = write(&path, Existing::Replace).expect("written");
    assert_eq!((written.counted, written.defects), (11, 1));
    // The exit code tells a script, too.
    let (code, _, err) = retrograde(&["report", offline::text(&path), "--force"]);
    assert_eq!(code, 1, "{err}");
    assert!(
        err.contains("trials whose records cannot be relied on: 1"),
        "{err}"
    );
}

/// Regression: a trial whose telemetry lacks its end was left out of the report, for a contradiction that is none, while
/// `campaign status` and `fit` counted it.
#[test]
fn a_trial_counts_although_its_telemetry_has_gaps() {
    let (_place, path) = made();
    let csv = telemetry_of(&path);
    let text = fs::read_to_string(&csv).expect("text");
    let rows: Vec<&str> = text.lines().collect();
    let kept = rows.len() - 20;
    fs::write(&csv, rows[..kept].join("\n") + "\n").expect("written");
    let sidecar = csv.with_extension("json");
    let text = fs::read_to_string(&sidecar).expect("text");
    let samples = |count: usize| format!("\"samples\": {count}");
    let fewer = text.replace(&samples(rows.len() - 1), &samples(kept - 1));
    assert_ne!(fewer, text);
    fs::write(&sidecar, fewer).expect("written");
    relist(&path);
    let written = write(&path, Existing::Keep).expect("written");
    assert_eq!(written.findings, Vec::<String>::new());
    assert_eq!((written.counted, written.defects), (12, 0));
    let html = page(&written);
    assert!(html.contains("complete; a part of the telemetry is missing"));
    assert!(html.contains("before the motion") && !html.contains("contradicts itself"));
}

#[test]
fn the_command_says_what_it_wrote_and_what_does_not_count() {
    let (_place, path) = made();
    let at = offline::text(&path);
    let (code, out, err) = retrograde(&["report", at]);
    assert_eq!(code, 0, "{err}");
    assert!(
        out.starts_with("12 of 14 trials count; origin board"),
        "{out}"
    );
    assert!(err.contains("trial 5 does not count: excluded"), "{err}");
    let (code, _, err) = retrograde(&["report", at]);
    assert_eq!(code, 1, "{err}");
    assert!(err.contains("--force"), "{err}");
    let (code, out, _) = retrograde(&["--json", "report", at, "--force"]);
    let json: serde_json::Value = serde_json::from_str(&out).expect("one object");
    assert_eq!((code, &json["counted"]), (0, &12.into()));
    for wrong in [&["report", at, at][..], &["report", at, "--out", "x.html"]] {
        let (code, _, err) = retrograde(wrong);
        assert_eq!(code, 2, "{err}");
        assert!(err.contains("is a campaign"), "{err}");
    }
}

/// An independent program in another language recalculates every number of the page from the campaign's files.
#[test]
fn every_number_of_the_page_is_worked_out_again() {
    let (_place, path) = made();
    write(&path, Existing::Keep).expect("written");
    let Some(output) = check_report(&path) else {
        // Without Python there is no independent program to compare with.
        return;
    };
    let said = String::from_utf8_lossy(&output.stdout).into_owned()
        + &String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let count = said.split(' ').next().and_then(|n| n.parse::<u32>().ok());
    assert!(count > Some(200), "{said}");
    // Make sure that the check can fail: change a line, expect a deviation.
    let page = report_folder(&path).join("report.html");
    let html = fs::read_to_string(&page).expect("a page");
    for key in ["/r_squared\">", "/greatest_deviation_mm\">"] {
        let at = html.find(key).expect(key) + key.len();
        let mut wrong = html.clone();
        let digit = if html[at..].starts_with('7') {
            "8"
        } else {
            "7"
        };
        wrong.replace_range(at..=at, digit);
        fs::write(&page, wrong).expect("edited");
        let output = check_report(&path).expect("as before");
        assert!(!output.status.success(), "{key}");
    }
}

/// Every colour that a drawing of the report has must have one for dark pages.
#[test]
fn every_colour_of_a_figure_changes_on_a_dark_page() {
    let (_place, path) = made();
    let written = write(&path, Existing::Keep).expect("written");
    let text = page(&written);
    let (style, body) = text.split_once("</style>").expect("a style");
    let mut count = 0;
    for kind in ["fill", "stroke"] {
        for part in body.split(&format!(" {kind}=\"#")).skip(1) {
            let rule = format!("svg [{kind}='#{}' i]", &part[..6]);
            assert!(style.contains(&rule), "{rule}");
            count += 1;
        }
    }
    assert!(count > 100, "{count}");
}

/// Horizontal positions of an SVG's marks of this colour, without the one in the legend, which is the first.
fn marks(svg: &str, colour: &str) -> BTreeSet<String> {
    let tags = svg.split("<circle ").skip(1);
    let tags = tags.filter_map(|rest| rest.split('>').next());
    let of_colour = tags.filter(|tag| tag.contains(colour)).skip(1);
    let sideways = of_colour.filter_map(|tag| tag.split("cx=\"").nth(1)?.split('"').next());
    sideways.map(str::to_owned).collect()
}

/// An x coordinate of an SVG as a number of its axis, by the numbers below the plot.
fn on_axis(svg: &str, x: f64) -> f64 {
    let attribute = |tag: &str, name: &str| {
        let rest = tag.split(&format!(" {name}=\"")).nth(1)?;
        rest.split('"').next()?.parse::<f64>().ok()
    };
    let parts = svg.split("<text").skip(1);
    let ticks = parts.filter_map(|part| {
        let (tag, text) = part.split_once('>')?;
        let number: f64 = text.split_once('<')?.0.trim().parse().ok()?;
        Some((attribute(tag, "y")?, attribute(tag, "x")?, number))
    });
    let ticks: Vec<_> = ticks.collect();
    let lowest = ticks.iter().map(|tick| tick.0).fold(f64::MIN, f64::max);
    let below: Vec<_> = ticks.iter().filter(|tick| tick.0 == lowest).collect();
    let (_, x0, from) = below[0];
    let (_, x1, to) = below[below.len() - 1];
    assert!(x1 > x0, "{ticks:?}");
    from + (to - from) * (x - x0) / (x1 - x0)
}

#[test]
fn figure_7_shows_each_trial_at_its_indentation_within_its_plot() {
    let (_place, path) = made();
    write(&path, Existing::Keep).expect("written");
    let read = |name: &str| fs::read_to_string(report_folder(&path).join(name)).expect(name);
    for (name, width) in [("figure7.svg", "85.0mm"), ("figure7-wide.svg", "170.0mm")] {
        let svg = read(name);
        assert!(
            svg.starts_with(&format!("<svg width=\"{width}\"")),
            "{name}"
        );
        for (colour, is_open) in [("#C06A10", false), ("#1F5AA8", true)] {
            let at: Vec<_> = (marks(&svg, colour).iter())
                .map(|x| on_axis(&svg, x.parse().expect("a number")))
                .collect();
            for a_mm in [0.99, 2.995] {
                let is_there = at.iter().any(|x| (x - a_mm).abs() < 0.02);
                assert!(is_there, "{name}, {colour}, {a_mm}: {at:?}");
            }
            let mut tags = svg.split("<circle ").filter(|tag| tag.contains(colour));
            assert_eq!(
                tags.all(|tag| tag.contains("fill=\"none\"")),
                is_open,
                "{name}, {colour}"
            );
        }
    }
    let page = read("report.html");
    assert!(page.contains("residual / µm") && !page.contains("/ um"));
    // The caption names the line that is drawn: that of the clampings, as in the table.
    let caption = page.split("<figcaption>").nth(1).expect("a caption");
    let caption = caption.split("</figcaption>").next().expect("its end");
    assert!(
        caption.contains("least squares through the means of the clampings")
            && !caption.contains("through all dots"),
        "{caption}"
    );
}

/// A telephone shows 102 trials as 102 lines, and paper none of them, unless the reader opens them.
#[test]
fn trials_are_folded_unless_they_do_not_count() {
    let (_place, path) = made();
    write(&path, Existing::Keep).expect("written");
    let page = fs::read_to_string(report_folder(&path).join("report.html")).expect("a page");
    let trials: Vec<_> = page.split("<details class=\"trial\"").skip(1).collect();
    assert_eq!(trials.len(), 13);
    for (trial, number) in trials.into_iter().zip(1..) {
        let (head, rest) = trial.split_once("<summary>").expect("a summary");
        assert_eq!(
            head.contains("open"),
            number == 5,
            "trial 5 is excluded: {number} {head}"
        );
        // The link in the table leads into the folded part, which browsers then open.
        let (_, folded) = rest.split_once("</summary>").expect("its end");
        assert!(
            folded.contains(&format!("id=\"trial-{number}\"")),
            "{number}"
        );
    }
    let (_, files) = page
        .split_once("files, with their SHA-256</summary>")
        .expect("folded");
    assert!(files.contains("plan.toml"));
    assert!(
        page.contains("details:not([open]){display:none}"),
        "on paper"
    );
}

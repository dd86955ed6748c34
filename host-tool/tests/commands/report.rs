//! The report tells contradictory records from intact ones, lists what it leaves out, and replaces no file unasked.

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::tool::{Memory, device};
use client::{Device, Unobserved};
use jiff::Timestamp;
use lab::trials::experiment::{self, PAPER_RUN};
use lab::trials::trial::Recording;
use protocol::capsule::ActuationKind;
use protocol::rig::{Run, RunTiming};
use protocol::system::DeviceKind;
use report::html::{self, Damaged, Existing, Found};
use simulated_machines::machine::{Script, link};

const RUN: Run = Run {
    cycles: 2,
    stroke_um: 10_000,
    timing: RunTiming::Total {
        total_us: 4_000_000,
        accel_um_s2: 100_000,
    },
    ..PAPER_RUN
};

fn recording(folder: &Path, stem: &str) -> Recording {
    Recording {
        folder: folder.to_owned(),
        stem: stem.to_owned(),
        now: Timestamp::UNIX_EPOCH,
        note: None,
        telemetry_ms: 20,
    }
}

/// Sidecars of a run and a fold in a folder.
fn trials(folder: &Path) -> [PathBuf; 2] {
    let mut rig = device(DeviceKind::Rig);
    let run = experiment::run(&mut rig, RUN, &recording(folder, "run"), &mut Unobserved);
    let mut capsule = device(DeviceKind::Capsule);
    let kind = ActuationKind::Fold;
    let fold = experiment::actuate(
        &mut capsule,
        kind,
        &recording(folder, "fold"),
        &mut Unobserved,
    );
    [run.expect("run").sidecar, fold.expect("fold").sidecar]
}

fn found(sidecar: &Path) -> Found {
    Found {
        sidecars: vec![sidecar.to_owned()],
        left_out: vec![],
    }
}

/// Makes a change, runs the report, and takes the change back.
fn damage(file: &Path, sidecar: &Path, change: &dyn Fn(&str) -> String) -> (String, Vec<Damaged>) {
    let before = fs::read_to_string(file).expect("there");
    let after = change(&before);
    assert_ne!(before, after, "the change changes something");
    fs::write(file, after).expect("changed");
    let report = html::html(&found(sidecar), &[]).expect("a page");
    fs::write(file, before).expect("as before");
    (report.html, report.damaged)
}

/// Changes the rows of a CSV file between its heading and its end.
fn rows(text: &str, change: impl FnOnce(&mut Vec<&str>)) -> String {
    let mut lines: Vec<&str> = text.lines().collect();
    let heading = lines.remove(0);
    change(&mut lines);
    lines.insert(0, heading);
    lines.join("\n") + "\n"
}

/// Text with another value in this row and column.
fn with_value(text: &str, row: usize, column: &str, value: &str) -> String {
    let place = text.lines().next().expect("heading");
    let place = place.split(',').position(|name| name == column);
    let place = place.expect("a column");
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    let mut cells: Vec<&str> = lines[row].split(',').collect();
    cells[place] = value;
    lines[row] = cells.join(",");
    lines.join("\n") + "\n"
}

/// The sidecar with another value at this pointer.
fn with_json(text: &str, pointer: &str, value: serde_json::Value) -> String {
    let mut json: serde_json::Value = serde_json::from_str(text).expect("JSON");
    *json.pointer_mut(pointer).expect("a value") = value;
    json.to_string()
}

type Change<'a> = (&'a str, &'a dyn Fn(&str) -> String, &'a str);

/// Changes that leave the record of the motion true.
const GAPS: [&str; 3] = ["another end", "its thread", "its duration"];

fn expect_damage(sidecar: &Path, in_csv: &[Change<'_>], in_json: &[Change<'_>]) {
    let clean = html::html(&found(sidecar), &[]).expect("a page");
    assert_eq!(clean.damaged, []);
    assert!(clean.html.contains("<span class=\"ok\">complete</span>"));
    let csv = sidecar.with_extension("csv");
    let files = [(csv.as_path(), in_csv), (sidecar, in_json)];
    for (file, changes) in files {
        for (name, change, wanted) in changes {
            let (html, damaged) = damage(file, sidecar, change);
            let told = damaged
                .first()
                .map(|damaged| damaged.defects.join("; "))
                .unwrap_or_default();
            assert!(told.contains(wanted), "{name}: {told:?}");
            assert!(html.contains("<ul class=\"bad\">"), "{name}");
            assert!(
                !html.contains("<span class=\"ok\">"),
                "{name}: nothing is green"
            );
            let said = match GAPS.contains(name) {
                true => "a part of the telemetry is missing",
                false => "the record contradicts itself",
            };
            assert!(html.contains(said), "{name}");
        }
    }
}

#[test]
fn a_damaged_run_is_red_with_the_reason() {
    let folder = tempfile::tempdir().expect("folder");
    let [sidecar, _] = trials(folder.path());
    let executed = |name: &'static str, value: u64| {
        move |text: &str| with_json(text, &format!("/action/executed/{name}"), value.into())
    };
    expect_damage(
        &sidecar,
        &[
            (
                "a tenth",
                &|text| rows(text, |rows| rows.truncate(rows.len() / 10)),
                "before the motion",
            ),
            (
                "its middle",
                &|text| rows(text, |rows| drop(rows.drain(80..90))),
                "gaps",
            ),
            ("empty", &|_| String::new(), "is empty"),
            (
                "only the heading",
                &|text| rows(text, |rows| rows.truncate(0)),
                "is empty",
            ),
            (
                "reversed",
                &|text| rows(text, |rows| rows.reverse()),
                "time does not go on",
            ),
            (
                "two rows exchanged",
                &|text| rows(text, |rows| rows.swap(50, 51)),
                "time does not go on",
            ),
            (
                "NaN",
                &|text| with_value(text, 100, "position_mm", "NaN"),
                "position_mm is `NaN`",
            ),
            (
                "a speed without end",
                &|text| with_value(text, 100, "speed_mm_s", "inf"),
                "speed_mm_s is `inf`",
            ),
            (
                "another position",
                &|text| with_value(text, 100, "position_mm", "1.5"),
                "position_mm is 1.5",
            ),
            (
                "text for a number",
                &|text| with_value(text, 100, "position_steps", "many"),
                "row 100",
            ),
            (
                "a loss",
                &|text| with_value(text, 100, "missed", "3"),
                "3 samples were lost",
            ),
            (
                "another origin",
                &|text| text.replace(",board", ",virtual"),
                "of origin virtual",
            ),
            (
                "a cut row",
                &|text| text[..text.len() - 12].to_owned(),
                "cannot be read",
            ),
        ],
        &[
            (
                "counted",
                &executed("counted_edges", 31_999),
                "31999 were seen",
            ),
            (
                "commanded",
                &executed("commanded_edges", 31_999),
                "31999 of 32000",
            ),
            ("strokes", &executed("strokes", 3), "3 of 4 strokes"),
            ("ticks", &executed("ticks", 399_999_999), "it took"),
            ("most", &executed("max_steps", 7_000), "0 to 7000"),
            (
                "samples",
                &|text| with_json(text, "/samples", 7.into()),
                "7 were recorded",
            ),
            (
                "the stroke",
                &|text| with_json(text, "/action/requested/stroke_um", 20_000.into()),
                "20 mm were asked for",
            ),
            (
                "a stop",
                &|text| with_json(text, "/action/executed/outcome", "stopped".into()),
                "status differ",
            ),
            (
                "an event",
                &|text| with_json(text, "/events/1/index", 77.into()),
                "event 77 follows",
            ),
            (
                "the name of the telemetry",
                &|text| with_json(text, "/telemetry", "other.csv".into()),
                "cannot be read",
            ),
        ],
    );
}

/// All counts of a record, edited alike, contradict the telemetry.
#[test]
fn counts_that_agree_with_each_other_must_agree_with_the_telemetry() {
    let folder = tempfile::tempdir().expect("folder");
    let [sidecar, _] = trials(folder.path());
    for (edges, wanted) in [(64_000, "reversals hide"), (31_000, "goes")] {
        let all = |text: &str| {
            let places = [
                "executed/counted_edges",
                "executed/commanded_edges",
                "achieved/edges",
            ];
            places.iter().fold(text.to_owned(), |text, place| {
                with_json(&text, &format!("/action/{place}"), edges.into())
            })
        };
        let (_, damaged) = damage(&sidecar, &sidecar, &all);
        let told = damaged[0].defects.join("; ");
        assert!(told.contains(wanted), "{told}");
    }
}

#[test]
fn a_damaged_fold_is_red_with_the_reason() {
    let folder = tempfile::tempdir().expect("folder");
    let [_, sidecar] = trials(folder.path());
    let record = |name: &'static str, value: u32| {
        move |text: &str| with_json(text, &format!("/action/record/{name}"), value.into())
    };
    expect_damage(
        &sidecar,
        &[
            (
                "a tenth",
                &|text| rows(text, |rows| rows.truncate(rows.len() / 10)),
                "before the motion",
            ),
            (
                "without its beginning",
                &|text| rows(text, |rows| drop(rows.drain(..20))),
                "after the motion",
            ),
            (
                "reversed",
                &|text| rows(text, |rows| rows.reverse()),
                "time does not go on",
            ),
            (
                "another end",
                &|text| {
                    let row = text.lines().count() - 1;
                    with_value(text, row, "thread_um", "12")
                },
                "ends at 0.012 mm of thread",
            ),
        ],
        &[
            (
                "its thread",
                &record("thread_um", 12),
                "the record says 0.012 mm",
            ),
            (
                "its current",
                &record("peak_current_ma", 1),
                "above the largest",
            ),
            (
                "its duration",
                &record("duration_ms", 9_000),
                "before the motion",
            ),
            ("its number", &record("actuation", 77), "another actuation"),
        ],
    );
}

#[test]
fn what_is_left_out_is_listed_with_the_reason() {
    let folder = tempfile::tempdir().expect("folder");
    let [run, fold] = trials(folder.path());
    let at = |name: &str| folder.path().join(name);
    fs::rename(&fold, at("my-fold.json")).expect("renamed");
    fs::write(at("broken.json"), "{ \"format\": 1").expect("written");
    fs::write(at("broken.csv"), "").expect("written");
    fs::write(at("run.json.part"), "").expect("written");
    let script = Script {
        running: Some((RUN, 5_000_000)),
        ..Script::new(DeviceKind::Rig)
    };
    let mut rig = Device::connect(link(script).0, DeviceKind::Rig, 1).expect("a rig");
    let fetched = lab::trials::fetched::fetch(&mut rig, Timestamp::UNIX_EPOCH);
    let fetched = fetched.expect("answers").expect("a run");
    let fetched = fetched.write(folder.path()).expect("written");
    let found = html::find(&[folder.path().to_owned()]).expect("a folder");
    assert_eq!(found.sidecars, [run]);
    let why = |name: &str| {
        let left = found.left_out.iter().find(|left| left.path.ends_with(name));
        left.map(|left| left.why.clone()).unwrap_or_default()
    };
    assert!(why("my-fold.json").contains("it was renamed"));
    let telemetry = fold.with_extension("csv");
    let telemetry = telemetry.file_name().expect("a name").to_string_lossy();
    assert!(why(&telemetry).contains("no sidecar"));
    assert!(why("broken.json").contains("EOF"), "{found:?}");
    assert!(why("run.json.part").contains("cut off"));
    let fetched = fetched.file_name().expect("a name").to_string_lossy();
    assert!(why(&fetched).contains("fetched"), "{found:?}");
    assert_eq!(found.left_out.len(), 5, "{found:?}");
    let is_record = |name: &str| {
        let mut left = found.left_out.iter();
        left.any(|left| left.path.ends_with(name) && left.is_record)
    };
    assert!(
        ["my-fold.json", "broken.json", &telemetry]
            .into_iter()
            .all(is_record)
    );
    let others = ["run.json.part", &fetched];
    assert!(!others.into_iter().any(is_record));
    let html = html::html(&found, &[]).expect("a page").html;
    for left in &found.left_out {
        assert!(html.contains(&left.why.replace('"', "&quot;")), "{left}");
    }
}

#[test]
fn a_report_replaces_nothing_unasked_and_never_a_record() {
    let folder = tempfile::tempdir().expect("folder");
    let [run, _] = trials(folder.path());
    let out = folder.path().join("report.html");
    fs::write(&out, "mine").expect("written");
    let memory = Memory::with(vec![]);
    let at = |path: &Path| path.to_str().expect("UTF-8").to_owned();
    let (run_at, out_at) = (at(&run), at(&out));
    let (code, _, err) = memory.run(&["report", &run_at, "--out", &out_at]);
    assert_eq!(code, 1, "{err}");
    assert!(
        err.contains("is there already") && err.contains("--force"),
        "{err}"
    );
    assert_eq!(fs::read_to_string(&out).expect("there"), "mine");
    let (code, text, err) = memory.run(&["report", &run_at, "--out", &out_at, "--force"]);
    assert_eq!((code, err.as_str()), (0, ""), "{text}");
    let html = fs::read_to_string(&out).expect("there");
    assert!(html.starts_with("<!DOCTYPE html>"));
    // The page loads nothing from elsewhere, and no partial file is left.
    assert!(!html.contains("<script") && !html.contains("src=") && !html.contains("@import"));
    assert!(!folder.path().join("report.html.part").exists());
    for own in [run.clone(), run.with_extension("csv")] {
        let error = html::write(&found(&run), &[], &own, Existing::Replace).expect_err("own");
        assert!(error.to_string().contains("one of the records"), "{error}");
    }
    // The terminal reports a damaged record, too.
    fs::write(run.with_extension("csv"), "").expect("emptied");
    let (code, _, err) = memory.run(&["report", &run_at, "--out", &out_at, "--force"]);
    assert_eq!(code, 1);
    assert!(
        err.contains("damaged: ") && err.contains("is empty"),
        "{err}"
    );
    let said = "is written; trials that contradict themselves: 1, records left out: 0";
    assert!(err.contains(said), "{err}");
    assert!(
        fs::read_to_string(&out)
            .expect("there")
            .contains("is empty")
    );
    let (code, json, _) = memory.run(&["--json", "report", &run_at, "--out", &out_at, "--force"]);
    assert_eq!(code, 1);
    for part in ["\"ok\": false", "\"damaged\"", "retrograde::report_defects"] {
        assert!(json.contains(part), "{part}: {json}");
    }
}

/// A report is a file, and that of a campaign has one place: another folder of records is no remedy.
#[test]
fn a_report_that_cannot_be_written_says_what_helps() {
    let folder = tempfile::tempdir().expect("folder");
    let [run, _] = trials(folder.path());
    let text = |path: &Path| path.to_str().expect("UTF-8").to_owned();
    let (run, study) = (text(&run), text(&folder.path().join("study")));
    let tool = Memory::with(vec![]);
    let plan = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/paper.toml");
    let (code, _, err) = tool.run(&["campaign", "new", plan, "--out", &study]);
    assert_eq!(code, 0, "{err}");
    // A file stands where a folder has to be made.
    fs::write(folder.path().join("study/report"), "").expect("written");
    let within = format!("{run}/page.html");
    for args in [&["report", &run, "--out", &within][..], &["report", &study]] {
        let (code, _, err) = tool.run(args);
        assert_eq!(code, 1, "{err}");
        assert!(!err.contains("--out DIR"), "{err}");
        assert!(err.contains("folder that can be written"), "{err}");
    }
}

#[test]
fn a_virtual_run_cannot_pass_as_a_measurement() {
    let folder = tempfile::tempdir().expect("folder");
    let [run, fold] = trials(folder.path());
    let page = |sidecars: &[&PathBuf]| {
        let found = Found {
            sidecars: sidecars.iter().map(|path| (*path).clone()).collect(),
            left_out: vec![],
        };
        html::html(&found, &[]).expect("a page").html
    };
    let measured = page(&[&run, &fold]);
    assert!(!measured.contains("class=\"banner\""));
    assert_eq!(measured.matches("Origin: board: measured").count(), 4);
    // As the bench's firmware identifies itself.
    let text = fs::read_to_string(&run).expect("there");
    let text = text.replace(&"ab".repeat(12), "7669727475616c2072696700");
    fs::write(&run, text).expect("written");
    let html = page(&[&run, &fold]);
    assert!(
        html.contains("VIRTUAL: 1 of 2 trials on this page"),
        "{html}"
    );
    assert_eq!(html.matches("Origin: virtual: simulated").count(), 2);
    assert!(html.contains("<span class=\"tag\">virtual</span>"));
}

#[test]
fn one_current_is_not_told_as_two() {
    let folder = tempfile::tempdir().expect("folder");
    let [_, fold] = trials(folder.path());
    let html = html::html(&found(&fold), &[]).expect("a page").html;
    let json: serde_json::Value =
        serde_json::from_slice(&fs::read(&fold).expect("there")).expect("JSON");
    let record = &json["action"]["record"];
    let mut reader = csv::Reader::from_path(fold.with_extension("csv")).expect("telemetry");
    let place = reader
        .headers()
        .expect("heading")
        .iter()
        .position(|name| name == "current_ma");
    let place = place.expect("a column");
    let largest = reader
        .records()
        .map(|row| row.expect("a row")[place].parse::<u16>().expect("a number"))
        .max()
        .expect("rows");
    for (name, value) in [
        (
            "largest current after the inrush, by the capsule",
            format!("{} mA", record["peak_current_ma"]),
        ),
        (
            "largest current in the telemetry, with the inrush",
            format!("{largest} mA"),
        ),
        ("energy of the motor", format!("{} mJ", record["energy_mj"])),
    ] {
        let row = format!("<tr><th>{name}</th><td>{value}</td></tr>");
        assert!(html.contains(&row), "{row}");
    }
    assert!(!html.contains(" J<"), "one unit of energy");
}

#[test]
fn a_refused_fold_has_no_empty_axes() {
    let folder = tempfile::tempdir().expect("folder");
    let mut capsule = Device::connect(
        link(Script::new(DeviceKind::Capsule)).0,
        DeviceKind::Capsule,
        1,
    )
    .expect("there");
    let kind = ActuationKind::Fold;
    let recording = recording(folder.path(), "fold");
    let refused = experiment::actuate(&mut capsule, kind, &recording, &mut Unobserved);
    refused.expect_err("not referenced");
    let sidecar = folder.path().join("fold-19700101T000000Z.json");
    let report = html::html(&found(&sidecar), &[]).expect("a page");
    assert_eq!(report.damaged, [], "it is as it says");
    assert!(!report.html.contains("<svg"));
    assert!(report.html.contains("No telemetry: no figure."));
}

/// It was said to be the first stroke's start, also of a run that began with a pause.
#[test]
fn a_report_says_where_time_begins_with_and_without_a_start_delay() {
    let folder = tempfile::tempdir().expect("folder");
    let recorded = |stem: &str, start_delay_us: u32| {
        let run = Run {
            start_delay_us,
            cycles: 1,
            ..RUN
        };
        let recording = recording(folder.path(), stem);
        let ran = experiment::run(
            &mut device(DeviceKind::Rig),
            run,
            &recording,
            &mut Unobserved,
        );
        ran.expect("run").sidecar
    };
    let said = |sidecar: &Path| {
        let html = html::html(&found(sidecar), &[]).expect("a page").html;
        let caption = html.split("<figcaption>").nth(1).expect("a caption");
        caption
            .split("</figcaption>")
            .next()
            .expect("its end")
            .to_owned()
    };
    let (at_once, later) = (recorded("at-once", 0), recorded("later", 1_500_000));
    let wanted = "Time 0 is the run's start; its first stroke begins";
    let text = said(&at_once);
    assert!(text.contains(&format!("{wanted} at once.")), "{text}");
    let text = said(&later);
    assert!(
        text.contains(&format!("{wanted} after its start delay, at 1.5 s.")),
        "{text}"
    );
    // A record that lost the event of its start does not say where the run began.
    let text = fs::read_to_string(&later).expect("there");
    let mut json: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    let events = json["events"].as_array_mut().expect("events");
    events.retain(|event| !event.to_string().contains("run_started"));
    fs::write(&later, json.to_string()).expect("written");
    let text = said(&later);
    assert!(text.contains("Time 0 is the first sample"), "{text}");
}

//! The report tells contradictory records from intact ones, lists what it leaves out, and replaces no file unasked.

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::plan::{SHORT_RUN, recording};
use crate::support::tool::{Memory, device};
use client::{Device, Unobserved};
use jiff::Timestamp;
use lab::trials::experiment;
use protocol::capsule::ActuationKind;
use protocol::rig::Run;
use protocol::system::DeviceKind;
use report::html::{self, Existing, Found};
use simulated_machines::machine::{Script, link};

/// Sidecars of a run and a fold in a folder.
fn trials(folder: &Path) -> [PathBuf; 2] {
    let mut rig = device(DeviceKind::Rig);
    let run = experiment::run(
        &mut rig,
        SHORT_RUN,
        &recording(folder, "run", 20),
        &mut Unobserved,
    );
    let mut capsule = device(DeviceKind::Capsule);
    let kind = ActuationKind::Fold;
    let fold = experiment::actuate(
        &mut capsule,
        kind,
        &recording(folder, "fold", 20),
        &mut Unobserved,
    );
    [run.expect("run").sidecar, fold.expect("fold").sidecar]
}

fn found(sidecar: &Path) -> Found {
    Found {
        sidecars: vec![sidecar.to_owned()],
        omitted: vec![],
    }
}

/// The records' own check has the table of all defects; the report shows them, a gap and a contradiction apart.
#[test]
fn a_damaged_record_is_red_with_the_reason() {
    let folder = tempfile::tempdir().expect("folder");
    let [run, fold] = trials(folder.path());
    let without = |text: &str, rows: std::ops::Range<usize>| {
        let mut lines: Vec<_> = text.lines().collect();
        drop(lines.drain(rows));
        lines.join("\n") + "\n"
    };
    let contradicts = "the record contradicts itself";
    let lacks = "a part of the telemetry is missing";
    type Change<'a> = &'a dyn Fn(&str) -> String;
    let seen = |text: &str| text.replace("\"counted_edges\": 32000", "\"counted_edges\": 31999");
    let longer = |text: &str| text.replace("\"duration_ms\": ", "\"duration_ms\": 9");
    let changes: [(&Path, &str, Change<'_>, &str, &str); 5] = [
        (&run, "csv", &|_| String::new(), "is empty", contradicts),
        (
            &run,
            "csv",
            &|text| without(text, 80..90),
            "gaps",
            contradicts,
        ),
        (
            &run,
            "csv",
            &|text| text.replace(",board", ",virtual"),
            "of origin virtual",
            contradicts,
        ),
        (&run, "json", &seen, "31999 were seen", contradicts),
        (&fold, "json", &longer, "before the motion", lacks),
    ];
    for (sidecar, extension, change, wanted, said) in changes {
        let clean = html::html(&found(sidecar), &[]).expect("a page");
        assert_eq!(clean.damaged, []);
        assert!(clean.html.contains("<span class=\"ok\">complete</span>"));
        let file = sidecar.with_extension(extension);
        let before = fs::read_to_string(&file).expect("there");
        fs::write(&file, change(&before)).expect("changed");
        let report = html::html(&found(sidecar), &[]).expect("a page");
        fs::write(&file, before).expect("as before");
        let told: Vec<_> = report
            .damaged
            .iter()
            .map(|damaged| damaged.defects.join("; "))
            .collect();
        assert!(
            told.iter().any(|told| told.contains(wanted)),
            "{wanted}: {told:?}"
        );
        assert!(report.html.contains("<ul class=\"bad\">"), "{wanted}");
        assert!(
            !report.html.contains("<span class=\"ok\">"),
            "{wanted}: nothing is green"
        );
        assert!(report.html.contains(said), "{wanted}");
    }
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
        running: Some((SHORT_RUN, 5_000_000)),
        ..Script::new(DeviceKind::Rig)
    };
    let mut rig = Device::connect(link(script).0, DeviceKind::Rig, 1).expect("a rig");
    let fetched = lab::trials::fetched::fetch(&mut rig, Timestamp::UNIX_EPOCH);
    let fetched = fetched.expect("answers").expect("a run");
    let fetched = fetched.write(folder.path()).expect("written");
    let found = html::find(&[folder.path().to_owned()]).expect("a folder");
    assert_eq!(found.sidecars, [run]);
    let why = |name: &str| {
        let omitted = found
            .omitted
            .iter()
            .find(|omitted| omitted.path.ends_with(name));
        omitted
            .map(|omitted| omitted.why.clone())
            .unwrap_or_default()
    };
    assert!(why("my-fold.json").contains("it was renamed"));
    let telemetry = fold.with_extension("csv");
    let telemetry = telemetry.file_name().expect("a name").to_string_lossy();
    assert!(why(&telemetry).contains("no sidecar"));
    assert!(why("broken.json").contains("EOF"), "{found:?}");
    assert!(why("run.json.part").contains("cut off"));
    let fetched = fetched.file_name().expect("a name").to_string_lossy();
    assert!(why(&fetched).contains("fetched"), "{found:?}");
    assert_eq!(found.omitted.len(), 5, "{found:?}");
    let is_record = |name: &str| {
        let mut omitted = found.omitted.iter();
        omitted.any(|omitted| omitted.path.ends_with(name) && omitted.is_record)
    };
    assert!(
        ["my-fold.json", "broken.json", &telemetry]
            .into_iter()
            .all(is_record)
    );
    let others = ["run.json.part", &fetched];
    assert!(!others.into_iter().any(is_record));
    let html = html::html(&found, &[]).expect("a page").html;
    for omitted in &found.omitted {
        assert!(
            html.contains(&omitted.why.replace('"', "&quot;")),
            "{omitted}"
        );
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
    let said =
        "is written; trials that contradict themselves or are incomplete: 1, records omitted: 0";
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
        assert!(
            err.contains("another path") || err.contains("permission"),
            "{err}"
        );
    }
}

#[test]
fn a_virtual_run_cannot_pass_as_a_measurement() {
    let folder = tempfile::tempdir().expect("folder");
    let [run, fold] = trials(folder.path());
    let page = |sidecars: &[&PathBuf]| {
        let found = Found {
            sidecars: sidecars.iter().map(|path| (*path).clone()).collect(),
            omitted: vec![],
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
fn a_refused_fold_has_no_empty_axes() {
    let folder = tempfile::tempdir().expect("folder");
    let mut capsule = Device::connect(
        link(Script::new(DeviceKind::Capsule)).0,
        DeviceKind::Capsule,
        1,
    )
    .expect("there");
    let kind = ActuationKind::Fold;
    let recording = recording(folder.path(), "fold", 20);
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
            ..SHORT_RUN
        };
        let recording = recording(folder.path(), stem, 20);
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

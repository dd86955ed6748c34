//! The command line: refusals before a byte is sent, exit codes, JSON, and commands against machines in memory.

use std::collections::BTreeSet;
use std::path::Path;

use crate::support::tool::{Memory, ready};
use assert_cmd::Command;
use protocol::capsule::KEPT_TRACE_POINTS;
use protocol::system::{DeviceKind, Urgent};
use serde_json::Value;
use simulated_machines::machine::capsule::FOLDED_UM;
use simulated_machines::machine::{Script, World, button, estop};

fn retrograde(args: &[&str]) -> (i32, String, String) {
    let output = Command::cargo_bin("retrograde")
        .expect("built")
        .env_remove("RETROGRADE_RIG")
        .env_remove("RETROGRADE_CAPSULE")
        .args(args)
        .output()
        .expect("starts");
    (
        output.status.code().unwrap_or(-1),
        String::from_utf8_lossy(&output.stdout).into_owned(),
        String::from_utf8_lossy(&output.stderr).into_owned(),
    )
}

/// An address without a listener: a command that tries to connect ends with exit code 4.
const NOBODY: &str = "tcp:127.0.0.1:1";

#[test]
fn impossible_runs_are_refused_before_a_link_is_opened() {
    for (args, code, says) in [
        (&["--stroke-mm", "131"][..], 3, "at most 130.000 mm"),
        (&["--duration-s", "10"], 3, "--duration-s 31.430613"),
        (&["--stroke-mm", "NaN"], 2, "not a number"),
        (&["--cycles", "70000"], 2, "use 1 to 10000"),
    ] {
        let line = [&["run", "--rig", NOBODY], args].concat();
        let (got, out, err) = retrograde(&line);
        assert_eq!(got, code, "{args:?}: {err}");
        assert!(err.contains(says), "{args:?}: {err}");
        assert!(out.is_empty(), "{args:?}: {out}");
    }
    // The same line with valid numbers does try to connect.
    assert_eq!(retrograde(&["run", "--rig", NOBODY]).0, 4);
}

#[test]
fn the_papers_plan() {
    let (code, out, err) = retrograde(&["plan"]);
    assert_eq!((code, err.as_str()), (0, ""));
    insta::assert_snapshot!(out, @r"
    cycles:        5 of 130 mm (130 mm achieved)
    duration:      40 s, a start delay of 0 s included
    strokes:       10, 4 s out, 4 s home
    ramps:         0.35683233 s out, 0.35683233 s home
    peak speed:    35.683 mm/s out, 35.683 mm/s home
    acceleration:  100 mm/s2 out, 100 mm/s2 home
    dwell:         0 s at the far end, 0 s at home
    step rate:     28547 Hz at most
    edges:         1040000, 104000 per stroke
    fingerprint:   9966e3a586ca9ec0
    ");
}

#[test]
fn a_plan_writes_its_edges_and_its_plot() {
    let folder = tempfile::tempdir().expect("folder");
    let (edges, plot) = (
        folder.path().join("edges.csv"),
        folder.path().join("plot.svg"),
    );
    let (code, out, err) = retrograde(&[
        "--json",
        "plan",
        "--cycles",
        "1",
        "--stroke-mm",
        "0.01",
        "--duration-s",
        "0.2",
        "--edges",
        edges.to_str().expect("UTF-8"),
        "--plot",
        plot.to_str().expect("UTF-8"),
    ]);
    assert_eq!(code, 0, "{err}");
    let json: Value = serde_json::from_str(&out).expect("one object");
    assert_eq!(json["ok"], true);
    assert_eq!(json["plan"]["achieved"]["edges"], 16);
    assert_eq!(
        std::fs::read_to_string(&edges)
            .expect("edges")
            .lines()
            .count(),
        17
    );
    assert!(
        std::fs::read_to_string(&plot)
            .expect("plot")
            .starts_with("<svg")
    );
}

/// A record names what made it: tool, firmware, protocol and settings.
#[test]
fn a_record_names_what_made_it() {
    let both = Memory::with(vec![ready(DeviceKind::Capsule), ready(DeviceKind::Rig)]);
    let folder = tempfile::tempdir().expect("folder");
    let out = ["--out", folder.path().to_str().expect("UTF-8")];
    let told = |args: &[&str]| -> Value {
        let (code, out, err) = both.run(&[&["--json"], args].concat());
        assert_eq!(code, 0, "{err}");
        serde_json::from_str(&out).expect("one object")
    };
    let (_, version, _) = both.run(&["--version"]);
    let own = concat!("retrograde ", env!("CARGO_PKG_VERSION"), " (");
    assert!(version.starts_with(own), "{version}");
    let info = told(&["info"]);
    let run = [
        "run",
        "--cycles",
        "1",
        "--stroke-mm",
        "1",
        "--duration-s",
        "1",
    ];
    for (machine, action) in [("rig", &run[..]), ("capsule", &["fold"])] {
        let trial = &told(&[action, &out].concat())["trial"];
        let known = &info[machine]["identity"];
        assert_eq!(trial["tool"], version.trim_end());
        assert_eq!(trial["device"], *known);
        assert_eq!(trial["protocol"], known["protocol"]);
        let settings = told(&["settings", "list", "--of", machine]);
        assert_eq!(trial["settings"], settings["settings"]);
        assert!(trial["settings"]["telemetry_ms"].is_u64());
    }
}

#[test]
fn help_completions_and_manual_are_there() {
    assert_eq!(retrograde(&["--help"]).0, 0);
    assert_eq!(retrograde(&[]).0, 2);
    let (code, out, _) = retrograde(&["completions", "bash"]);
    assert!(code == 0 && out.contains("estop"));
    let (code, out, _) = retrograde(&["man"]);
    assert!(code == 0 && out.starts_with(".ie"), "{out}");
    let (code, out, _) = retrograde(&["man", "settings", "set"]);
    assert!(
        code == 0 && out.contains("retrograde-settings-set"),
        "{out}"
    );
    assert!(out.contains("store it in flash"), "{out}");
    let (_, out, _) = retrograde(&["--help"]);
    assert!(out.contains("retrograde run --cycles 5"), "{out}");
}

#[test]
fn a_motion_of_the_capsule_says_what_it_takes_for_granted_and_what_it_reached() {
    let folder = tempfile::tempdir().expect("folder");
    let out_dir = folder.path().to_str().expect("UTF-8");
    let run = |script: Script, words: &[&str]| {
        let memory = Memory::with(vec![script]);
        memory.run(&[words, &["--out", out_dir]].concat())
    };
    let new = || Script::new(DeviceKind::Capsule);
    for (script, words, reached, warned) in [
        (
            ready(DeviceKind::Capsule),
            &["fold"][..],
            "complete: it is folded\n",
            false,
        ),
        (
            new(),
            &["capsule", "calibrate"],
            "complete: it is unfolded",
            false,
        ),
        (
            Script {
                // Those before are the places of the motion; it would end without them.
                failing_writes: 148..1_000,
                ..new()
            },
            &["capsule", "calibrate"],
            "NOT KEPT: the flash could not be written",
            false,
        ),
        (
            new(),
            &["capsule", "reference"],
            "complete: it is unfolded",
            true,
        ),
        (
            ready(DeviceKind::Capsule),
            &["capsule", "calibrate"],
            "complete: it is unfolded",
            false,
        ),
        (
            ready(DeviceKind::Capsule),
            &["capsule", "reference"],
            "complete: it is unfolded",
            false,
        ),
        (
            ready(DeviceKind::Capsule),
            &["fold", "--thread-mm", "12"],
            "complete: it is already at this length",
            false,
        ),
    ] {
        let (code, out, err) = run(script, words);
        assert_eq!(code, 0, "{words:?}: {out}{err}");
        assert!(out.contains(reached), "{words:?}: {out}");
        let warns = err.contains("there is no calibration");
        assert_eq!(warns, warned, "{words:?}: {err}");
    }
}

#[test]
fn machines_are_found_by_asking_and_each_command_takes_the_right_one() {
    let both = Memory::with(vec![ready(DeviceKind::Capsule), ready(DeviceKind::Rig)]);
    let (code, out, err) = both.run(&["home"]);
    assert_eq!(code, 0, "{err}");
    // It stands at 0: 0.26 s off the flag at 4 mm/s, 0.04 s back to it, 0.25 s for the pull-off of 3 mm, 1.51 s over
    // those 3 mm at 2 mm/s, 0.14 s for the last millimetre.
    assert!(out.contains("Homed in 2.2"), "{out}");
    let (code, out, _) = both.run(&["--json", "info"]);
    let json: Value = serde_json::from_str(&out).expect("one object");
    assert_eq!(
        (code, &json["rig"]["identity"]["device"]),
        (0, &Value::from("rig"))
    );
    assert_eq!(json["capsule"]["status"]["state"], "unfolded");
    let folded_um = json["capsule"]["calibration"]["folded_um"].as_i64();
    assert!((21_000..22_500).contains(&folded_um.expect("calibrated")));
    assert_eq!(json["rig"]["calibration"], Value::Null);
    let (_, out, _) = both.run(&["info", "capsule"]);
    assert!(out.contains("  calibrated: 21."), "{out}");
    assert!(!out.contains("next:"), "{out}");
    let new = Memory::with(vec![Script::new(DeviceKind::Capsule)]);
    let (_, out, _) = new.run(&["info"]);
    assert!(out.contains("not calibrated: unfold it by hand"), "{out}");
    let (code, out, _) = both.run(&["doctor"]);
    assert!(code == 0 && out.lines().count() == 2, "{out}");
}

#[test]
fn none_wrong_or_several_are_listed_and_refused_before_anything_moves() {
    for (scripts, args, code, says) in [
        (vec![], &["home"][..], "no rig found"),
        (
            vec![DeviceKind::Capsule],
            &["home"],
            "no rig found; there is:\n  0 (memory): capsule",
        ),
        (
            vec![DeviceKind::Rig, DeviceKind::Rig],
            &["home"],
            "several rigs found",
        ),
        (
            vec![DeviceKind::Capsule],
            &["--rig", "0", "home"],
            "is a capsule, not a rig",
        ),
    ]
    .map(|(kinds, args, says)| (kinds.into_iter().map(ready).collect(), args, 4, says))
    {
        let memory = Memory::with(scripts);
        let (got, _, err) = memory.run(args);
        assert_eq!(got, code, "{err}");
        assert!(err.contains(says), "{err}");
        assert!(!memory.heard().contains(&"Home"));
    }
}

#[test]
fn every_line_of_a_help_is_indented() {
    let capsule = Memory::with(vec![ready(DeviceKind::Capsule)]);
    let (_, _, err) = capsule.run(&["--rig", "0", "home"]);
    let help = err.split_once("\n  help: ").expect("a help").1;
    let mut more = help.trim_end().lines().skip(1);
    assert!(more.clone().count() > 0, "{err}");
    assert!(more.all(|line| line.starts_with("        ")), "{err}");
}

#[test]
fn a_run_is_recorded_and_reported() {
    let folder = tempfile::tempdir().expect("folder");
    let out_dir = folder.path().to_str().expect("UTF-8");
    let memory = Memory::with(vec![ready(DeviceKind::Rig)]);
    let (code, out, err) = memory.run(&[
        "run",
        "--out",
        out_dir,
        "--cycles",
        "1",
        "--duration-s",
        "8",
    ]);
    assert_eq!(code, 0, "{err}");
    assert!(out.contains("Run 1: 2 strokes of 130 mm in 8 s"), "{out}");
    assert!(out.contains("  5.0 s of 8.0 s, stroke 2 of 2"), "{out}");
    assert!(
        out.contains("2 of 2 strokes in 8.00000000 s, 208000 steps commanded, 208000 counted"),
        "{out}"
    );
    let report = folder.path().join("report.html");
    let (code, out, err) =
        memory.run(&["report", out_dir, "--out", report.to_str().expect("UTF-8")]);
    assert_eq!(code, 0, "{err}");
    assert!(out.starts_with("1 trial in"), "{out}");
    assert!(
        std::fs::read_to_string(report)
            .expect("report")
            .contains("position / mm")
    );
}

#[test]
fn json_is_one_object_and_progress_goes_elsewhere() {
    let folder = tempfile::tempdir().expect("folder");
    let out_dir = folder.path().to_str().expect("UTF-8");
    let memory = Memory::with(vec![ready(DeviceKind::Capsule)]);
    let (code, out, err) = memory.run(&["--json", "fold", "--out", out_dir]);
    assert_eq!(code, 0, "{err}");
    let json: Value = serde_json::from_str(&out).expect("one object");
    let thread_um = json["trial"]["action"]["record"]["thread_um"].as_i64();
    let thread_um = thread_um.expect("a number");
    assert!(thread_um.abs_diff(FOLDED_UM.into()) < 150, "{thread_um}");
    // The first actuation was the reference.
    assert!(err.contains("Actuation 2"), "{err}");
    let (code, out, _) = Memory::with(vec![]).run(&["--json", "home"]);
    let json: Value = serde_json::from_str(&out).expect("one object");
    assert_eq!(
        (code, &json["ok"], &json["exit_code"]),
        (4, &Value::from(false), &Value::from(4))
    );
    assert_eq!(json["error"]["code"], "retrograde::not_found");
}

#[test]
fn the_recording_of_the_last_actuation_becomes_a_file() {
    let folder = tempfile::tempdir().expect("folder");
    let out_dir = folder.path().to_str().expect("UTF-8");
    let trace = ["--json", "capsule", "trace", "--out", out_dir];
    // The last actuation is the reference, which takes longer than the recording keeps.
    let (code, out, err) = Memory::with(vec![ready(DeviceKind::Capsule)]).run(&trace);
    assert_eq!(code, 0, "{err}");
    let json: Value = serde_json::from_str(&out).expect("one object");
    assert_eq!(
        (&json["actuation"], &json["readings"]),
        (&1.into(), &KEPT_TRACE_POINTS.into())
    );
    let path = json["csv"].as_str().expect("a path");
    let text = std::fs::read_to_string(path).expect("a file");
    let mut lines = text.lines();
    assert_eq!(
        lines.next(),
        Some("time_ms,thread_um,current_ma,battery_mv,drive_mv,force_least_n,force_most_n,origin")
    );
    let rows: Vec<Vec<i64>> = lines
        .map(|line| {
            let numbers = line.strip_suffix(",board").expect("its origin");
            numbers
                .split(',')
                .take(5)
                .map(|field| field.parse().expect("a number"))
                .collect()
        })
        .collect();
    assert_eq!(rows.len(), KEPT_TRACE_POINTS);
    assert!((0..).zip(&rows).all(|(time_ms, row)| row[0] == time_ms));
    // The end pays out to zero: driven the other way, and the cell sags a little.
    assert!(rows.iter().any(|row| row[4] < -1_000));
    assert!(rows.iter().all(|row| (3_000..=3_700).contains(&row[3])));
    let last = &rows[rows.len() - 1];
    assert!((0..300).contains(&last[1]), "{last:?}");

    let (code, out, err) = Memory::with(vec![Script::new(DeviceKind::Capsule)]).run(&trace);
    assert_eq!(code, 0, "{err}");
    let json: Value = serde_json::from_str(&out).expect("one object");
    assert_eq!((&json["readings"], &json["csv"]), (&0.into(), &Value::Null));
}

/// Header and rows of a recording; an empty field becomes none.
pub(crate) fn rows(path: &Path) -> (String, Vec<Vec<Option<f64>>>) {
    let text = std::fs::read_to_string(path).expect("a file");
    let (head, body) = text.split_once('\n').expect("lines");
    let row = |line: &str| line.split(',').map(|field| field.parse().ok()).collect();
    (head.to_owned(), body.lines().map(row).collect())
}

#[test]
fn a_fold_brings_its_recording_with_the_force() {
    let folder = tempfile::tempdir().expect("folder");
    let path = |name: &str| folder.path().join(name);
    let out_dir = folder.path().to_str().expect("UTF-8");
    let fold_csv = path("new/fold.csv");
    let fold = [
        "--json",
        "fold",
        "--out",
        out_dir,
        "--trace",
        fold_csv.to_str().expect("UTF-8"),
    ];
    let memory = Memory::with(vec![ready(DeviceKind::Capsule)]);
    let (code, out, err) = memory.run(&fold);
    assert_eq!(code, 0, "{err}");
    let json: Value = serde_json::from_str(&out).expect("one object");
    assert_eq!(json["trace"], fold_csv.to_str().expect("UTF-8"));
    let (head, readings) = rows(&fold_csv);
    assert_eq!(
        head,
        "time_ms,thread_um,current_ma,battery_mv,drive_mv,force_least_n,force_most_n,origin"
    );
    let duration_ms = json["trial"]["action"]["record"]["duration_ms"].as_u64();
    let duration_ms = duration_ms.expect("a number") as usize;
    assert!((duration_ms..duration_ms + 60).contains(&readings.len()));
    let forces: Vec<_> = readings
        .iter()
        .filter_map(|row| Some((row[1]?, row[5]?, row[6]?)))
        .collect();
    assert!(forces.len() > 1_500);
    // The model capsule pulls with 0 N while the thread is slack, and with 6 N at the end.
    let slack = forces.iter().filter(|(um, ..)| *um < 2_000.0);
    let slack: Vec<_> = slack.map(|(_, _, most)| *most).collect();
    // A single reading may be off by 3 mA from the rounding of the speed.
    let mean_n = slack.iter().sum::<f64>() / slack.len() as f64;
    assert!(slack.len() > 5 && mean_n < 0.3, "{slack:?}");
    let (um, least, most) = *forces.last().expect("some");
    assert!((um - f64::from(FOLDED_UM)).abs() < 100.0, "{um}");
    assert!(
        least > 4.0 && least < 6.0 && most > 6.0 && most < 9.0,
        "{least} {most}"
    );

    // An existing file is not touched, and nothing moves.
    let (code, _, err) = memory.run(&fold);
    assert_eq!(code, 2, "{err}");
    assert!(err.contains("nothing moved"), "{err}");
    let folds = memory.heard().into_iter().filter(|name| *name == "Fold");
    assert_eq!(folds.count(), 1);
    assert_eq!(rows(&fold_csv).1.len(), readings.len());

    // A refused fold leaves no file behind.
    let none = path("none.csv");
    let (code, ..) = Memory::with(vec![Script::new(DeviceKind::Capsule)]).run(&[
        "fold",
        "--out",
        out_dir,
        "--trace",
        none.to_str().expect("UTF-8"),
    ]);
    assert_eq!((code, none.exists()), (3, false));

    // A stopped motion's recording is fetched, too.
    let stopped = path("stopped.csv");
    let script = Script {
        world: vec![(1_500_000, World::StopFrame)],
        ..ready(DeviceKind::Capsule)
    };
    let (code, ..) = Memory::with(vec![script]).run(&[
        "fold",
        "--out",
        out_dir,
        "--trace",
        stopped.to_str().expect("UTF-8"),
    ]);
    assert_eq!(code, 130);
    let count = rows(&stopped).1.len();
    assert!((100..1_600).contains(&count), "{count}");
}

#[test]
fn exit_codes_tell_the_endings_apart() {
    let folder = tempfile::tempdir().expect("folder");
    let out_dir = folder.path().to_str().expect("UTF-8");
    let run = &["--rig", "0", "run", "--out", out_dir];
    let code = |script: Script, args: &[&str]| Memory::with(vec![script]).run(args).0;
    let there = || ready(DeviceKind::Rig);
    let mismatched = Script {
        schema_key: 1,
        ..there()
    };
    let deaf = Script {
        deaf_to: vec![("Run", 99)],
        ..there()
    };
    let dead = Script {
        dead: true,
        ..there()
    };
    for (script, args, expected, what) in [
        (Script::new(DeviceKind::Rig), &run[..], 3, "not homed"),
        (mismatched, run, 5, "mismatch"),
        (deaf, run, 7, "outcome unknown"),
        (dead.clone(), run, 4, "no answer"),
        (dead, &["--rig", "0", "stop"], 7, "stop not confirmed"),
        (there(), &["--rig", "0", "ack"], 3, "nothing to acknowledge"),
    ] {
        assert_eq!(code(script, args), expected, "{what}");
    }
    for (world, expected, what) in [
        (estop(1_000_000), 6, "a fault"),
        (button(1_000_000), 130, "somebody else's stop"),
        (vec![(1_000_000, World::Reset)], 4, "a reset"),
        (vec![(1_000_000, World::TimerStands)], 6, "overdue"),
    ] {
        let script = Script {
            world,
            ..ready(DeviceKind::Rig)
        };
        let short = ["--stroke-mm", "20", "--cycles", "1", "--duration-s", "4"];
        let run = [&run[..], &short].concat();
        assert_eq!(code(script.clone(), &run), expected, "{what}, in a run");
        let home = &["--rig", "0", "home"];
        assert_eq!(code(script, home), expected, "{what}, in homing");
    }
}

#[test]
fn stops_are_sent_before_anything_else_and_to_all() {
    let both = Memory::with(vec![ready(DeviceKind::Rig), ready(DeviceKind::Capsule)]);
    let (code, out, err) = both.run(&["--rig", "0", "--capsule", "1", "estop"]);
    assert_eq!(code, 0, "{err}");
    assert_eq!(out.lines().count(), 2, "{out}");
    assert_eq!(both.heard(), ["Urgent", "Urgent"], "no Hello first");
    // Without addresses the stop goes to every machine that may be there. An unconfirmed stop is no success.
    let dead = Script {
        dead: true,
        ..ready(DeviceKind::Rig)
    };
    let found = Memory::with(vec![dead, ready(DeviceKind::Capsule)]);
    let (code, out, err) = found.run(&["stop"]);
    assert_eq!(code, 7, "{err}");
    assert!(out.contains("test capsule: stopped"), "{out}");
    assert!(err.contains("cut the motor supply NOW"), "{err}");
    assert_eq!(found.heard(), ["Urgent"], "no Hello first");
    for log in both.logs.lock().expect("logs").iter() {
        let urgent = log.lock().expect("log").urgent.clone();
        assert_eq!(urgent, [(Urgent::EStop, 0)]);
    }
}

#[test]
fn info_names_a_mismatched_machine_and_what_to_do() {
    let memory = Memory::with(vec![Script {
        schema_key: 1,
        ..ready(DeviceKind::Rig)
    }]);
    let (code, out, err) = memory.run(&["info"]);
    assert_eq!(code, 0, "{err}");
    assert!(
        out.contains("UID abab") && out.contains("flash the matching firmware"),
        "{out}"
    );
}

#[test]
fn what_the_environment_gives_is_not_shown_as_required() {
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_retrograde"))
        .args(["settings", "set"])
        .env("RETROGRADE_RIG", "tcp:127.0.0.1:1")
        .env("RETROGRADE_CAPSULE", "tcp:127.0.0.1:2")
        .output()
        .expect("starts");
    let err = String::from_utf8(output.stderr).expect("UTF-8");
    assert_eq!(output.status.code(), Some(2), "{err}");
    assert!(
        err.contains("Usage: retrograde settings set <KEY> <VALUE>"),
        "{err}"
    );
    // A wrong value from the environment is reported.
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_retrograde"))
        .args(["settings", "list"])
        .env("RETROGRADE_RIG", "tcp:127.0.0.1")
        .output()
        .expect("starts");
    let err = String::from_utf8(output.stderr).expect("UTF-8");
    assert!(err.contains("no host or no port"), "{err}");
}

/// Commands and options that messages, help and comments of the tool quote. A remedy that does not exist helps nobody.
#[test]
fn every_command_that_the_tool_quotes_is_there() {
    let (mut folders, mut texts) = (vec![], vec![]);
    folders.push(Path::new(env!("CARGO_MANIFEST_DIR")).to_owned());
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() && !path.ends_with("tests") {
                folders.push(path);
            } else if path
                .extension()
                .is_some_and(|it| it == "rs" || it == "html")
            {
                texts.push(std::fs::read_to_string(path).expect("text"));
            }
        }
    }
    let is_word = |word: &&str| word.bytes().all(|c| c.is_ascii_lowercase() || c == b'-');
    let mut quoted = BTreeSet::new();
    for line in texts.iter().flat_map(|text| text.lines()) {
        for quote in line.split("`retrograde ").skip(1) {
            let command = quote.split('`').next().unwrap_or_default();
            let words = command.split_whitespace();
            let words = words.take_while(|word| is_word(word) && !word.starts_with('-'));
            let options = command
                .split(|c: char| !c.is_ascii_alphanumeric() && c != '-')
                .filter(|word| word.len() > 2 && word.starts_with("--"));
            quoted.insert((
                words.take(2).collect::<Vec<_>>(),
                options.collect::<Vec<_>>(),
            ));
        }
    }
    assert!(quoted.len() > 40, "{quoted:?}");
    let mut wrong = vec![];
    for (words, options) in quoted {
        let (code, out, err) = retrograde(&[&words[..], &["--help"]].concat());
        if code != 0 || options.iter().any(|option| !out.contains(option)) {
            wrong.push(format!("{words:?} {options:?}: {code} {err}"));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

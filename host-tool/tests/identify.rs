//! `capsule identify`: what is found of capsules that are known, and what is said of recordings that show nothing.

mod machine;
mod population;

use host_tool::identify::{IdentifyError, identify};
use machine::tool::{Memory, ready};
use machine::{Script, World};
use protocol::capsule::TracePoint;
use protocol::system::DeviceKind;
use serde_json::Value;

/// A slice of what `examples/identify.rs` tries.
#[test]
fn capsules_that_differ_in_everything_are_identified_within_the_stated_uncertainty() {
    for seed in 0..10 {
        let found = population::tried(seed);
        assert_eq!(
            population::missed(&found),
            [""; 0],
            "seed {seed}: {found:?}"
        );
        for (name, truth, estimate) in &found {
            // It also has to say something.
            let most = if *name == "slack_mm" { 0.65 } else { 0.35 };
            let share = estimate.uncertainty / truth;
            assert!(share < most, "seed {seed}, {name}: {estimate:?}");
        }
    }
}

fn rest(readings: usize) -> Vec<TracePoint> {
    let point = TracePoint {
        thread_um: 0,
        current_ma: 0,
        battery_mv: 3_700,
        drive_mv: 0,
    };
    vec![point; readings]
}

#[test]
fn recordings_that_show_nothing_are_refused() {
    for readings in [0, 1, 20, 21, 2_000] {
        let fold = rest(readings);
        assert!(
            matches!(
                identify(&fold, &fold),
                Err(IdentifyError::TooShort {
                    motion: "fold",
                    blocks: 0
                })
            ),
            "{readings}"
        );
    }
    // A motor that turns at one speed with one current tells neither resistance nor motor constant.
    let turning = |sign: i16| -> Vec<TracePoint> {
        let points = rest(1_000).into_iter().zip(0..);
        let turned = points.map(|(point, ms)| TracePoint {
            thread_um: if sign > 0 { 13 * ms } else { 13_000 - 13 * ms },
            current_ma: 20,
            drive_mv: sign * 1_000,
            ..point
        });
        turned.collect()
    };
    let error = identify(&turning(1), &turning(-1)).expect_err("one speed");
    assert!(matches!(error, IdentifyError::NoFit(_)), "{error}");
    assert!(matches!(
        identify(&turning(1), &turning(1)),
        Err(IdentifyError::TooShort {
            motion: "unfolding",
            ..
        })
    ));
}

fn tool(script: Script, more: &[&str]) -> (u8, String, String, Vec<String>) {
    let folder = tempfile::tempdir().expect("folder");
    let out_dir = folder.path().to_str().expect("UTF-8");
    let args = [&["capsule", "identify", "--out", out_dir], more].concat();
    let (code, out, err) = Memory::with(vec![script]).run(&args);
    let files = std::fs::read_dir(folder.path()).expect("a folder");
    let names = files.map(|file| {
        file.expect("a file")
            .file_name()
            .into_string()
            .expect("UTF-8")
    });
    let mut names: Vec<_> = names.collect();
    names.sort();
    (code, out, err, names)
}

#[test]
fn the_command_folds_unfolds_and_says_what_it_found() {
    let (code, out, err, files) = tool(ready(DeviceKind::Capsule), &[]);
    assert_eq!(code, 0, "{out}{err}");
    for line in [
        "winding, bridge and cell: ",
        "motor constant: ",
        "no-load current: ",
        "friction in the worm: ",
        "stiffness over the beam estimate: ",
        "slack of the thread: ",
    ] {
        assert!(out.contains(line), "{line}\n{out}");
    }
    // Two trials of two files each, and two recordings.
    let starting = |stem: &str| files.iter().filter(|name| name.starts_with(stem)).count();
    let counts = ["identify-fold", "identify-unfold", "trace-"].map(starting);
    assert_eq!(counts, [2, 2, 2], "{files:?}");

    let (code, out, err, _) = tool(ready(DeviceKind::Capsule), &["--json"]);
    assert_eq!(code, 0, "{err}");
    let result: Value = serde_json::from_str(&out).expect("JSON");
    let of = |name: &str, what: &str| result["identified"][name][what].as_f64().expect("a number");
    let constant = (of("motor_constant_mvs", "value") - 2.11).abs();
    assert!(
        constant <= of("motor_constant_mvs", "uncertainty"),
        "{result}"
    );
}

#[test]
fn it_begins_unfolded_and_ends_with_the_first_fault() {
    let (code, out, err, files) = tool(Script::new(DeviceKind::Capsule), &[]);
    assert_eq!((code, files.len()), (3, 0), "{out}{err}");
    assert!(err.contains("retrograde capsule reference"), "{err}");
    // In the middle of the fold.
    let stopped = Script {
        world: vec![(1_000_000, World::StopFrame)],
        ..ready(DeviceKind::Capsule)
    };
    let (code, out, err, files) = tool(stopped, &[]);
    assert_eq!((code, files.len()), (130, 2), "{out}{err}");
}

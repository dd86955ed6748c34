//! `doctor` names what is wrong at each place, with its remedy.

use std::net::TcpStream;
use std::time::{Duration, Instant};

use crate::support::bench::Bench;
use crate::support::offline::retrograde;
use crate::support::others::{deaf, echo, instrument, other_baud, server, silent, ssh, web};
use crate::support::signal::{Signal, kill};
use crate::support::tool::{Memory, ready};
use protocol::system::DeviceKind;
use serde_json::Value;
use simulated_machines::machine::Script;

/// The findings in the JSON output: finding, text and remedy.
fn findings(out: &str) -> Vec<(String, String, String)> {
    let result: Value = serde_json::from_str(out).expect("JSON");
    let findings = result["findings"].as_array().expect("a list").iter();
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    findings
        .map(|found| {
            (
                text(&found["finding"]),
                text(&found["text"]),
                text(&found["remedy"]),
            )
        })
        .collect()
}

fn doctor(place: &str) -> (u8, Vec<(String, String, String)>) {
    let (code, out, _) = retrograde(&["--rig", place, "--json", "doctor"]);
    (code, findings(&out))
}

#[test]
fn what_is_no_machine_is_named_with_its_remedy() {
    type Serve = fn(TcpStream);
    let ends: [(Serve, &str, &str); 7] = [
        (silent, "silence", "is the board powered"),
        (echo, "echo", "loop-back plug"),
        (deaf, "deaf", "PA3"),
        (web, "web_server", "virtual-bench serve"),
        (ssh, "ssh_server", "virtual-bench serve"),
        (instrument, "other_instrument", "retrograde doctor"),
        (other_baud, "no_frames", "--baud"),
    ];
    for (serve, finding, remedy) in ends {
        let (code, found) = doctor(&server(serve));
        assert_eq!((code, found.len()), (4, 1), "{found:?}");
        assert_eq!(found[0].0, finding, "{found:?}");
        assert!(found[0].2.contains(remedy), "{found:?}");
    }
}

#[test]
fn a_place_that_does_not_open_is_named_with_its_remedy() {
    let file = tempfile::NamedTempFile::new().expect("a file");
    for (place, finding, remedy) in [
        ("/dev/retrograde-no-such-port", "absent", "check the cable"),
        (
            file.path().to_str().expect("UTF-8"),
            "no_port",
            "give a serial port",
        ),
        ("tcp:127.0.0.1:1", "unreachable", "start the server"),
        ("virtual", "absent", "virtual-bench"),
    ] {
        let (code, found) = doctor(place);
        assert_eq!((code, found.len()), (4, 1), "{found:?}");
        assert_eq!(found[0].0, finding, "{found:?}");
        assert!(found[0].2.contains(remedy), "{found:?}");
    }
}

/// Repeats the command while the owner of the line is reported silent, which a busy computer may cause for a moment.
fn answered(bench: &Bench, args: &[&str]) -> (Option<i32>, String, String) {
    let begin = Instant::now();
    loop {
        let (code, out, err) = bench.retrograde(args);
        if !out.contains("owner_silent") {
            return (code, out, err);
        }
        assert!(begin.elapsed() < Duration::from_secs(20), "{out}{err}");
    }
}

#[test]
fn a_machine_that_is_well_is_fine_and_one_with_a_fault_says_so() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let (code, out, err) = bench.retrograde(&["doctor"]);
    assert_eq!(code, Some(0), "{out}{err}");
    assert!(out.contains(": fine: rig, UID ab"), "{out}");
    // One line named for both machines. While one of them owns it, ask again.
    for _ in 0..5 {
        let (code, out, err) = answered(&bench, &["doctor", "--json", "--capsule", &bench.address]);
        assert_eq!(code, Some(4), "{out}{err}");
        let found = findings(&out);
        let codes: Vec<_> = found.iter().map(|found| found.0.as_str()).collect();
        assert_eq!(codes, ["fine", "wrong_kind"], "{found:?}");
    }
    assert_eq!(bench.retrograde(&["estop"]).0, Some(0));
    let (code, out, err) = bench.retrograde(&["doctor", "--json"]);
    assert_eq!(code, Some(6), "{out}{err}");
    let found = findings(&out);
    // One finding, with who it is: a rig with a fault is not fine.
    assert_eq!((found.len(), found[0].0.as_str()), (1, "fault"));
    assert!(found[0].1.contains("emergency stop"), "{found:?}");
    assert!(found[0].1.contains("it is rig, UID ab"), "{found:?}");
    assert!(found[0].2.contains("retrograde ack"), "{found:?}");
    // The doctor has not acknowledged anything.
    assert_eq!(bench.count("Acknowledge"), 0);
}

#[test]
fn the_owner_of_the_line_is_named_and_one_that_is_frozen_is_told() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut run = bench.run(&["--cycles", "1", "--stroke-mm", "130", "--duration-s", "60"]);
    let owner = format!("process {}", run.id());
    let (code, out, err) = answered(&bench, &["doctor"]);
    assert_eq!(code, Some(0), "{out}{err}");
    assert!(out.contains("fine") && out.contains(&owner), "{out}");
    kill(Signal::STOP, run.id());
    let (code, out, err) = bench.retrograde(&["doctor", "--json"]);
    assert_eq!(code, Some(4), "{out}{err}");
    let found = findings(&out);
    assert_eq!(found[0].0, "owner_silent", "{found:?}");
    assert!(
        found[0].1.contains(&owner) && found[0].2.contains("kill -9"),
        "{found:?}"
    );
    assert_eq!(bench.connections(), 1);
    run.kill().expect("killed");
    run.wait().expect("ended");
}

#[test]
fn the_wrong_machine_another_firmware_and_several_are_told() {
    let rig = || ready(DeviceKind::Rig);
    let capsule = || ready(DeviceKind::Capsule);
    let mut old = Script::new(DeviceKind::Rig);
    old.major -= 1;
    let silent = Script {
        dead: true,
        ..Script::new(DeviceKind::Rig)
    };
    for (scripts, args, code, finding, remedy) in [
        (
            vec![rig()],
            &["--capsule", "0"][..],
            4,
            "wrong_kind",
            "exchange `--rig`",
        ),
        (vec![old], &["--rig", "0"], 5, "other_firmware", "`info`"),
        (vec![rig(), rig()], &[], 4, "several", "`--rig WHERE`"),
        (vec![], &[], 4, "absent", "plug a board in"),
        (
            vec![rig(), silent],
            &[],
            4,
            "silence",
            "is the board powered",
        ),
    ] {
        let memory = Memory::with(scripts);
        let (got, out, err) = memory.run(&[args, &["--json", "doctor"]].concat());
        assert_eq!(got, code, "{finding}: {out}{err}");
        let found = findings(&out);
        let found = found.iter().find(|found| found.0 == finding);
        let (_, _, given) = found.unwrap_or_else(|| panic!("no {finding}: {out}"));
        assert!(given.contains(remedy), "{finding}: {given}");
    }
    let memory = Memory::with(vec![rig(), capsule()]);
    let (code, out, err) = memory.run(&["doctor"]);
    assert_eq!(code, 0, "{out}{err}");
    assert_eq!(out.matches(": fine: ").count(), 2, "{out}");
    let moved = [
        "Home",
        "Run",
        "Fold",
        "Reference",
        "Acknowledge",
        "SetTelemetry",
    ];
    let heard = memory.heard();
    assert!(heard.iter().all(|name| !moved.contains(name)), "{heard:?}");
}

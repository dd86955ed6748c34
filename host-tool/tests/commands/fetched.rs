//! Fetches a machine's own record after its host died or its button was pressed. Asking for it changes nothing.

use std::fs;
use std::path::Path;

use crate::support::tool::{Memory, ready};
use client::identity::Origin;
use client::{Device, Unobserved};
use jiff::Timestamp;
use lab::trials::fetched::{Kept, Nothing};
use lab::trials::trial::Status;
use protocol::rig::{LinkLossPolicy, Run, RunTiming};
use protocol::system::DeviceKind;
use serde_json::Value;
use simulated_machines::machine::{Script, VIRTUAL_UID, button, link};

/// Two strokes of 20 mm in 3 s.
const RUN: Run = Run {
    cycles: 1,
    stroke_um: 20_000,
    timing: RunTiming::Total {
        total_us: 3_000_000,
        accel_um_s2: 100_000,
    },
    far_dwell_us: 0,
    home_dwell_us: 0,
    start_delay_us: 0,
    link_loss: LinkLossPolicy::Finish,
};

fn fetch(script: Script, out: &Path) -> (u8, String, String, Memory) {
    let memory = Memory::with(vec![script]);
    let out = out.to_str().expect("UTF-8");
    let (code, said, err) = memory.run(&["records", "fetch", "--out", out]);
    (code, said, err, memory)
}

fn only(folder: &Path) -> Value {
    let files: Vec<_> = fs::read_dir(folder)
        .expect("a folder")
        .map(|entry| entry.expect("an entry").path())
        .collect();
    assert_eq!(files.len(), 1, "{files:?}");
    serde_json::from_slice(&fs::read(&files[0]).expect("a file")).expect("JSON")
}

fn whats(record: &Value) -> String {
    record["events"].to_string()
}

#[test]
fn a_run_whose_host_died_is_fetched() {
    let place = tempfile::tempdir().expect("a folder");
    let script = Script {
        running: Some((RUN, 4_000_000)),
        ..Script::new(DeviceKind::Rig)
    };
    let (code, said, err, memory) = fetch(script, place.path());
    assert_eq!(code, 0, "{err}");
    assert!(
        said.contains(
            "run 1: complete, 2 strokes, 32000 steps at the pin of 32000 commanded, 3.000 s"
        ),
        "{said}"
    );
    let record = only(place.path());
    assert_eq!(record["kind"], "fetched");
    assert_eq!(record["origin"], "board");
    assert_eq!(record["status"], "complete");
    assert_eq!(record["record"]["run"]["number"], 1);
    assert_eq!(record["record"]["run"]["executed"]["counted_edges"], 32_000);
    assert_eq!(record["settings"]["stroke_um"], 130_000);
    assert_eq!(record["lost_events"], 0);
    for what in ["homed", "run_started", "run_ended"] {
        assert!(whats(&record).contains(what), "{record}");
    }
    // The events lie before the moment of asking, on the same clock.
    let asked_us = record["fetched_device_us"].as_u64().expect("a number");
    for event in record["events"].as_array().expect("events") {
        assert!(event["time_us"].as_u64().expect("a number") < asked_us);
    }
    assert!(
        !memory.heard().iter().any(|name| [
            "Run",
            "Home",
            "MoveTo",
            "Acknowledge",
            "SetTelemetry",
            "SetSetting"
        ]
        .contains(name)),
        "{:?}",
        memory.heard()
    );
}

#[test]
fn a_run_of_the_button_is_fetched() {
    let script = Script {
        // A second after the homing, and more: a press before that was meant to stop it.
        world: button(1_200_000),
        uid: VIRTUAL_UID,
        ..ready(DeviceKind::Rig)
    };
    let mut rig = Device::connect(link(script).0, DeviceKind::Rig, 1).expect("a rig");
    let asked = lab::trials::fetched::fetch(&mut rig, Timestamp::UNIX_EPOCH).expect("answers");
    assert_eq!(asked, Err(Nothing::Yet));
    rig.idle(46_000_000, &mut Unobserved).expect("there");
    let asked = lab::trials::fetched::fetch(&mut rig, Timestamp::UNIX_EPOCH).expect("answers");
    let fetched = asked.expect("a run");
    assert_eq!(
        (fetched.status, fetched.origin),
        (Status::Complete, Origin::Virtual)
    );
    let Kept::Run {
        number: 1,
        executed,
    } = fetched.record
    else {
        panic!("{fetched:?}");
    };
    assert_eq!(executed.counted_edges, 1_040_000);
}

#[test]
fn nothing_is_fetched_of_what_goes_on_or_was_never_done_and_each_fetch_makes_a_file() {
    let place = tempfile::tempdir().expect("a folder");
    let running = Script {
        running: Some((RUN, 500_000)),
        ..Script::new(DeviceKind::Rig)
    };
    for (script, wanted, says, files) in [
        (running, 3, "still at it", 0),
        (Script::new(DeviceKind::Rig), 0, "nothing to fetch", 0),
        (Script::new(DeviceKind::Capsule), 0, "nothing to fetch", 0),
        (ready(DeviceKind::Capsule), 0, "actuation", 1),
        (ready(DeviceKind::Capsule), 0, "actuation", 2),
    ] {
        let (code, said, err, _) = fetch(script, place.path());
        assert_eq!(code, wanted, "{err}");
        assert!((said + &err).contains(says), "{says}");
        assert_eq!(fs::read_dir(place.path()).expect("a folder").count(), files);
    }
}

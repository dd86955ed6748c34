//! Hold, resume, jog and move report what really happened.

use crate::support::plan::SHORT_RUN;
use crate::support::tool::{Memory, ready};
use lab::trials::experiment::PAPER_RUN;
use protocol::{settings::SettingKey, system::DeviceKind};
use serde_json::Value;
use simulated_machines::machine::{Script, World, button, estop};

const SHORT_RUN_US: u64 = 4_000_000;
/// A rig in the middle of the paper's first stroke, at 35.7 mm/s. A hold reaches it 6 ms after the host has
/// connected. With 8 ms queued and 36 ms of braking, it stands after 50 ms.
fn running() -> Script {
    Script {
        running: Some((PAPER_RUN, 2_000_000)),
        ..ready(DeviceKind::Rig)
    }
}

/// Exit code, JSON object, text on standard error.
fn json(script: Script, args: &[&str]) -> (u8, Value, String) {
    let memory = Memory::with(vec![script]);
    let (code, out, err) = memory.run(&[&["--json", "--rig", "0"], args].concat());
    (code, serde_json::from_str(&out).expect("one object"), err)
}

#[test]
fn a_hold_is_reported_when_the_carriage_stands_within_the_run() {
    let (code, json, err) = json(running(), &["hold"]);
    assert_eq!(code, 0, "{err}");
    assert_eq!(json["held"], true);
    assert_eq!(json["status"]["state"], "held");
    // At 35.683 mm/s after a ramp of 0.357 s, it begins to brake 2.020 s after the start, at 65.71 mm. Braking takes
    // 0.64 mm.
    let um = json["status"]["position_um"].as_i64().expect("a number");
    assert!(um.abs_diff(66_350) < 100, "{um}");
}

#[test]
fn a_hold_that_somebody_else_has_ended_is_no_hold() {
    // The rig stands after 50 ms. A press of the button is too near to the motion: it finds the rig braking, or just
    // held, and does nothing.
    for (world, code, text) in [
        (
            vec![(51_000, World::Resume)],
            3,
            "the run was held, but somebody else",
        ),
        (button(32_000), 0, "Held at 66."),
        (button(10_000), 0, "Held at 66."),
    ] {
        let held = Script { world, ..running() };
        let (got, json, err) = json(held, &["hold"]);
        assert_eq!(got, code, "{err}");
        assert!(err.contains(text), "{err}");
        assert_eq!(json["ok"], code == 0, "{json}");
        assert!(!err.contains("the carriage is at"), "it may move: {err}");
    }
}

#[test]
fn a_hold_that_came_too_late_is_no_hold() {
    // The other host takes 6 ms of the run beside this idling. This host takes 6 ms until the hold, so that comes 4
    // ms before the end, when all steps are queued.
    let late = Script {
        running: Some((SHORT_RUN, SHORT_RUN_US - 16_000)),
        ..ready(DeviceKind::Rig)
    };
    let (code, json, err) = json(late, &["hold"]);
    assert_eq!(code, 3, "{err}");
    assert!(err.contains("too late, the run is complete"), "{err}");
    assert_eq!(json["ok"], false);
    assert_eq!(json["held"], Value::Null);
}

#[test]
fn a_fault_while_a_hold_brakes_is_reported_as_that() {
    let faulty = Script {
        world: estop(20_000),
        ..running()
    };
    let (code, json, err) = json(faulty, &["hold"]);
    assert_eq!(code, 6, "{err}");
    assert!(
        err.contains("the run ended by a fault: the E-stop"),
        "{err}"
    );
    assert_eq!(json["held"], Value::Null);
}

#[test]
fn a_jog_that_a_fault_ends_is_no_success() {
    for fault_at_us in [150_000, 200_000, 210_000, 500_000] {
        let faulty = Script {
            world: estop(fault_at_us),
            ..ready(DeviceKind::Rig)
        };
        let (code, json, err) = json(faulty, &["jog", "away", "--for-s", "1"]);
        assert_eq!(code, 6, "{fault_at_us}: {err}");
        assert!(
            err.contains("the jog ended by a fault: the E-stop"),
            "{fault_at_us}: {err}"
        );
        assert!(err.contains(" mm"), "where it stands: {err}");
        assert_eq!(json["ok"], false);
    }
}

#[test]
fn a_jog_ends_in_time_or_at_the_end_of_the_stroke() {
    let (code, ends, err) = json(ready(DeviceKind::Rig), &["jog", "away", "--for-s", "2"]);
    assert_eq!(code, 0, "{err}");
    let um = ends["status"]["position_um"].as_i64().expect("a number");
    assert!(um.abs_diff(10_000) < 200, "{um}");
    let line = &["jog", "away", "--for-s", "9", "--speed-mm-s", "40"];
    let (code, ends, err) = json(ready(DeviceKind::Rig), line);
    assert_eq!(code, 0, "{err}");
    assert_eq!(ends["status"]["position_um"], 130_000);
}

/// A jog is renewed within the rig's own dead-man time.
#[test]
fn a_jog_goes_on_with_the_shortest_dead_man_time() {
    let quick = Script {
        settings: vec![(SettingKey::DeadManMs, 50)],
        ..ready(DeviceKind::Rig)
    };
    let (code, ends, err) = json(quick, &["jog", "away", "--for-s", "1"]);
    assert_eq!(code, 0, "{err}");
    let um = ends["status"]["position_um"].as_i64().expect("a number");
    assert!(um.abs_diff(5_000) < 200, "{um}");
}

#[test]
fn a_move_that_a_fault_ends_has_moved() {
    let faulty = Script {
        world: estop(500_000),
        ..ready(DeviceKind::Rig)
    };
    let (code, _, err) = json(faulty, &["move", "60"]);
    assert_eq!(code, 6, "{err}");
    assert!(
        err.contains("the move ended by a fault: the E-stop"),
        "{err}"
    );
    assert!(
        // 0.1 s of acceleration to 20 mm/s, then 0.394 s.
        err.contains("the carriage is at 8.8") && !err.contains("nothing was moved"),
        "{err}"
    );
    // With a fault latched before, the jog does not even begin.
    let faulted = Script {
        world: estop(1),
        ..ready(DeviceKind::Rig)
    };
    let (code, _, err) = json(faulted, &["move", "60"]);
    assert_eq!(code, 3, "{err}");
    assert!(err.contains("nothing was moved"), "{err}");
}

#[test]
fn what_somebody_else_stopped_is_no_success() {
    for line in [&["jog", "away", "--for-s", "2"][..], &["move", "60"]] {
        let pressed = Script {
            world: button(460_000),
            ..ready(DeviceKind::Rig)
        };
        let (code, _, err) = json(pressed, line);
        assert_eq!(code, 130, "{err}");
        assert!(err.contains("the start button"), "{err}");
        assert!(err.contains("the carriage is at "), "{err}");
    }
    let held = Script {
        world: vec![(20_000, World::StopFrame)],
        ..running()
    };
    let (code, _, err) = json(held, &["hold"]);
    assert_eq!(code, 130, "{err}");
    assert!(err.contains("the run was stopped"), "{err}");
}

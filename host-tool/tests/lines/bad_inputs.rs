//! Wrong input on the command line, in files and from machines. Each is refused with its reason, a remedy and its
//! exit code, and nothing moves.

use std::fmt::Write as _;

use crate::support::bench::Bench;
use crate::support::offline::retrograde;
use client::Device;
use client::address::Address;
use lab::operations::connector::Ports;
use lab::operations::connector::{Connector as _, Purpose};
use protocol::rig::{GetRigHealth, RigHealth, RigStatus, RunRecord};
use protocol::system::DeviceKind;
use serde_json::Value;

/// An address without a listener.
const NOBODY: &str = "tcp:127.0.0.1:1";

/// Command line, exit code, part of the message, part of the remedy. `RIG` stands for a homed rig at rest.
const INPUTS: &[(&str, u8, &str, &str)] = &[
    // The command line itself.
    ("nonsense", 2, "unrecognized subcommand", "--help"),
    (
        "home extra",
        2,
        "unexpected argument 'extra'",
        "Usage: retrograde home",
    ),
    (
        "home --rig",
        2,
        "a value is required for '--rig <WHERE>'",
        "--help",
    ),
    ("settings", 2, "Settings and name of a machine", "import"),
    (
        "settings set stroke_um 5 --of capsule",
        2,
        "stroke_um is no setting of this machine",
        "--of",
    ),
    (
        "settings get end_force_ma --of rig",
        2,
        "end_force_ma is no setting of this machine",
        "--of",
    ),
    (
        "fold --thread-mm 5 --indentation-mm 2",
        2,
        "cannot be used with",
        "--help",
    ),
    ("fold --thread-mm -3", 2, "--thread-mm", "--help"),
    ("fold --indentation-mm 100", 2, "100", "nothing was sent"),
    ("simulate nothing", 2, "unrecognized subcommand", "--help"),
    (
        "--rig RIG stop other",
        2,
        "invalid value 'other'",
        "rig, capsule",
    ),
    (
        "--rig RIG commission other",
        2,
        "invalid value 'other'",
        "rig, capsule",
    ),
    (
        "completions tcsh",
        2,
        "invalid value 'tcsh'",
        "bash, elvish",
    ),
    // Addresses.
    ("home --rig=", 2, "empty", "tcp:HOST:PORT"),
    (
        "home --rig tcp:",
        2,
        "has no host or no port",
        "tcp:127.0.0.1:7001",
    ),
    (
        "home --rig tcp:host",
        2,
        "has no host or no port",
        "tcp:127.0.0.1:7001",
    ),
    (
        "home --rig tcp::7001",
        2,
        "has no host or no port",
        "tcp:127.0.0.1:7001",
    ),
    (
        "home --rig tcp:host:x",
        2,
        "has no host or no port",
        "tcp:127.0.0.1:7001",
    ),
    (
        "home --rig tcp:127.0.0.1:99999",
        2,
        "port 99999 does not exist",
        "1 to 65535",
    ),
    (
        "home --rig tcp:127.0.0.1:0",
        2,
        "port 0 does not exist",
        "1 to 65535",
    ),
    (
        "home --rig tcp:127.0.0.1:1",
        4,
        "refused",
        "check host and port",
    ),
    (
        "home --rig tcp:no-such-host.invalid:1",
        4,
        "cannot open",
        "check host and port",
    ),
    (
        "info --rig /dev/retrograde-no-such-port",
        4,
        "there is no such port",
        "retrograde doctor",
    ),
    (
        "info --rig /dev/null",
        4,
        "it is no serial port",
        "retrograde doctor",
    ),
    (
        "info --rig /dev",
        4,
        "it is no serial port",
        "retrograde doctor",
    ),
    (
        "info --rig /etc/passwd",
        4,
        "it is no serial port",
        "retrograde doctor",
    ),
    (
        "info --rig RIG --baud 0",
        2,
        "0 is not in 300 to 4000000",
        "--help",
    ),
    ("info --rig RIG --baud x", 2, "invalid value 'x'", "--help"),
    (
        "info --rig RIG --baud 99999999999",
        2,
        "is not in 300 to 4000000",
        "--help",
    ),
    (
        "info --rig 127.0.0.1:1",
        4,
        "tcp:127.0.0.1:1",
        "check host and port",
    ),
    // The wrong machine.
    (
        "info --capsule RIG",
        4,
        "is a rig, not a capsule",
        "exchange `--rig` and `--capsule`",
    ),
    (
        "fold --capsule RIG",
        4,
        "is a rig, not a capsule",
        "exchange `--rig` and `--capsule`",
    ),
    // Runs.
    (
        "run --rig RIG --stroke-mm 0",
        3,
        "more than zero",
        "nothing was sent",
    ),
    (
        "run --rig RIG --stroke-mm 131",
        3,
        "at most 130.000 mm",
        "nothing was sent",
    ),
    (
        "run --rig RIG --stroke-mm -130",
        2,
        "negative",
        "at least 0",
    ),
    ("run --rig RIG --stroke-mm NaN", 2, "not a number", "12.5"),
    ("run --rig RIG --stroke-mm inf", 2, "not a number", "12.5"),
    (
        "run --rig RIG --stroke-mm 1e12",
        2,
        "has an exponent",
        "write all digits",
    ),
    (
        "run --rig RIG --stroke-mm 12,5",
        2,
        "has a comma",
        "write a point",
    ),
    (
        "run --rig RIG --stroke-mm 0x10",
        2,
        "not a number",
        "write digits",
    ),
    (
        "run --rig RIG --stroke-mm 130.0001",
        2,
        "more than 3 decimals",
        "the finest step is 0.001",
    ),
    (
        "run --rig RIG --stroke-mm 99999999999999999999",
        2,
        "too large",
        "at most 4294967",
    ),
    (
        "run --rig RIG --stroke-mm 0.001",
        3,
        "the stroke is 0.001 mm",
        "0.002 to 130 mm",
    ),
    ("run --rig RIG --cycles 0", 2, "'0'", "use 1 to 10000"),
    (
        "run --rig RIG --cycles 10001",
        2,
        "'10001'",
        "use 1 to 10000",
    ),
    (
        "run --rig RIG --cycles 2.5",
        2,
        "not a whole number",
        "write for example 5",
    ),
    ("run --rig RIG --cycles -1", 2, "negative", "at least 0"),
    (
        "run --rig RIG --duration-s 0",
        3,
        "too little time",
        "--duration-s 31.430613",
    ),
    (
        "run --rig RIG --duration-s 10",
        3,
        "too little time",
        "--duration-s 31.430613",
    ),
    (
        "run --rig RIG --duration-s 30",
        3,
        "the axis allows 49 mm/s",
        "give it more time",
    ),
    (
        "run --rig RIG --duration-s 10 --accel-mm-s2 2000",
        3,
        "the axis allows 49 mm/s",
        "give it more time",
    ),
    (
        "run --rig RIG --duration-s 1e999",
        2,
        "has an exponent",
        "write all digits",
    ),
    (
        "run --rig RIG --duration-s 99999999999999999999",
        2,
        "too large",
        "at most 18446744073709",
    ),
    (
        "run --rig RIG --speed-mm-s 0",
        3,
        "the speed is zero",
        "at least 0.001 mm/s",
    ),
    (
        "run --rig RIG --speed-mm-s 60",
        3,
        "the axis allows 49 mm/s",
        "less speed",
    ),
    (
        "run --rig RIG --speed-mm-s 10 --duration-s 40",
        2,
        "cannot be used with",
        "Usage",
    ),
    (
        "run --rig RIG --return-speed-mm-s 10",
        2,
        "--speed-mm-s",
        "Usage",
    ),
    (
        "run --rig RIG --waves-per-minute 0",
        2,
        "invalid value '0'",
        "use a number above 0",
    ),
    (
        "run --rig RIG --waves-per-minute 1000",
        3,
        "too little time",
        "--duration-s 31.430613",
    ),
    (
        "run --rig RIG --preset other",
        2,
        "invalid value 'other'",
        "paper, wave",
    ),
    (
        "run --rig RIG --preset paper --duration-s 3",
        2,
        "cannot be used with",
        "Usage",
    ),
    (
        "run --rig RIG --accel-mm-s2 0",
        3,
        "the acceleration is zero",
        "at least 0.001 mm/s2",
    ),
    (
        "run --rig RIG --accel-mm-s2 99999",
        3,
        "99999 mm/s2",
        "mm/s2",
    ),
    (
        "run --rig RIG --far-dwell-s -1",
        2,
        "negative",
        "at least 0",
    ),
    (
        "run --rig RIG --start-delay-s 50",
        3,
        "too little time",
        "--duration-s 81.430613",
    ),
    (
        "run --rig RIG --telemetry-ms 4",
        2,
        "4 is not in 5 to 1000",
        "--help",
    ),
    (
        "run --rig RIG --telemetry-ms 1001",
        2,
        "1001 is not in 5 to 1000",
        "--help",
    ),
    (
        "run --rig RIG --on-link-loss carry-on",
        2,
        "invalid value 'carry-on'",
        "stop, finish",
    ),
    (
        "run --rig RIG --out /dev/null/x",
        1,
        "/dev/null/x",
        "folder",
    ),
    // By hand.
    ("jog --rig RIG", 2, "<DIRECTION>", "Usage"),
    (
        "jog --rig RIG left",
        2,
        "invalid value 'left'",
        "away, home",
    ),
    (
        "jog --rig RIG away --for-s 0",
        2,
        "invalid value '0'",
        "use a number above 0",
    ),
    (
        "jog --rig RIG away --speed-mm-s 0",
        3,
        "the speed is 0 mm/s",
        "mm/s",
    ),
    (
        "jog --rig RIG away --speed-mm-s 1000",
        3,
        "the speed is 1000 mm/s",
        "to 49 mm/s",
    ),
    ("move --rig RIG", 2, "<MM>", "Usage"),
    ("move --rig RIG -1", 2, "negative", "at least 0"),
    (
        "move --rig RIG 130.5",
        3,
        "the position is 130.5 mm",
        "0 to 130 mm",
    ),
    (
        "move --rig RIG 1e3",
        2,
        "has an exponent",
        "write all digits",
    ),
    (
        "move --rig RIG 60 --speed-mm-s 0",
        3,
        "the speed is 0 mm/s",
        "mm/s",
    ),
    (
        "move --rig RIG 60 --speed-mm-s 500",
        3,
        "the speed is 500 mm/s",
        "to 49 mm/s",
    ),
    ("hold --rig RIG", 3, "no run is moving", "nothing was moved"),
    ("resume --rig RIG", 3, "no run is held", "nothing was moved"),
    (
        "ack --rig RIG",
        3,
        "no fault is latched",
        "nothing was moved",
    ),
    // Settings.
    (
        "settings --rig RIG get nothing",
        2,
        "there is no setting `nothing`",
        "settings list",
    ),
    (
        "settings --rig RIG set lead_um 4.5",
        2,
        "lead_um cannot be 4.5",
        "500 to 50000 um",
    ),
    (
        "settings --rig RIG set lead_um -4",
        2,
        "lead_um cannot be -4",
        "500 to 50000 um",
    ),
    (
        "settings --rig RIG set lead_um 0",
        3,
        "lead_um is 0",
        "500 to 50000",
    ),
    (
        "settings --rig RIG set lead_um 99999999999999999999",
        3,
        "lead_um is 9",
        "500 to 50000",
    ),
    (
        "settings --rig RIG set microsteps 3",
        3,
        "microsteps",
        "power of two",
    ),
    (
        "settings --rig RIG set microsteps 256",
        3,
        "max_step_hz",
        "nothing was changed",
    ),
    (
        "settings --rig RIG name 0123456789012345678901234",
        2,
        "the name has 25 bytes",
        "24 are allowed",
    ),
    (
        "settings --rig RIG import /no/such/file",
        2,
        "No such file",
        "settings export",
    ),
    (
        "settings --rig RIG import /dev/zero",
        2,
        "more than 64 KiB",
        "settings export",
    ),
    (
        "settings --rig RIG import /etc/passwd",
        2,
        "line 1 column 1",
        "settings export",
    ),
    (
        "settings --rig RIG import /",
        2,
        "Is a directory",
        "settings export",
    ),
    (
        "settings --rig RIG export /no/such/folder/file",
        1,
        "No such file",
        "choose a file in a folder",
    ),
    (
        "settings --rig RIG export /etc/passwd",
        3,
        "exists already",
        "--force",
    ),
    (
        "settings --rig RIG reset",
        3,
        "was not confirmed",
        "settings reset --yes",
    ),
    // Commissioning.
    (
        "commission --rig RIG rig",
        3,
        "somebody at a terminal",
        "--yes",
    ),
    (
        "commission --rig RIG rig --strokes 3 --yes",
        2,
        "invalid value '3'",
        "an even number from 2 to 20000",
    ),
    (
        "commission --rig RIG rig --clock-s 0 --yes",
        2,
        "0 is not in 1 to 3600",
        "--help",
    ),
    (
        "commission --rig RIG rig --yes --hands 127.0.0.1:1",
        2,
        "no hands at 127.0.0.1:1",
        "virtual-bench serve",
    ),
    // Without a machine.
    ("plan --microsteps 3", 3, "3 microsteps", "use 1, 2, 4"),
    ("plan --lead-mm 0", 3, "a lead of 0 mm", "0.5 to 50 mm"),
    (
        "plan --edges /no/such/folder/e.csv",
        1,
        "No such file",
        "choose a file in a folder",
    ),
    (
        "design --alpha-deg 40",
        2,
        "alpha = 40 deg is not usable",
        "below 33.69 deg",
    ),
    ("design --crescents 33", 2, "33 is not in 1 to 32", "--help"),
    (
        "simulate sweep --frictions 1e12 --pressures-pa 3000",
        2,
        "\"1e12\": has an exponent",
        "write all digits",
    ),
    (
        "simulate sweep --frictions 0.05:0.25 --pressures-pa 3000",
        2,
        "\"0.05:0.25\"",
        "LOW:HIGH:STEP",
    ),
    (
        "man nothing",
        2,
        "there is no subcommand `nothing`",
        "retrograde --help",
    ),
    (
        "list --outcome bogus",
        2,
        "invalid value 'bogus'",
        "link_lost",
    ),
    ("report", 2, "<TRIAL>", "Usage"),
    (
        "report /no/such/file",
        1,
        "No such file",
        "give the JSON file of a trial",
    ),
    (
        "report /etc/passwd",
        1,
        "line 1 column 1",
        "give the JSON file of a trial",
    ),
];

/// The rig's own counters.
fn counters(rig: &str) -> (RigStatus, RunRecord, RigHealth) {
    let address: Address = rig.parse().expect("an address");
    let link = Ports
        .open(DeviceKind::Rig, &address, 115_200, Purpose::Glance)
        .expect("open");
    let mut rig = Device::connect(link, DeviceKind::Rig, Ports.nonce()).expect("a rig");
    (
        rig.rig_status().expect("a status"),
        rig.run_record().expect("a record"),
        rig.call(GetRigHealth).expect("counters"),
    )
}

#[test]
fn each_is_refused_with_its_reason_and_a_way_on_and_nothing_moves() {
    assert!(INPUTS.len() >= 80);
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let before = counters(&bench.address);
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().to_str().expect("UTF-8");
    let mut wrong = String::new();
    for (line, code, says, remedy) in INPUTS {
        let mut args: Vec<_> = line
            .split(' ')
            .map(|word| if word == "RIG" { &bench.address } else { word })
            .collect();
        if line.starts_with("run ") && !line.contains("--out") {
            args.extend(["--out", out]);
        }
        let (got, out, err) = retrograde(&args);
        // These print a result even so: `ack` what it found, `plan` what it calculated.
        let silent = out.is_empty() || line.starts_with("ack") || line.starts_with("plan");
        if got != *code || !err.contains(says) || !err.contains(remedy) || !silent {
            let _ = writeln!(wrong, "{line}: {got} {out:?}\n  {err}");
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
    let after = counters(&bench.address);
    let time_us = before.0.time_us;
    assert_eq!(RigStatus { time_us, ..after.0 }, before.0);
    assert_eq!(after.1, before.1);
    assert_eq!(
        (after.2.underruns, after.2.bad_frames),
        (before.2.underruns, before.2.bad_frames)
    );
    assert_eq!(after.0.position_steps, 0);
    for request in ["SetSetting", "SetName", "FactoryReset"] {
        // Only the rig can judge two of the settings, so it has received and refused these.
        let asked = if request == "SetSetting" { 2 } else { 0 };
        assert_eq!(bench.count(request), asked, "{request}");
    }
}

#[test]
fn with_json_a_wrong_command_line_is_an_object_as_well() {
    for (line, code) in [
        ("--json home extra", 2),
        ("--json run --stroke-mm NaN", 2),
        ("--json move --rig tcp:127.0.0.1:1 5", 4),
        ("--json plan --cycles 0", 2),
    ] {
        let args: Vec<_> = line.split(' ').collect();
        let (got, out, err) = retrograde(&args);
        assert_eq!(got, code, "{line}: {err}");
        let json: Value = serde_json::from_str(&out).expect("one object");
        assert_eq!(
            (&json["ok"], &json["exit_code"]),
            (&false.into(), &code.into())
        );
        let message = json["error"]["message"].as_str().expect("a message");
        assert!(
            !message.is_empty() && !message.starts_with("error"),
            "{out}"
        );
    }
    // Help is not an error.
    let (code, out, _) = retrograde(&["--json", "home", "--help"]);
    assert!(code == 0 && out.contains("Usage: "), "{out}");
}

#[test]
fn a_result_that_cannot_be_written_is_a_failure() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    for args in [
        &["plan"][..],
        &["settings", "list"],
        &["--json", "info"],
        &["health"],
        &["man"],
    ] {
        let full = std::fs::OpenOptions::new().write(true).open("/dev/full");
        let output = bench
            .command(args)
            .stdout(full.expect("there"))
            .output()
            .expect("starts");
        let (code, _, err) = crate::support::bench::read(output);
        assert_eq!(code, Some(1), "{args:?}: {err}");
        assert!(err.contains("standard output"), "{args:?}: {err}");
    }
    // A closed pipe is no error: its reader has read enough.
    for args in [&["plan"][..], &["man", "run"], &["completions", "bash"]] {
        let (reader, writer) = std::io::pipe().expect("a pipe");
        drop(reader);
        let output = bench.command(args).stdout(writer).output();
        let (code, _, err) = crate::support::bench::read(output.expect("starts"));
        assert_eq!(code, Some(0), "{args:?}: {err}");
    }
}

#[test]
fn what_is_reached_already_is_a_success_that_says_so() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let (code, out, err) = retrograde(&["--rig", &bench.address, "move", "0"]);
    assert_eq!(code, 0, "{err}");
    assert_eq!(out, "The carriage is at 0 mm already; nothing moved.\n");
    let bench = Bench::on_tcp(DeviceKind::Capsule);
    let (code, out, err) = bench.retrograde(&["unfold"]);
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("unfolded already"), "{out}");
    assert_eq!(bench.count("Unfold"), 0);
    assert!(!bench.folder.path().join("retrograde-data").exists());
}

#[test]
fn a_folded_capsule_is_not_calibrated_and_told_what_to_do() {
    let bench = Bench::on_tcp(DeviceKind::Capsule);
    let (code, _, err) = bench.retrograde(&["fold", "--thread-mm", "5"]);
    assert_eq!(code, Some(0), "{err}");
    // A capsule at work on its flash is asked again.
    let calibrate = || bench.retrograde(&["capsule", "calibrate"]);
    let (code, _, err) = std::iter::repeat_with(calibrate)
        .take(200)
        .find(|(_, _, err)| !err.contains("within the last half second"))
        .expect("it comes to rest");
    assert_eq!(code, Some(3), "{err}");
    let words = err.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(words.contains("the thread is 4.9"), "{err}");
    assert!(words.contains("allowed is 0 to 1 mm"), "{err}");
    assert!(words.contains("`retrograde unfold`"), "{err}");
    let (code, _, err) = bench.retrograde(&["unfold"]);
    assert_eq!(code, Some(0), "the position is still known: {err}");
}

#[test]
fn one_machine_without_a_fault_does_not_keep_the_other_from_its_acknowledgement() {
    let (rig, capsule) = (
        Bench::on_tcp(DeviceKind::Rig),
        Bench::on_tcp(DeviceKind::Capsule),
    );
    let both = ["--rig", &rig.address, "--capsule", &capsule.address];
    let (code, _, err) = retrograde(&["--capsule", &capsule.address, "estop"]);
    assert_eq!(code, 0, "{err}");
    let (code, out, err) = retrograde(&[&both[..], &["ack"]].concat());
    assert_eq!(code, 0, "{err}");
    assert!(out.contains("no fault is latched"), "{out}");
    assert!(
        out.contains("capsule at tcp:") && out.contains("acknowledged"),
        "{out}"
    );
    let (code, _, err) = retrograde(&[&both[..], &["ack"]].concat());
    assert_eq!(code, 3, "{err}");
    // A missing machine is named, and the other one is still asked.
    retrograde(&["--capsule", &capsule.address, "estop"]);
    let gone = ["--rig", NOBODY, "--capsule", &capsule.address, "ack"];
    let (code, out, _) = retrograde(&gone);
    assert_eq!(code, 4, "{out}");
    assert!(out.contains("acknowledged"), "{out}");
}

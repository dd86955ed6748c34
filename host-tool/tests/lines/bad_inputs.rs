//! Wrong input on the command line, in files and from machines. Each is refused with its reason, a remedy and its
//! exit code, and nothing moves.

use std::fmt::Write as _;

use crate::support::bench::Bench;
use crate::support::offline::retrograde;
use client::Device;
use client::address::Address;
use lab::operations::connector::Ports;
use lab::operations::connector::{Connector as _, LinkPurpose};
use protocol::rig::{GetRigHealth, RigHealth, RigStatus, RunRecord};
use protocol::system::DeviceKind;
use serde_json::Value;

/// An address without a listener.
const NOBODY: &str = "tcp:127.0.0.1:1";

/// Exit code, command line, part of the message, part of the remedy. `RIG` stands for a homed rig at rest.
const INPUTS: &str = r#"
2 | nonsense | unrecognized subcommand | --help
2 | home extra | unexpected argument 'extra' | Usage: retrograde home
2 | home --rig | a value is required for '--rig <WHERE>' | --help
2 | settings | Settings and name of a machine | import
2 | settings set stroke_um 5 --of capsule | stroke_um is not a setting of this machine | --of
2 | settings get end_force_ma --of rig | end_force_ma is not a setting of this machine | --of
2 | fold --thread-mm 5 --indentation-mm 2 | cannot be used with | --help
2 | fold --thread-mm -3 | --thread-mm | --help
2 | fold --indentation-mm 100 | 100 | nothing was sent
2 | --rig RIG stop other | invalid value 'other' | rig, capsule
2 | completions tcsh | invalid value 'tcsh' | bash, elvish
2 | home --rig tcp: | has no host or no port | tcp:127.0.0.1:7001
2 | home --rig tcp:127.0.0.1:99999 | port 99999 does not exist | 1 to 65535
4 | home --rig tcp:127.0.0.1:1 | refused | check host and port
4 | info --rig /dev/retrograde-no-such-port | there is no such port | retrograde doctor
4 | info --rig /dev/null | it is not a serial port | retrograde doctor
2 | info --rig RIG --baud 0 | 0 is not in 300 to 4000000 | --help
4 | info --rig 127.0.0.1:1 | tcp:127.0.0.1:1 | check host and port
4 | info --capsule RIG | is a rig, not a capsule | exchange `--rig` and `--capsule`
3 | run --rig RIG --stroke-mm 0 | more than zero | nothing was sent
3 | run --rig RIG --stroke-mm 131 | at most 130.000 mm | nothing was sent
2 | run --rig RIG --stroke-mm NaN | not a number | 12.5
2 | run --rig RIG --stroke-mm 12,5 | has a comma | write a point
2 | run --rig RIG --stroke-mm 130.0001 | more than 3 decimals | the finest step is 0.001
2 | run --rig RIG --stroke-mm 99999999999999999999 | too large | at most 4294967
3 | run --rig RIG --stroke-mm 0.001 | the stroke is 0.001 mm | 0.002 to 130 mm
2 | run --rig RIG --cycles 0 | '0' | use 1 to 10000
2 | run --rig RIG --cycles 2.5 | not a whole number | write for example 5
3 | run --rig RIG --duration-s 10 | too little time | --duration-s 31.430613
3 | run --rig RIG --duration-s 30 | the axis allows 49 mm/s | give it more time
3 | run --rig RIG --duration-s 10 --accel-mm-s2 2000 | the axis allows 49 mm/s | give it more time
3 | run --rig RIG --speed-mm-s 0 | the speed is zero | at least 0.001 mm/s
3 | run --rig RIG --speed-mm-s 60 | the axis allows 49 mm/s | less speed
2 | run --rig RIG --speed-mm-s 10 --duration-s 40 | cannot be used with | Usage
2 | run --rig RIG --return-speed-mm-s 10 | --speed-mm-s | Usage
2 | run --rig RIG --waves-per-minute 0 | invalid value '0' | use a number above 0
3 | run --rig RIG --waves-per-minute 1000 | too little time | --duration-s 31.430613
2 | run --rig RIG --preset other | invalid value 'other' | paper, wave
2 | run --rig RIG --preset paper --duration-s 3 | cannot be used with | Usage
3 | run --rig RIG --accel-mm-s2 0 | the acceleration is zero | at least 0.001 mm/s2
3 | run --rig RIG --accel-mm-s2 99999 | 99999 mm/s2 | mm/s2
3 | run --rig RIG --start-delay-s 50 | too little time | --duration-s 81.430613
2 | run --rig RIG --telemetry-ms 4 | 4 is not in 5 to 1000 | --help
2 | run --rig RIG --on-link-loss carry-on | invalid value 'carry-on' | stop, finish
1 | run --rig RIG --out /dev/null/x | /dev/null/x | folder
2 | jog --rig RIG | <DIRECTION> | Usage
2 | jog --rig RIG left | invalid value 'left' | away, home
2 | jog --rig RIG away --for-s 0 | invalid value '0' | use a number above 0
3 | jog --rig RIG away --speed-mm-s 0 | the speed is 0 mm/s | mm/s
3 | jog --rig RIG away --speed-mm-s 1000 | the speed is 1000 mm/s | to 49 mm/s
2 | move --rig RIG | <MM> | Usage
3 | move --rig RIG 130.5 | the position is 130.5 mm | 0 to 130 mm
3 | move --rig RIG 60 --speed-mm-s 0 | the speed is 0 mm/s | mm/s
3 | move --rig RIG 60 --speed-mm-s 500 | the speed is 500 mm/s | to 49 mm/s
3 | hold --rig RIG | no run is in progress | nothing was moved
3 | resume --rig RIG | no run is held | nothing was moved
3 | ack --rig RIG | no fault is latched | nothing was moved
3 | settings --rig RIG set microsteps 3 | microsteps | power of two
3 | settings --rig RIG set microsteps 256 | max_step_hz | nothing was changed
2 | settings --rig RIG import /no/such/file | No such file | settings export
2 | settings --rig RIG import /dev/zero | more than 64 KiB | settings export
2 | settings --rig RIG import /etc/passwd | line 1 column 1 | settings export
2 | settings --rig RIG import / | Is a directory | settings export
1 | settings --rig RIG export /no/such/folder/file | No such file | make its folder
3 | settings --rig RIG export /etc/passwd | exists already | --force
3 | settings --rig RIG reset | was not confirmed | settings reset --yes
3 | commission --rig RIG rig | somebody at a terminal | --yes
2 | commission --rig RIG rig --strokes 3 --yes | invalid value '3' | an even number from 2 to 20000
2 | commission --rig RIG rig --clock-s 0 --yes | 0 is not in 1 to 3600 | --help
2 | commission --rig RIG rig --yes --fixture 127.0.0.1:1 | no fixture at 127.0.0.1:1 | virtual-bench serve
3 | plan --microsteps 3 | 3 microsteps | use 1, 2, 4
3 | plan --lead-mm 0 | a lead of 0 mm | 0.5 to 50 mm
1 | plan --edges /no/such/folder/e.csv | No such file | make its folder
2 | design --alpha-deg 40 | alpha = 40 deg is not usable | below 33.69 deg
2 | design --crescents 33 | 33 is not in 1 to 32 | --help
2 | simulate sweep --frictions 1e12 --pressures-pa 3000 | "1e12": has an exponent | write all digits
2 | simulate sweep --frictions 0.05:0.25 --pressures-pa 3000 | "0.05:0.25" | LOW:HIGH:STEP
2 | man nothing | there is no subcommand `nothing` | retrograde --help
2 | report | <TRIAL> | Usage
1 | report /etc/passwd | line 1 column 1 | give the JSON file of a trial
"#;

/// The rig's own counters.
fn counters(rig: &str) -> (RigStatus, RunRecord, RigHealth) {
    let address: Address = rig.parse().expect("an address");
    let link = Ports
        .open(DeviceKind::Rig, &address, 115_200, LinkPurpose::Glance)
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
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let before = counters(&bench.address);
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().to_str().expect("UTF-8");
    let mut wrong = String::new();
    for row in INPUTS.lines().skip(1) {
        let columns: Vec<_> = row.split(" | ").collect();
        let [code, line, says, remedy] = columns[..] else {
            panic!("{row}");
        };
        let mut args: Vec<_> = line
            .split(' ')
            .map(|word| match word {
                "RIG" => bench.address.as_str(),
                word => word,
            })
            .collect();
        if line.starts_with("run ") && !line.contains("--out") {
            args.extend(["--out", out]);
        }
        let (got, out, err) = retrograde(&args);
        // These print a result even so: `ack` what it found, `plan` what it calculated.
        let silent = out.is_empty() || line.starts_with("ack") || line.starts_with("plan");
        if got.to_string() != code || !err.contains(says) || !err.contains(remedy) || !silent {
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
    assert!(words.contains("allowed is 0 to 0.5 mm"), "{err}");
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

//! A disk that fills up: in the middle of a run it is reported at once, and the rig's record of the run is not lost; a
//! recording that does not fit leaves no part of its file.

use crate::support::bench::{Bench, read, with_little_space};
use protocol::system::DeviceKind;

#[test]
fn a_disk_that_fills_in_mid_run_is_told_at_once_and_the_verdict_is_not_lost() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let run = [
        "run",
        "--cycles",
        "1",
        "--stroke-mm",
        "20",
        "--duration-s",
        "5.6",
    ];
    let (code, out, err) = read(
        with_little_space(&bench.command(&run), 8_192)
            .output()
            .expect("starts"),
    );
    assert_eq!(code, Some(1), "{out}{err}");
    let told = out.find("NOT RECORDED from here on").expect(&out);
    assert!(
        out[told..].contains(" s of 5.6 s"),
        "not before the end: {out}"
    );
    assert_eq!(out.matches("NOT RECORDED").count(), 1, "{out}");
    assert!(
        err.contains("the run ended as Complete after 2 strokes and 32000 steps; but"),
        "{err}"
    );
    // The sidecar is small enough to be written, and reports both.
    let trial = bench.trial();
    assert_eq!(trial["status"], "complete");
    let error = trial["error"].as_str().expect("a reason");
    assert!(
        error.contains("the telemetry was not recorded whole"),
        "{error}"
    );
    // Regression: every reader but one took it for whole.
    let folder = bench.folder.path().join("retrograde-data");
    let (code, out, err) = bench.retrograde(&["verify", folder.to_str().expect("UTF-8")]);
    assert_eq!(code, Some(1), "{out}{err}");
    assert!(
        out.contains("json: the telemetry was not recorded whole: "),
        "{out}"
    );
    // A full disk must not stop the rig.
    assert!(bench.urgent().is_empty());
}

/// Regression: a part of the file stayed, and the same command was refused because it was there.
#[test]
fn a_recording_that_does_not_fit_leaves_no_part_of_its_file() {
    let bench = Bench::on_tcp(DeviceKind::Capsule);
    let file = bench.folder.path().join("force.csv");
    let path = file.to_str().expect("UTF-8");
    // A few samples fit, and 4,200 readings do not.
    let fold = ["fold", "--telemetry-ms", "1000", "--trace", path];
    let (code, out, err) = read(
        with_little_space(&bench.command(&fold), 8_192)
            .output()
            .expect("starts"),
    );
    assert_eq!(code, Some(1), "{out}{err}");
    assert!(err.contains("force.csv"), "{err}");
    assert_eq!(bench.trial()["status"], "complete");
    assert!(!file.exists(), "{out}{err}");
}

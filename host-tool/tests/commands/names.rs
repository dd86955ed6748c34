//! Names of files and folders that are not Unicode: an old disk or another system has such ones.
#![cfg(unix)]

use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt as _;

use crate::support::bench::Bench;
use protocol::system::DeviceKind;
use serde_json::Value;

/// JSON cannot hold a path that is not Unicode. The result shows U+FFFD in it, and is a result all the same.
#[test]
fn a_path_that_is_not_unicode_ends_no_command() {
    let rig = Bench::on_tcp(DeviceKind::Rig);
    let strange = OsStr::from_bytes(b"e\xfft");
    let json = |args: &[&str], path: &OsStr| {
        let mut command = rig.command(&[&["--json"], args].concat());
        let output = command.arg(path).output().expect("starts");
        let err = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{args:?}: {err}");
        serde_json::from_slice::<Value>(&output.stdout).expect("JSON")
    };
    let run = [
        "run",
        "--cycles",
        "1",
        "--stroke-mm",
        "10",
        "--duration-s",
        "3",
        "--out",
    ];
    let ran = json(&run, strange);
    let sidecar = ran["sidecar"].as_str().expect("a path");
    assert!(sidecar.starts_with("e\u{fffd}t/run-"), "{ran}");
    let fetched = json(&["records", "fetch", "rig", "--out"], strange);
    assert!(fetched["rig"].is_string(), "{fetched}");
    let reported = json(&["report", "--out", "page.html"], strange);
    assert_eq!(reported["trials"][0], ran["sidecar"], "{reported}");
    assert!(reported["omitted"][0]["path"].is_string(), "{reported}");
    let examples = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/paper.toml");
    let study = OsStr::from_bytes(b"study-\xff");
    let made = json(&["campaign", "new", examples, "--out"], study);
    assert_eq!(made["folder"], "study-\u{fffd}");
    json(&["campaign", "status"], study);
    let page = json(&["report"], study);
    assert!(
        page["page"].is_string() && page["files"][0].is_string(),
        "{page}"
    );
    assert!(
        page["page"]
            .as_str()
            .is_some_and(|page| page.starts_with("study-"))
    );

    let drawn = json(&["plan", "--plot"], OsStr::from_bytes(b"p\xff.svg"));
    assert_eq!(drawn["plot"], "p\u{fffd}.svg");
    let drawn = json(&["design", "--svg"], OsStr::from_bytes(b"d\xff.svg"));
    assert_eq!(drawn["svg"], "d\u{fffd}.svg");
    // The files have the names that were asked for.
    let here = rig.locks().parent().expect("a folder").to_owned();
    assert!(fs::exists(here.join(OsStr::from_bytes(b"p\xff.svg"))).expect("known"));
}

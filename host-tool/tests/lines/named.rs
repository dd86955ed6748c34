//! Machines called by name: the file gives the address, and the rig must carry the name.

use crate::support::bench::Bench;
use protocol::system::{DeviceKind, Urgent};
use serde_json::Value;

fn write(bench: &Bench, text: &str) {
    std::fs::write(bench.folder.path().join("machines.toml"), text).expect("written");
}

#[test]
fn a_rig_is_called_by_the_name_that_it_carries_and_by_no_other() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    write(
        &bench,
        &format!("[rigs]\nleft-bench = \"{}\"\n", bench.address),
    );
    let left = |args: &[&str]| bench.retrograde(&[&["--rig", "left-bench"], args].concat());
    let (code, _, err) = left(&["home"]);
    assert_eq!(code, Some(4), "{err}");
    for says in [
        "carries no name",
        &bench.address,
        "settings name left-bench",
    ] {
        assert!(err.contains(says), "{says}: {err}");
    }
    assert_eq!(left(&["settings", "name", "right-bench"]).0, Some(0));
    for args in [
        &["home"][..],
        &["run"],
        &["info"],
        &["hold"],
        &["settings", "list"],
    ] {
        let (code, _, err) = left(args);
        assert_eq!(code, Some(4), "{args:?}: {err}");
        assert!(
            err.contains("`right-bench`, not `left-bench`"),
            "{args:?}: {err}"
        );
    }
    assert_eq!(
        (bench.count("Home"), bench.count("Run"), bench.count("Hold")),
        (0, 0, 0)
    );
    let (code, out, _) = left(&["doctor"]);
    assert_eq!(code, Some(4));
    assert!(out.contains("other_name"), "{out}");
    // A busy computer may take longer than a second to connect.
    let says = |seconds: &str| {
        let (_, out, _) = left(&["watch", "--for-s", seconds]);
        out.contains("`right-bench`, not `left-bench`")
    };
    assert!(
        ["1", "5", "20"].into_iter().any(says),
        "it watches the other one"
    );
    // A stop does not check the name.
    let (code, out, err) = left(&["stop"]);
    assert_eq!(code, Some(0), "{out}{err}");
    assert_eq!(bench.urgent().last(), Some(&Urgent::Stop));
    assert_eq!(left(&["settings", "name", "left-bench"]).0, Some(0));
    let (code, _, err) = left(&["home"]);
    assert_eq!(code, Some(0), "{err}");
    // By its address, the machine may have any name.
    assert_eq!(bench.retrograde(&["info"]).0, Some(0));
    // The name is checked through another process's door, too.
    let run = bench.run(&["--cycles", "1", "--stroke-mm", "20", "--duration-s", "3"]);
    let (code, out, err) = left(&["info"]);
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("Running"), "{out}");
    assert!(run.wait_with_output().expect("ends").status.success());
}

/// Regression: the command that gives the name was shown without quotes, and refused.
#[test]
fn the_remedy_for_a_wrong_name_can_be_pasted_although_the_name_has_a_blank() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    write(
        &bench,
        &format!("[rigs]\n\"right bench\" = \"{}\"\n", bench.address),
    );
    let (code, _, err) = bench.retrograde(&["--rig", "right bench", "home"]);
    assert_eq!(code, Some(4), "{err}");
    let words = err.split_whitespace().collect::<Vec<_>>().join(" ");
    let pasted = "`retrograde --rig 'right bench' settings name 'right bench'`";
    assert!(words.contains(pasted), "{words}");
}

#[test]
fn devices_shows_every_configured_place() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let text = format!(
        "[rigs]\nleft-bench = \"{}\"\nold = \"/dev/retrograde-no-such-port\"\n[capsules]\nblue = \"tcp:127.0.0.1:1\"\n",
        bench.address
    );
    write(&bench, &text);
    let (code, out, err) = bench.retrograde(&["devices"]);
    assert_eq!(code, Some(0), "{err}");
    for says in [
        &format!("left-bench: rig at {}: rig, UID abab", bench.address)[..],
        "carries no name, and should be `left-bench`",
        "old: rig at /dev/retrograde-no-such-port: cannot open",
        "blue: capsule at tcp:127.0.0.1:1: cannot open",
    ] {
        assert!(out.contains(says), "{says}: {out}");
    }
    let (_, out, _) = bench.retrograde(&["devices", "--json"]);
    let result: Value = serde_json::from_str(&out).expect("JSON");
    let configured = result["configured"].as_array().expect("a list");
    // The place from the environment comes first.
    assert_eq!(configured.len(), 3, "{out}");
    assert_eq!(configured[0]["name"], "left-bench");
    assert_eq!(configured[0]["carried_name"], "");
    assert_eq!(configured[0]["identity"]["device"], "rig");
    assert_eq!(
        configured[1]["error"]
            .as_str()
            .map(|why| why.contains("no such port")),
        Some(true)
    );
    // A file without names.
    write(&bench, "");
    let (_, out, _) = bench.retrograde(&["devices"]);
    let unnamed = format!("(no name): rig at {}: rig, UID abab", bench.address);
    assert!(out.contains(&unnamed), "{out}");
}

#[test]
fn a_file_that_cannot_be_used_is_told_and_keeps_nobody_from_working_without_names() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    write(&bench, "[rigs]\nleft-bench = 7\n");
    let (code, _, err) = bench.retrograde(&["--rig", "left-bench", "info"]);
    assert_eq!(code, Some(2), "{err}");
    assert!(
        err.contains("machines.toml") && err.contains("line 2"),
        "{err}"
    );
    let (code, _, err) = bench.retrograde(&["--rig", "left-bench", "estop"]);
    assert_eq!(code, Some(8), "{err}");
    assert!(
        err.contains("NOT DELIVERED") && err.contains("machines.toml"),
        "{err}"
    );
    let (code, out, err) = bench.retrograde(&["devices"]);
    assert_eq!(code, Some(0), "{out}");
    assert!(err.contains("warning: no names"), "{err}");
    assert_eq!(bench.retrograde(&["info"]).0, Some(0));
    // A name that is not in the file.
    write(&bench, "");
    let (code, _, err) = bench.retrograde(&["--rig", "left-bench", "info"]);
    assert_eq!(code, Some(4), "{err}");
    assert!(
        err.contains("machines.toml has to say where that is"),
        "{err}"
    );
    let (code, _, err) = bench.retrograde(&["--rig", "left-bench", "estop"]);
    assert_eq!(code, Some(8), "{err}");
}

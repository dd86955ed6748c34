//! A machine made for one command is made ready in that command; a real one never is.

use std::sync::{Arc, Mutex};

use crate::support::tool;
use client::address::Address;
use client::link::{Link, OpenError};
use jiff::Timestamp;
use lab::operations::connector::{Connector, LinkPurpose};
use protocol::system::DeviceKind;
use simulated_machines::machine::{Log, Script, link};

/// Creates a new machine at every address.
#[derive(Default)]
struct New(Mutex<Vec<Arc<Mutex<Log>>>>);

impl New {
    fn run(&self, args: &[&str]) -> (u8, String, String) {
        let folder = tempfile::tempdir().expect("a folder");
        let out = folder.path().to_str().expect("UTF-8");
        let mut line = args.to_vec();
        if ["run", "fold", "unfold", "capsule"].contains(&args[2]) {
            line.extend(["--out", out]);
        }
        tool::run(self, &line)
    }
}

impl Connector for New {
    fn open(
        &self,
        kind: DeviceKind,
        _: &Address,
        _: u32,
        _: LinkPurpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        let (link, log) = link(Script::new(kind));
        self.0.lock().expect("free").push(log);
        Ok(link)
    }

    fn is_created_on_open(&self, address: &Address) -> bool {
        *address == Address::Virtual
    }

    fn nonce(&self) -> u32 {
        1
    }

    fn now(&self) -> Timestamp {
        Timestamp::UNIX_EPOCH
    }
}

#[test]
fn a_virtual_machine_is_homed_or_referenced_in_the_same_command() {
    for (args, says, does) in [
        (
            &["--rig", "virtual", "run", "--cycles", "1"][..],
            "homes first",
            "Run",
        ),
        (&["--rig", "virtual", "move", "5"], "homes first", "MoveTo"),
        (
            &["--rig", "virtual", "jog", "away", "--for-s", "0.2"],
            "homes first",
            "Jog",
        ),
        (
            &["--capsule", "virtual", "fold"],
            "referenced first",
            "Fold",
        ),
        (
            &["--capsule", "virtual", "capsule", "cycle", "--count", "1"],
            "referenced first",
            "Unfold",
        ),
    ] {
        let new = New::default();
        let (code, out, err) = new.run(args);
        assert_eq!(code, 0, "{args:?}: {out}{err}");
        assert!(out.contains(says), "{args:?}: {out}");
        let logs = new.0.lock().expect("free");
        assert_eq!(logs.len(), 1, "one machine for the whole command");
        let executed = &logs[0].lock().expect("free").executed;
        assert!(executed.contains(&does), "{executed:?}");
    }
}

/// The command has homed before: only the refused request moved nothing.
#[test]
fn a_refusal_after_the_homing_does_not_deny_it() {
    let new = New::default();
    let (code, out, err) = new.run(&["--rig", "virtual", "move", "130.5"]);
    assert_eq!(code, 3, "{out}{err}");
    assert!(
        out.contains("homes first") && err.contains("nothing was moved by this request"),
        "{out}{err}"
    );
}

#[test]
fn a_real_machine_is_not() {
    for (args, first) in [
        (&["--rig", "/dev/real", "run", "--cycles", "1"][..], "Home"),
        (&["--rig", "/dev/real", "move", "5"], "Home"),
        (&["--rig", "/dev/real", "jog", "away"], "Home"),
        (&["--capsule", "/dev/real", "fold"], "Reference"),
    ] {
        let new = New::default();
        let (code, out, err) = new.run(args);
        assert_eq!(code, 3, "{args:?}: {out}{err}");
        let logs = new.0.lock().expect("free");
        let executed = &logs[0].lock().expect("free").executed;
        assert!(!executed.contains(&first), "{args:?}: {executed:?}");
    }
}

/// `retrograde` in a folder of its own, and then beside a bench that tells how it was called.
#[cfg(unix)]
#[test]
fn the_tool_hands_a_virtual_machine_to_the_bench_beside_it() {
    use std::fs::hard_link;
    use std::os::unix::fs::symlink;
    use std::process::Command;

    // Links, because a program that was written a moment ago may still be open for writing in another test's child.
    let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a folder");
    let tool = folder.path().join("retrograde");
    hard_link(env!("CARGO_BIN_EXE_retrograde"), &tool).expect("on the same disk");
    let called = |args: &[&str]| {
        let output = Command::new(&tool)
            .args(args)
            .env("RETROGRADE_RIG", "virtual")
            .env_remove("RETROGRADE_CAPSULE")
            .env("RETROGRADE_RUNTIME_DIR", folder.path().join("locks"))
            .output()
            .expect("started");
        let text = [output.stdout, output.stderr].concat();
        let text = String::from_utf8(text).expect("UTF-8");
        (output.status.code(), text)
    };
    let (code, text) = called(&["home"]);
    assert_eq!(code, Some(4), "{text}");
    assert!(text.contains("cargo build -p virtual-bench"), "{text}");
    symlink("/bin/echo", folder.path().join("virtual-bench")).expect("linked");
    let told = (Some(0), "retrograde home --json\n".to_owned());
    assert_eq!(called(&["home", "--json"]), told);
    // The command line counts, not the environment that it overrides.
    let (code, text) = called(&["home", "--rig", "tcp:127.0.0.1:1"]);
    assert_eq!(code, Some(4), "{text}");
}

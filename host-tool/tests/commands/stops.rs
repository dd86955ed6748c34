//! Stops go to all machines at once, and the result of each is reported.

use std::net::TcpListener;
use std::sync::{Condvar, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use crate::support::tool::{Memory, ready};
use client::address::Address;
use client::link::{Link, LinkError, OpenError, Reason};
use host_tool::cli::run_on;
use jiff::Timestamp;
use operations::connector::{Candidate, Connector, Ports, Purpose};
use protocol::system::DeviceKind;
use serde_json::Value;
use simulated_machines::machine::{Script, link};

/// Ports `dead...`, which never take a byte, and `live`. The dead ones open only after the live one, so a stop that
/// asks one after the other never reaches it.
struct Hall {
    ports: Vec<&'static str>,
    live: Mutex<bool>,
    opened: Condvar,
}

impl Hall {
    fn with(ports: &[&'static str]) -> Self {
        Self {
            ports: ports.to_vec(),
            live: Mutex::new(!ports.contains(&"live")),
            opened: Condvar::new(),
        }
    }

    fn run(&self, args: &[&str]) -> (u8, String, String) {
        let args = std::iter::once("retrograde").chain(args.iter().copied());
        let (mut out, mut err) = (vec![], vec![]);
        let code = run_on(args.map(Into::into), self, &mut out, &mut err, false);
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("UTF-8");
        (code, text(out), text(err))
    }
}

impl Connector for Hall {
    fn open(
        &self,
        _: DeviceKind,
        address: &Address,
        _: u32,
        _: Purpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        let place = address.to_string();
        if place == "live" {
            *self.live.lock().expect("free") = true;
            self.opened.notify_all();
            return Ok(link(ready(DeviceKind::Rig)).0);
        }
        let live = self.live.lock().expect("free");
        let (live, _) = self
            .opened
            .wait_timeout_while(live, Duration::from_secs(30), |live| !*live)
            .expect("free");
        assert!(*live, "{place} is asked first, and `live` waits for it");
        match place.as_str() {
            "dead and gone" => Err(OpenError {
                place,
                reason: Reason::Absent,
                why: "there is no such port".to_owned(),
                remedy: "start the server first".to_owned(),
            }),
            _ => Ok(Box::new(Mute(Instant::now()))),
        }
    }

    fn candidates(&self) -> Vec<Candidate> {
        let candidate = |port: &&str| Candidate {
            address: Address::Serial((*port).to_owned()),
            kind: None,
            description: "memory".to_owned(),
            may_ask: true,
        };
        self.ports.iter().map(candidate).collect()
    }

    fn nonce(&self) -> u32 {
        1
    }

    fn now(&self) -> Timestamp {
        Timestamp::UNIX_EPOCH
    }
}

/// Takes bytes and never answers, in real time.
struct Mute(Instant);

impl Link for Mute {
    fn place(&self) -> String {
        "mute".to_owned()
    }
    fn now_us(&self) -> u64 {
        self.0.elapsed().as_micros() as u64
    }
    fn send(&mut self, _: &[u8]) -> Result<(), LinkError> {
        Ok(())
    }
    fn receive(&mut self, _: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        let left_us = deadline_us.saturating_sub(self.now_us());
        thread::sleep(Duration::from_micros(left_us));
        Ok(0)
    }
}

#[test]
fn a_live_machine_does_not_wait_for_dead_ones() {
    for args in [&["stop"][..], &["estop"]] {
        let hall = Hall::with(&["dead and gone", "dead", "live"]);
        let (code, out, err) = hall.run(args);
        // The worst of the three results gives the exit code.
        assert_eq!(code, 8, "{err}");
        // On a slow computer there are also lines about those that have not confirmed yet.
        let lines = out.lines().filter(|line| !line.contains("NOT YET"));
        let lines: Vec<_> = lines.collect();
        assert_eq!(lines.len(), 3, "{out}");
        assert!(
            lines.iter().any(|line| line.starts_with("test rig: ")),
            "{out}"
        );
        for says in [
            "machine at dead and gone: NOT DELIVERED: ",
            "machine at dead: sent, NOT CONFIRMED: ",
        ] {
            assert!(out.contains(says), "{out}");
        }
        assert!(err.contains("cut the motor supply NOW"), "{err}");
        assert!(err.contains("Ctrl-C twice"), "{err}");
    }
}

#[test]
fn each_ending_of_a_stop_has_its_exit_code_and_its_name() {
    let dead = Script {
        dead: true,
        ..ready(DeviceKind::Capsule)
    };
    let memory = Memory::with(vec![ready(DeviceKind::Rig), dead]);
    for (args, code, outcomes) in [
        (&["--rig", "0"][..], 0, &["stopped"][..]),
        (&["--capsule", "1"], 7, &["not_confirmed"]),
        (
            &["--rig", "0", "--capsule", "1"],
            7,
            &["stopped", "not_confirmed"],
        ),
    ] {
        let (got, out, err) = memory.run(&[args, &["--json", "stop"]].concat());
        assert_eq!(got, code, "{err}");
        let json: Value = serde_json::from_str(&out).expect("one object");
        let mut said: Vec<_> = json["machines"]
            .as_array()
            .expect("machines")
            .iter()
            .map(|machine| machine["outcome"].as_str().expect("a name"))
            .collect();
        said.sort_unstable_by_key(|outcome| *outcome != "stopped");
        assert_eq!(said, outcomes, "{out}");
    }
}

#[test]
fn what_was_not_delivered_is_not_told_to_start_a_server() {
    let lines = [
        &["--rig", "tcp:127.0.0.1:1", "estop"][..],
        &["--rig", "/dev/retrograde-no-such-port", "stop"],
        &["--capsule", "virtual", "stop", "capsule"],
    ];
    for line in lines {
        let args = std::iter::once("retrograde").chain(line.iter().copied());
        let (mut out, mut err) = (vec![], vec![]);
        let code = run_on(args.map(Into::into), &Ports, &mut out, &mut err, false);
        let err = String::from_utf8(err).expect("UTF-8");
        assert_eq!(code, 8, "{err}");
        assert!(err.contains("NOT DELIVERED"), "{err}");
        assert!(err.contains("cut the motor supply NOW"), "{err}");
        for wrong in ["start the server", "by itself"] {
            assert!(!err.contains(wrong), "{err}");
        }
    }
    let (code, _, err) = Memory::with(vec![]).run(&["estop"]);
    assert_eq!(code, 8, "{err}");
    assert!(err.contains("NOT DELIVERED to any machine"), "{err}");
}

#[test]
fn a_machine_that_is_silent_on_tcp_has_not_confirmed() {
    // The system accepts the connections, but no program reads.
    let mute = [(); 2].map(|()| TcpListener::bind("127.0.0.1:0").expect("a free port"));
    let [rig, capsule] = mute
        .each_ref()
        .map(|mute| format!("tcp:{}", mute.local_addr().expect("bound")));
    let line = ["retrograde", "--rig", &rig, "--capsule", &capsule, "estop"];
    let (mut out, mut err) = (vec![], vec![]);
    let code = run_on(line.map(Into::into), &Ports, &mut out, &mut err, false);
    let out = String::from_utf8(out).expect("UTF-8");
    assert_eq!(code, 7, "{out}");
    assert_eq!(out.matches("sent, NOT CONFIRMED").count(), 2, "{out}");
}

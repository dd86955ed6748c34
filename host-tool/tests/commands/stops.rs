//! Stops go to all machines at once, and the result of each is reported.

use std::net::TcpListener;
use std::sync::{Arc, Condvar, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use crate::support::tool::{self, Memory, ready};
use client::address::Address;
use client::link::{Link, LinkError, OpenError, Reason};
use jiff::Timestamp;
use lab::operations::connector::{Candidate, Connector, LinkPurpose, Ports};
use protocol::settings::SettingKey;
use protocol::system::{DeviceKind, Urgent};
use serde_json::Value;
use simulated_machines::machine::{Log, Script, link};

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
        tool::run(self, args)
    }
}

impl Connector for Hall {
    fn open(
        &self,
        _: DeviceKind,
        address: &Address,
        _: u32,
        _: LinkPurpose,
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
        let (code, _, err) = tool::run(&Ports, line);
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

/// Regression: one address that could not be read kept the stop from every machine.
#[test]
fn an_address_that_cannot_be_read_keeps_no_stop_from_the_other_machine() {
    for (bad, why) in [
        ("tcp:localhost", "has no host or no port"),
        ("tcp:host:99999", "port 99999 does not exist"),
        ("", "empty: use"),
    ] {
        let memory = Memory::with(vec![ready(DeviceKind::Rig)]);
        let at = ["--rig", "0", "--capsule", bad];
        let (code, out, err) = memory.run(&[&at[..], &["estop"]].concat());
        assert_eq!(code, 8, "{err}");
        let told = format!("capsule at {bad}: NOT DELIVERED: ");
        for says in ["test rig: emergency stop latched", &told, why] {
            assert!(out.contains(says), "{says}: {out}");
        }
        assert!(err.contains("cut the motor supply NOW"), "{err}");
        let (code, out, _) = memory.run(&[&at[..], &["--json", "stop"]].concat());
        let json: Value = serde_json::from_str(&out).expect("one object");
        let outcome = |nth: usize| json["machines"][nth]["outcome"].as_str();
        assert_eq!(
            (code, outcome(0), outcome(1)),
            (8, Some("stopped"), Some("not_delivered"))
        );
        // Whoever means the rig alone has been told all.
        assert_eq!(memory.run(&[&at[..], &["stop", "rig"]].concat()).0, 0);
        assert_eq!(memory.run(&[&at[..], &["stop", "capsule"]].concat()).0, 8);
        let logs = memory.logs.lock().expect("logs");
        let urgent = logs
            .iter()
            .flat_map(|log| log.lock().expect("log").urgent.clone());
        let urgent: Vec<_> = urgent.map(|(urgent, _)| urgent).collect();
        assert_eq!(urgent, [Urgent::EStop, Urgent::Stop, Urgent::Stop]);
        // Any other command is refused as before.
        drop(logs);
        let (code, _, err) = memory.run(&[&at[..], &["info"]].concat());
        let says = format!("error: invalid value '{bad}' for '--capsule <WHERE>': ");
        assert!(code == 2 && err.starts_with(&says), "{err}");
        assert!(
            err.ends_with("For more information, try '--help'.\n"),
            "{err}"
        );
    }
}

/// A test that does not name both machines must not reach those of the person who runs it.
#[test]
fn no_test_reaches_a_machine_of_the_environment() {
    let machine = TcpListener::bind("127.0.0.1:0").expect("a free port");
    machine.set_nonblocking(true).expect("set");
    let place = format!("tcp:{}", machine.local_addr().expect("bound"));
    let test = "stops::what_was_not_delivered_is_not_told_to_start_a_server";
    let program = std::env::current_exe().expect("known");
    let output = std::process::Command::new(program)
        .args(["--exact", test])
        .env("RETROGRADE_RIG", &place)
        .env("RETROGRADE_CAPSULE", &place)
        .output()
        .expect("starts");
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(said.contains("1 passed"), "{said}");
    assert!(machine.accept().is_err(), "it was sent a stop");
}

/// A variable that a script leaves empty says nothing.
#[test]
fn an_empty_variable_counts_as_not_set() {
    let place = tempfile::tempdir().expect("a folder");
    let with = |rig: &str, args: &[&str]| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_retrograde"));
        command.args(args).current_dir(place.path());
        command
            .env("RETROGRADE_RIG", rig)
            .env("RETROGRADE_CAPSULE", "");
        let output = command.output().expect("starts");
        let err = String::from_utf8_lossy(&output.stderr).into_owned();
        (output.status.code(), err)
    };
    for args in [&["completions", "bash"][..], &["plan"]] {
        let (code, err) = with("", args);
        assert_eq!(code, Some(0), "{err}");
    }
    let (code, err) = with("", &["plan", "--rig", ""]);
    assert!(code == Some(2) && err.contains("empty: use"), "{err}");
    let (code, err) = with("tcp:localhost", &["estop"]);
    assert_eq!(code, Some(8), "{err}");
    assert!(
        err.contains("NOT DELIVERED to rig at tcp:localhost"),
        "{err}"
    );
    assert!(!err.contains("capsule"), "{err}");
}

#[test]
fn a_machine_that_is_silent_on_tcp_has_not_confirmed() {
    // The system accepts the connections, but no program reads.
    let mute = [(); 2].map(|()| TcpListener::bind("127.0.0.1:0").expect("a free port"));
    let [rig, capsule] = mute
        .each_ref()
        .map(|mute| format!("tcp:{}", mute.local_addr().expect("bound")));
    let (code, out, _) = tool::run(&Ports, &["--rig", &rig, "--capsule", &capsule, "estop"]);
    assert_eq!(code, 7, "{out}");
    assert_eq!(out.matches("sent, NOT CONFIRMED").count(), 2, "{out}");
}

/// A line that takes nothing for 30 ms, after which another process has sent a stop.
struct Interrupted {
    link: Box<dyn Link>,
    from_us: u64,
    urgent: Option<Urgent>,
}

impl Interrupted {
    fn is_over(&self) -> bool {
        self.link.now_us() >= self.from_us + 30_000
    }
}

impl Link for Interrupted {
    fn place(&self) -> String {
        self.link.place()
    }
    fn now_us(&self) -> u64 {
        self.link.now_us()
    }
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        match self.now_us() < self.from_us || self.is_over() {
            true => self.link.send(bytes),
            false => Ok(()),
        }
    }
    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        self.link.receive(buffer, deadline_us)
    }
    fn stopped(&mut self) -> Option<Urgent> {
        self.urgent.filter(|_| self.is_over())
    }
    fn forget_stop(&mut self) {
        self.urgent = None;
    }
}

struct Prompter {
    from_us: u64,
    urgent: Urgent,
    log: Mutex<Option<Arc<Mutex<Log>>>>,
}

impl Prompter {
    fn new(from_us: u64, urgent: Urgent) -> Self {
        Self {
            from_us,
            urgent,
            log: Mutex::default(),
        }
    }

    /// Exit code and errors.
    fn run(&self, args: &[&str]) -> (u8, String) {
        let (code, _, err) = tool::run(self, &[&["--rig", "0"], args].concat());
        (code, err)
    }
}

impl Connector for Prompter {
    fn open(
        &self,
        _: DeviceKind,
        _: &Address,
        _: u32,
        _: LinkPurpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        let (link, log) = link(ready(DeviceKind::Rig));
        *self.log.lock().expect("free") = Some(log);
        Ok(Box::new(Interrupted {
            link,
            from_us: self.from_us,
            urgent: Some(self.urgent),
        }))
    }

    fn nonce(&self) -> u32 {
        1
    }

    fn now(&self) -> Timestamp {
        Timestamp::UNIX_EPOCH
    }
}

#[test]
fn an_import_that_is_stopped_says_what_was_set() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("rig.json");
    let text = r#"{"name": "new", "settings": {"dead_man_ms": 350, "stroke_um": 20000, "seek_um_s": 5000}}"#;
    std::fs::write(&file, text).expect("written");
    let import = ["settings", "import", file.to_str().expect("UTF-8")];
    let mut partly = 0;
    for from_us in (0..400_000).step_by(4_000) {
        let prompter = Prompter::new(from_us, Urgent::Stop);
        let (code, err) = prompter.run(&import);
        if code == 0 {
            continue;
        }
        let log = prompter.log.lock().expect("free").clone().expect("a rig");
        let values = log.lock().expect("free").settings();
        for (key, value) in SettingKey::ALL.iter().zip(&values) {
            let told = err.contains(&format!(
                "{} from {} to {value}",
                key.name(),
                key.range().default
            ));
            // A stop may overtake the answer to the last order.
            let last = err.contains(&format!("{}: stopped by the operator", key.name()));
            assert!(
                key.range().default == *value || told || last,
                "{from_us} us: {err}"
            );
            partly += u32::from(told);
        }
    }
    assert!(partly > 0, "no stop came between two settings");
}

/// Regression: a stop from another process took the place of an emergency stop that was not confirmed yet, and the
/// command said that the emergency stop was latched.
#[test]
fn an_emergency_stop_reaches_the_machine_beside_a_stop_from_elsewhere() {
    for from_us in (0..60_000).step_by(2_000) {
        let prompter = Prompter::new(from_us, Urgent::Stop);
        let (code, err) = prompter.run(&["estop", "rig"]);
        let log = prompter.log.lock().expect("free").clone().expect("a rig");
        let urgent = log.lock().expect("free").urgent.clone();
        assert_eq!(code, 0, "{from_us} us: {err}");
        assert!(
            urgent.iter().any(|(urgent, _)| *urgent == Urgent::EStop),
            "{from_us} us: {urgent:?}"
        );
    }
}

/// Whatever was under way when the stop came, an order or a question: the command waits for the end of the motion, and says
/// where the carriage is.
#[test]
fn a_stop_says_where_the_carriage_stands_whatever_it_met() {
    let jog = ["jog", "away", "--speed-mm-s", "10", "--for-s", "2"];
    let to = ["move", "--speed-mm-s", "10", "60"];
    for (urgent, code) in [(Urgent::Stop, 130), (Urgent::EStop, 6)] {
        for (args, from) in [(&jog[..], 0..300_000), (&to, 0..100_000)] {
            for from_us in from.step_by(4_000) {
                let (ended, err) = Prompter::new(from_us, urgent).run(args);
                let all = format!("{urgent:?}, {from_us} us: {err}");
                assert_eq!(ended, code, "{all}");
                // Before there was an order, nothing has moved.
                assert!(
                    !err.contains("not sent, or not repeated") || from_us < 60_000,
                    "{all}"
                );
            }
        }
    }
}

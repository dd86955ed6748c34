//! The program on TCP in real time, and its reactions to the operator's keyboard.
#![cfg(unix)]

#[path = "../support/mod.rs"]
mod support;

use std::io::{BufReader, ErrorKind, Read, Write};
use std::net::TcpListener;
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use crate::support::signal::{Signal, kill};
use host_tool::cli::run_on;
use lab::operations::connector::Ports;
use protocol::system::{DeviceKind, Urgent};
use simulated_machines::link::Peer;
use simulated_machines::machine::pace::{MOST_LATE_US, Pace, TURN_US};
use simulated_machines::machine::{Log, Script, SimulatedMachine};

/// Serves one connection in real time.
fn serve(script: Script) -> (String, Arc<Mutex<Log>>) {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = format!("tcp:{}", listener.local_addr().expect("bound"));
    let (mut machine, log) = SimulatedMachine::new(script);
    thread::spawn(move || {
        let (mut stream, _) = listener.accept().expect("the client");
        stream.set_nonblocking(true).expect("set");
        let mut pace = Pace::new(1);
        let mut bytes = [0; 256];
        loop {
            let count = match stream.read(&mut bytes) {
                Ok(0) => return,
                Ok(count) => count,
                Err(io) if io.kind() == ErrorKind::WouldBlock => 0,
                Err(_) => return,
            };
            let now_us = pace.now_us();
            machine.take(&bytes[..count], now_us);
            if stream.write_all(&machine.give(now_us)).is_err() {
                return;
            }
            pace.rest();
        }
    });
    (address, log)
}

/// Time after which even a slow computer has answered.
const SOON: Duration = Duration::from_secs(60);

fn wait_until(log: &Mutex<Log>, is_so: impl Fn(&Log) -> bool) {
    let begin = Instant::now();
    while !is_so(&log.lock().expect("log")) {
        assert!(begin.elapsed() < SOON, "it does not come so far");
        thread::sleep(Duration::from_millis(2));
    }
}

/// Starts a command, waits until the rig has executed `request` and 0.4 s more, then sends `signals`: each when the
/// stop of the one before has come, because the system makes one of two that come at once. Returns the exit code,
/// standard error, the time to the end by the machine's clock, and the requests that the machine received.
fn signalled(
    args: &[&str],
    request: &str,
    signals: &[Signal],
) -> (Option<i32>, String, Duration, Vec<Urgent>) {
    let mut script = Script::new(DeviceKind::Rig);
    script.ready = true;
    let (address, log) = serve(script);
    let tool = Command::new(env!("CARGO_BIN_EXE_retrograde"))
        .args(["--rig", &address])
        .args(args)
        .env_remove("RETROGRADE_CAPSULE")
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("starts");
    wait_until(&log, |log| log.executed.contains(&request));
    let now_us = || log.lock().expect("log").now_us;
    let begun_us = now_us();
    wait_until(&log, |log| log.now_us > begun_us + 400_000);
    let asked_us = now_us();
    for (sent, signal) in signals.iter().enumerate() {
        wait_until(&log, |log| sent == 0 || !log.urgent.is_empty());
        kill(*signal, tool.id());
    }
    let output = tool.wait_with_output().expect("ends");
    let took = Duration::from_micros(now_us() - asked_us);
    let urgent = log
        .lock()
        .expect("log")
        .urgent
        .iter()
        .map(|urgent| urgent.0)
        .collect();
    let err = String::from_utf8_lossy(&output.stderr).into_owned();
    (output.status.code(), err, took, urgent)
}

#[test]
fn each_of_the_three_signals_is_a_controlled_stop() {
    let folder = tempfile::tempdir().expect("folder");
    let run = ["run", "--out", folder.path().to_str().expect("UTF-8")];
    for signal in [Signal::INT, Signal::TERM, Signal::HUP] {
        let (code, err, took, urgent) = signalled(&run, "Run", &[signal]);
        assert_eq!(
            (code, urgent),
            (Some(130), vec![Urgent::Stop]),
            "{signal:?}: {err}"
        );
        // The run lasts 40 s, so it was cut short.
        assert!(took < Duration::from_secs(20), "{signal:?}: {took:?}");
    }
}

/// A terminal that is closed sends SIGHUP twice, by its shell and by the system: that was the emergency stop, which
/// loses the position.
#[test]
fn only_ctrl_c_again_is_the_emergency_stop() {
    let folder = tempfile::tempdir().expect("folder");
    let run = ["run", "--out", folder.path().to_str().expect("UTF-8")];
    for (signals, wanted, last) in [
        ([Signal::HUP, Signal::HUP], 130, Urgent::Stop),
        ([Signal::TERM, Signal::HUP], 130, Urgent::Stop),
        ([Signal::INT, Signal::HUP], 130, Urgent::Stop),
        ([Signal::INT, Signal::INT], 6, Urgent::EStop),
        ([Signal::TERM, Signal::INT], 6, Urgent::EStop),
    ] {
        let (code, err, _, urgent) = signalled(&run, "Run", &signals);
        assert_eq!(code, Some(wanted), "{signals:?}: {err}");
        assert_eq!(urgent.first(), Some(&Urgent::Stop), "{signals:?}");
        assert_eq!(urgent.last(), Some(&last), "{signals:?}: {err}");
    }
}

#[test]
fn a_jog_or_a_move_that_the_operator_stops_says_so() {
    for (args, request) in [
        (&["jog", "away", "--for-s", "60"][..], "Jog"),
        (&["move", "130", "--speed-mm-s", "5"], "MoveTo"),
    ] {
        let (code, err, took, urgent) = signalled(args, request, &[Signal::INT]);
        assert_eq!(code, Some(130), "{args:?}: {err}");
        assert_eq!(urgent.first(), Some(&Urgent::Stop), "{args:?}");
        assert!(err.contains("stopped"), "{args:?}: {err}");
        // Both motions last more than 25 s, so they were cut short.
        assert!(took < Duration::from_secs(20), "{args:?}: {took:?}");
    }
}

/// A line of input: typed once the machine has executed this request, after this many us of the machine's clock.
type Typed = (&'static str, u64, &'static str);

struct Keyboard {
    log: Arc<Mutex<Log>>,
    lines: std::vec::IntoIter<Typed>,
}

impl Read for Keyboard {
    fn read(&mut self, into: &mut [u8]) -> std::io::Result<usize> {
        let Some((request, later_us, line)) = self.lines.next() else {
            return Ok(0);
        };
        wait_until(&self.log, |log| log.executed.contains(&request));
        let since_us = self.log.lock().expect("log").now_us;
        wait_until(&self.log, |log| log.now_us > since_us + later_us);
        into[..line.len()].copy_from_slice(line.as_bytes());
        Ok(line.len())
    }
}

#[test]
fn a_key_holds_the_run_and_another_resumes_it() {
    let mut script = Script::new(DeviceKind::Rig);
    script.ready = true;
    let (address, log) = serve(script);
    let folder = tempfile::tempdir().expect("folder");
    let line = [
        "retrograde",
        "--rig",
        &address,
        "run",
        "--cycles",
        "1",
        "--stroke-mm",
        "10",
        "--duration-s",
        "2",
        "--out",
        folder.path().to_str().expect("UTF-8"),
    ];
    let lines: Vec<Typed> = vec![
        ("Run", 700_000, "h\n"),
        ("Hold", 1_500_000, "what\n"),
        ("Hold", 10_000, "r\n"),
    ];
    let keyboard = Box::new(BufReader::new(Keyboard {
        log: Arc::clone(&log),
        lines: lines.into_iter(),
    }));
    let (mut out, mut err) = (vec![], vec![]);
    let code = run_on(
        line.map(Into::into),
        &Ports,
        &mut out,
        &mut err,
        Some(keyboard),
    );
    let (out, err) = (
        String::from_utf8_lossy(&out).into_owned(),
        String::from_utf8_lossy(&err).into_owned(),
    );
    assert_eq!(code, 0, "{out}{err}");
    // The hint, and the warning that the board was not commissioned.
    assert_eq!(err.lines().count(), 2, "{err}");
    assert!(err.contains("h and Enter"), "{err}");
    assert_eq!(out.matches("  held at ").count(), 1, "{out}");
    assert_eq!(out.matches("  resumed").count(), 1, "{out}");
    let log = log.lock().expect("log");
    let count = |name| log.executed.iter().filter(|seen| **seen == name).count();
    assert_eq!((count("Hold"), count("Resume")), (1, 1));
    // Two seconds of motion and one and a half on hold.
    assert!(log.now_us > 3_500_000, "{out}");
}

/// A computer that freezes slows the machine down. It must not look like a silent host.
#[test]
fn the_scripted_machines_clock_never_jumps() {
    let mut pace = Pace::new(12);
    assert_eq!(pace.after(500), 6_000);
    assert_eq!(pace.after(1_000), 12_000);
    let (froze_us, mut last_us) = (1_001_000, 12_000);
    for _ in 0..MOST_LATE_US / TURN_US {
        let now_us = pace.after(froze_us);
        assert_eq!(now_us - last_us, 12 * TURN_US);
        last_us = now_us;
    }
    assert_eq!(pace.after(froze_us), last_us, "the rest is given up");
    assert_eq!(pace.after(froze_us + 10), last_us + 120);
}

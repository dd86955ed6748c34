//! Tests docs/protocol.md against the images: with a program in another language written from that page, and the page's
//! figures.
#![cfg(unix)]

use client::{Device, Unobserved};

use crate::common::{LIMIT_NS, quick};
use protocol::{
    rig::RigEvent,
    system::{DeviceKind, GetEvents, What},
};
use rustix::fs::{Mode, OFlags};
use rustix::process::{Pid, Signal, kill_process};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use serde_json::Value;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};
use virtual_bench::bench::Bench;
use virtual_bench::boards::{capsule, rig};
use virtual_bench::emulator::Wiring;
use virtual_bench::hands::Plug;
use virtual_bench::link::VirtualLink;
use virtual_bench::pins::EdgeLog;
use virtual_bench::plants::{capsule::Parameters, rig::RigOptions};
use virtual_bench::serve::Server;
use virtual_bench::verdicts::{self, TICK_HZ, Verdict};

/// Serves a machine in real time at a port of the loopback interface, until the test process ends.
fn serve<W: Wiring>(bench: &Bench<W>, name: &'static str) -> u16 {
    let server = Server::listen(0).expect("a free port");
    let (port, bench) = (server.port(), bench.clone());
    thread::spawn(move || server.serve(&bench, name, &Plug::default()));
    port
}

/// A terminal connected to a TCP server, which programs see as a serial port. Also returns its other end, which must
/// stay open, because reading fails while it is closed.
fn serial_port(port: u16) -> (String, OwnedFd) {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).expect("a terminal");
    grantpt(&master).expect("a terminal");
    unlockpt(&master).expect("a terminal");
    let name = ptsname(&master, vec![]).expect("a terminal");
    let name = name.into_string().expect("a path");
    let other_end = rustix::fs::open(&*name, OFlags::RDWR | OFlags::NOCTTY, Mode::empty());
    let mut terminal = File::from(master);
    let mut typed = terminal.try_clone().expect("a handle");
    let mut server = TcpStream::connect(("127.0.0.1", port)).expect("it listens");
    server.set_nodelay(true).expect("an option of every socket");
    let mut said = server.try_clone().expect("a handle");
    thread::spawn(move || pass(&mut typed, &mut server));
    thread::spawn(move || pass(&mut said, &mut terminal));
    (name, other_end.expect("the terminal"))
}

/// Copies bytes as they come, until one of the ends closes.
fn pass(from: &mut impl Read, to: &mut impl Write) {
    let mut bytes = [0; 512];
    while let Ok(count @ 1..) = from.read(&mut bytes) {
        if to.write_all(&bytes[..count]).is_err() {
            break;
        }
    }
}

/// A running client. Dropping this value ends it.
struct Client(Child);

impl Client {
    fn start(arguments: &[&str]) -> Self {
        let script =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/examples/serial_client.py");
        let child = Command::new("python3")
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .arg(script)
            .args(arguments)
            // Allow many attempts, because other load on this computer slows the bench.
            .args(["--attempts", "100"])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn();
        match child {
            Ok(child) => Self(child),
            Err(why) => panic!(
                "this test runs docs/examples/serial_client.py and needs `python3`, 3.9 or newer, without any package: {why}"
            ),
        }
    }

    /// Waits for its end. Returns its exit code and both output streams together.
    fn ends(mut self) -> (Option<i32>, String) {
        let mut said = String::new();
        let (out, err) = (self.0.stdout.take(), self.0.stderr.take());
        let read = |pipe: &mut dyn Read, said: &mut String| {
            pipe.read_to_string(said).expect("text");
        };
        // The second stream is short, so it cannot fill its pipe meanwhile.
        out.into_iter()
            .for_each(|mut pipe| read(&mut pipe, &mut said));
        err.into_iter()
            .for_each(|mut pipe| read(&mut pipe, &mut said));
        (self.0.wait().expect("its status").code(), said)
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// One cycle of 20 mm in 2 s at 400 mm/s2, the client's run, as the bench computes it.
fn client_run() -> verdicts::Run {
    let stroke = verdicts::Stroke::within(16_000, TICK_HZ, 320_000).expect("feasible");
    verdicts::Run {
        cycles: 1,
        forward: stroke,
        back: stroke,
        ..verdicts::Run::paper()
    }
}

#[test]
fn a_client_written_from_the_document_homes_runs_stops_and_folds() {
    let rig = rig::start(RigOptions::WITH_BOTH_JUMPERS).expect("the image boots");
    let capsule = capsule::start(Parameters::nominal()).expect("the image boots");
    // Use virtual time here: the emulator translates the image as it runs, so it is slower than real time at first, and
    // a reference run takes 5 s.
    let link = Box::new(VirtualLink::new(&rig, "rig"));
    Device::connect(link, DeviceKind::Rig, 1).expect("the rig answers");
    let link = Box::new(VirtualLink::new(&capsule, "capsule"));
    let mut device = Device::connect(link, DeviceKind::Capsule, 1).expect("the capsule answers");
    let accepted = device.reference().expect("accepted");
    device
        .wait_actuation(&accepted, &mut Unobserved)
        .expect("referenced");
    drop(device);

    let rig_at = format!("tcp:127.0.0.1:{}", serve(&rig, "rig"));
    let capsule_port = serve(&capsule, "capsule");
    let edges = || {
        let edges = rig.visit(|visit| visit.board().rig.edges().since(0));
        edges.expect("the bench runs")
    };

    // The wrong machine at a serial port: the client says so and moves nothing. Test no more than that over a terminal,
    // because a busy computer may delay its bytes by a second, and a moving machine would stop.
    let (terminal_at, _terminal) = serial_port(capsule_port);
    let (code, said) = Client::start(&["--rig", &terminal_at]).ends();
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("is Capsule, expected Rig"), "{said}");

    let capsule_at = format!("tcp:127.0.0.1:{capsule_port}");

    let (code, said) = Client::start(&["--rig", &rig_at, "--capsule", &capsule_at]).ends();
    assert_eq!(code, Some(0), "{said}");
    let last = said.lines().last().unwrap_or_default();
    let result: Value = serde_json::from_str(last).unwrap_or_else(|why| panic!("{why}: {said}"));
    let counted = |run: &str| result[run]["counted_edges"].as_u64().expect("a number") as usize;
    assert_eq!(result["fold"]["outcome"], "Complete", "{said}");

    // Check the client's report against the pins.
    let (whole, stopped, all) = (counted("run"), counted("stopped"), edges());
    let homing = all.len() - whole - stopped;
    let part = |first: usize, count: usize| all.iter().skip(first).take(count).collect::<EdgeLog>();
    let verdict = Verdict::of(&client_run(), &part(homing, whole));
    verdict
        .check(LIMIT_NS)
        .unwrap_or_else(|why| panic!("{why}\n{said}"));
    assert_eq!(
        (verdict.extremes, verdict.end),
        ((0, 16_000), 0),
        "{verdict}"
    );
    let stopped_edges = part(homing + whole, stopped);
    assert!(
        stopped_edges.iter().all(|edge| edge.away) && stopped < 16_000,
        "{stopped}"
    );
    let carriage = rig.visit(|visit| visit.board().rig.carriage());
    assert_eq!(carriage.expect("the bench runs"), stopped as i64);

    // Ctrl-C during a run stops the rig, and no edge comes after the client has ended.
    let mut client = Client::start(&["--rig", &rig_at, "--duration-s", "30"]);
    let mut lines = BufReader::new(client.0.stdout.take().expect("a pipe")).lines();
    let began = lines.find(|line| line.as_ref().is_ok_and(|line| line.contains("Running")));
    assert!(began.is_some(), "{:?}", client.ends());
    let pid = Pid::from_raw(client.0.id() as i32).expect("a process");
    kill_process(pid, Signal::INT).expect("it is there");
    let (code, said) = client.ends();
    assert_eq!((code, said.trim()), (Some(1), "failed: interrupted"));
    let begin = Instant::now();
    let mut before = edges().len();
    loop {
        thread::sleep(Duration::from_millis(200));
        let now = edges().len();
        if now == before {
            break;
        }
        assert!(begin.elapsed() < Duration::from_secs(5), "it goes on");
        before = now;
    }
    assert!(before < all.len() + 16_000, "{before}");
}

/// Times that docs/protocol.md states.
#[test]
fn the_document_says_when_time_and_runs_begin() {
    let mut rig = crate::common::homed();
    let first = rig.edge_count();
    let run = quick(1, 5_000, 20_000, 400_000);
    let (accepted, _) = crate::common::execute(&mut rig, run);
    let mut events = vec![];
    let mut from = 0;
    loop {
        let part = rig.device.call(GetEvents { from }).expect("an answer");
        if part.events.is_empty() {
            break;
        }
        from = part.events.last().map_or(from, |event| event.index + 1);
        events.extend(part.events);
    }
    assert!(matches!(events[0].what, What::Booted(_)), "{:?}", events[0]);
    let started = events
        .iter()
        .find(|event| matches!(event.what, What::Rig(RigEvent::RunStarted { .. })));
    let started_us = started.expect("the event").time_us;
    // The firmware logs an event when it happens, and the bench knows the time of the log entry.
    let log = rig.bench.log().expect("the bench runs");
    let mut lines = log.lines().into_iter();
    let line = lines.find(|line| line.text.contains("RunStarted"));
    let logged_ns = line.expect("a line of the log").at_ns;
    let edge_ns = rig.edges(first).iter().next().expect("a step").at_ns;
    let stroke = verdicts::Stroke {
        steps: accepted.forward.steps.into(),
        duration_ticks: accepted.forward.duration_ticks,
        ramp_ticks: accepted.forward.ramp_ticks,
    };
    let origin_ns = edge_ns - (stroke.instant(1) / 100) as u64;
    let time_begins_us = logged_ns / 1_000 - started_us;
    let run_begins_us = (origin_ns.cast_signed() - logged_ns.cast_signed()) / 1_000;
    assert!((1_000..4_000).contains(&time_begins_us), "{time_begins_us}");
    assert!(run_begins_us.abs() < 1_000, "{run_begins_us}");
}

//! Programs that end, or are ended, while a machine has not confirmed their stop: each stops what it began, and none
//! leaves in silence.

use std::fs::{self, File};
use std::net::TcpStream;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

use crate::stopping::{DEAD, SOON, Server, breakable, has_begun};
use crate::support::bench::{Bench, read, ready};
use crate::support::server::start_saying;
use crate::support::signal::kill;
use crate::support::tool::Memory;
use protocol::system::{DeviceKind, Urgent};
use rustix::process::Signal;
use serde_json::Value;
use simulated_machines::machine::Script;

/// A rig that hears everything but stops.
fn deaf() -> Script {
    Script {
        deaf_to: vec![("Urgent", u32::MAX)],
        ..ready(DeviceKind::Rig)
    }
}

/// Starts a server that leaves its last words in a file.
fn server(bench: &Bench) -> Server {
    let last_words = File::create(bench.folder.path().join("said")).expect("a file");
    Server::new(start_saying(bench, &[], last_words.into()))
}

/// Presses Ctrl-C in the server's terminal. Returns its exit code and last words.
fn left(mut server: Server, bench: &Bench) -> (Option<i32>, String) {
    kill(Signal::INT, server.process.0.id());
    let begin = Instant::now();
    let status = loop {
        if let Some(status) = server.process.0.try_wait().expect("mine") {
            break status;
        }
        assert!(begin.elapsed() < SOON, "it does not end");
        thread::sleep(Duration::from_millis(5));
    };
    let said = fs::read_to_string(bench.folder.path().join("said")).expect("text");
    (status.code(), said)
}

/// Once it ended with exit code 0 and without a word.
#[test]
fn a_server_that_leaves_names_a_machine_that_has_not_confirmed() {
    let bench = Bench::on_tcp_as(&deaf(), 1);
    let served = server(&bench);
    served.move_away();
    let (code, said) = left(served, &bench);
    assert_eq!(code, Some(7), "{said}");
    for part in [
        "the stop was NOT CONFIRMED by rig at tcp:",
        "did not confirm the stop",
        "cut the motor supply NOW",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
}

/// The line broke before, so that the server no longer waits for the end of what it began.
#[test]
fn a_server_that_leaves_names_a_machine_that_it_does_not_reach() {
    let mut bench = Bench::on_tcp(DeviceKind::Rig);
    let line = breakable(&mut bench);
    let served = server(&bench);
    served.move_away();
    line.store(DEAD, Ordering::SeqCst);
    served.until("a loss", |rig| rig["contact"] == "lost");
    let (code, said) = left(served, &bench);
    assert_eq!(code, Some(8), "{said}");
    assert!(
        said.contains("the stop was NOT DELIVERED to rig at"),
        "{said}"
    );
}

/// Such a run goes on when its line breaks; after that the server once took it for somebody else's.
#[test]
fn a_server_stops_its_run_that_has_outlived_a_connection() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let served = server(&bench);
    let run = "{\"cycles\": 1, \"duration_s\": 60, \"on_link_loss\": \"finish\"}";
    let (status, text) = served.post("run", run, 1);
    assert_eq!(status, 202, "{text}");
    // The machine serves only the latest connection.
    let other = TcpStream::connect(bench.address.trim_start_matches("tcp:")).expect("a machine");
    let goes_on = |rig: &Value| {
        rig["link"]["losses"].as_u64() > Some(0)
            && rig["contact"] == "owned"
            && rig["state"] == "running"
    };
    served.until("the run again", goes_on);
    drop(other);
    // Neither a later order nor its refusal makes the server forget its run.
    for (nth, order) in [(2, "ack"), (3, "hold"), (4, "resume")] {
        let (_, text) = served.post(order, "{}", nth);
        served.until(order, |rig| rig["state"] != "held" || order == "hold");
        assert!(text.contains("action"), "{order}: {text}");
    }
    let (code, said) = left(served, &bench);
    assert_eq!(code, Some(0), "{said}");
    assert_eq!(bench.urgent().first(), Some(&Urgent::Stop), "{said}");
}

/// Another process's motion is not the server's to stop, even if its own broke off before.
#[test]
fn a_server_that_leaves_stops_no_run_of_another_process() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let served = server(&bench);
    let mut run = bench.run(&["--cycles", "1", "--duration-s", "60"]);
    served.until("a broker", |rig| {
        rig["contact"] == "broker" && rig["state"] == "running"
    });
    let (code, said) = left(served, &bench);
    assert_eq!((code, bench.urgent()), (Some(0), vec![]), "{said}");
    run.kill().expect("killed");
    run.wait().expect("ended");
}

/// Once, `move` said "stopping", then "emergency stop", and sent neither. A machine that does not confirm it is named.
#[test]
fn ctrl_c_stops_the_machine_while_a_command_waits_for_its_line() {
    for (script, ends) in [(ready(DeviceKind::Rig), 130), (deaf(), 7)] {
        let bench = Bench::on_tcp_as(&script, 1);
        let mut watch = bench.command(&["watch"]).spawn().expect("starts");
        bench.wait_for("GetRigStatus");
        kill(Signal::STOP, watch.id());
        let mut command = bench.command(&["move", "60", "--speed-mm-s", "20"]);
        let mut waiting = command.spawn().expect("starts");
        has_begun(&mut waiting);
        kill(Signal::INT, waiting.id());
        let (code, out, err) = read(waiting.wait_with_output().expect("ended"));
        watch.kill().expect("killed");
        watch.wait().expect("ended");
        assert_eq!(code, Some(ends), "{out}{err}");
        assert_eq!(bench.count("MoveTo"), 0, "{out}{err}");
        if ends == 130 {
            assert_eq!(bench.urgent(), [Urgent::Stop], "{out}{err}");
        } else {
            assert!(err.contains("cut the motor supply NOW"), "{err}");
        }
    }
}

/// Whoever leaves between two steps is told, too, when the stop that goes with it is not confirmed.
#[test]
fn a_commissioning_that_is_left_says_when_its_stop_is_not_confirmed() {
    let folder = tempfile::tempdir().expect("a folder");
    let record = folder.path().join("record.json");
    let mut script = Script::new(DeviceKind::Rig);
    script.deaf_to = vec![("Urgent", u32::MAX)];
    let line = [
        "--rig",
        "0",
        "commission",
        "rig",
        "--clock-s",
        "1",
        "--record",
        record.to_str().expect("UTF-8"),
    ];
    let (code, out, err) = Memory::with(vec![script]).run_typed(&line, "q\n");
    assert_eq!(code, 7, "{out}{err}");
    assert!(err.contains("did not confirm the stop"), "{err}");
}

//! One owner of a line and many clients: several real processes at one machine on TCP, in real time. The server takes
//! only the first connection, so any process that gets through has used the broker.

use std::fs::Permissions;
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Child, Command};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use crate::support::bench::{Bench, at_a_port, read, ready, through_the_broker_alone};
use crate::support::server::Killed;
use crate::support::signal::{Signal, kill};
use client::broker::client::BrokerClient;
use client::broker::lock::LineFiles;
use client::error::ClientError;
use client::link::Link;
use client::{Observer, Unobserved};
use protocol::system::{DeviceKind, Event, Urgent};
use protocol::table::Telemetry;

fn end(child: Child) -> (Option<i32>, String, String) {
    read(child.wait_with_output().expect("ends"))
}

/// Long enough for several commands of a slow computer.
const SHORT: [&str; 6] = ["--cycles", "1", "--stroke-mm", "40", "--duration-s", "12"];

#[test]
fn others_observe_while_a_run_goes_on_and_it_is_not_disturbed() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let run = bench.run(&SHORT);
    let begin = Instant::now();
    let mut looks = 0;
    // Stop well before the end of the run: a look that meets the end is told to try again.
    while begin.elapsed() < Duration::from_millis(1_200) {
        for (args, says) in [
            (&["info"][..], "Running, homed"),
            (&["health"], "underruns"),
            (&["settings", "list"], "link_timeout_ms"),
            (&["settings", "get", "lead_um"], "4000"),
        ] {
            let (code, out, err) = bench.retrograde(args);
            assert_eq!(code, Some(0), "{args:?}: {err}");
            assert!(out.contains(says), "{args:?}: {out}");
            looks += 1;
        }
    }
    assert!(looks >= 4, "{looks}");
    let (code, out, err) = end(run);
    assert_eq!(code, Some(0), "{out}{err}");
    assert_eq!(bench.connections(), 1);
    let trial = bench.trial();
    let record = &trial["action"]["executed"];
    assert_eq!(trial["status"], "complete");
    // 40 mm away and back at 800 steps per millimetre.
    assert_eq!(record["counted_edges"], 64_000, "{trial:#}");
    let (rows, missed) = bench.telemetry();
    assert_eq!(missed, 0);
    assert!(rows >= 1_180, "{rows}");
    // The socket closes with its owner, so this command opens the line itself.
    assert_eq!(bench.retrograde(&["info"]).0, Some(0));
    assert_eq!(bench.connections(), 2);
}

/// News that a subscriber receives.
#[derive(Debug, Default)]
struct Seen {
    samples: u32,
    missed: u32,
    events: Vec<u32>,
}

impl Observer for Seen {
    fn telemetry(&mut self, _: &Telemetry, missed: u16) {
        self.samples += 1;
        self.missed += u32::from(missed);
    }
    fn event(&mut self, event: &Event) {
        self.events.push(event.index);
    }
}

#[test]
fn windows_and_a_subscriber_take_nothing_from_the_owner() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let run = bench.run(&["--cycles", "2", "--stroke-mm", "20", "--duration-s", "12"]);
    // It waits for its clients, however long a busy computer takes to let them in.
    let (code, _, err) = bench.retrograde(&["hold"]);
    assert_eq!(code, Some(0), "{err}");
    let over = Arc::new(AtomicBool::new(false));
    thread::scope(|scope| {
        let watches: Vec<_> = (0..5)
            .map(|_| {
                scope.spawn(|| {
                    let mut rig = bench.broker_client();
                    let mut looks = 0;
                    while !over.load(Ordering::Relaxed) && rig.rig_status().is_ok() {
                        looks += 1;
                        thread::sleep(Duration::from_millis(100));
                    }
                    looks
                })
            })
            .collect();
        let mut subscriber = bench.broker_client();
        assert_eq!(subscriber.owner().expect("another").pid, run.id());
        let (code, _, err) = bench.retrograde(&["resume"]);
        assert_eq!(code, Some(0), "{err}");
        let mut seen = Seen::default();
        let gone = loop {
            match subscriber.idle(50_000, &mut seen) {
                // Five clients ask as well, and a busy computer takes its time for each of them.
                Ok(()) | Err(ClientError::Owned { busy: true, .. }) => {}
                Err(error) => break error,
            }
        };
        assert!(matches!(gone, ClientError::Link(_)), "{gone:?}");
        over.store(true, Ordering::Relaxed);
        // 100 a second, less the time before the client opened and after the last look.
        assert!(seen.samples > 300, "{seen:?}");
        assert_eq!(seen.missed, 0);
        // These are the ends of strokes.
        let events = &seen.events;
        assert!(events.len() >= 2, "{events:?}");
        assert!(events.is_sorted_by(|a, b| a + 1 == *b), "{events:?}");
        for watch in watches {
            let looks = watch.join().expect("no panic");
            assert!(looks > 10, "{looks}");
        }
    });
    let (code, out, err) = end(run);
    assert_eq!(code, Some(0), "{out}{err}");
    assert_eq!(bench.trial()["action"]["executed"]["counted_edges"], 64_000);
    let (rows, missed) = bench.telemetry();
    assert_eq!(missed, 0);
    assert!(rows >= 1_180, "{rows}");
}

/// An owner whose broker answers is alive. Its computer may just be busy, so the question waits.
#[test]
fn a_question_waits_for_an_owner_that_is_held_up() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let run = bench.run(&["--on-link-loss", "finish"]);
    let mut client = bench.broker_client();
    kill(Signal::STOP, run.id());
    thread::scope(|scope| {
        scope.spawn(|| {
            // Longer than one question is repeated.
            thread::sleep(Duration::from_millis(1_200));
            kill(Signal::CONT, run.id());
        });
        client.rig_status().expect("an answer");
    });
    // A client in a hurry is told that the owner does not answer.
    kill(Signal::STOP, run.id());
    client.ask_once(true);
    let error = client.rig_status().expect_err("no answer");
    assert!(
        matches!(error, ClientError::Owned { busy: true, .. }),
        "{error:?}"
    );
    kill(Signal::CONT, run.id());
    assert_eq!(bench.retrograde(&["stop"]).0, Some(0));
    assert_eq!(end(run).0, Some(130));
}

/// The owner's own status shows whether the silence lasts.
#[test]
fn a_question_that_the_machine_does_not_answer_does_not_end_the_run() {
    let mut script = ready(DeviceKind::Rig);
    // As often as a question is sent.
    script.deaf_to = vec![("GetRigHealth", u32::from(protocol::client::ATTEMPTS))];
    let bench = Bench::on_tcp_as(&script, 1);
    let run = bench.run(&SHORT);
    let (code, out, err) = bench.retrograde(&["health"]);
    assert_eq!(code, Some(0), "{out}{err}");
    // It went through the broker.
    assert_eq!(bench.connections(), 1);
    let (code, out, err) = end(run);
    assert_eq!(code, Some(0), "{out}{err}");
}

#[test]
fn a_client_knows_of_stops_that_are_newer_than_its_orders() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let run = bench.run(&SHORT);
    let address = bench.address.parse().expect("an address");
    let line_files = LineFiles::within(&bench.locks(), &address).expect("a line");
    let mut client = BrokerClient::open(&line_files, Duration::from_secs(20)).expect("a broker");
    assert!(!client.is_overtaken());
    line_files.mark_stop(Urgent::Stop);
    assert!(client.is_overtaken());
    client.ordered_at(LineFiles::last_stops(Some(&line_files)));
    assert!(!client.is_overtaken());
    assert_eq!(end(run).0, Some(130));
}

#[test]
fn a_serial_port_is_shared_as_well() {
    at_a_port(DeviceKind::Rig, |bench| {
        let run = bench.run(&SHORT);
        let (code, out, err) = bench.retrograde(&["info"]);
        assert_eq!(code, Some(0), "{err}");
        assert!(out.contains("Running, homed"), "{out}");
        assert_eq!(bench.retrograde(&["home"]).0, Some(3));
        // A second name for the same port.
        let link = bench.folder.path().join("port");
        std::os::unix::fs::symlink(&bench.address, &link).expect("a link");
        let name = link.to_str().expect("UTF-8");
        let (code, out, err) = bench.retrograde(&["--rig", name, "estop"]);
        assert_eq!(code, Some(0), "{out}{err}");
        assert_eq!(end(run).0, Some(6));
        assert_eq!(bench.urgent().first(), Some(&Urgent::EStop));
        let (code, _, err) = bench.retrograde(&["ack"]);
        assert_eq!(code, Some(0), "{err}");
    });
}

#[test]
fn a_stop_that_does_not_get_past_a_frozen_owner_of_a_port_says_so() {
    at_a_port(DeviceKind::Rig, |bench| {
        // Killed also if the test fails: it is frozen.
        let run = Killed(bench.run(&["--on-link-loss", "finish"]));
        kill(Signal::STOP, run.0.id());
        let (code, out, err) = bench.retrograde(&["estop"]);
        // The port is exclusive, so only the owner could have passed the stop on.
        assert_eq!(code, Some(8), "{out}{err}");
        assert!(err.contains("NOT DELIVERED"), "{err}");
        assert!(err.contains(&format!("process {}", run.0.id())), "{err}");
        assert_eq!(bench.urgent(), []);
    });
}

#[test]
fn the_capsule_has_a_broker_of_its_own() {
    through_the_broker_alone(|| {
        let bench = Bench::on_tcp(DeviceKind::Capsule);
        let cycles = bench
            .command(&["capsule", "cycle", "--count", "50"])
            .spawn();
        let cycles = cycles.expect("starts");
        bench.wait_for("Fold");
        let (code, out, err) = bench.retrograde(&["info"]);
        assert_eq!(code, Some(0), "{err}");
        assert!(out.contains("olding, referenced"), "{out}");
        for args in [
            &["capsule", "reference"][..],
            &["capsule", "calibrate"],
            &["capsule", "trace"],
            &["fold"],
        ] {
            let (code, _, err) = bench.retrograde(args);
            assert_eq!(code, Some(3), "{err}");
        }
        assert_eq!(bench.retrograde(&["stop"]).0, Some(0));
        let (code, _, err) = end(cycles);
        assert_eq!(code, Some(130), "{err}");
        assert_eq!(bench.count("Calibrate"), 0);
        bench
    });
}

#[test]
fn a_client_learns_at_once_that_the_owner_was_killed() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut run = bench.run(&SHORT);
    let mut rig = bench.broker_client();
    rig.rig_status().expect("a look");
    run.kill().expect("killed");
    let begin = Instant::now();
    let error = rig
        .idle(60_000_000, &mut Unobserved)
        .expect_err("the owner is gone");
    // It must not wait for the end of the run, even on a slow computer.
    assert!(begin.elapsed() < Duration::from_secs(30), "{error}");
    let text = error.to_string();
    assert!(
        text.contains(&format!("process {}", run.id())) && text.contains("has ended"),
        "{text}"
    );
    run.wait().expect("ended");
}

#[test]
fn whoever_does_not_keep_the_rules_harms_nobody() {
    use std::os::unix::net::UnixStream;
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let run = bench.run(&SHORT);
    let socket = std::fs::read_dir(bench.locks())
        .expect("locks")
        .map(|entry| entry.expect("an entry").path())
        .find(|path| path.extension().is_some_and(|kind| kind == "socket"))
        .expect("a broker");
    let greeting = b"{\"retrograde_client\":1}\n";
    let mut clients = vec![];
    // Clients: silent ones, other protocols, endless lines, one that never reads, and more of them than are let in.
    for words in [
        &b""[..],
        b"GET / HTTP/1.1\r\n\r\n",
        b"{}\n",
        &[b'x'; 5_000],
        &[0; 5_000],
    ] {
        let mut client = UnixStream::connect(&socket).expect("open");
        let _ = client.write_all(words);
        clients.push(client);
    }
    for _ in 0..40 {
        let mut client = UnixStream::connect(&socket).expect("open");
        let _ = client.write_all(greeting);
        let _ = client.write_all(&[0xa5; 300]);
        clients.push(client);
    }
    thread::sleep(Duration::from_secs(1));
    drop(clients);
    thread::sleep(Duration::from_millis(300));
    assert_eq!(bench.retrograde(&["info"]).0, Some(0));
    let (code, out, err) = end(run);
    assert_eq!(code, Some(0), "{out}{err}");
    assert_eq!(bench.telemetry().1, 0);
}

#[test]
fn what_moves_is_refused_and_names_the_owner() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let run = bench.run(&SHORT);
    let settings = bench.folder.path().join("settings.json");
    let file = settings.to_str().expect("UTF-8");
    assert_eq!(bench.retrograde(&["settings", "export", file]).0, Some(0));
    for args in [
        &["home"][..],
        &["run"],
        &["jog", "away"],
        &["move", "10"],
        &["commission", "rig", "--yes"],
        &["settings", "set", "max_speed_um_s", "20000"],
        &["settings", "name", "other"],
        &["settings", "import", file],
        &["settings", "reset", "--yes"],
    ] {
        let (code, _, err) = bench.retrograde(args);
        assert_eq!(code, Some(3), "{args:?}: {err}");
        let owner = format!("process {} (`retrograde run --cycles 1", run.id());
        for says in [&owner, "since 20", "`estop` work from here"] {
            assert!(err.contains(says), "{args:?}: {says}: {err}");
        }
    }
    assert_eq!(end(run).0, Some(0));
    for request in ["Home", "Jog", "MoveTo", "SetSetting", "SetName"] {
        assert_eq!(bench.count(request), 0, "{request}");
    }
    assert_eq!((bench.count("Run"), bench.connections()), (1, 1));
    // Only one record: the refused run has left none.
    bench.trial();
}

#[test]
fn a_stop_from_another_process_stops_the_run_and_the_owner_records_it() {
    for (stop, ends) in [("stop", 130), ("estop", 6)] {
        through_the_broker_alone(|| {
            let bench = Bench::on_tcp(DeviceKind::Rig);
            let run = bench.run(&SHORT);
            thread::sleep(Duration::from_millis(300));
            let (code, out, err) = bench.retrograde(&[stop]);
            assert_eq!(code, Some(0), "{err}");
            assert!(out.contains(&bench.address), "{out}");
            let (code, _, err) = end(run);
            assert_eq!(code, Some(ends), "{stop}: {err}");
            assert_eq!(bench.count("Run"), 1);
            let status = if stop == "stop" { "stopped" } else { "faulted" };
            assert_eq!(bench.trial()["status"], status);
            bench
        });
    }
}

#[test]
fn hold_and_resume_go_through_the_owner() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let run = bench.run(&SHORT);
    thread::sleep(Duration::from_millis(500));
    let (code, out, err) = bench.retrograde(&["hold"]);
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("Held at"), "{out}");
    let (_, out, _) = bench.retrograde(&["info"]);
    assert!(out.contains("Held, homed"), "{out}");
    // The owner shows its progress four times a second.
    thread::sleep(Duration::from_millis(400));
    let (code, _, err) = bench.retrograde(&["resume"]);
    assert_eq!(code, Some(0), "{err}");
    let (code, out, err) = end(run);
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("held at") && out.contains("resumed"), "{out}");
    assert_eq!((bench.count("Hold"), bench.count("Resume")), (1, 1));
    assert_eq!(bench.connections(), 1);
}

/// Asserts that this stop has arrived and no other. It is sent again until it is confirmed, which a busy computer may
/// delay.
fn only(bench: &Bench, stop: Urgent) {
    let came = bench.urgent();
    assert!(
        !came.is_empty() && came.iter().all(|one| *one == stop),
        "{came:?}"
    );
}

#[test]
fn the_death_of_the_owner_is_seen_at_once_and_the_line_is_free() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut run = bench.run(&["--on-link-loss", "finish"]);
    run.kill().expect("killed");
    let (code, _, err) = bench.retrograde(&["estop"]);
    run.wait().expect("ended");
    assert_eq!(code, Some(0), "{err}");
    only(&bench, Urgent::EStop);
    let (code, _, err) = bench.retrograde(&["ack"]);
    assert_eq!(code, Some(0), "{err}");
}

/// Regression: a stop panicked where the system makes no thread, as in a container at its limit of processes.
#[test]
fn a_stop_needs_no_thread() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    // No address space has room for such a stack.
    let without = |args: &[&str]| {
        let mut command = bench.command(args);
        command.env("RUST_MIN_STACK", (1_u64 << 47).to_string());
        read(command.output().expect("starts"))
    };
    let (code, out, err) = without(&["estop"]);
    assert_eq!(code, Some(0), "{out}{err}");
    only(&bench, Urgent::EStop);
    for args in [&["home"][..], &["run"], &["watch"]] {
        let (code, _, err) = without(args);
        assert_eq!(code, Some(1), "{args:?}: {err}");
        assert!(
            err.contains("no thread could be started"),
            "{args:?}: {err}"
        );
    }
    assert_eq!(bench.executed(), [] as [&str; 0]);
}

#[test]
fn a_stop_gets_past_an_owner_that_is_frozen() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut run = bench.run(&["--on-link-loss", "finish"]);
    kill(Signal::STOP, run.id());
    let (code, out, err) = bench.retrograde(&["estop"]);
    assert_eq!(code, Some(0), "{out}{err}");
    only(&bench, Urgent::EStop);
    // Reading does not take the line over, and names its owner.
    let (code, _, err) = bench.retrograde(&["info"]);
    assert_eq!(code, Some(4), "{err}");
    assert!(err.contains("does not answer"), "{err}");
    assert!(err.contains(&format!("process {}", run.id())), "{err}");
    run.kill().expect("killed");
    run.wait().expect("ended");
}

#[test]
fn an_owner_whose_output_is_stuck_goes_on() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let full = bench.folder.path().join("pipe");
    assert!(
        Command::new("mkfifo")
            .arg(&full)
            .status()
            .expect("mkfifo")
            .success()
    );
    // The pipe is open but not read. Fill its 64 KiB before the owner starts.
    let mut keep = std::fs::OpenOptions::new()
        .read(true)
        .write(true)
        .open(&full)
        .expect("a pipe");
    fill(&mut keep);
    let mut run = bench
        .command(&["run", "--on-link-loss", "finish"])
        .stdout(keep.try_clone().expect("a pipe"))
        .spawn()
        .expect("starts");
    bench.wait_for("Run");
    thread::sleep(Duration::from_millis(500));
    let (code, out, err) = bench.retrograde(&["estop"]);
    assert_eq!(code, Some(0), "{out}{err}");
    only(&bench, Urgent::EStop);
    let (code, _, err) = bench.retrograde(&["info"]);
    assert_eq!(code, Some(0), "{err}");
    run.kill().expect("killed");
    run.wait().expect("ended");
}

/// Fills a pipe to the last byte.
fn fill(pipe: &mut std::fs::File) {
    let flags = rustix::fs::fcntl_getfl(&pipe).expect("flags");
    rustix::fs::fcntl_setfl(&pipe, flags | rustix::fs::OFlags::NONBLOCK).expect("set");
    for chunk in [4_096, 1] {
        while pipe.write(&vec![b'.'; chunk]).is_ok() {}
    }
    rustix::fs::fcntl_setfl(&pipe, flags).expect("set");
}

#[test]
fn only_the_owner_of_the_folder_can_get_in() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let run = bench.run(&SHORT);
    let mode = |path: &Path| {
        let found = std::fs::metadata(path).expect("there");
        found.permissions().mode() & 0o777
    };
    assert_eq!(mode(&bench.locks()), 0o700);
    assert_eq!(end(run).0, Some(0));
    std::fs::set_permissions(bench.locks(), Permissions::from_mode(0o777)).expect("mine");
    let (code, _, err) = bench.retrograde(&["home"]);
    assert_eq!(code, Some(4), "{err}");
    assert!(err.contains("other users have access"), "{err}");
    // A stop goes out all the same.
    assert_eq!(bench.retrograde(&["stop"]).0, Some(0));
    only(&bench, Urgent::Stop);
}

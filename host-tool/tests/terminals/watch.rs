//! `watch` at a machine in real time: in a pseudo-terminal, whose state is compared before and after, and without
//! one.

use std::io::{BufRead, BufReader};
use std::net::{TcpListener, TcpStream};
use std::process::Command;
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use crate::support::bench::{Bench, at_a_port, read, ready};
use crate::support::signal::{Signal, kill};
use crate::support::terminal::{End, Terminal};
use host_tool::cli::watch::terminal::take;
use protocol::system::{DeviceKind, Urgent};

fn watch(bench: &Bench) -> Terminal {
    Terminal::start(bench.command(&["watch"]), 80, 24)
}

const SLOW: [&str; 6] = ["--cycles", "1", "--stroke-mm", "130", "--duration-s", "600"];

#[test]
fn a_run_of_another_process_is_seen_held_resumed_and_stopped_by_keys() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let run = bench.run(&SLOW);
    let mut terminal = watch(&bench);
    terminal.wait_for("RUNNING");
    terminal.wait_for("away from home");
    let owner = format!("through process {} (`retrograde run", run.id());
    for says in [
        &owner,
        "stroke 1 of 2",
        "130 mm",
        "0 missed",
        "e EMERGENCY STOP",
    ] {
        terminal.wait_for(says);
    }
    terminal.resize(200, 60);
    terminal.wait_for_row(59, "e EMERGENCY STOP");
    terminal.press("h");
    terminal.wait_for("HELD");
    terminal.press("r");
    terminal.wait_for("rig: resumed");
    terminal.wait_for("RUNNING");
    // A refusal of the rig is shown.
    terminal.press("r");
    terminal.wait_for("not resumed: no run is held");
    assert_eq!(bench.connections(), 1);
    terminal.press("s");
    terminal.wait_for("stop confirmed");
    terminal.press("q");
    assert_eq!(terminal.ends_restored(), Some(0));
    assert_eq!(read(run.wait_with_output().expect("ends")).0, Some(130));
    assert_eq!(bench.trial()["status"], "stopped");
    assert_eq!(bench.telemetry().1, 0);
}

/// Passes everything on between this port and the bench.
fn forward(listener: TcpListener, bench: &Bench) {
    let to = bench.address.strip_prefix("tcp:").expect("TCP").to_owned();
    thread::spawn(move || {
        for near in listener.incoming().flatten() {
            let far = TcpStream::connect(&to).expect("the bench");
            let copies = [&near, &far].map(|end| end.try_clone().expect("open"));
            let ways = copies.into_iter().zip([far, near]);
            for (mut from, mut to) in ways {
                thread::spawn(move || std::io::copy(&mut from, &mut to));
            }
        }
    });
}

/// Regression: it was sent when the machine was back, however much later, and a held run went on by itself.
#[test]
fn a_key_that_is_pressed_without_contact_does_nothing_later() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut run = bench.run(&SLOW);
    bench.wait_for("Run");
    let (code, _, err) = bench.retrograde(&["hold"]);
    assert_eq!(code, Some(0), "{err}");
    run.kill().expect("killed");
    run.wait().expect("ends");
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let port = listener.local_addr().expect("bound");
    drop(listener);
    let mut command = bench.command(&["watch"]);
    command.env("RETROGRADE_RIG", format!("tcp:{port}"));
    let mut terminal = Terminal::start(command, 80, 24);
    terminal.wait_for("NO CONTACT");
    terminal.press("r");
    terminal.wait_for("not sent: there is no contact");
    forward(TcpListener::bind(port).expect("free still"), &bench);
    terminal.wait_for("HELD");
    thread::sleep(Duration::from_secs(1));
    assert_eq!(bench.count("Resume"), 0);
    terminal.press("q");
    assert_eq!(terminal.ends_restored(), Some(0));
}

/// A key that came with a change of the window's size was read only with the next key.
#[test]
fn a_key_that_comes_with_a_resize_is_obeyed() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut run = bench.run(&SLOW);
    let mut terminal = watch(&bench);
    terminal.wait_for("away from home");
    for rows in 30..60 {
        for (key, says) in [("h", "HELD"), ("r", "RUNNING")] {
            // Both while the screen is drawn, which it is every 50 ms: in some of these instants.
            thread::sleep(Duration::from_millis(u64::from(rows - 30) * 2));
            terminal.resize(200, rows);
            terminal.press(key);
            terminal.wait_for(says);
        }
    }
    terminal.press("s");
    terminal.wait_for("stop confirmed");
    terminal.press("q");
    assert_eq!(terminal.ends_restored(), Some(0));
    assert_eq!(run.wait().expect("ends").code(), Some(130));
}

#[test]
fn a_key_is_an_emergency_stop_and_the_fault_is_shown_with_its_remedy() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut terminal = watch(&bench);
    let shown = terminal.wait_for("READY");
    assert!(!shown.contains("process"), "{shown}");
    terminal.wait_for("this program owns the line");
    terminal.press("e");
    terminal.wait_for("EMERGENCY STOP latched");
    assert_eq!(bench.urgent().first(), Some(&Urgent::EStop));
    terminal.wait_for("FAULTED");
    terminal.wait_for("acknowledge with `retrograde ack`");
    terminal.wait_for("FAULT: emergency stop by command");
    // The watch continues and serves others, even after a stop.
    let (code, _, err) = bench.retrograde(&["ack"]);
    assert_eq!(code, Some(0), "{err}");
    terminal.wait_for("UNHOMED");
    let (code, out, err) = bench.retrograde(&["stop"]);
    assert_eq!(code, Some(0), "{out}{err}");
    terminal.wait_for("stop from another terminal");
    kill(Signal::TERM, terminal.child.id());
    assert_eq!(terminal.ends_restored(), Some(0));
}

/// The screen that said so is gone after leaving, which ended with exit code 0.
#[test]
fn a_stop_that_is_not_confirmed_is_told_after_leaving() {
    let mut script = ready(DeviceKind::Rig);
    script.deaf_to = vec![("Urgent", u32::MAX)];
    let bench = Bench::on_tcp_as(&script, 1);
    for (key, end) in [
        ("s", End::Key("q")),
        ("e", End::Signal(Signal::TERM)),
        ("s", End::Signal(Signal::HUP)),
    ] {
        let mut terminal = watch(&bench);
        terminal.wait_for("READY");
        terminal.press(key);
        if matches!(end, End::Signal(_)) {
            // The signal must not come before the key.
            terminal.wait_for("NOT CONFIRMED");
        }
        terminal.end_by(end);
        let screen = Arc::clone(&terminal.screen);
        assert_eq!(terminal.ends_restored(), Some(7), "{end:?}");
        let shown = screen.lock().expect("free").screen().contents();
        let shown = shown.replace(['\n', ' '], "");
        for part in ["NOTCONFIRMEDbyrig", "cutthemotorsupplyNOW"] {
            assert!(shown.contains(part), "{end:?}: {shown}");
        }
    }
}

/// A failure that a later stop has made good is none.
#[test]
fn a_stop_that_is_confirmed_when_it_is_repeated_is_one() {
    let mut script = ready(DeviceKind::Rig);
    // All that the first press sends: eight times each, over its own line and over another one.
    script.deaf_to = vec![("Urgent", 16)];
    let bench = Bench::on_tcp_as(&script, 1);
    let mut terminal = watch(&bench);
    terminal.wait_for("READY");
    terminal.press("s");
    terminal.wait_for("NOT CONFIRMED");
    terminal.press("s");
    terminal.wait_for("stop confirmed");
    // The connection that comes back meets the mark of that stop, which is no other terminal's.
    terminal.wait_for("this program owns the line");
    thread::sleep(Duration::from_millis(500));
    let shown = terminal.text();
    assert!(shown.contains("stop confirmed"), "{shown}");
    terminal.press("q");
    assert_eq!(terminal.ends_restored(), Some(0));
}

#[test]
fn the_terminal_is_restored_however_it_ends() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let signals = [Signal::TERM, Signal::HUP, Signal::INT].map(End::Signal);
    for end in signals.into_iter().chain(["q", "\x03"].map(End::Key)) {
        let mut terminal = watch(&bench);
        terminal.wait_for("READY");
        terminal.end_by(end);
        assert_eq!(terminal.ends_restored(), Some(0), "{end:?}");
    }
    assert_eq!(bench.urgent(), []);
}

/// After its window has been closed, no key can end the watch, and it must not keep the line.
#[test]
fn a_watch_whose_terminal_is_gone_ends() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut child = Terminal::lost(bench.command(&["watch"]));
    let begin = Instant::now();
    while child.try_wait().expect("a child").is_none() {
        if begin.elapsed() > Duration::from_secs(60) {
            child.kill().expect("it is ours");
            panic!("it is still there");
        }
        thread::sleep(Duration::from_millis(20));
    }
    let (code, out, error) = bench.retrograde(&["info"]);
    assert_eq!(code, Some(0), "{out}{error}");
}

/// The program that the next test runs.
#[test]
#[ignore = "run by the next test in a terminal"]
fn panics_in_a_terminal() {
    let _taken = take().expect("a terminal");
    thread::spawn(|| panic!("on purpose"))
        .join()
        .expect_err("panics");
    panic!("once more");
}

#[test]
fn the_terminal_is_restored_before_the_message_of_a_panic() {
    let mut program = Command::new(std::env::current_exe().expect("this test"));
    program.env("RUST_BACKTRACE", "0");
    program.args([
        "--exact",
        "watch::panics_in_a_terminal",
        "--ignored",
        "--nocapture",
    ]);
    let mut terminal = Terminal::start(program, 80, 24);
    let shown = terminal.wait_for("once more");
    // The message is on the normal screen, where it stays.
    assert!(shown.contains("on purpose"), "{shown}");
    assert!(
        !terminal
            .screen
            .lock()
            .expect("free")
            .screen()
            .alternate_screen()
    );
    let bytes = terminal.bytes.lock().expect("free").clone();
    assert!(
        bytes.windows(8).any(|window| window == b"\x1b[?1049h"),
        "it was taken"
    );
    assert_eq!(terminal.ends_restored(), Some(101));
}

#[test]
fn a_terminal_that_is_too_small_says_so_and_its_keys_work() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut terminal = Terminal::start(bench.command(&["watch"]), 60, 20);
    terminal.wait_for("rig: Ready");
    for says in ["60x20", "80x24", "e EMERGENCY STOP"] {
        terminal.wait_for(says);
    }
    terminal.resize(80, 24);
    let shown = terminal.wait_for("READY");
    assert!(!shown.contains("80x24"), "{shown}");
    terminal.resize(20, 5);
    terminal.wait_for("20x5");
    terminal.press("e");
    terminal.resize(80, 24);
    terminal.wait_for("FAULTED");
    assert_eq!(bench.urgent().first(), Some(&Urgent::EStop));
    terminal.press("q");
    assert_eq!(terminal.ends_restored(), Some(0));
}

#[test]
fn without_colours_none_are_sent() {
    let bench = Bench::on_tcp(DeviceKind::Capsule);
    for (no_colour, colours) in [("", true), ("1", false)] {
        let mut command = bench.command(&["watch"]);
        command.env("NO_COLOR", no_colour);
        let mut terminal = Terminal::start(command, 80, 24);
        terminal.wait_for("UNFOLDED");
        let bytes = terminal.bytes.lock().expect("free").clone();
        let sent = bytes.windows(5).any(|window| window == b"\x1b[38;");
        assert_eq!(sent, colours);
        terminal.press("q");
        assert_eq!(terminal.ends_restored(), Some(0));
    }
}

#[test]
fn the_owner_of_the_line_is_killed_and_the_watch_goes_on() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut run = bench.run(&SLOW);
    let mut terminal = watch(&bench);
    terminal.wait_for("through process");
    run.kill().expect("killed");
    run.wait().expect("ended");
    terminal.wait_for("this program owns the line");
    kill(Signal::TERM, terminal.child.id());
    assert_eq!(terminal.ends_restored(), Some(0));
}

#[test]
fn a_watch_gives_the_line_up_for_a_command_that_moves_and_looks_on() {
    // Only a port that was closed can be opened again.
    at_a_port(DeviceKind::Rig, |bench| {
        let mut terminal = watch(bench);
        terminal.wait_for("this program owns the line");
        let mut other = watch(bench);
        other.wait_for("through process");
        for _ in 0..3 {
            let args = ["move", "1", "--speed-mm-s", "10"];
            let (code, _, err) = bench.retrograde(&args);
            assert_eq!(code, Some(0), "{err}");
            let (code, _, err) = bench.retrograde(&["move", "0"]);
            assert_eq!(code, Some(0), "{err}");
        }
        // It goes on until both windows have seen it, however long a busy computer takes for that.
        let run = bench.run(&["--cycles", "9", "--stroke-mm", "20", "--duration-s", "90"]);
        let owner = format!("through process {} (`retrograde run", run.id());
        terminal.wait_for(&owner);
        other.wait_for(&owner);
        let (code, _, err) = bench.retrograde(&["stop", "rig"]);
        assert_eq!(code, Some(0), "{err}");
        // Its result does not matter here.
        run.wait_with_output().expect("ends");
        // One of the two must own the line again.
        let begin = Instant::now();
        while [&terminal, &other]
            .iter()
            .all(|one| !one.text().contains("this program owns"))
        {
            assert!(
                begin.elapsed() < Duration::from_secs(20),
                "{}",
                terminal.text()
            );
            thread::sleep(Duration::from_millis(10));
        }
        for terminal in [terminal, other] {
            terminal.press("q");
            assert_eq!(terminal.ends_restored(), Some(0));
        }
    });
}

#[test]
fn without_a_terminal_it_prints_lines_until_nobody_reads() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut child = bench.command(&["watch"]).spawn().expect("starts");
    let mut out = BufReader::new(child.stdout.take().expect("piped"));
    let begin = Instant::now();
    loop {
        let mut line = String::new();
        let _ = out.read_line(&mut line).expect("a line");
        assert!(!line.contains('\x1b'), "{line:?}");
        if line.starts_with("rig: Ready, 0.000 mm") {
            break;
        }
        assert!(begin.elapsed() < Duration::from_secs(60), "{line}");
    }
    // A closed pipe ends the watch without an error.
    drop(out);
    assert_eq!(child.wait().expect("ends").code(), Some(0));
    assert_eq!(bench.urgent(), []);
}

#[test]
fn it_ends_after_a_time_with_the_last_status() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let begin = Instant::now();
    loop {
        let (code, out, err) = bench.retrograde(&["watch", "rig", "--json", "--for-s", "1.5"]);
        assert_eq!(code, Some(0), "{err}");
        assert!(err.starts_with("rig: "), "{err}");
        let result: serde_json::Value = serde_json::from_str(&out).expect("JSON");
        // On a busy computer it ends before the first answer.
        if !result["rig"]["status"].is_null() {
            assert_eq!(result["rig"]["status"]["state"], "ready", "{out}");
            return;
        }
        assert!(begin.elapsed() < Duration::from_secs(60), "{out}");
    }
}

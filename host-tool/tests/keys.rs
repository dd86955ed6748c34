//! Keys of `run` in a terminal, which is compared before and after.
#![cfg(unix)]

#[path = "machine/bench.rs"]
mod bench;
mod machine;
#[path = "machine/terminal.rs"]
mod terminal;

use std::process::Command;

use bench::Bench;
use protocol::system::{DeviceKind, Urgent};
use terminal::Terminal;

const RUN: [&str; 7] = [
    "run",
    "--cycles",
    "1",
    "--stroke-mm",
    "130",
    "--duration-s",
    "60",
];

fn kill(signal: &str, pid: u32) {
    // The shell's own: a small machine has no program of that name.
    let sent = Command::new("sh")
        .args(["-c", "kill \"$0\" \"$1\"", signal])
        .arg(pid.to_string())
        .status();
    assert!(sent.expect("kill").success());
}

#[test]
fn single_keys_hold_resume_and_stop_a_run() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut terminal = Terminal::start(bench.command(&RUN), 80, 24);
    terminal.wait_for("h holds the run, r resumes it, s or Ctrl-C stops it.");
    terminal.wait_for("stroke 1 of 2");
    terminal.press("h");
    terminal.wait_for("held at");
    terminal.press("r");
    terminal.wait_for("resumed");
    // Another key says which there are.
    terminal.press("x");
    let begin = std::time::Instant::now();
    while terminal.text().matches("h holds the run").count() < 2 {
        assert!(begin.elapsed().as_secs() < 60, "{}", terminal.text());
    }
    assert_eq!((bench.count("Hold"), bench.count("Resume")), (1, 1));
    // Pressed again while it brakes, it is no emergency stop.
    terminal.press("sss");
    assert_eq!(terminal.ends_restored(), Some(130));
    let urgent = bench.urgent();
    assert!(!urgent.is_empty() && urgent.iter().all(|stop| *stop == Urgent::Stop));
    assert_eq!(bench.trial()["status"], "stopped");
}

#[test]
fn the_terminal_is_restored_however_the_run_ends() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    for (end, code) in [("-TERM", 130), ("-HUP", 130), ("\x03", 130)] {
        let mut terminal = Terminal::start(bench.command(&RUN), 80, 24);
        terminal.wait_for("stroke 1 of 2");
        match end.strip_prefix('-') {
            Some(_) => kill(end, terminal.child.id()),
            None => terminal.press(end),
        }
        assert_eq!(terminal.ends_restored(), Some(code), "{end:?}");
        assert_eq!(bench.retrograde(&["home"]).0, Some(0));
    }
    let short = [
        "run",
        "--cycles",
        "1",
        "--stroke-mm",
        "10",
        "--duration-s",
        "2",
    ];
    let terminal = Terminal::start(bench.command(&short), 80, 24);
    assert_eq!(terminal.ends_restored(), Some(0));
    // Refused by the rig.
    assert_eq!(bench.retrograde(&["estop"]).0, Some(0));
    assert_eq!(bench.retrograde(&["ack"]).0, Some(0));
    let terminal = Terminal::start(bench.command(&RUN), 80, 24);
    assert_eq!(terminal.ends_restored(), Some(3));
}

#[test]
fn ctrl_c_after_the_key_is_the_emergency_stop() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    // It brakes for as long as it has accelerated.
    let slow = [
        "run",
        "--cycles",
        "1",
        "--speed-mm-s",
        "20",
        "--accel-mm-s2",
        "2",
    ];
    let mut terminal = Terminal::start(bench.command(&slow), 80, 24);
    terminal.wait_for("stroke 1 of 2");
    std::thread::sleep(std::time::Duration::from_secs(4));
    terminal.press("s");
    terminal.wait_for("stopping; Ctrl-C now for the emergency stop");
    terminal.press("\x03");
    assert_eq!(terminal.ends_restored(), Some(6));
    assert!(bench.urgent().contains(&Urgent::EStop));
}

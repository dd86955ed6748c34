//! Keys of `run` in a terminal, whose state is compared before and after.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::support::bench::Bench;
use crate::support::signal::Signal;
use crate::support::terminal::{End, Terminal};
use protocol::settings::SettingKey;
use protocol::system::{DeviceKind, Urgent};

const RUN: [&str; 7] = [
    "run",
    "--cycles",
    "1",
    "--stroke-mm",
    "130",
    "--duration-s",
    "60",
];

const SHORT: [&str; 7] = [
    "run",
    "--cycles",
    "1",
    "--stroke-mm",
    "10",
    "--duration-s",
    "2",
];

/// Presses a key, and again after each second: a busy computer may read it together with the one before, and neither is a
/// lone key then.
fn press_until(terminal: &mut Terminal, key: &str, shown: impl Fn(&str) -> bool) {
    for _ in 0..60 {
        terminal.press(key);
        std::thread::sleep(Duration::from_secs(1));
        if shown(&terminal.text()) {
            return;
        }
    }
    panic!("{}", terminal.text());
}

#[test]
fn single_keys_hold_resume_and_stop_a_run() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut terminal = Terminal::start(bench.command(&RUN), 80, 24);
    terminal.wait_for("h holds the run, ");
    terminal.wait_for("stroke 1 of 2");
    terminal.press("h");
    terminal.wait_for("held at");
    // F3, the position of the cursor and a pasted word end with `R`; F4 with `S`.
    for keys in [
        "\x1bOR",
        "\x1b[2;5R",
        "\x1bOS",
        "\x1br",
        "\x1b[200~s\x1b[201~",
        "hrs",
    ] {
        terminal.press(keys);
        std::thread::sleep(Duration::from_millis(300));
    }
    terminal.press("\x1b");
    std::thread::sleep(Duration::from_millis(40));
    terminal.press("O");
    std::thread::sleep(Duration::from_millis(40));
    terminal.press("R");
    std::thread::sleep(Duration::from_millis(300));
    assert_eq!((bench.count("Resume"), bench.urgent().len()), (0, 0));
    press_until(&mut terminal, "r", |text| {
        text.contains("Enter resumes the run")
    });
    press_until(&mut terminal, "\n", |text| text.contains("resumed"));
    // An unknown key shows the list of keys.
    press_until(&mut terminal, "x", |text| {
        text.matches("h holds the run").count() >= 2
    });
    assert_eq!((bench.count("Hold"), bench.count("Resume")), (1, 1));
    // Pressing it again while the rig brakes must not become an emergency stop.
    terminal.press("sss");
    assert_eq!(terminal.ends_restored(), Some(130));
    let urgent = bench.urgent();
    assert!(!urgent.is_empty() && urgent.iter().all(|stop| *stop == Urgent::Stop));
    assert_eq!(bench.trial()["status"], "stopped");
}

#[test]
fn the_terminal_is_restored_however_the_run_ends() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    for (end, code) in [
        (End::Signal(Signal::TERM), 130),
        (End::Signal(Signal::HUP), 130),
        (End::Key("\x03"), 130),
    ] {
        let mut terminal = Terminal::start(bench.command(&RUN), 80, 24);
        terminal.wait_for("stroke 1 of 2");
        terminal.end_by(end);
        assert_eq!(terminal.ends_restored(), Some(code), "{end:?}");
        assert_eq!(bench.retrograde(&["home"]).0, Some(0));
    }
    let terminal = Terminal::start(bench.command(&SHORT), 80, 24);
    assert_eq!(terminal.ends_restored(), Some(0));
    // The rig refuses the run.
    assert_eq!(bench.retrograde(&["estop"]).0, Some(0));
    assert_eq!(bench.retrograde(&["ack"]).0, Some(0));
    let terminal = Terminal::start(bench.command(&RUN), 80, 24);
    assert_eq!(terminal.ends_restored(), Some(3));
}

/// A rig that takes 0.4 s to stop from 20 mm/s.
fn sluggish() -> Bench {
    let mut script = crate::support::bench::ready(DeviceKind::Rig);
    script.settings.push((SettingKey::StopAccelUmS2, 50_000));
    Bench::on_tcp_as(&script, 1)
}

const SLOWLY: [&str; 7] = [
    "run",
    "--cycles",
    "1",
    "--speed-mm-s",
    "20",
    "--accel-mm-s2",
    "20",
];

#[test]
fn ctrl_c_after_the_key_is_the_emergency_stop() {
    let bench = sluggish();
    for attempt in 0.. {
        let mut terminal = Terminal::start(bench.command(&SLOWLY), 80, 24);
        terminal.wait_for("stroke 1 of 2");
        std::thread::sleep(Duration::from_millis(1_500));
        // A bar of two lines would wipe the text above it.
        let bar = |text: &str| text.lines().position(|line| line.contains("stroke 1 of 2"));
        let shown = terminal.text();
        assert_eq!(bar(&shown), Some(shown.lines().count() - 1), "{shown}");
        let braking = Instant::now();
        terminal.press("s");
        terminal.wait_for("stopping; Ctrl-C now for the emergency stop");
        terminal.press("\x03");
        let shown = Arc::clone(&terminal.bytes);
        let code = terminal.ends_restored();
        let took = braking.elapsed();
        if code == Some(130) && attempt < 3 {
            // Repeat if the computer stood still for as long as the rig brakes: that shows nothing.
            assert_eq!(bench.retrograde(&["home"]).0, Some(0));
            continue;
        }
        let shown = shown.lock().expect("free");
        let shown = String::from_utf8_lossy(&shown);
        assert_eq!(code, Some(6), "after {took:?}: {shown:?}");
        assert!(bench.urgent().contains(&Urgent::EStop));
        assert!(shown.contains("ended by a fault"), "{shown}");
        return;
    }
}

/// An emergency stop when the rig already stands: the run was stopped, but the position is lost all the same. The
/// last line must say so.
#[test]
fn an_emergency_stop_after_the_stop_is_told() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    for later_ms in [0, 4, 8, 15] {
        let stops = bench.urgent().len();
        let mut terminal = Terminal::start(bench.command(&SLOWLY), 80, 24);
        terminal.wait_for("stroke 1 of 2");
        terminal.press("s");
        terminal.wait_for("stopping; Ctrl-C now for the emergency stop");
        std::thread::sleep(Duration::from_millis(later_ms));
        terminal.press("\x03");
        let shown = Arc::clone(&terminal.bytes);
        let code = terminal.ends_restored();
        let shown = shown.lock().expect("free");
        let shown = String::from_utf8_lossy(&shown);
        let cut = bench.urgent()[stops..].contains(&Urgent::EStop);
        assert_eq!(
            code,
            Some(if cut { 6 } else { 130 }),
            "{later_ms} ms: {shown}"
        );
        assert_eq!(shown.contains("the position is kept"), !cut, "{shown}");
        if cut {
            assert_eq!(bench.retrograde(&["ack"]).0, Some(0));
        }
        assert_eq!(bench.retrograde(&["home"]).0, Some(0));
    }
}

/// Ctrl-S pauses the terminal: what is written there waits, and the run goes on and is recorded.
#[test]
fn a_paused_terminal_does_not_hold_up_a_run() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut terminal = Terminal::start(bench.command(&SHORT), 80, 24);
    terminal.wait_for("stroke 1 of 2");
    terminal.press("\x13");
    bench.wait_for("GetRunRecord");
    terminal.press("\x11");
    assert_eq!(terminal.ends_restored(), Some(0));
    let trial = bench.trial();
    assert_eq!(
        (&trial["status"], &trial["missed_samples"]),
        (&"complete".into(), &0.into())
    );
}

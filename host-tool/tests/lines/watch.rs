//! `watch` beside other processes: lines, whoever owns the line, and no effect on the machine.

use std::io::{BufRead, BufReader};
use std::process::{Child, ChildStdout};
use std::time::{Duration, Instant};

use crate::support::bench::{Bench, at_a_port};
use crate::support::signal::{Signal, kill};
use protocol::system::DeviceKind;
use serde_json::Value;

struct Watch {
    child: Child,
    out: BufReader<ChildStdout>,
}

impl Watch {
    fn start(bench: &Bench, more: &[&str]) -> Self {
        let args = [&["watch"], more].concat();
        let mut child = bench.command(&args).spawn().expect("starts");
        let out = BufReader::new(child.stdout.take().expect("piped"));
        Self { child, out }
    }

    fn line(&mut self) -> String {
        let mut line = String::new();
        let _ = self.out.read_line(&mut line).expect("a line");
        line
    }

    /// Reads on until a line is as wanted.
    fn until(&mut self, is: impl Fn(&str) -> bool) -> String {
        let begin = Instant::now();
        loop {
            let line = self.line();
            assert!(!line.is_empty() && begin.elapsed() < Duration::from_secs(60));
            if is(&line) {
                return line;
            }
        }
    }

    /// Reads on until the line belongs to this watch itself, or to the process.
    fn until_owned(&mut self, by: Option<u32>) {
        self.until(|line| {
            let line: Value = serde_json::from_str(line).expect("an object in each line");
            let owner = line["owner"].as_str();
            line["no_contact"].is_null()
                && match by {
                    Some(by) => owner.is_some_and(|o| o.starts_with(&format!("process {by} "))),
                    None => owner.is_none() && line["status"]["state"] == "ready",
                }
        });
    }

    fn ends(mut self) -> Option<i32> {
        self.child.wait().expect("ends").code()
    }
}

#[test]
fn it_prints_lines_until_nobody_reads() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut watch = Watch::start(&bench, &[]);
    let line = watch.until(|line| line.starts_with("rig: Ready, 0.000 mm"));
    assert!(!line.contains('\x1b'), "{line:?}");
    // A closed pipe ends the watch without an error.
    let Watch { mut child, out } = watch;
    drop(out);
    assert_eq!(child.wait().expect("ends").code(), Some(0));
    assert_eq!(bench.urgent(), []);
}

#[test]
fn a_signal_or_its_time_ends_it_and_stops_nothing() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    for signal in [Signal::TERM, Signal::HUP, Signal::INT] {
        let mut watch = Watch::start(&bench, &["--json"]);
        watch.until_owned(None);
        kill(signal, watch.child.id());
        assert_eq!(watch.ends(), Some(0));
    }
    assert_eq!(
        Watch::start(&bench, &["rig", "--for-s", "0.1"]).ends(),
        Some(0)
    );
    assert_eq!(bench.urgent(), []);
}

#[test]
fn the_owner_of_the_line_is_killed_and_the_watch_goes_on() {
    let bench = Bench::on_tcp(DeviceKind::Rig);
    let mut run = bench.run(&["--cycles", "1", "--duration-s", "600"]);
    let mut watch = Watch::start(&bench, &["--json"]);
    watch.until_owned(Some(run.id()));
    run.kill().expect("killed");
    run.wait().expect("ended");
    watch.until(|line| line.contains("\"owner\":null") && line.contains("\"no_contact\":null"));
    kill(Signal::TERM, watch.child.id());
    assert_eq!(watch.ends(), Some(0));
}

#[test]
fn it_gives_the_line_up_for_a_command_that_moves_and_looks_on() {
    // Only a port that was closed can be opened again.
    at_a_port(DeviceKind::Rig, |bench| {
        let mut watch = Watch::start(bench, &["--json"]);
        watch.until_owned(None);
        for _ in 0..3 {
            for target in ["1", "0"] {
                let (code, _, err) = bench.retrograde(&["move", target, "--speed-mm-s", "10"]);
                assert_eq!(code, Some(0), "{err}");
            }
        }
        let run = bench.run(&["--cycles", "9", "--stroke-mm", "20", "--duration-s", "90"]);
        watch.until_owned(Some(run.id()));
        let (code, _, err) = bench.retrograde(&["stop", "rig"]);
        assert_eq!(code, Some(0), "{err}");
        run.wait_with_output().expect("ends");
        watch.until(|line| line.contains("\"owner\":null") && line.contains("\"no_contact\":null"));
        kill(Signal::TERM, watch.child.id());
        assert_eq!(watch.ends(), Some(0));
    });
}

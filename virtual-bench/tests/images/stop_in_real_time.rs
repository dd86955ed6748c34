//! An emergency stop in real time, from the press to the last edge of STEP: by a second process, and over HTTP. The rig
//! runs at wall-clock pace behind a TCP port; everything else is the tool's own processes.
#![cfg(unix)]

use std::fs::Permissions;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;
use virtual_bench::bench::Bench;
use virtual_bench::boards::rig::{self, RigBoard};
use virtual_bench::fixture::Plug;
use virtual_bench::plants::rig::RigOptions;
use virtual_bench::serve::Server;
use virtual_bench::warm;

/// Longest time from the press to the last edge, ns, with the start of the process or the connection.
const LIMIT_NS: u64 = 50_000_000;
/// Presses of which one has to be in time: a busy computer may start a process late.
const PRESSES: usize = 8;
/// The same for each of them, ns: the link's time-out ends a run without any stop after 10 s.
const LATEST_NS: u64 = 5_000_000_000;
const LIMIT: Duration = Duration::from_secs(120);

/// A process of the tool. Dropping this value ends it.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

struct Laboratory {
    bench: Bench<RigBoard>,
    line: String,
    folder: tempfile::TempDir,
}

impl Laboratory {
    fn open() -> Self {
        // The emulator translates code when it first runs: slower than real time.
        warm::rig().expect("the image boots");
        let bench = rig::start(RigOptions::WITH_BOTH_JUMPERS).expect("the image boots");
        let server = Server::listen(0).expect("a free port");
        let line = format!("tcp:127.0.0.1:{}", server.port());
        let served = bench.clone();
        thread::spawn(move || server.serve(&served, "rig", &Plug::default()));
        // The tool keeps its locks in a folder that is closed to others only.
        let folder = tempfile::Builder::new()
            .permissions(Permissions::from_mode(0o700))
            .tempdir()
            .expect("a folder");
        Self {
            bench,
            line,
            folder,
        }
    }

    fn start(&self, arguments: &[&str]) -> Process {
        let child = Command::new(env!("CARGO_BIN_EXE_virtual-bench"))
            .arg("retrograde")
            .args(arguments)
            .env("RETROGRADE_RIG", &self.line)
            .env_remove("RETROGRADE_CAPSULE")
            .env("RETROGRADE_RUNTIME_DIR", self.folder.path())
            .current_dir(self.folder.path())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .spawn();
        Process(child.expect("it starts"))
    }

    fn ends(&self, mut process: Process, what: &str, code: i32) {
        let status = process.0.wait().expect("a status");
        assert_eq!(status.code(), Some(code), "{what}");
    }

    fn retrograde(&self, arguments: &[&str]) {
        self.ends(self.start(arguments), &arguments.join(" "), 0);
    }

    /// The machine's clock, ns, its edges so far, and when the last of them left the pin.
    fn seen(&self) -> (u64, usize, u64) {
        let seen = self.bench.visit(|visit| {
            let now_ns = visit.now_ns();
            let edges = visit.board().rig.edges();
            let last_ns = edges.iter().next_back().map_or(0, |edge| edge.at_ns);
            (now_ns, edges.len(), last_ns)
        });
        seen.expect("the bench runs")
    }

    fn wait<T>(&self, what: &str, mut until: impl FnMut() -> Option<T>) -> T {
        let begin = Instant::now();
        loop {
            if let Some(found) = until() {
                return found;
            }
            assert!(begin.elapsed() < LIMIT, "no {what}");
            thread::sleep(Duration::from_millis(2));
        }
    }

    /// The server's address and token, once it owns the line.
    fn served(&self) -> (String, String) {
        let path: PathBuf = self.folder.path().join("serve.json");
        let found: Value = self.wait("server", || {
            serde_json::from_slice(&std::fs::read(&path).ok()?).ok()
        });
        let text = |name: &str| found[name].as_str().expect("text").to_owned();
        let url = text("url");
        let at = url.trim_start_matches("http://").trim_end_matches('/');
        (at.to_owned(), text("token"))
    }
}

/// Posts to a server. Returns its answer.
fn post((at, token): &(String, String), path: &str) -> String {
    let mut stream = TcpStream::connect(at).expect("it listens");
    stream.set_read_timeout(Some(LIMIT)).expect("an option");
    let request = format!(
        "POST {path} HTTP/1.1\r\nHost: {at}\r\nConnection: close\r\nAuthorization: Bearer {token}\r\nContent-Length: 0\r\n\r\n"
    );
    stream.write_all(request.as_bytes()).expect("it reads");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("it answers");
    answer
}

/// Stops runs until one of the stops is in time.
fn is_in_time(laboratory: &Laboratory, name: &str, press: &dyn Fn()) {
    let mut took_ns = vec![];
    while took_ns.iter().all(|ns| *ns > LIMIT_NS) {
        assert!(took_ns.len() < PRESSES, "{name} takes {took_ns:?} ns");
        laboratory.retrograde(&["home"]);
        let before = laboratory.seen().1;
        let run = laboratory.start(&[
            "run",
            "--cycles",
            "1",
            "--stroke-mm",
            "40",
            "--duration-s",
            "8",
        ]);
        laboratory.wait("motion", || {
            (laboratory.seen().1 > before + 500).then_some(())
        });
        let (pressed_ns, _, _) = laboratory.seen();
        press();
        let (told_ns, _, _) = laboratory.seen();
        laboratory.ends(run, "the run that was stopped", 6);
        let (_, _, last_ns) = laboratory.seen();
        assert!(
            last_ns <= told_ns,
            "{name}: an edge after the stop was confirmed"
        );
        took_ns.push(last_ns.saturating_sub(pressed_ns));
        assert!(
            took_ns.iter().all(|ns| *ns < LATEST_NS),
            "{name}: {took_ns:?}"
        );
        laboratory.retrograde(&["ack"]);
    }
}

#[test]
fn an_emergency_stop_in_real_time_ends_the_pulses() {
    let laboratory = Laboratory::open();
    laboratory.retrograde(&["settings", "set", "link_timeout_ms", "10000"]);
    is_in_time(&laboratory, "a second process", &|| {
        laboratory.retrograde(&["estop"]);
    });
    let _server = laboratory.start(&["serve", "--listen", "127.0.0.1:0"]);
    let served = laboratory.served();
    is_in_time(&laboratory, "HTTP", &|| {
        let answer = post(&served, "/api/v1/estop");
        assert!(answer.contains("\"ok\":true"), "{answer}");
    });
}

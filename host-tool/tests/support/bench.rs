//! A machine at the end of a real line, in real time: TCP or a pseudo-terminal.
use std::collections::VecDeque;
use std::fs::Permissions;
use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::PermissionsExt;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use client::Device;
use client::broker::client::BrokerClient;
use client::broker::lock::LineFiles;
use protocol::settings::SettingKey;
use protocol::system::{DeviceKind, Urgent};
use serde_json::Value;
use simulated_machines::link::Peer;

use simulated_machines::machine::pace::Pace;
use simulated_machines::machine::{Log, Script, SimulatedMachine};

/// Bytes kept for a reader at a port: some seconds of telemetry.
const LONGEST_FREEZE: usize = 16 * 1024;

/// The machine's end of a line: sends bytes and takes those that have arrived.
type Carry = Box<dyn FnMut(&[u8], &mut [u8]) -> usize + Send>;

/// A machine that another host has already made ready.
pub fn ready(kind: DeviceKind) -> Script {
    let mut script = Script::new(kind);
    script.ready = true;
    if kind == DeviceKind::Rig {
        // A busy computer may freeze the tool for seconds, which must not end the run; some machines here run twelve
        // times as fast as real time.
        script.settings = vec![(SettingKey::LinkTimeoutMs, 60_000)];
    }
    script
}

/// A ready machine at the end of a line, and the folder of its locks and records.
pub struct Bench {
    pub kind: DeviceKind,
    pub address: String,
    pub log: Arc<Mutex<Log>>,
    pub folder: tempfile::TempDir,
    /// Number of connections on TCP so far.
    pub connections: Arc<Mutex<u32>>,
    /// Whether the line has held bytes back.
    stalled: Arc<AtomicBool>,
    /// Dropping the last of these switches the machine off.
    power: Arc<()>,
}

/// Longest time that moving bytes to or from the line takes a busy computer. Beyond it the line has stalled.
const STALL: Duration = Duration::from_millis(200);

/// Runs a test at a pseudo-terminal, and again if that has stalled: the system moves its bytes by the same workers that
/// write to disk, which a busy disk stops for seconds, and the tool rightly calls the machine silent.
pub fn at_a_port(kind: DeviceKind, test: impl Fn(&Bench)) {
    for attempt in 1.. {
        let bench = Bench::at_a_port(kind);
        match catch_unwind(AssertUnwindSafe(|| test(&bench))) {
            Ok(()) => return,
            Err(failed) if attempt == 20 || !bench.has_stalled() => resume_unwind(failed),
            Err(_) => {}
        }
    }
}

impl Bench {
    /// On TCP; serves only the latest connection.
    pub fn on_tcp(kind: DeviceKind) -> Self {
        Self::on_tcp_as(&ready(kind), 1)
    }

    /// On TCP with this script, at `speed` times real time.
    pub fn on_tcp_as(script: &Script, speed: u32) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = format!("tcp:{}", listener.local_addr().expect("bound"));
        listener.set_nonblocking(true).expect("set");
        let connections = Arc::new(Mutex::new(0));
        let counted = Arc::clone(&connections);
        let mut client: Option<TcpStream> = None;
        let carry = move |out: &[u8], into: &mut [u8]| {
            if let Ok((stream, _)) = listener.accept() {
                stream.set_nonblocking(true).expect("set");
                stream.set_nodelay(true).expect("set");
                *counted.lock().expect("free") += 1;
                client = Some(stream);
            }
            let Some(stream) = &mut client else {
                return 0;
            };
            let count = match stream.read(into) {
                Ok(0) => None,
                Ok(count) => Some(count),
                Err(io) if io.kind() == ErrorKind::WouldBlock => Some(0),
                Err(_) => None,
            };
            if count.is_none() || stream.write_all(out).is_err() {
                client = None;
            }
            count.unwrap_or(0)
        };
        Self::behind(script, speed, address, Box::new(carry), connections)
    }

    /// At a pseudo-terminal; see [`at_a_port`].
    fn at_a_port(kind: DeviceKind) -> Self {
        use rustix::fs::{OFlags, fcntl_setfl};
        use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).expect("a terminal");
        grantpt(&master).expect("mine");
        unlockpt(&master).expect("mine");
        let name = ptsname(&master, vec![]).expect("named");
        let address = name.into_string().expect("UTF-8");
        fcntl_setfl(&master, OFlags::NONBLOCK).expect("set");
        let mut port = std::fs::File::from(master);
        let mut waiting = VecDeque::new();
        let carry = move |out: &[u8], into: &mut [u8]| {
            // The system keeps 4 KiB for a reader, which is a second of telemetry: a computer that stands still for longer
            // is no line that loses bytes.
            waiting.extend(out);
            let written = port.write(waiting.make_contiguous()).unwrap_or(0);
            waiting.drain(..written);
            // Bytes that no reader fetches are lost, as at a port.
            waiting.drain(..waiting.len().saturating_sub(LONGEST_FREEZE));
            port.read(into).unwrap_or(0)
        };
        Self::at(kind, address, Box::new(carry), Arc::default())
    }

    pub fn at(
        kind: DeviceKind,
        address: String,
        carry: Carry,
        connections: Arc<Mutex<u32>>,
    ) -> Self {
        Self::behind(&ready(kind), 1, address, carry, connections)
    }

    fn behind(
        script: &Script,
        speed: u32,
        address: String,
        mut carry: Carry,
        connections: Arc<Mutex<u32>>,
    ) -> Self {
        let kind = script.kind;
        let (mut machine, log) = SimulatedMachine::new(script.clone());
        let power = Arc::new(());
        let stalled = Arc::new(AtomicBool::new(false));
        let stalls = Arc::clone(&stalled);
        let on = Arc::downgrade(&power);
        thread::spawn(move || {
            let mut pace = Pace::new(speed);
            let mut bytes = [0; 256];
            while on.strong_count() > 0 {
                let now_us = pace.now_us();
                let given = machine.give(now_us);
                let begin = Instant::now();
                let count = carry(&given, &mut bytes);
                stalls.fetch_or(begin.elapsed() > STALL, Ordering::Relaxed);
                machine.take(&bytes[..count], now_us);
                pace.rest();
            }
        });
        let folder = tempfile::tempdir().expect("a folder");
        let locks = folder.path().join("locks");
        std::fs::create_dir(&locks).expect("a folder");
        std::fs::set_permissions(&locks, Permissions::from_mode(0o700)).expect("mine");
        Self {
            kind,
            address,
            log,
            folder,
            connections,
            stalled,
            power,
        }
    }

    /// A client in this process that goes through the broker.
    pub fn broker_client(&self) -> Device {
        let address = self.address.parse().expect("an address");
        let line_files = LineFiles::within(&self.locks(), &address).expect("a line");
        let client = BrokerClient::open(&line_files, Duration::from_secs(1)).expect("a broker");
        Device::connect(Box::new(client), self.kind, 1).expect("a machine")
    }

    pub fn locks(&self) -> PathBuf {
        self.folder.path().join("locks")
    }

    pub fn command(&self, args: &[&str]) -> Command {
        let variable = match self.kind {
            DeviceKind::Rig => "RETROGRADE_RIG",
            DeviceKind::Capsule => "RETROGRADE_CAPSULE",
        };
        let mut command = Command::new(env!("CARGO_BIN_EXE_retrograde"));
        command
            .args(args)
            .env_remove("RETROGRADE_RIG")
            .env_remove("RETROGRADE_CAPSULE")
            .env(variable, &self.address)
            .env("RETROGRADE_RUNTIME_DIR", self.locks())
            .current_dir(self.folder.path())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        command
    }

    /// Exit code, standard output, standard error.
    pub fn retrograde(&self, args: &[&str]) -> (Option<i32>, String, String) {
        read(self.command(args).output().expect("starts"))
    }

    /// Starts a run in another process.
    pub fn run(&self, more: &[&str]) -> Child {
        let mut child = self
            .command(&[&["run"], more].concat())
            .spawn()
            .expect("starts");
        let begin = Instant::now();
        while self.count("Run") == 0 {
            if begin.elapsed() > Duration::from_secs(60) {
                child.kill().expect("it is ours");
            }
            if child.try_wait().expect("a child").is_some() && self.count("Run") == 0 {
                panic!(
                    "no run: {:?}",
                    read(child.wait_with_output().expect("ended"))
                );
            }
            thread::sleep(Duration::from_millis(2));
        }
        child
    }

    pub fn executed(&self) -> Vec<&'static str> {
        self.log.lock().expect("log").executed.clone()
    }

    pub fn count(&self, request: &str) -> usize {
        let executed = self.executed();
        executed.iter().filter(|name| **name == request).count()
    }

    pub fn wait_for(&self, request: &str) {
        let begin = Instant::now();
        while self.count(request) == 0 {
            assert!(begin.elapsed() < Duration::from_secs(60), "no {request}");
            thread::sleep(Duration::from_millis(2));
        }
    }

    pub fn urgent(&self) -> Vec<Urgent> {
        let log = self.log.lock().expect("log");
        log.urgent.iter().map(|(urgent, _)| *urgent).collect()
    }

    /// Whether the line has stalled so far. A stall that goes on is known only when it ends.
    fn has_stalled(&self) -> bool {
        let begin = Instant::now();
        while !self.stalled.load(Ordering::Relaxed) && begin.elapsed() < Duration::from_secs(5) {
            thread::sleep(Duration::from_millis(10));
        }
        self.stalled.load(Ordering::Relaxed)
    }

    pub fn connections(&self) -> u32 {
        *self.connections.lock().expect("free")
    }

    /// Sidecar of the only trial.
    pub fn trial(&self) -> Value {
        let folder = self.folder.path().join("retrograde-data");
        let files: Vec<_> = std::fs::read_dir(folder)
            .expect("records")
            .map(|entry| entry.expect("an entry").path())
            .filter(|path| path.extension().is_some_and(|kind| kind == "json"))
            .collect();
        assert_eq!(files.len(), 1, "{files:?}");
        let text = std::fs::read(&files[0]).expect("a sidecar");
        serde_json::from_slice(&text).expect("JSON")
    }

    /// Number of rows in its telemetry, and of samples missing between them.
    pub fn telemetry(&self) -> (usize, u32) {
        let folder = self.folder.path().join("retrograde-data");
        let csv = std::fs::read_dir(folder)
            .expect("records")
            .map(|entry| entry.expect("an entry").path())
            .find(|path| path.extension().is_some_and(|kind| kind == "csv"))
            .expect("telemetry");
        let text = std::fs::read_to_string(csv).expect("text");
        let missed = |line: &str| {
            let missed = line.rsplit(',').nth(1).expect("columns");
            missed.parse::<u32>().expect("a number")
        };
        let rows: Vec<_> = text.lines().skip(1).map(missed).collect();
        (rows.len(), rows.iter().sum())
    }
}

/// Exit code, standard output, standard error.
pub fn read(output: Output) -> (Option<i32>, String, String) {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (
        output.status.code(),
        text(&output.stdout),
        text(&output.stderr),
    )
}

/// The same command with a limit on file sizes: the system refuses to write more, as on a full disk.
pub fn with_little_space(command: &Command, bytes: u32) -> Command {
    // Without the trap, the system would kill the process.
    limited(command, &format!("trap '' XFSZ; ulimit -f {}", bytes / 512))
}

/// The same command after this of a shell.
pub fn limited(command: &Command, limit: &str) -> Command {
    let script = format!("{limit}; exec \"$0\" \"$@\"");
    let mut shell = Command::new("sh");
    shell.args(["-c", &script]).arg(command.get_program());
    shell
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    shell.args(command.get_args());
    for (name, value) in command.get_envs() {
        match value {
            Some(value) => shell.env(name, value),
            None => shell.env_remove(name),
        };
    }
    if let Some(folder) = command.get_current_dir() {
        shell.current_dir(folder);
    }
    shell
}

/// Tries until a stop has used the broker alone. One that a busy computer does not answer within 250 ms, or whose owner
/// leaves before it has answered, also goes the direct way, as it should, and shows nothing of the broker.
pub fn through_the_broker_alone(stop: impl Fn() -> Bench) {
    assert!(
        (0..25).any(|_| stop().connections() == 1),
        "each of 25 stops went the direct way as well"
    );
}

//! Target: arbitrary messages of a device, into the host tool's client, the server's worker and command lines.

use std::fs;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use crate::bench::{Bench, Opened, absent};
use crate::command;
use crate::server::{self, INSTANCE, Server};
use client::Unobserved;
use client::address::Address;
use client::error::ClientError;
use client::link::{Link, LinkError};
use client::{Device, Observer, Progress};
use jiff::Timestamp;
use lab::trials::fetched;
use protocol::frame::Kind;
use protocol::rig::{LinkLossPolicy, Run, RunTiming};
use protocol::settings::{GetSetting, SettingKey};
use protocol::system::{DeviceKind, Event, Urgent};
use protocol::table::{Reply, Telemetry};
use serde::{Deserialize, Serialize};
use simulated_machines::link::Peer;
use tempfile::TempDir;

use crate::exemplary::{Exemplary, SharedLog};
use crate::model::{self, Good};
use crate::script::steps;

/// Most steps of a script that are executed.
const MOST_STEPS: usize = 64;

/// The host's actions, and the beginning of the device's.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct HostScript {
    /// Whether the device is a capsule.
    pub capsule: bool,
    /// Number of correct answers that the device begins with.
    pub good: u8,
    /// The part of the host under test.
    pub part: HostPart,
}

/// The part of the host under test.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum HostPart {
    /// The client.
    Client(Vec<Act>),
    /// The server, with a command by its index.
    Server(u8),
    /// A command line, by its index, with `--json` if true.
    Command(u8, bool),
}

/// An action of the client.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub enum Act {
    /// Asks for the status.
    Status,
    /// Homes and waits for the end.
    Home,
    /// Runs and waits for the end.
    Run,
    /// Fetches events.
    Events,
    /// Waits for this many ms.
    Idle(u8),
    /// Only listens, for this many ms.
    Observe(u8),
    /// Waits until the rig is at rest.
    Rest,
    /// References or folds, and waits for the end.
    Actuate(bool),
    /// Fetches the recording.
    Trace,
    /// Stops.
    Urgent(Urgent),
    /// Asks for the last words.
    Words,
    /// Asks for a setting.
    Setting(SettingKey),
    /// Fetches the machine's record of its last action.
    Fetch,
}

/// The device's next behaviour.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum DeviceStep {
    /// The correct answer.
    Good,
    /// This answer to the last request.
    Reply(Reply),
    /// A sample; the sequence number advances by this much.
    Telemetry(u16, Telemetry),
    /// An event with the index that it contains.
    Event(Event),
    /// An event with the next index.
    Next(protocol::system::What),
    /// A frame: kind, session, sequence number, body.
    Frame(u8, u8, u16, Vec<u8>),
    /// Raw bytes.
    Noise(Vec<u8>),
    /// Silence for this many us.
    Silence(u32),
}

/// The device and the line to it.
struct LineState {
    now_us: u64,
    good: u8,
    steps: Vec<DeviceStep>,
    /// Gives the correct answers.
    machine: Exemplary,
    last: Option<Good>,
    telemetry: u16,
    event: u32,
    waiting: Vec<u8>,
    /// Number of reads from the line after the end of the script.
    late: u32,
}

#[derive(Clone)]
struct ScriptedLine(Arc<Mutex<LineState>>);

impl ScriptedLine {
    fn state(&self) -> MutexGuard<'_, LineState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl LineState {
    fn say(&mut self, step: DeviceStep) {
        let (session, seq) = self
            .last
            .as_ref()
            .map_or((0, 0), |last| (last.session, last.seq));
        let session = session.max(1);
        let bytes = match step {
            DeviceStep::Good => self.machine.give(0),
            DeviceStep::Reply(reply) => {
                let body = postcard::to_stdvec(&reply).expect("short");
                model::frame(Kind::Reply as u8, session, seq, &body)
            }
            DeviceStep::Telemetry(missed, sample) => {
                self.telemetry = self.telemetry.wrapping_add(missed).wrapping_add(1);
                let body = postcard::to_stdvec(&sample).expect("short");
                model::frame(Kind::Telemetry as u8, session, self.telemetry, &body)
            }
            DeviceStep::Event(event) => {
                self.event = event.index;
                let body = postcard::to_stdvec(&event).expect("short");
                model::frame(Kind::Event as u8, session, event.index as u16, &body)
            }
            DeviceStep::Next(what) => {
                self.event = self.event.wrapping_add(1);
                let event = Event {
                    index: self.event,
                    time_us: self.now_us,
                    what,
                };
                let body = postcard::to_stdvec(&event).expect("short");
                model::frame(Kind::Event as u8, session, self.event as u16, &body)
            }
            DeviceStep::Frame(kind, session, seq, body) => model::frame(kind, session, seq, &body),
            DeviceStep::Noise(bytes) => bytes,
            DeviceStep::Silence(us) => {
                self.now_us += u64::from(us);
                return;
            }
        };
        self.waiting.extend(bytes);
    }
}

impl Link for ScriptedLine {
    fn place(&self) -> String {
        "bench".to_owned()
    }

    fn now_us(&self) -> u64 {
        self.state().now_us
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        let mut state = self.state();
        let (sent, bad) = model::read(bytes);
        assert_eq!(bad, 0, "a host sends frames");
        for frame in &sent {
            assert!([1, 3].contains(&frame.kind), "a host's kinds");
        }
        state.machine.take(bytes, 0);
        state.last = sent.into_iter().next_back().or(state.last.take());
        Ok(())
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        let mut state = self.state();
        if state.waiting.is_empty() {
            if state.good > 0 {
                let reply = state.machine.give(0);
                if !reply.is_empty() {
                    state.good -= 1;
                    state.waiting = reply;
                }
            } else if let Some(step) = state.steps.pop() {
                state.say(step);
            } else {
                state.late += 1;
                assert!(state.late < 1_000, "no end without a line");
                return Err(LinkError::Lost {
                    place: self.place(),
                    why: "the script is over".to_owned(),
                });
            }
        }
        let count = buffer.len().min(state.waiting.len());
        for (slot, byte) in buffer.iter_mut().zip(state.waiting.drain(..count)) {
            *slot = byte;
        }
        if count == 0 {
            state.now_us = state.now_us.max(deadline_us);
        }
        Ok(count)
    }
}

/// Checks that events arrive once and in order.
#[derive(Default)]
struct Seen {
    newest: Option<u32>,
}

impl Observer for Seen {
    fn event(&mut self, event: &Event) {
        let is_new = self.newest.is_none_or(|newest| newest < event.index);
        assert!(is_new, "event {} after {:?}", event.index, self.newest);
        self.newest = Some(event.index);
    }

    fn progress(&mut self, progress: &Progress) {
        if let Progress::Run {
            elapsed_us,
            total_us,
            ..
        } = progress
        {
            assert!(elapsed_us <= total_us);
        }
    }
}

/// Runs a script.
///
/// # Panics
/// The host violates a property.
pub fn target(data: &[u8]) {
    let Ok((plan, data)) = postcard::take_from_bytes::<HostScript>(data) else {
        return;
    };
    let kind = match plan.capsule {
        false => DeviceKind::Rig,
        true => DeviceKind::Capsule,
    };
    let mut steps: Vec<_> = steps::<DeviceStep>(data).take(MOST_STEPS).collect();
    // Steps are popped from the end.
    steps.reverse();
    let line = ScriptedLine(Arc::new(Mutex::new(LineState {
        now_us: 0,
        good: plan.good,
        steps,
        machine: Exemplary::new(kind, true, &SharedLog::default()),
        last: None,
        telemetry: 0,
        event: 0,
        waiting: vec![],
        late: 0,
    })));
    match plan.part {
        HostPart::Client(acts) => {
            if let Err(error) = client(line, kind, &acts) {
                let help = miette::Diagnostic::help(&error).map(|help| help.to_string());
                assert!(
                    help.is_some_and(|help| !help.is_empty()),
                    "{error}: no help"
                );
            }
        }
        HostPart::Server(number) => server(line, kind, number),
        HostPart::Command(number, json) => command(line, kind, number, json),
    }
}

fn client(line: ScriptedLine, kind: DeviceKind, acts: &[Act]) -> Result<(), ClientError> {
    let mut device = Device::connect(Box::new(line), kind, 1)?;
    let mut seen = Seen::default();
    for act in acts.iter().take(MOST_STEPS) {
        match act {
            Act::Status => drop(device.rig_status()?),
            Act::Home => {
                let accepted = device.home()?;
                device.wait_homing(&accepted, &mut seen)?;
            }
            Act::Run => {
                let accepted = device.run(RUN)?;
                device.wait_run(&accepted, &mut seen)?;
            }
            Act::Events => {
                for event in device.take_events()? {
                    seen.event(&event);
                }
                device.take_telemetry();
            }
            Act::Idle(ms) => device.idle(u64::from(*ms) * 1_000, &mut seen)?,
            Act::Observe(ms) => device.observe(u64::from(*ms) * 1_000, &mut seen)?,
            Act::Rest => drop(device.wait_rest(&mut Unobserved)?),
            Act::Actuate(folds) => {
                let accepted = match folds {
                    true => device.fold()?,
                    false => device.reference()?,
                };
                device.wait_actuation(&accepted, &mut seen)?;
            }
            Act::Trace => drop(device.trace()?),
            Act::Urgent(urgent) => device.urgent(*urgent)?,
            Act::Words => drop(device.last_words()?),
            Act::Setting(key) => drop(device.call(GetSetting { key: *key })?),
            Act::Fetch => drop(fetched::fetch(&mut device, Timestamp::UNIX_EPOCH)?),
        }
    }
    Ok(())
}

pub(crate) const RUN: Run = Run {
    cycles: 1,
    stroke_um: 10_000,
    timing: RunTiming::Speeds {
        forward_um_s: 10_000,
        return_um_s: 10_000,
        accel_um_s2: 100_000,
    },
    far_dwell_us: 0,
    home_dwell_us: 0,
    start_delay_us: 0,
    link_loss: LinkLossPolicy::Stop,
};

/// Opens the one line, once.
fn once(line: ScriptedLine) -> Bench<impl Fn(DeviceKind) -> Opened> {
    let line = Mutex::new(Some(line));
    Bench(move |_| {
        let mut line = line.lock().unwrap_or_else(PoisonError::into_inner);
        let line = line.take().ok_or_else(absent)?;
        Ok(Box::new(line))
    })
}

/// Command lines that print data from a machine.
const LINES: [&[&str]; 7] = [
    &["info"],
    &["health"],
    &["settings", "list"],
    &["settings", "name"],
    &["records", "fetch"],
    &["ack"],
    &["stop"],
];

/// Runs a command line; the device's data must not control the terminal.
fn command(line: ScriptedLine, kind: DeviceKind, number: u8, json: bool) {
    static OUT: OnceLock<TempDir> = OnceLock::new();
    let out = OUT.get_or_init(|| tempfile::tempdir().expect("a folder"));
    let out = out.path().to_str().expect("UTF-8");
    let words = LINES[usize::from(number) % LINES.len()];
    let place = match kind {
        DeviceKind::Rig => "--rig",
        DeviceKind::Capsule => "--capsule",
    };
    let mut args = vec![place, "/bench"];
    args.extend(words);
    match (words[0], kind) {
        ("records", _) => args.extend(["--out", out]),
        ("settings", DeviceKind::Capsule) => args.extend(["--of", "capsule"]),
        _ => {}
    }
    if json {
        args.push("--json");
    }
    command::run(&args, &once(line));
    for entry in fs::read_dir(out).expect("a folder").flatten() {
        let _ = fs::remove_file(entry.path());
    }
}

/// Commands that leave no record, which makes them cheap.
const COMMANDS: [&str; 5] = ["rig/home", "rig/move", "rig/hold", "rig/ack", "capsule/ack"];

/// Sends a command to the server and reads its pages afterwards; both must work whatever the device has sent.
fn server(line: ScriptedLine, kind: DeviceKind, number: u8) {
    const TOKEN: &str = "0123456789abcdef";
    let places = [(kind, Address::Serial("bench".to_owned()))];
    let folder = std::env::temp_dir();
    server::with(&once(line), &places, TOKEN, &folder, |server| {
        let command = COMMANDS[usize::from(number) % COMMANDS.len()];
        let body = match command {
            "rig/move" => "{\"position_mm\":1}",
            _ => "{}",
        };
        let uri = format!("/api/v1/{command}");
        let key = format!("{INSTANCE}-1");
        let bearer = format!("Bearer {TOKEN}");
        let headers: [(&str, &[u8]); 4] = [
            ("host", b"localhost"),
            ("authorization", bearer.as_bytes()),
            ("idempotency-key", key.as_bytes()),
            ("content-type", b"application/json"),
        ];
        let ask = |server: &mut Server<'_>, method, uri| {
            let answer = server.ask(server::HttpRequest {
                here: true,
                method,
                uri,
                headers: &headers,
                body: body.as_bytes(),
            });
            answer.expect("a request").status
        };
        ask(server, "POST", &uri);
        assert_eq!(ask(server, "GET", "/api/v1/state"), 200);
        assert_eq!(ask(server, "GET", "/api/v1/actions"), 200);
    });
}

//! A machine behind a faulty line, in virtual time. The machine is the firmware, its link service and control, on the
//! mechanics of `rig` or [`capsule`]. Only the line and the events around the machine are scripted.
pub mod capsule;
mod line;
pub mod pace;
mod port;
mod rig;

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};

use crate::chip::Flash;
use crate::link::{Memory, Peer};
use client::{self, Unobserved};
use device::identity::identity;
use device::retained::Retained;
use device::service::{Inbound, Incoming, Service};
use device::settings::SettingsStore;
use line::{LATENCY_US, Line};
use port::Port;
use protocol::frame::{Header, Kind, encode};
use protocol::rig::Run;
use protocol::settings::SettingKey;
use protocol::system::{DeviceKind, ResetCause, Urgent};
use protocol::table::{Reply, SCHEMA_KEY, Telemetry};

/// Chip number, unless the script gives another one.
const UID: [u8; 12] = [0xab; 12];
/// Chip number of a board that reports itself as simulated.
pub const VIRTUAL_UID: [u8; 12] = *b"virtual test";
/// Interval at which the simulation checks whether a machine is driven, us.
const POLL_US: u64 = 5_000;
/// Locating speed for a rig with few steps: homing would otherwise take most of a script's time.
const FAST_HOMING: (SettingKey, u32) = (SettingKey::LocateUmS, 20_000);
/// How long a button press lasts, us.
const PRESS_US: u64 = 50_000;

/// The script: faults of the line, events around the machine, and its state before the host connects.
#[derive(Clone, Debug)]
pub struct Script {
    pub kind: DeviceKind,
    /// Number of the chip.
    pub uid: [u8; 12],
    /// Schema key of the firmware's identity.
    pub schema_key: u64,
    pub major: u8,
    /// Flips one bit in this many, in both directions; 0 flips none.
    pub flip_one_in: u64,
    pub seed: u64,
    /// Events with these indices are lost on the line.
    pub silent_events: Vec<u32>,
    /// Names of requests that the line loses, and how many times each.
    pub deaf_to: Vec<(&'static str, u32)>,
    /// The machine receives nothing, not even urgent stops.
    pub dead: bool,
    /// Another host has already homed or referenced the machine.
    pub ready: bool,
    /// Another host has already made the machine ready and started this run, this many us ago.
    pub running: Option<(Run, u64)>,
    /// Events around the machine with their times on the link's clock, us, in order.
    pub world: Vec<(u64, World)>,
    /// Settings changed before the host connects.
    pub settings: Vec<(SettingKey, u32)>,
    /// Writes to the flash that fail, numbered from 0.
    pub failing_writes: Range<usize>,
    /// A rig with 80 steps in its stroke, so that many motions cost little time.
    pub few_steps: bool,
}

impl Script {
    pub fn new(kind: DeviceKind) -> Self {
        Self {
            kind,
            uid: UID,
            schema_key: SCHEMA_KEY,
            major: protocol::VERSION.major,
            flip_one_in: 0,
            seed: 1,
            silent_events: vec![],
            deaf_to: vec![],
            dead: false,
            ready: false,
            running: None,
            world: vec![],
            settings: vec![],
            failing_writes: 0..0,
            few_steps: false,
        }
    }
}

/// An event around a machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum World {
    /// The E-stop loop opens or closes.
    EStopLoop { open: bool },
    /// The start button goes down or up.
    Button { down: bool },
    /// The step timer stops and does not restart.
    TimerStands,
    /// The watchdog resets the device.
    Reset,
    /// A stop comes from another terminal.
    StopFrame,
    /// A resume comes from another terminal.
    Resume,
    /// The capsule's cell has this voltage from now on.
    Battery { mv: u16 },
}

/// A press of the start button.
pub fn button(at_us: u64) -> Vec<(u64, World)> {
    for_a_moment(at_us, |down| World::Button { down })
}

/// The E-stop loop opens for a moment.
pub fn estop(at_us: u64) -> Vec<(u64, World)> {
    for_a_moment(at_us, |open| World::EStopLoop { open })
}

fn for_a_moment(at_us: u64, event: fn(bool) -> World) -> Vec<(u64, World)> {
    vec![(at_us, event(true)), (at_us + PRESS_US, event(false))]
}

/// The machine's log since the host connected.
pub struct Log {
    /// Time on the link's clock, us.
    pub now_us: u64,
    /// Names of the requests that were executed, once per execution.
    pub executed: Vec<&'static str>,
    /// Names of all request frames that arrived, and `Urgent`.
    pub heard: Vec<&'static str>,
    pub urgent: Vec<(Urgent, u64)>,
    /// When bytes from the host last arrived, us.
    pub heard_us: u64,
    /// When the machine was last seen driven.
    pub driven_us: u64,
    /// The machine's flash, and its number of writes before the host connected.
    flash: Flash,
    writes_before: usize,
}

impl Log {
    fn new(flash: &Flash) -> Self {
        Self {
            now_us: 0,
            executed: vec![],
            heard: vec![],
            urgent: vec![],
            heard_us: 0,
            driven_us: 0,
            flash: flash.clone(),
            writes_before: flash.operations().len(),
        }
    }

    /// The stored settings in the order of their keys.
    pub fn settings(&self) -> Vec<u32> {
        let store = stored(&self.flash);
        SettingKey::ALL.map(|key| store.values().get(key)).to_vec()
    }

    /// The stored name.
    pub fn name(&self) -> String {
        stored(&self.flash).name().to_owned()
    }

    /// How often the flash was written.
    pub fn writes(&self) -> usize {
        self.flash.operations().len() - self.writes_before
    }
}

/// The flash of a rig with few steps, built once and cached.
fn few_steps() -> &'static [u8] {
    static FLASH: OnceLock<Vec<u8>> = OnceLock::new();
    FLASH.get_or_init(|| {
        let flash = Flash::blank();
        for (key, value) in rig::FEW_STEPS.into_iter().chain([FAST_HOMING]) {
            stored(&flash).set(key, value).expect("a good flash");
        }
        flash.bytes()
    })
}

/// The settings that a machine would find in its flash at the next start.
fn stored(flash: &Flash) -> SettingsStore<Flash> {
    let (store, usable) = SettingsStore::load(flash.clone(), |_| true);
    assert!(usable, "the flash can be read");
    store
}

/// Control and mechanics of either machine. Times are the device's, us.
trait Device: Send {
    /// Restarts control; the mechanics keep their state.
    fn reset(&mut self, previous: Retained, cause: ResetCause);
    /// Time of the next event inside the device.
    fn due_us(&mut self) -> u64;
    fn advance(&mut self, until_us: u64);
    fn answer(&mut self, inbound: Inbound) -> Reply;
    fn telemetry(&mut self) -> Option<Telemetry>;
    fn world(&mut self, event: World);
    /// Pulses are going out, or the bridge is awake.
    fn is_driven(&mut self) -> bool;
    /// Pulses so far on a rig; readings with the bridge awake on a capsule.
    fn work(&mut self) -> u64;
}

/// A machine and the line to it.
pub struct SimulatedMachine {
    script: Script,
    line: Line,
    service: Service,
    port: Port,
    device: Box<dyn Device>,
    world: VecDeque<(u64, World)>,
    log: Arc<Mutex<Log>>,
    // The times below are in us since the machine was first switched on.
    now_us: u64,
    /// When the device last started.
    started_us: u64,
    /// When the host connected; the link's clock starts here.
    connected_us: u64,
    /// When the device is next due.
    due_us: u64,
}

/// A link to a new machine, and its log.
pub fn link(script: Script) -> (Box<Memory<SimulatedMachine>>, Arc<Mutex<Log>>) {
    let place = match script.kind {
        DeviceKind::Rig => "test rig",
        DeviceKind::Capsule => "test capsule",
    };
    let (machine, log) = SimulatedMachine::new(script);
    (Box::new(Memory::new(place, machine)), log)
}

impl SimulatedMachine {
    /// A machine to which a host has just connected, and its log from that moment.
    pub fn new(script: Script) -> (Self, Arc<Mutex<Log>>) {
        let port = Port::new();
        let flash = match script.few_steps {
            true => Flash::holding(few_steps().to_vec()),
            false => Flash::blank(),
        };
        for (key, value) in &script.settings {
            stored(&flash).set(*key, *value).expect("a good flash");
        }
        let previous = port.start();
        let service = service(&script, previous.boot_id, ResetCause::PowerOn);
        let device: Box<dyn Device> = match script.kind {
            DeviceKind::Rig => Box::new(rig::Rig::new(&port, &flash, previous, script.few_steps)),
            DeviceKind::Capsule => Box::new(capsule::Capsule::new(&port, &flash, previous)),
        };
        let log = Arc::new(Mutex::new(Log::new(&flash)));
        let mut machine = Self {
            line: Line::new(&Script::new(script.kind)),
            service,
            port,
            device,
            world: VecDeque::new(),
            log: Arc::clone(&log),
            now_us: 0,
            started_us: 0,
            connected_us: 0,
            due_us: 0,
            script,
        };
        if machine.script.ready || machine.script.running.is_some() {
            machine = machine.with_another_host();
        }
        machine.connect(&flash);
        (machine, log)
    }

    /// Lets another host make the machine ready over a good line.
    fn with_another_host(mut self) -> Self {
        self.connected_us = self.now_us;
        let script = self.script.clone();
        let shared = Arc::new(Mutex::new(self));
        let link = Memory::new("another host's", Shared(Arc::clone(&shared)));
        let mut host = client::Device::new(Box::new(link), u32::MAX);
        // This nonce is reserved for the other host.
        host.hello(u32::MAX).expect("there");
        make_ready(&mut host, &script);
        drop(host);
        let Some(machine) = Arc::into_inner(shared) else {
            panic!("the other host is gone");
        };
        machine.into_inner().expect("it has not panicked")
    }

    fn connect(&mut self, flash: &Flash) {
        self.line = Line::new(&self.script);
        self.connected_us = self.now_us;
        let world = self.script.world.iter();
        self.world = world
            .map(|(time_us, event)| (self.now_us + time_us, *event))
            .collect();
        flash.fail(self.script.failing_writes.clone());
        *self.log() = Log::new(flash);
    }

    /// Pulses so far on a rig; readings with the bridge awake on a capsule.
    pub fn work(&mut self) -> u64 {
        self.device.work()
    }

    /// Number of requests and stops that the machine has executed since the host connected.
    pub fn executed(&self) -> usize {
        let log = self.log();
        log.executed.len() + log.urgent.len()
    }

    /// Whether it is moving, and the last requested motion is a run.
    pub fn is_in_a_run(&mut self) -> bool {
        const MOTIONS: [&str; 4] = ["Home", "Jog", "MoveTo", "Run"];
        let log = self.log();
        let mut asked = log.executed.iter().rev();
        let last = asked.find(|name| MOTIONS.contains(name)).copied();
        drop(log);
        last == Some("Run") && self.device.is_driven()
    }

    /// Makes this event happen now.
    pub fn inject(&mut self, event: World) {
        self.happen(event);
        self.send();
    }

    /// When it was last seen driven, us on the link's clock.
    pub fn driven_us(&self) -> u64 {
        self.log().driven_us
    }

    fn log(&self) -> MutexGuard<'_, Log> {
        self.log
            .lock()
            .expect("no test panics while it holds the log")
    }

    /// Advances the machine to `now_us`.
    fn advance(&mut self, now_us: u64) {
        loop {
            let event_us = self.world.front().map_or(u64::MAX, |(time_us, _)| *time_us);
            let until_us = event_us.min(now_us).min(self.now_us + POLL_US);
            self.run(until_us);
            if self.device.is_driven() {
                self.log().driven_us = until_us - self.connected_us;
            }
            if event_us == until_us {
                if let Some((_, event)) = self.world.pop_front() {
                    self.happen(event);
                }
            } else if until_us == now_us {
                break;
            }
        }
        self.send();
    }

    /// Runs the device until `until_us` and sends its telemetry.
    fn run(&mut self, until_us: u64) {
        let until = until_us - self.started_us;
        while self.port.sample_us() <= until {
            self.device.advance(self.port.sample_us());
            self.port.send_sample(self.device.telemetry());
        }
        self.device.advance(until);
        self.now_us = until_us;
    }

    fn happen(&mut self, event: World) {
        match event {
            World::Reset => {
                self.send();
                let (previous, cause) = (self.port.start(), ResetCause::Watchdog);
                self.service = service(&self.script, previous.boot_id, cause);
                self.started_us = self.now_us;
                self.device.reset(previous, cause);
            }
            World::StopFrame => {
                let header = Header {
                    kind: Kind::Urgent,
                    session: 0,
                    seq: 0,
                };
                self.receive(&encode(header, &Urgent::Stop).expect("fits"));
            }
            event => self.device.world(event),
        }
    }

    /// Passes the device's frames to the line.
    fn send(&mut self) {
        for (time_us, frame) in self.port.sent() {
            self.line.carry_to_host(self.started_us + time_us, &frame);
        }
        let due_us = self.device.due_us().min(self.port.sample_us());
        self.due_us = self.started_us.saturating_add(due_us);
    }

    /// Delivers bytes to the device's port.
    fn receive(&mut self, bytes: &[u8]) {
        for byte in bytes {
            let Some(incoming) = self.service.receive(*byte, self.port.now_us() as u32) else {
                continue;
            };
            self.port
                .hear(self.service.session(), self.service.heard_us());
            let frame = match incoming {
                Incoming::Send(frame) => Some(frame),
                Incoming::Ask(inbound, to) => {
                    self.note(&inbound);
                    self.service.answer(to, &self.device.answer(inbound))
                }
                Incoming::Ignore => None,
            };
            self.port
                .hear(self.service.session(), self.service.heard_us());
            if let Some(frame) = frame {
                self.port.reply(frame);
            }
        }
        self.send();
    }

    fn note(&self, inbound: &Inbound) {
        let now_us = self.now_us - self.connected_us;
        match inbound {
            Inbound::Request(request) => self.log().executed.push(request.name()),
            Inbound::Urgent(urgent) => self.log().urgent.push((*urgent, now_us)),
        }
    }
}

impl Peer for SimulatedMachine {
    fn take(&mut self, bytes: &[u8], now_us: u64) {
        self.advance(self.connected_us + now_us);
        let mut heard = vec![];
        let bytes = self.line.carry_to_machine(bytes, &mut heard);
        let mut log = self.log();
        log.now_us = now_us;
        if !bytes.is_empty() {
            log.heard_us = now_us;
        }
        log.heard.extend(heard);
        drop(log);
        self.receive(&bytes);
    }

    fn give(&mut self, now_us: u64) -> Vec<u8> {
        self.advance(self.connected_us + now_us);
        self.log().now_us = now_us;
        self.line.arrived(self.now_us)
    }

    /// The earliest time at which bytes can reach the host: an event now takes at least the line's latency.
    fn next_us(&self) -> u64 {
        let event_us = self.world.front().map_or(u64::MAX, |(time_us, _)| *time_us);
        let next_us = self.due_us.min(event_us).saturating_add(LATENCY_US);
        next_us.min(self.line.next_us()) - self.connected_us
    }
}

/// The link service of a freshly started device.
fn service(script: &Script, boot_id: u32, cause: ResetCause) -> Service {
    let mut identity = identity(script.kind, script.uid, boot_id, cause);
    (identity.protocol.major, identity.schema_key) = (script.major, script.schema_key);
    Service::new(identity)
}

/// Homes or references the machine, then starts the run that the script wants in progress.
fn make_ready(host: &mut client::Device, script: &Script) {
    match script.kind {
        DeviceKind::Rig => {
            let accepted = host.home().expect("accepted");
            host.wait_homing(&accepted, &mut Unobserved).expect("homed");
        }
        DeviceKind::Capsule => {
            let accepted = host.reference().expect("accepted");
            let record = host.wait_actuation(&accepted, &mut Unobserved);
            record.expect("referenced");
        }
    }
    if let Some((run, for_us)) = script.running {
        host.run(run).expect("accepted");
        host.idle(for_us, &mut Unobserved).expect("there");
    }
}

/// A machine that outlives its link.
pub struct Shared(pub Arc<Mutex<SimulatedMachine>>);

impl Shared {
    fn machine(&self) -> MutexGuard<'_, SimulatedMachine> {
        self.0.lock().expect("it has not panicked")
    }
}

impl Peer for Shared {
    fn take(&mut self, bytes: &[u8], now_us: u64) {
        self.machine().take(bytes, now_us);
    }

    fn give(&mut self, now_us: u64) -> Vec<u8> {
        self.machine().give(now_us)
    }

    fn next_us(&self) -> u64 {
        self.machine().next_us()
    }
}

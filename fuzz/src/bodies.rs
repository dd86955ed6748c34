//! Target: good frames with arbitrary bodies into the request handling of both machines. Their real firmware decides,
//! on simulated mechanics, in virtual time.

use std::sync::{Arc, OnceLock};

use client::{Device, Unobserved};
use protocol::capsule::{Calibrate, Fold};
use protocol::error::Refusal;
use protocol::frame::Kind;
use protocol::rig::{Direction, LinkLossPolicy, MoveTo, Run, RunTiming};
use protocol::settings::{Setting, SettingKey};
use protocol::system::{DeviceKind, Hello, KeepAlive, Urgent};
use protocol::table::{Reply, Request, Response, SCHEMA_KEY};
use serde::{Deserialize, Serialize};
use simulated_machines::link::{Memory, Peer};

use crate::model::{self, Good, Once};
use crate::script::steps;
use simulated_machines::machine::{Left, Script, SimulatedMachine, World};

/// Time to wait for the answer to a frame, us.
const UNDER_WAY_US: u64 = 2_000;
/// Work after which a script ends: steps of a rig, or current readings of a capsule with its bridge awake. Bounds the
/// cost of a script.
const MOST_WORK: [u64; 2] = [1_500, 30];
/// Most steps of a script that are tried.
const MOST_STEPS: usize = 20;
/// Interval of the host's keep-alive requests, us.
const KEEP_ALIVE_US: u64 = 400_000;
/// Longest single advance of the virtual time, us.
const PIECE_US: u64 = 5_000;
/// Longest virtual time of a script, us.
const MOST_US: u64 = 8_000_000;

/// The machine of a script.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub enum Start {
    /// A rig that is not homed.
    Rig,
    /// A capsule that has no calibration.
    Capsule,
    /// A calibrated capsule that was switched off folded.
    Folded,
    /// A rig that another host has homed before.
    Homed,
}

/// A step of a script.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Step {
    /// A request of the session; the sequence number advances by this much.
    Request(u16, Request),
    /// A request that is likely to be accepted, so that motions begin.
    Sensible(Sensible),
    /// An arbitrary body, in the session (true) or in another one; the sequence number advances by this much.
    Body(bool, u16, Vec<u8>),
    /// The last frame again.
    Again,
    /// A Hello of the same host, or of another one.
    Hello(u32),
    /// A stop.
    Urgent(Urgent),
    /// This many ms pass, with keep-alive requests.
    Wait(u16),
    /// The E-stop loop of a rig opens (true) or closes.
    Loop(bool),
    /// The start button of a rig goes down (true) or up.
    Button(bool),
    /// The watchdog resets the machine.
    Reset,
    /// This many ms pass without any frame.
    Silence(u16),
}

/// A request that is usually within the limits.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub enum Sensible {
    /// A run: number of cycles, length in steps, speed in mm/s.
    Run(u8, u8, u8),
    /// A move to this step.
    Move(u8),
    /// A jog away (true) or home.
    Jog(bool),
    /// A setting, and its value as a share of its range, in 1/255.
    Set(u8, u8),
}

struct Bench {
    machine: SimulatedMachine,
    kind: DeviceKind,
    now_us: u64,
    once: Once,
    seq: u16,
    last: Vec<u8>,
}

/// Runs a script.
///
/// # Panics
/// The machine violates the protocol.
pub fn target(data: &[u8]) {
    let Ok((start, data)) = postcard::take_from_bytes::<Start>(data) else {
        return;
    };
    let mut bench = Bench::new(start);
    bench.hello(1);
    for step in steps::<Step>(data).take(MOST_STEPS) {
        bench.take(step);
        if bench.is_over() {
            return;
        }
    }
    bench.still_serves();
}

impl Bench {
    fn new(start: Start) -> Self {
        static FOLDED: OnceLock<Arc<Left>> = OnceLock::new();
        let kind = match start {
            Start::Rig | Start::Homed => DeviceKind::Rig,
            Start::Capsule | Start::Folded => DeviceKind::Capsule,
        };
        let mut script = Script::new(kind);
        script.few_steps = kind == DeviceKind::Rig;
        script.ready = matches!(start, Start::Homed);
        if let Start::Folded = start {
            script.left = Some(Arc::clone(FOLDED.get_or_init(|| Arc::new(folded()))));
        }
        Self {
            machine: SimulatedMachine::new(script).0,
            kind,
            now_us: 0,
            once: Once::default(),
            seq: 0,
            last: vec![],
        }
    }

    fn is_over(&mut self) -> bool {
        let [steps, readings] = MOST_WORK;
        let most = match self.kind {
            DeviceKind::Rig => steps,
            DeviceKind::Capsule => readings,
        };
        self.machine.work() > most || self.now_us > MOST_US
    }

    fn take(&mut self, step: Step) {
        match step {
            Step::Request(ahead, request) => self.request(ahead, &request),
            Step::Sensible(sensible) => self.request(1, &request(sensible)),
            Step::Body(ours, ahead, body) => {
                self.seq = self.seq.wrapping_add(ahead);
                let session = self.once.session() ^ u8::from(!ours);
                self.send(&model::frame(Kind::Request as u8, session, self.seq, &body));
            }
            Step::Again => self.send(&self.last.clone()),
            Step::Hello(nonce) => self.hello(nonce),
            Step::Urgent(urgent) => {
                self.seq = self.seq.wrapping_add(1);
                let body = postcard::to_stdvec(&urgent).expect("short");
                let session = self.once.session();
                self.send(&model::frame(Kind::Urgent as u8, session, self.seq, &body));
            }
            Step::Wait(ms) => self.attend(u64::from(ms) * 1_000),
            Step::Silence(ms) => drop(self.wait(u64::from(ms) * 1_000)),
            Step::Loop(open) if self.kind == DeviceKind::Rig => {
                self.machine.suffer(World::EStopLoop { open });
            }
            Step::Button(down) if self.kind == DeviceKind::Rig => {
                self.machine.suffer(World::Button { down });
            }
            Step::Reset => {
                self.machine.suffer(World::Reset);
                self.once.restarted();
            }
            Step::Loop(_) | Step::Button(_) => {}
        }
    }

    fn hello(&mut self, nonce: u32) {
        let hello = Hello {
            protocol: protocol::VERSION,
            schema_key: SCHEMA_KEY,
            nonce,
        };
        self.request(1, &Request::Hello(hello));
    }

    fn request(&mut self, ahead: u16, request: &Request) {
        self.seq = self.seq.wrapping_add(ahead);
        let body = postcard::to_stdvec(request).expect("short");
        let session = self.once.session();
        self.send(&model::frame(Kind::Request as u8, session, self.seq, &body));
    }

    /// Lets time pass with keep-alive requests.
    fn attend(&mut self, mut us: u64) {
        let last = self.last.clone();
        while us > KEEP_ALIVE_US && !self.is_over() {
            self.wait(KEEP_ALIVE_US);
            us -= KEEP_ALIVE_US;
            self.request(1, &Request::KeepAlive(KeepAlive));
        }
        self.wait(us);
        self.last = last;
    }

    /// Lets time pass; checks that the machine sends nothing but a device's frames, and returns them.
    fn wait(&mut self, us: u64) -> Vec<Good> {
        let end_us = self.now_us + us;
        let mut said = vec![];
        loop {
            self.now_us = (self.now_us + PIECE_US).min(end_us);
            said.extend(self.machine.give(self.now_us));
            if self.now_us == end_us || (us > UNDER_WAY_US && self.is_over()) {
                break;
            }
        }
        let (frames, bad) = model::read(&said);
        assert_eq!(bad, 0, "a machine sends frames");
        let is_ours = |frame: &Good| [2, 4, 5].contains(&frame.kind);
        assert!(frames.iter().all(is_ours), "a device's kinds");
        frames
    }

    /// Sends a frame; checks its one answer and what was executed for it.
    fn send(&mut self, bytes: &[u8]) {
        self.last = bytes.to_vec();
        let (sent, _) = model::read(bytes);
        let executed = self.machine.executed();
        self.machine.take(bytes, self.now_us);
        let executed = self.machine.executed() - executed;
        let said = self.wait(UNDER_WAY_US);
        let answers: Vec<_> = said.iter().filter(|frame| frame.kind == 2).collect();
        let [sent] = &sent[..] else {
            // The block is longer than any frame.
            assert_eq!((answers.len(), executed), (0, 0));
            return;
        };
        let [answer] = &answers[..] else {
            panic!("{} answers to {sent:?}", answers.len());
        };
        assert_eq!(answer.seq, sent.seq);
        let reply = postcard::take_from_bytes::<Reply>(&answer.body);
        let Ok((reply, [])) = reply else {
            panic!("{reply:?} to {sent:?}");
        };
        if let Reply::Accepted(Response::Hello(_)) = &reply {
            self.once.greeted(answer.session);
        } else {
            assert_eq!(answer.session, sent.session);
        }
        match executed {
            // Every copy of a stop is executed.
            1 if sent.kind == Kind::Urgent as u8 => {}
            0 if reply == Reply::Refused(Refusal::Incompatible) => self.once.refused(sent.seq),
            0 if sent.kind == Kind::Request as u8 => {}
            1 => self.once.executed(sent.session, sent.seq),
            more => panic!("{more} executions of {sent:?}"),
        }
    }

    /// Checks that a new host still gets a session and an answer.
    fn still_serves(&mut self) {
        for nonce in [u32::MAX, u32::MAX - 1] {
            self.hello(nonce);
        }
        self.request(1, &Request::KeepAlive(KeepAlive));
        self.once.newest_is(Some(self.seq));
    }
}

/// Builds the request, with steps of 250 um as on the bench's rig with few steps.
fn request(sensible: Sensible) -> Request {
    match sensible {
        Sensible::Run(cycles, steps, mm_s) => {
            let speed_um_s = u32::from(mm_s) * 1_000;
            Request::Run(Run {
                cycles: cycles.into(),
                stroke_um: u32::from(steps) * 250,
                timing: RunTiming::Speeds {
                    forward_um_s: speed_um_s,
                    return_um_s: speed_um_s,
                    accel_um_s2: 1_000_000,
                },
                far_dwell_us: 5_000,
                home_dwell_us: 5_000,
                start_delay_us: 0,
                link_loss: LinkLossPolicy::Stop,
            })
        }
        Sensible::Move(step) => Request::MoveTo(MoveTo {
            position_um: u32::from(step) * 250,
            speed_um_s: 40_000,
        }),
        Sensible::Jog(away) => Request::Jog(protocol::rig::Jog {
            sense: if away {
                Direction::Away
            } else {
                Direction::Home
            },
            speed_um_s: 40_000,
        }),
        Sensible::Set(key, share) => {
            let key = SettingKey::ALL[usize::from(key) % SettingKey::ALL.len()];
            let range = key.range();
            let width = u64::from(range.max - range.min);
            let value = range.min + (width * u64::from(share) / 255) as u32;
            Request::SetSetting(Setting { key, value })
        }
    }
}

/// A capsule that was calibrated, folded and switched off.
fn folded() -> Left {
    let machine = SimulatedMachine::new(Script::new(DeviceKind::Capsule)).0;
    let shared = Arc::new(std::sync::Mutex::new(machine));
    let line = simulated_machines::machine::Shared(Arc::clone(&shared));
    let mut host = Device::connect(Box::new(Memory::new("bench", line)), DeviceKind::Capsule, 1)
        .expect("a capsule");
    let reference = host.reference().expect("accepted");
    wait(&mut host, &reference);
    let calibrate = host.call(Calibrate).expect("accepted");
    wait(&mut host, &calibrate);
    let fold = host.call(Fold).expect("accepted");
    wait(&mut host, &fold);
    drop(host);
    let machine = Arc::into_inner(shared).expect("the host is gone");
    machine
        .into_inner()
        .expect("it has not panicked")
        .switch_off()
}

fn wait(host: &mut Device, accepted: &protocol::capsule::ActuationAccepted) {
    host.wait_actuation(accepted, &mut Unobserved)
        .expect("to its end");
    // Wait until it is written to flash.
    host.idle(2_000_000, &mut Unobserved).expect("there");
}

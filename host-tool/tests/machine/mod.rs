//! A small machine behind a bad line, in virtual time: the device's own session and event ring, and just enough
//! behaviour to be homed, run, folded, stopped and reset.
#![allow(dead_code, missing_docs, unreachable_pub)]

pub mod tool;

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};

use host_tool::link::memory::{Memory, Peer};
use host_tool::plan::{self, REFERENCE_LIMITS};
use motion::axis::Axis;
use protocol::capsule::{
    ActuationAccepted, ActuationKind, ActuationOutcome, ActuationRecord, CapsuleEvent,
    CapsuleState, CapsuleStatus, CapsuleTelemetry,
};
use protocol::error::{Field, Refusal};
use protocol::events::EventRing;
use protocol::frame::{Deframer, Header, Kind, encode};
use protocol::rig::{
    Direction, HomeAccepted, MoveAccepted, RigEvent, RigFault, RigInputs, RigState, RigStatus,
    RigTelemetry, Run, RunAccepted, RunOutcome, RunRecord, Stroke,
};
use protocol::session::{Decision, Session};
use protocol::settings::{MAX_NAME, Name, Setting, SettingKey, SettingRule};
use protocol::system::{
    BuildProfile, DeviceKind, Done, Event, Identity, LastWords, ResetCause, Revision, Urgent, What,
};
use protocol::table::{Reply, Request, Response, SCHEMA_KEY, Telemetry};
use serde::Serialize;

const LATENCY_US: u64 = 2_000;
const HOMING_US: u64 = 3_000_000;
const ACTUATION_US: u64 = 4_000_000;
const LINK_TIMEOUT_US: u64 = 1_000_000;
const BRAKING_US: u64 = 100_000;
const STROKE_STEPS: i32 = 104_000;
const CLOSED: RigInputs = RigInputs {
    home_flag: false,
    far_limit: false,
    estop_loop: false,
};

/// What the line and the machine do wrong.
#[derive(Clone, Debug)]
pub struct Script {
    pub kind: DeviceKind,
    pub schema_key: u64,
    pub major: u8,
    /// One bit in so many is flipped, both ways; 0: none.
    pub flip_one_in: u64,
    pub seed: u64,
    /// Events with these indices are not sent by themselves.
    pub silent_events: Vec<u32>,
    /// Requests with these names are not heard, so many times each.
    pub deaf_to: Vec<(&'static str, u32)>,
    /// From now on nothing is heard at all, not even urgent stops.
    pub dead: bool,
    pub reset_at_us: Option<u64>,
    /// Runs do not end.
    pub never_ends: bool,
    /// Homed or referenced from the start.
    pub ready: bool,
    /// The E-stop loop opens.
    pub fault_at_us: Option<u64>,
    /// The start button is pressed while something moves.
    pub button_at_us: Option<u64>,
    /// The run that is to be held is complete before the carriage stands.
    pub completes_while_braking: bool,
    /// A run goes on already.
    pub running: Option<Run>,
    /// The rig cannot store a name.
    pub broken_name: bool,
    /// So many changes of settings succeed, then the storage fails for good.
    pub writes_left: Option<u32>,
    /// Settings that are not the defaults.
    pub settings: Vec<(SettingKey, u32)>,
}

impl Script {
    pub fn new(kind: DeviceKind) -> Self {
        Self {
            kind,
            schema_key: SCHEMA_KEY,
            major: protocol::VERSION.major,
            flip_one_in: 0,
            seed: 1,
            silent_events: vec![],
            deaf_to: vec![],
            dead: false,
            reset_at_us: None,
            never_ends: false,
            ready: false,
            fault_at_us: None,
            button_at_us: None,
            completes_while_braking: false,
            running: None,
            broken_name: false,
            writes_left: None,
            settings: vec![],
        }
    }
}

/// What the machine saw and did.
#[derive(Debug, Default)]
pub struct Log {
    pub now_us: u64,
    /// Names of the requests that were executed, once per execution.
    pub executed: Vec<&'static str>,
    /// Names of all request frames that arrived, and `Urgent`.
    pub heard: Vec<&'static str>,
    pub urgent: Vec<(Urgent, u64)>,
    /// What the rig's settings and name are now.
    pub settings: Vec<u32>,
    pub name: String,
}

impl Log {
    pub fn setting(&self, key: SettingKey) -> u32 {
        self.settings[key as usize]
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Motion {
    Rest,
    Homing {
        end_us: u64,
    },
    Running {
        accepted: RunAccepted,
        start_us: u64,
        stroke: u32,
    },
    Actuating {
        kind: ActuationKind,
        start_us: u64,
    },
    /// Jog or move; a jog ends at `dead_us`.
    Moving {
        from: i32,
        to: i32,
        start_us: u64,
        end_us: u64,
        dead_us: u64,
    },
}

/// A hold of the run that goes on: its clock stands still.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Hold {
    None,
    Braking { since_us: u64 },
    Held { since_us: u64 },
}

pub struct Machine {
    script: Script,
    log: Arc<Mutex<Log>>,
    deframer: Deframer,
    session: Session,
    boots: u32,
    noise: u64,
    out: VecDeque<(u64, Vec<u8>)>,
    ring: EventRing,
    now_us: u64,
    heard_us: u64,
    motion: Motion,
    hold: Hold,
    /// Where the carriage rests.
    place: i32,
    settings: Vec<u32>,
    name: heapless::String<MAX_NAME>,
    homed: bool,
    referenced: bool,
    fault: Option<RigFault>,
    thread_um: i32,
    record: RunRecord,
    /// When the run was accepted.
    accepted_us: u64,
    actuation: ActuationRecord,
    telemetry_us: u64,
    next_telemetry_us: u64,
    telemetry_seq: u16,
}

/// A link to a new machine, and its log.
pub fn link(script: Script) -> (Box<Memory<Machine>>, Arc<Mutex<Log>>) {
    let log = Arc::new(Mutex::new(Log::default()));
    let place = match script.kind {
        DeviceKind::Rig => "test rig",
        DeviceKind::Capsule => "test capsule",
    };
    let machine = Machine::new(script, Arc::clone(&log));
    (Box::new(Memory::new(place, machine)), log)
}

impl Machine {
    pub fn new(script: Script, log: Arc<Mutex<Log>>) -> Self {
        let mut machine = Self {
            noise: script.seed | 1,
            log,
            deframer: Deframer::new(),
            session: Session::new(7),
            boots: 7,
            out: VecDeque::new(),
            ring: EventRing::new(),
            now_us: 0,
            heard_us: 0,
            motion: Motion::Rest,
            hold: Hold::None,
            place: 0,
            settings: SettingKey::ALL
                .map(|key| {
                    let set = script.settings.iter().find(|(set, _)| *set == key);
                    set.map_or(key.range().default, |(_, value)| *value)
                })
                .to_vec(),
            name: heapless::String::new(),
            homed: script.ready,
            referenced: script.ready,
            fault: None,
            thread_um: 0,
            record: RunRecord {
                run: 0,
                outcome: RunOutcome::None,
                strokes: 0,
                commanded_edges: 0,
                counted_edges: 0,
                ticks: 0,
                plan_hash: 0,
                min_steps: 0,
                max_steps: 0,
                worst_residual_steps: 0,
                min_queue: 9,
                glitches: 0,
                holds: 0,
                image_hash: 0,
            },
            accepted_us: 0,
            actuation: ActuationRecord {
                actuation: 0,
                kind: ActuationKind::Reference,
                outcome: ActuationOutcome::None,
                duration_ms: 0,
                thread_um: 0,
                end_current_ma: 0,
                peak_current_ma: 0,
                engaged_um: 0,
                energy_mj: 0,
                min_battery_mv: 3_900,
            },
            telemetry_us: 0,
            next_telemetry_us: u64::MAX,
            telemetry_seq: 0,
            script,
        };
        machine.event(0, What::Booted(ResetCause::PowerOn));
        machine.show_settings();
        if let Some(run) = machine.script.running.take() {
            machine.start(run).expect("a possible run");
        }
        machine
    }

    fn log(&self) -> MutexGuard<'_, Log> {
        self.log
            .lock()
            .expect("no test panics while it holds the log")
    }

    fn random(&mut self) -> u64 {
        self.noise ^= self.noise << 13;
        self.noise ^= self.noise >> 7;
        self.noise ^= self.noise << 17;
        self.noise
    }

    fn carry(&mut self, byte: u8) -> u8 {
        let mut carried = byte;
        for bit in 0..8 {
            if self.script.flip_one_in > 0 && self.random().is_multiple_of(self.script.flip_one_in)
            {
                carried ^= 1 << bit;
            }
        }
        carried
    }

    fn send(
        &mut self,
        kind: Kind,
        session: u8,
        seq: u16,
        body: &impl Serialize,
    ) -> protocol::frame::Encoded {
        let frame = encode(Header { kind, session, seq }, body).expect("fits");
        self.post(&frame);
        frame
    }

    fn post(&mut self, frame: &[u8]) {
        let bytes = frame.iter().map(|byte| self.carry(*byte)).collect();
        self.out.push_back((self.now_us + LATENCY_US, bytes));
    }

    fn event(&mut self, time_us: u64, what: What) {
        let event: Event = self.ring.record(time_us, what);
        let session = self.session.number();
        if session != 0 && !self.script.silent_events.contains(&event.index) {
            self.send(Kind::Event, session, event.index as u16, &event);
        }
    }

    fn rig_event(&mut self, event: RigEvent) {
        self.event(self.now_us, What::Rig(event));
    }

    fn reset(&mut self) {
        self.boots += 1;
        self.session = Session::new(self.boots);
        self.deframer = Deframer::new();
        self.ring = EventRing::new();
        self.motion = Motion::Rest;
        self.hold = Hold::None;
        self.homed = false;
        self.next_telemetry_us = u64::MAX;
        self.event(self.now_us, What::Booted(ResetCause::Watchdog));
    }

    /// When something happens next without a frame from the host.
    fn next_change_us(&self) -> u64 {
        let motion_us = match self.motion {
            _ if let Hold::Braking { since_us } = self.hold => since_us + BRAKING_US,
            _ if matches!(self.hold, Hold::Held { .. }) => u64::MAX,
            Motion::Rest => u64::MAX,
            Motion::Moving {
                end_us, dead_us, ..
            } => end_us.min(dead_us),
            Motion::Homing { end_us } => end_us,
            Motion::Running {
                accepted,
                start_us,
                stroke,
            } if !self.script.never_ends => {
                start_us + u64::from(stroke + 1) * accepted.forward.duration_ticks / 100
            }
            Motion::Running { .. } => u64::MAX,
            Motion::Actuating { start_us, .. } => start_us + ACTUATION_US,
        };
        let silence_us = match self.motion {
            _ if matches!(self.hold, Hold::Held { .. }) => u64::MAX,
            Motion::Rest => u64::MAX,
            _ => self.heard_us + LINK_TIMEOUT_US + 1,
        };
        motion_us
            .min(silence_us)
            .min(self.next_telemetry_us)
            .min(self.script.reset_at_us.unwrap_or(u64::MAX))
            .min(self.script.fault_at_us.unwrap_or(u64::MAX))
            .min(self.script.button_at_us.unwrap_or(u64::MAX))
    }

    /// Lives until `now_us`.
    fn live(&mut self, now_us: u64) {
        while self.next_change_us() <= now_us {
            self.now_us = self.next_change_us();
            self.change();
        }
        self.now_us = now_us;
        self.log().now_us = now_us;
    }

    fn change(&mut self) {
        if self
            .script
            .reset_at_us
            .is_some_and(|time| time <= self.now_us)
        {
            self.script.reset_at_us = None;
            return self.reset();
        }
        if self
            .script
            .fault_at_us
            .is_some_and(|time| time <= self.now_us)
        {
            self.script.fault_at_us = None;
            return self.latch(RigFault::EStopLoop);
        }
        if self
            .script
            .button_at_us
            .is_some_and(|time| time <= self.now_us)
        {
            self.script.button_at_us = None;
            return self.end(RunOutcome::Stopped, ActuationOutcome::Stopped);
        }
        if self.now_us >= self.next_telemetry_us {
            self.next_telemetry_us += self.telemetry_us;
            let session = self.session.number();
            let sample = self.telemetry();
            let seq = self.telemetry_seq;
            self.telemetry_seq = seq.wrapping_add(1);
            self.send(Kind::Telemetry, session, seq, &sample);
        }
        let held = matches!(self.hold, Hold::Held { .. });
        if self.motion != Motion::Rest && !held && self.now_us > self.heard_us + LINK_TIMEOUT_US {
            self.event(self.now_us, What::LinkLost);
            return self.end(RunOutcome::LinkLost, ActuationOutcome::LinkLost);
        }
        if let Hold::Braking { since_us } = self.hold {
            if since_us + BRAKING_US <= self.now_us {
                if self.script.completes_while_braking {
                    return self.end(RunOutcome::Complete, ActuationOutcome::None);
                }
                self.hold = Hold::Held { since_us };
                let position_steps = self.position_steps();
                self.rig_event(RigEvent::Held { position_steps });
            }
            return;
        }
        if held {
            return;
        }
        match self.motion {
            Motion::Moving {
                end_us, dead_us, ..
            } if end_us.min(dead_us) <= self.now_us => {
                self.place = self.position_steps();
                self.motion = Motion::Rest;
                let position_steps = self.place;
                self.rig_event(RigEvent::Moved { position_steps });
            }
            Motion::Homing { end_us } if end_us <= self.now_us => {
                self.place = 0;
                self.motion = Motion::Rest;
                self.homed = true;
                self.rig_event(RigEvent::Homed {
                    repeat_steps: 1,
                    shift_steps: -2,
                });
            }
            Motion::Running {
                accepted,
                start_us,
                stroke,
            } if start_us + u64::from(stroke + 1) * accepted.forward.duration_ticks / 100
                <= self.now_us =>
            {
                self.record.strokes = stroke + 1;
                self.record.counted_edges += u64::from(accepted.forward.steps);
                self.record.commanded_edges = self.record.counted_edges;
                self.rig_event(RigEvent::StrokeDone {
                    stroke,
                    residual_steps: 0,
                });
                if stroke + 1 == u32::from(accepted.requested.cycles) * 2 {
                    self.record.ticks = accepted.total_ticks;
                    self.end(RunOutcome::Complete, ActuationOutcome::None);
                } else {
                    self.motion = Motion::Running {
                        accepted,
                        start_us,
                        stroke: stroke + 1,
                    };
                }
            }
            Motion::Actuating { start_us, .. } if start_us + ACTUATION_US <= self.now_us => {
                self.end(RunOutcome::None, ActuationOutcome::Complete);
            }
            _ => {}
        }
    }

    /// As the firmware: the first cause stays, the position is lost.
    fn latch(&mut self, fault: RigFault) {
        self.end(RunOutcome::Faulted(fault), ActuationOutcome::Stopped);
        self.fault = Some(fault);
        self.homed = false;
        self.rig_event(RigEvent::Faulted(fault));
    }

    fn end(&mut self, run: RunOutcome, actuation: ActuationOutcome) {
        self.place = match run {
            RunOutcome::Complete => 0,
            _ => self.position_steps(),
        };
        self.hold = Hold::None;
        match std::mem::replace(&mut self.motion, Motion::Rest) {
            Motion::Rest => {}
            Motion::Homing { .. } | Motion::Moving { .. } => {
                let position_steps = self.place;
                self.rig_event(RigEvent::Stopped { position_steps });
            }
            Motion::Running { .. } => {
                self.record.outcome = run;
                let number = self.record.run;
                self.rig_event(RigEvent::RunEnded {
                    run: number,
                    outcome: run,
                });
            }
            Motion::Actuating { kind, start_us } => {
                self.thread_um = if kind == ActuationKind::Fold {
                    42_000
                } else {
                    0
                };
                self.referenced |= kind == ActuationKind::Reference;
                self.actuation.outcome = actuation;
                self.actuation.duration_ms = ((self.now_us - start_us) / 1_000) as u32;
                self.actuation.thread_um = self.thread_um;
                self.actuation.end_current_ma = 88;
                let number = self.actuation.actuation;
                self.event(
                    self.now_us,
                    What::Capsule(CapsuleEvent::Ended {
                        actuation: number,
                        outcome: actuation,
                    }),
                );
            }
        }
    }

    fn position_steps(&self) -> i32 {
        if let Motion::Moving {
            from,
            to,
            start_us,
            end_us,
            ..
        } = self.motion
        {
            let part = self.now_us.min(end_us) - start_us;
            let way = i64::from(to - from) * part as i64 / (end_us - start_us) as i64;
            return from + way as i32;
        }
        let Motion::Running {
            accepted,
            start_us,
            stroke,
        } = self.motion
        else {
            return self.place;
        };
        let stroke_us = accepted.forward.duration_ticks / 100;
        let now_us = match self.hold {
            Hold::None => self.now_us,
            Hold::Braking { since_us } | Hold::Held { since_us } => since_us,
        };
        let into = now_us.saturating_sub(start_us + u64::from(stroke) * stroke_us);
        let done = (u64::from(accepted.forward.steps) * into.min(stroke_us) / stroke_us) as i32;
        if stroke.is_multiple_of(2) {
            done
        } else {
            accepted.forward.steps as i32 - done
        }
    }

    fn rig_state(&self) -> RigState {
        match self.motion {
            _ if self.fault.is_some() => RigState::Faulted,
            _ if matches!(self.hold, Hold::Braking { .. }) => RigState::Stopping,
            _ if matches!(self.hold, Hold::Held { .. }) => RigState::Held,
            Motion::Homing { .. } => RigState::Homing,
            Motion::Moving { .. } => RigState::Moving,
            Motion::Running { .. } => RigState::Running,
            _ if self.homed => RigState::Ready,
            _ => RigState::Unhomed,
        }
    }

    fn capsule_state(&self) -> CapsuleState {
        match self.motion {
            Motion::Actuating { kind, .. } => match kind {
                ActuationKind::Reference => CapsuleState::Referencing,
                ActuationKind::Fold => CapsuleState::Folding,
                ActuationKind::Unfold => CapsuleState::Unfolding,
            },
            _ if !self.referenced => CapsuleState::Unreferenced,
            _ if self.thread_um > 0 => CapsuleState::Folded,
            _ => CapsuleState::Unfolded,
        }
    }

    fn telemetry(&self) -> Telemetry {
        match self.script.kind {
            DeviceKind::Rig => Telemetry::Rig(RigTelemetry {
                time_us: self.now_us,
                state: self.rig_state(),
                position_steps: self.position_steps(),
                commanded_steps: self.position_steps(),
                speed_um_s: 32_500,
                stroke: self.record.strokes,
                residual_steps: 0,
                inputs: CLOSED,
            }),
            DeviceKind::Capsule => Telemetry::Capsule(CapsuleTelemetry {
                time_us: self.now_us,
                state: self.capsule_state(),
                thread_um: self.thread_um,
                current_ma: 40,
                battery_mv: 3_900,
                drive_mv: 3_000,
            }),
        }
    }

    fn execute(&mut self, request: Request) -> Result<Response, Refusal> {
        let rig = self.script.kind == DeviceKind::Rig;
        Ok(match request {
            Request::Hello(_) | Request::KeepAlive(_) => Response::KeepAlive(Done),
            Request::GetLastWords(_) => Response::GetLastWords(LastWords {
                text: heapless_text("test"),
            }),
            Request::SetTelemetry(set) => {
                self.telemetry_us = u64::from(set.period_ms) * 1_000;
                self.next_telemetry_us = match set.period_ms {
                    0 => u64::MAX,
                    _ => self.now_us + self.telemetry_us,
                };
                Response::SetTelemetry(set)
            }
            Request::GetEvents(get) => Response::GetEvents(self.ring.since(get.from)),
            Request::Acknowledge(_) => {
                self.fault.take().ok_or(Refusal::NothingToAcknowledge)?;
                Response::Acknowledge(Done)
            }
            Request::GetRigStatus(_) if rig => Response::GetRigStatus(RigStatus {
                time_us: self.now_us,
                state: self.rig_state(),
                fault: self.fault,
                homed: self.homed,
                position_steps: self.position_steps(),
                position_um: self.position_steps() * 5 / 4,
                stroke_um: 130_000,
                steps_per_rev: 3_200,
                lead_um: 4_000,
                inputs: CLOSED,
                run: self.record.run,
                stroke: self.record.strokes,
                strokes: 10,
                elapsed_us: match self.motion {
                    Motion::Running { .. } if self.hold == Hold::None => {
                        self.now_us - self.accepted_us
                    }
                    _ => 0,
                },
                needs_acknowledge: false,
            }),
            Request::Home(_) if rig => {
                if let Some(fault) = self.fault {
                    return Err(Refusal::RigFaulted(fault));
                }
                self.motion = Motion::Homing {
                    end_us: self.now_us + HOMING_US,
                };
                Response::Home(HomeAccepted {
                    seek_um_s: 20_000,
                    locate_um_s: 2_000,
                    max_travel_um: 140_000,
                })
            }
            Request::Run(run) if rig => Response::Run(self.start(run)?),
            Request::GetRunRecord(_) if rig => Response::GetRunRecord(self.record),
            Request::Hold(_) if rig => {
                self.healthy()?;
                if !matches!(self.motion, Motion::Running { .. }) || self.hold != Hold::None {
                    return Err(Refusal::NothingToHold);
                }
                self.hold = Hold::Braking {
                    since_us: self.now_us,
                };
                Response::Hold(Done)
            }
            Request::Resume(_) if rig => {
                self.healthy()?;
                let Hold::Held { since_us } = self.hold else {
                    return Err(Refusal::NothingToResume);
                };
                self.hold = Hold::None;
                self.record.holds += 1;
                if let Motion::Running { start_us, .. } = &mut self.motion {
                    *start_us += self.now_us - since_us;
                }
                self.rig_event(RigEvent::Resumed);
                Response::Resume(Done)
            }
            Request::Jog(jog) if rig => {
                self.healthy()?;
                let dead_man_ms = self.settings[SettingKey::DeadManMs as usize];
                let until_us = self.now_us + u64::from(dead_man_ms) * 1_000;
                if let Motion::Moving { dead_us, .. } = &mut self.motion {
                    *dead_us = until_us;
                } else {
                    let to = match jog.sense {
                        Direction::Away => STROKE_STEPS,
                        Direction::Home => 0,
                    };
                    self.set_off(to, jog.speed_um_s, until_us)?;
                }
                Response::Jog(Done)
            }
            Request::MoveTo(to) if rig => {
                self.healthy()?;
                Response::MoveTo(self.set_off(
                    to.position_um as i32 * 4 / 5,
                    to.speed_um_s,
                    u64::MAX,
                )?)
            }
            Request::GetSetting(get) if rig => Response::GetSetting(Setting {
                key: get.key,
                value: self.settings[get.key as usize],
            }),
            Request::SetSetting(setting) if rig => Response::SetSetting(self.set(setting)?),
            Request::GetName(_) if rig => Response::GetName(Name {
                name: self.name.clone(),
            }),
            Request::SetName(name) if rig => {
                if self.script.broken_name {
                    return Err(Refusal::StorageFailed);
                }
                self.write()?;
                self.name = name.name.clone();
                Response::SetName(name)
            }
            Request::FactoryReset(_) if rig => {
                self.settings = SettingKey::ALL.map(|key| key.range().default).to_vec();
                Response::FactoryReset(Done)
            }
            Request::GetCapsuleStatus(_) if !rig => Response::GetCapsuleStatus(CapsuleStatus {
                time_us: self.now_us,
                state: self.capsule_state(),
                fault: None,
                referenced: self.referenced,
                thread_um: self.thread_um,
                current_ma: 40,
                battery_mv: 3_900,
                actuation: self.actuation.actuation,
                needs_acknowledge: false,
            }),
            Request::Reference(_) if !rig => {
                Response::Reference(self.actuate(ActuationKind::Reference)?)
            }
            Request::Fold(_) if !rig => Response::Fold(self.actuate(ActuationKind::Fold)?),
            Request::Unfold(_) if !rig => Response::Unfold(self.actuate(ActuationKind::Unfold)?),
            Request::GetActuationRecord(_) if !rig => Response::GetActuationRecord(self.actuation),
            _ => return Err(Refusal::WrongDevice),
        })
    }

    fn healthy(&self) -> Result<(), Refusal> {
        self.fault
            .map_or(Ok(()), |fault| Err(Refusal::RigFaulted(fault)))
    }

    fn set_off(&mut self, to: i32, speed_um_s: u32, dead_us: u64) -> Result<MoveAccepted, Refusal> {
        if !self.homed {
            return Err(Refusal::NotHomed);
        }
        if self.motion != Motion::Rest {
            return Err(Refusal::RigBusy(self.rig_state()));
        }
        let from = self.place;
        let steps = to.abs_diff(from);
        if steps == 0 {
            return Err(Refusal::AlreadyThere);
        }
        let duration_us = u64::from(steps) * 1_250_000 / u64::from(speed_um_s);
        self.motion = Motion::Moving {
            from,
            to,
            start_us: self.now_us,
            end_us: self.now_us + duration_us,
            dead_us,
        };
        Ok(MoveAccepted {
            from_steps: from,
            to_steps: to,
            stroke: Stroke {
                steps,
                duration_ticks: duration_us * 100,
                ramp_ticks: 1,
                peak_um_s: speed_um_s,
                accel_um_s2: 200_000,
            },
        })
    }

    fn write(&mut self) -> Result<(), Refusal> {
        match &mut self.script.writes_left {
            Some(0) => Err(Refusal::StorageFailed),
            Some(left) => {
                *left -= 1;
                Ok(())
            }
            None => Ok(()),
        }
    }

    /// Two of the firmware's rules, one of them between settings.
    fn set(&mut self, setting: Setting) -> Result<Setting, Refusal> {
        let Setting { key, value } = setting;
        let refused = |rule| Err(Refusal::SettingRule { key, rule });
        if self.motion != Motion::Rest {
            return Err(Refusal::RigBusy(self.rig_state()));
        }
        let mut wanted = self.settings.clone();
        wanted[key as usize] = value;
        let of = |key: SettingKey| wanted[key as usize];
        if !of(SettingKey::Microsteps).is_power_of_two() {
            return refused(SettingRule::Microsteps);
        }
        if of(SettingKey::FlagUm) + of(SettingKey::PullOffUm) > of(SettingKey::StrokeUm) {
            return refused(SettingRule::FlagWithinStroke);
        }
        self.write()?;
        self.settings = wanted;
        Ok(setting)
    }

    fn show_settings(&self) {
        let mut log = self.log();
        log.settings.clone_from(&self.settings);
        log.name = self.name.as_str().to_owned();
    }

    fn actuate(&mut self, kind: ActuationKind) -> Result<ActuationAccepted, Refusal> {
        if kind != ActuationKind::Reference && !self.referenced {
            return Err(Refusal::NotReferenced);
        }
        self.actuation.actuation += 1;
        self.actuation.kind = kind;
        self.actuation.outcome = ActuationOutcome::Running;
        self.motion = Motion::Actuating {
            kind,
            start_us: self.now_us,
        };
        let actuation = self.actuation.actuation;
        self.event(
            self.now_us,
            What::Capsule(CapsuleEvent::Started { actuation, kind }),
        );
        Ok(ActuationAccepted {
            actuation,
            timeout_ms: 20_000,
        })
    }

    fn start(&mut self, run: Run) -> Result<RunAccepted, Refusal> {
        if !self.homed {
            return Err(Refusal::NotHomed);
        }
        if self.motion != Motion::Rest {
            return Err(Refusal::RigBusy(self.rig_state()));
        }
        if run.stroke_um > 130_000 {
            return Err(Refusal::OutOfRange {
                field: Field::StrokeUm,
                requested: run.stroke_um.into(),
                min: 1,
                max: 130_000,
            });
        }
        let plan =
            plan::solve(&run, &Axis::REFERENCE, &REFERENCE_LIMITS).map_err(|_| Refusal::TooSlow)?;
        let summary = plan::summary(&run, &Axis::REFERENCE, &plan);
        let number = self.record.run + 1;
        self.record = RunRecord {
            run: number,
            outcome: RunOutcome::Running,
            strokes: 0,
            commanded_edges: 0,
            counted_edges: 0,
            ticks: 0,
            plan_hash: plan.hash(),
            max_steps: summary.achieved.forward.steps as i32,
            ..self.record
        };
        let accepted = RunAccepted {
            run: number,
            requested: run,
            forward: summary.achieved.forward,
            back: summary.achieved.back,
            total_ticks: summary.achieved.total_ticks,
            edges: summary.achieved.edges,
            plan_hash: plan.hash(),
        };
        self.accepted_us = self.now_us;
        self.motion = Motion::Running {
            accepted,
            start_us: self.now_us,
            stroke: 0,
        };
        self.rig_event(RigEvent::RunStarted { run: number });
        Ok(accepted)
    }

    fn urgent(&mut self, urgent: Urgent) {
        let now_us = self.now_us;
        self.log().urgent.push((urgent, now_us));
        if urgent == Urgent::EStop && self.script.kind == DeviceKind::Rig {
            self.latch(RigFault::EStopFrame);
        } else {
            self.end(RunOutcome::Stopped, ActuationOutcome::Stopped);
        }
    }

    fn identity(&self, session: u8) -> Identity {
        Identity {
            device: self.script.kind,
            protocol: protocol::system::Version {
                major: self.script.major,
                minor: 0,
            },
            schema_key: self.script.schema_key,
            uid: [0xab; 12],
            revision: Revision {
                commit: 0x1234_5678,
                dirty: true,
            },
            profile: BuildProfile::Firmware,
            boot_id: self.boots,
            reset_cause: ResetCause::PowerOn,
            session,
        }
    }

    fn byte(&mut self, byte: u8) {
        let byte = self.carry(byte);
        let Some(frame) = self.deframer.push(byte) else {
            return;
        };
        let name = match frame.header.kind {
            Kind::Urgent => "Urgent",
            _ => frame
                .decode::<Request>()
                .map_or("?", |request| request.name()),
        };
        let deaf = self
            .script
            .deaf_to
            .iter_mut()
            .find(|(deaf, left)| *deaf == name && *left > 0);
        if self.script.dead {
            return;
        }
        if let Some((_, left)) = deaf {
            *left -= 1;
            return;
        }
        let decision = self.session.receive(&frame);
        self.heard_us = self.now_us;
        self.log().heard.push(name);
        let reply = |machine: &mut Self, session, seq, reply: &Reply| {
            machine.send(Kind::Reply, session, seq, reply)
        };
        match decision {
            Decision::Greet { session, seq } => {
                let identity = self.identity(session);
                let hello = Reply::Accepted(Response::Hello(identity));
                reply(self, session, seq, &hello);
            }
            Decision::Execute { request, ticket } => {
                self.log().executed.push(request.name());
                let executed = self.execute(request);
                self.show_settings();
                let answer = match executed {
                    Ok(response) => Reply::Accepted(response),
                    Err(refusal) => Reply::Refused(refusal),
                };
                let frame = encode(
                    Header {
                        kind: Kind::Reply,
                        session: ticket.session,
                        seq: ticket.seq,
                    },
                    &answer,
                )
                .expect("fits");
                self.session.remember(ticket, &frame);
                self.post(&frame);
            }
            Decision::Urgent {
                urgent,
                session,
                seq,
            } => {
                self.urgent(urgent);
                reply(self, session, seq, &Reply::Urgent(urgent));
            }
            Decision::Resend(frame) => self.post(&frame),
            Decision::Refuse { refusal, ticket } => {
                reply(self, ticket.session, ticket.seq, &Reply::Refused(refusal));
            }
            Decision::Reject {
                error,
                session,
                seq,
            } => {
                reply(self, session, seq, &Reply::Wire(error));
            }
            Decision::Ignore => {}
        }
    }
}

fn heapless_text<T: for<'a> TryFrom<&'a str> + Default>(text: &str) -> T {
    T::try_from(text).unwrap_or_default()
}

impl Peer for Machine {
    fn take(&mut self, bytes: &[u8], now_us: u64) {
        self.live(now_us);
        for byte in bytes {
            self.byte(*byte);
        }
    }

    fn give(&mut self, now_us: u64) -> Vec<u8> {
        self.live(now_us);
        let mut bytes = vec![];
        while let Some((_, frame)) = self.out.pop_front_if(|(time_us, _)| *time_us <= now_us) {
            bytes.extend(frame);
        }
        bytes
    }

    fn next_us(&self) -> u64 {
        let out_us = self.out.front().map_or(u64::MAX, |(time_us, _)| *time_us);
        out_us.min(self.next_change_us())
    }
}

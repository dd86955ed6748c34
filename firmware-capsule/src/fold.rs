//! The capsule's state machine: reference, fold, unfold. Pure: time and sensors in, drive and events out.
//!
//! | state | event \[guard\] | next |
//! |---|---|---|
//! | any at rest | Reference \[battery, amplifier\] | Referencing |
//! | Unfolded, Stopped | Fold \[battery, amplifier\] | Folding |
//! | Folded, Stopped | Unfold \[battery, amplifier\] | Unfolding |
//! | any at rest | Reference, Fold, Unfold \[amplifier shows a current\] | Faulted |
//! | Referencing | zero found and reached | Unfolded |
//! | Folding | end force in the end window | Folded |
//! | Unfolding | zero reached | Unfolded |
//! | Folding, Unfolding | Stop, link silent | Stopped |
//! | Referencing | Stop, link silent | Unreferenced; Stopped once the zero is found |
//! | any | EStop | Faulted |
//! | moving | trip, jam, broken thread, time-out | Faulted |
//! | Faulted | Acknowledge \[cause gone\] | Stopped, or Unreferenced if the fault costs the position |
//!
//! The motor is driven only while referencing, folding or unfolding. Each of them ends with the motor shorted for
//! [`BRAKE_US`]: at 3.7 V it turns 270 times a second, and runs on for 0.1 mm of thread when braked, for almost 3 mm
//! when not. Then the bridge sleeps and the worm gear holds.
//!
//! [`leg`](crate::leg) says how each motion is driven, where it ends, and how the zero is found.

use crate::{
    detect::{Detector, Load, Sample, Spooling, Trip},
    leg::{Decision, Leg},
    mechanics::{Counts, FOLDED, NO_LOAD_MA, Thread},
    record::Recorder,
    sense::MOST_OFFSET_MA,
};
use protocol::{
    capsule::{
        ActuationKind, ActuationOutcome, ActuationRecord, CapsuleEvent, CapsuleFault, CapsuleState,
    },
    error::Refusal,
};

/// How long the motor is shorted after a motion: six of its time constants.
pub const BRAKE_US: u64 = 40_000;
/// Below this battery voltage a motion is refused.
pub const LEAST_BATTERY_MV: u16 = 3_000;
/// Two slow windings and two ways out.
pub const REFERENCE_TIMEOUT_MS: u32 = 12_000;
/// The model motor takes 1.6 s, with an almost empty battery twice as long.
pub const FOLD_TIMEOUT_MS: u32 = 4_000;
/// The model motor takes 1.2 s.
pub const UNFOLD_TIMEOUT_MS: u32 = 4_000;

/// State of the bridge.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Drive {
    /// Bridge asleep.
    #[default]
    Off,
    /// Motor shorted.
    Brake,
    /// Duty times battery voltage; positive winds. Never more than the battery has.
    Millivolts(i16),
}

/// What the host can order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Find the zero.
    Reference,
    /// Wind to the end force.
    Fold,
    /// Pay out to zero.
    Unfold,
    /// Motor off; never refused.
    Stop,
    /// Motor off and fault; never refused.
    EStop,
    /// Clear the fault.
    Acknowledge,
}

/// What happens to the capsule.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// New readings. Every 1 ms while the bridge is awake.
    Sample(Sample),
    /// Order of the host.
    Command(Command),
    /// No valid frame for longer than the link's time-out.
    LinkSilent,
}

/// What the caller has to do.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Actions {
    /// Set the bridge to this.
    pub drive: Drive,
    /// Record and send these, in this order.
    pub events: heapless::Vec<CapsuleEvent, 3>,
    /// Why the command was refused, if it was.
    pub refusal: Option<Refusal>,
}

impl Actions {
    fn emit(&mut self, event: CapsuleEvent) {
        // One step emits at most a start, an end and a fault.
        let _ = self.events.push(event);
    }
}

// There is only one machine, and no heap for a box.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug)]
enum Mode {
    Unreferenced,
    Unfolded,
    Folded,
    Stopped,
    Moving(Actuation),
    Faulted(CapsuleFault),
}

#[derive(Clone, Debug)]
struct Actuation {
    kind: ActuationKind,
    leg: Leg,
    detector: Detector,
    started_us: u64,
    deadline_us: u64,
    /// The thread was slack at the start, so the first mean current is the no-load current.
    from_slack: bool,
}

/// The state machine.
#[derive(Clone, Debug)]
pub struct Capsule {
    mode: Mode,
    referenced: bool,
    /// Count at thread zero.
    zero: Counts,
    sample: Sample,
    sample_us: u64,
    drive: Drive,
    brake_until_us: u64,
    no_load_ma: u16,
    recorder: Recorder,
}

impl Capsule {
    /// At the start of the device, position unknown. `fault` is what ended the last run of the firmware, if a
    /// fault did.
    pub fn new(fault: Option<CapsuleFault>) -> Self {
        Self {
            mode: fault.map_or(Mode::Unreferenced, Mode::Faulted),
            referenced: false,
            zero: Counts(0),
            sample: Sample::default(),
            sample_us: 0,
            drive: Drive::Off,
            brake_until_us: 0,
            no_load_ma: NO_LOAD_MA,
            recorder: Recorder::new(),
        }
    }

    /// The state by its name in the protocol.
    pub fn state(&self) -> CapsuleState {
        match &self.mode {
            Mode::Unreferenced => CapsuleState::Unreferenced,
            Mode::Unfolded => CapsuleState::Unfolded,
            Mode::Folded => CapsuleState::Folded,
            Mode::Stopped => CapsuleState::Stopped,
            Mode::Faulted(_) => CapsuleState::Faulted,
            Mode::Moving(actuation) => match actuation.kind {
                ActuationKind::Reference => CapsuleState::Referencing,
                ActuationKind::Fold => CapsuleState::Folding,
                ActuationKind::Unfold => CapsuleState::Unfolding,
            },
        }
    }

    /// The motor may be driven.
    pub fn is_moving(&self) -> bool {
        matches!(self.mode, Mode::Moving(_))
    }

    /// The latched fault.
    pub fn fault(&self) -> Option<CapsuleFault> {
        match self.mode {
            Mode::Faulted(fault) => Some(fault),
            _ => None,
        }
    }

    /// The thread position can be trusted.
    pub fn referenced(&self) -> bool {
        self.referenced
    }

    /// Thread on the spool at the last sample. Before the first reference it counts from an arbitrary zero.
    pub fn thread(&self) -> Thread {
        self.sample.counts.since(self.zero).thread()
    }

    /// The last sample.
    pub fn sample(&self) -> &Sample {
        &self.sample
    }

    /// The bridge's state after the last event.
    pub fn drive(&self) -> Drive {
        self.drive
    }

    /// The present or last actuation.
    pub fn record(&self) -> &ActuationRecord {
        self.recorder.record()
    }

    /// Longest time an actuation of this kind may take.
    pub fn timeout_ms(kind: ActuationKind) -> u32 {
        match kind {
            ActuationKind::Reference => REFERENCE_TIMEOUT_MS,
            ActuationKind::Fold => FOLD_TIMEOUT_MS,
            ActuationKind::Unfold => UNFOLD_TIMEOUT_MS,
        }
    }

    /// Takes one event. `now_us` must not run backwards; if it does, time stands still for the machine.
    pub fn step(&mut self, now_us: u64, event: Event) -> Actions {
        let mut actions = Actions::default();
        match event {
            Event::Sample(sample) => self.on_sample(now_us, sample, &mut actions),
            Event::Command(command) => {
                actions.refusal = self.on_command(now_us, command, &mut actions).err();
            }
            Event::LinkSilent => self.stop(now_us, ActuationOutcome::LinkLost, &mut actions),
        }
        self.drive = self.wanted_drive(now_us);
        actions.drive = self.drive;
        actions
    }

    fn on_command(
        &mut self,
        now_us: u64,
        command: Command,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        let kind = match command {
            Command::Reference => ActuationKind::Reference,
            Command::Fold => ActuationKind::Fold,
            Command::Unfold => ActuationKind::Unfold,
            Command::Stop => {
                self.stop(now_us, ActuationOutcome::Stopped, actions);
                return Ok(());
            }
            Command::EStop => {
                self.fail(now_us, CapsuleFault::EStopFrame, actions);
                return Ok(());
            }
            Command::Acknowledge => return self.acknowledge(),
        };
        match (&self.mode, kind) {
            (Mode::Faulted(CapsuleFault::Watchdog | CapsuleFault::Panic), _) => {
                return Err(Refusal::AcknowledgeFirst);
            }
            (Mode::Faulted(fault), _) => return Err(Refusal::CapsuleFaulted(*fault)),
            (Mode::Moving(_), _) => return Err(Refusal::CapsuleBusy(self.state())),
            (Mode::Unreferenced, ActuationKind::Fold | ActuationKind::Unfold) => {
                return Err(Refusal::NotReferenced);
            }
            (Mode::Folded, ActuationKind::Fold) | (Mode::Unfolded, ActuationKind::Unfold) => {
                return Err(Refusal::AlreadyThere);
            }
            _ => {}
        }
        if self.sample.battery_mv < LEAST_BATTERY_MV {
            return Err(Refusal::BatteryLow {
                battery_mv: self.sample.battery_mv,
                min_mv: LEAST_BATTERY_MV,
            });
        }
        if let Some(fault) = self.amplifier_fault() {
            self.fail(now_us, fault, actions);
            return Err(Refusal::CapsuleFaulted(fault));
        }
        self.start(now_us, kind, actions);
        Ok(())
    }

    /// The shunt amplifier shows a current at rest. Nothing it says under drive can then be relied on.
    fn amplifier_fault(&self) -> Option<CapsuleFault> {
        let current_ma = self.sample.offset_ma;
        (current_ma > MOST_OFFSET_MA).then_some(CapsuleFault::OverCurrent { current_ma })
    }

    fn acknowledge(&mut self) -> Result<(), Refusal> {
        let Mode::Faulted(fault) = self.mode else {
            return Err(Refusal::NothingToAcknowledge);
        };
        let persists = match fault {
            CapsuleFault::LowBattery { .. } => self.sample.battery_mv < LEAST_BATTERY_MV,
            CapsuleFault::DriverFault => self.sample.driver_fault,
            CapsuleFault::OverCurrent { .. } => self.amplifier_fault().is_some(),
            _ => false,
        };
        if persists {
            return Err(Refusal::CauseStillPresent);
        }
        self.mode = self.resting_between_ends();
        Ok(())
    }

    fn start(&mut self, now_us: u64, kind: ActuationKind, actions: &mut Actions) {
        let from_slack = matches!(self.mode, Mode::Unfolded);
        let leg = match kind {
            ActuationKind::Reference => {
                self.referenced = false;
                Leg::Seek {
                    origin: self.sample.counts,
                    second: false,
                }
            }
            ActuationKind::Fold => Leg::Wind,
            ActuationKind::Unfold => Leg::PayOut,
        };
        let from_us = now_us.max(self.brake_until_us);
        let timeout_us = u64::from(Self::timeout_ms(kind)) * 1_000;
        self.mode = Mode::Moving(Actuation {
            kind,
            leg,
            detector: Detector::new(leg.spooling(), from_us),
            started_us: now_us,
            deadline_us: from_us.saturating_add(timeout_us),
            from_slack,
        });
        self.recorder
            .start(kind, self.thread(), self.sample.battery_mv);
        actions.emit(CapsuleEvent::Started {
            actuation: self.record().actuation,
            kind,
        });
        // If the leg is already at its end, the motor is not even switched on.
        self.supervise(now_us, actions);
    }

    fn on_sample(&mut self, now_us: u64, sample: Sample, actions: &mut Actions) {
        // The last sample before a start is up to 100 ms old, and the motor was not driven then.
        let since_us = match &self.mode {
            Mode::Moving(actuation) => self.sample_us.max(actuation.started_us),
            _ => self.sample_us,
        };
        if let Drive::Millivolts(_) = self.drive {
            self.recorder
                .add_energy(&sample, now_us.saturating_sub(since_us));
        }
        self.sample = sample;
        self.sample_us = self.sample_us.max(now_us);
        self.supervise(now_us, actions);
        if self.is_moving() || now_us < self.brake_until_us {
            self.recorder.thread(self.thread());
        }
    }

    /// Judges the last sample while moving.
    fn supervise(&mut self, now_us: u64, actions: &mut Actions) {
        if let Err(fault) = self.judge(now_us, actions) {
            self.fail(now_us, fault, actions);
        }
    }

    fn judge(&mut self, now_us: u64, actions: &mut Actions) -> Result<(), CapsuleFault> {
        let driven_mv = match self.drive {
            Drive::Millivolts(drive_mv) => Some(drive_mv.unsigned_abs()),
            Drive::Off | Drive::Brake => None,
        };
        let thread = self.thread();
        let Mode::Moving(actuation) = &mut self.mode else {
            return Ok(());
        };
        let duration_us = now_us.saturating_sub(actuation.started_us);
        self.recorder.update(duration_us, self.sample.battery_mv);
        let detector = &mut actuation.detector;
        if now_us < detector.from_us() {
            return Ok(()); // still braking from the motion before
        }
        let load = match driven_mv {
            // The first sample of a leg was taken before its drive: only its position counts.
            None => Load::default(),
            Some(drive_mv) => {
                if detector.sees_force(now_us) {
                    self.recorder.current(self.sample.current_ma);
                }
                detector
                    .check(now_us, &self.sample, drive_mv, self.no_load_ma)
                    .map_err(|trip| fault_of(trip, thread))?
            }
        };
        if detector.spooling() == Spooling::Wind {
            if actuation.from_slack {
                self.no_load_ma = detector.first_mean_ma(now_us).unwrap_or(self.no_load_ma);
            }
            if let Some(engaged_at) = load.engaged_at {
                self.recorder.engaged(engaged_at.since(self.zero).thread());
            }
        }
        let stopping = detector.stopping_distance();
        let counts = self.sample.counts;
        let next = match actuation.leg.decide(counts, self.zero, load, stopping)? {
            Decision::Continue if now_us >= actuation.deadline_us => {
                return Err(CapsuleFault::Timeout);
            }
            Decision::Continue => return Ok(()),
            Decision::Reverse(leg) => leg,
            Decision::ZeroFound(zero) => {
                self.recorder.zero_moved(self.zero.since(zero).thread());
                self.zero = zero;
                self.referenced = true;
                Leg::PayOut
            }
            Decision::Folded => {
                if thread > FOLDED {
                    self.zero = counts.back(FOLDED.counts());
                }
                self.end(now_us, Mode::Folded, ActuationOutcome::Complete, actions);
                return Ok(());
            }
            Decision::Unfolded => {
                self.end(now_us, Mode::Unfolded, ActuationOutcome::Complete, actions);
                return Ok(());
            }
        };
        // The motor is braked, then driven the other way.
        let from_us = now_us.saturating_add(BRAKE_US);
        self.brake_until_us = from_us;
        actuation.leg = next;
        actuation.detector = Detector::new(next.spooling(), from_us);
        actuation.from_slack = false;
        Ok(())
    }

    fn stop(&mut self, now_us: u64, outcome: ActuationOutcome, actions: &mut Actions) {
        if self.is_moving() {
            let mode = self.resting_between_ends();
            self.end(now_us, mode, outcome, actions);
        }
    }

    /// At rest with the thread anywhere. A reference run stopped after it found the zero knows its position.
    fn resting_between_ends(&self) -> Mode {
        if self.referenced {
            Mode::Stopped
        } else {
            Mode::Unreferenced
        }
    }

    /// Ends the motion, if there is one, and latches the fault.
    fn fail(&mut self, now_us: u64, fault: CapsuleFault, actions: &mut Actions) {
        let latched = self.fault();
        if latched == Some(fault)
            || matches!(latched, Some(CapsuleFault::Watchdog | CapsuleFault::Panic))
        {
            return; // what ended the firmware's last run must be acknowledged under its own name
        }
        let keeps_position = matches!(
            fault,
            CapsuleFault::Jam { .. } | CapsuleFault::LowBattery { .. }
        );
        self.referenced &= keeps_position;
        if self.is_moving() {
            let outcome = ActuationOutcome::Faulted(fault);
            self.end(now_us, Mode::Faulted(fault), outcome, actions);
        }
        self.mode = Mode::Faulted(fault);
        actions.emit(CapsuleEvent::Faulted(fault));
    }

    fn end(&mut self, now_us: u64, mode: Mode, outcome: ActuationOutcome, actions: &mut Actions) {
        // Without drive there is nothing to brake.
        if matches!(self.drive, Drive::Millivolts(_)) {
            self.brake_until_us = now_us.saturating_add(BRAKE_US);
        }
        self.mode = mode;
        self.recorder.end(outcome, self.thread());
        actions.emit(CapsuleEvent::Ended {
            actuation: self.record().actuation,
            outcome,
        });
    }

    fn wanted_drive(&self, now_us: u64) -> Drive {
        match &self.mode {
            Mode::Moving(actuation) if now_us >= actuation.detector.from_us() => {
                let wanted_mv = actuation.leg.drive_mv(self.thread());
                // At most 3700: fits.
                let millivolts = wanted_mv.min(self.sample.battery_mv) as i16;
                Drive::Millivolts(match actuation.leg.spooling() {
                    Spooling::Wind => millivolts,
                    Spooling::PayOut => -millivolts,
                })
            }
            _ if now_us < self.brake_until_us => Drive::Brake,
            _ => Drive::Off,
        }
    }
}

fn fault_of(trip: Trip, thread: Thread) -> CapsuleFault {
    match trip {
        Trip::Driver => CapsuleFault::DriverFault,
        Trip::OverCurrent { current_ma } => CapsuleFault::OverCurrent { current_ma },
        Trip::LowBattery { battery_mv } => CapsuleFault::LowBattery { battery_mv },
        Trip::Blocked => CapsuleFault::Jam {
            thread_um: thread.0,
        },
        Trip::EncoderLost => CapsuleFault::EncoderLost,
    }
}

//! The capsule's state machine: reference, fold, unfold. Pure: time and sensors in, drive and events out.
//!
//! | state | event \[guard\] | next |
//! |---|---|---|
//! | any at rest | Reference \[battery\] | Referencing |
//! | Unfolded, Stopped | Fold \[battery\] | Folding |
//! | Folded, Stopped | Unfold \[battery\] | Unfolding |
//! | Referencing | zero found and reached | Unfolded |
//! | Folding | end force in the end window | Folded |
//! | Unfolding | zero reached | Unfolded |
//! | Folding, Unfolding | Stop, link silent | Stopped |
//! | Referencing | Stop, link silent | Unreferenced; Stopped once the zero is found |
//! | any | EStop | Faulted |
//! | moving | trip | Faulted |
//! | Faulted | Acknowledge \[cause gone\] | Stopped, or Unreferenced where the fault costs the position |
//!
//! The motor is driven only while referencing, folding or unfolding. Each of them ends with the motor
//! short-circuited for [`BRAKE_US`]: at 3.7 V it turns 270 times a second, runs on 0.1 mm of thread when
//! braked and almost 3 mm when let go. Then the bridge sleeps; the worm holds.
//!
//! # How the zero is found
//!
//! Paying out can only be counted, not felt: behind the worm a slack thread and one that has wound
//! itself backwards onto the spool look alike. And the force begins gently: by the beam estimate of the
//! origami the current rises by 0.3 of the no-load current (0.2 N) only some 9 mm after the slack
//! has ended, and where exactly depends on friction more than on the thread. So the first engagement is recorded but
//! nothing is referred to it. The sharp mark is the other end: at [`FORCE_MA`](crate::mechanics::FORCE_MA) the force grows
//! by about 5 N per mm, so that an error of 10 % in the current is 0.15 mm of thread. A reference run
//! therefore winds, slowly, to the same force at the same voltage as a fold does, calls that
//! [`FOLDED`], and pays out exactly that much: it ends unfolded, whatever the state was in which it began.
//!
//! An obstacle has an end force too, and taking it for the folded end would pay out past zero by all that was
//! missing. The origami takes [`LEAST_RISE`] or more from 3 N to the end force, an obstacle almost nothing. If
//! the rise was too short, the origami may have been folded from the beginning: then [`BACK_OFF`] is paid out and the
//! second try decides. Only a thread that is caught within its first 4 mm is paid out too far by that, by the
//! part of the 4 mm that was not wound; [`SEEK_LIMIT`] allows for it.
//!
//! # Zero after a fold
//!
//! A fold that ends in force beyond [`FOLDED`] takes this point as the new [`FOLDED`]; one that ends before it keeps its count. So
//! the next unfolding pays out the shorter one of two estimates, and what remains wound is taken up by the slack.

use crate::{
    detect::{Detector, Load, Sample, Spooling, Trip},
    mechanics::{
        BACK_OFF, Counts, END_WINDOW, FOLDED, LEAST_RISE, NO_LOAD_MA, SEEK_LIMIT, SOFT_MAXIMUM,
        Thread,
    },
};
use protocol::{
    capsule::{
        ActuationKind, ActuationOutcome, ActuationRecord, CapsuleEvent, CapsuleFault, CapsuleState,
    },
    error::Refusal,
};

/// Drive of the long way.
pub const FAST_MV: u16 = 3_700;
/// Drive where force ends the motion: stalls at 11 N.
pub const GENTLE_MV: u16 = 1_500;
/// A fold is gentle from here on.
pub const GENTLE_FROM: Thread = Thread(18_000);
/// A paying-out is braked where the motor will run on to this distance from its end. What the prediction of the
/// running-on is wrong by must be less: it is 0.15 mm at 20 mm/s.
pub const STOP_MARGIN: Thread = Thread(40);
/// Six time constants of the motor.
pub const BRAKE_US: u64 = 40_000;
/// A motion is refused below this battery voltage.
pub const LEAST_BATTERY_MV: u16 = 3_000;
/// Two slow ways up, two ways out.
pub const REFERENCE_TIMEOUT_MS: u32 = 12_000;
/// The model motor takes 1.6 s; an almost empty battery twice as long.
pub const FOLD_TIMEOUT_MS: u32 = 4_000;
/// The model motor takes 1.2 s.
pub const UNFOLD_TIMEOUT_MS: u32 = 4_000;

/// What the bridge does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Drive {
    /// Bridge asleep.
    #[default]
    Off,
    /// Motor short-circuited.
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

/// What has to be done.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Actions {
    /// Set the bridge to this.
    pub drive: Drive,
    /// Record and send these, in this order.
    pub events: heapless::Vec<CapsuleEvent, 3>,
    /// The command was refused.
    pub refusal: Option<Refusal>,
}

impl Actions {
    fn emit(&mut self, event: CapsuleEvent) {
        // One step emits at most a start, an end and a fault.
        let _ = self.events.push(event);
    }
}

// One machine exists, and boxes do not.
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
    /// The thread was slack at the start: the first current is the no-load current.
    from_slack: bool,
}

/// One direction of the motor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Leg {
    /// Wind to the force, for the reference.
    Seek { origin: Counts, second: bool },
    /// Pay out a little, to feel the rise on the second try.
    BackOff { to: Counts, origin: Counts },
    /// Wind to the force, for the fold.
    Wind,
    /// Pay out to zero.
    PayOut,
}

impl Leg {
    fn spooling(self) -> Spooling {
        match self {
            Leg::Seek { .. } | Leg::Wind => Spooling::Wind,
            Leg::BackOff { .. } | Leg::PayOut => Spooling::PayOut,
        }
    }
}

/// What a leg's sample means.
enum Step {
    Go,
    Turn(Leg),
    Folded,
    Unfolded,
    Fault(CapsuleFault),
}

/// The machine.
#[derive(Clone, Debug)]
pub struct Capsule {
    mode: Mode,
    referenced: bool,
    /// The encoder at thread zero.
    zero: Counts,
    sample: Sample,
    sample_us: u64,
    drive: Drive,
    brake_until_us: u64,
    no_load_ma: u16,
    record: ActuationRecord,
    energy_pj: u64,
}

impl Capsule {
    /// At the device's start: nothing is known. `fault` is that of the last start's end, if it ended badly.
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
            record: ActuationRecord {
                actuation: 0,
                kind: ActuationKind::Reference,
                outcome: ActuationOutcome::None,
                duration_ms: 0,
                thread_um: 0,
                end_current_ma: 0,
                peak_current_ma: 0,
                engaged_um: 0,
                energy_mj: 0,
                min_battery_mv: 0,
            },
            energy_pj: 0,
        }
    }

    /// As the protocol names it.
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

    /// Thread wound up, from the last sample; without a reference from an arbitrary zero.
    pub fn thread(&self) -> Thread {
        self.sample.counts.since(self.zero).thread()
    }

    /// The last sample.
    pub fn sample(&self) -> &Sample {
        &self.sample
    }

    /// What the bridge should do now.
    pub fn drive(&self) -> Drive {
        self.drive
    }

    /// The present or last actuation.
    pub fn record(&self) -> &ActuationRecord {
        &self.record
    }

    /// How long the present or last kind of actuation may take.
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
            Event::Sample(sample) => self.take(now_us, sample, &mut actions),
            Event::Command(command) => {
                actions.refusal = self.command(now_us, command, &mut actions).err();
            }
            Event::LinkSilent => self.stop(now_us, ActuationOutcome::LinkLost, &mut actions),
        }
        self.drive = self.wanted_drive(now_us);
        actions.drive = self.drive;
        actions
    }

    fn command(
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
        self.start(now_us, kind, actions);
        Ok(())
    }

    fn acknowledge(&mut self) -> Result<(), Refusal> {
        let Mode::Faulted(fault) = self.mode else {
            return Err(Refusal::NothingToAcknowledge);
        };
        let persists = match fault {
            CapsuleFault::LowBattery { .. } => self.sample.battery_mv < LEAST_BATTERY_MV,
            CapsuleFault::DriverFault => self.sample.driver_fault,
            _ => false,
        };
        if persists {
            return Err(Refusal::CauseStillPresent);
        }
        self.mode = if self.referenced {
            Mode::Stopped
        } else {
            Mode::Unreferenced
        };
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
        self.energy_pj = 0;
        self.record = ActuationRecord {
            actuation: self.record.actuation.saturating_add(1),
            kind,
            outcome: ActuationOutcome::Running,
            duration_ms: 0,
            thread_um: self.thread().0,
            end_current_ma: 0,
            peak_current_ma: 0,
            engaged_um: 0,
            energy_mj: 0,
            min_battery_mv: self.sample.battery_mv,
        };
        actions.emit(CapsuleEvent::Started {
            actuation: self.record.actuation,
            kind,
        });
        // Where there is nowhere to go, the motor is not even switched on.
        self.supervise(now_us, actions);
    }

    fn take(&mut self, now_us: u64, sample: Sample, actions: &mut Actions) {
        // The last sample before an actuation is up to 100 ms old, and nothing was driven then.
        let since_us = match &self.mode {
            Mode::Moving(actuation) => self.sample_us.max(actuation.started_us),
            _ => self.sample_us,
        };
        let elapsed_us = now_us.saturating_sub(since_us);
        if let Drive::Millivolts(_) = self.drive {
            // mV * mA * us = pJ. All of the motor's current comes from the battery: there is none between the
            // pulses.
            let power = u64::from(sample.battery_mv) * u64::from(sample.current_ma);
            self.energy_pj = self
                .energy_pj
                .saturating_add(power.saturating_mul(elapsed_us));
        }
        self.sample = sample;
        self.sample_us = self.sample_us.max(now_us);
        self.supervise(now_us, actions);
        if self.is_moving() || now_us < self.brake_until_us {
            self.record.thread_um = self.thread().0;
        }
    }

    /// Judges the last sample while moving.
    fn supervise(&mut self, now_us: u64, actions: &mut Actions) {
        let driven_mv = match self.drive {
            Drive::Millivolts(drive_mv) => Some(drive_mv.unsigned_abs()),
            Drive::Off | Drive::Brake => None,
        };
        let Mode::Moving(actuation) = &mut self.mode else {
            return;
        };
        let duration_us = now_us.saturating_sub(actuation.started_us);
        self.record.duration_ms = u32::try_from(duration_us / 1_000).unwrap_or(u32::MAX);
        self.record.energy_mj = u32::try_from(self.energy_pj / 1_000_000_000).unwrap_or(u32::MAX);
        self.record.min_battery_mv = self.record.min_battery_mv.min(self.sample.battery_mv);
        if now_us < actuation.detector.from_us() {
            return; // still braking from the motion before
        }
        let detector = &mut actuation.detector;
        let load = match driven_mv {
            // The first sample of a leg is from before its drive: only its position counts.
            None => Load::default(),
            Some(drive_mv) => {
                let checked = detector.check(now_us, &self.sample, drive_mv, self.no_load_ma);
                if detector.sees_force(now_us) {
                    let current_ma = self.sample.current_ma;
                    self.record.end_current_ma = current_ma;
                    self.record.peak_current_ma = self.record.peak_current_ma.max(current_ma);
                }
                match checked {
                    Ok(load) => load,
                    Err(trip) => return self.trip(now_us, trip, actions),
                }
            }
        };
        if detector.spooling() == Spooling::Wind {
            if actuation.from_slack {
                self.no_load_ma = detector.first_mean_ma(now_us).unwrap_or(self.no_load_ma);
            }
            if let (0, Some(engaged)) = (self.record.engaged_um, load.engaged_at) {
                self.record.engaged_um = engaged.since(self.zero).thread().0;
            }
        }
        let (leg, overdue) = (actuation.leg, now_us >= actuation.deadline_us);
        let running_on = actuation.detector.stopping_distance().thread();
        let margin = Thread(running_on.0.saturating_add(STOP_MARGIN.0));
        match self.judge(leg, load, margin) {
            Step::Go if overdue => self.fail(now_us, CapsuleFault::Timeout, actions),
            Step::Go => {}
            Step::Turn(leg) => self.turn(now_us, leg),
            Step::Folded => {
                if self.thread() > FOLDED {
                    self.zero = self.sample.counts.back(FOLDED.counts());
                }
                self.end(now_us, Mode::Folded, ActuationOutcome::Complete, actions);
            }
            Step::Unfolded => self.end(now_us, Mode::Unfolded, ActuationOutcome::Complete, actions),
            Step::Fault(fault) => self.fail(now_us, fault, actions),
        }
    }

    /// Where a leg ends. `margin` is how far ahead of a counted end the brake must be applied.
    fn judge(&mut self, leg: Leg, load: Load, margin: Thread) -> Step {
        let (thread, counts) = (self.thread(), self.sample.counts);
        let jam = Step::Fault(CapsuleFault::Jam {
            thread_um: thread.0,
        });
        // Past the last possible end: without load the thread is broken; with load it is longer than the count
        // says, and a new reference is the remedy.
        let past_the_end = Step::Fault(if load.engaged_at.is_some() {
            CapsuleFault::Timeout
        } else {
            CapsuleFault::ThreadBroken
        });
        match leg {
            Leg::Wind if load.end_force && thread >= END_WINDOW && thread <= SOFT_MAXIMUM => {
                Step::Folded
            }
            Leg::Wind if thread >= SOFT_MAXIMUM => past_the_end,
            Leg::Wind if load.end_force => jam,
            Leg::Wind => Step::Go,
            Leg::Seek { origin, second } => {
                if load.end_force {
                    let rise = load
                        .rise_from
                        .map_or(Thread(0), |from| counts.since(from).thread());
                    if rise >= LEAST_RISE {
                        self.set_reference(counts.back(FOLDED.counts()));
                        Step::Turn(Leg::PayOut)
                    } else if second {
                        jam
                    } else {
                        Step::Turn(Leg::BackOff {
                            to: counts.back(BACK_OFF.counts()),
                            origin,
                        })
                    }
                } else if counts.since(origin).thread() >= SEEK_LIMIT {
                    past_the_end
                } else {
                    Step::Go
                }
            }
            Leg::BackOff { .. } | Leg::PayOut if load.end_force => jam,
            Leg::BackOff { to, origin } => {
                if counts.since(to).thread() <= margin {
                    Step::Turn(Leg::Seek {
                        origin,
                        second: true,
                    })
                } else {
                    Step::Go
                }
            }
            Leg::PayOut if thread <= margin => Step::Unfolded,
            Leg::PayOut => Step::Go,
        }
    }

    fn set_reference(&mut self, zero: Counts) {
        // What was recorded from the old zero moves along. An engagement at exactly 0 would read as "never".
        if self.record.engaged_um != 0 {
            let moved = self.zero.since(zero).thread().0;
            self.record.engaged_um = self.record.engaged_um.saturating_add(moved);
        }
        self.zero = zero;
        self.referenced = true;
    }

    fn turn(&mut self, now_us: u64, leg: Leg) {
        let from_us = now_us.saturating_add(BRAKE_US);
        self.brake_until_us = from_us;
        if let Mode::Moving(actuation) = &mut self.mode {
            actuation.leg = leg;
            actuation.detector = Detector::new(leg.spooling(), from_us);
            actuation.from_slack = false;
        }
    }

    fn trip(&mut self, now_us: u64, trip: Trip, actions: &mut Actions) {
        let fault = match trip {
            Trip::Driver => CapsuleFault::DriverFault,
            Trip::OverCurrent { current_ma } => CapsuleFault::OverCurrent { current_ma },
            Trip::LowBattery { battery_mv } => CapsuleFault::LowBattery { battery_mv },
            Trip::Blocked => CapsuleFault::Jam {
                thread_um: self.thread().0,
            },
            Trip::EncoderLost => CapsuleFault::EncoderLost,
        };
        self.fail(now_us, fault, actions);
    }

    fn stop(&mut self, now_us: u64, outcome: ActuationOutcome, actions: &mut Actions) {
        if !self.is_moving() {
            return;
        }
        // A reference run that has found its zero and was paying out knows where it is.
        let mode = if self.referenced {
            Mode::Stopped
        } else {
            Mode::Unreferenced
        };
        self.end(now_us, mode, outcome, actions);
    }

    /// Ends the motion, if there is one, and latches the fault.
    fn fail(&mut self, now_us: u64, fault: CapsuleFault, actions: &mut Actions) {
        let latched = self.fault();
        if latched == Some(fault)
            || matches!(latched, Some(CapsuleFault::Watchdog | CapsuleFault::Panic))
        {
            return; // the failure of the last start must be acknowledged as what it is
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
        // Nothing to brake if the motor was never switched on.
        if matches!(self.drive, Drive::Millivolts(_)) {
            self.brake_until_us = now_us.saturating_add(BRAKE_US);
        }
        self.mode = mode;
        self.record.outcome = outcome;
        self.record.thread_um = self.thread().0;
        actions.emit(CapsuleEvent::Ended {
            actuation: self.record.actuation,
            outcome,
        });
    }

    fn wanted_drive(&self, now_us: u64) -> Drive {
        match &self.mode {
            Mode::Moving(actuation) if now_us >= actuation.detector.from_us() => {
                let wanted_mv = match actuation.leg {
                    Leg::Seek { .. } | Leg::BackOff { .. } => GENTLE_MV,
                    Leg::Wind if self.thread() < GENTLE_FROM => FAST_MV,
                    Leg::Wind => GENTLE_MV,
                    Leg::PayOut => FAST_MV,
                };
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

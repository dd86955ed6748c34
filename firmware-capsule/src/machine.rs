//! The capsule's state machine. Pure: time and sensors in, drive and events out.
//!
//! At rest the state follows from what is [known](crate::known); `orders` says what each accepts:
//!
//! | state at rest | when |
//! |---|---|
//! | Unreferenced | no calibration, or the count is uncertain by more than 0.25 mm |
//! | Unfolded | counted to zero |
//! | Folded | counted to the folded end, and the thread pulled there |
//! | Stopped | anywhere else |
//! | Faulted | latched until it is acknowledged |
//!
//! A motion is a list of phases:
//!
//! | motion | phases |
//! |---|---|
//! | calibrate | zero is here; wind to the end force, the folded end is 0.1 mm before; feel; fold once; home |
//! | fold | have 2 mm of run-up; wind to the folded end; feel |
//! | check | feel, where it is folded; else as fold |
//! | unfold | where it is folded, pay out 1 mm, and feel if that took too little current; home |
//! | partial fold | to the place |
//! | reference | wind to the folded end less the doubt; feel; wind on until the thread pulls as calibrated; home |
//!
//! To feel is to pay out 1 mm and to wind it again. Between two phases, and after the last, the motor is shorted for
//! [`BRAKE_US`]. Then the bridge sleeps and the worm holds.

use crate::feel::Feel;
use crate::guards::{CELL_MILLIOHM, Guards, lasts, runs_on};
use crate::known::{Known, NEAR, RECORDED_EACH};
use crate::phase::{FELT, Goal, HOME, Phase};
use crate::record::Recorder;
use crate::sample::{Sample, Spooling};
use crate::settings::Settings;
use crate::speed::SpeedLoop;
use crate::units::{Counts, Thread};
use protocol::{
    capsule::{
        ActuationKind, ActuationOutcome, ActuationRecord, CapsuleEvent, CapsuleFault, CapsuleState,
    },
    error::Refusal,
};

/// Time that the motor is shorted after each phase: six of its time constants.
pub const BRAKE_US: u64 = 40_000;
/// Minimum current from the cell for measuring its resistance.
const LOAD_MA: u32 = 50;
/// Current above the no-load current at which the thread pulls: 0.3 N.
const ENGAGED_MA: i32 = 7;
/// Time after the start of a phase from which that counts: until then the current may accelerate the motor.
const ENGAGES_US: u64 = 150_000;
/// No-load current until a calibration has measured it: the data sheet's.
const NO_LOAD_MA: u16 = 16;
/// Readings of the end force that end a calibration's winding.
const END_READINGS: u8 = 3;
/// The folded end lies this far before the place where the end force was felt: a fold need not pull that hard.
const BEFORE_THE_FORCE: Thread = Thread(100);
/// Run-up of a fold, so that the rise of its current can be measured: play and hysteresis are behind it.
const RUN_UP: Thread = Thread(2_000);
/// How far past the folded end a reference winds on: the scatter of the pull.
const PAST_THE_END: Thread = Thread(300);
/// Time limit of a calibration and of a reference, which feels up to 20 times.
pub const REFERENCE_TIMEOUT_MS: u32 = 40_000;

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

/// An order of the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Take this place as the unfolded end and find the folded one.
    Calibrate,
    /// Feel whether it is folded, and stay there.
    CheckFolded,
    /// Find the folded end again, and unfold.
    Reference,
    /// Wind to the folded end and feel.
    Fold,
    /// Pay out to zero.
    Unfold,
    /// Wind or pay out to this thread length.
    FoldTo(Thread),
    /// Motor off; never refused.
    Stop,
    /// Motor off and fault; never refused.
    EStop,
    /// Clear the fault.
    Acknowledge,
}

/// An input of the state machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// New readings, every 1 ms while the bridge is awake.
    Sample(Sample),
    /// An order of the host.
    Command(Command),
    /// No valid frame has come for longer than the link's time-out.
    LinkSilent,
    /// The supply is too low for the flash, while something moves.
    SupplyLow,
}

/// Output of a step, for the caller to carry out.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Actions {
    /// Drive for the bridge from now on.
    pub drive: Drive,
    /// Events to record and send, in this order.
    pub events: heapless::Vec<CapsuleEvent, 3>,
    /// Reason why the command was refused.
    pub refusal: Option<Refusal>,
    /// What a start has to find that comes while this motion goes on: to be written to flash now.
    pub keep: Option<Known>,
}

impl Actions {
    pub(crate) fn emit(&mut self, event: CapsuleEvent) {
        // The capacity suffices: one step emits at most a start, an end and a fault.
        let _ = self.events.push(event);
    }
}

/// A motion under way.
#[derive(Clone, Debug)]
pub(crate) struct Motion {
    /// A reference without a calibration is a calibration; the record has the name of the order.
    kind: ActuationKind,
    step: u8,
    phase: Phase,
    /// The place that the motion is about: the folded end, or where a partial fold ends.
    top: Thread,
    feel: Feel,
    guards: Guards,
    speed: SpeedLoop,
    /// Duty times battery voltage in the direction of the phase; none shorts the motor.
    effort: Option<i16>,
    end_readings: u8,
    /// Thread at the last record in flash.
    recorded: Thread,
    started_us: u64,
    /// The phase is driven from this time on.
    from_us: u64,
    deadline_us: u64,
    /// Battery voltage before the drive.
    rest_mv: u16,
}

/// The state machine.
#[derive(Clone, Debug)]
pub struct Capsule {
    motion: Option<Motion>,
    /// The latched fault. No motion then.
    pub fault: Option<CapsuleFault>,
    /// What is known of the thread.
    pub known: Known,
    /// The first reading has come, so the count is that of `known`.
    anchored: bool,
    /// The amplifier's offset before the last motion, for comparison with the one after it.
    pub(crate) offset_before_ma: i16,
    /// The last sample.
    pub sample: Sample,
    sample_us: u64,
    /// State of the bridge after the last event.
    pub drive: Drive,
    pub(crate) brake_until_us: u64,
    /// Internal resistance of the cell, as measured in the last motion under load.
    pub(crate) cell_milliohm: u32,
    /// The settings in force. Not to be changed during a motion.
    pub settings: Settings,
    recorder: Recorder,
}

impl Capsule {
    /// A started device. `fault` is the fault that ended the previous run of the firmware, if one did; what is `known`
    /// comes from flash.
    pub fn new(fault: Option<CapsuleFault>, known: Known, settings: Settings) -> Self {
        Self {
            motion: None,
            fault,
            known,
            anchored: false,
            offset_before_ma: 0,
            sample: Sample::default(),
            sample_us: 0,
            drive: Drive::Off,
            brake_until_us: 0,
            cell_milliohm: CELL_MILLIOHM.unsigned_abs(),
            settings,
            recorder: Recorder::new(),
        }
    }

    /// The state by its name in the protocol.
    pub fn state(&self) -> CapsuleState {
        let Some(motion) = &self.motion else {
            return match self.fault {
                Some(_) => CapsuleState::Faulted,
                None => self.known.state(self.thread()),
            };
        };
        match motion.kind {
            ActuationKind::Reference | ActuationKind::Calibrate => CapsuleState::Referencing,
            ActuationKind::CheckFolded => CapsuleState::Checking,
            ActuationKind::Fold => CapsuleState::Folding,
            ActuationKind::Unfold => CapsuleState::Unfolding,
            ActuationKind::FoldTo => match motion.phase.spooling {
                Spooling::Wind => CapsuleState::Folding,
                Spooling::PayOut => CapsuleState::Unfolding,
            },
        }
    }

    /// The motor may be driven.
    pub fn is_moving(&self) -> bool {
        self.motion.is_some()
    }

    /// Thread on the spool at the last sample, at least.
    pub fn thread(&self) -> Thread {
        self.known.thread(self.sample.counts)
    }

    /// What a start has to find while nothing moves.
    pub fn resting(&self) -> Known {
        self.known.resting(self.sample.counts)
    }

    /// Record of the present or last actuation.
    pub fn record(&self) -> ActuationRecord {
        self.recorder.record()
    }

    /// Number of the present or last actuation.
    pub fn actuation(&self) -> u32 {
        self.recorder.actuation()
    }

    /// Longest time an actuation of this kind may take.
    pub fn timeout_ms(&self, kind: ActuationKind) -> u32 {
        match kind {
            ActuationKind::Reference | ActuationKind::Calibrate => REFERENCE_TIMEOUT_MS,
            ActuationKind::Fold | ActuationKind::FoldTo | ActuationKind::CheckFolded => {
                self.settings.fold_timeout_ms
            }
            ActuationKind::Unfold => self.settings.unfold_timeout_ms,
        }
    }

    /// Takes one event. `now_us` must not run backwards; if it does, the machine keeps its last time.
    pub fn step(&mut self, now_us: u64, event: Event) -> Actions {
        let mut actions = Actions::default();
        match event {
            Event::Sample(sample) => self.on_sample(now_us, sample, &mut actions),
            Event::Command(command) => {
                actions.refusal = self.on_command(now_us, command, &mut actions).err();
            }
            Event::LinkSilent => self.stop(now_us, ActuationOutcome::LinkLost, &mut actions),
            Event::SupplyLow => {
                let battery_mv = self.sample.battery_mv;
                self.fail(
                    now_us,
                    CapsuleFault::LowBattery { battery_mv },
                    &mut actions,
                );
            }
        }
        self.drive = self.wanted_drive(now_us);
        actions.drive = self.drive;
        actions
    }

    fn on_sample(&mut self, now_us: u64, sample: Sample, actions: &mut Actions) {
        if let (Drive::Millivolts(drive_mv), Some(motion)) = (self.drive, &self.motion) {
            // The last sample before a start is up to 100 ms old, but the motor was not driven then.
            let since_us = self.sample_us.max(motion.started_us);
            let elapsed_us = now_us.saturating_sub(since_us);
            self.recorder
                .add_energy(&sample, drive_mv, motion.rest_mv, elapsed_us);
        }
        if !self.anchored {
            self.known.anchor(sample.counts);
            self.anchored = true;
        }
        self.sample = sample;
        self.sample_us = self.sample_us.max(now_us);
        self.supervise(now_us, actions);
        self.watch_offset(now_us, actions);
        if self.is_moving() || now_us < self.brake_until_us {
            self.recorder.thread(self.thread());
        }
    }

    /// Judges the last sample of a motion, and asks the speed loop what to do until the next.
    fn supervise(&mut self, now_us: u64, actions: &mut Actions) {
        let Some(mut motion) = self.motion.take() else {
            return;
        };
        let goes_on = self.judge(&mut motion, now_us, actions);
        if now_us >= motion.from_us {
            let aim = motion.phase.aim(self.thread());
            let (speeds, battery_mv) = (motion.guards.speeds_cps(), self.sample.battery_mv);
            motion.effort = motion.speed.step(aim, speeds, battery_mv, &self.settings);
        }
        self.motion = Some(motion);
        match goes_on {
            Ok(true) => {}
            Ok(false) => self.end(now_us, ActuationOutcome::Complete, actions),
            Err(fault) => self.fail(now_us, fault, actions),
        }
    }

    /// Judges the last sample: the guards first, then where the phase is. False at the end of the motion.
    fn judge(
        &mut self,
        motion: &mut Motion,
        now_us: u64,
        actions: &mut Actions,
    ) -> Result<bool, CapsuleFault> {
        let duration_us = now_us.saturating_sub(motion.started_us);
        self.recorder.update(duration_us, self.sample.battery_mv);
        if now_us < motion.from_us {
            return Ok(true); // still shorted
        }
        // The first sample of a phase was taken before its drive, so only its position counts.
        let mut held = (false, false);
        if self.drive != Drive::Off && now_us > motion.from_us {
            let known = self.known.calibration.filter(|_| !motion.calibrates());
            let back_emf = known.map_or(self.settings.back_emf_uv_per_cps, |known| {
                known.back_emf_uv_cps.into()
            });
            let drive_mv = match self.drive {
                Drive::Millivolts(drive_mv) => {
                    Some(motion.phase.spooling.along(drive_mv.into()) as i16)
                }
                Drive::Brake | Drive::Off => None,
            };
            held.0 =
                motion
                    .guards
                    .check(now_us, &self.sample, drive_mv, back_emf, &self.settings)?;
            held.1 = self.measure(motion, now_us, drive_mv);
        }
        if now_us >= motion.deadline_us {
            return Err(CapsuleFault::Timeout);
        }
        let (thread, (cps, _)) = (self.thread(), motion.guards.speeds_cps());
        let phase = &motion.phase;
        if phase.judge(thread, runs_on(cps), held, &self.settings)? {
            return self.conclude(motion, now_us, actions);
        }
        if (thread - motion.recorded).0.abs() >= RECORDED_EACH.0 {
            motion.recorded = thread;
            actions.keep = Some(self.known.moving(self.sample.counts, phase.spooling));
        }
        Ok(true)
    }

    /// Measures the steady current. True if it is the end force.
    fn measure(&mut self, motion: &mut Motion, now_us: u64, drive_mv: Option<i16>) -> bool {
        let thread = self.thread();
        if let Some(means) = motion.guards.means.take() {
            motion.feel.compared(&means, &self.settings);
        }
        let (Some(current_ua), Some(drive_mv)) = (motion.guards.steady_ua(now_us), drive_mv) else {
            motion.end_readings = 0;
            return false;
        };
        let depth = motion.top - thread;
        motion
            .feel
            .take(motion.phase.goal, thread, depth, current_ua);
        let current_ma = u16::try_from(current_ua / 1_000).unwrap_or(0);
        self.recorder.current(current_ma);
        let drawn_ma = (u32::from(current_ma) * u32::from(drive_mv.unsigned_abs()))
            .checked_div(self.sample.battery_mv.into())
            .unwrap_or(0);
        if drawn_ma >= LOAD_MA {
            let sag_mv = motion.rest_mv.saturating_sub(self.sample.battery_mv);
            self.cell_milliohm = u32::from(sag_mv) * 1_000 / drawn_ma;
        }
        let measured = motion.feel.no_load_ma().filter(|_| motion.calibrates());
        let no_load_ma = measured
            .or(self.known.calibration.map(|known| known.no_load_ma))
            .unwrap_or(NO_LOAD_MA);
        let excess_ma = i32::from(current_ma) - i32::from(no_load_ma);
        let is_started = now_us.saturating_sub(motion.from_us) >= ENGAGES_US;
        if motion.phase.spooling == Spooling::Wind && is_started && excess_ma >= ENGAGED_MA {
            self.recorder.engaged(thread);
        }
        let ends =
            motion.phase.goal == Goal::Seek && excess_ma >= self.settings.end_force_ma.into();
        lasts(&mut motion.end_readings, ends, END_READINGS)
    }

    /// The motions as lists of phases: the phase of this step; none after the last.
    fn plan(&self, kind: ActuationKind, step: u8, top: Thread) -> Option<Phase> {
        use ActuationKind::{Calibrate, CheckFolded, Fold, FoldTo, Reference, Unfold};
        let thread = self.thread();
        let (goal, target) = match (kind, step) {
            (Calibrate, 0) => (Goal::Seek, self.settings.folded_range.1),
            (Reference | FoldTo, 0) => (Goal::Arrive, top),
            (Fold | CheckFolded, 0) | (Calibrate, 3) => (Goal::Arrive, thread.min(top - RUN_UP)),
            (Fold | CheckFolded, 1) | (Calibrate, 4) => (Goal::Fold, top),
            (Calibrate | Reference, 1) | (Fold | CheckFolded, 2) | (Unfold, 0) => {
                (Goal::Slacken, top - FELT)
            }
            (Calibrate | Reference, 2) | (Fold | CheckFolded, 3) | (Unfold, 1) => {
                (Goal::Tighten, top)
            }
            (Calibrate, 5) | (Reference, 3) | (Unfold, 2) => (Goal::Arrive, HOME),
            _ => return None,
        };
        Some(Phase::new(goal, thread, target, &self.settings))
    }

    /// A phase is over: what it has told, and what comes next. False at the end of the motion.
    fn conclude(
        &mut self,
        motion: &mut Motion,
        now_us: u64,
        actions: &mut Actions,
    ) -> Result<bool, CapsuleFault> {
        use ActuationKind::{Calibrate, CheckFolded, Fold, Reference, Unfold};
        let thread = self.thread();
        let mut next = motion.step + 1;
        match (motion.kind, motion.step, &self.known.calibration) {
            (Calibrate, 0, _) => motion.top = thread - BEFORE_THE_FORCE,
            (Calibrate, 2, _) => motion.feel.rise = Default::default(),
            (Calibrate, 4, _) => {
                let found = motion.feel.calibration(motion.top, &self.settings)?;
                self.known.calibration = Some(found);
            }
            (Fold | CheckFolded, 1, Some(known)) => {
                if !motion.feel.folded(known) {
                    return Err(CapsuleFault::SlipOrBreak);
                }
                motion.feel.again();
            }
            (Fold | CheckFolded, 3, Some(known)) | (Unfold, 1, Some(known)) => {
                if !motion.feel.holds(known) {
                    return Err(CapsuleFault::SlipOrBreak);
                }
                self.known.felt = motion.kind != Unfold;
            }
            (Unfold, 0, Some(known)) if motion.feel.surely_holds(known) => next = 2,
            (Reference, 2, Some(known)) => match motion.feel.winds_on(known) {
                Some(further) => {
                    motion.top = motion.top + further;
                    motion.feel.again();
                    if motion.top > self.known.end().unwrap_or_default() + PAST_THE_END {
                        return Err(CapsuleFault::SlipOrBreak);
                    }
                    next = 0;
                }
                None if !motion.feel.is_origami(known) => {
                    return Err(CapsuleFault::Jam {
                        thread_um: thread.0,
                    });
                }
                None => self.known.referenced(motion.top),
            },
            _ => {}
        }
        Ok(self.go_on(motion, now_us, next, actions))
    }

    /// Begins the phase of this step, or the first after it that is not over before it begins. False after the last.
    fn go_on(
        &mut self,
        motion: &mut Motion,
        now_us: u64,
        mut step: u8,
        actions: &mut Actions,
    ) -> bool {
        let thread = self.thread();
        let phase = loop {
            match self.plan(motion.kind, step, motion.top) {
                Some(phase) if phase.is_over(thread) => step += 1,
                Some(phase) => break phase,
                None => return false,
            }
        };
        // Short the motor first, unless it stands.
        if self.drive != Drive::Off {
            self.brake_until_us = self.brake_until_us.max(now_us + BRAKE_US);
        }
        actions.keep = Some(self.known.moving(self.sample.counts, phase.spooling));
        (motion.step, motion.phase, motion.recorded) = (step, phase, thread);
        motion.speed = SpeedLoop::default();
        motion.effort = None;
        motion.end_readings = 0;
        motion.drive_from(now_us.max(self.brake_until_us));
        true
    }

    /// Begins a motion, which was accepted. Only a partial fold uses `target`.
    pub(crate) fn begin(
        &mut self,
        now_us: u64,
        order: ActuationKind,
        target: Thread,
        actions: &mut Actions,
    ) {
        use ActuationKind::{Calibrate, CheckFolded, Fold, FoldTo, Reference, Unfold};
        let kind = match self.known.calibration {
            None if order == Reference => Calibrate,
            _ => order,
        };
        let is_folded = self.state() == CapsuleState::Folded;
        if kind == Calibrate {
            self.known.unfolded_here(self.sample.counts);
        }
        let thread = self.thread();
        let end = self.known.end().unwrap_or_default();
        let (step, top) = match kind {
            FoldTo => (0, target),
            Unfold => (if is_folded { 0 } else { 2 }, thread),
            CheckFolded if is_folded => (2, thread),
            Fold | CheckFolded => (0, end),
            Reference => (0, end - self.known.doubt.unwrap_or_default()),
            Calibrate => (0, Thread(0)),
        };
        self.known.felt = false;
        self.offset_before_ma = self.sample.offset_ma;
        let from_us = now_us.max(self.brake_until_us);
        let rest_mv = self.sample.battery_mv;
        let mut motion = Motion {
            kind,
            step,
            phase: Phase::new(Goal::Arrive, thread, thread, &self.settings),
            top,
            feel: Feel::default(),
            guards: Guards::new(Spooling::Wind, from_us, rest_mv),
            speed: SpeedLoop::default(),
            effort: None,
            end_readings: 0,
            recorded: thread,
            started_us: now_us,
            from_us,
            deadline_us: from_us + u64::from(self.timeout_ms(kind)) * 1_000,
            rest_mv,
        };
        self.recorder.start(order, thread, rest_mv);
        actions.emit(CapsuleEvent::Started {
            actuation: self.actuation(),
            kind: order,
        });
        let goes_on = self.go_on(&mut motion, now_us, step, actions);
        self.motion = Some(motion);
        match goes_on {
            // At once, so that the drive follows from the last reading.
            true => self.supervise(now_us, actions),
            false => self.end(now_us, ActuationOutcome::Complete, actions),
        }
    }

    /// The motion that was just accepted is driven only from now on: something else had to be done first.
    pub fn begin_late(&mut self, now_us: u64) {
        let from_us = now_us.max(self.brake_until_us);
        if let Some(motion) = &mut self.motion {
            let late_us = from_us.saturating_sub(motion.from_us);
            motion.started_us += late_us;
            motion.deadline_us += late_us;
            motion.drive_from(from_us);
        }
    }

    /// Ends a motion by request.
    pub(crate) fn stop(&mut self, now_us: u64, outcome: ActuationOutcome, actions: &mut Actions) {
        if self.is_moving() {
            self.end(now_us, outcome, actions);
        }
    }

    /// Latches the fault, and ends the motion if there is one.
    pub(crate) fn fail(&mut self, now_us: u64, fault: CapsuleFault, actions: &mut Actions) {
        if self.fault == Some(fault)
            || matches!(
                self.fault,
                Some(CapsuleFault::Watchdog | CapsuleFault::Panic)
            )
        {
            return; // what ended the firmware's last run must be acknowledged under its own name
        }
        match fault {
            CapsuleFault::EncoderLost | CapsuleFault::SenseOrEncoder => self.known.lose(),
            // At rest nothing has moved, and the fold was judged correctly.
            CapsuleFault::EStopFrame => {}
            _ => self.known.felt = false,
        }
        self.stop(now_us, ActuationOutcome::Faulted(fault), actions);
        self.fault = Some(fault);
        actions.emit(CapsuleEvent::Faulted(fault));
    }

    fn end(&mut self, now_us: u64, outcome: ActuationOutcome, actions: &mut Actions) {
        // An undriven motor needs no brake.
        if self.drive != Drive::Off {
            self.brake_until_us = now_us.saturating_add(BRAKE_US);
        }
        self.motion = None;
        self.recorder.end(outcome, self.thread());
        actions.emit(CapsuleEvent::Ended {
            actuation: self.actuation(),
            outcome,
        });
    }

    fn wanted_drive(&self, now_us: u64) -> Drive {
        match &self.motion {
            Some(motion) if now_us >= motion.from_us => match motion.effort {
                None => Drive::Brake,
                Some(drive_mv) => {
                    Drive::Millivolts(motion.phase.spooling.along(drive_mv.into()) as i16)
                }
            },
            _ if now_us < self.brake_until_us => Drive::Brake,
            _ => Drive::Off,
        }
    }

    /// The count at which no thread was on the spool, as far as it is counted.
    pub fn zero(&self) -> Counts {
        self.sample.counts - self.thread().counts()
    }

    /// It stands at an end: a partial fold and a fold have nothing to do there.
    pub(crate) fn is_near(&self, place: Thread) -> bool {
        (self.thread() - place).0.abs() <= NEAR.0
    }
}

impl Motion {
    fn calibrates(&self) -> bool {
        self.kind == ActuationKind::Calibrate
    }

    /// Drives the phase from this time on, and begins to watch it.
    fn drive_from(&mut self, from_us: u64) {
        self.from_us = from_us;
        self.guards = Guards::new(self.phase.spooling, from_us, self.rest_mv);
    }
}

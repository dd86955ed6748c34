//! The capsule's state machine. Pure: time and sensors in, drive and events out.
//!
//! At rest the state follows from what is [known](crate::known). A motion is a list of phases. Between two, and after the
//! last, the motor is shorted for [`BRAKE_US`]. Then the bridge sleeps and the worm holds.

use crate::feel::{Feel, MOST_NO_LOAD_MA};
use crate::guards::Guards;
use crate::known::{Known, RECORDED_EACH};
use crate::phase::{Goal, Phase};
use crate::record::Recorder;
use crate::sense::Sample;
use crate::settings::Settings;
use crate::speed::{Drive, SpeedLoop};
use crate::units::{NEAR, Spooling, Thread};
use protocol::capsule::ActuationKind::{
    self, Calibrate, CheckFolded, Fold, FoldTo, Reference, Unfold,
};
use protocol::capsule::{
    ActuationOutcome, ActuationRecord, CapsuleEvent, CapsuleFault, CapsuleState,
};
use protocol::error::Refusal;

/// Time that the motor is shorted after each phase: six of its time constants.
pub const BRAKE_US: u64 = 40_000;
/// The folded end lies this far before the place where the end force was felt: a fold need not pull that hard.
const BEFORE_THE_FORCE: Thread = Thread(100);

/// The motions as lists of phases.
fn phases(kind: ActuationKind, is_folded: bool) -> &'static [Goal] {
    use Goal::{Home, Place, RunUp, Seek, Slacken, Tighten};
    match kind {
        Calibrate => &[Seek, RunUp, Goal::Fold, Slacken, Tighten, Home],
        // The first three repeat until the thread pulls as calibrated.
        Reference => &[Place, Slacken, Tighten, Home],
        CheckFolded => &[Slacken, Tighten],
        Fold => &[RunUp, Goal::Fold, Slacken, Tighten],
        Unfold if is_folded => &[Slacken, Tighten, Home],
        Unfold => &[Home],
        FoldTo => &[Place],
    }
}

/// An input of the state machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// New readings, every 1 ms while the bridge is awake.
    Sample(Sample),
    /// Begin a motion. Only a partial fold goes to the length of thread.
    Begin(ActuationKind, Thread),
    /// End the motion; never refused.
    Stop,
    /// No valid frame has come for longer than the link's time-out.
    LinkSilent,
    /// End the motion and latch this; never refused.
    Fail(CapsuleFault),
    /// Clear the fault.
    Acknowledge,
}

/// Output of a step, for the caller to carry out.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Actions {
    /// Events to record and send, in this order.
    pub events: heapless::Vec<CapsuleEvent, 3>,
    /// Reason why the order was refused.
    pub refusal: Option<Refusal>,
    /// Record to write to flash now, for a start while this motion goes on.
    pub keep: Option<Known>,
}

#[derive(Clone, Debug)]
struct Motion {
    kind: ActuationKind,
    phase: Phase,
    /// The phases after it.
    next: &'static [Goal],
    /// The place that the motion is about: the folded end, or where a partial fold ends.
    top: Thread,
    feel: Feel,
    /// Thread at the last record in flash.
    recorded: Thread,
    deadline_us: u64,
    /// Battery voltage before the drive.
    rest_mv: u16,
}

#[derive(Clone, Debug, Default)]
pub struct Capsule {
    motion: Option<Motion>,
    /// Of the present phase. Too large to be moved with the motion in each step.
    guards: Guards,
    speed: SpeedLoop,
    /// The latched fault. No motion then.
    pub fault: Option<CapsuleFault>,
    pub known: Known,
    /// The amplifier's offset before the last motion, for comparison with the one after it.
    pub(crate) offset_before_ma: i16,
    pub sample: Sample,
    /// Time of the last event.
    pub(crate) now_us: u64,
    /// Output of the present step.
    actions: Actions,
    /// For the bridge from the last step on.
    pub drive: Drive,
    /// The motor is shorted until then, and driven from then on by a motion.
    pub(crate) brake_until_us: u64,
    /// Not to be changed during a motion.
    pub settings: Settings,
    recorder: Recorder,
}

impl Capsule {
    /// A started device. `fault` ended the previous run of the firmware, if one did; `known` comes from flash.
    pub fn new(fault: Option<CapsuleFault>, known: Known, settings: Settings) -> Self {
        Self {
            fault,
            known,
            settings,
            ..Self::default()
        }
    }

    pub fn state(&self) -> CapsuleState {
        let Some(motion) = &self.motion else {
            return match self.fault {
                Some(_) => CapsuleState::Faulted,
                None => self.known.state(self.thread()),
            };
        };
        match (motion.kind, motion.phase.spooling) {
            (Reference | Calibrate, _) => CapsuleState::Referencing,
            (CheckFolded, _) => CapsuleState::Checking,
            (Fold, _) | (FoldTo, Spooling::Wind) => CapsuleState::Folding,
            (Unfold | FoldTo, _) => CapsuleState::Unfolding,
        }
    }

    /// The motor may be driven.
    pub fn is_moving(&self) -> bool {
        self.motion.is_some()
    }

    /// Nothing moves, and the bridge sleeps.
    pub fn rests(&self) -> bool {
        !self.is_moving() && self.drive == Drive::Off
    }

    /// Thread on the spool at the last sample, at least.
    pub fn thread(&self) -> Thread {
        self.known.thread(self.sample.counts)
    }

    pub fn record(&self) -> ActuationRecord {
        self.recorder.record()
    }

    pub fn actuation(&self) -> u32 {
        self.recorder.record.actuation
    }

    /// Takes one event. `now_us` must not run backwards; if it does, the machine keeps its last time.
    pub fn step(&mut self, now_us: u64, event: Event) -> Actions {
        self.now_us = self.now_us.max(now_us);
        match event {
            Event::Sample(sample) => self.on_sample(sample),
            Event::Begin(kind, to) => self.actions.refusal = self.on_order(kind, to).err(),
            Event::Stop => self.end(ActuationOutcome::Stopped),
            Event::LinkSilent => self.end(ActuationOutcome::LinkLost),
            Event::Fail(fault) => self.fail(fault),
            Event::Acknowledge => self.actions.refusal = self.acknowledge().err(),
        }
        self.drive = match &self.motion {
            _ if self.now_us < self.brake_until_us => Drive::Brake,
            Some(motion) => self.speed.drive(motion.phase.spooling),
            None => Drive::Off,
        };
        core::mem::take(&mut self.actions)
    }

    fn on_sample(&mut self, sample: Sample) {
        self.sample = sample;
        if let Some(motion) = self.motion.take() {
            self.supervise(motion);
        }
        self.watch_offset();
        if self.is_moving() || self.now_us < self.brake_until_us {
            self.recorder.record.thread_um = self.thread().0;
        }
    }

    /// Judges the last sample of a motion, and has the speed loop set the drive until the next.
    fn supervise(&mut self, mut motion: Motion) {
        let (sample, drive_mv) = (&self.sample, self.drive.millivolts());
        (self.recorder).sample(self.now_us, sample, drive_mv, motion.rest_mv);
        let goes_on = self.judge(&mut motion);
        if self.now_us >= self.brake_until_us {
            let aim = motion.phase.aim(self.thread());
            let (speeds, battery_mv) = (self.guards.speeds_cps(), self.sample.battery_mv);
            self.speed.step(aim, speeds, battery_mv, &self.settings);
        }
        self.motion = Some(motion);
        match goes_on {
            Ok(true) => {}
            Ok(false) => self.end(ActuationOutcome::Complete),
            Err(fault) => self.fail(fault),
        }
    }

    /// Judges the last sample: the guards first, then where the phase is. False at the end of the motion.
    fn judge(&mut self, motion: &mut Motion) -> Result<bool, CapsuleFault> {
        let (now_us, thread, spooling) = (self.now_us, self.thread(), motion.phase.spooling);
        if now_us < self.brake_until_us {
            return Ok(true);
        }
        let mut stands = self.guards.check(now_us, &self.sample, self.drive)?;
        if let Some(current_ua) = self.guards.steady_ua() {
            stands |= self.measure(motion, current_ua);
        }
        if now_us >= motion.deadline_us {
            return Err(CapsuleFault::Timeout);
        }
        if (motion.phase).judge(thread, self.guards.runs_on(), stands)? {
            self.conclude(motion)?;
            return Ok(self.go_on(motion));
        }
        if (thread - motion.recorded).0.abs() >= RECORDED_EACH.0 {
            motion.recorded = thread;
            self.actions.keep = Some(self.known.moving(self.sample.counts, spooling));
        }
        Ok(true)
    }

    /// Takes the steady current of a driven motor. True if it is the end force, which ends a phase like a standstill.
    fn measure(&mut self, motion: &mut Motion, current_ua: i32) -> bool {
        let (thread, goal, feel) = (self.thread(), motion.phase.goal, &mut motion.feel);
        feel.take(goal, thread, motion.top - thread, current_ua);
        let current_ma = u16::try_from(current_ua / 1_000).unwrap_or(0);
        let known = (self.known.calibration).map(|known| known.no_load_ma);
        let no_load_ma = feel.no_load_ma().or(known).unwrap_or(MOST_NO_LOAD_MA);
        let excess_ma = i32::from(current_ma) - i32::from(no_load_ma);
        let winds = motion.phase.spooling == Spooling::Wind;
        let winds_us = u64::from(winds) * (self.now_us - self.brake_until_us);
        (self.recorder).current(current_ma, excess_ma, winds_us, thread);
        goal == Goal::Seek && excess_ma >= self.settings.end_force_ma.into()
    }

    /// Judges what a phase that is over has measured.
    fn conclude(&mut self, motion: &mut Motion) -> Result<(), CapsuleFault> {
        use CapsuleFault::{Jam, NotUnfolded, SlipOrBreak};
        let (thread, shortest) = (self.thread(), self.settings.folded_range.0);
        let (thread_um, wound_um, feel) = (thread.0, thread.0, &mut motion.feel);
        match (motion.phase.goal, motion.kind, &self.known.calibration) {
            (Goal::Seek, ..) if thread < shortest => return Err(NotUnfolded { wound_um }),
            (Goal::Seek, ..) => {
                motion.top = thread - BEFORE_THE_FORCE;
                feel.back_emf = self.guards.back_emf;
            }
            (Goal::Tighten, Calibrate, _) => {
                self.known.calibration = Some(feel.calibration(motion.top)?);
            }
            (Goal::Tighten, Reference, Some(known)) => match feel.winds_on(known) {
                Some(further) => {
                    motion.top = motion.top + further;
                    motion.next = phases(Reference, false);
                    let may_pull = motion.top <= self.known.end() + NEAR;
                    may_pull.then_some(()).ok_or(SlipOrBreak)?;
                }
                None if feel.is_origami(known) => self.known.referenced(motion.top),
                None => return Err(Jam { thread_um }),
            },
            (Goal::Tighten, Fold | CheckFolded | Unfold, Some(known)) => {
                let holds = feel.holds(known, motion.kind == Fold);
                holds.then_some(()).ok_or(SlipOrBreak)?;
                self.known.felt = motion.kind != Unfold;
            }
            _ => {}
        }
        Ok(())
    }

    /// Begins the next phase that is not over before it begins. False after the last.
    fn go_on(&mut self, motion: &mut Motion) -> bool {
        let thread = self.thread();
        let phase = loop {
            let Some((goal, next)) = motion.next.split_first() else {
                return false;
            };
            motion.next = next;
            let phase = Phase::new(*goal, thread, motion.top, &self.settings);
            if phase.remaining(thread) > Thread(0) {
                break phase;
            }
        };
        self.brake();
        self.actions.keep = Some(self.known.moving(self.sample.counts, phase.spooling));
        (motion.phase, motion.recorded) = (phase, thread);
        self.speed = SpeedLoop::default();
        let mut settings = self.settings;
        if let Some(known) = self.known.calibration.filter(|_| motion.kind != Calibrate) {
            settings.back_emf_uv_per_cps = known.back_emf_uv_cps.into();
        }
        self.guards = Guards::new(phase.spooling, motion.rest_mv, settings);
        true
    }

    /// Begins a motion, which was accepted.
    pub(crate) fn begin(&mut self, order: ActuationKind, target: Thread) {
        let (kind, is_folded) = (self.meant(order), self.state() == CapsuleState::Folded);
        if kind == Calibrate {
            self.known.unfolded_here(self.sample.counts);
        }
        let (thread, rest_mv) = (self.thread(), self.sample.battery_mv);
        let top = match kind {
            FoldTo => target,
            Reference => self.known.end() - self.known.uncertainty.unwrap_or_default(),
            Unfold | CheckFolded if is_folded => thread,
            _ => self.known.end(),
        };
        self.known.felt = false;
        self.offset_before_ma = self.sample.offset_ma;
        let from_us = self.now_us.max(self.brake_until_us);
        let mut motion = Motion {
            kind,
            phase: Phase::new(Goal::Place, thread, thread, &self.settings),
            next: phases(kind, is_folded),
            top,
            feel: Feel::default(),
            recorded: thread,
            deadline_us: from_us + u64::from(self.settings.timeout_ms(kind)) * 1_000,
            rest_mv,
        };
        // The record has the name of the order.
        self.recorder.start(self.now_us, order, thread, rest_mv);
        let (actuation, kind) = (self.actuation(), order);
        self.emit(CapsuleEvent::Started { actuation, kind });
        let goes_on = self.go_on(&mut motion);
        self.motion = Some(motion);
        if !goes_on {
            self.end(ActuationOutcome::Complete);
        }
    }

    /// Latches the fault, and ends the motion if there is one.
    pub(crate) fn fail(&mut self, fault: CapsuleFault) {
        let crash = [Some(CapsuleFault::Watchdog), Some(CapsuleFault::Panic)];
        if self.fault == Some(fault) || crash.contains(&self.fault) {
            return; // what ended the firmware's last run must be acknowledged under its own name
        }
        match fault {
            CapsuleFault::EncoderLost | CapsuleFault::SenseOrEncoder => self.known.lose(),
            // At rest nothing has moved, and the fold was judged correctly.
            CapsuleFault::EStopFrame => {}
            _ => self.known.felt = false,
        }
        self.end(ActuationOutcome::Faulted(fault));
        self.fault = Some(fault);
        self.emit(CapsuleEvent::Faulted(fault));
    }

    /// Ends a motion, if there is one.
    fn end(&mut self, outcome: ActuationOutcome) {
        if self.motion.take().is_none() {
            return;
        }
        self.brake();
        let (actuation, thread_um) = (self.actuation(), self.thread().0);
        let record = &mut self.recorder.record;
        (record.outcome, record.thread_um) = (outcome, thread_um);
        self.emit(CapsuleEvent::Ended { actuation, outcome });
    }

    fn emit(&mut self, event: CapsuleEvent) {
        // The capacity suffices: one step emits at most a start, an end and a fault.
        let _ = self.actions.events.push(event);
    }

    /// Shorts the motor, unless the bridge sleeps.
    fn brake(&mut self) {
        let brake_us = u64::from(self.drive != Drive::Off) * BRAKE_US;
        self.brake_until_us = self.brake_until_us.max(self.now_us + brake_us);
    }
}

//! The capsule's state machine: reference, fold, unfold. Pure: time and sensors in, drive and events out.
//!
//! | state | event \[guard\] | next |
//! |---|---|---|
//! | any at rest | Reference \[battery, amplifier\] | Referencing |
//! | any at rest | Calibrate \[not wound, as far as known; battery, amplifier\] | Referencing |
//! | Unfolded, Stopped | Fold \[battery, amplifier\] | Folding |
//! | Unfolded, Folded, Stopped | FoldTo \[calibration, battery, amplifier\] | Folding or Unfolding |
//! | Folded, Stopped | Unfold \[battery, amplifier\] | Unfolding |
//! | any at rest | CheckFolded \[calibration, battery, amplifier\] | Checking |
//! | any at rest | Reference, Fold, ... \[amplifier shows a current\] | Faulted |
//! | Referencing | zero found and reached | Unfolded |
//! | Folding | end force at the calibrated end | Folded; WasFolded if the end has wandered |
//! | Folding, Unfolding | where a partial fold was to stop | Stopped |
//! | Checking | end force | Folded |
//! | Unfolding | zero reached | Unfolded |
//! | Folding, Unfolding | Stop, link silent | Stopped |
//! | Referencing, Checking | Stop, link silent | Unreferenced; Stopped if the zero is known, or a first calibration has wound |
//! | any | EStop | Faulted |
//! | moving | trip, jam, broken thread, time-out | Faulted |
//! | Faulted | Acknowledge \[cause gone\] | Stopped; Unreferenced if it costs the position; WasFolded after an EStop at rest |
//!
//! A reference of a capsule without a calibration is a calibration: both have to begin unfolded then. A calibration that
//! begins where a reference run may have left thread on the spool, and finds the end as much earlier, is NotUnfolded.
//!
//! The motor is driven only while it moves. Each motion ends with the motor shorted for [`BRAKE_US`]. Then the bridge
//! sleeps and the worm gear holds.
//!
//! [`leg`](crate::leg) says how each motion is driven, where it ends, and how the zero is found.

mod measures;
mod orders;

use crate::calibration::Calibration;
use crate::circuit::Circuit;
use crate::detect::{Detector, Load, Trip};
use crate::governor::{Effort, Governor};
use crate::leg::{Decision, Leg, Purpose, Rise, STOP_MARGIN, is_near};
use crate::mechanics::{Counts, FOUND_AGAIN, FOUND_BY_RISE, Thread};
use crate::record::Recorder;
use crate::sample::{Sample, Spooling};
use crate::settings::Settings;
use measures::{Drift, FRICTION_FORCE, Mean, drawn_ma};
use protocol::{
    capsule::{
        ActuationKind, ActuationOutcome, ActuationRecord, CapsuleEvent, CapsuleFault, CapsuleState,
    },
    error::Refusal,
};

/// Time that the motor is shorted after a motion: six of its time constants.
pub const BRAKE_US: u64 = 40_000;
/// Longest time that a motor is shorted after it has met something hard.
const STRUCK_BRAKE_US: u64 = 10_000;
/// Stop braking at this speed, counts/s, 3.7 mm/s, so that a false alarm cannot stall the motor: starting from
/// standstill takes more than the end force.
const STRUCK_CPS: i32 = 3_000;
/// Above this speed, counts/s, drive the motor against its direction instead of shorting it. The speed is 2 ms old
/// and falls by 3 counts/ms per ms.
const PLUGGED_CPS: i32 = 4_500;
/// Internal resistance of a good cell, used until it is measured.
const CELL_MILLIOHM: u32 = 500;
/// Minimum current from the cell for measuring its resistance.
const LOAD_MA: u32 = 50;
/// Current above the no-load current at which the thread pulls: 0.3 N.
const ENGAGED_MA: u16 = 7;
/// Time limit of a reference: two slow windings of 28.5 mm, 5.7 s each, and paying out twice.
pub const REFERENCE_TIMEOUT_MS: u32 = 16_000;
/// Thread on the spool with which a calibration is refused, unless it is unfolded: below that it begins near enough.
const WOUND: Thread = Thread(1_000);
/// Least distance of a partial fold from either end: the ends have motions of their own.
pub const PARTIAL_MARGIN: Thread = Thread(500);

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
    /// Take this position as the unfolded end and measure the way to the end force.
    Calibrate,
    /// Wind gently to the end force, and stay there.
    CheckFolded,
    /// Find the zero.
    Reference,
    /// Wind to the end force.
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
    /// Calibration to write to flash, as soon as the bridge sleeps.
    pub calibrated: Option<Calibration>,
}

impl Actions {
    fn emit(&mut self, event: CapsuleEvent) {
        // The capacity suffices: one step emits at most a start, an end and a fault.
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
    /// Thread at which the motion, or the feeling of its end, began, plus the stop margin of a partial winding.
    from: Thread,
    started_us: u64,
    deadline_us: u64,
    governor: Governor,
    effort: Effort,
    /// The end force is near. Kept for the hysteresis.
    near: bool,
    /// The motor has met something: braked until this time.
    struck_until_us: u64,
    /// Battery voltage before the drive.
    rest_mv: u16,
    /// Count at the start if the thread was slack there; the current that follows is then the no-load current.
    slack_from: Option<Counts>,
    slack: Mean,
    /// Current while winding at the folded end, before the taut thread is paid out.
    winding_ma: Option<u16>,
    /// Current while paying out the taut thread.
    taut: Mean,
    /// Pull just before the calibrated end over the calibration's pull there, in thousandths.
    share: Mean,
    /// Extensions left for the tension zone.
    prolongations: u8,
    circuit: Circuit,
    /// Back-EMF that a calibration has measured on its way to the folded end.
    back_emf_uv_cps: u16,
    /// Length and rise that a calibration has found; its tension is measured afterwards.
    found: Option<(Thread, Rise)>,
    /// The calibration that this motion has made is in force.
    calibrated: bool,
    /// The zero was known when the motion began.
    zero_known: bool,
    /// Settings with the end force scaled to this motion's friction.
    settings: Settings,
}

/// The state machine.
#[derive(Clone, Debug)]
pub struct Capsule {
    mode: Mode,
    referenced: bool,
    /// The amplifier's offset before the last motion, for comparison with the one after it.
    offset_before_ma: i16,
    /// Count at thread zero.
    zero: Counts,
    /// Safety margin: the thread at the folded end may be this much shorter than calibrated.
    spare: Thread,
    /// How much later than calibrated the last fold felt its force. Either the friction has changed or the count has
    /// moved. Nothing tells which, so an unfolding ends this much before zero.
    doubt: Thread,
    /// How far the folded end has crept past the calibrated one: thread and origami stretch with time.
    crept: Thread,
    sample: Sample,
    sample_us: u64,
    drive: Drive,
    brake_until_us: u64,
    no_load_ma: u16,
    calibration: Option<Calibration>,
    /// Where the thread was unfolded, as far as it was known before the position was lost without a defect: by an
    /// emergency stop, or a run that was cut short.
    unfolded_at: Option<Counts>,
    /// Internal resistance of the cell, as measured in the last motion under load.
    cell_milliohm: u32,
    /// The last motion before a reset or an emergency stop ended folded, and nothing has moved since.
    was_folded: bool,
    drift: Drift,
    settings: Settings,
    recorder: Recorder,
}

impl Capsule {
    /// A started device with an unknown position. `fault` is the fault that ended the previous run of the firmware,
    /// if one did. `calibration`, `folded` and `settings` come from flash; `folded` is the [`margin`](Self::margin) of
    /// the folded end at which the last motion has ended.
    pub fn new(
        fault: Option<CapsuleFault>,
        calibration: Option<Calibration>,
        folded: Option<Thread>,
        settings: Settings,
    ) -> Self {
        Self {
            mode: fault.map_or(Mode::Unreferenced, Mode::Faulted),
            referenced: false,
            offset_before_ma: 0,
            spare: folded.unwrap_or_default(),
            doubt: Thread(0),
            crept: Thread(0),
            zero: Counts(0),
            sample: Sample::default(),
            sample_us: 0,
            drive: Drive::Off,
            brake_until_us: 0,
            no_load_ma: calibration
                .map_or(settings.no_load_ma, |calibration| calibration.no_load_ma),
            calibration,
            unfolded_at: None,
            cell_milliohm: CELL_MILLIOHM,
            was_folded: folded.is_some(),
            drift: Drift::default(),
            settings,
            recorder: Recorder::new(),
        }
    }

    /// The state by its name in the protocol.
    pub fn state(&self) -> CapsuleState {
        match &self.mode {
            Mode::Unreferenced if self.was_folded => CapsuleState::WasFolded,
            Mode::Unreferenced => CapsuleState::Unreferenced,
            Mode::Unfolded => CapsuleState::Unfolded,
            Mode::Folded => CapsuleState::Folded,
            Mode::Stopped => CapsuleState::Stopped,
            Mode::Faulted(_) => CapsuleState::Faulted,
            Mode::Moving(actuation) => match actuation.kind {
                ActuationKind::Reference | ActuationKind::Calibrate => CapsuleState::Referencing,
                ActuationKind::CheckFolded => CapsuleState::Checking,
                ActuationKind::Fold => CapsuleState::Folding,
                ActuationKind::Unfold => CapsuleState::Unfolding,
                ActuationKind::FoldTo => match actuation.leg {
                    Leg::Wind { .. } => CapsuleState::Folding,
                    _ => CapsuleState::Unfolding,
                },
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

    /// Thread on the spool at the last sample. Counts from an arbitrary zero before the first reference.
    pub fn thread(&self) -> Thread {
        self.sample.counts.since(self.zero).thread()
    }

    /// Count at thread zero.
    pub fn zero(&self) -> Counts {
        self.zero
    }

    /// How much shorter than calibrated the thread at the folded end is believed.
    pub fn margin(&self) -> Thread {
        self.spare
    }

    /// The capsule's calibration, if it has one.
    pub fn calibration(&self) -> Option<&Calibration> {
        self.calibration.as_ref()
    }

    /// The last sample.
    pub fn sample(&self) -> &Sample {
        &self.sample
    }

    /// State of the bridge after the last event.
    pub fn drive(&self) -> Drive {
        self.drive
    }

    /// The settings in force.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Puts other settings in force. Not to be called during a motion.
    pub fn set_settings(&mut self, settings: Settings) {
        // Adopt a changed no-load current only if no calibration has measured it.
        if self.calibration.is_none() && settings.no_load_ma != self.settings.no_load_ma {
            self.no_load_ma = settings.no_load_ma;
        }
        self.settings = settings;
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
            ActuationKind::Reference | ActuationKind::Calibrate | ActuationKind::CheckFolded => {
                REFERENCE_TIMEOUT_MS
            }
            ActuationKind::Fold | ActuationKind::FoldTo => self.settings.fold_timeout_ms,
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
        }
        self.drive = self.wanted_drive(now_us);
        actions.drive = self.drive;
        actions
    }

    fn on_sample(&mut self, now_us: u64, sample: Sample, actions: &mut Actions) {
        if let (Drive::Millivolts(drive_mv), Mode::Moving(actuation)) = (self.drive, &self.mode) {
            // The last sample before a start is up to 100 ms old, but the motor was not driven then.
            let since_us = self.sample_us.max(actuation.started_us);
            self.recorder.add_energy(
                &sample,
                drive_mv,
                actuation.rest_mv,
                now_us.saturating_sub(since_us),
            );
        }
        self.sample = sample;
        self.sample_us = self.sample_us.max(now_us);
        self.supervise(now_us, actions);
        self.watch_offset(now_us, actions);
        self.govern(now_us);
        if self.is_moving() || now_us < self.brake_until_us {
            self.recorder.thread(self.thread());
        }
    }

    /// Asks the speed loop what to do until the next sample.
    fn govern(&mut self, now_us: u64) {
        let (thread, no_load_ma) = (self.thread(), self.no_load_ma);
        let Mode::Moving(actuation) = &mut self.mode else {
            return;
        };
        if now_us < actuation.detector.from_us() {
            return; // still braking from the motion before
        }
        let (cps, least_cps) = actuation.detector.speeds_cps();
        if now_us < actuation.struck_until_us && least_cps > STRUCK_CPS {
            actuation.effort = if least_cps > PLUGGED_CPS {
                actuation.governor.plug(least_cps, &self.settings)
            } else {
                actuation.governor.brake()
            };
            return;
        }
        let aim = actuation
            .leg
            .aim(thread, no_load_ma, actuation.near, &self.settings);
        let battery_mv = self.sample.battery_mv;
        let speeds = (cps, least_cps);
        actuation.effort = actuation
            .governor
            .step(aim, speeds, battery_mv, &self.settings);
    }

    /// Judges the last sample of a moving capsule.
    fn supervise(&mut self, now_us: u64, actions: &mut Actions) {
        if let Err(fault) = self.judge(now_us, actions) {
            self.fail(now_us, fault, actions);
        }
    }

    fn judge(&mut self, now_us: u64, actions: &mut Actions) -> Result<(), CapsuleFault> {
        let thread = self.thread();
        let driven = self.drive != Drive::Off;
        let Mode::Moving(actuation) = &mut self.mode else {
            return Ok(());
        };
        let duration_us = now_us.saturating_sub(actuation.started_us);
        self.recorder.update(duration_us, self.sample.battery_mv);
        if now_us < actuation.detector.from_us() {
            return Ok(()); // still braking from the motion before
        }
        let load = if driven && now_us > actuation.detector.from_us() {
            let ordered_ma = match self.drive {
                Drive::Millivolts(_) => actuation.governor.ordered_ma(),
                Drive::Brake | Drive::Off => None,
            };
            let checked = actuation.detector.check(
                now_us,
                &self.sample,
                ordered_ma,
                self.no_load_ma,
                &actuation.settings,
            );
            match (checked, actuation.leg) {
                // The motor cannot wind the thread with all its current, so the thread pulls.
                (Err(Trip::Blocked), Leg::Feel { .. }) => Load {
                    end_force: true,
                    stands: true,
                    ..Load::default()
                },
                (checked, _) => checked.map_err(|trip| fault_of(trip, thread))?,
            }
        } else {
            // The first sample of a leg was taken before its drive, so only its position counts.
            Load::default()
        };
        if let Some(excess_ma) = load.excess_ma {
            actuation.near = is_near(actuation.near, excess_ma, &actuation.settings);
            let current_ma = excess_ma.saturating_add(self.no_load_ma);
            self.recorder.current(current_ma);
            if let Drive::Millivolts(drive_mv) = self.drive {
                let drawn_ma = drawn_ma(current_ma, drive_mv, self.sample.battery_mv);
                if drawn_ma >= LOAD_MA {
                    let sag_mv = actuation.rest_mv.saturating_sub(self.sample.battery_mv);
                    self.cell_milliohm = u32::from(sag_mv) * 1_000 / drawn_ma;
                }
            }
            let winds = actuation.leg.spooling() == Spooling::Wind
                && !matches!(actuation.leg, Leg::Feel { .. });
            if winds && load.pull_ma >= Some(ENGAGED_MA) {
                self.recorder.engaged(thread);
            }
        }
        self.follow_friction(&load);
        self.compare(now_us, load.excess_ma.is_some())?;
        if !load.silent {
            self.measure(thread, load.excess_ma.is_some())?;
        }
        self.decide(now_us, load, actions)
    }

    fn decide(
        &mut self,
        now_us: u64,
        load: Load,
        actions: &mut Actions,
    ) -> Result<(), CapsuleFault> {
        let end = self.folded_end();
        let Mode::Moving(actuation) = &mut self.mode else {
            return Ok(());
        };
        let stopping = actuation.detector.stopping_distance();
        let counts = self.sample.counts;
        // Once a calibration has found its end, the end of the previous one no longer applies.
        let found = actuation.found.is_some();
        let zero_known = self.referenced || actuation.zero_known;
        let known = self.calibration.as_ref().filter(|_| !found);
        let known = known.map(|calibration| (calibration, end.filter(|_| zero_known)));
        let decided = actuation.leg.decide(
            counts,
            self.zero,
            load,
            stopping,
            (known, &actuation.settings),
        );
        // Accept no end if current and counts contradict each other: one of them has found it.
        let ends = matches!(
            decided,
            Err(_) | Ok(Decision::Folded | Decision::EndFound { .. })
        );
        if ends && self.circuit_disagrees() {
            return Err(CapsuleFault::SenseOrEncoder);
        }
        let may_have_slipped = self.may_have_slipped();
        let pulls_as_felt = self.pulls_as_felt(now_us, &load);
        let Mode::Moving(actuation) = &mut self.mode else {
            return Ok(());
        };
        let next = match decided? {
            decision if decision.goes_on() && now_us >= actuation.deadline_us => {
                return Err(CapsuleFault::Timeout);
            }
            Decision::Continue => return Ok(()),
            Decision::Careful(leg) => {
                actuation.leg = leg;
                if load.struck {
                    actuation.struck_until_us = now_us.saturating_add(STRUCK_BRAKE_US);
                }
                return Ok(());
            }
            Decision::Reverse(leg) => leg,
            Decision::Felt(leg) => {
                actuation.winding_ma = actuation.detector.mean_ma();
                leg
            }
            Decision::EndFound {
                wound,
                rise,
                purpose,
            } => match self.end_found(wound, rise, purpose)? {
                Some(leg) => leg,
                None => {
                    self.end(now_us, Mode::Folded, ActuationOutcome::Complete, actions);
                    return Ok(());
                }
            },
            Decision::Folded if may_have_slipped => self.feels_again(),
            Decision::Folded => {
                self.folded(now_us, actions);
                return Ok(());
            }
            // The folded thread pulls as it did at the calibration: wind back to the start.
            Decision::Arrived if ends_folded(actuation.kind) => {
                match actuation.leg.spooling() {
                    Spooling::PayOut => {
                        // Without a tension nothing shows that the thread holds.
                        if actuation.leg.measures_tension() {
                            return Err(CapsuleFault::SlipOrBreak);
                        }
                        // Allow the largest end force: friction must not end the way back. It is as slow as near the end
                        // from its start: a motor that is braked for that late has no reading when it is back.
                        actuation.settings = Settings {
                            near_ma: (0, 0),
                            ..self.settings.with_force(FRICTION_FORCE.1)
                        };
                        Leg::Wind {
                            end: end.unwrap_or_default(),
                            careful: true,
                            short: Some(actuation.from),
                        }
                    }
                    Spooling::Wind => {
                        match pulls_as_felt {
                            Some(true) => self.folded(now_us, actions),
                            Some(false) => return Err(CapsuleFault::SlipOrBreak),
                            None => {}
                        }
                        return Ok(());
                    }
                }
            }
            Decision::Arrived if actuation.kind != ActuationKind::Unfold => {
                self.end(now_us, Mode::Stopped, ActuationOutcome::Complete, actions);
                return Ok(());
            }
            Decision::Arrived | Decision::Unfolded => {
                // The tension was not measured, so nothing shows that the thread holds.
                if actuation.leg.measures_tension() {
                    return Err(CapsuleFault::SlipOrBreak);
                }
                self.end(now_us, Mode::Unfolded, ActuationOutcome::Complete, actions);
                return Ok(());
            }
        };
        let Mode::Moving(actuation) = &mut self.mode else {
            return Ok(());
        };
        // Brake the motor first, then drive it the other way.
        let from_us = now_us.saturating_add(BRAKE_US);
        self.brake_until_us = from_us;
        actuation.leg = next;
        actuation.detector = Detector::new(next.spooling(), from_us, actuation.rest_mv);
        actuation.governor = Governor::default();
        // The old leg's effort must not drive this one, should an order come before the next reading.
        actuation.effort = Effort::Brake;
        actuation.circuit = Circuit::default();
        actuation.near = matches!(next, Leg::Wind { .. });
        actuation.slack_from = None;
        Ok(())
    }

    /// Sets the zero once the end force has been found. Returns the next leg, if there is one.
    fn end_found(
        &mut self,
        wound: Thread,
        rise: Rise,
        purpose: Purpose,
    ) -> Result<Option<Leg>, CapsuleFault> {
        let folded = match (purpose, &self.calibration) {
            (Purpose::Reference | Purpose::Check { .. }, Some(calibration)) => calibration.folded,
            _ => {
                if wound < self.settings.folded_range.0 || self.misses_thread(wound) {
                    return Err(CapsuleFault::NotUnfolded { wound_um: wound.0 });
                }
                if let Mode::Moving(actuation) = &mut self.mode {
                    actuation.found = Some((wound, rise));
                }
                wound
            }
        };
        if let Mode::Moving(actuation) = &mut self.mode {
            actuation.winding_ma = actuation.detector.mean_ma();
            if purpose == Purpose::Calibrate {
                let constant = actuation.circuit.constant_uv_cps();
                if !Circuit::is_possible(constant, &self.settings) {
                    return Err(CapsuleFault::SenseOrEncoder);
                }
                actuation.back_emf_uv_cps = constant;
            }
        }
        // The end may be found earlier than the calibration found it. Believe the thread shorter then, so that an
        // unfolding ends before zero. Thread that this run has wound itself is certain.
        self.spare = match purpose {
            Purpose::Calibrate => Thread(0),
            // This end is where the last motion ended, which may have been at something in the way.
            Purpose::Check { believed: true } => Thread(self.spare.0.max(FOUND_AGAIN.0)),
            Purpose::Reference | Purpose::Check { .. } => {
                Thread((folded.0 - wound.0).clamp(FOUND_AGAIN.0, FOUND_BY_RISE.0))
            }
        };
        let believed = Thread(folded.0 - self.spare.0);
        let zero = self.sample.counts.back(believed.counts());
        self.recorder.zero_moved(self.zero.since(zero).thread());
        self.zero = zero;
        (self.drift, self.doubt) = (Drift::default(), Thread(0));
        // The new zero includes the creep, so the end is where the calibration found it.
        self.crept = Thread(0);
        // A calibration is complete only after its last part, the tension.
        self.referenced = purpose != Purpose::Calibrate;
        if matches!(purpose, Purpose::Check { .. }) {
            return Ok(None);
        }
        // The current of a motor that was just braked shows no pull: wind on from here to feel it.
        let reads = matches!(&self.mode, Mode::Moving(moving) if moving.winding_ma.is_some());
        Ok(Some(match reads {
            true => Leg::PayOut {
                to: Thread(0),
                taut_to: Some(self.taut_to()),
            },
            false => Leg::feel(self.sample.counts, Thread(0)),
        }))
    }

    /// Ends a motion at the folded end.
    fn folded(&mut self, now_us: u64, actions: &mut Actions) {
        let end = match &self.mode {
            // Thread at which the feeling of the end began.
            Mode::Moving(actuation) if actuation.winding_ma.is_some() => {
                Thread(actuation.from.0.saturating_sub(STOP_MARGIN.0))
            }
            _ => self.thread(),
        };
        self.end(now_us, Mode::Folded, ActuationOutcome::Complete, actions);
        if self.record().kind != ActuationKind::CheckFolded {
            self.watch_drift(end, actions);
        }
    }

    /// Whether a calibration found its end too early, in a capsule whose zero may be too high: its last reference run
    /// did not wind all the thread itself. The start of a calibration becomes the unfolded end, so thread left on the
    /// spool would never be paid out.
    fn misses_thread(&self, wound: Thread) -> bool {
        let kept = self.calibration.filter(|_| self.spare == FOUND_BY_RISE);
        kept.is_some_and(|kept| wound.0 < kept.folded.0 - FOUND_BY_RISE.0 / 2)
    }

    /// Latches the fault, and ends the motion if there is one.
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
        if keeps_position || fault == CapsuleFault::EStopFrame {
            self.cut_short();
        } else {
            // A thread that has slipped, or is exchanged now, is unfolded elsewhere.
            self.unfolded_at = None;
        }
        self.referenced &= keeps_position;
        // Nothing has moved, and the fold was judged correctly.
        self.was_folded |= matches!(self.mode, Mode::Folded) && fault == CapsuleFault::EStopFrame;
        if self.is_moving() {
            let outcome = ActuationOutcome::Faulted(fault);
            self.end(now_us, Mode::Faulted(fault), outcome, actions);
        }
        self.mode = Mode::Faulted(fault);
        actions.emit(CapsuleEvent::Faulted(fault));
    }

    fn end(&mut self, now_us: u64, mode: Mode, outcome: ActuationOutcome, actions: &mut Actions) {
        // An undriven motor needs no brake.
        if self.drive != Drive::Off {
            self.brake_until_us = now_us.saturating_add(BRAKE_US);
        }
        // The next start must find the calibration that is in force, whatever has ended the motion.
        if matches!(&self.mode, Mode::Moving(actuation) if actuation.calibrated) {
            actions.calibrated = self.calibration;
        }
        self.mode = mode;
        self.recorder.end(outcome, self.thread());
        actions.emit(CapsuleEvent::Ended {
            actuation: self.actuation(),
            outcome,
        });
    }

    fn wanted_drive(&self, now_us: u64) -> Drive {
        match &self.mode {
            Mode::Moving(actuation) if now_us >= actuation.detector.from_us() => {
                match actuation.effort {
                    Effort::Brake => Drive::Brake,
                    Effort::Millivolts(millivolts) => {
                        Drive::Millivolts(match actuation.leg.spooling() {
                            Spooling::Wind => millivolts,
                            Spooling::PayOut => -millivolts,
                        })
                    }
                }
            }
            _ if now_us < self.brake_until_us => Drive::Brake,
            _ => Drive::Off,
        }
    }
}

fn ends_folded(kind: ActuationKind) -> bool {
    matches!(kind, ActuationKind::Fold | ActuationKind::CheckFolded)
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
        Trip::BridgeSilent => CapsuleFault::BridgeSilent,
        Trip::SenseLost => CapsuleFault::SenseLost,
    }
}

#[cfg(test)]
#[path = "../tests/unit/fold.rs"]
mod tests;

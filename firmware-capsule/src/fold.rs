//! The capsule's state machine: reference, fold, unfold. Pure: time and sensors in, drive and events out.
//!
//! | state | event \[guard\] | next |
//! |---|---|---|
//! | any at rest | Calibrate, Reference \[battery, amplifier\] | Referencing |
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
//! | Referencing, Checking | Stop, link silent | Unreferenced; Stopped if the zero is known |
//! | any | EStop | Faulted |
//! | moving | trip, jam, broken thread, time-out | Faulted |
//! | Faulted | Acknowledge \[cause gone\] | Stopped, or Unreferenced if the fault costs the position |
//!
//! A reference of a capsule without a calibration is a calibration: both have to begin unfolded then.
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
use crate::leg::{Decision, Leg, Purpose, Rise, is_near};
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

/// How long the motor is shorted after a motion: six of its time constants.
pub const BRAKE_US: u64 = 40_000;
/// How long a motor that meets something hard is shorted at most.
const STRUCK_BRAKE_US: u64 = 10_000;
/// And down to this speed, counts/s, 3.7 mm/s: should it be a false alarm, it must not stand. From standstill it takes more
/// than the end force to start.
const STRUCK_CPS: i32 = 3_000;
/// While it is faster than this it is driven against its direction. The speed is 2 ms old, and falls by 3 counts/ms in each.
const PLUGGED_CPS: i32 = 4_500;
/// Internal resistance of a good cell, until it is measured.
const CELL_MILLIOHM: u32 = 500;
/// From this current out of the cell on its sag tells its resistance.
const LOAD_MA: u32 = 50;
/// Above the no-load current, the thread pulls: 0.3 N.
const ENGAGED_MA: u16 = 7;
/// Two slow windings of 28.5 mm, 5.7 s each, and two ways out.
pub const REFERENCE_TIMEOUT_MS: u32 = 16_000;
/// A partial fold is this far from either end: the ends have motions of their own.
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

/// What the host can order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Measure how far it is from here, the unfolded end, to the end force.
    Calibrate,
    /// Wind gently to the end force, and stay there.
    CheckFolded,
    /// Find the zero.
    Reference,
    /// Wind to the end force.
    Fold,
    /// Pay out to zero.
    Unfold,
    /// Wind or pay out to here.
    FoldTo(Thread),
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
    /// Keep this in flash, as soon as the bridge sleeps.
    pub calibrated: Option<Calibration>,
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
    /// Where it began, and as much more as a partial winding stops early.
    from: Thread,
    started_us: u64,
    deadline_us: u64,
    governor: Governor,
    effort: Effort,
    /// The end force is near.
    near: bool,
    /// Shorted until then: the motor has met something.
    struck_until_us: u64,
    /// Battery before the drive.
    rest_mv: u16,
    /// Where the thread was slack at the start, so that the first current is the no-load current.
    slack_from: Option<Counts>,
    slack: Mean,
    /// Current winding at the folded end, before a thread that must be taut is paid out.
    winding_ma: Option<u16>,
    /// Its current then.
    taut: Mean,
    /// Pull just before the calibrated end over what it was there, in thousandths.
    share: Mean,
    /// So often may the slow part that it is measured in be prolonged.
    prolongations: u8,
    circuit: Circuit,
    /// Back-EMF that a calibration has measured on its way to the end.
    back_emf_uv_cps: u16,
    /// A calibration that lacks its tension.
    found: Option<(Thread, Rise)>,
    /// With the end force that the friction of this motion asks for.
    settings: Settings,
}

/// The state machine.
#[derive(Clone, Debug)]
pub struct Capsule {
    mode: Mode,
    referenced: bool,
    /// The amplifier's offset before the last motion, until its zero has been looked at again.
    offset_before_ma: i16,
    /// Count at thread zero.
    zero: Counts,
    /// So much less thread than calibrated is believed to be wound at the folded end.
    spare: Thread,
    /// How much later than calibrated the last fold felt its force: by another friction, or because the count has moved. Nothing
    /// tells which, so an unfolding ends this much before zero.
    doubt: Thread,
    /// How much further on than calibrated the folded end is: thread and origami have become longer.
    crept: Thread,
    sample: Sample,
    sample_us: u64,
    drive: Drive,
    brake_until_us: u64,
    no_load_ma: u16,
    calibration: Option<Calibration>,
    /// Internal resistance of the cell, as the last motion under load has shown it.
    cell_milliohm: u32,
    /// The last motion of the run before ended folded, and nothing has moved since.
    was_folded: bool,
    drift: Drift,
    settings: Settings,
    recorder: Recorder,
}

impl Capsule {
    /// At the start of the device, position unknown. `fault` is what ended the last run of the firmware, if a
    /// fault did; `calibration`, whether it `was_folded`, and `settings` come from flash.
    pub fn new(
        fault: Option<CapsuleFault>,
        calibration: Option<Calibration>,
        was_folded: bool,
        settings: Settings,
    ) -> Self {
        Self {
            mode: fault.map_or(Mode::Unreferenced, Mode::Faulted),
            referenced: false,
            offset_before_ma: 0,
            spare: Thread(0),
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
            cell_milliohm: CELL_MILLIOHM,
            was_folded,
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

    /// Thread on the spool at the last sample. Before the first reference it counts from an arbitrary zero.
    pub fn thread(&self) -> Thread {
        self.sample.counts.since(self.zero).thread()
    }

    /// Count at thread zero.
    pub fn zero(&self) -> Counts {
        self.zero
    }

    /// What is known of this capsule.
    pub fn calibration(&self) -> Option<&Calibration> {
        self.calibration.as_ref()
    }

    /// The last sample.
    pub fn sample(&self) -> &Sample {
        &self.sample
    }

    /// The bridge's state after the last event.
    pub fn drive(&self) -> Drive {
        self.drive
    }

    /// What a person can change.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Other settings are in force. Not while it moves.
    pub fn set_settings(&mut self, settings: Settings) {
        // A measured current stays, unless somebody knows better.
        if self.calibration.is_none() && settings.no_load_ma != self.settings.no_load_ma {
            self.no_load_ma = settings.no_load_ma;
        }
        self.settings = settings;
    }

    /// The present or last actuation.
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

    fn on_sample(&mut self, now_us: u64, sample: Sample, actions: &mut Actions) {
        if let (Drive::Millivolts(drive_mv), Mode::Moving(actuation)) = (self.drive, &self.mode) {
            // The last sample before a start is up to 100 ms old, and the motor was not driven then.
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

    /// Judges the last sample while moving.
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
                // A thread that cannot be wound with all that the motor is given pulls.
                (Err(Trip::Blocked), Leg::Feel { .. }) => Load {
                    end_force: true,
                    ..Load::default()
                },
                (checked, _) => checked.map_err(|trip| fault_of(trip, thread))?,
            }
        } else {
            // The first sample of a leg was taken before its drive: only its position counts.
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
        let end = self.folded_end().unwrap_or_default();
        let Mode::Moving(actuation) = &mut self.mode else {
            return Ok(());
        };
        let stopping = actuation.detector.stopping_distance();
        let counts = self.sample.counts;
        let decided = actuation.leg.decide(
            counts,
            self.zero,
            load,
            stopping,
            (self.calibration.as_ref(), &self.settings),
        );
        // No end counts that was found by a current or by counts which disagree.
        let ends = matches!(
            decided,
            Err(_) | Ok(Decision::Folded | Decision::EndFound { .. })
        );
        if ends && self.circuit_disagrees() {
            return Err(CapsuleFault::SenseOrEncoder);
        }
        let Mode::Moving(actuation) = &mut self.mode else {
            return Ok(());
        };
        let next = match decided? {
            Decision::Continue if now_us >= actuation.deadline_us => {
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
                actuation.winding_ma = load.excess_ma.and(actuation.detector.mean_ma());
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
            Decision::Folded => {
                let drifts = actuation.kind != ActuationKind::CheckFolded;
                self.end(now_us, Mode::Folded, ActuationOutcome::Complete, actions);
                if drifts {
                    self.watch_drift(actions);
                }
                return Ok(());
            }
            // The folded thread pulls as it did: back to where it was.
            Decision::Arrived if actuation.kind == ActuationKind::CheckFolded => {
                match actuation.leg.spooling() {
                    Spooling::PayOut => {
                        // Whatever the friction asks for.
                        actuation.settings = self.settings.with_force(FRICTION_FORCE.1);
                        Leg::Wind {
                            end,
                            careful: true,
                            short: Some(actuation.from),
                        }
                    }
                    Spooling::Wind => {
                        self.end(now_us, Mode::Folded, ActuationOutcome::Complete, actions);
                        return Ok(());
                    }
                }
            }
            Decision::Arrived if actuation.kind != ActuationKind::Unfold => {
                self.end(now_us, Mode::Stopped, ActuationOutcome::Complete, actions);
                return Ok(());
            }
            Decision::Arrived | Decision::Unfolded => {
                if actuation.found.is_some() {
                    actions.calibrated = self.calibration;
                }
                self.end(now_us, Mode::Unfolded, ActuationOutcome::Complete, actions);
                return Ok(());
            }
        };
        let Mode::Moving(actuation) = &mut self.mode else {
            return Ok(());
        };
        // The motor is braked, then driven the other way.
        let from_us = now_us.saturating_add(BRAKE_US);
        self.brake_until_us = from_us;
        actuation.leg = next;
        actuation.detector = Detector::new(next.spooling(), from_us, actuation.rest_mv);
        actuation.governor = Governor::default();
        actuation.circuit = Circuit::default();
        actuation.near = false;
        actuation.slack_from = None;
        Ok(())
    }

    fn circuit_disagrees(&self) -> bool {
        let Mode::Moving(actuation) = &self.mode else {
            return false;
        };
        let known = self.known_back_emf();
        actuation.circuit.disagrees_now(known, &self.settings)
    }

    /// The end force has been found, so the zero is known; the leg that follows, if one does.
    fn end_found(
        &mut self,
        wound: Thread,
        rise: Rise,
        purpose: Purpose,
    ) -> Result<Option<Leg>, CapsuleFault> {
        let folded = match (purpose, &self.calibration) {
            (Purpose::Reference | Purpose::Check { .. }, Some(calibration)) => calibration.folded,
            _ => {
                if wound < self.settings.folded_range.0 {
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
        // The end may be found before where the calibration found it: the thread is believed shorter, so that an unfolding ends
        // before zero. What this run has wound itself is there.
        self.spare = match purpose {
            Purpose::Calibrate => {
                self.crept = Thread(0);
                Thread(0)
            }
            Purpose::Check { believed: true } => FOUND_AGAIN,
            Purpose::Reference | Purpose::Check { .. } => {
                Thread((folded.0 - wound.0).clamp(FOUND_AGAIN.0, FOUND_BY_RISE.0))
            }
        };
        let believed = Thread(folded.0 - self.spare.0);
        let zero = self.sample.counts.back(believed.counts());
        self.recorder.zero_moved(self.zero.since(zero).thread());
        self.zero = zero;
        (self.drift, self.doubt) = (Drift::default(), Thread(0));
        // A calibration counts only with its last part, the tension.
        self.referenced = purpose != Purpose::Calibrate;
        if matches!(purpose, Purpose::Check { .. }) {
            return Ok(None);
        }
        Ok(Some(Leg::PayOut {
            to: Thread(0),
            taut_to: Some(self.taut_to()),
        }))
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
        if self.drive != Drive::Off {
            self.brake_until_us = now_us.saturating_add(BRAKE_US);
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

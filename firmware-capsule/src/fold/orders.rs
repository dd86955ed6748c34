//! Orders of the host: checks them and begins the motions.

use super::{Actions, Actuation, Capsule, Command, Mode, WOUND, measures};
use crate::{
    circuit::Circuit,
    detect::Detector,
    governor::{Effort, Governor},
    leg::{Leg, MOST_MA, Purpose, STOP_MARGIN, TENSION_ZONE},
    mechanics::{Counts, Thread},
    sense::MOST_OFFSET_MA,
};
use protocol::{
    capsule::{ActuationKind, ActuationOutcome, CapsuleEvent, CapsuleFault},
    error::{Field, Refusal},
};

/// Voltage that a nearly empty cell loses over a fold and an unfolding.
const RESERVE_MV: u16 = 100;
/// Current at rest, beyond which the amplifier's output must lie at one end of its range.
const OPEN_MA: u16 = 1_000;
/// Largest change of the amplifier's zero over a motion: warming moves it by 5 mA.
const MOST_MOVED_MA: u16 = 7;
/// Distance within which a partial fold has arrived, um.
const ARRIVED: i32 = 100;
/// Thread that is paid out and wound again to feel a folded capsule: the tension zone with all its extensions, 1.9 mm, and
/// the way that the motor runs on.
const CHECKED: Thread = Thread(2_000);

fn out_of_range(thread: Thread, (least, most): (Thread, Thread)) -> Refusal {
    let count = |Thread(um)| u64::try_from(um).unwrap_or(0);
    Refusal::OutOfRange {
        field: Field::ThreadUm,
        requested: count(thread),
        min: count(least),
        max: count(most),
    }
}

impl Capsule {
    pub(super) fn on_command(
        &mut self,
        now_us: u64,
        command: Command,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        let kind = match command {
            Command::Reference => ActuationKind::Reference,
            Command::Calibrate => ActuationKind::Calibrate,
            Command::CheckFolded => ActuationKind::CheckFolded,
            Command::Fold => ActuationKind::Fold,
            Command::Unfold => ActuationKind::Unfold,
            Command::FoldTo(_) => ActuationKind::FoldTo,
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
            (
                Mode::Unreferenced,
                ActuationKind::Fold | ActuationKind::Unfold | ActuationKind::FoldTo,
            ) => {
                return Err(Refusal::NotReferenced);
            }
            (Mode::Folded, ActuationKind::Fold) | (Mode::Unfolded, ActuationKind::Unfold) => {
                return Err(Refusal::AlreadyThere);
            }
            (_, ActuationKind::Fold | ActuationKind::CheckFolded | ActuationKind::FoldTo)
                if self.calibration.is_none() =>
            {
                return Err(Refusal::NotCalibrated);
            }
            _ => {}
        }
        if let Command::FoldTo(target) = command {
            self.may_stop_at(target)?;
        }
        if self.is_calibration(kind) {
            self.may_calibrate()?;
        }
        let min_mv = match kind {
            // Paying out takes little current, and a person may need it.
            ActuationKind::Unfold => self.least_unfolding_mv(),
            _ => self.least_battery_mv(),
        };
        if self.sample.battery_mv < min_mv {
            return Err(Refusal::BatteryLow {
                battery_mv: self.sample.battery_mv,
                min_mv,
            });
        }
        if let Some(fault) = self.amplifier_fault() {
            self.fail(now_us, fault, actions);
            return Err(Refusal::CapsuleFaulted(fault));
        }
        let target = match command {
            Command::FoldTo(target) => target,
            _ => Thread(0),
        };
        self.start(now_us, kind, target, actions);
        Ok(())
    }

    pub(super) fn stop(&mut self, now_us: u64, outcome: ActuationOutcome, actions: &mut Actions) {
        if self.is_moving() {
            self.cut_short();
            let mode = self.resting_between_ends();
            self.end(now_us, mode, outcome, actions);
        }
    }

    /// Mode at rest between the ends. A reference run that is stopped after it has found the zero keeps its position.
    fn resting_between_ends(&self) -> Mode {
        if self.referenced {
            Mode::Stopped
        } else {
            Mode::Unreferenced
        }
    }

    /// Keeps what is known of the place where a motion is cut short. In a calibration that is not in force yet a known
    /// zero stays known. Otherwise the beginning is the zero if there is no calibration, because nothing else can lead
    /// back to it; if there is one, a reference run does, and tells whether the person was right.
    pub(super) fn cut_short(&mut self) {
        if self.referenced {
            self.unfolded_at = Some(self.zero);
        }
        let Mode::Moving(actuation) = &self.mode else {
            return;
        };
        let origin = match actuation.leg {
            Leg::Seek {
                origin,
                purpose: Purpose::Calibrate,
                ..
            } => origin,
            _ if actuation.found.is_some() && !actuation.calibrated => self.zero,
            _ => return,
        };
        self.unfolded_at = Some(origin);
        if actuation.zero_known {
            self.referenced = true;
        } else if self.calibration.is_none() && self.wound_since(origin) >= WOUND {
            self.recorder.zero_moved(self.zero.since(origin).thread());
            self.zero = origin;
            self.referenced = true;
        }
    }

    fn wound_since(&self, origin: Counts) -> Thread {
        self.sample.counts.since(origin).thread()
    }

    /// Refuses a calibration while thread is on the spool, as far as it is known: the calibration would take it for part
    /// of the unfolded end. An unfolding or a reference run pays it out.
    fn may_calibrate(&self) -> Result<(), Refusal> {
        let wound = match (&self.mode, self.unfolded_at) {
            (Mode::Folded | Mode::Stopped, _) => self.thread(),
            // Without a calibration only a hand can help, and what it does is not seen.
            (Mode::Unreferenced, Some(zero)) if self.calibration.is_some() => {
                self.wound_since(zero)
            }
            _ => Thread(0),
        };
        match wound >= WOUND {
            true => Err(out_of_range(wound, (Thread(0), WOUND))),
            false => Ok(()),
        }
    }

    fn is_calibration(&self, kind: ActuationKind) -> bool {
        kind == ActuationKind::Calibrate
            || kind == ActuationKind::Reference && self.calibration.is_none()
    }

    /// Refuses a partial fold whose target is too close to an end, or is the present position.
    pub(super) fn may_stop_at(&self, target: Thread) -> Result<(), Refusal> {
        let Thread(end_um) = self.folded_end().unwrap_or_default();
        // The count may be too high by what is doubted: paid out to less, it would pass zero.
        let min = self.doubt.0.max(super::PARTIAL_MARGIN.0);
        let max = end_um - super::PARTIAL_MARGIN.0;
        if !(min..=max).contains(&target.0) {
            return Err(out_of_range(target, (Thread(min), Thread(max))));
        }
        if self.thread().0.abs_diff(target.0) <= ARRIVED.unsigned_abs() {
            return Err(Refusal::AlreadyThere);
        }
        Ok(())
    }

    /// It stands folded, as far as it knows. No fault at rest unfolds it, but all except an emergency stop cast doubt on
    /// how the end was judged.
    pub fn is_folded(&self) -> bool {
        match &self.mode {
            Mode::Folded => true,
            Mode::Unreferenced | Mode::Faulted(_) => self.was_folded,
            _ => false,
        }
    }

    /// Believed position of the folded end.
    pub(super) fn folded_end(&self) -> Option<Thread> {
        let calibration = self.calibration.as_ref()?;
        Some(Thread(calibration.folded.0 - self.spare.0 + self.crept.0))
    }

    /// Minimum voltage at rest: keeps the cell above its limit under the end force for a fold and an unfolding.
    pub(super) fn least_battery_mv(&self) -> u16 {
        let sag_mv = self.cell_milliohm * u32::from(MOST_MA) / 1_000;
        let under_load_mv = u32::from(self.settings.loaded_battery_mv + RESERVE_MV) + sag_mv;
        u16::try_from(under_load_mv)
            .unwrap_or(u16::MAX)
            .max(self.settings.least_battery_mv)
    }

    /// Minimum voltage for unfolding alone, so that an almost empty cell cannot strand a capsule half folded.
    pub(super) fn least_unfolding_mv(&self) -> u16 {
        self.settings.loaded_battery_mv + RESERVE_MV
    }

    /// The amplifier shows a current at rest, so its readings under drive cannot be trusted.
    pub(super) fn amplifier_fault(&self) -> Option<CapsuleFault> {
        let current_ma = self.sample.offset_ma.unsigned_abs();
        match current_ma {
            ..=MOST_OFFSET_MA => None,
            OPEN_MA.. => Some(CapsuleFault::SenseLost),
            _ => Some(CapsuleFault::OverCurrent { current_ma }),
        }
    }

    /// Faults if the amplifier's zero has moved during a motion: its currents were then wrong, and so was everything
    /// judged by them.
    pub(super) fn watch_offset(&mut self, now_us: u64, actions: &mut Actions) {
        let judged_by_current = match self.mode {
            Mode::Moving(_) => false,
            Mode::Faulted(fault) => !matches!(
                fault,
                CapsuleFault::LowBattery { .. }
                    | CapsuleFault::DriverFault
                    | CapsuleFault::EStopFrame
                    | CapsuleFault::SenseLost
            ),
            _ => true,
        };
        let moved = self.sample.offset_ma.abs_diff(self.offset_before_ma);
        // A reading without a supply has measured neither battery nor zero.
        let measured = self.sample.battery_mv > 0;
        if judged_by_current
            && measured
            && self.actuation() > 0
            && now_us >= self.brake_until_us
            && moved > MOST_MOVED_MA
        {
            self.fail(now_us, CapsuleFault::SenseLost, actions);
        }
    }

    pub(super) fn acknowledge(&mut self) -> Result<(), Refusal> {
        let Mode::Faulted(fault) = self.mode else {
            return Err(Refusal::NothingToAcknowledge);
        };
        let persists = match fault {
            CapsuleFault::LowBattery { .. } => self.sample.battery_mv < self.least_unfolding_mv(),
            CapsuleFault::DriverFault => self.sample.driver_fault,
            CapsuleFault::OverCurrent { .. } | CapsuleFault::SenseLost => {
                self.amplifier_fault().is_some()
            }
            _ => false,
        };
        if persists {
            return Err(Refusal::CauseStillPresent);
        }
        self.offset_before_ma = self.sample.offset_ma;
        self.mode = self.resting_between_ends();
        Ok(())
    }

    /// Begins a motion. Only a partial fold uses `target`.
    pub(super) fn start(
        &mut self,
        now_us: u64,
        kind: ActuationKind,
        target: Thread,
        actions: &mut Actions,
    ) {
        let origin = self.sample.counts;
        let seek = |purpose| Leg::Seek {
            origin,
            second: false,
            purpose,
        };
        let calibrates = self.is_calibration(kind);
        let slack =
            calibrates || kind != ActuationKind::Reference && matches!(self.mode, Mode::Unfolded);
        let pay_out = |to: Thread| match self.mode {
            // Feel the pull first, unless the motion ends before the tension can be measured.
            Mode::Folded if to < self.taut_to() => Leg::feel(origin, to),
            _ => Leg::PayOut { to, taut_to: None },
        };
        let wind = |end, careful, short| Leg::Wind {
            end,
            careful,
            short,
        };
        let leg = match (kind, self.folded_end()) {
            (ActuationKind::Unfold, _) => pay_out(self.doubt),
            (ActuationKind::FoldTo, _) if target < self.thread() => pay_out(target),
            (ActuationKind::FoldTo, Some(end)) => wind(end, false, Some(target)),
            // A thread that is taut already is felt; to wind it further, blind at first, would tighten it each time.
            (ActuationKind::Fold | ActuationKind::CheckFolded, _) if self.stands_at_end() => {
                self.feel_folded()
            }
            (ActuationKind::Fold, Some(end)) => wind(end, false, None),
            (ActuationKind::CheckFolded, Some(end)) if self.referenced => wind(end, true, None),
            (ActuationKind::CheckFolded, _) => seek(Purpose::Check {
                believed: self.was_folded,
            }),
            _ if calibrates => seek(Purpose::Calibrate),
            _ => seek(Purpose::Reference),
        };
        if calibrates && !self.referenced {
            // Somebody may have pulled at the thread.
            self.spare = Thread(0);
        }
        let zero_known = self.referenced;
        if matches!(leg, Leg::Seek { .. }) {
            self.referenced = false;
            // The rise is compared with the calibration's, which was counted above this current. A thread that is not
            // quite slack pulls less after its first fold.
            if let Some(calibration) = self.calibration.as_ref().filter(|_| !calibrates) {
                self.no_load_ma = calibration.no_load_ma;
            }
        }
        self.was_folded = false;
        if calibrates {
            self.unfolded_at = None;
        } else if zero_known {
            self.unfolded_at = Some(self.zero);
        }
        self.offset_before_ma = self.sample.offset_ma;
        let from_us = now_us.max(self.brake_until_us);
        let timeout_us = u64::from(self.timeout_ms(kind)) * 1_000;
        self.mode = Mode::Moving(Actuation {
            kind,
            leg,
            detector: Detector::new(leg.spooling(), from_us, self.sample.battery_mv),
            from: Thread(self.comes_back_to().0.saturating_add(STOP_MARGIN.0)),
            started_us: now_us,
            deadline_us: from_us.saturating_add(timeout_us),
            governor: Governor::default(),
            effort: Effort::Millivolts(0),
            near: false,
            struck_until_us: 0,
            rest_mv: self.sample.battery_mv,
            slack_from: slack.then_some(origin),
            slack: measures::Mean::default(),
            winding_ma: None,
            taut: measures::Mean::default(),
            share: measures::Mean::default(),
            circuit: Circuit::default(),
            back_emf_uv_cps: 0,
            prolongations: measures::PROLONGATIONS,
            found: None,
            calibrated: false,
            zero_known,
            settings: self.settings_for(&leg),
        });
        self.recorder
            .start(kind, self.thread(), self.sample.battery_mv);
        actions.emit(CapsuleEvent::Started {
            actuation: self.actuation(),
            kind,
        });
        // Supervise at once: a leg that is already at its end never switches the motor on.
        self.supervise(now_us, actions);
        self.govern(now_us);
    }

    /// The thread is wound to its end, or further: an unfolding that was stopped at once has only wound a little.
    fn stands_at_end(&self) -> bool {
        let is_past = self.folded_end().is_some_and(|end| self.thread() >= end);
        matches!(self.mode, Mode::Folded) || self.referenced && is_past
    }

    /// Where a thread that is felt is wound to again: a folded one to where it was, one that was wound further to its
    /// end.
    fn comes_back_to(&self) -> Thread {
        match (&self.mode, self.folded_end()) {
            (Mode::Stopped, Some(end)) => self.thread().min(end),
            _ => self.thread(),
        }
    }

    /// The motion that was just accepted is driven only from now on: something else had to be done first.
    pub fn begin_late(&mut self, now_us: u64) {
        let from_us = now_us.max(self.brake_until_us);
        if let Mode::Moving(actuation) = &mut self.mode {
            let late_us = from_us.saturating_sub(actuation.detector.from_us());
            actuation.started_us = actuation.started_us.saturating_add(late_us);
            actuation.deadline_us = actuation.deadline_us.saturating_add(late_us);
            let spooling = actuation.leg.spooling();
            actuation.detector = Detector::new(spooling, from_us, actuation.rest_mv);
        }
    }

    /// Feels the folded thread, and winds it again to here afterwards.
    pub(super) fn feels_again(&mut self) -> Leg {
        let here = self.thread();
        if let Mode::Moving(actuation) = &mut self.mode {
            actuation.from = Thread(here.0.saturating_add(STOP_MARGIN.0));
        }
        self.feel_folded()
    }

    /// Feels whether the folded thread pulls: winds a little, then pays out `CHECKED`.
    fn feel_folded(&self) -> Leg {
        let to = Thread(self.thread().0.saturating_sub(CHECKED.0));
        Leg::feel(self.sample.counts, to)
    }

    /// Lower end of the tension zone, for a thread that is taut now.
    pub(super) fn taut_to(&self) -> Thread {
        Thread(self.thread().0.saturating_sub(TENSION_ZONE.0))
    }
}

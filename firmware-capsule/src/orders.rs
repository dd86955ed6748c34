//! Orders of the host: which motion each state accepts, and what has to be in order before it begins.

use crate::known::RESOLVABLE;
use crate::machine::Capsule;
use crate::sense::MOST_OFFSET_MA;
use crate::units::Thread;
use protocol::capsule::ActuationKind::{
    self, Calibrate, CheckFolded, Fold, FoldTo, Reference, Unfold,
};
use protocol::capsule::CapsuleFault::{self, DriverFault, EStopFrame, LowBattery, SenseLost};
use protocol::capsule::CapsuleState::{Folded, Unfolded, Unreferenced};
use protocol::error::{Field, Refusal};

/// Largest change of the amplifier's zero over a motion: warming moves it by 5 mA.
const MOST_MOVED_MA: u16 = 7;
/// What is nearer to an end belongs to it: a calibration may begin there, and a partial fold may not go there.
const END: Thread = Thread(500);

fn out_of_range(thread: Thread, least: Thread, most: Thread) -> Result<(), Refusal> {
    let [requested, min, max] = [thread, least, most].map(|of| of.0.max(0).unsigned_abs().into());
    Err(Refusal::OutOfRange {
        field: Field::ThreadUm,
        requested,
        min,
        max,
    })
}

impl Capsule {
    /// Begins a motion, if everything is in order.
    pub(crate) fn on_order(&mut self, kind: ActuationKind, target: Thread) -> Result<(), Refusal> {
        self.accepts(kind, target)?;
        // Paying out takes little current, and an almost empty cell must not strand a capsule half folded.
        let min_mv = match kind {
            Unfold => self.settings.least_unfolding_mv,
            _ => self.settings.least_battery_mv,
        };
        let battery_mv = self.sample.battery_mv;
        if battery_mv < min_mv {
            return Err(Refusal::BatteryLow { battery_mv, min_mv });
        }
        if self.has_offset() {
            self.fail(SenseLost);
            return Err(Refusal::CapsuleFaulted(SenseLost));
        }
        self.begin(kind, target);
        Ok(())
    }

    /// The motion that an order means: without a calibration a reference calibrates, and a check folds what is not folded.
    pub(crate) fn meant(&self, order: ActuationKind) -> ActuationKind {
        match order {
            Reference if self.known.calibration.is_none() => Calibrate,
            CheckFolded if self.state() != Folded => Fold,
            _ => order,
        }
    }

    /// Which motion each state accepts.
    fn accepts(&self, order: ActuationKind, target: Thread) -> Result<(), Refusal> {
        match self.fault {
            Some(CapsuleFault::Watchdog | CapsuleFault::Panic) => {
                return Err(Refusal::AcknowledgeFirst);
            }
            Some(fault) => return Err(Refusal::CapsuleFaulted(fault)),
            None if self.is_moving() => return Err(Refusal::CapsuleBusy(self.state())),
            None => {}
        }
        let (known, thread) = (&self.known, self.thread());
        let is_counted = known.uncertainty.is_some();
        // What a reference leaves on the spool is known as roughly as the pull scatters, so the next one counts it, too.
        let resolves = |more: Thread| more + known.remaining <= RESOLVABLE;
        match (self.state(), self.meant(order)) {
            // The calibration would take thread on the spool for part of the unfolded end. An unfolding pays it out.
            (_, Calibrate) if is_counted && thread >= END => out_of_range(thread, Thread(0), END),
            (_, Calibrate) => Ok(()),
            (Unreferenced, Unfold) if is_counted => Ok(()),
            (_, Fold | FoldTo | CheckFolded) if known.calibration.is_none() => {
                Err(Refusal::NotCalibrated)
            }
            (_, Reference) if known.uncertainty.is_some_and(resolves) => Ok(()),
            (Unreferenced, Reference | Unfold) => Err(Refusal::UnfoldByHand),
            (Unreferenced, _) => Err(Refusal::NotReferenced),
            (Folded, Fold) | (Unfolded, Unfold) => Err(Refusal::AlreadyThere),
            (_, FoldTo) if !(END..=known.end() - END).contains(&target) => {
                out_of_range(target, END, known.end() - END)
            }
            _ => Ok(()),
        }
    }

    /// The amplifier shows a current at rest, so its readings under drive cannot be trusted.
    fn has_offset(&self) -> bool {
        self.sample.offset_ma.unsigned_abs() > MOST_OFFSET_MA
    }

    /// Latches a fault if the amplifier's zero has moved in a motion: what was judged by its currents is then wrong.
    pub(crate) fn watch_offset(&mut self) {
        let (fault, offset_ma) = (self.fault, self.sample.offset_ma);
        let by_current = !matches!(fault, Some(LowBattery { .. } | DriverFault | EStopFrame));
        let moved_ma = offset_ma.abs_diff(self.offset_before_ma);
        // A reading without a supply has measured neither battery nor zero.
        let is_measured = self.sample.battery_mv > 0 && self.actuation() > 0;
        let rests = !self.is_moving() && self.now_us >= self.brake_until_us;
        if by_current && is_measured && rests && moved_ma > MOST_MOVED_MA {
            self.fail(SenseLost);
        }
    }

    pub(crate) fn acknowledge(&mut self) -> Result<(), Refusal> {
        let persists = match self.fault.ok_or(Refusal::NothingToAcknowledge)? {
            LowBattery { .. } => self.sample.battery_mv < self.settings.least_unfolding_mv,
            DriverFault => self.sample.driver_fault,
            CapsuleFault::OverCurrent { .. } | SenseLost => self.has_offset(),
            _ => false,
        };
        if persists {
            return Err(Refusal::CauseStillPresent);
        }
        self.offset_before_ma = self.sample.offset_ma;
        self.fault = None;
        Ok(())
    }
}

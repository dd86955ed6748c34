//! Orders of the host: which command each state accepts, and what has to be in order before a motion begins.

use crate::known::RESOLVABLE;
use crate::machine::{Actions, Capsule, Command};
use crate::sense::MOST_OFFSET_MA;
use crate::speed::MOST_MA;
use crate::units::Thread;
use protocol::{
    capsule::{ActuationKind, ActuationOutcome, CapsuleFault, CapsuleState},
    error::{Field, Refusal},
};

/// Voltage that a nearly empty cell loses over a fold and an unfolding.
const RESERVE_MV: u16 = 100;
/// Current at rest, beyond which the amplifier's output must lie at one end of its range.
const OPEN_MA: u16 = 1_000;
/// Largest change of the amplifier's zero over a motion: warming moves it by 5 mA.
const MOST_MOVED_MA: u16 = 7;
/// Thread on the spool with which a calibration is refused: below that it begins near enough.
const WOUND: Thread = Thread(1_000);
/// Least distance of a partial fold from either end: the ends have motions of their own.
pub const PARTIAL_MARGIN: Thread = Thread(500);

fn out_of_range(thread: Thread, least: Thread, most: Thread) -> Refusal {
    let um = |thread: Thread| u64::try_from(thread.0).unwrap_or(0);
    Refusal::OutOfRange {
        field: Field::ThreadUm,
        requested: um(thread),
        min: um(least),
        max: um(most),
    }
}

impl Capsule {
    pub(crate) fn on_command(
        &mut self,
        now_us: u64,
        command: Command,
        actions: &mut Actions,
    ) -> Result<(), Refusal> {
        let (kind, target) = match command {
            Command::Reference => (ActuationKind::Reference, Thread(0)),
            Command::Calibrate => (ActuationKind::Calibrate, Thread(0)),
            Command::CheckFolded => (ActuationKind::CheckFolded, Thread(0)),
            Command::Fold => (ActuationKind::Fold, Thread(0)),
            Command::Unfold => (ActuationKind::Unfold, Thread(0)),
            Command::FoldTo(target) => (ActuationKind::FoldTo, target),
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
        self.accepts(kind, target)?;
        self.has_battery(kind)?;
        if let Some(fault) = self.amplifier_fault() {
            self.fail(now_us, fault, actions);
            return Err(Refusal::CapsuleFaulted(fault));
        }
        self.begin(now_us, kind, target, actions);
        Ok(())
    }

    /// Which motion each state accepts.
    fn accepts(&self, kind: ActuationKind, target: Thread) -> Result<(), Refusal> {
        use ActuationKind::{Calibrate, CheckFolded, Fold, FoldTo, Reference, Unfold};
        match self.fault {
            Some(CapsuleFault::Watchdog | CapsuleFault::Panic) => {
                return Err(Refusal::AcknowledgeFirst);
            }
            Some(fault) => return Err(Refusal::CapsuleFaulted(fault)),
            None if self.is_moving() => return Err(Refusal::CapsuleBusy(self.state())),
            None => {}
        }
        let calibrates = kind == Calibrate || kind == Reference && self.known.calibration.is_none();
        match (self.state(), kind) {
            _ if calibrates => self.may_calibrate(),
            (CapsuleState::Unreferenced, Unfold) if self.known.doubt.is_some() => {
                match self.is_near(Thread(0)) {
                    true => Err(Refusal::AlreadyThere),
                    false => Ok(()),
                }
            }
            (_, Fold | FoldTo | CheckFolded) if self.known.calibration.is_none() => {
                Err(Refusal::NotCalibrated)
            }
            (_, Reference) if self.is_resolvable() => Ok(()),
            (CapsuleState::Unreferenced, Reference | Unfold) => Err(Refusal::UnfoldByHand),
            (CapsuleState::Unreferenced, _) => Err(Refusal::NotReferenced),
            (CapsuleState::Folded, Fold) | (CapsuleState::Unfolded, Unfold) => {
                Err(Refusal::AlreadyThere)
            }
            (_, FoldTo) => self.may_stop_at(target),
            _ => Ok(()),
        }
    }

    /// A reference may wind on by as much as is unknown. What the last one has left on the spool is known as roughly as
    /// the pull scatters, so it counts, too.
    fn is_resolvable(&self) -> bool {
        let known = &self.known;
        known
            .doubt
            .is_some_and(|doubt| doubt + known.left <= RESOLVABLE)
    }

    /// Refuses a calibration while thread is on the spool, as far as it is known: the calibration would take it for part
    /// of the unfolded end. An unfolding pays it out.
    fn may_calibrate(&self) -> Result<(), Refusal> {
        let thread = self.thread();
        match self.known.doubt.is_some() && thread >= WOUND {
            true => Err(out_of_range(thread, Thread(0), WOUND)),
            false => Ok(()),
        }
    }

    /// Refuses a partial fold whose target is too close to an end, or is the present position.
    fn may_stop_at(&self, target: Thread) -> Result<(), Refusal> {
        let most = self.known.end().unwrap_or_default() - PARTIAL_MARGIN;
        if !(PARTIAL_MARGIN..=most).contains(&target) {
            return Err(out_of_range(target, PARTIAL_MARGIN, most));
        }
        match self.is_near(target) {
            true => Err(Refusal::AlreadyThere),
            false => Ok(()),
        }
    }

    /// Refuses a motion that the cell would not carry to its end. Paying out takes little current, and a person may need
    /// it: an almost empty cell must not strand a capsule half folded.
    fn has_battery(&self, kind: ActuationKind) -> Result<(), Refusal> {
        let least_mv = self.least_unfolding_mv();
        let sag_mv = self.cell_milliohm * u32::from(MOST_MA) / 1_000;
        let min_mv = match kind {
            ActuationKind::Unfold => least_mv,
            _ => u16::try_from(u32::from(least_mv) + sag_mv)
                .unwrap_or(u16::MAX)
                .max(self.settings.least_battery_mv),
        };
        let battery_mv = self.sample.battery_mv;
        match battery_mv < min_mv {
            true => Err(Refusal::BatteryLow { battery_mv, min_mv }),
            false => Ok(()),
        }
    }

    fn least_unfolding_mv(&self) -> u16 {
        self.settings.loaded_battery_mv + RESERVE_MV
    }

    /// The amplifier shows a current at rest, so its readings under drive cannot be trusted.
    fn amplifier_fault(&self) -> Option<CapsuleFault> {
        let current_ma = self.sample.offset_ma.unsigned_abs();
        match current_ma {
            ..=MOST_OFFSET_MA => None,
            OPEN_MA.. => Some(CapsuleFault::SenseLost),
            _ => Some(CapsuleFault::OverCurrent { current_ma }),
        }
    }

    /// Faults if the amplifier's zero has moved during a motion: its currents were then wrong, and so was everything
    /// judged by them.
    pub(crate) fn watch_offset(&mut self, now_us: u64, actions: &mut Actions) {
        let judged_by_current = !matches!(
            self.fault,
            Some(
                CapsuleFault::LowBattery { .. }
                    | CapsuleFault::DriverFault
                    | CapsuleFault::EStopFrame
                    | CapsuleFault::SenseLost
            )
        );
        let moved_ma = self.sample.offset_ma.abs_diff(self.offset_before_ma);
        // A reading without a supply has measured neither battery nor zero.
        let measured = self.sample.battery_mv > 0 && self.actuation() > 0;
        let rests = !self.is_moving() && now_us >= self.brake_until_us;
        if judged_by_current && measured && rests && moved_ma > MOST_MOVED_MA {
            self.fail(now_us, CapsuleFault::SenseLost, actions);
        }
    }

    fn acknowledge(&mut self) -> Result<(), Refusal> {
        let fault = self.fault.ok_or(Refusal::NothingToAcknowledge)?;
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
        self.fault = None;
        Ok(())
    }
}

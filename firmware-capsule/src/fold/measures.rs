//! Measured under way: the current without load, the pull of the thread, the friction of the worm, where folds end.

use super::{Actions, Capsule, Mode};
use crate::calibration::Calibration;
use crate::detect::Load;
use crate::leg::Leg;
use crate::mechanics::{MOST_NO_LOAD_MA, Thread};
use crate::sample::Spooling;
use protocol::capsule::{ActuationKind, CapsuleEvent, CapsuleFault};

/// Sum and number of some currents.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Mean {
    sum: i32,
    count: i32,
}

impl Mean {
    fn add(&mut self, current_ma: i16) {
        self.sum = self.sum.saturating_add(i32::from(current_ma));
        self.count = self.count.saturating_add(1);
    }

    fn mean_ma(&self) -> Option<u16> {
        let mean = (self.sum + self.count / 2).checked_div(self.count)?;
        Some(u16::try_from(mean.max(0)).unwrap_or(u16::MAX))
    }
}

/// A thread is slack over this way from the unfolded end, and the motor at its speed.
const SLACK_ZONE: (Thread, Thread) = (Thread(800), Thread(2_200));
/// The last part of the tension zone, where its current counts.
const STEADY_UM: i32 = 300;
/// So often is the tension zone made longer by that, if the motor was never steady in it.
pub(super) const PROLONGATIONS: u8 = 4;
/// Winding a taut thread takes at least this more than paying it out.
const LEAST_TENSION_MA: u32 = 15;
/// Of the calibrated pull, what a folded thread has at least: what has slipped by 2 mm or more pulls with 65 % at most.
const LEAST_PULL_PERCENT: u32 = 72;
/// Half of the end force is felt earlier or later by no more than this because of friction.
const FRICTION_SHIFT: Thread = Thread(1_200);
/// By so much, um.
const EARLIER_UM: i32 = 80;
/// By so much the place scatters, um.
const SCATTER_UM: i32 = 120;
/// Least and most end force for its sake, in thousandths.
pub(super) const FRICTION_FORCE: (i32, i32) = (600, 1_350);

/// Where folds have ended since the zero was found.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Drift {
    first: Option<Thread>,
    /// Of the distances from the first end, over about four folds, so that one of them does not decide.
    mean: Thread,
    folds: i32,
}

impl Drift {
    /// Takes an end; returns how far the ends have wandered.
    fn add(&mut self, end: Thread) -> Thread {
        let first = *self.first.get_or_insert(end);
        self.folds = (self.folds + 1).min(4);
        self.mean.0 += (end.0 - first.0 - self.mean.0) / self.folds;
        self.mean
    }
}

impl Capsule {
    /// The folded end is a place, found by a current that depends on the worm's friction. Where the force of half of it is felt earlier or later than in the calibration, the
    /// friction is another one, and so is the current at the end: the force there grows by the same share in each millimetre.
    pub(super) fn follow_friction(&mut self, load: &Load) {
        let (Mode::Moving(actuation), Some(calibration)) = (&mut self.mode, &self.calibration)
        else {
            return;
        };
        let (Leg::Wind { end, short, .. }, Some(from)) = (actuation.leg, load.rise_from) else {
            return;
        };
        // A check of a folded capsule begins beyond that place.
        if actuation.kind == ActuationKind::CheckFolded && short.is_some() {
            return;
        }
        let rise_um = calibration.rise.0.max(1);
        let later_um = from.since(self.zero).thread().0 - (end.0 - rise_um);
        // A fast fold feels it a little earlier than the slow calibration.
        self.doubt = Thread((later_um + EARLIER_UM).clamp(0, FRICTION_SHIFT.0));
        actuation.settings = if later_um.abs() <= FRICTION_SHIFT.0 {
            // What is less than the scatter of the place is none, and from twice of it on all of it counts. ln 2 of the force in each rise.
            let beyond_um = later_um - later_um.clamp(-SCATTER_UM, SCATTER_UM);
            let counted_um = later_um.abs().min(2 * beyond_um.abs()) * later_um.signum();
            let less = 693 * counted_um / rise_um;
            let (least, most) = FRICTION_FORCE;
            self.settings.with_force((1_000 - less).clamp(least, most))
        } else {
            self.settings
        };
    }

    /// Currents of a slack thread and of a taut one, from readings at a steady speed.
    pub(super) fn measure(&mut self, thread: Thread, steady: bool) -> Result<(), CapsuleFault> {
        let Mode::Moving(actuation) = &mut self.mode else {
            return Ok(());
        };
        let counts = self.sample.counts;
        let current_ma = self.sample.along_ma(actuation.detector.spooling());
        if let Some(slack_from) = actuation.slack_from
            && actuation.detector.spooling() == Spooling::Wind
        {
            let way = counts.since(slack_from).thread();
            let (from, to) = SLACK_ZONE;
            if (from..to).contains(&way) {
                if steady {
                    actuation.slack.add(current_ma);
                }
            } else if way >= to {
                actuation.slack_from = None;
                let measured = actuation.slack.mean_ma();
                if let Some(no_load_ma) = measured.filter(|mean_ma| *mean_ma <= MOST_NO_LOAD_MA) {
                    self.no_load_ma = no_load_ma;
                }
            }
        }
        let Leg::PayOut {
            taut_to: Some(taut_to),
            to,
        } = actuation.leg
        else {
            return Ok(());
        };
        if thread > taut_to {
            // Not while the motor takes up its speed.
            if steady && thread.0 - taut_to.0 <= STEADY_UM {
                actuation.taut.add(current_ma);
            }
            return Ok(());
        }
        let further = Thread(taut_to.0 - STEADY_UM);
        if actuation.taut.count == 0 && actuation.prolongations > 0 && to < further {
            // A motor that starts too fast is braked, and its current does not count for a while.
            actuation.prolongations -= 1;
            actuation.leg = Leg::PayOut {
                taut_to: Some(further),
                to,
            };
            return Ok(());
        }
        actuation.leg = Leg::PayOut { taut_to: None, to };
        // Without steady readings there is no verdict: the next fold finds a broken thread.
        let tension_ma = actuation
            .winding_ma
            .zip(actuation.taut.mean_ma())
            .map(|(winding_ma, taut_ma)| winding_ma.saturating_sub(taut_ma));
        let least_ma = match (actuation.found, &self.calibration) {
            (None, Some(calibration)) => {
                u32::from(calibration.tension_ma) * LEAST_PULL_PERCENT / 100
            }
            _ => 0,
        };
        let least_ma = least_ma.max(LEAST_TENSION_MA);
        if tension_ma.is_some_and(|tension_ma| u32::from(tension_ma) < least_ma) {
            return Err(CapsuleFault::SlipOrBreak);
        }
        if let Some((folded, rise)) = actuation.found {
            self.calibration = Some(Calibration {
                folded,
                no_load_ma: self.no_load_ma,
                rise: rise.half,
                long_rise: rise.quarter,
                tension_ma: tension_ma.unwrap_or(0),
            });
            self.referenced = true;
        }
        Ok(())
    }

    /// A folded end that wanders means that thread or zero are not what they were.
    pub(super) fn watch_drift(&mut self, actions: &mut Actions) {
        let by = self.drift.add(self.thread());
        if by.0.saturating_abs() <= self.settings.drift.0 {
            return;
        }
        self.referenced = false;
        self.was_folded = true;
        self.mode = Mode::Unreferenced;
        actions.emit(CapsuleEvent::Drifted { by_um: by.0 });
    }
}

/// What the cell gives for a current of the motor: the share of the pulses in the period.
pub(super) fn drawn_ma(current_ma: u16, drive_mv: i16, battery_mv: u16) -> u32 {
    (u32::from(current_ma) * u32::from(drive_mv.unsigned_abs()))
        .checked_div(battery_mv.into())
        .unwrap_or(0)
}

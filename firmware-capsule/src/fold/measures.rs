//! Measurements during a motion: no-load current, pull of the thread, friction of the worm, position of the folded
//! ends.

use super::{Actions, Capsule, Drive, Mode, ends_folded};
use crate::calibration::Calibration;
use crate::circuit::Reading;
use crate::detect::Load;
use crate::leg::{HIGHEST_ZERO, Leg, Purpose, STOP_MARGIN};
use crate::mechanics::{Counts, MOST_NO_LOAD_MA, Thread};
use crate::sample::Spooling;
use crate::settings::Settings;
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

    fn mean(&self) -> Option<u16> {
        let mean = (self.sum + self.count / 2).checked_div(self.count)?;
        Some(u16::try_from(mean.max(0)).unwrap_or(u16::MAX))
    }
}

/// Range of thread, from the unfolded end, in which the thread is slack and the motor at its speed.
const SLACK_ZONE: (Thread, Thread) = (Thread(800), Thread(2_200));
/// Length of the last part of the tension zone, um: only there does its current count.
const STEADY_UM: i32 = 300;
/// Extensions of the tension zone, each by `STEADY_UM`, for a motor that was never steady in it, or not long enough.
pub(super) const PROLONGATIONS: u8 = 4;
/// Minimum readings by which a reference calls a thread slipped: a single one is off by up to 20 mA.
const LEAST_TAUT: i32 = 8;
/// Minimum current that winding a taut thread takes more than paying it out.
const LEAST_TENSION_MA: u32 = 15;
/// Minimum pull of a folded thread, percent of the calibrated one: a thread that has slipped by 2 mm or more keeps 65
/// % at most.
const LEAST_PULL_PERCENT: u32 = 72;
/// Largest distance before zero at which an unfolding ends because of friction.
const FRICTION_SHIFT: Thread = Thread(1_200);
/// Margin on a fold's force, in thousandths: the place at which it feels half of the end force scatters by 0.12 mm.
const SCATTERED: i32 = 1_050;
/// Range before the calibrated end, um, in which a slow fold's force is compared with the calibration's.
const COMPARED_UM: (i32, i32) = (350, 100);
/// Minimum readings in that range.
const LEAST_COMPARED: i32 = 8;
/// Minimum pull just before the end, in thousandths of the calibration's, at which a fold is not checked by feeling.
/// After a slip of 2 mm the pull was at most 620 in 150 lifelike capsules, 780 with 1.4 times the friction. Friction x
/// 0.7 alone lowers it as far.
const SURE_PULL: u16 = 800;
/// Largest creep of the end that is believed, um: twice as much is a slip that keeps 65 % of its pull.
const MOST_CREPT_UM: i32 = 800;
/// The legs know how much may be doubted.
const _: () = assert!(FRICTION_SHIFT.0 + MOST_CREPT_UM <= HIGHEST_ZERO.0);
/// Largest creep per cycle, um.
const CREEPS_UM: i32 = 30;
/// Largest distance by which friction may bring the end force forward, um.
const MOST_EARLY_UM: i32 = 800;
/// Largest length that is computed with, um.
const MOST_UM: i32 = 1_000_000;
/// Range to which friction may scale the end force, in thousandths.
pub(super) const FRICTION_FORCE: (i32, i32) = (600, 1_350);

/// Wandering of the folded ends since the zero was found.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Drift {
    first: Option<Thread>,
    /// Mean distance from the first end, over about four folds, so that no single fold decides.
    mean: Thread,
    folds: i32,
}

impl Drift {
    /// Adds an end. Returns how far the ends have wandered.
    fn add(&mut self, end: Thread) -> Thread {
        let first = *self.first.get_or_insert(end);
        self.folds = (self.folds + 1).min(4);
        self.mean.0 += (end.0 - first.0 - self.mean.0) / self.folds;
        self.mean
    }
}

/// Factor by which the force grows over `um`, in thousandths: it doubles with every rise.
fn grows(um: i32, rise_um: i32) -> i32 {
    let rises = (um * 1_000 / rise_um.max(1)).clamp(-1_000, 1_000);
    // 2^x to second order.
    1_000 + 693 * rises / 1_000 + 240 * (rises * rises / 1_000) / 1_000
}

/// Distance by which the force lags if the thread has this share of it, in thousandths, limited to 600 to 1,400: the
/// inverse of [`grows`].
fn crept_by(share: i32, rise_um: i32) -> i32 {
    let lacks = (1_000 - share).clamp(-400, 400);
    // -ln(1 - x) to third order.
    let logarithm = lacks + lacks * lacks / 2_000 + lacks * lacks / 1_000 * lacks / 3_000;
    logarithm * rise_um / 693
}

/// Length of thread over which the force grows from a quarter to half of the end force, um. It doubles there more slowly
/// than at the end.
fn flatter_um(calibration: &Calibration) -> i32 {
    let rise_um = calibration.rise.0.max(1);
    (calibration.long_rise.0 - rise_um).max(rise_um)
}

/// Whether a winding that began at this thread sees where its force rises above half of the end force, whatever the
/// friction.
fn feels_the_rise(calibration: &Calibration, end: Thread, began: Thread) -> bool {
    let earliest_um = calibration.rise.0.max(1) + flatter_um(calibration) * 5 / 4;
    end.0.saturating_sub(began.0) >= earliest_um
}

impl Capsule {
    /// Whether the folded end was reached with so little pull that friction has fallen or the thread has slipped, and
    /// it was not felt yet.
    pub(super) fn may_have_slipped(&self) -> bool {
        let Mode::Moving(actuation) = &self.mode else {
            return false;
        };
        let share = actuation.share.mean();
        ends_folded(actuation.kind)
            && actuation.winding_ma.is_none()
            && share.is_some_and(|share| share < SURE_PULL)
    }

    /// Whether a thread that was felt, and has been wound back, pulls at least half as much as it did there; none while
    /// that is not known. A motor that winds a slack thread is braked at times, and tells nothing then.
    pub(super) fn pulls_as_felt(&self, now_us: u64, load: &Load) -> Option<bool> {
        let Mode::Moving(actuation) = &self.mode else {
            return Some(true);
        };
        let Some(felt_ma) = actuation.winding_ma else {
            return Some(true);
        };
        let least_ma = felt_ma.saturating_sub(self.no_load_ma) / 2;
        let goes_on = self.thread() < actuation.from && now_us < actuation.deadline_us;
        match load.excess_ma {
            Some(excess_ma) => Some(excess_ma >= least_ma),
            None if goes_on => None,
            None => Some(false),
        }
    }

    /// Settings for a motion that begins here with this leg. Where the force of a winding may already have risen above
    /// half of the end force before its first reading, it cannot feel how early that was. It gets all that friction may
    /// take; its scale is still measured just before the end.
    pub(super) fn settings_for(&self, leg: &Leg) -> Settings {
        let (Leg::Wind { end, .. }, Some(calibration)) = (leg, &self.calibration) else {
            return self.settings;
        };
        if feels_the_rise(calibration, *end, self.thread()) {
            return self.settings;
        }
        Settings {
            end_tolerance: Thread(self.settings.end_tolerance.0 + MOST_EARLY_UM),
            // As slow before the end as ever, for the same reading there, and no faster at something hard.
            near_ma: self.settings.near_ma,
            ..self.settings.with_force(FRICTION_FORCE.1)
        }
    }

    /// Scales the end force to the friction of this motion. The folded end is a place, but a current finds it, and
    /// that depends on the worm's friction and on anything else that scales the origami's force. If a fold feels half
    /// of the end force earlier than the calibration did, it may go on to more force without being called a jam. The
    /// scale itself is measured just before the end. There the fold is as slow as the calibration was: a damped
    /// origami pulls more at a faster thread.
    pub(super) fn follow_friction(&mut self, load: &Load) {
        let thread = self.thread();
        let (Mode::Moving(actuation), Some(calibration)) = (&mut self.mode, &self.calibration)
        else {
            return;
        };
        let Leg::Wind { end, short, .. } = actuation.leg else {
            return;
        };
        // A folded thread that was felt is being wound back; do not scale again.
        if actuation.kind != ActuationKind::FoldTo && short.is_some() {
            return;
        }
        let rise_um = calibration.rise.0.max(1);
        // Limited to the range of the arithmetic below: an encoder may say anything.
        let left_um = end.0.saturating_sub(thread.0).clamp(-MOST_UM, MOST_UM);
        // The origami's force grows faster towards the folded end.
        let steep_um = rise_um * 85 / 100;
        let (from_um, to_um) = COMPARED_UM;
        // Later readings count while there are too few: a motor that is braked has none.
        let compares = left_um >= to_um || actuation.share.count < LEAST_COMPARED;
        if left_um < from_um && compares {
            if let Some(pull_ma) = load.pull_ma {
                let wanted_ma =
                    i32::from(self.settings.force_ma) * grows(-left_um, steep_um) / 1_000;
                let share = i32::from(pull_ma) * 1_000 / wanted_ma.max(1);
                actuation.share.add(share.clamp(0, 4_000) as i16);
            }
            return;
        }
        let (least, most) = FRICTION_FORCE;
        if left_um < to_um {
            if actuation.share.count >= LEAST_COMPARED {
                let share = i32::from(actuation.share.mean().unwrap_or(0));
                actuation.settings = self.settings.with_force(share.clamp(least, most));
                // Either the friction has fallen or the count has moved. Nothing tells which.
                let later_um = crept_by(share, rise_um).clamp(0, FRICTION_SHIFT.0);
                self.doubt = Thread(later_um + self.crept.0);
            }
            return;
        }
        let began = Thread(actuation.from.0.saturating_sub(STOP_MARGIN.0));
        let Some(from) = load.rise_from else {
            return;
        };
        if !feels_the_rise(calibration, end, began) {
            return; // the force is seen only from where the motion began
        }
        let risen = self.sample.counts.since(from).thread();
        if risen.0 * 2 < rise_um {
            // Something hard raises the force faster than the origami.
            return;
        }
        let flatter_um = flatter_um(calibration);
        let earlier_um = end.0 - rise_um - from.since(self.zero).thread().0;
        if (0..=flatter_um * 5 / 4).contains(&earlier_um) {
            let more = grows(earlier_um, flatter_um) * SCATTERED / 1_000;
            let usual_um = self.settings.end_tolerance.0;
            actuation.settings = Settings {
                end_tolerance: Thread(usual_um + earlier_um.min(MOST_EARLY_UM)),
                ..self.settings.with_force(more.min(most))
            };
        }
    }

    /// Moves the believed end with the creep of thread and origami. The measure is the folded thread's pull, in which
    /// friction cancels, over the calibrated pull. Follows slowly and within limits.
    fn follow_creep(&mut self, tension_ma: u16) {
        let Some(calibration) = &self.calibration else {
            return;
        };
        let known_ma = i32::from(calibration.tension_ma).max(1);
        let share = i32::from(tension_ma) * 1_000 / known_ma;
        let by_um = crept_by(share, calibration.rise.0) / 8;
        let by_um = by_um.clamp(-CREEPS_UM, CREEPS_UM);
        self.crept = Thread((self.crept.0 + by_um).clamp(0, MOST_CREPT_UM));
    }

    /// Compares voltage, current and speed of the driven motor.
    pub(super) fn compare(&mut self, now_us: u64, steady: bool) -> Result<(), CapsuleFault> {
        let known = self.known_back_emf();
        let (sample, drive) = (self.sample, self.drive);
        let Mode::Moving(actuation) = &mut self.mode else {
            return Ok(());
        };
        let spooling = actuation.leg.spooling();
        let reading = match drive {
            Drive::Millivolts(drive_mv) if steady => Some(Reading {
                drive_mv: spooling.along(drive_mv.into()) as i16,
                current_ua: spooling.along(sample.current_ua),
                along: Counts(spooling.along(sample.counts.0)),
                battery_mv: sample.battery_mv,
                sag_mv: actuation.rest_mv.saturating_sub(sample.battery_mv),
                at_us: now_us,
            }),
            _ => None,
        };
        match actuation.circuit.take(reading, known, &self.settings) {
            true => Err(CapsuleFault::SenseOrEncoder),
            false => Ok(()),
        }
    }

    /// Whether voltage, current and speed contradict each other now.
    pub(super) fn circuit_disagrees(&self) -> bool {
        let Mode::Moving(actuation) = &self.mode else {
            return false;
        };
        let known = self.known_back_emf();
        actuation.circuit.disagrees_now(known, &self.settings)
    }

    /// Motor constant measured by the calibration; 0 while one is in progress or if there is none.
    pub(super) fn known_back_emf(&self) -> u16 {
        match &self.calibration {
            Some(calibration) if !self.calibrates() => calibration.back_emf_uv_cps,
            _ => 0,
        }
    }

    fn calibrates(&self) -> bool {
        match &self.mode {
            Mode::Moving(actuation) => matches!(
                actuation.leg,
                Leg::Seek {
                    purpose: Purpose::Calibrate,
                    ..
                }
            ),
            _ => false,
        }
    }

    /// Measures the currents of a slack thread and of a taut one, from readings at a steady speed.
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
                let measured = actuation.slack.mean();
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
            // Skip readings while the motor takes up its speed.
            if steady && thread.0 - taut_to.0 <= STEADY_UM {
                actuation.taut.add(current_ma);
            }
            return Ok(());
        }
        let tension_ma = actuation
            .winding_ma
            .zip(actuation.taut.mean())
            .map(|(winding_ma, taut_ma)| winding_ma.saturating_sub(taut_ma));
        let found = actuation.found;
        let least_ma = match (found, &self.calibration) {
            (None, Some(calibration)) => {
                u32::from(calibration.tension_ma) * LEAST_PULL_PERCENT / 100
            }
            _ => 0,
        };
        let least_ma = least_ma.max(LEAST_TENSION_MA);
        let lacks = tension_ma.is_some_and(|tension_ma| u32::from(tension_ma) < least_ma);
        let further = Thread(taut_to.0 - STEADY_UM);
        // A reference has just felt the end, and less pull may be one bad reading. Elsewhere it is a slip: 2 mm can leave
        // just enough further down.
        let few = match actuation.kind {
            ActuationKind::Reference if lacks => actuation.taut.count < LEAST_TAUT,
            _ => actuation.taut.count == 0,
        };
        if few && actuation.prolongations > 0 && to < further {
            // A motor that starts too fast is braked, and its current does not count for a while: extend the zone.
            actuation.prolongations -= 1;
            actuation.governor.hold_less();
            actuation.leg = Leg::PayOut {
                taut_to: Some(further),
                to,
            };
            return Ok(());
        }
        actuation.leg = Leg::PayOut { taut_to: None, to };
        // Without steady readings nothing shows that the thread holds. Only a partial unfolding may be too short for
        // them; it does not end at an end.
        let told = tension_ma.is_some() || actuation.kind == ActuationKind::FoldTo;
        if !told || lacks {
            return Err(CapsuleFault::SlipOrBreak);
        }
        let back_emf_uv_cps = actuation.back_emf_uv_cps;
        actuation.calibrated = found.is_some();
        // Follow once a cycle: an end that is only felt will be left later.
        let leaves = !ends_folded(actuation.kind);
        if let (None, Some(tension_ma), true) = (found, tension_ma, leaves) {
            self.follow_creep(tension_ma);
        }
        if let Some((folded, rise)) = found {
            self.calibration = Some(Calibration {
                folded,
                no_load_ma: self.no_load_ma,
                rise: rise.half,
                long_rise: rise.quarter,
                tension_ma: tension_ma.unwrap_or(0),
                back_emf_uv_cps,
            });
            self.referenced = true;
        }
        Ok(())
    }

    /// Drops the reference if the folded ends, of which this is one, wander: thread or zero have changed.
    pub(super) fn watch_drift(&mut self, end: Thread, actions: &mut Actions) {
        let by = self.drift.add(end);
        if by.0.saturating_abs() <= self.settings.drift.0 {
            return;
        }
        self.referenced = false;
        self.was_folded = true;
        self.mode = Mode::Unreferenced;
        actions.emit(CapsuleEvent::Drifted { by_um: by.0 });
    }
}

/// Current from the cell for a current of the motor: it flows only during the pulses' share of the period.
pub(super) fn drawn_ma(current_ma: u16, drive_mv: i16, battery_mv: u16) -> u32 {
    (u32::from(current_ma) * u32::from(drive_mv.unsigned_abs()))
        .checked_div(battery_mv.into())
        .unwrap_or(0)
}

#[cfg(test)]
#[path = "../../tests/unit/measures.rs"]
mod tests;

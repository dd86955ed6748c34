//! Measurements on the way of a motion: the current without load, the pull of the folded thread, and how the current
//! rises just before the folded end.
//!
//! To feel, the motor pays a little thread out and winds it again. The pull is the current of winding less that of
//! paying out at the same place: the current without load cancels, and most of the friction.

use crate::guards::MEAN;
use crate::known::Calibration;
use crate::phase::Goal;
use crate::units::Thread;
use core::ops::Range;
use protocol::capsule::CapsuleFault;

/// Where the thread is felt, below the upper end: the motor is at its speed there, both ways. The pull is measured in the
/// first zone, the rise is that of the mean from the first zone to the second.
const ZONES: [Range<Thread>; 2] = [Thread(400)..Thread(650), Thread(40)..Thread(200)];
/// Where the thread of a calibration is slack and the motor at its speed, from the unfolded end.
const SLACK_ZONE: Range<Thread> = Thread(400)..Thread(1_400);
/// Largest plausible no-load current, mA: a higher one was not measured on a slack thread.
pub const MOST_NO_LOAD_MA: u16 = 30;
/// Least pull of a calibration, mA: 0.6 N.
const LEAST_PULL_MA: u16 = 15;
/// Least pull of a thread that holds, in percent of the calibration's: one that has slipped by 2 mm keeps 65 at most. An
/// unfolding whose current of paying out is less feels the thread first.
const HOLDS_PERCENT: i32 = 75;
/// Pull in percent at which a reference has found the folded end. A fold that is tightened again takes as much of its
/// current at the end: a spool that slipped there has given way.
const END_PERCENT: i32 = 95;
/// Least rise of a fold in percent of the calibration's: a spool that slips winds on without one.
const LEAST_RISE_PERCENT: i32 = 52;
/// Rise that may be missing, in thousandths: a crescent that snaps through there leaves little, and scatters.
const MISSING_RISE: i32 = 45;
/// Most rise in percent at which a reference believes in the origami: something harder in the way has more.
const MOST_RISE_PERCENT: i32 = 300;

/// Sum and number of some currents, uA.
#[derive(Clone, Copy, Debug, Default)]
struct Mean {
    sum: i32,
    count: i32,
}

impl Mean {
    fn add(&mut self, value: i32) {
        self.sum = self.sum.saturating_add(value);
        self.count += 1;
    }

    fn mean(&self) -> Option<i32> {
        (self.count >= MEAN as i32).then(|| self.sum / self.count)
    }
}

#[derive(Clone, Debug, Default)]
pub struct Feel {
    /// Back-EMF of the motor on the slack thread, uV per count per second.
    pub back_emf: Option<u16>,
    slack: Mean,
    /// A reference has felt the folded end here.
    pulls: bool,
    /// In the two zones, while the thread is wound to the folded end, slackened, and tightened again.
    folding: [Mean; 2],
    slackening: [Mean; 2],
    tightening: [Mean; 2],
}

/// Percent of a known value.
fn percent(of: i32, known: i32) -> i32 {
    (of.clamp(-20_000_000, 20_000_000) * 100)
        .checked_div(known)
        .unwrap_or(0)
}

/// Rise from the first zone to the second, in thousandths of the current above `no_load_ma`.
fn rise([low, high]: [Mean; 2], no_load_ma: u16) -> Option<i32> {
    let (low, high) = (low.mean()?, high.mean()?);
    let above_ma = high / 1_000 - i32::from(no_load_ma);
    Some((high - low) / above_ma.max(1))
}

impl Feel {
    /// Takes the steady current of a phase with this thread on the spool, `depth` below the upper end.
    pub fn take(&mut self, goal: Goal, thread: Thread, depth: Thread, current_ua: i32) {
        let means = match goal {
            Goal::Fold => &mut self.folding,
            Goal::Slacken => &mut self.slackening,
            Goal::Tighten => &mut self.tightening,
            Goal::Seek if SLACK_ZONE.contains(&thread) => return self.slack.add(current_ua),
            _ => return,
        };
        for (mean, zone) in means.iter_mut().zip(ZONES) {
            if zone.contains(&depth) {
                mean.add(current_ua);
            }
        }
    }

    /// Current without load, once a calibration has measured it, mA.
    pub fn no_load_ma(&self) -> Option<u16> {
        let no_load_ma = u16::try_from((self.slack.mean()? + 500) / 1_000).unwrap_or(0);
        Some(no_load_ma.min(MOST_NO_LOAD_MA))
    }

    fn pull_ua(&self) -> Option<i32> {
        Some(self.tightening[0].mean()? - self.slackening[0].mean()?)
    }

    /// The calibration of a capsule that is folded at `folded`.
    ///
    /// # Errors
    /// The thread does not pull, or something was not measured.
    pub fn calibration(&self, folded: Thread) -> Result<Calibration, CapsuleFault> {
        let of_ma = |ua: i32| u16::try_from(ua / 1_000).unwrap_or(0);
        let no_load_ma = self.no_load_ma().ok_or(CapsuleFault::SenseLost)?;
        let pull_ma = self.pull_ua().map_or(0, of_ma);
        if pull_ma < LEAST_PULL_MA {
            return Err(CapsuleFault::SlipOrBreak);
        }
        let paid_ma = self.slackening[0].mean().map_or(0, of_ma);
        let rise = rise(self.folding, no_load_ma).unwrap_or(0);
        Ok(Calibration {
            folded,
            no_load_ma,
            pull_ma,
            paid_ma: paid_ma.saturating_sub(no_load_ma),
            rise: rise.clamp(0, 1_000) as u16,
            back_emf_uv_cps: self.back_emf.ok_or(CapsuleFault::SenseOrEncoder)?,
        })
    }

    fn pull_percent(&self, known: &Calibration) -> Option<i32> {
        Some(percent(self.pull_ua()? / 1_000, known.pull_ma.into()))
    }

    /// Checks that the thread pulls as it did at the calibration. Without a reading nothing shows that it holds.
    ///
    /// # Errors
    /// It does not: it has slipped or is broken.
    pub fn holds(&self, known: &Calibration) -> Result<(), CapsuleFault> {
        let above = |ua: i32| ua - i32::from(known.no_load_ma) * 1_000;
        let again = self.tightening[1].mean().map_or(0, above);
        let gives_way = |folded| percent(again, above(folded)) < END_PERCENT;
        let pull = self.pull_percent(known).unwrap_or(0);
        match pull < HOLDS_PERCENT || self.folding[1].mean().is_some_and(gives_way) {
            true => Err(CapsuleFault::SlipOrBreak),
            false => Ok(()),
        }
    }

    /// Checks that the current of a fold has risen.
    ///
    /// # Errors
    /// It has not: the spool has slipped.
    pub fn rises(&self, known: &Calibration) -> Result<(), CapsuleFault> {
        let known_rise = i32::from(known.rise);
        let least = (known_rise * LEAST_RISE_PERCENT / 100).min(known_rise - MISSING_RISE);
        match rise(self.folding, known.no_load_ma) {
            Some(rise) if rise >= least => Ok(()),
            _ => Err(CapsuleFault::SlipOrBreak),
        }
    }

    /// The thread that is paid out surely pulls; if not, it has to be felt.
    pub fn surely_holds(&self, known: &Calibration) -> bool {
        let above_ma = |paid_ua: i32| paid_ua / 1_000 - i32::from(known.no_load_ma);
        let paid_ma = self.slackening[0].mean().map(above_ma);
        paid_ma.is_some_and(|ma| percent(ma, known.paid_ma.into()) >= HOLDS_PERCENT)
    }

    /// How far a reference winds on; none once the folded end was felt twice. The first winding there pulls harder.
    pub fn winds_on(&mut self, known: &Calibration) -> Option<Thread> {
        let pull = self.pull_percent(known).unwrap_or(0);
        let pulled = core::mem::replace(&mut self.pulls, pull >= END_PERCENT);
        let further_um = match pull {
            END_PERCENT.. if pulled => return None,
            END_PERCENT.. => 0,
            HOLDS_PERCENT.. => 150,
            50.. => 300,
            _ => 600,
        };
        (self.slackening, self.tightening) = Default::default();
        Some(Thread(further_um))
    }

    /// The current rises no more than with the origami.
    pub fn is_origami(&self, known: &Calibration) -> bool {
        let rise = rise(self.tightening, known.no_load_ma);
        rise.is_some_and(|rise| percent(rise, known.rise.into()) <= MOST_RISE_PERCENT)
    }
}

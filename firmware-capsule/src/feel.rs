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
        (self.sum, self.count) = (self.sum.saturating_add(value), self.count + 1);
    }

    /// The mean, above this no-load current.
    fn above_ua(&self, no_load_ma: u16) -> Option<i32> {
        let is_enough = self.count >= MEAN as i32;
        is_enough.then(|| self.sum / self.count - i32::from(no_load_ma) * 1_000)
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
    let hundredfold = of.clamp(-20_000_000, 20_000_000) * 100;
    hundredfold.checked_div(known).unwrap_or(0)
}

/// Rise from the first zone to the second, in thousandths of the current above `no_load_ma`.
fn rise([low, high]: [Mean; 2], no_load_ma: u16) -> Option<i32> {
    let (low_ua, high_ua) = (low.above_ua(no_load_ma)?, high.above_ua(no_load_ma)?);
    Some((high_ua - low_ua) / (high_ua / 1_000).max(1))
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
        let zone = ZONES.iter().position(|zone| zone.contains(&depth));
        if let Some(zone) = zone {
            means[zone].add(current_ua);
        }
    }

    /// Current without load, once a calibration has measured it, mA.
    pub fn no_load_ma(&self) -> Option<u16> {
        let no_load_ua = self.slack.above_ua(0)?.max(0) + 500;
        Some((no_load_ua / 1_000).min(MOST_NO_LOAD_MA.into()) as u16)
    }

    fn pull_ma(&self) -> Option<i32> {
        Some((self.tightening[0].above_ua(0)? - self.slackening[0].above_ua(0)?) / 1_000)
    }

    /// The calibration of a capsule that is folded at `folded`.
    ///
    /// # Errors
    /// The thread does not pull, or something was not measured.
    pub fn calibration(&self, folded: Thread) -> Result<Calibration, CapsuleFault> {
        let no_load_ma = self.no_load_ma().ok_or(CapsuleFault::SenseLost)?;
        let pull_ma = self.pull_ma().and_then(|ma| u16::try_from(ma).ok());
        let pull_ma = pull_ma.filter(|pull_ma| *pull_ma >= LEAST_PULL_MA);
        let paid_ua = self.slackening[0].above_ua(no_load_ma).unwrap_or(0);
        let rise = rise(self.folding, no_load_ma).unwrap_or(0);
        Ok(Calibration {
            folded,
            no_load_ma,
            pull_ma: pull_ma.ok_or(CapsuleFault::SlipOrBreak)?,
            paid_ma: u16::try_from(paid_ua / 1_000).unwrap_or(0),
            rise: rise.clamp(0, 1_000) as u16,
            back_emf_uv_cps: self.back_emf.ok_or(CapsuleFault::SenseOrEncoder)?,
        })
    }

    /// Pull in percent of the calibration's. Without a reading nothing shows that the thread pulls.
    fn pull_percent(&self, known: &Calibration) -> i32 {
        percent(self.pull_ma().unwrap_or(0), known.pull_ma.into())
    }

    /// The thread pulls as it did at the calibration: it has not slipped and is not broken.
    pub fn holds(&self, known: &Calibration) -> bool {
        let [again_ua, folded_ua] =
            [self.tightening, self.folding].map(|[_, high]| high.above_ua(known.no_load_ma));
        let keeps = |folded_ua| percent(again_ua.unwrap_or(0), folded_ua) >= END_PERCENT;
        self.pull_percent(known) >= HOLDS_PERCENT && folded_ua.is_none_or(keeps)
    }

    /// The current of a fold has risen: the spool has not slipped.
    pub fn rises(&self, known: &Calibration) -> bool {
        let known_rise = i32::from(known.rise);
        let least = (known_rise * LEAST_RISE_PERCENT / 100).min(known_rise - MISSING_RISE);
        rise(self.folding, known.no_load_ma).is_some_and(|rise| rise >= least)
    }

    /// The thread that is paid out surely pulls; if not, it has to be felt.
    pub fn surely_holds(&self, known: &Calibration) -> bool {
        let paid_ua = self.slackening[0].above_ua(known.no_load_ma).unwrap_or(0);
        percent(paid_ua / 1_000, known.paid_ma.into()) >= HOLDS_PERCENT
    }

    /// How far a reference winds on; none once the folded end was felt twice. The first winding there pulls harder.
    pub fn winds_on(&mut self, known: &Calibration) -> Option<Thread> {
        let pull = self.pull_percent(known);
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

//! Measurements on the way of a motion: the current without load, and how the folded thread pulls. To feel it, the motor
//! pays a little thread out and winds it again. The pull is the current of winding less that of paying out at the same
//! place: the current without load cancels, and most of the friction.

use crate::guards::MEAN;
use crate::known::Calibration;
use crate::phase::Goal;
use crate::units::Thread;
use core::ops::Range;
use protocol::capsule::CapsuleFault;

/// Where the thread is felt, below the upper end: the motor is at its speed there, both ways.
const ZONE: Range<Thread> = Thread(300)..Thread(550);
/// Where its current has risen further as it is tightened.
const END_ZONE: Range<Thread> = Thread(40)..Thread(200);
/// Where the thread of a calibration is slack and the motor at its speed, from the unfolded end.
const SLACK_ZONE: Range<Thread> = Thread(400)..Thread(1_400);
/// Largest plausible no-load current, mA: a higher one was not measured on a slack thread.
pub const MOST_NO_LOAD_MA: u16 = 30;
/// Least pull of a calibration, mA: 0.6 N.
const LEAST_PULL_MA: u16 = 15;
/// Least pull of a thread that holds, in percent of the calibration's: one that has slipped by 2 mm keeps 65 at most.
const HOLDS_PERCENT: i32 = 75;
/// Pull in percent at which a reference has found the folded end.
const END_PERCENT: i32 = 95;
/// Most current that tightening may lack of the fold's, in thousandths, beyond what it lacked at the calibration: it lacks
/// 48 at most if nothing slips, and most often 80 or more if the spool has slipped by 0.3 mm.
const MOST_LACKING: i32 = 60;
/// Most rise in percent at which a reference believes in the origami. It had 135 in 149 of 150, something stiff more.
const MOST_RISE_PERCENT: i32 = 200;

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
    /// A reference has felt the folded end here.
    pulls: bool,
    /// On the slack thread of a calibration.
    slack: Mean,
    /// In the zone, while the thread is wound to the folded end, slackened, and tightened again.
    folding: Mean,
    slackening: Mean,
    tightening: Mean,
    /// In the zone at the end, while it is tightened.
    tight: Mean,
}

/// Percent of a known value.
fn percent(of: i32, known: i32) -> i32 {
    let hundredfold = of.clamp(-20_000_000, 20_000_000) * 100;
    hundredfold.checked_div(known).unwrap_or(0)
}

impl Feel {
    /// Takes the steady current of a phase with this thread on the spool, `depth` below the upper end.
    pub fn take(&mut self, goal: Goal, thread: Thread, depth: Thread, current_ua: i32) {
        let mean = match goal {
            Goal::Seek if SLACK_ZONE.contains(&thread) => &mut self.slack,
            Goal::Tighten if END_ZONE.contains(&depth) => &mut self.tight,
            Goal::Fold if ZONE.contains(&depth) => &mut self.folding,
            Goal::Slacken if ZONE.contains(&depth) => &mut self.slackening,
            Goal::Tighten if ZONE.contains(&depth) => &mut self.tightening,
            _ => return,
        };
        mean.add(current_ua);
    }

    /// Current without load, once a calibration has measured it, mA.
    pub fn no_load_ma(&self) -> Option<u16> {
        let no_load_ua = self.slack.above_ua(0)?.max(0) + 500;
        Some((no_load_ua / 1_000).min(MOST_NO_LOAD_MA.into()) as u16)
    }

    /// How far tightening takes less than `other`, in thousandths of that, both above the no-load current.
    fn less_than(&self, other: Mean, no_load_ma: u16) -> Option<i32> {
        let other_ua = other.above_ua(no_load_ma)?;
        let less_ua = other_ua - self.tightening.above_ua(no_load_ma)?;
        Some(less_ua / (other_ua / 1_000).max(1))
    }

    fn pull_ma(&self) -> Option<i32> {
        Some((self.tightening.above_ua(0)? - self.slackening.above_ua(0)?) / 1_000)
    }

    /// The calibration of a capsule that is folded at `folded`.
    ///
    /// # Errors
    /// The thread does not pull, or something was not measured.
    pub fn calibration(&self, folded: Thread) -> Result<Calibration, CapsuleFault> {
        let no_load_ma = self.no_load_ma().ok_or(CapsuleFault::SenseLost)?;
        let pull_ma = self.pull_ma().and_then(|ma| u16::try_from(ma).ok());
        let pull_ma = pull_ma.filter(|pull_ma| *pull_ma >= LEAST_PULL_MA);
        let less = |mean| {
            self.less_than(mean, no_load_ma)
                .ok_or(CapsuleFault::SenseLost)
        };
        Ok(Calibration {
            folded,
            no_load_ma,
            pull_ma: pull_ma.ok_or(CapsuleFault::SlipOrBreak)?,
            rise: less(self.tight)?.clamp(-1_000, 1_000) as i16,
            lacking: less(self.folding)?.clamp(-1_000, 1_000) as i16,
            back_emf_uv_cps: self.back_emf.ok_or(CapsuleFault::SenseOrEncoder)?,
        })
    }

    /// Pull in percent of the calibration's. Without a reading nothing shows that the thread pulls.
    fn pull_percent(&self, known: &Calibration) -> i32 {
        percent(self.pull_ma().unwrap_or(0), known.pull_ma.into())
    }

    /// The thread pulls as it did at the calibration and, if it was folded before, as it did then: it has not slipped.
    pub fn holds(&self, known: &Calibration, was_folded: bool) -> bool {
        let most = i32::from(known.lacking) + MOST_LACKING;
        let lacking = self.less_than(self.folding, known.no_load_ma);
        let holds = self.pull_percent(known) >= HOLDS_PERCENT;
        holds && (!was_folded || lacking.is_some_and(|of| of <= most))
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
        (self.slackening, self.tightening, self.tight) = Default::default();
        Some(Thread(further_um))
    }

    /// The current rises no more than with the origami.
    pub fn is_origami(&self, known: &Calibration) -> bool {
        let rise = self.less_than(self.tight, known.no_load_ma);
        rise.is_some_and(|rise| percent(rise, known.rise.into()) <= MOST_RISE_PERCENT)
    }
}

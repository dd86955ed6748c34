//! Measurements on the way of a motion: the current without load, the pull of the folded thread, and how the current
//! rises just before the folded end.
//!
//! To feel, the motor pays out [`FELT`](crate::phase::FELT) and winds it again. The pull is the current of winding less
//! that of paying out at the same place: the current without load cancels, and most of the friction.

use crate::guards::Means;
use crate::known::Calibration;
use crate::phase::Goal;
use crate::readings::MEAN;
use crate::settings::Settings;
use crate::units::Thread;
use core::ops::Range;
use protocol::capsule::CapsuleFault;

/// Where the thread is felt, below the upper end: the motor is at its speed there, both ways. The pull is measured in the
/// first zone, the rise is that of the mean from the first zone to the second.
const ZONES: [Range<Thread>; 2] = [Thread(400)..Thread(650), Thread(40)..Thread(200)];
/// Where the thread of a calibration is slack and the motor at its speed, from the unfolded end.
const SLACK_ZONE: Range<Thread> = Thread(400)..Thread(1_400);
/// Largest plausible no-load current, mA: a higher one was not measured on a slack thread.
const MOST_NO_LOAD_MA: u16 = 30;
/// Largest plausible deviation of the measured back-EMF from the setting, percent: a motor that does not count right is
/// further off.
const BACK_EMF_PERCENT: i32 = 12;
/// Largest current at which the back-EMF is measured, mA: with little current the resistance matters little.
const LIGHT_MA: i32 = 45;
/// Least pull of a calibration, mA: 0.6 N.
const LEAST_PULL_MA: u16 = 15;
/// Least pull of a thread that holds, in percent of the calibration's: one that has slipped by 2 mm keeps 65 at most. An
/// unfolding whose current of paying out is less feels the thread first.
const HOLDS_PERCENT: i32 = 75;
/// Pull in percent at which a reference has found the folded end.
const END_PERCENT: i32 = 95;
/// Least rise of a fold in percent of the calibration's: a spool that slips winds on without one.
const LEAST_RISE_PERCENT: i32 = 35;
/// Below this rise the thread has to pull this much, in percent: a spool that slips just before the end is both flat and
/// weak.
const FLAT_RISE_PERCENT: i32 = 72;
const FLAT_PULL_PERCENT: i32 = 95;
/// Rise that may be missing, in thousandths: a crescent that snaps through there leaves little, and scatters.
const MISSING_RISE: i32 = 45;
/// Most rise in percent at which a reference believes in the origami: something harder in the way has more.
const MOST_RISE_PERCENT: i32 = 300;

/// Sum and number of some currents, uA.
#[derive(Clone, Copy, Debug, Default)]
pub struct Mean {
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

/// The measurements of a motion.
#[derive(Clone, Debug, Default)]
pub struct Feel {
    paid: Mean,
    wound: Mean,
    /// In the two zones.
    pub rise: [Mean; 2],
    /// The current of the fold has risen little towards its end.
    is_flat: bool,
    slack: Mean,
    back_emf: Option<i32>,
}

/// Percent of a known value.
fn percent(of: i32, known: i32) -> i32 {
    (of.clamp(-20_000_000, 20_000_000) * 100)
        .checked_div(known)
        .unwrap_or(0)
}

impl Feel {
    /// Takes the steady current of a phase with this thread on the spool, `depth` below the upper end.
    pub fn take(&mut self, goal: Goal, thread: Thread, depth: Thread, current_ua: i32) {
        let [low, high] = ZONES.map(|zone| zone.contains(&depth));
        match goal {
            Goal::Slacken if low => self.paid.add(current_ua),
            Goal::Fold if low => self.rise[0].add(current_ua),
            Goal::Tighten if low => {
                self.wound.add(current_ua);
                self.rise[0].add(current_ua);
            }
            Goal::Fold | Goal::Tighten if high => self.rise[1].add(current_ua),
            Goal::Seek if SLACK_ZONE.contains(&thread) => self.slack.add(current_ua),
            _ => {}
        }
    }

    /// Takes a comparison of voltage, current and speed.
    pub fn compared(&mut self, means: &Means, settings: &Settings) {
        if self.back_emf.is_none() && (0..LIGHT_MA).contains(&means.current_ma) {
            self.back_emf = means.back_emf_uv_cps(settings);
        }
    }

    /// Begins a new look at the folded end.
    pub fn again(&mut self) {
        (self.paid, self.wound, self.rise) = Default::default();
    }

    /// Current without load, once a calibration has measured it, mA.
    pub fn no_load_ma(&self) -> Option<u16> {
        let no_load_ma = u16::try_from((self.slack.mean()? + 500) / 1_000).unwrap_or(0);
        Some(no_load_ma.min(MOST_NO_LOAD_MA))
    }

    fn pull_ua(&self) -> Option<i32> {
        Some(self.wound.mean()? - self.paid.mean()?)
    }

    /// Rise in thousandths of the current above `no_load_ma`.
    fn rise(&self, no_load_ma: u16) -> Option<i32> {
        let [low, high] = [self.rise[0].mean()?, self.rise[1].mean()?];
        let above_ma = high / 1_000 - i32::from(no_load_ma);
        Some((high - low) / above_ma.max(1))
    }

    /// The calibration of a capsule that is folded at `folded`.
    ///
    /// # Errors
    /// The thread does not pull, or the motor is not that of the settings.
    pub fn calibration(
        &self,
        folded: Thread,
        settings: &Settings,
    ) -> Result<Calibration, CapsuleFault> {
        let of_ma = |ua: i32| u16::try_from(ua / 1_000).unwrap_or(0);
        let no_load_ma = self.no_load_ma().ok_or(CapsuleFault::SenseLost)?;
        let back_emf = self.back_emf.ok_or(CapsuleFault::SenseOrEncoder)?;
        if (percent(back_emf, settings.back_emf_uv_per_cps) - 100).abs() > BACK_EMF_PERCENT {
            return Err(CapsuleFault::SenseOrEncoder);
        }
        let pull_ma = self.pull_ua().map_or(0, of_ma);
        if pull_ma < LEAST_PULL_MA {
            return Err(CapsuleFault::SlipOrBreak);
        }
        Ok(Calibration {
            folded,
            no_load_ma,
            pull_ma,
            paid_ma: self.paid.mean().map_or(0, of_ma).saturating_sub(no_load_ma),
            rise: self
                .rise(no_load_ma)
                .map_or(0, |rise| rise.clamp(0, 1_000) as u16),
            back_emf_uv_cps: back_emf as u16,
        })
    }

    fn pull_percent(&self, known: &Calibration) -> Option<i32> {
        Some(percent(self.pull_ua()? / 1_000, known.pull_ma.into()))
    }

    /// The thread pulls as it did at the calibration. Without a reading nothing shows that it holds.
    pub fn holds(&self, known: &Calibration) -> bool {
        let least = if self.is_flat {
            FLAT_PULL_PERCENT
        } else {
            HOLDS_PERCENT
        };
        self.pull_percent(known).is_some_and(|pull| pull >= least)
    }

    /// The current of winding has risen towards the folded end by this share of the calibration's rise.
    fn has_risen(&self, known: &Calibration, percent: i32) -> bool {
        let known_rise = i32::from(known.rise);
        let least = (known_rise * percent / 100).min(known_rise - MISSING_RISE);
        self.rise(known.no_load_ma)
            .is_some_and(|rise| rise >= least)
    }

    /// Judges the rise of a fold. False if the spool has slipped.
    pub fn folded(&mut self, known: &Calibration) -> bool {
        self.is_flat = !self.has_risen(known, FLAT_RISE_PERCENT);
        self.has_risen(known, LEAST_RISE_PERCENT)
    }

    /// The thread that is paid out surely pulls; if not, it has to be felt.
    pub fn surely_holds(&self, known: &Calibration) -> bool {
        let above_ma = self
            .paid
            .mean()
            .map(|paid_ua| paid_ua / 1_000 - i32::from(known.no_load_ma));
        above_ma.is_some_and(|above_ma| percent(above_ma, known.paid_ma.into()) >= HOLDS_PERCENT)
    }

    /// How a reference goes on after it has felt the thread: none at the folded end, else by how much it winds on.
    pub fn winds_on(&self, known: &Calibration) -> Option<Thread> {
        match self.pull_percent(known).unwrap_or(0) {
            END_PERCENT.. => None,
            HOLDS_PERCENT.. => Some(Thread(150)),
            50.. => Some(Thread(300)),
            _ => Some(Thread(600)),
        }
    }

    /// What pulls rises no harder than the origami.
    pub fn is_origami(&self, known: &Calibration) -> bool {
        let rise = self.rise(known.no_load_ma);
        rise.is_some_and(|rise| percent(rise, known.rise.into()) <= MOST_RISE_PERCENT)
    }
}

//! What the motor's current, its encoder and the battery say about one leg of a motion.
//!
//! Every start and every reversal creates a new [`Detector`]. The current is the mean over one PWM period, and
//! bounded by the speed loop: a healthy motor draws 250 mA at most, also from standstill and when it is blocked.

use crate::sample::{Sample, Spooling};
use crate::{
    mechanics::{COASTING_CPS2_PER_MA, Counts},
    settings::Settings,
    window::Window,
};

/// After a start the motor accelerates, and the current says nothing about force.
pub const BLANKING_US: u64 = 30_000;
/// And so long after a brake within a leg: the motor takes up its speed again.
const AFTER_BRAKE_US: u64 = 40_000;
/// The current is averaged over so many readings, and must have been driven in all of them.
const FORCE_READINGS: usize = 8;
/// A load must last this long.
const LOAD_DEBOUNCE_US: u64 = 2_000;
/// A driven motor may make no progress for this long.
pub const STANDSTILL_US: u64 = 40_000;
/// Two encoder lines count as progress. With one channel broken the count flickers by one on the spot.
const PROGRESS_COUNTS: i32 = 8;
/// So far the wrong way, 0.05 mm, and the encoder's lines are swapped.
const WRONG_WAY_COUNTS: i32 = 40;
/// Twice what the speed loop lets a healthy motor draw.
pub const OVER_CURRENT_MA: u16 = 450;
/// A motor that is braked against its speed draws 0.6 A.
const MOST_BRAKING_MA: i16 = 800;
/// Over-current must last this long.
const OVER_CURRENT_DEBOUNCE_US: u64 = 2_000;
/// Twice the current that was ordered, and this, is a short circuit, too.
const SURPLUS_MA: u32 = 60;
/// For so long: when something stops the motor, its back-EMF is overestimated for 3 ms.
const SURPLUS_DEBOUNCE_US: u64 = 4_000;
/// A motor that stands draws what was ordered, within winding, cell and amplifier; one that turns draws less, by its back-EMF.
const STALLED_PERCENT: u32 = 85;
/// A sag must last this long.
const SAG_DEBOUNCE_US: u64 = 15_000;
/// Below this a cell has collapsed: the chip's own supply goes with it, and what is measured against it means nothing.
const COLLAPSED_MV: u16 = 2_000;
/// So many readings of a leg, with others between them: a drive that the collapse ends lets the cell recover.
const COLLAPSES: u8 = 5;
/// Ignores nFAULT while the bridge wakes up (DRV8833: 1 ms).
const DRIVER_DEBOUNCE_US: u64 = 3_000;
/// Near the end of the amplifier's range, 1,475 mA with the least supply.
const RAIL_MA: i16 = 1_300;
/// A winding that draws so much pulls the battery down by more than this, if at least half of the time.
const SHORT_SAG_MV: u16 = 100;
/// Less than this is no current at all: a turning motor takes 10 mA at least.
const NOTHING_MA: u16 = 5;
/// Readings that show nothing are not taken for a slack thread: a dead amplifier is named later.
const SILENT_READINGS: usize = 3;
/// A current must be ordered for its absence to mean something.
const ORDERED_MA: u16 = 12;
/// No current for this long, and its name is sought.
const SILENCE_US: u64 = 24_000;
/// Readings before the present one with which the speed is compared: the silence, less the speed's own window.
const SILENCE_READINGS: usize = 22;
/// A blocked motor that draws current pulls the battery down by this; the least resistance of a cell is 0.3 ohm.
const LEAST_SAG_MV: u16 = 15;
/// Speed from which a sudden resistance is looked for, counts/s: 7 mm/s.
const FAST_CPS: i32 = 6_000;
/// A sudden loss of speed is more than this, counts/s: one and a half counts in 2 ms. Rounding alone makes one.
const STRUCK_LOSS_CPS: i32 = 750;
/// From this speed on, counts/s, a loss of a fifth is more than rounding.
const SLOW_CPS_AT_LEAST: i32 = 3_000;
/// Readings with which the order is compared.
const ORDERED_READINGS: usize = 20;
/// Readings without a count after which a motor that pulls with the end force is asked whether it turns.
const STILL_READINGS: usize = 10;
/// Speed times this is the stopping distance of a braked motor: its time constant with the bridge's resistance
/// (0.6 ohm) in the loop, 6.9 ms, less a tenth for friction, plus 1 ms between two samples.
const STOP_US: i64 = 7_300;

/// What ends a leg at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trip {
    /// The bridge reports a fault (nFAULT).
    Driver,
    /// Short circuit.
    OverCurrent {
        /// Measured.
        current_ma: u16,
    },
    /// The battery is empty.
    LowBattery {
        /// Measured.
        battery_mv: u16,
    },
    /// The motor stands still with the current that it was given.
    Blocked,
    /// The motor turns, by its current, and the encoder does not count.
    EncoderLost,
    /// The motor is driven, draws nothing, and does not turn.
    BridgeSilent,
    /// The motor turns, or pulls the battery down, and its current reads nothing.
    SenseLost,
}

/// What the current says about the thread.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Load {
    /// The thread pulls with the end force.
    pub end_force: bool,
    /// Current above the no-load current, while it can be told.
    pub excess_ma: Option<u16>,
    /// The same without what makes the motor faster.
    pub pull_ma: Option<u16>,
    /// Where the force rose above half of the end force, while it stays above.
    pub rise_from: Option<Counts>,
    /// The same for a quarter of it.
    pub long_rise_from: Option<Counts>,
    /// A fast motor is slowed down, or loaded more than the origami loads it there.
    pub resisted: bool,
    /// It is slowed down: its momentum pulls until it stands.
    pub struck: bool,
    /// The last readings show no current at all, though some was ordered.
    pub silent: bool,
}

/// A condition that must last before it counts.
#[derive(Clone, Copy, Debug, Default)]
struct Debounce(Option<(u64, Counts)>);

impl Debounce {
    /// Where the condition began, once it has lasted for `for_us`.
    fn update(&mut self, now_us: u64, counts: Counts, holds: bool, for_us: u64) -> Option<Counts> {
        if !holds {
            self.0 = None;
            return None;
        }
        let (since_us, began_at) = *self.0.get_or_insert((now_us, counts));
        (now_us.saturating_sub(since_us) >= for_us).then_some(began_at)
    }

    /// Where the condition began, however long ago.
    fn began_at(&self) -> Option<Counts> {
        self.0.map(|(_, began_at)| began_at)
    }
}

/// Watches one leg.
#[derive(Clone, Debug)]
pub struct Detector {
    spooling: Spooling,
    from_us: u64,
    /// The motor has taken up its speed again.
    steady_from_us: u64,
    /// Battery before the drive.
    rest_mv: u16,
    window: Window,
    started_at: Option<Counts>,
    /// Furthest count so far, and when it was reached.
    furthest: Option<(Counts, u64)>,
    driver: Debounce,
    over_current: Debounce,
    surplus: Debounce,
    sag: Debounce,
    collapses: u8,
    /// The last voltage below the limit that could be measured, or the least that can be.
    sagged_mv: u16,
    silence: Debounce,
    end_force: Debounce,
    rise: Debounce,
    long_rise: Debounce,
}

impl Detector {
    /// For a leg whose drive begins at `from_us`, with a battery that has `rest_mv` without load.
    pub fn new(spooling: Spooling, from_us: u64, rest_mv: u16) -> Self {
        Self {
            spooling,
            from_us,
            steady_from_us: 0,
            rest_mv,
            window: Window::new(),
            started_at: None,
            furthest: None,
            driver: Debounce::default(),
            over_current: Debounce::default(),
            surplus: Debounce::default(),
            sag: Debounce::default(),
            collapses: 0,
            sagged_mv: COLLAPSED_MV,
            silence: Debounce::default(),
            end_force: Debounce::default(),
            rise: Debounce::default(),
            long_rise: Debounce::default(),
        }
    }

    /// When the drive begins.
    pub fn from_us(&self) -> u64 {
        self.from_us
    }

    /// Which way the leg goes.
    pub fn spooling(&self) -> Spooling {
        self.spooling
    }

    /// The blanking is over: the current is a measure of force.
    pub fn sees_force(&self, now_us: u64) -> bool {
        now_us.saturating_sub(self.from_us) >= BLANKING_US
    }

    /// Speed in the direction of the leg over the last 8 ms, counts/s.
    pub fn speed_cps(&self) -> i32 {
        self.spooling.along(self.window.speed_cps(8, 0))
    }

    /// The same, and the least that it may have become in the last 3 ms.
    pub fn speeds_cps(&self) -> (i32, i32) {
        let cps = self.speed_cps();
        (
            cps,
            cps.min(self.spooling.along(self.window.speed_cps(3, 0))),
        )
    }

    /// How far the motor runs on in the leg's direction if it is braked now.
    pub fn stopping_distance(&self) -> Counts {
        let counts = i64::from(self.speed_cps().max(0)).saturating_mul(STOP_US) / 1_000_000;
        Counts(i32::try_from(counts).unwrap_or(i32::MAX))
    }

    /// Judges one sample, taken at `now_us` (not before [`Self::from_us`]), after a millisecond in which `ordered_ma`
    /// should have flown; none while braking.
    ///
    /// # Errors
    /// The [`Trip`] that ends the leg.
    pub fn check(
        &mut self,
        now_us: u64,
        sample: &Sample,
        ordered_ma: Option<u16>,
        no_load_ma: u16,
        settings: &Settings,
    ) -> Result<Load, Trip> {
        let Sample {
            counts,
            battery_mv,
            driver_fault,
            ..
        } = *sample;
        let current_ma = sample.magnitude_ma();
        let along_ma = sample.along_ma(self.spooling);
        self.window.push(now_us, sample, along_ma, ordered_ma);
        if ordered_ma.is_none() {
            self.steady_from_us = now_us.saturating_add(AFTER_BRAKE_US);
        }
        let lasts = |condition: &mut Debounce, holds, for_us| {
            condition.update(now_us, counts, holds, for_us).is_some()
        };
        if lasts(&mut self.driver, driver_fault, DRIVER_DEBOUNCE_US) {
            return Err(Trip::Driver);
        }
        if self.is_open(along_ma, battery_mv) {
            return Err(Trip::SenseLost);
        }
        let over = along_ma > OVER_CURRENT_MA as i16 || along_ma < -MOST_BRAKING_MA;
        if lasts(&mut self.over_current, over, OVER_CURRENT_DEBOUNCE_US) {
            return Err(Trip::OverCurrent { current_ma });
        }
        let low = battery_mv < settings.loaded_battery_mv;
        if battery_mv < COLLAPSED_MV {
            self.collapses = self.collapses.saturating_add(1);
        }
        if low && battery_mv >= COLLAPSED_MV {
            self.sagged_mv = battery_mv;
        }
        if lasts(&mut self.sag, low, SAG_DEBOUNCE_US) || self.collapses >= COLLAPSES {
            let battery_mv = self.sagged_mv;
            return Err(Trip::LowBattery { battery_mv });
        }
        if self.turns_uncounted(counts) {
            return Err(Trip::EncoderLost);
        }
        let means = self.window.means_ma(FORCE_READINGS);
        let surplus = means.is_some_and(|(mean_ma, wanted_ma)| {
            u32::from(mean_ma) > 2 * u32::from(wanted_ma) + SURPLUS_MA
        });
        if lasts(&mut self.surplus, surplus, SURPLUS_DEBOUNCE_US) {
            let current_ma = means.map_or(current_ma, |(mean_ma, _)| mean_ma);
            return Err(Trip::OverCurrent { current_ma });
        }
        let ordered = means.is_some_and(|(_, wanted_ma)| wanted_ma >= ORDERED_MA);
        let silent = ordered && self.draws_nothing(FORCE_READINGS);
        if lasts(&mut self.silence, silent, SILENCE_US) && self.makes_progress(now_us) {
            return Err(self.name_of_silence());
        }
        let mut load = self.load(now_us, counts, no_load_ma, settings);
        // What is more than ordered may be a short circuit; its own debounce decides.
        load.end_force &= !surplus;
        let stands = self.stands_still(now_us, counts);
        if load.end_force {
            // A motor that is slow here may pull on while its encoder is lost.
            let name = self.counts_nothing().then(|| self.name_of_standstill());
            return match name {
                Some(lost @ Trip::EncoderLost) => Err(lost),
                _ => Ok(load),
            };
        }
        if stands {
            return Err(self.name_of_standstill());
        }
        Ok(load)
    }

    /// No current either way over so many readings.
    fn draws_nothing(&self, over: usize) -> bool {
        let mean_ma = self.window.along_ma(over);
        mean_ma.is_some_and(|mean_ma| mean_ma.unsigned_abs() < NOTHING_MA.into())
    }

    /// The amplifier's output lies at 0 V, a current that no motor draws: against the drive when it winds, without a sag of the
    /// battery when it pays out.
    fn is_open(&self, along_ma: i16, battery_mv: u16) -> bool {
        match self.spooling {
            Spooling::Wind => along_ma < -RAIL_MA,
            Spooling::PayOut => {
                along_ma > RAIL_MA && self.rest_mv.saturating_sub(battery_mv) < SHORT_SAG_MV
            }
        }
    }

    fn load(&mut self, now_us: u64, counts: Counts, no_load_ma: u16, settings: &Settings) -> Load {
        let seen = self.sees_force(now_us) && now_us >= self.steady_from_us;
        let means = self.window.means_ma(FORCE_READINGS).filter(|_| seen);
        let excess_ma = means.map(|(mean_ma, _)| mean_ma.saturating_sub(no_load_ma));
        let above = |level| excess_ma.is_some_and(|excess| excess >= level);
        // What accelerates the motor does not pull at the thread.
        let accelerating_ma = self.accelerating_ma();
        let pulls = |level| above(accelerating_ma.saturating_add(level));
        let end_force = pulls(settings.force_ma);
        // Shorted for a moment, or not yet steady after it: the force has not gone.
        let told = excess_ma.is_some();
        let rise_from = |rise: &mut Debounce, level_ma| {
            if told {
                // Ripple does not end it.
                let ends_ma = level_ma - level_ma / 8;
                let level_ma = rise.began_at().map_or(level_ma, |_| ends_ma);
                rise.update(now_us, counts, above(level_ma), LOAD_DEBOUNCE_US)
            } else {
                rise.began_at()
            }
        };
        let rise_from_half = rise_from(&mut self.rise, settings.rise_start_ma);
        let long_rise_from = rise_from(&mut self.long_rise, settings.rise_start_ma / 2);
        let met = pulls(settings.met_ma) && self.meets_something();
        let slowed = self.is_slowed();
        Load {
            end_force: self
                .end_force
                .update(now_us, counts, end_force, LOAD_DEBOUNCE_US)
                .is_some()
                || met,
            excess_ma,
            pull_ma: excess_ma.map(|excess_ma| excess_ma.saturating_sub(accelerating_ma)),
            rise_from: rise_from_half,
            long_rise_from,
            resisted: slowed || above(settings.resisted_ma),
            struck: slowed,
            silent: self.window.is_driven(SILENT_READINGS) && self.draws_nothing(SILENT_READINGS),
        }
    }

    /// Over the last 2 ms the motor was slower than over 8 ms before, by more than it has been losing anyway, and not because
    /// it was braked.
    fn is_slowed(&self) -> bool {
        let earlier = self.spooling.along(self.window.speed_cps(28, 12));
        let before = self.spooling.along(self.window.speed_cps(12, 4));
        let now = self.spooling.along(self.window.speed_cps(2, 0));
        // The middles of the three are 12 and 7 ms apart.
        let losing = earlier.saturating_sub(before).max(0) / 12 * 7;
        let sudden = (before / 14).max(STRUCK_LOSS_CPS);
        let least = before.saturating_sub(losing).saturating_sub(sudden);
        self.window.is_driven(12) && before >= FAST_CPS && now < least
    }

    /// Part of the current that makes the motor faster; none while it becomes slower.
    fn accelerating_ma(&self) -> u16 {
        let before = self.spooling.along(self.window.speed_cps(24, 12));
        let now = self.spooling.along(self.window.speed_cps(12, 0));
        // Counts/s more than 12 ms before.
        let gained = now.saturating_sub(before).max(0).unsigned_abs();
        let cps2 = gained.saturating_mul(1_000) / 12;
        u16::try_from(cps2 / COASTING_CPS2_PER_MA).unwrap_or(u16::MAX)
    }

    /// A slow motor has lost a fifth of its speed within 3 ms, beyond what it has been losing anyway, still turns, and not
    /// because less current was ordered. The
    /// current follows later, and the motor's momentum pulls meanwhile.
    fn meets_something(&self) -> bool {
        let earlier = self.spooling.along(self.window.speed_cps(27, 11));
        let before = self.spooling.along(self.window.speed_cps(11, 3));
        let now = self.spooling.along(self.window.speed_cps(3, 0));
        // The middles of the three are 12 and 5.5 ms apart.
        let losing = earlier.saturating_sub(before).max(0) / 24 * 11;
        let turns = self.window.step(0).is_some_and(|step| step.abs() >= 2);
        before >= SLOW_CPS_AT_LEAST
            && now < (before - before / 5).saturating_sub(losing)
            && turns
            && self.window.orders_most_now(ORDERED_READINGS)
    }

    /// The encoder has counted nothing for 10 ms, one line that flickers at most.
    fn counts_nothing(&self) -> bool {
        (0..STILL_READINGS).all(|age| self.window.step(age).is_some_and(|step| step.abs() <= 1))
    }

    /// The counts end within 1 ms, for 3 ms: a motor needs longer to stop. Or they go the wrong way.
    fn turns_uncounted(&mut self, counts: Counts) -> bool {
        let started_at = *self.started_at.get_or_insert(counts);
        let way = self.spooling.along(counts.since(started_at).0);
        if way <= -WRONG_WAY_COUNTS {
            return true;
        }
        let steps: [Option<i32>; 7] = core::array::from_fn(|age| self.window.step(age));
        let [
            Some(a),
            Some(b),
            Some(c),
            Some(_),
            Some(d),
            Some(e),
            Some(f),
        ] = steps
        else {
            return false;
        };
        // A motor that is being stopped, because it has met something, may end as suddenly.
        if !self.window.is_driven(steps.len()) {
            return false;
        }
        // Two steps lie between `d` and the first without progress. A jam takes 2 counts per ms and ms.
        let (d, e, f) = (d.abs(), e.abs(), f.abs());
        let steady = d >= 8 || d >= 4 && e.max(f) <= d + 1;
        let stopped = [a, b, c].iter().all(|step| step.abs() <= 1) && (a + b + c).abs() <= 1;
        steady && stopped
    }

    /// Mean of the current in the leg's direction over the last readings, if all of them were driven.
    pub fn mean_ma(&self) -> Option<u16> {
        self.window.means_ma(FORCE_READINGS).map(|(mean, _)| mean)
    }

    fn makes_progress(&self, now_us: u64) -> bool {
        self.furthest
            .is_some_and(|(_, since_us)| now_us.saturating_sub(since_us) < STANDSTILL_US / 4)
    }

    /// The motor turns, and its current reads nothing: a motor without current becomes slower.
    fn name_of_silence(&self) -> Trip {
        let before = self.spooling.along(
            self.window
                .speed_cps(SILENCE_READINGS + FORCE_READINGS, SILENCE_READINGS),
        );
        let now = self.spooling.along(self.window.speed_cps(4, 0));
        if now < before - before / 16 {
            Trip::BridgeSilent
        } else {
            Trip::SenseLost
        }
    }

    fn name_of_standstill(&self) -> Trip {
        let Some((mean_ma, wanted_ma)) = self.window.means_ma(FORCE_READINGS) else {
            return Trip::Blocked; // driven and braked by turns
        };
        let sag_mv = self
            .window
            .battery_mv(FORCE_READINGS)
            .map_or(0, |loaded_mv| self.rest_mv.saturating_sub(loaded_mv));
        // A motor that turns uncounted is ordered as one that stands, and is braked by that for a while.
        if self.draws_nothing(FORCE_READINGS) && self.draws_nothing(ORDERED_READINGS) {
            if sag_mv >= LEAST_SAG_MV {
                Trip::SenseLost
            } else {
                Trip::BridgeSilent
            }
        } else if u32::from(mean_ma) * 100 >= u32::from(wanted_ma) * STALLED_PERCENT {
            Trip::Blocked
        } else {
            Trip::EncoderLost
        }
    }

    fn stands_still(&mut self, now_us: u64, counts: Counts) -> bool {
        let (furthest, since_us) = *self.furthest.get_or_insert((counts, now_us));
        if self.spooling.along(counts.since(furthest).0) >= PROGRESS_COUNTS {
            self.furthest = Some((counts, now_us));
            return false;
        }
        now_us.saturating_sub(since_us) >= STANDSTILL_US
    }
}

#[cfg(test)]
#[path = "../tests/unit/detect.rs"]
mod tests;

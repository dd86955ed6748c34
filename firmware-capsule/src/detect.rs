//! Judges one leg of a motion by the motor's current, its encoder and the battery.
//!
//! Every start and every reversal creates a new [`Detector`]. The current is the mean over one PWM period. The speed
//! loop bounds it: a healthy motor never draws more than 250 mA, even from standstill or blocked.

use crate::sample::{Sample, Spooling};
use crate::{
    mechanics::{COASTING_CPS2_PER_MA, Counts},
    settings::Settings,
    window::Window,
};

/// After a start the motor accelerates for this long, and its current says nothing about force.
pub const BLANKING_US: u64 = 30_000;
/// The same after a brake within a leg, while the motor takes up its speed again.
const AFTER_BRAKE_US: u64 = 40_000;
/// Readings over which the current is averaged. All of them must have been driven.
const FORCE_READINGS: usize = 8;
/// Time that a load must last.
const LOAD_DEBOUNCE_US: u64 = 2_000;
/// Longest time that a driven motor may make no progress.
pub const STANDSTILL_US: u64 = 40_000;
/// Counts that make progress: two encoder lines, because one broken channel makes the count flicker by one on the
/// spot.
const PROGRESS_COUNTS: i32 = 8;
/// Counts in the wrong direction, 0.05 mm, that reveal swapped encoder lines.
const WRONG_WAY_COUNTS: i32 = 40;
/// Over-current: twice the current that the speed loop lets a healthy motor draw.
pub const OVER_CURRENT_MA: u16 = 450;
/// Largest plausible current against the drive: a motor braked from full speed draws 0.6 A.
const MOST_BRAKING_MA: i16 = 800;
/// Time that an over-current must last.
const OVER_CURRENT_DEBOUNCE_US: u64 = 2_000;
/// Short circuit: above twice the ordered current plus this.
const SURPLUS_MA: u32 = 60;
/// Time that this surplus must last. When something stops the motor, its back-EMF is overestimated for 3 ms.
const SURPLUS_DEBOUNCE_US: u64 = 4_000;
/// A blocked motor draws the ordered current, within the tolerances of winding, cell and amplifier. A turning one
/// draws less than this share, by its back-EMF.
const STALLED_PERCENT: u32 = 85;
/// Time that a sag of the battery must last.
const SAG_DEBOUNCE_US: u64 = 15_000;
/// Below this the cell has collapsed. The chip's own supply falls with it, so that readings mean nothing.
const COLLAPSED_MV: u16 = 2_000;
/// Collapsed readings, not necessarily in a row, that end a leg: a collapse stops the drive, and the cell recovers
/// meanwhile.
const COLLAPSES: u8 = 5;
/// Time that nFAULT must last: the bridge needs up to 1 ms to wake up (DRV8833).
const DRIVER_DEBOUNCE_US: u64 = 3_000;
/// Current near the end of the amplifier's range, which is 1,475 mA at the lowest supply.
const RAIL_MA: i16 = 1_300;
/// A real current near that range sags the battery by at least this, if it is driven at least half of the time.
const SHORT_SAG_MV: u16 = 100;
/// Below this no current flows: a turning motor draws at least 10 mA.
const NOTHING_MA: u16 = 5;
/// Readings without current after which the thread is not taken for slack. A dead amplifier is named later.
const SILENT_READINGS: usize = 3;
/// Smallest ordered current whose absence means something.
const ORDERED_MA: u16 = 12;
/// Time without current after which its cause is determined.
const SILENCE_US: u64 = 24_000;
/// Age of the readings with which the speed is compared: the silence, less the window over which the speed is
/// measured.
const SILENCE_READINGS: usize = 22;
/// Least sag of the battery from a blocked motor that draws current; a cell has at least 0.3 ohm.
const LEAST_SAG_MV: u16 = 15;
/// Minimum speed for detecting a sudden resistance, counts/s: 7 mm/s.
const FAST_CPS: i32 = 6_000;
/// Sudden loss of speed, counts/s: more than one and a half counts in 2 ms, because rounding alone makes one.
const STRUCK_LOSS_CPS: i32 = 750;
/// Surplus over the ordered current, above its mean over the readings before, that a sudden loss of speed causes, mA:
/// 700 counts/s. Healthy folds reach 20 mA.
const SURGE_MA: i32 = 22;
/// Readings in that mean.
const BEFORE_SURGE: usize = 10;
/// Minimum speed at which the loss of a fifth exceeds rounding, counts/s.
const SLOW_CPS_AT_LEAST: i32 = 3_000;
/// Two successive readings have to show that loss, us: rounding and the encoder's phase together reach it in one.
const MET_DEBOUNCE_US: u64 = 500;
/// Readings within which the ordered current must not have fallen.
const ORDERED_READINGS: usize = 20;
/// Readings without a count after which a motor at the end force is suspected of a lost encoder.
const STILL_READINGS: usize = 10;
/// Stopping distance of a braked motor over its speed: its time constant with the bridge's 0.6 ohm in the loop, 6.9
/// ms, less a tenth for friction, plus 1 ms between two samples.
const STOP_US: i64 = 7_300;

/// A condition that ends a leg at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trip {
    /// The bridge reports a fault (nFAULT).
    Driver,
    /// Short circuit.
    OverCurrent {
        /// Measured current.
        current_ma: u16,
    },
    /// The battery is empty.
    LowBattery {
        /// Measured voltage.
        battery_mv: u16,
    },
    /// The motor stands still although it draws the ordered current.
    Blocked,
    /// The current shows that the motor turns, but the encoder does not count.
    EncoderLost,
    /// The motor is driven but draws nothing and does not turn.
    BridgeSilent,
    /// The motor turns or sags the battery, but its current reads nothing.
    SenseLost,
}

/// Load of the thread, judged by the current.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Load {
    /// The thread pulls with the end force.
    pub end_force: bool,
    /// Current above the no-load current; none while it is unknown.
    pub excess_ma: Option<u16>,
    /// `excess_ma` less the current that accelerates the motor.
    pub pull_ma: Option<u16>,
    /// Where the force rose above half of the end force; none once it has fallen again.
    pub rise_from: Option<Counts>,
    /// The same for a quarter of the end force.
    pub long_rise_from: Option<Counts>,
    /// A fast motor is losing speed suddenly, or is loaded more than the origami loads it there.
    pub resisted: bool,
    /// The motor is losing speed suddenly: its momentum pulls until it stands.
    pub struck: bool,
    /// The motor has made no progress for 40 ms although it is driven.
    pub stands: bool,
    /// The last readings show no current although some was ordered.
    pub silent: bool,
}

/// A condition that counts once it has lasted long enough.
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

    /// Where the condition began, even if it has not lasted yet.
    fn began_at(&self) -> Option<Counts> {
        self.0.map(|(_, began_at)| began_at)
    }
}

/// Watches one leg.
#[derive(Clone, Debug)]
pub struct Detector {
    spooling: Spooling,
    from_us: u64,
    /// From this time on the motor is back at its speed after a brake.
    steady_from_us: u64,
    /// Battery voltage without load, before the drive.
    rest_mv: u16,
    window: Window,
    started_at: Option<Counts>,
    /// Furthest count so far, and the time at which it was reached.
    furthest: Option<(Counts, u64)>,
    driver: Debounce,
    over_current: Debounce,
    surplus: Debounce,
    sag: Debounce,
    collapses: u8,
    /// The last meaningful voltage below the limit; before the first, the lowest one that can be measured.
    sagged_mv: u16,
    silence: Debounce,
    end_force: Debounce,
    met: Debounce,
    rise: Debounce,
    long_rise: Debounce,
}

impl Detector {
    /// Watches a leg whose drive begins at `from_us`. `rest_mv` is the battery voltage without load.
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
            met: Debounce::default(),
            rise: Debounce::default(),
            long_rise: Debounce::default(),
        }
    }

    /// Time at which the drive begins.
    pub fn from_us(&self) -> u64 {
        self.from_us
    }

    /// Direction of the leg.
    pub fn spooling(&self) -> Spooling {
        self.spooling
    }

    /// The blanking is over, so the current is a measure of force.
    pub fn sees_force(&self, now_us: u64) -> bool {
        now_us.saturating_sub(self.from_us) >= BLANKING_US
    }

    /// Speed in the direction of the leg over the last 8 ms, counts/s.
    pub fn speed_cps(&self) -> i32 {
        self.spooling.along(self.window.speed_cps(8, 0))
    }

    /// The speed over the last 8 ms, and the lowest value that it may have reached in the last 3 ms.
    pub fn speeds_cps(&self) -> (i32, i32) {
        let cps = self.speed_cps();
        (
            cps,
            cps.min(self.spooling.along(self.window.speed_cps(3, 0))),
        )
    }

    /// Distance that the motor runs on in the leg's direction if it is braked now.
    pub fn stopping_distance(&self) -> Counts {
        let counts = i64::from(self.speed_cps().max(0)).saturating_mul(STOP_US) / 1_000_000;
        Counts(i32::try_from(counts).unwrap_or(i32::MAX))
    }

    /// Judges one sample, taken at `now_us` (not before [`Self::from_us`]). `ordered_ma` should have flown in the
    /// millisecond before it; none while braking.
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
        if self.is_open(along_ma, battery_mv, ordered_ma.is_some()) {
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
        // A surplus may be a short circuit, which has its own debounce. It is not an end force. Nor does a force end a
        // leg that pays out: a motor that stands there is blocked.
        load.end_force &= !surplus && self.spooling == Spooling::Wind;
        let stands = self.stands_still(now_us, counts);
        load.stands = stands;
        if load.end_force {
            // A motor whose encoder is lost reads as standing here, and would go on pulling.
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

    /// The mean current over this many readings is nothing, either way.
    fn draws_nothing(&self, over: usize) -> bool {
        let mean_ma = self.window.along_ma(over);
        mean_ma.is_some_and(|mean_ma| mean_ma.unsigned_abs() < NOTHING_MA.into())
    }

    /// The amplifier's output is open and lies at 0 V, which reads as a current that no motor draws. While winding, it
    /// is against the drive; a motor that is not `driven` forwards, but against a blow, may draw one. While paying out,
    /// the battery does not sag as it would under a real one.
    fn is_open(&self, along_ma: i16, battery_mv: u16, driven: bool) -> bool {
        match self.spooling {
            Spooling::Wind => driven && along_ma < -RAIL_MA,
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
        // The current that accelerates the motor does not pull at the thread.
        let accelerating_ma = self.accelerating_ma();
        let pulls = |level| above(accelerating_ma.saturating_add(level));
        let end_force = pulls(settings.force_ma);
        // No reading while the motor is braked or not yet steady after it: the force is still there, so keep the
        // start.
        let told = excess_ma.is_some();
        let rise_from = |rise: &mut Debounce, level_ma| {
            if told {
                // Hysteresis, so that ripple does not end it.
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
        let met = self.met.update(now_us, counts, met, MET_DEBOUNCE_US);
        let slowed = self.is_slowed();
        Load {
            end_force: self
                .end_force
                .update(now_us, counts, end_force, LOAD_DEBOUNCE_US)
                .is_some()
                || met.is_some(),
            excess_ma,
            pull_ma: excess_ma.map(|excess_ma| excess_ma.saturating_sub(accelerating_ma)),
            rise_from: rise_from_half,
            long_rise_from,
            resisted: slowed || above(settings.resisted_ma),
            // A motor that draws so much is short-circuited. Driven backwards against its momentum, it would read like
            // an amplifier whose output is open.
            struck: slowed && self.over_current.began_at().is_none(),
            stands: false,
            silent: self.window.is_driven(SILENT_READINGS) && self.draws_nothing(SILENT_READINGS),
        }
    }

    /// The motor has lost speed suddenly: over the last 2 ms it was slower than over the 8 ms before, by more than
    /// its earlier trend, and not because it was braked. Half of that loss counts if the current rises with it.
    fn is_slowed(&self) -> bool {
        let before = self.spooling.along(self.window.speed_cps(12, 4));
        let now = self.spooling.along(self.window.speed_cps(2, 0));
        let sudden = (before / 14).max(STRUCK_LOSS_CPS);
        // Nearly always true; skip the rest, which would delay the next duty.
        if before < FAST_CPS || now >= before.saturating_sub(sudden / 2) {
            return false;
        }
        let earlier = self.spooling.along(self.window.speed_cps(28, 12));
        // The middles of the three windows are 12 and 7 ms apart.
        let losing = earlier.saturating_sub(before).max(0) / 12 * 7;
        let least = before.saturating_sub(losing);
        if !self.window.is_driven(12) || now >= least.saturating_sub(sudden / 2) {
            return false;
        }
        // A motor that is slowed draws more than ordered before its counts tell.
        now < least.saturating_sub(sudden) || self.window.surge_ma(BEFORE_SURGE) >= Some(SURGE_MA)
    }

    /// Part of the current that accelerates the motor; 0 while it slows down.
    fn accelerating_ma(&self) -> u16 {
        let before = self.spooling.along(self.window.speed_cps(24, 12));
        let now = self.spooling.along(self.window.speed_cps(12, 0));
        // Gain of speed over 12 ms, counts/s.
        let gained = now.saturating_sub(before).max(0).unsigned_abs();
        let cps2 = gained.saturating_mul(1_000) / 12;
        u16::try_from(cps2 / COASTING_CPS2_PER_MA).unwrap_or(u16::MAX)
    }

    /// A slow motor has lost a fifth of its speed within 3 ms, beyond its earlier trend. It still turns, and no less
    /// current was ordered. The current follows later; meanwhile the motor's momentum pulls.
    fn meets_something(&self) -> bool {
        let earlier = self.spooling.along(self.window.speed_cps(27, 11));
        let before = self.spooling.along(self.window.speed_cps(11, 3));
        let now = self.spooling.along(self.window.speed_cps(3, 0));
        // The middles of the three windows are 12 and 5.5 ms apart.
        let losing = earlier.saturating_sub(before).max(0) / 24 * 11;
        let turns = self.window.step(0).is_some_and(|step| step.abs() >= 2);
        before >= SLOW_CPS_AT_LEAST
            && now < (before - before / 5).saturating_sub(losing)
            && turns
            && self.window.orders_most_now(ORDERED_READINGS)
    }

    /// The encoder has counted nothing for 10 ms, apart from one line that may flicker.
    fn counts_nothing(&self) -> bool {
        (0..STILL_READINGS).all(|age| self.window.step(age).is_some_and(|step| step.abs() <= 1))
    }

    /// The counts stop within 1 ms and stay away for 3 ms, though a motor needs longer to stop. Or they run the wrong
    /// way.
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
        // A motor that is being braked, because it has met something, may stop as suddenly.
        if !self.window.is_driven(steps.len()) {
            return false;
        }
        // Two steps lie between `d` and the first one without progress. A jam takes 2 counts per ms off the step in
        // each ms.
        let (d, e, f) = (d.abs(), e.abs(), f.abs());
        let steady = d >= 8 || d >= 4 && e.max(f) <= d + 1;
        let stopped = [a, b, c].iter().all(|step| step.abs() <= 1) && (a + b + c).abs() <= 1;
        steady && stopped
    }

    /// Mean current in the leg's direction over the last readings; none unless all of them were driven.
    pub fn mean_ma(&self) -> Option<u16> {
        self.window.means_ma(FORCE_READINGS).map(|(mean, _)| mean)
    }

    fn makes_progress(&self, now_us: u64) -> bool {
        self.furthest
            .is_some_and(|(_, since_us)| now_us.saturating_sub(since_us) < STANDSTILL_US / 4)
    }

    /// Names the cause when the motor turns and its current reads nothing. A motor that really has no current slows
    /// down.
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
        // Check the longer time too: a motor whose turning is not counted is driven like a standing one. The drive then
        // brakes it, and it draws nothing for a while.
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

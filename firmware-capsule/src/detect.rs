//! What the motor's current, its encoder and the battery say about one leg of a motion.
//!
//! Every start and every reversal creates a new [`Detector`]. The inrush current of a motor at rest reaches 0.7 A and
//! decays with a time constant of 6 ms, so the current is ignored for the first 30 ms.
//!
//! The current is the mean over one PWM period. The bridge lets the motor coast between its pulses, so the motor
//! sees `duty * (battery - back-EMF) / R` and never regenerates. At part duty the inrush is therefore smaller and
//! lasts longer (6 ms / duty), and an unloaded motor turns almost as fast as at full duty.

use crate::mechanics::{Counts, FORCE_MA, MOTOR_MILLIOHM, RISE_START_MA};

/// One reading of the sensors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sample {
    /// Encoder.
    pub counts: Counts,
    /// Magnitude of the motor current.
    pub current_ma: u16,
    /// The shunt amplifier's offset, taken at rest; `current_ma` is without it, unless it is too large.
    pub offset_ma: u16,
    /// Battery voltage.
    pub battery_mv: u16,
    /// The bridge pulls nFAULT low.
    pub driver_fault: bool,
}

/// Which way the spool turns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Spooling {
    /// Thread onto the spool.
    Wind,
    /// Thread off the spool.
    PayOut,
}

impl Spooling {
    /// Counts from `from` to `to`, positive in this direction.
    fn travel(self, from: Counts, to: Counts) -> Counts {
        match self {
            Spooling::Wind => to.since(from),
            Spooling::PayOut => from.since(to),
        }
    }
}

/// After a start the current says nothing about force for this long: five time constants at full duty, two at
/// 1.5 V, which leave 34 mA of inrush.
pub const BLANKING_US: u64 = 30_000;
/// The engagement is a small load and shows only after the longer inrush at 1.5 V: six times 15 ms.
const ENGAGEMENT_BLANKING_US: u64 = 90_000;
/// Force and over-current must last this long.
pub const LOAD_DEBOUNCE_US: u64 = 5_000;
/// A driven motor may make no progress for this long.
pub const STANDSTILL_US: u64 = 50_000;
/// Two encoder lines count as progress. With one channel broken the count flickers by one on the spot; with the
/// channels swapped it runs backwards. Neither is progress.
const PROGRESS_COUNTS: i32 = 8;
/// Above the stall current of a full battery (4.2 V / 5.4 ohm = 778 mA) it is a short circuit. Not blanked.
pub const OVER_CURRENT_MA: u16 = 800;
/// A battery that sags below this under load is empty.
pub const BATTERY_UNDER_LOAD_MV: u16 = 2_700;
/// A sag must last this long: a reversal's inrush must not trip it.
const SAG_DEBOUNCE_US: u64 = 20_000;
/// Ignores nFAULT while the bridge wakes up (DRV8833: 1 ms).
const DRIVER_DEBOUNCE_US: u64 = 3_000;
/// Shortest time over which the speed is measured; 17 counts per ms are usual.
const SPEED_WINDOW_US: u64 = 4_000;
/// Speed times this is the stopping distance of a braked motor: its time constant with the bridge's resistance
/// (0.6 ohm) in the loop, 6.9 ms, less a tenth for friction, plus 1 ms between two samples.
const STOP_US: i64 = 7_300;
/// The no-load current is averaged over this time after the blanking.
const NO_LOAD_US: u64 = 50_000;

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
    /// No progress and hardly any back-EMF: the motor stands still.
    Blocked,
    /// No progress, but the back-EMF says that the motor turns.
    EncoderLost,
}

/// What the current says about the thread.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Load {
    /// The thread pulls with the end force.
    pub end_force: bool,
    /// Where the current rose above the no-load current, while it stays above.
    pub engaged_at: Option<Counts>,
    /// Where the force rose above 3 N, while it stays above.
    pub rise_from: Option<Counts>,
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
}

#[derive(Clone, Copy, Debug, Default)]
struct Mean {
    sum: u32,
    samples: u32,
}

/// Watches one leg.
#[derive(Clone, Debug)]
pub struct Detector {
    spooling: Spooling,
    from_us: u64,
    /// Furthest count so far, and when it was reached.
    furthest: Option<(Counts, u64)>,
    driver: Debounce,
    over_current: Debounce,
    sag: Debounce,
    end_force: Debounce,
    engaged: Debounce,
    rise: Debounce,
    no_load: Mean,
    speed_from: Option<(Counts, u64)>,
    counts_per_s: i64,
}

impl Detector {
    /// For a leg whose drive begins at `from_us`.
    pub fn new(spooling: Spooling, from_us: u64) -> Self {
        Self {
            spooling,
            from_us,
            furthest: None,
            driver: Debounce::default(),
            over_current: Debounce::default(),
            sag: Debounce::default(),
            end_force: Debounce::default(),
            engaged: Debounce::default(),
            rise: Debounce::default(),
            no_load: Mean::default(),
            speed_from: None,
            counts_per_s: 0,
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

    /// Judges one sample, taken at `now_us` (not before [`Self::from_us`]) with the magnitude `drive_mv` at the motor.
    ///
    /// # Errors
    /// The [`Trip`] that ends the leg.
    pub fn check(
        &mut self,
        now_us: u64,
        sample: &Sample,
        drive_mv: u16,
        no_load_ma: u16,
    ) -> Result<Load, Trip> {
        let Sample {
            counts,
            current_ma,
            battery_mv,
            driver_fault,
            ..
        } = *sample;
        if self
            .driver
            .update(now_us, counts, driver_fault, DRIVER_DEBOUNCE_US)
            .is_some()
        {
            return Err(Trip::Driver);
        }
        self.measure_speed(now_us, counts);
        let over = current_ma > OVER_CURRENT_MA;
        if self
            .over_current
            .update(now_us, counts, over, LOAD_DEBOUNCE_US)
            .is_some()
        {
            return Err(Trip::OverCurrent { current_ma });
        }
        let load = if self.sees_force(now_us) {
            let low = battery_mv < BATTERY_UNDER_LOAD_MV;
            if self
                .sag
                .update(now_us, counts, low, SAG_DEBOUNCE_US)
                .is_some()
            {
                return Err(Trip::LowBattery { battery_mv });
            }
            self.load(now_us, counts, current_ma, no_load_ma)
        } else {
            Load::default()
        };
        if !load.end_force && self.stands_still(now_us, counts) {
            return Err(if is_stall(current_ma, drive_mv) {
                Trip::Blocked
            } else {
                Trip::EncoderLost
            });
        }
        Ok(load)
    }

    fn load(&mut self, now_us: u64, counts: Counts, current_ma: u16, no_load_ma: u16) -> Load {
        let driven_us = now_us.saturating_sub(self.from_us);
        if driven_us < BLANKING_US + NO_LOAD_US {
            self.no_load.sum = self.no_load.sum.saturating_add(u32::from(current_ma));
            self.no_load.samples = self.no_load.samples.saturating_add(1);
        }
        // Loaded: above 1.3 times the no-load current.
        let loaded = u32::from(current_ma) * 10 > u32::from(no_load_ma) * 13;
        let engaged = driven_us >= ENGAGEMENT_BLANKING_US && loaded;
        let end_force = current_ma >= FORCE_MA;
        let rise = current_ma >= RISE_START_MA;
        Load {
            end_force: self
                .end_force
                .update(now_us, counts, end_force, LOAD_DEBOUNCE_US)
                .is_some(),
            engaged_at: self
                .engaged
                .update(now_us, counts, engaged, LOAD_DEBOUNCE_US),
            rise_from: self.rise.update(now_us, counts, rise, LOAD_DEBOUNCE_US),
        }
    }

    /// Mean current of the 50 ms after the blanking, once they have passed. It is the no-load current only if the
    /// thread was slack.
    pub fn first_mean_ma(&self, now_us: u64) -> Option<u16> {
        let over = now_us.saturating_sub(self.from_us) >= BLANKING_US + NO_LOAD_US;
        let mean = self.no_load.sum.checked_div(self.no_load.samples)?;
        over.then(|| u16::try_from(mean).unwrap_or(u16::MAX))
    }

    /// How far the motor runs on in the leg's direction if it is braked now.
    pub fn stopping_distance(&self) -> Counts {
        let counts = self.counts_per_s.saturating_mul(STOP_US) / 1_000_000;
        Counts(i32::try_from(counts).unwrap_or(i32::MAX))
    }

    /// Updates the speed once [`SPEED_WINDOW_US`] have passed since the last update.
    fn measure_speed(&mut self, now_us: u64, counts: Counts) {
        let (from, since_us) = *self.speed_from.get_or_insert((counts, now_us));
        let elapsed_us = now_us.saturating_sub(since_us);
        if elapsed_us < SPEED_WINDOW_US {
            return;
        }
        let travel = self.spooling.travel(from, counts);
        let elapsed_us = i64::try_from(elapsed_us).unwrap_or(i64::MAX);
        self.counts_per_s = (i64::from(travel.0) * 1_000_000 / elapsed_us).max(0);
        self.speed_from = Some((counts, now_us));
    }

    fn stands_still(&mut self, now_us: u64, counts: Counts) -> bool {
        let (furthest, since_us) = *self.furthest.get_or_insert((counts, now_us));
        if self.spooling.travel(furthest, counts).0 >= PROGRESS_COUNTS {
            self.furthest = Some((counts, now_us));
            return false;
        }
        now_us.saturating_sub(since_us) >= STANDSTILL_US
    }
}

/// The back-EMF is below a quarter of the battery voltage: `i R >= 3/4 duty * battery`.
fn is_stall(current_ma: u16, drive_mv: u16) -> bool {
    let resistive_mv = u32::from(current_ma) * MOTOR_MILLIOHM / 1_000;
    resistive_mv * 4 >= u32::from(drive_mv) * 3
}

#[cfg(test)]
#[path = "../tests/unit/detect.rs"]
mod tests;

//! What the motor's current, its encoder and the battery say about one leg of a motion.
//!
//! Every start and every reversal begins a new [`Detector`]: the inrush of a motor at rest is up to 0.7 A and
//! decays with a time constant of 6 ms, so nothing that is read from the current counts during the first 30 ms.
//!
//! The current is the mean over a PWM period. The bridge lets the motor run free between its pulses, so the motor
//! sees `duty * (battery - back-EMF) / R` and never feeds back: at part duty the inrush is smaller and lasts longer
//! (6 ms / duty), and without load the motor turns almost as fast as at full duty. See `board.rs` for why.

use crate::mechanics::{Counts, FIRM_MA, FORCE_MA, MOTOR_MILLIOHM};

/// One reading of the sensors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sample {
    /// Encoder.
    pub counts: Counts,
    /// Motor current, whatever its direction.
    pub current_ma: u16,
    /// Battery.
    pub battery_mv: u16,
    /// The bridge pulls nFAULT low.
    pub driver_fault: bool,
}

/// Which way the motor turns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// Thread up.
    Wind,
    /// Thread out.
    PayOut,
}

/// The current is no measure of force this long after a start: five time constants at full duty; at 1.5 V two, after
/// which 34 mA are left.
pub const BLANKING_US: u64 = 30_000;
/// A load as small as that of the engagement shows only after the longer inrush at 1.5 V: six times 15 ms.
const ENGAGEMENT_BLANKING_US: u64 = 90_000;
/// A force or an over-current must last this long.
pub const HOLD_US: u64 = 5_000;
/// The encoder may stand still this long while the motor is driven.
pub const STANDSTILL_US: u64 = 50_000;
/// Progress that counts as turning: two lines of the encoder. A single broken channel makes the count flicker by
/// one on the spot, swapped channels make it run backwards; neither is progress.
const PROGRESS_COUNTS: i32 = 8;
/// Above the stall current of a full battery (4.2 V / 5.4 ohm = 778 mA): a short circuit. Not blanked.
pub const OVER_CURRENT_MA: u16 = 800;
/// A battery that sags below this under load is empty.
pub const BATTERY_UNDER_LOAD_MV: u16 = 2_700;
/// It must last this long, so that a reversal's inrush is no reason.
const SAG_US: u64 = 20_000;
/// nFAULT is ignored while the bridge wakes up (DRV8833: 1 ms).
const DRIVER_HOLD_US: u64 = 3_000;
/// The speed is taken over this time; 17 counts per ms are usual.
const PACE_US: u64 = 4_000;
/// Speed times this is how far a braked motor runs on: its time constant with the bridge's own resistance
/// (0.6 ohm) in the loop, 6.9 ms, less a tenth by friction, and 1 ms between two samples.
const STOP_US: i64 = 7_300;
/// The no-load current is the mean over this time after the blanking.
const NO_LOAD_US: u64 = 50_000;

/// What ends a leg at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trouble {
    /// nFAULT.
    Driver,
    /// Short circuit.
    OverCurrent {
        /// Measured.
        current_ma: u16,
    },
    /// Empty.
    LowBattery {
        /// Measured.
        battery_mv: u16,
    },
    /// No progress, and hardly any back-EMF: the motor stands still.
    Blocked,
    /// No progress although the back-EMF says that the motor turns.
    EncoderLost,
}

/// What the current says about the thread.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Load {
    /// The end force is reached.
    pub force: bool,
    /// The current is above the no-load current, since this count.
    pub engaged: Option<Counts>,
    /// The force is above 3 N, since this count.
    pub firm: Option<Counts>,
}

/// A condition that must hold for a while.
#[derive(Clone, Copy, Debug, Default)]
struct Held(Option<(u64, Counts)>);

impl Held {
    /// Where the condition began, once it has held for `hold_us`.
    fn update(&mut self, now_us: u64, counts: Counts, holds: bool, hold_us: u64) -> Option<Counts> {
        if !holds {
            self.0 = None;
            return None;
        }
        let (since_us, began) = *self.0.get_or_insert((now_us, counts));
        (now_us.saturating_sub(since_us) >= hold_us).then_some(began)
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
    direction: Direction,
    from_us: u64,
    /// Best count so far, and when it was reached.
    furthest: Option<(Counts, u64)>,
    driver: Held,
    over_current: Held,
    sag: Held,
    force: Held,
    engaged: Held,
    firm: Held,
    mean: Mean,
    pace: Option<(Counts, u64)>,
    counts_per_s: i64,
}

impl Detector {
    /// For a leg whose drive begins at `from_us`.
    pub fn new(direction: Direction, from_us: u64) -> Self {
        Self {
            direction,
            from_us,
            furthest: None,
            driver: Held::default(),
            over_current: Held::default(),
            sag: Held::default(),
            force: Held::default(),
            engaged: Held::default(),
            firm: Held::default(),
            mean: Mean::default(),
            pace: None,
            counts_per_s: 0,
        }
    }

    /// When the drive begins.
    pub fn from_us(&self) -> u64 {
        self.from_us
    }

    /// Which way.
    pub fn direction(&self) -> Direction {
        self.direction
    }

    /// The current means something now.
    pub fn sees_current(&self, now_us: u64) -> bool {
        now_us.saturating_sub(self.from_us) >= BLANKING_US
    }

    /// Judges one sample that was taken at `now_us`, not before [`Self::from_us`], with `drive_mv` (a magnitude)
    /// at the motor.
    ///
    /// # Errors
    /// The [`Trouble`] that must end the leg.
    pub fn check(
        &mut self,
        now_us: u64,
        sample: &Sample,
        drive_mv: u16,
        no_load_ma: u16,
    ) -> Result<Load, Trouble> {
        let Sample {
            counts,
            current_ma,
            battery_mv,
            driver_fault,
        } = *sample;
        if self
            .driver
            .update(now_us, counts, driver_fault, DRIVER_HOLD_US)
            .is_some()
        {
            return Err(Trouble::Driver);
        }
        self.measure_speed(now_us, counts);
        let over = current_ma > OVER_CURRENT_MA;
        if self
            .over_current
            .update(now_us, counts, over, HOLD_US)
            .is_some()
        {
            return Err(Trouble::OverCurrent { current_ma });
        }
        let load = if self.sees_current(now_us) {
            let low = battery_mv < BATTERY_UNDER_LOAD_MV;
            if self.sag.update(now_us, counts, low, SAG_US).is_some() {
                return Err(Trouble::LowBattery { battery_mv });
            }
            self.load(now_us, counts, current_ma, no_load_ma)
        } else {
            Load::default()
        };
        if !load.force && self.stands_still(now_us, counts) {
            return Err(if is_stall(current_ma, drive_mv) {
                Trouble::Blocked
            } else {
                Trouble::EncoderLost
            });
        }
        Ok(load)
    }

    fn load(&mut self, now_us: u64, counts: Counts, current_ma: u16, no_load_ma: u16) -> Load {
        if now_us.saturating_sub(self.from_us) < BLANKING_US + NO_LOAD_US {
            self.mean.sum = self.mean.sum.saturating_add(u32::from(current_ma));
            self.mean.samples = self.mean.samples.saturating_add(1);
        }
        let past_inrush = now_us.saturating_sub(self.from_us) >= ENGAGEMENT_BLANKING_US;
        let engaged = past_inrush && u32::from(current_ma) * 10 > u32::from(no_load_ma) * 13;
        let force = current_ma >= FORCE_MA;
        Load {
            force: self.force.update(now_us, counts, force, HOLD_US).is_some(),
            engaged: self.engaged.update(now_us, counts, engaged, HOLD_US),
            firm: self
                .firm
                .update(now_us, counts, current_ma >= FIRM_MA, HOLD_US),
        }
    }

    /// Mean current of the 50 ms after the blanking, once they are over. It is the no-load current only if the
    /// thread was slack.
    pub fn first_mean_ma(&self, now_us: u64) -> Option<u16> {
        let over = now_us.saturating_sub(self.from_us) >= BLANKING_US + NO_LOAD_US;
        let mean = self.mean.sum.checked_div(self.mean.samples)?;
        over.then(|| u16::try_from(mean).unwrap_or(u16::MAX))
    }

    /// How far the motor runs on in the leg's direction if it is braked now.
    pub fn stopping_distance(&self) -> Counts {
        let counts = self.counts_per_s.saturating_mul(STOP_US) / 1_000_000;
        Counts(i32::try_from(counts).unwrap_or(i32::MAX))
    }

    /// Speed over at least [`PACE_US`].
    fn measure_speed(&mut self, now_us: u64, counts: Counts) {
        let (from, since_us) = *self.pace.get_or_insert((counts, now_us));
        let elapsed_us = now_us.saturating_sub(since_us);
        if elapsed_us < PACE_US {
            return;
        }
        let turned = match self.direction {
            Direction::Wind => counts.since(from),
            Direction::PayOut => from.since(counts),
        };
        let elapsed_us = i64::try_from(elapsed_us).unwrap_or(i64::MAX);
        self.counts_per_s = (i64::from(turned.0) * 1_000_000 / elapsed_us).max(0);
        self.pace = Some((counts, now_us));
    }

    fn stands_still(&mut self, now_us: u64, counts: Counts) -> bool {
        let (furthest, since_us) = *self.furthest.get_or_insert((counts, now_us));
        let progress = match self.direction {
            Direction::Wind => counts.since(furthest),
            Direction::PayOut => furthest.since(counts),
        };
        if progress.0 >= PROGRESS_COUNTS {
            self.furthest = Some((counts, now_us));
            return false;
        }
        now_us.saturating_sub(since_us) >= STANDSTILL_US
    }
}

/// The back-EMF is less than a quarter of the battery: `i R >= 3/4 duty * battery`.
fn is_stall(current_ma: u16, drive_mv: u16) -> bool {
    let resistive_mv = u32::from(current_ma) * MOTOR_MILLIOHM / 1_000;
    resistive_mv * 4 >= u32::from(drive_mv) * 3
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turning(at_ms: u64, current_ma: u16) -> Sample {
        Sample {
            counts: Counts(at_ms as i32 * 10),
            current_ma,
            battery_mv: 3_900,
            driver_fault: false,
        }
    }

    #[test]
    fn inrush_is_not_force_and_force_must_last() {
        let mut detector = Detector::new(Direction::Wind, 0);
        let force = |detector: &mut Detector, ms: u64, ma| {
            detector
                .check(ms * 1_000, &turning(ms, ma), 1_500, 16)
                .map(|load| load.force)
        };
        for ms in 0..30 {
            assert_eq!(force(&mut detector, ms, 600), Ok(false), "{ms} ms");
        }
        for ms in 30..35 {
            assert_eq!(force(&mut detector, ms, 160), Ok(false), "{ms} ms");
        }
        assert_eq!(
            force(&mut detector, 35, 159),
            Ok(false),
            "an interruption starts anew"
        );
        for ms in 36..41 {
            assert_eq!(force(&mut detector, ms, 160), Ok(false), "{ms} ms");
        }
        assert_eq!(force(&mut detector, 41, 160), Ok(true));
    }

    #[test]
    fn a_short_circuit_is_not_blanked() {
        let mut detector = Detector::new(Direction::Wind, 0);
        for ms in 0..5 {
            assert!(
                detector
                    .check(ms * 1_000, &turning(ms, 801), 3_700, 16)
                    .is_ok()
            );
        }
        assert_eq!(
            detector.check(5_000, &turning(5, 801), 3_700, 16),
            Err(Trouble::OverCurrent { current_ma: 801 })
        );
    }

    /// Runs with the given count and current per millisecond until trouble; returns it with its time.
    fn first_trouble(direction: Direction, count: impl Fn(i32) -> i32, ma: u16) -> (Trouble, u64) {
        let mut detector = Detector::new(direction, 0);
        for ms in 0..1_000_u64 {
            let sample = Sample {
                counts: Counts(count(ms as i32)),
                ..turning(ms, ma)
            };
            if let Err(trouble) = detector.check(ms * 1_000, &sample, 1_500, 16) {
                return (trouble, ms);
            }
        }
        panic!("no trouble");
    }

    #[test]
    fn a_lost_encoder_is_told_from_a_blocked_motor_by_the_back_emf() {
        use Direction::{PayOut, Wind};
        assert_eq!(
            first_trouble(Wind, |_| 7, 40),
            (Trouble::EncoderLost, 50),
            "both channels"
        );
        assert_eq!(
            first_trouble(Wind, |ms| ms % 2, 40),
            (Trouble::EncoderLost, 50),
            "one channel"
        );
        assert_eq!(
            first_trouble(Wind, |ms| -ms * 10, 40),
            (Trouble::EncoderLost, 50),
            "swapped"
        );
        assert_eq!(
            first_trouble(PayOut, |ms| ms * 10, 40),
            (Trouble::EncoderLost, 50),
            "swapped"
        );
        // 1.5 V / 5.4 ohm = 278 mA; at 1.0 V of drive 155 mA are a stall below the force threshold.
        let mut detector = Detector::new(PayOut, 0);
        let blocked = (0..60_u64).find_map(|ms| {
            let sample = Sample {
                counts: Counts(0),
                ..turning(ms, 155)
            };
            detector.check(ms * 1_000, &sample, 1_000, 16).err()
        });
        assert_eq!(blocked, Some(Trouble::Blocked));
    }

    #[test]
    fn a_sagging_battery_is_noticed_and_a_short_dip_is_not() {
        let mut detector = Detector::new(Direction::Wind, 0);
        let mut check = |ms: u64, battery_mv| {
            let sample = Sample {
                battery_mv,
                ..turning(ms, 30)
            };
            detector.check(ms * 1_000, &sample, 1_500, 16)
        };
        for ms in 0..200 {
            let dip = ms < 30 || (100..119).contains(&ms);
            assert!(
                check(ms, if dip { 2_500 } else { 3_500 }).is_ok(),
                "{ms} ms"
            );
        }
        for ms in 200..220 {
            assert!(check(ms, 2_699).is_ok(), "{ms} ms");
        }
        assert_eq!(
            check(220, 2_699),
            Err(Trouble::LowBattery { battery_mv: 2_699 })
        );
    }

    #[test]
    fn engagement_is_reported_with_the_count_where_it_began() {
        let mut detector = Detector::new(Direction::Wind, 0);
        let mut load = Load::default();
        for ms in 0..200 {
            let ma = if ms < 100 { 20 } else { 21 };
            load = detector
                .check(ms * 1_000, &turning(ms, ma), 1_500, 16)
                .unwrap_or_default();
            assert_eq!(load.engaged.is_some(), ms >= 105, "{ms} ms");
            let stops_in = if ms < 4 { 0 } else { 73 };
            assert_eq!(detector.stopping_distance(), Counts(stops_in), "{ms} ms");
        }
        assert_eq!(load.engaged, Some(Counts(1_000)));
        assert_eq!(detector.first_mean_ma(200_000), Some(20));
    }
}

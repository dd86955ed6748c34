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
mod tests {
    use super::*;

    /// A detector that gets one sample per millisecond from a motor that turns by 20 counts per ms.
    struct Feed {
        detector: Detector,
        ms: u64,
        sample: Sample,
        counts_per_ms: i32,
        drive_mv: u16,
        no_load_ma: u16,
    }

    impl Feed {
        fn new(spooling: Spooling) -> Self {
            Self {
                detector: Detector::new(spooling, 0),
                ms: 0,
                sample: HEALTHY,
                counts_per_ms: match spooling {
                    Spooling::Wind => 20,
                    Spooling::PayOut => -20,
                },
                drive_mv: 1_500,
                no_load_ma: 16,
            }
        }

        /// All readings but the encoder's.
        fn set(&mut self, sample: Sample) {
            let counts = self.sample.counts;
            self.sample = Sample { counts, ..sample };
        }

        fn check(&mut self) -> Result<Load, Trip> {
            let now_us = self.ms * 1_000;
            let result = self
                .detector
                .check(now_us, &self.sample, self.drive_mv, self.no_load_ma);
            self.ms += 1;
            self.sample.counts.0 += self.counts_per_ms;
            result
        }

        /// Samples up to, but not including, `ms`, all without a trip or a load.
        fn healthy_until(&mut self, ms: u64) {
            while self.ms < ms {
                assert_eq!(self.check(), Ok(Load::default()), "{} ms", self.ms);
            }
        }

        fn counts_at(&self, ms: u64) -> Counts {
            Counts(HEALTHY.counts.0 + self.counts_per_ms * ms as i32)
        }
    }

    const HEALTHY: Sample = Sample {
        counts: Counts(500),
        current_ma: 20,
        battery_mv: 3_900,
        driver_fault: false,
    };

    /// Something in the samples that counts only once it has lasted.
    struct Condition {
        name: &'static str,
        sample: Sample,
        shows: fn(Result<Load, Trip>) -> bool,
        lasting_ms: u64,
        /// How long it is ignored after the start of the drive.
        blanked_ms: u64,
    }

    const CONDITIONS: [Condition; 6] = [
        Condition {
            name: "nFAULT",
            sample: Sample {
                driver_fault: true,
                ..HEALTHY
            },
            shows: |result| result == Err(Trip::Driver),
            lasting_ms: 3,
            blanked_ms: 0,
        },
        Condition {
            name: "over-current",
            sample: Sample {
                current_ma: 801,
                ..HEALTHY
            },
            shows: |result| result == Err(Trip::OverCurrent { current_ma: 801 }),
            lasting_ms: 5,
            blanked_ms: 0,
        },
        Condition {
            name: "sag",
            sample: Sample {
                battery_mv: 2_699,
                ..HEALTHY
            },
            shows: |result| result == Err(Trip::LowBattery { battery_mv: 2_699 }),
            lasting_ms: 20,
            blanked_ms: 30,
        },
        Condition {
            name: "end force",
            sample: Sample {
                current_ma: 160,
                ..HEALTHY
            },
            shows: |result| result.is_ok_and(|load| load.end_force),
            lasting_ms: 5,
            blanked_ms: 30,
        },
        Condition {
            name: "rise",
            sample: Sample {
                current_ma: 87,
                ..HEALTHY
            },
            shows: |result| result.is_ok_and(|load| load.rise_from.is_some()),
            lasting_ms: 5,
            blanked_ms: 30,
        },
        Condition {
            name: "engagement",
            sample: Sample {
                current_ma: 21,
                ..HEALTHY
            },
            shows: |result| result.is_ok_and(|load| load.engaged_at.is_some()),
            lasting_ms: 5,
            blanked_ms: 90,
        },
    ];

    #[test]
    fn a_condition_counts_once_it_has_lasted() {
        for spooling in [Spooling::Wind, Spooling::PayOut] {
            for condition in &CONDITIONS {
                let (name, lasting_ms) = (condition.name, condition.lasting_ms);
                let mut feed = Feed::new(spooling);
                feed.healthy_until(200);
                // One sample too few, twice: an interruption starts anew.
                for round in 0..2 {
                    feed.set(condition.sample);
                    for ms in 0..lasting_ms {
                        let shows = (condition.shows)(feed.check());
                        assert!(!shows, "{name}, round {round}: {ms} ms");
                    }
                    feed.set(HEALTHY);
                    assert_eq!(feed.check(), Ok(Load::default()), "{name}");
                }
                feed.set(condition.sample);
                for _ in 0..lasting_ms {
                    assert!(!(condition.shows)(feed.check()), "{name}");
                }
                let shows = (condition.shows)(feed.check());
                assert!(shows, "{name} after {lasting_ms} ms");
            }
        }
    }

    #[test]
    fn the_inrush_blanks_all_but_nfault_and_over_current() {
        for condition in &CONDITIONS {
            let name = condition.name;
            let mut feed = Feed::new(Spooling::Wind);
            feed.set(condition.sample);
            for ms in 0..condition.blanked_ms + condition.lasting_ms {
                assert!(!(condition.shows)(feed.check()), "{name} at {ms} ms");
            }
            assert!((condition.shows)(feed.check()), "{name}");
        }
    }

    #[test]
    fn nothing_shows_at_the_safe_side_of_a_threshold() {
        let mut feed = Feed::new(Spooling::Wind);
        feed.sample.battery_mv = 2_700;
        feed.healthy_until(400);
        for (current_ma, end_force, rise, engaged) in [
            (20, false, false, false),
            (21, false, false, true),
            (86, false, false, true),
            (87, false, true, true),
            (159, false, true, true),
            (160, true, true, true),
            (800, true, true, true),
        ] {
            feed.sample.current_ma = current_ma;
            let mut load = Load::default();
            for _ in 0..100 {
                load = feed.check().expect("no trip");
            }
            assert_eq!(
                (
                    load.end_force,
                    load.rise_from.is_some(),
                    load.engaged_at.is_some()
                ),
                (end_force, rise, engaged),
                "{current_ma} mA"
            );
        }
    }

    #[test]
    fn a_load_is_more_than_thirteen_tenths_of_the_no_load_current() {
        for (no_load_ma, unloaded_ma) in [(10, 13), (16, 20), (20, 26), (30, 39)] {
            let mut feed = Feed::new(Spooling::Wind);
            feed.no_load_ma = no_load_ma;
            feed.sample.current_ma = unloaded_ma;
            feed.healthy_until(200);
            feed.sample.current_ma = unloaded_ma + 1;
            for _ in 0..5 {
                let _ = feed.check();
            }
            assert!(feed.check().is_ok_and(|load| load.engaged_at.is_some()));
        }
    }

    #[test]
    fn a_load_is_placed_where_it_began() {
        for spooling in [Spooling::Wind, Spooling::PayOut] {
            let mut feed = Feed::new(spooling);
            feed.healthy_until(100);
            feed.sample.current_ma = 50;
            while feed.ms < 150 {
                let _ = feed.check();
            }
            feed.sample.current_ma = 100;
            while feed.ms < 200 {
                let _ = feed.check();
            }
            let load = Load {
                end_force: false,
                engaged_at: Some(feed.counts_at(100)),
                rise_from: Some(feed.counts_at(150)),
            };
            assert_eq!(feed.check(), Ok(load));
        }
    }

    #[test]
    fn the_no_load_current_is_the_mean_of_the_fifty_milliseconds_after_the_blanking() {
        let mut feed = Feed::new(Spooling::Wind);
        // Inrush before, 20 and 40 mA in turn within, the thread's pull after.
        for ms in 0..200_u64 {
            feed.sample.current_ma = match ms {
                0..30 => 600,
                30..80 => 20 + 20 * (ms % 2) as u16,
                _ => 150,
            };
            assert!(feed.check().is_ok());
            let mean_ma = feed.detector.first_mean_ma(ms * 1_000);
            assert_eq!(mean_ma, (ms >= 80).then_some(30), "{ms} ms");
        }
        let unfed = Detector::new(Spooling::Wind, 0);
        assert_eq!(unfed.first_mean_ma(200_000), None, "no sample, no mean");
    }

    #[test]
    fn times_count_from_the_start_of_the_drive() {
        let mut detector = Detector::new(Spooling::PayOut, 7_000_000);
        assert_eq!(detector.from_us(), 7_000_000);
        assert_eq!(detector.spooling(), Spooling::PayOut);
        let mut sample = Sample {
            current_ma: 200,
            ..HEALTHY
        };
        for ms in 0..36 {
            let now_us = 7_000_000 + ms * 1_000;
            assert_eq!(detector.sees_force(now_us), ms >= 30, "{ms} ms");
            let load = detector.check(now_us, &sample, 3_700, 16);
            assert_eq!(load.map(|load| load.end_force), Ok(ms >= 35), "{ms} ms");
            sample.counts.0 -= 20;
        }
    }

    #[test]
    fn the_stopping_distance_follows_the_speed_over_four_milliseconds() {
        for (spooling, sign) in [(Spooling::Wind, 1), (Spooling::PayOut, -1)] {
            let mut feed = Feed::new(spooling);
            // Counts per ms, and 7.3 ms of them; backwards is no run-on.
            for (counts_per_ms, stopping) in [(10, 73), (17, 124), (0, 0), (-5, 0), (20, 146)] {
                let before = feed.detector.stopping_distance();
                feed.counts_per_ms = sign * counts_per_ms;
                for _ in 0..4 {
                    assert_eq!(feed.detector.stopping_distance(), before);
                    let _ = feed.check();
                }
                // This sample closes the four milliseconds and opens the next.
                let now_us = feed.ms * 1_000;
                let _ = feed.detector.check(now_us, &feed.sample, 1_500, 16);
                assert_eq!(feed.detector.stopping_distance(), Counts(stopping));
            }
        }
    }

    #[test]
    fn late_samples_do_not_change_the_speed() {
        let mut detector = Detector::new(Spooling::Wind, 0);
        let mut sample = HEALTHY;
        for gap_ms in [0, 4, 5, 9, 23] {
            sample.counts.0 += 10 * gap_ms;
            let now_us = (sample.counts.0 - HEALTHY.counts.0) as u64 * 100;
            let _ = detector.check(now_us, &sample, 1_500, 16);
            let stopping = if gap_ms == 0 { 0 } else { 73 };
            assert_eq!(detector.stopping_distance(), Counts(stopping));
        }
    }

    #[test]
    fn a_leap_of_the_encoder_saturates_the_stopping_distance() {
        let mut detector = Detector::new(Spooling::Wind, 0);
        let mut sample = HEALTHY;
        let _ = detector.check(0, &sample, 1_500, 16);
        sample.counts.0 += i32::MAX - HEALTHY.counts.0;
        let _ = detector.check(4_000, &sample, 1_500, 16);
        assert_eq!(detector.stopping_distance(), Counts(i32::MAX));
    }

    /// First trip, and its time in ms, of a leg with these counts and this current.
    fn first_trip(
        spooling: Spooling,
        drive_mv: u16,
        current_ma: u16,
        count: impl Fn(i32) -> i32,
    ) -> Option<(Trip, u64)> {
        let mut detector = Detector::new(spooling, 0);
        (0..1_000_u64).find_map(|ms| {
            let sample = Sample {
                counts: Counts(count(ms as i32)),
                current_ma,
                ..HEALTHY
            };
            let result = detector.check(ms * 1_000, &sample, drive_mv, 16);
            result.err().map(|trip| (trip, ms))
        })
    }

    #[test]
    fn a_motor_without_progress_trips_after_fifty_milliseconds() {
        use Spooling::{PayOut, Wind};
        type Case = (&'static str, Spooling, fn(i32) -> i32, Option<(Trip, u64)>);
        let lost = |ms| Some((Trip::EncoderLost, ms));
        let cases: [Case; 10] = [
            ("both channels", Wind, |_| 7, lost(50)),
            ("one channel", Wind, |ms| ms % 2, lost(50)),
            ("one channel", PayOut, |ms| ms % 2, lost(50)),
            ("swapped", Wind, |ms| -ms * 10, lost(50)),
            ("swapped", PayOut, |ms| ms * 10, lost(50)),
            (
                "seven counts",
                Wind,
                |ms| if ms < 10 { 0 } else { 7 },
                lost(50),
            ),
            (
                "lost after 100 ms",
                PayOut,
                |ms| -ms.min(100) * 10,
                lost(150),
            ),
            ("eight counts in 49 ms", Wind, |ms| ms / 49 * 8, None),
            ("eight counts in 50 ms", PayOut, |ms| -ms / 50 * 8, None),
            ("eight counts in 51 ms", Wind, |ms| ms / 51 * 8, lost(50)),
        ];
        for (name, spooling, count, expected) in cases {
            let trip = first_trip(spooling, 1_500, 40, count);
            assert_eq!(trip, expected, "{name}, {spooling:?}");
        }
    }

    #[test]
    fn the_back_emf_tells_a_lost_encoder_from_a_blocked_motor() {
        // Three quarters of the drive over 5.4 ohm.
        for (drive_mv, stall_ma) in [(1_000, 139), (500, 70), (144, 20)] {
            let trip = |current_ma| first_trip(Spooling::PayOut, drive_mv, current_ma, |_| 0);
            assert_eq!(trip(stall_ma), Some((Trip::Blocked, 50)), "{drive_mv} mV");
            let lost = Some((Trip::EncoderLost, 50));
            assert_eq!(trip(stall_ma - 1), lost, "{drive_mv} mV");
        }
    }

    #[test]
    fn a_motor_that_stands_with_the_end_force_does_not_trip() {
        assert_eq!(first_trip(Spooling::Wind, 1_500, 160, |_| 0), None);
    }
}

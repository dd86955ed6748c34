//! What the detector makes of readings, sample by sample.

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
    offset_ma: 0,
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

//! Detection within a leg, reading by reading.

use super::*;

const NO_LOAD_MA: u16 = 16;

fn force_ma() -> u16 {
    Settings::REFERENCE.force_ma
}

/// Readings of a motor that winds.
#[derive(Clone)]
struct Feed {
    detector: Detector,
    now_us: u64,
    sample: Sample,
    ordered_ma: Option<u16>,
    spooling: Spooling,
}

impl Feed {
    fn new(spooling: Spooling) -> Self {
        Self {
            detector: Detector::new(spooling, 0, 3_700),
            now_us: 0,
            sample: Sample {
                counts: Counts(i32::MAX - 100),
                current_ua: spooling.along(16_000),
                offset_ma: 0,
                battery_mv: 3_690,
                driver_fault: false,
            },
            ordered_ma: Some(NO_LOAD_MA),
            spooling,
        }
    }

    /// A millisecond with `counts` counts in the direction of the leg.
    fn step(&mut self, counts: i32) -> Result<Load, Trip> {
        self.now_us += 1_000;
        let along = self.spooling.along(counts);
        self.sample.counts = Counts(self.sample.counts.0.wrapping_add(along));
        self.detector.check(
            self.now_us,
            &self.sample,
            self.ordered_ma,
            NO_LOAD_MA,
            &Settings::REFERENCE,
        )
    }

    /// Milliseconds until a trip; none within `ms`.
    fn until_trip(&mut self, ms: u32, counts: i32) -> Option<(u32, Trip)> {
        (1..=ms).find_map(|ms| self.step(counts).err().map(|trip| (ms, trip)))
    }

    /// At speed, also across the wrap of the counter.
    fn at_speed(spooling: Spooling, counts: i32) -> Self {
        let mut feed = Self::new(spooling);
        assert_eq!(feed.until_trip(60, counts), None);
        feed
    }

    fn draws(&mut self, current_ma: u16, ordered_ma: u16) {
        self.sample.current_ua = self
            .detector
            .spooling()
            .along(i32::from(current_ma) * 1_000);
        self.ordered_ma = Some(ordered_ma);
    }
}

const BOTH: [Spooling; 2] = [Spooling::Wind, Spooling::PayOut];

#[test]
fn a_healthy_motor_trips_nothing() {
    for spooling in BOTH {
        for counts in [1, 2, 5, 11, 17] {
            assert_eq!(Feed::new(spooling).until_trip(3_000, counts), None);
        }
    }
}

#[test]
fn the_end_force_is_a_mean_of_8_readings_above_the_no_load_current() {
    let mut feed = Feed::at_speed(Spooling::Wind, 5);
    feed.draws(NO_LOAD_MA + force_ma(), 170);
    let after_ms = (1..40).find(|_| feed.step(5).is_ok_and(|load| load.end_force));
    assert_eq!(after_ms, Some(10), "8 readings, and 2 ms");
    let mut feed = Feed::at_speed(Spooling::Wind, 5);
    feed.draws(NO_LOAD_MA + force_ma() - 1, 170);
    assert!((0..100).all(|_| feed.step(5).is_ok_and(|load| !load.end_force)));
    // An accelerating motor draws as much.
    let mut feed = Feed::new(Spooling::Wind);
    feed.draws(200, 220);
    let after_ms = (1..60).find(|_| feed.step(5).is_ok_and(|load| load.end_force));
    assert_eq!(after_ms, Some(32));
}

#[test]
fn after_a_brake_the_current_says_nothing_for_40_ms() {
    let mut feed = Feed::at_speed(Spooling::Wind, 5);
    feed.ordered_ma = None;
    assert!(feed.step(5).is_ok());
    feed.draws(200, 220);
    let after_ms = (1..80).find(|_| feed.step(5).is_ok_and(|load| load.end_force));
    assert_eq!(after_ms, Some(42));
}

#[test]
fn a_fast_motor_that_is_slowed_is_resisted() {
    let mut feed = Feed::at_speed(Spooling::Wind, 11);
    assert!(feed.step(11).is_ok_and(|load| !load.resisted));
    assert!(
        feed.step(10).is_ok_and(|load| !load.resisted),
        "a count less is noise"
    );
    assert!(feed.step(8).is_ok_and(|load| load.resisted));
    assert!(feed.step(8).is_ok_and(|load| load.struck));
    let mut feed = Feed::at_speed(Spooling::Wind, 5);
    assert!(feed.step(3).is_ok_and(|load| !load.resisted), "slow enough");
    let mut feed = Feed::at_speed(Spooling::Wind, 6);
    assert!(
        feed.step(4).is_ok_and(|load| load.resisted),
        "just too fast"
    );
}

/// A fourteenth of the speed, and at least 750 counts/s: 1,214 of 17,000, and 750 of 10,250.
#[test]
fn a_sudden_loss_of_speed_is_a_share_of_it() {
    for (before, last, struck) in [
        ([17; 4], [16, 16], false),
        ([17; 4], [16, 15], true),
        ([10, 10, 10, 11], [10, 9], false),
        ([10, 10, 10, 11], [9, 9], true),
    ] {
        let mut feed = Feed::new(Spooling::Wind);
        for counts in before.repeat(10) {
            assert!(feed.step(counts).is_ok_and(|load| !load.struck));
        }
        let loads = [before[0], before[1], last[0], last[1]].map(|counts| feed.step(counts));
        assert!(loads[3].is_ok_and(|load| load.struck == struck), "{last:?}");
    }
}

/// From 10,750 to 10,000 counts/s in 12 ms: 434 less are to be expected, and 750 less than that.
#[test]
fn a_loss_of_speed_that_goes_on_is_not_sudden() {
    // With more current than was ordered half of that is enough, but no less.
    for (last, surge_ma, struck) in [
        ([9, 9], 0, false),
        ([9, 8], 0, true),
        ([10, 9], 30, false),
        ([9, 9], 30, true),
    ] {
        let mut feed = Feed::at_speed(Spooling::Wind, 11);
        for counts in [11, 10, 11, 10, 11, 10, 11, 10].into_iter().chain([10; 10]) {
            assert!(feed.step(counts).is_ok_and(|load| !load.struck));
        }
        assert!(feed.step(last[0]).is_ok_and(|load| !load.struck));
        feed.draws(NO_LOAD_MA + surge_ma, NO_LOAD_MA);
        let load = feed.step(last[1]);
        assert!(load.is_ok_and(|load| load.struck == struck), "{last:?}");
    }
}

/// The current rises with the loss of speed, and is read more finely than the counts.
#[test]
fn a_motor_that_draws_more_as_it_becomes_slower_is_struck_sooner() {
    for (surge_ma, struck) in [(0, false), (21, false), (25, true)] {
        let mut feed = Feed::at_speed(Spooling::Wind, 11);
        assert!(feed.step(11).is_ok());
        feed.draws(NO_LOAD_MA + surge_ma, NO_LOAD_MA);
        let load = feed.step(10);
        assert!(load.is_ok_and(|load| load.struck == struck), "{surge_ma}");
    }
    // More current alone, at the same speed, is no loss of speed; nor is more current that was ordered.
    let mut feed = Feed::at_speed(Spooling::Wind, 11);
    feed.draws(NO_LOAD_MA + 60, NO_LOAD_MA);
    assert!(feed.step(11).is_ok_and(|load| !load.struck));
    let mut feed = Feed::at_speed(Spooling::Wind, 11);
    feed.draws(NO_LOAD_MA + 60, NO_LOAD_MA + 60);
    assert!(feed.step(10).is_ok_and(|load| !load.struck));
}

/// A stiff origami slows a motor by 60 counts/s in each millisecond; that is no jam, but a jam on top of it is.
#[test]
fn a_motor_that_becomes_slower_is_not_struck() {
    let mut feed = Feed::at_speed(Spooling::Wind, 11);
    let mut travel = 0;
    for ms in 1..=40 {
        // Thousandths of a count.
        let before = travel;
        travel += 11_000 - 60 * ms;
        let step = travel / 1_000 - before / 1_000;
        assert!(feed.step(step).is_ok_and(|load| !load.struck), "{ms} ms");
    }
    assert!(feed.step(8).is_ok_and(|load| !load.struck), "8,600 before");
    assert!(feed.step(6).is_ok_and(|load| load.struck));
}

/// A gain of 2 counts/ms in 12 ms is 166,700 counts/s2: 39 mA.
#[test]
fn what_makes_the_motor_faster_does_not_pull_at_the_thread() {
    for (pull_ma, found) in [(force_ma() + 36, false), (force_ma() + 42, true)] {
        let mut feed = Feed::at_speed(Spooling::Wind, 2);
        feed.draws(NO_LOAD_MA + pull_ma, 220);
        let last = (0..12).map(|_| feed.step(4)).last();
        let found_now = last.is_some_and(|load| load.is_ok_and(|load| load.end_force));
        assert_eq!(found_now, found, "{pull_ma} mA");
    }
}

#[test]
fn counts_that_end_at_once_are_an_encoder_and_counts_that_fade_are_none() {
    for spooling in BOTH {
        for counts in [5, 11, 17] {
            let mut feed = Feed::at_speed(spooling, counts);
            assert!(feed.step(counts / 2).is_ok(), "within a millisecond");
            assert_eq!(feed.until_trip(10, 0), Some((3, Trip::EncoderLost)));
            // Only one line works: the count flickers in place.
            let mut feed = Feed::at_speed(spooling, counts);
            assert!(feed.step(0).is_ok());
            let flicker = [1, -1, 1, -1];
            let trips = flicker.map(|step| feed.step(step).err());
            assert!(trips.contains(&Some(Trip::EncoderLost)), "{trips:?}");
        }
        // A count more or less in a millisecond is a steady speed.
        let mut feed = Feed::at_speed(spooling, 5);
        for counts in [5, 4, 2] {
            assert!(feed.step(counts).is_ok());
        }
        assert_eq!(feed.until_trip(10, 0), Some((3, Trip::EncoderLost)));
        // A jam at 7 mm/s, and one at 13 mm/s with the brake.
        for fading in [
            &[5, 5, 4, 4, 3, 3, 2, 1, 0, 0, 0, 0][..],
            &[11, 10, 7, 4, 1, 0, 0, 0, 0],
        ] {
            let mut feed = Feed::at_speed(spooling, fading[0]);
            feed.draws(200, 220);
            for counts in fading {
                assert!(feed.step(*counts).is_ok(), "{fading:?}");
            }
        }
    }
}

/// Two counts in the last three milliseconds are a motor that still turns.
#[test]
fn a_motor_that_almost_stands_is_no_lost_encoder() {
    for (steps, lost) in [
        ([1, 0, 1], false),
        ([1, 1, 0], false),
        ([0, 1, 1], false),
        ([1, 0, 0], true),
        ([-1, 1, -1], true),
    ] {
        let mut feed = Feed::at_speed(Spooling::Wind, 11);
        assert!(feed.step(5).is_ok());
        let trips = steps.map(|counts| feed.step(counts).err());
        let expected = lost.then_some(Trip::EncoderLost);
        assert_eq!(trips, [None, None, expected], "{steps:?}");
    }
}

/// From half of the end force, 67 mA, and an eighth less before it is over.
#[test]
fn a_rise_goes_on_until_the_current_has_fallen_by_an_eighth() {
    let half_ma = Settings::REFERENCE.rise_start_ma;
    let ends_ma = half_ma - half_ma / 8;
    for (then_ma, goes_on) in [(ends_ma, true), (ends_ma - 1, false)] {
        let mut feed = Feed::at_speed(Spooling::Wind, 5);
        feed.draws(NO_LOAD_MA + half_ma - 1, 100);
        assert_eq!(feed.until_trip(20, 5), None);
        assert!(feed.step(5).is_ok_and(|load| load.rise_from.is_none()));
        feed.draws(NO_LOAD_MA + half_ma, 100);
        assert_eq!(feed.until_trip(20, 5), None);
        feed.draws(NO_LOAD_MA + then_ma, 100);
        assert_eq!(feed.until_trip(20, 5), None);
        let last = feed.step(5);
        assert!(
            last.is_ok_and(|load| load.rise_from.is_some() == goes_on),
            "{then_ma}"
        );
    }
}

/// A slow motor with 105 mA above the no-load current, then slower by a fifth and more.
fn slowed_to(counts: i32, ordered_ma: u16) -> Load {
    let mut feed = Feed::at_speed(Spooling::Wind, 6);
    feed.draws(NO_LOAD_MA + 105, 130);
    assert_eq!(feed.until_trip(20, 6), None);
    feed.draws(NO_LOAD_MA + 105, ordered_ma);
    (0..3)
        .map(|_| feed.step(counts).expect("no trip"))
        .last()
        .expect("three readings")
}

#[test]
fn a_loaded_motor_that_becomes_slower_has_met_its_end_unless_it_was_ordered_to() {
    assert!(slowed_to(4, 130).end_force && slowed_to(3, 140).end_force);
    assert!(!slowed_to(5, 130).end_force, "by a sixth");
    assert!(!slowed_to(4, 129).end_force, "less current was ordered");
    assert!(!slowed_to(1, 140).end_force, "no motor stops so fast");
}

/// A fifth of the speed is not yet too much; and a motor that was becoming slower has to lose more than that.
#[test]
fn a_loaded_motor_has_met_its_end_if_it_loses_more_than_a_fifth_beyond_its_trend() {
    let faster = [6; 16];
    for (earlier, before, last, met) in [
        (&[5; 16], [5; 8], [4, 4, 4, 4], false),
        (&[5; 16], [5; 8], [4, 4, 3, 3], true),
        // One reading may be rounding.
        (&[5; 16], [5; 8], [4, 4, 3, 5], false),
        // 500 counts/s in 12 ms: 220 in the next 5.5 ms, off 4,400.
        (&faster, [6, 5, 6, 5, 6, 5, 6, 5], [5, 4, 3, 3], true),
        // 1,000 in 12 ms: 451, off 4,000.
        (&faster, [5; 8], [4, 4, 3, 4], false),
        (&faster, [5; 8], [4, 3, 3, 3], true),
    ] {
        let mut feed = Feed::at_speed(Spooling::Wind, earlier[0]);
        feed.draws(NO_LOAD_MA + 105, 130);
        for counts in earlier.iter().chain(&before).chain(&last[..3]) {
            assert!(feed.step(*counts).is_ok_and(|load| !load.end_force));
        }
        let end = feed.step(last[3]);
        assert!(
            end.is_ok_and(|load| load.end_force == met),
            "{before:?} {last:?}"
        );
    }
}

/// A healthy origami slows the motor down slowly. Counts are whole, and the edges of the encoder lie up to 0.3 counts off.
#[test]
fn rounding_and_phase_are_no_end() {
    for (cps, phase, begin) in (3_000..4_500)
        .step_by(50)
        .flat_map(|cps| [-0.3, 0.3].map(|phase| (cps, phase)))
        .flat_map(|(cps, phase)| (0..20).map(move |nth| (cps, phase, f64::from(nth) / 5.0)))
    {
        // Edge `n` lies at `n`, or off it by the phase.
        let edges = |place: f64| {
            let passed =
                |n: i32| place >= f64::from(n) + [0.0, phase, 0.0, -phase][(n % 4) as usize];
            let near = place as i32;
            (near..=near + 1)
                .rev()
                .find(|n| passed(*n))
                .unwrap_or(near - 1)
        };
        let (mut place, mut per_ms) = (begin, f64::from(cps) / 1_000.0);
        let mut feed = Feed::at_speed(Spooling::Wind, cps / 1_000);
        for ms in 0..60 {
            feed.draws(NO_LOAD_MA + 109, 130 + ms);
            let counts = edges(place + per_ms) - edges(place);
            place += per_ms;
            per_ms *= 0.995;
            let load = feed.step(counts).expect("no trip");
            assert!(!load.end_force, "{cps} {phase} {begin} at {ms} ms");
        }
    }
}

/// A slow motor loses its encoder: the speed loop orders more and more current, and the motor draws less than that.
#[test]
fn an_end_force_without_counts_is_a_lost_encoder_if_the_motor_turns() {
    for (current_ma, counts, expected) in [
        (168, 0, Err(Trip::EncoderLost)),
        (168, 2, Ok(true)),
        (172, 0, Ok(true)),
    ] {
        let mut feed = Feed::at_speed(Spooling::Wind, 2);
        feed.draws(NO_LOAD_MA + 100, 130);
        assert_eq!(feed.until_trip(20, counts), None);
        feed.draws(current_ma, 200);
        let found = (0..12).find_map(|_| match feed.step(counts) {
            Ok(Load {
                end_force: true, ..
            }) => Some(Ok(true)),
            Ok(_) => None,
            Err(trip) => Some(Err(trip)),
        });
        assert_eq!(found, Some(expected), "{current_ma} mA of 200 mA");
    }
}

#[test]
fn counts_the_wrong_way_are_an_encoder() {
    for spooling in BOTH {
        let mut feed = Feed::new(spooling);
        assert_eq!(feed.until_trip(20, -10), Some((5, Trip::EncoderLost)));
    }
}

/// The fault of a motor that was never seen to move, after 40 ms.
fn standing(current_ma: u16, ordered_ma: u16, battery_mv: u16) -> Option<(u32, Trip)> {
    let mut feed = Feed::new(Spooling::Wind);
    feed.draws(current_ma, ordered_ma);
    feed.sample.battery_mv = battery_mv;
    feed.until_trip(100, 0)
}

#[test]
fn a_standstill_has_four_names() {
    assert_eq!(standing(145, 145, 3_600), Some((41, Trip::Blocked)));
    assert_eq!(standing(128, 150, 3_600), Some((41, Trip::Blocked)));
    assert_eq!(standing(127, 150, 3_600), Some((41, Trip::EncoderLost)));
    assert_eq!(standing(30, 200, 3_690), Some((41, Trip::EncoderLost)));
    assert_eq!(standing(0, 200, 3_700), Some((41, Trip::BridgeSilent)));
    assert_eq!(standing(0, 200, 3_640), Some((41, Trip::SenseLost)));
    assert_eq!(
        standing(200, 200, 3_600),
        None,
        "the end force ends the leg"
    );
}

/// No force ends a leg that pays out, so a motor that stands there with all its current is blocked.
#[test]
fn a_motor_that_stands_while_it_pays_out_is_blocked() {
    let mut feed = Feed::new(Spooling::PayOut);
    feed.draws(200, 200);
    assert_eq!(feed.until_trip(100, 0), Some((41, Trip::Blocked)));
}

/// A motor that turns uncounted is driven like one that stands, brakes by that, and draws nothing for a while.
#[test]
fn a_standing_motor_that_drew_a_current_just_now_has_a_bridge() {
    let mut feed = Feed::new(Spooling::Wind);
    feed.draws(30, 200);
    assert_eq!(feed.until_trip(29, 0), None);
    feed.draws(0, 200);
    assert_eq!(feed.until_trip(20, 0), Some((12, Trip::EncoderLost)));
}

#[test]
fn a_silent_current_is_the_bridge_if_the_motor_becomes_slower() {
    for (slower_every_ms, name) in [(0, Trip::SenseLost), (4, Trip::BridgeSilent)] {
        let mut feed = Feed::at_speed(Spooling::Wind, 11);
        feed.draws(0, 40);
        let mut counts = 11;
        let trip = (1..100).find_map(|ms| {
            if slower_every_ms != 0 && ms % slower_every_ms == 0 {
                counts -= 1;
            }
            feed.step(counts).err().map(|trip| (ms, trip))
        });
        let (ms, trip) = trip.expect("it is noticed");
        assert_eq!(trip, name);
        assert!((24..40).contains(&ms), "{ms} ms");
    }
    // A sixteenth less over 4 ms, from 8,000 to 7,500 counts/s, is not yet slower.
    // Readings before the 8 ms of the earlier speed do not count.
    let mut feed = Feed::at_speed(Spooling::Wind, 9);
    feed.draws(0, 40);
    let steps = [8; 9].into_iter().chain([7, 8].repeat(20));
    let trip = steps.into_iter().find_map(|counts| feed.step(counts).err());
    assert_eq!(trip, Some(Trip::SenseLost));
    // Below 5 mA no current flows.
    for (current_ma, flows) in [(4, false), (5, true)] {
        let mut feed = Feed::at_speed(Spooling::Wind, 8);
        feed.draws(current_ma, 40);
        assert_eq!(feed.until_trip(60, 8).is_none(), flows, "{current_ma} mA");
    }
    // A motor coasting to zero is ordered to draw next to nothing.
    let mut feed = Feed::at_speed(Spooling::PayOut, 11);
    feed.draws(0, 11);
    assert_eq!(feed.until_trip(300, 5), None);
}

/// A motor that has not turned for 10 ms is judged as one that stands, 40 ms after its last 8 counts.
#[test]
fn a_silent_current_needs_a_motor_that_turns() {
    for (turns_ms, tripped_ms) in [(21, 30), (20, 60)] {
        let mut feed = Feed::at_speed(Spooling::Wind, 8);
        feed.draws(0, 40);
        assert_eq!(feed.until_trip(turns_ms, 8), None);
        let mut fading = [3, 2, 1, 1].into_iter();
        let after_ms = (1..100).find(|_| feed.step(fading.next().unwrap_or(0)).is_err());
        assert_eq!(after_ms.map(|ms| turns_ms + ms), Some(tripped_ms));
    }
}

#[test]
fn short_circuits_are_seen_by_level_and_by_surplus() {
    let mut feed = Feed::at_speed(Spooling::Wind, 11);
    feed.draws(OVER_CURRENT_MA + 1, 40);
    let current_ma = OVER_CURRENT_MA + 1;
    assert_eq!(
        feed.until_trip(10, 11),
        Some((3, Trip::OverCurrent { current_ma }))
    );
    let mut feed = Feed::at_speed(Spooling::Wind, 11);
    feed.draws(300, 40);
    let trip = feed.until_trip(20, 11);
    assert!(
        matches!(trip, Some((..=14, Trip::OverCurrent { .. }))),
        "{trip:?}"
    );
    // By level only above it.
    let mut feed = Feed::at_speed(Spooling::Wind, 11);
    feed.draws(OVER_CURRENT_MA, 220);
    assert_eq!(feed.until_trip(50, 11), None);
    // A motor that is braked from full speed draws up to 800 mA against the drive.
    for (against_ma, trips) in [(800, false), (801, true)] {
        let mut feed = Feed::at_speed(Spooling::Wind, 11);
        feed.sample.current_ua = -1_000 * against_ma;
        feed.ordered_ma = None;
        assert_eq!(feed.until_trip(10, 11).is_some(), trips, "{against_ma}");
    }
    // By surplus above twice the ordered current and 60 mA.
    for (current_ma, trips) in [(260, false), (261, true)] {
        let mut feed = Feed::at_speed(Spooling::Wind, 11);
        feed.draws(current_ma, 100);
        assert_eq!(feed.until_trip(50, 11).is_some(), trips, "{current_ma}");
    }
    // The most that a healthy motor may draw.
    let mut feed = Feed::at_speed(Spooling::Wind, 11);
    feed.draws(250, 220);
    assert_eq!(feed.until_trip(500, 11), None);
}

/// A short circuit takes the torque away, so that the motor loses speed as if it were struck.
#[test]
fn a_motor_that_loses_speed_by_a_short_circuit_is_not_struck() {
    for (current_ma, struck) in [(1_500, false), (OVER_CURRENT_MA + 1, false), (250, true)] {
        let mut feed = Feed::at_speed(Spooling::Wind, 11);
        feed.draws(current_ma, 90);
        feed.step(11).expect("no trip yet");
        let load = feed.step(10).expect("no trip yet");
        assert_eq!(load.struck, struck, "{current_ma} mA");
    }
}

#[test]
fn battery_and_driver_are_debounced() {
    let mut feed = Feed::at_speed(Spooling::Wind, 11);
    feed.sample.battery_mv = Settings::REFERENCE.loaded_battery_mv - 1;
    let battery_mv = feed.sample.battery_mv;
    assert_eq!(
        feed.until_trip(50, 11),
        Some((16, Trip::LowBattery { battery_mv }))
    );
    let mut feed = Feed::at_speed(Spooling::Wind, 11);
    feed.sample.battery_mv = Settings::REFERENCE.loaded_battery_mv;
    assert_eq!(feed.until_trip(50, 11), None);
    feed.sample.driver_fault = true;
    assert_eq!(feed.until_trip(50, 11), Some((4, Trip::Driver)));
}

/// A weak cell pulls the chip's supply down, the drive ends, and the cell recovers before the sag has lasted.
#[test]
fn a_cell_that_collapses_again_and_again_is_low() {
    for (on_its_way_mv, told_mv) in [(None, 2_000), (Some(2_350), 2_350)] {
        let mut feed = Feed::at_speed(Spooling::Wind, 11);
        let whole_mv = feed.sample.battery_mv;
        feed.draws(0, 40);
        for collapse in 1..=5 {
            // A voltage measured below 2 V is meaningless, and is not reported.
            feed.sample.battery_mv = [0, 1_999, 0, 1_200, 0][collapse - 1];
            let trip = feed.until_trip(1, 11);
            let low = Some((
                1,
                Trip::LowBattery {
                    battery_mv: told_mv,
                },
            ));
            assert_eq!(trip, low.filter(|_| collapse == 5), "{collapse}");
            feed.sample.battery_mv = on_its_way_mv.unwrap_or(whole_mv);
            if collapse < 5 {
                assert_eq!(feed.until_trip(2, 11), None, "{collapse}");
            }
        }
    }
}

/// At 2 V the chip's supply still holds, so that only a sag that lasts counts.
#[test]
fn a_cell_that_falls_to_2_v_has_not_collapsed() {
    let mut feed = Feed::at_speed(Spooling::Wind, 11);
    let whole_mv = feed.sample.battery_mv;
    for _ in 0..10 {
        feed.sample.battery_mv = COLLAPSED_MV;
        assert_eq!(feed.until_trip(2, 11), None);
        feed.sample.battery_mv = whole_mv;
        assert_eq!(feed.until_trip(2, 11), None);
    }
}

/// A clock that stands still gives no speed, and no division by zero.
#[test]
fn readings_without_time_trip_nothing_and_overflow_nothing() {
    let mut feed = Feed::new(Spooling::Wind);
    for counts in [i32::MIN, i32::MAX, 0, 40_000] {
        feed.sample.counts = Counts(counts);
        let _ = feed.detector.check(
            5,
            &feed.sample,
            Some(u16::MAX),
            NO_LOAD_MA,
            &Settings::REFERENCE,
        );
        let _ = feed.detector.speeds_cps();
        let _ = feed.detector.stopping_distance();
    }
}

/// At 0 V the amplifier reads as a current beyond any that the drive or the battery could give: against the drive, or
/// with it while the battery hardly sags.
#[test]
fn an_open_amplifier_is_told_from_a_large_current() {
    for (spooling, along_ma, battery_mv, is_open) in [
        (Spooling::Wind, -1_301, 3_690, true),
        (Spooling::Wind, -1_300, 3_690, false),
        (Spooling::Wind, 1_400, 3_690, false),
        (Spooling::PayOut, 1_301, 3_690, true),
        (Spooling::PayOut, 1_300, 3_690, false),
        (Spooling::PayOut, 1_400, 3_601, true),
        (Spooling::PayOut, 1_400, 3_600, false),
        (Spooling::PayOut, -1_400, 3_690, false),
    ] {
        let mut feed = Feed::at_speed(spooling, 11);
        feed.sample.current_ua = spooling.along(along_ma * 1_000);
        feed.sample.battery_mv = battery_mv;
        let mut backwards = feed.clone();
        let found = feed.step(11) == Err(Trip::SenseLost);
        assert_eq!(found, is_open, "{spooling:?} {along_ma} {battery_mv}");
        // A short circuit looks like a blow, which is braked by driving backwards for a moment.
        backwards.ordered_ma = None;
        if spooling == Spooling::Wind {
            assert!(backwards.step(11).is_ok(), "{along_ma}");
        }
    }
}

/// With the bridge's resistance the motor stops in 7.3 ms times its speed: 80 counts at 11,000 counts/s.
#[test]
fn a_motor_that_is_braked_runs_on_in_proportion_to_its_speed() {
    for spooling in BOTH {
        for (counts, runs_on) in [(11, 80), (5, 36), (0, 0), (-1, 0)] {
            let mut feed = Feed::new(spooling);
            assert_eq!(feed.until_trip(30, counts), None);
            assert_eq!(feed.detector.stopping_distance(), Counts(runs_on));
        }
    }
}

//! What the machine measures and when it acts, to the millisecond: it is fed exact samples, one per millisecond.

use firmware_capsule::{
    detect::Sample,
    fold::{Actions, BRAKE_US, Capsule, Command, Drive, Event, LEAST_BATTERY_MV},
    mechanics::{Counts, FOLDED, Thread},
    sense::MOST_OFFSET_MA,
};
use protocol::{
    capsule::{
        ActuationKind, ActuationOutcome, ActuationRecord, CapsuleEvent, CapsuleFault, CapsuleState,
    },
    error::Refusal,
};

/// Usual speed: 24.5 um of thread per sample.
const COUNTS_PER_MS: i32 = 20;
/// Slack thread; 1.3 times the assumed no-load current is 20.8 mA.
const UNLOADED_MA: u16 = 20;
/// Above 3 N, below the end force.
const RISE_MA: u16 = 120;
/// Above the end force.
const END_MA: u16 = 165;

/// A capsule whose sensors say exactly what the test sets.
struct Feed {
    capsule: Capsule,
    now_us: u64,
    sample: Sample,
    counts_per_ms: i32,
    events: Vec<CapsuleEvent>,
}

impl Feed {
    /// Just started, with one sample taken.
    fn new() -> Self {
        let mut feed = Self {
            capsule: Capsule::new(None),
            now_us: 0,
            sample: Sample {
                counts: Counts(1_000),
                current_ma: UNLOADED_MA,
                offset_ma: 0,
                battery_mv: 4_000,
                driver_fault: false,
            },
            counts_per_ms: COUNTS_PER_MS,
            events: Vec::new(),
        };
        feed.tick();
        feed
    }

    fn give(&mut self, event: Event) -> Actions {
        let actions = self.capsule.step(self.now_us, event);
        self.events.extend(actions.events.iter().copied());
        actions
    }

    fn order(&mut self, command: Command) -> Actions {
        let actions = self.give(Event::Command(command));
        assert_eq!(actions.refusal, None, "{command:?}");
        actions
    }

    /// A driven motor turns; then a sample is taken.
    fn tick(&mut self) {
        if let Drive::Millivolts(millivolts) = self.capsule.drive() {
            let turned = self.counts_per_ms * i32::from(millivolts.signum());
            self.sample.counts.0 += turned;
        }
        self.now_us += 1_000;
        self.give(Event::Sample(self.sample));
    }

    fn ticks(&mut self, ms: u32) {
        for _ in 0..ms {
            self.tick();
        }
    }

    fn with_current(&mut self, current_ma: u16, ms: u32) {
        self.sample.current_ma = current_ma;
        self.ticks(ms);
    }

    /// Until the bridge sleeps; at most 15 s.
    fn rest(&mut self) {
        for _ in 0..15_000 {
            if self.capsule.drive() == Drive::Off {
                return;
            }
            self.tick();
        }
        panic!("still driven: {:?}", self.capsule);
    }

    fn thread_um(&self) -> i32 {
        self.capsule.thread().0
    }

    /// Winds without load to `end_um`, then with the current of a rise for 1.0 mm, then with the end force.
    fn wind_to_force(&mut self, end_um: i32) {
        self.sample.current_ma = UNLOADED_MA;
        while self.thread_um() < end_um - 1_000 {
            self.tick();
        }
        self.sample.current_ma = RISE_MA;
        while self.thread_um() < end_um {
            self.tick();
        }
        self.with_current(END_MA, 6);
        self.sample.current_ma = UNLOADED_MA;
    }

    /// Referenced, unfolded, at rest.
    fn unfolded() -> Self {
        let mut feed = Self::new();
        feed.order(Command::Reference);
        feed.wind_to_force(21_000);
        feed.rest();
        assert_eq!(feed.capsule.state(), CapsuleState::Unfolded);
        feed.events.clear();
        feed
    }

    fn folded() -> Self {
        let mut feed = Self::unfolded();
        feed.order(Command::Fold);
        feed.wind_to_force(21_000);
        feed.rest();
        assert_eq!(feed.capsule.state(), CapsuleState::Folded);
        feed.events.clear();
        feed
    }

    /// At rest after a stop in mid-fold.
    fn stopped() -> Self {
        let mut feed = Self::unfolded();
        feed.order(Command::Fold);
        feed.ticks(400);
        feed.order(Command::Stop);
        feed.rest();
        assert_eq!(feed.capsule.state(), CapsuleState::Stopped);
        feed.events.clear();
        feed
    }

    fn record(&self) -> ActuationRecord {
        *self.capsule.record()
    }
}

#[test]
fn every_motion_ends_with_a_timeout_at_its_time_and_not_before() {
    let cases = [
        (Feed::new(), Command::Reference, 12_000),
        (Feed::unfolded(), Command::Fold, 4_000),
        (Feed::folded(), Command::Unfold, 4_000),
    ];
    for (mut feed, command, timeout_ms) in cases {
        // Slow enough to arrive nowhere, fast enough to be a turning motor.
        feed.counts_per_ms = 1;
        feed.order(command);
        let kind = feed.record().kind;
        assert_eq!(Capsule::timeout_ms(kind), timeout_ms);
        feed.ticks(timeout_ms - 1);
        assert_eq!(feed.capsule.fault(), None, "{command:?}");
        assert!(feed.capsule.is_moving());
        feed.tick();
        assert_eq!(feed.capsule.fault(), Some(CapsuleFault::Timeout));
        assert_eq!(feed.capsule.drive(), Drive::Brake);
        assert!(!feed.capsule.referenced(), "the position is in doubt");
        let record = feed.record();
        let outcome = ActuationOutcome::Faulted(CapsuleFault::Timeout);
        assert_eq!((record.outcome, record.duration_ms), (outcome, timeout_ms));
        let actuation = record.actuation;
        assert_eq!(
            feed.events,
            [
                CapsuleEvent::Started { actuation, kind },
                CapsuleEvent::Ended { actuation, outcome },
                CapsuleEvent::Faulted(CapsuleFault::Timeout),
            ]
        );
        feed.order(Command::Acknowledge);
        assert_eq!(feed.capsule.state(), CapsuleState::Unreferenced);
    }
}

#[test]
fn a_motion_that_arrives_at_its_deadline_is_complete() {
    let mut feed = Feed::folded();
    feed.counts_per_ms = 1;
    feed.order(Command::Unfold);
    feed.ticks(3_999);
    feed.sample.counts = feed.sample.counts.back(feed.capsule.thread().counts());
    feed.tick();
    assert_eq!(feed.capsule.state(), CapsuleState::Unfolded);
    assert_eq!(feed.record().outcome, ActuationOutcome::Complete);
}

#[test]
fn a_start_during_the_brake_gets_the_full_time_and_is_not_judged_before_its_drive() {
    let mut feed = Feed::unfolded();
    feed.counts_per_ms = 1;
    feed.order(Command::Fold);
    feed.ticks(100);
    feed.order(Command::Stop);
    feed.order(Command::Fold);
    // A standing motor, a short circuit, nFAULT and an empty battery mean nothing while the motor is shorted.
    let healthy = feed.sample;
    feed.sample.driver_fault = true;
    feed.sample.battery_mv = 2_000;
    feed.with_current(1_500, 39);
    assert_eq!(feed.capsule.drive(), Drive::Brake);
    assert_eq!(feed.capsule.state(), CapsuleState::Folding);
    assert_eq!(feed.record().min_battery_mv, 2_000, "but it is noted");
    feed.sample = healthy;
    feed.tick();
    assert_eq!(feed.capsule.drive(), Drive::Millivolts(3_700));
    feed.ticks(3_999);
    assert_eq!(feed.capsule.fault(), None);
    feed.tick();
    assert_eq!(feed.capsule.fault(), Some(CapsuleFault::Timeout));
    assert_eq!(feed.record().duration_ms, 4_040, "with the brake");
}

#[test]
fn the_motor_is_shorted_for_forty_milliseconds_and_the_record_follows_until_then() {
    let mut feed = Feed::unfolded();
    feed.order(Command::Fold);
    feed.ticks(400);
    assert_eq!(feed.order(Command::Stop).drive, Drive::Brake);
    let brake_ms = BRAKE_US / 1_000;
    assert_eq!(brake_ms, 40);
    for ms in 1..brake_ms {
        feed.sample.counts.0 += 10;
        feed.tick();
        assert_eq!(feed.capsule.drive(), Drive::Brake, "{ms} ms");
        assert_eq!(feed.record().thread_um, feed.thread_um(), "{ms} ms");
    }
    let braked_um = feed.record().thread_um;
    feed.sample.counts.0 += 10;
    feed.tick();
    assert_eq!(feed.capsule.drive(), Drive::Off);
    assert_eq!(feed.record().thread_um, braked_um, "the motion is over");
    assert!(feed.thread_um() > braked_um);
}

#[test]
fn a_motion_starts_with_3000_mv_and_not_with_less() {
    assert_eq!(LEAST_BATTERY_MV, 3_000);
    let cases = [
        (Feed::new(), Command::Reference),
        (Feed::unfolded(), Command::Fold),
        (Feed::folded(), Command::Unfold),
    ];
    for (mut feed, command) in cases {
        feed.sample.battery_mv = 2_999;
        feed.tick();
        let refused = feed.give(Event::Command(command));
        let refusal = Refusal::BatteryLow {
            battery_mv: 2_999,
            min_mv: 3_000,
        };
        assert_eq!(refused.refusal, Some(refusal));
        assert_eq!((refused.drive, feed.events.len()), (Drive::Off, 0));
        feed.sample.battery_mv = 3_000;
        feed.tick();
        let millivolts = match feed.order(command).drive {
            Drive::Millivolts(millivolts) => millivolts.unsigned_abs(),
            other => panic!("{other:?}"),
        };
        assert!(millivolts <= 3_000, "no more than the battery has");
    }
}

#[test]
fn a_motion_is_refused_while_the_amplifier_shows_a_current_at_rest() {
    let cases = [
        (Feed::new(), Command::Reference),
        (Feed::unfolded(), Command::Fold),
        (Feed::folded(), Command::Unfold),
    ];
    for (mut feed, command) in cases {
        feed.sample.offset_ma = MOST_OFFSET_MA + 1;
        feed.tick();
        assert_eq!(feed.capsule.fault(), None, "nobody wanted to move");
        let fault = CapsuleFault::OverCurrent {
            current_ma: MOST_OFFSET_MA + 1,
        };
        let refused = feed.give(Event::Command(command));
        assert_eq!(refused.refusal, Some(Refusal::CapsuleFaulted(fault)));
        assert_eq!(refused.drive, Drive::Off);
        assert_eq!(feed.events, [CapsuleEvent::Faulted(fault)]);
        assert_eq!(feed.capsule.fault(), Some(fault));
        let acknowledge = Event::Command(Command::Acknowledge);
        let refusal = feed.give(acknowledge).refusal;
        assert_eq!(refusal, Some(Refusal::CauseStillPresent));
        feed.sample.offset_ma = MOST_OFFSET_MA;
        feed.tick();
        feed.order(Command::Acknowledge);
        feed.order(Command::Reference);
        assert!(feed.capsule.is_moving());
    }
}

#[test]
fn a_fault_is_acknowledged_only_once_its_cause_is_gone() {
    let mut feed = Feed::unfolded();
    feed.order(Command::Fold);
    feed.ticks(100);
    feed.sample.battery_mv = 2_600;
    feed.rest();
    let fault = CapsuleFault::LowBattery { battery_mv: 2_600 };
    assert_eq!(feed.capsule.fault(), Some(fault));
    let acknowledge = Event::Command(Command::Acknowledge);
    for battery_mv in [2_600, 2_999] {
        feed.sample.battery_mv = battery_mv;
        feed.tick();
        let refusal = feed.give(acknowledge).refusal;
        assert_eq!(refusal, Some(Refusal::CauseStillPresent), "{battery_mv} mV");
        assert_eq!(feed.capsule.fault(), Some(fault));
    }
    feed.sample.battery_mv = 3_000;
    feed.tick();
    feed.order(Command::Acknowledge);
    assert_eq!(feed.capsule.state(), CapsuleState::Stopped);
    assert!(feed.capsule.referenced(), "the encoder still counts");

    feed.order(Command::Fold);
    feed.ticks(100);
    feed.sample.driver_fault = true;
    feed.rest();
    assert_eq!(feed.capsule.fault(), Some(CapsuleFault::DriverFault));
    let refusal = feed.give(acknowledge).refusal;
    assert_eq!(refusal, Some(Refusal::CauseStillPresent));
    feed.sample.driver_fault = false;
    feed.tick();
    feed.order(Command::Acknowledge);
    assert_eq!(feed.capsule.state(), CapsuleState::Unreferenced);
    let refusal = feed.give(acknowledge).refusal;
    assert_eq!(refusal, Some(Refusal::NothingToAcknowledge));
}

#[test]
fn the_record_counts_the_energy_of_the_driven_time_only() {
    let mut feed = Feed::unfolded();
    feed.counts_per_ms = 2;
    // At the start the last sample is 70 ms old: nothing was driven since.
    feed.now_us += 70_000;
    feed.order(Command::Fold);
    assert_eq!(feed.record().energy_mj, 0, "the reference has its own");
    feed.now_us += 29_000;
    feed.with_current(50, 971);
    // 4.0 V * 50 mA * 1.0 s
    assert_eq!(feed.record().energy_mj, 200);
    assert_eq!(feed.record().duration_ms, 1_000);
    feed.order(Command::Stop);
    feed.with_current(500, 100);
    assert_eq!(feed.record().energy_mj, 200, "braked and asleep");
    assert_eq!(feed.record().duration_ms, 1_000);

    feed.sample.current_ma = UNLOADED_MA;
    feed.order(Command::Fold);
    feed.sample.battery_mv = 3_500;
    feed.with_current(100, 300);
    // 3.5 V * 100 mA * 0.3 s
    assert_eq!(feed.record().energy_mj, 105);
}

#[test]
fn a_clock_that_runs_backwards_adds_no_energy() {
    let mut feed = Feed::unfolded();
    feed.order(Command::Fold);
    feed.with_current(50, 500);
    assert_eq!(feed.record().energy_mj, 100);
    let now_us = feed.now_us;
    feed.now_us -= 300_000;
    feed.ticks(299);
    assert_eq!(feed.record().energy_mj, 100);
    assert!(feed.capsule.is_moving());
    feed.now_us = now_us;
    feed.ticks(100);
    assert_eq!(feed.record().energy_mj, 120);
}

#[test]
fn the_record_holds_currents_after_the_blanking_and_the_lowest_voltage() {
    let mut feed = Feed::unfolded();
    feed.sample.battery_mv = 3_100;
    feed.tick();
    feed.sample.battery_mv = 3_900;
    feed.tick();
    feed.order(Command::Fold);
    assert_eq!(feed.record().min_battery_mv, 3_900, "of this motion");
    feed.with_current(700, 29);
    let record = feed.record();
    assert_eq!((record.peak_current_ma, record.end_current_ma), (0, 0));
    feed.sample.battery_mv = 3_300;
    feed.with_current(130, 1);
    feed.sample.battery_mv = 3_600;
    feed.with_current(40, 5);
    let record = feed.record();
    assert_eq!((record.peak_current_ma, record.end_current_ma), (130, 40));
    feed.order(Command::Stop);
    feed.sample.battery_mv = 3_000;
    feed.with_current(300, 60);
    let record = feed.record();
    assert_eq!((record.peak_current_ma, record.end_current_ma), (130, 40));
    assert_eq!(record.min_battery_mv, 3_300);
}

/// Thread position at the engagement if the current rises from `unloaded_ma` to `loaded_ma` after 200 ms.
fn engagement(mut feed: Feed, unloaded_ma: u16, loaded_ma: u16) -> i32 {
    feed.order(Command::Fold);
    feed.with_current(unloaded_ma, 199);
    let before_um = feed.thread_um();
    feed.with_current(loaded_ma, 50);
    let engaged_um = feed.record().engaged_um;
    assert!(engaged_um == 0 || (20..=30).contains(&(engaged_um - before_um)));
    engaged_um
}

#[test]
fn a_fold_from_a_slack_thread_learns_the_no_load_current() {
    // 1.3 times 30 mA is 39 mA.
    assert_eq!(engagement(Feed::unfolded(), 30, 39), 0);
    assert!(engagement(Feed::unfolded(), 30, 40) > 4_000);
    // 1.3 times 10 mA is 13 mA.
    assert_eq!(engagement(Feed::unfolded(), 10, 13), 0);
    assert!(engagement(Feed::unfolded(), 10, 14) > 4_000);
}

#[test]
fn a_fold_from_mid_way_keeps_the_no_load_current_it_knows() {
    let mut feed = Feed::stopped();
    let from_um = feed.thread_um();
    feed.order(Command::Fold);
    // 1.3 times 20 mA, learnt by the fold before, is 26 mA. The thread pulls from the start.
    feed.with_current(27, 200);
    let engaged_um = feed.record().engaged_um;
    // Seen as soon as the longer blanking of the engagement is over, at 90 ms.
    let moved_um = engaged_um - from_um;
    assert!((2_180..2_230).contains(&moved_um), "{moved_um} um");
    assert_eq!(engagement(Feed::stopped(), 26, 26), 0);
}

#[test]
fn the_first_engagement_of_a_fold_stays_in_its_record() {
    let mut feed = Feed::unfolded();
    feed.order(Command::Fold);
    feed.with_current(20, 199);
    feed.with_current(30, 20);
    let engaged_um = feed.record().engaged_um;
    assert!(engaged_um > 0);
    feed.with_current(20, 100);
    feed.with_current(30, 100);
    assert_eq!(feed.record().engaged_um, engaged_um);
}

#[test]
fn an_engagement_is_recorded_while_winding_only() {
    let mut feed = Feed::folded();
    feed.order(Command::Unfold);
    feed.with_current(100, 300);
    assert!(feed.capsule.is_moving());
    assert_eq!(feed.record().engaged_um, 0);
}

#[test]
fn a_reference_refers_its_engagement_to_the_zero_it_finds() {
    let mut feed = Feed::new();
    feed.order(Command::Reference);
    feed.with_current(UNLOADED_MA, 300);
    feed.with_current(40, 1);
    let engaged = feed.sample.counts;
    while feed.thread_um() < 20_000 {
        feed.tick();
    }
    assert_eq!(
        feed.record().engaged_um,
        engaged.thread().0,
        "from the arbitrary zero"
    );
    feed.with_current(RISE_MA, 40);
    feed.with_current(END_MA, 6);
    assert!(feed.capsule.referenced());
    let wound_since_um = feed.sample.counts.since(engaged).thread().0;
    let expected_um = FOLDED.0 - wound_since_um;
    let engaged_um = feed.record().engaged_um;
    assert!(
        (engaged_um - expected_um).abs() <= 1,
        "{engaged_um} um, expected {expected_um}"
    );
    assert!((engaged_um - engaged.thread().0).abs() > 100);
}

#[test]
fn a_motion_that_is_already_at_its_end_does_not_switch_the_motor_on() {
    let mut feed = Feed::unfolded();
    feed.order(Command::Fold);
    feed.order(Command::Stop);
    // 30 um from zero: within the stop margin.
    let excess = Thread(feed.thread_um() - 30).counts();
    feed.sample.counts = feed.sample.counts.back(excess);
    feed.ticks(100);
    assert_eq!(feed.capsule.state(), CapsuleState::Stopped);
    assert_eq!(feed.capsule.drive(), Drive::Off);
    let actuation = feed.record().actuation + 1;
    let actions = feed.order(Command::Unfold);
    let kind = ActuationKind::Unfold;
    let outcome = ActuationOutcome::Complete;
    assert_eq!(
        actions.events.as_slice(),
        [
            CapsuleEvent::Started { actuation, kind },
            CapsuleEvent::Ended { actuation, outcome }
        ]
    );
    assert_eq!(actions.drive, Drive::Off, "nothing to brake either");
    assert_eq!(feed.capsule.state(), CapsuleState::Unfolded);
    feed.ticks(50);
    assert_eq!(feed.capsule.drive(), Drive::Off);
}

#[test]
fn an_emergency_stop_replaces_another_fault_once() {
    let mut feed = Feed::unfolded();
    feed.order(Command::Fold);
    feed.ticks(200);
    feed.with_current(END_MA, 6);
    feed.rest();
    let Some(jam @ CapsuleFault::Jam { .. }) = feed.capsule.fault() else {
        panic!("{:?}", feed.capsule.fault())
    };
    assert!(feed.capsule.referenced(), "a jam keeps the position");
    let record = feed.record();
    let events = feed.order(Command::EStop).events;
    let estop = CapsuleFault::EStopFrame;
    assert_eq!(events.as_slice(), [CapsuleEvent::Faulted(estop)]);
    assert_eq!(feed.capsule.fault(), Some(estop));
    assert!(!feed.capsule.referenced());
    assert_eq!(feed.record(), record, "of the fold that jammed");
    assert_eq!(record.outcome, ActuationOutcome::Faulted(jam));
    for event in [Event::Command(Command::EStop), Event::LinkSilent] {
        assert!(feed.give(event).events.is_empty());
        assert_eq!(feed.capsule.fault(), Some(estop));
    }
}

/// Folds to the end force at `end_um`. Returns the thread counted from the zero before the fold, um.
fn fold_to(end_um: i32) -> (i32, Feed) {
    let mut feed = Feed::unfolded();
    let offset = feed.sample.counts.since(feed.capsule.thread().counts());
    feed.order(Command::Fold);
    feed.wind_to_force(end_um);
    assert_eq!(feed.capsule.state(), CapsuleState::Folded);
    (feed.sample.counts.since(offset).thread().0, feed)
}

#[test]
fn a_fold_past_the_expected_end_moves_the_zero_and_a_shorter_one_does_not() {
    let (counted_um, feed) = fold_to(21_800);
    assert!((21_900..22_000).contains(&counted_um), "{counted_um} um");
    assert!((feed.thread_um() - FOLDED.0).abs() <= 1);
    let (counted_um, feed) = fold_to(21_000);
    assert!((21_100..21_200).contains(&counted_um), "{counted_um} um");
    assert!((feed.thread_um() - counted_um).abs() <= 1);
    // Either way the unfold pays out what the machine says is wound, down to the stop margin.
    for end_um in [21_800, 21_000] {
        let (_, mut feed) = fold_to(end_um);
        feed.rest();
        feed.order(Command::Unfold);
        feed.rest();
        assert_eq!(feed.capsule.state(), CapsuleState::Unfolded);
        // 20 counts per ms run on for 146 counts, 179 um; this motor stops dead.
        let end_um = feed.thread_um();
        assert!((180..=219).contains(&end_um), "{end_um} um");
    }
}

#[test]
fn a_fold_is_fast_until_18_mm_and_gentle_from_there() {
    let mut feed = Feed::unfolded();
    feed.order(Command::Fold);
    feed.counts_per_ms = 1;
    // Within a millimetre of the change, by single counts.
    feed.sample.counts.0 += Thread(17_500).counts().0;
    while feed.thread_um() < 18_100 {
        feed.tick();
        let expected = if feed.thread_um() < 18_000 {
            Drive::Millivolts(3_700)
        } else {
            Drive::Millivolts(1_500)
        };
        assert_eq!(feed.capsule.drive(), expected, "{} um", feed.thread_um());
    }
}

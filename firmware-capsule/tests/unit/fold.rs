//! The state machine from inside: single readings of a motion, with the speeds and currents that they need.

use super::*;
use crate::{circuit::Reading, leg::Then};

pub(super) const END: Thread = Thread(21_700);
pub(super) const KNOWN: Calibration = Calibration {
    folded: END,
    no_load_ma: 16,
    rise: Thread(1_500),
    long_rise: Thread(3_300),
    tension_ma: 90,
    back_emf_uv_cps: 203,
};

/// A motion that this order has begun at this thread; the origin is the count 0.
pub(super) fn moving(mode: Mode, thread: Thread, command: Command) -> Capsule {
    let mut capsule = Capsule::new(None, Some(KNOWN), None, Settings::REFERENCE);
    let sample = Sample {
        counts: thread.counts(),
        battery_mv: 3_900,
        ..Sample::default()
    };
    capsule.step(0, Event::Sample(sample));
    (capsule.mode, capsule.referenced) = (mode, true);
    let actions = capsule.step(1_000, Event::Command(command));
    assert_eq!(actions.refusal, None);
    assert!(capsule.is_moving());
    capsule
}

pub(super) fn actuation(capsule: &mut Capsule) -> &mut Actuation {
    match &mut capsule.mode {
        Mode::Moving(actuation) => actuation,
        other => panic!("{other:?}"),
    }
}

/// The next reading, this many counts further, with this current, a millisecond later.
fn read(capsule: &mut Capsule, counts: i32, current_ma: i32) -> Actions {
    let sample = Sample {
        counts: Counts(capsule.sample.counts.0 + counts),
        current_ua: current_ma * 1_000,
        ..capsule.sample
    };
    capsule.step(capsule.sample_us + 1_000, Event::Sample(sample))
}

/// Above 4,500 counts/s against its direction, above 3,000 shorted; a slower one is driven on, and so is one whose time
/// is over.
#[test]
fn the_speed_of_a_struck_motor_says_how_it_is_slowed() {
    // A speed over 8 ms, of 125 counts/s for each count.
    for (counts, in_time, effort) in [
        (37, true, Some(Effort::Millivolts(-2_500))),
        (36, true, Some(Effort::Brake)),
        (25, true, Some(Effort::Brake)),
        (24, true, None),
        (37, false, None),
    ] {
        let mut capsule = moving(Mode::Unfolded, Thread(0), Command::Fold);
        let settings = Settings::REFERENCE;
        let moves = actuation(&mut capsule);
        let mut sample = Sample {
            battery_mv: 3_900,
            ..Sample::default()
        };
        // The last three milliseconds are no slower than all eight.
        let step = (counts + 7) / 8;
        for at in 0..=8 {
            sample.counts = Counts(match at {
                ..=5 => (counts - 3 * step) * at / 5,
                _ => counts - (8 - at) * step,
            });
            let now_us = 2_000 + 1_000 * u64::try_from(at).expect("positive");
            let checked = moves.detector.check(now_us, &sample, None, 16, &settings);
            assert!(checked.is_ok(), "{checked:?}");
        }
        let (_, least_cps) = moves.detector.speeds_cps();
        assert_eq!(least_cps, counts * 125);
        moves.struck_until_us = 10_000 + u64::from(in_time);
        moves.effort = Effort::Millivolts(7);
        capsule.govern(10_000);
        let governed = actuation(&mut capsule).effort;
        match effort {
            Some(effort) => assert_eq!(governed, effort, "{counts}"),
            None => assert!(matches!(governed, Effort::Millivolts(1..)), "{governed:?}"),
        }
    }
}

/// The reading that ends the brake was not driven yet. Taken for one of the leg, it would blind it for 10 ms more.
#[test]
fn a_leg_after_a_brake_sees_the_force_30_ms_later() {
    let mut capsule = moving(Mode::Unfolded, Thread(0), Command::Fold);
    capsule.step(2_000, Event::Command(Command::Stop));
    assert_eq!(capsule.brake_until_us, 42_000);
    capsule.step(3_000, Event::Command(Command::Unfold));
    let seen_us = (0..100).find_map(|_| {
        read(&mut capsule, 1, -30);
        (capsule.record().end_current_ma != 0).then_some(capsule.sample_us)
    });
    assert_eq!(seen_us, Some(72_000));
}

/// All the current of a motor that feels for the thread cannot wind it: the thread pulls, and nothing is jammed.
#[test]
fn a_motor_that_stands_while_it_feels_is_pulled() {
    let mut capsule = moving(Mode::Folded, END, Command::Unfold);
    let settings = Settings::REFERENCE;
    let standing = Sample {
        current_ua: 145_000,
        ..capsule.sample
    };
    for ms in 1..=40 {
        let detector = &mut actuation(&mut capsule).detector;
        let load = detector.check(1_000 + 1_000 * ms, &standing, Some(145), 16, &settings);
        assert!(load.is_ok_and(|load| !load.end_force), "{ms} ms");
    }
    capsule.sample_us = 41_000;
    read(&mut capsule, 0, 145);
    assert_eq!(capsule.fault(), None);
    let leg = actuation(&mut capsule).leg;
    assert!(leg.measures_tension(), "{leg:?}");
}

/// Sequence 1,310,777 of `tests/sequences.rs`: a fold beyond its time became careful, then felt its thread.
#[test]
fn a_motion_whose_time_is_over_begins_no_other_leg() {
    let mut capsule = moving(Mode::Folded, END, Command::Unfold);
    let leg = Leg::BackOff {
        to: capsule.sample.counts,
        then: Then::PayOut {
            to: Thread(0),
            left: 0,
        },
    };
    let mut late = capsule.clone();
    for (capsule, deadline_us) in [(&mut capsule, u64::MAX), (&mut late, 0)] {
        let actuation = actuation(capsule);
        (actuation.leg, actuation.deadline_us) = (leg, deadline_us);
        read(capsule, 0, 16);
    }
    assert!(matches!(actuation(&mut capsule).leg, Leg::Feel { .. }));
    assert_eq!(late.fault(), Some(CapsuleFault::Timeout));
}

/// It has paid out all that it may, and was never steady enough for a reading: nothing shows that the thread holds.
#[test]
fn an_end_that_could_not_be_felt_is_none() {
    for (mode, command) in [
        (Mode::Folded, Command::CheckFolded),
        (Mode::Unfolded, Command::Fold),
    ] {
        for (taut_to, felt) in [(Some(Thread(19_720)), false), (None, true)] {
            let mut capsule = moving(mode.clone(), END, command);
            let to = Thread(END.0 - 2_000);
            actuation(&mut capsule).leg = Leg::PayOut { to, taut_to };
            let thread = Thread(to.0 + 30);
            capsule.sample.counts = thread.counts();
            let mut actions = Actions::default();
            let decided = capsule.decide(2_000, Load::default(), &mut actions);
            let expected = match felt {
                true => Ok(()),
                false => Err(CapsuleFault::SlipOrBreak),
            };
            assert_eq!(decided, expected, "{command:?}");
        }
    }
}

/// The end creeps once a cycle, with the unfolding: one that is felt in a fold or a check is felt again then.
#[test]
fn only_what_leaves_the_folded_end_follows_its_creep() {
    for (mode, command, follows) in [
        (Mode::Folded, Command::Unfold, true),
        (Mode::Folded, Command::CheckFolded, false),
        (Mode::Unfolded, Command::Fold, false),
    ] {
        let mut capsule = moving(mode, END, command);
        let taut_to = Thread(END.0 - 700);
        let moves = actuation(&mut capsule);
        moves.leg = Leg::PayOut {
            to: Thread(0),
            taut_to: Some(taut_to),
        };
        moves.detector = Detector::new(Spooling::PayOut, 0, 3_900);
        // Three quarters of the calibrated pull.
        moves.winding_ma = Some(100);
        capsule.sample.current_ua = -32_000;
        for um in [100, 0] {
            capsule.sample.counts = Thread(taut_to.0 + um).counts();
            capsule
                .measure(Thread(taut_to.0 + um), true)
                .expect("it pulls");
        }
        assert_eq!(capsule.crept != Thread(0), follows, "{command:?}");
    }
}

/// A motor of 203 uV per count/s that draws 60 mA more than its voltage and speed explain.
fn contradicts(capsule: &mut Capsule) {
    for ms in 1..=49 {
        let reading = Reading {
            drive_mv: 2_190,
            current_ua: 80_000,
            along: Counts(10 * ms),
            battery_mv: 3_700,
            sag_mv: 0,
            at_us: 1_000 * u64::try_from(ms).expect("positive"),
        };
        let circuit = &mut actuation(capsule).circuit;
        assert!(!circuit.take(Some(reading), 203, &Settings::REFERENCE));
    }
}

/// The comparison that the end cuts short counts, too.
#[test]
fn no_end_is_believed_that_current_and_counts_contradict() {
    let load = Load {
        end_force: true,
        excess_ma: Some(135),
        ..Load::default()
    };
    for (contradicted, decided) in [(false, Ok(())), (true, Err(CapsuleFault::SenseOrEncoder))] {
        let mut capsule = moving(Mode::Unfolded, Thread(0), Command::Fold);
        if contradicted {
            contradicts(&mut capsule);
        }
        capsule.sample.counts = END.counts();
        let mut actions = Actions::default();
        assert_eq!(capsule.decide(60_000, load, &mut actions), decided);
        assert_eq!(capsule.state() == CapsuleState::Folded, !contradicted);
    }
    // On the way it takes two comparisons in a row.
    let mut capsule = moving(Mode::Unfolded, Thread(0), Command::Fold);
    contradicts(&mut capsule);
    let on_the_way = capsule.decide(60_000, Load::default(), &mut Actions::default());
    assert_eq!(on_the_way, Ok(()));
}

/// A calibration ends short of the shortest fold if the thread was not paid out when it began.
#[test]
fn the_shortest_fold_is_long_enough_for_a_calibration() {
    let shortest = Settings::REFERENCE.folded_range.0;
    for (um, refused) in [(0, false), (-1, true)] {
        let mut capsule = moving(Mode::Stopped, Thread(0), Command::Calibrate);
        let wound = Thread(shortest.0 + um);
        let found = capsule.end_found(wound, Rise::default(), Purpose::Calibrate);
        assert_eq!(found.is_err(), refused, "{wound:?}: {found:?}");
    }
}

/// Without a calibration there is nothing to compare the end with.
#[test]
fn the_first_reference_is_a_calibration() {
    for (calibration, purpose) in [
        (None, Purpose::Calibrate),
        (Some(KNOWN), Purpose::Reference),
    ] {
        let mut capsule = Capsule::new(None, calibration, None, Settings::REFERENCE);
        capsule.sample.battery_mv = 3_900;
        capsule.step(0, Event::Command(Command::Reference));
        let leg = actuation(&mut capsule).leg;
        assert!(
            matches!(leg, Leg::Seek { purpose: is, .. } if is == purpose),
            "{leg:?}"
        );
    }
}

/// Thread that a run has not wound itself may be missing at zero: up to 1.3 mm, and 0.1 mm in any case.
#[test]
fn thread_that_a_run_has_not_wound_is_not_paid_out() {
    let believed = Purpose::Check { believed: true };
    let doubted = Purpose::Check { believed: false };
    for (purpose, missing_um, spare_um) in [
        (Purpose::Reference, 0, 100),
        (Purpose::Reference, 500, 500),
        (Purpose::Reference, 5_000, 1_300),
        (doubted, 500, 500),
        (believed, 5_000, 100),
        (Purpose::Calibrate, 500, 0),
    ] {
        let mut capsule = moving(Mode::Stopped, END, Command::Reference);
        let wound = Thread(END.0 - missing_um);
        let found = capsule.end_found(wound, Rise::default(), purpose);
        assert!(found.is_ok(), "{found:?}");
        assert_eq!(capsule.spare, Thread(spare_um), "{purpose:?} {missing_um}");
        let believed_um = match purpose {
            Purpose::Calibrate => wound.0,
            _ => END.0 - spare_um,
        };
        assert!(capsule.thread().0.abs_diff(believed_um) <= 1);
    }
}

#[test]
fn the_folded_end_is_believed_short_by_the_margin_and_further_by_the_creep() {
    let mut capsule = Capsule::new(None, Some(KNOWN), None, Settings::REFERENCE);
    (capsule.spare, capsule.crept) = (Thread(100), Thread(30));
    assert_eq!(capsule.folded_end(), Some(Thread(END.0 - 70)));
}

/// The rise that a reference run compares was counted above the calibration's no-load current.
#[test]
fn a_reference_counts_from_the_calibrations_no_load_current() {
    for (command, no_load_ma) in [(Command::Reference, 16), (Command::Calibrate, 22)] {
        let mut capsule = moving(Mode::Unfolded, Thread(0), Command::Fold);
        capsule.mode = Mode::Stopped;
        capsule.no_load_ma = 22;
        let begun = capsule.step(2_000, Event::Command(command));
        assert_eq!(begun.refusal, None);
        assert_eq!(capsule.no_load_ma, no_load_ma, "{command:?}");
    }
}

/// A calibration has measured the no-load current, so a setting does not change it.
#[test]
fn settings_are_in_force_once_they_are_set() {
    let other = Settings {
        no_load_ma: 21,
        force_ma: 120,
        ..Settings::REFERENCE
    };
    for (calibration, no_load_ma) in [(None, 21), (Some(KNOWN), 16)] {
        let mut capsule = Capsule::new(None, calibration, None, Settings::REFERENCE);
        capsule.set_settings(other);
        assert_eq!(*capsule.settings(), other);
        assert_eq!(capsule.no_load_ma, no_load_ma);
    }
    // A current that a slack thread has shown outlives a change of something else.
    let mut capsule = Capsule::new(None, None, None, other);
    capsule.no_load_ma = 18;
    capsule.set_settings(Settings {
        force_ma: 130,
        ..other
    });
    assert_eq!(capsule.no_load_ma, 18);
}

/// An end force after this rise, on the way of this order.
fn risen(command: Command, half_um: i32, quarter_um: i32) -> Capsule {
    let mut capsule = moving(Mode::Stopped, Thread(0), command);
    let at = Thread(20_000).counts();
    capsule.sample.counts = at;
    let load = Load {
        end_force: true,
        rise_from: Some(at.back(Thread(half_um).counts())),
        long_rise_from: Some(at.back(Thread(quarter_um).counts())),
        ..Load::default()
    };
    let decided = capsule.decide(60_000, load, &mut Actions::default());
    assert_eq!(decided, Ok(()));
    capsule
}

/// A calibration knows no rise yet, and takes one that the calibration before it would not.
#[test]
fn a_reference_compares_the_rise_with_the_calibrations() {
    for (command, half_um, quarter_um, found) in [
        (Command::Reference, 1_500, 3_300, true),
        (Command::Reference, 700, 1_500, false),
        (Command::Calibrate, 700, 1_500, true),
    ] {
        let mut capsule = risen(command, half_um, quarter_um);
        let leg = actuation(&mut capsule).leg;
        let backs_off = matches!(leg, Leg::BackOff { .. });
        assert_eq!(backs_off, !found, "{command:?} {half_um} um: {leg:?}");
    }
}

/// An old calibration may have ended where the thread of the new one is still wound and felt.
#[test]
fn a_calibration_is_not_held_to_the_end_of_the_one_before() {
    let past_um = END.0 + Settings::REFERENCE.end_overrun.0;
    for (found, goes_on) in [
        (Some((Thread(past_um), Rise::default())), true),
        (None, false),
    ] {
        let mut capsule = moving(Mode::Folded, Thread(past_um), Command::Unfold);
        let at = capsule.sample.counts;
        let moves = actuation(&mut capsule);
        moves.leg = Leg::feel(at, Thread(0));
        moves.found = found;
        let decided = capsule.decide(2_000, Load::default(), &mut Actions::default());
        assert_eq!(decided, Ok(()));
        let feels = matches!(actuation(&mut capsule).leg, Leg::Feel { .. });
        assert_eq!(feels, goes_on);
    }
}

/// Only an unfolding that ends at zero, or at what is believed of it, leaves the capsule unfolded.
#[test]
fn a_partial_motion_ends_stopped() {
    for (command, mode, state) in [
        (
            Command::FoldTo(Thread(12_000)),
            Mode::Unfolded,
            CapsuleState::Stopped,
        ),
        (
            Command::FoldTo(Thread(12_000)),
            Mode::Folded,
            CapsuleState::Stopped,
        ),
        (Command::Unfold, Mode::Stopped, CapsuleState::Unfolded),
    ] {
        let from = match mode {
            Mode::Unfolded => Thread(0),
            _ => END,
        };
        let mut capsule = moving(mode, from, command);
        let (to, leg) = match command {
            Command::FoldTo(to) => (to, actuation(&mut capsule).leg),
            _ => (Thread(0), actuation(&mut capsule).leg),
        };
        if let Leg::Feel { .. } = leg {
            actuation(&mut capsule).leg = Leg::PayOut { to, taut_to: None };
        }
        capsule.sample.counts = to.counts();
        let decided = capsule.decide(2_000, Load::default(), &mut Actions::default());
        assert_eq!((decided, capsule.state()), (Ok(()), state), "{command:?}");
    }
}

/// A way of the tension zone, 0.7 mm, is too short to measure the tension in.
#[test]
fn a_longer_way_from_the_folded_end_begins_with_feeling() {
    for (um, feels) in [(700, false), (701, true)] {
        let to = Thread(END.counts().thread().0 - um);
        let mut capsule = moving(Mode::Folded, END, Command::FoldTo(to));
        let leg = actuation(&mut capsule).leg;
        assert_eq!(matches!(leg, Leg::Feel { .. }), feels, "{um} um: {leg:?}");
    }
}

/// A thread that may pull shows no no-load current.
#[test]
fn only_a_slack_thread_is_measured_without_load() {
    for (mode, command, slack) in [
        (Mode::Unfolded, Command::Fold, true),
        (Mode::Stopped, Command::Fold, false),
        (Mode::Unfolded, Command::Reference, false),
        (Mode::Stopped, Command::Calibrate, true),
    ] {
        let mut capsule = moving(mode, Thread(0), command);
        let measured = actuation(&mut capsule).slack_from.is_some();
        assert_eq!(measured, slack, "{command:?}");
    }
}

/// An unfolding needs less: an almost empty cell must not leave a capsule half folded.
#[test]
fn a_motion_begins_with_just_the_voltage_that_it_needs() {
    let settings = Settings::REFERENCE;
    let unfolding_mv = settings.loaded_battery_mv + 100;
    for (command, least_mv) in [
        (Command::Fold, settings.least_battery_mv),
        (Command::Unfold, unfolding_mv),
    ] {
        for (battery_mv, refused) in [(least_mv, false), (least_mv - 1, true)] {
            let mut capsule = Capsule::new(None, Some(KNOWN), None, settings);
            (capsule.mode, capsule.referenced) = (Mode::Stopped, true);
            (capsule.sample.battery_mv, capsule.sample.counts) = (battery_mv, Counts(8_000));
            let refusal = capsule.step(0, Event::Command(command)).refusal;
            let min_mv = least_mv;
            let low = Refusal::BatteryLow { battery_mv, min_mv };
            assert_eq!(refusal, refused.then_some(low), "{command:?}");
        }
    }
}

/// A current at rest is a fault before anything moves; one that no bridge can cause is the amplifier's.
#[test]
fn an_amplifier_that_shows_a_current_at_rest_starts_nothing() {
    let over = |current_ma| Some(CapsuleFault::OverCurrent { current_ma });
    for (offset_ma, fault) in [
        (20, None),
        (-20, None),
        (21, over(21)),
        (-999, over(999)),
        (1_000, Some(CapsuleFault::SenseLost)),
        (-1_650, Some(CapsuleFault::SenseLost)),
    ] {
        let mut capsule = Capsule::new(None, Some(KNOWN), None, Settings::REFERENCE);
        (capsule.sample.battery_mv, capsule.sample.offset_ma) = (3_900, offset_ma);
        let actions = capsule.step(0, Event::Command(Command::Reference));
        assert_eq!(actions.refusal, fault.map(Refusal::CapsuleFaulted));
        assert_eq!(
            (capsule.fault(), capsule.is_moving()),
            (fault, fault.is_none())
        );
    }
}

#[test]
fn a_motion_that_takes_too_long_is_ended() {
    let ms = Settings::REFERENCE.fold_timeout_ms;
    let deadline_us = 1_000 + 1_000 * u64::from(ms);
    for (now_us, decided) in [
        (deadline_us - 1, Ok(())),
        (deadline_us, Err(CapsuleFault::Timeout)),
    ] {
        let mut capsule = moving(Mode::Unfolded, Thread(0), Command::Fold);
        let load = Load::default();
        assert_eq!(
            capsule.decide(now_us, load, &mut Actions::default()),
            decided
        );
    }
}

/// Acknowledging does not help against what is still there.
#[test]
fn a_fault_is_acknowledged_once_its_cause_is_gone() {
    let least_mv = Settings::REFERENCE.loaded_battery_mv + 100;
    let low = CapsuleFault::LowBattery { battery_mv: 2_500 };
    for (fault, battery_mv, driver_fault, gone) in [
        (CapsuleFault::DriverFault, 3_900, true, false),
        (CapsuleFault::DriverFault, 3_900, false, true),
        (low, least_mv - 1, false, false),
        (low, least_mv, true, true),
        (CapsuleFault::Timeout, 2_000, true, true),
    ] {
        let mut capsule = Capsule::new(Some(fault), None, None, Settings::REFERENCE);
        (capsule.sample.battery_mv, capsule.sample.driver_fault) = (battery_mv, driver_fault);
        let refusal = capsule
            .step(0, Event::Command(Command::Acknowledge))
            .refusal;
        let expected = (!gone).then_some(Refusal::CauseStillPresent);
        assert_eq!(refusal, expected, "{fault:?} at {battery_mv} mV");
        assert_eq!(capsule.fault().is_none(), gone);
    }
}

/// 0.65 mm less than the calibration in force, whose zero may be 1.3 mm too high.
#[test]
fn a_calibration_that_winds_less_than_the_last_one_misses_thread() {
    let spared = Thread(FOUND_BY_RISE.0 - 1);
    for (spare, wound_um, misses) in [
        (FOUND_BY_RISE, 21_049, true),
        (FOUND_BY_RISE, 21_050, false),
        (FOUND_BY_RISE, 21_700, false),
        (spared, 20_000, false),
    ] {
        let mut capsule = Capsule::new(None, Some(KNOWN), None, Settings::REFERENCE);
        capsule.spare = spare;
        let told = capsule.misses_thread(Thread(wound_um));
        assert_eq!(told, misses, "{spare:?}, {wound_um} um");
    }
}

/// In a motion that began with a zero, or one that has found it, a pull is not looked for past the end.
#[test]
fn the_end_counts_while_the_zero_is_known() {
    for (referenced, zero_known, is_past) in [
        (true, true, true),
        (true, false, true),
        (false, true, true),
        (false, false, false),
    ] {
        let past = Thread(END.0 + Settings::REFERENCE.end_overrun.0);
        let mut capsule = moving(Mode::Folded, END, Command::Unfold);
        capsule.referenced = referenced;
        capsule.sample.counts = past.counts();
        let moves = actuation(&mut capsule);
        moves.zero_known = zero_known;
        moves.leg = Leg::feel(past.counts(), Thread(0));
        let before = moves.leg;
        let decided = capsule.decide(2_000, Load::default(), &mut Actions::default());
        assert_eq!(decided, Ok(()));
        let goes_on = actuation(&mut capsule).leg == before;
        assert_eq!(goes_on, !is_past, "{referenced}, {zero_known}");
    }
}

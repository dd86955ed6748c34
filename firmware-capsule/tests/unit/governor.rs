//! Output of the speed loop.

use super::*;

const FAST: Aim = Aim {
    cps: 11_000,
    limit_ma: 220,
    held_ma: 220,
};

/// A motor at standstill gets the current limit times its resistance as voltage, at any battery voltage.
#[test]
fn the_first_pulse_is_bounded_by_the_current() {
    for battery_mv in [2_900, 3_700, 4_200] {
        let mut governor = Governor::default();
        for _ in 0..200 {
            let Effort::Millivolts(drive_mv) =
                governor.step(FAST, (0, 0), battery_mv, &Settings::REFERENCE)
            else {
                panic!("it brakes");
            };
            assert!(drive_mv <= 1_430, "{drive_mv} mV are more than 220 mA");
        }
        assert_eq!(governor.ordered_ma(), Some(220));
    }
}

#[test]
fn a_turning_motor_is_given_more_for_the_same_current() {
    // 11,000 counts/s are 2,277 mV of back-EMF.
    assert_eq!(drive_mv(100_000, 0, 3_700, &Settings::REFERENCE), 650);
    assert_eq!(
        drive_mv(100_000, 11_000, 3_700, &Settings::REFERENCE),
        2_927
    );
    assert_eq!(
        drive_mv(100_000, 18_000, 3_700, &Settings::REFERENCE),
        3_700,
        "nothing remains"
    );
    assert_eq!(drive_mv(100_000, -11_000, 3_700, &Settings::REFERENCE), 650);
    assert_eq!(
        drive_mv(u32::MAX, i32::MAX, u16::MAX, &Settings::REFERENCE),
        u16::MAX
    );
}

#[test]
fn a_motor_that_is_too_fast_is_braked_and_a_little_too_fast_is_not() {
    for (aim_cps, cps, brakes) in [
        (8_000, 10_000, false),
        (8_000, 10_001, true),
        (1_600, 2_100, false),
        (1_600, 2_101, true),
    ] {
        let mut governor = Governor::default();
        let aim = Aim {
            cps: aim_cps,
            ..FAST
        };
        let effort = governor.step(aim, (cps, cps), 3_700, &Settings::REFERENCE);
        assert_eq!(effort == Effort::Brake, brakes, "{cps} for {aim_cps}");
        assert_eq!(governor.ordered_ma().is_none(), brakes);
    }
}

/// While something stops the motor, the back-EMF that it had 4 ms ago must not raise the current.
#[test]
fn the_current_is_bounded_by_the_least_speed() {
    let mut governor = Governor::default();
    governor.step(FAST, (11_000, 11_000), 3_700, &Settings::REFERENCE);
    let mut slowed = governor.clone();
    let Effort::Millivolts(steady) =
        governor.step(FAST, (10_000, 10_000), 3_700, &Settings::REFERENCE)
    else {
        panic!("it brakes");
    };
    let Effort::Millivolts(stopped) = slowed.step(FAST, (10_000, 0), 3_700, &Settings::REFERENCE)
    else {
        panic!("it brakes");
    };
    assert!(stopped * 2 < steady, "{stopped} of {steady} mV");
}

/// The measured speed is a mean over 3 ms, so a motor that is being shorted is slower than measured.
#[test]
fn a_motor_that_is_being_braked_is_not_braked_too_long() {
    for (braked_ms, cps, brakes) in [
        (0, 10_001, true),
        (1, 11_400, false),
        (1, 11_500, true),
        (2, 13_300, false),
        (2, 13_400, true),
    ] {
        let mut governor = Governor::default();
        for _ in 0..braked_ms {
            governor.brake();
        }
        let aim = Aim { cps: 8_000, ..FAST };
        let effort = governor.step(aim, (cps, cps), 3_700, &Settings::REFERENCE);
        assert_eq!(
            effort == Effort::Brake,
            brakes,
            "{cps} after {braked_ms} ms"
        );
    }
}

/// A load of 130 mA: with 100 mA held, what is missing costs 30 mA / 15 uA per count/s = 2,000 counts/s.
#[test]
fn what_needs_more_than_is_held_is_moved_more_slowly() {
    let mut governor = Governor::default();
    let aim = Aim {
        held_ma: 100,
        ..FAST
    };
    for _ in 0..1_000 {
        governor.step(aim, (9_000, 9_000), 3_700, &Settings::REFERENCE);
    }
    assert_eq!(governor.ordered_ma(), Some(130));
    governor.step(aim, (11_000, 11_000), 3_700, &Settings::REFERENCE);
    assert_eq!(governor.ordered_ma(), Some(100));
    for _ in 0..1_000 {
        governor.step(FAST, (9_000, 9_000), 3_700, &Settings::REFERENCE);
    }
    assert_eq!(governor.ordered_ma(), Some(220), "all is held");
}

/// The speed loop does not wind up on an empty battery: as soon as a motor that was too slow is too fast, it gets less
/// than the drive that held it.
#[test]
fn a_motor_that_the_battery_cannot_speed_up_is_slowed_down_at_once() {
    let mut governor = Governor::default();
    let out_of_reach = Aim {
        cps: 17_100,
        ..FAST
    };
    for _ in 0..1_000 {
        let effort = governor.step(out_of_reach, (15_500, 15_500), 3_300, &Settings::REFERENCE);
        assert_eq!(effort, Effort::Millivolts(3_300));
    }
    let lower = Aim {
        cps: 15_000,
        ..FAST
    };
    governor.step(lower, (15_500, 15_500), 3_300, &Settings::REFERENCE);
    let ordered_ma = governor.ordered_ma().expect("it is driven");
    assert!(ordered_ma < 40, "{ordered_ma} mA");
}

/// A load on the way up asks for current beyond the battery. None of that is owed once the aim falls.
#[test]
fn a_current_that_the_battery_no_longer_gives_is_not_kept() {
    let mut governor = Governor::default();
    let mut step = |aim_cps, least_cps, cps| {
        let aim = Aim {
            cps: aim_cps,
            ..FAST
        };
        let effort = governor.step(aim, (cps, least_cps), 3_300, &Settings::REFERENCE);
        let Effort::Millivolts(drive_mv) = effort else {
            panic!("{effort:?}")
        };
        (drive_mv, governor.integral_ua)
    };
    for _ in 0..800 {
        step(17_100, 9_000, 16_900);
    }
    let (drive_mv, held_ua) = step(17_100, 15_500, 15_500);
    assert!(drive_mv == 3_300 && held_ua > 30_000, "{held_ua} uA");
    step(15_400, 15_500, 15_500);
    let (drive_mv, _) = step(14_500, 15_500, 15_500);
    assert!(drive_mv < 3_250, "{drive_mv} mV");
}

/// 600 mA against the motion take 3,900 mV at standstill, more than an empty cell has, and less by the back-EMF of a
/// motor that turns. It never drives on.
#[test]
fn a_motor_is_plugged_with_a_bounded_current() {
    for (cps, drive_mv) in [
        (-10_000, -2_500),
        (0, -2_500),
        (6_764, -2_500),
        (6_769, -2_499),
        (10_000, -1_830),
        (15_000, -795),
        (18_841, 0),
        (30_000, 0),
    ] {
        let mut governor = Governor::default();
        governor.step(FAST, (9_000, 9_000), 3_700, &Settings::REFERENCE);
        let effort = governor.plug(cps, &Settings::REFERENCE);
        assert_eq!(effort, Effort::Millivolts(drive_mv), "{cps}");
        assert_eq!(governor.ordered_ma(), None);
    }
}

/// At 15,500 counts/s 92 mV of an almost empty cell are left for the current, 14.153 mA. A motor at its aim holds what
/// it asked for; one count per second above it, the 15 uA of its excess more than the cell gives.
#[test]
fn only_a_motor_above_its_aim_gives_back_what_the_battery_does_not_give() {
    for (aim_cps, held_ua) in [(15_500, 200_000), (15_499, 14_168)] {
        let mut governor = Governor {
            integral_ua: 200_000,
            ..Governor::default()
        };
        let aim = Aim {
            cps: aim_cps,
            ..FAST
        };
        let effort = governor.step(aim, (15_500, 15_500), 3_300, &Settings::REFERENCE);
        assert_eq!(effort, Effort::Millivolts(3_300));
        assert_eq!(governor.integral_ua, held_ua, "{aim_cps}");
    }
}

/// A motor at its aim on a battery that gives all it has: a lower limit counts at once.
#[test]
fn what_may_no_longer_be_held_is_dropped_on_an_empty_battery_too() {
    let mut governor = Governor {
        integral_ua: 200_000,
        saturated: true,
        ..Governor::default()
    };
    let aim = Aim {
        held_ma: 100,
        ..FAST
    };
    governor.step(aim, (11_000, 11_000), 3_300, &Settings::REFERENCE);
    assert_eq!(governor.integral_ua, 100_000);
}

#[test]
fn a_governor_that_holds_less_drops_a_third() {
    let mut governor = Governor {
        integral_ua: 90_000,
        ..Governor::default()
    };
    governor.hold_less();
    assert_eq!(governor.integral_ua, 60_000);
}

/// A motor that turns at least at an eighth of its aim is no longer helped to start. What is missing to the limit is
/// not added up while the error alone asks for all of it: 7,000 counts/s take 105 mA.
#[test]
fn the_integral_part_grows_faster_only_while_the_motor_hardly_turns() {
    for (cps, limit_ma, integral_ua) in [
        (999, 220, 7_001),
        (1_000, 220, 1_750),
        (1_000, 105, 0),
        (1_000, 106, 1_750),
    ] {
        let mut governor = Governor::default();
        let aim = Aim {
            cps: 8_000,
            limit_ma,
            held_ma: 220,
        };
        governor.step(aim, (cps, cps), 3_700, &Settings::REFERENCE);
        assert_eq!(governor.integral_ua, integral_ua, "{cps} {limit_ma}");
    }
}

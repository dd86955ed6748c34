//! End position of each leg, and the speed there.

use super::*;

/// Anything but 0, so that counts and distances differ.
const ZERO: Counts = Counts(-5_000);
const ORIGIN: Counts = Counts(70_000);
const END: Thread = Thread(21_700);

const fn seek(second: bool, purpose: Purpose) -> Leg {
    Leg::Seek {
        origin: ORIGIN,
        second,
        purpose,
    }
}

const WIND: Leg = Leg::Wind {
    end: END,
    careful: false,
    short: None,
};

/// The first count that reads `um` of thread from `from`.
fn after(from: Counts, um: i32) -> Counts {
    let nearest = Counts(from.0 + Thread(um).counts().0);
    if nearest.since(from).thread() < Thread(um) {
        Counts(nearest.0 + 1)
    } else {
        nearest
    }
}

const KNOWN: Calibration = Calibration {
    folded: END,
    no_load_ma: 16,
    rise: Thread(1_500),
    long_rise: Thread(3_300),
    tension_ma: 90,
    back_emf_uv_cps: 207,
};
const NONE: Load = Load {
    long_rise_from: None,
    pull_ma: Some(0),
    end_force: false,
    excess_ma: Some(0),
    rise_from: None,
    resisted: false,
    struck: false,
    stands: false,
    silent: false,
};
const END_FORCE: Load = Load {
    end_force: true,
    excess_ma: Some(FORCE),
    ..NONE
};
const FORCE: u16 = 150;

fn decide(leg: Leg, counts: Counts, load: Load) -> Result<Decision, CapsuleFault> {
    leg.decide(
        counts,
        ZERO,
        load,
        Counts(0),
        (Some((&KNOWN, Some(END))), &Settings::REFERENCE),
    )
}

#[test]
fn a_fold_is_folded_at_its_calibrated_end_and_jammed_before() {
    assert_eq!(
        decide(WIND, after(ZERO, END.0), END_FORCE),
        Ok(Decision::Folded)
    );
    let end_um = END.0 - Settings::REFERENCE.end_tolerance.0;
    let before = Counts(after(ZERO, end_um).0 - 2);
    let thread_um = before.since(ZERO).thread().0;
    let jam = Err(CapsuleFault::Jam { thread_um });
    assert_eq!(decide(WIND, before, END_FORCE), jam);
}

/// Short of the end within the tolerance: more friction, or something hard, which the motor cannot wind past.
#[test]
fn an_early_end_force_winds_on_as_far_as_it_can() {
    let early = after(ZERO, END.0 - SURELY_FOLDED.0 - 2);
    assert_eq!(decide(WIND, early, END_FORCE), Ok(Decision::Continue));
    let standing = Load {
        stands: true,
        ..END_FORCE
    };
    let thread_um = early.since(ZERO).thread().0;
    let jam = Err(CapsuleFault::Jam { thread_um });
    assert_eq!(decide(WIND, early, standing), jam);
    let there = after(ZERO, END.0 - SURELY_FOLDED.0);
    for load in [END_FORCE, standing] {
        assert_eq!(decide(WIND, there, load), Ok(Decision::Folded));
    }
}

/// To the micrometre: within 0.12 mm it is folded, and beyond the tolerance it is a jam.
#[test]
fn an_end_force_is_judged_by_what_the_thread_is_short_of() {
    let at = after(ZERO, 20_000);
    let thread_um = at.since(ZERO).thread().0;
    let tolerance_um = Settings::REFERENCE.end_tolerance.0;
    let jam = Err(CapsuleFault::Jam { thread_um });
    for (short_um, expected) in [
        (SURELY_FOLDED.0, Ok(Decision::Folded)),
        (SURELY_FOLDED.0 + 1, Ok(Decision::Continue)),
        (tolerance_um, Ok(Decision::Continue)),
        (tolerance_um + 1, jam),
    ] {
        let leg = Leg::Wind {
            end: Thread(thread_um + short_um),
            careful: true,
            short: None,
        };
        assert_eq!(decide(leg, at, END_FORCE), expected, "{short_um} um");
    }
}

#[test]
fn past_the_end_the_thread_is_broken_or_has_slipped() {
    let past = after(ZERO, END.0 + Settings::REFERENCE.end_overrun.0);
    let loaded = |excess_ma| Load { excess_ma, ..NONE };
    for (excess_ma, fault) in [
        (None, CapsuleFault::ThreadBroken),
        (Some(11), CapsuleFault::ThreadBroken),
        (Some(12), CapsuleFault::SpoolSlip),
    ] {
        assert_eq!(decide(WIND, past, loaded(excess_ma)), Err(fault));
        let before = Counts(past.0 - 1);
        assert_eq!(
            decide(WIND, before, loaded(excess_ma)),
            Ok(Decision::Continue)
        );
    }
    for purpose in [Purpose::Calibrate, Purpose::Reference] {
        let limit = match purpose {
            Purpose::Calibrate => Settings::REFERENCE.folded_range.1.0 + 1,
            _ => Settings::REFERENCE.seek_limit(Thread(0)).0,
        };
        let far = after(ORIGIN, limit);
        let leg = seek(false, purpose);
        assert_eq!(decide(leg, far, NONE), Err(CapsuleFault::ThreadBroken));
        assert_eq!(decide(leg, Counts(far.0 - 2), NONE), Ok(Decision::Continue));
    }
}

#[test]
fn what_resists_makes_a_fold_careful() {
    let resisted = Load {
        resisted: true,
        ..NONE
    };
    let careful = Leg::Wind {
        end: END,
        careful: true,
        short: None,
    };
    let at = after(ZERO, 9_000);
    assert_eq!(decide(WIND, at, resisted), Ok(Decision::Careful(careful)));
    assert_eq!(decide(careful, at, resisted), Ok(Decision::Continue));
    assert_eq!(
        WIND.aim(Thread(9_000), 16, false, &Settings::REFERENCE).cps,
        Settings::REFERENCE.fold_cps
    );
    assert_eq!(
        careful
            .aim(Thread(9_000), 16, false, &Settings::REFERENCE)
            .cps,
        Settings::REFERENCE.slow_cps
    );
    assert_eq!(
        WIND.aim(Thread(END.0 - SLOW_ZONE.0), 16, false, &Settings::REFERENCE)
            .cps,
        Settings::REFERENCE.slow_cps
    );
}

#[test]
fn near_the_end_force_the_speed_does_not_go_to_and_fro() {
    assert!(
        is_near(false, 102, &Settings::REFERENCE) && !is_near(false, 101, &Settings::REFERENCE)
    );
    assert!(is_near(true, 73, &Settings::REFERENCE) && !is_near(true, 72, &Settings::REFERENCE));
    assert_eq!(
        WIND.aim(END, 16, true, &Settings::REFERENCE).cps,
        Settings::REFERENCE.near_cps
    );
    assert_eq!(
        WIND.aim(Thread(9_000), 16, true, &Settings::REFERENCE).cps,
        Settings::REFERENCE.fold_cps
    );
}

/// Something soft in the way raises the force along a line. A rise from half the force may be the origami's; one from
/// a quarter is not. Friction lengthens the rise of a run that has wound almost all of the way.
#[test]
fn a_rise_along_a_line_is_no_origami() {
    let almost = Thread(END.0 - FRICTION_MOVES.0);
    for (half, quarter, right, right_if_whole) in [
        (1_500, 3_300, true, true),
        (1_500, 2_900, true, true),
        (1_500, 2_600, false, true),
        (1_500, 2_250, false, false),
        (1_120, 2_600, false, false),
        (1_900, 4_200, false, true),
        (2_070, 4_200, false, false),
    ] {
        let rise = Rise {
            half: Thread(half),
            quarter: Thread(quarter),
        };
        let less = Thread(almost.0 - 1);
        assert_eq!(rise.is_of(&KNOWN, less, false), right, "{rise:?}");
        assert_eq!(
            rise.is_of(&KNOWN, almost, false),
            right_if_whole,
            "{rise:?}"
        );
    }
}

/// A snap or an early pull at the calibration makes its rise from a quarter long. The same capsule has the usual rise in
/// the next run, and a line is still no origami.
#[test]
fn a_quarter_that_was_felt_early_need_not_be_felt_early_again() {
    for long_um in [3_300, 3_800, 4_500, 9_000] {
        let known = Calibration {
            long_rise: Thread(long_um),
            ..KNOWN
        };
        for (quarter_um, less, right) in [
            (3_300, 1, true),
            (2_888, 1, true),
            (2_887, 1, false),
            (2_579, 0, true),
            (2_578, 0, false),
            (2_250, 0, false),
        ] {
            let rise = Rise {
                half: Thread(1_500),
                quarter: Thread(quarter_um),
            };
            let wound = Thread(END.0 - FRICTION_MOVES.0 - less);
            let found = rise.is_of(&known, wound, false);
            assert_eq!(found, right, "{rise:?} after {long_um} um");
        }
    }
}

/// At 0.7 times the friction the end force comes later, after a shorter rise. Before the end something hard may be in the
/// way.
#[test]
fn a_shorter_rise_is_believed_past_the_known_end_only() {
    let rise = |half| Rise {
        half: Thread(half),
        quarter: Thread(half + 1_600),
    };
    let almost = Thread(END.0 - FRICTION_MOVES.0);
    for (half, past_the_end, right) in [
        (1_125, false, true),
        (1_124, false, false),
        (1_124, true, true),
        (938, true, true),
        (937, true, false),
    ] {
        let found = rise(half).is_of(&KNOWN, almost, past_the_end);
        assert_eq!(found, right, "{half} um, past the end: {past_the_end}");
    }
    assert!(!rise(1_000).is_of(&KNOWN, Thread(almost.0 - 1), true));
    let begun = after(ORIGIN, 0);
    let counts = Counts(begun.0 + END.counts().0);
    let zero_for = |thread: i32| counts.back(Thread(thread).counts());
    let load = Load {
        rise_from: Some(counts.back(Thread(1_000).counts())),
        long_rise_from: Some(counts.back(Thread(2_700).counts())),
        ..END_FORCE
    };
    for (thread_um, end, found) in [
        (END.0 + 2, Some(END), true),
        (END.0 - 2, Some(END), false),
        // The count means nothing.
        (END.0 + 2, None, false),
    ] {
        let decided = seek(false, Purpose::Reference).decide(
            counts,
            zero_for(thread_um),
            load,
            Counts(0),
            (Some((&KNOWN, end)), &Settings::REFERENCE),
        );
        let is_found = matches!(decided, Ok(Decision::EndFound { .. }));
        assert_eq!(is_found, found, "{thread_um} um: {decided:?}");
    }
}

/// A reference run backs off only while the thread pulls.
#[test]
fn what_is_felt_decides_what_follows() {
    let at = after(ZERO, 10_000);
    let back = Then::BackOff {
        origin: ORIGIN,
        left: 1,
    };
    let feel = |then| Leg::Feel {
        from: Counts(at.0 - FELT_AFTER.counts().0 - 1),
        then,
    };
    let load = |excess_ma| Load {
        excess_ma: Some(excess_ma),
        ..NONE
    };
    let untold = Load {
        excess_ma: None,
        ..NONE
    };
    assert_eq!(decide(feel(back), at, untold), Ok(Decision::Continue));
    let further = decide(feel(back), at, load(LOADED_MA));
    let again = Leg::BackOff {
        to: at.back(BACK_OFF.counts()),
        then: Then::BackOff {
            origin: ORIGIN,
            left: 0,
        },
    };
    assert_eq!(further, Ok(Decision::Reverse(again)));
    let slack = decide(feel(back), at, load(LOADED_MA - 1));
    assert_eq!(slack, Ok(Decision::Careful(seek(true, Purpose::Reference))));
    let last = Then::BackOff {
        origin: ORIGIN,
        left: 0,
    };
    let enough = decide(feel(last), at, load(60));
    assert_eq!(
        enough,
        Ok(Decision::Careful(seek(true, Purpose::Reference)))
    );
    let to = Thread(0);
    // A pull that is felt with the last try counts as well.
    for left in [0, 1] {
        let paid_out = decide(feel(Then::PayOut { to, left }), at, load(60));
        let taut_to = Some(Thread(10_000 - TENSION_ZONE.0));
        assert_eq!(
            paid_out,
            Ok(Decision::Felt(Leg::PayOut { to, taut_to })),
            "{left}"
        );
    }
    // Without a reading it makes room and tries again, and in the end nothing shows that the thread holds.
    let unread = |left| {
        let from = Counts(at.0 - FELT_AT_MOST.counts().0 - 1);
        let then = Then::PayOut { to, left };
        decide(Leg::Feel { from, then }, at, untold)
    };
    let again = Leg::BackOff {
        to: at.back(ROOM_TO_FEEL.counts()),
        then: Then::PayOut { to, left: 0 },
    };
    assert_eq!(unread(1), Ok(Decision::Reverse(again)));
    assert_eq!(unread(0), Err(CapsuleFault::SlipOrBreak));
}

/// A short rise is an obstacle, or an origami that was folded from the start.
#[test]
fn a_short_rise_is_tried_again_by_a_reference_only() {
    let at = after(ORIGIN, 20_000);
    // The rise from a quarter is as long as the origami's.
    let risen = |um: i32| Load {
        rise_from: Some(Counts(at.0 - Thread(um).counts().0)),
        long_rise_from: Some(Counts(at.0 - Thread(um * 22 / 10).counts().0)),
        ..END_FORCE
    };
    let thread_um = at.since(ZERO).thread().0;
    let jam = Err(CapsuleFault::Jam { thread_um });
    let again = Ok(Decision::Reverse(Leg::BackOff {
        to: at.back(BACK_OFF.counts()),
        then: Then::BackOff {
            origin: ORIGIN,
            left: BACK_OFFS,
        },
    }));
    assert_eq!(
        decide(seek(false, Purpose::Reference), at, risen(450)),
        again
    );
    assert_eq!(decide(seek(true, Purpose::Reference), at, risen(450)), jam);
    assert_eq!(decide(seek(false, Purpose::Calibrate), at, risen(450)), jam);
    let doubted = Purpose::Check { believed: false };
    assert_eq!(
        decide(seek(false, doubted), at, risen(450)),
        jam,
        "nothing is paid out"
    );
    for (purpose, um) in [
        (Purpose::Reference, 1_150),
        (Purpose::Reference, 1_850),
        (Purpose::Calibrate, 510),
        (doubted, 1_500),
    ] {
        let found = decide(seek(false, purpose), at, risen(um));
        assert!(
            matches!(found, Ok(Decision::EndFound { .. })),
            "{purpose:?} {found:?}"
        );
    }
}

/// A folded capsule has little to wind. One that winds more has to show the rise of the origami.
#[test]
fn the_flash_alone_is_believed_for_the_first_3_mm() {
    let believed = Purpose::Check { believed: true };
    for (wound_um, found) in [
        (2_900, true),
        (3_000, true),
        (3_002, false),
        (20_000, false),
    ] {
        let decided = decide(seek(false, believed), after(ORIGIN, wound_um), END_FORCE);
        assert_eq!(
            matches!(decided, Ok(Decision::EndFound { purpose, .. }) if purpose == believed),
            found,
            "{wound_um} um: {decided:?}"
        );
    }
}

#[test]
fn paying_out_ends_before_zero_by_what_the_motor_runs_on() {
    let leg = Leg::PayOut {
        to: Thread(0),
        taut_to: None,
    };
    let stopping = Thread(200).counts();
    let at = after(ZERO, 200 + STOP_MARGIN.0 + 2);
    assert_eq!(
        leg.decide(
            at,
            ZERO,
            NONE,
            stopping,
            (Some((&KNOWN, Some(END))), &Settings::REFERENCE)
        ),
        Ok(Decision::Continue)
    );
    let at = Counts(at.0 - 4);
    assert_eq!(
        leg.decide(
            at,
            ZERO,
            NONE,
            stopping,
            (Some((&KNOWN, Some(END))), &Settings::REFERENCE)
        ),
        Ok(Decision::Unfolded)
    );
}

/// Wherever the power is cut, friction alone stops the motor before zero: with 4,200 counts/s2 per mA, and with a
/// quarter less.
#[test]
fn paying_out_is_never_faster_than_friction_stops() {
    let leg = Leg::PayOut {
        to: Thread(0),
        taut_to: None,
    };
    for no_load_ma in [10, 16, 22] {
        let mut last = 0;
        for thread_um in (0..24_000).step_by(50) {
            let cps = leg
                .aim(Thread(thread_um), no_load_ma, false, &Settings::REFERENCE)
                .cps;
            assert!(cps >= last, "slower further out");
            last = cps;
            let deceleration = 4_200.0 * f64::from(no_load_ma) * 0.75;
            let coasts_um = f64::from(cps).powi(2) / 2.0 / deceleration * 1.2272;
            assert!(
                coasts_um <= f64::from(thread_um) * 1.001 || cps == LAST_CPS,
                "{cps} counts/s at {thread_um} um coast {coasts_um} um"
            );
        }
        assert_eq!(last, Settings::REFERENCE.pay_out_cps);
    }
}

/// Over the last 1.5 mm before zero, wherever that may be, an encoder that is lost must not let the motor pull with all
/// its current. Before a partial target farther out it may: the thread pulls there.
#[test]
fn the_current_is_lower_over_the_last_part_of_paying_out() {
    for (to_um, from_um) in [(0, 1_500), (500, 2_000), (2_000, 3_500), (2_001, 3_500)] {
        let leg = Leg::PayOut {
            to: Thread(to_um),
            taut_to: None,
        };
        for (thread_um, limit_ma) in [(from_um, MOST_MA), (from_um - 1, LAST_LIMIT_MA)] {
            let aim = leg.aim(Thread(thread_um), 16, false, &Settings::REFERENCE);
            assert_eq!((aim.limit_ma, aim.held_ma), (limit_ma, limit_ma));
        }
    }
}

/// As slow as near the end force, which may be just ahead.
#[test]
fn a_pull_is_felt_at_the_lowest_speed() {
    let settings = Settings::REFERENCE;
    for near in [false, true] {
        let feel = Leg::feel(Counts(0), Thread(0)).aim(END, 16, near, &settings);
        assert_eq!(feel.cps, settings.near_cps);
    }
}

/// While the thread is taut, its tension is measured at a low speed.
#[test]
fn a_taut_thread_is_paid_out_slowly() {
    let leg = Leg::PayOut {
        to: Thread(0),
        taut_to: Some(Thread(20_000)),
    };
    let settings = Settings::REFERENCE;
    for (thread_um, cps) in [(20_001, settings.slow_cps), (20_000, settings.pay_out_cps)] {
        let aim = leg.aim(Thread(thread_um), 16, false, &settings);
        assert_eq!(aim.cps, cps, "{thread_um} um");
    }
}

/// A motor that stands pulls with all its current; one that still turns is felt like any other.
#[test]
fn only_a_motor_that_stands_with_the_end_force_is_pulled_without_a_reading() {
    let then = Then::PayOut {
        to: Thread(0),
        left: 1,
    };
    let at = after(ZERO, 10_000);
    let leg = Leg::Feel { from: at, then };
    let load = |end_force, stands| Load {
        end_force,
        stands,
        excess_ma: None,
        ..NONE
    };
    for (load, felt) in [
        (load(true, true), true),
        (load(true, false), false),
        (load(false, true), false),
    ] {
        let decided = decide(leg, at, load);
        assert_eq!(matches!(decided, Ok(Decision::Felt(_))), felt, "{load:?}");
        assert_eq!(decided == Ok(Decision::Continue), !felt, "{load:?}");
    }
}

/// It ends just before the fold would be called too long, and makes room to feel further down.
#[test]
fn a_pull_is_not_looked_for_past_the_end() {
    let then = Then::PayOut {
        to: Thread(0),
        left: 1,
    };
    let last_um = END.0 + Settings::REFERENCE.end_overrun.0 - STOP_MARGIN.0;
    let at = after(ZERO, last_um);
    for (at, goes_on) in [(Counts(at.0 - 1), true), (at, false)] {
        let leg = Leg::Feel { from: at, then };
        let decided = decide(leg, at, NONE);
        assert_eq!(decided == Ok(Decision::Continue), goes_on, "{decided:?}");
    }
}

#[test]
fn the_longest_fold_is_not_too_long_for_a_calibration() {
    let mut settings = Settings::REFERENCE;
    let longest = after(ORIGIN, settings.folded_range.1.0);
    // A length for which a count stands.
    settings.folded_range.1 = longest.since(ORIGIN).thread();
    for (further, expected) in [
        (0, Ok(Decision::Continue)),
        (1, Err(CapsuleFault::ThreadBroken)),
    ] {
        let at = Counts(longest.0 + further);
        let leg = seek(false, Purpose::Calibrate);
        let decided = leg.decide(at, ZERO, NONE, Counts(0), (None, &settings));
        assert_eq!(decided, expected);
    }
}

//! Where each leg ends.

use super::*;

/// Anything but 0, so that counts and distances differ.
const ZERO: Counts = Counts(-5_000);
const ORIGIN: Counts = Counts(70_000);
const FIRST: Leg = seek(false);
const SECOND: Leg = seek(true);

const fn seek(second: bool) -> Leg {
    Leg::Seek {
        origin: ORIGIN,
        second,
    }
}

/// The first count that reads `um` of thread from `from`.
fn after(from: Counts, um: i32) -> Counts {
    let nearest = Counts(from.0 + Thread(um).counts().0);
    if nearest.since(from).thread() < Thread(um) {
        next(nearest)
    } else {
        nearest
    }
}

/// One count less: 1.2 um.
fn before(counts: Counts) -> Counts {
    Counts(counts.0 - 1)
}

fn next(counts: Counts) -> Counts {
    Counts(counts.0 + 1)
}

const UNLOADED: Load = Load {
    end_force: false,
    engaged_at: None,
    rise_from: None,
};
const ENGAGED: Load = Load {
    engaged_at: Some(Counts(0)),
    ..UNLOADED
};
const END_FORCE: Load = Load {
    end_force: true,
    ..ENGAGED
};

fn decide(leg: Leg, counts: Counts, load: Load) -> Result<Decision, CapsuleFault> {
    leg.decide(counts, ZERO, load, Counts(0))
}

fn jam(counts: Counts) -> Result<Decision, CapsuleFault> {
    let thread_um = counts.since(ZERO).thread().0;
    Err(CapsuleFault::Jam { thread_um })
}

#[test]
fn a_fold_ends_with_force_between_the_end_window_and_the_soft_maximum() {
    let window = after(ZERO, 20_000);
    let maximum = after(ZERO, 24_500);
    let fold = |counts, load| decide(Leg::Wind, counts, load);
    for load in [UNLOADED, ENGAGED] {
        for counts in [ZERO, before(window), window, before(maximum)] {
            assert_eq!(fold(counts, load), Ok(Decision::Continue));
        }
    }
    for counts in [ZERO, after(ZERO, 10_000), before(window)] {
        assert_eq!(fold(counts, END_FORCE), jam(counts));
    }
    for counts in [window, after(ZERO, 22_000), maximum] {
        assert_eq!(fold(counts, END_FORCE), Ok(Decision::Folded));
    }
    for counts in [maximum, next(maximum), after(maximum, 5_000)] {
        assert_eq!(fold(counts, UNLOADED), Err(CapsuleFault::ThreadBroken));
        assert_eq!(fold(counts, ENGAGED), Err(CapsuleFault::Timeout));
    }
    assert_eq!(fold(next(maximum), END_FORCE), Err(CapsuleFault::Timeout));
}

#[test]
fn a_seek_is_limited_by_its_way_from_the_origin() {
    let limit = after(ORIGIN, 28_500);
    for leg in [FIRST, SECOND] {
        for load in [UNLOADED, ENGAGED] {
            // The soft maximum has no meaning here: the zero is arbitrary.
            for counts in [ORIGIN, after(ZERO, 24_500), before(limit)] {
                assert_eq!(decide(leg, counts, load), Ok(Decision::Continue));
            }
        }
        let broken = Err(CapsuleFault::ThreadBroken);
        assert_eq!(decide(leg, limit, UNLOADED), broken);
        assert_eq!(decide(leg, limit, ENGAGED), Err(CapsuleFault::Timeout));
    }
}

#[test]
fn half_a_millimetre_of_rise_makes_the_end_force_the_folded_end() {
    let here = after(ORIGIN, 9_000);
    let rising_for = |um| Load {
        rise_from: Some(here.back(after(Counts(0), um))),
        ..END_FORCE
    };
    let found = Ok(Decision::ZeroFound(here.back(Thread(21_500).counts())));
    let back_off = Ok(Decision::Reverse(Leg::BackOff {
        to: here.back(Thread(4_000).counts()),
        origin: ORIGIN,
    }));
    for (load, long_enough) in [
        (END_FORCE, false),
        (rising_for(0), false),
        (rising_for(499), false),
        (rising_for(500), true),
        (rising_for(2_000), true),
    ] {
        let (first, second) = if long_enough {
            (found, found)
        } else {
            (back_off, jam(here))
        };
        assert_eq!(decide(FIRST, here, load), first, "{load:?}");
        assert_eq!(decide(SECOND, here, load), second, "{load:?}");
    }
}

#[test]
fn paying_out_ends_where_the_braked_motor_reaches_the_margin() {
    let to = Counts(3_000);
    let back_off = Leg::BackOff { to, origin: ORIGIN };
    for stopping_um in [0, 150] {
        let stopping = Thread(stopping_um).counts();
        for (leg, end, over) in [
            (Leg::PayOut, ZERO, Decision::Unfolded),
            (back_off, to, Decision::Reverse(SECOND)),
        ] {
            let last = after(end, stopping_um + 40);
            let decide = |counts, load| leg.decide(counts, ZERO, load, stopping);
            for counts in [after(end, 20_000), next(last)] {
                assert_eq!(decide(counts, ENGAGED), Ok(Decision::Continue), "{leg:?}");
            }
            for counts in [last, end, after(end, -3_000)] {
                assert_eq!(decide(counts, ENGAGED), Ok(over), "{leg:?}");
            }
            for counts in [after(end, 20_000), end] {
                assert_eq!(decide(counts, END_FORCE), jam(counts), "{leg:?}");
            }
        }
    }
}

#[test]
fn a_stopping_distance_beyond_all_bounds_ends_paying_out() {
    let far = after(ZERO, 20_000);
    let over = Leg::PayOut.decide(far, ZERO, UNLOADED, Counts(i32::MAX));
    assert_eq!(over, Ok(Decision::Unfolded));
}

#[test]
fn force_is_met_gently_and_the_long_way_is_fast() {
    let back_off = Leg::BackOff {
        to: ZERO,
        origin: ORIGIN,
    };
    for (leg, spooling, until_18_mm, beyond) in [
        (FIRST, Spooling::Wind, 1_500, 1_500),
        (back_off, Spooling::PayOut, 1_500, 1_500),
        (SECOND, Spooling::Wind, 1_500, 1_500),
        (Leg::Wind, Spooling::Wind, 3_700, 1_500),
        (Leg::PayOut, Spooling::PayOut, 3_700, 3_700),
    ] {
        assert_eq!(leg.spooling(), spooling, "{leg:?}");
        for um in [-4_000, 0, 17_999] {
            assert_eq!(leg.drive_mv(Thread(um)), until_18_mm, "{leg:?} {um}");
        }
        for um in [18_000, 24_500] {
            assert_eq!(leg.drive_mv(Thread(um)), beyond, "{leg:?} {um}");
        }
    }
}

//! The quantities from which the measures of a fold are computed.

use super::super::{
    Command,
    tests::{END, KNOWN, actuation, moving},
};
use super::*;
use crate::detect::Detector;

/// The force doubles with every rise: one rise further it is twice as large, one before half; to second order, and no
/// more than that.
#[test]
fn the_force_doubles_with_every_rise() {
    for (um, thousandths) in [
        (0, 1_000),
        (800, 1_406),
        (1_600, 1_933),
        (3_000, 1_933),
        (-800, 714),
        (-1_600, 547),
        (-3_000, 547),
    ] {
        assert_eq!(grows(um, 1_600), thousandths, "{um} um");
    }
    assert_eq!(grows(1, 0), 1_933, "a thread without a rise");
}

/// -ln(1 - x): a thread that has 90 % of its force lags by 0.105 of 1 / ln 2 rises.
#[test]
fn a_share_of_the_force_is_a_distance() {
    for (share, um) in [
        (1_000, 0),
        (900, 105),
        (700, 354),
        (600, 501),
        (500, 501),
        (0, 501),
        (1_100, -95),
        (1_400, -341),
        (3_000, -341),
    ] {
        assert_eq!(crept_by(share, 693), um, "{share} thousandths");
        assert_eq!(crept_by(share, 1_386), 2 * um, "{share} thousandths");
    }
}

#[test]
fn the_distance_is_that_over_which_the_force_grows() {
    for share in (600..=1_400).step_by(10) {
        let force = grows(-crept_by(share, 1_600), 1_600);
        assert!(force.abs_diff(share) <= 60, "{force} for {share}");
    }
}

/// The mean of the first four, and a quarter of the difference from then on.
#[test]
fn no_single_fold_decides_how_far_the_ends_have_wandered() {
    let mut drift = Drift::default();
    let mut wandered = |um| drift.add(Thread(um)).0;
    assert_eq!(wandered(20_000), 0);
    assert_eq!(wandered(20_100), 50);
    assert_eq!(wandered(20_200), 100);
    assert_eq!(wandered(20_300), 150);
    assert_eq!(wandered(20_350), 200);
    assert_eq!(wandered(20_200), 200);
    assert_eq!(wandered(19_800), 100);
}

/// Moves the end of a fold: not every place has a count.
fn winds_to(capsule: &mut Capsule, end: Thread) {
    actuation(capsule).leg = Leg::Wind {
        end,
        careful: false,
        short: None,
    };
}

/// The settings of a fold to `end` that is at `at` and has felt half of its force from `from` on.
fn felt(from: Counts, at: Counts, end: Thread) -> Settings {
    let mut capsule = moving(Mode::Unfolded, Thread(0), Command::Fold);
    winds_to(&mut capsule, end);
    capsule.sample.counts = at;
    capsule.follow_friction(&Load {
        rise_from: Some(from),
        ..Load::default()
    });
    actuation(&mut capsule).settings
}

/// Half of the force is expected 1.5 mm before the end. Between a quarter and a half it doubles over 1.8 mm here.
#[test]
fn a_fold_that_feels_its_force_early_may_go_on_to_more() {
    let usual = Settings::REFERENCE;
    let with = |early_um, thousandths| Settings {
        end_tolerance: Thread(usual.end_tolerance.0 + early_um),
        ..usual.with_force(thousandths)
    };
    for (early_um, expected) in [
        (-1, usual),
        (0, with(0, 1_050)),
        (400, with(400, 1_222)),
        (800, with(800, 1_350)),
        (1_200, with(800, 1_350)),
        (2_250, with(800, 1_350)),
        (2_251, usual),
    ] {
        let from = Thread(19_800).counts();
        let at = Counts(from.0 + Thread(800).counts().0);
        let end = Thread(from.thread().0 + early_um + 1_500);
        assert_eq!(felt(from, at, end), expected, "{early_um} um");
    }
}

/// Friction may bring the half of the force forward by 2.25 mm, from 1.5 mm before the end.
#[test]
fn a_fold_that_begins_near_its_end_may_go_on_to_all_that_friction_takes() {
    let capsule = moving(Mode::Unfolded, Thread(0), Command::Fold);
    let settings = |left_um| {
        capsule.settings_for(&Leg::Wind {
            end: Thread(capsule.thread().0 + left_um),
            careful: false,
            short: None,
        })
    };
    let usual = Settings::REFERENCE;
    assert_eq!(settings(3_750), usual);
    let expected = Settings {
        end_tolerance: Thread(usual.end_tolerance.0 + 800),
        near_ma: usual.near_ma,
        ..usual.with_force(1_350)
    };
    assert_ne!(usual.with_force(1_350).near_ma, usual.near_ma);
    assert_eq!(settings(3_749), expected);
}

/// 750 um are half of the calibrated rise.
#[test]
fn a_force_that_has_just_begun_says_nothing_of_the_friction() {
    let from = Thread(19_800).counts();
    let risen = |counts| Counts(from.0 + counts);
    assert_eq!(risen(611).since(from).thread(), Thread(750));
    assert_eq!(felt(from, risen(610), END), Settings::REFERENCE);
    assert_ne!(felt(from, risen(611), END), Settings::REFERENCE);
}

/// A reading of a fold this far before its end, with this pull.
fn pulls(capsule: &mut Capsule, left_um: i32, pull_ma: u16) {
    let end = Thread(capsule.thread().0 + left_um);
    winds_to(capsule, end);
    capsule.follow_friction(&Load {
        pull_ma: Some(pull_ma),
        ..Load::default()
    });
}

/// Its force lacks a tenth at 0.1 to 0.35 mm before the end: it ends with a tenth less, and lags by 228 um.
#[test]
fn the_pull_just_before_the_end_scales_the_end_force() {
    let mut capsule = moving(Mode::Unfolded, Thread(0), Command::Fold);
    pulls(&mut capsule, 350, 100);
    assert_eq!(actuation(&mut capsule).share.count, 0, "not yet");
    let wanted =
        |left_um: i32| i32::from(Settings::REFERENCE.force_ma) * grows(-left_um, 1_275) / 1_000;
    let lacking = |left_um| (wanted(left_um) * 9 / 10) as u16;
    for _ in 0..7 {
        pulls(&mut capsule, 349, lacking(349));
    }
    // Seven are too few: the next one counts where no more are wanted.
    pulls(&mut capsule, 98, lacking(98));
    assert_eq!(actuation(&mut capsule).share.count, 8);
    assert_eq!(actuation(&mut capsule).settings, Settings::REFERENCE);
    capsule.crept = Thread(50);
    pulls(&mut capsule, 98, 0);
    assert_eq!(actuation(&mut capsule).share.count, 8, "enough");
    let share = i32::from(actuation(&mut capsule).share.mean().expect("8"));
    assert!((890..=900).contains(&share), "{share}");
    let expected = Settings::REFERENCE.with_force(share);
    assert_eq!(actuation(&mut capsule).settings, expected);
    let doubt = capsule.doubt;
    assert_eq!(doubt, Thread(crept_by(share, 1_500) + 50));
    assert!((260..300).contains(&doubt.0), "{doubt:?}");
    // All readings from 0.35 to 0.1 mm count.
    pulls(&mut capsule, 100, lacking(100));
    assert_eq!(actuation(&mut capsule).share.count, 9);
}

/// A partial fold may pass the compared range; the short way back of a check begins beyond it.
#[test]
fn every_fold_compares_its_pull_except_the_way_back_of_a_check() {
    let short = Some(Thread(21_000));
    for (command, short, compares) in [
        (Command::Fold, None, true),
        (Command::FoldTo(Thread(12_000)), short, true),
        (Command::CheckFolded, None, true),
        (Command::CheckFolded, short, false),
    ] {
        let mut capsule = moving(Mode::Stopped, Thread(0), command);
        actuation(&mut capsule).leg = Leg::Wind {
            end: Thread(200),
            careful: true,
            short,
        };
        capsule.follow_friction(&Load {
            pull_ma: Some(100),
            ..Load::default()
        });
        let count = actuation(&mut capsule).share.count;
        assert_eq!(count, i32::from(compares), "{command:?} {short:?}");
    }
}

/// Readings from before a brake and after it belong to different speeds.
#[test]
fn a_motor_that_is_not_steady_begins_its_comparison_anew() {
    for (steady, disagrees) in [(true, true), (false, false)] {
        let mut capsule = moving(Mode::Unfolded, Thread(0), Command::Fold);
        capsule.drive = Drive::Millivolts(2_190);
        capsule.sample.current_ua = 80_000;
        for ms in 1..=25 {
            capsule.sample.counts = Counts(10 * ms);
            let at_us = 1_000 * u64::try_from(ms).expect("positive");
            let compared = capsule.compare(at_us, steady || ms != 15);
            assert_eq!(compared, Ok(()));
        }
        assert_eq!(capsule.circuit_disagrees(), disagrees, "{steady}");
    }
}

/// A folded thread that pulls a tenth less has crept by 228 um; a fold follows an eighth of that, and at most 30 um.
#[test]
fn the_believed_end_follows_the_creep_slowly() {
    let mut capsule = Capsule::new(None, Some(KNOWN), None, Settings::REFERENCE);
    let mut follow = |tension_ma| {
        capsule.follow_creep(tension_ma);
        capsule.crept.0
    };
    assert_eq!(follow(90), 0);
    assert_eq!(follow(81), 28);
    assert_eq!(follow(81), 56);
    assert_eq!(follow(60), 86);
    assert_eq!(follow(95), 72);
    assert_eq!(follow(140), 42);
    assert_eq!(follow(140), 12);
    assert_eq!(follow(140), 0, "no end comes before the calibrated one");
    for _ in 0..26 {
        follow(60);
    }
    assert_eq!(follow(60), 800);
    assert_eq!(follow(60), 800, "more is a slip");
}

#[test]
fn the_measured_motor_constant_counts_unless_it_is_being_measured() {
    let rests = Capsule::new(None, Some(KNOWN), None, Settings::REFERENCE);
    assert_eq!(rests.known_back_emf(), 203);
    for (command, known) in [(Command::Reference, 203), (Command::Calibrate, 0)] {
        let capsule = moving(Mode::Stopped, Thread(0), command);
        assert_eq!(capsule.known_back_emf(), known, "{command:?}");
    }
    let new = Capsule::new(None, None, None, Settings::REFERENCE);
    assert_eq!(new.known_back_emf(), 0);
}

/// Pays out the taut thread down to 21 mm. Winding took 150 mA.
fn paying_out(command: Command) -> Capsule {
    let mut capsule = moving(Mode::Folded, END, command);
    let moves = actuation(&mut capsule);
    moves.leg = Leg::PayOut {
        to: Thread(0),
        taut_to: Some(Thread(21_000)),
    };
    moves.detector = Detector::new(Spooling::PayOut, 0, 3_900);
    moves.winding_ma = Some(150);
    capsule
}

fn taut_to(capsule: &mut Capsule) -> Option<Thread> {
    match actuation(capsule).leg {
        Leg::PayOut { taut_to, .. } => taut_to,
        other => panic!("{other:?}"),
    }
}

/// The tension zone is extended four times. Only a partial unfolding may end without a reading.
#[test]
fn a_tension_that_cannot_be_read_is_looked_for_further_down_and_missed_in_the_end() {
    let missed = Err(CapsuleFault::SlipOrBreak);
    for (command, last) in [
        (Command::Unfold, missed),
        (Command::FoldTo(Thread(5_000)), Ok(())),
    ] {
        let mut capsule = paying_out(command);
        for to in [20_700, 20_400, 20_100, 19_800] {
            let end = taut_to(&mut capsule).expect("to be measured");
            assert_eq!(capsule.measure(end, false), Ok(()));
            assert_eq!(taut_to(&mut capsule), Some(Thread(to)), "{command:?}");
        }
        assert_eq!(capsule.measure(Thread(19_800), false), last, "{command:?}");
        assert_eq!(taut_to(&mut capsule), None);
    }
}

/// The zone is not extended to where the unfolding ends.
#[test]
fn a_partial_unfolding_that_ends_in_the_tension_zone_reads_none() {
    for (to_um, extended) in [(20_700, None), (20_699, Some(Thread(20_700)))] {
        let mut capsule = paying_out(Command::FoldTo(Thread(5_000)));
        actuation(&mut capsule).leg = Leg::PayOut {
            to: Thread(to_um),
            taut_to: Some(Thread(21_000)),
        };
        assert_eq!(capsule.measure(Thread(21_000), false), Ok(()));
        assert_eq!(taut_to(&mut capsule), extended, "to {to_um} um");
    }
}

/// The calibrated tension is 90 mA; 72 % of it are 64 mA.
#[test]
fn a_folded_thread_has_to_pull_as_it_did() {
    for (taut_ma, tells) in [
        (60, Ok(())),
        (86, Ok(())),
        (87, Err(CapsuleFault::SlipOrBreak)),
        (200, Err(CapsuleFault::SlipOrBreak)),
    ] {
        let mut capsule = paying_out(Command::Unfold);
        capsule.sample.current_ua = -1_000 * taut_ma;
        // Only readings of a steady motor in the last 0.3 mm count.
        for (um, steady, count) in [
            (301, true, 0),
            (300, false, 0),
            (300, true, 1),
            (1, true, 2),
        ] {
            assert_eq!(capsule.measure(Thread(21_000 + um), steady), Ok(()));
            assert_eq!(actuation(&mut capsule).taut.count, count);
        }
        assert_eq!(capsule.measure(Thread(21_000), true), tells, "{taut_ma} mA");
        assert_eq!(taut_to(&mut capsule), None);
    }
}

/// One reading can be off by more than the pull's margin. Elsewhere than in a reference it may be a slip.
#[test]
fn a_pull_that_few_readings_call_too_weak_is_read_further_down() {
    let slipped = Err(CapsuleFault::SlipOrBreak);
    for kind in [
        ActuationKind::CheckFolded,
        ActuationKind::Fold,
        ActuationKind::Unfold,
        ActuationKind::FoldTo,
    ] {
        let mut other = paying_out(Command::Unfold);
        actuation(&mut other).kind = kind;
        other.sample.current_ua = -100_000;
        assert_eq!(other.measure(Thread(21_001), true), Ok(()));
        assert_eq!(other.measure(Thread(21_000), true), slipped, "{kind:?}");
    }
    // A pull that is not too weak, or eight readings, tell at once.
    for (readings, taut_ma, tells) in [(1, 86, Ok(())), (7, 86, Ok(())), (8, 87, slipped)] {
        let mut capsule = paying_out(Command::Unfold);
        actuation(&mut capsule).kind = ActuationKind::Reference;
        capsule.sample.current_ua = -1_000 * taut_ma;
        for _ in 0..readings {
            assert_eq!(capsule.measure(Thread(21_001), true), Ok(()));
        }
        let told = capsule.measure(Thread(21_000), true);
        assert_eq!(told, tells, "{readings} readings of {taut_ma} mA");
        assert_eq!(taut_to(&mut capsule), None);
    }
    for (then_ma, tells) in [(50, Ok(())), (87, slipped)] {
        let mut capsule = paying_out(Command::Unfold);
        actuation(&mut capsule).kind = ActuationKind::Reference;
        capsule.sample.current_ua = -100_000;
        for _ in 0..7 {
            assert_eq!(capsule.measure(Thread(21_001), true), Ok(()));
        }
        assert_eq!(capsule.measure(Thread(21_000), true), Ok(()));
        assert_eq!(taut_to(&mut capsule), Some(Thread(20_700)));
        capsule.sample.current_ua = -1_000 * then_ma;
        for _ in 0..200 {
            assert_eq!(capsule.measure(Thread(20_701), true), Ok(()));
        }
        assert_eq!(capsule.measure(Thread(20_700), true), tells, "{then_ma} mA");
        assert_eq!(taut_to(&mut capsule), None);
    }
}

/// The thread is slack and the motor steady from 0.8 to 2.2 mm of a fold.
#[test]
fn a_slack_thread_shows_the_no_load_current() {
    for (current_ma, known_ma) in [(19, 19), (30, 30), (31, 16)] {
        let mut capsule = moving(Mode::Unfolded, Thread(0), Command::Fold);
        let mut at = |um, steady, current_ma| {
            capsule.sample.counts = Thread(um).counts();
            assert_eq!(capsule.thread().0, um, "a count stands for it");
            capsule.sample.current_ua = current_ma * 1_000;
            assert_eq!(capsule.measure(Thread(um), steady), Ok(()));
            capsule.no_load_ma
        };
        at(799, true, 90);
        at(800, true, current_ma);
        at(2_199, true, current_ma);
        at(1_500, false, 90);
        assert_eq!(at(2_198, true, current_ma), 16, "not yet");
        assert_eq!(at(2_200, true, 90), known_ma);
        assert_eq!(at(1_500, true, 40), known_ma, "once");
        assert_eq!(at(2_200, true, 40), known_ma, "once");
    }
}

/// A check may end where the capsule was folded by hand.
#[test]
fn only_a_fold_tells_whether_the_ends_wander() {
    for (command, folds) in [(Command::Fold, 1), (Command::CheckFolded, 0)] {
        let mut capsule = moving(Mode::Stopped, Thread(0), command);
        capsule.sample.counts = END.counts();
        let load = Load {
            end_force: true,
            ..Load::default()
        };
        let decided = capsule.decide(60_000, load, &mut Actions::default());
        assert_eq!(decided, Ok(()));
        assert!(matches!(capsule.mode, Mode::Folded));
        assert_eq!(capsule.drift.folds, folds, "{command:?}");
    }
}

/// 0.4 mm are allowed, as the mean of the ends since the zero was found.
#[test]
fn folded_ends_that_wander_cost_the_reference() {
    let most_um = Settings::REFERENCE.drift.0;
    for (by_um, wanders) in [
        (most_um - 2, false),
        (most_um + 2, true),
        (-most_um - 2, true),
    ] {
        let mut capsule = moving(Mode::Unfolded, Thread(0), Command::Fold);
        capsule.mode = Mode::Folded;
        let mut actions = Actions::default();
        for end_um in [20_000, 20_000 + 2 * by_um] {
            capsule.watch_drift(Thread(end_um), &mut actions);
        }
        assert_eq!(capsule.referenced, !wanders, "{by_um} um");
        assert_eq!(matches!(capsule.mode, Mode::Unreferenced), wanders);
        assert_eq!(capsule.was_folded, wanders);
        let drifted = |event: &CapsuleEvent| matches!(event, CapsuleEvent::Drifted { .. });
        assert_eq!(actions.events.iter().any(drifted), wanders);
    }
}

/// With less than 0.8 times the expected pull, at the end of a motion that ends folded, and only once.
#[test]
fn only_an_end_that_pulled_weakly_and_was_not_felt_may_be_a_slip() {
    for (command, share, winding_ma, slips) in [
        (Command::Fold, Some(799), None, true),
        (Command::CheckFolded, Some(799), None, true),
        (Command::Fold, Some(800), None, false),
        (Command::Fold, Some(1_000), None, false),
        (Command::Fold, None, None, false),
        (Command::Fold, Some(799), Some(150), false),
        (Command::FoldTo(Thread(5_000)), Some(799), None, false),
        (Command::FoldTo(Thread(5_000)), Some(1_000), None, false),
    ] {
        let mut capsule = moving(Mode::Stopped, Thread(0), command);
        let moves = actuation(&mut capsule);
        moves.winding_ma = winding_ma;
        moves.share = Mean::default();
        if let Some(share) = share {
            moves.share.add(share);
        }
        let told = capsule.may_have_slipped();
        assert_eq!(told, slips, "{command:?}: {share:?}, {winding_ma:?}");
    }
}

/// Before it is believed.
#[test]
fn an_end_that_pulled_weakly_is_felt() {
    for (share, is_felt) in [(799, true), (800, false)] {
        let mut capsule = moving(Mode::Stopped, Thread(0), Command::Fold);
        capsule.sample.counts = END.counts();
        let moves = actuation(&mut capsule);
        moves.share = Mean::default();
        moves.share.add(share);
        let load = Load {
            end_force: true,
            ..Load::default()
        };
        let decided = capsule.decide(60_000, load, &mut Actions::default());
        assert_eq!(decided, Ok(()));
        assert_eq!(capsule.is_moving(), is_felt, "{share} thousandths");
    }
}

/// It pulled 100 mA more than a slack thread. A braked motor tells nothing until it is back or its time is over.
#[test]
fn a_thread_that_was_felt_has_to_pull_half_as_much_where_it_was() {
    let deadline_us = 5_000;
    for (excess_ma, beyond_um, now_us, told) in [
        (Some(50), -1, 4_999, Some(true)),
        (Some(49), -1, 4_999, Some(false)),
        (Some(50), 0, 5_000, Some(true)),
        (None, -1, 4_999, None),
        (None, -100, 0, None),
        (None, 0, 4_999, Some(false)),
        (None, 1, 4_999, Some(false)),
        (None, -1, 5_000, Some(false)),
        (None, -1, 5_001, Some(false)),
        (None, 0, 5_000, Some(false)),
    ] {
        let mut capsule = moving(Mode::Stopped, Thread(20_000), Command::Fold);
        capsule.no_load_ma = 16;
        let thread = capsule.thread();
        let moves = actuation(&mut capsule);
        (moves.winding_ma, moves.deadline_us) = (Some(116), deadline_us);
        moves.from = Thread(thread.0 - beyond_um);
        let load = Load {
            excess_ma,
            ..Load::default()
        };
        let pulls = capsule.pulls_as_felt(now_us, &load);
        assert_eq!(pulls, told, "{excess_ma:?}, {beyond_um} um, {now_us} us");
    }
}

/// A thread that was felt has been paid out and wound back since: its end is where it was felt.
#[test]
fn the_end_of_a_fold_is_where_it_was_felt() {
    for (winding_ma, from_um, end_um) in [
        (Some(150), 20_000, 20_000 - STOP_MARGIN.0),
        (None, 20_000, 21_000),
    ] {
        let mut capsule = moving(Mode::Stopped, Thread(0), Command::Fold);
        capsule.sample.counts = Thread(21_000).counts();
        let moves = actuation(&mut capsule);
        (moves.winding_ma, moves.from) = (winding_ma, Thread(from_um));
        capsule.folded(60_000, &mut Actions::default());
        let first = capsule.drift.first.expect("an end");
        assert!(first.0.abs_diff(end_um) <= 1, "{winding_ma:?}: {first:?}");
    }
}

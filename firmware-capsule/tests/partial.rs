//! Folds that stop between the ends, and folded ends that wander, in closed loop with the model of the mechanics.

use capsule_plant::{Defect, Parameters};
use firmware_capsule::{
    fold::{Command, Event, PARTIAL_MARGIN},
    mechanics::Thread,
};
use protocol::{
    capsule::{ActuationOutcome, CapsuleEvent, CapsuleFault, CapsuleState},
    error::{Field, Refusal},
};
use simulated_machines::plant::Simulation;

fn refusal(sim: &mut Simulation, um: i32) -> Option<Refusal> {
    sim.give(Event::Command(Command::FoldTo(Thread(um))))
        .refusal
}

/// Moves up and down, short and long, soft and stiff: the capsule stops at its target, and unfolds to zero from there.
#[test]
fn a_partial_fold_stops_where_it_was_told() {
    for seed in 0..12 {
        let mut sim = Simulation::calibrated(Parameters::varied(seed), seed);
        for um in [10_000, 15_000, 15_400, 4_000, 700, 12_345, 11_900, 500] {
            sim.run(Command::FoldTo(Thread(um)));
            let record = sim.capsule.record();
            assert_eq!(record.outcome, ActuationOutcome::Complete, "{seed}: {um}");
            assert_eq!(sim.capsule.state(), CapsuleState::Stopped);
            let off_mm = sim.plant.wound_mm() - f64::from(um) / 1e3;
            assert!(
                off_mm.abs() < 0.1,
                "seed {seed}: {um} um, {off_mm:.3} mm off"
            );
        }
        sim.run(Command::FoldTo(Thread(9_000)));
        sim.run(Command::Fold);
        assert_eq!(sim.capsule.state(), CapsuleState::Folded);
        let end = sim.capsule.thread().0;
        for um in [end - 5_000, 3_000] {
            sim.run(Command::FoldTo(Thread(um)));
            let off_mm = sim.plant.wound_mm() - f64::from(um) / 1e3;
            assert!(
                off_mm.abs() < 0.1,
                "seed {seed}: {um} um, {off_mm:.3} mm off"
            );
        }
        sim.run(Command::Unfold);
        assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);
        assert!(sim.plant.extremes_mm().0 >= 0.0, "seed {seed}: past zero");
        assert!(sim.plant.wound_mm() < 0.1);
    }
}

/// Just below the folded end the thread pulls, and the motor needs more current than before zero.
#[test]
fn a_short_way_down_a_thread_that_pulls_is_no_jam() {
    for seed in 88..94 {
        let mut folded = Simulation::calibrated(Parameters::lifelike(seed), seed);
        folded.run(Command::Fold);
        let end = folded.capsule.thread().0;
        for ways in [[600, 800], [1_000, 300], [2_500, 1_200]] {
            let (mut sim, mut um) = (folded.clone(), end);
            for way in ways {
                um -= way;
                sim.run(Command::FoldTo(Thread(um)));
                assert_eq!(sim.capsule.fault(), None, "{seed}: {ways:?}");
                assert_eq!(sim.capsule.state(), CapsuleState::Stopped);
                let off_um = sim.capsule.thread().0 - um;
                assert!(off_um.abs() < 100, "{seed}: {ways:?}, {off_um} um off");
            }
        }
    }
}

#[test]
fn a_partial_fold_is_refused_at_the_ends_and_where_it_stands() {
    let mut sim = Simulation::calibrated(Parameters::nominal(), 0);
    let end = sim.capsule.calibration().expect("calibrated").folded.0;
    let (min, max) = (PARTIAL_MARGIN.0, end - PARTIAL_MARGIN.0);
    for (um, sent) in [(-5, 0), (0, 0), (min - 1, min - 1), (max + 1, max + 1)] {
        let range = Refusal::OutOfRange {
            field: Field::ThreadUm,
            requested: sent as u64,
            min: min as u64,
            max: max as u64,
        };
        assert_eq!(refusal(&mut sim, um), Some(range), "{um}");
    }
    sim.run(Command::FoldTo(Thread(5_000)));
    assert_eq!(refusal(&mut sim, 5_050), Some(Refusal::AlreadyThere));
    assert_eq!(refusal(&mut sim, 5_200), None);
    let busy = Refusal::CapsuleBusy(CapsuleState::Folding);
    assert_eq!(refusal(&mut sim, 9_000), Some(busy));
    let mut new = Simulation::nominal();
    assert_eq!(refusal(&mut new, 5_000), Some(Refusal::NotReferenced));
}

#[test]
fn a_jam_under_way_is_a_jam() {
    let mut sim = Simulation::calibrated(Parameters::nominal(), 0);
    sim.plant.suffer(Defect::Jam(8.0));
    sim.run(Command::FoldTo(Thread(14_000)));
    assert!(matches!(
        sim.capsule.fault(),
        Some(CapsuleFault::Jam { .. })
    ));
    assert!(sim.plant.peak_force_n() < 20.0);
}

/// A motion that begins near the folded end is blind for its first 30 ms, and so cannot feel where its force rose. With
/// more friction in the worm the end force came too early for it, and was called a jam.
#[test]
fn more_friction_is_no_jam_where_a_motion_begins_near_the_end() {
    for (seed, less, friction) in [0, 2, 5].into_iter().flat_map(|seed| {
        [501, 1_500]
            .into_iter()
            .flat_map(move |less| [1.2, 1.4].map(|friction| (seed, less, friction)))
    }) {
        let mut near = Simulation::calibrated(Parameters::lifelike(seed), seed);
        let end_um = near.capsule.calibration().expect("calibrated").folded.0;
        near.plant.suffer(Defect::Friction(friction));
        near.run(Command::FoldTo(Thread(end_um - less)));
        let further = Command::FoldTo(Thread(end_um - 501));
        let [fold, check] = [Command::Fold, Command::CheckFolded];
        let wanted = if less > 501 {
            &[fold, check, further][..]
        } else {
            &[fold, check]
        };
        for command in wanted {
            let mut sim = near.clone();
            sim.run(*command);
            let case =
                format!("{seed}: {command:?} from {less} um before the end, friction x {friction}");
            assert_eq!(sim.capsule.fault(), None, "{case}");
            if *command != further {
                let off_mm = sim.plant.wound_mm() - f64::from(end_um) / 1e3;
                assert!(off_mm.abs() < 0.3, "{case}: {off_mm:.3} mm off");
            }
        }
    }
}

/// Something hard in the last quarter of a millimetre stops the motor, and only the origami lets it on.
#[test]
fn something_hard_near_the_end_is_a_jam_also_where_a_motion_begins_near_it() {
    for (seed, less) in (0..4).flat_map(|seed| [501, 1_500].map(|less| (seed, less))) {
        let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
        let end_um = sim.capsule.calibration().expect("calibrated").folded.0;
        sim.run(Command::FoldTo(Thread(end_um - less)));
        let ahead_mm = sim.plant.travel_mm() + 0.15;
        sim.plant.suffer(Defect::Jam(ahead_mm));
        sim.run(Command::Fold);
        let fault = sim.capsule.fault();
        assert!(
            matches!(fault, Some(CapsuleFault::Jam { .. })),
            "{seed} from {less}: {fault:?}"
        );
        let most_n = sim.plant.peak_force_n();
        assert!(most_n < 20.0, "{seed} from {less}: {most_n:.1} N");
    }
}

/// An unfolding that is stopped at once has only wound a little to feel the thread. A fold from there wound further, blind
/// for its first 30 ms, and the fourth in a row named a broken thread.
#[test]
fn a_folded_thread_is_not_tightened_again_and_again() {
    for (seed, again) in
        (0..3).flat_map(|seed| [Command::Fold, Command::CheckFolded].map(|again| (seed, again)))
    {
        let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
        let end_um = sim.capsule.calibration().expect("calibrated").folded.0;
        sim.run(Command::Fold);
        sim.forget();
        for time in 0..8 {
            sim.order(Command::Unfold);
            for _ in 0..80 {
                sim.tick();
            }
            sim.run(Command::Stop);
            sim.run(again);
            let state = sim.capsule.state();
            assert_eq!(state, CapsuleState::Folded, "{seed} {again:?} {time}");
            let off_um = sim.capsule.thread().0 - end_um;
            assert!(
                off_um.abs() < 250,
                "{seed} {again:?} {time}: {off_um} um off"
            );
        }
        let most_n = sim.plant.peak_force_n();
        assert!(most_n < 9.0, "{seed} {again:?}: {most_n:.1} N");
        sim.run(Command::Unfold);
        assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);
        assert!(sim.plant.extremes_mm().0 >= 0.0);
    }
}

/// A counter that loses 0.06 mm in each cycle shifts the zero after a while. No single fold shows it.
#[test]
fn a_count_that_moves_pays_out_past_zero_no_more_than_another_friction() {
    let mut sim = Simulation::calibrated(Parameters::nominal(), 0);
    for cycle in 0..9 {
        sim.run(Command::Fold);
        assert_eq!(sim.capsule.state(), CapsuleState::Folded, "cycle {cycle}");
        sim.run(Command::Unfold);
        assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);
        let least_mm = sim.plant.extremes_mm().0;
        assert!(least_mm >= -0.05, "cycle {cycle}: {least_mm} mm");
        // The position reads 0.12 mm more than is wound.
        sim.board.miscount(100);
    }
}

/// A count that moves by 0.06 mm in each cycle looks like friction that falls: either way the same place takes less
/// current. Ends that wander by less than friction moves them are no sign, so the reference goes only after some 0.3 mm
/// beyond that. Until then each unfolding ends before zero by what is doubted.
#[test]
fn ends_that_wander_take_the_reference_away() {
    let mut sim = Simulation::calibrated(Parameters::nominal(), 0);
    let mut folds = 0;
    let drifted = loop {
        sim.run(Command::Fold);
        folds += 1;
        let drifted = sim.events.iter().find_map(|event| match event {
            CapsuleEvent::Drifted { by_um } => Some(*by_um),
            _ => None,
        });
        if let Some(by_um) = drifted {
            break by_um;
        }
        assert_eq!(sim.capsule.state(), CapsuleState::Folded);
        assert!(folds < 18, "not noticed");
        sim.run(Command::Unfold);
        let least_mm = sim.plant.extremes_mm().0;
        assert!(least_mm >= -0.05, "fold {folds}: {least_mm} mm");
        sim.board.miscount(50);
    };
    assert!((150..350).contains(&drifted), "{folds}: {drifted}");
    let record = sim.capsule.record();
    assert_eq!(record.outcome, ActuationOutcome::Complete, "it is folded");
    assert_eq!(sim.capsule.state(), CapsuleState::WasFolded);
    let refused = sim.give(Event::Command(Command::Unfold)).refusal;
    assert_eq!(refused, Some(Refusal::NotReferenced));
    // A check finds the end, and with it the zero.
    sim.run(Command::CheckFolded);
    assert_eq!(sim.capsule.state(), CapsuleState::Folded);
    sim.forget();
    sim.run(Command::Unfold);
    let left_mm = sim.plant.wound_mm();
    assert!(left_mm.abs() < 0.25, "{left_mm} mm");
    assert!(sim.plant.extremes_mm().0 >= 0.0);
}

/// A count that may be too high ends no partial fold below what is doubted of it.
#[test]
fn a_partial_fold_respects_what_is_doubted() {
    let mut sim = Simulation::calibrated(Parameters::nominal(), 0);
    for _ in 0..14 {
        sim.run(Command::Fold);
        assert_eq!(sim.capsule.state(), CapsuleState::Folded);
        sim.run(Command::Unfold);
        sim.board.miscount(50);
    }
    let least = PARTIAL_MARGIN.0;
    match refusal(&mut sim, least) {
        Some(Refusal::OutOfRange { min, .. }) => assert!(min > least as u64, "{min}"),
        other => {
            sim.settle();
            panic!("{other:?}: {} mm", sim.plant.extremes_mm().0);
        }
    }
}

/// A healthy capsule folds the same way again and again.
#[test]
fn a_healthy_capsule_does_not_drift() {
    let mut sim = Simulation::calibrated(Parameters::varied(7), 7);
    for _ in 0..25 {
        sim.run(Command::Fold);
        assert_eq!(sim.capsule.state(), CapsuleState::Folded);
        sim.run(Command::Unfold);
    }
}

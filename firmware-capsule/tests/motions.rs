//! Single motions, reading by reading: the drive that follows from each, and the data that stay.

use capsule_plant::{Defect, Parameters};
use device::settings::Values;
use firmware_capsule::{
    calibration::Calibration,
    fold::{Capsule, Command, Drive, Event},
    mechanics::Thread,
    sample::Sample,
    settings::Settings,
    trace::Recording,
};
use protocol::{
    capsule::{ActuationOutcome, CapsuleFault, CapsuleState, GetTrace},
    error::Refusal,
    settings::SettingKey,
};
use simulated_machines::plant::Simulation;
use std::sync::LazyLock;

/// Calibrated once for all: that takes longer than most tests here.
fn unfolded() -> Simulation {
    static CALIBRATED: LazyLock<Simulation> =
        LazyLock::new(|| Simulation::calibrated(Parameters::nominal(), 0));
    CALIBRATED.clone()
}

/// Folded, at rest.
fn folded() -> Simulation {
    static FOLDED: LazyLock<Simulation> = LazyLock::new(|| {
        let mut sim = unfolded();
        sim.run(Command::Fold);
        sim
    });
    FOLDED.clone()
}

/// Stopped in mid-fold, at rest.
fn stopped() -> Simulation {
    let mut sim = unfolded();
    sim.run_past(Command::Fold, 5.0);
    sim.run(Command::Stop);
    sim
}

/// Gives the last sample again a millisecond later, changed.
fn read(sim: &mut Simulation, change: impl Fn(&mut Sample)) {
    let mut sample = *sim.capsule.sample();
    change(&mut sample);
    sim.now_us += 1_000;
    sim.give(Event::Sample(sample));
}

/// A spool that is turned by hand afterwards does not change the record.
#[test]
fn a_record_ends_where_the_motor_stands() {
    let mut sim = unfolded();
    sim.run_past(Command::Fold, 5.0);
    sim.order(Command::Stop);
    let stopped_um = sim.capsule.record().thread_um;
    for _ in 0..39 {
        sim.tick();
    }
    let stands_um = sim.capsule.record().thread_um;
    assert_eq!(stands_um, sim.capsule.thread().0);
    assert_eq!(sim.capsule.drive(), Drive::Brake);
    assert!(
        stands_um > stopped_um + 20,
        "{stopped_um} to {stands_um} um"
    );
    read(&mut sim, |sample| sample.counts.0 += 1_000);
    assert_eq!(sim.capsule.record().thread_um, stands_um);
    assert_eq!(sim.capsule.drive(), Drive::Off, "40 ms are over");
}

/// A thread that is paid out, or wound to feel it, engages nothing.
#[test]
fn only_a_fold_engages_the_thread() {
    let mut sim = folded();
    let engaged_um = sim.capsule.record().engaged_um;
    assert!((500..10_000).contains(&engaged_um), "{engaged_um}");
    sim.run(Command::Unfold);
    assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);
    assert_eq!(sim.capsule.record().engaged_um, 0);
}

/// An order at the end switches the motor on for no millisecond.
#[test]
fn an_unfolding_that_begins_at_its_end_drives_nothing() {
    let mut sim = stopped();
    let zero = sim.capsule.zero();
    read(&mut sim, |sample| sample.counts.0 = zero.0 + 20);
    let actions = sim.give(Event::Command(Command::Unfold));
    assert_eq!(actions.refusal, None);
    assert_eq!(actions.drive, Drive::Off);
    assert_eq!(actions.events.len(), 2, "{actions:?}");
    assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);
    assert_eq!(sim.capsule.record().outcome, ActuationOutcome::Complete);
}

/// A fast motor that has met something loses its speed within 4 ms against its drive; shorted, it takes twice as long.
#[test]
fn a_motor_that_has_struck_something_is_driven_back_until_it_is_slow() {
    let mut sim = unfolded();
    sim.plant.suffer(Defect::Jam(12.0));
    sim.run_past(Command::Fold, 11.5);
    let mut drives = Vec::new();
    while sim.capsule.is_moving() {
        drives.push(sim.tick().1);
    }
    let against = |drive: &Drive| matches!(drive, Drive::Millivolts(..0));
    let on = |drive: &Drive| matches!(drive, Drive::Millivolts(0..));
    let mut struck = drives.iter().skip_while(|drive| on(drive));
    let back = struck.by_ref().take_while(|drive| against(drive)).count();
    assert_eq!(back, 4, "{drives:?}");
    assert!(!struck.any(against), "{drives:?}");
    let brakes = drives
        .iter()
        .filter(|drive| **drive == Drive::Brake)
        .count();
    assert_eq!(brakes, 1, "only the end of the motion: {drives:?}");
}

/// The voltage that a start needs, as the refusal of a fold on an empty cell tells it.
fn least_mv(mut sim: Simulation) -> u16 {
    sim.order(Command::Stop);
    read(&mut sim, |sample| sample.battery_mv = 2_000);
    match sim.give(Event::Command(Command::Fold)).refusal {
        Some(Refusal::BatteryLow { min_mv, .. }) => min_mv,
        other => panic!("{other:?}"),
    }
}

/// A sag that a slack thread's 16 mA cannot have made tells nothing of the cell.
#[test]
fn only_a_loaded_motor_measures_the_cell() {
    for (mm, counts) in [(3.0, false), (20.0, true)] {
        let mut sim = unfolded();
        sim.run_past(Command::Fold, mm);
        let mut sagged = sim.clone();
        read(&mut sim, |_| {});
        read(&mut sagged, |sample| sample.battery_mv -= 500);
        let (before, after) = (least_mv(sim), least_mv(sagged));
        assert_eq!(after > before, counts, "{before} and {after} mV at {mm} mm");
    }
}

#[test]
fn a_trace_counts_from_the_capsules_zero() {
    let mut sim = folded();
    sim.reset(true);
    sim.run(Command::CheckFolded);
    let mut recording = Recording::new();
    recording.take(1, sim.capsule.sample(), Drive::Off);
    let trace = recording.part(&GetTrace { from: 0 }, sim.capsule.zero());
    assert!(trace.points[0].thread_um > 20_000, "{trace:?}");
    assert_eq!(trace.points[0].thread_um, sim.capsule.thread().0);
}

/// Readings that were taken with another zero of the amplifier judged a motion wrongly.
#[test]
fn a_zero_of_the_amplifier_that_moved_over_a_motion_is_a_fault() {
    let sim = stopped();
    let before_ma = sim.capsule.sample().offset_ma;
    for (by_ma, fault) in [
        (7, None),
        (-7, None),
        (8, Some(CapsuleFault::SenseLost)),
        (-8, Some(CapsuleFault::SenseLost)),
    ] {
        let mut sim = sim.clone();
        read(&mut sim, |sample| sample.offset_ma = before_ma + by_ma);
        assert_eq!(sim.capsule.fault(), fault, "{by_ma} mA");
    }
    // Not before the motor stands: the zero of a motor that still turns is none.
    let mut sim = unfolded();
    sim.run_past(Command::Fold, 5.0);
    read(&mut sim, |sample| sample.offset_ma = before_ma + 8);
    assert_eq!(sim.capsule.fault(), None);
    sim.order(Command::Stop);
    read(&mut sim, |sample| sample.offset_ma = before_ma + 8);
    assert_eq!(sim.capsule.fault(), None);
}

/// A jam was judged by the current, an emergency stop was not.
#[test]
fn a_zero_that_moved_renames_only_the_faults_that_the_current_named() {
    for (defect, renamed) in [(Some(Defect::Jam(6.0)), true), (None, false)] {
        let mut sim = unfolded();
        match defect {
            Some(jam) => {
                sim.plant.suffer(jam);
                sim.run(Command::Fold);
            }
            None => {
                sim.run_past(Command::Fold, 5.0);
                sim.run(Command::EStop);
            }
        }
        let named = sim.capsule.fault().expect("faulted");
        read(&mut sim, |sample| sample.offset_ma += 8);
        let expected = if renamed {
            CapsuleFault::SenseLost
        } else {
            named
        };
        assert_eq!(sim.capsule.fault(), Some(expected), "{named:?}");
    }
}

#[test]
fn a_lost_amplifier_is_acknowledged_once_its_zero_is_back() {
    let mut sim = stopped();
    for (offset_ma, refusal) in [
        (1_000, Some(Refusal::CauseStillPresent)),
        (21, Some(Refusal::CauseStillPresent)),
        (-21, Some(Refusal::CauseStillPresent)),
        (20, None),
    ] {
        read(&mut sim, |sample| sample.offset_ma = offset_ma);
        assert_eq!(sim.capsule.fault(), Some(CapsuleFault::SenseLost));
        let actions = sim.give(Event::Command(Command::Acknowledge));
        assert_eq!(actions.refusal, refusal, "{offset_ma} mA");
    }
    read(&mut sim, |_| {});
    assert_eq!(sim.capsule.fault(), None, "the zero that is there counts");
}

#[test]
fn a_calibration_measures_the_motor_constant() {
    let calibration = unfolded().kept.expect("calibrated");
    let known = Settings::REFERENCE.back_emf_uv_per_cps;
    let off = u32::from(calibration.back_emf_uv_cps).abs_diff(known);
    assert!(off * 20 < known, "{calibration:?}");
}

/// A thread that was slack would show after 1.5 mm.
#[test]
fn a_check_of_a_folded_capsule_pays_little_out() {
    let mut sim = folded();
    let folded_mm = sim.plant.wound_mm();
    sim.forget();
    sim.run(Command::CheckFolded);
    let paid_out_mm = folded_mm - sim.plant.extremes_mm().0;
    assert!((0.6..2.0).contains(&paid_out_mm), "{paid_out_mm} mm");
}

/// Whoever stops a check of a capsule that knows its place gets that back.
#[test]
fn a_check_from_a_known_place_keeps_the_reference() {
    let mut sim = stopped();
    sim.order(Command::CheckFolded);
    sim.tick();
    assert!(sim.capsule.referenced());
    sim.run(Command::Stop);
    assert_eq!(sim.capsule.state(), CapsuleState::Stopped);
}

/// The tension is measured over 0.7 mm. A way that is shorter begins without winding.
#[test]
fn a_folded_thread_is_felt_before_it_is_paid_out_for_long() {
    let sim = folded();
    for (less_um, feels) in [(600, false), (1_000, true)] {
        let mut sim = sim.clone();
        let to = Thread(sim.capsule.thread().0 - less_um);
        sim.order(Command::FoldTo(to));
        let (_, drive) = sim.tick();
        assert_eq!(matches!(drive, Drive::Millivolts(1..)), feels, "{drive:?}");
    }
}

/// Calibrates a capsule again, with less thread than before, and stops where the new calibration is in force. Returns
/// the capsule and that calibration.
fn calibrated_anew() -> (Simulation, Calibration) {
    let before = unfolded().kept.expect("calibrated");
    let parameters = Parameters {
        slack_mm: 0.5,
        ..Parameters::nominal()
    };
    let mut sim = Simulation::new(parameters, 0);
    sim.kept = Some(before);
    sim.reset(false);
    sim.order(Command::Calibrate);
    while sim.capsule.calibration() == Some(&before) {
        sim.tick();
        assert!(sim.capsule.is_moving(), "{:?}", sim.capsule.record());
    }
    let in_force = *sim.capsule.calibration().expect("calibrated");
    (sim, in_force)
}

/// After the next start a reference with the calibration before would pay out past zero. While the motor turns, nothing
/// can be written.
#[test]
fn a_calibration_in_force_is_kept_whatever_ends_its_motion() {
    let (sim, in_force) = calibrated_anew();
    let before = sim.kept;
    type End = fn(&mut Simulation);
    let ends: [(&str, End); 4] = [
        ("stop", |sim| sim.order(Command::Stop)),
        ("emergency stop", |sim| sim.order(Command::EStop)),
        ("silent host", |sim| {
            sim.give(Event::LinkSilent);
        }),
        ("time-out", |sim| sim.now_us += 16_000_000),
    ];
    for (name, end) in ends {
        let mut sim = sim.clone();
        assert_eq!(sim.kept, before, "not in the motion");
        end(&mut sim);
        sim.settle();
        let outcome = sim.capsule.record().outcome;
        assert_ne!(outcome, ActuationOutcome::Complete, "{name}");
        assert_eq!(sim.capsule.calibration(), Some(&in_force), "{name}");
        assert_eq!(sim.kept, Some(in_force), "{name}: {outcome:?}");
        sim.reset(false);
        sim.run(Command::Reference);
        assert_eq!(sim.capsule.state(), CapsuleState::Unfolded, "{name}");
        let least_mm = sim.plant.extremes_mm().0;
        assert!(least_mm >= 0.0, "{name}: {least_mm} mm");
    }
}

/// The folded end is a place that a calibration has found with its force. Folds go on ending there, if they can.
#[test]
fn another_end_force_moves_the_folded_end_only_once_it_is_calibrated() {
    for (force_ma, folds_there, moves_um) in
        [(60, false, -1_820), (100, true, -590), (160, true, 385)]
    {
        let values = Values::DEFAULT.with(SettingKey::EndForceMa, force_ma);
        let settings = Settings::new(&values.expect("within its range")).expect("keeps the rules");
        let mut sim = unfolded();
        sim.capsule.set_settings(settings);
        let end_um = |sim: &Simulation| sim.capsule.calibration().expect("calibrated").folded.0;
        let before_um = end_um(&sim);
        let mut folds = sim.clone();
        folds.run(Command::Fold);
        let folded_um = folds.capsule.thread().0;
        match folds.capsule.fault() {
            None => assert!(folded_um.abs_diff(before_um) < 150, "{folded_um} um"),
            fault => assert!(matches!(fault, Some(CapsuleFault::Jam { .. })), "{fault:?}"),
        }
        let folded = folds.capsule.state() == CapsuleState::Folded;
        assert_eq!(folded, folds_there, "{force_ma} mA");
        sim.run(Command::Calibrate);
        let moved_um = end_um(&sim) - before_um;
        assert!(moved_um.abs_diff(moves_um) < 100, "{moved_um} um");
    }
}

/// `longest_fold_um` is about calibrations. Where it is below the one in force, a reference run named a slipped thread.
#[test]
fn a_reference_run_finds_an_end_beyond_the_longest_fold() {
    let values = Values::DEFAULT.with(SettingKey::LongestFoldUm, 20_000);
    let settings = Settings::new(&values.expect("within its range")).expect("keeps the rules");
    let mut sim = unfolded();
    sim.capsule.set_settings(settings);
    let end_um = sim.capsule.calibration().expect("calibrated").folded.0;
    assert!(end_um > 21_000, "{end_um}");
    let mut snapped = sim.clone();
    sim.run(Command::Reference);
    assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);
    assert!(sim.plant.extremes_mm().0 >= 0.0);
    sim.run(Command::Fold);
    sim.capsule = Capsule::new(None, sim.kept, Some(sim.capsule.margin()), settings);
    sim.tick();
    sim.run(Command::CheckFolded);
    assert_eq!(sim.capsule.state(), CapsuleState::Folded);
    snapped.plant.suffer(Defect::Snap(15.0));
    snapped.run(Command::Reference);
    assert_eq!(snapped.capsule.fault(), Some(CapsuleFault::ThreadBroken));
    let wound_mm = snapped.plant.extremes_mm().1;
    assert!(wound_mm < f64::from(end_um) / 1e3 + 1.2, "{wound_mm} mm");
}

/// The way back of a check became slower where the thread pulls again. A motor that is braked for that reads nothing, and
/// with little force was back before it read again: a healthy thread had slipped.
#[test]
fn a_check_with_little_force_reads_the_thread_until_it_is_back() {
    for (force_ma, seed) in [(80, 0), (80, 1), (80, 2), (80, 3), (90, 18), (100, 9)] {
        let values = Values::DEFAULT.with(SettingKey::EndForceMa, force_ma);
        let settings = Settings::new(&values.expect("within its range")).expect("keeps the rules");
        let mut sim = Simulation::new(Parameters::lifelike(seed), seed);
        sim.capsule.set_settings(settings);
        sim.run(Command::Calibrate);
        sim.run(Command::Fold);
        for after_ms in [0, 37, 74, 111] {
            let mut sim = sim.clone();
            for _ in 0..after_ms {
                sim.tick();
            }
            sim.run(Command::CheckFolded);
            let state = sim.capsule.state();
            assert_eq!(state, CapsuleState::Folded, "{force_ma} mA, {seed}");
        }
        sim.plant.suffer(Defect::Slip(2.0));
        sim.run(Command::CheckFolded);
        let fault = sim.capsule.fault();
        assert_eq!(
            fault,
            Some(CapsuleFault::SlipOrBreak),
            "{force_ma} mA, {seed}"
        );
    }
}

//! What happens in each state at each command: the table that somebody who has only the module's text can write down.

use capsule_plant::Parameters;
use firmware_capsule::known::Known;
use firmware_capsule::machine::{Capsule, Event};
use firmware_capsule::sense::{Counts, Sample};
use firmware_capsule::settings::Settings;
use firmware_capsule::speed::Drive;
use proptest::prelude::*;
use protocol::capsule::{CapsuleFault, CapsuleState};
use protocol::error::Refusal;
use simulated_machines::plant::{
    CALIBRATE, CHECK, ESTOP, FOLD, REFERENCE, Simulation, UNFOLD, fold_to,
};

const COMMANDS: [Event; 7] = [
    CALIBRATE,
    REFERENCE,
    FOLD,
    UNFOLD,
    fold_to(9_000),
    CHECK,
    Event::Acknowledge,
];

/// A calibrated capsule in this state.
fn in_state(state: &str) -> Simulation {
    let mut sim = match state {
        "new" => return Simulation::nominal(),
        "wound without a calibration" => {
            let mut sim = Simulation::nominal();
            sim.run_past(CALIBRATE, 5.0);
            sim.order(Event::Stop);
            sim.settle();
            return sim;
        }
        _ => Simulation::calibrated(Parameters::nominal(), 0),
    };
    match state {
        "Unfolded" => {}
        "Folded" => sim.run(FOLD),
        "Stopped" => sim.run(fold_to(12_000)),
        "moving" => sim.run_past(FOLD, 3.0),
        "Faulted" => {
            sim.order(ESTOP);
        }
        // A cut of the power within a fold.
        "uncertain" => {
            sim.run_past(FOLD, 5.0);
            sim.restart(None);
        }
        // The encoder was lost, and that acknowledged.
        "lost" => {
            sim.plant.inject(capsule_plant::Defect::Encoder);
            sim.order(FOLD);
            sim.settle();
            sim.order(Event::Acknowledge);
        }
        "restarted by the watchdog" => sim.restart(Some(CapsuleFault::Watchdog)),
        other => panic!("{other}"),
    }
    sim
}

/// `+` accepted; else the refusal: a stands for AlreadyThere, b for CapsuleBusy, c for NotCalibrated, f for
/// CapsuleFaulted, h for UnfoldByHand, k for AcknowledgeFirst, n for NothingToAcknowledge, r for NotReferenced, w for
/// OutOfRange.
fn answer(sim: &Simulation, command: Event) -> char {
    let mut sim = sim.clone();
    match sim.give(command).refusal {
        None => '+',
        Some(Refusal::AlreadyThere) => 'a',
        Some(Refusal::CapsuleBusy(_)) => 'b',
        Some(Refusal::NotCalibrated) => 'c',
        Some(Refusal::CapsuleFaulted(_)) => 'f',
        Some(Refusal::UnfoldByHand) => 'h',
        Some(Refusal::AcknowledgeFirst) => 'k',
        Some(Refusal::NothingToAcknowledge) => 'n',
        Some(Refusal::NotReferenced) => 'r',
        Some(Refusal::OutOfRange { .. }) => 'w',
        Some(other) => panic!("{other:?}"),
    }
}

#[test]
fn each_state_accepts_what_the_table_says() {
    use CapsuleState::{Faulted, Folded, Folding, Stopped, Unfolded, Unreferenced};
    // In the order of COMMANDS: calibrate, reference, fold, unfold, partial fold, check, acknowledge.
    for (name, state, expected) in [
        ("new", Unreferenced, "++chccn"),
        ("wound without a calibration", Unreferenced, "wwc+ccn"),
        ("Unfolded", Unfolded, "+++a++n"),
        ("Folded", Folded, "w+a+++n"),
        ("Stopped", Stopped, "w+++++n"),
        ("uncertain", Unreferenced, "w+r+rrn"),
        ("lost", Unreferenced, "+hrhrrn"),
        ("moving", Folding, "bbbbbbn"),
        ("Faulted", Faulted, "ffffff+"),
        ("restarted by the watchdog", Faulted, "kkkkkk+"),
    ] {
        let sim = in_state(name);
        assert_eq!(sim.capsule.state(), state, "{name}");
        let answers: String = COMMANDS
            .map(|command| answer(&sim, command))
            .iter()
            .collect();
        assert_eq!(answers, expected, "{name}");
        // Stop and emergency stop are never refused.
        for command in [Event::Stop, ESTOP] {
            let mut sim = sim.clone();
            assert_eq!(sim.give(command).refusal, None, "{name}");
            assert!(!sim.capsule.is_moving());
        }
    }
}

/// Where each motion leads from each state that accepts it.
#[test]
fn each_motion_ends_where_the_table_says() {
    use CapsuleState::{Folded, Stopped, Unfolded};
    for (from, command, ends) in [
        ("new", CALIBRATE, Unfolded),
        ("new", REFERENCE, Unfolded),
        ("Unfolded", CALIBRATE, Unfolded),
        ("Unfolded", FOLD, Folded),
        ("Unfolded", CHECK, Folded),
        ("Unfolded", fold_to(9_000), Stopped),
        ("Unfolded", REFERENCE, Unfolded),
        ("Folded", CHECK, Folded),
        ("Folded", fold_to(9_000), Stopped),
        ("Folded", UNFOLD, Unfolded),
        ("Stopped", FOLD, Folded),
        ("Stopped", fold_to(9_000), Stopped),
        ("Stopped", UNFOLD, Unfolded),
        ("uncertain", REFERENCE, Unfolded),
        (
            "wound without a calibration",
            UNFOLD,
            CapsuleState::Unreferenced,
        ),
    ] {
        let mut sim = in_state(from);
        sim.run(command);
        assert_eq!(sim.capsule.state(), ends, "{from}, {command:?}");
        let wound_mm = sim.plant.wound_mm();
        match (ends, command) {
            (Unfolded | CapsuleState::Unreferenced, _) => {
                let left_mm = f64::from(sim.capsule.known.remaining.0) / 1e3;
                assert!(
                    (0.0..0.3).contains(&(wound_mm - left_mm).abs()),
                    "{from}: {wound_mm} mm"
                );
            }
            (Stopped, _) => assert!((wound_mm - 9.0).abs() < 0.1, "{from}: {wound_mm} mm"),
            _ => assert!(
                (wound_mm - sim.folded_mm()).abs() < 0.1,
                "{from}: {wound_mm} mm"
            ),
        }
        assert!(sim.plant.extremes_mm().0 >= 0.0, "{from}, {command:?}");
    }
}

/// A partial fold stays 0.5 mm off both ends, and is refused with the numbers that would do.
#[test]
fn a_partial_fold_stays_off_the_ends() {
    let sim = in_state("Unfolded");
    let end_um = sim.calibration().folded.0;
    for (target, fine) in [
        (499, false),
        (500, true),
        (end_um - 500, true),
        (end_um - 499, false),
    ] {
        let actions = sim.clone().give(fold_to(target));
        assert_eq!(actions.refusal.is_none(), fine, "{target}");
        if let Some(Refusal::OutOfRange { min, max, .. }) = actions.refusal {
            assert_eq!((min, max), (500, end_um as u64 - 500));
        }
    }
}

/// A stop keeps the place, and so do an emergency stop and the faults that do not doubt the count.
#[test]
fn a_motion_that_is_cut_short_keeps_its_place() {
    for (command, fault) in [(Event::Stop, None), (ESTOP, Some(CapsuleFault::EStopFrame))] {
        let mut sim = in_state("Unfolded");
        sim.run_past(FOLD, 8.0);
        sim.order(command);
        sim.settle();
        assert_eq!(sim.capsule.fault, fault);
        if fault.is_some() {
            sim.order(Event::Acknowledge);
        }
        assert_eq!(sim.capsule.state(), CapsuleState::Stopped);
        sim.run(UNFOLD);
        assert!((0.0..0.1).contains(&sim.plant.wound_mm()));
    }
    let mut sim = in_state("Unfolded");
    sim.run_past(FOLD, 8.0);
    sim.give(Event::LinkSilent);
    sim.settle();
    assert_eq!(sim.capsule.state(), CapsuleState::Stopped);
}

fn rested(battery_mv: u16, offset_ma: i16) -> Capsule {
    let mut capsule = Capsule::new(None, Known::default(), Settings::REFERENCE);
    let sample = Sample {
        battery_mv,
        offset_ma,
        ..Sample::default()
    };
    capsule.step(1_000, Event::Sample(sample));
    capsule
}

#[test]
fn an_empty_cell_and_a_wrong_amplifier_refuse_a_motion() {
    for (battery_mv, offset_ma, refusal) in [
        (3_000, 20, None),
        (
            2_999,
            0,
            Some(Refusal::BatteryLow {
                battery_mv: 2_999,
                min_mv: 3_000,
            }),
        ),
        (
            3_700,
            21,
            Some(Refusal::CapsuleFaulted(CapsuleFault::SenseLost)),
        ),
    ] {
        let mut capsule = rested(battery_mv, offset_ma);
        let actions = capsule.step(2_000, CALIBRATE);
        assert_eq!(actions.refusal, refusal);
        assert_eq!(capsule.is_moving(), refusal.is_none());
    }
}

/// A reading that no motor need explain.
fn any_sample() -> impl Strategy<Value = Sample> {
    (
        -30_000..30_000,
        -1_500_000..1_500_000,
        2_000..4_300_u16,
        any::<bool>(),
    )
        .prop_map(|(counts, current_ua, battery_mv, driver_fault)| Sample {
            counts: Counts(counts),
            current_ua,
            offset_ma: 0,
            battery_mv,
            driver_fault,
        })
}

proptest! {
    /// Whatever is read and ordered, the motor is driven by an accepted motion alone, and a stop of any kind ends it at
    /// once.
    #[test]
    fn nothing_drives_but_an_accepted_motion(
        calibrated in any::<bool>(),
        inputs in prop::collection::vec((0..12_usize, any_sample()), 1..60),
    ) {
        let mut capsule = match calibrated {
            true => in_state("Unfolded").capsule,
            false => rested(3_900, 0),
        };
        let (mut now_us, mut ordered) = (60_000_000, false);
        for (kind, sample) in inputs {
            now_us += 1_000;
            let event = match kind {
                0 => Event::Stop,
                1 => ESTOP,
                2 => Event::LinkSilent,
                3..=8 => COMMANDS[kind - 3],
                9 => Event::Acknowledge,
                _ => Event::Sample(sample),
            };
            let actions = capsule.step(now_us, event);
            match kind {
                0..=2 => ordered = false,
                3..=8 => ordered |= actions.refusal.is_none(),
                _ => ordered &= capsule.is_moving(),
            }
            let driven = matches!(capsule.drive, Drive::Millivolts(_));
            prop_assert!(!driven || ordered && capsule.is_moving(), "{event:?}");
        }
        // At rest the bridge sleeps after the brake.
        capsule.step(now_us + 1_000, Event::Stop);
        capsule.step(now_us + 50_000, Event::Sample(capsule.sample));
        prop_assert_eq!(capsule.drive, Drive::Off);
    }
}

//! The machine in closed loop with a model of its mechanics: what a person would try on the bench.

mod plant;

use firmware_capsule::{
    detect::Sample,
    fold::{Command, Drive, Event},
    mechanics::FOLDED,
};
use plant::{Defect, Plant, Simulation};
use protocol::{
    capsule::{ActuationKind, ActuationOutcome, CapsuleEvent, CapsuleFault, CapsuleState},
    error::Refusal,
};

fn assert_fault(sim: &Simulation, expected: CapsuleFault) {
    assert_eq!(sim.capsule.fault(), Some(expected));
    let record = sim.capsule.record();
    assert_eq!(record.outcome, ActuationOutcome::Faulted(expected));
    let (actuation, outcome) = (record.actuation, record.outcome);
    let tail = &sim.events[sim.events.len() - 2..];
    assert_eq!(
        tail,
        [
            CapsuleEvent::Ended { actuation, outcome },
            CapsuleEvent::Faulted(expected)
        ]
    );
    assert_eq!(sim.capsule.drive(), Drive::Off);
}

#[test]
fn a_reference_ends_unfolded_inside_the_slack_from_wherever_it_starts() {
    // Unfolded, a bit too far out, half wound, folded.
    for start_mm in [0.0, 0.4, -3.0, 5.0, 12.0, 19.0, 20.5, 21.7] {
        let mut sim = Simulation::new(Plant::at(start_mm));
        let lowest = sim.plant.thread_mm();
        sim.run(Command::Reference);
        assert_eq!(
            sim.capsule.state(),
            CapsuleState::Unfolded,
            "from {start_mm}"
        );
        assert!(sim.capsule.referenced());
        let end_mm = sim.plant.thread_mm();
        assert!((0.0..0.5).contains(&end_mm), "from {start_mm} to {end_mm}");
        assert!(
            sim.lowest_mm >= lowest.min(0.0),
            "paid out to {}",
            sim.lowest_mm
        );
        assert!(sim.peak_force < 8.0, "{} N", sim.peak_force);
        let thread_um = sim.capsule.thread().0;
        assert!((0..=60).contains(&thread_um), "{thread_um} um");
    }
}

#[test]
fn a_reference_holds_for_half_and_twice_the_assumed_stiffness() {
    for stiffness in [0.5, 2.0] {
        let mut sim = Simulation::new(Plant {
            stiffness,
            ..Plant::at(0.2)
        });
        sim.run(Command::Reference);
        assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);
    }
}

#[test]
fn a_caught_thread_is_not_taken_for_a_folded_origami() {
    for jam_mm in [6.0, 12.0, 17.0] {
        let mut sim = Simulation::new(Plant {
            defect: Some(Defect::Jam(jam_mm)),
            ..Plant::at(0.3)
        });
        sim.run(Command::Reference);
        assert!(
            matches!(sim.capsule.fault(), Some(CapsuleFault::Jam { .. })),
            "{:?}",
            sim.capsule.fault()
        );
        assert!(!sim.capsule.referenced());
        assert!(
            sim.lowest_mm >= 0.0,
            "jam at {jam_mm}: paid out to {}",
            sim.lowest_mm
        );
    }
}

#[test]
fn a_fold_ends_on_force_in_time_and_within_the_energy() {
    let mut sim = Simulation::referenced();
    sim.run(Command::Fold);
    assert_eq!(sim.capsule.state(), CapsuleState::Folded);
    let record = *sim.capsule.record();
    assert_eq!(record.kind, ActuationKind::Fold);
    assert_eq!(record.outcome, ActuationOutcome::Complete);
    assert!(
        (900..1_500).contains(&record.duration_ms),
        "{} ms",
        record.duration_ms
    );
    assert!(
        (160..175).contains(&record.end_current_ma),
        "{} mA",
        record.end_current_ma
    );
    assert!(
        (record.thread_um - FOLDED.0).abs() < 150,
        "{} um",
        record.thread_um
    );
    assert!(
        (5.5..7.5).contains(&sim.plant.force()),
        "{} N",
        sim.plant.force()
    );
    assert!(
        (120..220).contains(&record.energy_mj),
        "{} mJ",
        record.energy_mj
    );
    assert!(
        (6_000..14_000).contains(&record.engaged_um),
        "{} um",
        record.engaged_um
    );
    assert!(
        record.min_battery_mv < 3_900 && record.min_battery_mv > 3_300,
        "{} mV",
        record.min_battery_mv
    );

    sim.run(Command::Unfold);
    assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);
    let unfold = *sim.capsule.record();
    assert!(
        (900..1_400).contains(&unfold.duration_ms),
        "{} ms",
        unfold.duration_ms
    );
    assert!(
        record.energy_mj + unfold.energy_mj < 410,
        "{} mJ",
        unfold.energy_mj
    );
    assert_eq!(unfold.engaged_um, 0);
}

#[test]
fn the_energy_in_the_record_is_what_the_battery_gave() {
    let mut sim = Simulation::referenced();
    for command in [Command::Fold, Command::Unfold] {
        let before = sim.plant.energy;
        sim.run(command);
        let given_mj = (sim.plant.energy - before) * 1e3;
        let recorded_mj = f64::from(sim.capsule.record().energy_mj);
        assert!(
            (recorded_mj / given_mj - 1.0).abs() < 0.03,
            "{recorded_mj} mJ, true {given_mj}"
        );
    }
}

#[test]
fn a_thread_that_slipped_on_the_spool_is_a_timeout_and_a_reference_helps() {
    let mut sim = Simulation::referenced();
    sim.plant.slipped_mm = 4.0;
    sim.run(Command::Fold);
    // At the soft maximum it pulls, but with less than the end force.
    assert_fault(&sim, CapsuleFault::Timeout);
    assert!(sim.plant.force() > 1.0, "{} N", sim.plant.force());
    assert!(sim.highest_mm < 25.2, "{} mm", sim.highest_mm);
    sim.order(Command::Acknowledge);
    assert_eq!(sim.capsule.state(), CapsuleState::Unreferenced);
    sim.run(Command::Reference);
    assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);
    let slack_mm = sim.plant.thread_mm() - sim.plant.slipped_mm;
    assert!((0.0..0.5).contains(&slack_mm), "{slack_mm} mm");
}

#[test]
fn twenty_folds_neither_creep_nor_pay_out_past_zero() {
    let mut sim = Simulation::referenced();
    for round in 0..20 {
        sim.run(Command::Fold);
        assert_eq!(sim.capsule.state(), CapsuleState::Folded, "round {round}");
        sim.run(Command::Unfold);
        let end_mm = sim.plant.thread_mm();
        assert!((0.0..0.6).contains(&end_mm), "round {round}: {end_mm} mm");
    }
    assert!(sim.lowest_mm >= 0.0, "{}", sim.lowest_mm);
    assert!(sim.highest_mm < 22.0, "{}", sim.highest_mm);
}

#[test]
fn the_motor_sleeps_in_every_resting_state() {
    let mut sim = Simulation::referenced();
    for command in [Command::Fold, Command::Unfold] {
        sim.run(command);
        for _ in 0..1_000 {
            sim.tick();
            assert_eq!(sim.capsule.drive(), Drive::Off);
        }
    }
}

#[test]
fn an_obstacle_is_a_jam_and_the_way_back_is_open() {
    let mut sim = Simulation::referenced();
    sim.plant.defect = Some(Defect::Jam(12.0));
    sim.run(Command::Fold);
    let Some(fault @ CapsuleFault::Jam { thread_um }) = sim.capsule.fault() else {
        panic!("{:?}", sim.capsule.fault())
    };
    assert_fault(&sim, fault);
    assert!((11_500..12_300).contains(&thread_um), "{thread_um} um");
    let refusal = sim.give(Event::Command(Command::Unfold)).refusal;
    assert_eq!(refusal, Some(Refusal::CapsuleFaulted(fault)));
    sim.order(Command::Acknowledge);
    assert_eq!(sim.capsule.state(), CapsuleState::Stopped);
    sim.run(Command::Unfold);
    assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);
    assert!(sim.lowest_mm >= 0.0);
}

#[test]
fn a_broken_thread_is_noticed_at_the_soft_maximum() {
    for snap_mm in [0.5, 15.0, 20.0] {
        let mut sim = Simulation::referenced();
        sim.plant.defect = Some(Defect::Snap(snap_mm));
        sim.run(Command::Fold);
        assert_fault(&sim, CapsuleFault::ThreadBroken);
        let end_mm = sim.plant.thread_mm();
        assert!((24.0..25.2).contains(&end_mm), "{end_mm} mm");
        sim.order(Command::Acknowledge);
        assert_eq!(sim.capsule.state(), CapsuleState::Unreferenced);
    }
}

#[test]
fn a_reference_with_a_broken_thread_ends() {
    let mut sim = Simulation::new(Plant {
        snapped: true,
        ..Plant::at(0.0)
    });
    sim.run(Command::Reference);
    assert_fault(&sim, CapsuleFault::ThreadBroken);
    assert!(sim.highest_mm < 29.0);
}

#[test]
fn a_lost_encoder_ends_the_motion_within_a_millimetre() {
    for (command, at_mm) in [
        (Command::Fold, 5.0),
        (Command::Fold, 19.0),
        (Command::Fold, -1.0),
    ] {
        let mut sim = Simulation::referenced();
        sim.plant.defect = Some(Defect::Encoder(at_mm));
        sim.run(command);
        assert_fault(&sim, CapsuleFault::EncoderLost);
        assert!(sim.highest_mm < at_mm.max(0.5) + 1.5);
    }
    let mut sim = Simulation::new(Plant {
        defect: Some(Defect::Swapped),
        ..Plant::at(0.3)
    });
    sim.run(Command::Reference);
    assert_fault(&sim, CapsuleFault::EncoderLost);
}

#[test]
fn bridge_fault_and_short_circuit_end_the_motion_in_milliseconds() {
    let mut sim = Simulation::referenced();
    sim.plant.defect = Some(Defect::Driver(5.0));
    sim.run(Command::Fold);
    assert_fault(&sim, CapsuleFault::DriverFault);
    assert!(sim.highest_mm < 5.4, "{}", sim.highest_mm);

    let mut sim = Simulation::referenced();
    sim.plant.defect = Some(Defect::Short(5.0));
    sim.run(Command::Fold);
    assert_fault(&sim, CapsuleFault::OverCurrent { current_ma: 1_500 });
    assert!(sim.highest_mm < 5.4, "{}", sim.highest_mm);
}

#[test]
fn a_low_battery_is_refused_at_rest_and_ends_a_motion() {
    let mut sim = Simulation::referenced();
    sim.plant.cell = 2.95;
    sim.tick();
    let refusal = sim.give(Event::Command(Command::Fold)).refusal;
    assert_eq!(
        refusal,
        Some(Refusal::BatteryLow {
            battery_mv: 2_950,
            min_mv: 3_000
        })
    );
    assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);

    // Two silver-oxide cells: enough at rest, not under load.
    let mut sim = Simulation::referenced();
    (sim.plant.cell, sim.plant.cell_ohm) = (3.1, 20.0);
    sim.tick();
    sim.run(Command::Fold);
    let Some(fault @ CapsuleFault::LowBattery { .. }) = sim.capsule.fault() else {
        panic!("{:?}", sim.capsule.fault())
    };
    assert_fault(&sim, fault);
    sim.plant.cell = 2.9;
    sim.tick();
    let refusal = sim.give(Event::Command(Command::Acknowledge)).refusal;
    assert_eq!(refusal, Some(Refusal::CauseStillPresent));
    sim.plant.cell = 3.9;
    sim.tick();
    sim.order(Command::Acknowledge);
    assert_eq!(sim.capsule.state(), CapsuleState::Stopped);
    assert!(sim.capsule.referenced());
}

#[test]
fn a_stop_in_mid_fold_keeps_the_position_and_either_way_goes_on() {
    for onward in [Command::Fold, Command::Unfold] {
        let mut sim = Simulation::referenced();
        sim.run_past(Command::Fold, 10.0);
        let actions = sim.give(Event::Command(Command::Stop));
        assert_eq!(actions.drive, Drive::Brake);
        assert_eq!(sim.capsule.state(), CapsuleState::Stopped);
        let outcome = ActuationOutcome::Stopped;
        assert_eq!(sim.capsule.record().outcome, outcome);
        sim.settle();
        assert!(sim.plant.thread_mm() < 10.3, "{}", sim.highest_mm);
        let record_um = f64::from(sim.capsule.record().thread_um);
        // The reference puts the zero 0.2 mm into the slack, and the force is felt a little late.
        let (true_um, zero_um) = (sim.plant.thread_mm() * 1e3, 400.0);
        assert!(
            (true_um - record_um - zero_um).abs() < 150.0,
            "{record_um} um, true {true_um}"
        );
        sim.run(onward);
        let expected = match onward {
            Command::Fold => CapsuleState::Folded,
            _ => CapsuleState::Unfolded,
        };
        assert_eq!(sim.capsule.state(), expected);
        assert!(sim.lowest_mm >= 0.0 && sim.highest_mm < 22.0);
    }
}

#[test]
fn a_reversal_during_the_brake_waits_for_its_end() {
    let mut sim = Simulation::referenced();
    sim.run_past(Command::Fold, 10.0);
    sim.order(Command::Stop);
    sim.order(Command::Unfold);
    let mut braked_ms = 0;
    while sim.capsule.drive() == Drive::Brake {
        sim.tick();
        braked_ms += 1;
    }
    assert_eq!(braked_ms, 40);
    sim.settle();
    assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);
}

#[test]
fn link_loss_stops_and_says_so() {
    let mut sim = Simulation::referenced();
    sim.run_past(Command::Fold, 8.0);
    sim.give(Event::LinkSilent);
    assert_eq!(sim.capsule.state(), CapsuleState::Stopped);
    assert_eq!(sim.capsule.record().outcome, ActuationOutcome::LinkLost);
    sim.settle();
    assert!(sim.highest_mm < 8.3);
    let quiet = sim.give(Event::LinkSilent);
    assert!(quiet.events.is_empty(), "silence at rest is no event");
}

#[test]
fn a_stop_before_the_zero_is_found_leaves_it_unknown_and_after_it_known() {
    let mut sim = Simulation::new(Plant::at(0.4));
    sim.run_past(Command::Reference, 10.0);
    sim.order(Command::Stop);
    assert_eq!(sim.capsule.state(), CapsuleState::Unreferenced);
    sim.settle();
    sim.order(Command::Reference);
    while !sim.capsule.referenced() {
        sim.tick();
    }
    sim.order(Command::Stop);
    assert_eq!(sim.capsule.state(), CapsuleState::Stopped);
}

#[test]
fn an_emergency_stop_latches_and_costs_the_reference() {
    let mut sim = Simulation::referenced();
    sim.run_past(Command::Fold, 10.0);
    sim.order(Command::EStop);
    assert_eq!(sim.capsule.drive(), Drive::Brake);
    sim.settle();
    assert_fault(&sim, CapsuleFault::EStopFrame);
    sim.order(Command::EStop);
    assert_fault(&sim, CapsuleFault::EStopFrame);
    sim.order(Command::Acknowledge);
    let refusal = sim.give(Event::Command(Command::Fold)).refusal;
    assert_eq!(refusal, Some(Refusal::NotReferenced));
    sim.run(Command::Reference);
    assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);
}

#[test]
fn a_clock_that_stops_cannot_keep_the_motor_on_for_ever() {
    // Samples arrive but time stands still. The deadline never passes; the soft maximum needs no clock.
    let mut sim = Simulation::referenced();
    sim.plant.snapped = true;
    sim.order(Command::Fold);
    let now_us = sim.now_us;
    for count in 0..40_000 {
        let sample = Sample {
            counts: firmware_capsule::mechanics::Counts(count),
            current_ma: 16,
            offset_ma: 0,
            battery_mv: 3_900,
            driver_fault: false,
        };
        sim.now_us = now_us;
        sim.give(Event::Sample(sample));
    }
    assert_eq!(sim.capsule.fault(), Some(CapsuleFault::ThreadBroken));
}

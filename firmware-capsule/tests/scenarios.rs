//! The machine on a model of its mechanics: what a person would try at the bench.

mod plant;

use firmware_capsule::{
    detect::Sample,
    fold::{Command, Drive, Event},
    mechanics::FOLDED,
};
use plant::{Bench, Break, Plant};
use protocol::{
    capsule::{ActuationKind, ActuationOutcome, CapsuleEvent, CapsuleFault, CapsuleState},
    error::Refusal,
};

fn assert_fault(bench: &Bench, expected: CapsuleFault) {
    assert_eq!(bench.capsule.fault(), Some(expected));
    let record = bench.capsule.record();
    assert_eq!(record.outcome, ActuationOutcome::Faulted(expected));
    let (actuation, outcome) = (record.actuation, record.outcome);
    let tail = &bench.events[bench.events.len() - 2..];
    assert_eq!(
        tail,
        [
            CapsuleEvent::Ended { actuation, outcome },
            CapsuleEvent::Faulted(expected)
        ]
    );
    assert_eq!(bench.capsule.drive(), Drive::Off);
}

#[test]
fn a_reference_ends_unfolded_inside_the_slack_from_wherever_it_starts() {
    // Unfolded, a bit too far out, half wound, folded.
    for start_mm in [0.0, 0.4, -3.0, 5.0, 12.0, 19.0, 20.5, 21.7] {
        let mut bench = Bench::new(Plant::at(start_mm));
        let lowest = bench.plant.thread_mm();
        bench.run(Command::Reference);
        assert_eq!(
            bench.capsule.state(),
            CapsuleState::Unfolded,
            "from {start_mm}"
        );
        assert!(bench.capsule.referenced());
        let end_mm = bench.plant.thread_mm();
        assert!((0.0..0.5).contains(&end_mm), "from {start_mm} to {end_mm}");
        assert!(
            bench.lowest_mm >= lowest.min(0.0),
            "paid out to {}",
            bench.lowest_mm
        );
        assert!(bench.peak_force < 8.0, "{} N", bench.peak_force);
        let thread_um = bench.capsule.thread().0;
        assert!((0..=60).contains(&thread_um), "{thread_um} um");
    }
}

#[test]
fn a_reference_holds_for_half_and_twice_the_assumed_stiffness() {
    for stiffness in [0.5, 2.0] {
        let mut bench = Bench::new(Plant {
            stiffness,
            ..Plant::at(0.2)
        });
        bench.run(Command::Reference);
        assert_eq!(bench.capsule.state(), CapsuleState::Unfolded);
    }
}

#[test]
fn a_caught_thread_is_not_taken_for_a_folded_origami() {
    for jam_mm in [6.0, 12.0, 17.0] {
        let mut bench = Bench::new(Plant {
            broken: Some(Break::Jam(jam_mm)),
            ..Plant::at(0.3)
        });
        bench.run(Command::Reference);
        assert!(
            matches!(bench.capsule.fault(), Some(CapsuleFault::Jam { .. })),
            "{:?}",
            bench.capsule.fault()
        );
        assert!(!bench.capsule.referenced());
        assert!(
            bench.lowest_mm >= 0.0,
            "jam at {jam_mm}: paid out to {}",
            bench.lowest_mm
        );
    }
}

#[test]
fn a_fold_ends_on_force_in_time_and_within_the_energy() {
    let mut bench = Bench::referenced();
    bench.run(Command::Fold);
    assert_eq!(bench.capsule.state(), CapsuleState::Folded);
    let record = *bench.capsule.record();
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
        (5.5..7.5).contains(&bench.plant.force()),
        "{} N",
        bench.plant.force()
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

    bench.run(Command::Unfold);
    assert_eq!(bench.capsule.state(), CapsuleState::Unfolded);
    let unfold = *bench.capsule.record();
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
fn twenty_folds_neither_creep_nor_pay_out_past_zero() {
    let mut bench = Bench::referenced();
    for round in 0..20 {
        bench.run(Command::Fold);
        assert_eq!(bench.capsule.state(), CapsuleState::Folded, "round {round}");
        bench.run(Command::Unfold);
        let end_mm = bench.plant.thread_mm();
        assert!((0.0..0.6).contains(&end_mm), "round {round}: {end_mm} mm");
    }
    assert!(bench.lowest_mm >= 0.0, "{}", bench.lowest_mm);
    assert!(bench.highest_mm < 22.0, "{}", bench.highest_mm);
}

#[test]
fn the_motor_sleeps_in_every_resting_state() {
    let mut bench = Bench::referenced();
    for command in [Command::Fold, Command::Unfold] {
        bench.run(command);
        for _ in 0..1_000 {
            bench.tick();
            assert_eq!(bench.capsule.drive(), Drive::Off);
        }
    }
}

#[test]
fn an_obstacle_is_a_jam_and_the_way_back_is_open() {
    let mut bench = Bench::referenced();
    bench.plant.broken = Some(Break::Jam(12.0));
    bench.run(Command::Fold);
    let Some(fault @ CapsuleFault::Jam { thread_um }) = bench.capsule.fault() else {
        panic!("{:?}", bench.capsule.fault())
    };
    assert_fault(&bench, fault);
    assert!((11_500..12_300).contains(&thread_um), "{thread_um} um");
    let refusal = bench.give(Event::Command(Command::Unfold)).refusal;
    assert_eq!(refusal, Some(Refusal::CapsuleFaulted(fault)));
    bench.order(Command::Acknowledge);
    assert_eq!(bench.capsule.state(), CapsuleState::Stopped);
    bench.run(Command::Unfold);
    assert_eq!(bench.capsule.state(), CapsuleState::Unfolded);
    assert!(bench.lowest_mm >= 0.0);
}

#[test]
fn a_broken_thread_is_noticed_at_the_soft_maximum() {
    for snap_mm in [0.5, 15.0, 20.0] {
        let mut bench = Bench::referenced();
        bench.plant.broken = Some(Break::Thread(snap_mm));
        bench.run(Command::Fold);
        assert_fault(&bench, CapsuleFault::ThreadBroken);
        let end_mm = bench.plant.thread_mm();
        assert!((24.0..25.2).contains(&end_mm), "{end_mm} mm");
        bench.order(Command::Acknowledge);
        assert_eq!(bench.capsule.state(), CapsuleState::Unreferenced);
    }
}

#[test]
fn a_reference_with_a_broken_thread_ends() {
    let mut bench = Bench::new(Plant {
        snapped: true,
        ..Plant::at(0.0)
    });
    bench.run(Command::Reference);
    assert_fault(&bench, CapsuleFault::ThreadBroken);
    assert!(bench.highest_mm < 29.0);
}

#[test]
fn a_lost_encoder_ends_the_motion_within_a_millimetre() {
    for (command, at_mm) in [
        (Command::Fold, 5.0),
        (Command::Fold, 19.0),
        (Command::Fold, -1.0),
    ] {
        let mut bench = Bench::referenced();
        bench.plant.broken = Some(Break::Encoder(at_mm));
        bench.run(command);
        assert_fault(&bench, CapsuleFault::EncoderLost);
        assert!(bench.highest_mm < at_mm.max(0.5) + 1.5);
    }
    let mut bench = Bench::new(Plant {
        broken: Some(Break::Swapped),
        ..Plant::at(0.3)
    });
    bench.run(Command::Reference);
    assert_fault(&bench, CapsuleFault::EncoderLost);
}

#[test]
fn bridge_fault_and_short_circuit_end_the_motion_in_milliseconds() {
    let mut bench = Bench::referenced();
    bench.plant.broken = Some(Break::Driver(5.0));
    bench.run(Command::Fold);
    assert_fault(&bench, CapsuleFault::DriverFault);
    assert!(bench.highest_mm < 5.4, "{}", bench.highest_mm);

    let mut bench = Bench::referenced();
    bench.plant.broken = Some(Break::Short(5.0));
    bench.run(Command::Fold);
    assert_fault(&bench, CapsuleFault::OverCurrent { current_ma: 1_500 });
    assert!(bench.highest_mm < 5.4, "{}", bench.highest_mm);
}

#[test]
fn a_low_battery_is_refused_at_rest_and_ends_a_motion() {
    let mut bench = Bench::referenced();
    bench.plant.cell = 2.95;
    bench.tick();
    let refusal = bench.give(Event::Command(Command::Fold)).refusal;
    assert_eq!(
        refusal,
        Some(Refusal::BatteryLow {
            battery_mv: 2_950,
            min_mv: 3_000
        })
    );
    assert_eq!(bench.capsule.state(), CapsuleState::Unfolded);

    // Two silver-oxide cells: enough at rest, not under load.
    let mut bench = Bench::referenced();
    (bench.plant.cell, bench.plant.cell_ohm) = (3.1, 20.0);
    bench.tick();
    bench.run(Command::Fold);
    let Some(fault @ CapsuleFault::LowBattery { .. }) = bench.capsule.fault() else {
        panic!("{:?}", bench.capsule.fault())
    };
    assert_fault(&bench, fault);
    bench.plant.cell = 2.9;
    bench.tick();
    let refusal = bench.give(Event::Command(Command::Acknowledge)).refusal;
    assert_eq!(refusal, Some(Refusal::CauseStillPresent));
    bench.plant.cell = 3.9;
    bench.tick();
    bench.order(Command::Acknowledge);
    assert_eq!(bench.capsule.state(), CapsuleState::Stopped);
    assert!(bench.capsule.referenced());
}

#[test]
fn a_stop_in_mid_fold_keeps_the_position_and_either_way_goes_on() {
    for onward in [Command::Fold, Command::Unfold] {
        let mut bench = Bench::referenced();
        bench.run_past(Command::Fold, 10.0);
        let actions = bench.give(Event::Command(Command::Stop));
        assert_eq!(actions.drive, Drive::Brake);
        assert_eq!(bench.capsule.state(), CapsuleState::Stopped);
        let outcome = ActuationOutcome::Stopped;
        assert_eq!(bench.capsule.record().outcome, outcome);
        bench.settle();
        assert!(bench.plant.thread_mm() < 10.3, "{}", bench.highest_mm);
        let record_um = f64::from(bench.capsule.record().thread_um);
        // The reference puts the zero 0.2 mm into the slack, and the force is felt a little late.
        let (true_um, zero_um) = (bench.plant.thread_mm() * 1e3, 400.0);
        assert!(
            (true_um - record_um - zero_um).abs() < 150.0,
            "{record_um} um, true {true_um}"
        );
        bench.run(onward);
        let expected = match onward {
            Command::Fold => CapsuleState::Folded,
            _ => CapsuleState::Unfolded,
        };
        assert_eq!(bench.capsule.state(), expected);
        assert!(bench.lowest_mm >= 0.0 && bench.highest_mm < 22.0);
    }
}

#[test]
fn a_reversal_during_the_brake_waits_for_its_end() {
    let mut bench = Bench::referenced();
    bench.run_past(Command::Fold, 10.0);
    bench.order(Command::Stop);
    bench.order(Command::Unfold);
    let mut braked_ms = 0;
    while bench.capsule.drive() == Drive::Brake {
        bench.tick();
        braked_ms += 1;
    }
    assert_eq!(braked_ms, 40);
    bench.settle();
    assert_eq!(bench.capsule.state(), CapsuleState::Unfolded);
}

#[test]
fn link_loss_stops_and_tells_so() {
    let mut bench = Bench::referenced();
    bench.run_past(Command::Fold, 8.0);
    bench.give(Event::LinkSilent);
    assert_eq!(bench.capsule.state(), CapsuleState::Stopped);
    assert_eq!(bench.capsule.record().outcome, ActuationOutcome::LinkLost);
    bench.settle();
    assert!(bench.highest_mm < 8.3);
    let quiet = bench.give(Event::LinkSilent);
    assert!(quiet.events.is_empty(), "silence at rest is no event");
}

#[test]
fn a_stop_before_the_zero_is_found_leaves_it_unknown_and_after_it_known() {
    let mut bench = Bench::new(Plant::at(0.4));
    bench.run_past(Command::Reference, 10.0);
    bench.order(Command::Stop);
    assert_eq!(bench.capsule.state(), CapsuleState::Unreferenced);
    bench.settle();
    bench.order(Command::Reference);
    while !bench.capsule.referenced() {
        bench.tick();
    }
    bench.order(Command::Stop);
    assert_eq!(bench.capsule.state(), CapsuleState::Stopped);
}

#[test]
fn an_emergency_stop_latches_and_costs_the_reference() {
    let mut bench = Bench::referenced();
    bench.run_past(Command::Fold, 10.0);
    bench.order(Command::EStop);
    assert_eq!(bench.capsule.drive(), Drive::Brake);
    bench.settle();
    assert_fault(&bench, CapsuleFault::EStopFrame);
    bench.order(Command::EStop);
    assert_fault(&bench, CapsuleFault::EStopFrame);
    bench.order(Command::Acknowledge);
    let refusal = bench.give(Event::Command(Command::Fold)).refusal;
    assert_eq!(refusal, Some(Refusal::NotReferenced));
    bench.run(Command::Reference);
    assert_eq!(bench.capsule.state(), CapsuleState::Unfolded);
}

#[test]
fn a_clock_that_stops_cannot_keep_the_motor_on_for_ever() {
    // The samples come, the time does not: the deadline never passes, but the soft maximum does not need it.
    let mut bench = Bench::referenced();
    bench.plant.snapped = true;
    bench.order(Command::Fold);
    let now_us = bench.now_us;
    for count in 0..40_000 {
        let sample = Sample {
            counts: firmware_capsule::mechanics::Counts(count),
            current_ma: 16,
            battery_mv: 3_900,
            driver_fault: false,
        };
        bench.now_us = now_us;
        bench.give(Event::Sample(sample));
    }
    assert_eq!(bench.capsule.fault(), Some(CapsuleFault::ThreadBroken));
}

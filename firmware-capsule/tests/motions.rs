//! Motions on the model with all its effects: populations, and what a fault has to stop.
//!
//! `CASES=200 cargo test --release -p firmware-capsule --test all motions -- --nocapture` tries 200 of each population
//! and prints the tables of docs/capsule.md.
#![allow(clippy::print_stdout)]

use capsule_plant::{Defect, Parameters, Random, cases::Kind, verdict};
use firmware_capsule::machine::Event;
use firmware_capsule::speed::Drive;
use std::collections::BTreeMap;

use protocol::capsule::{ActuationOutcome, CapsuleFault, CapsuleState};
use simulated_machines::plant::{
    CALIBRATE, CHECK, ESTOP, FOLD, REFERENCE, Simulation, UNFOLD, fold_to,
};

use crate::cases;

#[test]
fn the_nominal_capsule_folds_within_its_time_and_energy() {
    let life = cases::life(Parameters::nominal(), 0, 1.0, false);
    assert_eq!(life.name, "Complete");
    assert!(life.least_mm >= 0.0 && life.left_mm < 0.1, "{life:?}");
    assert!(life.short_mm.abs() < 0.1 && life.peak_n < 6.5, "{life:?}");
    assert!(
        life.longest_ms[0] <= 4_000 && life.longest_ms[1] <= 3_200,
        "{life:?}"
    );
    assert!(
        life.energy_mj <= 350.0 && life.energy_error < 0.05,
        "{life:?}"
    );
}

/// Seeds of a population: `CASES`, or so few that everybody can wait for them.
fn seeds(few: u64) -> u64 {
    std::env::var("CASES").map_or(few, |cases| cases.parse().expect("a number of cases"))
}

/// The names with how often each came, as a cell of a table.
fn counted<'a>(names: impl Iterator<Item = &'a String>) -> String {
    let mut counts = BTreeMap::<&str, u32>::new();
    for name in names {
        *counts.entry(name).or_default() += 1;
    }
    format!("{counts:?}")
}

fn most<T>(found: &[T], of: impl Fn(&T) -> f64) -> f64 {
    found.iter().map(of).fold(f64::MIN, f64::max)
}

#[test]
fn healthy_capsules_fold_in_warmth_and_with_other_friction() {
    println!(
        "| friction, warm | how they end | least thread, mm | N | short, mm | fold, unfolding, ms | mJ | energy off, % |"
    );
    for (friction, warm) in [
        (1.0, false),
        (1.0, true),
        (0.7, false),
        (1.2, false),
        (1.4, false),
    ] {
        let lives = verdict::all(seeds(4), |seed| {
            cases::life(Parameters::lifelike(seed), seed, friction, warm)
        });
        println!(
            "| x {friction}, {warm} | {} | {:.3} | {:.1} | {:.2} | {:.0}, {:.0} | {:.0} | {:.1} |",
            counted(lives.iter().map(|life| &life.name)),
            -most(&lives, |life| -life.least_mm),
            most(&lives, |life| life.peak_n),
            most(&lives, |life| life.short_mm),
            most(&lives, |life| life.longest_ms[0].into()),
            most(&lives, |life| life.longest_ms[1].into()),
            most(&lives, |life| life.energy_mj),
            most(&lives, |life| 100.0 * life.energy_error),
        );
        let incomplete = lives.iter().filter(|life| life.name != "Complete").count();
        assert!(200 * incomplete <= lives.len(), "99.5 % are complete");
        for (seed, life) in lives.iter().enumerate() {
            let what = format!("seed {seed}, friction x {friction}: {life:?}");
            assert!(life.least_mm >= -0.05 && life.peak_n < 18.0, "{what}");
            assert!(life.short_mm <= 0.3, "{what}");
        }
    }
}

/// Each defect stops the motion, is named so that its remedy helps, and never leaves a capsule that says `Folded` and
/// is not.
#[test]
fn each_defect_is_stopped_and_named() {
    println!("{}", verdict::HEAD);
    for kind in Kind::ALL {
        let tried = verdict::all(seeds(4), |seed| cases::try_case(kind, seed));
        let verdicts: Vec<_> = tried.iter().map(|(verdict, _)| verdict.clone()).collect();
        println!("{}", verdict::row(kind, &verdicts));
        let wrong: Vec<_> = verdict::wrong(kind, &verdicts).collect();
        assert!(20 * wrong.len() <= tried.len(), "{kind:?}: {wrong:?}");
        for (seed, (verdict, least_mm)) in tried.iter().enumerate() {
            let what = format!("{kind:?}, seed {seed}: {verdict:?}, {least_mm} mm");
            assert!(verdict.short_mm.unwrap_or(0.0) <= 0.3, "{what}");
            assert!(verdict.peak_n < 18.0 && *least_mm >= -0.05, "{what}");
        }
    }
}

/// Regression: a spool that slips just before the end left folds that were 0.37 mm short and called complete.
#[test]
fn a_spool_that_slips_near_the_end_is_no_fold() {
    for seed in [39, 221] {
        let (verdict, _) = cases::try_case(Kind::Clutch, seed);
        assert_eq!(verdict.name, "SlipOrBreak", "seed {seed}: {verdict:?}");
    }
}

#[test]
fn something_in_the_way_pulls_no_more_than_18_newton_and_can_be_left() {
    let found = verdict::all(seeds(12), cases::obstacle);
    println!(
        "obstacles: {}, at most {:.1} N, `Folded` short by at most {:.2} mm; then unfold: {}",
        counted(found.iter().map(|(verdict, ..)| &verdict.name)),
        most(&found, |(verdict, ..)| verdict.peak_n),
        most(&found, |(verdict, ..)| verdict.short_mm.unwrap_or(f64::MIN)),
        counted(found.iter().map(|(_, after, _)| after)),
    );
    let stuck = found.iter().filter(|(_, after, _)| after != "Complete");
    assert!(100 * stuck.count() <= found.len(), "99 % unfold");
    for (verdict, _, least_mm) in found {
        let what = format!("{verdict:?}, {least_mm} mm");
        assert!(
            ["Jam", "Complete", "SlipOrBreak"].contains(&verdict.name.as_str()),
            "{what}"
        );
        assert!(
            verdict.peak_n < 18.0 && verdict.short_mm.unwrap_or(0.0) <= 0.3,
            "{what}"
        );
        assert!(least_mm >= -0.05, "{what}");
    }
}

/// The way out leads to an unfolded capsule, or says what needs a hand.
#[test]
fn a_cut_of_the_power_leaves_a_way_out_and_never_passes_zero() {
    let found = verdict::all(seeds(24), cases::cut);
    let unfolded = |(end, _, left_mm): &(String, f64, f64)| match end.starts_with("Unfolded") {
        true => *left_mm,
        false => f64::MIN,
    };
    println!(
        "cuts: {}, left at most {:.2} mm",
        counted(found.iter().map(|(end, ..)| end)),
        most(&found, unfolded)
    );
    for (end, least_mm, left_mm) in &found {
        let what = format!("{end}, least {least_mm} mm, left {left_mm} mm");
        assert!(*least_mm >= -0.05, "{what}");
        assert!(
            end.starts_with("Unfolded") || end.starts_with("a hand: "),
            "{what}"
        );
    }
    let untold = found
        .iter()
        .filter(|(end, _, left_mm)| end == "Unfolded" && *left_mm >= 0.6);
    assert!(
        200 * untold.count() <= found.len(),
        "99.5 % tell what is left"
    );
}

/// A reference takes for the folded end what pulls like it, but nothing that is much stiffer.
#[test]
fn a_reference_does_not_take_a_stiff_obstacle_for_the_origami() {
    for (n_per_mm, end) in [(0.0, "Complete"), (10.0, "Jam"), (100.0, "Jam")] {
        let mut sim = Simulation::calibrated(Parameters::nominal(), 0);
        let at_mm = sim.folded_mm() - sim.plant.parameters.slack_mm - 1.0;
        sim.run_past(FOLD, 12.0);
        sim.restart(None);
        sim.plant.inject(Defect::Obstacle { at_mm, n_per_mm });
        assert_eq!(cases::run(&mut sim, REFERENCE), end, "{n_per_mm} N/mm");
    }
}

/// An unfolding is slow enough at every instant for a motor without power to stop before zero.
#[test]
fn no_instant_of_an_unfolding_is_too_fast_for_a_cut() {
    for seed in [0, 78] {
        let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
        sim.run(FOLD);
        sim.order(UNFOLD);
        let mut ms = 0;
        while sim.capsule.is_moving() {
            sim.tick();
            ms += 1;
            if ms % 8 == 0 {
                let mut cut = sim.plant.clone();
                cut.set_bridge(capsule_plant::Bridge::Coast);
                cut.advance(0.6, |_| ());
                assert!(
                    cut.is_quiet() && cut.wound_mm() >= 0.0,
                    "{ms} ms: {} mm",
                    cut.wound_mm()
                );
            }
        }
    }
}

/// A thread that has slipped while it was folded is found by a check, which leaves a healthy one folded.
#[test]
fn a_check_feels_the_thread_and_stays_folded() {
    for (slip_mm, outcome) in [
        (0.0, ActuationOutcome::Complete),
        (3.0, ActuationOutcome::Faulted(CapsuleFault::SlipOrBreak)),
    ] {
        let mut sim = Simulation::calibrated(Parameters::lifelike(3), 3);
        sim.run(FOLD);
        let wound_mm = sim.plant.wound_mm();
        sim.plant.inject(Defect::Slip(slip_mm));
        sim.run(CHECK);
        assert_eq!(sim.capsule.record().outcome, outcome);
        let folded = sim.capsule.state() == CapsuleState::Folded;
        assert_eq!(folded, outcome == ActuationOutcome::Complete);
        assert!((sim.plant.wound_mm() - wound_mm).abs() < 0.1);
    }
}

/// A thread that slips a little in each cycle looks like falling friction or creep, until it pulls too little.
#[test]
fn a_thread_that_slips_little_by_little_is_named_in_the_end() {
    let mut sim = Simulation::calibrated(Parameters::nominal(), 0);
    let mut cycles = 0;
    // A fold that pulls too little is felt and named; else the unfolding behind it finds the thread slack.
    while sim.capsule.fault.is_none() && cycles < 9 {
        cases::run(&mut sim, FOLD);
        cases::run(&mut sim, UNFOLD);
        sim.plant.inject(Defect::Slip(0.25));
        cycles += 1;
    }
    let fault = sim.capsule.fault;
    assert_eq!(fault, Some(CapsuleFault::SlipOrBreak), "{cycles} cycles");
    assert!(cycles > 2 && sim.plant.extremes_mm().0 >= 0.0);
}

/// A calibration that does not begin unfolded finds the end too early, and the calibration before stays.
#[test]
fn a_calibration_that_begins_wound_is_told() {
    let parameters = Parameters {
        wound_mm: 8.0,
        ..Parameters::nominal()
    };
    let mut sim = Simulation::new(parameters, 0);
    sim.run(CALIBRATE);
    let outcome = sim.capsule.record().outcome;
    let ActuationOutcome::Faulted(CapsuleFault::NotUnfolded { wound_um }) = outcome else {
        panic!("{outcome:?}");
    };
    assert!((13_000..15_000).contains(&wound_um), "{wound_um} um");
    assert_eq!(sim.capsule.known.calibration, None);
    // It knows what it has wound.
    sim.order(Event::Acknowledge);
    sim.run(UNFOLD);
    assert!((sim.plant.wound_mm() - 8.0).abs() < 0.1);
}

/// After the brake the motor is off and the bridge sleeps, whatever has ended the motion.
#[test]
fn at_rest_the_bridge_sleeps() {
    for end in [Event::Stop, ESTOP] {
        let mut sim = Simulation::calibrated(Parameters::nominal(), 0);
        sim.run_past(FOLD, 5.0);
        let began_us = sim.now_us;
        sim.order(end);
        assert_eq!(sim.capsule.drive, Drive::Brake);
        while sim.capsule.drive == Drive::Brake {
            sim.tick();
        }
        assert_eq!(sim.now_us - began_us, 40_000);
        let wound_mm = sim.plant.wound_mm();
        sim.wait(500);
        assert_eq!(
            (sim.capsule.drive, sim.plant.wound_mm()),
            (Drive::Off, wound_mm)
        );
    }
}

/// A fold from close to its end still has the run-up in which the rise of its current is measured.
#[test]
fn a_fold_from_close_to_its_end_takes_a_run_up() {
    let mut sim = Simulation::calibrated(Parameters::nominal(), 0);
    let end_um = sim.calibration().folded.0;
    sim.run(fold_to(end_um - 500));
    sim.run(FOLD);
    assert_eq!(sim.capsule.state(), CapsuleState::Folded);
}

/// The time limit is a fault of its own.
#[test]
fn a_motion_that_takes_too_long_ends() {
    let mut sim = Simulation::calibrated(Parameters::nominal(), 0);
    sim.order(FOLD);
    let late_us = sim.now_us + 8_000_000;
    sim.capsule.step(late_us, Event::Sample(sim.capsule.sample));
    assert_eq!(sim.capsule.fault, Some(CapsuleFault::Timeout));
}

/// Motions in any order, each left alone or cut short at any instant by a stop, an emergency stop, or a reset. Nothing
/// but the count and the flash leads from one to the next.
#[test]
fn no_order_of_motions_passes_zero_or_calls_folded_what_is_not() {
    let lives = verdict::all(seeds(4), any_motions);
    let wrong: Vec<_> = lives.iter().filter(|life| life.is_err()).collect();
    println!("any order, {} lives: {wrong:?}", lives.len());
    assert!(50 * wrong.len() <= lives.len(), "{wrong:?}");
    // Regression: a reference took the first pull for the folded end, and the next fold was 0.37 mm short.
    assert_eq!(any_motions(133), Ok(()));
}

fn any_motions(seed: u64) -> Result<(), String> {
    let mut random = Random::new(seed ^ 0x0DD5);
    let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
    let end_mm = sim.folded_mm();
    for number in 0..20 {
        let command = match (random.unit() * 6.0) as u32 {
            0 | 1 => FOLD,
            2 | 3 => UNFOLD,
            4 => CHECK,
            _ => fold_to(random.between(0.0, 22e3) as i32),
        };
        let what = format!("seed {seed}, motion {number}, {command:?}");
        sim.give(command);
        if random.unit() < 0.5 {
            sim.wait(random.between(1.0, 4e3) as u32);
            match (random.unit() * 4.0) as u32 {
                0 => sim.restart(None),
                1 => sim.restart(Some(CapsuleFault::Watchdog)),
                2 => sim.order(ESTOP),
                _ => sim.order(Event::Stop),
            }
        }
        sim.settle();
        let (least_mm, wound_mm) = (sim.plant.extremes_mm().0, sim.plant.wound_mm());
        let said_mm = f64::from(sim.capsule.thread().0) / 1e3;
        let known = sim.capsule.known;
        let doubt = known.uncertainty.ok_or("the place is lost")?;
        let most_mm = said_mm + f64::from((doubt + known.remaining).0) / 1e3;
        assert!(least_mm >= -0.05, "{what}: down to {least_mm} mm");
        let peak_n = sim.plant.peak_force_n();
        assert!(peak_n <= 18.0, "{what}: {peak_n} N");
        if !(said_mm - 0.1..=most_mm + 0.5).contains(&wound_mm) {
            return Err(format!(
                "{what}: {wound_mm} mm, it says {said_mm} to {most_mm}"
            ));
        }
        if sim.capsule.state() == CapsuleState::Folded && wound_mm < end_mm - 0.3 {
            return Err(format!("{what}: folded at {wound_mm} of {end_mm} mm"));
        }
        if sim.capsule.fault.is_some() {
            sim.order(Event::Acknowledge);
        }
        if sim.capsule.state() == CapsuleState::Unreferenced {
            cases::run(&mut sim, REFERENCE);
        }
        if sim.capsule.state() == CapsuleState::Unreferenced {
            break; // it needs a hand
        }
    }
    // It leads round in no circle.
    cases::way_out(&mut sim);
    Ok(())
}

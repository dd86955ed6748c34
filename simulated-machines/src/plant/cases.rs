//! Seeded capsules with one defect each, and what the firmware made of them.

use super::Simulation;
use capsule_plant::{
    Bridge, Defect, Parameters, Random,
    cases::{Course, Kind, Motion},
    verdict::{Verdict, name},
};
use firmware_capsule::fold::{Command, Drive, Event};
use protocol::{
    capsule::{ActuationOutcome, CapsuleState},
    error::Refusal,
};

fn name_of(outcome: ActuationOutcome) -> String {
    match outcome {
        ActuationOutcome::Faulted(fault) => name(&fault),
        outcome => name(&outcome),
    }
}

/// Tries one capsule with one defect.
pub fn try_case(kind: Kind, seed: u64) -> Verdict {
    try_with(kind, seed, kind.parameters(seed))
}

/// The same with these parameters.
pub fn try_with(kind: Kind, seed: u64, parameters: Parameters) -> Verdict {
    if kind.course(seed, 0.0).motion == Motion::Calibrate {
        let mut sim = Simulation::new(parameters, seed);
        return follow(&mut sim, &kind.course(seed, 0.0), 0.0);
    }
    let mut sim = Simulation::calibrated(parameters, seed);
    let calibrated = name_of(sim.capsule.record().outcome);
    if calibrated != "Complete" {
        return Verdict {
            name: calibrated,
            took_ms: None,
            peak_n: sim.plant.peak_force_n(),
            short_mm: None,
        };
    }
    let folded = sim.capsule.calibration().expect("calibrated").folded;
    let end_mm = f64::from(folded.0) / 1e3 - parameters.slack_mm;
    follow(&mut sim, &kind.course(seed, end_mm), end_mm)
}

fn follow(sim: &mut Simulation, course: &Course, end_mm: f64) -> Verdict {
    if course.folds_first {
        sim.run(Command::Fold);
        sim.forget();
    }
    for defect in &course.defects {
        sim.plant.suffer(*defect);
    }
    for _ in 0..course.rests_ms {
        sim.tick();
    }
    match course.motion {
        Motion::Calibrate => with_defect(sim, Command::Calibrate, course.planned, end_mm),
        Motion::Fold => with_defect(sim, Command::Fold, course.planned, end_mm),
        Motion::Unfold => with_defect(sim, Command::Unfold, course.planned, end_mm),
        Motion::Cycles(cycles) => healthy(sim, cycles, end_mm),
    }
}

/// Runs a motion, and lets something happen at an instant in ms from its start.
fn with_defect(
    sim: &mut Simulation,
    command: Command,
    mut planned: Option<(f64, Defect)>,
    end_mm: f64,
) -> Verdict {
    if let Some((_, defect)) = planned.take_if(|(at_ms, _)| *at_ms < 0.0) {
        sim.plant.suffer(defect);
        sim.tick();
    }
    sim.plant.forget_extremes();
    let mut suffered_us = None;
    let refusal = sim.give(Event::Command(command)).refusal;
    let started_us = sim.now_us;
    let mut took_ms = None;
    for _ in 0..20_000 {
        if let Some((_, defect)) =
            planned.take_if(|(at_ms, _)| (sim.now_us - started_us) as f64 >= *at_ms * 1e3)
        {
            sim.plant.suffer(defect);
            suffered_us = Some(sim.now_us);
        }
        sim.tick();
        if !sim.capsule.is_moving() {
            took_ms = took_ms.or(suffered_us.map(|since_us| (sim.now_us - since_us) / 1_000));
            if sim.capsule.drive() == Drive::Off && sim.plant.speed() == 0.0 {
                break;
            }
        }
    }
    // Its zero is looked at again once it rests.
    for _ in 0..100 {
        sim.tick();
    }
    let folded = sim.capsule.state() == CapsuleState::Folded;
    Verdict {
        name: match refusal {
            None if let Some(fault) = sim.capsule.fault() => name(&fault),
            None => name_of(sim.capsule.record().outcome),
            Some(Refusal::CapsuleFaulted(fault)) => name(&fault),
            Some(refusal) => name(&refusal),
        },
        took_ms,
        peak_n: sim.plant.peak_force_n(),
        short_mm: folded.then(|| end_mm - sim.plant.travel_mm()),
    }
}

fn healthy(sim: &mut Simulation, cycles: u32, end_mm: f64) -> Verdict {
    let mut verdict = Verdict {
        name: "Complete".to_owned(),
        took_ms: None,
        peak_n: 0.0,
        short_mm: None,
    };
    for _ in 0..cycles {
        for command in [Command::Fold, Command::Unfold] {
            let this = with_defect(sim, command, None, end_mm);
            sim.settle();
            if this.name != "Complete" {
                return this;
            }
            verdict.short_mm = verdict.short_mm.or(this.short_mm);
            verdict.peak_n = verdict.peak_n.max(this.peak_n);
        }
    }
    verdict
}

/// What two cycles of a healthy capsule measure.
#[derive(Clone, Copy, Debug, Default)]
pub struct Figures {
    /// Force at the end of a fold, N, and the largest on the way.
    pub end_n: f64,
    /// Largest force, N.
    pub peak_n: f64,
    /// Recorded over true energy of a fold, less 1.
    pub energy_error: f64,
    /// Difference of the folded ends, and of the unfolded ends from zero, mm.
    pub fold_repeat_mm: f64,
    /// Largest distance of an unfolded end from zero, mm.
    pub unfold_mm: f64,
    /// Least thread on the spool, mm.
    pub lowest_mm: f64,
    /// Largest current from the cell over a PWM period, mA.
    pub peak_ma: f64,
    /// Duration of a fold and of an unfolding, ms.
    pub duration_ms: [u32; 2],
    /// True energy of them, mJ.
    pub energy_mj: [f64; 2],
}

/// Calibration and `cycles` folds and unfoldings; none if one did not complete.
pub fn figures(parameters: Parameters, seed: u64, cycles: u32) -> Option<Figures> {
    let mut sim = Simulation::new(parameters, seed);
    sim.run(Command::Calibrate);
    let mut figures = Figures {
        peak_n: sim.plant.peak_force_n(),
        ..Figures::default()
    };
    let mut ends = Vec::new();
    for _ in 0..cycles {
        for (index, command) in [Command::Fold, Command::Unfold].into_iter().enumerate() {
            let before_j = sim.plant.energy_j();
            if sim.give(Event::Command(command)).refusal.is_some() {
                return None;
            }
            sim.settle();
            let record = sim.capsule.record();
            if record.outcome != ActuationOutcome::Complete {
                return None;
            }
            let true_mj = (sim.plant.energy_j() - before_j) * 1e3;
            figures.energy_mj[index] = true_mj;
            figures.duration_ms[index] = record.duration_ms;
            if command == Command::Fold {
                figures.end_n = sim.plant.force_n();
                let error = f64::from(record.energy_mj) / true_mj - 1.0;
                if error.abs() > figures.energy_error.abs() {
                    figures.energy_error = error;
                }
                ends.push(sim.plant.wound_mm());
            } else {
                figures.unfold_mm = figures.unfold_mm.max(sim.plant.wound_mm().abs());
            }
        }
    }
    let (least, most) = ends
        .iter()
        .fold((f64::MAX, f64::MIN), |(least, most), end| {
            (least.min(*end), most.max(*end))
        });
    figures.fold_repeat_mm = most - least;
    figures.lowest_mm = sim.plant.extremes_mm().0;
    figures.peak_n = figures.peak_n.max(sim.plant.peak_force_n());
    figures.peak_ma = sim.peak_ma;
    Some(figures)
}

/// A reset while folded, then a check and an unfolding; or while unfolded, then a reference run, a fold and an unfolding.
/// Returns the least thread on the spool after the reset and the thread left at the end, mm; none if one did not complete.
pub fn found_again(seed: u64, folded: bool) -> Option<[f64; 2]> {
    found_again_with(Parameters::lifelike(seed), seed, folded)
}

/// The same with these parameters.
pub fn found_again_with(parameters: Parameters, seed: u64, folded: bool) -> Option<[f64; 2]> {
    let mut sim = Simulation::calibrated(parameters, seed);
    if folded {
        sim.run(Command::Fold);
    }
    sim.reset(folded);
    let way = [Command::CheckFolded, Command::Unfold];
    let other = [Command::Reference, Command::Fold, Command::Unfold];
    for command in if folded { &way[..] } else { &other } {
        sim.run(*command);
        if sim.capsule.record().outcome != ActuationOutcome::Complete {
            return None;
        }
    }
    Some([sim.plant.extremes_mm().0, sim.plant.wound_mm()])
}

/// Cuts the power at a random instant of a fold or of an unfolding. Returns the least thread on the spool, mm.
pub fn cut(seed: u64) -> f64 {
    let mut random = Random::new(seed);
    let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
    let (unfolds, at) = (random.unit() < 0.7, random.unit());
    if unfolds {
        sim.run(Command::Fold);
    }
    sim.order(if unfolds {
        Command::Unfold
    } else {
        Command::Fold
    });
    // An unfolding takes 1.3 s and more: as long as it lasts.
    let at_ms = (at * if unfolds { 1_300.0 } else { 1_600.0 }) as u32;
    for _ in 0..at_ms {
        sim.tick();
    }
    sim.plant.set_bridge(Bridge::Coast);
    sim.plant.advance(2.0, |_| ());
    assert!(sim.plant.is_quiet(), "it still moves");
    sim.plant.extremes_mm().0
}

/// From so late on an unfolding is at a speed from which a motor without power runs on, ms; and how often it is looked.
const RUNS_ON_FROM_MS: u32 = 150;
const LOOKS_MS: u32 = 8;

/// Cuts the power at each instant of an unfolding, 8 ms apart: in copies of the plant, which run out. Returns the least thread
/// on the spool, mm.
pub fn cut_anywhere(seed: u64) -> f64 {
    let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
    sim.run(Command::Fold);
    sim.order(Command::Unfold);
    let (mut least_mm, mut ms) = (f64::MAX, 0);
    while sim.capsule.is_moving() {
        sim.tick();
        ms += 1;
        if ms < RUNS_ON_FROM_MS || ms % LOOKS_MS != 0 {
            continue;
        }
        let mut without_power = sim.plant.clone();
        without_power.set_bridge(Bridge::Coast);
        without_power.advance(0.6, |_| ());
        assert!(without_power.is_quiet(), "it still moves");
        least_mm = least_mm.min(without_power.extremes_mm().0);
    }
    least_mm
}

/// Calibrated at room temperature, then three cycles, each at another temperature of 22 to 40 degrees: the first name that is not `Complete`,
/// the least thread on the spool, mm, and the largest force, N.
pub fn through_the_day(seed: u64, parameters: Parameters) -> (String, f64, f64) {
    let mut random = Random::new(seed ^ 0xDA15);
    let mut sim = Simulation::new(parameters, seed);
    let mut name = run(&mut sim, Command::Calibrate);
    let mut way = "Calibrate".to_owned();
    'life: for _ in 0..3 {
        for command in [Command::Fold, Command::Unfold] {
            if name != "Complete" {
                break 'life;
            }
            let celsius = random.between(22.0, 40.0);
            sim.plant.suffer(Defect::Temperature(celsius));
            name = run(&mut sim, command);
            way = format!("{command:?}");
        }
    }
    if name != "Complete" {
        name = format!("{way} {name}");
    }
    (name, sim.plant.extremes_mm().0, sim.plant.peak_force_n())
}

/// 500 cycles, of which each tenth is made and the rest only ages the capsule. The calibration is of a new one. A fold that finds its
/// end wandered is checked, as the manual says.
pub fn grows_old(seed: u64) -> (String, f64, f64) {
    let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
    for cycle in 0..50 {
        sim.plant.suffer(Defect::Aged(9.0));
        for command in [Command::Fold, Command::CheckFolded, Command::Unfold] {
            if command == Command::CheckFolded && sim.capsule.referenced() {
                continue;
            }
            let name = run(&mut sim, command);
            if name != "Complete" {
                let name = format!("{command:?} {name}");
                return (name, sim.plant.extremes_mm().0, f64::from(cycle));
            }
        }
    }
    let (least_mm, _) = sim.plant.extremes_mm();
    ("Complete".to_owned(), least_mm, sim.plant.wound_mm())
}

/// What a change in a life makes of three folds and unfoldings: the first name that is not `Complete`, the least thread on the spool,
/// mm, and how far at most a folded end is from the calibrated one, mm.
pub fn lives_on(seed: u64, changes: &[Defect]) -> (String, f64, f64) {
    lives_on_with(Parameters::lifelike(seed), seed, changes)
}

/// The same with these parameters.
pub fn lives_on_with(parameters: Parameters, seed: u64, changes: &[Defect]) -> (String, f64, f64) {
    let mut sim = Simulation::calibrated(parameters, seed);
    let Some(folded) = sim.capsule.calibration().map(|found| found.folded) else {
        return (
            format!("Calibrate {}", name_of(sim.capsule.record().outcome)),
            0.0,
            0.0,
        );
    };
    for change in changes {
        sim.plant.suffer(*change);
    }
    let mut off_mm: f64 = 0.0;
    for _ in 0..3 {
        for command in [Command::Fold, Command::Unfold] {
            let name = run(&mut sim, command);
            if command == Command::Fold && name == "Complete" {
                let end_mm = f64::from(folded.0) / 1e3;
                off_mm = off_mm.max((sim.plant.wound_mm() - end_mm).abs());
            }
            if name != "Complete" {
                return (
                    format!("{command:?} {name}"),
                    sim.plant.extremes_mm().0,
                    off_mm,
                );
            }
        }
    }
    ("Complete".to_owned(), sim.plant.extremes_mm().0, off_mm)
}

/// Folded at 22 degrees, held for an hour, unfolded at 37: friction and no-load current fall, the origami relaxes. Checked before,
/// or not; after a reset, or not. What ended it, and the least thread on the spool, mm.
pub fn held_and_warmed(seed: u64) -> (String, f64) {
    let mut random = Random::new(seed ^ 0x3700);
    let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
    sim.run(Command::Fold);
    sim.plant.suffer(Defect::Temperature(37.0));
    sim.plant.rest(3_600.0);
    let (resets, checks) = (random.unit() < 0.3, random.unit() < 0.5);
    if resets {
        sim.reset(true);
    }
    let mut way = Vec::new();
    if resets || checks {
        way.push(Command::CheckFolded);
    }
    way.extend([Command::Unfold, Command::Fold, Command::Unfold]);
    for command in way {
        let name = run(&mut sim, command);
        if name != "Complete" {
            return (format!("{command:?} {name}"), sim.plant.extremes_mm().0);
        }
    }
    ("Complete".to_owned(), sim.plant.extremes_mm().0)
}

/// A reference run from anywhere, past something of 0.5 to 300 N/mm anywhere, or nothing. What ended it, and the least thread on the
/// spool, mm.
pub fn referenced_past(seed: u64, obstacle: bool) -> (String, f64) {
    let mut random = Random::new(seed ^ 0x0B57);
    let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
    let Some(calibration) = sim.capsule.calibration() else {
        return (
            format!("Calibrate {}", name_of(sim.capsule.record().outcome)),
            0.0,
        );
    };
    let folded = f64::from(calibration.folded.0) / 1e3;
    match random.unit() {
        ..0.4 => {}
        ..0.6 => sim.run(Command::Fold),
        _ => {
            sim.run_past(Command::Fold, random.between(1.0, folded - 0.5));
            sim.order(Command::Stop);
            sim.settle();
        }
    }
    sim.reset(false);
    if obstacle {
        let travel_mm = sim.plant.travel_mm();
        let end_mm = folded - sim.plant.parameters.slack_mm;
        sim.plant.suffer(Defect::Obstacle {
            at_mm: random.between(travel_mm, end_mm),
            n_per_mm: 0.5 * 600_f64.powf(random.unit()),
        });
    }
    let name = run(&mut sim, Command::Reference);
    (name, sim.plant.extremes_mm().0)
}

/// Orders something and waits for its end: how it ended, or why it was refused.
fn run(sim: &mut Simulation, command: Command) -> String {
    if let Some(refusal) = sim.give(Event::Command(command)).refusal {
        return name(&refusal);
    }
    sim.settle();
    name_of(sim.capsule.record().outcome)
}

//! Seeded capsules with one defect each, and the firmware's verdict on them.

use super::Simulation;
use capsule_plant::{
    Bridge, Defect, Parameters, Random,
    cases::{Course, Kind, Motion},
    verdict::{Verdict, name},
};
use firmware_capsule::fold::{Capsule, Command, Drive, Event};
use firmware_capsule::mechanics::Thread;
use firmware_capsule::settings::Settings;
use protocol::{
    capsule::{ActuationOutcome, CapsuleFault, CapsuleState},
    error::Refusal,
};

fn name_of(outcome: ActuationOutcome) -> String {
    match outcome {
        ActuationOutcome::Faulted(fault) => name(&fault),
        outcome => name(&outcome),
    }
}

/// Runs a seeded capsule with one defect.
pub fn try_case(kind: Kind, seed: u64) -> Verdict {
    try_with(kind, seed, kind.parameters(seed))
}

/// As [`try_case`], with these parameters.
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

/// Runs a motion and injects a defect this many ms after its start; negative: before it.
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
    // Give the firmware time to check the amplifier's zero at rest.
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

/// Figures from cycles of a healthy capsule.
#[derive(Clone, Copy, Debug, Default)]
pub struct Figures {
    /// Force at the end of the last fold, N.
    pub end_n: f64,
    /// Largest force, N.
    pub peak_n: f64,
    /// Recorded energy of a fold over its true energy, less 1: the worst of all folds.
    pub energy_error: f64,
    /// Spread of the folded ends, mm.
    pub fold_repeat_mm: f64,
    /// Largest distance of an unfolded end from zero, mm.
    pub unfold_mm: f64,
    /// Least thread on the spool, mm.
    pub lowest_mm: f64,
    /// Largest current from the cell over a PWM period, mA.
    pub peak_ma: f64,
    /// Durations of a fold and an unfolding, ms.
    pub duration_ms: [u32; 2],
    /// True energies of a fold and an unfolding, mJ.
    pub energy_mj: [f64; 2],
}

/// Runs a calibration and `cycles` folds and unfoldings; none if one did not complete.
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

/// Resets a folded capsule, then checks and unfolds it; or resets an unfolded one, then references, folds and unfolds
/// it. Returns the least thread on the spool after the reset and the thread left at the end, mm; none if a motion did
/// not complete.
pub fn found_again(parameters: Parameters, seed: u64, folded: bool) -> Option<[f64; 2]> {
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
    // An unfolding takes at least 1.3 s, so every instant of it can be hit.
    let at_ms = (at * if unfolds { 1_300.0 } else { 1_600.0 }) as u32;
    for _ in 0..at_ms {
        sim.tick();
    }
    sim.plant.set_bridge(Bridge::Coast);
    sim.plant.advance(2.0, |_| ());
    assert!(sim.plant.is_quiet(), "it still moves");
    sim.plant.extremes_mm().0
}

/// From this time on, an unfolding is fast enough for the motor to coast after a power cut, ms. Then the interval of
/// trial cuts.
const RUNS_ON_FROM_MS: u32 = 150;
const LOOKS_MS: u32 = 8;

/// Cuts the power every 8 ms of an unfolding, each time in a copy of the plant that then coasts to rest. Returns the
/// least thread on the spool, mm.
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

/// Calibrates at room temperature, then runs three cycles with every motion at a random temperature of 22 to 40
/// degrees. Returns the first outcome that is not `Complete`, the least thread on the spool, mm, and the largest
/// force, N.
pub fn through_the_day(seed: u64, parameters: Parameters) -> (String, f64, f64) {
    let mut random = Random::new(seed ^ 0xDA15);
    let mut sim = Simulation::new(parameters, seed);
    let mut name = completed(&mut sim, [Command::Calibrate]);
    for command in [Command::Fold, Command::Unfold].repeat(3) {
        if name != "Complete" {
            break;
        }
        let celsius = random.between(22.0, 40.0);
        sim.plant.suffer(Defect::Temperature(celsius));
        name = completed(&mut sim, [command]);
    }
    (name, sim.plant.extremes_mm().0, sim.plant.peak_force_n())
}

/// Ages a capsule by ten cycles in each of `rounds`, the last of which it runs, with the calibration of the new
/// capsule. Checks a fold whose end has wandered, as the manual says. Returns the first outcome that is not
/// `Complete`, the least thread on the spool, mm, and the largest force at a folded end, N.
pub fn grows_old(seed: u64, rounds: u32) -> (String, f64, f64) {
    let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
    let (mut outcome, mut most_n) = ("Complete".to_owned(), 0.0_f64);
    'life: for _ in 0..rounds {
        sim.plant.suffer(Defect::Aged(9.0));
        for command in [Command::Fold, Command::CheckFolded, Command::Unfold] {
            if command == Command::CheckFolded && sim.capsule.referenced() {
                continue;
            }
            outcome = completed(&mut sim, [command]);
            if command != Command::Unfold {
                most_n = most_n.max(sim.plant.force_n());
            }
            if outcome != "Complete" {
                break 'life;
            }
        }
    }
    (outcome, sim.plant.extremes_mm().0, most_n)
}

/// Applies changes to a calibrated capsule, then folds and unfolds it three times. Returns the first outcome that is
/// not `Complete`, the least thread on the spool, mm, and the largest distance of a folded end from the calibrated
/// one, mm.
pub fn lives_on(parameters: Parameters, seed: u64, changes: &[Defect]) -> (String, f64, f64) {
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
    let (mut name, mut off_mm) = ("Complete".to_owned(), 0.0_f64);
    for command in [Command::Fold, Command::Unfold].repeat(3) {
        name = completed(&mut sim, [command]);
        if name != "Complete" {
            break;
        }
        if command == Command::Fold {
            let end_mm = f64::from(folded.0) / 1e3;
            off_mm = off_mm.max((sim.plant.wound_mm() - end_mm).abs());
        }
    }
    (name, sim.plant.extremes_mm().0, off_mm)
}

/// Changes the friction of a calibrated capsule, folds and unfolds it, references it where it is, and folds and unfolds
/// it again. Returns the first outcome that is not `Complete` and the least thread on the spool, mm.
pub fn referenced_again(seed: u64, friction: f64) -> (String, f64) {
    let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
    sim.plant.suffer(Defect::Friction(friction));
    let way = [
        Command::Fold,
        Command::Unfold,
        Command::Reference,
        Command::Fold,
        Command::Unfold,
    ];
    (completed(&mut sim, way), sim.plant.extremes_mm().0)
}

/// Folds at 22 degrees, holds for an hour and unfolds at 37: friction and no-load current fall, the origami relaxes.
/// Some seeds reset in between, some check first. Returns the outcome and the least thread on the spool, mm.
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
    (completed(&mut sim, way), sim.plant.extremes_mm().0)
}

/// References from a random position, past an obstacle of 0.5 to 300 N/mm at a random place, or past none. Returns
/// the outcome and the least thread on the spool, mm.
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

/// References past an obstacle of 0.5 to 300 N/mm in the last 4 mm of the way, and folds if that completes. Returns the
/// capsule, and the outcome if it is another.
fn folded_past(seed: u64) -> (Simulation, Option<String>) {
    let mut random = Random::new(seed ^ 0x5807);
    let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
    let folded = sim.capsule.calibration().map_or(0, |one| one.folded.0);
    let end_mm = f64::from(folded) / 1e3 - sim.plant.parameters.slack_mm;
    sim.reset(false);
    sim.plant.suffer(Defect::Obstacle {
        at_mm: end_mm - random.between(0.0, 4.0),
        n_per_mm: 0.5 * 600_f64.powf(random.unit()),
    });
    let name = run(&mut sim, Command::Reference);
    if name != "Complete" {
        return (sim, Some(name));
    }
    let name = run(&mut sim, Command::Fold);
    let other = (name != "Complete").then(|| format!("then {name}"));
    (sim, other)
}

/// Folds past something in the last 4 mm of the way. Returns the outcome and by how much the fold is shorter than one
/// without it, mm.
pub fn referenced_short(seed: u64) -> (String, f64) {
    let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
    run(&mut sim, Command::Fold);
    let whole_mm = sim.plant.wound_mm();
    match folded_past(seed) {
        (sim, None) => ("Complete".to_owned(), whole_mm - sim.plant.wound_mm()),
        (_, Some(name)) => (name, 0.0),
    }
}

/// Folds past something in the last 4 mm of the way, resets, checks and unfolds. Returns the outcome and the least thread
/// on the spool, mm.
pub fn checked_short(seed: u64) -> (String, f64) {
    let (mut sim, other) = folded_past(seed);
    if let Some(name) = other {
        return (name, 0.0);
    }
    sim.reset(true);
    let name = completed(&mut sim, [Command::CheckFolded, Command::Unfold]);
    (name, sim.plant.extremes_mm().0)
}

/// Ends a motion, or the second after it, at a random instant by a cut of the power, a watchdog, an emergency stop or a
/// silent host, then follows the manual's way out. Returns its end, the least thread on the spool and the thread left
/// on it, mm.
pub fn rescued(seed: u64) -> (String, f64, f64) {
    let mut random = Random::new(seed ^ 0x4E5C);
    let parameters = Parameters::lifelike(seed);
    let (mut sim, motion) = match random.unit() {
        ..0.1 => (Simulation::new(parameters, seed), Command::Calibrate),
        unit => {
            let mut sim = Simulation::calibrated(parameters, seed);
            if unit < 0.6 {
                sim.run(Command::Fold);
            } else if unit < 0.75 {
                sim.run(Command::FoldTo(Thread(random.between(3e3, 15e3) as i32)));
            }
            let unfolded = sim.capsule.state() == CapsuleState::Unfolded;
            let folded = sim.capsule.state() == CapsuleState::Folded;
            let motion = match random.unit() {
                ..0.4 if unfolded => Command::Fold,
                ..0.4 => Command::Unfold,
                ..0.7 => Command::CheckFolded,
                ..0.85 if folded => Command::FoldTo(Thread(8_000)),
                ..0.85 => Command::Fold,
                _ => Command::Reference,
            };
            (sim, motion)
        }
    };
    sim.order(motion);
    let (at_ms, after_ms) = (random.between(0.0, 5_000.0), random.between(0.0, 1_000.0));
    let (mut ms, mut rests_ms) = (0.0, 0.0);
    while ms < at_ms && rests_ms < after_ms {
        sim.tick();
        ms += 1.0;
        rests_ms += f64::from(u8::from(!sim.capsule.is_moving()));
    }
    let restart = match random.unit() {
        ..0.4 => Some(None),
        ..0.6 => Some(Some(CapsuleFault::Watchdog)),
        ..0.8 => {
            sim.give(Event::Command(Command::EStop));
            None
        }
        _ => {
            sim.give(Event::LinkSilent);
            None
        }
    };
    if let Some(fault) = restart {
        // The flash knows of a folded end half a second after it.
        let was_folded = rests_ms > 540.0 && sim.capsule.state() == CapsuleState::Folded;
        sim.plant.set_bridge(Bridge::Coast);
        sim.plant.advance(2.0, |_| ());
        let folded = was_folded.then(|| sim.capsule.margin());
        sim.reset(was_folded);
        sim.capsule = Capsule::new(fault, sim.kept, folded, Settings::REFERENCE);
        sim.tick();
    } else {
        sim.settle();
    }
    (
        way_out(&mut sim),
        sim.plant.extremes_mm().0,
        sim.plant.wound_mm(),
    )
}

/// The manual's way from any state to unfolded. Returns `Unfolded`, or the fault that needs a hand.
pub fn way_out(sim: &mut Simulation) -> String {
    let mut faults = 0;
    loop {
        let command = match sim.capsule.state() {
            CapsuleState::Unfolded => return "Unfolded".to_owned(),
            CapsuleState::Folded | CapsuleState::Stopped => Command::Unfold,
            CapsuleState::WasFolded => Command::CheckFolded,
            CapsuleState::Unreferenced if sim.capsule.calibration().is_none() => {
                return "a hand: NotCalibrated".to_owned();
            }
            CapsuleState::Unreferenced => Command::Reference,
            CapsuleState::Faulted => {
                faults += 1;
                if faults > 2 {
                    return format!("a hand: {}", name_of(sim.capsule.record().outcome));
                }
                Command::Acknowledge
            }
            moving => panic!("{moving:?} at rest"),
        };
        if let Some(refusal) = sim.give(Event::Command(command)).refusal {
            return format!("a hand: {}", name(&refusal));
        }
        sim.settle();
    }
}

/// Gives one command after the other. Returns the first that does not complete with its outcome, or `Complete`.
fn completed(sim: &mut Simulation, commands: impl IntoIterator<Item = Command>) -> String {
    for command in commands {
        let name = run(sim, command);
        if name != "Complete" {
            return format!("{command:?} {name}");
        }
    }
    "Complete".to_owned()
}

/// Gives a command and waits for its end. Returns the outcome or the refusal.
fn run(sim: &mut Simulation, command: Command) -> String {
    if let Some(refusal) = sim.give(Event::Command(command)).refusal {
        return name(&refusal);
    }
    sim.settle();
    name_of(sim.capsule.record().outcome)
}

//! Seeded capsules and what becomes of them: healthy lives, one defect each, something in
//! the way, a cut of the power.

use capsule_plant::{
    Defect, Parameters, Random,
    cases::{Kind, Motion},
    verdict::{Verdict, name},
};
use firmware_capsule::machine::Event;
use firmware_capsule::speed::Drive;
use protocol::{
    capsule::{ActuationOutcome, CapsuleFault, CapsuleState},
    error::Refusal,
};
use simulated_machines::plant::{CALIBRATE, CHECK, FOLD, REFERENCE, Simulation, UNFOLD, fold_to};

/// Largest thread that is told as left on the spool without a hand, mm.
const LEFT_MM: f64 = 0.3;

fn name_of(outcome: ActuationOutcome) -> String {
    match outcome {
        ActuationOutcome::Faulted(fault) => name(&fault),
        outcome => name(&outcome),
    }
}

/// Gives a command and waits for its end. Returns the outcome or the refusal.
pub(crate) fn run(sim: &mut Simulation, command: Event) -> String {
    if let Some(refusal) = sim.give(command).refusal {
        return name(&refusal);
    }
    sim.settle();
    name_of(sim.capsule.record().outcome)
}

/// Cycles of a healthy capsule.
#[derive(Clone, Debug, Default)]
pub(crate) struct Life {
    /// The first outcome that is not `Complete`.
    pub(crate) name: String,
    /// Least thread on the spool, and most at an unfolded end, mm.
    pub(crate) least_mm: f64,
    /// See `least_mm`.
    pub(crate) left_mm: f64,
    /// Largest force, N.
    pub(crate) peak_n: f64,
    /// Most by which a fold was shorter than the calibrated one, mm.
    pub(crate) short_mm: f64,
    /// Longest fold and unfolding, ms.
    pub(crate) longest_ms: [u32; 2],
    /// Most energy of a fold, mJ.
    pub(crate) energy_mj: f64,
    /// Recorded energy of a fold over its true energy, less 1: the worst.
    pub(crate) energy_error: f64,
}

/// Calibrates at room temperature, then changes the friction and folds and unfolds three times, each motion at a random
/// temperature of 22 to 40 degrees if `warm`.
pub(crate) fn life(parameters: Parameters, seed: u64, friction: f64, warm: bool) -> Life {
    let mut random = Random::new(seed ^ 0xDA15);
    let mut sim = Simulation::new(parameters, seed);
    let mut life = Life {
        name: run(&mut sim, CALIBRATE),
        short_mm: f64::MIN,
        ..Life::default()
    };
    if life.name != "Complete" {
        return life;
    }
    sim.plant.inject(Defect::Friction(friction));
    for command in [FOLD, UNFOLD].repeat(3) {
        if warm {
            sim.plant
                .inject(Defect::Temperature(random.between(22.0, 40.0)));
        }
        let before_j = sim.plant.energy_j();
        life.name = run(&mut sim, command);
        if life.name != "Complete" {
            life.name = format!(
                "{} {}",
                if command == FOLD { "Fold" } else { "Unfold" },
                life.name
            );
            break;
        }
        let (record, wound_mm) = (sim.capsule.record(), sim.plant.wound_mm());
        let [fold_ms, unfold_ms] = &mut life.longest_ms;
        if command == FOLD {
            let true_mj = (sim.plant.energy_j() - before_j) * 1e3;
            let error = f64::from(record.energy_mj) / true_mj - 1.0;
            life.energy_mj = life.energy_mj.max(true_mj);
            life.energy_error = life.energy_error.max(error.abs());
            life.short_mm = life.short_mm.max(sim.folded_mm() - wound_mm);
            *fold_ms = (*fold_ms).max(record.duration_ms);
        } else {
            life.left_mm = life.left_mm.max(wound_mm);
            *unfold_ms = (*unfold_ms).max(record.duration_ms);
        }
    }
    (life.least_mm, life.peak_n) = (sim.plant.extremes_mm().0, sim.plant.peak_force_n());
    life
}

/// The firmware's verdict on a seeded capsule with one defect, and the least thread on its spool, mm. A thread that does
/// not hold counts as 20 mm short.
pub(crate) fn try_case(kind: Kind, seed: u64) -> (Verdict, f64) {
    let parameters = kind.parameters(seed);
    let mut sim = Simulation::new(parameters, seed);
    let calibrates = kind.scenario(seed, 0.0).motion == Motion::Calibrate;
    let mut verdict = Verdict {
        name: "Complete".to_owned(),
        took_ms: None,
        peak_n: 0.0,
        short_mm: None,
    };
    let mut end_mm = 0.0;
    if !calibrates {
        verdict.name = run(&mut sim, CALIBRATE);
        if verdict.name != "Complete" {
            return (verdict, sim.plant.extremes_mm().0);
        }
        end_mm = sim.folded_mm() - parameters.slack_mm;
    }
    let scenario = kind.scenario(seed, end_mm);
    if scenario.folds_first {
        run(&mut sim, FOLD);
    }
    for defect in &scenario.defects {
        sim.plant.inject(*defect);
    }
    sim.wait(scenario.rests_ms);
    sim.plant.forget_extremes();
    let commands = match scenario.motion {
        Motion::Calibrate => vec![CALIBRATE],
        Motion::Fold => vec![FOLD],
        Motion::Unfold => vec![UNFOLD],
        Motion::Cycles(cycles) => [FOLD, UNFOLD].repeat(cycles as usize),
    };
    for command in commands {
        with_defect(&mut sim, command, scenario.planned, &mut verdict);
        if sim.capsule.state() == CapsuleState::Folded {
            let holds = sim.plant.force_n() > 0.5;
            let short_mm = if holds {
                end_mm - sim.plant.travel_mm()
            } else {
                20.0
            };
            verdict.short_mm = Some(verdict.short_mm.map_or(short_mm, |most| most.max(short_mm)));
        }
        if verdict.name != "Complete" {
            break;
        }
    }
    verdict.peak_n = sim.plant.peak_force_n();
    (verdict, sim.plant.extremes_mm().0)
}

/// Runs a motion and injects a defect this many ms after its start; negative: before it.
fn with_defect(
    sim: &mut Simulation,
    command: Event,
    mut planned: Option<(f64, Defect)>,
    verdict: &mut Verdict,
) {
    if let Some((_, defect)) = planned.take_if(|(at_ms, _)| *at_ms < 0.0) {
        sim.plant.inject(defect);
        sim.tick();
    }
    let mut suffered_us = None;
    let refusal = sim.give(command).refusal;
    let started_us = sim.now_us;
    for _ in 0..60_000 {
        let ms = (sim.now_us - started_us) as f64 / 1e3;
        if let Some((_, defect)) = planned.take_if(|(at_ms, _)| ms >= *at_ms) {
            sim.plant.inject(defect);
            suffered_us = Some(sim.now_us);
        }
        sim.tick();
        if !sim.capsule.is_moving() {
            let took_ms = suffered_us.map(|since_us| (sim.now_us - since_us) / 1_000);
            verdict.took_ms = verdict.took_ms.or(took_ms);
            if sim.capsule.drive == Drive::Off && sim.plant.speed() == 0.0 {
                break;
            }
        }
    }
    // Give the firmware time to check the amplifier's zero at rest.
    sim.wait(100);
    verdict.name = match refusal {
        None if let Some(fault) = sim.capsule.fault => name(&fault),
        None => name_of(sim.capsule.record().outcome),
        Some(Refusal::CapsuleFaulted(fault)) => name(&fault),
        Some(refusal) => name(&refusal),
    };
}

/// Folds with something of 0.3 to 300 N/mm in the way at a random place, then acknowledges and unfolds. Returns the
/// verdict on the fold, the outcome of the unfolding, and the least thread on the spool, mm.
pub(crate) fn obstacle(seed: u64) -> (Verdict, String, f64) {
    let mut random = Random::new(seed ^ 0x0B5A);
    let mut sim = Simulation::calibrated(Parameters::lifelike(seed), seed);
    let end_mm = sim.folded_mm() - sim.plant.parameters.slack_mm;
    sim.plant.inject(Defect::Obstacle {
        at_mm: random.between(0.5, end_mm),
        n_per_mm: 0.3 * 1_000_f64.powf(random.unit()),
    });
    let name = run(&mut sim, FOLD);
    let folded = sim.capsule.state() == CapsuleState::Folded;
    let short_mm = folded.then(|| end_mm - sim.plant.travel_mm());
    if sim.capsule.fault.is_some() {
        sim.order(Event::Acknowledge);
    }
    let after = run(&mut sim, UNFOLD);
    let verdict = Verdict {
        name,
        took_ms: None,
        peak_n: sim.plant.peak_force_n(),
        short_mm,
    };
    (verdict, after, sim.plant.extremes_mm().0)
}

/// Cuts the power at a random instant of a random motion, or lets the watchdog reset the chip, then follows the manual's
/// way out. Returns its end, the least thread on the spool and the thread left on it, mm.
pub(crate) fn cut(seed: u64) -> (String, f64, f64) {
    let mut random = Random::new(seed ^ 0xC077);
    let unit = random.unit();
    let mut sim = Simulation::new(Parameters::lifelike(seed), seed);
    let mut motion = CALIBRATE;
    if unit >= 0.05 {
        sim.run(CALIBRATE);
        if unit < 0.5 {
            sim.run(FOLD);
        } else if unit < 0.65 {
            sim.run(fold_to(random.between(3e3, 15e3) as i32));
        }
        let state = sim.capsule.state();
        motion = match random.unit() {
            ..0.6 if state == CapsuleState::Unfolded => FOLD,
            ..0.6 => UNFOLD,
            ..0.7 if state == CapsuleState::Folded => CHECK,
            ..0.85 if state == CapsuleState::Folded => fold_to(8_000),
            ..0.85 => FOLD,
            _ if state == CapsuleState::Folded => CHECK,
            _ => fold_to(16_500),
        };
    }
    sim.forget();
    sim.order(motion);
    let mut probe = sim.clone();
    let mut lasts_ms = 0;
    while probe.capsule.is_moving() {
        probe.tick();
        lasts_ms += 1;
    }
    sim.wait((random.unit() * f64::from(lasts_ms)) as u32);
    sim.restart((random.unit() < 0.2).then_some(CapsuleFault::Watchdog));
    let end = way_out(&mut sim);
    (end, sim.plant.extremes_mm().0, sim.plant.wound_mm())
}

/// The manual's way from any state to unfolded. Returns `Unfolded`, or what needs a hand.
///
/// # Panics
/// It leads round in a circle.
pub(crate) fn way_out(sim: &mut Simulation) -> String {
    for _ in 0..12 {
        let state = sim.capsule.state();
        let command = match state {
            CapsuleState::Unfolded => {
                let left_mm = f64::from(sim.capsule.known.remaining.0) / 1e3;
                return if left_mm > LEFT_MM {
                    "Unfolded, left told"
                } else {
                    "Unfolded"
                }
                .to_owned();
            }
            CapsuleState::Folded | CapsuleState::Stopped => UNFOLD,
            CapsuleState::Unreferenced if sim.capsule.known.calibration.is_none() => {
                return "a hand: NotCalibrated".to_owned();
            }
            CapsuleState::Unreferenced => REFERENCE,
            CapsuleState::Faulted => Event::Acknowledge,
            moving => panic!("{moving:?} at rest"),
        };
        let end = match command {
            Event::Acknowledge => {
                sim.order(command);
                continue;
            }
            command => run(sim, command),
        };
        if end != "Complete" && sim.capsule.state() == state {
            return format!("a hand: {end}");
        }
        if end != "Complete" && command == REFERENCE {
            // Its fault is latched. A person acknowledges it, and is told to unfold.
            sim.give(Event::Acknowledge);
            let end = format!("a hand: {end}");
            run(sim, UNFOLD);
            return end;
        }
    }
    panic!("no way out of {:?}", sim.capsule.state());
}

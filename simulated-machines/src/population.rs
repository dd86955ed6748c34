//! Seeded capsules with the firmware's own control: folds, unfolds and identifies them.

use crate::plant::Simulation;
use capsule_plant::Parameters;
use firmware_capsule::fold::Command;
use firmware_capsule::trace::Recording;
use lab::trials::identify::{Estimate, Identified, IdentifyError, REST_S, identify};
use protocol::capsule::{ActuationOutcome, GetTrace, TracePoint};

/// Runs a motion and returns its trace, fetched in parts as the host does.
fn recorded(sim: &mut Simulation, command: Command) -> Vec<TracePoint> {
    let mut recording = Recording::new();
    sim.order(command);
    while sim.capsule.is_moving() {
        let (sample, drive) = sim.tick();
        recording.take(1, &sample, drive);
    }
    assert_eq!(sim.capsule.record().outcome, ActuationOutcome::Complete);
    sim.settle();
    let mut points: Vec<TracePoint> = vec![];
    loop {
        let from = points.len() as u32;
        let part = recording.part(&GetTrace { from }, sim.capsule.zero());
        points.extend(&part.points);
        if points.len() == usize::from(part.total) {
            return points;
        }
    }
}

/// Traces of a fold, after the rest that an identification asks for, and of the unfolding after it.
pub fn recordings(truth: Parameters, seed: u64) -> [Vec<TracePoint>; 2] {
    let mut sim = Simulation::calibrated(truth, seed);
    for _ in 0..REST_S * 1_000 {
        sim.tick();
    }
    [Command::Fold, Command::Unfold].map(|command| recorded(&mut sim, command))
}

/// A parameter's name, true value and estimate.
pub type Found = (&'static str, f64, Estimate);

/// Identifies the capsule of a seed, with all effects.
///
/// # Errors
/// Its readings fit no capsule of the design.
pub fn tried(seed: u64) -> Result<Vec<Found>, IdentifyError> {
    let truth = Parameters::lifelike(seed);
    let [fold, unfold] = recordings(truth, seed);
    let Identified {
        circuit_ohm,
        motor_constant_mvs,
        no_load_ma,
        worm_friction,
        stiffness,
        slack_mm,
    } = identify(&fold, &unfold)?;
    let ohm = truth.winding_ohm + truth.bridge_ohm + truth.battery_ohm;
    Ok(vec![
        ("circuit_ohm", ohm, circuit_ohm),
        (
            "motor_constant_mvs",
            truth.motor_constant * 1e3,
            motor_constant_mvs,
        ),
        ("no_load_ma", truth.no_load_a * 1e3, no_load_ma),
        ("worm_friction", truth.worm_friction, worm_friction),
        ("stiffness", truth.stiffness, stiffness),
        ("slack_mm", truth.slack_mm, slack_mm),
    ])
}

/// Names of the parameters whose true value lies outside the estimate's uncertainty.
pub fn missed(found: &[Found]) -> Vec<&'static str> {
    found
        .iter()
        .filter(|(_, truth, estimate)| (estimate.value - truth).abs() > estimate.uncertainty)
        .map(|(name, ..)| *name)
        .collect()
}

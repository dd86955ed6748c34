//! The capsule in the bench's time: the model of `capsule-plant`, with faults at an instant, and the chip's supply.

use capsule_plant::{BATTERY_DIVIDER, Plant};
pub use capsule_plant::{Bridge, Defect, Parameters};

use crate::faults::{Faults, When};

/// Output of the chip's linear regulator, mV, while the battery is above it.
const REGULATED_MV: f64 = 3_300.0;
/// Dropout of the regulator on an empty battery, mV: its pass transistor's 5 ohm at the chip's 10 mA [assumed].
const DROPOUT_MV: f64 = 50.0;
/// Time constant of the same resistance with 10 uF behind it, s [assumed].
const SUPPLY_FILTER: f64 = 50e-6;
/// Longest step of the integration, ns.
const STEP_NS: u64 = 20_000;
/// Interval at which a moving motor is sampled, ns.
const SAMPLE_NS: u64 = 50_000;

/// The capsule.
#[derive(Debug)]
pub struct Capsule {
    plant: Plant,
    now_ns: u64,
    awake: bool,
    supply_mv: f64,
    encoder: (bool, bool),
    flash_moving: u64,
    /// When the motor was first driven since [`Capsule::forget_drive`].
    driven_ns: Option<u64>,
    faults: Faults<Defect>,
}

impl Capsule {
    /// A capsule at rest, its driver asleep.
    #[must_use]
    pub fn new(parameters: Parameters) -> Self {
        let plant = Plant::new(parameters);
        Self {
            encoder: plant.encoder(),
            plant,
            now_ns: 0,
            awake: false,
            supply_mv: REGULATED_MV,
            flash_moving: 0,
            driven_ns: None,
            faults: Faults::default(),
        }
    }

    /// Its mechanics.
    #[must_use]
    pub fn plant(&self) -> &Plant {
        &self.plant
    }

    /// Its mechanics, mutable, at the present instant.
    pub fn plant_mut(&mut self) -> &mut Plant {
        &mut self.plant
    }

    /// Thread on the spool, mm.
    #[must_use]
    pub fn wound_mm(&self) -> f64 {
        self.plant.wound_mm()
    }

    /// Travel of the fold, mm: the thread beyond its slack.
    #[must_use]
    pub fn travel_mm(&self) -> f64 {
        self.plant.travel_mm()
    }

    /// Force in the thread, N.
    #[must_use]
    pub fn force_n(&self) -> f64 {
        self.plant.force_n()
    }

    /// Largest force so far, N.
    #[must_use]
    pub fn peak_force_n(&self) -> f64 {
        self.plant.peak_force_n()
    }

    /// Least and most thread on the spool so far, mm.
    #[must_use]
    pub fn extremes_mm(&self) -> (f64, f64) {
        self.plant.extremes_mm()
    }

    /// Energy that the motor has taken from the battery so far, J.
    #[must_use]
    pub fn energy_j(&self) -> f64 {
        self.plant.energy_j()
    }

    /// Whether the bridge is awake.
    #[must_use]
    pub fn is_awake(&self) -> bool {
        self.awake
    }

    /// Whether the motor turns.
    #[must_use]
    pub fn is_moving(&self) -> bool {
        self.plant.speed() != 0.0
    }

    /// When the motor was first driven, either way, since [`Capsule::forget_drive`].
    #[must_use]
    pub fn driven_ns(&self) -> Option<u64> {
        self.driven_ns
    }

    /// Forgets the first drive: the next one counts as the first.
    pub fn forget_drive(&mut self) {
        self.driven_ns = None;
    }

    /// Number of erasures begun while the motor turned. Writing a record of the position is allowed then.
    #[must_use]
    pub fn flash_moving(&self) -> u64 {
        self.flash_moving
    }

    /// Voltage at the current amplifier's output, mV.
    #[must_use]
    pub fn sense_mv(&self) -> f64 {
        self.plant.sense_mv(self.supply_mv())
    }

    /// Supply and analog reference of the chip, mV.
    #[must_use]
    pub fn supply_mv(&self) -> f64 {
        if self.plant.is_quiet() {
            self.regulated_mv()
        } else {
            self.supply_mv
        }
    }

    fn regulated_mv(&self) -> f64 {
        (self.plant.terminal_mv() - DROPOUT_MV).clamp(0.0, REGULATED_MV)
    }

    /// Voltage at the battery's divider, mV.
    #[must_use]
    pub fn battery_mv(&self) -> f64 {
        self.plant.seen_battery_mv() / BATTERY_DIVIDER
    }

    /// Voltage at the battery's terminals, mV.
    #[must_use]
    pub fn battery_terminal_mv(&self) -> f64 {
        self.plant.terminal_mv()
    }

    /// Level of the driver's fault output, low while there is a fault.
    #[must_use]
    pub fn fault_high(&self) -> bool {
        self.plant.fault_high()
    }

    /// The encoder's outputs A and B.
    #[must_use]
    pub fn encoder(&self) -> (bool, bool) {
        self.plant.encoder()
    }

    /// Plans a defect; a capsule has no step edges, only instants.
    pub fn plan(&mut self, at_ns: u64, defect: Defect) {
        self.faults.plan(When::At(at_ns), defect);
    }

    /// Applies a defect now.
    pub fn inject(&mut self, defect: Defect) {
        self.plant.inject(defect);
    }

    /// The bridge's inputs have changed. Call after [`Capsule::advance`] to the present instant.
    pub fn drive(&mut self, awake: bool, in1: bool, in2: bool) {
        self.awake = awake;
        if awake && in1 != in2 {
            self.driven_ns.get_or_insert(self.now_ns);
        }
        self.plant.set_bridge(match (awake, in1, in2) {
            (true, true, false) => Bridge::Forward,
            (true, false, true) => Bridge::Reverse,
            (true, true, true) => Bridge::Brake,
            _ => Bridge::Coast,
        });
    }

    /// Advances to `until_ns`; calls `edge` with the encoder's outputs after each edge, and with the end of the step in
    /// which the edge falls.
    pub fn advance(&mut self, until_ns: u64, mut edge: impl FnMut((bool, bool), u64)) {
        loop {
            // Include defects due at the very end, because the next call only asks for later ones.
            for defect in self.faults.due_by(self.now_ns) {
                self.plant.inject(defect);
            }
            if self.now_ns >= until_ns {
                return;
            }
            if self.plant.is_quiet() {
                self.supply_mv = self.regulated_mv();
                let next = self.faults.next_ns().unwrap_or(until_ns);
                let next = next.clamp(self.now_ns + 1, until_ns);
                self.plant.rest((next - self.now_ns) as f64 * 1e-9);
                self.now_ns = next;
                continue;
            }
            let step_ns = STEP_NS.min(until_ns - self.now_ns);
            let step_s = step_ns as f64 * 1e-9;
            let (encoder, end_ns) = (&mut self.encoder, self.now_ns + step_ns);
            self.plant.advance(step_s, |plant| {
                let levels = plant.encoder();
                if std::mem::replace(encoder, levels) != levels {
                    edge(levels, end_ns);
                }
            });
            let settled = 1.0 - (-step_s / SUPPLY_FILTER).exp();
            self.supply_mv += (self.regulated_mv() - self.supply_mv) * settled;
            self.now_ns += step_ns;
        }
    }

    /// When the capsule must be advanced even if no pin changes, ns.
    #[must_use]
    pub fn next_ns(&self) -> Option<u64> {
        let moving = (!self.plant.is_quiet()).then_some(self.now_ns + SAMPLE_NS);
        moving.into_iter().chain(self.faults.next_ns()).min()
    }

    /// The chip has begun a flash operation.
    pub fn flash_began(&mut self, erases: bool) {
        self.flash_moving += u64::from(erases && self.is_moving());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_encoder_leads_with_a_when_folding() {
        let mut capsule = Capsule::new(Parameters::nominal());
        capsule.drive(true, true, false);
        let mut seen = Vec::new();
        capsule.advance(20_000_000, |state, _| seen.push(state));
        assert_eq!(
            seen[..4],
            [(true, false), (true, true), (false, true), (false, false)]
        );
    }

    #[test]
    fn a_planned_fault_of_the_driver_lets_the_motor_run_out() {
        let mut capsule = Capsule::new(Parameters::nominal());
        capsule.plan(100_000_000, Defect::DriverFault);
        capsule.drive(true, true, false);
        capsule.advance(400_000_000, |_, _| ());
        assert!(!capsule.fault_high());
        assert!(!capsule.is_moving());
    }
}

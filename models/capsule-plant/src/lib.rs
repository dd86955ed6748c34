//! Model of the capsule's mechanics, for the firmware's tests on the host and for the virtual bench: cell with internal
//! resistance, bridge, motor, planetary gear, worm, spool, thread, folding spring, encoder, current amplifier.
//!
//! ```text
//! L i' = V - ke w - i (winding + bridge + cell)      exactly, between the edges of the bridge
//! J w' = kt i - kt I0 sgn(w) - load                  motor
//! x'   = w r / N                                     thread on the spool
//! ```
//! [`Effects`] adds further behaviour of a real capsule; each effect can be switched off.
//!
//! The model shares no code with the firmware, so it can judge it. Thread 0 is the paid-out end of a healthy capsule;
//! below it the thread winds itself backwards onto the spool.

pub mod cases;
pub mod effects;
mod encoder;
mod origami;
mod parameters;
mod random;
mod spring;
pub mod verdict;
mod winding;

pub use effects::{Effect, Effects};
pub use parameters::{BATTERY_DIVIDER, COUNTS_PER_REVOLUTION, Parameters, SENSE_MV_PER_MA, Shunt};
pub use random::Random;
pub use winding::Bridge;

use effects::{ROOM_C, STICK_RAD_S};
use encoder::Encoder;
use origami::Origami;
use winding::Source;

/// Resistance of a winding with a short circuit inside, ohm (assumed).
const SHORTED_OHM: f64 = 0.3;
/// Voltage drop of a collapsing cell, V/s (assumed).
const COLLAPSE_V_PER_S: f64 = 4.0;
/// Longest step of the integration, s.
const STEP_S: f64 = 20e-6;
/// Force that counts as a cycle once the thread has reached it and gone slack again, N.
const CYCLE_N: f64 = 2.0;

/// A defect of the capsule. Positions are travel of the fold in mm, which is thread beyond the slack.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Defect {
    /// A hard obstacle at this travel stops the fold.
    Jam(f64),
    /// A compliant obstacle resists the fold.
    Obstacle {
        /// Travel, mm.
        at_mm: f64,
        /// Stiffness, N per mm of thread.
        n_per_mm: f64,
    },
    /// Factor on the worm's friction: grease, temperature, wear.
    Friction(f64),
    /// Factor on the no-load current.
    NoLoad(f64),
    /// Factor on the origami's force: relaxation of a held fold.
    Relaxed(f64),
    /// The thread snaps once the travel reaches this.
    Snap(f64),
    /// The thread slips by this length at once, mm: more slack.
    Slip(f64),
    /// The spool slips on its shaft above this force, N.
    Clutch(f64),
    /// The encoder's line A is stuck at its level.
    ChannelA,
    /// The encoder's line B is stuck at its level.
    ChannelB,
    /// Both of the encoder's lines are stuck at their levels.
    Encoder,
    /// The encoder's lines are swapped.
    Swapped,
    /// The bridge drives nothing and reports no fault.
    SilentBridge,
    /// The bridge drives nothing and pulls nFAULT low.
    DriverFault,
    /// The motor's winding has a short circuit inside.
    Short,
    /// The current amplifier shows 0 mV.
    SenseOpen,
    /// Internal resistance of the cell, ohm.
    Weak(f64),
    /// The cell's voltage collapses within a second.
    Collapse,
    /// Voltage of the cell without load, mV.
    Battery(f64),
    /// A tired cell: adds this to its resistance and to its polarisation, ohm each.
    Tired(f64),
    /// Factor on the current amplifier's gain.
    Gain(f64),
    /// Adds this to the current amplifier's zero, mA.
    Offset(f64),
    /// The encoder loses this fraction of its lines.
    LosesCounts(f64),
    /// Temperature of the whole capsule, degrees Celsius.
    Temperature(f64),
    /// Adds this number of cycles.
    Aged(f64),
}

/// The mechanics with their defects.
#[derive(Clone, Debug)]
pub struct Plant {
    /// Parameters of this capsule.
    pub parameters: Parameters,
    bridge: Bridge,
    /// Temperature, degrees Celsius.
    celsius: f64,
    cycles: f64,
    /// Decades of cycles, for the creep.
    decades: f64,
    /// The thread has pulled in this cycle.
    pulled: bool,
    /// Time since the start; then the cell's polarisation, mV.
    time_s: f64,
    polarised_mv: f64,
    origami: Origami,
    encoder: Encoder,
    /// Thread wound by the spool, which lags behind the motor by the backlash.
    spool_mm: f64,
    /// Speed and angle of the motor, rad/s and rad.
    speed: f64,
    angle: f64,
    /// Present current in the winding.
    current_a: f64,
    /// Mean current in the winding over the last step.
    mean_a: f64,
    /// Mean current from the cell over the last step.
    drawn_a: f64,
    filtered_ma: f64,
    filtered_mv: f64,
    energy_j: f64,
    charge_c: f64,
    peak_force_n: f64,
    extremes_mm: (f64, f64),
    jam_mm: Option<f64>,
    obstacle: Option<(f64, f64)>,
    snap_mm: Option<f64>,
    snapped: bool,
    slipped_mm: f64,
    clutch_n: Option<f64>,
    silent: bool,
    driver_fault: bool,
    shorted: bool,
    sense_open: bool,
    collapsing: bool,
    held: bool,
}

impl Plant {
    /// A capsule at rest with the bridge open.
    #[must_use]
    pub fn new(parameters: Parameters) -> Self {
        Self {
            parameters,
            bridge: Bridge::Coast,
            celsius: ROOM_C,
            cycles: 0.0,
            decades: 0.0,
            pulled: false,
            time_s: 0.0,
            polarised_mv: 0.0,
            origami: Origami::at((parameters.wound_mm - parameters.slack_mm).max(0.0)),
            encoder: Encoder::new(parameters.effects.phase),
            spool_mm: parameters.wound_mm,
            speed: 0.0,
            angle: 0.0,
            current_a: 0.0,
            mean_a: 0.0,
            drawn_a: 0.0,
            filtered_ma: 0.0,
            filtered_mv: parameters.battery_mv,
            energy_j: 0.0,
            charge_c: 0.0,
            peak_force_n: 0.0,
            extremes_mm: (parameters.wound_mm, parameters.wound_mm),
            jam_mm: None,
            obstacle: None,
            snap_mm: None,
            snapped: false,
            slipped_mm: 0.0,
            clutch_n: None,
            silent: false,
            driver_fault: false,
            shorted: false,
            sense_open: false,
            collapsing: false,
            held: false,
        }
    }

    /// Applies a defect now.
    pub fn inject(&mut self, defect: Defect) {
        match defect {
            Defect::Jam(travel_mm) => self.jam_mm = Some(travel_mm),
            Defect::Obstacle { at_mm, n_per_mm } => self.obstacle = Some((at_mm, n_per_mm)),
            Defect::Friction(times) => {
                self.parameters.worm_friction *= times;
            }
            Defect::NoLoad(times) => self.parameters.no_load_a *= times,
            Defect::Relaxed(fraction) => self.parameters.stiffness *= fraction,
            Defect::Snap(travel_mm) => self.snap_mm = Some(travel_mm),
            Defect::Slip(length_mm) => self.slipped_mm += length_mm,
            Defect::Clutch(newton) => self.clutch_n = Some(newton),
            Defect::ChannelA => self.encoder.stick([true, false]),
            Defect::ChannelB => self.encoder.stick([false, true]),
            Defect::Encoder => self.encoder.stick([true, true]),
            Defect::Swapped => self.encoder.swapped = true,
            Defect::LosesCounts(fraction) => self.encoder.loses = fraction,
            Defect::SilentBridge => self.silent = true,
            Defect::DriverFault => self.driver_fault = true,
            Defect::Short => self.shorted = true,
            Defect::SenseOpen => self.sense_open = true,
            Defect::Weak(ohm) => self.parameters.battery_ohm = ohm,
            Defect::Collapse => self.collapsing = true,
            Defect::Battery(mv) => self.parameters.battery_mv = mv,
            Defect::Tired(ohm) => {
                self.parameters.battery_ohm += ohm;
                self.parameters.effects.polarisation_ohm += ohm;
            }
            Defect::Gain(times) => self.parameters.sense_gain *= times,
            Defect::Offset(ma) => self.parameters.sense_offset_mv += ma * SENSE_MV_PER_MA,
            Defect::Temperature(celsius) => self.celsius = celsius,
            Defect::Aged(cycles) => self.age(cycles),
        }
    }

    /// Holds or releases the motor's shaft.
    pub fn hold(&mut self, held: bool) {
        self.held = held;
    }

    /// Sets the bridge.
    pub fn set_bridge(&mut self, bridge: Bridge) {
        self.bridge = bridge;
    }

    /// Thread on the spool, mm.
    #[must_use]
    pub fn wound_mm(&self) -> f64 {
        self.spool_mm
    }

    fn age(&mut self, cycles: f64) {
        self.cycles += cycles;
        self.decades = (1.0 + self.cycles).log10();
    }

    /// Travel of the fold, mm: the thread beyond its slack.
    #[must_use]
    pub fn travel_mm(&self) -> f64 {
        let creep_mm = self.parameters.effects.creep_mm * self.decades;
        (self.spool_mm - self.parameters.slack_mm - creep_mm - self.slipped_mm).max(0.0)
    }

    fn stiffness(&self) -> f64 {
        self.parameters.stiffness * (1.0 - self.parameters.effects.softening * self.decades)
    }

    /// Pull of the thread, N.
    #[must_use]
    pub fn force_n(&self) -> f64 {
        if self.snapped {
            return 0.0;
        }
        let travel = self.travel_mm();
        let end = self.parameters.end_mm;
        let stop = self.jam_mm.map_or(end, |jam| jam.min(end));
        let met = self.obstacle.map_or(0.0, |(at_mm, n_per_mm)| {
            n_per_mm * (travel - at_mm).max(0.0)
        });
        self.origami
            .pull_n(travel, self.stiffness(), &self.parameters.effects)
            + met
            + self.parameters.stop_n_per_mm * (travel - stop).max(0.0)
    }

    /// Largest force so far, N.
    #[must_use]
    pub fn peak_force_n(&self) -> f64 {
        self.peak_force_n
    }

    /// Least and most thread on the spool so far, mm.
    #[must_use]
    pub fn extremes_mm(&self) -> (f64, f64) {
        self.extremes_mm
    }

    /// Restarts the record of the largest force and the extremes of the thread.
    pub fn forget_extremes(&mut self) {
        self.peak_force_n = self.force_n();
        self.extremes_mm = (self.wound_mm(), self.wound_mm());
    }

    /// Energy that the motor has taken from the cell's terminals so far, J.
    #[must_use]
    pub fn energy_j(&self) -> f64 {
        self.energy_j
    }

    /// Charge that the motor has taken from the cell so far, C.
    #[must_use]
    pub fn charge_c(&self) -> f64 {
        self.charge_c
    }

    /// Current in the winding, mA, positive folding: mean over the last step.
    #[must_use]
    pub fn current_ma(&self) -> f64 {
        self.mean_a * 1e3
    }

    /// Current from the cell, mA: mean over the last step.
    #[must_use]
    pub fn drawn_ma(&self) -> f64 {
        self.drawn_a * 1e3
    }

    /// Speed of the motor, rad/s, positive folding.
    #[must_use]
    pub fn speed(&self) -> f64 {
        self.speed
    }

    /// Whether it is at rest: nothing changes without a new drive or defect.
    #[must_use]
    pub fn is_quiet(&self) -> bool {
        self.bridge == Bridge::Coast
            && self.speed == 0.0
            && self.current_a == 0.0
            && self.filtered_ma.abs() < 0.01
            && !self.collapsing
    }

    /// Voltage at the current amplifier's output, mV, without noise. `supply_mv` is the amplifier's supply.
    #[must_use]
    pub fn sense_mv(&self, supply_mv: f64) -> f64 {
        if self.sense_open {
            return 0.0;
        }
        let signal = self.filtered_ma * SENSE_MV_PER_MA * self.parameters.sense_gain;
        let effects = &self.parameters.effects;
        let drift =
            effects.drift_mv * (std::f64::consts::TAU * self.time_s / effects.drift_s).sin();
        let zero = match self.parameters.shunt {
            Shunt::Below { .. } => 0.0,
            Shunt::InSeries => supply_mv / 2.0,
        };
        (zero + self.parameters.sense_offset_mv + drift + signal).clamp(0.0, supply_mv)
    }

    /// Voltage at the cell's terminals, mV: mean over the last step.
    #[must_use]
    pub fn terminal_mv(&self) -> f64 {
        let sag = 1e3 * self.parameters.battery_ohm * self.drawn_a;
        (self.parameters.battery_mv - self.polarised_mv - sag).max(0.0)
    }

    /// The terminal voltage behind the divider's filter, not yet divided.
    #[must_use]
    pub fn seen_battery_mv(&self) -> f64 {
        if self.is_quiet() {
            self.terminal_mv()
        } else {
            self.filtered_mv
        }
    }

    /// Level of the bridge's fault output, low while there is a fault.
    #[must_use]
    pub fn fault_high(&self) -> bool {
        !self.driver_fault
    }

    /// The encoder's outputs A and B.
    #[must_use]
    pub fn encoder(&self) -> (bool, bool) {
        self.encoder.levels()
    }

    fn drives(&self) -> Bridge {
        if self.driver_fault || self.silent {
            Bridge::Coast
        } else {
            self.bridge
        }
    }

    /// Lets `duration_s` pass. Calls `observe` after each integration step of 20 us at most.
    pub fn advance(&mut self, duration_s: f64, mut observe: impl FnMut(&Self)) {
        let steps = (duration_s / STEP_S).ceil().max(1.0);
        let step_s = duration_s / steps;
        for _ in 0..steps as u64 {
            let charge = self.carry(step_s);
            self.turn(charge, step_s);
            observe(self);
        }
    }

    /// Simulates one period of the bridge, 50 us at most; each phase is a state of the bridge and its duration.
    /// Integrates the current from edge to edge, but the motion over the whole period, in which the speed hardly
    /// changes. Means cover the whole period.
    pub fn advance_period(&mut self, phases: &[(Bridge, f64)]) {
        let (mut charge, mut drawn, mut whole_s) = (0.0, 0.0, 0.0);
        for &(bridge, length_s) in phases {
            if length_s > 0.0 {
                self.bridge = bridge;
                charge += self.carry(length_s);
                drawn += self.drawn_a * length_s;
                whole_s += length_s;
            }
        }
        if whole_s > 0.0 {
            (self.mean_a, self.drawn_a) = (charge / whole_s, drawn / whole_s);
            self.turn(charge, whole_s);
        }
    }

    /// Lets time pass for a plant [at rest](Self::is_quiet): the origami relaxes, the cell recovers.
    pub fn rest(&mut self, duration_s: f64) {
        self.time_s += duration_s;
        self.polarise(duration_s);
        self.follow(duration_s);
    }

    fn polarise(&mut self, dt: f64) {
        let effects = &self.parameters.effects;
        if effects.polarisation_ohm > 0.0 {
            let settles_mv = effects.polarisation_ohm * self.drawn_a * 1e3;
            let settled = origami::settles(dt / effects.polarisation_s);
            self.polarised_mv += (settles_mv - self.polarised_mv) * settled;
        }
    }

    /// Moves the origami with the thread.
    fn follow(&mut self, dt: f64) {
        let held_mm = if self.snapped { 0.0 } else { self.travel_mm() };
        let stiffness = self.stiffness();
        self.origami
            .follow(held_mm, stiffness, &self.parameters.effects, dt);
    }

    /// Present motor constant, V s/rad.
    fn motor_constant(&self) -> f64 {
        let (_, magnet) = self.parameters.effects.motor_at(self.celsius);
        self.parameters.motor_constant * magnet
    }

    /// Advances current, cell and amplifier at the present speed. Returns the charge through the winding, C.
    fn carry(&mut self, dt: f64) -> f64 {
        let parameters = &self.parameters;
        let (copper, _) = parameters.effects.motor_at(self.celsius);
        let cell_mv = parameters.battery_mv - self.polarised_mv;
        // A winding with a short circuit inside gives no back-EMF.
        let (ohm, henry, back) = match self.shorted {
            true => (SHORTED_OHM, 0.0, 0.0),
            false => (
                parameters.winding_ohm * copper,
                parameters.winding_h,
                self.motor_constant() * self.speed,
            ),
        };
        let source = Source {
            cell_v: cell_mv.max(0.0) * 1e-3,
            ohm,
            henry,
        };
        let flow = winding::flow(
            parameters,
            source,
            self.drives(),
            (self.current_a, back),
            dt,
        );
        self.current_a = flow.end_a;
        (self.mean_a, self.drawn_a) = (flow.charge / dt, flow.drawn / dt);
        self.charge_c += flow.drawn;
        let heat = self.parameters.battery_ohm * flow.drawn_square;
        self.energy_j += cell_mv * 1e-3 * flow.drawn - heat;
        let settled = 1.0 - (-dt / self.parameters.filter_s).exp();
        let sensed_ma = flow.sensed / dt * 1e3;
        self.filtered_ma += (sensed_ma - self.filtered_ma) * settled;
        self.filtered_mv += (self.terminal_mv() - self.filtered_mv) * settled;
        flow.charge
    }

    /// Torques that resist folding and unfolding at this pull of the thread, N m.
    fn resistance(&self, force: f64) -> (f64, f64) {
        let parameters = &self.parameters;
        let effects = &parameters.effects;
        let (worm, no_load) = effects.friction_at(self.celsius, self.cycles);
        // A fast motor has no standing friction.
        let turns = self.speed.abs() / STICK_RAD_S;
        let sticks = match effects.stick > 0.0 && turns < 20.0 {
            true => 1.0 + effects.stick * (-turns).exp(),
            false => 1.0,
        };
        let friction = parameters.worm_friction * worm * sticks;
        let (raising, lowering) =
            parameters.worm_factors(friction, friction * (1.0 + effects.direction));
        let ratio = parameters.planetary_ratio * parameters.worm_ratio;
        let lever = parameters.spool_mm * 1e-3 / ratio / parameters.planetary_efficiency;
        let ideal = force * lever;
        let idle = parameters.motor_constant * parameters.no_load_a * no_load * sticks;
        let stop = parameters.paid_out_stop_mm.map_or(0.0, |at| {
            (at - self.wound_mm()).max(0.0) * parameters.stop_n_per_mm * lever
        });
        (
            ideal * raising + idle,
            -(ideal * lowering + stop * raising + idle),
        )
    }

    /// Advances the motion, with this charge through the winding.
    fn turn(&mut self, charge: f64, dt: f64) {
        let mm_per_rad = self.parameters.mm_per_rad();
        self.time_s += dt;
        self.polarise(dt);
        if self.held {
            self.speed = 0.0;
            self.follow(dt);
            return;
        }
        let mut force = self.force_n();
        if let Some(limit) = self.clutch_n
            && force > limit
            && self.speed > 0.0
        {
            // Beyond the clutch's limit the spool turns without winding thread.
            self.slipped_mm += self.speed * mm_per_rad * dt;
            force = limit;
        }
        if self.snap_mm.is_some_and(|at| self.travel_mm() >= at) {
            self.snapped = true;
        }
        self.peak_force_n = self.peak_force_n.max(force);
        if force > CYCLE_N {
            self.pulled = true;
        } else if force == 0.0 && std::mem::take(&mut self.pulled) {
            self.age(1.0);
        }

        let (folding, unfolding) = self.resistance(force);
        // A winding with a short circuit inside gives no torque.
        let torque = match self.shorted {
            true => 0.0,
            false => self.motor_constant() * charge / dt,
        };
        let resisting = if self.speed > 0.0 {
            folding
        } else if self.speed < 0.0 {
            unfolding
        } else {
            torque.clamp(unfolding, folding)
        };
        let speed = self.speed + (torque - resisting) / self.parameters.inertia * dt;
        // Friction and load can stop the motor but not reverse it. Only the torque of the next step may reverse it.
        self.speed = if speed * self.speed < 0.0 { 0.0 } else { speed };
        self.angle += self.speed * dt;
        self.encoder
            .turn(self.angle * COUNTS_PER_REVOLUTION / std::f64::consts::TAU);
        self.wind(force);
        self.follow(dt);
        let wound = self.wound_mm();
        let (least, most) = self.extremes_mm;
        self.extremes_mm = (least.min(wound), most.max(wound));
        if self.collapsing {
            let lost_mv = COLLAPSE_V_PER_S * 1e3 * dt;
            self.parameters.battery_mv = (self.parameters.battery_mv - lost_mv).max(0.0);
        }
    }

    /// Moves the spool with the motor: at once under load, which keeps the worm wheel on one flank; without load only
    /// past the backlash.
    fn wind(&mut self, force: f64) {
        let motor_mm = self.parameters.wound_mm + self.angle * self.parameters.mm_per_rad();
        let least_mm = motor_mm - self.parameters.effects.backlash_mm;
        self.spool_mm = match force > 0.0 {
            true => least_mm,
            false => self.spool_mm.clamp(least_mm, motor_mm),
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(plant: &mut Plant, us: u64) -> u64 {
        let (mut edges, mut known) = (0, plant.encoder());
        plant.advance(us as f64 * 1e-6, |plant| {
            edges += u64::from(known != plant.encoder());
            known = plant.encoder();
        });
        edges
    }

    /// A held motor has no back-EMF: only the loop's resistance limits its current.
    #[test]
    fn a_motor_that_is_held_stands_and_draws() {
        let mut plant = Plant::new(Parameters::nominal());
        plant.hold(true);
        plant.set_bridge(Bridge::Forward);
        assert_eq!(run(&mut plant, 200_000), 0);
        let held_ma = plant.current_ma();
        assert!(held_ma > 400.0, "{held_ma} mA");
        plant.hold(false);
        assert!(run(&mut plant, 200_000) > 100);
        assert!(plant.current_ma() < held_ma / 2.0);
    }

    #[test]
    fn a_motor_without_load_runs_at_its_no_load_current() {
        let mut plant = Plant::new(Parameters::nominal());
        plant.inject(Defect::Snap(0.0));
        plant.set_bridge(Bridge::Forward);
        let edges = run(&mut plant, 200_000);
        assert!((plant.current_ma() - 16.0).abs() < 0.5);
        assert!((plant.sense_mv(3_300.0) - 1_666.0).abs() < 0.5);
        let counts = plant.angle * COUNTS_PER_REVOLUTION / std::f64::consts::TAU;
        assert!((counts.floor() - edges as f64).abs() <= 1.0);
    }

    /// By the parts of `docs/capsule.md` a pull costs 23.5 mA/N beside the 16 mA without load.
    #[test]
    fn forces_cost_the_currents_of_the_parts() {
        for (newton, ma) in [(1.0, 40.0), (3.0, 87.0), (6.0, 157.0), (10.0, 251.0)] {
            // Choose the voltage at which the motor stalls with this force.
            let mut plant = Plant::new(Parameters {
                battery_mv: ma * 5.4,
                battery_ohm: 0.0,
                bridge_ohm: 0.0,
                ..Parameters::nominal()
            });
            plant.set_bridge(Bridge::Forward);
            run(&mut plant, 60_000_000);
            let force = plant.force_n();
            assert!((force / newton - 1.0).abs() < 0.03, "{force} N at {ma} mA");
        }
    }

    #[test]
    fn the_worm_holds_with_the_motor_off_and_unfolds_when_driven() {
        for worm_friction in [0.10, 0.15, 0.20] {
            let mut plant = Plant::new(Parameters {
                worm_friction,
                ..Parameters::nominal()
            });
            plant.set_bridge(Bridge::Forward);
            run(&mut plant, 1_000_000);
            plant.set_bridge(Bridge::Coast);
            run(&mut plant, 300_000);
            let folded = plant.wound_mm();
            assert!(folded > 15.0, "{folded} mm");
            run(&mut plant, 1_000_000);
            assert_eq!(plant.wound_mm(), folded);
            plant.set_bridge(Bridge::Reverse);
            run(&mut plant, 500_000);
            assert!(plant.wound_mm() < folded - 5.0);
        }
        let nominal = Parameters::nominal();
        let friction = nominal.worm_friction;
        let (raising, lowering) = nominal.worm_factors(friction, friction);
        assert!((1.0 / raising - 0.315).abs() < 0.001 && (lowering - 1.133).abs() < 0.002);
    }

    #[test]
    fn defects_act_where_they_should() {
        let folding = |defect| {
            let mut plant = Plant::new(Parameters::nominal());
            plant.inject(defect);
            plant.set_bridge(Bridge::Forward);
            run(&mut plant, 2_000_000);
            plant
        };
        let jam = folding(Defect::Jam(12.0));
        assert!((12.0..12.3).contains(&jam.travel_mm()) && jam.sense_mv(3_300.0) > 1_950.0);
        assert_eq!(folding(Defect::Snap(15.0)).force_n(), 0.0);
        let clutch = folding(Defect::Clutch(3.0));
        assert!(clutch.peak_force_n() < 3.1 && clutch.wound_mm() > 30.0);
        assert!(folding(Defect::SilentBridge).wound_mm() == 0.0);
        assert!(!folding(Defect::DriverFault).fault_high());
        assert!(folding(Defect::Short).current_ma() > 2_000.0);
        assert_eq!(folding(Defect::SenseOpen).sense_mv(3_300.0), 0.0);
        assert_eq!(folding(Defect::Collapse).terminal_mv(), 0.0);
        assert!(folding(Defect::Weak(20.0)).peak_force_n() < 6.0);
    }

    #[test]
    fn a_broken_line_of_the_encoder_flickers_on_the_spot() {
        for (defect, moving) in [(Defect::ChannelA, 1), (Defect::ChannelB, 0)] {
            let mut plant = Plant::new(Parameters::nominal());
            plant.inject(defect);
            plant.set_bridge(Bridge::Forward);
            let mut seen = [[false; 2]; 2];
            plant.advance(0.01, |plant| {
                let (a, b) = plant.encoder();
                seen[0][usize::from(a)] = true;
                seen[1][usize::from(b)] = true;
            });
            assert_eq!(seen[moving], [true, true]);
            assert_eq!(seen[1 - moving], [true, false]);
        }
    }

    #[test]
    fn a_stop_at_the_paid_out_end_stops_the_spool() {
        let mut plant = Plant::new(Parameters {
            paid_out_stop_mm: Some(-0.5),
            ..Parameters::nominal()
        });
        plant.set_bridge(Bridge::Reverse);
        run(&mut plant, 500_000);
        assert!(
            (-0.8..-0.5).contains(&plant.wound_mm()),
            "{}",
            plant.wound_mm()
        );
        assert!(plant.current_ma() < -400.0);
    }

    #[test]
    fn the_same_seed_is_the_same_capsule() {
        let all: Vec<_> = (0..1_000).map(Parameters::varied).collect();
        assert_eq!(all[7], Parameters::varied(7));
        for (low, high) in [(0.5, 0.6), (3.5, 4.0)] {
            assert!(all.iter().any(|p| (low..high).contains(&p.stiffness)));
        }
        assert!(all.iter().all(|p| (0.10..0.20).contains(&p.worm_friction)));
        assert!(
            all.iter()
                .all(|p| (3_050.0..4_200.0).contains(&p.battery_mv))
        );
    }
}

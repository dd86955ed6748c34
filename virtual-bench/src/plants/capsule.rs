//! The capsule: battery, H-bridge, motor, gears, spool, thread and the folding spring.
//!
//! ```text
//! i   = (V - ke w) / R                    winding, no inductance
//! J w' = kt i - kt I0 sgn(w) - load       motor
//! x'  = w r / N                           thread on the spool
//! ```
//! The worm gear is self-locking: at rest it holds the load, and unfolding has to be driven, too. Values without a
//! remark are those of the model motor and gears in `docs/science.md`.

use crate::faults::{Faults, When};

/// Counts per motor revolution: 16 lines, four edges each.
pub const COUNTS_PER_REVOLUTION: f64 = 64.0;

/// Output of the current amplifier: a shunt of 0.5 ohm in series with the winding and a gain of 2 on its magnitude.
pub const SENSE_MV_PER_MA: f64 = 1.0;

/// Ratio of the battery's voltage divider.
pub const BATTERY_DIVIDER: f64 = 2.0;

/// Winding resistance, ohm.
const RESISTANCE: f64 = 5.4;
/// Torque constant, N m/A, and back-EMF constant, V s/rad: the same number.
const CONSTANT: f64 = 2.11e-3;
/// No-load current, A.
const NO_LOAD: f64 = 0.016;
/// Inertia, kg m2.
const INERTIA: f64 = 5.1e-9;
/// Planetary gear: ratio and efficiency.
const PLANETARY: (f64, f64) = (4.0, 0.8);
/// Worm gear: ratio, efficiency when it raises the load, and driving torque over the ideal one when it lowers the load.
const WORM: (f64, f64, f64) = (30.0, 0.315, 1.133);
/// Spool radius, mm.
const SPOOL_MM: f64 = 1.5;
/// Force of the fold over the thread's travel, (mm, N), from the beam estimate; linear between the points.
const FOLD: [(f64, f64); 5] = [
    (0.0, 0.0),
    (16.6, 1.2),
    (19.0, 2.9),
    (20.6, 5.8),
    (21.7, 10.8),
];
/// Travel at which the folded crescents meet (a 13 mm body), mm, and the stiffness beyond it and of a jam, N/mm.
const END_MM: f64 = 22.22;
const STOP_N_PER_MM: f64 = 200.0;
/// What the linear regulator of the chip gives, mV, as long as the battery has more.
const REGULATED_MV: f64 = 3_300.0;
/// What it drops of an empty battery, mV: the resistance of its pass transistor, 5 ohm, at the chip's 10 mA [assumed].
const DROPOUT_MV: f64 = 50.0;
/// The same resistance with 10 uF behind it, s [assumed].
const SUPPLY_FILTER: f64 = 50e-6;
/// Time constant of the amplifier's filter, s [assumed].
const SENSE_FILTER: f64 = 160e-6;
/// Longest step of the integration, ns.
const STEP_NS: u64 = 20_000;
/// Interval at which a moving motor is looked at, ns.
const LOOK_NS: u64 = 50_000;

/// Parameters of the capsule.
#[derive(Clone, Copy, Debug)]
pub struct CapsuleOptions {
    /// Battery voltage without load, mV.
    pub battery_mv: f64,
    /// Internal resistance of the battery, ohm (assumed).
    pub battery_ohm: f64,
    /// Thread on the spool initially, mm.
    pub wound_mm: f64,
    /// Thread to wind before it is taut, mm.
    pub slack_mm: f64,
    /// What the current amplifier shows without current, mV.
    pub sense_offset_mv: f64,
}

impl Default for CapsuleOptions {
    /// A charged 40 mAh cell, unfolded, 1 mm of slack.
    fn default() -> Self {
        Self {
            battery_mv: 3_700.0,
            battery_ohm: 0.5,
            wound_mm: 0.0,
            slack_mm: 1.0,
            sense_offset_mv: 0.0,
        }
    }
}

/// Faults of the capsule.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Action {
    /// The fold meets an obstacle at this travel in mm, or is free again.
    Jam(Option<f64>),
    /// The thread snaps, or is whole again.
    Snap(bool),
    /// The encoder stops counting, or works again.
    LoseEncoder(bool),
    /// Battery voltage without load, mV.
    Battery(f64),
    /// The driver reports a fault and drives nothing, or works again.
    DriverFault(bool),
}

/// What the bridge does to the winding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Bridge {
    /// Asleep, or both inputs low: the winding is open.
    Coast,
    /// IN1 high: folds.
    Forward,
    /// IN2 high: unfolds.
    Reverse,
    /// Both high: the winding is shorted.
    Brake,
}

/// The capsule.
#[derive(Debug)]
pub struct Capsule {
    options: CapsuleOptions,
    now_ns: u64,
    bridge: Bridge,
    awake: bool,
    /// rad/s and rad at the motor.
    speed: f64,
    angle: f64,
    current: f64,
    sense_ma: f64,
    supply_mv: f64,
    jam_mm: Option<f64>,
    snapped: bool,
    encoder_lost: bool,
    driver_fault: bool,
    counts: i64,
    energy_j: f64,
    peak_force_n: f64,
    extremes_mm: (f64, f64),
    flash_moving: u64,
    faults: Faults<Action>,
}

impl Capsule {
    /// A capsule at rest, its driver asleep.
    #[must_use]
    pub fn new(options: CapsuleOptions) -> Self {
        Self {
            options,
            now_ns: 0,
            bridge: Bridge::Coast,
            awake: false,
            speed: 0.0,
            angle: 0.0,
            current: 0.0,
            sense_ma: 0.0,
            supply_mv: REGULATED_MV,
            jam_mm: None,
            snapped: false,
            encoder_lost: false,
            driver_fault: false,
            counts: 0,
            energy_j: 0.0,
            peak_force_n: 0.0,
            extremes_mm: (options.wound_mm, options.wound_mm),
            flash_moving: 0,
            faults: Faults::default(),
        }
    }

    /// Thread on the spool, mm.
    #[must_use]
    pub fn wound_mm(&self) -> f64 {
        self.options.wound_mm + self.angle * SPOOL_MM / (PLANETARY.0 * WORM.0)
    }

    /// Travel of the fold, mm: the thread beyond its slack.
    #[must_use]
    pub fn travel_mm(&self) -> f64 {
        (self.wound_mm() - self.options.slack_mm).max(0.0)
    }

    /// Force in the thread, N.
    #[must_use]
    pub fn force_n(&self) -> f64 {
        if self.snapped {
            return 0.0;
        }
        let travel = self.travel_mm();
        let stop = self.jam_mm.map_or(END_MM, |jam| jam.min(END_MM));
        fold_n(travel) + STOP_N_PER_MM * (travel - stop).max(0.0)
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

    /// Energy that the motor has taken from the battery so far, J.
    #[must_use]
    pub fn energy_j(&self) -> f64 {
        self.energy_j
    }

    /// Current in the winding, mA, positive folding.
    #[must_use]
    pub fn current_ma(&self) -> f64 {
        self.current * 1e3
    }

    /// Whether the bridge is awake.
    #[must_use]
    pub fn is_awake(&self) -> bool {
        self.awake
    }

    /// Whether the motor turns.
    #[must_use]
    pub fn is_moving(&self) -> bool {
        self.speed != 0.0
    }

    /// Number of flash operations begun while the motor turned.
    #[must_use]
    pub fn flash_moving(&self) -> u64 {
        self.flash_moving
    }

    /// Voltage at the current amplifier's output, mV.
    #[must_use]
    pub fn sense_mv(&self) -> f64 {
        self.options.sense_offset_mv + self.sense_ma * SENSE_MV_PER_MA
    }

    /// Supply and analog reference of the chip, mV.
    #[must_use]
    pub fn supply_mv(&self) -> f64 {
        if self.is_quiet() {
            self.regulated_mv()
        } else {
            self.supply_mv
        }
    }

    fn regulated_mv(&self) -> f64 {
        (self.terminal_mv() - DROPOUT_MV).clamp(0.0, REGULATED_MV)
    }

    /// Voltage at the battery's divider, mV.
    #[must_use]
    pub fn battery_mv(&self) -> f64 {
        self.terminal_mv() / BATTERY_DIVIDER
    }

    /// Voltage at the battery's terminals, mV.
    #[must_use]
    pub fn battery_terminal_mv(&self) -> f64 {
        self.terminal_mv()
    }

    /// Level of the driver's fault output, low while there is a fault.
    #[must_use]
    pub fn fault_high(&self) -> bool {
        !self.driver_fault
    }

    /// The encoder's outputs A and B.
    #[must_use]
    pub fn encoder(&self) -> (bool, bool) {
        let phase = self.counts.rem_euclid(4);
        (phase == 1 || phase == 2, phase == 2 || phase == 3)
    }

    /// Plans a fault; a capsule has no step edges, only instants.
    pub fn plan(&mut self, at_ns: u64, action: Action) {
        self.faults.plan(When::At(at_ns), action);
    }

    /// Does `action` now.
    pub fn act(&mut self, action: Action) {
        match action {
            Action::Jam(at_mm) => self.jam_mm = at_mm,
            Action::Snap(snapped) => self.snapped = snapped,
            Action::LoseEncoder(lost) => self.encoder_lost = lost,
            Action::Battery(mv) => self.options.battery_mv = mv,
            Action::DriverFault(fault) => self.driver_fault = fault,
        }
    }

    /// The bridge's inputs have changed. Call after [`Capsule::advance`] to the present instant.
    pub fn drive(&mut self, awake: bool, in1: bool, in2: bool) {
        self.awake = awake;
        self.bridge = match (awake, in1, in2) {
            (true, true, false) => Bridge::Forward,
            (true, false, true) => Bridge::Reverse,
            (true, true, true) => Bridge::Brake,
            _ => Bridge::Coast,
        };
    }

    /// Lets time pass to `until_ns`; calls `edge` with the encoder's outputs after each of its edges.
    pub fn advance(&mut self, until_ns: u64, mut edge: impl FnMut((bool, bool))) {
        loop {
            // Including those at the very end, because the next look only asks for later ones.
            for action in self.faults.due_by(self.now_ns) {
                self.act(action);
            }
            if self.now_ns >= until_ns {
                return;
            }
            if self.is_quiet() {
                self.supply_mv = self.regulated_mv();
                let next = self.faults.next_ns().unwrap_or(until_ns);
                self.now_ns = next.clamp(self.now_ns + 1, until_ns);
                continue;
            }
            let step_ns = STEP_NS.min(until_ns - self.now_ns);
            self.integrate(step_ns as f64 * 1e-9);
            self.now_ns += step_ns;
            self.turn_encoder(&mut edge);
        }
    }

    /// When the capsule has to be looked at again even if no pin changes, ns.
    #[must_use]
    pub fn next_ns(&self) -> Option<u64> {
        let moving = (!self.is_quiet()).then_some(self.now_ns + LOOK_NS);
        moving.into_iter().chain(self.faults.next_ns()).min()
    }

    fn is_quiet(&self) -> bool {
        self.bridge == Bridge::Coast && self.speed == 0.0 && self.sense_ma < 0.01
    }

    fn terminal_mv(&self) -> f64 {
        let drawn = match self.drives() {
            Bridge::Forward => self.current,
            Bridge::Reverse => -self.current,
            _ => 0.0,
        };
        self.options.battery_mv - 1e3 * self.options.battery_ohm * drawn.max(0.0)
    }

    fn drives(&self) -> Bridge {
        if self.driver_fault {
            Bridge::Coast
        } else {
            self.bridge
        }
    }

    fn integrate(&mut self, dt: f64) {
        let open = self.options.battery_mv * 1e-3;
        let whole = RESISTANCE + self.options.battery_ohm;
        let back = CONSTANT * self.speed;
        self.current = match self.drives() {
            Bridge::Forward => (open - back) / whole,
            Bridge::Reverse => (-open - back) / whole,
            Bridge::Brake => -back / RESISTANCE,
            Bridge::Coast => 0.0,
        };
        self.energy_j += (self.terminal_mv() * 1e-3 * self.current.abs()).max(0.0)
            * dt
            * f64::from(u8::from(matches!(
                self.drives(),
                Bridge::Forward | Bridge::Reverse
            )));
        let force = self.force_n();
        self.peak_force_n = self.peak_force_n.max(force);
        let ideal = force * SPOOL_MM * 1e-3 / (PLANETARY.0 * WORM.0);
        let friction = CONSTANT * NO_LOAD;
        let folding = ideal / (PLANETARY.1 * WORM.1) + friction;
        let unfolding = -(ideal * WORM.2 / PLANETARY.1 + friction);
        let torque = CONSTANT * self.current;
        let resisting = if self.speed > 0.0 {
            folding
        } else if self.speed < 0.0 {
            unfolding
        } else {
            torque.clamp(unfolding, folding)
        };
        let speed = self.speed + (torque - resisting) / INERTIA * dt;
        // Friction and load can stop the motor but not reverse it; only the torque of the next step may.
        self.speed = if speed * self.speed < 0.0 { 0.0 } else { speed };
        self.angle += self.speed * dt;
        let wound = self.wound_mm();
        let (least, most) = self.extremes_mm;
        self.extremes_mm = (least.min(wound), most.max(wound));
        let settled = |filter: f64| 1.0 - (-dt / filter).exp();
        self.sense_ma += (self.current.abs() * 1e3 - self.sense_ma) * settled(SENSE_FILTER);
        self.supply_mv += (self.regulated_mv() - self.supply_mv) * settled(SUPPLY_FILTER);
    }

    fn turn_encoder(&mut self, edge: &mut impl FnMut((bool, bool))) {
        if self.encoder_lost {
            return;
        }
        let counts = (self.angle * COUNTS_PER_REVOLUTION / std::f64::consts::TAU).floor() as i64;
        while self.counts != counts {
            self.counts += (counts - self.counts).signum();
            edge(self.encoder());
        }
    }

    /// The chip has begun a flash operation.
    pub fn flash_began(&mut self) {
        self.flash_moving += u64::from(self.speed != 0.0);
    }
}

/// Force of the fold at `travel` mm, N.
fn fold_n(travel: f64) -> f64 {
    let last = FOLD.len() - 2;
    let section = FOLD
        .windows(2)
        .position(|ends| travel < ends[1].0)
        .unwrap_or(last);
    let ((x0, f0), (x1, f1)) = (FOLD[section], FOLD[section + 1]);
    f0 + (travel - x0) * (f1 - f0) / (x1 - x0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(capsule: &mut Capsule, us: u64) -> i64 {
        let mut edges = 0;
        let until = capsule.now_ns + us * 1_000;
        capsule.advance(until, |_| edges += 1);
        edges
    }

    #[test]
    fn a_motor_without_load_runs_at_its_no_load_current() {
        let mut capsule = Capsule::new(CapsuleOptions::default());
        capsule.act(Action::Snap(true));
        capsule.drive(true, true, false);
        let edges = run(&mut capsule, 200_000);
        assert!(
            (capsule.current_ma() - 16.0).abs() < 0.5,
            "{}",
            capsule.current_ma()
        );
        assert!((capsule.sense_mv() - 16.0).abs() < 0.5);
        let expected = capsule.angle * COUNTS_PER_REVOLUTION / std::f64::consts::TAU;
        assert!((edges as f64 - expected).abs() <= 1.0);
    }

    #[test]
    fn six_newtons_cost_157_milliamperes() {
        // A voltage at which the motor stalls at 6 N.
        let mut capsule = Capsule::new(CapsuleOptions {
            battery_mv: 157.0 * RESISTANCE,
            battery_ohm: 0.0,
            ..CapsuleOptions::default()
        });
        capsule.drive(true, true, false);
        run(&mut capsule, 20_000_000);
        assert!(
            (capsule.force_n() - 6.0).abs() < 0.1,
            "{} N",
            capsule.force_n()
        );
    }

    #[test]
    fn the_worm_holds_with_the_motor_off_and_unfolds_when_driven() {
        let mut capsule = Capsule::new(CapsuleOptions::default());
        capsule.drive(true, true, false);
        run(&mut capsule, 1_000_000);
        capsule.drive(false, false, false);
        run(&mut capsule, 100_000);
        let folded = capsule.wound_mm();
        assert!(folded > 15.0, "{folded} mm");
        run(&mut capsule, 10_000_000);
        assert_eq!(capsule.wound_mm(), folded);
        capsule.drive(true, false, true);
        run(&mut capsule, 500_000);
        assert!(capsule.wound_mm() < folded - 5.0);
    }

    #[test]
    fn a_jam_raises_the_current_where_it_is() {
        let mut capsule = Capsule::new(CapsuleOptions::default());
        capsule.act(Action::Jam(Some(12.0)));
        capsule.drive(true, true, false);
        run(&mut capsule, 2_000_000);
        assert!(!capsule.is_moving());
        assert!(
            (12.0..12.3).contains(&capsule.travel_mm()),
            "{} mm",
            capsule.travel_mm()
        );
        assert!(capsule.sense_mv() > 300.0);
    }

    #[test]
    fn the_encoder_leads_with_a_when_folding() {
        let mut capsule = Capsule::new(CapsuleOptions::default());
        capsule.drive(true, true, false);
        let mut seen = Vec::new();
        capsule.advance(20_000_000, |state| seen.push(state));
        assert_eq!(
            seen[..4],
            [(true, false), (true, true), (false, true), (false, false)]
        );
    }

    #[test]
    fn a_fault_of_the_driver_lets_the_motor_run_out() {
        let mut capsule = Capsule::new(CapsuleOptions::default());
        capsule.plan(100_000_000, Action::DriverFault(true));
        capsule.drive(true, true, false);
        run(&mut capsule, 400_000);
        assert!(!capsule.fault_high());
        assert!(!capsule.is_moving());
    }
}

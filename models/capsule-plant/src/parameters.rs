//! The parameters of one capsule, each with its source, and populations drawn from their ranges.

use crate::effects::Effects;
use crate::random::Random;

/// Position of the shunt, and range of its amplifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shunt {
    /// Below the bridge, with a single supply. Does not see the current that circulates through the low sides;
    /// current back into the cell is cut off at 0 mV. `filtered_first` says whether the pulses are filtered before
    /// the amplifier cuts them off, or after.
    Below {
        /// The filter is ahead of the amplifier.
        filtered_first: bool,
    },
    /// In series with the motor, with the zero at half of the amplifier's supply: shows the current with its sign.
    InSeries,
}

/// Counts per motor revolution: 16 lines, four edges each.
pub const COUNTS_PER_REVOLUTION: f64 = 64.0;
/// Output of the current amplifier, mV per mA: a shunt of 0.05 ohm and a gain of 20.
pub const SENSE_MV_PER_MA: f64 = 1.0;
/// Ratio of the battery's voltage divider.
pub const BATTERY_DIVIDER: f64 = 2.0;

/// One capsule. [`Parameters::nominal`] has the parts of `docs/capsule.md`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Parameters {
    /// Winding resistance, ohm: 5.4 (data sheet of the motor 0816K003SR).
    pub winding_ohm: f64,
    /// Inductance of the winding, H: 53e-6 (data sheet, 53 uH at 1 kHz), a time constant of 8 us. 0 means none.
    pub winding_h: f64,
    /// Torque constant, N m/A, and back-EMF constant, V s/rad, the same number: 2.11e-3 (data sheet).
    pub motor_constant: f64,
    /// No-load current, A: 0.016 (data sheet). It represents the friction of motor and gears without load.
    pub no_load_a: f64,
    /// Rotor, kg m2: 5.1e-9 (data sheet, 0.051 g cm2).
    pub inertia: f64,
    /// Planetary gear, ratio: 4 (design).
    pub planetary_ratio: f64,
    /// Planetary gear, efficiency: 0.8 (data sheet of the series).
    pub planetary_efficiency: f64,
    /// Worm gear, ratio: 30 (design).
    pub worm_ratio: f64,
    /// Lead angle of the worm, degrees: 4 (design).
    pub worm_lead_deg: f64,
    /// Coefficient of friction in the worm: 0.15 for steel on bronze with grease (assumed; 0.10 to 0.20 in use).
    pub worm_friction: f64,
    /// Radius of the spool, mm: 1.5 (design).
    pub spool_mm: f64,
    /// Thread to wind before it is taut, mm: 1 (design).
    pub slack_mm: f64,
    /// Origami force relative to its beam estimate: 1. Thickness and modulus are not measured, so 0.5 to 4 is
    /// possible.
    pub stiffness: f64,
    /// Travel at which the folded crescents meet a 13 mm body, mm: 22.22 (from the paper's kinematics).
    pub end_mm: f64,
    /// Stiffness of that end and of any hard obstacle, N/mm: 200 (assumed).
    pub stop_n_per_mm: f64,
    /// Mechanical stop of the spool at the paid-out end, mm of thread; none in the reference design.
    pub paid_out_stop_mm: Option<f64>,
    /// Resistance of both conducting switches of the bridge, ohm: 0.6 (DRV8833 at 25 C, 0.36 typical; with wires,
    /// assumed).
    pub bridge_ohm: f64,
    /// Forward voltage of a diode in the bridge, V: 0.7 (assumed).
    pub diode_v: f64,
    /// Position of the shunt.
    pub shunt: Shunt,
    /// Voltage of the cell without load, mV: 3,700, a charged cell of 40 mAh.
    pub battery_mv: f64,
    /// Internal resistance of the cell, ohm: 0.5 (assumed; two SR44 in series: 20).
    pub battery_ohm: f64,
    /// Output of the current amplifier without current, mV.
    pub sense_offset_mv: f64,
    /// Gain of the current amplifier relative to nominal.
    pub sense_gain: f64,
    /// Noise of one reading of the current, mA rms. The bench adds none: the emulated converter is exact.
    pub sense_noise_ma: f64,
    /// Time constant of the filters, s: 160e-6 (design, 1 kOhm and 160 nF behind the amplifier, two 100 kOhm and 3.3 nF
    /// at the divider of the battery).
    pub filter_s: f64,
    /// Thread on the spool at the start, mm.
    pub wound_mm: f64,
    /// Effects beyond the plain model.
    pub effects: Effects,
}

impl Parameters {
    /// The model capsule, unfolded.
    #[must_use]
    pub const fn nominal() -> Self {
        Self {
            winding_ohm: 5.4,
            winding_h: 53e-6,
            motor_constant: 2.11e-3,
            no_load_a: 0.016,
            inertia: 5.1e-9,
            planetary_ratio: 4.0,
            planetary_efficiency: 0.8,
            worm_ratio: 30.0,
            worm_lead_deg: 4.0,
            worm_friction: 0.15,
            spool_mm: 1.5,
            slack_mm: 1.0,
            stiffness: 1.0,
            end_mm: 22.22,
            stop_n_per_mm: 200.0,
            paid_out_stop_mm: None,
            bridge_ohm: 0.6,
            diode_v: 0.7,
            shunt: Shunt::InSeries,
            battery_mv: 3_700.0,
            battery_ohm: 0.5,
            sense_offset_mv: 0.0,
            sense_gain: 1.0,
            sense_noise_ma: 0.0,
            filter_s: 160e-6,
            wound_mm: 0.0,
            effects: Effects::NONE,
        }
    }

    /// A healthy capsule within the spread of production and of a patient's day. Ranges: stiffness x0.5 to 4,
    /// friction in the worm 0.10 to 0.20, cell 3.05 to 4.2 V and 0.3 to 0.8 ohm, no-load current 12 to 20 mA, slack
    /// 0.8 to 1.2 mm, amplifier gain within 3 % with up to 15 mV of offset and 2 mA of noise, end and jams of 100 to
    /// 300 N/mm. A seed always gives the same capsule.
    #[must_use]
    pub fn varied(seed: u64) -> Self {
        let mut random = Random::new(seed);
        Self {
            stiffness: 0.5 * 8_f64.powf(random.unit()),
            worm_friction: random.between(0.10, 0.20),
            battery_mv: random.between(3_050.0, 4_200.0),
            battery_ohm: random.between(0.3, 0.8),
            no_load_a: random.between(0.012, 0.020),
            slack_mm: random.between(0.8, 1.2),
            sense_offset_mv: random.between(0.0, 15.0),
            sense_gain: random.between(0.97, 1.03),
            sense_noise_ma: 2.0,
            stop_n_per_mm: random.between(100.0, 300.0),
            ..Self::nominal()
        }
    }

    /// [`Parameters::varied`] with all effects.
    #[must_use]
    pub fn lifelike(seed: u64) -> Self {
        Self {
            effects: Effects::varied(seed),
            ..Self::varied(seed)
        }
    }

    /// Motor torque relative to the ideal one when the worm raises the load, and when it lowers it, with these
    /// coefficients of friction: tan(lead + angle of friction) / tan(lead), and its counterpart. The worm is
    /// self-locking, so lowering takes torque too.
    pub(crate) fn worm_factors(&self, raising: f64, lowering: f64) -> (f64, f64) {
        let lead = self.worm_lead_deg.to_radians().tan();
        (
            (lead + raising) / (1.0 - lead * raising) / lead,
            (lowering - lead) / (1.0 + lead * lowering) / lead,
        )
    }

    /// Thread per radian of the motor, mm.
    #[must_use]
    pub fn mm_per_rad(&self) -> f64 {
        self.spool_mm / (self.planetary_ratio * self.worm_ratio)
    }
}

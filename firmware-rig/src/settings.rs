//! The rig's settings: every number that belongs to one particular rig, with its unit and range.

use motion::{axis::Axis, run::Limits};

/// Settings of a rig. Lengths in um, speeds in um/s, accelerations in um/s2.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Screw, motor, microsteps, stroke.
    pub axis: Axis,
    /// What no plan may exceed.
    pub limits: Limits,
    /// Speed of the first homing pass.
    pub seek_um_s: u32,
    /// Speed of the second, measuring pass.
    pub locate_um_s: u32,
    /// Acceleration of homing moves.
    pub homing_accel_um_s2: u32,
    /// Deceleration of a category-1 stop.
    pub stop_accel_um_s2: u32,
    /// How far the first pass may travel beyond the stroke before the flag counts as missing.
    pub overtravel_um: u32,
    /// Distance between the two passes.
    pub pull_off_um: u32,
    /// Where the home flag's edge lies, measured from position 0.
    pub flag_um: u32,
    /// Largest residual of the position ledger that a run tolerates, in steps.
    pub ledger_limit_steps: u32,
    /// Silence of the host that counts as a lost link while the machine moves.
    pub link_timeout_us: u64,
}

impl Settings {
    /// The paper's rig: SFU1204 screw, 1/16 microsteps, 130 mm.
    pub const REFERENCE: Self = Self {
        axis: Axis::REFERENCE,
        limits: Limits {
            // 24 V, lead 4 mm: full torque to 740 rpm (motor model in the motion notes).
            max_speed_um_s: 49_000,
            max_accel_um_s2: 2_000_000,
            // 250 kHz: the DRV8825's limit, safe for every supported driver.
            min_interval_ticks: 400,
            // DIR changes by software inside the turn-around; see `periods`.
            min_turnaround_ticks: 100_000,
        },
        seek_um_s: 20_000,
        locate_um_s: 2_000,
        homing_accel_um_s2: 200_000,
        stop_accel_um_s2: 1_000_000,
        overtravel_um: 10_000,
        pull_off_um: 3_000,
        flag_um: 1_000,
        ledger_limit_steps: 8,
        link_timeout_us: 1_000_000,
    };

    /// The home flag's edge in steps from position 0.
    pub fn flag_steps(&self) -> i32 {
        self.steps(self.flag_um)
    }

    /// A length in whole steps.
    pub fn steps(&self, um: u32) -> i32 {
        let steps = self.axis.steps_within(motion::units::Micrometres(um));
        steps
            .and_then(|steps| i32::try_from(steps.0).ok())
            .unwrap_or(i32::MAX)
    }
}

//! The rig's settings: checks the values of flash and wire, and converts them to the units of the firmware.

use device::settings::Values;
use motion::{
    axis::{Acceleration, Axis, AxisError, Speed},
    run::Limits,
    trapezoid::StrokeProfile,
    units::{Micrometres, StepPosition, Steps, TICK_HZ, TICKS_PER_US},
};
use protocol::{
    error::{Field, Refusal},
    settings::{SettingKey, SettingRule},
};

/// Largest distance between the points where the home flag closes and opens (differential travel in the datasheet of a
/// switch). A stroke that turns within it meets no edge on its way home.
const FLAG_HYSTERESIS: Micrometres = Micrometres(1_000);

/// Settings of a rig. Lengths in um, speeds in um/s, accelerations in um/s2.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Screw, motor, microsteps, stroke.
    pub axis: Axis,
    pub limits: Limits,
    /// Width of a step pulse.
    pub pulse_ticks: u16,
    /// Speed of the first homing pass.
    pub seek_um_s: u32,
    /// Speed of the second, measuring pass.
    pub locate_um_s: u32,
    /// Acceleration of homing, jog and move.
    pub homing_accel: Acceleration,
    /// Deceleration of a category-1 stop and of a hold.
    pub stop_accel: Acceleration,
    /// How far the first pass may travel beyond the stroke before the flag counts as missing.
    pub overtravel_um: u32,
    /// The same in whole steps.
    pub overtravel: Steps,
    /// Distance between the two passes.
    pub pull_off: Steps,
    /// Where the home flag's edge lies, measured from position 0.
    pub flag_um: u32,
    /// The same in whole steps.
    pub flag: StepPosition,
    /// Longest time of homing.
    pub homing_timeout_us: u64,
    /// Largest residual of the step-loss check that a run tolerates, in steps.
    pub max_residual_steps: u32,
    /// Silence of the host that counts as a lost link while the machine moves.
    pub link_timeout_us: u64,
    /// A jog that is not renewed within this time stops.
    pub dead_man_us: u64,
}

impl Settings {
    /// The paper's rig, the default: SFU1204 screw, 1/16 microsteps, 130 mm.
    pub const REFERENCE: Self = match Self::new(&Values::DEFAULT) {
        Ok(settings) => settings,
        Err(_) => panic!("the defaults keep the rules"),
    };

    /// Checks the values and converts them.
    ///
    /// # Errors
    /// The first rule that the values break.
    pub const fn new(values: &Values) -> Result<Self, SettingRule> {
        use SettingKey as Key;
        let get = Values::get;
        let axis = match Axis::new(
            get(values, Key::LeadUm),
            get(values, Key::FullSteps) as u16,
            get(values, Key::Microsteps) as u16,
            get(values, Key::StrokeUm),
        ) {
            Ok(axis) => axis,
            Err(AxisError::FullSteps { .. }) => return Err(SettingRule::FullSteps),
            Err(AxisError::Microsteps { .. }) => return Err(SettingRule::Microsteps),
            Err(_) => return Err(SettingRule::StrokeHoldsAStep),
        };
        let pull_off_um = get(values, Key::PullOffUm);
        let pull_off = match axis.steps_within(Micrometres(pull_off_um)) {
            Some(steps) if steps.0 > 0 => steps,
            _ => return Err(SettingRule::PullOffHoldsAStep),
        };
        let flag_um = get(values, Key::FlagUm);
        let flag = match axis.position_um(Micrometres(flag_um)) {
            Some(flag) if flag_um + pull_off_um <= axis.stroke().0 => flag.signed(),
            _ => return Err(SettingRule::FlagWithinStroke),
        };
        let overtravel_um = get(values, Key::OvertravelUm);
        // Never fails: the ranges of these settings stay far below 2^32 steps and exclude zero.
        let (Some(overtravel), Ok(homing_accel), Ok(stop_accel)) = (
            axis.steps_within(Micrometres(overtravel_um)),
            axis.acceleration(get(values, Key::HomingAccelUmS2)),
            axis.acceleration(get(values, Key::StopAccelUmS2)),
        ) else {
            return Err(SettingRule::Microsteps);
        };
        let min_interval_ticks = (TICK_HZ as u32).div_ceil(get(values, Key::MaxStepHz));
        let pulse_ticks = get(values, Key::StepPulseNs).div_ceil(10);
        if 2 * pulse_ticks > min_interval_ticks {
            return Err(SettingRule::PulseWithinStep);
        }
        let (seek_um_s, locate_um_s) = (get(values, Key::SeekUmS), get(values, Key::LocateUmS));
        let fastest = if seek_um_s > 2 * locate_um_s {
            seek_um_s
        } else {
            2 * locate_um_s
        };
        let steps_per_rev = axis.steps_per_rev() as u64;
        if fastest as u64 * steps_per_rev * min_interval_ticks as u64
            > TICK_HZ * axis.lead().0 as u64
        {
            return Err(SettingRule::HomingWithinStepRate);
        }
        if matches!(get(values, Key::TelemetryMs), 1..=4) {
            return Err(SettingRule::TelemetryInterval);
        }
        Ok(Self {
            axis,
            limits: Limits {
                max_speed_um_s: get(values, Key::MaxSpeedUmS),
                max_accel_um_s2: get(values, Key::MaxAccelUmS2),
                min_interval_ticks,
                min_turnaround_ticks: get(values, Key::TurnaroundUs) * TICKS_PER_US as u32,
            },
            pulse_ticks: pulse_ticks as u16,
            seek_um_s,
            locate_um_s,
            homing_accel,
            stop_accel,
            overtravel_um,
            overtravel,
            pull_off,
            flag_um,
            flag,
            homing_timeout_us: get(values, Key::HomingTimeoutS) as u64 * 1_000_000,
            max_residual_steps: get(values, Key::MaxResidualSteps),
            link_timeout_us: get(values, Key::LinkTimeoutMs) as u64 * 1_000,
            dead_man_us: get(values, Key::DeadManMs) as u64 * 1_000,
        })
    }

    /// Whether the step times of homing's longest moves can be calculated exactly. On the finest axes the slowest
    /// speeds have none.
    pub fn homing_has_profiles(&self) -> bool {
        let flag = self.flag.distance_to(StepPosition::HOME).0;
        let moves = [
            (flag + self.overtravel.0, self.locate_um_s * 2),
            (
                self.axis.stroke_steps().0 + self.overtravel.0,
                self.seek_um_s,
            ),
            (2 * self.pull_off.0, self.locate_um_s),
        ];
        moves.into_iter().all(|(distance, speed_um_s)| {
            let speed = self.axis.speed(speed_um_s).ok();
            let profile = speed
                .map(|speed| StrokeProfile::from_speed(Steps(distance), speed, self.homing_accel));
            profile.is_some_and(|profile| profile.is_ok())
        })
    }

    /// Steps beyond the flag's opening edge after which the flag is certainly closed: 1 mm of hysteresis.
    pub fn closes_the_flag_after(&self) -> Steps {
        let hysteresis = self.axis.steps_within(FLAG_HYSTERESIS);
        Steps(hysteresis.map_or(u32::MAX, |steps| steps.0))
    }

    /// Converts the speed of a jog or a move.
    ///
    /// # Errors
    /// Zero, or above the limit.
    pub fn speed(&self, um_s: u32) -> Result<Speed, Refusal> {
        let max = self.limits.max_speed_um_s;
        let out_of_range = Refusal::OutOfRange {
            field: Field::SpeedUmS,
            requested: um_s.into(),
            min: 1,
            max: max.into(),
        };
        match self.axis.speed(um_s) {
            Ok(speed) if um_s <= max => Ok(speed),
            _ => Err(out_of_range),
        }
    }

    /// The profile of a jog or a move over a distance.
    ///
    /// # Errors
    /// Steps faster than the driver takes, or too slow for exact step times.
    pub fn move_profile(&self, distance: Steps, speed: Speed) -> Result<StrokeProfile, Refusal> {
        let profile = StrokeProfile::from_speed(distance, speed, self.homing_accel);
        let profile = profile.map_err(|_| Refusal::TooSlow)?;
        let (interval, least) = (profile.min_interval().0, self.limits.min_interval_ticks);
        if interval < u64::from(least) {
            return Err(Refusal::StepRateLimit {
                needed_hz: TICK_HZ.div_ceil(interval.max(1)),
                max_hz: TICK_HZ / u64::from(least),
            });
        }
        Ok(profile)
    }
}

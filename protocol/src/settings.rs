//! Settings of rig and capsule: key, owner, unit, range and default, in one table for device, host and manual.

use crate::system::DeviceKind;
use postcard_schema::Schema;
use serde::{Deserialize, Serialize};

macro_rules! settings {
    ($($key:ident of $owner:ident: $name:literal, $unit:literal, $min:literal..=$max:literal, $default:literal, $doc:literal;)*) => {
        /// Key of a setting. Index-coded, and the number of its record in flash: append only.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
        #[serde(rename_all = "snake_case")]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        #[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
        #[repr(u8)]
        pub enum SettingKey { $(#[doc = $doc] $key),* }

        impl SettingKey {
            /// All keys in the order of their numbers.
            pub const ALL: [Self; 0 $(+ { let _ = Self::$key; 1 })*] = [$(Self::$key),*];

            const OWNERS: [Owner; Self::ALL.len()] = [$(Owner::$owner),*];

            const RANGES: [Range; Self::ALL.len()] =
                [$(Range { min: $min, max: $max, default: $default }),*];

            /// Allowed values and the default.
            #[must_use]
            pub const fn range(self) -> Range {
                Self::RANGES[self as usize]
            }

            /// Name as people write it, with the unit.
            #[must_use]
            pub const fn name(self) -> &'static str {
                match self { $(Self::$key => $name),* }
            }

            /// Unit of the value; `1` for a pure number.
            #[must_use]
            pub const fn unit(self) -> &'static str {
                match self { $(Self::$key => $unit),* }
            }

            /// Description in one line.
            #[must_use]
            pub const fn doc(self) -> &'static str {
                match self { $(Self::$key => $doc),* }
            }
        }
    };
}

settings! {
    // Append only.
    LeadUm of Rig: "lead_um", "um", 500..=50_000, 4_000, "Travel of the carriage per turn of the screw.";
    FullSteps of Rig: "full_steps", "steps/turn", 200..=400, 200, "Full steps of the motor per turn: 200 or 400.";
    Microsteps of Rig: "microsteps", "1", 1..=256, 16, "Microsteps per full step, a power of two, as the driver is strapped.";
    StrokeUm of Rig: "stroke_um", "um", 1..=130_000, 130_000, "Longest stroke; no step leaves 0 to stroke in a run.";
    MaxSpeedUmS of Rig: "max_speed_um_s", "um/s", 1..=200_000, 49_000, "Highest speed of the carriage that is accepted.";
    MaxAccelUmS2 of Rig: "max_accel_um_s2", "um/s2", 1..=10_000_000, 2_000_000, "Highest acceleration that is accepted.";
    MaxStepHz of Rig: "max_step_hz", "Hz", 1_000..=250_000, 250_000, "Highest step rate that the driver takes.";
    StepPulseNs of Rig: "step_pulse_ns", "ns", 1_000..=10_000, 2_000, "Width of a step pulse; the pause after it is at least as long.";
    TurnaroundUs of Rig: "turnaround_us", "us", 400..=100_000, 1_000, "Least time between two strokes; DIR changes in it, 10 us after the last pulse or later.";
    SeekUmS of Rig: "seek_um_s", "um/s", 100..=100_000, 20_000, "Homing: speed of the first pass.";
    LocateUmS of Rig: "locate_um_s", "um/s", 100..=20_000, 2_000, "Homing: speed of the second, measuring pass.";
    HomingAccelUmS2 of Rig: "homing_accel_um_s2", "um/s2", 1_000..=10_000_000, 200_000, "Acceleration of homing, jog and move.";
    StopAccelUmS2 of Rig: "stop_accel_um_s2", "um/s2", 10_000..=10_000_000, 1_000_000, "Deceleration of stop and hold.";
    OvertravelUm of Rig: "overtravel_um", "um", 1_000..=20_000, 10_000, "Homing: how far beyond the stroke the flag is searched for.";
    PullOffUm of Rig: "pull_off_um", "um", 100..=20_000, 3_000, "Homing: distance between the two passes.";
    FlagUm of Rig: "flag_um", "um", 0..=20_000, 1_000, "Where the home flag's edge lies, from position 0.";
    HomingTimeoutS of Rig: "homing_timeout_s", "s", 5..=600, 60, "Homing that takes longer is a fault.";
    MaxResidualSteps of Rig: "max_residual_steps", "steps", 0..=10_000, 8, "Largest residual at the home flag that a run tolerates.";
    LinkTimeoutMs of Both: "link_timeout_ms", "ms", 200..=60_000, 1_000, "Silence of the host that counts as a lost link while something moves.";
    DeadManMs of Rig: "dead_man_ms", "ms", 50..=2_000, 300, "A jog that is not renewed within this time stops.";
    SwitchFilterUs of Rig: "switch_filter_us", "us", 5..=24, 21, "How long home flag and far limit must stay open or closed to count. A contact that bounces for long may be reported up to 3.5 ms late; its position is that of the first edge.";
    TelemetryMs of Both: "telemetry_ms", "ms", 0..=1_000, 0, "Interval of telemetry after a start: 5 to 1000, or 0 for none until it is asked for.";
    ButtonCycles of Rig: "button_cycles", "1", 1..=10_000, 5, "Run of the start button: cycles.";
    ButtonStrokeUm of Rig: "button_stroke_um", "um", 1..=130_000, 130_000, "Run of the start button: stroke.";
    ButtonTotalMs of Rig: "button_total_ms", "ms", 100..=86_400_000, 40_000, "Run of the start button: total duration.";
    ButtonAccelUmS2 of Rig: "button_accel_um_s2", "um/s2", 1..=10_000_000, 100_000, "Run of the start button: acceleration.";
    EndForceMa of Capsule: "end_force_ma", "mA", 60..=160, 132, "Current above the no-load current at which a calibration finds the folded end.";
    FoldUmS of Capsule: "fold_um_s", "um/s", 5_000..=11_000, 7_000, "Winding over the long way of a fold. No faster: a thread that catches has to stop the motor's momentum.";
    UnfoldUmS of Capsule: "unfold_um_s", "um/s", 5_000..=10_000, 10_000, "Paying out. No faster: without power the motor must stop within its last, slow millimetre.";
    LeastBatteryMv of Capsule: "least_battery_mv", "mV", 2_900..=4_000, 3_000, "Battery at rest below which a motion is refused.";
    LoadedBatteryMv of Capsule: "loaded_battery_mv", "mV", 2_400..=3_500, 2_700, "Battery under load below which a motion ends with LowBattery.";
    MotorMohm of Capsule: "motor_mohm", "mohm", 2_000..=20_000, 6_500, "Winding, both switches of the bridge, and cell: what bounds the current.";
    BackEmfUvCps of Capsule: "back_emf_uv_cps", "uV/cps", 50..=1_000, 207, "Back-EMF of the motor per encoder count per second.";
    ShortestFoldUm of Capsule: "shortest_fold_um", "um", 8_000..=24_000, 16_000, "A calibration that finds the end force before this was not unfolded.";
    LongestFoldUm of Capsule: "longest_fold_um", "um", 9_000..=28_000, 24_500, "A calibration that has not found the end force by then has no thread to wind.";
    FoldTimeoutMs of Capsule: "fold_timeout_ms", "ms", 2_000..=20_000, 8_000, "A fold that takes longer is a fault.";
    UnfoldTimeoutMs of Capsule: "unfold_timeout_ms", "ms", 2_000..=20_000, 4_000, "An unfolding that takes longer is a fault.";
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Owner {
    Rig,
    Capsule,
    Both,
}

impl Owner {
    const fn is(self, kind: DeviceKind) -> bool {
        match self {
            Self::Both => true,
            Self::Rig => matches!(kind, DeviceKind::Rig),
            Self::Capsule => matches!(kind, DeviceKind::Capsule),
        }
    }
}

/// Allowed values of a setting and its default.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Range {
    pub min: u32,
    pub max: u32,
    pub default: u32,
}

impl SettingKey {
    /// Whether a machine of this kind has the setting; the other kind refuses its key.
    #[must_use]
    pub const fn is_of(self, kind: DeviceKind) -> bool {
        Self::OWNERS[self as usize].is(kind)
    }

    /// Keys of a machine, in the order of their numbers.
    pub fn of(kind: DeviceKind) -> impl Iterator<Item = Self> {
        Self::ALL.into_iter().filter(move |key| key.is_of(kind))
    }

    #[must_use]
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.get(usize::from(number)).copied()
    }
}

macro_rules! rules {
    ($($rule:ident of $owner:ident: $text:literal, $doc:literal;)*) => {
        /// Rules between settings; each variant lists the settings that it is about. Index-coded: append only.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
        #[serde(rename_all = "snake_case")]
        pub enum SettingRule { $(#[doc = $doc] $rule),* }

        impl SettingRule {
            /// All rules in the order of their numbers.
            pub const ALL: [Self; 0 $(+ { let _ = Self::$rule; 1 })*] = [$(Self::$rule),*];

            const OWNERS: [Owner; Self::ALL.len()] = [$(Owner::$owner),*];

            /// The rule in words.
            #[must_use]
            pub const fn text(self) -> &'static str {
                match self { $(Self::$rule => $text),* }
            }
        }
    };
}

rules! {
    // Append only.
    FullSteps of Rig: "full_steps is 200 or 400", "[`SettingKey::FullSteps`].";
    Microsteps of Rig: "microsteps is a power of two", "[`SettingKey::Microsteps`].";
    StrokeHoldsAStep of Rig: "stroke_um must hold at least one step of lead_um / (full_steps x microsteps)", "[`SettingKey::StrokeUm`], lead and microsteps.";
    PullOffHoldsAStep of Rig: "pull_off_um must hold at least one step of lead_um / (full_steps x microsteps)", "[`SettingKey::PullOffUm`], lead and microsteps.";
    FlagWithinStroke of Rig: "flag_um + pull_off_um must not exceed stroke_um", "[`SettingKey::FlagUm`], [`SettingKey::PullOffUm`], [`SettingKey::StrokeUm`].";
    PulseWithinStep of Rig: "two of step_pulse_ns must fit between two steps at max_step_hz", "[`SettingKey::StepPulseNs`], [`SettingKey::MaxStepHz`].";
    HomingWithinStepRate of Rig: "seek_um_s and twice locate_um_s must not need more than max_step_hz with this lead and these microsteps", "[`SettingKey::SeekUmS`], [`SettingKey::LocateUmS`], [`SettingKey::MaxStepHz`], lead and microsteps.";
    TelemetryInterval of Both: "telemetry_ms is 0, or 5 to 1000", "[`SettingKey::TelemetryMs`].";
    FoldHasARange of Capsule: "shortest_fold_um must be at least 1000 below longest_fold_um", "[`SettingKey::ShortestFoldUm`], [`SettingKey::LongestFoldUm`].";
    LoadedBelowRest of Capsule: "loaded_battery_mv must be at least 200 below least_battery_mv", "[`SettingKey::LoadedBatteryMv`], [`SettingKey::LeastBatteryMv`].";
}

impl SettingRule {
    /// Rules of a machine's settings, in the order of their numbers.
    pub fn of(kind: DeviceKind) -> impl Iterator<Item = Self> {
        let rules = Self::ALL.into_iter();
        rules.filter(move |rule| Self::OWNERS[*rule as usize].is(kind))
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct GetSetting {
    pub key: SettingKey,
}

/// A setting and its value. As a request it changes the setting; as the answer to both requests it is the value in
/// force.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Setting {
    pub key: SettingKey,
    /// Value in the unit of the setting's name.
    pub value: u32,
}

/// Sets all settings back to their defaults and clears the name. A capsule's calibration and totals stay.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct FactoryReset;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct GetName;

/// Longest name, bytes.
pub const MAX_NAME: usize = 24;

/// The machine's name; empty = none. As a request it changes the name; as the answer to both requests it is the name in
/// force.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Name {
    /// UTF-8 text.
    pub name: heapless::String<MAX_NAME>,
}

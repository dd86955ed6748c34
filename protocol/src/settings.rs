//! Settings of the rig: key, unit, range and default, in one table for device, host and manual.

use postcard_schema::Schema;
use serde::{Deserialize, Serialize};

macro_rules! settings {
    ($($key:ident: $name:literal, $unit:literal, $min:literal..=$max:literal, $default:literal, $doc:literal;)*) => {
        /// Key of a setting. Index-coded, and the number of its record in flash: append only.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        #[repr(u8)]
        pub enum SettingKey { $(#[doc = $doc] $key),* }

        impl SettingKey {
            /// All keys in the order of their numbers.
            pub const ALL: [Self; 0 $(+ { let _ = Self::$key; 1 })*] = [$(Self::$key),*];

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
    LeadUm: "lead_um", "um", 500..=50_000, 4_000, "Travel of the carriage per turn of the screw.";
    FullSteps: "full_steps", "steps/turn", 200..=400, 200, "Full steps of the motor per turn: 200 or 400.";
    Microsteps: "microsteps", "1", 1..=256, 16, "Microsteps per full step, a power of two, as the driver is strapped.";
    StrokeUm: "stroke_um", "um", 1..=130_000, 130_000, "Longest stroke; no step leaves 0..stroke in a run.";
    MaxSpeedUmS: "max_speed_um_s", "um/s", 1..=200_000, 49_000, "Highest speed of the carriage that is accepted.";
    MaxAccelUmS2: "max_accel_um_s2", "um/s2", 1..=10_000_000, 2_000_000, "Highest acceleration that is accepted.";
    MaxStepHz: "max_step_hz", "Hz", 1_000..=250_000, 250_000, "Highest step rate that the driver takes.";
    StepPulseNs: "step_pulse_ns", "ns", 1_000..=10_000, 2_000, "Width of a step pulse; the pause after it is at least as long.";
    TurnaroundUs: "turnaround_us", "us", 400..=100_000, 1_000, "Least time between two strokes; DIR changes in it, 10 us after the last pulse or later.";
    SeekUmS: "seek_um_s", "um/s", 100..=100_000, 20_000, "Homing: speed of the first pass.";
    LocateUmS: "locate_um_s", "um/s", 100..=20_000, 2_000, "Homing: speed of the second, measuring pass.";
    HomingAccelUmS2: "homing_accel_um_s2", "um/s2", 1_000..=10_000_000, 200_000, "Acceleration of homing, jog and move.";
    StopAccelUmS2: "stop_accel_um_s2", "um/s2", 10_000..=10_000_000, 1_000_000, "Deceleration of stop and hold.";
    OvertravelUm: "overtravel_um", "um", 1_000..=20_000, 10_000, "Homing: how far beyond the stroke the flag is searched for.";
    PullOffUm: "pull_off_um", "um", 100..=20_000, 3_000, "Homing: distance between the two passes.";
    FlagUm: "flag_um", "um", 0..=20_000, 1_000, "Where the home flag's edge lies, from position 0.";
    HomingTimeoutS: "homing_timeout_s", "s", 5..=600, 60, "Homing that takes longer is a fault.";
    LedgerLimitSteps: "ledger_limit_steps", "steps", 0..=10_000, 8, "Largest residual at the home flag that a run tolerates.";
    LinkTimeoutMs: "link_timeout_ms", "ms", 200..=60_000, 1_000, "Silence of the host that counts as a lost link while something moves.";
    DeadManMs: "dead_man_ms", "ms", 50..=2_000, 300, "A jog that is not renewed within this time stops.";
    SwitchFilterUs: "switch_filter_us", "us", 5..=24, 21, "How long home flag and far limit must stay open or closed to count. A contact that bounces for long may be told up to 3.5 ms late; the position is that of its first edge.";
    TelemetryMs: "telemetry_ms", "ms", 0..=1_000, 0, "Interval of telemetry after a start: 5..=1000, or 0 for none until it is asked for.";
    ButtonCycles: "button_cycles", "1", 1..=10_000, 5, "Run of the start button: cycles.";
    ButtonStrokeUm: "button_stroke_um", "um", 1..=130_000, 130_000, "Run of the start button: stroke.";
    ButtonTotalMs: "button_total_ms", "ms", 100..=86_400_000, 40_000, "Run of the start button: total duration.";
    ButtonAccelUmS2: "button_accel_um_s2", "um/s2", 1..=10_000_000, 100_000, "Run of the start button: acceleration.";
}

/// Allowed values of a setting and its default.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Range {
    /// Smallest allowed value.
    pub min: u32,
    /// Largest allowed value.
    pub max: u32,
    /// Value of a new rig.
    pub default: u32,
}

impl SettingKey {
    /// The key with this number.
    #[must_use]
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.get(usize::from(number)).copied()
    }
}

/// Rules between settings; each variant lists the settings that it is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SettingRule {
    /// [`SettingKey::FullSteps`].
    FullSteps,
    /// [`SettingKey::Microsteps`].
    Microsteps,
    /// [`SettingKey::StrokeUm`], lead and microsteps.
    StrokeHoldsAStep,
    /// [`SettingKey::PullOffUm`], lead and microsteps.
    PullOffHoldsAStep,
    /// [`SettingKey::FlagUm`], [`SettingKey::PullOffUm`], [`SettingKey::StrokeUm`].
    FlagWithinStroke,
    /// [`SettingKey::StepPulseNs`], [`SettingKey::MaxStepHz`].
    PulseWithinStep,
    /// [`SettingKey::SeekUmS`], [`SettingKey::LocateUmS`], [`SettingKey::MaxStepHz`], lead and microsteps.
    HomingWithinStepRate,
    /// [`SettingKey::TelemetryMs`].
    TelemetryInterval,
}

impl SettingRule {
    /// The rule in words.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Self::FullSteps => "full_steps is 200 or 400",
            Self::Microsteps => "microsteps is a power of two",
            Self::StrokeHoldsAStep => {
                "stroke_um must hold at least one step of lead_um / (full_steps x microsteps)"
            }
            Self::PullOffHoldsAStep => {
                "pull_off_um must hold at least one step of lead_um / (full_steps x microsteps)"
            }
            Self::FlagWithinStroke => "flag_um + pull_off_um must not exceed stroke_um",
            Self::PulseWithinStep => {
                "two of step_pulse_ns must fit between two steps at max_step_hz"
            }
            Self::HomingWithinStepRate => {
                "seek_um_s and twice locate_um_s must not need more than max_step_hz with this lead and these microsteps"
            }
            Self::TelemetryInterval => "telemetry_ms is 0, or 5 to 1000",
        }
    }
}

/// Asks for the value of a setting.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct GetSetting {
    /// The setting.
    pub key: SettingKey,
}

/// A setting and its value. As a request it changes the setting; as the answer to both requests it is what is in force.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Setting {
    /// The setting.
    pub key: SettingKey,
    /// Value in the unit of the setting's name.
    pub value: u32,
}

/// Sets all settings back to their defaults and clears the name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FactoryReset;

/// Asks for the rig's name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct GetName;

/// Longest name, bytes.
pub const MAX_NAME: usize = 24;

/// The rig's name; empty = none. As a request it changes the name; as the answer to both requests it says what it is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Name {
    /// UTF-8 text.
    pub name: heapless::String<MAX_NAME>,
}

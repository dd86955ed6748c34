//! Why a request was not carried out: refusals by the machine and errors of the wire. Their texts say what to do.

use crate::{
    capsule::{CapsuleFault, CapsuleState},
    rig::{HomingPhase, RigFault, RigState, Switch},
    settings::{SettingKey, SettingRule},
};
use core::fmt;
use postcard_schema::Schema;
use serde::{Deserialize, Serialize};

/// The request was understood and refused. Nothing moved, nothing changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
pub enum Refusal {
    /// Another machine serves this request.
    WrongDevice,
    /// Host and device were built from different protocols.
    Incompatible,
    RigFaulted(RigFault),
    CapsuleFaulted(CapsuleFault),
    CauseStillPresent,
    NothingToAcknowledge,
    /// The last start was caused by a watchdog or panic that has not been acknowledged.
    AcknowledgeFirst,
    /// The position is unknown.
    NotHomed,
    /// The thread's position is unknown.
    NotReferenced,
    /// Not possible in this state of the rig.
    RigBusy(RigState),
    /// Not possible in this state of the capsule.
    CapsuleBusy(CapsuleState),
    OutOfRange {
        field: Field,
        requested: u64,
        min: u64,
        max: u64,
    },
    /// The duration is too short for the stroke at this acceleration.
    TooFast {
        requested_us: u64,
        /// Shortest possible with the requested acceleration, within the limits of speed and step rate.
        min_us: u64,
        /// Least acceleration with which the same run would be accepted in the requested time; `u64::MAX` if there is
        /// none within the limits, delay and dwells included.
        min_accel_um_s2: u64,
    },
    /// The plan needs a speed that the axis must not reach.
    SpeedLimit {
        /// Peak speed of the plan.
        needed_um_s: u64,
        /// Highest speed allowed.
        max_um_s: u64,
    },
    /// The plan needs steps faster than the driver accepts.
    StepRateLimit {
        /// Highest step rate of the plan.
        needed_hz: u64,
        /// Highest step rate allowed.
        max_hz: u64,
    },
    /// The numbers are too large for the exact arithmetic: the strokes are too slow or ramps too long.
    TooSlow,
    /// The carriage is not at home; home first.
    NotAtHome {
        position_um: i32,
    },
    /// The battery is too low to finish an actuation.
    BatteryLow {
        battery_mv: u16,
        /// Least voltage needed.
        min_mv: u16,
    },
    /// The carriage or the thread already is where the request would take it.
    AlreadyThere,
    SettingRange {
        key: SettingKey,
        requested: u32,
    },
    /// A setting's value breaks a rule between settings.
    SettingRule {
        key: SettingKey,
        rule: SettingRule,
    },
    /// The flash could not be written; the old value stays in force.
    StorageFailed,
    NothingToHold,
    NothingToResume,
    /// The E-stop loop is open; no fault is latched.
    LoopOpen,
    /// Home flag and far limit are both open; no fault is latched.
    BothSwitchesOpen,
    /// The far limit is open; no fault is latched.
    FarLimitOpen,
    /// The supply is too low to write the flash or to begin a motion; nothing has changed.
    SupplyLow,
    /// A name has a character that cannot be printed.
    NameNotPrintable,
    NotCalibrated,
    /// The thread's position is too uncertain to move it.
    UnfoldByHand,
}

/// The values that a request checks against a range.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
pub enum Field {
    Cycles,
    StrokeUm,
    TotalUs,
    AccelUmS2,
    ForwardUmS,
    ReturnUmS,
    FarDwellUs,
    HomeDwellUs,
    StartDelayUs,
    PeriodMs,
    PositionUm,
    SpeedUmS,
    ThreadUm,
}

/// A frame with a good CRC whose content could not be used. Nothing moved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub enum WireError {
    /// No session with this number: say Hello (the device may have been reset).
    NoSession,
    /// The body is not a request of this protocol.
    Malformed,
    /// This sequence number was already used for another request.
    SequenceReused,
    /// The sequence number is older than the answers that the cache still holds.
    Stale,
}

impl fmt::Display for Field {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Field::Cycles => "cycles",
            Field::StrokeUm => "stroke (um)",
            Field::TotalUs => "duration (us)",
            Field::AccelUmS2 => "acceleration (um/s2)",
            Field::ForwardUmS => "forward speed (um/s)",
            Field::ReturnUmS => "return speed (um/s)",
            Field::FarDwellUs => "dwell at the far end (us)",
            Field::HomeDwellUs => "dwell at home (us)",
            Field::StartDelayUs => "start delay (us)",
            Field::PeriodMs => "telemetry period (ms)",
            Field::PositionUm => "position (um)",
            Field::SpeedUmS => "speed (um/s)",
            Field::ThreadUm => "thread (um)",
        })
    }
}

impl fmt::Display for HomingPhase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            HomingPhase::Clear => "leaving the flag",
            HomingPhase::Seek => "first pass",
            HomingPhase::PullOff => "pulling off",
            HomingPhase::Locate => "second pass",
            HomingPhase::ToZero => "to zero",
        })
    }
}

impl fmt::Display for RigFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            RigFault::EStopLoop => f.write_str(
                "the E-stop / end-of-travel loop opened: release the button (or fix the loop), acknowledge, home",
            ),
            RigFault::EStopFrame => f.write_str("emergency stop by command: acknowledge, then home"),
            RigFault::FarLimit => f.write_str(
                "the far limit opened: check the stroke setting and the switch's wire, acknowledge, home",
            ),
            RigFault::FlagNotFound(phase) => write!(
                f,
                "homing ({phase}): the home flag was not found within the allowed travel, or closed again or opened elsewhere: check that the carriage moves, and the flag's switch and wire",
            ),
            RigFault::HomingTimeout(phase) => write!(
                f,
                "homing ({phase}) took too long: check the settings seek_um_s and homing_timeout_s, acknowledge, home",
            ),
            RigFault::FlagStuck => f.write_str(
                "homing: the home flag stays open over the whole pull-off: check the switch for dirt and its wire for a break",
            ),
            RigFault::BothSwitchesOpen => f.write_str(
                "home flag and far limit are both open: plug in the switch cable",
            ),
            RigFault::LostSteps { residual_steps } => write!(
                f,
                "the home flag was met {residual_steps} steps from where it should be: steps were lost; check load, current and speed, acknowledge, home"
            ),
            RigFault::ReadBack { commanded, counted } => write!(
                f,
                "the pin carried {counted} steps where {commanded} were commanded: check the read-back jumper D2-A0, acknowledge, home"
            ),
            RigFault::Underrun => f.write_str(
                "the step generator ran out of prepared steps and stopped the pulses: acknowledge, home, and report this",
            ),
            RigFault::WindowGuard => f.write_str(
                "the step generator refused a step outside the stroke: acknowledge, home, and report this",
            ),
            RigFault::Watchdog => f.write_str("a task hung and the watchdog reset the device: acknowledge, then home"),
            RigFault::Panic => f.write_str("the firmware stopped itself and restarted: acknowledge, then home"),
            RigFault::ClockMissing => f.write_str(
                "the board gets no 8 MHz clock from its ST-LINK, and without it nothing moves: check jumpers JP5 and JP1 and bridges SB16 and SB50 (a board MB1136 C-01 lacks them); the rig restarts when the clock starts",
            ),
            RigFault::ClockFailed => f.write_str(
                "the 8 MHz clock from the ST-LINK stopped: supply board and ST-LINK so that they run without the USB cable, acknowledge, home",
            ),
            RigFault::SwitchNoise(switch) => write!(
                f,
                "the line of the {} is too noisy to be watched: check its pull-up, its shield and the motor's wires, acknowledge, home",
                match switch {
                    Switch::HomeFlag => "home flag",
                    Switch::FarLimit => "far limit",
                }
            ),
        }
    }
}

impl fmt::Display for CapsuleFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            CapsuleFault::Jam { thread_um } => write!(
                f,
                "something held the thread at {}.{:03} mm of thread: free the origami, acknowledge, unfold",
                thread_um / 1000,
                (thread_um % 1000).unsigned_abs()
            ),
            CapsuleFault::EncoderLost => f.write_str(
                "the motor turned and the encoder did not count: check the encoder's wires, acknowledge, unfold by hand, calibrate",
            ),
            CapsuleFault::OverCurrent { current_ma } => {
                write!(f, "motor current {current_ma} mA: check for a short circuit, acknowledge, unfold")
            }
            CapsuleFault::LowBattery { battery_mv } => {
                write!(f, "battery at {battery_mv} mV: charge or change it, then acknowledge")
            }
            CapsuleFault::Timeout => f.write_str("the actuation did not end in time: acknowledge, unfold"),
            CapsuleFault::DriverFault => f.write_str("the motor driver reports a fault: check motor and supply, acknowledge, unfold"),
            CapsuleFault::EStopFrame => f.write_str("emergency stop by command: acknowledge, then unfold"),
            CapsuleFault::Watchdog => f.write_str("a task hung and the watchdog reset the device: acknowledge, then see `retrograde info` for the position of the thread"),
            CapsuleFault::SlipOrBreak => f.write_str(
                "the thread pulls less than at the calibration: it has slipped or is broken; acknowledge, unfold, check thread, knot and spool, calibrate",
            ),
            CapsuleFault::BridgeSilent => f.write_str(
                "the motor was driven and drew no current: check its wires and the bridge's supply, acknowledge, unfold",
            ),
            CapsuleFault::SenseLost => f.write_str(
                "the motor ran and no current was measured: check the shunt amplifier and its wire, acknowledge, unfold",
            ),
            CapsuleFault::NotUnfolded { wound_um } => write!(
                f,
                "the end force came after {}.{:03} mm of thread: a calibration has to begin unfolded; free and unfold the origami, acknowledge, calibrate",
                wound_um / 1000,
                (wound_um % 1000).unsigned_abs()
            ),
            CapsuleFault::SenseOrEncoder => f.write_str(
                "voltage, current and counts of the motor do not agree: the encoder loses counts or the current amplifier is wrong; check both, acknowledge, unfold by hand, calibrate",
            ),
            CapsuleFault::Panic => f.write_str("the firmware stopped itself and restarted: acknowledge, then see `retrograde info` for the position of the thread"),
        }
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Refusal::WrongDevice => f.write_str("this device does not serve this request: check which port is which"),
            Refusal::Incompatible => f.write_str("host tool and firmware were built from different protocols: flash the matching firmware"),
            Refusal::RigFaulted(fault) => write!(f, "a fault is latched: {fault}"),
            Refusal::CapsuleFaulted(fault) => write!(f, "a fault is latched: {fault}"),
            Refusal::CauseStillPresent => f.write_str("the cause of the fault is still present: remove it, then acknowledge"),
            Refusal::NothingToAcknowledge => f.write_str("no fault is latched"),
            Refusal::AcknowledgeFirst => f.write_str("the device restarted after a failure: read its last words, then acknowledge"),
            Refusal::NotHomed => f.write_str("the position is unknown: home first"),
            Refusal::NotReferenced => f.write_str("the thread position is uncertain: reference first"),
            Refusal::RigBusy(state) => write!(f, "not possible while the rig is {}", match state {
                RigState::Unhomed => "not homed",
                RigState::Homing => "homing",
                RigState::Ready => "at rest",
                RigState::Running => "running",
                RigState::Held => "held",
                RigState::Stopping => "stopping",
                RigState::Faulted => "faulted",
                RigState::Moving => "moving",
            }),
            Refusal::CapsuleBusy(state) => write!(f, "not possible while the capsule is {}", match state {
                CapsuleState::Unreferenced => concat!("not referenced", " and has moved within the last half second: try again in a second"),
                CapsuleState::Referencing => "referencing",
                CapsuleState::Unfolded => concat!("unfolded", " and has moved within the last half second: try again in a second"),
                CapsuleState::Folding => "folding",
                CapsuleState::Folded => concat!("folded", " and has moved within the last half second: try again in a second"),
                CapsuleState::Unfolding => "unfolding",
                CapsuleState::Stopped => concat!("stopped between its ends", " and has moved within the last half second: try again in a second"),
                CapsuleState::Faulted => concat!("faulted", " and has moved within the last half second: try again in a second"),
                CapsuleState::Checking => "checking that it is folded",
            }),
            Refusal::OutOfRange { field, requested, min, max } => {
                write!(f, "{field} is {requested}, allowed is {min} to {max}")
            }
            Refusal::TooFast { requested_us, min_us, min_accel_um_s2: u64::MAX } => write!(
                f,
                "{requested_us} us is too short: with the delay and the dwells no acceleration within the limits is enough; at this acceleration the run takes at least {min_us} us"
            ),
            Refusal::TooFast { requested_us, min_us, min_accel_um_s2 } => write!(
                f,
                "{requested_us} us is too short: at this acceleration the run takes at least {min_us} us; to do it in the requested time needs at least {min_accel_um_s2} um/s2"
            ),
            Refusal::SpeedLimit { needed_um_s, max_um_s } => {
                write!(f, "needs {needed_um_s} um/s, the axis allows {max_um_s} um/s: give it more time, or less speed; a higher acceleration helps only where the mean speed of a stroke is allowed")
            }
            Refusal::StepRateLimit { needed_hz, max_hz } => {
                write!(f, "needs {needed_hz} steps/s, the driver accepts {max_hz} steps/s: use fewer microsteps or more time")
            }
            Refusal::TooSlow => f.write_str("the strokes are too slow for the exact step arithmetic: give less time or a higher acceleration"),
            Refusal::NotAtHome { position_um } => {
                write!(f, "the carriage is at {position_um} um, a run starts at 0: move to 0 or home first")
            }
            Refusal::BatteryLow { battery_mv, min_mv } => {
                write!(f, "the battery is at {battery_mv} mV, {min_mv} mV are needed: charge or change it; a reset measures it again")
            }
            Refusal::AlreadyThere => f.write_str("already there: nothing to do"),
            Refusal::SettingRange { key, requested } => {
                let range = key.range();
                write!(f, "{} is {requested}, allowed is {} to {}", key.name(), range.min, range.max)
            }
            Refusal::SettingRule { key, rule } => {
                write!(f, "{} cannot have this value: {}", key.name(), rule.text())
            }
            Refusal::StorageFailed => f.write_str("the flash could not be written, so nothing has changed. Try again; if it happens twice, set everything back to the defaults; if that fails too, replace the board"),
            Refusal::NothingToHold => f.write_str("no run is in progress, so none can be held"),
            Refusal::NothingToResume => f.write_str("no run is held"),
            Refusal::LoopOpen => f.write_str("the E-stop / end-of-travel loop is open: release the button, or fix the loop"),
            Refusal::BothSwitchesOpen => f.write_str("home flag and far limit are both open: plug in the switch cable"),
            Refusal::FarLimitOpen => f.write_str("the far limit is open: check its switch and its wire, or move the carriage off it by hand"),
            Refusal::SupplyLow => f.write_str("the supply is below 2.7 V: nothing is stored, and no motion of the rig begins; check the supply, then try again"),
            Refusal::NotCalibrated => f.write_str("this capsule has no calibration: unfold it, then `retrograde capsule calibrate`"),
            Refusal::UnfoldByHand => f.write_str("too little is known of the thread's position: unfold the origami by hand, the thread slack by 1 mm, then `retrograde capsule calibrate`"),
            Refusal::NameNotPrintable => f.write_str("the name has a character that cannot be printed: use letters, digits, spaces and signs"),
        }
    }
}

impl fmt::Display for WireError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            WireError::NoSession => "the device knows no such session (it may have been reset): connect again",
            WireError::Malformed => "the device could not read the request: the protocols differ; flash the matching firmware",
            WireError::SequenceReused => "a sequence number was used twice: another program may be using the same port",
            WireError::Stale => "the request was overtaken by newer ones",
        })
    }
}

impl core::error::Error for Refusal {}
impl core::error::Error for WireError {}

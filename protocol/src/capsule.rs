//! Messages of the capsule.

use crate::settings::SettingKey;
use postcard_schema::Schema;
use serde::{Deserialize, Serialize};

/// Finds the folded end by the pull of the thread, after the count has become uncertain, and unfolds. Without a
/// calibration it acts as [`Calibrate`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Reference;

/// Winds the thread to the folded end by count, then checks by the motor current that it pulls.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Fold;

/// Pays the thread out to zero by count, and never past it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Unfold;

/// Calibrates a capsule that is unfolded: winds slowly to the end force, measures the length, pays out, stores it in
/// flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Calibrate;

/// Checks that the thread of a folded capsule pulls, and leaves it folded. A capsule that is not folded folds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct CheckFolded;

/// Winds or pays out to a length of thread between zero and the calibrated end, and stays there. A broken thread is
/// detected only at the end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct FoldTo {
    /// Thread wound up, from zero.
    pub thread_um: i32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub struct ActuationAccepted {
    /// Number of the actuation, counted from 1 since the device started.
    pub actuation: u32,
    /// It ends within this time, complete or with a fault.
    pub timeout_ms: u32,
}

/// State of the capsule.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
pub enum CapsuleState {
    /// The thread's position is unknown.
    Unreferenced,
    /// Finding the zero.
    Referencing,
    /// At rest, thread paid out.
    Unfolded,
    Folding,
    /// At rest, folded; the worm holds with the motor off.
    Folded,
    /// Paying out.
    Unfolding,
    /// At rest between the ends after a stop; the worm holds.
    Stopped,
    Faulted,
    /// Checking that the thread pulls.
    Checking,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub enum CapsuleFault {
    /// The motor stalled before its target at full current: something holds the thread.
    Jam {
        /// Thread on the spool there.
        thread_um: i32,
    },
    /// The motor turned, but the encoder did not count, or counted in the wrong direction.
    EncoderLost,
    /// Current above the driver's limit.
    OverCurrent { current_ma: u16 },
    /// Battery below the limit.
    LowBattery { battery_mv: u16 },
    /// The actuation did not end in time.
    Timeout,
    /// The bridge reports a fault (nFAULT).
    DriverFault,
    #[serde(rename(serialize = "estop_frame", deserialize = "estop_frame"))]
    EStopFrame,
    /// A task did not check in; the device was reset.
    Watchdog,
    /// The firmware panicked or hit a processor fault; the device was reset.
    Panic,
    /// At the folded end the thread does not pull as it did at the calibration: it has slipped, or is broken.
    SlipOrBreak,
    /// The bridge was driven, but no current flowed, and the motor stood or coasted.
    BridgeSilent,
    /// The motor turned, or loaded the battery, but no current was measured.
    SenseLost,
    /// A calibration found the end force after too little thread: it did not begin unfolded, or something blocks.
    NotUnfolded {
        /// Thread wound from the start to the end force.
        wound_um: i32,
    },
    /// Voltage, current and speed of the motor do not agree: the encoder loses counts, or the current amplifier is
    /// wrong.
    SenseOrEncoder,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct GetCapsuleStatus;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct CapsuleStatus {
    /// Device time since its start.
    pub time_us: u64,
    pub state: CapsuleState,
    /// The latched fault, if there is one.
    pub fault: Option<CapsuleFault>,
    /// The thread position is known to 0.25 mm, and the capsule is calibrated.
    pub referenced: bool,
    /// Lower bound of the thread on the spool, by the encoder.
    pub thread_um: i32,
    /// How much more there may be; none if that is unknown, so that the capsule has to be unfolded by hand.
    pub uncertainty_um: Option<u32>,
    /// Thread that stays on the spool after unfolding, as measured by the last reference.
    pub remaining_um: u32,
    pub current_ma: u16,
    pub battery_mv: u16,
    /// Number of the present or last actuation.
    pub actuation: u32,
    /// After a watchdog reset or a panic: motion is refused until [`crate::system::Acknowledge`].
    pub needs_acknowledge: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub enum ActuationKind {
    /// [`Reference`].
    Reference,
    /// [`Fold`].
    Fold,
    /// [`Unfold`].
    Unfold,
    /// [`Calibrate`].
    Calibrate,
    /// [`CheckFolded`].
    CheckFolded,
    /// [`FoldTo`].
    FoldTo,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub enum ActuationOutcome {
    /// No actuation since the start of the device.
    None,
    /// Still going on.
    Running,
    Complete,
    /// Stopped on request; the thread position is kept.
    Stopped,
    /// Ended by link loss; the thread position is kept.
    LinkLost,
    Faulted(CapsuleFault),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct GetActuationRecord;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub struct ActuationRecord {
    pub actuation: u32,
    pub kind: ActuationKind,
    /// How it ended, or `Running`.
    pub outcome: ActuationOutcome,
    /// From the first drive until the motor is off.
    pub duration_ms: u32,
    pub thread_um: i32,
    /// Current that ended the motion, or the last one measured before it ended.
    pub end_current_ma: u16,
    /// Largest current, without the inrush that is blanked.
    pub peak_current_ma: u16,
    /// Thread position at which the load first rose above the no-load current; 0 = never.
    pub engaged_um: i32,
    /// Energy drawn by the motor, integrated from battery voltage and current.
    pub energy_mj: u32,
    /// Lowest battery voltage under way.
    pub min_battery_mv: u16,
}

/// Asks for a part of the recording of the present or last actuation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct GetTrace {
    /// First reading wanted; 0 is the oldest one kept.
    pub from: u32,
}

/// Most readings in one part of a recording.
pub const MAX_TRACE_POINTS: usize = 13;

/// Readings of an actuation that the capsule keeps, 1 ms apart: those of a whole fold at the default speed, with a
/// margin.
pub const KEPT_TRACE_POINTS: usize = 4_200;

/// One reading of a recording; 1 ms apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct TracePoint {
    /// Thread wound up, by the encoder.
    pub thread_um: i32,
    pub current_ma: u16,
    /// Battery voltage, to 10 mV, 2.00 to 4.55 V.
    pub battery_mv: u16,
    /// Voltage applied to the motor until the next reading, to 40 mV, signed: positive winds. 0 is off or braked.
    pub drive_mv: i16,
}

/// A part of the recording of an actuation: its last [`KEPT_TRACE_POINTS`] readings.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Trace {
    /// The actuation. A new number means that a new recording began.
    pub actuation: u32,
    /// Number of readings kept.
    pub total: u16,
    /// Readings from the requested one on; fewer than [`MAX_TRACE_POINTS`] at the end.
    pub points: heapless::Vec<TracePoint, MAX_TRACE_POINTS>,
}

/// Asks for the totals and the calibration in flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct GetCapsuleTotals;

/// The totals that the capsule keeps in flash, and its calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct CapsuleTotals {
    pub actuations: u32,
    pub energy_mj: u64,
    /// Measured by [`Calibrate`]; none before.
    pub calibration: Option<CapsuleCalibration>,
}

/// Properties of one capsule, as measured by [`Calibrate`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct CapsuleCalibration {
    /// Thread from the unfolded end to the folded one.
    pub folded_um: i32,
    /// Current of the motor with a slack thread.
    pub no_load_ma: u16,
    /// Current of winding the folded thread less that of paying it out.
    pub pull_ma: u16,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub enum CapsuleEvent {
    /// An actuation began.
    Started {
        actuation: u32,
        kind: ActuationKind,
    },
    Ended {
        actuation: u32,
        outcome: ActuationOutcome,
    },
    Faulted(CapsuleFault),
    /// The flash could not be written. The capsule tries again every 10 s at rest; until it succeeds, a reset loses
    /// totals or calibration.
    StorageFailed,
    /// A setting was changed.
    SettingChanged(SettingKey),
    /// All settings are at their defaults, and the name is cleared.
    SettingsReset,
    /// Settings in flash cannot be used; their defaults are in force, or all defaults if they contradict each other.
    SettingsUnusable,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct CapsuleTelemetry {
    /// Device time since its start.
    pub time_us: u64,
    pub state: CapsuleState,
    /// Thread wound up, by the encoder.
    pub thread_um: i32,
    pub current_ma: u16,
    pub battery_mv: u16,
    /// Voltage applied to the motor, signed: positive winds.
    pub drive_mv: i16,
}

//! Messages of the capsule.

use postcard_schema::Schema;
use serde::{Deserialize, Serialize};

/// Finds the thread's zero: unwinds to the hard reference, then winds to the point where the thread engages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Reference;

/// Winds the thread until the force (motor current) in the end window shows that the origami is folded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Fold;

/// Pays the thread out to the referenced zero by encoder count, and never past it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Unfold;

/// An actuation was accepted and has begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ActuationAccepted {
    /// Number of the actuation, counted from 1 since the device started.
    pub actuation: u32,
    /// It ends by itself within this time, complete or with a fault.
    pub timeout_ms: u32,
}

/// State of the capsule (design: "Capsule states").
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum CapsuleState {
    /// The thread's position is unknown.
    Unreferenced,
    /// Finding the zero.
    Referencing,
    /// At rest, thread paid out.
    Unfolded,
    /// Winding.
    Folding,
    /// At rest, folded; the worm holds with the motor off.
    Folded,
    /// Paying out.
    Unfolding,
    /// At rest between the ends after a stop; the worm holds.
    Stopped,
    /// A fault is latched.
    Faulted,
}

/// Why the capsule latched a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum CapsuleFault {
    /// The end current was reached before the end window: something blocks the fold.
    Jam {
        /// Thread wound up to there.
        thread_um: i32,
    },
    /// The end window was passed at no-load current.
    ThreadBroken,
    /// The motor was driven and the encoder stood still, without stall current.
    EncoderLost,
    /// Current above the driver's limit.
    OverCurrent {
        /// Measured motor current.
        current_ma: u16,
    },
    /// Battery below the limit.
    LowBattery {
        /// Measured battery voltage.
        battery_mv: u16,
    },
    /// The actuation did not end in time.
    Timeout,
    /// The bridge reports a fault (nFAULT).
    DriverFault,
    /// Emergency stop by frame.
    EStopFrame,
    /// A task did not check in; the device was reset.
    Watchdog,
    /// The firmware panicked or hit a processor fault; the device was reset.
    Panic,
}

/// Asks for the capsule's status.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct GetCapsuleStatus;

/// Status of the capsule.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CapsuleStatus {
    /// Device time since its start.
    pub time_us: u64,
    /// State of the machine.
    pub state: CapsuleState,
    /// The latched fault, if there is one.
    pub fault: Option<CapsuleFault>,
    /// The thread position can be trusted.
    pub referenced: bool,
    /// Thread wound up, by the encoder.
    pub thread_um: i32,
    /// Motor current.
    pub current_ma: u16,
    /// Battery voltage.
    pub battery_mv: u16,
    /// Number of the present or last actuation.
    pub actuation: u32,
    /// After a watchdog reset or a panic: motion is refused until [`crate::system::Acknowledge`].
    pub needs_acknowledge: bool,
}

/// The kinds of actuation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ActuationKind {
    /// [`Reference`].
    Reference,
    /// [`Fold`].
    Fold,
    /// [`Unfold`].
    Unfold,
}

/// How an actuation ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ActuationOutcome {
    /// No actuation since the start of the device.
    None,
    /// Still going on.
    Running,
    /// Reached its end position.
    Complete,
    /// Stopped on request; the thread position is kept.
    Stopped,
    /// Ended by link loss; the thread position is kept.
    LinkLost,
    /// Ended by a fault.
    Faulted(CapsuleFault),
}

/// Asks for the record of the last actuation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct GetActuationRecord;

/// Record of an actuation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ActuationRecord {
    /// Number of the actuation.
    pub actuation: u32,
    /// What was asked for.
    pub kind: ActuationKind,
    /// How it ended, or that it goes on.
    pub outcome: ActuationOutcome,
    /// From the first drive until the motor is off.
    pub duration_ms: u32,
    /// Thread position at the end.
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

/// What happened on the capsule.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum CapsuleEvent {
    /// An actuation began.
    Started {
        /// Number of the actuation.
        actuation: u32,
        /// What was asked for.
        kind: ActuationKind,
    },
    /// An actuation ended.
    Ended {
        /// Number of the actuation.
        actuation: u32,
        /// How it ended.
        outcome: ActuationOutcome,
    },
    /// A fault was latched.
    Faulted(CapsuleFault),
}

/// Telemetry of the capsule.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CapsuleTelemetry {
    /// Device time since its start.
    pub time_us: u64,
    /// State of the machine.
    pub state: CapsuleState,
    /// Thread wound up, by the encoder.
    pub thread_um: i32,
    /// Motor current.
    pub current_ma: u16,
    /// Battery voltage.
    pub battery_mv: u16,
    /// Voltage applied to the motor, signed: positive winds.
    pub drive_mv: i16,
}

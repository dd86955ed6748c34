//! Messages that both machines share: identity, the session's upkeep, events, urgent stops.

use crate::{capsule, rig};
use heapless::Vec;
use postcard_schema::Schema;
use serde::{Deserialize, Serialize};

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Version {
    /// Raised when an existing message changes.
    pub major: u8,
    /// Raised when a row is appended.
    pub minor: u8,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
pub enum DeviceKind {
    Rig,
    Capsule,
}

/// Opens a session. The encoding of this message never changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Hello {
    pub protocol: Version,
    /// [`crate::table::SCHEMA_KEY`] of the host.
    pub schema_key: u64,
    /// Chosen by the host, new for every connection: the same nonce again gets the same session.
    pub nonce: u32,
}

/// Why the device last started.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub enum ResetCause {
    /// Supply switched on, or brown-out.
    PowerOn,
    /// Reset pin or debugger.
    Pin,
    /// The firmware reset itself after a panic or a processor fault.
    Panic,
    /// The watchdog: a task did not check in.
    Watchdog,
    /// Reset on request or of unknown software origin.
    Software,
}

/// How the image was built.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
pub enum BuildProfile {
    /// With debug assertions.
    Debug,
    /// The optimised profile that is flashed.
    Firmware,
}

/// Source revision of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Revision {
    /// First 32 bits of the commit hash; 0 = built outside a repository.
    pub commit: u32,
    /// Built from a tree with uncommitted changes.
    pub dirty: bool,
}

/// Answer to [`Hello`]. The encoding of this message never changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Identity {
    pub device: DeviceKind,
    pub protocol: Version,
    /// [`crate::table::SCHEMA_KEY`] of the device.
    pub schema_key: u64,
    /// Unique number of the microcontroller, 96 bits (RM0383 section 24.1).
    pub uid: [u8; 12],
    /// Source revision of the image.
    pub revision: Revision,
    /// How the image was built.
    pub profile: BuildProfile,
    /// Counts starts since it was switched on, from 1: a new value means a reset.
    pub boot_id: u32,
    /// Why it last started.
    pub reset_cause: ResetCause,
    /// Session number for all further requests, 1..=255.
    pub session: u8,
}

/// Asks for the text of the last panic or processor fault, which survives the reset.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct GetLastWords;

/// Text of the last panic or processor fault; empty when there was none.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct LastWords {
    /// UTF-8 text, cut at 120 bytes.
    pub text: heapless::String<120>,
}

/// Sets the interval of telemetry. The answer repeats it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct SetTelemetry {
    /// 5..=1000 ms (200..1 Hz), or 0 for none.
    pub period_ms: u16,
}

impl SetTelemetry {
    /// Shortest and longest interval, ms.
    pub const PERIOD_MS: (u16, u16) = (5, 1_000);
}

/// Tells the device that the host is still there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct KeepAlive;

/// Clears a latched fault whose cause has been removed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Acknowledge;

/// Answer to a request that returns no data.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Done;

/// Asks for clock, supply and option bytes of the chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct GetChip;

/// Clock, supply and option bytes of the microcontroller.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Chip {
    /// Source of the processor's clock.
    pub clock: Clock,
    /// Supply below which the chip holds itself in reset, by its option bytes.
    pub brown_out: BrownOut,
    /// The supply is below 2.7 V, where the flash must not be written (DS10314 table 45).
    pub supply_low: bool,
    /// The option bytes as FLASH_OPTCR shows them (RM0383 section 3.8.6).
    pub option_bytes: u32,
}

/// Sources of the processor's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
pub enum Clock {
    /// 8 MHz from the ST-LINK or a crystal.
    External,
    /// The chip's own oscillator, accurate to 1 %.
    Internal,
}

/// Brown-out levels of the option bytes, by falling threshold (DS10314 table 19).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
pub enum BrownOut {
    /// 1.7 V: only the power-down reset.
    Off,
    /// 2.13 to 2.24 V.
    Level1,
    /// 2.44 to 2.56 V.
    Level2,
    /// 2.75 to 2.88 V.
    Level3,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct GetEvents {
    /// Index of the first event wanted.
    pub from: u32,
}

/// How many events fit into one [`Events`].
pub const EVENTS_PER_REPLY: usize = 3;

/// Some events of the device's ring.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub struct Events {
    /// Oldest index that the ring still holds.
    pub oldest: u32,
    /// Index that the next event will get.
    pub next: u32,
    /// Events from the wanted index on, or from `oldest` on if that is later.
    pub events: Vec<Event, EVENTS_PER_REPLY>,
}

/// Something that happened on the device. It is sent at once and kept in a ring.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub struct Event {
    /// Counts from 0 at each start of the device.
    pub index: u32,
    /// Device time since its start.
    pub time_us: u64,
    pub what: What,
}

/// Kind and content of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "json", derive(schemars::JsonSchema))]
pub enum What {
    Booted(ResetCause),
    Acknowledged,
    /// The host was silent for longer than the link time-out while the machine moved.
    LinkLost,
    Rig(rig::RigEvent),
    Capsule(capsule::CapsuleEvent),
}

/// A stop: valid at any time, in any session, in any state. The encoding of this message never changes.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, Schema, Hash,
)]
#[serde(rename_all = "snake_case")]
pub enum Urgent {
    /// Category-1 stop: decelerate, keep the position (rig); motor off, worm holds (capsule).
    Stop,
    /// Emergency stop by frame: pulses or motor current end at once; latched as a fault.
    #[serde(rename(serialize = "estop", deserialize = "estop"))]
    EStop,
}

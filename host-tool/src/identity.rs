//! Names of machines, images and versions, for people and for records.

use protocol::system::{DeviceKind, Identity, ResetCause, Revision};
use serde::{Deserialize, Serialize};

/// The machine's name, as in `--rig` and `--capsule`.
#[must_use]
pub const fn kind_name(kind: DeviceKind) -> &'static str {
    match kind {
        DeviceKind::Rig => "rig",
        DeviceKind::Capsule => "capsule",
    }
}

/// Commit of an image: eight hex digits, `-dirty` if there were uncommitted changes.
#[must_use]
pub fn revision(revision: &Revision) -> String {
    let dirty = if revision.dirty { "-dirty" } else { "" };
    if revision.commit == 0 {
        return format!("unknown{dirty}");
    }
    format!("{:08x}{dirty}", revision.commit)
}

/// The cause of a device's last start.
#[must_use]
pub const fn reset_cause(cause: ResetCause) -> &'static str {
    match cause {
        ResetCause::PowerOn => "power on",
        ResetCause::Pin => "reset pin or debugger",
        ResetCause::Panic => "restart after a panic or processor fault",
        ResetCause::Watchdog => "watchdog: a task hung",
        ResetCause::Software => "reset by software",
    }
}

/// Identifies a device in one line.
#[must_use]
pub fn line(identity: &Identity) -> String {
    let record = IdentityRecord::from(identity);
    format!(
        "{}, UID {}, firmware {} ({}), protocol {}, schema {}, start {} ({})",
        record.device,
        record.uid,
        record.firmware,
        record.profile,
        record.protocol,
        record.schema_key,
        record.boot_id,
        record.reset_cause
    )
}

/// An identity as it is written to records and `--json`. 64-bit numbers are hex text, because many JSON readers round
/// them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct IdentityRecord {
    /// `rig` or `capsule`.
    pub device: String,
    /// Unique number of the microcontroller, 24 hex digits.
    pub uid: String,
    /// Commit of the image.
    pub firmware: String,
    /// `debug` or `firmware`.
    pub profile: String,
    /// `major.minor`.
    pub protocol: String,
    /// 16 hex digits.
    pub schema_key: String,
    /// Number of the device's starts.
    pub boot_id: u32,
    /// Cause of the last start.
    pub reset_cause: String,
}

impl From<&Identity> for IdentityRecord {
    fn from(identity: &Identity) -> Self {
        Self {
            device: kind_name(identity.device).to_owned(),
            uid: identity
                .uid
                .iter()
                .map(|byte| format!("{byte:02x}"))
                .collect(),
            firmware: revision(&identity.revision),
            profile: format!("{:?}", identity.profile).to_lowercase(),
            protocol: format!("{}.{}", identity.protocol.major, identity.protocol.minor),
            schema_key: format!("{:016x}", identity.schema_key),
            boot_id: identity.boot_id,
            reset_cause: reset_cause(identity.reset_cause).to_owned(),
        }
    }
}

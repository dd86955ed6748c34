//! Names of machines, images and versions, for people and for records, and whether a machine is real.
//!
//! Only this module decides an [`Origin`].

use std::sync::OnceLock;

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

/// Version and revision of the program that runs, which only the program itself knows.
pub static TOOL: OnceLock<&'static str> = OnceLock::new();

/// What [`TOOL`] says; a program that uses the library alone may leave it unset.
#[must_use]
pub fn version() -> &'static str {
    TOOL.get().unwrap_or(&"(unknown)")
}

/// The program that writes a record, as the record names it.
#[must_use]
pub fn tool() -> String {
    format!("retrograde {}", version())
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

/// Whether a record is from a real machine. A virtual run must never pass as a measurement, so an unknown origin never
/// counts as `board`, and any sign of `virtual` outweighs all signs of a board.
#[derive(
    Clone,
    Copy,
    Debug,
    Default,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    Deserialize,
    schemars::JsonSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Origin {
    /// Measured on a board.
    Board,
    /// The record does not say; older tools did not write it.
    #[default]
    Unknown,
    /// Produced by a simulated machine.
    Virtual,
}

/// Prefix of a virtual machine's UID, in ASCII; no real microcontroller has it.
const VIRTUAL_UID: &[u8] = b"virtual";
/// Prefix of the virtual bench's places: `virtual`, `virtual rig`.
const VIRTUAL_PLACE: &str = "virtual";

impl Origin {
    /// Origin of a machine with this identity at this place, as [`crate::link::Link::place`] names it.
    #[must_use]
    pub fn of(identity: &Identity, place: &str) -> Self {
        let word = place.split(' ').next();
        if identity.uid.starts_with(VIRTUAL_UID) || word == Some(VIRTUAL_PLACE) {
            Self::Virtual
        } else {
            Self::Board
        }
    }

    /// Origin of a record from its own statement and from its hexadecimal UID, which is harder to remove.
    #[must_use]
    pub fn of_record(says: Self, uid: &str) -> Self {
        let virtual_uid: String = VIRTUAL_UID
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect();
        if uid.to_ascii_lowercase().starts_with(&virtual_uid) {
            Self::Virtual
        } else {
            says
        }
    }

    /// Meaning in words.
    #[must_use]
    pub const fn meaning(self) -> &'static str {
        match self {
            Self::Board => "board: measured on a machine",
            Self::Unknown => "unknown: the record does not say what made it",
            Self::Virtual => "virtual: simulated, not a measurement",
        }
    }
}

impl std::fmt::Display for Origin {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // As in records.
        f.write_str(match self {
            Self::Board => "board",
            Self::Unknown => "unknown",
            Self::Virtual => "virtual",
        })
    }
}

/// Identifies a device in one line.
#[must_use]
pub fn line(identity: &Identity) -> String {
    let record = IdentityRecord::new(identity, "");
    let simulated = match record.origin {
        Origin::Virtual => ", virtual",
        Origin::Board | Origin::Unknown => "",
    };
    format!(
        "{}{simulated}, UID {}, firmware {} ({}), protocol {}, schema {}, start {} ({})",
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

/// An identity as written to records and `--json`. 64-bit numbers are hexadecimal text, because many JSON readers round
/// them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct IdentityRecord {
    /// `rig` or `capsule`.
    pub device: String,
    #[serde(default)]
    pub origin: Origin,
    /// Unique number of the microcontroller, 24 hex digits.
    pub uid: String,
    pub firmware: String,
    /// `debug` or `firmware`.
    pub profile: String,
    /// `major.minor`.
    pub protocol: String,
    /// 16 hex digits.
    pub schema_key: String,
    /// Number of the device's starts.
    pub boot_id: u32,
    pub reset_cause: String,
}

impl IdentityRecord {
    /// The identity of the machine that answers at this place.
    #[must_use]
    pub fn new(identity: &Identity, place: &str) -> Self {
        Self {
            origin: Origin::of(identity, place),
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

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::system::BuildProfile;

    fn identity(uid: [u8; 12]) -> Identity {
        Identity {
            device: DeviceKind::Rig,
            protocol: protocol::VERSION,
            schema_key: 1,
            revision: Revision {
                commit: 1,
                dirty: false,
            },
            profile: BuildProfile::Firmware,
            uid,
            boot_id: 1,
            reset_cause: ResetCause::PowerOn,
            session: 1,
        }
    }

    #[test]
    fn one_sign_of_a_simulation_is_enough() {
        let board = identity(*b"1234567890ab");
        for (of, place, origin) in [
            (&board, "/dev/ttyACM0", Origin::Board),
            (&board, "tcp:127.0.0.1:7001", Origin::Board),
            (&board, "/dev/virtual", Origin::Board),
            (&board, "virtual", Origin::Virtual),
            (&board, "virtual capsule", Origin::Virtual),
            (
                &identity(*b"virtual rig\0"),
                "/dev/ttyACM0",
                Origin::Virtual,
            ),
            (&identity(*b"virtual caps"), "tcp:a:1", Origin::Virtual),
        ] {
            let record = IdentityRecord::new(of, place);
            assert_eq!(record.origin, origin, "{place}");
            let reread = Origin::of_record(Origin::Unknown, &record.uid);
            let by_uid = of.uid.starts_with(b"virtual");
            assert_eq!(reread == Origin::Virtual, by_uid, "{place}");
        }
        let rig = IdentityRecord::new(&identity(*b"virtual rig\0"), "COM3");
        assert_eq!(Origin::of_record(Origin::Board, &rig.uid), Origin::Virtual);
        assert_eq!(
            Origin::of_record(Origin::Board, &rig.uid.to_uppercase()),
            Origin::Virtual
        );
        assert_eq!(Origin::of_record(Origin::Unknown, "00ff"), Origin::Unknown);
    }

    #[test]
    fn a_record_that_does_not_say_is_not_of_a_board() {
        let record = IdentityRecord::new(&identity(*b"1234567890ab"), "COM3");
        let mut json = serde_json::to_value(&record).expect("JSON");
        json.as_object_mut().expect("object").remove("origin");
        let old: IdentityRecord = serde_json::from_value(json).expect("readable");
        assert_eq!(old.origin, Origin::Unknown);
        assert!(Origin::Board < Origin::Unknown && Origin::Unknown < Origin::Virtual);
    }
}

//! The identity that a device reports.

use crate::retained::Retained;
use protocol::{
    VERSION,
    system::{BuildProfile, DeviceKind, Identity, ResetCause, Revision},
    table::SCHEMA_KEY,
};

/// Revision of the sources, found by `build.rs`.
pub(crate) const REVISION: Revision = Revision {
    commit: match u32::from_str_radix(env!("RETROGRADE_COMMIT"), 16) {
        Ok(commit) => commit,
        Err(_) => 0,
    },
    dirty: matches!(env!("RETROGRADE_DIRTY").as_bytes(), b"1"),
};

/// The identity of this image on this chip; the session is filled in when it is issued.
#[must_use]
pub fn identity(
    device: DeviceKind,
    uid: [u8; 12],
    boot_id: u32,
    reset_cause: ResetCause,
) -> Identity {
    Identity {
        device,
        protocol: VERSION,
        schema_key: SCHEMA_KEY,
        uid,
        revision: REVISION,
        profile: if cfg!(debug_assertions) {
            BuildProfile::Debug
        } else {
            BuildProfile::Firmware
        },
        boot_id,
        reset_cause,
        session: 0,
    }
}

/// Why the device started. The data of the previous start may tell more than the chip's flags: the device resets itself
/// after a panic, and when a missing clock starts.
#[must_use]
pub fn reset_cause(by_flags: ResetCause, previous: &Retained) -> ResetCause {
    match (by_flags, previous.cause) {
        (ResetCause::Software, Some(cause)) => cause,
        (ResetCause::Software, None) if previous.last_words.is_some() => ResetCause::Panic,
        (cause, _) => cause,
    }
}

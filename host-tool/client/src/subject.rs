//! The machine that produced a result, and everything the result depends on.

use std::collections::BTreeMap;

use protocol::rig::GetRigHealth;
use protocol::settings::SettingKey;
use protocol::system::{DeviceKind, Identity};

use crate::Device;
use crate::diagnosis::Sign;
use crate::error::ClientError;
use crate::identity::{IdentityRecord, Origin, kind_name};

/// The machine that produced a result.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Subject {
    pub machine: DeviceKind,
    /// Unique number of its board.
    pub uid: String,
    pub origin: Origin,
    /// Fingerprint of the rig's image, 8 hex digits; for the capsule, which has none, the commit.
    pub image: String,
    pub firmware: String,
    pub protocol: String,
    /// All settings of a rig by name; those of a capsule are not read.
    pub settings: BTreeMap<String, u32>,
}

impl Subject {
    /// Reads everything from a machine that its results depend on.
    ///
    /// # Errors
    /// As [`Device::call`]; [`ClientError::NoAnswer`] before [`Device::hello`].
    pub fn of(device: &mut Device) -> Result<Self, ClientError> {
        let Some(identity) = device.identity().copied() else {
            let place = device.place();
            return Err(ClientError::NoAnswer {
                place,
                sign: Sign::Silence,
            });
        };
        let mut subject = Self::of_identity(&identity);
        subject.origin = device.origin();
        if identity.device == DeviceKind::Rig {
            let hash = device.call(GetRigHealth)?.image_hash;
            subject.image = format!("{hash:08x}");
            subject.settings = device.settings(DeviceKind::Rig)?;
        }
        Ok(subject)
    }

    /// The part that follows from the identity alone.
    #[must_use]
    pub fn of_identity(identity: &Identity) -> Self {
        let known = IdentityRecord::new(identity, "");
        Self {
            machine: identity.device,
            uid: known.uid,
            origin: known.origin,
            image: known.firmware.clone(),
            firmware: known.firmware,
            protocol: known.protocol,
            settings: BTreeMap::new(),
        }
    }

    #[must_use]
    pub fn setting(&self, key: SettingKey) -> u32 {
        let known = self.settings.get(key.name()).copied();
        known.unwrap_or(key.range().default)
    }

    /// File name of the record.
    #[must_use]
    pub fn file_name(&self) -> String {
        file_name(self.machine, &self.uid)
    }
}

/// File name of a board's commissioning record.
#[must_use]
pub fn file_name(machine: DeviceKind, uid: &str) -> String {
    format!("commissioning-{}-{uid}.json", kind_name(machine))
}

//! Names that the user's file gives to machines.

use client::address::Address;
use client::named::{self, Named, NamedError};
use protocol::system::DeviceKind;

use crate::operations::failure::Failure;

/// The names by which the user has called the machines.
#[derive(Clone, Debug, Default)]
pub struct Names {
    rig: Option<String>,
    capsule: Option<String>,
}

impl Names {
    /// The name by which the user called this machine, if any.
    #[must_use]
    pub fn of(&self, kind: DeviceKind) -> Option<&str> {
        match kind {
            DeviceKind::Rig => self.rig.as_deref(),
            DeviceKind::Capsule => self.capsule.as_deref(),
        }
    }
}

/// Replaces names by addresses, and returns the names.
///
/// # Errors
/// A name was given, but the file cannot be used.
pub fn resolve(rig: &mut Option<Address>, capsule: &mut Option<Address>) -> Result<Names, Failure> {
    let mut names = Names::default();
    for (kind, given, name) in [
        (DeviceKind::Rig, rig, &mut names.rig),
        (DeviceKind::Capsule, capsule, &mut names.capsule),
    ] {
        let Some(Address::Serial(text)) = given else {
            continue;
        };
        if !named::may_be_a_name(text) {
            continue;
        }
        let named = Named::read().map_err(|error| unusable(&error))?;
        if let Some(address) = named.address(kind, text) {
            *name = Some(std::mem::take(text));
            *given = Some(address.clone());
        }
    }
    Ok(names)
}

fn unusable(error: &NamedError) -> Failure {
    Failure::input(
        error.to_string(),
        "mend the file, or give the address itself: `--rig /dev/ttyACM0`, `--rig tcp:HOST:PORT`",
    )
}

//! The steps of each machine.

use protocol::system::DeviceKind;

use crate::commissioning::step::Step;
use crate::commissioning::{capsule, rig};

/// The steps of a machine, in their order.
#[must_use]
pub const fn of(machine: DeviceKind) -> &'static [Step] {
    match machine {
        DeviceKind::Rig => rig::STEPS,
        DeviceKind::Capsule => capsule::STEPS,
    }
}

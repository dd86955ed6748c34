//! A step of the commissioning: what it shows and what its result depends on.

use protocol::settings::SettingKey;
use protocol::system::DeviceKind;

use crate::commission::work::{Halt, Work};
use crate::commission::{capsule, rig};

/// A step.
#[derive(Clone, Copy, Debug)]
pub struct Step {
    /// Name, in records and on the screen.
    pub name: &'static str,
    /// What a pass shows, in a line.
    pub shows: &'static str,
    /// What a person has to look at meanwhile, because nothing measures it; may be empty.
    pub look: &'static str,
    /// Its result is that of an image: another image needs another result.
    pub of_image: bool,
    /// The settings on which its result depends.
    pub settings: &'static [SettingKey],
    /// It cannot be shown without somebody at the machine.
    pub needs_hands: bool,
    /// Carries it out.
    pub check: fn(&mut Work<'_>) -> Result<(), Halt>,
}

/// The steps of a machine, in their order.
#[must_use]
pub const fn of(machine: DeviceKind) -> &'static [Step] {
    match machine {
        DeviceKind::Rig => rig::STEPS,
        DeviceKind::Capsule => capsule::STEPS,
    }
}

//! A commissioning step: what it shows and what its result depends on. The steps of each machine.

use protocol::settings::SettingKey;
use protocol::system::DeviceKind;

use crate::commissioning::halt::Halt;
use crate::commissioning::work::Work;
use crate::commissioning::{capsule, rig};

#[derive(Clone, Copy, Debug)]
pub struct ProcedureStep {
    /// Name in records and on the screen.
    pub name: &'static str,
    /// What a pass proves, in one line.
    pub shows: &'static str,
    /// Hint for the operator: what to observe, because nothing measures it; may be empty.
    pub observe: &'static str,
    /// The result depends on the image: another image needs another result.
    pub of_image: bool,
    /// The settings on which its result depends.
    pub settings: &'static [SettingKey],
    /// The step cannot be shown without an operator.
    pub needs_operator: bool,
    pub check: fn(&mut Work<'_>) -> Result<(), Halt>,
}

pub const fn steps(machine: DeviceKind) -> &'static [ProcedureStep] {
    match machine {
        DeviceKind::Rig => rig::STEPS,
        DeviceKind::Capsule => capsule::STEPS,
    }
}

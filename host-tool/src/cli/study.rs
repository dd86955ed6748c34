//! Preconditions of the capsule's studies.

use client::Device;
use lab::operations::failure::{FIND_THREAD, Failure};
use protocol::capsule::CapsuleState;

/// Refuses unless the capsule is unfolded and referenced.
pub(crate) fn begin_unfolded(what: &str, capsule: &mut Device) -> Result<(), Failure> {
    let status = capsule.capsule_status()?;
    if status.state == CapsuleState::Unfolded && status.referenced {
        return Ok(());
    }
    Err(Failure::refused(
        format!(
            "{what} begins unfolded and referenced; the capsule is {:?}, and nothing moved",
            status.state
        ),
        match status.state {
            CapsuleState::Folded | CapsuleState::Stopped => "`retrograde unfold`, then again",
            CapsuleState::WasFolded => {
                "`retrograde capsule check`, `retrograde unfold`, then again"
            }
            CapsuleState::Faulted => "`retrograde info` names the fault",
            _ => FIND_THREAD,
        }
        .to_owned(),
    ))
}

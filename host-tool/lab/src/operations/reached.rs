//! Detects targets that are already reached. The command then succeeds and says so, so that a script can repeat it.

use client::Device;
use client::error::ClientError;
use protocol::capsule::{ActuationKind, CapsuleState, CapsuleStatus};
use protocol::error::Refusal;

/// Whether the device refused because the target is already reached.
pub fn is_there(error: &ClientError) -> bool {
    matches!(
        error,
        ClientError::Refused {
            refusal: Refusal::AlreadyThere,
            ..
        }
    )
}

/// The capsule's status and the name of its state, if it is already in the state that the actuation leads to.
pub fn reached(
    kind: ActuationKind,
    capsule: &mut Device,
) -> Result<Option<(CapsuleStatus, &'static str)>, ClientError> {
    let (goal, name) = match kind {
        ActuationKind::Fold => (CapsuleState::Folded, "folded"),
        ActuationKind::Unfold => (CapsuleState::Unfolded, "unfolded"),
        _ => return Ok(None),
    };
    let status = capsule.capsule_status()?;
    // Let an unreferenced or faulted capsule refuse the command itself: its refusal names the reason.
    let there = status.state == goal && status.referenced && status.fault.is_none();
    Ok(there.then_some((status, name)))
}

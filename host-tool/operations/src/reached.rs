//! Goals that are reached already: a command succeeds and says so, so that a script can repeat it.

use client::Device;
use client::error::ClientError;
use protocol::capsule::{ActuationKind, CapsuleState, CapsuleStatus};
use protocol::error::Refusal;

/// The device refused because there is nothing to do.
pub fn is_there(error: &ClientError) -> bool {
    matches!(
        error,
        ClientError::Refused {
            refusal: Refusal::AlreadyThere,
            ..
        }
    )
}

/// The capsule's status, and what it is called, if it already is what the actuation would make it.
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
    // One that is not referenced has more to say.
    let there = status.state == goal && status.referenced && status.fault.is_none();
    Ok(there.then_some((status, name)))
}

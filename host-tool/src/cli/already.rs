//! Commands that find their goal reached: they succeed and say so, so that a script can repeat them.

use client::Device;
use client::error::ClientError;
use protocol::capsule::{ActuationKind, CapsuleState, CapsuleStatus};
use protocol::error::Refusal;
use serde_json::{Value, json};

use crate::cli::failure::Failure;
use crate::cli::screen::Screen;

/// The device refused because there is nothing to do.
pub(crate) fn is_there(error: &ClientError) -> bool {
    matches!(
        error,
        ClientError::Refused {
            refusal: Refusal::AlreadyThere,
            ..
        }
    )
}

/// The capsule's status, and what it is called, if it already is what the actuation would make it.
pub(crate) fn reached(
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

/// The result if the capsule already is what the actuation would make it: nothing moves and nothing is recorded.
pub(crate) fn actuated(
    kind: ActuationKind,
    capsule: &mut Device,
    screen: &mut Screen<'_>,
) -> Result<Option<Value>, Failure> {
    let Some((status, name)) = reached(kind, capsule)? else {
        return Ok(None);
    };
    screen.say(&format!(
        "The capsule is {name} already; nothing moved and nothing was recorded."
    ));
    Ok(Some(json!({ "already": true, "status": status })))
}

//! Handles a fold or an unfolding of a capsule that is already folded or unfolded.

use client::Device;
use operations::failure::Failure;
use operations::reached::reached;
use protocol::capsule::ActuationKind;
use serde_json::{Value, json};

use crate::cli::screen::Screen;

/// The result if the capsule already is as ordered. Nothing moves and nothing is recorded then.
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

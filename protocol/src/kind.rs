//! The kinds of machine, below settings and messages.

use postcard_schema::Schema;
use serde::{Deserialize, Serialize};

/// The kinds of machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[serde(rename_all = "snake_case")]
pub enum DeviceKind {
    /// The roller rig.
    Rig,
    /// The capsule.
    Capsule,
}

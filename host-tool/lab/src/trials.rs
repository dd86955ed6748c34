//! Actions that are executed once and recorded.
//!
//! * [`trial`]: the record of an action: telemetry CSV and JSON sidecar.
//! * [`status`]: how a trial ended.
//! * [`writer`]: writes files on its own thread.
//! * [`check`]: whether a record contradicts itself.
//! * [`sidecar`]: the heading of a record, and JSON files of other kinds.
//! * [`listing`]: the trials in a folder.
//! * [`experiment`]: recorded actions.
//! * [`coordination`]: an actuation that begins at a position of a run, its [`cue`].
//! * [`plan`]: a run, calculated before it is sent.
//! * [`progress`]: progress for people, as a bar or as lines.
//! * [`fetched`]: a machine's own record of its last action.
//! * [`force`]: a capsule's own recording as a file, with the force.

pub mod check;
pub mod coordination;
pub mod cue;
pub mod experiment;
pub mod fetched;
pub mod force;
pub mod listing;
pub mod plan;
pub mod progress;
pub mod sidecar;
pub mod status;
pub mod trial;
pub mod writer;

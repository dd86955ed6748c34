//! The table of requests: one row per request with everything that both ends must agree on.
//!
//! The module of a request's type says which machine serves it: `system` and `settings` both, `rig` the rig, `capsule`
//! the capsule. The other machine refuses it with [`Refusal::WrongDevice`]. While a fault is latched, a machine refuses
//! what moves it ([`Impact::Pace`], [`Impact::Motion`]) and serves the rest.

use crate::{capsule, error::Refusal, error::WireError, rig, settings, system};
use postcard_schema::Schema;
use postcard_schema::key::Key;
use serde::{Deserialize, Serialize};

/// The effect of carrying out a request. From it the sender decides how long to wait for the answer, whether to give
/// the request up for a stop, and what is certain without an answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Impact {
    /// Changes nothing that moves or lasts. Safe to send at any time; without an answer nothing was done.
    None,
    /// Clears the latched fault. A copy that arrives after an emergency stop would clear the fault of that stop.
    Fault,
    /// Writes settings or the name to flash. The device receives nothing while it erases, so the sender waits longer.
    Flash,
    /// Holds or resumes the present run. A stop ends that run, so a copy that arrives later changes nothing.
    Pace,
    /// Starts a motion. A copy that arrives after a stop would start again what the operator stopped.
    Motion,
}

/// A type of request: its variant of [`Request`] and the type of its response.
pub trait Endpoint: Sized {
    type Response;
    /// Wraps the request for the wire.
    fn into_request(self) -> Request;
    /// Unwraps the response; `None` if the device answered with another row's response.
    fn from_response(response: Response) -> Option<Self::Response>;
}

macro_rules! table {
    ($($name:ident: $request:ty => $response:ty, match $matched:literal, impact $impact:ident;)*) => {
        /// All requests. Index-coded: append only.
        #[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
        pub enum Request { $(#[doc = concat!("[`", stringify!($request), "`]")] $name($request)),* }

        /// All responses, in the order of [`Request`].
        #[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
        pub enum Response { $(#[doc = concat!("Of [`", stringify!($request), "`].")] $name($response)),* }

        impl Request {
            /// Names of all requests, in the order of their indices.
            pub const NAMES: &[&str] = &[$(stringify!($name)),*];

            // One `match` per column: the images do not use the names, so these take no flash.

            /// Name of the request, as in the table.
            pub const fn name(&self) -> &'static str {
                match self { $(Request::$name(_) => stringify!($name)),* }
            }

            /// Refused unless both ends have the same major version and schema key.
            pub const fn needs_match(&self) -> bool {
                match self { $(Request::$name(_) => $matched),* }
            }

            /// Effect of the request when it is carried out.
            pub const fn impact(&self) -> Impact {
                match self { $(Request::$name(_) => Impact::$impact),* }
            }
        }

        $(impl Endpoint for $request {
            type Response = $response;
            fn into_request(self) -> Request { Request::$name(self) }
            fn from_response(response: Response) -> Option<$response> {
                match response { Response::$name(response) => Some(response), _ => None }
            }
        })*
    };
}

table! {
    // Append only.
    Hello: system::Hello => system::Identity, match false, impact None;
    KeepAlive: system::KeepAlive => system::Done, match false, impact None;
    GetLastWords: system::GetLastWords => system::LastWords, match false, impact None;
    SetTelemetry: system::SetTelemetry => system::SetTelemetry, match true, impact None;
    GetEvents: system::GetEvents => system::Events, match true, impact None;
    Acknowledge: system::Acknowledge => system::Done, match true, impact Fault;
    GetRigStatus: rig::GetRigStatus => rig::RigStatus, match true, impact None;
    Home: rig::Home => rig::HomeAccepted, match true, impact Motion;
    Run: rig::Run => rig::RunAccepted, match true, impact Motion;
    GetRunRecord: rig::GetRunRecord => rig::RunRecord, match true, impact None;
    GetCapsuleStatus: capsule::GetCapsuleStatus => capsule::CapsuleStatus, match true, impact None;
    Reference: capsule::Reference => capsule::ActuationAccepted, match true, impact Motion;
    Fold: capsule::Fold => capsule::ActuationAccepted, match true, impact Motion;
    Unfold: capsule::Unfold => capsule::ActuationAccepted, match true, impact Motion;
    GetActuationRecord: capsule::GetActuationRecord => capsule::ActuationRecord, match true, impact None;
    Hold: rig::Hold => system::Done, match true, impact Pace;
    Resume: rig::Resume => system::Done, match true, impact Pace;
    Jog: rig::Jog => system::Done, match true, impact Motion;
    MoveTo: rig::MoveTo => rig::MoveAccepted, match true, impact Motion;
    GetSetting: settings::GetSetting => settings::Setting, match true, impact None;
    SetSetting: settings::Setting => settings::Setting, match true, impact Flash;
    FactoryReset: settings::FactoryReset => system::Done, match true, impact Flash;
    GetName: settings::GetName => settings::Name, match true, impact None;
    SetName: settings::Name => settings::Name, match true, impact Flash;
    GetRigHealth: rig::GetRigHealth => rig::RigHealth, match true, impact None;
    GetChip: system::GetChip => system::Chip, match true, impact None;
    Calibrate: capsule::Calibrate => capsule::ActuationAccepted, match true, impact Motion;
    CheckFolded: capsule::CheckFolded => capsule::ActuationAccepted, match true, impact Motion;
    GetTrace: capsule::GetTrace => capsule::Trace, match true, impact None;
    GetCapsuleTotals: capsule::GetCapsuleTotals => capsule::CapsuleTotals, match true, impact None;
    FoldTo: capsule::FoldTo => capsule::ActuationAccepted, match true, impact Motion;
    GetRigHardware: rig::GetRigHardware => rig::RigHardware, match true, impact None;
}

// One reply exists at a time, on the stack; there is no heap to box it on.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub enum Reply {
    /// Carried out, or begun.
    Accepted(Response),
    /// Understood and refused; nothing moved.
    Refused(Refusal),
    /// The frame was good, its content was not; nothing moved.
    Wire(WireError),
    /// An [`system::Urgent`] was carried out.
    Urgent(system::Urgent),
}

/// Body of a telemetry frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
pub enum Telemetry {
    Rig(rig::RigTelemetry),
    Capsule(capsule::CapsuleTelemetry),
}

/// Fingerprint of all message types, computed at compile time.
pub const SCHEMA_KEY: u64 = {
    let request = u64::from_le_bytes(Key::for_path::<Request>("request").to_bytes());
    let reply = u64::from_le_bytes(Key::for_path::<Reply>("reply").to_bytes());
    let telemetry = u64::from_le_bytes(Key::for_path::<Telemetry>("telemetry").to_bytes());
    let event = u64::from_le_bytes(Key::for_path::<system::Event>("event").to_bytes());
    let urgent = u64::from_le_bytes(Key::for_path::<system::Urgent>("urgent").to_bytes());
    request
        ^ reply.rotate_left(1)
        ^ telemetry.rotate_left(2)
        ^ event.rotate_left(3)
        ^ urgent.rotate_left(4)
};

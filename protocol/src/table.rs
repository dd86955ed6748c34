//! The table of requests: one row per request with everything that both ends must agree on.

use crate::{capsule, error::Refusal, error::WireError, rig, settings, system};
use postcard_schema::Schema;
use postcard_schema::key::Key;
use serde::{Deserialize, Serialize};

/// Which device serves a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Served {
    /// Both machines.
    Both,
    /// The rig only.
    Rig,
    /// The capsule only.
    Capsule,
}

/// What a repeated frame does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Retry {
    /// Executing it twice is harmless; answered from the cache all the same.
    Idempotent,
    /// Must be executed once only; the device's response cache sees to it.
    Deduplicated,
}

/// One row of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Row {
    /// Name of the request, as in [`Request`].
    pub name: &'static str,
    /// Who serves it.
    pub served: Served,
    /// Refused unless both ends have the same major version and schema key.
    pub needs_match: bool,
    /// Served while a fault is latched.
    pub while_faulted: bool,
    /// What a repeated frame does.
    pub retry: Retry,
}

/// A request type: names its row and its response type.
pub trait Command: Sized {
    /// What the device answers.
    type Response;
    /// Wraps the request for the wire.
    fn into_request(self) -> Request;
    /// Unwraps the response; `None` if the device answered with another row's response.
    fn from_response(response: Response) -> Option<Self::Response>;
}

macro_rules! table {
    ($($name:ident: $request:ty => $response:ty, $served:ident, match $matched:literal, faulted $faulted:literal, $retry:ident;)*) => {
        /// All requests. Index-coded: append only.
        #[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        pub enum Request { $(#[doc = concat!("[`", stringify!($request), "`]")] $name($request)),* }

        /// All responses, in the order of [`Request`].
        #[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        pub enum Response { $(#[doc = concat!("Of [`", stringify!($request), "`].")] $name($response)),* }

        /// The table; row `i` belongs to the variant with index `i`.
        pub const TABLE: &[Row] = &[$(Row {
            name: stringify!($name), served: Served::$served, needs_match: $matched,
            while_faulted: $faulted, retry: Retry::$retry,
        }),*];

        impl Request {
            /// [`Row::needs_match`] of its row, without the names: those are for people, not for the flash.
            pub const fn needs_match(&self) -> bool {
                match self { $(Request::$name(_) => $matched),* }
            }

            /// The request's row.
            pub const fn row(&self) -> &'static Row {
                enum Index { $($name),* }
                match self { $(Request::$name(_) => &TABLE[Index::$name as usize]),* }
            }
        }

        $(impl Command for $request {
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
    Hello: system::Hello => system::Identity, Both, match false, faulted true, Idempotent;
    KeepAlive: system::KeepAlive => system::Done, Both, match false, faulted true, Idempotent;
    GetLastWords: system::GetLastWords => system::LastWords, Both, match false, faulted true, Idempotent;
    SetTelemetry: system::SetTelemetry => system::SetTelemetry, Both, match true, faulted true, Idempotent;
    GetEvents: system::GetEvents => system::Events, Both, match true, faulted true, Idempotent;
    Acknowledge: system::Acknowledge => system::Done, Both, match true, faulted true, Deduplicated;
    GetRigStatus: rig::GetRigStatus => rig::RigStatus, Rig, match true, faulted true, Idempotent;
    Home: rig::Home => rig::HomeAccepted, Rig, match true, faulted false, Deduplicated;
    Run: rig::Run => rig::RunAccepted, Rig, match true, faulted false, Deduplicated;
    GetRunRecord: rig::GetRunRecord => rig::RunRecord, Rig, match true, faulted true, Idempotent;
    GetCapsuleStatus: capsule::GetCapsuleStatus => capsule::CapsuleStatus, Capsule, match true, faulted true, Idempotent;
    Reference: capsule::Reference => capsule::ActuationAccepted, Capsule, match true, faulted false, Deduplicated;
    Fold: capsule::Fold => capsule::ActuationAccepted, Capsule, match true, faulted false, Deduplicated;
    Unfold: capsule::Unfold => capsule::ActuationAccepted, Capsule, match true, faulted false, Deduplicated;
    GetActuationRecord: capsule::GetActuationRecord => capsule::ActuationRecord, Capsule, match true, faulted true, Idempotent;
    Hold: rig::Hold => system::Done, Rig, match true, faulted false, Deduplicated;
    Resume: rig::Resume => system::Done, Rig, match true, faulted false, Deduplicated;
    Jog: rig::Jog => system::Done, Rig, match true, faulted false, Deduplicated;
    MoveTo: rig::MoveTo => rig::MoveAccepted, Rig, match true, faulted false, Deduplicated;
    GetSetting: settings::GetSetting => settings::Setting, Rig, match true, faulted true, Idempotent;
    SetSetting: settings::Setting => settings::Setting, Rig, match true, faulted true, Deduplicated;
    FactoryReset: settings::FactoryReset => system::Done, Rig, match true, faulted true, Deduplicated;
    GetName: settings::GetName => settings::Name, Rig, match true, faulted true, Idempotent;
    SetName: settings::Name => settings::Name, Rig, match true, faulted true, Deduplicated;
    GetRigHealth: rig::GetRigHealth => rig::RigHealth, Rig, match true, faulted true, Idempotent;
}

/// Answer to a request.
// One reply exists at a time, on the stack, and boxes do not exist here.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, Schema)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Reply {
    /// Done or begun.
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
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Telemetry {
    /// Of the rig.
    Rig(rig::RigTelemetry),
    /// Of the capsule.
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

//! How a trial ended, by name: in sidecars, lists and ledgers.

use protocol::capsule::ActuationOutcome;
use protocol::rig::RunOutcome;

/// An enumeration whose values have names, for records and people. `ALL` contains every value.
#[macro_export]
macro_rules! outcomes {
    ($(#[$doc:meta])* $type:ident { $($(#[$variant_doc:meta])* $variant:ident: $name:literal,)* }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
        #[derive(schemars::JsonSchema)]
        pub enum $type { $($(#[$variant_doc])* #[serde(rename = $name)] $variant,)* }

        impl $type {
            pub const ALL: &'static [Self] = &[$(Self::$variant),*];

            /// Name in records.
            #[must_use]
            pub const fn name(self) -> &'static str {
                match self { $(Self::$variant => $name),* }
            }
        }
    };
}

outcomes! {
    /// How a trial ended.
    Status {
        /// Not ended yet, or the host stopped before it ended.
        Running: "running",
        /// Ended as planned.
        Complete: "complete",
        /// Never begun: the machine refused it, or was not asked to begin. See `error`.
        Refused: "refused",
        /// Stopped on request.
        Stopped: "stopped",
        /// Stopped by the device, because the host was silent.
        LinkLost: "link_lost",
        /// Ended by a fault.
        Faulted: "faulted",
        /// The host lost the device: see `error`.
        Unknown: "unknown",
    }
}

impl From<RunOutcome> for Status {
    fn from(outcome: RunOutcome) -> Self {
        match outcome {
            RunOutcome::None | RunOutcome::Running => Self::Unknown,
            RunOutcome::Complete => Self::Complete,
            RunOutcome::Stopped => Self::Stopped,
            RunOutcome::LinkLost => Self::LinkLost,
            RunOutcome::Faulted(_) => Self::Faulted,
        }
    }
}

impl From<ActuationOutcome> for Status {
    fn from(outcome: ActuationOutcome) -> Self {
        match outcome {
            ActuationOutcome::None | ActuationOutcome::Running => Self::Unknown,
            ActuationOutcome::Complete => Self::Complete,
            ActuationOutcome::Stopped => Self::Stopped,
            ActuationOutcome::LinkLost => Self::LinkLost,
            ActuationOutcome::Faulted(_) => Self::Faulted,
        }
    }
}

//! Broker: one owner of a line, many clients.
//!
//! The process that opens a line (a serial port or a TCP server) takes the line's lock and starts a *broker* for it.
//! Any other process of the same user finds the broker's socket beside the lock and connects to it: a
//! [`client::BrokerClient`] is a [`crate::link::Link`], so that the whole client works over it.
//!
//! Traffic through a broker:
//!
//! * The broker's own thread writes a stop to the line at once, whatever the owner is doing.
//! * Reading, holding, resuming and acknowledging are questions. The owner sends them between two requests of its own,
//!   in its own session, so that nothing is executed twice and the owner's requests keep their answers.
//! * Telemetry and events are passed on as they come.
//! * Everything else is for the owner alone: motion, writing settings, the interval of telemetry.
//!
//! # The broker's protocol
//!
//! Its version is [`VERSION`]. Each side first sends one line of JSON that ends with a line feed: the client a
//! [`Greeting`], the broker a [`Welcome`]. From then on both send frames of the machines' protocol
//! ([`protocol::frame`]), and the broker acts as the device's end of a separate session. It rejects requests that are
//! not allowed with [`protocol::error::WireError::Malformed`]. It answers a question that its owner could not send in
//! time, or that a stop has overtaken, with [`protocol::error::WireError::Stale`]: the machine has not seen it. A
//! client may send a stop before the welcome arrives.
//!
//! Once the limit of clients is reached, a further one can stop the machine and nothing else: [`Welcome::full`] says
//! so.
//!
//! An owner that only observes the machine offers its line. A client that greets with [`Greeting::wants_line`] gets it:
//! the owner closes line and socket, the client opens the line, and the former owner comes back as a client.
//!
//! New versions only add fields to the two lines. Stops work between all versions.

pub mod lock;
pub mod server;
pub mod shared;

use crate::link::owner::Owner;

pub mod client;
#[doc(hidden)]
pub mod stream;

use protocol::table::{Impact, Request};
use serde::{Deserialize, Serialize};

/// Version of the broker's protocol.
pub const VERSION: u32 = 1;

/// Longest first line of either side, bytes.
pub const LONGEST_LINE: usize = 2_048;

/// The client's first line.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Greeting {
    /// [`VERSION`] of the client.
    pub retrograde_client: u32,
    /// The client wants the line if the owner gives it up. The client then has to open the line itself.
    #[serde(default)]
    pub wants_line: bool,
}

/// The broker's first line.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Welcome {
    /// [`VERSION`] of the broker.
    pub retrograde_broker: u32,
    pub owner: Owner,
    /// The owner only observes: it gives the line up to a client that wants it.
    #[serde(default)]
    pub yields: bool,
    /// The limit of clients is reached: this one can only stop the machine.
    #[serde(default)]
    pub full: bool,
}

/// Whether the broker lets a request through.
#[must_use]
pub fn admits(request: &Request) -> bool {
    match request.impact() {
        // The owner's record depends on the telemetry interval.
        Impact::None => !matches!(request, Request::SetTelemetry(_)),
        Impact::Fault | Impact::Pace => true,
        Impact::Flash | Impact::Motion => false,
    }
}

#[cfg(test)]
mod tests {
    use protocol::capsule;
    use protocol::rig;
    use protocol::settings::FactoryReset;
    use protocol::system::{Acknowledge, GetEvents, KeepAlive, SetTelemetry};
    use protocol::table::Endpoint;

    use crate::link::owner::shown;

    use super::*;

    #[test]
    fn nothing_that_moves_or_lasts_goes_through() {
        for request in [
            KeepAlive.into_request(),
            GetEvents { from: 0 }.into_request(),
            Acknowledge.into_request(),
            rig::GetRigStatus.into_request(),
            rig::GetRigHealth.into_request(),
            rig::Hold.into_request(),
            rig::Resume.into_request(),
        ] {
            assert!(admits(&request), "{}", request.name());
        }
        for request in [
            SetTelemetry { period_ms: 10 }.into_request(),
            rig::Home.into_request(),
            capsule::Fold.into_request(),
            FactoryReset.into_request(),
        ] {
            assert!(!admits(&request), "{}", request.name());
        }
    }

    #[test]
    fn a_command_is_shown_without_its_folder_and_on_one_line() {
        let args = ["/a/b/retrograde", "run", "--note", "two\nlines"].map(str::to_owned);
        assert_eq!(shown(&args), "retrograde run --note two lines");
        assert_eq!(shown(&["x".repeat(1_000)]).len(), 200);
    }
}

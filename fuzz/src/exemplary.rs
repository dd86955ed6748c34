//! A machine that answers each request with the protocol's exemplar of its response, stands still, and notes what it was asked.

use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use device::identity::identity;
use device::service::{Inbound, Incoming, Service};
use host_tool::link::memory::Peer;
use protocol::capsule::CapsuleState;
use protocol::error::Refusal;
use protocol::rig::RigState;
use protocol::system::{DeviceKind, Identity, ResetCause, Urgent};
use protocol::table::{Impact, Reply, Request, Response};

use crate::exemplars;

/// What machines were asked; clones are the same one.
#[derive(Clone, Debug, Default)]
pub struct Asked(Arc<Mutex<Notes>>);

/// In the order of their arrival.
#[derive(Clone, Debug, Default)]
pub struct Notes {
    /// Requests that were executed and change something.
    pub changes: Vec<(DeviceKind, Request)>,
    /// Stops.
    pub stops: Vec<(DeviceKind, Urgent)>,
}

impl Asked {
    /// What there is.
    ///
    /// # Panics
    /// Never.
    #[must_use]
    pub fn notes(&self) -> MutexGuard<'_, Notes> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The machine.
#[derive(Debug)]
pub struct Exemplary {
    kind: DeviceKind,
    /// It begins what it is asked to; else it is not ready for it.
    willing: bool,
    service: Service,
    asked: Asked,
    said: Vec<u8>,
}

impl Exemplary {
    /// A machine that has just started.
    #[must_use]
    pub fn new(kind: DeviceKind, willing: bool, asked: &Asked) -> Self {
        static IDENTITY: OnceLock<Identity> = OnceLock::new();
        let identity =
            IDENTITY.get_or_init(|| identity(DeviceKind::Rig, [7; 12], 1, ResetCause::PowerOn));
        Self {
            kind,
            willing,
            service: Service::new(Identity {
                device: kind,
                ..*identity
            }),
            asked: asked.clone(),
            said: vec![],
        }
    }

    fn answer(&self, inbound: &Inbound) -> Reply {
        let request = match inbound {
            Inbound::Urgent(urgent) => {
                self.asked.notes().stops.push((self.kind, *urgent));
                return Reply::Urgent(*urgent);
            }
            Inbound::Request(request) => request,
        };
        if request.impact() != Impact::None {
            let mut notes = self.asked.notes();
            notes.changes.push((self.kind, request.clone()));
            if !self.willing {
                return Reply::Refused(Refusal::NotHomed);
            }
        }
        Reply::Accepted(response(request))
    }
}

impl Peer for Exemplary {
    fn take(&mut self, bytes: &[u8], _: u64) {
        for byte in bytes {
            let frame = match self
                .service
                .receive(*byte)
                .map(|received| received.incoming)
            {
                Some(Incoming::Send(frame)) => Some(frame),
                Some(Incoming::Ask(inbound, to)) => {
                    let reply = self.answer(&inbound);
                    self.service.answer(to, &reply)
                }
                Some(Incoming::Ignore) | None => None,
            };
            self.said.extend(frame.into_iter().flatten());
        }
    }

    fn give(&mut self, _: u64) -> Vec<u8> {
        std::mem::take(&mut self.said)
    }

    fn next_us(&self) -> u64 {
        u64::MAX
    }
}

/// The exemplar for a request; in a status the machine stands.
fn response(request: &Request) -> Response {
    static EXEMPLARS: OnceLock<Vec<Response>> = OnceLock::new();
    let exemplars = EXEMPLARS.get_or_init(|| {
        // One of each, in the order of the table.
        let mut all = exemplars::responses();
        assert_eq!(all.len(), Request::NAMES.len());
        for response in &mut all {
            match response {
                Response::GetRigStatus(status) => {
                    status.state = RigState::Ready;
                    status.fault = None;
                }
                Response::GetCapsuleStatus(status) => {
                    status.state = CapsuleState::Unfolded;
                    status.fault = None;
                }
                // Else it has no end.
                Response::GetTrace(trace) => trace.points.clear(),
                _ => {}
            }
        }
        all
    });
    let index = Request::NAMES
        .iter()
        .position(|name| *name == request.name());
    exemplars[index.expect("of the table")].clone()
}

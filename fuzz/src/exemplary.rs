//! A machine that answers each request with the protocol's exemplar of its response, never moves, and logs the
//! requests.

use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use device::identity::identity;
use device::service::{Inbound, Incoming, Service};
use protocol::capsule::CapsuleState;
use protocol::error::Refusal;
use protocol::rig::RigState;
use protocol::system::{DeviceKind, Events, Identity, ResetCause, Urgent};
use protocol::table::{Impact, Reply, Request, Response};
use simulated_machines::link::Peer;

/// A log of executed requests; clones share it.
#[derive(Clone, Debug, Default)]
pub struct SharedLog(Arc<Mutex<RequestLog>>);

/// The requests in the order of their arrival.
#[derive(Clone, Debug, Default)]
pub struct RequestLog {
    /// Executed requests that change something.
    pub changes: Vec<(DeviceKind, Request)>,
    /// Stops.
    pub stops: Vec<(DeviceKind, Urgent)>,
}

impl SharedLog {
    /// Locks the log.
    pub fn lock(&self) -> MutexGuard<'_, RequestLog> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A machine that answers by exemplars.
#[derive(Debug)]
pub struct Exemplary {
    kind: DeviceKind,
    /// Whether it accepts motions; otherwise it refuses them as not ready.
    willing: bool,
    /// Whether its recording and its events never end.
    endless: bool,
    service: Service,
    log: SharedLog,
    sent: Vec<u8>,
}

impl Exemplary {
    /// A machine that has just started.
    #[must_use]
    pub fn new(kind: DeviceKind, willing: bool, log: &SharedLog) -> Self {
        static IDENTITY: OnceLock<Identity> = OnceLock::new();
        let identity =
            IDENTITY.get_or_init(|| identity(DeviceKind::Rig, [7; 12], 1, ResetCause::PowerOn));
        Self {
            kind,
            willing,
            endless: false,
            service: Service::new(Identity {
                device: kind,
                ..*identity
            }),
            log: log.clone(),
            sent: vec![],
        }
    }

    fn answer(&self, inbound: &Inbound) -> Reply {
        let request = match inbound {
            Inbound::Urgent(urgent) => {
                self.log.lock().stops.push((self.kind, *urgent));
                return Reply::Urgent(*urgent);
            }
            Inbound::Request(request) => request,
        };
        if request.impact() != Impact::None {
            let mut lock = self.log.lock();
            lock.changes.push((self.kind, request.clone()));
            if !self.willing {
                return Reply::Refused(Refusal::NotHomed);
            }
        }
        match response(request) {
            Response::GetEvents(events) => {
                let events = match self.endless {
                    true => endless(request, events),
                    false => kept(request, events),
                };
                Reply::Accepted(Response::GetEvents(events))
            }
            // End the recording, or the client would request the exemplar's points for ever.
            Response::GetTrace(mut trace) if !self.endless => {
                trace.points.clear();
                Reply::Accepted(Response::GetTrace(trace))
            }
            response => Reply::Accepted(response),
        }
    }
}

impl Peer for Exemplary {
    fn take(&mut self, bytes: &[u8], _: u64) {
        for byte in bytes {
            let frame = match self.service.receive(*byte, 0) {
                Some(Incoming::Send(frame)) => Some(frame),
                Some(Incoming::Ask(inbound, to)) => {
                    let reply = self.answer(&inbound);
                    self.service.answer(to, &reply)
                }
                Some(Incoming::Ignore) | None => None,
            };
            self.sent.extend(frame.into_iter().flatten());
        }
    }

    fn give(&mut self, _: u64) -> Vec<u8> {
        std::mem::take(&mut self.sent)
    }

    fn next_us(&self) -> u64 {
        u64::MAX
    }
}

/// The exemplar's events from the requested number on.
fn kept(request: &Request, mut events: Events) -> Events {
    if let Request::GetEvents(get) = request {
        events.events.retain(|event| event.index >= get.from);
    }
    events
}

/// The requested events, as if as many as possible were still to come. A client that connects asks for the newest
/// index, and gets 0.
fn endless(request: &Request, mut events: Events) -> Events {
    let Request::GetEvents(get) = request else {
        return events;
    };
    if get.from == u32::MAX {
        (events.oldest, events.next) = (0, 0);
        events.events.clear();
        return events;
    }
    (events.oldest, events.next) = (0, u32::MAX);
    for (index, event) in (get.from..).zip(&mut events.events) {
        event.index = index;
    }
    events
}

/// The exemplar of the response to a request; a status shows a machine at rest.
fn response(request: &Request) -> Response {
    static EXEMPLARS: OnceLock<Vec<Response>> = OnceLock::new();
    let exemplars = EXEMPLARS.get_or_init(|| {
        // Exemplars in the order of the table, one per row.
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

#[cfg(test)]
mod tests {
    use client::Device;
    use client::error::ClientError;
    use lab::trials::fetched;
    use simulated_machines::link::Memory;

    use super::*;

    fn endless() -> Device {
        let mut machine = Exemplary::new(DeviceKind::Capsule, true, &SharedLog::default());
        machine.endless = true;
        let link = Box::new(Memory::new("bench", machine));
        Device::connect(link, DeviceKind::Capsule, 1).expect("a capsule")
    }

    #[test]
    fn a_recording_and_events_without_an_end_are_given_up() {
        let now = jiff::Timestamp::UNIX_EPOCH;
        for error in [
            endless().trace().expect_err("no end"),
            fetched::fetch(&mut endless(), now).expect_err("no end"),
            endless().take_events().expect_err("no end"),
        ] {
            let is_wrong = matches!(error, ClientError::NotUnderstood { error: None, .. });
            assert!(is_wrong, "{error}");
        }
    }
}

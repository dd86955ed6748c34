//! Helpers for the tests of the link: noise, raw bytes, and a device that keeps what it executed.

use protocol::{
    frame::{Deframer, Encoded, Header, Kind, encode},
    session::{Decision, Session},
    system::{BuildProfile, DeviceKind, Done, Identity, ResetCause, Revision},
    table::{Reply, Request, Response, SCHEMA_KEY},
};

/// Deterministic noise.
pub struct Noise(pub u64);
impl Noise {
    pub fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }
    /// True once in `n` on average.
    pub fn one_in(&mut self, n: u64) -> bool {
        self.next().is_multiple_of(n)
    }
}

/// Bytes without a length in front of them.
pub struct Raw(pub Vec<u8>);
impl serde::Serialize for Raw {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        use serde::ser::SerializeTuple;
        let mut tuple = serializer.serialize_tuple(self.0.len())?;
        self.0
            .iter()
            .try_for_each(|byte| tuple.serialize_element(byte))?;
        tuple.end()
    }
}

/// A device that keeps what it executed.
pub struct Device {
    pub deframer: Deframer,
    pub session: Session,
    /// The interval of each [`Request::SetTelemetry`] that was executed.
    pub executed: Vec<u16>,
    pub stops: u32,
    pub boots: u32,
}

impl Device {
    pub fn new() -> Self {
        Self {
            deframer: Deframer::new(),
            session: Session::new(1),
            executed: vec![],
            stops: 0,
            boots: 1,
        }
    }

    pub fn reset(&mut self) {
        self.boots += 1;
        self.session = Session::new(self.boots);
        self.deframer = Deframer::new();
    }

    pub fn identity(&self, session: u8) -> Identity {
        Identity {
            device: DeviceKind::Rig,
            protocol: protocol::VERSION,
            schema_key: SCHEMA_KEY,
            uid: [0; 12],
            revision: Revision {
                commit: 1,
                dirty: false,
            },
            profile: BuildProfile::Firmware,
            boot_id: self.boots,
            reset_cause: ResetCause::Pin,
            session,
        }
    }

    pub fn receive(&mut self, byte: u8) -> Option<Encoded> {
        let frame = self.deframer.push(byte)?;
        let reply = |session, seq, reply: &Reply| {
            encode(
                Header {
                    kind: Kind::Reply,
                    session,
                    seq,
                },
                reply,
            )
            .ok()
        };
        match self.session.receive(&frame) {
            Decision::Greet { session, seq } => reply(
                session,
                seq,
                &Reply::Accepted(Response::Hello(self.identity(session))),
            ),
            Decision::Execute { request, ticket } => {
                let response = match request {
                    Request::SetTelemetry(set) => {
                        self.executed.push(set.period_ms);
                        Response::SetTelemetry(set)
                    }
                    _ => Response::KeepAlive(Done),
                };
                let frame = reply(ticket.session, ticket.seq, &Reply::Accepted(response))?;
                self.session.remember(ticket, &frame);
                Some(frame)
            }
            Decision::Urgent {
                urgent,
                session,
                seq,
            } => {
                self.stops += 1;
                reply(session, seq, &Reply::Urgent(urgent))
            }
            Decision::Resend(frame) => Some(frame),
            Decision::Refuse { refusal, ticket } => {
                let frame = reply(ticket.session, ticket.seq, &Reply::Refused(refusal))?;
                self.session.remember(ticket, &frame);
                Some(frame)
            }
            Decision::Reject {
                error,
                session,
                seq,
            } => reply(session, seq, &Reply::Wire(error)),
            Decision::Ignore => None,
        }
    }
}

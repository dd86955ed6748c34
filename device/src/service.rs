//! The device's end of the link without its wires: bytes in, frames and questions to the state machine out.

use protocol::{
    frame::{Deframer, Encoded, Header, Kind, encode},
    session::{Decision, Session, Ticket},
    system::{Identity, Urgent},
    table::{Reply, Request, Response},
};

/// A question to the state machine's owner.
// One exists at a time, in a signal.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug, PartialEq)]
pub enum Inbound {
    /// Of the session.
    Request(Request),
    /// A stop; valid at any time.
    Urgent(Urgent),
}

/// Control of a machine, as the link's questions reach it.
pub trait Answers {
    /// Carries out a request of the session.
    fn request(&mut self, request: Request) -> Reply;

    /// Carries out a stop, which cannot be refused.
    fn stop(&mut self, urgent: Urgent);

    /// Answers a question.
    fn answer(&mut self, inbound: Inbound) -> Reply {
        match inbound {
            Inbound::Request(request) => self.request(request),
            Inbound::Urgent(urgent) => {
                self.stop(urgent);
                Reply::Urgent(urgent)
            }
        }
    }
}

/// What a good frame asks for.
// One exists at a time, on the stack.
#[allow(clippy::large_enum_variant)]
#[derive(Debug, PartialEq)]
pub enum Incoming {
    /// Send this.
    Send(Encoded),
    /// Have this carried out, then send [`Service::answer`].
    Ask(Inbound, Return),
    /// Nothing: not addressed to a device.
    Ignore,
}

/// A good frame.
#[derive(Debug, PartialEq)]
pub struct Received {
    /// What it asks for.
    pub incoming: Incoming,
    /// It shows that the host of the session, or somebody who stops the machine, is there.
    pub is_sign_of_life: bool,
}

/// A host is alive that opens a session, sends a request of it, or stops the machine. A frame of another session is a host
/// that was left behind; a malformed one may be anybody's; one that only devices send is an echo on the line.
fn is_sign_of_life(decision: &Decision) -> bool {
    match decision {
        Decision::Greet { .. }
        | Decision::Execute { .. }
        | Decision::Urgent { .. }
        | Decision::Resend(_)
        | Decision::Refuse { .. } => true,
        Decision::Reject { .. } | Decision::Ignore => false,
    }
}

/// Where an answer goes: session, sequence, and the ticket of a request that may be repeated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Return(u8, u16, Option<Ticket>);

/// The device's end.
#[derive(Debug)]
pub struct Service {
    deframer: Deframer,
    session: Session,
    identity: Identity,
}

impl Service {
    /// No session yet. `identity` is complete but for the session.
    #[must_use]
    pub const fn new(identity: Identity) -> Self {
        Self {
            deframer: Deframer::new(),
            session: Session::new(identity.boot_id),
            identity,
        }
    }

    /// Blocks of bytes that were no good frames, since the start.
    pub fn bad_frames(&self) -> u32 {
        self.deframer.rejected()
    }

    /// Number of the session for frames that nobody asked for; 0 before the first.
    pub fn session(&self) -> u8 {
        self.session.number()
    }

    /// Takes a byte; something comes back when it completes a good frame.
    #[inline(never)]
    pub fn receive(&mut self, byte: u8) -> Option<Received> {
        let frame = self.deframer.push(byte)?;
        let decision = self.session.receive(&frame);
        Some(Received {
            is_sign_of_life: is_sign_of_life(&decision),
            incoming: serve(&mut self.session, &self.identity, decision),
        })
    }

    /// The frame of a reply, kept for the case that its request is repeated.
    pub fn answer(&mut self, to: Return, reply: &Reply) -> Option<Encoded> {
        answer(&mut self.session, to, reply)
    }
}

fn serve(session: &mut Session, identity: &Identity, decision: Decision) -> Incoming {
    let (to, reply) = match decision {
        Decision::Greet {
            session: number,
            seq,
        } => {
            let identity = Identity {
                session: number,
                ..*identity
            };
            let reply = Reply::Accepted(Response::Hello(identity));
            (Return(number, seq, None), reply)
        }
        Decision::Execute { request, ticket } => {
            return Incoming::Ask(
                Inbound::Request(request),
                Return(ticket.session, ticket.seq, Some(ticket)),
            );
        }
        Decision::Urgent {
            urgent,
            session,
            seq,
        } => return Incoming::Ask(Inbound::Urgent(urgent), Return(session, seq, None)),
        Decision::Resend(frame) => return Incoming::Send(frame),
        Decision::Refuse { refusal, ticket } => (
            Return(ticket.session, ticket.seq, Some(ticket)),
            Reply::Refused(refusal),
        ),
        Decision::Reject {
            error,
            session,
            seq,
        } => (Return(session, seq, None), Reply::Wire(error)),
        Decision::Ignore => return Incoming::Ignore,
    };
    answer(session, to, &reply).map_or(Incoming::Ignore, Incoming::Send)
}

/// Not inlined: one copy of the whole encoder.
#[inline(never)]
fn answer(open: &mut Session, to: Return, reply: &Reply) -> Option<Encoded> {
    let Return(session, seq, ticket) = to;
    let kind = Kind::Reply;
    let header = Header { kind, session, seq };
    let frame = encode(header, reply).ok()?;
    if let Some(ticket) = ticket {
        open.remember(ticket, &frame);
    }
    Some(frame)
}

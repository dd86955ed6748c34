//! The device's end of the link, without the hardware: takes bytes, returns frames and requests for the state machine.

use protocol::{
    frame::{Deframer, Encoded, Header, Kind, encode},
    session::{Decision, Session, Ticket},
    system::{Identity, Urgent},
    table::{Impact, Reply, Request, Response},
};

/// A request or a stop for the owner of the state machine.
// One exists at a time, in a signal.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug, PartialEq)]
pub enum Inbound {
    Request(Request),
    /// A stop; valid at any time.
    Urgent(Urgent),
}

/// Control of a machine, as the link sees it.
pub trait Answers {
    /// Carries out a request of the session.
    fn request(&mut self, request: Request) -> Reply;

    /// Carries out a stop, which cannot be refused.
    fn stop(&mut self, urgent: Urgent);

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

/// Reaction to a good frame.
// One exists at a time, on the stack.
#[allow(clippy::large_enum_variant)]
#[derive(Debug, PartialEq)]
pub enum Incoming {
    Send(Encoded),
    /// Let control carry this out, then send [`Service::answer`].
    Ask(Inbound, Return),
    /// Nothing: not addressed to a device.
    Ignore,
}

/// When the host that began the motion was last heard. A motion ends when that host falls silent. Another host that
/// takes over the line opens its own session, and its requests do not keep a motion alive that it did not begin.
#[derive(Debug)]
struct Liveness {
    /// The present session has begun a motion.
    began: bool,
    /// Low 32 bits of the time, us.
    heard_us: u32,
    /// Previous `heard_us`, from before the request in progress.
    before_us: u32,
}

impl Liveness {
    /// Notes a frame, and decides whether it is a sign of life. A frame of another session comes from the previous
    /// host, a malformed one from any host, and a frame that only devices send is an echo. A stop is no sign of life
    /// either.
    fn update(&mut self, decision: &Decision, is_new_session: bool, now_us: u32) {
        self.before_us = self.heard_us;
        self.began &= !is_new_session;
        let is_sign = match decision {
            // Count it now: the motion may begin before the answer is known.
            Decision::Execute { request, .. } => self.began || begins(request),
            Decision::Greet { .. } | Decision::Resend(_) | Decision::Refuse { .. } => self.began,
            Decision::Urgent { .. } | Decision::Reject { .. } | Decision::Ignore => false,
        };
        if is_sign {
            self.heard_us = now_us;
        }
    }

    /// Notes the answer to a request that begins a motion.
    fn answered(&mut self, is_accepted: bool) {
        if is_accepted {
            self.began = true;
        } else if !self.began {
            self.heard_us = self.before_us;
        }
    }
}

/// Whether this request begins a motion, if it is accepted.
fn begins(request: &Request) -> bool {
    request.impact() == Impact::Motion || matches!(request, Request::Resume(_))
}

/// Header of an answer, and the ticket of a request that may be repeated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Return {
    session: u8,
    seq: u16,
    ticket: Option<Ticket>,
    begins: bool,
}

impl Return {
    const fn new(session: u8, seq: u16, ticket: Option<Ticket>) -> Self {
        Self {
            session,
            seq,
            ticket,
            begins: false,
        }
    }
}

#[derive(Debug)]
pub struct Service {
    deframer: Deframer,
    session: Session,
    identity: Identity,
    liveness: Liveness,
}

impl Service {
    /// Creates a service without a session. `identity` is complete except for the session.
    #[must_use]
    pub const fn new(identity: Identity) -> Self {
        Self {
            deframer: Deframer::new(),
            session: Session::new(identity.boot_id),
            identity,
            liveness: Liveness {
                began: false,
                heard_us: 0,
                before_us: 0,
            },
        }
    }

    /// Bad frames since the start.
    pub fn bad_frames(&self) -> u32 {
        self.deframer.rejected()
    }

    /// Session number for unsolicited frames; 0 before the first session.
    pub fn session(&self) -> u8 {
        self.session.number()
    }

    /// When the host that began the motion was last heard, low 32 bits, us. It changes with [`Service::receive`] and
    /// [`Service::answer`].
    pub fn heard_us(&self) -> u32 {
        self.liveness.heard_us
    }

    /// Takes a byte. `now_us` is the low 32 bits of the time. Returns a value when the byte completes a good frame.
    pub fn receive(&mut self, byte: u8, now_us: u32) -> Option<Incoming> {
        let frame = self.deframer.push(byte)?;
        let before = self.session.number();
        let decision = self.session.receive(&frame);
        let is_new_session = self.session.number() != before;
        self.liveness.update(&decision, is_new_session, now_us);
        Some(serve(&mut self.session, &self.identity, decision))
    }

    /// Encodes a reply, and keeps the frame in case the request is repeated.
    pub fn answer(&mut self, to: Return, reply: &Reply) -> Option<Encoded> {
        // After a newer Hello, this answer does not begin a motion for the new host.
        if to.begins && to.session == self.session.number() {
            self.liveness.answered(matches!(reply, Reply::Accepted(_)));
        }
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
            (Return::new(number, seq, None), reply)
        }
        Decision::Execute { request, ticket } => {
            let to = Return {
                begins: begins(&request),
                ..Return::new(ticket.session, ticket.seq, Some(ticket))
            };
            return Incoming::Ask(Inbound::Request(request), to);
        }
        Decision::Urgent {
            urgent,
            session,
            seq,
        } => return Incoming::Ask(Inbound::Urgent(urgent), Return::new(session, seq, None)),
        Decision::Resend(frame) => return Incoming::Send(frame),
        Decision::Refuse { refusal, ticket } => (
            Return::new(ticket.session, ticket.seq, Some(ticket)),
            Reply::Refused(refusal),
        ),
        Decision::Reject {
            error,
            session,
            seq,
        } => (Return::new(session, seq, None), Reply::Wire(error)),
        Decision::Ignore => return Incoming::Ignore,
    };
    answer(session, to, &reply).map_or(Incoming::Ignore, Incoming::Send)
}

fn answer(open: &mut Session, to: Return, reply: &Reply) -> Option<Encoded> {
    let Return {
        session,
        seq,
        ticket,
        ..
    } = to;
    let kind = Kind::Reply;
    let header = Header { kind, session, seq };
    let frame = encode(header, reply).ok()?;
    if let Some(ticket) = ticket {
        open.remember(ticket, &frame);
    }
    Some(frame)
}

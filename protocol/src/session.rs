//! The device's end: decides for each frame whether to execute it, to answer it from the cache, or to refuse it.
//!
//! Sans-IO and without a clock: frames in, decisions out. The owner executes, sends, and calls [`Session::remember`]
//! before it hands in the next frame. Otherwise a repeated request would be rejected as stale.

use crate::{
    VERSION,
    error::{Refusal, WireError},
    frame::{Encoded, Frame, Kind},
    system::{Hello, Urgent},
    table::{Request, SCHEMA_KEY},
};

/// Number of answers kept for repeated requests.
pub const CACHED_REPLIES: usize = 4;

/// The decision on a received frame.
#[derive(Clone, Debug, PartialEq)]
// One decision exists at a time, on the stack.
#[allow(clippy::large_enum_variant)]
pub enum Decision {
    /// Answer with the identity and this session number. There is nothing to remember.
    Greet {
        /// Session to put into the identity and the reply's header.
        session: u8,
        /// Sequence of the reply.
        seq: u16,
    },
    /// Execute, answer, and [`Session::remember`] the encoded answer.
    Execute {
        request: Request,
        /// Ticket for [`Session::remember`].
        ticket: Ticket,
    },
    /// Carry out at once and answer with [`crate::table::Reply::Urgent`].
    Urgent {
        /// Stop or emergency stop.
        urgent: Urgent,
        /// Session of the reply, as received.
        session: u8,
        /// Sequence of the reply.
        seq: u16,
    },
    /// Send these bytes again; execute nothing.
    Resend(Encoded),
    /// Answer with the refusal and [`Session::remember`] it; execute nothing.
    Refuse {
        refusal: Refusal,
        /// Ticket for [`Session::remember`], with the reply's session and sequence.
        ticket: Ticket,
    },
    /// Answer with the wire error; execute nothing.
    Reject {
        error: WireError,
        /// Session of the reply, as received.
        session: u8,
        /// Sequence of the reply.
        seq: u16,
    },
    /// Send nothing: only devices send such a frame, so it is an echo of our own.
    Ignore,
}

/// Identifies the request that an answer belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ticket {
    pub session: u8,
    pub seq: u16,
    body_hash: u64,
}

#[derive(Debug)]
struct Cached {
    ticket: Ticket,
    reply: Encoded,
}

#[derive(Debug)]
pub struct Session {
    number: u8,
    /// A host has said Hello since the device started.
    open: bool,
    nonce: u32,
    matched: bool,
    newest_seq: Option<u16>,
    cache: heapless::Deque<Cached, CACHED_REPLIES>,
}

impl Session {
    /// Creates the device's end without a session. The number of the first session is derived from `first`, the boot
    /// id, and the first nonce: after a restart it most likely differs from the number before.
    pub const fn new(first: u32) -> Self {
        Self {
            number: (first % 255) as u8 + 1,
            open: false,
            nonce: 0,
            matched: false,
            newest_seq: None,
            cache: heapless::Deque::new(),
        }
    }

    /// Decides what to do with one frame.
    pub fn receive(&mut self, frame: &Frame<'_>) -> Decision {
        let (session, seq) = (frame.header.session, frame.header.seq);
        match frame.header.kind {
            Kind::Urgent => match frame.decode::<Urgent>() {
                Some(urgent) => Decision::Urgent {
                    urgent,
                    session,
                    seq,
                },
                None => Decision::Reject {
                    error: WireError::Malformed,
                    session,
                    seq,
                },
            },
            Kind::Request => match frame.decode::<Request>() {
                // Serve a Hello of any version: its encoding never changes.
                Some(Request::Hello(hello)) => self.greet(&hello, seq),
                request => self.request(request, frame),
            },
            Kind::Reply | Kind::Telemetry | Kind::Event => Decision::Ignore,
        }
    }

    fn greet(&mut self, hello: &Hello, seq: u16) -> Decision {
        let again = self.open && hello.nonce == self.nonce;
        if !again {
            // The boot id is 1 after every power-on, so a program that missed the restart may still hold the number
            // that would follow. Let the first nonce choose it instead: every number except the last one is equally
            // likely.
            let on = if self.open { 1 } else { 1 + hello.nonce % 254 };
            self.number = ((u32::from(self.number) - 1 + on) % 255) as u8 + 1;
            self.nonce = hello.nonce;
            self.newest_seq = None;
            self.cache.clear();
        }
        self.matched = hello.protocol.major == VERSION.major && hello.schema_key == SCHEMA_KEY;
        self.open = true;
        Decision::Greet {
            session: self.number,
            seq,
        }
    }

    fn request(&mut self, request: Option<Request>, frame: &Frame<'_>) -> Decision {
        let (session, seq) = (frame.header.session, frame.header.seq);
        let reject = |error| Decision::Reject {
            error,
            session,
            seq,
        };
        if !self.open || session != self.number {
            return reject(WireError::NoSession);
        }
        let ticket = Ticket {
            session,
            seq,
            body_hash: fnv1a(frame.body()),
        };
        if let Some(cached) = self.cache.iter().find(|cached| cached.ticket.seq == seq) {
            return if cached.ticket == ticket {
                Decision::Resend(cached.reply.clone())
            } else {
                reject(WireError::SequenceReused)
            };
        }
        if self.newest_seq.is_some_and(|newest| !is_newer(seq, newest)) {
            return reject(WireError::Stale);
        }
        let Some(request) = request else {
            return reject(WireError::Malformed);
        };
        self.newest_seq = Some(seq);
        if request.needs_match() && !self.matched {
            return Decision::Refuse {
                refusal: Refusal::Incompatible,
                ticket,
            };
        }
        Decision::Execute { request, ticket }
    }

    /// Keeps the encoded answer to a request, to send it again if the request is repeated.
    pub fn remember(&mut self, ticket: Ticket, reply: &Encoded) {
        if ticket.session != self.number {
            return; // answered after a newer Hello: keep it out of the new session's cache
        }
        if self.cache.is_full() {
            self.cache.pop_front();
        }
        // Cannot fail: there is room for one more.
        let _ = self.cache.push_back(Cached {
            ticket,
            reply: reply.clone(),
        });
    }

    /// Number of the present session, for telemetry and events; 0 before the first [`Hello`].
    pub fn number(&self) -> u8 {
        if self.open { self.number } else { 0 }
    }
}

/// Whether `a` comes after `b`, in serial-number arithmetic (RFC 1982).
fn is_newer(a: u16, b: u16) -> bool {
    matches!(a.wrapping_sub(b), 1..0x8000)
}

/// FNV-1a, 64 bits (Fowler, Noll, Vo).
pub fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x100_0000_01b3)
    })
}

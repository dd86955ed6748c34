//! The host's end: sends one request at a time, repeats it until it is answered, and counts lost telemetry.
//!
//! Sans-IO and without a clock: `now_us` is an argument. The owner moves the bytes.

use crate::{
    VERSION,
    error::{Refusal, WireError},
    frame::{Deframer, Encoded, Header, Kind, encode},
    system::{Event, Hello, Identity, Urgent},
    table::{Impact, Reply, Request, Response, SCHEMA_KEY, Telemetry},
};

/// Time to wait for an answer before the request is sent again. A full frame takes 15 ms at 115200 baud.
pub const RETRY_AFTER_US: u64 = 100_000;
/// Times a request is sent before its outcome is reported as unknown.
pub const ATTEMPTS: u8 = 8;
/// [`ATTEMPTS`] for requests that write to flash: the device receives nothing while it erases, half a second or more.
pub const FLASH_ATTEMPTS: u8 = 30;

/// A received message for the owner of a [`Client`].
#[derive(Clone, Debug, PartialEq)]
// One output exists at a time, on the stack.
#[allow(clippy::large_enum_variant)]
pub enum Output {
    /// The pending request was carried out or begun.
    Accepted(Response),
    /// The pending request was refused; nothing moved.
    Refused(Refusal),
    /// The device could not use the pending request; nothing moved. After [`WireError::NoSession`] the session is
    /// closed: the device was reset or another host took over.
    Rejected(WireError),
    /// The urgent stop was carried out.
    UrgentDone(Urgent),
    Telemetry {
        /// Samples lost just before this one.
        missed: u16,
        sample: Telemetry,
    },
    /// An event, sent as it happened. A gap in the indices shows that events were lost; they can be fetched again.
    Event(Event),
}

/// The next action for the owner of a [`Client`].
#[derive(Clone, Debug, PartialEq)]
// One exists at a time, on the stack.
#[allow(clippy::large_enum_variant)]
pub enum Poll {
    /// Send these bytes, then poll again.
    Transmit(Encoded),
    /// Wait for bytes until this time (`u64::MAX`: until the next request).
    WaitUntil(u64),
    /// Give up: nothing answered the request or the stop, which may or may not have been carried out.
    TimedOut,
}

/// A request is already pending, or (other than Hello) there is no session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotNow;

#[derive(Debug)]
struct Pending {
    header: Header,
    frame: Encoded,
    attempts: u8,
    sent: u8,
    next_us: u64,
}

impl Pending {
    fn new(header: Header, frame: Encoded, attempts: u8) -> Self {
        Self {
            header,
            frame,
            attempts,
            sent: 0,
            next_us: 0,
        }
    }

    fn poll(&mut self, now_us: u64) -> Poll {
        if now_us < self.next_us {
            return Poll::WaitUntil(self.next_us);
        }
        if self.sent == self.attempts {
            return Poll::TimedOut;
        }
        self.sent += 1;
        self.next_us = now_us.saturating_add(RETRY_AFTER_US);
        Poll::Transmit(self.frame.clone())
    }
}

/// The host's end of a session. By default it has none, and numbers its frames from 0.
#[derive(Debug, Default)]
pub struct Client {
    deframer: Deframer,
    session: u8,
    next_seq: u16,
    pending: Option<Pending>,
    urgent: Option<(Urgent, Pending)>,
    next_telemetry: Option<u16>,
}

impl Client {
    /// A client without a session. Pass a `seq` that the previous connection has not just used. Otherwise a late
    /// reply to that connection could confirm a stop that the device never received.
    pub fn numbering_from(seq: u16) -> Self {
        Self {
            next_seq: seq,
            ..Self::default()
        }
    }

    /// Asks the device for its identity and a session. Take a new `nonce` for every connection.
    ///
    /// # Errors
    /// [`NotNow`] while a request is pending.
    pub fn hello(&mut self, nonce: u32) -> Result<(), NotNow> {
        self.session = 0;
        self.next_telemetry = None;
        self.put(&Request::Hello(Hello {
            protocol: VERSION,
            schema_key: SCHEMA_KEY,
            nonce,
        }))
    }

    /// Sends a request in the open session.
    ///
    /// # Errors
    /// [`NotNow`] while a request is pending or without a session.
    pub fn request(&mut self, request: &Request) -> Result<(), NotNow> {
        if self.session == 0 {
            return Err(NotNow);
        }
        self.put(request)
    }

    fn put(&mut self, request: &Request) -> Result<(), NotNow> {
        if self.pending.is_some() {
            return Err(NotNow);
        }
        let header = Header {
            kind: Kind::Request,
            session: self.session,
            seq: self.take_seq(),
        };
        // The messages of this crate all fit; see the test `every_message_fits`.
        let frame = encode(header, request).map_err(|_| NotNow)?;
        let attempts = match request.impact() {
            Impact::Flash => FLASH_ATTEMPTS,
            _ => ATTEMPTS,
        };
        self.pending = Some(Pending::new(header, frame, attempts));
        Ok(())
    }

    /// Stops the machine. Goes ahead of any pending request and needs no session. Another call replaces the one before,
    /// but [`Urgent::Stop`] never weakens an [`Urgent::EStop`] that is not confirmed: that is sent again.
    pub fn urgent(&mut self, urgent: Urgent) {
        let urgent = match self.urgent {
            Some((unconfirmed, _)) => urgent.max(unconfirmed),
            None => urgent,
        };
        let header = Header {
            kind: Kind::Urgent,
            session: self.session,
            seq: self.take_seq(),
        };
        self.urgent = encode(header, &urgent)
            .ok()
            .map(|frame| (urgent, Pending::new(header, frame, ATTEMPTS)));
    }

    /// Forgets the pending request: it is not sent again, and an answer to it is not reported.
    pub fn forget(&mut self) {
        self.pending = None;
    }

    fn take_seq(&mut self) -> u16 {
        let seq = self.next_seq;
        self.next_seq = seq.wrapping_add(1);
        seq
    }

    /// Returns the next action: send, wait or give up.
    pub fn poll(&mut self, now_us: u64) -> Poll {
        let urgent = match &mut self.urgent {
            Some((_, pending)) => pending.poll(now_us),
            None => Poll::WaitUntil(u64::MAX),
        };
        let Poll::WaitUntil(urgent_us) = urgent else {
            if urgent == Poll::TimedOut {
                self.urgent = None;
            }
            return urgent;
        };
        let pending = match &mut self.pending {
            // While a stop is unanswered, a pending request waits, so that it cannot delay the stop.
            Some(pending) if self.urgent.is_none() => pending.poll(now_us),
            _ => Poll::WaitUntil(u64::MAX),
        };
        match pending {
            Poll::WaitUntil(pending_us) => Poll::WaitUntil(urgent_us.min(pending_us)),
            Poll::TimedOut => {
                self.pending = None;
                Poll::TimedOut
            }
            Poll::Transmit(frame) => Poll::Transmit(frame),
        }
    }

    pub fn receive(&mut self, byte: u8) -> Option<Output> {
        let frame = self.deframer.push(byte)?;
        // A restarted device sends events without a session before this end knows of the restart.
        let in_session = self.session != 0 && frame.header.session != 0;
        match frame.header.kind {
            Kind::Telemetry if in_session => {
                let sample = frame.decode()?;
                let seq = frame.header.seq;
                let missed = self
                    .next_telemetry
                    .map_or(0, |expected| seq.wrapping_sub(expected));
                self.next_telemetry = Some(seq.wrapping_add(1));
                Some(Output::Telemetry { missed, sample })
            }
            Kind::Event if in_session => frame.decode().map(Output::Event),
            Kind::Reply => {
                let (header, reply) = (frame.header, frame.decode::<Reply>()?);
                self.reply(header, reply)
            }
            Kind::Telemetry | Kind::Event | Kind::Request | Kind::Urgent => None,
        }
    }

    fn reply(&mut self, header: Header, reply: Reply) -> Option<Output> {
        if let Reply::Urgent(urgent) = reply {
            // A device confirms the stop that it has carried out. The confirmation of another, weaker one does not
            // count.
            self.urgent
                .take_if(|(asked, pending)| pending.header.seq == header.seq && *asked == urgent)?;
            return Some(Output::UrgentDone(urgent));
        }
        self.pending
            .take_if(|pending| pending.header.seq == header.seq)?;
        Some(match reply {
            Reply::Accepted(response) => {
                if let Response::Hello(Identity { session, .. }) = response {
                    self.session = session;
                }
                Output::Accepted(response)
            }
            Reply::Refused(refusal) => Output::Refused(refusal),
            Reply::Wire(error) => {
                if error == WireError::NoSession {
                    self.session = 0;
                }
                Output::Rejected(error)
            }
            Reply::Urgent(urgent) => Output::UrgentDone(urgent),
        })
    }

    pub fn is_open(&self) -> bool {
        self.session != 0
    }

    /// Number of received blocks that were not valid frames.
    pub fn rejected_frames(&self) -> u32 {
        self.deframer.rejected()
    }
}

//! Events: numbered, kept for whoever asks later, and made into frames for whoever listens now.

use protocol::{
    events::EventRing,
    frame::{Encoded, Header, Kind, encode},
    system::{Event, Events, What},
};

/// The events since the device's start.
#[derive(Debug, Default)]
pub struct Outbox {
    ring: EventRing,
}

impl Outbox {
    /// Nothing has happened yet.
    pub const fn new() -> Self {
        Self {
            ring: EventRing::new(),
        }
    }

    /// Records an event. Returns its frame for `session`; none for session 0, in which nobody listens.
    ///
    /// The frame may be dropped when the line is busy: the host fetches the event by its index.
    pub fn record(&mut self, now_us: u64, what: What, session: u8) -> Option<Encoded> {
        let event = self.ring.record(now_us, what);
        if session == 0 {
            return None;
        }
        frame(session, &event)
    }

    /// As [`EventRing::since`].
    pub fn since(&self, from: u32) -> Events {
        self.ring.since(from)
    }
}

fn frame(session: u8, event: &Event) -> Option<Encoded> {
    let header = Header {
        kind: Kind::Event,
        session,
        seq: event.index as u16,
    };
    encode(header, event).ok()
}

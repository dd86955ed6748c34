//! The device's ring of events: numbered and timed, so that a host can fetch lost ones by index.

use crate::system::{EVENTS_PER_REPLY, Event, Events, What};

/// Number of events that the ring holds.
pub const RING: usize = 32;

/// The ring. Index 0 is the first event since the device's start.
#[derive(Debug, Default)]
pub struct EventRing {
    ring: heapless::Deque<Event, RING>,
    next: u32,
}

impl EventRing {
    pub const fn new() -> Self {
        Self {
            ring: heapless::Deque::new(),
            next: 0,
        }
    }

    /// Numbers an event, stores it (a full ring drops its oldest one), and returns it for sending.
    pub fn record(&mut self, time_us: u64, what: What) -> Event {
        let event = Event {
            index: self.next,
            time_us,
            what,
        };
        self.next = self.next.saturating_add(1);
        if self.ring.is_full() {
            self.ring.pop_front();
        }
        // Cannot fail: there is room for one more.
        let _ = self.ring.push_back(event);
        event
    }

    /// Up to [`EVENTS_PER_REPLY`] events, beginning at index `from`, or at the oldest kept one if that is later.
    pub fn since(&self, from: u32) -> Events {
        let oldest = self.ring.front().map_or(self.next, |event| event.index);
        let events = self
            .ring
            .iter()
            .filter(|event| event.index >= from)
            .take(EVENTS_PER_REPLY)
            .copied()
            .collect();
        Events {
            oldest,
            next: self.next,
            events,
        }
    }
}

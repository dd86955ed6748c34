//! Delivers events without gaps, and telemetry.

use std::collections::{BTreeMap, VecDeque};

use protocol::capsule::CapsuleEvent;
use protocol::rig::RigEvent;
use protocol::system::{Event, What};
use protocol::table::Telemetry;

use crate::device::Device;
use crate::device::observer::Observer;
use crate::error::ClientError;

/// Whether the machine is at rest or braking after this event.
fn is_end(event: &Event) -> bool {
    matches!(
        event.what,
        What::Rig(
            RigEvent::Homed { .. }
                | RigEvent::RunEnded { .. }
                | RigEvent::Stopped { .. }
                | RigEvent::Faulted(_)
        ) | What::Capsule(CapsuleEvent::Ended { .. })
    )
}

/// Maximum events kept until an earlier one arrives, more than a device keeps. Further ones are fetched later.
const MOST_EARLY: usize = 256;

/// Telemetry samples kept until they are taken. Beyond that the oldest are dropped and count as missed.
const TELEMETRY_INBOX: usize = 4_096;

/// Maximum successive fetches. Fetching all that the device keeps takes 11; more events may occur during the fetches.
const MOST_PIECES: usize = 1_000;

/// Received events and telemetry that were not taken yet.
#[derive(Default)]
pub(crate) struct Inbox {
    /// Index of the next event to deliver.
    pub(crate) next: u32,
    /// Events that arrived before an earlier one.
    pub(crate) early: BTreeMap<u32, Event>,
    pub(crate) events: VecDeque<Event>,
    /// Events that the device had dropped before they were fetched.
    pub(crate) lost: u32,
    telemetry: VecDeque<(u16, Telemetry)>,
}

impl Inbox {
    /// Delivers events from index `next` on. Forgets later ones that have already arrived: they would be reported
    /// twice, or wait for earlier ones for ever.
    pub(crate) fn begin_at(&mut self, next: u32) {
        self.events.retain(|event| event.index < next);
        self.continue_at(next);
    }

    /// Delivers no event before index `next`.
    fn continue_at(&mut self, next: u32) {
        self.next = next;
        self.early = self.early.split_off(&next);
    }

    /// Adds an event. Returns whether it ends a motion.
    pub(crate) fn event(&mut self, event: Event) -> bool {
        // The largest index belongs to no event: a request from there returns none.
        let is_new = event.index >= self.next && event.index != u32::MAX;
        let is_next = event.index == self.next;
        if is_new && (is_next || self.early.len() < MOST_EARLY) {
            self.early.insert(event.index, event);
        }
        let mut ended = false;
        while let Some(event) = self.early.remove(&self.next) {
            self.next += 1;
            ended |= is_end(&event);
            self.events.push_back(event);
        }
        ended
    }

    /// Adds a sample, before which `missed` others were lost.
    pub(crate) fn sample(&mut self, missed: u16, sample: Telemetry) {
        self.telemetry.push_back((missed, sample));
        if self.telemetry.len() > TELEMETRY_INBOX
            && let Some((before, _)) = self.telemetry.pop_front()
            && let Some((missed, _)) = self.telemetry.front_mut()
        {
            *missed = missed.saturating_add(before).saturating_add(1);
        }
    }
}

impl Device {
    /// Telemetry since the last call, oldest first, each sample with the number of those lost before it.
    pub fn take_telemetry(&mut self) -> Vec<(u16, Telemetry)> {
        self.inbox.telemetry.drain(..).collect()
    }

    /// Events since the last call, in order and without gaps.
    ///
    /// # Errors
    /// As [`Device::call`]: missing events are fetched again.
    pub fn take_events(&mut self) -> Result<Vec<Event>, ClientError> {
        self.fetch_events()?;
        Ok(self.inbox.events.drain(..).collect())
    }

    /// The events that the device keeps, and the number of those that it has lost.
    ///
    /// # Errors
    /// As [`Device::call`]; [`ClientError::NotUnderstood`] if the events never end.
    pub fn kept_events(&mut self) -> Result<(Vec<Event>, u32), ClientError> {
        let (mut events, mut oldest, mut from) = (vec![], None, 0);
        for _ in 0..MOST_PIECES {
            let piece = self.events(from)?;
            oldest.get_or_insert(piece.oldest);
            for event in piece.events.iter().filter(|event| event.index >= from) {
                events.push(*event);
            }
            // The largest index belongs to no event.
            let last = piece.events.last();
            from = last.map_or(u32::MAX, |event| event.index.saturating_add(1));
            if from >= piece.next {
                return Ok((events, oldest.unwrap_or(0)));
            }
        }
        Err(self.wrong_response("GetEvents"))
    }

    pub(crate) fn deliver(&mut self, observer: &mut dyn Observer) {
        for event in self.inbox.events.drain(..) {
            observer.event(&event);
        }
        self.deliver_telemetry(observer);
    }

    pub(crate) fn deliver_telemetry(&mut self, observer: &mut dyn Observer) {
        for (missed, sample) in self.inbox.telemetry.drain(..) {
            observer.telemetry(&sample, missed);
        }
    }

    /// Receives until `until_us` without a request.
    pub(crate) fn listen(&mut self, until_us: u64) -> Result<(), ClientError> {
        while self.now_us() < until_us {
            self.step(until_us)?;
        }
        Ok(())
    }

    pub(crate) fn note_event(&mut self, event: Event) {
        self.motion.reported &= !self.inbox.event(event);
    }

    /// Fetches all events that the device has and this client lacks.
    pub(crate) fn fetch_events(&mut self) -> Result<(), ClientError> {
        for _ in 0..MOST_PIECES {
            let from = self.inbox.next;
            let piece = self.events(from)?;
            let next = self.inbox.next;
            if piece.oldest > next {
                self.inbox.lost = self.inbox.lost.saturating_add(piece.oldest - next);
                self.inbox.continue_at(piece.oldest);
            }
            for event in &piece.events {
                self.note_event(*event);
            }
            if self.inbox.next >= piece.next || self.inbox.next == from {
                return Ok(());
            }
        }
        Err(self.wrong_response("GetEvents"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::waiting::tests::At;

    /// Regression: a device that left out one event took all memory with later ones.
    #[test]
    fn a_device_that_leaves_out_an_event_takes_no_memory() {
        let mut device = Device::new(Box::new(At(0)), 1);
        let event = |index| Event {
            index,
            time_us: 0,
            what: What::LinkLost,
        };
        (1..100_000).for_each(|index| device.note_event(event(index)));
        assert_eq!(device.inbox.early.len(), MOST_EARLY);
        device.note_event(event(0));
        assert_eq!(
            (device.inbox.early.len(), device.inbox.events.len()),
            (0, MOST_EARLY + 1)
        );
    }
}

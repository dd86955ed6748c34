//! The host's end of the line in a scenario: keeps the frames, and sends some of them twice.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use client::link::{Link, LinkError};

use crate::emulator::Wiring;
use crate::link::VirtualLink;

/// Frames that are kept, to be sent again.
const KEPT: usize = 8;

/// The host's frames.
#[derive(Debug, Default)]
pub(super) struct Sent {
    /// The frames since the last answer.
    pub(super) new: Vec<Vec<u8>>,
    /// Frames of answered requests, the last one at the end.
    pub(super) answered: VecDeque<Vec<u8>>,
    /// Number of next frames that are sent twice.
    pub(super) twice: u32,
}

impl Sent {
    /// The last request was answered.
    pub(super) fn answered(&mut self) {
        self.answered.extend(self.new.drain(..).next_back());
        while self.answered.len() > KEPT {
            self.answered.pop_front();
        }
    }
}

/// A line whose frames are kept.
pub(super) struct KeptLine<W: Wiring> {
    link: VirtualLink<W>,
    sent: Arc<Mutex<Sent>>,
}

impl<W: Wiring> KeptLine<W> {
    pub(super) fn new(link: VirtualLink<W>, sent: &Arc<Mutex<Sent>>) -> Self {
        let sent = Arc::clone(sent);
        Self { link, sent }
    }
}

pub(super) fn locked(sent: &Mutex<Sent>) -> MutexGuard<'_, Sent> {
    sent.lock().unwrap_or_else(PoisonError::into_inner)
}

impl<W: Wiring> Link for KeptLine<W> {
    fn place(&self) -> String {
        self.link.place()
    }

    fn now_us(&self) -> u64 {
        self.link.now_us()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        let again = {
            let mut sent = locked(&self.sent);
            sent.new.push(bytes.to_vec());
            let again = sent.twice > 0;
            sent.twice = sent.twice.saturating_sub(1);
            again
        };
        if again {
            self.link.send(bytes)?;
        }
        self.link.send(bytes)
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        self.link.receive(buffer, deadline_us)
    }
}

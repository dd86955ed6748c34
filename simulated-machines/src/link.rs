//! A link to a machine in this process, in virtual time, for tests of the layers above.

use client::link::{Link, LinkError};

/// The machine at the other end.
pub trait Peer: Send {
    /// Takes bytes from the host.
    fn take(&mut self, bytes: &[u8], now_us: u64);
    /// Returns the bytes that have reached the host by now.
    fn give(&mut self, now_us: u64) -> Vec<u8>;
    /// When it next has bytes to send, us; `u64::MAX` if it will only answer.
    fn next_us(&self) -> u64;
}

/// A link whose clock jumps to the next event.
#[derive(Debug)]
pub struct Memory<P> {
    place: String,
    now_us: u64,
    peer: P,
    given: std::collections::VecDeque<u8>,
}

impl<P: Peer> Memory<P> {
    /// A link to `peer`, called `place` in messages.
    pub fn new(place: &str, peer: P) -> Self {
        Self {
            place: place.to_owned(),
            now_us: 0,
            peer,
            given: std::collections::VecDeque::new(),
        }
    }
}

impl<P: Peer> Link for Memory<P> {
    fn place(&self) -> String {
        self.place.clone()
    }

    fn now_us(&self) -> u64 {
        self.now_us
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.peer.take(bytes, self.now_us);
        Ok(())
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        loop {
            self.given.extend(self.peer.give(self.now_us));
            if !self.given.is_empty() {
                let count = buffer.len().min(self.given.len());
                for (slot, byte) in buffer.iter_mut().zip(self.given.drain(..count)) {
                    *slot = byte;
                }
                return Ok(count);
            }
            if self.now_us >= deadline_us {
                return Ok(0);
            }
            let next_us = self.peer.next_us().max(self.now_us + 1);
            self.now_us = next_us.min(deadline_us);
        }
    }
}

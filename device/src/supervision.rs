//! Check-ins of the tasks since the watchdog was last fed.

use core::sync::atomic::{AtomicU8, Ordering};

/// A task that the watchdog waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Client {
    Motion = 1,
    /// Reads the serial port.
    Link = 2,
    Control = 4,
}

/// Longest time between two check-ins of a client, ms.
pub const CHECK_IN_MS: u64 = 100;

const ALL_CLIENTS: u8 = Client::Motion as u8 | Client::Link as u8 | Client::Control as u8;

/// One bit per client.
#[derive(Debug, Default)]
pub struct CheckIns(AtomicU8);

impl CheckIns {
    /// No check-ins yet.
    pub const fn new() -> Self {
        Self(AtomicU8::new(0))
    }

    /// Notes that a client is alive.
    pub fn note(&self, client: Client) {
        self.0.fetch_or(client as u8, Ordering::Relaxed);
    }

    /// True if all clients have checked in since the last time it was true; it then clears the check-ins.
    pub fn complete(&self) -> bool {
        let complete = self.0.load(Ordering::Relaxed) == ALL_CLIENTS;
        if complete {
            self.0.store(0, Ordering::Relaxed);
        }
        complete
    }
}

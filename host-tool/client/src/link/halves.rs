//! The two directions of a line, for two threads or, as a link, for one.

use std::io::{ErrorKind, Read, Write};
use std::time::{Duration, Instant};

use crate::link::{Link, LinkError};

/// Longest wait of a read. A reader notices the end of the link only after this time.
pub const READ: Duration = Duration::from_millis(10);

/// Time limit for a write. A frame of 170 bytes takes 15 ms, so a slower line is stuck.
pub const WRITE: Duration = Duration::from_secs(1);

/// Both directions of a line, each usable by its own thread. A read returns within [`READ`], with or without bytes.
pub struct Halves {
    pub reader: Box<dyn Read + Send>,
    pub writer: Box<dyn Write + Send>,
    /// Reason for the end of the line, when a read returns no bytes.
    pub end: &'static str,
}

/// A line that this process uses alone, without lock and broker.
pub struct Direct {
    place: String,
    start: Instant,
    halves: Halves,
}

impl Direct {
    #[must_use]
    pub fn new(place: String, halves: Halves) -> Self {
        let start = Instant::now();
        Self {
            place,
            start,
            halves,
        }
    }

    fn lost(&self, why: impl ToString) -> LinkError {
        LinkError::Lost {
            place: self.place.clone(),
            why: why.to_string(),
        }
    }
}

impl Link for Direct {
    fn place(&self) -> String {
        self.place.clone()
    }

    fn now_us(&self) -> u64 {
        wall_us(self.start)
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        let sent = self.halves.writer.write_all(bytes);
        sent.map_err(|io| self.lost(io))
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        loop {
            match self.halves.reader.read(buffer) {
                Ok(0) => return Err(self.lost(self.halves.end)),
                Ok(count) => return Ok(count),
                Err(io) if !nothing_yet(io.kind()) => return Err(self.lost(io)),
                Err(_) if self.now_us() >= deadline_us => return Ok(0),
                Err(_) => {}
            }
        }
    }
}

/// Time since `start`, us.
pub(crate) fn wall_us(start: Instant) -> u64 {
    u64::try_from(start.elapsed().as_micros()).unwrap_or(u64::MAX)
}

/// Time to a deadline: never zero, which would mean "forever", and limited for the operating system.
pub(crate) fn timeout(now_us: u64, deadline_us: u64) -> Duration {
    Duration::from_micros(deadline_us.saturating_sub(now_us).clamp(1_000, 60_000_000))
}

/// Whether a read ended without bytes but without a failure.
pub(crate) fn nothing_yet(kind: ErrorKind) -> bool {
    matches!(
        kind,
        ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::net::UnixStream;

    #[test]
    fn bytes_pass_both_ways_until_the_line_ends() {
        let (near, mut far) = UnixStream::pair().expect("a line");
        near.set_read_timeout(Some(READ)).expect("set");
        let mut link = Direct::new(
            "there".to_owned(),
            Halves {
                reader: Box::new(near.try_clone().expect("open")),
                writer: Box::new(near),
                end: "gone",
            },
        );
        link.start -= Duration::from_secs(2);
        assert!(link.now_us() >= 2_000_000);
        let mut buffer = [0; 16];
        link.send(b"there").expect("connected");
        far.read_exact(&mut buffer[..5]).expect("connected");
        far.write_all(b"back").expect("connected");
        let later_us = link.now_us() + 60_000_000;
        assert_eq!(link.receive(&mut buffer, later_us).ok(), Some(4));
        // Nothing has come, which is no error.
        assert_eq!(link.receive(&mut buffer, 0).ok(), Some(0));
        drop(far);
        let lost = link.receive(&mut buffer, later_us).expect_err("gone");
        assert_eq!(lost.to_string(), "the link to there was lost: gone");
    }

    #[test]
    fn a_wait_is_neither_endless_nor_longer_than_a_minute() {
        for (now_us, deadline_us, wait_ms) in [
            (5_000_000, 5_250_000, 250),
            (5_000_000, 5_000_000, 1),
            (5_000_000, 0, 1),
            (0, u64::MAX, 60_000),
        ] {
            assert_eq!(timeout(now_us, deadline_us), Duration::from_millis(wait_ms));
        }
    }
}

//! A link to a machine behind a TCP server that passes the bytes of its serial port in real time.

use std::io::{self, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::net::ToSocketAddrs;
use std::time::{Duration, Instant};

use crate::link::halves::{Halves, READ};
use crate::link::{Link, LinkError, OpenError, Reason};

/// Time limit for a write: a server that reads nothing for this long is stuck.
const WRITE: Duration = Duration::from_secs(1);

/// Error text for a connection that has ended.
const CLOSED: &str = "the other end closed the connection";

/// A TCP link.
#[derive(Debug)]
pub struct Tcp {
    place: String,
    stream: TcpStream,
    start: Instant,
}

impl Tcp {
    /// Connects to `HOST:PORT`, with a time limit for each address of the host.
    ///
    /// # Errors
    /// [`OpenError`] if the name is unknown or nobody listens there.
    pub fn open_within(host_port: &str, limit: Duration) -> Result<Self, OpenError> {
        let place = format!("tcp:{host_port}");
        let error = |why: String| OpenError {
            place: place.clone(),
            reason: Reason::Unreachable,
            why,
            remedy: "start the server first (`virtual-bench serve`), and check host and port"
                .into(),
        };
        let mut last = "the host name has no address".to_owned();
        let addresses = host_port
            .to_socket_addrs()
            .map_err(|io| error(io.to_string()))?;
        for address in addresses {
            match TcpStream::connect_timeout(&address, limit) {
                Ok(stream) => {
                    // Small frames must leave at once: a stop must not wait for more data.
                    stream
                        .set_nodelay(true)
                        .map_err(|io| error(io.to_string()))?;
                    return Ok(Self {
                        place,
                        stream,
                        start: Instant::now(),
                    });
                }
                Err(io) => last = io.to_string(),
            }
        }
        Err(error(last))
    }

    /// Splits the connection for two threads.
    pub fn halves(self) -> io::Result<Halves> {
        self.stream.set_read_timeout(Some(READ))?;
        self.stream.set_write_timeout(Some(WRITE))?;
        Ok(Halves {
            reader: Box::new(self.stream.try_clone()?),
            writer: Box::new(self.stream),
            end: CLOSED,
        })
    }

    fn lost(&self, why: impl ToString) -> LinkError {
        LinkError::Lost {
            place: self.place.clone(),
            why: why.to_string(),
        }
    }
}

impl Link for Tcp {
    fn place(&self) -> String {
        self.place.clone()
    }

    fn now_us(&self) -> u64 {
        wall_us(self.start)
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.stream.write_all(bytes).map_err(|io| self.lost(io))
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        let timeout = timeout(self.now_us(), deadline_us);
        self.stream
            .set_read_timeout(Some(timeout))
            .map_err(|io| self.lost(io))?;
        match self.stream.read(buffer) {
            Ok(0) => Err(self.lost(CLOSED)),
            Ok(count) => Ok(count),
            Err(io) if nothing_yet(io.kind()) => Ok(0),
            Err(io) => Err(self.lost(io)),
        }
    }
}

/// Time since `start`, us.
pub(crate) fn wall_us(start: Instant) -> u64 {
    u64::try_from(start.elapsed().as_micros()).unwrap_or(u64::MAX)
}

/// Time to a deadline: never zero, which would mean "forever", and bounded for the operating system.
pub(crate) fn timeout(now_us: u64, deadline_us: u64) -> Duration {
    Duration::from_micros(deadline_us.saturating_sub(now_us).clamp(1_000, 60_000_000))
}

/// Whether a read merely ended without bytes.
pub(crate) fn nothing_yet(kind: ErrorKind) -> bool {
    matches!(
        kind,
        ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::TcpListener;

    /// A connection that began two seconds ago, and its other end.
    fn connected() -> (Tcp, TcpStream) {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let at = listener.local_addr().expect("an address").to_string();
        let mut link = Tcp::open_within(&at, WRITE).expect("it listens");
        assert_eq!(link.place(), format!("tcp:{at}"));
        link.start -= Duration::from_secs(2);
        (link, listener.accept().expect("connected").0)
    }

    #[test]
    fn bytes_pass_both_ways_until_the_other_end_closes() {
        let (mut link, mut other) = connected();
        let mut buffer = [0; 16];
        link.send(b"there").expect("connected");
        other.read_exact(&mut buffer[..5]).expect("connected");
        assert_eq!(&buffer[..5], b"there");
        other.write_all(b"back").expect("connected");
        let later_us = link.now_us() + 60_000_000;
        let mut received = |deadline_us| link.receive(&mut buffer, deadline_us).ok();
        assert_eq!(received(later_us), Some(4));
        // Nothing has come, which is no error.
        assert_eq!(received(0), Some(0));
        assert_eq!(&buffer[..4], b"back");
        drop(other);
        let lost = link.receive(&mut buffer, later_us).expect_err("closed");
        assert_eq!(lost.to_string(), link.lost(CLOSED).to_string());
        assert!(lost.to_string().contains(&link.place()), "{lost}");
    }

    #[test]
    fn its_clock_began_with_the_connection() {
        let (link, _other) = connected();
        let at_us = link.now_us();
        assert!(at_us >= 2_000_000, "{at_us}");
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

    #[test]
    fn an_address_without_a_listener_is_unreachable() {
        let free = TcpListener::bind("127.0.0.1:0").expect("a port");
        let at = free.local_addr().expect("an address").to_string();
        drop(free);
        let error = Tcp::open_within(&at, WRITE).expect_err("nobody listens");
        assert_eq!(error.reason, Reason::Unreachable);
        assert_eq!(error.place, format!("tcp:{at}"));
    }
}

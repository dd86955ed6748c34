//! A client's side of a broker: a link to the machine that another process owns.

use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use crate::broker::lock::LineFiles;
use crate::broker::stream::read_line;
use crate::broker::{Greeting, LONGEST_LINE, VERSION, Welcome};
use crate::link::halves::{nothing_yet, timeout, wall_us};
use crate::link::owner::{Owner, StopMark};
use crate::link::{Link, LinkError};

/// A link through another process. Stops are sent at once; questions go between the owner's requests.
/// [`crate::device::Device`] refuses everything that is for the owner alone, before it is sent.
#[derive(Debug)]
pub struct BrokerClient {
    place: String,
    owner: Owner,
    yields: bool,
    full: bool,
    line_files: LineFiles,
    stream: UnixStream,
    start: Instant,
    /// The last stop known when the orders were given.
    ordered_at: StopMark,
}

impl BrokerClient {
    /// Connects to the socket and sends the greeting; the owner has `limit` to answer. A [full](BrokerClient::is_full)
    /// client only passes stops.
    ///
    /// # Errors
    /// Nothing listens at the socket, the owner does not answer, or another program answers.
    pub fn open(line_files: &LineFiles, limit: Duration) -> io::Result<Self> {
        Self::greet(line_files, limit, false)
    }

    fn greet(line_files: &LineFiles, limit: Duration, wants_line: bool) -> io::Result<Self> {
        let mut stream = line_files.connect()?;
        stream.set_read_timeout(Some(limit))?;
        stream.set_write_timeout(Some(limit))?;
        let greeting = Greeting {
            retrograde_client: VERSION,
            wants_line,
        };
        let mut line = serde_json::to_vec(&greeting)?;
        line.push(b'\n');
        stream.write_all(&line)?;
        let welcome = read_line(&mut stream, LONGEST_LINE)?;
        let welcome: Welcome = serde_json::from_slice(&welcome)?;
        Ok(Self {
            place: line_files.place().to_owned(),
            owner: welcome.owner,
            yields: welcome.yields,
            full: welcome.full,
            line_files: line_files.clone(),
            stream,
            start: Instant::now(),
            ordered_at: LineFiles::last_stops(Some(line_files)),
        })
    }

    /// Whether the limit of clients is reached: this client only passes stops.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.full
    }

    fn lost(&self) -> LinkError {
        LinkError::OwnerGone {
            place: self.place.clone(),
            owner: Box::new(self.owner.clone()),
        }
    }
}

impl Link for BrokerClient {
    fn place(&self) -> String {
        self.place.clone()
    }

    fn now_us(&self) -> u64 {
        wall_us(self.start)
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.stream.write_all(bytes).map_err(|_| self.lost())
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        let limit = timeout(self.now_us(), deadline_us);
        self.stream
            .set_read_timeout(Some(limit))
            .map_err(|_| self.lost())?;
        match self.stream.read(buffer) {
            Ok(0) => Err(self.lost()),
            Ok(count) => Ok(count),
            Err(io) if nothing_yet(io.kind()) => Ok(0),
            Err(_) => Err(self.lost()),
        }
    }

    fn owner(&self) -> Option<&Owner> {
        Some(&self.owner)
    }

    fn ordered_at(&mut self, mark: StopMark) {
        self.ordered_at = mark;
    }

    fn is_overtaken(&self) -> bool {
        (LineFiles::last_stops(Some(&self.line_files)).since(self.ordered_at)).is_some()
    }

    fn want_line(&mut self) -> bool {
        // An owner that has ended has also given the line up.
        if self.yields {
            let _ = Self::greet(&self.line_files, Duration::from_secs(1), true);
        }
        self.yields
    }
}

#[cfg(test)]
mod tests {
    use protocol::system::Urgent;

    use super::*;

    /// A client, and the owner's side of it.
    fn opened() -> (BrokerClient, UnixStream, LineFiles, tempfile::TempDir) {
        let folder = tempfile::tempdir().expect("a folder");
        let line_files = LineFiles::new(folder.path().to_owned(), "one", "there".to_owned());
        let lock = line_files.claim().expect("possible").expect("free");
        let listener = lock.listen().expect("a broker");
        let owner = std::thread::spawn(move || {
            let (mut client, _) = listener.accept().expect("a client");
            read_line(&mut client, LONGEST_LINE).expect("a greeting");
            let welcome = Welcome {
                retrograde_broker: VERSION,
                owner: lock.owner().clone(),
                yields: false,
                full: true,
            };
            let line = serde_json::to_string(&welcome).expect("text") + "\n";
            client.write_all(line.as_bytes()).expect("connected");
            client
        });
        let client = BrokerClient::open(&line_files, Duration::from_secs(10)).expect("welcome");
        (client, owner.join().expect("no panic"), line_files, folder)
    }

    #[test]
    fn orders_are_overtaken_by_a_stop_that_came_after_them() {
        let (mut client, _owner, line_files, _folder) = opened();
        assert!(!client.is_overtaken());
        line_files.mark_stop(Urgent::Stop);
        assert!(client.is_overtaken());
        client.ordered_at(LineFiles::last_stops(Some(&line_files)));
        assert!(!client.is_overtaken());
    }
}

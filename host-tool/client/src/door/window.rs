//! A guest's side of a door: a link to the machine that another process owns.

use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use crate::door::lock::Doorway;
use crate::door::stream::read_line;
use crate::door::{Greeting, LONGEST_LINE, VERSION, Welcome};
use crate::link::halves::{nothing_yet, timeout, wall_us};
use crate::link::owner::{Owner, StopMark};
use crate::link::{Link, LinkError};

/// A link through another process. Stops are sent at once; reading goes between the owner's requests.
/// [`crate::device::Device`] refuses everything that is for the owner alone, before it is sent.
#[derive(Debug)]
pub struct Window {
    place: String,
    owner: Owner,
    yields: bool,
    full: bool,
    doorway: Doorway,
    stream: UnixStream,
    start: Instant,
    /// The last stop that was known when the orders were given.
    ordered_at: StopMark,
}

impl Window {
    /// Connects to the door and introduces itself; the owner has `limit` to answer. A [full](Window::is_full) window
    /// only passes stops.
    ///
    /// # Errors
    /// There is no door, nobody answers, or something else than a door answers.
    pub fn open(doorway: &Doorway, limit: Duration) -> io::Result<Self> {
        Self::greet(doorway, limit, false)
    }

    fn greet(doorway: &Doorway, limit: Duration, wants_line: bool) -> io::Result<Self> {
        let mut stream = doorway.connect()?;
        stream.set_read_timeout(Some(limit))?;
        stream.set_write_timeout(Some(limit))?;
        let greeting = Greeting {
            retrograde_window: VERSION,
            wants_line,
        };
        let mut line = serde_json::to_vec(&greeting)?;
        line.push(b'\n');
        stream.write_all(&line)?;
        let welcome = read_line(&mut stream, LONGEST_LINE)?;
        let welcome: Welcome = serde_json::from_slice(&welcome)?;
        Ok(Self {
            place: doorway.place().to_owned(),
            owner: welcome.owner,
            yields: welcome.yields,
            full: welcome.full,
            doorway: doorway.clone(),
            stream,
            start: Instant::now(),
            ordered_at: Doorway::last_stops(Some(doorway)),
        })
    }

    /// Whether the limit of guests is reached: this window only passes stops.
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

impl Link for Window {
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
        (Doorway::last_stops(Some(&self.doorway)).since(self.ordered_at)).is_some()
    }

    fn want_line(&mut self) -> bool {
        // An owner that has ended has also given the line up.
        if self.yields {
            let _ = Self::greet(&self.doorway, Duration::from_secs(1), true);
        }
        self.yields
    }
}

#[cfg(test)]
mod tests {
    use protocol::system::Urgent;

    use super::*;

    /// A window, and the owner's side of it.
    fn opened() -> (Window, UnixStream, Doorway, tempfile::TempDir) {
        let folder = tempfile::tempdir().expect("a folder");
        let doorway = Doorway::new(folder.path().to_owned(), "one", "there".to_owned());
        let lock = doorway.claim().expect("possible").expect("free");
        let listener = lock.listen().expect("a door");
        let owner = std::thread::spawn(move || {
            let (mut guest, _) = listener.accept().expect("a guest");
            read_line(&mut guest, LONGEST_LINE).expect("a greeting");
            let welcome = Welcome {
                retrograde_door: VERSION,
                owner: lock.owner().clone(),
                yields: false,
                full: true,
            };
            let line = serde_json::to_string(&welcome).expect("text") + "\n";
            guest.write_all(line.as_bytes()).expect("connected");
            guest
        });
        let window = Window::open(&doorway, Duration::from_secs(10)).expect("welcome");
        (window, owner.join().expect("no panic"), doorway, folder)
    }

    #[test]
    fn orders_are_overtaken_by_a_stop_that_came_after_them() {
        let (mut window, _owner, doorway, _folder) = opened();
        assert!(!window.is_overtaken());
        doorway.mark_stop(Urgent::Stop);
        assert!(window.is_overtaken());
        window.ordered_at(Doorway::last_stops(Some(&doorway)));
        assert!(!window.is_overtaken());
    }
}

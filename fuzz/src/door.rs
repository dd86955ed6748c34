//! A door in this process, without sockets and threads, for tests. The test sends the bytes of guests and machine, and
//! reads those for the line, the owner and the guests. The test sets the time, too.

use std::io::{self, Write};
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use protocol::system::{Identity, Urgent};

use client::door::LONGEST_LINE;
use client::door::lock::OwnerFile;
use client::door::server::{Core, Visit, WAITING_FRAMES, read_greeting};
use client::door::shared::Pump;
use client::door::stream::read_line;
use client::link::owner::Owner;
use client::link::owner::Question;

/// The bytes written to the line.
#[derive(Clone, Default)]
struct Line(Arc<Mutex<Vec<u8>>>);

impl Line {
    fn bytes(&self) -> MutexGuard<'_, Vec<u8>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Write for Line {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.bytes().extend(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A door and its owner's side.
pub struct Door {
    core: Arc<Core>,
    line: Line,
    owner_file: OwnerFile,
    pump: Pump,
    start: Instant,
}

impl Door {
    /// A door for those who know the token; with `yields` its owner offers the line.
    #[must_use]
    pub fn new(token: &str, yields: bool) -> Self {
        let line = Line::default();
        Self {
            core: Core::new(Box::new(line.clone()), yields, None),
            line,
            owner_file: OwnerFile {
                owner: Owner {
                    pid: 1,
                    command: "retrograde run".to_owned(),
                    since: Timestamp::UNIX_EPOCH,
                },
                port: None,
                token: token.to_owned(),
                recording: None,
            },
            pump: Pump::default(),
            start: Instant::now(),
        }
    }

    /// A guest that begins with these bytes: returns it with its welcome and the bytes after its greeting, or `None` if
    /// the door refuses it.
    #[must_use]
    pub fn greet<'a>(&self, mut bytes: &'a [u8]) -> Option<(Guest, Vec<u8>, &'a [u8])> {
        let line = read_line(&mut bytes, LONGEST_LINE).ok()?;
        let greeting = read_greeting(&line, &self.owner_file).ok()?;
        let (frames, waiting) = sync_channel(WAITING_FRAMES);
        let visit = Visit::new(&self.core, Box::new(|| {}), frames)?;
        let welcome = visit.welcome(&greeting, &self.owner_file).ok()?;
        let start = self.start;
        Some((
            Guest {
                visit,
                waiting,
                start,
            },
            welcome,
            bytes,
        ))
    }

    /// The bytes written to the line since the last call.
    #[must_use]
    pub fn written(&self) -> Vec<u8> {
        std::mem::take(&mut *self.line.bytes())
    }

    /// The machine says this.
    pub fn hear(&mut self, bytes: &[u8]) {
        self.pump.take(&self.core, bytes);
    }

    // The owner's, as of a `Link`.

    /// Writes a frame of the owner.
    ///
    /// # Errors
    /// None here; those of a line elsewhere.
    pub fn send(&self, bytes: &[u8]) -> io::Result<()> {
        self.core.send(bytes)
    }

    /// The owner has met the machine.
    pub fn introduce(&self, identity: &Identity) {
        self.core.introduce(identity);
    }

    /// The next question for the machine, `now_us` after the door was opened.
    #[must_use]
    pub fn question(&self, now_us: u64) -> Option<Question> {
        self.core
            .question(self.start + Duration::from_micros(now_us))
    }

    /// The strongest stop of guests; the owner has noticed it.
    #[must_use]
    pub fn stopped(&self) -> Option<Urgent> {
        self.core.stopped()
    }

    /// The owner goes on after a stop.
    pub fn forget_stop(&self) {
        self.core.forget_stop();
    }
}

/// A guest that was let in; it leaves with this value.
pub struct Guest {
    visit: Visit,
    waiting: Receiver<Vec<u8>>,
    start: Instant,
}

impl Guest {
    /// Says this, `now_us` after the door was opened.
    ///
    /// # Errors
    /// The line's.
    pub fn say(&mut self, bytes: &[u8], now_us: u64) -> io::Result<()> {
        let now = self.start + Duration::from_micros(now_us);
        self.visit.take(bytes, now)
    }

    /// The bytes that it was sent since the last call.
    #[must_use]
    pub fn told(&self) -> Vec<u8> {
        self.waiting.try_iter().flatten().collect()
    }
}

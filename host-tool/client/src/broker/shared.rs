//! A link over a line that this process owns, with a broker for others. A separate thread reads the line, so that a
//! client's stop is sent and confirmed whatever the owner is doing.

use std::io::Read;
use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use protocol::frame::{Deframer, MAX_FRAME};
use protocol::system::{Identity, Urgent};

use crate::broker::lock::Lock;
use crate::broker::server::{Core, serve};
use crate::link::halves::{Halves, nothing_yet, wall_us};
use crate::link::owner::{Question, StopMark};
use crate::link::{Link, LinkError, OpenError, Reason};

pub struct Shared {
    place: String,
    start: Instant,
    core: Arc<Core>,
    pump: Option<JoinHandle<()>>,
    // Declared last, so that it is dropped after the line is closed.
    lock: Lock,
}

impl Shared {
    /// With `yields` the line is offered to other processes: see [`Link::is_line_wanted`].
    pub fn new(lock: Lock, halves: Halves, yields: bool) -> Result<Self, OpenError> {
        let place = lock.line_files().place().to_owned();
        let core = Core::new(halves.writer, yields, Some(lock.line_files().clone()));
        let (listener, owner) = (lock.listen()?, lock.owner().clone());
        let failed = |why: std::io::Error| OpenError {
            place: place.clone(),
            reason: Reason::Other,
            why: why.to_string(),
            remedy: "close other programs: the system has no thread left".to_owned(),
        };
        let (reader, end) = (halves.reader, halves.end);
        let pumped = Arc::clone(&core);
        let pump = thread::Builder::new()
            .name("line".to_owned())
            .spawn(move || pump(&pumped, reader, end))
            .map_err(failed)?;
        let served = Arc::clone(&core);
        let shared = Self {
            place: place.clone(),
            start: Instant::now(),
            core,
            pump: Some(pump),
            lock,
        };
        thread::Builder::new()
            .name("socket".to_owned())
            .spawn(move || serve(&listener, &owner, &served))
            .map_err(failed)?;
        Ok(shared)
    }

    fn lost(&self, why: impl ToString) -> LinkError {
        LinkError::Lost {
            place: self.place.clone(),
            why: why.to_string(),
        }
    }
}

impl Drop for Shared {
    fn drop(&mut self) {
        self.core.close();
        // Wake the broker's thread by connecting; it would otherwise wait for the next client.
        let _ = self.lock.line_files().connect();
        if let Some(pump) = self.pump.take() {
            let _ = pump.join();
        }
    }
}

impl Link for Shared {
    fn place(&self) -> String {
        self.place.clone()
    }

    fn now_us(&self) -> u64 {
        wall_us(self.start)
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.core.send(bytes).map_err(|io| self.lost(io))
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        let remaining = Duration::from_micros(deadline_us.saturating_sub(self.now_us()));
        // Limit the wait, so that it can be added to an `Instant`.
        let deadline = Instant::now() + remaining.min(Duration::from_secs(60));
        self.core
            .receive(buffer, deadline)
            .map_err(|why| self.lost(why))
    }

    fn introduce(&mut self, identity: &Identity) {
        self.core.introduce(identity);
    }

    fn stopped(&mut self) -> Option<Urgent> {
        self.core.stopped()
    }

    fn ordered_at(&mut self, mark: StopMark) {
        self.core.ordered_at(mark);
    }

    fn is_line_wanted(&mut self) -> bool {
        self.core.is_line_wanted()
    }

    fn offer_line(&mut self, offered: bool) {
        self.core.offer_line(offered);
    }

    fn forget_stop(&mut self) {
        self.core.forget_stop();
    }

    fn question(&mut self) -> Option<Question> {
        self.core.question(Instant::now())
    }
}

/// Passes the machine's bytes to the owner and, frame by frame, to its clients.
#[derive(Default)]
pub struct Pump {
    deframer: Deframer,
    block: Vec<u8>,
}

impl Pump {
    pub fn take(&mut self, core: &Core, bytes: &[u8]) {
        core.arrived(bytes);
        for byte in bytes {
            if self.block.len() < MAX_FRAME {
                self.block.push(*byte);
            }
            if let Some(frame) = self.deframer.push(*byte) {
                // Include the delimiter of the preceding block, which a client may have missed.
                let wire = [&[0], &self.block[..]].concat();
                core.passed(&frame, &wire);
            }
            if *byte == 0 {
                self.block.clear();
            }
        }
    }
}

/// Reads the line until the line or the link ends.
fn pump(core: &Core, mut reader: Box<dyn Read + Send>, end: &str) {
    let mut pump = Pump::default();
    let mut bytes = [0; 512];
    while !core.is_closing() {
        match reader.read(&mut bytes) {
            Ok(0) => return core.lost(end.to_owned()),
            Ok(count) => pump.take(core, &bytes[..count]),
            Err(io) if nothing_yet(io.kind()) => {}
            Err(io) => return core.lost(io.to_string()),
        }
    }
}

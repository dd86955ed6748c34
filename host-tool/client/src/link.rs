//! A byte link to one machine: serial port, TCP, memory pipe or virtual bench.
//!
//! The link provides the clock, so that the same client runs against a port in real time and against the virtual bench
//! in virtual time.

pub mod halves;
pub mod owner;
pub mod serial;
pub mod tcp;

use protocol::system::{Identity, Urgent};

use crate::link::owner::{Owner, Question, StopMark};

/// The reason why a link could not be opened, for programs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    Permission,
    Busy,
    /// Another `retrograde` owns it and does not answer at its socket.
    OwnerSilent,
    Absent,
    /// It is not a serial port.
    NoPort,
    /// No server listens there.
    Unreachable,
    /// Anything else, such as a problem with the folder of the locks.
    Other,
}

/// A link could not be opened. Nothing was sent.
#[derive(Debug, thiserror::Error, miette::Diagnostic)]
#[error("cannot open {place}: {why}")]
#[diagnostic(code(retrograde::open), help("{remedy}"))]
pub struct OpenError {
    pub place: String,
    pub reason: Reason,
    pub why: String,
    pub remedy: String,
}

/// The reason why a link could not carry bytes.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The other end is gone: cable pulled, socket closed, emulator ended.
    #[error("the link to {place} was lost: {why}")]
    Lost {
        place: String,
        /// Reported by the operating system or the bench.
        why: String,
    },
    /// [`LinkError::Lost`] while something moved, or after an order to move was sent.
    #[error("the link to {place} was lost: {why}: it MAY BE MOVING")]
    Cut { place: String, why: String },
    /// The process that owned the line has ended or given the line up, so its socket is closed.
    #[error("{place} belonged to {owner}, which has ended, or has given the line up")]
    OwnerGone { place: String, owner: Box<Owner> },
}

impl LinkError {
    #[must_use]
    pub fn remedy(&self) -> &'static str {
        match self {
            Self::Lost { .. } => {
                "check cable and supply; a moving rig stops by itself after 1 s without the host, unless the run was started with `--on-link-loss finish`"
            }
            Self::Cut { .. } => {
                "press the emergency stop button or cut the motor supply if it moves; then check cable and supply"
            }
            Self::OwnerGone { .. } => "the line is free now: try again",
        }
    }
}

pub trait Link: Send {
    /// The place, for messages: `/dev/ttyACM0`, `tcp:127.0.0.1:7001`, `virtual rig`.
    fn place(&self) -> String;

    /// Microseconds on the link's own clock; never steps back.
    fn now_us(&self) -> u64;

    /// Queues `bytes` for transmission and returns at once, without using link time.
    ///
    /// # Errors
    /// [`LinkError::Lost`] when the other end is gone.
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError>;

    /// Waits until bytes arrive or the link's clock reaches `deadline_us`; returns how many bytes were
    /// put into `buffer`, 0 at the deadline.
    ///
    /// # Errors
    /// [`LinkError::Lost`] when the other end is gone.
    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError>;

    /// The process that owns the line, if it is not this one.
    fn owner(&self) -> Option<&Owner> {
        None
    }

    /// Asks the owner of the line to give it up. If it agrees, returns true, and the line can soon be opened again.
    fn want_line(&mut self) -> bool {
        false
    }

    // Methods for the owner of a line, on behalf of other processes that observe the machine; see `crate::broker`.

    /// Notes the machine that has answered Hello.
    fn introduce(&mut self, identity: &Identity) {
        let _ = identity;
    }

    /// Sets the last stop known when the next orders were given. A later stop counts as new.
    fn ordered_at(&mut self, mark: StopMark) {
        let _ = mark;
    }

    /// Whether a stop was requested on this line since the orders were given. Only a broker client answers here: the
    /// owner learns it from [`Link::stopped`].
    fn is_overtaken(&self) -> bool {
        false
    }

    /// The strongest stop that another process has sent on this line so far.
    fn stopped(&mut self) -> Option<Urgent> {
        None
    }

    /// Whether another process wants the line that was offered.
    fn is_line_wanted(&mut self) -> bool {
        false
    }

    /// Offers the line to other processes, or withdraws the offer. Does nothing if this process does not own the line.
    fn offer_line(&mut self, offered: bool) {
        let _ = offered;
    }

    /// Forgets the stops that other processes have sent so far.
    fn forget_stop(&mut self) {}

    /// The next question of another process, to be sent between two requests.
    fn question(&mut self) -> Option<Question> {
        None
    }
}

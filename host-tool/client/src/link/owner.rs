//! Shared knowledge of a line's owner and its guests: the owner, the stops, the guests' questions.

use std::collections::VecDeque;
use std::fmt;
use std::time::{Instant, SystemTime};

use jiff::Timestamp;
use protocol::system::Urgent;
use protocol::table::{Reply, Request};
use serde::{Deserialize, Serialize};

/// Longest command that is shown, characters.
const LONGEST_COMMAND: usize = 200;

/// The process that owns a line.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Owner {
    /// Its process ID.
    pub pid: u32,
    /// Its command line.
    pub command: String,
    /// Time at which it took the line.
    pub since: Timestamp,
}

impl Owner {
    /// This process, with the present time.
    #[must_use]
    pub fn this_process() -> Self {
        let args: Vec<_> = std::env::args_os()
            .map(|arg| arg.to_string_lossy().into_owned())
            .collect();
        Self {
            pid: std::process::id(),
            command: shown(&args),
            since: Timestamp::now(),
        }
    }
}

impl fmt::Display for Owner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            pid,
            command,
            since,
        } = self;
        write!(f, "process {pid} (`{command}`), since {since:.0}")
    }
}

/// A command line without the program's folder and without control characters, shortened.
pub(crate) fn shown(args: &[String]) -> String {
    let program = args.first().map_or("", |path| {
        path.rsplit(['/', '\\']).next().unwrap_or_default()
    });
    let line: Vec<_> = std::iter::once(program)
        .chain(args.iter().skip(1).map(String::as_str))
        .collect();
    let line = line.join(" ");
    let clean = line.chars().map(|c| if c.is_control() { ' ' } else { c });
    clean.take(LONGEST_COMMAND).collect()
}

/// The last stop and the last emergency stop on a line, from any process. If two marks differ, a stop was requested
/// between them: orders given before it must no longer move anything.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StopMark {
    pub(crate) stop: Option<SystemTime>,
    pub(crate) estop: Option<SystemTime>,
}

impl StopMark {
    /// The mark as of an earlier time of this computer, without later stops. A mark from the future, after the clock
    /// was set back, counts as old.
    #[must_use]
    pub fn at(self, time: SystemTime) -> Self {
        let until_now = |stop: &SystemTime| *stop <= time || *stop > SystemTime::now();
        Self {
            stop: self.stop.filter(until_now),
            estop: self.estop.filter(until_now),
        }
    }

    /// The strongest stop between an earlier mark and this one.
    #[must_use]
    pub fn since(self, earlier: Self) -> Option<Urgent> {
        if self.estop != earlier.estop {
            return Some(Urgent::EStop);
        }
        (self.stop != earlier.stop).then_some(Urgent::Stop)
    }
}

/// A guest's question to the machine, which the owner sends.
pub struct Question {
    /// The request. [`crate::door::admits`] has let it through.
    pub request: Request,
    pub(crate) asked: Instant,
    pub(crate) answer: Box<dyn FnOnce(Option<Reply>) + Send>,
}

impl Question {
    /// Merges the same questions of several guests.
    pub(crate) fn shared_with(self, others: VecDeque<Self>) -> Self {
        let Self {
            request,
            asked,
            answer,
        } = self;
        Self {
            request,
            asked,
            answer: Box::new(move |reply| {
                for other in others {
                    other.answer(reply.clone());
                }
                answer(reply);
            }),
        }
    }

    /// Sends the answer to the guest; `None` if there was none.
    pub fn answer(self, reply: Option<Reply>) {
        (self.answer)(reply);
    }
}

//! What a line's owner and the others on it know of each other: who it is, which stops there were, what a guest asks.

use std::collections::VecDeque;
use std::fmt;
use std::time::{Instant, SystemTime};

use jiff::Timestamp;
use protocol::system::Urgent;
use protocol::table::{Reply, Request};
use serde::{Deserialize, Serialize};

/// The longest command that is shown, in characters.
const LONGEST_COMMAND: usize = 200;

/// The process that owns a line.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Owner {
    /// Its process number.
    pub pid: u32,
    /// Its command line.
    pub command: String,
    /// When it took the line.
    pub since: Timestamp,
}

impl Owner {
    /// This process, from now on.
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

/// A command line without the program's folder, without control characters, not too long.
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

/// Which stop and which emergency stop were the last ones on a line, whichever process wanted them. Two marks that differ
/// say that one was wanted between them: what was ordered before it must no longer move anything.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StopMark {
    pub(crate) stop: Option<SystemTime>,
    pub(crate) estop: Option<SystemTime>,
}

impl StopMark {
    /// What it was at an earlier time of this computer: a stop since then is not in it. One from the future, after the
    /// clock was set back, counts as an old one.
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

/// A guest's question to the machine, which the owner asks.
pub struct Question {
    /// The request. [`crate::door::admits`] has let it through.
    pub request: Request,
    pub(crate) asked: Instant,
    pub(crate) answer: Box<dyn FnOnce(Option<Reply>) + Send>,
}

impl Question {
    /// The same question of several guests.
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

    /// Hands the answer to the guest; `None` if there was none.
    pub fn answer(self, reply: Option<Reply>) {
        (self.answer)(reply);
    }
}

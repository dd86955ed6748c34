//! What owner and clients of a line share: the owner's description, the stops, and the clients' questions.

use std::fmt;
use std::time::{Duration, Instant, SystemTime};

use jiff::Timestamp;
use protocol::system::Urgent;
use protocol::table::{Reply, Request};
use serde::{Deserialize, Serialize};

/// Longest command that is shown, characters.
const LONGEST_COMMAND: usize = 200;

/// The process that owns a line.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Owner {
    pub pid: u32,
    pub command: String,
    /// Time at which the process took the line.
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
    /// The mark as of the start of a process, without later stops.
    #[must_use]
    pub fn before(self, began: Began) -> Self {
        let (elapsed, now) = (began.at.elapsed(), SystemTime::now());
        let before = |stop: &SystemTime| began.is_after(*stop, elapsed, now);
        Self {
            stop: self.stop.filter(before),
            estop: self.estop.filter(before),
        }
    }

    /// The strongest stop between an earlier mark and this one. A missing mark was removed as an old temporary file and
    /// is not a stop.
    #[must_use]
    pub fn since(self, earlier: Self) -> Option<Urgent> {
        let new = |mark: Option<SystemTime>, before| mark.is_some() && mark != before;
        if new(self.estop, earlier.estop) {
            return Some(Urgent::EStop);
        }
        new(self.stop, earlier.stop).then_some(Urgent::Stop)
    }
}

/// Start of a process by two clocks, because the computer's clock may be set afterwards.
#[derive(Clone, Copy, Debug)]
pub struct Began {
    time: SystemTime,
    at: Instant,
}

impl Began {
    /// A process that begins now.
    #[must_use]
    pub fn now() -> Self {
        Self {
            time: SystemTime::now(),
            at: Instant::now(),
        }
    }

    /// Whether the process began after a stop, as seen `elapsed` later, when the clock shows `now`. In doubt it did
    /// not, so that the stop applies to it.
    fn is_after(&self, stop: SystemTime, elapsed: Duration, now: SystemTime) -> bool {
        // Start of the process, by the clock as it is set now.
        let began = now.checked_sub(elapsed).unwrap_or(self.time);
        // A stop with a time in the future is from before the clock was set back. It is older than this process, unless
        // the clock can have shown that time since the start.
        stop <= began.min(self.time) || stop > now.max(self.time + elapsed)
    }
}

/// A client's question to the machine, which the owner sends.
pub struct Question {
    /// The request. [`crate::broker::admits`] has let it through.
    pub request: Request,
    pub(crate) asked: Instant,
    pub(crate) answer: Box<dyn FnOnce(Option<Reply>) + Send>,
}

impl Question {
    /// A question asked now. `answer` gets the reply, or `None` if there was none.
    pub fn new(request: Request, answer: impl FnOnce(Option<Reply>) + Send + 'static) -> Self {
        Self {
            request,
            asked: Instant::now(),
            answer: Box::new(answer),
        }
    }

    /// Sends the answer to the client; `None` if there was none.
    pub fn answer(self, reply: Option<Reply>) {
        (self.answer)(reply);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_that_was_set_hides_no_stop() {
        let second = |count: f64| SystemTime::UNIX_EPOCH + Duration::from_secs_f64(count);
        let began = Began {
            time: second(100.0),
            at: Instant::now(),
        };
        for (stop, elapsed_s, now, is_after, why) in [
            (100.6, 1, 99.85, false, "set back by 1 s after the stop"),
            (99.9, 5, 105.0, true, "a stop before"),
            (100.1, 5, 105.0, false, "a stop since"),
            (99.5, 5, 103.0, false, "set back by 2 s before the stop"),
            (104.0, 5, 103.0, false, "set back by 2 s after the stop"),
            (200.0, 5, 105.0, true, "set back long before both"),
            (104.0, 5, 905.0, false, "set forward after the stop"),
            (904.0, 5, 905.0, false, "set forward before the stop"),
            (99.9, 5, 905.0, true, "a stop before, and set forward"),
        ] {
            let elapsed = Duration::from_secs(elapsed_s);
            let found = began.is_after(second(stop), elapsed, second(now));
            assert_eq!(found, is_after, "{why}");
        }
    }
}

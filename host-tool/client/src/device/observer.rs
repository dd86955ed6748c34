//! Reports a motion to the caller, and polls the operator's requests during it.

use std::sync::Arc;

use protocol::capsule::ActuationAccepted;
use protocol::error::Refusal;
use protocol::rig::{HomeAccepted, MoveAccepted, RunAccepted};
use protocol::system::{Event, Urgent};
use protocol::table::Telemetry;
use serde::Serialize;

/// Returns the stop that the operator wants; polled at least every 20 ms of link time. It is a level, not an edge: once
/// it has returned a stop it keeps doing so, and may only escalate to an emergency stop.
pub type Interrupt = Arc<dyn Fn() -> Option<Urgent> + Send + Sync>;

/// A request of the operator during a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    Hold,
    Resume,
}

/// Returns the operator's next request; polled at least every 20 ms of link time while waiting. Each one is sent once,
/// and the device accepts or refuses it.
pub type Pacer = Box<dyn FnMut() -> Option<Pace> + Send>;

/// An action that was accepted and has begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
// Only one exists at a time, on the stack.
#[allow(clippy::large_enum_variant)]
pub enum Begun {
    Homing(HomeAccepted),
    Run(RunAccepted),
    /// Referencing, folding or unfolding.
    Actuation(ActuationAccepted),
    Move(MoveAccepted),
}

/// Progress of an action.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum Progress {
    Homing {
        /// Time since its acceptance, us.
        elapsed_us: u64,
        /// Longest possible duration, us, whether it succeeds or ends in a fault.
        #[serde(rename = "total_us")]
        at_most_us: u64,
        /// Position, um; meaningful only if the rig was homed before.
        position_um: i32,
    },
    /// A run; a move is one stroke.
    Run {
        /// Time into the run without holds, us; at most `total_us`, although a hold and a resume make the run a little
        /// longer.
        elapsed_us: u64,
        total_us: u64,
        /// Stroke in progress, from 0.
        stroke: u32,
        strokes: u32,
        /// Position by the read-back counter, um.
        position_um: i32,
        held: bool,
    },
    /// Referencing, folding or unfolding.
    Actuation {
        /// Time since its acceptance, us.
        elapsed_us: u64,
        /// Longest possible duration, us, whether it succeeds or ends in a fault.
        #[serde(rename = "total_us")]
        at_most_us: u64,
        thread_um: i32,
        current_ma: u16,
    },
}

/// Receives what happens during a wait. By default every method does nothing.
pub trait Observer {
    fn begun(&mut self, begun: &Begun) {
        let _ = begun;
    }
    /// A telemetry sample; `missed` samples were lost just before it.
    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        let _ = (sample, missed);
    }
    /// An event. Each is delivered once and in order; events lost on the link are fetched again.
    fn event(&mut self, event: &Event) {
        let _ = event;
    }
    /// Called about four times a second, or more often if the rig's link timeout is short.
    fn progress(&mut self, progress: &Progress) {
        let _ = progress;
    }
    /// The record cannot be written. Machine and wait continue.
    fn unrecorded(&mut self, why: &str) {
        let _ = why;
    }
    /// The device refused a request of the [`Pacer`]; the wait continues.
    fn refused(&mut self, pace: Pace, refusal: &Refusal) {
        let _ = (pace, refusal);
    }
    /// Called in each turn of the wait for a run or an actuation, at least every 20 ms while no request is pending,
    /// with the link's clock. It must return quickly: nothing is received from the device during the call.
    fn turn(&mut self, now_us: u64, clock: Option<Clock>) {
        let _ = (now_us, clock);
    }
}

/// Relation of a device's clock to that of its link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Clock {
    /// Link's time minus device's, us: lower and upper bound, because the device reads its clock between a request and
    /// its answer.
    pub ahead_us: (i64, i64),
}

impl Clock {
    /// The relation shown by one exchange in which the device reported `device_us`.
    pub(crate) fn of(asked_us: u64, device_us: u64, answered_us: u64) -> Self {
        // Saturate: a device that claims to have run for 300,000 years must not crash the host.
        let ahead = |link_us: u64| {
            link_us
                .cast_signed()
                .saturating_sub(device_us.cast_signed())
        };
        Self {
            ahead_us: (ahead(asked_us), ahead(answered_us)),
        }
    }

    /// Lower bound of the time that has passed on the link but not on the device since `then`, us.
    pub(crate) fn behind_us(self, then: Self) -> u64 {
        let behind_us = self.ahead_us.0.saturating_sub(then.ahead_us.1);
        u64::try_from(behind_us).unwrap_or(0)
    }
}

/// Passes everything to two observers.
pub struct Both<'a>(pub &'a mut dyn Observer, pub &'a mut dyn Observer);

impl Observer for Both<'_> {
    fn begun(&mut self, begun: &Begun) {
        self.0.begun(begun);
        self.1.begun(begun);
    }
    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        self.0.telemetry(sample, missed);
        self.1.telemetry(sample, missed);
    }
    fn event(&mut self, event: &Event) {
        self.0.event(event);
        self.1.event(event);
    }
    fn progress(&mut self, progress: &Progress) {
        self.0.progress(progress);
        self.1.progress(progress);
    }
    fn unrecorded(&mut self, why: &str) {
        self.0.unrecorded(why);
        self.1.unrecorded(why);
    }
    fn refused(&mut self, pace: Pace, refusal: &Refusal) {
        self.0.refused(pace, refusal);
        self.1.refused(pace, refusal);
    }
    fn turn(&mut self, now_us: u64, clock: Option<Clock>) {
        self.0.turn(now_us, clock);
        self.1.turn(now_us, clock);
    }
}

/// An observer that ignores everything.
#[derive(Clone, Copy, Debug)]
pub struct Unobserved;
impl Observer for Unobserved {}

#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Homed {
    /// Position of the flag in the second pass, relative to the first pass, steps.
    pub repeat_steps: i32,
    /// Shift of the reference since the previous homing, steps; 0 if the position was not trusted before.
    pub shift_steps: i32,
    /// Time from the acceptance of the request to the end, us.
    pub duration_us: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_is_behind_by_no_more_than_two_exchanges_show() {
        let then = Clock::of(100, 50, 120);
        assert_eq!(then.ahead_us, (50, 70));
        let now = Clock::of(1_100, 950, 1_130);
        assert_eq!((now.ahead_us, now.behind_us(then)), ((150, 180), 80));
        assert_eq!(then.behind_us(now), 0);
        assert_eq!(Clock::of(0, u64::MAX, 1).ahead_us, (1, 2));
    }
}

//! Knowledge of the thread. The flash keeps it as one record; no other module remembers any of it.
//!
//! The count is a lower bound: at least as much thread is on the spool. So an unfolding by count never pays out past
//! zero, and what remains on the spool is the [`uncertainty`](Known::uncertainty) at most.

use crate::sense::Counts;
use crate::units::{HOME, NEAR, SLOWS, Spooling, Thread};
use protocol::capsule::CapsuleState;
use serde::{Deserialize, Serialize};

/// Results of a calibration: a length, and currents to compare later ones with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Calibration {
    /// Thread from the unfolded end to the folded one.
    pub folded: Thread,
    /// Current of the motor with a slack thread.
    pub no_load_ma: u16,
    /// The folded thread's pull: the current of winding it less that of paying it out. Friction hardly changes it.
    pub pull_ma: u16,
    /// Rise of the current of tightening over the last half millimetre, in thousandths of that current.
    pub rise: i16,
    /// What tightening took less than folding at the same place, in thousandths of that current.
    pub lacking: i16,
    /// Back-EMF of the motor, uV per count per second.
    pub back_emf_uv_cps: u16,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Known {
    /// None before the first calibration.
    pub calibration: Option<Calibration>,
    /// Thread that is on the spool at least when the count is 0, as it is after each start of the chip.
    origin: Thread,
    /// How much more there may be. None: nothing is known, and only a hand can help.
    pub uncertainty: Option<Thread>,
    /// Thread that a reference has found to stay on the spool at the unfolded end.
    pub remaining: Thread,
    /// The thread was felt at the folded end, and nothing has moved since.
    pub felt: bool,
}

/// Most uncertain and remaining thread that a reference resolves without a hand, and within half a minute.
pub const RESOLVABLE: Thread = Thread(3_000);
/// Travel from one record in flash to the next.
pub const RECORDED_EACH: Thread = Thread(1_000);
/// Longest way that a motor runs on which is shorted before it turns round.
const TURNS: Thread = Thread(100);

impl Known {
    /// Thread on the spool at this count, at least.
    pub fn thread(&self, counts: Counts) -> Thread {
        self.origin + counts.thread()
    }

    /// The folded end by count; 0 before a calibration.
    pub fn end(&self) -> Thread {
        (self.calibration).map_or(Thread(0), |found| found.folded - self.remaining)
    }

    /// The place is known well enough to fold.
    pub fn is_certain(&self) -> bool {
        self.calibration.is_some() && self.uncertainty.is_some_and(|more| more <= NEAR)
    }

    /// State at rest with this thread on the spool.
    pub fn state(&self, thread: Thread) -> CapsuleState {
        match (self.is_certain(), self.felt) {
            (false, _) => CapsuleState::Unreferenced,
            (true, true) => CapsuleState::Folded,
            (true, false) if thread <= HOME + NEAR => CapsuleState::Unfolded,
            (true, false) => CapsuleState::Stopped,
        }
    }

    /// Takes this count as the unfolded end, as a person says.
    pub fn unfolded_here(&mut self, counts: Counts) {
        self.origin = Thread(0) - counts.thread();
        (self.uncertainty, self.remaining, self.felt) = (Some(Thread(0)), Thread(0), false);
    }

    /// Takes this as the folded end that a reference has felt. The thread that it is short of stays on the spool.
    pub fn referenced(&mut self, end: Thread) {
        let folded = self.calibration.map_or(end, |found| found.folded);
        (self.remaining, self.uncertainty) = ((folded - end).max(Thread(0)), Some(Thread(0)));
    }

    /// The count cannot be trusted any more.
    pub fn lose(&mut self) {
        (self.uncertainty, self.felt) = (None, false);
    }

    /// The record for flash in a motion at this count. It covers the next [`RECORDED_EACH`] and the run-out after it.
    pub fn moving(mut self, counts: Counts, spooling: Spooling) -> Self {
        let ahead = RECORDED_EACH + SLOWS;
        let below = match spooling {
            Spooling::Wind => TURNS,
            Spooling::PayOut => ahead,
        };
        self.origin = self.thread(counts) - below;
        self.uncertainty = self.uncertainty.map(|more| more + ahead + TURNS);
        self.felt = false;
        self
    }

    /// The record for flash at this count, once the motor stands.
    pub fn resting(mut self, counts: Counts) -> Self {
        self.origin = self.thread(counts);
        self
    }

    /// A record of `other` tells the same, and the place within this distance.
    pub fn is_like(&self, other: &Self, within: Thread) -> bool {
        let mut there = *self;
        there.origin = other.origin;
        there == *other && (self.origin - other.origin).0.abs() <= within.0
    }
}

//! What is known of the thread, and nothing else remembers anything: where zero is, how much more thread than counted
//! there may be, what the calibration found, and whether the thread was felt folded. The flash keeps it as one record.
//!
//! The count is a lower bound: at least as much thread is on the spool. So an unfolding by count never pays out past
//! zero, and what is left on the spool is the [`doubt`](Known::doubt) at most.

use crate::sample::Spooling;
use crate::units::{Counts, Thread};
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
    /// Current of paying the folded thread out, above the no-load current.
    pub paid_ma: u16,
    /// Rise of the winding current over the last half millimetre, in thousandths of that current.
    pub rise: u16,
    /// Back-EMF of the motor, uV per count per second.
    pub back_emf_uv_cps: u16,
}

/// What is known.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Known {
    /// None before the first calibration.
    pub calibration: Option<Calibration>,
    /// Thread that is on the spool at least when the count is 0.
    origin: Thread,
    /// How much more there may be. None: nothing is known, and only a hand can help.
    pub doubt: Option<Thread>,
    /// Thread that a reference has found to stay on the spool at the unfolded end.
    pub left: Thread,
    /// The thread was felt at the folded end, and nothing has moved since.
    pub felt: bool,
}

/// Most doubt and thread left on the spool that a reference resolves without a hand. More would take it longer than half
/// a minute.
pub const RESOLVABLE: Thread = Thread(3_000);
/// What is within this of a place is there: a motor stands where friction stops it. So much doubt leaves the place
/// known: a fold may then be short by it.
pub const NEAR: Thread = Thread(250);
/// Travel from one record in flash to the next.
pub const RECORDED_EACH: Thread = Thread(1_000);
/// Longest way that a motor without power runs on, paying out at full speed with a quarter less friction than usual.
const COASTS: Thread = Thread(1_200);
/// Way that a motor which is shorted before it turns round runs on.
const TURNS: Thread = Thread(100);
/// Range of a plausible calibration: the shortest and longest fold that any settings allow.
const POSSIBLE_FOLD: core::ops::RangeInclusive<i32> = 8_000..=28_000;

impl Known {
    /// Thread on the spool at this count, at least.
    pub fn thread(&self, counts: Counts) -> Thread {
        self.origin + counts.thread()
    }

    /// The folded end by count.
    pub fn end(&self) -> Option<Thread> {
        Some(self.calibration?.folded - self.left)
    }

    /// The place is known well enough to fold.
    pub fn is_certain(&self) -> bool {
        self.calibration.is_some() && self.doubt.is_some_and(|doubt| doubt <= NEAR)
    }

    /// State at rest with this thread on the spool.
    pub fn state(&self, thread: Thread) -> CapsuleState {
        if !self.is_certain() {
            CapsuleState::Unreferenced
        } else if self.felt {
            CapsuleState::Folded
        } else if thread <= NEAR {
            CapsuleState::Unfolded
        } else {
            CapsuleState::Stopped
        }
    }

    /// The counter starts anew: this count is where the record was written.
    pub fn anchor(&mut self, counts: Counts) {
        self.origin = self.origin - counts.thread();
    }

    /// A person says that this count is the unfolded end.
    pub fn unfolded_here(&mut self, counts: Counts) {
        self.origin = Thread(0) - counts.thread();
        (self.doubt, self.left, self.felt) = (Some(Thread(0)), Thread(0), false);
    }

    /// A reference has felt the folded end here: what lies beyond it stays on the spool.
    pub fn referenced(&mut self, end: Thread) {
        if let Some(calibration) = self.calibration {
            self.left = (calibration.folded - end).max(Thread(0));
            self.doubt = Some(Thread(0));
        }
    }

    /// The count cannot be trusted any more.
    pub fn lose(&mut self) {
        (self.doubt, self.felt) = (None, false);
    }

    /// What a start finds that comes within the next [`RECORDED_EACH`] of a motion which is at this count.
    pub fn moving(&self, counts: Counts, spooling: Spooling) -> Self {
        let ahead = RECORDED_EACH + COASTS;
        let (before, after) = match spooling {
            Spooling::Wind => (TURNS, ahead),
            Spooling::PayOut => (ahead, TURNS),
        };
        Self {
            origin: self.thread(counts) - before,
            doubt: self.doubt.map(|doubt| doubt + before + after),
            felt: false,
            ..*self
        }
    }

    /// What a start finds at this count, once the motor stands.
    pub fn resting(&self, counts: Counts) -> Self {
        Self {
            origin: self.thread(counts),
            ..*self
        }
    }

    /// Whether a record of `other` would tell the same. A line of the encoder that rests on its edge may flicker.
    pub fn is_like(&self, other: &Self) -> bool {
        const FLICKER: Thread = Thread(6);
        let near = (self.origin - other.origin).0.abs() <= FLICKER.0;
        near && Self {
            origin: other.origin,
            ..*self
        } == *other
    }

    /// The calibration, if there is one, fits a capsule.
    pub fn is_possible(&self) -> bool {
        (self.calibration).is_none_or(|found| POSSIBLE_FOLD.contains(&found.folded.0))
    }
}

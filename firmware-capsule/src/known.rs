//! Knowledge of the thread: where zero is, how much more thread than counted there may be, what the calibration found,
//! and whether the thread was felt folded. The flash keeps it as one record; no other module remembers any of it.
//!
//! The count is a lower bound: at least as much thread is on the spool. So an unfolding by count never pays out past
//! zero, and what remains on the spool is the [`uncertainty`](Known::uncertainty) at most.

use crate::phase::HOME;
use crate::units::{Counts, Spooling, Thread};
use protocol::{capsule::CapsuleState, settings::SettingKey};
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

/// Most uncertainty and remaining thread that a reference resolves without a hand. More would take it longer than half a
/// minute.
pub const RESOLVABLE: Thread = Thread(3_000);
/// Distance within which a place counts as reached: friction may stop a motor there. More would make a fold too short. A
/// place with this uncertainty counts as known.
pub const NEAR: Thread = Thread(200);
/// Travel from one record in flash to the next.
pub const RECORDED_EACH: Thread = Thread(1_000);
/// Longest way that a motor without power runs on, paying out at full speed with a quarter less friction than usual.
const COASTS: Thread = Thread(1_200);
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
        if !self.is_certain() {
            CapsuleState::Unreferenced
        } else if self.felt {
            CapsuleState::Folded
        } else if thread <= HOME + NEAR {
            CapsuleState::Unfolded
        } else {
            CapsuleState::Stopped
        }
    }

    /// Takes this count as the unfolded end, as a person says.
    pub fn unfolded_here(&mut self, counts: Counts) {
        self.origin = Thread(0) - counts.thread();
        (self.uncertainty, self.remaining, self.felt) = (Some(Thread(0)), Thread(0), false);
    }

    /// Takes this as the folded end that a reference has felt. The thread that it is short of stays on the spool.
    pub fn referenced(&mut self, end: Thread) {
        if let Some(calibration) = self.calibration {
            self.remaining = (calibration.folded - end).max(Thread(0));
            self.uncertainty = Some(Thread(0));
        }
    }

    /// The count cannot be trusted any more.
    pub fn lose(&mut self) {
        (self.uncertainty, self.felt) = (None, false);
    }

    /// The record for flash in a motion at this count. It covers the next [`RECORDED_EACH`] and the run-out after it.
    pub fn moving(&self, counts: Counts, spooling: Spooling) -> Self {
        let ahead = RECORDED_EACH + COASTS;
        let (before, after) = match spooling {
            Spooling::Wind => (TURNS, ahead),
            Spooling::PayOut => (ahead, TURNS),
        };
        Self {
            origin: self.thread(counts) - before,
            uncertainty: self.uncertainty.map(|more| more + before + after),
            felt: false,
            ..*self
        }
    }

    /// The record for flash at this count, once the motor stands.
    pub fn resting(&self, counts: Counts) -> Self {
        Self {
            origin: self.thread(counts),
            ..*self
        }
    }

    /// Whether a record of `other` tells the same, and the place within this distance.
    pub fn is_like(&self, other: &Self, within: Thread) -> bool {
        let near = (self.origin - other.origin).0.abs() <= within.0;
        near && Self {
            origin: other.origin,
            ..*self
        } == *other
    }

    /// The calibration, if there is one, is a fold that some settings allow.
    pub fn is_possible(&self) -> bool {
        let (shortest, longest) = (SettingKey::ShortestFoldUm, SettingKey::LongestFoldUm);
        let possible_um = shortest.range().min as i32..=longest.range().max as i32;
        (self.calibration).is_none_or(|found| possible_um.contains(&found.folded.0))
    }
}

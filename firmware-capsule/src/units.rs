//! The drive train in numbers: thread on the spool, its two directions, and lengths that several files share.
//!
//! Motor 0816K003SR (2.11 mNm/A), planetary gear 4:1 (efficiency 0.8), worm 30:1 (0.315 when winding; self-locking),
//! spool radius 1.5 mm: a newton of thread takes 23.5 mA above the no-load current. The worm's friction is not known: a
//! coefficient of 0.10 to 0.20 makes it 18 to 29 mA.

use core::ops::{Add, Sub};
use serde::{Deserialize, Serialize};

/// Thread on the spool, um. 0 is the paid-out end, positive is wound up. Saturates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Thread(pub i32);

/// Direction of the spool: winds thread onto it, or pays thread out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Spooling {
    #[default]
    Wind,
    PayOut,
}

/// Way before its target on which a phase slows down, and run-up of a fold. A motor that pays out at full speed coasts no
/// further if the power is cut, with a quarter less friction than usual.
pub const SLOWS: Thread = Thread(1_200);
/// An unfolding ends this far before zero: the run-out of the shorted motor must not be further off.
pub const HOME: Thread = Thread(40);
/// Uncertainty with which a place is known, and distance at which it is reached if friction stops the motor there.
pub const NEAR: Thread = Thread(200);

impl Spooling {
    /// A distance, a speed or a current, positive in this direction.
    pub fn along(self, value: i32) -> i32 {
        match self {
            Spooling::Wind => value,
            Spooling::PayOut => value.saturating_neg(),
        }
    }
}

impl Add for Thread {
    type Output = Self;
    fn add(self, more: Self) -> Self {
        Self(self.0.saturating_add(more.0))
    }
}

impl Sub for Thread {
    type Output = Self;
    fn sub(self, less: Self) -> Self {
        Self(self.0.saturating_sub(less.0))
    }
}

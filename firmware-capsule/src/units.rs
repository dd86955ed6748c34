//! The drive train in numbers: encoder counts, thread on the spool, and the two directions.
//!
//! Motor 0816K003SR (2.11 mNm/A), planetary gear 4:1 (efficiency 0.8), worm 30:1 (0.315 when winding; self-locking),
//! spool radius 1.5 mm: a newton of thread takes 23.5 mA above the no-load current. The worm's friction is not known: a
//! coefficient of 0.10 to 0.20 makes it 18 to 29 mA.

use core::ops::{Add, Sub};
use serde::{Deserialize, Serialize};

/// Encoder counts: 16 lines of four edges per motor revolution. Positive winds the thread up. Wraps as the counter
/// does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Counts(pub i32);

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

impl Spooling {
    /// A distance, a speed or a current, positive in this direction.
    pub fn along(self, value: i32) -> i32 {
        match self {
            Spooling::Wind => value,
            Spooling::PayOut => value.saturating_neg(),
        }
    }
}

/// One count is `2 pi * 1500 um / (4 * 30 * 64)` of thread. With pi = 355/113 (8e-8 off) that is 8875/7232 um.
const UM_PER_COUNT: (i64, i64) = (8875, 7232);

/// A ratio below 2 with 31 binary places: the chip multiplies to 64 bits in a cycle, and divides them in hundreds.
const fn ratio((numerator, denominator): (i64, i64)) -> i64 {
    ((numerator << 31) + denominator / 2) / denominator
}

const fn rescale(value: i32, ratio: i64) -> i64 {
    (value as i64 * ratio + (1 << 30)) >> 31
}

impl Counts {
    /// Length of thread, rounded to the nearest um.
    pub fn thread(self) -> Thread {
        let um = rescale(self.0, const { ratio(UM_PER_COUNT) });
        Thread(um.clamp(i32::MIN.into(), i32::MAX.into()) as i32)
    }
}

impl Thread {
    /// Encoder counts, rounded to the nearest count.
    pub const fn counts(self) -> Counts {
        // Fewer than there are um, so they fit.
        Counts(rescale(self.0, const { ratio((UM_PER_COUNT.1, UM_PER_COUNT.0)) }) as i32)
    }
}

impl Add for Counts {
    type Output = Self;
    fn add(self, more: Self) -> Self {
        Self(self.0.wrapping_add(more.0))
    }
}

impl Sub for Counts {
    type Output = Self;
    fn sub(self, less: Self) -> Self {
        Self(self.0.wrapping_sub(less.0))
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

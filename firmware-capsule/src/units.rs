//! The drive train in numbers: encoder counts, and thread on the spool.
//!
//! Model motor 0816K003SR: 5.4 ohm, 2.11 mNm/A, no-load current 16 mA. Planetary gear 4:1 (efficiency 0.8), worm
//! 30:1 (efficiency 0.315 when winding; self-locking), spool radius 1.5 mm. Above the no-load current a thread force F
//! thus takes `F * 1.5 mm / (120 * 0.8 * 0.315) / 2.11 mNm/A`, which is 23.5 mA per newton. The worm's friction is
//! not known: a coefficient of 0.10 to 0.20 makes it 18 to 29 mA per newton.

use core::ops::{Add, Sub};
use serde::{Deserialize, Serialize};

/// Encoder counts: 16 lines of four edges per motor revolution. Positive winds the thread up. Wraps as the counter
/// does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Counts(pub i32);

/// Thread on the spool, um. 0 is the paid-out end, positive is wound up. Saturates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Thread(pub i32);

/// One count is `2 pi * 1500 um / (4 * 30 * 64)` of thread. With pi = 355/113 (8e-8 off) that is 8875/7232 um.
const THREAD_PER_COUNT: (i64, i64) = (8875, 7232);

impl Counts {
    /// Length of thread, rounded to the nearest um.
    pub const fn thread(self) -> Thread {
        Thread(rescale(self.0, THREAD_PER_COUNT))
    }
}

impl Thread {
    /// Encoder counts, rounded to the nearest count.
    pub const fn counts(self) -> Counts {
        let (um, counts) = THREAD_PER_COUNT;
        Counts(rescale(self.0, (counts, um)))
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

const fn rescale(value: i32, (numerator, denominator): (i64, i64)) -> i32 {
    // Up to 240 mm: the chip divides 32 bits in 12 cycles, and 64 bits in hundreds.
    if value.unsigned_abs() <= 200_000 {
        let (numerator, denominator) = (numerator as i32, denominator as i32);
        let half = if value < 0 {
            -denominator / 2
        } else {
            denominator / 2
        };
        return (value * numerator + half) / denominator;
    }
    // |value * numerator| < 2^31 * 2^14: no overflow.
    let product = value as i64 * numerator;
    let half = if product < 0 {
        -denominator / 2
    } else {
        denominator / 2
    };
    let quotient = (product + half) / denominator;
    if quotient > i32::MAX as i64 {
        i32::MAX
    } else if quotient < i32::MIN as i64 {
        i32::MIN
    } else {
        quotient as i32
    }
}

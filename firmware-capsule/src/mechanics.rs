//! The drive train in numbers: encoder, gears, spool, thread, and forces as motor currents.
//!
//! Model motor 0816K003SR: 5.4 ohm, 2.11 mNm/A, no-load current 16 mA. Planetary gear 4:1 (efficiency 0.8), worm
//! 30:1 (efficiency 0.315 when winding; self-locking), spool radius 1.5 mm. Above the no-load current a thread force F
//! thus takes `F * 1.5 mm / (120 * 0.8 * 0.315) / 2.11 mNm/A`, which is 23.5 mA per newton. The worm's friction is
//! not known: a coefficient of 0.10 to 0.20 makes it 18 to 29 mA per newton.

/// Encoder counts: 16 lines of four edges per motor revolution. Positive winds the thread up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Counts(pub i32);

/// Thread on the spool, um. 0 is the paid-out end, positive is wound up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Thread(pub i32);

/// One count is `2 pi * 1500 um / (4 * 30 * 64)` of thread. With pi = 355/113 (8e-8 off) that is 8875/7232 um.
const THREAD_NUMERATOR: i64 = 8875;
/// Denominator of the same fraction.
const THREAD_DENOMINATOR: i64 = 7232;

impl Counts {
    /// Counts from `origin` to here, also across a wrap of the 32-bit counter.
    pub const fn since(self, origin: Counts) -> Counts {
        Counts(self.0.wrapping_sub(origin.0))
    }

    /// The count `distance` before this one. Wraps as the counter does.
    pub const fn back(self, distance: Counts) -> Counts {
        Counts(self.0.wrapping_sub(distance.0))
    }

    /// Length of thread, rounded to the nearest um. Saturates: half the counter's range is 2.6 km of thread.
    pub const fn thread(self) -> Thread {
        Thread(rescale(self.0, THREAD_NUMERATOR, THREAD_DENOMINATOR))
    }
}

impl Thread {
    /// Encoder counts, rounded to the nearest count.
    pub const fn counts(self) -> Counts {
        Counts(rescale(self.0, THREAD_DENOMINATOR, THREAD_NUMERATOR))
    }
}

const fn rescale(value: i32, numerator: i64, denominator: i64) -> i32 {
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

/// Largest plausible no-load current, mA: a higher one was not measured on a slack thread.
pub const MOST_NO_LOAD_MA: u16 = 30;

/// Deceleration of a motor that coasts without load, counts/s2 per mA of no-load current: friction over inertia.
pub const COASTING_CPS2_PER_MA: u32 = 4_200;

/// Minimum length of thread from half of the end force to all of it that can be the origami's. The origami takes 1.6
/// mm; with half to four times the assumed stiffness 1.0 to 3 mm. A hard stop or a caught thread takes almost none.
pub const LEAST_RISE: Thread = Thread(500);

/// Range of a plausible calibration: the shortest and longest fold that any settings allow.
pub const POSSIBLE_FOLD: (Thread, Thread) = (Thread(8_000), Thread(28_000));

/// Safety margin subtracted from the calibrated length where a folded capsule's end is found again: the worst error
/// seen was 0.1 mm, and an unfolding must not pass zero.
pub const FOUND_AGAIN: Thread = Thread(100);
/// The same margin where only the rise of the force has told the end. Something soft in the way, of 0.3 to 300 N/mm at
/// any place, can raise the force like the origami and end the run up to 1.1 mm early.
pub const FOUND_BY_RISE: Thread = Thread(1_300);
/// Thread that a reference run backs off before it feels again whether the thread pulls. Less than the slack, so that
/// a thread that pulled before cannot be paid out past zero.
pub const BACK_OFF: Thread = Thread(700);
/// Most back-offs, if the thread keeps pulling: the rise from a quarter of the end force takes up to 4.4 mm.
pub const BACK_OFFS: u8 = 14;

#[cfg(test)]
#[path = "../tests/unit/mechanics.rs"]
mod tests;

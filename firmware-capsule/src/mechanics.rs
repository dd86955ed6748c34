//! The drive train in numbers: encoder, gears, spool, thread, and forces as motor currents.
//!
//! Model motor 0816K003SR: 5.4 ohm, 2.11 mNm/A, no-load current 16 mA. Planetary gear 4:1 (efficiency 0.8), worm
//! 30:1 (efficiency 0.315 when winding; self-locking), spool radius 1.5 mm. Above the no-load current a thread force F
//! thus takes `F * 1.5 mm / (120 * 0.8 * 0.315) / 2.11 mNm/A`, which is 23.5 mA per newton.

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

/// Winding resistance of the motor.
pub const MOTOR_MILLIOHM: u32 = 5_400;

/// No-load current from the data sheet. The first fold from a slack thread replaces it with a measurement.
pub const NO_LOAD_MA: u16 = 16;

/// Slack of the paid-out thread: this much is wound before the origami feels it.
pub const SLACK: Thread = Thread(1_000);

/// Thread on the spool at the end force: 20.7 mm of travel at 6.1 N by the beam estimate, plus the slack, less
/// 0.2 mm. The 0.2 mm put the zero inside the slack, so that a small error of the estimate does not pay out more
/// thread than the slack has.
pub const FOLDED: Thread = Thread(20_700 + SLACK.0 - 200);

/// From here on the end force means folded. Before, it is an obstacle.
pub const END_WINDOW: Thread = Thread(20_000);

/// The thread is never wound past this: longest travel of the origami (its wall meets the core), plus the slack.
pub const SOFT_MAXIMUM: Thread = Thread(23_500 + SLACK.0);

/// Longest way to the folded end from an unknown position: the soft maximum, plus 4 mm that an interrupted back-off
/// may have paid out too far.
pub const SEEK_LIMIT: Thread = Thread(SOFT_MAXIMUM.0 + 4_000);

/// How far a reference run backs off before its second try.
pub const BACK_OFF: Thread = Thread(4_000);

/// Current at the end force, 6.1 N.
pub const FORCE_MA: u16 = 160;

/// Current at 3 N: start of the rise that tells an origami from an obstacle.
pub const RISE_START_MA: u16 = 87;

/// Least thread wound between [`RISE_START_MA`] and [`FORCE_MA`] if it is the origami that pulls. The origami takes
/// 1.6 mm, with half or twice the assumed stiffness still 1.2 to 1.9 mm; a hard stop or a caught thread takes almost
/// none.
pub const LEAST_RISE: Thread = Thread(500);

#[cfg(test)]
#[path = "../tests/unit/mechanics.rs"]
mod tests;

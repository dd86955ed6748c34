//! Units as types, so that micrometres cannot be passed as steps.

use core::fmt;

/// Frequency of the step timer, ticks per second: one tick is 10 ns.
pub const TICK_HZ: u64 = 100_000_000;

/// Ticks per microsecond.
pub const TICKS_PER_US: u64 = TICK_HZ / 1_000_000;

/// A number of microsteps: a distance, without a direction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Steps(pub u32);

/// A carriage position in microsteps as the value of a counter: 0 is home, positive is away from home.
///
/// Unlike [`crate::axis::Position`] it may lie outside the stroke, and it is undefined until homing has set the
/// counter. Its methods with a direction are in [`crate::axis`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct StepPosition(pub i32);

/// Positions from `first` to `last`, both included. With `first` above `last` it is empty.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Window {
    /// The position nearest to home.
    pub first: StepPosition,
    /// The position farthest from home.
    pub last: StepPosition,
}

/// A length in micrometres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Micrometres(pub u32);

/// A time or a duration in ticks of the step timer, [`TICK_HZ`] per second.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Ticks(pub u64);

impl StepPosition {
    /// The position at which the counter is zero.
    pub const HOME: Self = Self(0);

    /// Steps from `other` to here, positive if here is farther from home.
    ///
    /// Wraps if the two are 2^31 steps apart or more. No axis reaches that: its stroke holds fewer than 2^25 steps, and
    /// 2^31 steps at the highest step rate, 1 MHz, take 35 minutes in one direction.
    #[must_use]
    pub const fn since(self, other: Self) -> i32 {
        self.0.wrapping_sub(other.0)
    }

    /// Steps between the two, exact for any two positions.
    #[must_use]
    pub const fn distance_to(self, other: Self) -> Steps {
        Steps(self.0.abs_diff(other.0))
    }
}

impl Window {
    /// The window from one position to the other, given in either order.
    #[must_use]
    pub const fn between(a: StepPosition, b: StepPosition) -> Self {
        if a.0 <= b.0 {
            Self { first: a, last: b }
        } else {
            Self { first: b, last: a }
        }
    }

    /// Whether the position is in the window, ends included.
    #[must_use]
    pub const fn contains(&self, position: StepPosition) -> bool {
        self.first.0 <= position.0 && position.0 <= self.last.0
    }
}

impl Ticks {
    /// Converts microseconds; `None` if the ticks do not fit 64 bits (5,800 years).
    #[must_use]
    pub const fn from_us(us: u64) -> Option<Self> {
        match us.checked_mul(TICKS_PER_US) {
            Some(ticks) => Some(Self(ticks)),
            None => None,
        }
    }

    /// Whole microseconds, rounded up, so that the result is never shorter than this time.
    #[must_use]
    pub const fn to_us_ceil(self) -> u64 {
        self.0.div_ceil(TICKS_PER_US)
    }
}

/// `value / 10^decimals`, written exactly and without trailing zeros; `decimals` is at most 19.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Decimal {
    /// The number in its smallest unit.
    pub value: u64,
    /// Number of decimals that the smallest unit stands for.
    pub decimals: u32,
}

impl Decimal {
    /// Micrometres, with or without a time in their unit, as millimetres.
    #[must_use]
    pub const fn milli(value: u64) -> Self {
        Self { value, decimals: 3 }
    }

    /// Microseconds as seconds.
    #[must_use]
    pub const fn micro(value: u64) -> Self {
        Self { value, decimals: 6 }
    }
}

impl fmt::Display for Decimal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scale = 10_u64.pow(self.decimals);
        let (whole, mut fraction) = (self.value / scale, self.value % scale);
        if fraction == 0 {
            return write!(f, "{whole}");
        }
        let mut width = self.decimals as usize;
        while fraction.is_multiple_of(10) {
            fraction /= 10;
            width -= 1;
        }
        write!(f, "{whole}.{fraction:0width$}")
    }
}

impl fmt::Display for Steps {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} steps", self.0)
    }
}

/// Written as `step -3`.
impl fmt::Display for StepPosition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "step {}", self.0)
    }
}

/// In millimetres with three decimals.
impl fmt::Display for Micrometres {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:03} mm", self.0 / 1_000, self.0 % 1_000)
    }
}

/// In seconds with eight decimals: exact.
impl fmt::Display for Ticks {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:08} s", self.0 / TICK_HZ, self.0 % TICK_HZ)
    }
}

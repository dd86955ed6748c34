//! Units as types, so that a micrometre is never taken for a step.

use core::fmt;

/// Frequency of the step timer, ticks per second: one tick is 10 ns.
pub const TICK_HZ: u64 = 100_000_000;

/// Ticks per microsecond.
pub const TICKS_PER_US: u64 = TICK_HZ / 1_000_000;

/// A number of microsteps, always a distance: the direction is told separately.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Steps(pub u32);

/// A length in micrometres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Micrometres(pub u32);

/// A length in nanometres: fine enough to tell every microstep of every allowed axis apart.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Nanometres(pub u64);

/// A time or a duration in ticks of the step timer, [`TICK_HZ`] per second.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Ticks(pub u64);

impl Nanometres {
    /// To the nearest micrometre, half upward.
    #[must_use]
    pub const fn to_um(self) -> u64 {
        self.0.saturating_add(500) / 1_000
    }
}

impl Ticks {
    /// From microseconds; none if it does not fit 64 bits (5,800 years).
    #[must_use]
    pub const fn from_us(us: u64) -> Option<Self> {
        match us.checked_mul(TICKS_PER_US) {
            Some(ticks) => Some(Self(ticks)),
            None => None,
        }
    }

    /// Whole microseconds, rounded up: a time that suffices.
    #[must_use]
    pub const fn to_us_ceil(self) -> u64 {
        self.0.div_ceil(TICKS_PER_US)
    }
}

impl fmt::Display for Steps {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} steps", self.0)
    }
}

/// In millimetres with three decimals.
impl fmt::Display for Micrometres {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:03} mm", self.0 / 1_000, self.0 % 1_000)
    }
}

/// In millimetres with six decimals.
impl fmt::Display for Nanometres {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:06} mm", self.0 / 1_000_000, self.0 % 1_000_000)
    }
}

/// In seconds with eight decimals: exact.
impl fmt::Display for Ticks {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:08} s", self.0 / TICK_HZ, self.0 % TICK_HZ)
    }
}

//! A move from rest to rest: a symmetric trapezoid of speed over time, defined by three integers.
//!
//! With `n` steps, duration `T` and ramp `r` in ticks, 0 < r <= T/2, the acceleration is
//! n / (r (T - r)), the peak speed n / (T - r), and step k happens at
//!
//! ```text
//! acceleration  t = sqrt(k C)             C = 2 r (T - r) / n, while t <= r
//! cruise        t = r/2 + k (T - r) / n
//! deceleration  t = T - sqrt((n - k) C)
//! ```
//!
//! Only the three integers define the profile. A speed in um/s is an input for finding them.

use core::fmt;

use crate::axis::{Acceleration, Axis, Speed};
use crate::units::{Decimal, Steps, TICK_HZ, Ticks};

/// Maximum steps of one stroke. The finest axis has 26.6 M in 130 mm.
pub const MAX_STEPS: Steps = Steps(1 << 25);

/// Shortest interval between two successive steps of a profile: 1 us, 1 MHz.
pub const MIN_INTERVAL: Ticks = Ticks(100);

/// Longest interval between two successive steps of a profile: 10.7 s.
pub const MAX_INTERVAL: Ticks = Ticks((1 << 30) - 1);

/// A move of `steps` from rest to rest in `duration`, with ramps of `ramp` at both ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StrokeProfile {
    steps: u32,
    duration_ticks: u64,
    ramp_ticks: u64,
}

impl StrokeProfile {
    /// The profile with these three integers.
    ///
    /// # Errors
    /// No steps or more than [`MAX_STEPS`]; a ramp outside 1..=duration/2; intervals below
    /// [`MIN_INTERVAL`] or above [`MAX_INTERVAL`]; or so slow that step times would overflow:
    /// 2 r (T - r) must be below 2^62 and 2 n T below 2^60.
    pub fn from_parts(steps: Steps, duration: Ticks, ramp: Ticks) -> Result<Self, StrokeError> {
        let (n, t, r) = (steps.0, duration.0, ramp.0);
        if n == 0 {
            return Err(StrokeError::NoSteps);
        }
        if n > MAX_STEPS.0 {
            return Err(StrokeError::TooManySteps { steps: n });
        }
        if r == 0 || r > t / 2 {
            return Err(StrokeError::Ramp { duration, ramp });
        }
        let span = t - r;
        if span / u64::from(n) < MIN_INTERVAL.0 {
            return Err(StrokeError::TooFast {
                interval: Ticks(span / u64::from(n)),
            });
        }
        let bound = |product: Option<u64>, bits: u32| product.is_some_and(|p| p >> bits == 0);
        let square = r.checked_mul(span).and_then(|p| p.checked_mul(2));
        let area = t.checked_mul(2 * u64::from(n));
        let profile = Self {
            steps: n,
            duration_ticks: t,
            ramp_ticks: r,
        };
        if !bound(square, 62) || !bound(area, 60) || profile.first_interval().0 > MAX_INTERVAL.0 {
            return Err(StrokeError::TooSlow { duration });
        }
        Ok(profile)
    }

    /// The profile of exactly this duration with the lowest peak speed: its ramp is the shortest
    /// whose acceleration is at most the requested one.
    ///
    /// # Errors
    /// [`StrokeError::Infeasible`] if even a triangle needs more acceleration; it contains the duration and the
    /// acceleration that would suffice. Otherwise as [`StrokeProfile::from_parts`].
    pub fn from_duration(
        steps: Steps,
        duration: Ticks,
        acceleration: Acceleration,
    ) -> Result<Self, StrokeError> {
        if steps.0 == 0 {
            return Err(StrokeError::NoSteps);
        }
        let square = acceleration.least_square(steps);
        let product = |r: u64| u128::from(r) * u128::from(duration.0 - r);
        let half = duration.0 / 2;
        if product(half) < square {
            return Err(StrokeError::Infeasible {
                minimal_duration: shortest(square),
                minimal_accel_um_s2: acceleration.least_for(steps, product(half)),
            });
        }
        let ramp = least(1, half, |r| product(r) >= square);
        Self::from_parts(steps, duration, Ticks(ramp))
    }

    /// The shortest profile within this speed and this acceleration. A move too short to reach the
    /// speed becomes a triangle; [`StrokeProfile::peak_um_s`] is the speed it reaches.
    ///
    /// # Errors
    /// As [`StrokeProfile::from_parts`].
    pub fn from_speed(
        steps: Steps,
        speed: Speed,
        acceleration: Acceleration,
    ) -> Result<Self, StrokeError> {
        if steps.0 == 0 {
            return Err(StrokeError::NoSteps);
        }
        Self::shortest_within(
            steps,
            speed.least_span(steps),
            acceleration.least_square(steps),
        )
    }

    /// The rest of a stopped stroke: the shortest profile of the `remaining` steps within this profile's peak speed and
    /// acceleration.
    ///
    /// # Errors
    /// As [`StrokeProfile::from_parts`].
    pub fn resumed(&self, remaining: Steps) -> Result<Self, StrokeError> {
        if remaining.0 == 0 {
            return Err(StrokeError::NoSteps);
        }
        let (remaining_steps, n) = (u128::from(remaining.0), u128::from(self.steps));
        let span = u128::from(self.duration_ticks - self.ramp_ticks);
        let square = span * u128::from(self.ramp_ticks);
        Self::shortest_within(
            remaining,
            (remaining_steps * span).div_ceil(n),
            (remaining_steps * square).div_ceil(n),
        )
    }

    /// The shortest profile with a peak speed of at most steps / span and an acceleration of at most
    /// steps / square.
    pub(crate) fn shortest_within(
        steps: Steps,
        span: u128,
        square: u128,
    ) -> Result<Self, StrokeError> {
        let ramp = square.div_ceil(span);
        if ramp >= span {
            let duration = shortest(square);
            return Self::from_parts(steps, duration, Ticks(duration.0 / 2));
        }
        let ticks = |value: u128| Ticks(u64::try_from(value).unwrap_or(u64::MAX));
        Self::from_parts(steps, ticks(ramp + span), ticks(ramp))
    }

    /// The longest ramp, up to `most`, for which a profile of this duration has exact step times; `None` if no ramp
    /// has. A longer ramp makes the first steps slower.
    pub(crate) fn longest_ramp(steps: Steps, duration: Ticks, most: u64) -> Option<Ticks> {
        let is_too_slow = |ramp| {
            let profile = Self::from_parts(steps, duration, Ticks(ramp));
            matches!(profile, Err(StrokeError::TooSlow { .. }))
        };
        let longest = match least(1, most, is_too_slow) {
            ramp if is_too_slow(ramp) => ramp - 1,
            ramp => ramp,
        };
        (longest > 0).then_some(Ticks(longest))
    }

    #[must_use]
    pub const fn steps(&self) -> Steps {
        Steps(self.steps)
    }

    /// Time from rest to rest: the tick of the last step.
    #[must_use]
    pub const fn duration(&self) -> Ticks {
        Ticks(self.duration_ticks)
    }

    /// Duration of each of the two ramps.
    #[must_use]
    pub const fn ramp(&self) -> Ticks {
        Ticks(self.ramp_ticks)
    }

    /// Ticks that all steps would take at peak speed: duration - ramp.
    #[must_use]
    pub const fn span(&self) -> Ticks {
        Ticks(self.duration_ticks - self.ramp_ticks)
    }

    /// 2 r (T - r), that is n C.
    pub(crate) const fn square(&self) -> u64 {
        2 * self.ramp_ticks * (self.duration_ticks - self.ramp_ticks)
    }

    /// Steps within each of the two ramps; the rest is cruise.
    #[must_use]
    pub const fn ramp_steps(&self) -> Steps {
        let span = self.duration_ticks - self.ramp_ticks;
        Steps((self.steps as u64 * self.ramp_ticks / (2 * span)) as u32)
    }

    /// Ticks from rest to the first step, and from the last but one to the last.
    #[must_use]
    pub fn first_interval(&self) -> Ticks {
        let n = u64::from(self.steps);
        let span = self.span().0;
        if self.steps == 1 {
            self.duration()
        } else if self.ramp_steps().0 == 0 {
            Ticks((n * self.ramp_ticks + 2 * span + n) / (2 * n))
        } else {
            // The square is below 2^62 for every accepted profile.
            Ticks((4 * self.square() / n).isqrt().div_ceil(2))
        }
    }

    /// A lower bound of all intervals between two steps, reached in cruise.
    #[must_use]
    pub const fn min_interval(&self) -> Ticks {
        Ticks(self.span().0 / self.steps as u64)
    }

    /// Peak speed achieved, um/s, to the nearest integer.
    #[must_use]
    pub fn peak_um_s(&self, axis: &Axis) -> u32 {
        axis.scaled_um(self.steps, u128::from(TICK_HZ), u128::from(self.span().0))
    }

    /// Acceleration achieved, um/s^2, to the nearest integer.
    #[must_use]
    pub fn accel_um_s2(&self, axis: &Axis) -> u32 {
        axis.scaled_um(
            self.steps,
            u128::from(TICK_HZ) * u128::from(TICK_HZ),
            u128::from(self.span().0) * u128::from(self.ramp_ticks),
        )
    }

    /// Whether the peak speed is at most `speed`, compared exactly.
    #[must_use]
    pub fn within(&self, speed: Speed) -> bool {
        u128::from(self.span().0) >= speed.least_span(self.steps())
    }
}

/// The shortest duration whose triangle has r (T - r) >= square. That is ceil(sqrt(4 square)),
/// because floor(T/2) ceil(T/2) = floor(T^2 / 4).
fn shortest(square: u128) -> Ticks {
    Ticks(least(1, 1 << 60, |t| {
        u128::from(t) * u128::from(t) >= 4 * square
    }))
}

/// The least value in `low..=high` for which the monotone condition holds; `high` if it never does.
fn least(mut low: u64, mut high: u64, holds: impl Fn(u64) -> bool) -> u64 {
    while low < high {
        let middle = low + (high - low) / 2;
        if holds(middle) {
            high = middle;
        } else {
            low = middle + 1;
        }
    }
    low
}

/// The reason why a stroke was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StrokeError {
    NoSteps,
    /// More than [`MAX_STEPS`].
    TooManySteps {
        steps: u32,
    },
    /// Not 0 < ramp <= duration / 2.
    Ramp {
        duration: Ticks,
        ramp: Ticks,
    },
    /// Steps would be closer than [`MIN_INTERVAL`].
    TooFast {
        /// The interval at peak speed.
        interval: Ticks,
    },
    /// Too slow for exact step times in 64 bits.
    TooSlow {
        duration: Ticks,
    },
    /// Too little time at this acceleration. Changing either number alone is enough; both are exact.
    Infeasible {
        /// The shortest duration at this acceleration.
        minimal_duration: Ticks,
        /// The least whole acceleration for this duration, um/s^2.
        minimal_accel_um_s2: u64,
    },
}

impl fmt::Display for StrokeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::NoSteps => write!(f, "the move is shorter than one step: make it longer"),
            Self::TooManySteps { steps } => write!(
                f,
                "{steps} steps in one stroke are more than {}: use fewer microsteps",
                MAX_STEPS.0
            ),
            Self::Ramp { duration, ramp } => write!(
                f,
                "a ramp of {ramp} does not fit a stroke of {duration}: use more than zero and at most half"
            ),
            Self::TooFast { interval } => write!(
                f,
                "steps would be {} ticks apart, less than {}: go slower or use fewer microsteps",
                interval.0, MIN_INTERVAL.0
            ),
            Self::TooSlow { duration } => write!(
                f,
                "a stroke of {duration} is too slow for exact step times: use more speed, more acceleration or finer microsteps"
            ),
            Self::Infeasible {
                minimal_duration,
                minimal_accel_um_s2,
            } => write!(
                f,
                "too little time: allow at least {minimal_duration} for the stroke, or accelerate with at least {} mm/s2",
                Decimal::milli(minimal_accel_um_s2)
            ),
        }
    }
}

impl core::error::Error for StrokeError {}
